"""`Frames`: which frame of x is taken and which one arrives, sample by sample."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

_FOREVER = 1e15  # samples
_TINY = 1e-6  # of a frame or a sample: more than round-off in k dt, less than anyone means


class Frame(NamedTuple):
    """Work of a camera at one sample.

    Attributes:
        is_taken: Whether it takes an image now.
        kept_at: Place of the image that it took last.
        lost: Numbers of the intervals in which x is lost that the one it takes now is taken in.
        read_at: Place of the image that arrives.
        is_new: Whether that arrives now, or is read again.
        t_x: Time at which that was taken [s].
    """

    is_taken: bool
    kept_at: int
    lost: list[int]
    read_at: int
    is_new: bool
    t_x: float


class Frames:
    """The frames of one run, which time alone decides: the same in all runs.

    Images have places, which are taken again once nobody will read what is there.

    Args:
        dt: Sampling time [s].
        x_rate: As of `Sensing`, like all below.
        x_delay: Age of a frame that arrives [s].
        lost: Intervals (start, end) [s].
        frozen: Intervals (start, end) [s].
    """

    def __init__(
        self,
        dt: float,
        x_rate: float | None,
        x_delay: float,
        lost: Sequence[tuple[float, float]],
        frozen: Sequence[tuple[float, float]],
    ) -> None:
        self._dt, self._lost, self._frozen = dt, lost, frozen
        per_sample = None if x_rate is None else x_rate * dt
        self._per_sample = None if per_sample is None or per_sample > 1.0 - _TINY else per_sample
        late = round(min(x_delay / dt, _FOREVER))
        self._places = late + 1
        if self._per_sample is not None:  # those that are taken while one is on its way
            self._places = min(self._places, math.ceil(late * self._per_sample) + 2)
        self._late: deque[tuple[int, int, float]] = deque(maxlen=late + 1)
        self._samples, self._number, self._arrived, self._taken = 0, -1, -1, 0
        self._kept_at, self._taken_at = 0, 0.0

    def next(self, t: float) -> Frame:
        """Return what happens at the next sample, at time t [s]."""
        number = self._samples
        if self._per_sample is not None:  # counted from the start, so that no rounding adds up
            number = math.floor(self._samples * self._per_sample + _TINY)
        self._samples += 1
        lost: list[int] = []
        is_taken = number != self._number
        if is_taken and self._frozen and self._taken:
            is_taken = not self._within(t, self._frozen)
        self._number = number
        if is_taken:
            self._kept_at, self._taken_at = self._taken % self._places, t
            self._taken += 1
            lost = self._within(t, self._lost) if self._lost else lost
        self._late.append((number, self._kept_at, self._taken_at))
        arriving, read_at, t_x = self._late[0]  # before the first one arrives, the first is seen
        is_new = arriving != self._arrived or self._per_sample is None
        self._arrived = arriving
        return Frame(is_taken, self._kept_at, lost, read_at, is_new, t_x)

    def _within(self, t: float, intervals: Sequence[tuple[float, float]]) -> list[int]:
        """Return the numbers of the intervals that a time [s] is in."""
        t += _TINY * self._dt
        return [i for i, (start, end) in enumerate(intervals) if start <= t < end]
