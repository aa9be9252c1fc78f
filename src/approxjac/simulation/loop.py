"""Loops: a controller and what moves, sample by sample; targets, and what is checked before."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError, MeasurementError, SimulationError
from approxjac.formatting import joined
from approxjac.interface import Evaluation, Measurement, Target, TargetPath
from approxjac.simulation.plant import INTEGRATORS, Plant
from approxjac.simulation.sensing import SensorReadings
from approxjac.tasks import Task
from approxjac.tasks.analysis import require_unmirrored
from approxjac.validation import Array, as_array, require

_STEP = 1e-3  # of the arm under a servo, at most [s]
_TINY = 1e-6  # of a step: more than round-off, less than anyone means
Wanted = Target | TargetPath | Array
"""A target that has been checked: an array at rest, a `Target`, or a path."""


def wanted_of(sensor: Task, target: object, t: float) -> Wanted:
    """Return a target, or a path, whose value at t [s] is one of the sensor."""
    if isinstance(target, type) or not isinstance(target, Target | TargetPath):
        return sensor.target(target)
    now = target.at(t) if isinstance(target, TargetPath) else target
    require("at(t) of a path", now, Target, "a Target(x, v, a)")
    x = sensor.target(now.x)
    if isinstance(target, TargetPath):
        return target
    rates = {
        name: None if value is None else as_array(f"{name} of the target", value, (sensor.m,))
        for name, value in (("v", now.v), ("a", now.a))
    }
    return Target(x, **rates)


def target_at(wanted: Wanted, t: float) -> Target | Array:
    """Return the target at t [s]."""
    if isinstance(wanted, np.ndarray | Target):
        return wanted
    return wanted.at(t)


def x_of(target: Target | Array) -> Array:
    """Return x_d, shape (n_x,)."""
    return target.x if isinstance(target, Target) else target


def require_start(task: Task, wanted: Wanted, x: Array) -> None:
    """Refuse a target at rest whose points run round the other way than they are measured."""
    if isinstance(wanted, np.ndarray):
        require_unmirrored(task, "target", wanted, x, "the measured x")


def diverged(t: float, duration: float, error: Exception) -> SimulationError:
    """Return the error of a loop that diverged."""
    return SimulationError(
        f"the simulation diverged at t = {t:g} of {duration:g} s: {error} (a smaller dt or smaller "
        "gains may help)",
        given=t,
    )


def first_state(
    plant: Plant,
    controller: Controller,
    wanted: Target | Array,
    measurement: Measurement,
    dt: float,
    given: Array | None = None,
) -> Array:
    """Return the state that a controller begins with, after a step in which it is seen to be one.

    Its initial state, unless another one is given.
    """
    state = controller.initial_state(measurement)
    if given is not None:
        state = as_array("state", given, state.shape)
    state = as_array("the controller's initial_state", state, (np.size(state),))
    stepped = controller.step(state, measurement, wanted, dt)
    if not (isinstance(stepped, tuple) and len(stepped) == 2):
        raise InvalidInputError(
            f"step of a controller must return (state, Evaluation), got {stepped!r}", given=stepped
        )
    after, answer = stepped
    require("the controller's answer", answer, Evaluation, "an Evaluation")
    unit = "N m or N" if plant.servo is None else "rad/s or m/s"
    as_array(f"the controller's {plant.command}", answer.torque, (plant.robot.nv,), unit)
    require("the controller's state", after, np.ndarray, "an array")
    as_array("the controller's state", after, state.shape)
    learnt = controller.learnt(state)
    require("learnt of the controller", learnt, np.ndarray, "an array")
    if len(learnt) != len(controller.parameters):
        raise InvalidInputError(
            f"parameters of the controller must name the {len(learnt)} numbers that learnt(state) "
            f"returns, got {controller.parameters!r}",
            given=controller,
        )
    if controller.is_continuous:
        as_array("the controller's state_rate", answer.state_rate, state.shape)
    if np.isfinite(measurement.x).all():  # a lost x has no error
        as_array(
            "the controller's e", answer.e, (controller.task.m,), joined(controller.task.units)
        )
    return state


def require_fit(plant: Plant, controller: Controller, dt: float | None) -> None:
    """Refuse a controller that is none, of another task, command or sampling time."""
    like = "a controller, such as SetpointController(...)"
    require("controller", controller, Controller, like)
    require("task of the controller", controller.task, Task, "the task of the believed robot")
    plant.require_measured(controller.task)
    if controller.command != plant.command:
        without = "Plant(..., servo=VelocityServo()) takes velocities, one without servo torques"
        raise InvalidInputError(
            f"command of the controller must be {plant.command!r}, which the plant takes, got "
            f"{controller.command!r} of {controller!r}; {without}",
            given=controller,
        )
    wanted = controller.dt
    if wanted is not None and (dt is None or not np.isclose(dt, wanted, rtol=1e-9, atol=0.0)):
        raise InvalidInputError(
            f"dt must be that of the controller, {wanted:g} [s], for which it was built, got "
            f"{dt!r}",
            given=dt,
        )


class InitialState(NamedTuple):
    """How a run begins.

    Attributes:
        q0: Configuration, shape (nq,); `plant.ready_configuration()` by default.
        v0: Velocity, shape (n_v,); at rest by default.
        state: State of the controller, such as `controller.resumed(...)` gives; by default its
            `initial_state`.
    """

    q0: Sequence[float] | Array | None = None
    v0: Sequence[float] | Array | None = None
    state: Array | None = None

    def checked(self, plant: Plant) -> tuple[Array, Array, Array | None]:
        """Return configuration, velocity and state for a plant, refused where they are wrong."""
        robot = plant.robot
        q0 = plant.ready_configuration() if self.q0 is None else self.q0
        q = as_array("q0", robot.configuration(q0, "q0"), (robot.nq,))
        robot.require_radians("q0", q)
        v0 = np.zeros(robot.nv) if self.v0 is None else self.v0
        return q, as_array("v0", v0, (robot.nv,), "rad/s"), self.state


class Loop:
    """Base of the loops of a plant and of a robot.

    An observer may look at all of it, and may move the target, exchange the controller or stop it.

    Attributes:
        plant: The true robot, or of a real one what is believed of it.
        controller: The controller.
        path: What the target is now and later: an array at rest, a `Target` or a path.
        target: x_d, shape (n_x,).
        dt: Sampling time [s].
        step: Number of the step.
        steps: Number of the last one.
        truth: Measurement of ideal sensors; its x is NaN where the sensor does not see. Of a robot
            it is what was measured last.
        measurement: Measurement that the controller gets.
        state: State of the controller before this step, shape (n_state,).
        answer: Answer of the controller.
        tau: Torque at this instant, the controller's or that of the plant's servo, shape (n_v,).
        stopped: Whether an observer stopped it.
    """

    truth: Measurement
    measurement: Measurement
    state: Array
    answer: Evaluation
    tau: Array
    target: Array
    _wanted: Target | Array
    _knows_truth: ClassVar[bool] = True  # of a robot nobody does

    def __init__(
        self, plant: Plant, controller: Controller, path: Wanted, dt: float, steps: int
    ) -> None:
        self.plant = plant
        self.controller = controller
        self.path = path
        self.dt = dt
        self.step = 0
        self.steps = steps
        self.stopped = False

    @property
    def t(self) -> float:
        """Time [s]."""
        return self.truth.t

    @property
    def ended(self) -> bool:
        """Return True after the last step."""
        return self.stopped or self.step == self.steps

    def aim_at(self, target: Target | TargetPath | Array) -> None:
        """Move the target, from the next step on, to a value that the sensor has."""
        path = wanted_of(self.plant.sensor, target, self.t)
        wanted = target_at(path, self.t)
        try:
            self.controller.step(self.state, self.measurement, wanted, self.dt)
        except MeasurementError as error:
            raise InvalidInputError(
                f"target must be one that the controller can be evaluated with, without an "
                f"overflow, got {x_of(wanted).tolist()}",
                given=target,
            ) from error
        self.path = path
        self.target = x_of(wanted)

    def exchange(self, controller: Controller) -> None:
        """Let another controller go on, from the next step on, with the state that there is.

        Raises:
            InvalidInputError: A controller of another task, with a state of another length, or
                for another sampling time.
        """
        require_fit(self.plant, controller, self.dt)
        state = first_state(self.plant, controller, self._wanted, self.measurement, self.dt)
        if state.shape != self.state.shape:
            raise InvalidInputError(
                f"controller must have a state of length {len(self.state)} to go on with, got "
                f"{controller!r} with {len(state)}",
                given=controller,
            )
        self.controller = controller

    def stop(self) -> None:
        """End the run at this step."""
        self.stopped = True

    def _aim(self) -> None:
        self._wanted = target_at(self.path, self.step * self.dt)
        self.target = x_of(self._wanted)

    def _control(self) -> None:
        self._after, answer = self.controller.step(
            self.state, self.measurement, self._wanted, self.dt
        )
        if not math.isfinite(math.hypot(*self._after.tolist())):
            as_array("state", self._after, self._after.shape)
        # a controller may use one buffer for all its torques, and `aim_at` asks it once more
        self.answer = answer._replace(torque=answer.torque.copy())
        self.tau = self.answer.torque


class HeldCommands:
    """Commands of one run: torques, late; or velocities, taken at the servo's period and late.

    Attributes:
        h: Time for which each command that acts is held [s]: dt, or at most 1 ms with a servo.
    """

    def __init__(self, plant: Plant, q: Array, dt: float, samples: int) -> None:
        if plant.servo is None:
            first, delay = plant.holding_torque(q), plant.actuator_delay
            self._per_sample, self._taken_per_step = 1, 1.0
        else:
            first, delay = np.zeros(plant.robot.nv), plant.servo.delay
            self._per_sample = max(1, math.ceil(dt / _STEP - _TINY))
            self._taken_per_step = min(dt / self._per_sample / plant.servo.period, 1.0)
        self.h = dt / self._per_sample
        late = round(min(delay / self.h, float(samples * self._per_sample)))
        self._waiting = deque([first] * late)
        self._steps, self._number, self._taken = 0, -1, first

    def acting(self, command: Array) -> list[Array]:
        """Return the commands that act over the next sample, one after the other for h [s]."""
        return [self._next(command) for _ in range(self._per_sample)]

    def _next(self, command: Array) -> Array:
        # counted from the start, so that no rounding adds up
        number = math.floor(self._steps * self._taken_per_step + _TINY)
        if number != self._number:
            self._number, self._taken = number, command
        self._steps += 1
        self._waiting.append(self._taken)
        return self._waiting.popleft()


class SampledLoop(Loop):
    """A closed loop whose command is held over dt (zero-order hold), as `simulate` runs it.

    What an observer does not touch is the same to the last bit as without it.
    """

    def __init__(
        self,
        plant: Plant,
        controller: Controller,
        path: Wanted,
        start: InitialState,
        dt: float,
        steps: int,
        integrator: str,
        seed: int = 0,
    ) -> None:
        super().__init__(plant, controller, path, dt, steps)
        self.integrator = integrator
        self._integrate = INTEGRATORS[integrator]
        self._readings = None
        if plant.sensing is not None:
            self._readings = SensorReadings(plant.sensing, plant.sensor, dt, seed)
        q, v, state = start.checked(plant)
        self._aim()
        self._sense(q, v)
        self.state = first_state(plant, controller, self._wanted, self.measurement, dt, state)
        self._commands = HeldCommands(plant, q, dt, steps)
        self._control()

    def advance(self) -> None:
        """Hold the command for dt, measure, and control; a SimulationError if the loop diverged."""
        self.state = self._after
        q, v, h = self.truth.q, self.truth.v, self._commands.h
        for command in self._acting:
            q, v = self.plant.advance(q, v, command, h, self._integrate)
        self.step += 1
        self._aim()
        try:
            self._sense(q, v)
            self._control()
        except (InvalidInputError, MeasurementError) as error:
            raise diverged(self.step * self.dt, self.steps * self.dt, error) from error

    def _sense(self, q: Array, v: Array) -> None:
        self.truth = self.plant.measure(self.step * self.dt, q, v)
        self.measurement = self.truth if self._readings is None else self._readings.read(self.truth)

    def _control(self) -> None:
        super()._control()
        self._acting = self._commands.acting(self.answer.torque)
        if self.plant.servo is not None:
            self.tau = self.plant.applied(self.truth.q, self.truth.v, self._acting[0])
