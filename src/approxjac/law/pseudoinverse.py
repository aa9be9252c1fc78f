"""The right pseudo-inverse Ĵ⁺, damped near singular poses, and the rate of that damping."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from approxjac.law.branches import array, choose, complement, select
from approxjac.law.products import root
from approxjac.validation import Array

SINGULAR_RATIO = 0.02
"""Damping sets in where σ_min(Ĵ) falls below this share of σ_max(Ĵ)."""


def damped_gram_solve(
    G: Array, b: Array, singular_ratio: float = SINGULAR_RATIO, scale: float = 0.0
) -> tuple[Array, float]:
    """Return w = (G + λ²I)⁻¹ b of G = J Jᵀ with λ = 0 away from singular poses; then J⁺b = Jᵀw.

    λ² = ε²(1 − (σ_min/ε)²) where σ_min < ε = `singular_ratio` · max(σ_max, `scale`), so that J⁺ is
    continuous in J and never larger than 1/ε. The ratio makes ε free of units (image Jacobians
    are a hundred times smaller than those of positions); the scale bounds J⁺ where all singular
    values vanish together, as the only one of a J with one row does.

    Source: Y. Nakamura and H. Hanafusa, "Inverse kinematic solutions with singularity
    robustness for robot manipulator control", J. Dyn. Sys. Meas. Control 108, 1986.

    Returned are w (m,), zero where G (m, m) is, and λ, 0 where w is exact.
    """
    solve, singular = regular_solver(G, singular_ratio, scale)

    def damped() -> tuple[Array, float]:
        solve, _, damping = damped_solver(G, singular_ratio, scale)
        return solve(b), root(damping)

    return choose(singular, damped, lambda: (solve(b), 0.0))


def damped_solver(
    G: Array, singular_ratio: float = SINGULAR_RATIO, scale: float = 0.0
) -> tuple[Callable[[Array], Array], Array, Any]:
    """Return b ↦ w of `damped_gram_solve`; eigenvectors of least and largest eigenvalue; and λ²."""
    squares, U = np.linalg.eigh(G)
    least, largest = squares.min(), squares.max()
    damping = gram_damping(least, largest, singular_ratio, scale)
    # squares below zero by round-off are lifted by the damping that is then at work
    lifted, ends = np.maximum(squares, 0.0) + damping, U.T[[0, -1]]
    is_some, divisor = lifted > 0.0, np.where(lifted > 0.0, lifted, 1.0)
    if U.dtype.hasobject:  # whose order is not known
        for i, row in enumerate(U.T):
            ends[0] = select(squares[i] <= least, row, ends[0])
            ends[1] = select(squares[i] >= largest, row, ends[1])
    return lambda b: U.dot(np.where(is_some, b.dot(U) / divisor, 0.0)), ends, damping


def regular_solver(
    G: Array, singular_ratio: float, scale: float
) -> tuple[Callable[[Array], Array], Any]:
    """Return b ↦ G⁻¹b, and whether J may be near singular, so that it must not be used.

    In closed form up to three rows, three times as fast as LAPACK through NumPy. Of more rows of
    numbers the eigenvalues tell, which take no longer than a solution.
    """
    if len(G) <= 3:
        rows, determinant, bound, trace = adjugate(G.tolist())
        regular = is_surely_regular(bound, trace, singular_ratio, scale)
        return lambda b: array(solution(rows, determinant, b.tolist())), complement(regular)
    if type(G) is np.ndarray:
        return lambda b: b, True
    inverse = np.linalg.inv(G)
    trace, inverse_trace = G.trace(), inverse.trace()  # the latter at least 1 / least eigenvalue
    regular = (singular_ratio**2 * trace * inverse_trace < 1.0) & (trace > len(G) * scale**2)
    return partial(np.linalg.solve, G), complement(regular & (inverse_trace > 0.0))


def is_surely_regular(bound: Any, trace: Any, singular_ratio: float, scale: float) -> Any:
    """Return True where σ_min is surely large enough, of the bound and the trace of `adjugate`."""
    large = trace > 3.0 * scale * scale  # of which the largest eigenvalue is a third
    return large & (bound > singular_ratio**2 * trace * trace * trace)


def may_be_singular(G: Array, singular_ratio: float, scale: float) -> Any:
    """Return False where σ_min of J is surely above a share of σ_max and the scale, of G = J Jᵀ."""
    if len(G) > 3:
        return regular_solver(G, singular_ratio, scale)[1]
    return complement(is_surely_regular(*adjugate(G.tolist())[2:], singular_ratio, scale))


def damping_rate(
    J: Array, J_dot: Array, ends: Array, singular_ratio: float = SINGULAR_RATIO, scale: float = 0.0
) -> Any:
    """Return d(λ²)/dt of `damped_solver` where λ > 0, along a motion of J (m, n_v) with rate J'.

    (λ²)' = ε²' − (σ_min²)', with (σᵢ²)' = 2 (Jᵀuᵢ)ᵀJ'ᵀuᵢ of its left singular vector uᵢ. Where
    singular values cross, one of the derivatives to either side. `ends` are those two vectors.
    """
    moved = [u.dot(J) for u in ends]
    least, largest = (2.0 * u_J.dot(u.dot(J_dot)) for u, u_J in zip(ends, moved, strict=True))
    return select(moved[1].dot(moved[1]) > scale**2, singular_ratio**2 * largest, 0.0) - least


def is_near_singular(G: Array, singular_ratio: float = SINGULAR_RATIO, scale: float = 0.0) -> Any:
    """Return True if σ_min of J is below `singular_ratio` · max(σ_max, `scale`), from G = J Jᵀ."""

    def by_eigenvalues() -> tuple[Array]:
        squares = np.asanyarray(np.linalg.eigvalsh(G))
        return (gram_damping(squares.min(), squares.max(), singular_ratio, scale),)

    may_be = may_be_singular(G, singular_ratio, scale)
    if may_be is False:
        return False
    damping: Any = choose(may_be, by_eigenvalues, lambda: (0.0,))[0]
    return bool(damping > 0.0) if isinstance(damping, float) else damping > 0.0


def gram_damping(least: Array, largest: Array, singular_ratio: float, scale: float) -> Array:
    """Return λ² of `damped_gram_solve`, from the least and the largest eigenvalue of J Jᵀ.

    Eigenvalues below zero by round-off count as zero.
    """
    threshold = singular_ratio**2 * np.maximum(largest, scale**2)
    return np.maximum(threshold - np.maximum(least, 0.0), 0.0)


def adjugate(G: list[list[float]]) -> tuple[Rows, float, float, float]:
    """Return adjugate, determinant, bound and trace of a symmetric G (1 to 3 rows), in numbers.

    The bound is at most the smallest eigenvalue times trace²: det · trace of two rows, whose other
    eigenvalue is at most the trace, and 4 det of three, of which the product of the other two is at
    most (trace/2)².
    """
    if len(G) == 1:
        g = G[0][0]
        return ((1.0,),), g, g * g * g, g
    if len(G) == 2:
        (g00, g01), (_, g11) = G
        determinant, trace = g00 * g11 - g01 * g01, g00 + g11
        return ((g11, -g01), (-g01, g00)), determinant, determinant * trace, trace
    (g00, g01, g02), (_, g11, g12), (_, _, g22) = G
    a00, a01, a02 = g11 * g22 - g12 * g12, g02 * g12 - g01 * g22, g01 * g12 - g02 * g11
    a11, a12, a22 = g00 * g22 - g02 * g02, g01 * g02 - g00 * g12, g00 * g11 - g01 * g01
    determinant = g00 * a00 + g01 * a01 + g02 * a02
    rows = (a00, a01, a02), (a01, a11, a12), (a02, a12, a22)
    return rows, determinant, 4.0 * determinant, g00 + g11 + g22


def solution(rows: Rows, determinant: float, b: list[float]) -> tuple[float, ...]:
    """Return w = G⁻¹b from the adjugate and the determinant of G."""
    if len(b) == 1:
        return (b[0] / determinant,)
    b0, b1 = b[0] / determinant, b[1] / determinant
    if len(b) == 2:
        (a00, a01), (_, a11) = rows
        return a00 * b0 + a01 * b1, a01 * b0 + a11 * b1
    (a00, a01, a02), (_, a11, a12), (_, _, a22) = rows
    b2 = b[2] / determinant
    return (
        a00 * b0 + a01 * b1 + a02 * b2,
        a01 * b0 + a11 * b1 + a12 * b2,
        a02 * b0 + a12 * b1 + a22 * b2,
    )


Rows = tuple[tuple[float, ...], ...]
