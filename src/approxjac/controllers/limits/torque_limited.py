"""`TorqueLimited`: torque, rate and joint limits by a QP that keeps the proof where it can."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import pinocchio as pin

from approxjac import law
from approxjac.controllers.arguments import require_dt
from approxjac.controllers.controller import Controller
from approxjac.controllers.gains.sample_configurations import (
    light_inertias,
    quickest,
    usual_inertias,
)
from approxjac.controllers.limits.acceleration_observer import AccelerationObserver
from approxjac.controllers.limits.cross_weight import CrossWeight
from approxjac.controllers.limits.limiter import Asked, Limited, Limiter
from approxjac.controllers.limits.limits import (
    Limits,
    acceleration_bounds,
    speed_bounds,
    sure_deceleration,
)
from approxjac.controllers.limits.quadratic_program import QuadraticProgram, Verdict, as_solver
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.interface import Evaluation, LimitStatus, Measurement, Target
from approxjac.validation import Array, as_diagonal, as_number, require

Weight = Literal["joint inertia", "inertia", "identity"]
_WEIGHTS = ("joint inertia", "inertia", "identity")
_FREE, _LIMITED, _INFEASIBLE = LimitStatus.FREE, LimitStatus.LIMITED, LimitStatus.INFEASIBLE
_KEPT, _GIVEN_UP = LimitStatus.PROOF_KEPT, LimitStatus.PROOF_GIVEN_UP
_ROUND_OFF = 1e-10
_MARGIN = 1e-6  # what a solver may be off
_NO_LOWER = np.array([-np.inf])
_UNKNOWN, _KNOWN = 0.1, 0.3  # times the rate of samples, or of the lag: how fast damping may be
_TOLD = 1e-3  # beyond a limit of speed (as a share) or position [rad or m] that has its status
_HUGE = 1e30  # below it nothing overflows
_DEAR = 10.0  # how much dearer it is that a joint brakes too little than that others do


class Ahead(NamedTuple):
    """Motion that a torque leads to in the next period.

    Attributes:
        f: q̈ by the believed dynamics, shape (n_v,).
        residual: r, by which periods have shown that to be wrong, shape (n_v,).
        q_dd: Both together.
        speeds: Smallest and largest q̇, n_v numbers each.
        place: Joint positions, then q̇.
    """

    f: Array
    residual: Array
    q_dd: Array
    speeds: tuple[list[float], list[float]]
    place: list[float]


class TorqueLimited(Limiter):
    """A controller whose torque keeps limits, and the proof where limits leave room for it.

    Replacing the law's τ* by τ changes V̇ by yᵀ(τ − τ*) with y = q̇ + αĴ⁺s(e), so that any τ with
    yᵀ(τ − τ*) ≤ 0 keeps V̇ ≤ −W. In each step

        min ½(τ − τ*)ᵀR(τ − τ*) + ρσ   subject to   yᵀ(τ − τ*) ≤ σ,  σ ≥ 0

    and to the limits: of τ and its rate; and of q̇ and q, whose next step the believed dynamics
    predict. A slack σ > 0 is reported, never hidden. The multiplier of the proof's row acts as
    damping added along y, λR⁻¹ with λ ≤ ρ, so ρ is chosen such that this damping is not faster
    than `braking` at usual configurations.

    Where R is diagonal and no limit of speed or position is near, the minimum is known in closed
    form and no solver is called. Where no torque keeps all limits, and where the solver fails,
    joints are braked as hard as motors can, those first that need it most. On a path q̇ − Ĵ⁺ẋ_d
    takes the place of q̇ in y.

    Immutable, but it owns scratch memory: one instance a thread.

    Attributes:
        cross_weight: G of the V that is kept falling; None where it is αĴ⁺.

    Args:
        controller: The controller whose torque to limit.
        limits: Limits to keep; those of the believed robot's URDF by default.
        weight: R: "joint inertia", diagonal, the largest (M̂⁻¹)ᵢᵢ over usual configurations;
            "inertia", M̂(q)⁻¹, so that accelerations change least; "identity"; or a diagonal, shape
            (n_v,).
        proof: Whether yᵀ(τ − τ*) ≤ σ is asked for.
        alpha: α of y [1/s]; that of the adaptation where gravity is learnt. By default 0.3 of the
            rate of the task's slow pole: with a small α it is q̇ that counts, and the proof can be
            kept more often.
        cross_weight: G of y = q̇ + G(q)s(e) in place of αĴ⁺, such as `StabilityReport.cross_weight`:
            then it is the report's own V that the limits let fall.
        dt: Sampling time [s].
        braking: How fast damping may be, and the correction of `AccelerationObserver` [1/s],
            at most 1/dt. By
            default 0.3 over the lag of q̇ where the law knows its latency. Else as fast as the law's
            own joint damping, which the loop stands, but from 0.1/dt to 0.3/dt; with a limit of the
            rate 0.1/dt.
        approach: κ of `speed_bounds` [1/s], at most `braking`; a tenth of it by default.
        solver: "daqp", "osqp", or a function that takes a `QuadraticProgram` and returns its
            minimum.

    Raises:
        InvalidInputError: Numbers out of range, limits of another number of joints, another α than
            that of the adaptation, or a cross_weight beside α or of another law.
        UnknownNameError: No such weight or solver.
    """

    def __init__(
        self,
        controller: Controller,
        limits: Limits | None = None,
        *,
        weight: Weight | Sequence[float] | Array = "joint inertia",
        proof: bool = True,
        alpha: float | None = None,
        cross_weight: CrossWeight | None = None,
        dt: float = 1e-3,
        braking: float | None = None,
        approach: float | None = None,
        solver: str | Callable[[QuadraticProgram], Array | None] = "daqp",
    ) -> None:
        super().__init__(controller, limits)
        self._remember(locals())
        self._dt = as_number("dt", dt, unit="s", above=0.0)
        inside = controller.dt
        if inside is not None and not math.isclose(inside, self._dt):
            wanted = f"that of the controller inside, {inside:g} [s]"
            told = (
                f"{dt!r}; take TorqueLimited(..., dt={inside!r}), or build the controller inside "
            )
            told += "for another"
            raise InvalidInputError(f"dt must be {wanted}, got {told}", given=dt)
        require("proof", proof, bool, "True or False")
        robot = controller.task.robot
        self.proof = proof
        self.alpha = controller.resolved_alpha(alpha)
        if cross_weight is not None:
            wanted = "a CrossWeight, such as that of a StabilityReport, or None"
            require("cross_weight", cross_weight, CrossWeight, wanted)
            if alpha is not None:
                raise InvalidInputError(
                    f"alpha must be None with a cross_weight, which takes its place, got {alpha!r}",
                    given=alpha,
                )
            cross_weight = cross_weight.required_of(controller)
        self.cross_weight = cross_weight
        inertias = usual_inertias(robot)
        usual = self._usual_braking(inertias)
        self.braking = self._rate_of("braking", braking, 1.0 / self._dt, usual)
        self.approach = self._rate_of("approach", approach, self.braking, 0.1 * self.braking)
        self._solver, self._brakes = as_solver(solver), as_solver("daqp")
        self._diagonal = self._resolved_weight(weight, inertias)
        self.weight = weight if isinstance(weight, str) else self._diagonal
        self._R = None if self._diagonal is None else np.diag(self._diagonal)
        self._rho = self.braking
        if self._diagonal is not None:
            self._rho = self.braking / quickest(inertias, 1.0 / self._diagonal)
        own = np.median([np.diag(M) for M in inertias], axis=0)
        self._jerk = self._rate / own if self._has_rate else None
        self._prediction = AccelerationObserver(controller, self._dt, self.braking)
        self._dynamics = self._prediction.dynamics
        self._model = robot.model
        self._neutral = None if robot.nq == robot.nv else robot.neutral()
        # arrays, which NumPy multiplies with in a third of the time of numbers
        self._braking, self._alpha = np.array(self.braking), np.array(self.alpha)
        (low, high), fastest = np.array(self.limits.position), np.asarray(self.limits.velocity)
        joints = np.array([low, high, fastest, sure_deceleration(robot, self._upper)])
        self._joints = joints.T.tolist()
        too_fast = (1.0 + _TOLD) * fastest
        self._told = [*(low - _TOLD), *-too_fast], [*(high + _TOLD), *too_fast]
        self._per_speed = 1.0 / fastest if np.isfinite(fastest).any() else None
        self._looks_ahead = bool(np.isfinite(joints[:3]).any())
        if self._looks_ahead:
            self._keep(self._prediction.nothing())
        self._no_rows = np.zeros((0, robot.nv)), np.zeros(0), np.zeros(0)
        # with a diagonal R, the nearest torque within bounds alone is the clipped one
        self._only_clips = not (proof or self._looks_ahead) and self._diagonal is not None

    @property
    def dt(self) -> float | None:  # type: ignore[override]
        """Sampling time that control has to have [s], or None where any will do."""
        return self._dt if self._looks_ahead else self.controller.dt

    def step(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """Return the state after a step, and a torque within the limits: see `Limiter.step`.

        Raises:
            InvalidInputError: Another dt than the one that speeds and positions are limited for.
        """
        if self._looks_ahead and dt != self._dt:
            require_dt(dt, self._dt)
        return super().step(state, measurement, target, dt)

    def _limit(self, asked: Asked) -> Limited:
        if self._only_clips:
            return Limited(asked.clipped, _LIMITED, math.nan, asked.memory)
        answer, (_, q, v, *_) = asked.answer, asked.measurement
        numbers = answer.torque.tolist() + answer.e.tolist() + q.tolist() + v.tolist()
        numbers += asked.gravity.tolist() + asked.memory.tolist()  # what was learnt may be any
        if math.hypot(*numbers) < _HUGE:  # NaN where x is lost
            return self._nearest(asked)
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows has a status
            return self._nearest(asked)

    def _nearest(self, asked: Asked) -> Limited:
        """Return what `_limit` does."""
        answer, _, (_, q, v, *_), lower, upper, torque, free, *_ = asked
        wanted, y, rho, slack = answer.torque, None, 0.0, math.nan
        if not free and self.proof:
            y, rho = self._passive_output(asked)
            if self._diagonal is not None:
                torque, slack = law.limited_torque(wanted, y, lower, upper, self._diagonal, rho)
        ahead = self._predicted(asked, torque) if self._looks_ahead else None
        # the minimum without rows that it keeps is the minimum with them
        if (free or self._diagonal is not None) and (ahead is None or self._keeps(ahead, v)):
            status, slack = (_FREE, 0.0) if free else self._said(answer, slack)
            if free and ahead is not None and not _is_within(ahead.place, *self._told):
                status = LimitStatus.EXCEEDED
            return self._limited(asked, torque, status, slack, ahead)

        if y is None:
            y, rho = self._passive_output(asked)
        M_inv, R, bounds, q_dd_0 = self._dynamics.M_inv(q), self._R, None, None
        if R is None:
            R = M_inv
        A, low, high = self._no_rows
        if ahead is not None:
            # q̈ = M̂⁻¹τ + q̈₀ is within its bounds, with q̈₀ the acceleration without a torque
            bounds, q_dd_0 = self._accelerations(ahead, v), ahead.q_dd - M_inv.dot(torque)
            A, (low, high) = M_inv, bounds - q_dd_0
        price = None
        if self.proof:  # yᵀ(τ − τ*) ≤ 0; of length one, solvers do better
            size = math.hypot(*y.tolist()) or 1.0
            price, most = rho * size, np.array([y.dot(wanted) / size - _MARGIN])
            A = np.concatenate([A, (y / size)[np.newaxis]])
            low, high = np.concatenate([low, _NO_LOWER]), np.concatenate([high, most])
        problem = QuadraticProgram(R, -R.dot(wanted), lower, upper, A, low, high)
        found, verdict = self._solver.solve(problem, price, slack > 0.0)
        if found is not None:
            status, slack = self._said(answer, _slack(found, wanted, y))
        else:
            status = _INFEASIBLE if verdict is Verdict.INFEASIBLE else LimitStatus.SOLVER_FAILED
            found = self._fallback(asked, M_inv, bounds, q_dd_0)
            _, slack = self._said(answer, _slack(found, wanted, y))
        if ahead is not None:
            ahead = Ahead(ahead.f + M_inv.dot(found - torque), *ahead[1:])
        return self._limited(asked, found, status, slack, ahead)

    def _limited(
        self, asked: Asked, torque: Array, status: LimitStatus, slack: float, ahead: Ahead | None
    ) -> Limited:
        """Return a torque with its status, and the memory for the next step."""
        memory = asked.memory
        if ahead is not None:
            memory = self._prediction.expecting(asked.measurement, ahead.f, ahead.residual)
        return Limited(torque, status, slack, memory)

    def _said(self, answer: Evaluation, slack: float) -> tuple[LimitStatus, float]:
        """Return status and slack of a torque that was limited and keeps the limits."""
        if not self.proof or not self.controller.is_proven(answer):
            return _LIMITED, math.nan  # without x, or without Ĵ⁺, there is no V
        return (_KEPT, 0.0) if slack == 0.0 else (_GIVEN_UP, slack)

    def _fallback(
        self, asked: Asked, M_inv: Array, bounds: Array | None, q_dd_0: Array | None
    ) -> Array:
        """Return a torque that brakes as hard as motors can, shape (n_v,).

        Joints that cannot be kept within their bounds come as near to them as can be, for which the
        others give way within theirs: first the one that lacks most counts as one that cannot,
        then the two that do, until there is a torque. Without bounds joints come to rest.
        """
        v, lower, upper, gravity = asked.measurement.v, asked.lower, asked.upper, asked.gravity
        dear = np.zeros_like(v)
        if bounds is None or q_dd_0 is None:
            q_dd_0 = self._prediction.forward(asked.measurement, dear, gravity)
            wanted, low, high = -self._braking * v, dear - np.inf, dear + np.inf
        else:
            wanted = np.minimum(np.maximum(0.0, bounds[0]), bounds[1])
            low, high = bounds - q_dd_0
        # the least square of q̈ − wanted, weighted by M̂ and by what is dear besides
        change = wanted - q_dd_0
        for joint in np.argsort(-np.abs(wanted) / np.abs(M_inv).dot(upper)):
            low[joint], high[joint], dear[joint] = -np.inf, np.inf, _DEAR / M_inv[joint, joint]
            H, f = M_inv + (M_inv * dear).dot(M_inv), -change - M_inv.dot(dear * change)
            problem = QuadraticProgram(H, f, lower, upper, M_inv, low, high)
            found, _ = self._brakes.solve(problem)
            if found is not None:
                return found
        return np.minimum(np.maximum(gravity, lower), upper)

    def _predicted(self, asked: Asked, torque: Array) -> Ahead:
        """Return what a torque leads to."""
        measurement, q = asked.measurement, asked.measurement.q
        motion = q if self._neutral is None else pin.difference(self._model, self._neutral, q)
        f = self._prediction.forward(measurement, torque, asked.gravity)
        r = self._prediction.residual(asked.memory, measurement)
        place = motion.tolist() + measurement.v.tolist()
        return Ahead(f, r, f + r, speed_bounds(motion, self._joints, self.approach), place)

    def _keeps(self, ahead: Ahead, v: Array) -> bool:
        """Return whether q̈ leads q̇ into its bounds."""
        if self._jerk is None:  # the same, in less time
            return _is_within((v + ahead.q_dd / self._braking).tolist(), *ahead.speeds)
        return _is_within(ahead.q_dd.tolist(), *self._accelerations(ahead, v).tolist())

    def _accelerations(self, ahead: Ahead, v: Array) -> Array:
        """Return bounds of q̈, shape (2, n_v)."""
        return acceleration_bounds(v, np.array(ahead.speeds), self._braking, self._jerk)

    def _passive_output(self, asked: Asked) -> tuple[Array, float]:
        """Return y, shape (n_v,), and ρ.

        λ pulls q̇ to where y is 0, such as Ĵ⁺ẋ_d − αĴ⁺s(e). Where that is faster than joints may
        move, ρ is reduced, or the pull would drive them into their limits of speed for as long as
        the error lasts.
        """
        answer, v = asked.answer, asked.measurement.v
        if self.cross_weight is None:
            y = self.controller.passive_output(answer, v, self._alpha)
        else:
            y = self.cross_weight.passive_output(self.controller, answer, v)
        if answer.reference is not None:
            y = y - answer.reference
        if self._per_speed is None:
            return y, self._rho
        pull = ((y - v) * self._per_speed).tolist()
        if math.hypot(*pull) <= 1.0:  # the norm first: it is cheap, and mostly small enough
            return y, self._rho
        return y, self._rho / max(1.0, *map(abs, pull))

    def _usual_braking(self, inertias: Array) -> float:
        latency = self.controller.latency
        if latency is not None:
            return _KNOWN / (latency.of_velocity - latency.period + self._dt)
        # the loop stands the law's own damping, too; a limit of the rate makes it act late
        own = 0.0 if self._has_rate else self.controller.damping_rate(inertias)
        return min(max(_UNKNOWN / self._dt, own), _KNOWN / self._dt)

    def _rate_of(self, name: str, value: float | None, most: float, usual: float) -> float:
        """Return a rate that was given, at most `most`, or the usual one."""
        if value is None:
            return usual
        rate = as_number(name, value, unit="1/s", above=0.0)
        if rate > most * (1.0 + 1e-9):
            raise InvalidInputError(
                f"{name} must be at most {most:g} [1/s], got {rate:g}", given=value
            )
        return rate

    def _resolved_weight(self, weight: Any, inertias: Array) -> Array | None:
        """Return the diagonal of R, or None where it is no diagonal."""
        nv = self.task.robot.nv
        if not isinstance(weight, str):
            return as_diagonal("weight", weight, nv)
        if weight not in _WEIGHTS:
            raise UnknownNameError("weight", weight, "the weights", _WEIGHTS)
        if weight == "joint inertia":
            return 1.0 / light_inertias(inertias)
        return np.ones(nv) if weight == "identity" else None

    def __repr__(self) -> str:
        weight = self.weight if isinstance(self.weight, str) else "a diagonal"
        return (
            f"TorqueLimited({self.controller!r}, weight={weight}, proof={self.proof}, "
            f"dt={self._dt:g}, braking={self.braking:g}, solver={self._solver.name}"
            + (")" if self.cross_weight is None else f", cross_weight={self.cross_weight!r})")
        )


def _slack(torque: Array, wanted: Array, y: Array) -> float:
    """Return σ = yᵀ(τ − τ*) where positive by more than round-off [W]."""
    power = float(y.dot(torque - wanted))
    if power <= 0.0:
        return 0.0
    if not math.isfinite(power):
        return math.inf
    round_off = _ROUND_OFF * max(1.0, float(np.abs(y).dot(np.abs(wanted))))
    return power if power > round_off else 0.0


def _is_within(values: list[float], low: list[float], high: list[float]) -> bool:
    return all(map(operator.le, low, values)) and all(map(operator.le, values, high))
