"""`HeldCommands`: what a controller commands, on its way to the motors in one run."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from approxjac.simulation.plant import Plant
from approxjac.validation import Array

_STEP = 1e-3  # of the arm under a servo, at most [s]
_TINY = 1e-6  # of a step: more than round-off, less than anyone means


class HeldCommands:
    """Commands of one run: torques, late; or velocities, taken at the servo's period and late.

    Args:
        plant: What takes them.
        q: Configuration at the start, shape (nq,).
        dt: Sampling time of the controller [s].
        samples: Number of samples of the run.

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
        """Return what acts over the next sample, one after the other for h [s] each."""
        return [self._next(command) for _ in range(self._per_sample)]

    def _next(self, command: Array) -> Array:
        # counted from the start, so that no rounding adds up
        number = math.floor(self._steps * self._taken_per_step + _TINY)
        if number != self._number:
            self._number, self._taken = number, command
        self._steps += 1
        self._waiting.append(self._taken)
        return self._waiting.popleft()
