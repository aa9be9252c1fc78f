"""Torque limits that keep the decrease of V: any τ with yᵀ(τ − τ*) ≤ 0 does.

Replacing the law's τ* by another τ changes V̇ by yᵀ(τ − τ*), with the passive output y of eq. (10).
The paper has no torque limits; this is what its proof leaves room for.
"""

from __future__ import annotations

import math

import numpy as np

from approxjac.validation import Array

_ROUND_OFF = 1e-12
_FAR = 1e100  # a λ that stands for infinity where a limit or 1/y is infinite
_LEAST = 1e-300
_NONE = 1e-100  # a joint that moves less reaches no limit before that


def limited_torque(
    torque: Array, y: Array, lower: Array, upper: Array, weight: Array, rho: float
) -> tuple[Array, float]:
    """Torque nearest to τ* within limits that keeps V̇ ≤ −W, or gives up as little as it can.

    Minimises ½ Σ rᵢ(τᵢ − τ*ᵢ)² + ρσ subject to τ within its limits, yᵀ(τ − τ*) ≤ σ and σ ≥ 0.
    The minimum is τ = τ* − λ R⁻¹y brought inside the limits, with the smallest λ from 0 to ρ that
    makes σ = 0, or λ = ρ where none does: the proof is bought with extra damping along y, at
    most ρ R⁻¹. The power yᵀ(τ − τ*) falls with λ along a line that is broken where a joint
    reaches or leaves its limit, so λ is found exactly from the power at these breaks.

    Args:
        torque: τ* of the law, shape (n_v,) [N m or N].
        y: Passive output, eq. (10), shape (n_v,) [rad/s or m/s].
        lower: Smallest torques, shape (n_v,).
        upper: Largest torques, shape (n_v,), not below `lower`.
        weight: Diagonal of R > 0, shape (n_v,).
        rho: ρ ≥ 0, the most that λ may be.

    Returns:
        τ within the limits, shape (n_v,), and σ [W].
    """
    clipped: Array = np.minimum(np.maximum(torque, lower), upper)
    power = float(y.dot(clipped - torque))
    if power <= 0.0:
        return clipped, 0.0
    if not math.isfinite(power):  # it overflows
        return clipped, math.inf
    # where no joint reaches or leaves a limit on the way, the first guess is exact
    step = y / weight
    slope = float((y * step).dot(clipped == torque))
    multiplier = min(power / slope, rho) if slope > 0.0 else rho
    guess: Array = np.minimum(np.maximum(torque - multiplier * step, lower), upper)
    left = float(y.dot(guess - torque))
    if abs(left) <= _ROUND_OFF * power:
        return guess, 0.0
    if left > 0.0 and multiplier == rho:
        return guess, left
    root = power_zero(power, torque, y, lower, upper, step)
    least: Array = np.minimum(np.maximum(torque - min(root, rho) * step, lower), upper)
    return least, 0.0 if root <= rho else float(y.dot(least - torque))


def power_zero(
    power: float, torque: Array, y: Array, lower: Array, upper: Array, step: Array
) -> float:
    """λ > 0 where the power of `limited_torque`, positive at λ = 0, falls to zero.

    It never rises, and is straight between the breaks: so λ is on the line from the last break that
    has a power above zero to the first one that has not, and infinite where none has not.

    Args:
        power: yᵀ(τ − τ*) at λ = 0.
        torque: As in `limited_torque`, and so are y, lower and upper.
        y: Passive output.
        lower: Smallest torques.
        upper: Largest torques.
        step: R⁻¹y, shape (n_v,).
    """
    per_step = np.where(np.abs(step) < _NONE, _FAR, step)
    ends = np.concatenate([torque - lower, torque - upper]) / np.concatenate([per_step, per_step])
    breaks = np.minimum(np.maximum(ends, 0.0), _FAR)  # λ where each joint is at a limit
    torques = np.minimum(np.maximum(torque - breaks[:, np.newaxis] * step, lower), upper)
    powers = (torques - torque).dot(y)
    is_above = powers > 0.0
    here, there = np.where(is_above, breaks, 0.0).max(), np.where(is_above, np.inf, breaks).min()
    above = np.minimum(np.where(is_above, powers, power).min(), power)
    below = np.where(is_above, -_FAR, powers).max()
    share = np.maximum(above / (above - below), _LEAST)  # for what is infinitely far stays so
    root: float = here + share * (there - here)
    return root
