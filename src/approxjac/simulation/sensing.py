"""What sensors and drives really deliver: noise, delay, quantisation, dropouts, no tachometer."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from approxjac.checks import Array, as_diagonal, as_number, shape_of
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement
from approxjac.tasks import Task

_FOREVER = 1e15  # samples


@dataclass(frozen=True, eq=False)
class Sensing:
    """How the measurements differ from the truth. Everything is off by default.

    The task value gets noise, is rounded, arrives late and is sometimes lost; the encoders get
    noise and are rounded; and q̇ may come from differences of the measured q instead of a
    tachometer, as the paper recommends for x.

    Attributes:
        x_noise: Standard deviation of white noise on the task coordinates, a number or shape
            (m,) [unit of the task].
        x_quantum: Steps that they are rounded to, a number or shape (m,) [unit of the task].
        x_delay: Age of x when it arrives [s]; rounded to whole samples.
        x_dropout: Probability that a sample of x is lost, from 0 to 1.
        q_noise: Standard deviation of white noise on q, a number or shape (n_v,) [rad or m].
        q_quantum: Steps of the encoders, a number or shape (n_v,) [rad or m].
        velocity_filter: Time constant T of q̇ from differences of the measured q,
            T dq̇/dt + q̇ = Δq/dt [s], from q̇ = 0 at the first sample; 0 does not filter. None is an
            exact tachometer.

    Raises:
        InvalidInputError: Negative or not finite, or a probability above 1.
    """

    x_noise: float | Sequence[float] | Array = 0.0
    x_quantum: float | Sequence[float] | Array = 0.0
    x_delay: float = 0.0
    x_dropout: float = 0.0
    q_noise: float | Sequence[float] | Array = 0.0
    q_quantum: float | Sequence[float] | Array = 0.0
    velocity_filter: float | None = None

    def __post_init__(self) -> None:
        for name in ("x_noise", "x_quantum", "q_noise", "q_quantum"):
            value = getattr(self, name)
            as_diagonal(name, value, math.prod(shape_of(value)), positive=False)
        as_number("x_delay", self.x_delay, unit="s", minimum=0.0)
        if as_number("x_dropout", self.x_dropout, minimum=0.0) > 1.0:
            raise InvalidInputError(
                f"x_dropout must be a probability from 0 to 1, got {self.x_dropout!r}",
                given=self.x_dropout,
            )
        if self.velocity_filter is not None:
            as_number("velocity_filter", self.velocity_filter, unit="s", minimum=0.0)

    @property
    def is_linear(self) -> bool:
        """Whether it does no more than delay x and filter q̇: nothing random, nothing rounded."""
        others = (self.x_noise, self.x_quantum, self.x_dropout, self.q_noise, self.q_quantum)
        return not any(np.any(value) for value in others)


class SensorReadings:
    """The readings of one run, sample by sample; the same seed gives the same ones.

    Args:
        sensing: The imperfections.
        task: The task that is measured.
        dt: Sampling time [s].
        seed: Of the noise and the dropouts.

    Raises:
        InvalidInputError: A number of entries that fits neither the task nor the robot.
    """

    def __init__(self, sensing: Sensing, task: Task, dt: float, seed: int) -> None:
        m, nv = task.m, task.robot.nv
        self._task, self._model, self._dt = task, task.robot.model, dt
        self._neutral = task.robot.neutral()
        self._x_noise = as_diagonal("x_noise", sensing.x_noise, m, positive=False)
        self._x_quantum = as_diagonal("x_quantum", sensing.x_quantum, m, positive=False)
        self._q_noise = as_diagonal("q_noise", sensing.q_noise, nv, positive=False)
        self._q_quantum = as_diagonal("q_quantum", sensing.q_quantum, nv, positive=False)
        self._dropout, self._filter = sensing.x_dropout, sensing.velocity_filter
        late = round(min(sensing.x_delay / dt, _FOREVER))
        self._late: deque[Array] = deque(maxlen=late + 1)
        self._rng = np.random.default_rng(seed)
        self._before: Array | None = None
        self._v = np.zeros(nv)

    def read(self, truth: Measurement) -> Measurement:
        """Return what is measured at the next sample, given what is true then."""
        q = self._read_q(truth.q)
        v = truth.v if self._filter is None else self._difference(q, self._filter)
        return Measurement(truth.t, q, v, self._read_x(truth.x))

    def _read_x(self, x: Array) -> Array:
        if self._x_noise.any():
            x = self._task.displaced(x, self._x_noise * self._rng.standard_normal(self._task.m))
        if self._x_quantum.any():
            origin = self._task.origin
            x = self._task.displaced(origin, _rounded(self._task.error(x, origin), self._x_quantum))
        self._late.append(x)  # before the first one arrives, the first is seen
        if self._dropout and self._rng.random() < self._dropout:
            return np.full(self._task.n_x, np.nan)
        return self._late[0]

    def _read_q(self, q: Array) -> Array:
        if self._q_noise.any():
            noise = self._q_noise * self._rng.standard_normal(len(self._q_noise))
            q = pin.integrate(self._model, q, noise)
        if self._q_quantum.any():
            motion = pin.difference(self._model, self._neutral, q)
            q = pin.integrate(self._model, self._neutral, _rounded(motion, self._q_quantum))
        return q

    def _difference(self, q: Array, time_constant: float) -> Array:
        if self._before is not None:
            slope = pin.difference(self._model, self._before, q) / self._dt
            self._v = self._v + self._dt / (time_constant + self._dt) * (slope - self._v)
        self._before = q
        return self._v


def _rounded(values: Array, steps: Array) -> Array:
    """Round to multiples of steps; a step of 0 rounds nothing."""
    safe = np.where(steps > 0.0, steps, 1.0)
    return np.where(steps > 0.0, safe * np.round(values / safe), values)
