"""`TorqueLimited`: torque, rate and motion limits by a QP that keeps the proof if possible."""

import functools
import math
import operator
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from approxjac import law
from approxjac.controllers.arguments import HUGE, require_dt, sampling_time
from approxjac.controllers.controller import Controller
from approxjac.controllers.gains.sample_configurations import max_damping_rate, usual_inertias
from approxjac.controllers.guard import usual_accelerations
from approxjac.controllers.limits.limits import (
    Limit,
    Limits,
    LimitTerms,
    require_rows,
    rows_at,
    sure_deceleration,
)
from approxjac.controllers.limits.quadratic_program import Solver
from approxjac.controllers.wrapper import ControllerWrapper
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status, Target
from approxjac.law import limits as limiting
from approxjac.robots.traced import positions_at
from approxjac.tasks.frame_tasks import FrameKinematics
from approxjac.validation import Array, as_number, read_only, require

_FREE, _LIMITED = LimitStatus.FREE, LimitStatus.LIMITED  # members of an enum are slow to look up
_INFEASIBLE, _FAILED = LimitStatus.INFEASIBLE, LimitStatus.SOLVER_FAILED
_KEPT, _GIVEN_UP = LimitStatus.PROOF_KEPT, LimitStatus.PROOF_GIVEN_UP
_EXCEEDED = LimitStatus.EXCEEDED
_GOES_ON = _FREE, _KEPT, _EXCEEDED  # V̇ ≤ −W holds
_LEARNS = Status.OK, Status.NEAR_SINGULAR  # of the law, where there is something to learn from
_UNKNOWN, _KNOWN = 0.1, 0.3  # times the rate of samples, or of the lag: how fast damping may be
_ELASTIC = 20.0  # [1/s], at most where joints may be elastic
_BEYOND = 1e-3  # a limit of speed (as a share) or position [rad or m], which has a status
_AT_LIMIT = 0.02  # a joint this near to its position limit counts as at it [rad or m]
_NEARLY = 0.98  # of a limit of torque or speed
_FAR = 1e100  # a deceleration or jerk that stands for infinity: of infinity times 0 is NaN
_TRIAL = 1.0  # speed of joints at which limits are asked for their rows first [rad/s or m/s]
_UNSET, _SET = 1e20, 1e19  # a torque before that is not known yet, and what is surely known
_LARGEST = np.finfo(float).max
_EXPLAINED = 5.0  # times what a guard takes for granted
_NEVER = 1e20  # [s], a time that is never measured
_FORGETS = 0.3  # of the rate of damping
_CALM = 0.03  # share of the acceleration from full speed to rest at that rate: no change of f
_BOLD = 0.1  # least ρ² where f changes by that much
_LIGHTEST, _GEARED = 1e-3, 0.3  # least ρ: of what is as good as without inertia; with rotors


