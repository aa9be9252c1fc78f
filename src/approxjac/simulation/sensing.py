"""Realistic sensing: noise, delay, quantization, dropouts, frames, no tachometer."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.formatting import short_fields
from approxjac.interface import Measurement
from approxjac.robots import Robot
from approxjac.robots.traced import motion_between, moved
from approxjac.tasks import Task
from approxjac.tasks.analysis import with_error
from approxjac.validation import Array, as_delay, as_diagonal, as_number

DRAWN = ("x_noise", "q_noise", "x_dropout")  # names of what is drawn while a run goes on


@dataclass(frozen=True, eq=False, repr=False)
class Sensing:
    """Errors of the measurements. All are off by default.

    Each sample of x is a frame. With an `x_rate`, frame k is taken at the first control sample at
    or after k/x_rate, and its x is repeated, bit by bit, until the next one arrives. Noise,
    rounding and dropout apply once per frame.

    Attributes:
        x_noise: Standard deviation of white noise on the task coordinates, a number or shape
            (m,) [unit of the task].
        x_quantum: Rounding steps of the task coordinates, likewise.
        x_delay: Age of x when it arrives [s]; rounded to whole samples of control.
        x_dropout: Probability that a frame of x is lost, from 0 to 1: NaN until the next arrives.
        q_noise: Standard deviation of white noise on q, a number or shape (n_v,) [rad or m].
        q_quantum: Rounding steps of the encoders, likewise.
        velocity_filter: Time constant T of q̇ from differences of the measured q,
            T dq̇/dt + q̇ = Δq/dt [s], from q̇ = 0 at the first sample; 0 does not filter. None is an
            exact tachometer.
        x_rate: Frames of x per second [Hz]; None takes one at each control sample.
        x_lost: Intervals (start, end) [s] in which x is lost, or (start, end, part) for one part
            of a task with several, counted from 0.
        x_frozen: Intervals (start, end) [s] in which the last frame is repeated.

    Raises:
        InvalidInputError: Negative or not finite, delays above 10 s, or a probability above 1.
    """

    x_noise: float | Sequence[float] | Array = 0.0
    x_quantum: float | Sequence[float] | Array = 0.0
    x_delay: float = 0.0
    x_dropout: float = 0.0
    q_noise: float | Sequence[float] | Array = 0.0
    q_quantum: float | Sequence[float] | Array = 0.0
    velocity_filter: float | None = None
    x_rate: float | None = None
    x_lost: Sequence[tuple[float, float] | tuple[float, float, int]] = ()
    x_frozen: Sequence[tuple[float, float]] = ()
    __repr__ = short_fields

    def __post_init__(self) -> None:
        for name in ("x_noise", "x_quantum", "q_noise", "q_quantum"):
            as_diagonal(name, getattr(self, name), positive=False)
        as_delay("x_delay", self.x_delay)
        as_number("x_dropout", self.x_dropout, minimum=0.0, most=1.0)
        if self.velocity_filter is not None:
            as_delay("velocity_filter", self.velocity_filter)
        if self.x_rate is not None:
            as_number("x_rate", self.x_rate, unit="Hz", above=0.0)
        lost = _intervals("x_lost", self.x_lost, parts=True)
        vars(self).update(x_lost=lost, x_frozen=_intervals("x_frozen", self.x_frozen, parts=False))

    @property
    def is_linear(self) -> bool:
        """True if it only delays x and filters q̇: nothing is random, rounded or repeated."""
        if self.x_rate is not None or self.x_lost or self.x_frozen:
            return False
        others = (self.x_noise, self.x_quantum, self.x_dropout, self.q_noise, self.q_quantum)
        return not any(np.any(value) for value in others)

    def sizes(self, task: Task) -> tuple[Array, ...]:
        """Return noise and quantum of a task's x (m,), noise and quantum of q (n_v,)."""
        sizes = {"x_noise": task.m, "x_quantum": task.m}
        sizes |= dict.fromkeys(("q_noise", "q_quantum"), task.robot.nv)
        given = ((name, getattr(self, name), size) for name, size in sizes.items())
        return tuple(as_diagonal(*each, positive=False) for each in given)


