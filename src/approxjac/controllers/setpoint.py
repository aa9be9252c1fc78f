"""`SetpointController`: the paper's set-point laws (5), (6) and (28)."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from approxjac import law
from approxjac.controllers.arguments import FLOAT64, HUGE, overflow, require_arrays, require_finite
from approxjac.controllers.controller import Controller, Instant
from approxjac.controllers.friction import FrictionCompensation
from approxjac.controllers.gains.gains import Diagonals, Gains, Latency
from approxjac.controllers.gains.sample_configurations import max_damping_rate, singular_ratio
from approxjac.controllers.gains.tuning import (
    UNKNOWN_TOOL,
    Tuning,
    require_damping,
    slow_rate,
    tuned,
)
from approxjac.controllers.gravity import (
    Adaptation,
    AdaptiveGravity,
    Gravity,
    ModelGravity,
    describe_gravity,
    require_gravity,
)
from approxjac.controllers.posture import AwayFromStops, Posture
from approxjac.controllers.saturation import describe_saturation, require_saturation
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status, Target
from approxjac.law import Linear, Saturation, Tanh
from approxjac.robots import Drives, Dynamics, GravityRegressor, Robot
from approxjac.tasks import PoseTask, PositionTask, Task, analysis
from approxjac.validation import Array, Immutable, as_number, as_vector, read_only, require

_OK, _LOST = Status.OK, Status.MEASUREMENT_LOST  # members of an enum are slow to look up
_ALPHA_SHARE = 0.3  # of the rate of the task's slow pole
_SATURATED, _SINGULAR = Status.TORQUE_SATURATED, Status.NEAR_SINGULAR
_HOLDING = Status.HOLDING
_FAR, _UNLIMITED = Status.OUT_OF_REACH, LimitStatus.UNLIMITED


@dataclass(frozen=True)
class DifferentiatedVelocity:
    """Ẋ of the earlier law (5): the measured x, filtered with a time constant T and differentiated.

    Attributes:
        time_constant: T > 0 [s]. Sampled control needs dt well below it.
    """

    time_constant: float = 0.02

    def __post_init__(self) -> None:
        as_number("time_constant", self.time_constant, unit="s", above=0.0)


class Reach:
    """Bound on the reach of the believed arm; infinite for other tasks than positions and poses."""

    def __init__(self, task: Task) -> None:
        self._task, self.most = task, math.inf
        if isinstance(task, PositionTask | PoseTask):
            (self._feature,) = task.features
            origin, self.most = task.robot.reach_bound(task.frame)
            self._origin = origin[["xyz".index(axis) for axis in self._feature.axes]]

    def position(self, x: Array) -> Array:
        """Return the positions of values (…, n_x), from the first joint along world axes [m]."""
        return np.asanyarray(self._feature.place(x) - self._origin)

    def is_exceeded(self, q: Array, e: Array) -> Any:
        """Return True if a target is out of reach, even with an unmodelled tool.

        It is taken at e (m,) from the believed position at q, so the sensor may stand anywhere.
        """
        if self.most == math.inf:
            return False
        k, most = len(self._origin), self.most
        if (is_far := law.length(e[:k]) > UNKNOWN_TOOL * most) is False:
            return False
        there = self.position(self._task.value(q)[:k] - e[:k])
        return is_far & (law.length(there) > (1.0 + UNKNOWN_TOOL) * most)


class SetpointController(Immutable, Controller):
    """A set-point law with an approximate Jacobian: brings the measured task value to a target.

    τ = −Ĵᵀ(K_p s(e) + K_v Ĵq̇) − B_c q̇ + gravity, with e = x − x_d, x measured. It uses only the
    believed robot, by the Jacobian of `task` and by `gravity`.

    The theorems are for a target at rest. For a moving one, q̇ − Ĵ⁺ẋ_d replaces q̇ in the torque and
    in the adaptation: it is followed more closely, but without a proof.

    Its state is θ̂ if gravity is learnt, followed by that of the friction compensation (F̂, how long
    each joint stood, how quiet all is) and by the differentiator's state for law (5).

    Immutable, but it owns scratch memory: one instance per thread.

    Attributes:
        adaptation: The adaptation of gravity, with its defaults filled in; None without.
        pinv: The Ĵ⁺ of y = q̇ + αĴ⁺s(e), which drives the adaptation.

    Args:
        task: The task of the believed robot.
        gains: K_p, K_v and the added joint damping B_c; those of `tuned` by default.
        gravity: Source of the gravity torque; the believed robot's own model by default.
            `NoGravity` is for robots that compensate it themselves, `AdaptiveGravity` makes this
            the law (28), (29).
        saturation: s(e), any `law.Saturation`. By default the tanh of `tuned`, or s(e) = e if gains
            are given.
        velocity: None for the paper's estimated task velocity Ĵq̇, law (6); or
            `DifferentiatedVelocity`, law (5).
        posture: A `Posture` that attracts the self-motion of a redundant arm, or `AwayFromStops`;
            none by default.
        latency: Latency of the loop, for `tuned`; by default that of 1 kHz with ideal sensors. With
            late torques or a filtered q̇ motors behind elastic gears tolerate the gains.
        settling_time: Desired settling time [s], for `tuned`, which scales all gains; by default
            as short as inertia, motors and latency allow.
        friction: `FrictionCompensation()` for joints that rub; None is without.
        drives: Rotors and gears of the joints, as far as they are known, for `tuned`. With a lag
            alone rotors that geared arms have at least; `Drives()` says that there are none.

    Raises:
        InvalidInputError: Gains of the wrong shape, an invalid saturation, no added damping on an
            arm with more joints than task coordinates, a posture for an arm without self-motion,
            or gravity of a robot with other joints.
    """

    def __init__(
        self,
        task: Task,
        gains: Gains | None = None,
        *,
        gravity: Gravity | None = None,
        saturation: Saturation | None = None,
        velocity: DifferentiatedVelocity | None = None,
        posture: Posture | AwayFromStops | None = None,
        latency: Latency | None = None,
        settling_time: float | None = None,
        friction: FrictionCompensation | None = None,
        drives: Drives | None = None,
    ) -> None:
        analysis.require_controllable(task)
        for name, value, kind, wanted in (
            ("gains", gains, Gains, "Gains(kp=..., kv=..., damping=...) or None"),
            ("velocity", velocity, DifferentiatedVelocity, "DifferentiatedVelocity(T) or None"),
            ("posture", posture, Posture | AwayFromStops, "Posture(q, stiffness) or None"),
            ("latency", latency, Latency, "Latency(period=...) or None"),
            ("friction", friction, FrictionCompensation, "FrictionCompensation() or None"),
            ("drives", drives, Drives, "Drives(...) or None"),
        ):
            require(name, value, kind | None, wanted)
        robot = task.robot
        self.task, self.velocity, self.posture, self.latency = task, velocity, posture, latency
        self.friction = friction
        self.gravity: Gravity = ModelGravity(robot) if gravity is None else gravity
        require_gravity(self.gravity, task)
        self.tuning = self._tuned(gains, latency, settling_time, drives)
        if gains is None:
            assert self.tuning is not None
            gains = self.tuning.gains
            saturation = Tanh(self.tuning.gamma) if saturation is None else saturation
        self.gains = gains
        self.saturation: Saturation = Linear() if saturation is None else saturation
        self.diagonals: Diagonals = self.gains.diagonals(task.m, robot.nv)
        self.gain_values = self.diagonals._asdict()
        require_saturation(self.saturation, task)
        require_damping(self.gains, self.diagonals, task)
        if velocity is not None and not task.subtracts:
            raise InvalidInputError(
                f"law (5) differentiates x and needs a task whose error is x - x_d, got {task!r}",
                given=velocity,
            )
        learning = self.gravity
        if isinstance(learning, AdaptiveGravity):
            chosen = None if self.tuning is None else self.tuning.learning
            learning = learning.adaptation(task, self.diagonals, chosen)
        self.adaptation = learning if isinstance(learning, Adaptation) else None
        names = {} if self.adaptation is None else self.adaptation.parameters(task)
        self._p = len(names)
        self.resting = self._p + (2 * robot.nv + 1 if friction else 0)
        self.parameters = {**names, **friction.parameters(robot)} if friction else names
        self._equation = "(28)" if self.adaptation else "(6)" if velocity is None else "(5)"
        weight = None if self.adaptation is None else self.adaptation.pinv_weight
        root = None if weight is None else 1.0 / np.sqrt(weight)
        ratio, scale = singular_ratio(task), analysis.vanishing(task)
        self.pinv = law.Pseudoinverse(ratio, scale, root, weight)
        # as arrays, which NumPy takes in two thirds of the time of numbers
        self._alpha = np.array(0.0 if self.adaptation is None else self.adaptation.alpha)
        self._lag = np.array(1.0 if velocity is None else velocity.time_constant)
        self._pull = None
        if posture is not None:
            self._pull = posture.torque(task, self.diagonals, slow_rate(task, self.diagonals))
        self.reach, self._subtracts = Reach(task), task.subtracts  # as most do
        self._combination = analysis.combination(task)  # a target moves as what is measured does
        self._continuous = robot.nq != robot.nv
        self._rubs = None
        if friction is not None:
            self._rubs = friction.rule(
                task, self.diagonals, float(self.alpha), weight, self.adaptation is not None
            )
            self._alpha = np.array(self.alpha)
        self._no_rate = read_only(np.zeros(self.resting + (0 if velocity is None else task.m)))
        # of q, v, x, target and state
        self._shapes = (robot.nq,), (robot.nv,), (task.n_x,), (task.n_x,), self._no_rate.shape

    def _tuned(
        self,
        gains: Gains | None,
        latency: Latency | None,
        settling_time: float | None,
        drives: Drives | None,
    ) -> Tuning | None:
        gravity, alpha, regressor = self.gravity, None, None
        if isinstance(gravity, AdaptiveGravity) and (gravity.L is None or not gravity.L.any()):
            alpha, regressor = gravity.alpha, gravity.regressor
        if gains is not None and regressor is None:
            return None
        if self.velocity is not None:  # damping of law (5) acts as late as x tells Ẋ
            known = Latency() if latency is None else latency
            if not known.is_felt_by_motors and drives is None:
                drives = Drives()
            lag = known.image_age + 0.5 * known.image_period + self.velocity.time_constant
            latency = replace(known, velocity_filter=known.velocity_filter + lag)
        return tuned(
            self.task, latency, settling_time=settling_time, regressor=regressor, gains=gains,
            alpha=alpha, drives=drives,
        )  # fmt: skip

    def begin(self, measurement: Measurement) -> Array:
        """Return the state before the first evaluation: θ̂(0), and the first measured x for law (5).

        Raises:
            InvalidInputError: A measurement of the wrong shapes, or of mirrored corners.
            MeasurementError: Law (5), and the first x is lost.
        """
        task, x_d, x = self.task, np.zeros(self.task.n_x), getattr(measurement, "x", None)
        if not hasattr(x, "arm_of"):  # which symbols have
            q, _, x = require_arrays(self._no_rate, measurement, x_d, task, len(self._no_rate))
            analysis.require_as_believed(task, q, x)
            if self.velocity is not None and not np.isfinite(x).all():
                raise MeasurementError(
                    f"the first x must be finite for law (5), which differentiates it, got {x}",
                    given=x,
                )
        theta0 = np.zeros(0) if self.adaptation is None else self.adaptation.theta0
        followed = np.zeros(0) if self.velocity is None else x
        rubs = [] if self._rubs is None else [self._rubs.first, np.zeros(task.robot.nv + 1)]
        return np.concatenate([theta0, *rubs, followed])

    def describe_learnt(self, state: Array) -> str:
        """Describe the gravity that a state has learnt; "" if none."""
        learning = self.adaptation
        return "" if learning is None else learning.describe(state[: self._p], self.task)

    def learnt(self, state: Array) -> Array:
        """Return θ̂, and F̂ of friction, (…, p) of a state, or of a series of states (…, n_state)."""
        return state[..., : len(self.parameters)]

    def lyapunov(self, at: Instant) -> float:
        """Return V [J] of (12), or (31) if gravity is learnt, with Ĵ⁺ as in the law.

        It is NaN if the error is not known.
        """
        if at.answer.J_hat is None or not np.isfinite(at.e).all():
            return math.nan
        (kp, kv, _), s, S = self.diagonals, self.saturation.s(at.e), self.saturation.S(at.e)
        V = law.V(at.v, s, S, self.pinv.matrix(at.answer.J_hat), at.M, kp, kv, self.alpha)
        if self.adaptation is None:
            return V
        regressor = self.adaptation.regressor
        theta = _true_parameters(regressor, at.dynamics.robot)
        if at.adds_gravity is not None:  # the rest is what there is to learn
            theta = theta - _true_parameters(regressor, at.adds_gravity)
        off = self.adaptation.whole(theta) - at.state[: self._p]
        return V + law.parameter_potential(off, self.adaptation.L)

    def task_torque(self, at: Instant) -> Array:
        """Return −Ĵᵀ(K_p s(e) + K_v Ĵq̇), without K_p s(e) where x was lost, shape (n_v,)."""
        (kp, kv, _), e, J_hat = self.diagonals, at.answer.e, at.answer.J_hat
        assert J_hat is not None
        x_dot = J_hat.dot(at.v)
        if self.velocity is not None and np.isfinite(e).all():
            x_dot = (e + at.x_d - at.state[self.resting :]) / self._lag
        return np.asarray(-(kp * np.nan_to_num(self.saturation.s(e)) + kv * x_dot).dot(J_hat))

    def passive_output(self, answer: Evaluation, v: Array, alpha: float | Array) -> Array:
        """Return y = q̇ + αĴ⁺s(e) of eq. (10), (n_v,) [rad/s or m/s]; q̇ where x was lost."""
        e, J_hat = answer.e, answer.J_hat
        if J_hat is None or (is_seen := law.is_finite(e)) is False:  # s(∞) may be finite
            return v
        s = law.select(is_seen, law.array(self.saturation.s(e)), np.zeros(len(e)))
        return law.passive_output(v, self.pinv.times(J_hat, s), alpha)

    def is_proven(self, answer: Evaluation) -> Any:
        """Return True if V̇ is known: x is measured, and Ĵ⁺ not damped."""
        return (answer.status == _OK) | (answer.status == _HOLDING)

    def rate_without(
        self, locked: Array, state: Array, measurement: Measurement, answer: Evaluation
    ) -> Array:
        """Return the rate (p,) of θ̂ with y = q̇ + α(ĴP)⁺s(e), where P leaves out locked joints."""
        J_hat, learning, g = answer.J_hat, self.adaptation, answer.gravity
        if learning is None or J_hat is None or g is None:
            return np.zeros(self.resting)
        _, q, v, *_ = measurement
        J_free, s = np.where(locked, 0.0, J_hat), self.saturation.s(answer.e)
        v = np.where(locked, 0.0, v)
        if answer.reference is not None:  # q̇ − (ĴP)⁺ẋ_d takes the place of q̇
            v_d, ratio = J_hat.dot(answer.reference), self.pinv.ratio
            scale = float(np.linalg.norm(J_hat, 2))
            v = v - law.damped_gram_solve(J_free @ J_free.T, v_d, ratio, scale)[0] @ J_free
        y = law.passive_output(v, self.pinv.times(J_free, s, J_hat), learning.alpha)
        Y = learning.Y(q, J_hat)
        rate = np.zeros(self.resting)
        learnt = law.theta_hat_rate(learning.L, Y, y)
        rate[: self._p] = learning.bounded(learnt, state[: self._p], Y, g)[0]
        return rate

    def with_limiter(self, motors: Array) -> SetpointController:
        """Return this law with adaptation that only the limiter pauses."""
        if self.adaptation is None:
            return self
        always = np.full(self.task.robot.nv, np.inf)
        return self.with_gravity(self.adaptation._replace(torque_limits=always, motors=motors))

    def damping_rate(self, inertias: Array) -> float:
        """Return the rate of joint damping by B_c [1/s]."""
        return max_damping_rate(inertias, self.diagonals.damping)

    def believed_dynamics(self) -> tuple[Dynamics, bool]:
        """Return the believed dynamics, and True (with gravity) if gravity is learnt."""
        robot, learns = self.task.robot, self.adaptation is not None
        return Dynamics(robot if learns else robot.with_gravity((0.0, 0.0, 0.0))), learns

    @functools.cached_property
    def alpha(self) -> float:  # type: ignore[override]
        """α of V [1/s]: that of the adaptation, else 0.3 of the rate of the task's slow pole."""
        if self.adaptation is not None:
            return self.adaptation.alpha
        return _ALPHA_SHARE * slow_rate(self.task, self.diagonals)

    def gravity_torque(self, state: Array, q: Array) -> Array:
        if self.adaptation is not None:
            return law.gravity(self.adaptation.Y(q, self.task.jacobian(q)), state[: self._p])
        return self.gravity.torque(q).copy()  # type: ignore[union-attr]  # the others have one

    def with_gains(self, gains: Gains) -> Self:
        """Return this controller with other gains, and the same learning rates."""
        return self._with(gains=gains)

    def with_gravity(self, gravity: Gravity) -> Self:
        """Return this controller with another source of gravity, and the same gains."""
        return self._with(gravity=gravity)

    def with_task(self, task: Task) -> Self:
        """Return this controller with another task, and the same gains, gravity and learning."""
        return self._with(task=task)

    def _with(self, **changes: Any) -> Self:
        gravity = self.gravity if self.adaptation is None else self.adaptation
        has = {"gains": self.gains, "saturation": self.saturation, "gravity": gravity}
        return self._rebuilt(**has | changes)

    def evaluate(
        self, state: Array, measurement: Measurement, target: Target | Array
    ) -> Evaluation:
        """Return torque and rate of the state for one measurement.

        An x that is not finite counts as lost: then there is no position force, only damping (by
        K_v and B_c) and gravity compensation, and adaptation pauses.

        Raises:
            MeasurementError: q or v not finite, or a torque that overflows.
            InvalidInputError: Wrong shapes or types, a target or state that is not finite, or
                (cos, sin) pairs of continuous joints off the unit circle.
        """
        v_d = None
        if isinstance(target, Target):
            target, v_d, _ = target
            if v_d is not None:
                v_d = self._combination.dot(
                    as_vector("v of the target", v_d, self._combination.shape[1])
                )
        try:
            _, q, v, x, _ = measurement
            usual = (
                type(q) is type(v) is type(x) is type(target) is type(state) is np.ndarray
                and (q.shape, v.shape, x.shape, target.shape, state.shape) == self._shapes
                and q.dtype is v.dtype is x.dtype is target.dtype is state.dtype is FLOAT64
            )
        except (TypeError, ValueError, AttributeError):
            usual = False
        if not usual:
            if hasattr(getattr(measurement, "q", None), "arm_of"):  # symbols
                e = law.array(self.task.error(x, target))
                return self._answer(q, v, x, e, state, v_d, law.complement(law.is_finite(e)))
            q, v, x = require_arrays(state, measurement, target, self.task, len(self._no_rate))
        # One number that is not small if anything is not finite. Unlike sums of squares it
        # overflows without a warning, and it is faster.
        size = math.hypot(*q.tolist(), *v.tolist(), *x.tolist(), *target.tolist(), *state.tolist())
        if v_d is not None:
            size = math.hypot(size, *v_d.tolist())
        if size < HUGE:
            e = x - target if self._subtracts else self.task.error(x, target)
            if self._subtracts or math.isfinite(e.dot(e)):
                if self._continuous:
                    self.task.robot.configuration(q)
                answer = self._answer(q, v, x, e, state, v_d, lost=False)
                if answer.torque.dot(answer.torque) < HUGE:  # a user's own task may fail
                    return answer
        with np.errstate(over="ignore", invalid="ignore"):  # an overflow is a named error
            e = x - target if self._subtracts else self.task.error(x, target)
            require_finite(q, v, target, state, self.task)
            lost = not np.isfinite(e).all()
            self.task.robot.configuration(q)
            try:
                answer = self._answer(q, v, x, e, state, None if lost else v_d, lost)
                if np.isfinite(answer.torque).all() and np.isfinite(answer.state_rate).all():  # type: ignore[arg-type]
                    return answer
            except np.linalg.LinAlgError:  # no eigenvalues: Ĵ has overflowed
                pass
        raise overflow(measurement)

    def _answer(
        self, q: Array, v: Array, x: Array, e: Array, state: Array, v_d: Array | None, lost: Any
    ) -> Evaluation:
        """Evaluate the law at inputs that have been checked, or are symbols."""
        J_hat = law.array(self.task.jacobian(q, x))
        s = law.array(self.saturation.s(e)) if lost is not True else np.zeros(self.task.m)
        if lost is not False:
            s = law.select(lost, np.zeros(self.task.m), s)
        learning, g, Y, x_dot, theta_hat = self.adaptation, None, None, None, state[: self._p]
        if learning is None:
            g = law.array(self.gravity.torque(q)).copy()  # type: ignore[union-attr]
        else:
            Y = learning.Y(q, J_hat)
        if self.velocity is not None:
            # The differentiator's state follows x with time constant T: its rate is Ẋ itself.
            # Without x it integrates Ĵq̇, so that there is no jump when x is back.
            x_dot = (x - state[self.resting :]) / self._lag
            if lost is not False:
                x_dot = law.select(lost, J_hat.dot(v), x_dot)
        if v_d is not None and lost is not False:
            v_d = law.select(lost, np.zeros(len(v_d)), v_d)
        pull = None if self._pull is None else self._pull(q)
        terms = law.SetpointTerms(J_hat, s, g, Y, pull, x_dot, v_d)
        kp, kv, damping = self.diagonals
        answer = law.setpoint_step(kp, kv, damping, terms, v, theta_hat, self.pinv)
        torque, g, singular, relative, pinv_s, reference = answer
        status, stuck, rubbing = law.select(singular, _SINGULAR, _OK), False, self._no_rate[:0]
        if self._rubs is not None:
            if pinv_s is None:
                pinv_s = self.pinv.times(J_hat, s)
            more, rubbing, stuck = law.friction_step(
                self._rubs, state[self._p : self.resting], relative, -self._alpha * pinv_s, e, lost
            )
            torque = torque + more
            near = law.all_of(np.abs(e) <= 2.0 * self._rubs.fine)
            holds = near & (state[self.resting - 1] > 0.5)
            status = law.select(holds & (status == _OK), _HOLDING, status)
        rate = self._no_rate[: self._p]
        if learning is not None:
            rests, far = learning.rests(torque), self.reach.is_exceeded(q, e)
            stands = lost | rests | far | stuck
            if stands is not True:
                assert Y is not None
                assert pinv_s is not None
                y = law.passive_output(relative, pinv_s, self._alpha)
                learnt = law.theta_hat_rate(law.array(learning.L), Y, y)
                learnt, unfinished = learning.bounded(learnt, theta_hat, Y, g)
                law.leave(unfinished & law.complement(stands))
                rate = law.select(stands, rate, learnt)
            status = law.select(rests, _SATURATED, law.select(far, _FAR, status))
        if x_dot is not None or self._rubs is not None:
            rate = np.concatenate([rate, rubbing, *([] if x_dot is None else [x_dot])])
        status = law.select(lost, _LOST, status)
        return Evaluation(torque, rate, status, e, J_hat, g, _UNLIMITED, 0.0, reference)

    def describe(self) -> list[str]:
        """Describe law, gains, saturation and gravity, its task, and the reasons of `tuned`."""
        saturation = describe_saturation(self.saturation, self.task)
        gravity = "learnt" if self.resting else describe_gravity(self.gravity, self.task.robot)
        first = f"set-point law {self._equation}, {self.gains}, {saturation}; gravity {gravity}"
        first += "; friction learnt where joints stand" if self.friction else ""
        return [first, super().describe()[1], *(self.tuning.reasons if self.tuning else ())]

    def __repr__(self) -> str:
        parts = f"law {self._equation}, {self.task!r}, {self.gains!r}, {self.gravity!r}"
        return f"{type(self).__name__}({parts})"


@functools.lru_cache(maxsize=4)
def _true_parameters(regressor: GravityRegressor, robot: Robot) -> Array:
    """Return the θ of a true robot; kept, as a live view asks for it at each picture."""
    return regressor.fit(robot)[0]
