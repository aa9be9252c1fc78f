"""Limits of torques and motions that keep the decrease of V: any τ with yᵀ(τ − τ*) ≤ 0 does.

Replacing the law's τ* by another τ changes V̇ by yᵀ(τ − τ*), with the passive output y of eq. (10).
The paper has no limits; its proof allows these. All functions run on symbols, too.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from approxjac.law.branches import choose, complement, repeat, select
from approxjac.law.products import root
from approxjac.law.quadratic import Minimum, QuadraticProgram
from approxjac.validation import Array

_ROUND_OFF = 1e-12
_POWER_ROUND_OFF = 1e-10  # of yᵀ(τ − τ*), relative
_MARGIN = 1e-6  # what a solver may be off
_DEAR = 10.0  # how much dearer it is that a row is not kept than that joints brake otherwise
_FAR = 1e100  # a λ that stands for infinity where a limit or 1/y is infinite
_LEAST = 1e-300
_NO_LOWER = np.array([-np.inf])
_NONE = 1e-100  # a joint that moves less reaches no limit before that


def limited_torque(
    torque: Array, y: Array, lower: Array, upper: Array, weight: Array, rho: float
) -> tuple[Array, float]:
    """Return the torque nearest to τ* within limits that keeps V̇ ≤ −W, or the least slack.

    Minimises ½ Σ rᵢ(τᵢ − τ*ᵢ)² + ρσ subject to τ within its limits, yᵀ(τ − τ*) ≤ σ and σ ≥ 0.
    The minimum is τ = τ* − λ R⁻¹y brought inside the limits, with the smallest λ from 0 to ρ that
    makes σ = 0, or λ = ρ where none does: the proof is bought with extra damping along y, at
    most ρ R⁻¹. The power yᵀ(τ − τ*) falls with λ along a line that is broken where a joint
    reaches or leaves its limit, so λ is found exactly from the power at these breaks.

    τ* [N m or N], y of eq. (10) [rad/s or m/s], the bounds, and the diagonal of R > 0 are (n_v,).
    Returned are τ and σ [W].
    """
    clipped: Array = np.minimum(np.maximum(torque, lower), upper)
    step, power = y / weight, y.dot(clipped - torque)
    if type(torque) is np.ndarray:  # where it is quickly found, which saves time only
        if power <= 0.0:
            return clipped, 0.0
        if not math.isfinite(power):  # it overflows
            return clipped, math.inf
        # where no joint reaches or leaves a limit on the way, the first guess is exact
        slope = float((y * step).dot(clipped == torque))
        multiplier = min(power / slope, rho) if slope > 0.0 else rho
        guess: Array = np.minimum(np.maximum(torque - multiplier * step, lower), upper)
        left = float(y.dot(guess - torque))
        if abs(left) <= _ROUND_OFF * power:
            return guess, 0.0
        if left > 0.0 and multiplier == rho:
            return guess, left
    most = power_zero(power, torque, y, lower, upper, step)
    least = np.minimum(np.maximum(torque - np.minimum(most, rho) * step, lower), upper)
    slack = select(most <= rho, 0.0, y.dot(least - torque))
    is_positive, is_finite = power > 0.0, power < np.inf
    nearest = select(is_positive & is_finite, least, clipped)
    return nearest, select(is_finite, select(is_positive, slack, 0.0), math.inf)


def power_zero(
    power: float, torque: Array, y: Array, lower: Array, upper: Array, step: Array
) -> float:
    """Return the λ > 0 at which the power of `limited_torque` falls to zero; `step` is R⁻¹y.

    The power, positive at λ = 0, never rises and is piecewise linear: λ is on the line from the
    last break with a positive power to the next, and infinite if the power stays positive.
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
    return here + share * (there - here)


def approach_speed(left: Array, fastest: Array, approach: float | Array, knee: Array) -> Array:
    """Return the largest signed speed towards a limit at the distance `left`; negative beyond it.

    At a distance d it is κd at most, so that the limit is approached as exp(−κt), without a sudden
    stop; where that needs more than the deceleration a, √(2ad − (a/κ)²), which a allows until the
    two meet. Beyond the limit it is the speed of return.

    Source: B. Faverjon and P. Tournassoud, "A local based approach for path planning of
    manipulators with a high number of degrees of freedom", ICRA 1987, for κd.

    `left` is d, `fastest` the speed limit, `approach` κ [1/s], and `knee` a/κ, the speed above
    which the deceleration a decides.
    """
    signed = approach * left
    speed = np.abs(signed)
    faster = np.maximum(speed, knee)
    braked = np.sqrt(knee * (faster + faster - knee))
    return np.copysign(np.minimum(np.minimum(speed, braked), fastest), signed)


