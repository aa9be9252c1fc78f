"""Bounds on the Jacobian error: eqs. (7), (23), (24) and (25).

Theorem 1 asks for p, a bound of ‖Jᵀ − Ĵᵀ‖, below both curves of the paper's Figure 1.
"""

from __future__ import annotations

import numpy as np

from approxjac.checks import Array


def jacobian_error(J: Array, J_hat: Array) -> float:
    """‖Jᵀ − Ĵᵀ‖, the spectral norm. Implements Eq. (7) at one posture."""
    return float(np.linalg.norm(J - J_hat, 2))


def lambda_2(J_hat: Array, B_over_kv: Array) -> float:
    """λ₂ = λ_min[Ĵᵀ Ĵ + B / k_v]. Implements Eq. (23), its eigenvalue.

    Args:
        J_hat: Estimated task Jacobian, shape (m, n_v).
        B_over_kv: Diagonal of B / k_v, shape (n_v,).
    """
    smallest = np.linalg.eigvalsh(J_hat.T @ J_hat + np.diag(B_over_kv))[0]
    return max(float(smallest), 0.0)  # it is never negative but for round-off


def allowed_p_velocity(a: Array, alpha: float, lambda2: float) -> Array:
    """2 λ₂ / (a + α): the curve of Figure 1 that falls with a. Implements Eq. (23), first."""
    return 2.0 * lambda2 / (a + alpha)


def allowed_p_position(a: Array, alpha: float) -> Array:
    """2 a α / (a + α): the curve of Figure 1 that rises with a. Implements Eq. (23), second."""
    return 2.0 * a * alpha / (a + alpha)


def allowed_p_at_crossing(alpha: float, lambda2: float) -> float:
    """2 α λ₂ / (α² + λ₂), where the curves cross, at a = λ₂ / α.

    Implements Eq. (24). Departure: the paper prints a = λ₁/α for the crossing.
    """
    return 2.0 * alpha * lambda2 / (alpha**2 + lambda2) if lambda2 > 0.0 else 0.0


def largest_allowed_p(lambda2: float) -> float:
    """λ₂^½, the largest p that any α allows, reached at α = λ₂^½. Implements Eq. (25).

    Departure: the paper says that the left-hand side of (24) is maximal there; it is the
    right-hand side.
    """
    return float(np.sqrt(lambda2))
