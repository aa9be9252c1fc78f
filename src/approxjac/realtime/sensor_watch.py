"""`SensorWatch`: the measured task value held against the joints' motion, frame by frame."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.interface import Measurement
from approxjac.realtime.accuracy import Accuracy
from approxjac.realtime.faults import Fault
from approxjac.tasks import Task
from approxjac.tasks.frame_kinematics import FrameKinematics
from approxjac.validation import Array

_SIGMAS = 7.0  # of lengths, of up to three coordinates
_KEPT = 512  # periods for which q is remembered: frames may be as old
_SPANS = (0.03, 0.06, 0.12, 0.25)  # over which frames are compared [s]
_APART = 4e-3  # s, between frames that are kept
_FRAMES = 3.0  # periods of x for which the same one may be told

_IMAGE = 0.5  # share of Ĵ by which an image may move otherwise than is believed


class _Frame(NamedTuple):
    """One value of x, and what is believed of the instant it was taken at."""

    t: float
    x: Array
    x_hat: Array
    path: float  # ∫‖q̇‖ dt until then
    rotation: Array  # of the tip link in the axes of x, shape (3, 3)
    x_d: Array  # the target when it came


class SensorWatch:
    """Hold x and q against each other.

    x̂ = h(q) of the believed robot is only roughly right. A tip that lies elsewhere on its link by d
    moves from one configuration to another by (R' − R) d more; so motions between two frames are
    off by

        7√2 σ + ℓ ‖R' − R‖ + κ ‖Ĵ‖ ∫‖q̇‖ dt

    at most, with σ the largest noise, ℓ and κ those of `Accuracy` (`tool`, `jacobian`) and ‖Ĵ‖ the
    largest singular value. Of that, (R' − R) d is square to the axis about which the link has
    turned: a tool explains nothing along it. Coordinates of different units are looked at apart.
    Where kinematics are learnt, the sensor may be turned: lengths of motions are compared then.

    Args:
        task: The controller's task.
        dt: Period [s].
        accuracy: Of x and Ĵ.
        unseen: How far the tip may move while x is lost, shape (m,) [unit of the task].
        is_learnt: Whether the controller learns where the sensor is.
    """

    def __init__(
        self, task: Task, dt: float, accuracy: Accuracy, unseen: Array, is_learnt: bool
    ) -> None:
        self._task, self._dt, self._unseen = task._measured, dt, unseen
        self._is_learnt, self._tool = is_learnt, accuracy.tool
        # a task of several ends has no one tip; its tool counts as known then
        tip, self._turn, features = task.robot.tip, np.eye(3), self._task._features
        # positions along all axes, in the axes of a tracker where one is believed
        self._is_spatial = len(features) == 1 and features[0].axes == "xyz"
        self._is_spatial &= list(self._task.units).count("m") == 3
        if self._is_spatial:
            tip = features[0].frame
            self._turn = self._turn if features[0].placed is None else features[0].placed[0]
        self._link = None if tip is None else FrameKinematics(task.robot, tip)
        units = np.array(self._task.units)
        self._groups = [np.flatnonzero(units == unit) for unit in dict.fromkeys(self._task.units)]
        names = [self._task.units[group[0]] for group in self._groups]
        self._is_place = [name == "m" for name in names]
        self._share = [_IMAGE if name == "px" else accuracy.jacobian for name in names]
        known = accuracy.for_units(self._task.units)
        sd = np.broadcast_to(np.asarray(known.x, float), self._task.m)
        spread = _SIGMAS * math.sqrt(2.0)
        self._noise = [spread * float(sd[group].max()) for group in self._groups]
        self._norms = [math.inf] * len(self._groups)  # of Ĵ
        self._longest = _FRAMES * accuracy.x_period
        self._times = np.full(_KEPT, -math.inf)
        self._places = np.zeros((_KEPT, task.robot.nq))
        self._paths = np.zeros(_KEPT)
        self._path, self._count = 0.0, 0
        self._frames: deque[_Frame] = deque(maxlen=round(1.2 * _SPANS[-1] / _APART))
        self._last: _Frame | None = None
        self._seen = -math.inf
        self._q_seen: Array | None = None  # in the last period in which there was an x

    def look(self, measurement: Measurement, x_d: Array) -> Fault | None:
        """Return what is wrong with x, or None. q and q̇ are taken for right.

        Args:
            measurement: Of this period.
            x_d: Where the controller leads x to, shape (n_x,).
        """
        t, q, v, x, t_x = measurement
        k = self._count % _KEPT
        self._path += self._dt * math.hypot(*v.tolist())
        self._times[k], self._places[k], self._paths[k] = t, q, self._path
        self._count += 1
        last = self._last
        if not math.isfinite(math.hypot(*x.tolist())):
            return None if self._q_seen is None else self._lost(q, self._q_seen)
        self._q_seen = q
        if last is not None and (x == last.x).all():  # repeated, whatever t_x says
            return self._repeated(t, q, x_d, last)
        self._seen = t
        at = self._index(t if t_x is None else t_x)
        if at is None:
            return None
        taken, place = float(self._times[at]), self._places[at].copy()
        frame = self._frame(taken, x, place, float(self._paths[at]), x_d)
        self._last = frame
        if last is not None and self._is_off(frame, last):
            return Fault.SENSOR_JUMPED
        if self._frames and taken - self._frames[-1].t < _APART:
            return None
        J = self._task.jacobian(place)
        self._norms = [float(np.linalg.norm(J[group], 2)) for group in self._groups]
        self._frames.append(frame)
        return self._compare(frame)

    def _index(self, taken: float) -> int | None:
        """Return where the configuration is kept that a frame was taken at, if it is."""
        k = (self._count - 1) % _KEPT
        i = k - round((self._times[k] - taken) / self._dt)
        if i <= k - min(self._count, _KEPT) or i > k:
            return None  # from before the run, or by a clock that nobody knows
        i %= _KEPT
        if abs(self._times[i] - taken) > 2.0 * self._dt:  # periods were missed
            i = int(np.argmin(np.abs(self._times - taken)))
        return i if abs(self._times[i] - taken) <= 2.0 * self._dt else None

    def _compare(self, frame: _Frame) -> Fault | None:
        """Hold a frame against some that are older by the spans."""
        for span in _SPANS:
            for old in reversed(self._frames):
                if frame.t - old.t >= span:
                    if self._is_off(frame, old):
                        return Fault.SENSOR_DISAGREES
                    if self._is_still(frame, old):
                        return Fault.SENSOR_FROZEN
                    break
        return None

    def _is_off(self, new: _Frame, old: _Frame) -> bool:
        """Return whether x moved otherwise than the joints can have moved it."""
        seen, believed = self._motions(new, old)
        if self._is_learnt:
            pairs = zip(self._sizes(seen), self._sizes(believed), strict=True)
            return self._exceeds([abs(a - b) for a, b in pairs], self._unknown(new, old))
        off, besides = seen - believed, self._besides(new, old)
        if not self._exceeds(self._sizes(off), besides):  # mostly nothing needs a tool
            return False
        return self._exceeds(self._sizes(self._unexplained(off, new, old)), besides)

    def _exceeds(self, off: list[float], unknown: list[float]) -> bool:
        slack = zip(off, self._noise, unknown, strict=True)
        return any(size > noise + more for size, noise, more in slack)

    def _is_still(self, new: _Frame, old: _Frame) -> bool:
        """Return whether x does not move though it is led to, and though the joints move it.

        Half of what is unknown is not the reason then: that would be joints which turn about a tip
        that is held, and whose target rests.
        """
        seen, believed = self._motions(new, old)
        led = self._sizes(self._task.error(new.x_d, old.x_d))
        if any(size > noise for size, noise in zip(self._sizes(seen), self._noise, strict=True)):
            return False
        off = self._sizes(seen - believed)
        slack = zip(off, led, self._noise, self._unknown(new, old), strict=True)
        return any(min(size, way) > noise + 0.5 * unknown for size, way, noise, unknown in slack)

    def _motions(self, new: _Frame, old: _Frame) -> tuple[Array, Array]:
        return self._task.error(new.x, old.x), self._task.error(new.x_hat, old.x_hat)

    def _unexplained(self, error: Array, new: _Frame, old: _Frame) -> Array:
        """Return what is left of an error where a tip elsewhere on its link explains all it can."""
        left, turned = error.copy(), self._turned(new, old)
        for group, is_place in zip(self._groups, self._is_place, strict=True):
            if is_place:
                along = np.zeros(len(group))
                if self._is_spatial:
                    turn = pin.log3(new.rotation @ old.rotation.T)
                    along = turn * (turn @ error[group]) / max(turn @ turn, 1e-18)
                across = error[group] - along
                size = math.hypot(*across.tolist())
                left[group] = along + max(1.0 - turned / max(size, 1e-12), 0.0) * across
        return left

    def _turned(self, new: _Frame, old: _Frame) -> float:
        """Return by how much a tip elsewhere on its link may move otherwise [m]."""
        # ‖R' − R‖ is √2 times smaller in the spectral norm than in Frobenius'
        return self._tool * float(np.linalg.norm(new.rotation - old.rotation)) / math.sqrt(2.0)

    def _besides(self, new: _Frame, old: _Frame) -> list[float]:
        """Return by how much motions may differ besides that and noise, of each unit."""
        way = new.path - old.path
        shares = zip(self._share, self._norms, strict=True)
        return [share * norm * way if way > 0.0 else 0.0 for share, norm in shares]

    def _unknown(self, new: _Frame, old: _Frame) -> list[float]:
        """Return by how much motions may differ without noise, of each unit."""
        turned, besides = self._turned(new, old), self._besides(new, old)
        return [a * turned + b for a, b in zip(self._is_place, besides, strict=True)]

    def _sizes(self, error: Array) -> list[float]:
        """Return the lengths of the parts of an error that have one unit each."""
        return [math.hypot(*error[group].tolist()) for group in self._groups]

    def _repeated(self, t: float, q: Array, x_d: Array, last: _Frame) -> Fault | None:
        """Return a fault where the same x is told although the tip must have moved."""
        if t - self._seen <= self._longest:
            return None
        now = self._frame(t, last.x, q, self._path, x_d)
        return Fault.SENSOR_FROZEN if self._is_off(now, last) or self._is_still(now, last) else None

    def _frame(self, t: float, x: Array, q: Array, path: float, x_d: Array) -> _Frame:
        rotation = self._turn if self._link is None else self._turn @ self._link.placement(q)[0]
        return _Frame(t, x, self._task.value(q), path, rotation, x_d)

    def _lost(self, q: Array, seen: Array) -> Fault | None:
        """Return a fault where the tip has moved too far without being seen."""
        way = self._task.error(self._task.value(q), self._task.value(seen)) / self._unseen
        return Fault.BLIND if any(size > 1.0 for size in self._sizes(way)) else None
