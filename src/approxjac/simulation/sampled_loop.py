"""`SampledLoop`: a plant and a controller as a robot runs them, step by step."""

from __future__ import annotations

import math

import numpy as np

from approxjac.errors import InvalidInputError, MeasurementError, SimulationError
from approxjac.formatting import joined
from approxjac.interface import (
    ContinuousController,
    Controller,
    Evaluation,
    Measurement,
    Target,
    TargetPath,
)
from approxjac.simulation.held_commands import HeldCommands
from approxjac.simulation.integrators import INTEGRATORS
from approxjac.simulation.plant import Plant
from approxjac.simulation.sensing import SensorReadings
from approxjac.tasks import Task
from approxjac.validation import Array, as_array, require


class SampledLoop:
    """A closed loop whose command is held over dt (zero-order hold).

    `simulate` runs it. An observer gets it after every step of the controller, may look at all of
    it, and may move the target, exchange the controller or stop it; what it does not touch is the
    same to the last bit as without it.

    Attributes:
        plant: The true robot.
        controller: The controller.
        path: What the target is now and later: an array at rest, a `Target` or a path.
        target: x_d, shape (n_x,).
        integrator: Of the plant.
        dt: Sampling time [s].
        step: Number of the step.
        steps: Number of the last one.
        truth: Measurement of ideal sensors; its x is NaN where the sensor does not see.
        measurement: Measurement that the controller gets.
        state: State of the controller before this step, shape (n_state,).
        answer: Answer of the controller.
        tau: Torque at this instant, the controller's or that of the plant's servo, shape (n_v,).
        stopped: Whether an observer stopped it.
    """

    def __init__(
        self,
        plant: Plant,
        controller: Controller,
        path: Wanted,
        q: Array,
        v: Array,
        dt: float,
        steps: int,
        integrator: str,
        seed: int,
        state: Array | None = None,
    ) -> None:
        self.plant = plant
        self.controller = controller
        self.dt = dt
        self.step = 0
        self.steps = steps
        self.stopped = False
        self.path = path
        self.integrator = integrator
        self._integrate = INTEGRATORS[integrator]
        self._readings = None
        if plant.sensing is not None:
            self._readings = SensorReadings(plant.sensing, plant.sensor, dt, seed)
        self._aim()
        self._sense(q, v)
        self.state = first_state(plant, controller, self._wanted, self.measurement, dt, state)
        self._commands = HeldCommands(plant, q, dt, steps)
        self._control()

    @property
    def t(self) -> float:
        """Time [s]."""
        return self.truth.t

    @property
    def ended(self) -> bool:
        """Return whether there is no further step."""
        return self.stopped or self.step == self.steps

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

    def aim_at(self, target: Target | TargetPath | Array) -> None:
        """Move the target, from the next step on.

        Raises:
            InvalidInputError: Wrong shape, not finite, or not a value that the sensor has.
        """
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
        """Let another controller go on, from the next step on.

        It goes on with the state that there is, such as gravity that was learnt.

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

    def _sense(self, q: Array, v: Array) -> None:
        self.truth = self.plant.measure(self.step * self.dt, q, v)
        self.measurement = self.truth if self._readings is None else self._readings.read(self.truth)

    def _control(self) -> None:
        self._after, answer = self.controller.step(
            self.state, self.measurement, self._wanted, self.dt
        )
        if not math.isfinite(math.hypot(*self._after.tolist())):
            as_array("state", self._after, self._after.shape)
        # a controller may use one buffer for all its torques, and `aim_at` asks it once more
        self.answer: Evaluation = answer._replace(torque=answer.torque.copy())
        self._acting = self._commands.acting(self.answer.torque)
        self.tau = self.answer.torque
        if self.plant.servo is not None:
            self.tau = self.plant.applied(self.truth.q, self.truth.v, self._acting[0])


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
    if isinstance(controller, ContinuousController):
        as_array("the controller's state_rate", answer.state_rate, state.shape)
    if np.isfinite(measurement.x).all():  # a lost x has no error
        as_array("the controller's e", answer.e, (plant.sensor.m,), joined(plant.sensor.units))
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
