"""`SampledLoop`: a plant and a controller as a robot runs them, step by step."""

from __future__ import annotations

from collections import deque

import numpy as np

from approxjac.errors import InvalidInputError, MeasurementError, SimulationError
from approxjac.interface import Controller, Evaluation, Measurement
from approxjac.simulation.integrators import INTEGRATORS
from approxjac.simulation.plant import Plant
from approxjac.simulation.sensing import SensorReadings
from approxjac.tasks import Task
from approxjac.validation import Array, as_array, require


class SampledLoop:
    """A closed loop whose torque is held over dt; the controller's state takes an Euler step.

    `simulate` runs it. An observer gets it after every evaluation, may look at all of it, and may
    move the target, exchange the controller or stop it; what it does not touch stays as it was.

    Attributes:
        plant: The true robot.
        controller: The controller.
        target: x_d, shape (n_x,).
        dt: Sampling time [s].
        step: Number of the step.
        steps: Number of the last one.
        truth: What ideal sensors measure; its x is NaN where the sensor does not see.
        measurement: What the controller gets.
        state: State of the controller, shape (n_state,).
        answer: What the controller answered.
        stopped: Whether an observer stopped it.
    """

    def __init__(
        self,
        plant: Plant,
        controller: Controller,
        target: Array,
        q: Array,
        v: Array,
        dt: float,
        steps: int,
        integrator: str,
        seed: int,
    ) -> None:
        self.plant = plant
        self.controller = controller
        self.target = target
        self.dt = dt
        self.step = 0
        self.steps = steps
        self.stopped = False
        self._integrate = INTEGRATORS[integrator]
        self._readings = None
        if plant.sensing is not None:
            self._readings = SensorReadings(plant.sensing, plant.sensor, dt, seed)
        self.truth = plant.measure(0.0, q, v)
        self.measurement = self._read(self.truth)
        self.state = first_state(plant, controller, target, self.measurement)
        late = round(min(plant.actuator_delay / dt, float(steps)))
        self._waiting = deque([plant.dynamics.g(q)] * late)
        self.answer = self._evaluate()

    @property
    def t(self) -> float:
        """Time [s]."""
        return self.truth.t

    @property
    def ended(self) -> bool:
        """Whether there is no further step."""
        return self.stopped or self.step == self.steps

    def advance(self) -> None:
        """Hold the torque for dt, measure, and evaluate the controller.

        Raises:
            SimulationError: The closed loop diverged.
        """
        self._waiting.append(self.answer.torque)
        self.state = self.state + self.dt * self.answer.state_rate
        try:
            torque = self._waiting.popleft()
            q, v = self._integrate(self.plant, self.truth.q, self.truth.v, torque, self.dt)
            as_array("state", self.state, self.state.shape)
            self.step += 1
            self.truth = self.plant.measure(self.step * self.dt, q, v)
        except InvalidInputError as error:
            raise self._diverged(error) from error
        self.measurement = self._read(self.truth)
        self.answer = self._evaluate()

    def aim_at(self, target: Array) -> None:
        """Move the target, from the next step on.

        Raises:
            InvalidInputError: Wrong shape, not finite, or not a value that the sensor has.
        """
        wanted = self.plant.sensor.target(target)
        try:
            self.controller.evaluate(self.state, self.measurement, wanted)
        except MeasurementError as error:
            raise InvalidInputError(
                f"target must be one that the controller can be evaluated with, without an "
                f"overflow, got {wanted.tolist()}",
                given=target,
            ) from error
        self.target = wanted

    def exchange(self, controller: Controller) -> None:
        """Let another controller go on, from the next step on.

        It goes on with the state that there is, such as gravity that was learnt.

        Raises:
            InvalidInputError: A controller of another task, with a state of another length, or
                for another sampling time.
        """
        require_fit(self.plant, controller, self.dt)
        state = first_state(self.plant, controller, self.target, self.measurement)
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

    def _evaluate(self) -> Evaluation:
        try:
            answer = self.controller.evaluate(self.state, self.measurement, self.target)
        except (InvalidInputError, MeasurementError) as error:
            raise self._diverged(error) from error
        # a controller may use one buffer for all its torques, and `aim_at` asks it once more
        return answer._replace(torque=answer.torque.copy())

    def _read(self, truth: Measurement) -> Measurement:
        return truth if self._readings is None else self._readings.read(truth)

    def _diverged(self, error: Exception) -> SimulationError:
        return diverged(self.step * self.dt, self.steps * self.dt, error)


def diverged(t: float, duration: float, error: Exception) -> SimulationError:
    """The error that says that a loop diverged."""
    return SimulationError(
        f"the simulation diverged at t = {t:g} of {duration:g} s: {error} (a smaller dt or smaller "
        "gains may help)",
        given=t,
    )


def first_state(
    plant: Plant, controller: Controller, x_d: Array, measurement: Measurement
) -> Array:
    """Initial state of a controller, after one evaluation whose answer is looked at.

    What is wrong with the arguments or the controller shows here, and not as a divergence.
    """
    state = as_array(
        "the controller's initial_state",
        controller.initial_state(measurement),
        (controller.n_state,),
    )
    answer = controller.evaluate(state, measurement, x_d)
    require("the controller's answer", answer, Evaluation, "an Evaluation")
    as_array("the controller's torque", answer.torque, (plant.robot.nv,), "N m or N")
    as_array("the controller's state_rate", answer.state_rate, state.shape)
    if np.isfinite(measurement.x).all():  # a lost x has no error
        as_array("the controller's e", answer.e, (plant.sensor.m,), plant.sensor.unit)
    return state


def require_fit(plant: Plant, controller: Controller, dt: float | None) -> None:
    """Refuse a controller that is none, of another task, or for another sampling time.

    Raises:
        InvalidInputError: It does not fit.
    """
    if isinstance(controller, type) or not hasattr(controller, "evaluate"):
        raise InvalidInputError(
            f"controller must be a controller, such as SetpointController(...), got {controller!r}",
            given=controller,
        )
    task = getattr(controller, "task", None)
    if isinstance(task, Task):
        plant.require_measured(task)
    wanted = getattr(controller, "dt", None)
    if isinstance(wanted, float) and (
        dt is None or not np.isclose(dt, wanted, rtol=1e-9, atol=0.0)
    ):
        raise InvalidInputError(
            f"dt must be that of the controller, {wanted:g} [s], which keeps limits of torque "
            f"rates, speeds or positions, or a held measurement, from step to step, got {dt!r}",
            given=dt,
        )
