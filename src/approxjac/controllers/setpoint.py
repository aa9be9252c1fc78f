"""`SetpointController`: the laws (5), (6) and (28) put together with a believed robot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import get_args

import numpy as np

from approxjac import law
from approxjac.checks import Array, as_number, require
from approxjac.controllers.gains import Gains
from approxjac.controllers.gravity import AdaptiveGravity, Gravity, ModelGravity
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.interface import Evaluation, Measurement, Status
from approxjac.law import Linear, Saturation
from approxjac.tasks import Task


@dataclass(frozen=True)
class DifferentiatedVelocity:
    """Ẋ of the earlier law (5): the measured x, filtered with a time constant T and differentiated.

    Attributes:
        time_constant: T > 0 [s]. Sampled control needs dt well below it.
    """

    time_constant: float = 0.02

    def __post_init__(self) -> None:
        as_number("time_constant", self.time_constant, unit="s", above=0.0)


class SetpointController:
    """Brings a measured task value to a fixed target with an approximate Jacobian.

    τ = −Ĵᵀ(K_p s(e) + K_v Ĵq̇) − B_c q̇ + gravity, with e = x − x_d, x measured. It knows the
    believed robot only, through the Jacobian of `task` and through `gravity`.

    Its state is θ̂ where gravity is learnt, followed by the differentiator's state for law (5).

    Immutable, but it owns scratch memory: one instance a thread.

    Args:
        task: The task of the believed robot.
        gains: K_p, K_v and the added joint damping.
        gravity: Where the gravity torque comes from; the believed robot's own model by default.
            `NoGravity` is for robots that compensate it themselves, `AdaptiveGravity` makes this
            the law (28), (29).
        saturation: s(e); s(e) = e by default.
        velocity: None for the paper's estimated task velocity Ĵq̇, law (6); or
            `DifferentiatedVelocity`, law (5).

    Raises:
        InvalidInputError: Gains or saturation of the wrong shape, no added damping on an arm with
            more joints than task coordinates, or gravity of a robot with other joints.
    """

    def __init__(
        self,
        task: Task,
        gains: Gains,
        *,
        gravity: Gravity | None = None,
        saturation: Saturation | None = None,
        velocity: DifferentiatedVelocity | None = None,
    ) -> None:
        require("task", task, Task, "a task of the believed robot, such as PositionTask(robot)")
        require("gains", gains, Gains, "Gains(kp=..., kv=..., damping=...)")
        if gravity is not None:
            wanted = "one of ModelGravity, RegressorGravity, AdaptiveGravity and NoGravity"
            require("gravity", gravity, get_args(Gravity), wanted)
        if velocity is not None:
            require(
                "velocity", velocity, DifferentiatedVelocity, "DifferentiatedVelocity(T) or None"
            )
        self.task = task
        self.gains = gains
        self.gravity: Gravity = ModelGravity(task.robot) if gravity is None else gravity
        self.saturation: Saturation = Linear() if saturation is None else saturation
        self.velocity = velocity
        self.diagonals = gains.diagonals(task.m, task.robot.nv)
        self._require_saturation()
        robot = task.robot
        if robot.nv > task.m and not (self.diagonals.damping > 0.0).all():
            raise InvalidInputError(
                f"damping must be > 0 [N m s/rad] for {robot.name}: it has {robot.nv} joints for "
                f"{task.m} task coordinates, and nothing else damps its self-motion; "
                f"got {self.diagonals.damping.tolist()}",
                given=gains.damping,
            )
        if self.gravity.robot.joint_names != robot.joint_names:
            raise InvalidInputError(
                f"gravity must be that of a robot with the joints of the task's robot "
                f"({', '.join(robot.joint_names)}), got {self.gravity.robot!r}",
                given=gravity,
            )
        self._p = self.gravity.regressor.p if isinstance(self.gravity, AdaptiveGravity) else 0
        self._n_state = self._p + (0 if velocity is None else task.m)
        self._shapes = ((robot.nq,), (robot.nv,), (task.m,), (task.m,), (self._n_state,))
        self._no_rate = np.zeros(self._n_state)
        self._no_rate.flags.writeable = False

    @property
    def n_state(self) -> int:
        """Length of the state, p where gravity is learnt, plus m for law (5)."""
        return self._n_state

    def initial_state(self, measurement: Measurement) -> Array:
        """State before the first evaluation: θ̂(0), and the first measured x for law (5).

        Raises:
            MeasurementError: Law (5), and the first x is lost.
        """
        self._require_shapes(self._no_rate, measurement, measurement.x)
        if self.velocity is not None and not np.isfinite(measurement.x).all():
            raise MeasurementError(
                f"the first x must be finite for law (5), which differentiates it, "
                f"got {measurement.x.tolist()}",
                given=measurement,
            )
        theta0 = self.gravity.theta0 if isinstance(self.gravity, AdaptiveGravity) else np.zeros(0)
        followed = np.zeros(0) if self.velocity is None else measurement.x
        return np.concatenate([theta0, followed])

    def theta_hat(self, state: Array) -> Array:
        """θ̂ from one state (n_state,) or a series of them (…, n_state); shape (…, p)."""
        return state[..., : self._p]

    @np.errstate(over="ignore", invalid="ignore")  # what overflows is a named error below
    def evaluate(self, state: Array, measurement: Measurement, target: Array) -> Evaluation:
        """Torque for one measurement.

        A measurement x that is not finite counts as lost: then there is no position force, only
        damping (by K_v and B_c) and gravity compensation, and θ̂ stands still.

        Args:
            state: Controller state, shape (n_state,).
            measurement: t, q, v and the measured x.
            target: x_d, shape (m,) [unit of the task].

        Raises:
            MeasurementError: q or v not finite, or a torque that overflows.
            InvalidInputError: Wrong shapes or types, a target or state that is not finite, or
                (cos, sin) pairs of continuous joints off the unit circle.
        """
        self._require_shapes(state, measurement, target)
        _, q, v, x = measurement
        e = x - target
        # One cheap number that is not finite if anything is; the rare cases are told apart after.
        lost = False
        if not math.isfinite(q.dot(q) + v.dot(v) + e.dot(e) + state.dot(state)):
            lost = self._require_finite(state, measurement, target)
        s = np.zeros(self.task.m) if lost else self.saturation.s(e)
        J_hat = self.task.jacobian(q)
        kp, kv, damping = self.diagonals
        theta_rate = self._no_rate[: self._p]

        if isinstance(self.gravity, AdaptiveGravity):
            Z = self.gravity.regressor.Z(q)
            J_hat_pinv, sigma_min, damped = law.damped_right_pinv(J_hat)
            singular = damped > 0.0
            if not lost:
                y = law.passive_output(v, J_hat_pinv, s, self.gravity.alpha)
                theta_rate = law.theta_hat_rate(self.gravity.L, Z, y)
            g = law.gravity(Z, state[: self._p])  # with it, (6) below is (28)
        else:
            g = self.gravity.torque(q)
            sigma_min, sigma_max = law.extreme_singular_values(J_hat)
            singular = sigma_min < law.SINGULAR_RATIO * sigma_max

        if self.velocity is None:
            torque = law.estimated_velocity_torque(J_hat, kp, kv, s, v, damping, g)
            rate = theta_rate
        else:
            # The differentiator's state follows x with time constant T: its rate is Ẋ itself.
            # Without x it goes on with Ĵq̇, so that there is no jump when x is back.
            lag = self.velocity.time_constant
            x_dot = J_hat @ v if lost else (x - state[self._p :]) / lag
            torque = law.measured_velocity_torque(J_hat, kp, kv, s, x_dot, v, damping, g)
            rate = np.concatenate([theta_rate, x_dot])
        status = Status.OK
        if lost:
            status = Status.MEASUREMENT_LOST
        elif singular:
            status = Status.NEAR_SINGULAR
        if not math.isfinite(torque.dot(torque) + rate.dot(rate)) and not (
            np.isfinite(torque).all() and np.isfinite(rate).all()
        ):
            raise MeasurementError(
                f"the torque overflows: q = {q.tolist()}, v = {v.tolist()}, x = {x.tolist()} are "
                "beyond what the law can be evaluated at",
                given=measurement,
            )
        return Evaluation(torque, rate, status, e, sigma_min)

    def _require_saturation(self) -> None:
        """Refuse a saturation whose γ has another length than the task."""
        m = self.task.m
        try:
            fits = np.shape(self.saturation.s(np.zeros(m))) == (m,)
        except (ValueError, TypeError, AttributeError):
            fits = False
        if not fits:
            raise InvalidInputError(
                f"saturation must be Linear(), Sine(gamma) or Tanh(gamma) with one gamma or {m} "
                f"for {self.task!r}, got {self.saturation!r}",
                given=self.saturation,
            )

    def _require_shapes(self, state: Array, measurement: Measurement, target: Array) -> None:
        try:
            _, q, v, x = measurement
        except (TypeError, ValueError):
            raise InvalidInputError(
                f"measurement must be Measurement(t, q, v, x), got {measurement!r}",
                given=measurement,
            ) from None
        try:
            if (q.shape, v.shape, x.shape, target.shape, state.shape) == self._shapes and (
                q.dtype == v.dtype == x.dtype == target.dtype == state.dtype == np.float64
            ):
                return
        except AttributeError:
            pass
        names = ("q", "v", "x", "target", "state")
        for name, value, shape in zip(names, (q, v, x, target, state), self._shapes, strict=True):
            if not isinstance(value, np.ndarray) or value.shape != shape:
                given = value.shape if isinstance(value, np.ndarray) else type(value).__name__
                raise InvalidInputError(
                    f"{name} must be an array of shape {shape} for {self.task!r}, got {given}",
                    given=value,
                )
            if value.dtype != np.float64:  # differences of unsigned pixels would wrap around
                raise InvalidInputError(
                    f"{name} must be an array of float64, got {value.dtype}; "
                    f"{name}.astype(float) makes one of numbers",
                    given=value,
                )

    def _require_finite(self, state: Array, measurement: Measurement, target: Array) -> bool:
        """Tell what is not finite apart; return whether only the measured x is."""
        for name, value in (("q", measurement.q), ("v", measurement.v)):
            if not np.isfinite(value).all():
                raise MeasurementError(
                    f"{name} must be finite, got {value.tolist()}: no safe torque exists without "
                    "the joint state; stop the robot",
                    given=measurement,
                )
        for name, value in (("target", target), ("state", state)):
            if not np.isfinite(value).all():
                raise InvalidInputError(f"{name} must be finite, got {value.tolist()}", given=value)
        if not np.isfinite(measurement.x).all():
            return True
        if not np.isfinite(measurement.x - target).all():
            raise MeasurementError(
                f"the error overflows: x = {measurement.x.tolist()} is beyond what the law can be "
                "evaluated at",
                given=measurement,
            )
        return False

    def __repr__(self) -> str:
        law = "(28), (29)" if self._p else "(6)" if self.velocity is None else "(5)"
        return f"SetpointController(law {law}, {self.task!r}, {self.gains!r})"
