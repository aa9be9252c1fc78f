"""`FaultWatch`: a robot's measurements held against each other, period by period."""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.interface import Measurement
from approxjac.realtime.accuracy import Accuracy
from approxjac.realtime.faults import Fault
from approxjac.robots import Robot
from approxjac.tasks import Task
from approxjac.tasks.frame_kinematics import FrameKinematics
from approxjac.validation import Array

_SIGMAS = 6.0  # beyond which noise is none
_UNKNOWN = 3  # periods without q and q̇ that are bridged
_STILL = 5  # periods in which a clock may stand still
_SHARE = 0.12  # of the way moved, by which ∫q̇ may be off
_WINDOWS = (8, 24, 64)  # periods over which q is held against ∫q̇
_SUDDEN = 0.05  # of the largest speed: by which q̇ may change in a millisecond
_WAY = 0.02  # rad or m, which a joint is led to go and goes no bit of it
_STOPPED = 30.0  # rad/s², by which no joint stops by itself
_REPEATS = 8  # readings of q to the bit, after which a joint that moved is taken for frozen
_STANDS = 0.03  # s, for which a joint has to tell the same q to the bit to be at rest
_REMEMBERED = 200  # readings of both clocks
_TORQUE = {"rad": "N m", "m": "N"}
_GROWTH, _STEPS, _TIME = 1.4, 5, 0.03  # of speed, over so many times of so many seconds


