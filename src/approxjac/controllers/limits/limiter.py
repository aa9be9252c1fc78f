"""`Limiter`: the base of controllers whose torque is brought within limits."""

from __future__ import annotations

import abc
import math
from typing import NamedTuple, Self

import numpy as np
import pinocchio as pin

from approxjac import law
from approxjac.controllers.arguments import HUGE, overflow
from approxjac.controllers.controller import Controller
from approxjac.controllers.limits.limits import Limits
from approxjac.controllers.wrapper import ControllerWrapper
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status, Target
from approxjac.validation import Array, require

_FREE = LimitStatus.FREE  # members of an enum are slow to look up
_GOES_ON = _FREE, LimitStatus.PROOF_KEPT, LimitStatus.EXCEEDED  # V̇ ≤ −W holds

_GIVES_UP = LimitStatus.PROOF_GIVEN_UP, LimitStatus.LIMITED
_TOLD = Status.OK, Status.NEAR_SINGULAR  # of the law, where there is something to learn from
_AT_LIMIT = 0.02  # a joint this near to its position limit counts as at it [rad or m]
_NEARLY = 0.98  # of a limit of torque or speed


class Asked(NamedTuple):
    """Torque that a controller asks for in one step, and its bounds.

    Attributes:
        answer: Answer of the controller.
        gravity: Gravity torque in it, shape (n_v,).
        measurement: What was measured.
        lower: Smallest torques, shape (n_v,).
        upper: Largest torques, shape (n_v,).
        clipped: The torque asked for, brought within them, shape (n_v,).
        free: Whether it was within them.
        memory: What the limiter kept from the step before, shape (k,).
    """

    answer: Evaluation
    gravity: Array
    measurement: Measurement
    lower: Array
    upper: Array
    clipped: Array
    free: bool
    memory: Array


class Limited(NamedTuple):
    """A torque within its bounds.

    Attributes:
        torque: Shape (n_v,).
        status: What was done to it.
        slack: σ [W].
        memory: What to keep for the next step, shape (k,).
    """

    torque: Array
    status: LimitStatus
    slack: float
    memory: Array


