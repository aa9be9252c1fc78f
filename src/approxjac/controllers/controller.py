"""`Controller`: the one base of everything that turns measurements into commands."""

from __future__ import annotations

import functools
import math
from abc import ABC
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, Self

import numpy as np

from approxjac.controllers.gains.gains import Diagonals, Latency
from approxjac.controllers.gains.tuning import Tuning
from approxjac.controllers.learning.estimator import Kinematics
from approxjac.controllers.learning.kinematic_report import KinematicReport
from approxjac.controllers.limits.limits import Limits
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.formatting import spaced, wrapped
from approxjac.interface import Evaluation, Measurement, Target
from approxjac.robots import Dynamics, Robot
from approxjac.tasks import Task
from approxjac.validation import Array, as_number

_HUGE = 1e300  # below it no finite rate makes a state overflow within a second


class Instant(NamedTuple):
    """One instant of a run as it truly was, for a controller to look at afterwards.

    Attributes:
        q: Joint configuration, shape (nq,).
        v: Joint velocity q̇, shape (n_v,).
        e: True task error, shape (m,) [unit of the task].
        x_d: Wanted task value, shape (n_x,).
        state: State of the controller before its step, shape (n_state,).
        answer: Its answer, without the rate of the state.
        dynamics: Of the true robot.
        adds_gravity: Robot whose gravity the true one compensates itself; None is none.
    """

    q: Array
    v: Array
    e: Array
    x_d: Array
    state: Array
    answer: Evaluation
    dynamics: Dynamics
    adds_gravity: Robot | None = None

    @property
    def M(self) -> Array:
        """True inertia matrix, shape (n_v, n_v)."""
        return self.dynamics.M(self.q)


