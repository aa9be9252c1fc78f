"""`FaultWatch`: a robot's measurements held against each other, period by period."""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise

import numpy as np
import pinocchio as pin

from approxjac.interface import Measurement
from approxjac.realtime.accuracy import Accuracy
from approxjac.realtime.faults import Fault
from approxjac.robots import Robot
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
        """Return what is wrong with this measurement, or None.

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

    def _tell(self, fault: Fault, j: int, told: str) -> Fault:
        """Return a fault of a joint, with what is told of it as its detail."""
        self.detail = f"{self._names[j]}: {told}"
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
        told = f"its torque changed by {pushed[j]:.3g} {_TORQUE[self._units[j]]}"
        if led[j] > _WAY:
            told = f"it was led {led[j]:.3g} {self._units[j]}"
        return self._tell(Fault.COMMAND_UNANSWERED, j, told)

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
            told = f"from {before[j]:.3g} to {v[j]:.3g} {self._units[j]}/s"
            return self._tell(Fault.VELOCITY_JUMPED, j, told)
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
        told = f"moved {ways} in {1e3 * elapsed:.3g} ms"
        return self._tell(Fault.VELOCITY_DISAGREES, j, told)

    def _q_or_v(self, way: Array, off: Array, v: Array, elapsed: float) -> Fault:
        j = int(np.argmax(off / self._q_jump))
        q_moves = abs(way[j]) > self._q_jump[j] + self._dt * self._fastest[j]
        if not q_moves:
            return self._disagrees(j, way[j], elapsed * v[j], elapsed)
        told = f"by {way[j]:.3g} {self._units[j]} in {1e3 * elapsed:.3g} ms"
        return self._tell(Fault.POSITION_JUMPED, j, told)

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
