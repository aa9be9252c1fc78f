"""Adaptation: gravity by the passive output (10) and (29); positions with forgetting."""

from typing import Any, NamedTuple

import numpy as np

from approxjac.law.branches import (
    all_of,
    any_of,
    choose,
    collect,
    collected,
    complement,
    repeat,
    select,
    take,
)
from approxjac.law.factors import product
from approxjac.validation import Array

_TINY = np.finfo(float).tiny
_SWEEPS = 10
_FEW, _SOME = 12, 32  # motors and parameters whose bounds are taken without loops of their own
_SWEPT = 1e-12  # of what led out of bounds, which sweeps may leave
_STILL = 1e-5  # a speed of joints that stand [rad/s or m/s]
_LITTLE = 5e-3  # of the largest F̂
_DWELL, _STOOD, _RELEASE = 0.05, 0.8, 0.01  # how long [s], which share of it, and of forgetting it
_ROUND_OFF = 1e-8  # bounds this close to dependent count as so: λ and its error grow as 1/angle


def passive_output(v: Array, J_hat_pinv_s: Array, alpha: float | Array) -> Array:
    """Return y = q̇ + α Ĵ⁺ s(e): the output along which the closed loop is passive.

    Implements Eq. (10), with the joint velocity q̇, Ĵ⁺ s(e) and y of shape (n_v,), α > 0 [1/s].
    """
    return v + alpha * J_hat_pinv_s


def theta_hat_rate(L: Array, Z: Array, y: Array) -> Array:
    """Return dθ̂/dt = −L Zᵀ y, shape (p,), with the passive output y of (10), shape (n_v,).

    Implements Eq. (29), differentiated. The adaptation gain L is a diagonal (p,) or a matrix
    (p, p), the gravity regressor Z is (n_v, p).
    """
    return -L * y.dot(Z) if L.ndim == 1 else -y.dot(Z).dot(L)


