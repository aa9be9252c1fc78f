"""The passive output, eq. (10), and the adaptation of the gravity parameters, eq. (29)."""

from __future__ import annotations

from approxjac.checks import Array


def passive_output(v: Array, J_hat_pinv: Array, s: Array, alpha: float) -> Array:
    """y = q̇ + α Ĵ⁺ s(e): the output along which the closed loop is passive.

    Implements Eq. (10).

    Args:
        v: Joint velocity q̇, shape (n_v,).
        J_hat_pinv: Right pseudo-inverse of Ĵ, shape (n_v, m).
        s: Saturated error s(e), shape (m,).
        alpha: Scalar α > 0 [1/s].

    Returns:
        y, shape (n_v,).
    """
    return v + alpha * (J_hat_pinv @ s)


def theta_hat_rate(L: Array, Z: Array, y: Array) -> Array:
    """dθ̂/dt = −L Zᵀ y.

    Implements Eq. (29), differentiated.

    Args:
        L: Adaptation gain: a diagonal, shape (p,), or a matrix, shape (p, p).
        Z: Gravity regressor, shape (n_v, p).
        y: Passive output (10), shape (n_v,).

    Returns:
        Rate of the estimated parameters, shape (p,).
    """
    return -(L * (y @ Z)) if L.ndim == 1 else -(L @ (y @ Z))
