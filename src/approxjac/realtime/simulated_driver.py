"""`SimulatedDriver`: a plant behind the interface of a robot, to rehearse with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from approxjac.controllers import Limits
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement
from approxjac.realtime.scheduling import Pace
from approxjac.robots import Dynamics, Robot
from approxjac.simulation.plant import INTEGRATORS, Plant
from approxjac.simulation.sensing import SensorReadings
from approxjac.simulation.simulate import HeldCommands
from approxjac.validation import Array, as_integer, as_number, require

_LONGEST = 1e5  # s, of one run
_CATCH_UP = 50  # periods that an arm goes on without a command


class SimulatedDriver:
    """A plant as a robot: with its sensors, its delays, a clock, and a brake.

    In real time the arm does not wait: where a command is late, it goes on with the one before.

    Args:
        plant: The true robot: a `Plant`, or a `MujocoPlant` with friction and a floor.
        q0: Start configuration, shape (nq,); `plant.ready_configuration()` by default.
        dt: Period [s].
        adds_gravity: The robot by whose model it adds gravity to the torques that it is sent, such
            as that of a Franka without a tool; None adds none.
        pace: Seconds that pass in the plant in one of the clock's on the wall; infinite for as
            fast as it goes.
        seed: Of the sensors' noise, ≥ 0.

    Attributes:
        t: Its time now [s].
        q: Its true configuration now.
        v: Its true joint velocity now.
        braked: Whether the brake is closed; the arm then stands still.
    """

    def __init__(
        self,
        plant: Plant,
        q0: Sequence[float] | Array | None = None,
        *,
        dt: float = 1e-3,
        adds_gravity: Robot | None = None,
        pace: float = 1.0,
        seed: int = 0,
    ) -> None:
        require("plant", plant, Plant, "a Plant")
        robot = plant.robot
        if adds_gravity is not None and (plant.adds_gravity or plant.servo) is not None:
            raise InvalidInputError(
                "adds_gravity must be None of a plant that adds gravity by itself, or has a servo, "
                f"got {adds_gravity.name} with {plant!r}",
                given=adds_gravity,
            )
        self.plant, self.dt = plant, as_number("dt", dt, unit="s", above=0.0)
        self.command: Literal["torque", "velocity"] = plant.command
        q = robot.configuration(plant.ready_configuration() if q0 is None else q0, "q0")
        self.q, self.v = np.array(q), np.zeros(robot.nv)
        self.limits = Limits(effort=plant.motor_limits)
        self.adds_gravity = (adds_gravity or plant.adds_gravity) is not None
        self._gravity = None if adds_gravity is None else Dynamics(adds_gravity)
        self._pace = None
        if pace != math.inf:
            self._pace = Pace(self.dt / as_number("pace", pace, above=0.0))
        self._readings = None
        if plant.sensing is not None:
            seed = as_integer("seed", seed, 0)
            self._readings = SensorReadings(plant.sensing, plant.sensor, self.dt, seed)
        self._step = INTEGRATORS["semi_implicit_euler"]
        self._commands = HeldCommands(plant, self.q, self.dt, round(_LONGEST / self.dt))
        self._command: Array | None = None  # until the first one the arm stands on its brake
        self._count, self.braked = 0, False

    @property
    def t(self) -> float:
        """Its time [s]."""
        return self._count * self.dt

    def read(self) -> Measurement:
        """Wait for the next period and return what is measured then."""
        periods = 1 if self._pace is None else min(self._pace.wait(), _CATCH_UP)
        for _ in range(periods):
            measured = self._next()
        return measured

    def go_on(self, duration: float) -> None:
        """Let the arm go on with the last command, as it does while nobody reads [s]."""
        for _ in range(round(duration / self.dt)):
            self._next()

    def send(self, command: Array) -> None:
        """Take a command for the periods until the next one."""
        self._command = np.array(command, dtype=float)

    def brake(self) -> None:
        """Hold the arm where it is."""
        self.braked = True

    def _next(self) -> Measurement:
        self._advance()
        self._count += 1
        truth = self.plant.measure(self.t, self.q, self.v)
        return truth if self._readings is None else self._readings.read(truth)

    def _advance(self) -> None:
        if self.braked or self._command is None:
            self.v = np.zeros_like(self.v)
            return
        command = self._command
        if self._gravity is not None:
            command = command + self._gravity.g(self.q)
        for acting in self._commands.acting(command):
            self.q, self.v = self.plant.advance(
                self.q, self.v, acting, self._commands.h, self._step
            )
