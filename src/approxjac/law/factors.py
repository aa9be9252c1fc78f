"""`Factors`: a small symmetric matrix as LDLᵀ, of numbers or symbols; large ones by loops."""

from typing import Any

import numpy as np

from approxjac.law.branches import array, collect, repeat, take
from approxjac.validation import Array


class Factors:
    """A = LDLᵀ of a symmetric positive definite A (n, n)."""

    def __init__(self, A: Array) -> None:
        n, self._kind = len(A), type(A)
        self._L: list[list[Any]] = [[0.0] * n for _ in range(n)]
        self._inverse: list[Any] = []  # of D
        self.pivots: list[Any] = []  # D
        scaled: list[list[Any]] = [[0.0] * n for _ in range(n)]  # LD
        for i in range(n):
            for j in range(i + 1):
                total: Any = A[i, j]
                for k in range(j):
                    total = total - scaled[i][k] * self._L[j][k]
                if j < i:
                    scaled[i][j], self._L[i][j] = total, total * self._inverse[j]
            self.pivots.append(total)
            self._inverse.append(1.0 / total)

    def solve(self, b: Array) -> Array:
        """Return A⁻¹b, b of shape (n,) or (n, k)."""
        if b.ndim == 2:
            return np.stack([self.solve(column) for column in b.T]).T
        n, z = len(b), b.tolist()
        for i in range(n):
            for k in range(i):
                z[i] = z[i] - self._L[i][k] * z[k]
        z = [each * inverse for each, inverse in zip(z, self._inverse, strict=True)]
        for i in reversed(range(n)):
            for k in range(i + 1, n):
                z[i] = z[i] - self._L[k][i] * z[k]
        solved: Array = array(z)
        if solved.dtype.hasobject or self._kind is np.ndarray:
            return solved
        return solved.astype(object).view(self._kind)  # constants among symbols


def inverse(A: Array) -> Array:
    """Return A⁻¹ of a symmetric positive definite A (n, n)."""
    if not A.dtype.hasobject:
        return np.asarray(np.linalg.inv(A))
    return _swept(A, np.zeros_like(A, shape=(len(A), 0)))[0]


def solved(A: Array, b: Array) -> Array:
    """Return A⁻¹b of a symmetric positive definite A (n, n) and b (n, k)."""
    if not A.dtype.hasobject:
        return np.asarray(np.linalg.solve(A, b))
    return _swept(A, b)[1]


def _swept(A: Array, b: Array) -> tuple[Array, Array]:
    """Return A⁻¹ and A⁻¹b of symbols, by a loop in the generated code.

    Each pass sweeps the first row, and moves it to the end (Beaton's sweep operator, 1964).
    """
    n, k = b.shape
    rows, columns = np.triu_indices(n)
    places = np.zeros((n, n), dtype=int)
    places[rows, columns] = places[columns, rows] = np.arange(len(rows))
    last = np.roll(np.arange(n), -1)
    order = places[np.ix_(last, last)][rows, columns]

    def sweep(_: Any, values: tuple[Array, Array]) -> tuple[Array, Array]:
        upper, given = values[0].tolist(), values[1]
        row = upper[:n]
        pivot = 1.0 / row[0]
        scaled, first = [pivot * each for each in row], pivot * given[0]
        after = [-pivot, *scaled[1:]]
        pairs = zip(rows[n:].tolist(), columns[n:].tolist(), upper[n:], strict=True)
        after += [each - row[i] * scaled[j] for i, j, each in pairs]
        others = [given[i] - row[i] * first for i in range(1, n)]
        return array(after)[order], np.stack([*others, first])

    upper, found = repeat(n, sweep, (A[rows, columns], b))
    return -upper[places], found.reshape(n, k)


def product(A: Array, B: Array) -> Array:
    """Return A B of matrices (n, k) and (k, m); of symbols by a loop over the rows of A."""
    if not A.dtype.hasobject and not B.dtype.hasobject:
        return A.dot(B)
    several = (*A.ravel().tolist(), *B.ravel().tolist())
    symbol = next((each for each in several if hasattr(each, "looped")), None)
    if symbol is None:
        return A.dot(B)
    found = collect(len(A), lambda i, kept: (kept, (take(A, i).dot(B),)), (symbol,))
    return found[1][0]