def within_bounds(
    rate: Array,
    theta_hat: Array,
    lower: Array,
    upper: Array,
    L: Array,
    outward: Array | None = None,
) -> Array:
    """Return the rate of θ̂ projected so that θ̂ stays within bounds.

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
    root = np.diag(np.maximum(np.sqrt(L), _TINY)) if L.ndim == 1 else np.linalg.cholesky(L)
    F, c = root.T.dot(N.T), np.linalg.solve(root, rate)
    F = F / np.maximum(np.sqrt((F * F).sum(axis=0)), _TINY)
    projected = root.dot(c - F.dot(_nonnegative(F, c)))
    projected = np.where(low, np.maximum(projected, 0.0), projected)  # the box to the last bit
    return np.asarray(np.where(high, np.minimum(projected, 0.0), projected))


def swept_within_bounds(
    rate: Array,
    theta_hat: Array,
    bounds: tuple[Array, Array],
    L: Array,
    Y: Array,
    g: Array,
    motors: Array,
) -> tuple[Array, Any]:
    """Do as `within_bounds`, by branchless sweeps; return also True if they did not converge.

    C. Hildreth's method ("A quadratic programming procedure", Naval Research Logistics 4(1), 1957)
    takes the multiplier of one bound after the other. A few sweeps usually suffice.

    Where g = Yθ̂ (n_v,) is beyond the limits `motors` (n_v,), it does not grow further; the
    regressor Y is (n_v, P).
    """
    lower, upper = bounds
    high, low, is_beyond = theta_hat >= upper, theta_hat <= lower, np.abs(g) > motors
    side = np.where(high, 1.0, np.where(low, -1.0, 0.0))
    beyond = np.where(is_beyond, np.where(g > 0.0, 1.0, -1.0), 0.0)
    # what may lead out; where nothing does, no multiplier is needed
    outward = np.concatenate([high & (rate > 0.0), low & (rate < 0.0), is_beyond])
    own_lead = side * L if L.ndim == 1 else L
    own_size = _inverse(side * (side * (L if L.ndim == 1 else L.diagonal())))

    def of_motor(i: Any, values: tuple[Any]) -> tuple[tuple[Any], tuple[Any, ...]]:
        """Return the rows of N, N L, … of torques that a motor has to hold."""
        row = take(beyond, i) * take(Y, i)
        turned = row * L if L.ndim == 1 else row.dot(L)
        return values, (row, turned, _inverse(row.dot(turned)), row.dot(rate))

    def own(r: Array, multipliers: Array) -> tuple[Array, Array]:
        """Return the rate and multipliers after a sweep over each parameter's own bound."""
        if L.ndim == 1:
            after = np.maximum(multipliers + (side * r) * own_size, 0.0)
            return r - (after - multipliers) * own_lead, after

        def one(i: Any, values: tuple[Array]) -> tuple[tuple[Array], tuple[Any]]:
            was, (r,) = take(multipliers, i), values
            along = take(side, i) * take(r, i)
            after = np.maximum(was + along * take(own_size, i), 0.0)
            return (r - (after - was) * (take(side, i) * take(own_lead, i)),), (after,)

        each = collect if len(rate) > _SOME else collected
        (r,), (after,) = each(len(rate), one, (r,))
        return r, after

    def swept() -> tuple[Array, Any]:
        each = collect if len(g) > _FEW else collected  # which leaves out what is surely 0
        _, (N, NL, size, before) = each(len(g), of_motor, (g,))

        def sweep(_: Any, values: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            r, of_own, of_motors = values
            r, of_own = own(r, of_own)

            def one(i: Any, values: tuple[Array]) -> tuple[tuple[Array], tuple[Any]]:
                was, (r,) = take(of_motors, i), values
                after = np.maximum(was + take(N, i).dot(r) * take(size, i), 0.0)
                return (r - (after - was) * take(NL, i),), (after,)

            (r,), (of_motors,) = each(len(g), one, (r,))
            return r, of_own, of_motors

        start = rate, 0.0 * rate, 0.0 * g
        r, *multipliers = repeat(_SWEEPS, sweep, start)
        _, (beside,) = each(len(g), lambda i, v: (v, (take(N, i).dot(r),)), (g,))
        least = _SWEPT * np.abs(np.concatenate([side * rate, before])).max()
        beside, multiplier = np.concatenate([side * r, beside]), np.concatenate(multipliers)
        wrong = ((beside > least) | ((multiplier > 0.0) & (beside < -least))).any()
        return r, select(wrong, 1.0, 0.0)

    bounded, unfinished = choose(outward.any(), swept, lambda: (rate, 0.0))
    return bounded, unfinished > 0.0


def _inverse(sizes: Any) -> Any:
    return np.where(sizes > 0.0, 1.0 / np.where(sizes > 0.0, sizes, 1.0), 0.0)


def _nonnegative(F: Array, c: Array) -> Array:
    """Return the λ ≥ 0 (k,) with the smallest |Fλ − c|, for an F (p, k) with unit columns.

    The active set method of C. Lawson and R. Hanson, "Solving Least Squares Problems" (1974),
    chapter 23. |Fλ − c| falls with each iterate, all of which are ≥ 0: even if round-off of bounds
    that depend on each other ends the search early, the rate is no longer than it was.
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


def forgotten(P: Array, Lambda_0: Array, share: Any) -> Array:
    """Return P ← P + s(P − PΛ₀P): forget a share s of the data, never the prior Λ₀.

    Implements Theorem A's forgetting, in samples. It is ((1 − s)P⁻¹ + sΛ₀)⁻¹ but for s², and never
    more than that: Λ₀⁻¹ ≥ P stays so, and V₁ falls.
    """
    weighted = P * Lambda_0 if Lambda_0.ndim == 1 else product(P, Lambda_0)  # (n,) is diagonal
    return np.asanyarray(P + share * (P - product(weighted, P)))


def gain(P: Array, H: Array, variance: Any) -> Array:
    """Return the gain K = PHᵀ(HPHᵀ + R)⁻¹ of a frame, shape (n, m).

    Implements Theorem A's gain, in samples: Θ̂ + Kε with ε = x − HΘ̂ (m,), P = Λ⁻¹ before the frame,
    H (m, n), and R = variance I. After the frame P is P − K(PHᵀ)ᵀ.
    """
    PH = product(P, H.T)
    S = H.dot(PH) + variance * np.eye(len(H))
    if S.dtype.hasobject:  # symbols are solved with where a matrix is symmetric to the letter
        rows = np.arange(len(S))
        S = S[np.maximum.outer(rows, rows), np.minimum.outer(rows, rows)]
    return np.asanyarray(np.linalg.solve(S, PH.T).T)


class Rubbing(NamedTuple):
    """Numbers of a rule that learns dry friction at joints that stand."""

    width: Array  # ε of tanh(ν/ε), (n_v,) [rad/s or m/s]
    most: Array  # largest F̂, (n_v,) [N m or N]
    grows: Array  # rate of F̂ where a joint should move but stands, (n_v,) [N m/s or N/s]
    falls: Array  # rate of F̂ for ψ y where it moves ahead of ν, (n_v,) [N m/rad or N/m]
    fine: Array  # error within which all rests, (m,) [unit of the task]
    first: Array  # F̂(0), (n_v,)
    slow: float  # speed [rad/s or m/s] and share of ν up to which a joint stands
    share: float


def friction_step(
    rule: Rubbing, memory: Array, v: Array, nu: Array, e: Array, is_lost: Any
) -> tuple[Array, Array, Any]:
    """Return F̂ψ, the rate of the memory (F̂, how long each joint stood, how quiet all was), rests.

    With ψ = tanh(ν/ε) and a reference ν of the joints, τ + F̂ψ and F̂' = −γψ(q̇ − ν) add
    0.279 Σ εᵢFᵢ at most to V̇, for F_i ∈ [−F, F] of friction that is −F sgn(q̇) where it slides.

    Args:
        rule: Its numbers.
        memory: F̂ (n_v,), z (n_v,) and h, in [0, 1].
        v: q̇, (n_v,).
        nu: ν, (n_v,).
        e: Task error, (m,), of any value where it is lost.
        is_lost: True if e is not known, and ν = 0.

    Returns:
        F̂ψ; the rate of the memory; True if what else is learnt rests.
    """
    n = len(v)
    F_hat, stood, quiet = np.maximum(memory[:n], 0.0), memory[n : 2 * n], memory[2 * n]
    psi = np.tanh(nu / rule.width)
    slow = np.abs(v) <= np.minimum(rule.slow, rule.share * np.abs(nu) + _STILL)
    dwell = np.where(slow, np.where(stood < 1.0, 1.0 / _DWELL, 0.0), -stood / _RELEASE)
    stands = slow & (stood > _STOOD)
    away = np.abs(e) / rule.fine
    all_stand, near, far = all_of(stands), all_of(away <= 1.0), any_of(away > 2.0)
    rubs = any_of(F_hat > _LITTLE * rule.most)  # or nothing is to rest
    settles = select(far, -quiet, 0.0)
    settles = select(near & all_stand & rubs, 1.0 - quiet, settles) / _RELEASE
    holds = quiet > 0.5
    at_most = any_of(F_hat >= rule.most)
    rises = np.where(F_hat < rule.most, rule.grows * np.abs(psi), 0.0)
    rises = select(near, np.zeros(n), rises)
    falls = -rule.falls * np.maximum(psi * (v - nu), 0.0)
    rate = np.where(stands, rises, np.where(memory[:n] > 0.0, falls, 0.0))
    rate = select(holds | is_lost, np.zeros(n), rate)
    rests = holds | (all_stand & complement(near | at_most))
    return F_hat * psi, np.concatenate([rate, dwell, [settles]]), rests
