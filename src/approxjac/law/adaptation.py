"""The passive output, eq. (10), and the adaptation of the gravity parameters, eq. (29)."""

from __future__ import annotations

import numpy as np

from approxjac.law.products import dot
from approxjac.validation import Array

_PIVOTS = 100  # for two dozen bounds at once mostly a dozen


def passive_output(v: Array, J_hat_pinv_s: Array, alpha: float | Array) -> Array:
    """y = q̇ + α Ĵ⁺ s(e): the output along which the closed loop is passive.

    Implements Eq. (10), with the joint velocity q̇, Ĵ⁺ s(e) and y of shape (n_v,), α > 0 [1/s].
    """
    return v + alpha * J_hat_pinv_s


def theta_hat_rate(L: Array, Z: Array, y: Array) -> Array:
    """dθ̂/dt = −L Zᵀ y, shape (p,), with the passive output y of (10), shape (n_v,).

    Implements Eq. (29), differentiated. The adaptation gain L is a diagonal (p,) or a matrix
    (p, p), the gravity regressor Z is (n_v, p).
    """
    return -L * dot(y, Z) if L.ndim == 1 else -dot(L, dot(y, Z))


def within_bounds(rate: Array, theta_hat: Array, lower: Array, upper: Array, L: Array) -> Array:
    """Rate of θ̂ with what would lead out of bounds taken back.

    The projection of Eq. (29) onto a box, in the metric L⁻¹ of V: r = dθ̂/dt − L S λ, where S has
    the sign of each bound that θ̂ is at and λ ≥ 0. Where θ lies in the box, ΔθᵀSλ ≤ 0 for any such
    λ, so V̇ ≤ −W stays. With a diagonal L, entries that would lead out become zero. The rate is
    that of `theta_hat_rate`, with its L; θ̂ and its smallest and largest values are (p,).
    """
    low, high = theta_hat <= lower, theta_hat >= upper
    if not (low | high).any():
        return rate
    if L.ndim == 1:
        return np.where((low & (rate < 0.0)) | (high & (rate > 0.0)), 0.0, rate)
    at = np.flatnonzero(low | high)
    sign = np.where(high[at], 1.0, -1.0)
    outward = sign * rate[at]
    held = outward > 0.0
    if not held.any():
        return rate
    A = sign[:, None] * L[np.ix_(at, at)] * sign
    round_off = 1e-12 * np.abs(outward).max()
    for _ in range(_PIVOTS):  # Murty's: the first bound that is wrong changes sides
        multipliers = np.zeros(len(at))
        multipliers[held] = np.linalg.solve(A[np.ix_(held, held)], outward[held])
        wrong = np.where(held, multipliers < 0.0, outward - A @ multipliers > round_off)
        if not wrong.any():
            break
        held[np.argmax(wrong)] ^= True
    return np.asarray(rate - L[:, at] @ (sign * np.maximum(multipliers, 0.0)))
