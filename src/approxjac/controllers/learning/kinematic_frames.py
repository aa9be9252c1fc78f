"""Frames of a sensor as they come: late, seldom, lost, or wrong for a moment."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.controllers.arguments import time_of_x, told_ahead
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.interface import Measurement, Status
from approxjac.robots import Robot
from approxjac.validation import Array, as_number

_OK, _PREDICTED = Status.OK, Status.PREDICTED  # members of an enum are slow to look up
_LOST = Status.MEASUREMENT_LOST
_SPACING = 10e-3  # between remembered configurations, from which others are interpolated [s]
_HORIZON = 0.25  # age up to which a frame finds its configuration [s]
_LONG_AGO = -1e6  # [s]
_FOREVER = 1e15  # t of no clock [s]
_AHEAD = 1e-9  # by which a clock is on time [s]
_OTHER = 1.0  # by which it is another one [s]
_CLOSEST = 4e-3  # between frames, below which there is nothing to learn from the second one [s]
_STALE = 1.0  # without a frame to learn from, after which it is said [s]
_FARTHEST = 1e3  # that anything is from the sensor [m]


def parts_of(sizes: Mapping[str, int]) -> tuple[dict[str, slice], int]:
    """Return where parts of a state are, one after the other, and its length."""
    ends = np.cumsum(list(sizes.values())).tolist()
    each = zip(sizes.items(), ends, strict=True)
    return {name: slice(end - size, end) for (name, size), end in each}, ends[-1]


def is_seen(x: Array) -> Array:
    """Return which entries of x are positions, and not lost, shape (n_x,)."""
    return np.asarray(np.abs(x) < _FARTHEST)


def _time(measurement: Measurement) -> float:
    """Return the time of a measurement [s], or refuse it: what is learnt has to be known when."""
    name, most = "t of a measurement", _FOREVER
    return as_number(name, measurement.t, unit="s", minimum=-most, most=most)


def _require_known(measurement: Measurement) -> None:
    """Refuse a first measurement without a time or a configuration."""
    _time(measurement)
    if not np.isfinite(measurement.q).all():
        raise MeasurementError(
            f"q must be finite, got {measurement.q.tolist()}: frames are learnt from with the "
            "configuration of their time",
            given=measurement,
        )


class Frame(NamedTuple):
    """A frame: x (n_x,), NaN where it is lost, when it was taken [s], and q at that time (nq,)."""

    x: Array
    t: float
    q: Array


class Frames:
    """Memory of which x is new, and at which configuration it was taken.

    Its numbers: the last x, when it was taken, where the ring was written last, the last t, by how
    much its own clock is ahead of that, when it last found a frame, and the ring of (t, q). A clock
    t that stands still from step to step is gone on with by dt.

    A frame is new by `Measurement.t_x`, and was taken then. Where that is None or ahead of
    now, it is new by a change of x, and was taken `delay` ago; 1 s ahead is refused. One taken
    before all that the ring remembers is passed over, and so are those faster than at 250 Hz.

    Args:
        robot: The believed robot.
        n_x: Length of x.
        delay: Age of x where `Measurement.t_x` is None [s].
        dt: Sampling time of control [s].
    """

    def __init__(self, robot: Robot, n_x: int, delay: float, dt: float) -> None:
        self._model, self._is_vector = robot.model, robot.nq == robot.nv
        self._delay, self._n_x = delay, n_x
        self._spacing = max(_SPACING, dt)
        self._count = math.ceil(max(_HORIZON, 2.0 * delay) / self._spacing) + 2
        self._width = 1 + robot.nq
        self._head = n_x + 5
        self.size = self._head + self._count * self._width

    def initial(self, measurement: Measurement) -> Array:
        """Return the numbers before the first frame: the arm was at rest; shape (size,)."""
        _require_known(measurement)
        ring = np.empty((self._count, self._width))
        ring[:, 0] = measurement.t + self._spacing * np.arange(1 - self._count, 1)
        ring[:, 1:] = measurement.q
        head = np.zeros(self._head)
        t = measurement.t
        head[self._n_x :] = _LONG_AGO, self._count - 1, t - self._spacing, 0.0, t
        return np.concatenate([head, ring.ravel()])

    def first(self, measurement: Measurement) -> Frame | None:
        """Return the frame that is there before the first step, None if it is lost or too old."""
        return self.new(self.initial(measurement), measurement)

    def on_time(self, numbers: Array, measurement: Measurement, dt: float) -> Measurement:
        """Return a measurement by the own clock, dt [s] after the one before if t stands still."""
        n, t = self._n_x, _time(measurement)
        (last, ahead), t_x = numbers[n + 2 : n + 4].tolist(), time_of_x(measurement.t_x)
        ahead = ahead + dt if t == last else max(ahead - abs(t - last), 0.0)
        numbers[n + 2 : n + 4] = t, ahead
        if told := told_ahead(t + ahead, t_x, _OTHER):
            raise InvalidInputError(f"t_x must be by the clock of t: {told}", given=measurement)
        t_x = None if t_x is None else t_x + ahead
        return Measurement(t + ahead, measurement.q, measurement.v, measurement.x, t_x)

    def silence(self, numbers: Array) -> float:
        """Return for how long there was no frame to learn from [s]."""
        t, ahead, found = numbers[self._n_x + 2 : self._head].tolist()
        return float(max(t + ahead - found, 0.0))

    def status(self, numbers: Array, measurement: Measurement, has_begun: bool) -> Status:
        """Return what may be done by a state (see `Kinematics`) that has seen x, or has not."""
        if not has_begun:
            return _LOST
        if measurement.t_x is None or self.silence(numbers) <= _STALE:
            return _OK
        return _PREDICTED

    def remember(self, numbers: Array, measurement: Measurement) -> bool:
        """Write the configuration at hand into the ring, if it is time.

        Returns:
            Whether it was, or time does not pass.
        """
        n, head = self._n_x, self._head
        if not 0.0 <= numbers[n + 1] < self._count:
            raise InvalidInputError(
                "state must be one that initial_state, resumed or step returned: its frames are "
                f"counted from 0 to {self._count - 1}, got {numbers[n + 1]:g}",
                given=numbers,
            )
        last = int(numbers[n + 1])
        since = measurement.t - numbers[head + last * self._width]
        if since >= self._spacing - 1e-9:
            last = (last + 1) % self._count
            at = head + last * self._width
            numbers[at] = measurement.t
            numbers[at + 1 : at + self._width] = measurement.q
            numbers[n + 1] = last
            return True
        if since < -1e-9:  # time starts anew
            numbers[:] = self.initial(measurement)
        return bool(since < 1e-9)

    def new(self, numbers: Array, measurement: Measurement) -> Frame | None:
        """Return the frame if it is new, and note it; `remember` comes first."""
        n = self._n_x
        t, _, _, x, t_x = measurement
        is_told = t_x is not None and t_x <= t + _AHEAD
        if t_x is not None and is_told:
            taken, is_old = min(t_x, t), t_x <= numbers[n]
        else:  # a clock that is ahead is wrong, and would say of one frame that it is always new
            taken, is_old = t - self._delay, x.tolist() == numbers[:n].tolist()
        has_last = numbers[n] > _LONG_AGO
        if (is_old and has_last) or 0.0 < taken - numbers[n] < _CLOSEST - 1e-9:
            return None
        seen = is_seen(x)
        known = np.where(seen, x, 0.0)
        if not seen.any() or (has_last and not is_told and np.array_equal(known, numbers[:n])):
            return None
        numbers[:n], numbers[n] = known, taken
        q = self._at(numbers, taken, measurement)
        if q is None:
            return None
        numbers[n + 4] = t
        return Frame(np.where(seen, x, np.nan), taken, q)

    def _at(self, numbers: Array, t: float, measurement: Measurement) -> Array | None:
        """Return the configuration at a time [s], None if that is longer ago than the ring is."""
        ring = numbers[self._head :].reshape(self._count, self._width)
        order = (int(numbers[self._n_x + 1]) + 1 + np.arange(self._count)) % self._count
        times = ring[order, 0]
        after = int(np.searchsorted(times, t))
        if after == 0:
            return None
        t_0, q_0 = times[after - 1], ring[order[after - 1], 1:]
        if after < self._count:
            t_1, q_1 = times[after], ring[order[after], 1:]
        else:
            t_1, q_1 = measurement.t, measurement.q
        share = 1.0 if t_1 - t_0 < 1e-9 else min((t - t_0) / (t_1 - t_0), 1.0)
        if self._is_vector:
            return np.asarray(q_0 + share * (q_1 - q_0))
        return np.array(pin.interpolate(self._model, np.array(q_0), np.array(q_1), share))


class Gate:
    """Tells a sensor that jumps from an arm that moves.

    From one frame to the next that is believed, x moves by no more than the arm does. One that
    moves farther is passed over, and so are all until x is back; but if it stays, and frames agree
    with each other, the sensor is believed: it was moved.

    Its numbers: frames passed over in a row, then of the last frame that was believed and of the
    last one that was not: configuration, x, and 1 for each entry of x that was seen at it.

    Args:
        robot: The believed robot.
        n_x: Length of x.
        jump: By how much x may change wherever the arm is, so that nobody need ask.
    """

    PASSED_OVER = 8
    """Frames in a row that agree after which the sensor is believed."""

    def __init__(self, robot: Robot, n_x: int, jump: float = 0.0) -> None:
        self._nq, self._n_x, self._jump = robot.nq, n_x, jump
        self._width = robot.nq + 2 * n_x
        self.size = 1 + 2 * self._width

    def initial(self) -> Array:
        """Return the numbers before the first frame, shape (size,)."""
        return np.zeros(self.size)

    def judge(
        self, numbers: Array, frame: Frame, moved: Callable[[Array, Array], Array]
    ) -> tuple[bool, bool]:
        """Return whether to believe a frame, and whether it is the first after the sensor moved.

        Args:
            numbers: As before; what is judged is noted.
            frame: The frame.
            moved: moved(q_0, q) → how far each entry of x may move between configurations, (n_x,).
        """
        believed, other = numbers[1:].reshape(2, -1)
        fits = self._fits(believed, frame, moved)
        if not fits:
            agrees = numbers[0] > 0.0 and self._fits(other, frame, moved)
            numbers[0] = numbers[0] + 1.0 if agrees else 1.0
            self._note(other, frame)
            if numbers[0] < self.PASSED_OVER:
                return False, False
        numbers[0] = 0.0
        self._note(believed, frame)
        return True, not fits

    def _fits(self, last: Array, frame: Frame, moved: Callable[[Array, Array], Array]) -> bool:
        """Return whether x is where it may be after the last frame; where none was, it may be."""
        nq, n = self._nq, self._nq + self._n_x
        compared = (last[n:] > 0.0) & np.isfinite(frame.x)
        change = np.where(compared, np.abs(frame.x - last[nq:n]), 0.0)
        if change.max() <= self._jump:  # which is usual
            return True
        return bool((change <= moved(last[:nq], frame.q)).all())

    def _note(self, where: Array, frame: Frame) -> None:
        n, seen = self._nq, np.isfinite(frame.x)
        where[:n] = frame.q
        where[n : n + self._n_x][seen] = frame.x[seen]
        where[n + self._n_x :] = seen
