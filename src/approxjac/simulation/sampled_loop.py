"""`SampledLoop`: a plant and a controller as a robot runs them, step by step."""

from __future__ import annotations

from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.simulation.held_commands import HeldCommands
from approxjac.simulation.integrators import INTEGRATORS
from approxjac.simulation.loop import Loop
from approxjac.simulation.plant import Plant
from approxjac.simulation.sensing import SensorReadings
from approxjac.simulation.targets import Wanted, diverged, first_state
from approxjac.validation import Array


class SampledLoop(Loop):
    """A closed loop whose command is held over dt (zero-order hold).

    `simulate` runs it. An observer gets it after every step of the controller; what it does not
    touch is the same to the last bit as without it.

    Attributes:
        integrator: Of the plant.
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
        super().__init__(plant, controller, path, dt, steps)
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