class AccelerationObserver:
    """q̈ = ψ + ρ(f − φ), with f the believed dynamics, φ and ψ what f and q̈ were.

    f is as late as the measured q̈, by the lag of the controller's `latency`; else ρ would be taken
    for too small, and torques for harmless. φ and ψ are f and the measured q̈, low-passed at a given
    rate [1/s]: one at which damping may act. Delays and filters that allow that damping allow ψ,
    and noise of q̇ causes no more torque than with that damping.

    ρ ≤ 1, one number a joint, is the share of a change of f by which q̈ changes: 0.01 of a light
    wrist with a payload that the belief lacks. It is the least square of q̈ − ψ − ρ(f − φ) in the
    last periods, and 1 where f hardly changes. What is taken for light by mistake is found out by
    the first torque that is too large for it. Behind gears q̈ swings by what no torque explains,
    which looks like a small ρ; but their rotors, which are in f then, leave no joint light. ρ is
    above 1 only if a joint lacks them.

    ψ − ρφ is at most what half of all motors' efforts can cause, more than payloads and friction
    do, so that a bad q̇ is soon forgotten.

    Limits have to be kept while gravity is learnt: then f has the believed arm's weight, whatever
    was learnt; otherwise it has the gravity that the controller compensates.

    Its memory, of length 1 + 6 n_v: the time at which the next q̇ is expected [s], the last q̇ and f,
    φ and ψ, and the sums of the least square. A q̇ more than half a period early or late is ignored.
    """

    def __init__(self, controller: Controller, dt: float, rate: float, fastest: Array) -> None:
        robot = controller.task.robot
        self.dynamics, self.has_weight = controller.believed_dynamics()
        self._n, self.rotors = robot.nv, None
        self._least, self._largest = _LIGHTEST, 1.0
        if controller.rotors is not None:
            self.rotors, inertias = np.diag(controller.rotors), usual_inertias(robot)
            mobility, geared = (
                np.linalg.inv(M).diagonal(axis1=1, axis2=2).max(axis=0)
                for M in (inertias, inertias + self.rotors)
            )
            self._least, self._largest = _GEARED, mobility / geared
        self._dt, self._per_period, self._share = dt, np.array(1.0 / dt), np.array(rate * dt)
        self._forgets = np.array(_FORGETS * rate * dt)
        known = controller.latency
        lag = 0.0 if known is None else known.of_velocity - known.period
        self._late = np.array(lag / (dt + lag))
        self._most = _EXPLAINED * usual_accelerations(robot)[1]
        self._calm = (_CALM * rate * np.where(np.isfinite(fastest), fastest, 1.0)) ** 2
        # before the first period
        self.nothing = read_only(np.concatenate([[_NEVER], np.zeros(6 * robot.nv)]))

    def timed(self, memory: Array, measurement: Measurement) -> Measurement:
        """Return a measurement, at the expected time if its t does not advance."""
        if not hasattr(measurement.t, "is_unknown"):
            return measurement
        return measurement._replace(t=law.select(memory[0] < _NEVER, memory[0], 0.0))

    def observed(self, memory: Array, measurement: Measurement) -> tuple[Array, Array, Array]:
        """Return the memory that knows this q̇, ρ and ψ − ρφ [rad/s² or m/s²], (n_v,) each."""
        n = self._n
        v, f, *_ = old = memory[1:].reshape(6, n)
        now = np.concatenate([f, self._per_period * (measurement.v - v)]).reshape(2, n)
        of_f, of_a = now - old[2:4]
        sums = np.concatenate([of_f * of_f, of_f * of_a]).reshape(2, n)
        sums = old[4:] + self._forgets * (sums - old[4:])
        once = old[2:4] + self._share * (now - old[2:4])
        rho, rest = self._fitted(once, sums)
        after = [memory[: 2 * n + 1], once[0], rest + rho * once[0], sums.ravel()]
        is_due = abs(measurement.t - memory[0]) <= 0.5 * self._dt
        after = law.select(is_due, np.concatenate(after), memory)
        known = after[2 * n + 1 :].reshape(4, n)
        rho, rest = self._fitted(known[:2], known[2:])
        return after, rho, rest

    def _fitted(self, once: Array, sums: Array) -> tuple[Array, Array]:
        of_f, both = sums[0] + self._calm, sums[1] + self._calm
        # torques grow from period to period while it is sought, but not at once
        rho = np.maximum(both / of_f, np.sqrt(_BOLD * self._calm / of_f))
        rho = np.minimum(np.maximum(rho, self._least), self._largest)
        return rho, np.minimum(np.maximum(once[1] - rho * once[0], -self._most), self._most)

    def forward(self, measurement: Measurement, gravity: Array, torque: Array) -> Array:
        """Return f for a torque, (n_v,) [rad/s² or m/s²]; `gravity` is the compensated one."""
        _, q, v, _, _ = measurement
        torque = torque if self.has_weight else torque - gravity
        return self.dynamics.forward(q, v, torque, self.rotors)

    def expecting(self, measurement: Measurement, f: Array, memory: Array) -> Array:
        """Return the memory after sending a torque with this f."""
        n, is_first = self._n, memory[0] > 0.5 * _NEVER
        late = f
        if self._late > 0.0:
            late = law.select(is_first, f, f + self._late * (memory[n + 1 : 2 * n + 1] - f))
        once = law.select(is_first, np.concatenate([f, f]), memory[2 * n + 1 : 4 * n + 1])
        sent = [[measurement.t + self._dt], measurement.v, late, once, memory[4 * n + 1 :]]
        memory = np.concatenate(sent)
        # what is absurd must not make the next period's prediction overflow
        return law.select(law.length(memory) < HUGE, memory, self.nothing)