class Limiter(ControllerWrapper):
    """A controller whose torque is brought within limits.

    Its state is that of the controller, followed by what the limiter itself keeps from step to
    step, and by the torque of the step before where the rate of torques is limited; the first step
    starts from the torque that holds the arm.

    Learning by eq. (29) goes on where the torque is free, or limited such that V̇ ≤ −W holds: the
    parameters are part of that V, and it needs them to move. Where the proof is given up, joints
    that are at a limit count as locked: the others go on learning as the arm of these joints does,
    y = q̇ + α(ĴP)⁺s(e) with P leaving out what is locked. So an arm that weight has pushed to a
    stop learns what it needs to leave it, and nothing winds up where the others cannot lessen the
    error. Otherwise θ̂ rests. This takes the place of `AdaptiveGravity.torque_limits`. Dynamics that
    a `TrackingController` learns rest wherever the proof is given up; its kinematics go on.

    `resumed`, `kinematics_learnt` and `learnt_robot` of such a law are to be had of this, too, and
    take its states.

    Args:
        controller: The controller whose torque to limit.
        limits: Limits to keep; those of the believed robot's URDF by default.

    Attributes:
        controller: The controller.
    """

    _what = "its torque is kept within limits"

    def __init__(self, controller: Controller, limits: Limits | None = None) -> None:
        self._remember(locals())
        wanted = (
            "a law such as SetpointController (what holds measurements goes around it: "
            "HeldMeasurement(TorqueLimited(law), ...))"
        )
        require("controller", controller, Controller, wanted)
        if controller.command != "torque":
            raise InvalidInputError(
                f'controller must command torques to be limited, got command="velocity" of '
                f"{controller!r}, which keeps limits of its own",
                given=controller,
            )
        if limits is not None:
            require("limits", limits, Limits, "Limits(effort=...), Limits.of(robot) or None")
        self.controller = controller
        robot = controller.task.robot
        given = Limits.of(robot) if limits is None else limits
        self._limits = given.for_joints(robot.nv)
        self._upper = np.asarray(self.limits.effort)
        self._law, self._p = controller.with_limiter(self._upper), controller.resting
        self._lower = -self._upper
        self._rate = np.asarray(self.limits.rate)
        self._has_rate = bool(np.isfinite(self._rate).any())
        self._looks_ahead = False  # whether a torque within its limits may be limited too
        self._keep(np.zeros(0))

    def _keep(self, kept: Array) -> None:
        """Keep numbers from step to step; `kept` is what they are before the first one."""
        self._kept = kept
        self._memory = len(kept) + (len(self._upper) if self._has_rate else 0)

    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step.

        Raises:
            InvalidInputError: A measurement of the wrong shapes.
            MeasurementError: Law (5), and the first x is lost; or a limit of the rate, and q is
                not finite.
        """
        return self._begun(self._law.initial_state(measurement), measurement)

    def _begun(self, state: Array, measurement: Measurement) -> Array:
        """Return a first state of the law with what is kept besides."""
        if not self._has_rate:
            return np.concatenate([state, self._kept]) if len(self._kept) else state
        q = measurement.q
        if not np.isfinite(q).all():
            raise MeasurementError(
                f"q must be finite, got {q.tolist()}: the torque that holds the arm is "
                "not known without it",
                given=measurement,
            )
        q = self.task.robot.configuration(q)
        with np.errstate(over="ignore", invalid="ignore"):
            hold = self._law.gravity_torque(state, q)
        if not math.hypot(*hold.tolist()) < HUGE:
            raise overflow(measurement)
        return np.concatenate([state, self._kept, np.clip(hold, self._lower, self._upper)])

    def step(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """Return the state after a step, and a torque within the limits.

        Arguments and errors are those of the controller.
        """
        lower, upper, memory = self._lower, self._upper, self._kept
        if self._memory:
            state, memory = self._split(state)
            if self._has_rate:
                memory, before = np.split(memory, [len(self._kept)])
                if not math.hypot(*before.tolist()) < HUGE:  # no law gives such a torque
                    told = f"state must end with the torque before, got {before.tolist()}"
                    raise InvalidInputError(told, given=state)
        after, answer = self._law.step(state, measurement, target, dt)
        if self._has_rate:
            within = np.minimum(np.maximum(before, lower), upper)
            with np.errstate(over="ignore"):  # no bound at all, of an absurd rate or dt
                lower, upper = law.rate_bounds(within, self._rate, dt, lower, upper)
        wanted = answer.torque
        torque: Array = np.minimum(np.maximum(wanted, lower), upper)
        status, slack = _FREE, 0.0
        free = torque.tolist() == wanted.tolist()
        if not free or self._looks_ahead:
            g = answer.gravity
            if g is None:
                g = self._law.gravity_torque(state, measurement.q)
            asked = Asked(answer, g, measurement, lower, upper, torque, free, memory)
            torque, status, slack, memory = self._limit(asked)
            if self._p and status not in _GOES_ON:
                after[: self._p] = state[: self._p]
                # or θ̂ would ask for ever more than the motors have
                has_room = not (np.abs(answer.torque) > self._upper).any()
                if status in _GIVES_UP and answer.status in _TOLD and has_room:
                    locked = self._locked(measurement, torque)
                    if locked.any():
                        rate = self._law.rate_without(locked, state, measurement, answer)
                        after[: self._p] += dt * rate
        if self._memory:
            after = np.concatenate([after, memory, torque] if self._has_rate else [after, memory])
        return after, Evaluation(torque, *answer[1:6], status, slack, answer.reference)

    def _locked(self, measurement: Measurement, torque: Array) -> Array:
        """Return which joints are at a limit, shape (n_v,)."""
        _, q, v, *_ = measurement
        robot = self.task.robot
        motion = q if robot.nq == robot.nv else pin.difference(robot.model, robot.neutral(), q)
        low, high = np.asarray(self.limits.position)
        locked = (motion < low + _AT_LIMIT) | (motion > high - _AT_LIMIT)
        locked |= np.abs(v) > _NEARLY * np.asarray(self.limits.velocity)
        locked |= np.abs(torque) > _NEARLY * self._upper
        return np.asarray(locked)

    @property
    def limits(self) -> Limits:  # type: ignore[override]
        """The limits with an entry for each joint."""
        return self._limits

    @property
    def limited_law(self) -> Controller:
        """The law whose torque is limited."""
        return self.controller

    def with_limits(self, limits: Limits) -> Self:
        """Return this with other limits."""
        return self._rebuilt(limits=limits)

    @abc.abstractmethod
    def _limit(self, asked: Asked) -> Limited:
        """Return a torque within [lower, upper]."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.controller!r})"
