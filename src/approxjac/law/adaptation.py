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


def within_bounds(
    rate: Array,
    theta_hat: Array,
    lower: Array,
    upper: Array,
    L: Array,
    outward: Array | None = None,
) -> Array:
    """Rate of θ̂ with what would lead out of bounds taken back.

    The projection of Eq. (29) onto a convex set, in the metric L⁻¹ of V: r = dθ̂/dt − L Nᵀλ, where
    N has the outward normals of the bounds that θ̂ is at, and λ ≥ 0. Where θ lies in the set,
    ΔθᵀNᵀλ ≤ 0 for any such λ, so V̇ ≤ −W stays. The rate is that of `theta_hat_rate`, with its L; θ̂
    and its smallest and largest values are (p,). `outward` are normals of further bounds that it
    is at, shape (k, p).
    """
    low, high = theta_hat <= lower, theta_hat >= upper
    if outward is None:
        if not (low | high).any():
            return rate
        if L.ndim == 1:
            return np.where((low & (rate < 0.0)) | (high & (rate > 0.0)), 0.0, rate)
    at = np.flatnonzero(low | high)
    N = np.zeros((len(at), len(rate)))
    N[np.arange(len(at)), at] = np.where(high[at], 1.0, -1.0)
    if outward is not None:
        N = np.concatenate([N, outward])
    leads_out = N @ rate
    held = leads_out > 0.0
    if not held.any():
        return rate
    NL = N * L if L.ndim == 1 else N @ L
    A = NL @ N.T
    round_off = 1e-12 * np.abs(leads_out).max()
    for _ in range(_PIVOTS):  # Murty's: the first bound that is wrong changes sides
        multipliers = np.zeros(len(N))
        multipliers[held] = np.linalg.lstsq(A[np.ix_(held, held)], leads_out[held])[0]
        wrong = np.where(held, multipliers < 0.0, leads_out - A @ multipliers > round_off)
        if not wrong.any():
            break
        held[np.argmax(wrong)] ^= True
    return np.asarray(rate - np.maximum(multipliers, 0.0) @ NL)
