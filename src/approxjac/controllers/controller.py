"""`Controller`: the base class of everything that turns measurements into commands."""

from __future__ import annotations

import functools
import math
from abc import ABC
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, Self

import numpy as np

from approxjac.controllers.arguments import as_measurement
from approxjac.controllers.gains.gains import Diagonals, Latency
from approxjac.controllers.gains.tuning import Tuning
from approxjac.controllers.guard import USUAL, Guard, SampleGuard
from approxjac.controllers.learning.estimator import Kinematics
from approxjac.controllers.learning.kinematic_report import KinematicReport
from approxjac.controllers.limits.limits import Limit, Limits
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.formatting import spaced, wrapped
from approxjac.interface import Evaluation, Measurement, Target
from approxjac.robots import Dynamics, Robot
from approxjac.tasks import Task
from approxjac.validation import Array, as_number, as_vector, changed_copy, require

_HUGE = 1e300  # below it no finite rate makes a state overflow within a second


class Instant(NamedTuple):
    """The true state at one instant of a run, for analysis after the run."""

    q: Array  # joint configuration, shape (nq,)
    v: Array  # joint velocity q̇, shape (n_v,)
    e: Array  # true task error, shape (m,) [unit of the task]
    x_d: Array  # desired task value, shape (n_x,)
    state: Array  # state of the controller before its step, shape (n_state,)
    answer: Evaluation  # its output, without the rate of the state
    dynamics: Dynamics  # dynamics of the true robot
    # robot whose gravity the true one compensates itself; None is none
    adds_gravity: Robot | None = None

    @property
    def M(self) -> Array:
        """True inertia matrix, shape (n_v, n_v)."""
        return self.dynamics.M(self.q)


