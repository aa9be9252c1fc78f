"""The passive output, eq. (10), and the adaptation of the gravity parameters, eq. (29)."""

from __future__ import annotations

import numpy as np

from approxjac.law.products import dot
from approxjac.validation import Array

_TINY = np.finfo(float).tiny
_ROUND_OFF = (
    1e-8  # bounds nearer to dependent count as dependent: λ grows as 1/angle, its error too
)


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
    if not (N.dot(rate) > 0.0).any():
        return rate
    if L.ndim == 1:
        root = np.sqrt(L)
        F, c = root[:, np.newaxis] * N.T, rate / np.maximum(root, _TINY)
    else:
        root = np.linalg.cholesky(L)
        F, c = root.T.dot(N.T), np.linalg.solve(root, rate)
    F = F / np.maximum(np.sqrt((F * F).sum(axis=0)), _TINY)
    kept = c - F.dot(_nonnegative(F, c))
    projected = root * kept if L.ndim == 1 else root.dot(kept)
    projected = np.where(low, np.maximum(projected, 0.0), projected)  # the box to the last bit
    return np.asarray(np.where(high, np.minimum(projected, 0.0), projected))


def _nonnegative(F: Array, c: Array) -> Array:
    """The λ ≥ 0 with the smallest |Fλ − c|, for an F (p, k) with columns of length one.

    The active set method of C. Lawson and R. Hanson, "Solving Least Squares Problems" (1974),
    chapter 23. What is minimized falls from iterate to iterate, each of which is ≥ 0: wherever
    rounding of bounds that depend on each other ends it, the rate is no longer than it was.
    """
    count = F.shape[1]
    multipliers = np.zeros(count)
    free = np.zeros(count, dtype=bool)
    least = 1e-14 * np.abs(c).max()
    for _ in range(3 * count):
        slope = np.where(free, -np.inf, (c - F.dot(multipliers)).dot(F))
        if slope.max() <= least:
            break
        free[slope.argmax()] = True
        while free.any():
            wanted = np.zeros(count)
            wanted[free] = np.linalg.lstsq(F[:, free], c, rcond=_ROUND_OFF)[0]
            below = free & (wanted <= 0.0)
            if not below.any():
                multipliers = wanted
                break
            shares = np.full(count, np.inf)
            shares[below] = multipliers[below] / np.maximum((multipliers - wanted)[below], _TINY)
            first = shares.argmin()
            multipliers = multipliers + shares[first] * (wanted - multipliers)
            free &= multipliers > 0.0
            free[first] = False
            multipliers[~free] = 0.0
    return multipliers
