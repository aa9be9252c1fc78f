"""Linear algebra of small symmetric matrices on symbols, without a branch."""

from __future__ import annotations

import math

import numpy as np

from approxjac import law
from approxjac.codegen.trace.symbols import Condition, Number, Scalar, Symbols, select, symbols
from approxjac.law.factors import Factors

_SWEEPS = {1: 0, 2: 1, 3: 5}
_MANY_SWEEPS = 7  # beyond three rows
_LARGE = 200  # entries of a matrix, beyond which its product is a loop


def solved(A: Symbols, b: Symbols) -> Symbols:
    """Return A⁻¹b of a symmetric A (n, n), or of any of at most three rows."""
    n, rows = len(A), A.tolist()
    if all(same(rows[i][j], rows[j][i]) for i in range(n) for j in range(i)):
        return Factors(A).solve(b)
    if n > 3:
        raise TypeError("no solution with a matrix that is not known yet, nor symmetric, n > 3")
    return symbols(_inverse(rows)) @ b


def same(a: Number, b: Number) -> bool:
    """Return whether two numbers are surely the same."""
    if isinstance(a, Scalar) and isinstance(b, Scalar):
        return a.place == b.place
    return not isinstance(a, Scalar) and not isinstance(b, Scalar) and bool(a == b)


def _inverse(rows: list[list[Number]]) -> list[list[Number]]:
    """Return the inverse of a matrix of at most three rows, by its cofactors."""
    n = len(rows)
    if n == 1:
        return [[1.0 / rows[0][0]]]

    def cofactor(i: int, j: int) -> Number:
        if n == 2:
            return rows[1 - i][1 - j] * (1.0 if i == j else -1.0)
        (a, b), (c, d) = ((i + 1) % 3, (i + 2) % 3), ((j + 1) % 3, (j + 2) % 3)
        return rows[a][c] * rows[b][d] - rows[a][d] * rows[b][c]

    cofactors = [[cofactor(i, j) for j in range(n)] for i in range(n)]
    determinant: Number = sum((rows[0][j] * cofactors[0][j] for j in range(n)), 0.0)
    return [[cofactors[j][i] / determinant for j in range(n)] for i in range(n)]


def eigensystem(A: Symbols) -> tuple[Symbols, Symbols]:
    """Return eigenvalues (n,), in no order, and -vectors (n, n) of a symmetric A (n, n).

    By Jacobi's rotations.
    """
    n, a = len(A), [list(row) for row in A.tolist()]
    if not any(isinstance(each, Scalar) for row in a for each in row):
        squares, U = np.linalg.eigh(a)
        return symbols(squares.tolist()), symbols(U.tolist())
    upper = np.triu_indices(n)

    def sweep(_: object, values: tuple[Symbols, Symbols]) -> tuple[Symbols, Symbols]:
        whole = symbols(np.zeros((n, n)))
        whole[upper] = whole.T[upper] = values[0]
        a, vectors = whole.tolist(), values[1].tolist()
        for p in range(n):
            for q in range(p + 1, n):
                _rotate(a, vectors, p, q)
        return symbols(a)[upper], symbols(vectors)

    start = symbols(a)[upper], symbols(np.eye(n))
    found, vectors = law.repeat(_SWEEPS.get(n, _MANY_SWEEPS), sweep, start)
    diagonal = symbols(np.zeros((n, n)))
    diagonal[upper] = found
    return diagonal.diagonal(), vectors


def _rotate(a: list[list[Number]], vectors: list[list[Number]], p: int, q: int) -> None:
    """Make a[p][q] zero."""
    off = a[p][q]
    if not isinstance(off, Scalar) and off == 0.0:
        return
    ratio = (a[q][q] - a[p][p]) / (off + off)
    size = abs(ratio)
    tangent: Number = 1.0 / (size + _root(size * size + 1.0))
    tangent = select(ratio < 0.0, -tangent, tangent)
    tangent = select(off == 0.0, 0.0, tangent)
    cosine = 1.0 / _root(tangent * tangent + 1.0)
    sine = tangent * cosine
    a[p][p], a[q][q] = a[p][p] - tangent * off, a[q][q] + tangent * off
    a[p][q] = a[q][p] = 0.0
    for row in vectors:
        row[p], row[q] = cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]
    for r in range(len(a)):
        if r not in (p, q):
            left, right = a[r][p], a[r][q]
            a[r][p] = a[p][r] = cosine * left - sine * right
            a[r][q] = a[q][r] = sine * left + cosine * right


def _root(a: Number) -> Number:
    return a.sqrt() if isinstance(a, Scalar) else math.sqrt(a)


def is_regular(G: Symbols, ratio: float, scale: float) -> Condition:
    """Return whether σ_min of J is surely above a share of σ_max and of a scale, from G = J Jᵀ."""
    if len(G) <= 3:
        _, _, bound, trace = law.adjugate(G.tolist())
        return law.is_surely_regular(bound, trace, ratio, scale)
    trace = G.trace()
    largest = Factors(G).solve(symbols(np.eye(len(G)))).trace()  # at least 1 / least eigenvalue
    regular = (ratio**2 * trace * largest < 1.0) & (trace > len(G) * scale**2)
    return regular & (largest > 0.0)