class JointRange(NamedTuple):
    """Allowed positions of joints and the speed bounds near their ends."""

    ends: Array  # smallest and largest positions, shape (2, n_v), infinite where there is none
    fastest: Array  # largest speeds, shape (2, n_v): NumPy takes its time for another shape
    approach: Array  # κ [1/s]
    knee: Array  # a/κ with the deceleration a that each joint is sure of, shape (2, n_v)

    @classmethod
    def of(
        cls, ends: Any, fastest: Any, approach: float, deceleration: Array | float
    ) -> JointRange:
        """Return a range with a deceleration, which may be infinite."""
        both = np.zeros(np.shape(ends))
        knee = both + np.minimum(deceleration, _FAR) / approach
        return cls(np.asarray(ends), both + fastest, np.array(approach), knee)

    def speed_bounds(self, motion: Array) -> Array:
        """Return the smallest and largest speeds, (2, n_v), by `approach_speed`.

        A joint beyond its range has to return, within its speed limit. `motion` are joint
        positions, shape (n_v,) [rad or m].
        """
        return approach_speed(self.ends - motion, *self[1:])


def acceleration_bounds(
    v: Array, speeds: Array, braking: float | Array, jerk: Array | None = None
) -> Array:
    """Return accelerations that keep speeds within bounds, of the shape of these.

    In the next step q̇ covers at most the share r dt of the distance to its bound, and beyond it at
    least that share of the way back. A share well below one avoids chatter although the step is
    predicted with a wrong inertia.

    With limited torque rates, an acceleration has to be reduced in time: within the distance to the
    bound, at half of the possible jerk, so it is √(jd) at most.

    v is q̇ or another speed; a bound may be infinite; `braking` is r [1/s], and `jerk` is j, the
    largest rate of accelerations [rad/s³ or m/s³], None for no limit.
    """
    left: Array = speeds - v
    if jerk is None:
        return braking * left
    size = np.abs(left)
    size = np.minimum(braking * size, np.sqrt(jerk * size))
    return np.copysign(size, left)


class Rows(NamedTuple):
    """Bounds of q̈, and of further rows E q̈, at one step."""

    low: Array  # shape (n_v + k,), those of q̈ first; −inf where there is no bound
    high: Array  # shape (n_v + k,), inf where there is none
    E: Array | None = None  # shape (k, n_v); None is without further rows

    def of(self, q_dd: Array) -> Array:
        """Return the bounded numbers of q̈ (n_v,) or of matrices (n_v, n_v)."""
        return q_dd if self.E is None else np.concatenate([q_dd, self.E.dot(q_dd)])

    def of_torque(self, M_inv: Array, at_rest: Array) -> tuple[Array, Array, Array]:
        """Return A and bounds of A τ where q̈ = M̂⁻¹τ + q̈₀, q̈₀ the acceleration `at_rest`."""
        offset = self.of(at_rest)
        return self.of(M_inv), self.low - offset, self.high - offset

    def per(self, rho: Array) -> Rows:
        """Return the rows of a where q̈ = ρa, ρ > 0 of shape (n_v,)."""
        if self.E is None:
            return Rows(self.low / rho, self.high / rho)
        n = len(rho)
        low, high = (np.concatenate([s[:n] / rho, s[n:]]) for s in (self.low, self.high))
        return Rows(low, high, self.E * rho)


class AskedTorque(NamedTuple):
    """A torque that a law asks for, and its bounds, each of shape (n_v,)."""

    torque: Array  # τ*
    lower: Array
    upper: Array
    clipped: Array  # τ* brought within them
    is_beyond: Any  # whether that is another torque