class TorqueLimited(ControllerWrapper):
    """A controller whose torque keeps limits, and the stability proof where limits allow it.

    Replacing the law's τ* by τ changes V̇ by yᵀ(τ − τ*) with y = q̇ + αĴ⁺s(e), so that any τ with
    yᵀ(τ − τ*) ≤ 0 keeps V̇ ≤ −W. Each step solves

        min ½(τ − τ*)ᵀR(τ − τ*) + ρσ   subject to   yᵀ(τ − τ*) ≤ σ,  σ ≥ 0

    and to the limits of τ and its rate, and of the next q̇ and q by the believed dynamics. R is
    diagonal, the largest (M̂⁻¹)ᵢᵢ over usual configurations. The slack σ is reported in each
    `Evaluation`. The multiplier λ ≤ ρ of the proof's row acts as damping λR⁻¹ along y, and ρ makes
    it no faster than `braking`. While no limit of speed or position is near, the minimum has a
    closed form. If no torque keeps all limits, or the solver fails, joints are braked as hard as
    motors can, the most urgent first. On a path q̇ − Ĵ⁺ẋ_d replaces q̇ in y.

    Adaptation by eq. (29) continues while the torque is free, or limited such that V̇ ≤ −W holds.
    If the proof is given up, joints at a limit count as locked and the remaining arm adapts with
    y = q̇ + α(ĴP)⁺s(e), where P leaves out the locked joints: so an arm pushed against a stop by its
    weight learns the torque to leave it. Otherwise adaptation pauses. This replaces
    `AdaptiveGravity.torque_limits`. A `TrackingController` pauses adaptation of its dynamics, not
    of its kinematics, while the proof is given up.

    The state is that of the controller, followed by the predicted motion if motion is limited, and
    by the last torque if its rate is.

    Immutable, but it owns scratch memory: one instance per thread.

    Attributes:
        alpha: α of y [1/s]: that of the adaptation if gravity is learnt, else 0.3 of the rate of
            the task's slow pole.
        motion_limits: Limits of motion besides those of joints.

    Args:
        controller: The controller whose torque to limit.
        limits: `Limits` of joints and motors, by default those of the believed robot's URDF; a
            `Limit` of motion such as `Wall`; or a list of them.
        proof: True to include the row yᵀ(τ − τ*) ≤ σ.
        dt: Sampling time [s]; by default that of the controller, else of its latency, else 1 ms.
        braking: Largest rate of damping and of `AccelerationObserver`'s correction [1/s], at most
            1/dt. By default 0.3 over the lag of q̇ if the law knows its latency, at most 20 1/s if
            its joints are elastic; else that of the law's own joint damping, from 0.1/dt to 0.3/dt;
            0.1/dt with a limit of the torque rate.
        solver: A function that takes a `QuadraticProgram` and returns its minimum; DAQP by
            default, which is exact.

    Raises:
        InvalidInputError: Numbers out of range, or limits of another number of joints.
    """

    _what = "its torque is kept within limits"
    # its own, not those of the controller inside
    motion_limits: tuple[Limit, ...] = ()
    limits: Limits = Limits()
    dt: float | None = None
    needs_solver: bool = False

    def __init__(
        self,
        controller: Controller,
        limits: Limits | Limit | Sequence[Limits | Limit] | None = None,
        *,
        proof: bool = True,
        dt: float | None = None,
        braking: float | None = None,
        solver: Callable[[law.QuadraticProgram], Any] | None = None,
    ) -> None:
        wanted = (
            "a law such as SetpointController (what holds measurements goes around it: "
            "HeldMeasurement(TorqueLimited(law), ...))"
        )
        require("controller", controller, Controller, wanted)
        if controller.law is not controller:
            message = f"controller must be {wanted}, got {controller!r}"
            raise InvalidInputError(message, given=controller)
        if controller.command != "torque":
            raise InvalidInputError(
                f'controller must command torques to be limited, got command="velocity" of '
                f"{controller!r}, which keeps limits of its own",
                given=controller,
            )
        robot = controller.task.robot
        self.controller = controller
        listed = limits if isinstance(limits, list | tuple) else () if limits is None else (limits,)
        of_joints = [each for each in listed if isinstance(each, Limits)]
        if len(of_joints) > 1:
            message = f"limits must hold one Limits at most, got {limits!r}"
            raise InvalidInputError(message, given=limits)
        self.motion_limits = tuple(each for each in listed if not isinstance(each, Limits))
        self.limits = (of_joints or [Limits.of(robot)])[0].for_joints(robot.nv)
        self._upper, self._rate = np.asarray(self.limits.effort), np.asarray(self.limits.rate)
        self._lower = -self._upper
        self._has_rate = bool(np.isfinite(self._rate).any())
        self._law, self._p = controller.with_limiter(self._upper), controller.resting
        inside = controller.dt
        self._dt = sampling_time(dt, inside, controller.latency)
        if inside is not None and not math.isclose(inside, self._dt):
            raise InvalidInputError(
                f"dt must be that of the controller inside, {inside:g} [s], got {dt!r}; take "
                f"TorqueLimited(..., dt={inside!r}), or build the controller inside for another",
                given=dt,
            )
        require("proof", proof, bool, "True or False")
        self.proof = proof
        self.alpha = controller.alpha
        inertias = usual_inertias(robot)
        if braking is None and (latency := controller.latency) is not None:
            braking = _KNOWN / (latency.of_velocity - latency.period + self._dt)
            braking = braking if controller.rotors is None else min(braking, _ELASTIC)
        elif braking is None:
            # the loop stands the law's own damping, too; a limit of the rate makes it act late
            damped = 0.0 if self._has_rate else controller.damping_rate(inertias)
            braking = min(max(_UNKNOWN / self._dt, damped), _KNOWN / self._dt)
        at_most = (1.0 + 1e-9) / self._dt
        self.braking = as_number("braking", braking, unit="1/s", above=0.0, most=at_most)
        self.approach = 0.1 * self.braking  # κ of `speed_bounds` [1/s]
        if not (solver is None or callable(solver)):
            wanted = "a function of a QuadraticProgram, or None for DAQP"
            raise InvalidInputError(f"solver must be {wanted}, got {solver!r}", given=solver)
        self.solver, self._solver, self._brakes = solver, Solver(solver), Solver()
        lightest = 1.0 / np.diagonal(np.linalg.inv(inertias), axis1=1, axis2=2).max(axis=0)
        self._weight = 1.0 / lightest  # R
        self._rho = self.braking / max_damping_rate(inertias, 1.0 / self._weight)
        own = np.median([np.diag(M) for M in inertias], axis=0)
        self._jerk = np.minimum(self._rate / own, _FAR) if self._has_rate else None
        # arrays, which NumPy multiplies with in a third of the time of numbers
        self._one = np.ones(robot.nv)
        self._braking, self._alpha = np.array(self.braking), np.array(self.alpha)
        (low, high), fastest = np.array(self.limits.position), np.asarray(self.limits.velocity)
        most = np.asarray(self.limits.acceleration)
        self._acceleration = most if np.isfinite(most).any() else None
        self._sure = np.minimum(np.minimum(sure_deceleration(robot, self._upper), most), _FAR)
        self._joints = law.JointRange.of(self.limits.position, fastest, self.approach, self._sure)
        too_fast = (1.0 + _BEYOND) * fastest
        self._beyond = [*(low - _BEYOND), *-too_fast], [*(high + _BEYOND), *too_fast]
        self._per_speed = 1.0 / fastest if np.isfinite(fastest).any() else None
        self._frames = functools.cache(partial(FrameKinematics, robot))
        if self.motion_limits:
            q = next(robot.configurations(1))
            for limit in self.motion_limits:
                require_rows(limit, self._terms(q, np.full(robot.nv, _TRIAL)), self._dt)
        self._prediction = AccelerationObserver(controller, self._dt, self.braking, fastest)
        # whether a torque within its limits may be limited, too; else there is a closed form
        bounds_motion = bool(np.isfinite([low, high, fastest, most]).any())
        self.needs_solver = self._looks_ahead = bounds_motion or bool(self.motion_limits)
        self.dt = self._dt if self._looks_ahead else inside
        self._kept = self._prediction.nothing if self._looks_ahead else np.zeros(0)
        self._memory = len(self._kept) + (robot.nv if self._has_rate else 0)

    @property
    def limited_law(self) -> Controller:
        return self.controller

    def begin(self, measurement: Measurement) -> Array:
        """Return the state before the first step, (n_state,); raises as the controller."""
        return self._with_memory(self._law.begin(measurement), measurement)

    def resumed(self, state: Array, measurement: Measurement) -> Array:
        state = super().resumed(state, measurement)
        n = self.controller.size
        state[n : self.size] = self._with_memory(state[:n], measurement)[n:]
        return state

    def _with_memory(self, state: Array, measurement: Measurement) -> Array:
        before = np.zeros(0)
        if self._has_rate:
            before = np.full(len(self._rate), _UNSET)
            if type(measurement.q) is np.ndarray:  # C begins before it is known
                g = np.asarray(self._law.gravity_torque(state, measurement.q))
                before = np.where(np.isfinite(g), g, before)
        return np.concatenate([state, self._kept, before])

    def advance(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """Return the state after a step, and a torque within the limits.

        Arguments and errors are those of the controller.

        Raises:
            InvalidInputError: dt is not that for which speeds and positions are limited.
        """
        traced = hasattr(state, "arm_of")
        if self._looks_ahead and not traced and dt != self._dt:
            require_dt(dt, self._dt)
        state, memory = self._split(state) if self._memory else (state, self._kept)
        after, answer = self._law.advance(state, measurement, target, dt)
        wanted, rate, of_law, e, J_hat, gravity, _, _, reference = answer
        g, lower, upper = gravity, self._lower, self._upper
        if g is None:
            g = self._law.gravity_torque(state, measurement.q)
        if self._has_rate:
            memory, before = memory[: len(self._kept)], memory[len(self._kept) :]
            before = np.where(before > _SET, g, before)
            within = np.minimum(np.maximum(before, lower), upper)
            with np.errstate(over="ignore"):  # no bound at all, of an absurd rate or dt
                lower = np.maximum(lower, within - dt * self._rate)
                upper = np.minimum(upper, within + dt * self._rate)
        torque: Array = np.minimum(np.maximum(wanted, lower), upper)
        is_free = law.all_equal(torque, wanted)
        status, slack = _FREE, 0.0
        if is_free is not True or self._looks_ahead:
            asked = limiting.AskedTorque(wanted, lower, upper, torque, law.complement(is_free))
            torque, status, slack, memory = self.limited(answer, g, measurement, asked, memory)
            if self._p:
                after = self._rested(after, state, measurement, answer, torque, status, dt)
        if traced:  # what overflows has to show
            torque = np.where(np.abs(wanted) <= _LARGEST, torque, wanted)
        if self._has_rate:
            after = np.concatenate([after, memory, torque])
        elif self._memory:
            after = np.concatenate([after, memory]) if len(after) else memory
        return after, Evaluation(torque, rate, of_law, e, J_hat, gravity, status, slack, reference)

    @np.errstate(over="ignore", invalid="ignore")  # what overflows has a status
    def limited(
        self,
        answer: Evaluation,
        gravity: Array,
        measurement: Measurement,
        asked: limiting.AskedTorque,
        memory: Array,
    ) -> tuple[Array, Any, Any, Array]:
        """Return the limited torque, its status, σ [W], and the new memory.

        It runs on symbols, too. `gravity` is the gravity torque in the law's answer, shape (n_v,).
        """
        forward = partial(self._prediction.forward, measurement, gravity)
        M_inv = partial(self._prediction.dynamics.M_inv, measurement.q, self._prediction.rotors)
        output = partial(self._passive_output, answer, measurement.v) if self.proof else None

        def brakes(M_inv: Array, rows: limiting.Rows, at_rest: Array) -> Array:
            lower, upper = asked.lower, asked.upper
            hold = np.minimum(np.maximum(gravity, lower), upper)
            rest, solver = -self._braking * measurement.v / rho, self._brakes.minimum
            return limiting.braked(M_inv, rows, at_rest, lower, upper, rest, hold, solver)

        residual = rows = None
        rho = self._one
        if self._looks_ahead:
            measurement = self._prediction.timed(memory, measurement)
            memory, rho, residual = self._prediction.observed(memory, measurement)
            rows, residual = self.rows(measurement).per(rho), residual / rho
        torque, f, slack, verdict, is_free = law.limit_step(
            asked, output, self._weight, forward, M_inv, rows, residual, brakes,
            self._solver.minimum,
        )  # fmt: skip
        if residual is not None:
            memory = self._prediction.expecting(measurement, f, memory)
        exceeds = rows is not None and self.is_exceeded(measurement)
        free = law.select(exceeds, _EXCEEDED, _FREE)
        if law.surely(is_free > 0.0):  # which is usual
            return torque, free, 0.0, memory
        # without x, or without Ĵ⁺, there is no V
        is_proven = self.proof and self._law.is_proven(answer)
        status = law.select(is_proven, law.select(slack == 0.0, _KEPT, _GIVEN_UP), _LIMITED)
        failed = law.select(verdict > 1, _FAILED, _INFEASIBLE)
        status = law.select(verdict > 0, failed, status)
        unknown = 0.0 if hasattr(measurement.q, "arm_of") else math.nan  # C answers with numbers
        slack = law.select(is_free > 0.0, 0.0, law.select(is_proven, slack, unknown))
        return torque, law.select(is_free > 0.0, free, status), slack, memory

    def _rested(
        self,
        after: Array,
        state: Array,
        measurement: Measurement,
        answer: Evaluation,
        torque: Array,
        status: Any,
        dt: float,
    ) -> Array:
        """Return a state after a step with what is learnt at rest where the proof is given up."""
        p = self._p
        if hasattr(after, "arm_of"):
            goes_on = functools.reduce(operator.or_, [status == each for each in _GOES_ON])
            rests = law.complement(goes_on)
            if self._looks_ahead or self._has_rate:  # what joints at no limit learn is for Python
                learns = (answer.status == _LEARNS[0]) | (answer.status == _LEARNS[1])
                learns &= (status == _GIVEN_UP) | (status == _LIMITED)
                is_beyond = law.any_of(np.abs(answer.torque) > self._upper)
                law.leave(learns & law.complement(is_beyond))
            return np.concatenate([law.select(rests, state[:p], after[:p]), after[p:]])
        if status in _GOES_ON:
            return after
        after[:p] = state[:p]
        # or θ̂ would ask for ever more than the motors have
        has_room = not (np.abs(answer.torque) > self._upper).any()
        if status in (_GIVEN_UP, _LIMITED) and answer.status in _LEARNS and has_room:
            motion = positions_at(self.task.robot, measurement.q)
            low, high = np.asarray(self.limits.position)
            locked = (motion < low + _AT_LIMIT) | (motion > high - _AT_LIMIT)
            locked |= np.abs(measurement.v) > _NEARLY * np.asarray(self.limits.velocity)
            locked |= np.abs(torque) > _NEARLY * self._upper
            if locked.any():
                after[:p] += dt * self._law.rate_without(locked, state, measurement, answer)
        return after

    def rows(self, measurement: Measurement) -> limiting.Rows:
        """Return the bounds of motion at a configuration and speed."""
        t, q, v, *_ = measurement
        speeds = self._joints.speed_bounds(positions_at(self.task.robot, q))
        bounds = law.acceleration_bounds(v, speeds, self._braking, self._jerk)
        if self._acceleration is not None:
            bounds = np.minimum(np.maximum(bounds, -self._acceleration), self._acceleration)
        if not self.motion_limits:
            return limiting.Rows(*bounds)
        terms = self._terms(q, v)
        more = [rows_at(limit, terms, self._dt, t) for limit in self.motion_limits]
        E, lows, highs = zip(*more, strict=True)
        return limiting.Rows(
            np.concatenate([bounds[0], *lows]),
            np.concatenate([bounds[1], *highs]),
            np.concatenate(E),
        )

    def is_exceeded(self, measurement: Measurement) -> Any:
        """Return True if a joint is beyond its limits of speed or position."""
        q, v = positions_at(self.task.robot, measurement.q), measurement.v
        return law.complement(
            limiting.within(self._beyond[0], q.tolist() + v.tolist(), self._beyond[1])
        )

    def _terms(self, q: Array, v: Array) -> LimitTerms:
        return LimitTerms(
            self.task.robot, q, v, self._frames, self.approach, self.braking,
            self._sure, self._jerk,
        )  # fmt: skip

    def _passive_output(self, answer: Evaluation, v: Array) -> tuple[Array, Any]:
        """Return y, shape (n_v,), and ρ, less where y = 0 is faster than joints may move."""
        y = self._law.passive_output(answer, v, self._alpha)
        if answer.reference is not None:
            y = y - answer.reference
        if self._per_speed is None:
            return y, self._rho
        return y, self._rho / limiting.largest(((y - v) * self._per_speed).tolist(), 1.0)

    def __repr__(self) -> str:
        numbers = f"dt={self._dt:g}, braking={self.braking:g}"
        return f"TorqueLimited({self.controller!r}, proof={self.proof}, {numbers})"
