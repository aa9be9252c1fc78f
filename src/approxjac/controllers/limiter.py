"""What all limiters of a controller's torque share: limits, the torque before, learning."""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import numpy as np

from approxjac.controllers.checked import CheckedController
from approxjac.controllers.gravity import Adaptation, AdaptiveGravity
from approxjac.controllers.limits import Limits, effort_bounds, rate_bounds
from approxjac.controllers.setpoint import SetpointController
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.interface import Evaluation, LimitStatus, Measurement
from approxjac.tasks import Task
from approxjac.validation import Array, SetOnce, as_number, require

_FREE, _KEPT = LimitStatus.FREE, LimitStatus.PROOF_KEPT  # members of an enum are slow to look up


class Asked(NamedTuple):
    """What a controller asks for in one step, and the bounds of its torque.

    Attributes:
        answer: What it answers.
        state: Its state.
        measurement: What was measured.
        lower: Smallest torques, shape (n_v,).
        upper: Largest torques, shape (n_v,).
        clipped: The torque asked for, brought within them, shape (n_v,).
        free: Whether it was within them.
    """

    answer: Evaluation
    state: Array
    measurement: Measurement
    lower: Array
    upper: Array
    clipped: Array
    free: bool


class Limiter(SetOnce, abc.ABC):
    """A controller whose torque is brought within limits.

    Its state is that of the controller, followed by the torque of the step before where the rate
    of torques is limited; the first step starts from the torque that holds the arm.

    Learning by eq. (29) goes on where the torque is free, or limited such that V̇ ≤ −W holds: the
    parameters are part of that V, and it needs them to move. Otherwise θ̂ stands still. This takes
    the place of `AdaptiveGravity.torque_limits`.

    Args:
        controller: The controller whose torque to limit.
        limits: What to keep; those of the believed robot's URDF by default.
        dt: Sampling time [s].

    Attributes:
        controller: The controller.
        limits: The limits with an entry for each joint.
        dt: Sampling time that control has to have, or None where any will do.
    """

    def __init__(
        self, controller: CheckedController, limits: Limits | None = None, *, dt: float = 1e-3
    ) -> None:
        wanted = (
            "a SetpointController or a VelocityServo (what holds measurements "
            "goes around it: HeldMeasurement(TorqueLimited(law), ...))"
        )
        require("controller", controller, CheckedController, wanted)
        if limits is not None:
            require("limits", limits, Limits, "Limits(effort=...), Limits.of(robot) or None")
        self.controller = controller
        self._given_limits = limits
        self._step = as_number("dt", dt, unit="s", above=0.0)
        robot = controller.task.robot
        given = Limits.of(robot) if limits is None else limits
        self.limits = given.for_joints(robot.nv)
        learning = controller.adaptation if isinstance(controller, SetpointController) else None
        self._law = controller if learning is None else _always_learning(controller, learning)
        self._lower, self._upper = effort_bounds(np.asarray(self.limits.effort))
        self._rate = np.asarray(self.limits.rate)
        self._has_rate = bool(np.isfinite(self._rate).any())
        self._looks_ahead = False  # whether a torque within its limits may be limited too
        self._p = 0 if learning is None else learning.regressor.p
        self._n_inner = controller.n_state

    @property
    def task(self) -> Task:
        """The task of the believed robot."""
        return self.controller.task

    @property
    def law(self) -> Any:
        """The `SetpointController` that it limits, whose state comes first; None of others."""
        return getattr(self.controller, "law", None)

    @property
    def dt(self) -> float | None:
        """Sampling time that control has to have [s], or None where any will do."""
        return self._step if self._has_rate else None

    @property
    def n_state(self) -> int:
        """Length of the controller's state, plus n_v where the rate of torques is limited."""
        return self._n_inner + (self.task.robot.nv if self._has_rate else 0)

    def initial_state(self, measurement: Measurement) -> Array:
        """State before the first evaluation.

        Raises:
            InvalidInputError: A measurement of the wrong shapes.
            MeasurementError: Law (5), and the first x is lost; or a limit of the rate, and q is
                not finite.
        """
        state = self._law.initial_state(measurement)
        if not self._has_rate:
            return state
        _, q, _, _ = measurement
        if not np.isfinite(q).all():
            raise MeasurementError(
                f"q must be finite, got {q.tolist()}: the torque that holds the arm is "
                "not known without it",
                given=measurement,
            )
        self.task.robot.configuration(q)
        hold = self._law.gravity_torque(state, q)
        return np.concatenate([state, np.clip(hold, self._lower, self._upper)])

    def evaluate(self, state: Array, measurement: Measurement, target: Array) -> Evaluation:
        """Torque within the limits for one measurement.

        Args:
            state: Controller state, shape (n_state,).
            measurement: t, q, v and the measured x.
            target: x_d, shape (n_x,) [unit of the task].

        Raises:
            MeasurementError: As the controller.
            InvalidInputError: As the controller.
        """
        if not self._has_rate:
            answer = self._law.evaluate(state, measurement, target)
            lower, upper = self._lower, self._upper
        else:
            state, before = self._split(state)
            answer = self._law.evaluate(state, measurement, target)
            within = np.minimum(np.maximum(before, self._lower), self._upper)
            lower, upper = rate_bounds(within, self._rate, self._step, self._lower, self._upper)
        wanted = answer.torque
        torque: Array = np.minimum(np.maximum(wanted, lower), upper)
        status, slack = _FREE, 0.0
        free = torque.tolist() == wanted.tolist()
        if not free or self._looks_ahead:
            asked = Asked(answer, state, measurement, lower, upper, torque, free)
            torque, status, slack = self._limit(asked)
        state_rate = answer.state_rate
        if self._p and status is not _FREE and status is not _KEPT:
            state_rate = state_rate.copy()
            state_rate[: self._p] = 0.0
        if self._has_rate:
            state_rate = np.concatenate([state_rate, (torque - before) / self._step])
        return Evaluation(torque, state_rate, answer.status, answer.e, answer.J_hat, status, slack)

    @abc.abstractmethod
    def _limit(self, asked: Asked) -> tuple[Array, LimitStatus, float]:
        """Torque within [lower, upper], what was done to it, and the slack."""

    def _split(self, state: Array) -> tuple[Array, Array]:
        """State of the controller, and the torque before."""
        wanted = (self.n_state,)
        if not isinstance(state, np.ndarray) or state.shape != wanted or state.dtype.kind != "f":
            given = f"{state.dtype} {state.shape}" if isinstance(state, np.ndarray) else repr(state)
            raise InvalidInputError(
                f"state must be an array of float64 of shape {wanted}, got {given}", given=state
            )
        before = state[self._n_inner :]
        if not np.isfinite(before).all():
            raise InvalidInputError(f"state must be finite, got {state.tolist()}", given=state)
        return state[: self._n_inner], before

    def with_task(self, task: Task) -> Limiter:
        """Return this limiter for its controller with another task."""
        return type(self)(self.controller.with_task(task), **self._options())

    def __reduce__(self) -> tuple[Any, ...]:
        # a copy has scratch memory of its own, down to that of its controller
        return _with_options, (type(self), self.controller, self._options())

    def _options(self) -> dict[str, Any]:
        return {"limits": self._given_limits, "dt": self._step}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.controller!r})"


def _with_options(
    kind: type[Limiter], controller: CheckedController, options: dict[str, Any]
) -> Limiter:
    return kind(controller, **options)


def _always_learning(controller: Any, learning: Adaptation) -> CheckedController:
    """Return a controller that learns whatever the torque; the limiter decides when not to."""
    gravity = AdaptiveGravity(
        learning.regressor,
        learning.L,
        learning.alpha,
        learning.theta0,
        learning.bounds,
        torque_limits=np.inf,
    )
    unguarded: CheckedController = controller.with_gravity(gravity)
    return unguarded