class Controller(ABC):
    """Anything that turns measurements into torques, or velocities, step by step.

    Derive from it and write `step`, or `evaluate` of a law in continuous time, whose `step` is an
    Euler step of the rate of its state. All else has a default, and is overridden where a
    controller can tell more: its V (`lyapunov`), what it has learnt (`learnt`, `parameters`), how
    limits of torques may change its torque (`passive_output`, `is_proven`).

    A controller holds no memory of its own: what evolves is a flat state array that goes in and
    comes out, so that a loop can be stopped, saved and gone on with.

    Attributes:
        task: The task of the believed robot.
        command: What it commands, which `Evaluation.torque` then is: torques, or velocities of
            the joints for a robot that takes those.
        dt: Sampling time that control has to have [s], or None where any will do.
        latency: Of the loop, if it is known.
        tuning: What a rule chose of its gains, and why; None if they are given.
        limits: Limits that it keeps, with an entry for each joint; None is none.
        parameters: Names and units of the numbers that `learnt` returns, in their order.
        kinematics: What predicts the error that it controls, known or learnt; None where it
            controls the measured one.
        alpha: α of `passive_output` [1/s].
        diagonals: Gains of its task and joints, if it has such.
        gain_values: Gains by their names.
        resting: Count of the state's first numbers, which rest where limits give the proof up.
        needs_solver: Whether its limits may need a solver, which takes its time.

    Args:
        task: The task of the believed robot.
    """

    task: Task
    command: Literal["torque", "velocity"] = "torque"
    dt: float | None = None
    latency: Latency | None = None
    tuning: Tuning | None = None
    limits: Limits | None = None
    parameters: Mapping[str, str] = MappingProxyType({})
    kinematics: Kinematics | None = None
    alpha: float = 1.0
    diagonals: Diagonals | None = None
    gain_values: Mapping[str, Any] = MappingProxyType({})
    resting: int = 0
    needs_solver: bool = False

    def __init__(self, task: Task) -> None:
        self.task = task

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.task!r})"

    def __str__(self) -> str:
        first, *others = self.describe()
        return "\n".join([*wrapped(first), *(line for o in others for line in wrapped(o, "  "))])

    def describe(self) -> list[str]:
        """Describe it in plain words: in a line, then its task, then what else to know."""
        return [spaced(type(self).__name__), f"{self.task.describe()} of {self.task.robot.name}"]

    # -- the loop -------------------------------------------------------------------------------

    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step, shape (n_state,)."""
        return np.zeros(0)

    def step(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """Return the state after a step, and torque and status for it.

        By default one Euler step of the rate that `evaluate` answers with.

        Args:
            state: State before the step, shape (n_state,).
            measurement: What was measured.
            target: Wanted task value: x_d, shape (n_x,), or a `Target` that moves.
            dt: Time for which the torque is held [s].

        Raises:
            InvalidInputError: As `evaluate`, no positive dt, or an answer without a rate.
            MeasurementError: As `evaluate`, or a state that overflows.
        """
        answer = self.evaluate(state, measurement, target)
        if isinstance(answer, Evaluation) and hasattr(answer.torque, "arm_of"):  # symbols
            return state + np.multiply(dt, answer.state_rate), answer  # type: ignore[arg-type]
        if not (isinstance(dt, float) and 0.0 < dt < math.inf):
            dt = as_number("dt", dt, unit="s", above=0.0)
        try:
            if dt <= 1.0 and math.hypot(*state.tolist()) < _HUGE:  # errstate takes its time
                return state + dt * np.asarray(answer.state_rate), answer
            with np.errstate(over="ignore"):  # an overflow is a named error
                after = state + dt * np.asarray(answer.state_rate)
        except (AttributeError, TypeError, ValueError):
            message = f"evaluate must return an Evaluation with a state_rate, got {answer!r}"
            raise InvalidInputError(message, given=answer) from None
        if math.isfinite(math.hypot(*after.tolist())):
            return after, answer
        message = f"the state overflows in a step of {dt:g} s from {state.tolist()}"
        raise MeasurementError(message, given=state)

    def evaluate(
        self, state: Array, measurement: Measurement, target: Target | Array
    ) -> Evaluation:
        """Return torque, rate of the state and status, of a law in continuous time.

        The arguments are those of `step`.

        Raises:
            InvalidInputError: A controller that runs in samples only.
        """
        raise InvalidInputError(
            f"controller must have a step(state, measurement, target, dt), or an "
            f"evaluate(state, measurement, target) of a law in continuous time, got {self!r}",
            given=self,
        )

    @property
    def is_continuous(self) -> bool:
        """True if the state has a rate, so that `evaluate` may be integrated."""
        return type(self).evaluate is not Controller.evaluate

    @property
    def law(self) -> Controller:
        """The law inside of all wrappers, such as the `SetpointController`; else itself.

        Its state is the first part of theirs.
        """
        return self

    def with_task(self, task: Task) -> Self:
        """Return this controller with another task, such as that of another believed robot.

        Args:
            task: A task with the same coordinates, of a robot with the same joints.

        Raises:
            InvalidInputError: A controller that cannot.
        """
        raise InvalidInputError(
            f"controller must be able to take another task for its belief to be changed, got "
            f"{self!r}",
            given=self,
        )

    @property
    def limited_law(self) -> Controller | None:
        """The law whose torque this brings within limits; None of what limits none itself."""
        return None

    # -- what is learnt -------------------------------------------------------------------------

    def learnt(self, state: Array) -> Array:
        """Return the learnt numbers of a state, or of a series (…, n_state), shape (…, p)."""
        return state[..., :0]

    def describe_learnt(self, state: Array) -> str:
        """Return in words what a state has learnt beside kinematics; "" of nothing."""
        return ""

    def learnt_sd(self, state: Array) -> Array:
        """Return the standard deviations of what a state has learnt, (p,); NaN is not known."""
        return np.full(len(self.learnt(state)), np.nan)

    def resumed(self, state: Array, measurement: Measurement) -> Array:
        """Return a state before a first step that knows what another state has learnt.

        Such as the last one of a run before, for `simulate(state=...)`; of the same controller.

        Raises:
            InvalidInputError: A state of another controller, a measurement of the wrong shapes, or
                a controller that learns no kinematics.
        """
        self.kinematics_of(state)
        return state

    def kinematics_of(self, state: Array) -> tuple[Kinematics, Array]:
        """Return the kinematics that this learns, and their part of a state.

        Raises:
            InvalidInputError: A controller that learns no kinematics, or a state of another one.
        """
        raise InvalidInputError(
            "controller must learn kinematics, such as a TrackingController or a "
            f"PredictedMeasurement, got {self!r}",
            given=self,
        )

    def kinematics_learnt(self, state: Array) -> KinematicReport:
        """Report the kinematics that a state has learnt; raises as `kinematics_of`."""
        kinematics, known = self.kinematics_of(state)
        return kinematics.report(known)

    def learnt_robot(self, state: Array) -> Robot:
        """Return the believed robot with what a state has learnt of its tool and joint origins.

        Masses, friction and the tracker are not in it; a state that is saved has them all. Raises
        as `kinematics_of`.
        """
        kinematics, known = self.kinematics_of(state)
        return kinematics.robot(known)

    # -- what is true of a run ------------------------------------------------------------------

    def lyapunov(self, at: Instant) -> float:
        """Return V [J] at an instant of a run; by default NaN: there is none."""
        return math.nan

    def task_torque(self, at: Instant) -> Array:
        """Return the part of the torque that acts on the task, (n_v,); NaN is not known."""
        return np.full(len(at.v), np.nan)

    # -- what limits of torques need to know ----------------------------------------------------
    # V̇ changes by yᵀ(τ − τ*) where τ takes the place of the law's own torque τ*: any τ with
    # yᵀ(τ − τ*) ≤ 0 keeps what is proven of V̇.

    def passive_output(self, answer: Evaluation, v: Array, alpha: float | Array) -> Array:
        """Return y where this law gave an answer, shape (n_v,) [rad/s or m/s].

        By default q̇: limits add no energy. v is the joint velocity that the answer was given for,
        shape (n_v,), less the answer's reference if there is one; α [1/s] is for a law whose y has
        one.
        """
        return v

    def is_proven(self, answer: Evaluation) -> Any:
        """Return True where V̇ is known for an answer of this law; by default nowhere."""
        return False

    def rate_without(
        self, locked: Array, state: Array, measurement: Measurement, answer: Evaluation
    ) -> Array:
        """Return the rate of what rests, shape (`resting`,), as of an arm with locked joints.

        A limiter asks for it where the proof is given up; by default it rests. `locked` (n_v,) says
        which joints are at a limit.
        """
        return np.zeros(self.resting)

    def with_limiter(self, motors: Array) -> Controller:
        """Return this law inside of a limiter, which rests it and sends at most `motors` (n_v,)."""
        return self

    def damping_rate(self, inertias: Array) -> float:
        """Return the rate at which this damps joints [1/s], given usual inertias (k, n_v, n_v)."""
        return 0.0

    def gravity_torque(self, state: Array, q: Array) -> Array:
        """Return the gravity torque compensated, (n_v,) [N m or N]; by default the robot's."""
        return self._own_dynamics.g(q)

    def believed_dynamics(self) -> tuple[Dynamics, bool]:
        """Return the dynamics that predict what a torque does, and whether they have gravity.

        Without it the gravity of the law's answer is subtracted.
        """
        return self._own_dynamics, True

    @functools.cached_property
    def _own_dynamics(self) -> Dynamics:
        return Dynamics(self.task.robot)
