"""The right pseudo-inverse Ĵ⁺, damped near singular poses, and the rate of that damping."""

from __future__ import annotations

import math

import numpy as np

from approxjac.law.products import dot
from approxjac.validation import Array

SINGULAR_RATIO = 0.02
"""Damping sets in where σ_min(Ĵ) falls below this share of σ_max(Ĵ)."""


def right_pinv(J: Array) -> Array:
    """J⁺ = Jᵀ(J Jᵀ)⁻¹, shape (n_v, m), of J (m, n_v) with full row rank, so that J J⁺ = I."""
    return np.asarray(np.linalg.solve(J @ J.T, J).T, dtype=np.float64)


def damped_gram_solve(
    G: Array, b: Array, singular_ratio: float = SINGULAR_RATIO, scale: float = 0.0
) -> tuple[Array, float]:
    """w = (G + λ²I)⁻¹ b of G = J Jᵀ with λ = 0 away from singular poses; then J⁺b = Jᵀw.

    λ² = ε²(1 − (σ_min/ε)²) where σ_min < ε = `singular_ratio` · max(σ_max, `scale`), so that J⁺ is
    continuous in J and never larger than 1/ε. The ratio makes ε free of units (image Jacobians
    are a hundred times smaller than those of positions); the scale bounds J⁺ where all singular
    values vanish together, as the only one of a J with one row does.

    Source: Y. Nakamura and H. Hanafusa, "Inverse kinematic solutions with singularity
    robustness for robot manipulator control", J. Dyn. Sys. Meas. Control 108, 1986.

    Args:
        G: J Jᵀ, shape (m, m).
        b: Shape (m,).
        singular_ratio: Ratio of singular values below which damping sets in.
        scale: A σ_max below which it counts as this large [unit of J].

    Returns:
        w, shape (m,), zero where G is, and λ (0 where w is exact).
    """
    # In plain numbers, three times as fast as LAPACK through NumPy at these sizes.
    if len(b) == len(G) == 2:
        g00, g01, g11 = float(G[0, 0]), float(G[0, 1]), float(G[1, 1])
        b0, b1 = float(b[0]), float(b[1])
        determinant, trace = g00 * g11 - g01 * g01, g00 + g11
        if _surely_regular(determinant * trace, trace, singular_ratio, scale):
            b0, b1 = b0 / determinant, b1 / determinant
            return np.array((g11 * b0 - g01 * b1, g00 * b1 - g01 * b0)), 0.0
    elif len(b) == len(G) == 3:
        g00, g01, g02 = float(G[0, 0]), float(G[0, 1]), float(G[0, 2])
        g11, g12, g22 = float(G[1, 1]), float(G[1, 2]), float(G[2, 2])
        b0, b1, b2 = float(b[0]), float(b[1]), float(b[2])
        a00, a01, a02 = g11 * g22 - g12 * g12, g02 * g12 - g01 * g22, g01 * g12 - g02 * g11
        determinant = g00 * a00 + g01 * a01 + g02 * a02
        if _surely_regular(4.0 * determinant, g00 + g11 + g22, singular_ratio, scale):
            a11, a12, a22 = g00 * g22 - g02 * g02, g01 * g02 - g00 * g12, g00 * g11 - g01 * g01
            b0, b1, b2 = b0 / determinant, b1 / determinant, b2 / determinant
            w = (
                a00 * b0 + a01 * b1 + a02 * b2,
                a01 * b0 + a11 * b1 + a12 * b2,
                a02 * b0 + a12 * b1 + a22 * b2,
            )
            return np.array(w), 0.0
    squares, U = np.linalg.eigh(G)
    threshold = singular_ratio**2 * max(float(squares[-1]), scale**2)
    damping = max(threshold - max(float(squares[0]), 0.0), 0.0)
    if threshold <= 0.0:
        return np.zeros(len(b)), 0.0
    # squares below zero by round-off are lifted by the damping that is then at work
    return dot(U, dot(b, U) / (np.maximum(squares, 0.0) + damping)), math.sqrt(damping)


def damping_rate(
    J: Array, J_dot: Array, singular_ratio: float = SINGULAR_RATIO, scale: float = 0.0
) -> float:
    """d(λ²)/dt of `damped_gram_solve` where λ > 0, along a motion of J (m, n_v) with rate J'.

    (λ²)' = ε²' − (σ_min²)', with (σᵢ²)' = 2 (Jᵀuᵢ)ᵀJ'ᵀuᵢ of its left singular vector uᵢ. Where
    singular values cross, one of the derivatives to either side.
    """
    squares, U = np.linalg.eigh(dot(J, J.T))

    def square_rate(i: int) -> float:
        return 2.0 * float(dot(dot(U[:, i], J), dot(U[:, i], J_dot)))

    of_threshold = singular_ratio**2 * square_rate(-1) if squares[-1] > scale**2 else 0.0
    return of_threshold - square_rate(0)


def is_near_singular(G: Array, singular_ratio: float = SINGULAR_RATIO, scale: float = 0.0) -> bool:
    """Return whether σ_min of J is below `singular_ratio` · max(σ_max, `scale`), from G = J Jᵀ."""
    if len(G) == 2:
        a, b, d = float(G[0, 0]), float(G[0, 1]), float(G[1, 1])
        if _surely_regular((a * d - b * b) * (a + d), a + d, singular_ratio, scale):
            return False
    elif len(G) == 3:
        a, b, c = float(G[0, 0]), float(G[0, 1]), float(G[0, 2])
        d, e, f = float(G[1, 1]), float(G[1, 2]), float(G[2, 2])
        determinant = a * (d * f - e * e) + b * (c * e - b * f) + c * (b * e - c * d)
        if _surely_regular(4.0 * determinant, a + d + f, singular_ratio, scale):
            return False
    squares = np.linalg.eigvalsh(G)
    return bool(squares[0] < singular_ratio**2 * max(squares[-1], scale**2))


def _surely_regular(bound: float, trace: float, singular_ratio: float, scale: float) -> bool:
    """Return whether a symmetric 2 × 2 or 3 × 3 matrix surely has σ_min above the ratio.

    `bound` is at most its smallest eigenvalue times trace²: det · trace of a 2 × 2 matrix, whose
    other eigenvalue is at most the trace; 4 det of a 3 × 3 matrix, of which the product of the
    other two is at most (trace/2)². The largest eigenvalue is at least a third of the trace.
    """
    return bound > singular_ratio**2 * trace * trace * trace and trace > 3.0 * scale * scale
