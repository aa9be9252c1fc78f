"""`SimulatedDriver`: a plant behind the interface of a robot, to rehearse with."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from approxjac.controllers import Limits
from approxjac.interface import Measurement
from approxjac.realtime.scheduling import Pace
from approxjac.simulation.plant import Plant
from approxjac.simulation.simulate import MovingArm
from approxjac.validation import Array, as_integer, as_number, require

_CATCH_UP = 50  # periods for which an arm moves on without a command


class SimulatedDriver(MovingArm):
    """A plant as a robot: with its sensors, its delays, a clock, and a brake.

    In real time the arm does not wait: if a command is late, the last one continues.

    Args:
        plant: The true robot: a `Plant`, or a `MujocoPlant` with friction and a floor.
        q0: Start configuration, shape (nq,); `plant.ready_configuration()` by default.
        dt: Period [s].
        pace: Simulated seconds per second of real time; infinite for as fast as possible.
        seed: Seed of the sensors' noise, ≥ 0.

    Attributes:
        t: Simulated time [s].
        q: True configuration, shape (nq,).
        v: True joint velocity, shape (n_v,).
        braked: True if the brake is closed, so that the arm is at rest.
    """

    def __init__(
        self,
        plant: Plant,
        q0: Sequence[float] | Array | None = None,
        *,
        dt: float = 1e-3,
        pace: float = 1.0,
        seed: int = 0,
    ) -> None:
        require("plant", plant, Plant, "a Plant")
        dt, seed = as_number("dt", dt, unit="s", above=0.0), as_integer("seed", seed, 0)
        robot = plant.robot
        q = robot.configuration(plant.ready_configuration() if q0 is None else q0, "q0")
        rest = np.zeros(robot.nv)
        super().__init__(plant, np.array(q), rest, dt, "semi_implicit_euler", seed)
        self.command: Literal["torque", "velocity"] = plant.command
        self.limits = Limits(effort=plant.motor_limits)
        self.adds_gravity = plant.adds_gravity is not None
        self._pace = None
        if pace != math.inf:
            self._pace = Pace(dt / as_number("pace", pace, above=0.0))
        self._command: Array | None = None  # until the first one the arm stands on its brake
        self.braked = False

    def read(self) -> Measurement:
        """Wait for the next period and return its measurement."""
        periods = 1 if self._pace is None else min(self._pace.wait(), _CATCH_UP)
        for _ in range(periods):
            measured = self._period()
        return measured

    def advance(self, duration: float) -> None:
        """Simulate for a duration [s] with the last command, as while the loop does not read."""
        for _ in range(round(duration / self.dt)):
            self._period()

    def send(self, command: Array) -> None:
        """Accept a command, which acts until the next one."""
        self._command = np.array(command, dtype=float)

    def brake(self) -> None:
        """Hold the arm where it is."""
        self.braked = True

    def _period(self) -> Measurement:
        if self.braked or self._command is None:
            self.v = np.zeros_like(self.v)
            if self.motors is not None:
                self.motors = self.motors._replace(rate=self.v)
            self.move([])
        else:
            self.move(self.take(self._command))
        return self.sense()[1]
