"""The passive output, eq. (10), and the adaptation of the gravity parameters, eq. (29)."""

from __future__ import annotations

import numpy as np

from approxjac.law.products import dot
from approxjac.validation import Array


def passive_output(v: Array, J_hat_pinv_s: Array, alpha: float | Array) -> Array:
    """y = q̇ + α Ĵ⁺ s(e): the output along which the closed loop is passive.

    Implements Eq. (10).

    Args:
        v: Joint velocity q̇, shape (n_v,).
        J_hat_pinv_s: Ĵ⁺ s(e), shape (n_v,).
        alpha: Scalar α > 0 [1/s].

    Returns:
        y, shape (n_v,).
    """
    return v + alpha * J_hat_pinv_s


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
    rate: Array = -L * dot(y, Z) if L.ndim == 1 else -dot(L, dot(y, Z))
    return rate


def within_bounds(rate: Array, theta_hat: Array, lower: Array, upper: Array) -> Array:
    """Rate of θ̂ with what would lead out of bounds left out, entry by entry.

    The projection of Eq. (29) onto a box: where θ lies in the box and L is diagonal,
    −Δθᵀ L⁻¹ dθ̂/dt only becomes smaller, so V̇ ≤ −W stays.

    Args:
        rate: dθ̂/dt of (29), shape (p,).
        theta_hat: θ̂, shape (p,).
        lower: Smallest θ, shape (p,).
        upper: Largest θ, shape (p,).

    Returns:
        Shape (p,).
    """
    outward = ((theta_hat <= lower) & (rate < 0.0)) | ((theta_hat >= upper) & (rate > 0.0))
    return np.where(outward, 0.0, rate)