class SensorReadings:
    """The readings of one run, sample by sample; the same seed gives the same ones.

    Random numbers depend on time alone: each kind has a generator of its own, see `generator`.
    """

    def __init__(self, sensing: Sensing, task: Task, dt: float, seed: int) -> None:
        self._task, self._dt = task, dt
        self._x_noise, self._x_quantum, self._q_noise, self._q_quantum = sensing.sizes(task)
        self._x_noisy, self._q_noisy = self._x_noise.any(), self._q_noise.any()
        self._dropout, self._filter = sensing.x_dropout, sensing.velocity_filter
        self._lost = lost_entries(sensing, task)
        self._frames = SensorFrames(sensing, dt)
        self._images: dict[int, Array] = {}
        self._reading = np.full(task.n_x, np.nan)
        self._of_x, self._of_q, self._of_dropouts = (generator(seed, kind) for kind in DRAWN)
        self._before: Array | None = None
        self._v = np.zeros(task.robot.nv)

    def read(self, truth: Measurement) -> Measurement:
        """Return the measurement at the next sample, given what is true then."""
        noise = None
        if self._q_noisy:
            noise = self._q_noise * self._of_q.standard_normal(len(self._q_noise))
        q = encoded(self._task.robot, truth.q, noise, self._q_quantum)
        v = truth.v
        if self._filter is not None:
            if self._before is not None:
                slope = motion_between(self._task.robot, self._before, q) / self._dt
                self._v = filtered(self._v, slope, self._filter, self._dt)
            self._before, v = q, self._v
        frame = self._frames.next(truth.t)
        if frame.is_taken:
            noisy = self._x_noisy
            noise = self._x_noise * self._of_x.standard_normal(self._task.m) if noisy else None
            image = np.array(imaged(self._task, truth.x, noise, self._x_quantum))
            for interval in frame.lost:
                image[self._lost[interval]] = np.nan
            self._images[frame.kept_at] = image
        if frame.is_new:
            lost = self._dropout and self._of_dropouts.random() < self._dropout
            image = self._images[frame.read_at]
            self._reading = np.full(self._task.n_x, np.nan) if lost else image
        return Measurement(truth.t, q, v, self._reading, frame.t_x)


def generator(seed: int, kind: str) -> np.random.Generator:
    """Return the random generator of one of `DRAWN` in the run of a seed.

    A run draws m normal numbers for each frame of x that is taken, n_v for each sample of q, and a
    number from 0 to 1 for each frame that arrives: they may be drawn in blocks.
    """
    i = DRAWN.index(kind)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(i,) if i else ()))


def encoded(robot: Robot, q: Array, noise: Array | None, quantum: Array) -> Array:
    """Return q (nq,) as encoders deliver it, with noise and steps (n_v,)."""
    if noise is not None:
        q = moved(robot, q, noise)
    if quantum.any():
        neutral = robot.neutral()
        q = moved(robot, neutral, rounded(motion_between(robot, neutral, q), quantum))
    return q


def imaged(task: Task, x: Array, noise: Array | None, quantum: Array) -> Array:
    """Return x (n_x,) as a sensor delivers it, with noise and steps (m,) of its error."""
    if noise is not None:
        x = task.displaced(x, noise)
    if quantum.any():
        origin = task.origin
        x = with_error(task, x, origin, rounded(task.error(x, origin), quantum))
    return x


def rounded(values: Array, steps: Array) -> Array:
    """Round to multiples of steps; 0 is no rounding."""
    safe = np.where(steps > 0.0, steps, 1.0)
    return np.where(steps > 0.0, safe * np.rint(values / safe), values)


def filtered(v: Array, slope: Array, time_constant: float, dt: float) -> Array:
    """Return v of T dv/dt + v = slope after a step dt [s], by implicit Euler."""
    return v + dt / (time_constant + dt) * (slope - v)