def limit_step(
    asked: AskedTorque,
    output: Callable[[], tuple[Array, Any]] | None,
    weight: Array,
    forward: Callable[[Array], Array],
    M_inverse: Callable[[], Array],
    rows: Rows | None,
    residual: Array | None,
    brakes: Callable[[Array, Rows, Array], Array],
    minimum: Minimum,
) -> tuple[Array, Array, Any, Any, Any]:
    """Bring τ* within bounds of torque and motion, and keep V̇ ≤ −W where they leave room for it.

    Minimises ½(τ − τ*)ᵀR(τ − τ*) + ρσ subject to yᵀ(τ − τ*) ≤ σ, σ ≥ 0, to τ within its bounds, and
    to q̈ within those of the rows, with q̈ = M̂⁻¹τ + q̈₀ of the believed arm. No solver is called if
    the closed form keeps the rows.

    Args:
        asked: τ* and its bounds.
        output: Function that returns y, shape (n_v,), and ρ; None is without the proof.
        weight: Diagonal of R, shape (n_v,).
        forward: Function of a torque that returns the believed arm's q̈.
        M_inverse: Function that returns M̂⁻¹, shape (n_v, n_v).
        rows: Bounds of motion, if any.
        residual: Correction of the believed q̈, shape (n_v,), if there are rows.
        brakes: Function of M̂⁻¹, rows and q̈₀ for the torque without a minimum, such as `braked`.
        minimum: Solver.

    Returns:
        τ; q̈ by the believed dynamics with it, if motion is bounded; σ = yᵀ(τ − τ*) ≥ 0 [W], 0
        without the proof; 0, or 1 if no torque keeps all bounds, 2 if the solver failed; 1 if τ
        is τ*, else 0.
    """
    wanted, lower, upper, clipped, beyond = asked

    def nearest() -> tuple[Array, Any]:
        if output is None:
            return clipped, 0.0
        y, rho = output()
        return limited_torque(wanted, y, lower, upper, weight, rho)

    near, slack = choose(beyond, nearest, lambda: (wanted, 0.0))
    q_dd, fits, f = near, True, near
    if rows is not None and residual is not None:
        f = forward(near)
        q_dd = f + residual
        fits = within(rows.low.tolist(), rows.of(q_dd).tolist(), rows.high.tolist())
    free = select(beyond, 0.0, 1.0)

    def searched() -> tuple[Array, Array, Any, Any, Any]:
        M_inv = M_inverse()
        assert rows is not None
        at_rest = q_dd - M_inv.dot(near)
        (A, low, high), y, price = rows.of_torque(M_inv, at_rest), None, None
        if output is not None:  # yᵀ(τ − τ*) ≤ 0; of length one, solvers do better
            y, rho = output()
            size = np.maximum(root(y.dot(y)), _LEAST)
            price, row = rho * size, (y / size)[np.newaxis]
            A, low = np.concatenate([A, row]), np.concatenate([low, _NO_LOWER])
            high = np.concatenate([high, row.dot(wanted) - _MARGIN])
        R = np.diag(weight)
        problem = QuadraticProgram(R, -R.dot(wanted), lower, upper, A, low, high)
        best, verdict = minimum(problem, price, slack > 0.0)
        (torque,) = choose(verdict > 0, lambda: (brakes(M_inv, rows, at_rest),), lambda: (best,))
        left = 0.0
        if y is not None:  # yᵀ(τ − τ*) where positive by more than round-off [W]
            power = y.dot(torque - wanted)
            round_off = _POWER_ROUND_OFF * np.maximum(1.0, np.abs(y).dot(np.abs(wanted)))
            left = select(power < np.inf, select(power <= round_off, 0.0, power), math.inf)
        return torque, f + M_inv.dot(torque - near), left, verdict, 0.0

    return choose(complement(fits), searched, lambda: (near, f, slack, 0, free))


def braked(
    M_inv: Array,
    rows: Rows,
    at_rest: Array,
    lower: Array,
    upper: Array,
    brake: Array,
    hold: Array,
    minimum: Minimum,
) -> Array:
    """Return a torque that brakes as hard as motors can, shape (n_v,).

    Rows are given up one by one, that which asks most of the motors first, until there is a torque;
    those given up come as near to their bounds as the others allow.

    `brake` is the q̈ that brings joints to rest, which is wanted beside further rows E; `hold` is
    the torque to send if everything fails.
    """
    A, low, high = rows.of_torque(M_inv, at_rest)
    n, start = len(lower), brake
    if rows.E is None:
        start = np.zeros(n)
    # the least square of q̈ − wanted, weighted by M̂ and by what is dear besides
    wanted = np.concatenate([start, np.zeros(len(rows.low) - n)])
    wanted = np.minimum(np.maximum(wanted, rows.low), rows.high)
    change, lacks = wanted - rows.of(at_rest), np.abs(wanted) / np.abs(A).dot(upper)
    sizes = np.diag(M_inv)
    if rows.E is not None:
        sizes = np.concatenate([sizes, (rows.E * A[n:]).sum(axis=1)])
    dearness = _DEAR / np.maximum(sizes, _LEAST)
    # the place of each from the one that lacks most on; the first of two that tie
    others, before = lacks[:, np.newaxis], np.tri(len(lacks), k=-1, dtype=bool)
    place = np.where((lacks > others) | ((lacks == others) & before), 1.0, 0.0).sum(axis=1)

    def stage(i: Any, before: tuple[Array, Any]) -> tuple[Array, Any]:
        def tried() -> tuple[Array, Any]:
            soft = place <= i
            dear = np.where(soft, dearness, 0.0)
            H = M_inv + (A.T * dear).dot(A)
            f = -change[:n] - A.T.dot(dear * change)
            least, most = np.where(soft, -np.inf, low), np.where(soft, np.inf, high)
            return minimum(QuadraticProgram(H, f, lower, upper, A, least, most), None, False)

        return choose(before[1] > 0, tried, lambda: before)

    torque, verdict = repeat(len(wanted), stage, (hold, 1))
    return choose(verdict > 0, lambda: (hold,), lambda: (torque,))[0]


def within(low: list[Any], values: list[Any], high: list[Any]) -> Any:
    """Return True if all values are within their bounds."""
    try:
        return all(map(operator.le, low, values)) and all(map(operator.le, values, high))
    except TypeError:  # symbols
        holds: Any = True
    for pair in [*zip(low, values, strict=True), *zip(values, high, strict=True)]:
        if not any(isinstance(each, float) and math.isinf(each) for each in pair):
            holds = holds & (pair[0] <= pair[1])
    return holds


def largest(values: list[Any], least: float) -> Any:
    """Return the largest of some numbers' sizes and of `least`."""
    try:
        return max(least, *map(abs, values))
    except TypeError:  # symbols
        return functools.reduce(np.maximum, map(abs, values), least)
