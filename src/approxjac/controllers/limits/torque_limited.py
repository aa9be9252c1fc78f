"""`TorqueLimited`: torque, rate and joint limits by a QP that keeps the proof where it can."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

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
from approxjac.controllers.limits.limit import FramesByName, Limit, LimitTerms, require_rows
from approxjac.controllers.limits.limiter import Asked, Limited, Limiter
from approxjac.controllers.limits.limits import Limits, sure_deceleration
from approxjac.controllers.limits.quadratic_program import QuadraticProgram, as_solver
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.interface import Evaluation, LimitStatus, Measurement, Target
from approxjac.robots.traced import motion_between
from approxjac.validation import Array, as_diagonal, as_number, require

Weight = Literal["joint inertia", "inertia", "identity"]
_WEIGHTS = ("joint inertia", "inertia", "identity")
_FREE, _LIMITED = LimitStatus.FREE, LimitStatus.LIMITED
_VERDICTS = _LIMITED, LimitStatus.INFEASIBLE, LimitStatus.SOLVER_FAILED
_KEPT, _GIVEN_UP = LimitStatus.PROOF_KEPT, LimitStatus.PROOF_GIVEN_UP
_UNKNOWN, _KNOWN = 0.1, 0.3  # times the rate of samples, or of the lag: how fast damping may be
_TOLD = 1e-3  # beyond a limit of speed (as a share) or position [rad or m] that has its status
_HUGE = 1e30  # below it nothing overflows
_FAR = 1e100  # a deceleration that stands for infinity
_TRIAL = 1.0  # speed of joints at which limits are asked for their rows first [rad/s or m/s]


class Believed(NamedTuple):
    """The believed arm at one step, as `law.limit_step` asks for it.

    Attributes:
        prediction: What predicts.
        measurement: q and q̇.
        gravity: What the controller compensates, shape (n_v,).
    """

    prediction: AccelerationObserver
    measurement: Measurement
    gravity: Array

    def forward(self, torque: Array) -> Array:
        """Return q̈ by the believed dynamics, shape (n_v,)."""
        return self.prediction.forward(self.measurement, torque, self.gravity)

    def M_inv(self) -> Array:
        """Return M̂⁻¹, shape (n_v, n_v)."""
        return self.prediction.dynamics.M_inv(self.measurement.q)


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
        motion_limits: Limits of motion besides those of joints.

    Args:
        controller: The controller whose torque to limit.
        limits: Limits to keep: `Limits` of joints and motors, a `Limit` of motion such as `Wall`,
            or a list of them. Where there are no `Limits` among them, those of the believed
            robot's URDF are kept.
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
        limits: Limits | Limit | Sequence[Limits | Limit] | None = None,
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
        self._remember(locals())
        arguments = self._arguments
        of_joints, self.motion_limits = _sorted(limits)
        super().__init__(controller, of_joints)
        self._arguments = arguments
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
            cross_weight = cross_weight.required_of(controller)  # type: ignore[arg-type]
        self.cross_weight = cross_weight
        inertias = usual_inertias(robot)
        usual = self._usual_braking(inertias)
        self.braking = self._rate_of("braking", braking, 1.0 / self._dt, usual)
        self.approach = self._rate_of("approach", approach, self.braking, 0.1 * self.braking)
        self._solver, self._brakes = as_solver(solver), as_solver("daqp")
        self._diagonal = self._resolved_weight(weight, inertias)
        self.weight = weight if isinstance(weight, str) else self._diagonal
        self._rho = self.braking
        if self._diagonal is not None:
            self._rho = self.braking / quickest(inertias, 1.0 / self._diagonal)
        own = np.median([np.diag(M) for M in inertias], axis=0)
        self._jerk = self._rate / own if self._has_rate else None
        self._prediction = AccelerationObserver(controller, self._dt, self.braking)
        self._dynamics = self._prediction.dynamics
        self._neutral = None if robot.nq == robot.nv else robot.neutral()
        # arrays, which NumPy multiplies with in a third of the time of numbers
        self._braking, self._alpha = np.array(self.braking), np.array(self.alpha)
        (low, high), fastest = np.array(self.limits.position), np.asarray(self.limits.velocity)
        most = np.asarray(self.limits.acceleration)
        self._acceleration = most if np.isfinite(most).any() else None
        sure = np.minimum(sure_deceleration(robot, self._upper), most)
        self._sure = np.minimum(sure, _FAR)
        self._joints = law.JointRange.of(self.limits.position, fastest, self.approach, sure)
        too_fast = (1.0 + _TOLD) * fastest
        self._told = [*(low - _TOLD), *-too_fast], [*(high + _TOLD), *too_fast]
        self._per_speed = 1.0 / fastest if np.isfinite(fastest).any() else None
        self._frames = FramesByName(robot)
        self._looks_ahead = bool(np.isfinite([low, high, fastest, most]).any())
        if self.motion_limits:
            self._looks_ahead = True
            q = robot.random_configuration(np.random.default_rng(0))
            for limit in self.motion_limits:
                require_rows(limit, self._terms(q, np.full(robot.nv, _TRIAL)), self._dt)
        if self._looks_ahead:
            self._keep(self._prediction.nothing())
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
        answer, memory = asked.answer, asked.memory
        residual = rows = None
        if self._looks_ahead:
            residual = self._prediction.residual(memory, asked.measurement)
            rows = self.rows(asked.measurement)
        found = self.limited(
            asked, residual, rows, lambda: self._passive_output(asked),
            self._solver.minimum, self._brakes.minimum,
        )  # fmt: skip
        proven = self.proof and self.controller.is_proven(answer)
        status, slack = _VERDICTS[found.verdict], found.slack if proven else math.nan
        if found.free:
            status, slack = _FREE, 0.0
            if rows is not None and self.is_exceeded(asked.measurement):
                status = LimitStatus.EXCEEDED
        elif not found.verdict:
            # without x, or without Ĵ⁺, there is no V
            status = (_KEPT if slack == 0.0 else _GIVEN_UP) if proven else _LIMITED
        if residual is not None:
            memory = self._prediction.expecting(asked.measurement, found.f, residual)
        return Limited(found.torque, status, float(slack), memory)

    # what follows runs on symbols, too

    def limited(
        self,
        asked: Asked,
        residual: Array | None,
        rows: law.Rows | None,
        output: Callable[[], tuple[Array, Any]],
        minimum: law.Minimum,
        brake_minimum: law.Minimum,
    ) -> law.LimitStep:
        """Return the torque of a step within its limits, as numbers or as symbols.

        Args:
            asked: What is asked for.
            residual: r, shape (n_v,), where there are rows.
            rows: Bounds of motion, if there are any.
            output: Gives y, shape (n_v,), and ρ.
            minimum: Solver.
            brake_minimum: Solver of what is sent where that finds nothing.
        """
        _, gravity, measurement, lower, upper, *_ = asked
        believed = Believed(self._prediction, measurement, gravity)

        def brakes(M_inv: Array, bounds: law.TorqueRows | None) -> Array:
            hold = np.minimum(np.maximum(gravity, lower), upper)
            rest = -self._braking * measurement.v
            return law.braked(M_inv, bounds, lower, upper, believed, rest, hold, brake_minimum)

        return law.limit_step(
            asked.answer.torque, asked.clipped, law.complement(asked.free), lower, upper,
            output if self.proof else None, self._diagonal, believed, rows, residual, brakes,
            minimum,
        )  # fmt: skip

    def rows(self, measurement: Measurement) -> law.Rows:
        """Return the bounds of motion at a configuration and speed."""
        _, q, v, *_ = measurement
        speeds = law.speed_bounds(self._positions(q), self._joints)
        bounds = law.acceleration_bounds(v, speeds, self._braking, self._jerk)
        if self._acceleration is not None:
            bounds = np.minimum(np.maximum(bounds, -self._acceleration), self._acceleration)
        low, high = bounds
        if not self.motion_limits:
            return law.Rows(low, high)
        terms = self._terms(q, v)
        more = [limit.rows(terms, v, self._dt) for limit in self.motion_limits]
        E, lows, highs = zip(*(map(law.array, each) for each in more), strict=True)
        return law.Rows(
            np.concatenate([low, *lows]), np.concatenate([high, *highs]), np.concatenate(E)
        )

    def is_exceeded(self, measurement: Measurement) -> Any:
        """Return whether a joint is beyond its limits of speed or position."""
        _, q, v, *_ = measurement
        place = self._positions(q).tolist() + v.tolist()
        return law.complement(law.within(self._told[0], place, self._told[1]))

    def _positions(self, q: Array) -> Array:
        """Return the position of each joint, shape (n_v,) [rad or m]."""
        return q if self._neutral is None else motion_between(self.task.robot, self._neutral, q)

    def _terms(self, q: Array, v: Array) -> LimitTerms:
        """Return what limits of motion make their rows of."""
        return LimitTerms(
            self.task.robot, q, v, self._frames, self.approach, self.braking,
            self._sure, self._jerk,
        )  # fmt: skip

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
            law_inside: Any = self.controller
            y = self.cross_weight.passive_output(law_inside, answer, v)
        if answer.reference is not None:
            y = y - answer.reference
        return y, self.price(y, v)

    def price(self, y: Array, v: Array) -> Any:
        """Return ρ, less where y is 0 at a speed that joints may not have."""
        if self._per_speed is None:
            return self._rho
        return self._rho / law.largest(((y - v) * self._per_speed).tolist(), 1.0)

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


def _sorted(
    limits: Limits | Limit | Sequence[Limits | Limit] | None,
) -> tuple[Limits | None, tuple[Limit, ...]]:
    """Return the limits of joints and motors, None of none, and those of motion."""
    listed = tuple(limits) if isinstance(limits, list | tuple) else (limits,)
    of_joints = [each for each in listed if each is None or isinstance(each, Limits)]
    if len(of_joints) > 1:
        raise InvalidInputError(
            f"limits must hold one Limits at most, got {limits!r}", given=limits
        )
    others = tuple(each for each in listed if each is not None and not isinstance(each, Limits))
    return (of_joints[0] if of_joints else None), others