def lost_entries(sensing: Sensing, task: Task) -> list[slice]:
    """Return the entries of x that are lost in each of the intervals `x_lost`."""
    parts = task.parts
    wrong = [i for _, _, *part in sensing.x_lost for i in part if i >= len(parts)]
    if wrong:
        raise InvalidInputError(
            f"part of x_lost must be one of the {len(parts)} of {task!r}, counted from 0, got "
            f"{wrong[0]}",
            given=wrong[0],
        )
    return [parts[part[0]][0] if part else slice(None) for _, _, *part in sensing.x_lost]


def _intervals(name: str, value: Any, *, parts: bool) -> tuple[Any, ...]:
    try:
        intervals = [(start, end, *part) for start, end, *part in value]
        if not all(type(i) is int and i >= 0 for _, _, *part in intervals for i in part):
            raise TypeError
        if any(len(interval) > 2 + parts for interval in intervals):
            raise TypeError
    except (TypeError, ValueError):
        wanted = "(start, end) or (start, end, part)" if parts else "(start, end)"
        message = f"{name} must be intervals {wanted}, such as [(1.0, 2.5)] [s], got {value!r}"
        raise InvalidInputError(message, given=value) from None
    checked = []
    for start, end, *part in intervals:
        start = as_number(f"start of {name}", start, unit="s")
        checked.append((start, as_number(f"end of {name}", end, unit="s", above=start), *part))
    return tuple(checked)


_FOREVER = 1e15  # samples
_TINY = 1e-6  # of a frame or a sample: more than round-off in k dt, less than anyone means


class SensorFrame(NamedTuple):
    """Frames taken by, and arriving from, a sensor at one control sample."""

    is_taken: bool
    kept_at: int  # the place of the image that it took last
    lost: list[int]  # numbers of the intervals of `x_lost` that it is in
    read_at: int  # the place of the image that arrives
    is_new: bool  # or is read again
    t_x: float  # when that was taken [s]


class SensorFrames:
    """The frames of one run; their timing is the same in all runs.

    Frames are kept in slots, which are reused once they will not be read any more.
    """

    def __init__(self, sensing: Sensing, dt: float) -> None:
        self._dt, self._frozen = dt, sensing.x_frozen
        self._lost = [(start, end) for start, end, *_ in sensing.x_lost]
        per_sample = None if sensing.x_rate is None else sensing.x_rate * dt
        self._per_sample = None if per_sample is None or per_sample > 1.0 - _TINY else per_sample
        late = round(min(sensing.x_delay / dt, _FOREVER))
        self._places = late + 1
        if self._per_sample is not None:  # those that are taken while one is on its way
            self._places = min(self._places, math.ceil(late * self._per_sample) + 2)
        self._late: deque[tuple[int, int, float]] = deque(maxlen=late + 1)
        self._samples, self._number, self._arrived, self._taken = 0, -1, -1, 0
        self._kept_at, self._taken_at = 0, 0.0

    def next(self, t: float) -> SensorFrame:
        """Advance to the next sample, at time t [s]."""
        number = self._samples
        if self._per_sample is not None:  # counted from the start, so that no rounding adds up
            number = math.floor(self._samples * self._per_sample + _TINY)
        self._samples += 1
        is_taken = number != self._number
        if self._frozen and self._taken and self._within(t, self._frozen):
            is_taken = False
        self._number = number
        lost = self._within(t, self._lost) if is_taken and self._lost else []
        if is_taken:
            self._kept_at, self._taken_at = self._taken % self._places, t
            self._taken += 1
        self._late.append((number, self._kept_at, self._taken_at))
        arriving, read_at, t_x = self._late[0]  # before the first one arrives, the first is seen
        is_new = arriving != self._arrived or self._per_sample is None
        self._arrived = arriving
        return SensorFrame(is_taken, self._kept_at, lost, read_at, is_new, t_x)

    def _within(self, t: float, intervals: Sequence[tuple[float, float]]) -> list[int]:
        t += _TINY * self._dt
        return [i for i, (start, end) in enumerate(intervals) if start <= t < end]
