"""The right pseudo-inverse Ĵ⁺, damped near singular poses, and its time derivative."""

from __future__ import annotations

import math

import numpy as np

from approxjac.checks import Array

SINGULAR_RATIO = 0.02
"""Damping sets in where σ_min(Ĵ) falls below this share of σ_max(Ĵ)."""


def right_pinv(J: Array) -> Array:
    """J⁺ = Jᵀ(J Jᵀ)⁻¹, so that J J⁺ = I.

    Args:
        J: Matrix of full row rank, shape (m, n_v), m ≤ n_v.

    Returns:
        J⁺, shape (n_v, m).
    """
    return np.asarray(np.linalg.solve(J @ J.T, J).T, dtype=np.float64)


def damped_right_pinv(
    J: Array, singular_ratio: float = SINGULAR_RATIO
) -> tuple[Array, float, float]:
    """J⁺ = Jᵀ(J Jᵀ + λ²I)⁻¹ with λ = 0 away from singular poses.

    λ² = ε²(1 − (σ_min/ε)²) where σ_min < ε = `singular_ratio` · σ_max, so that J⁺ is continuous
    in J and never larger than 1/ε. The ratio makes ε free of units (image Jacobians are a
    hundred times smaller than those of positions).

    Source: Y. Nakamura and H. Hanafusa, "Inverse kinematic solutions with singularity
    robustness for robot manipulator control", J. Dyn. Sys. Meas. Control 108, 1986.

    Args:
        J: Matrix, shape (m, n_v), m ≤ n_v. A zero matrix gives a zero J⁺.
        singular_ratio: Ratio of singular values below which damping sets in.

    Returns:
        J⁺ of shape (n_v, m), σ_min(J) and λ (0 where J⁺ is exact).
    """
    squares, U = np.linalg.eigh(J @ J.T)
    smallest = max(float(squares[0]), 0.0)
    threshold = singular_ratio**2 * float(squares[-1])
    damping = max(threshold - smallest, 0.0)
    if threshold <= 0.0:
        return np.zeros((J.shape[1], J.shape[0])), 0.0, 0.0
    # squares below zero by round-off are lifted by the damping that is then at work
    inverse = (U / (np.maximum(squares, 0.0) + damping)) @ U.T
    return J.T @ inverse, math.sqrt(smallest), math.sqrt(damping)


def extreme_singular_values(J: Array) -> tuple[float, float]:
    """Smallest and largest singular value of J, shape (m, n_v) with m ≤ n_v."""
    squares = np.linalg.eigvalsh(J @ J.T)
    return math.sqrt(max(float(squares[0]), 0.0)), math.sqrt(float(squares[-1]))


def right_pinv_dot(J: Array, J_dot: Array) -> Array:
    """d/dt of `right_pinv`: (I − J⁺J) J̇ᵀ (J Jᵀ)⁻¹ − J⁺ J̇ J⁺.

    Args:
        J: Matrix of full row rank, shape (m, n_v).
        J_dot: Its time derivative, shape (m, n_v).

    Returns:
        Shape (n_v, m).
    """
    J_pinv = right_pinv(J)
    tail = np.linalg.solve(J @ J.T, J_dot).T  # J̇ᵀ (J Jᵀ)⁻¹
    return tail - J_pinv @ (J @ tail) - J_pinv @ (J_dot @ J_pinv)