class Controller(ABC):
    """Anything that turns measurements into joint torques or velocities, step by step.

    Derive from it and write `advance` (and `begin`, if it has a state); or, for a law in continuous
    time, `evaluate`, of which `advance` is an Euler step. All else has a default to override: the
    Lyapunov function (`lyapunov`), learnt numbers (`learnt`, `parameters`), and how limits may
    change the torque (`passive_output`, `is_proven`).

    A controller has no memory: its state is a flat array, an argument and a result of each step, so
    that a run can be stopped, saved and continued. It is the state of `begin`, followed by that of
    its `Guard`, which keeps bad samples from `advance`.

    Attributes:
        task: The task of the believed robot.
        command: Kind of `Evaluation.torque`: joint torques, or joint velocities for a robot that
            takes those.
        dt: Required sampling time [s]; None for any.
        latency: Latency of the loop, if known.
        tuning: Gains that `tuned` chose, and why; None if they were given.
        limits: Limits that it keeps, with an entry for each joint; None is none.
        motion_limits: Limits of motion that it keeps besides.
        parameters: Names and units of the numbers that `learnt` returns, in their order.
        kinematics: Known or learnt kinematics that predict the controlled error; None if it
            controls the measured one.
        unseen: Largest motion that it allows without a new x, for each measured coordinate [unit of
            the task]; None if it has no such limit.
        alpha: α of `passive_output` [1/s].
        diagonals: Gains of its task and joints, if any.
        gain_values: Gains by name.
        resting: Number of leading state entries that pause when limits give up the proof.
        rotors: Least rotor inertias, (n_v,) [kg m² or kg], if it takes joints for elastic: then no
            limit may damp motors hard. None is for joints that move as the believed robot's.
        needs_solver: True if its limits may need a solver, which takes time.
        guard: Bounds of good samples; None is without, see `guarded`.
    """

    task: Task
    command: Literal["torque", "velocity"] = "torque"
    dt: float | None = None
    latency: Latency | None = None
    tuning: Tuning | None = None
    limits: Limits | None = None
    motion_limits: tuple[Limit, ...] = ()
    parameters: Mapping[str, str] = MappingProxyType({})
    kinematics: Kinematics | None = None
    unseen: Array | None = None
    alpha: float = 1.0
    diagonals: Diagonals | None = None
    gain_values: Mapping[str, Any] = MappingProxyType({})
    resting: int = 0
    rotors: Array | None = None
    needs_solver: bool = False
    guard: Guard | None = USUAL
    _carried = ("guard",)

    def __init_subclass__(cls, **given: Any) -> None:
        super().__init_subclass__(**given)
        for name, hook in (("step", "advance"), ("initial_state", "begin")):
            if name in cls.__dict__ and cls.__module__.partition(".")[0] != "approxjac":
                raise InvalidInputError(
                    f"{name} of {cls.__name__} must be called {hook}, which Controller.{name} "
                    "calls with guarded samples",
                    given=cls,
                )

    def __init__(self, task: Task) -> None:
        self.task = task

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.task!r})"

    def __str__(self) -> str:
        first, *others = self.describe()
        return "\n".join([*wrapped(first), *(line for o in others for line in wrapped(o, "  "))])

    def describe(self) -> list[str]:
        """Describe it in lines of text: the law, its task, further remarks."""
        return [spaced(type(self).__name__), f"{self.task.describe()} of {self.task.robot.name}"]

    # -- the loop -------------------------------------------------------------------------------

    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step, shape (n_state,).

        Raises:
            MeasurementError: q or q̇ is not finite. Also the errors of `begin`.
        """
        first, guard = as_measurement(measurement), self._sample_guard
        is_known = (np.isfinite(np.asarray(each)).all() for each in first[1:3])
        if not (hasattr(first.q, "arm_of") or all(is_known)):
            message = f"q and q̇ must be finite in a first measurement, got {measurement!r}"
            raise MeasurementError(message, given=measurement)
        own = self.begin(first)
        return own if guard is None else np.concatenate([own, guard.first])

    def step(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """Return the state after a step, and its output, whose status shows a refused sample.

        A state of `begin`, without the memory of the guard, is stepped without it.

        Args:
            state: State before the step, shape (n_state,).
            measurement: The measurement.
            target: Desired task value: x_d, shape (n_x,), or a `Target` that moves.
            dt: Time for which the torque is held [s].

        Raises the errors of `advance`.
        """
        if not (type(measurement) is Measurement and type(measurement.t) is type(dt) is float):
            measurement = as_measurement(measurement)
            if not hasattr(state, "arm_of"):  # or they are symbols
                dt = as_number("dt", dt, unit="s", above=0.0)
        guard, n = self._sample_guard, self.size
        if guard is None or getattr(state, "shape", None) != (n + len(guard.first),):
            return self.advance(state, measurement, target, dt)
        return guard.step(self, state[:n], state[n:], measurement, target, dt)

    def guarded(self, guard: Guard | None) -> Self:
        """Return this controller with other bounds of good samples; None accepts all."""
        require("guard", guard, Guard | None, "Guard(q=..., lag=...) or None")
        copy: Self = changed_copy(self, guard=guard)
        vars(copy).pop("_sample_guard", None)
        return copy

    @functools.cached_property
    def _sample_guard(self) -> SampleGuard | None:
        return None if self.guard is None else SampleGuard(self.guard, self)

    @functools.cached_property
    def size(self) -> int:
        """Length of the state of `begin`."""
        robot, task = self.task.robot, self.task
        x = task.value(q := robot.neutral())
        x = np.where(np.isfinite(x), x, task.origin)
        return len(self.begin(Measurement(0.0, q, np.zeros(robot.nv), x, 0.0)))

    @property
    def whole_size(self) -> int:
        """Length of the state of `initial_state`, with the memory of the guard."""
        return self.size + (0 if self._sample_guard is None else len(self._sample_guard.first))

    def _own_part(self, state: Array) -> Array:
        """Return a state without the guard's memory, if it has just that."""
        is_whole = getattr(state, "shape", None) == (self.whole_size,)
        return state[: self.size] if is_whole else state

    # -- what a law of your own writes ----------------------------------------------------------

    def begin(self, measurement: Measurement) -> Array:
        """Return the state before the first step; by default none, shape (0,)."""
        return np.zeros(0)

    def advance(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """Return the state after a step with a sample that passed the guard, and its output.

        By default an Euler step of the rate from `evaluate`. The arguments are those of `step`,
        with a state of `begin`.

        Raises:
            InvalidInputError: As `evaluate`; dt is not positive, or the output has no rate.
            MeasurementError: As `evaluate`, or a state that overflows.
        """
        answer = self.evaluate(state, measurement, target)
        if isinstance(answer, Evaluation) and hasattr(answer.torque, "arm_of"):  # symbols
            return state + np.multiply(dt, answer.state_rate), answer  # type: ignore[arg-type]
        if not (isinstance(dt, float) and 0.0 < dt < math.inf):
            dt = as_number("dt", dt, unit="s", above=0.0)
        try:
            rate = answer.state_rate
            if type(rate) is np.ndarray and rate.shape == state.shape == (0,):  # as of many laws
                return state, answer
            if dt <= 1.0 and math.hypot(*state.tolist()) < _HUGE:  # errstate takes its time
                return state + dt * np.asarray(rate), answer
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
        """Return torque, rate of the state and status of a law in continuous time.

        The arguments are those of `step`.

        Raises:
            InvalidInputError: The controller is discrete.
        """
        raise InvalidInputError(
            f"controller must have an advance(state, measurement, target, dt), or an "
            f"evaluate(state, measurement, target) of a law in continuous time, got {self!r}",
            given=self,
        )

    @property
    def is_continuous(self) -> bool:
        """True if the state has a rate, so that `evaluate` may be integrated."""
        return type(self).evaluate is not Controller.evaluate

    @property
    def law(self) -> Controller:
        """The law inside all wrappers, such as the `SetpointController`; else itself.

        Its state comes first in the wrappers' state.
        """
        return self

    def with_task(self, task: Task) -> Self:
        """Return this controller with another task, such as that of another believed robot.

        Args:
            task: A task with the same coordinates, of a robot with the same joints.

        Raises:
            InvalidInputError: The controller cannot.
        """
        raise InvalidInputError(
            f"controller must have a method with_task for its belief to be changed, got {self!r}",
            given=self,
        )

    @property
    def limited_law(self) -> Controller | None:
        """The law whose torque this limits; None if it is no limiter."""
        return None

    # -- what is learnt -------------------------------------------------------------------------

    def learnt(self, state: Array) -> Array:
        """Return the learnt numbers (…, p) of a state of `begin`, or of a series of those."""
        return state[..., :0]

    def describe_learnt(self, state: Array) -> str:
        """Describe what a state has learnt beside kinematics; "" if nothing."""
        return ""

    def learnt_sd(self, state: Array) -> Array:
        """Return the standard deviations of `learnt`, shape (p,); NaN where unknown."""
        return np.full(len(self.learnt(state)), np.nan)

    def resumed(self, state: Array, measurement: Measurement) -> Array:
        """Return an initial state with the learnt numbers of another state.

        Use it to continue from the last state of an earlier run of this controller, with
        `simulate(..., q0=InitialState(state=...))`.

        Raises:
            InvalidInputError: A state of another controller, or a measurement of the wrong shapes.
        """
        fresh = self.initial_state(measurement)
        fresh[: self.size] = as_vector("state", self._own_part(state), self.size)
        return fresh

    def kinematics_of(self, state: Array) -> tuple[Kinematics, Array]:
        """Return the learnt kinematics, and their part (k,) of a state (n_state,).

        Raises:
            InvalidInputError: The controller learns no kinematics, or a state of another one.
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

    def relearnt(self, state: Array) -> Array:
        """Return a state that learns kinematics anew, about what it has and as unsure as at first.

        Use it after the tool or the sensor was moved, with kinematics that do not restart by
        themselves. Raises the errors of `kinematics_of`.
        """
        kinematics, known = self.kinematics_of(state)
        _, where = self.kinematics_of(np.arange(float(self.size)))
        state = state.copy()
        state[where.astype(int)] = kinematics.relearnt(known)
        return state

    def learnt_robot(self, state: Array) -> Robot:
        """Return the believed robot with the tool and joint origins that a state has learnt.

        It is without learnt masses, friction and tracker, which only the state has. Raises the
        errors of `kinematics_of`.
        """
        kinematics, known = self.kinematics_of(state)
        return kinematics.robot(known)

    # -- what is true of a run ------------------------------------------------------------------

    def lyapunov(self, at: Instant) -> float:
        """Return the Lyapunov function V [J] at an instant; NaN, the default, if there is none."""
        return math.nan

    def task_torque(self, at: Instant) -> Array:
        """Return the part of the torque that acts on the task, (n_v,); NaN where unknown."""
        return np.full(len(at.v), np.nan)

    # -- what limits of torques need to know ----------------------------------------------------
    # V̇ changes by yᵀ(τ − τ*) where τ takes the place of the law's own torque τ*: any τ with
    # yᵀ(τ − τ*) ≤ 0 keeps what is proven of V̇.

    def passive_output(self, answer: Evaluation, v: Array, alpha: float | Array) -> Array:
        """Return the y for which a torque change Δτ adds yᵀΔτ to V̇, (n_v,) [rad/s or m/s].

        By default q̇: limits add no energy. v is the joint velocity at the `answer`, shape (n_v,),
        minus its reference if there is one; α [1/s] is for a law whose y has one.
        """
        return v

    def is_proven(self, answer: Evaluation) -> Any:
        """Return True if V̇ is known for an output of this law; by default False."""
        return False

    def rate_without(
        self, locked: Array, state: Array, measurement: Measurement, answer: Evaluation
    ) -> Array:
        """Return the rate of the first `resting` state entries for an arm with locked joints.

        A limiter uses it while the proof is given up; by default zero. `locked` (n_v,) is True
        for joints at a limit.
        """
        return np.zeros(self.resting)

    def with_limiter(self, motors: Array) -> Controller:
        """Return this law for use in a limiter that decides when learning pauses."""
        return self

    def damping_rate(self, inertias: Array) -> float:
        """Return the rate of its joint damping [1/s], given usual inertias (k, n_v, n_v)."""
        return 0.0

    def gravity_torque(self, state: Array, q: Array) -> Array:
        """Return the compensated gravity torque, (n_v,) [N m or N]; by default the robot's."""
        return self._own_dynamics.g(q)

    def believed_dynamics(self) -> tuple[Dynamics, bool]:
        """Return the dynamics that predict accelerations, and whether they include gravity.

        If they do not, the gravity torque of the law's output is subtracted.
        """
        return self._own_dynamics, True

    @functools.cached_property
    def _own_dynamics(self) -> Dynamics:
        return Dynamics(self.task.robot)