class FaultWatch:
    """Hold q, q̇ and the clock against each other.

    It sees each period's measurement once. Thresholds come from noise, speed limits and period; no
    dynamics are believed.

    Args:
        robot: The believed robot.
        dt: Period [s].
        accuracy: Of q and q̇.
        fastest: Largest joint speeds, shape (n_v,) [rad/s or m/s].
        late: Time from state to state that is a fault [s].
        commands_velocity: Whether joint velocities are commanded, not torques.

    Attributes:
        detail: Of the fault that was found, in words: which joint, and by how much.
    """

    def __init__(
        self,
        robot: Robot,
        dt: float,
        accuracy: Accuracy,
        fastest: Array,
        late: float,
        commands_velocity: bool,
    ) -> None:
        n = robot.nv
        self._model, self._is_vector = robot.model, robot.nq == n
        self._dt, self._fastest, self._late = dt, fastest, late
        self._names, self._units, self.detail = robot.joint_names, robot.joint_units, ""
        self._q_noise = _SIGMAS * np.sqrt(2.0) * np.broadcast_to(np.asarray(accuracy.q, float), n)
        self._v_noise = _SIGMAS * np.broadcast_to(np.asarray(accuracy.v, float), n)
        self._lag = 1.5 * accuracy.velocity_filter + 0.5 * dt
        known = np.where(np.isfinite(fastest), fastest, 3.0)
        self._q_jump = self._q_noise + 0.6 * dt * known
        self._v_jump = np.sqrt(2.0) * self._v_noise + _SUDDEN * known * (dt / 1e-3)
        self._v_stop = np.maximum(0.5 * np.sqrt(2.0) * self._v_noise, _STOPPED * dt)
        longest = _WINDOWS[-1]
        # rings: motion of q, ∫q̇, way, each since the beginning, and q̇
        self._sums = np.zeros((longest + 1, 3, n))
        self._speeds = np.zeros((longest + 1, n))
        self._moved = np.zeros((3, n))
        self._count = self._unknown = self._still = 0
        self._repeats = np.zeros(n)
        self._halted = np.zeros(n, dtype=bool)
        self._last: Measurement | None = None
        # a command that a joint at rest must answer: a change of torque, or a way
        self._answered = 2.0 * accuracy.stiction_of(robot.effort_limits)
        self._commands_velocity = commands_velocity
        if commands_velocity:
            self._answered = np.full(n, np.inf)
        self._way, self._asked = np.zeros(n), np.zeros(n)
        self._stood, self._stands = np.zeros(n), max(_REPEATS, round(_STANDS / dt))
        self._held_by = np.zeros(n)
        self._command = np.zeros(n)
        self._led = np.zeros(n)
        self._peaks = [0.0] * (_STEPS + 1)  # of speed beyond that, relative to the fastest
        self._peak_until = 0.0
        self._ahead = deque([-math.inf], maxlen=_REMEMBERED)

    def look(self, measurement: Measurement, now: float) -> Fault | None:
        """Return the fault of this measurement, or None.

        One without q and q̇ is bridged for some periods; it is the caller who must not use it.

        Args:
            measurement: Of this period.
            now: When it was read, by this machine's clock [s].
        """
        t, q, v = measurement.t, measurement.q, measurement.v
        self.detail = ""
        if not math.isfinite(math.hypot(*q.tolist(), *v.tolist())):
            self._unknown += 1
            return Fault.JOINTS_UNKNOWN if self._unknown > _UNKNOWN else None
        last, self._last = self._last, measurement
        # a reading that was held up makes its clock seem slow, never fast
        ahead = t - now > max(self._ahead) + 0.5 * self._late
        self._ahead.append(t - now)
        missed, self._unknown = self._unknown, 0
        if last is None:
            self._peak_until = t + _TIME
            return None
        elapsed = t - last.t
        if not 0.0 <= elapsed <= self._late + missed * self._dt:
            is_late = elapsed > 0.0 and not ahead
            most = f", at most {1e3 * self._late:.3g}" if is_late else ""
            self.detail = f"{1e3 * elapsed:.3g} ms from state to state{most}"
            return Fault.TORQUE_LATE if is_late else Fault.CLOCK_JUMPED
        if elapsed < 0.1 * self._dt:
            self._still += 1
            self._last = last._replace(t=t)  # what comes meanwhile is held against the last state
            return Fault.CLOCK_STOOD_STILL if self._still >= _STILL else None
        self._still = 0
        way = q - last.q if self._is_vector else pin.difference(self._model, last.q, q)
        return self._compare(way, v, last.v, elapsed, missed) or self._speed(t, v)

    def sent(self, command: Array, reference: Array | None) -> None:
        """Take note of what was sent, and of the joint velocity it is to lead to, both (n_v,)."""
        self._command = command
        if self._count == 0:  # what holds a joint that stood still from the beginning
            self._held_by = command
        led = np.zeros(1) if reference is None else np.abs(reference)
        self._led = led + led.max()  # joints need not share the motion as it is led
        if self._commands_velocity:
            reference = command
        self._asked = np.zeros_like(command) if reference is None else reference

    def too_fast(self, j: int, share: float, v: Array) -> str:
        """Return in words how fast a joint is, which is a share of what it may be."""
        unit = self._units[j]
        return f"{self._names[j]}: {abs(v[j]):.3g} {unit}/s, at most {abs(v[j]) / share:.3g}"

    def _tell(self, fault: Fault, j: int, message: str) -> Fault:
        """Return a fault of a joint, with a message as its detail."""
        self.detail = f"{self._names[j]}: {message}"
        return fault

    def _unanswered(self, same: Array) -> Fault | None:
        """Return a fault where a joint stands still under a command that must move it."""
        self._stood = np.where(same, self._stood + 1.0, 0.0)
        self._way = np.where(same, self._way + self._dt * self._asked, 0.0)
        self._held_by = np.where(same, self._held_by, self._command)
        led, pushed = np.abs(self._way), np.abs(self._command - self._held_by)
        unanswered = (led > _WAY) | (pushed > self._answered)
        unanswered &= self._stood >= self._stands
        if not unanswered.any():
            return None
        j = int(unanswered.argmax())
        message = f"its torque changed by {pushed[j]:.3g} {_TORQUE[self._units[j]]}"
        if led[j] > _WAY:
            message = f"it was led {led[j]:.3g} {self._units[j]}"
        return self._tell(Fault.COMMAND_UNANSWERED, j, message)

    def _compare(
        self, way: Array, v: Array, before: Array, elapsed: float, missed: int
    ) -> Fault | None:
        """Hold the way of a period against q̇."""
        periods = elapsed / self._dt
        mean = (0.5 * elapsed) * (v + before)
        off = np.abs(way - mean)
        self._moved += (way, mean, np.abs(mean))
        k, size = self._count + 1, len(self._sums)
        self._count = k
        self._sums[k % size], self._speeds[k % size] = self._moved, v
        # first what has a cause in this period alone
        sudden = np.abs(v - before)
        if (off > self._q_jump * periods).any():
            # a q̇ that does not belong to q is off as much in every period
            return self._q_or_v(way, off, v, elapsed)
        if (sudden > self._v_jump * (periods + missed)).any():
            j = int(np.argmax(sudden / self._v_jump))
            message = f"from {before[j]:.3g} to {v[j]:.3g} {self._units[j]}/s"
            return self._tell(Fault.VELOCITY_JUMPED, j, message)
        for window in _WINDOWS:
            if k >= window:
                old = self._sums[(k - window) % size]
                q_way, v_way, path = self._moved - old
                change = np.abs(v - self._speeds[(k - window) % size])
                slack = (
                    self._q_noise + _SHARE * path + self._lag * change
                    + self._v_noise * (math.sqrt(window) * self._dt + 0.1 * window * self._dt)
                )  # fmt: skip
                if (np.abs(q_way - v_way) > slack).any():
                    j = int(np.argmax(np.abs(q_way - v_way) - slack))
                    return self._disagrees(j, q_way[j], v_way[j], window * self._dt)
        # a joint that stops from one period to the next, and then tells the same q again and again
        same = way == 0.0
        moved = np.abs(before) > self._v_noise
        self._halted = (self._halted | ((sudden > self._v_stop) & moved)) & same
        self._repeats = np.where(self._halted, self._repeats + 1.0, 0.0)
        if (self._repeats >= _REPEATS).any():
            j = int(self._repeats.argmax())
            return self._tell(Fault.ENCODER_FROZEN, j, f"{_REPEATS} times the same q")
        return self._unanswered(same)

    def _disagrees(self, j: int, way: float, mean: float, elapsed: float) -> Fault:
        ways = f"{way:.3g} {self._units[j]} by q and {mean:.3g} by q̇"
        message = f"moved {ways} in {1e3 * elapsed:.3g} ms"
        return self._tell(Fault.VELOCITY_DISAGREES, j, message)

    def _q_or_v(self, way: Array, off: Array, v: Array, elapsed: float) -> Fault:
        j = int(np.argmax(off / self._q_jump))
        q_moves = abs(way[j]) > self._q_jump[j] + self._dt * self._fastest[j]
        if not q_moves:
            return self._disagrees(j, way[j], elapsed * v[j], elapsed)
        message = f"by {way[j]:.3g} {self._units[j]} in {1e3 * elapsed:.3g} ms"
        return self._tell(Fault.POSITION_JUMPED, j, message)

    def _speed(self, t: float, v: Array) -> Fault | None:
        """Look at speeds, and whether they grow like those of a loop that is unstable."""
        share = np.abs(v) / (self._fastest + self._v_noise)
        if (share > 1.0).any():
            j = int(share.argmax())
            self.detail = self.too_fast(j, share[j], v)
            return Fault.TOO_FAST
        peaks = self._peaks
        peaks[-1] = max(peaks[-1], float(np.max((np.abs(v) - self._led) / self._fastest)))
        if t < self._peak_until:
            return None
        self._peak_until = t + _TIME
        grew = all(b > _GROWTH * a for a, b in pairwise(peaks))
        fault = Fault.SPEED_GREW if grew and peaks[0] > 0.01 and peaks[-1] > 0.25 else None
        self._peaks = [*peaks[1:], 0.0]
        return fault


_LENGTH_SIGMAS = 7.0  # of lengths, of up to three coordinates
_KEPT = 512  # periods for which q is remembered: frames may be as old
_SPANS = (0.03, 0.06, 0.12, 0.25)  # over which frames are compared [s]
_APART = 4e-3  # s, between frames that are kept
_FRAMES = 3.0  # periods of x for which the same one may be read

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
        spread = _LENGTH_SIGMAS * math.sqrt(2.0)
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
        """Return the fault of x, or None. q and q̇ are taken for right.

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
        """Return the index of the configuration that a frame was taken at, if it is kept."""
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
        """Return True where x moved otherwise than the joints can have moved it."""
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
        """Return True where x does not move though it is led to, and though the joints move it.

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
        """Return the rest of an error that no other tip on its link explains."""
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
        """Return a fault where the same x is read although the tip must have moved."""
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
