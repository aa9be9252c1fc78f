"""`FaultWatch`: consistency checks of a robot's measurements, period by period."""

import math
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.controllers.guard import usual_accelerations
from approxjac.interface import Measurement
from approxjac.realtime.faults import Accuracy, Fault
from approxjac.robots import Drives, Dynamics, Friction, Robot
from approxjac.robots.drives import usual_inertia
from approxjac.tasks import Task
from approxjac.tasks.frame_tasks import FrameKinematics
from approxjac.validation import Array

_SIGMAS = 6.0  # beyond which noise is none
_UNKNOWN = 3  # periods without q and q̇ that are bridged
_STILL = 5  # periods in which a clock may stand still
_SHARE = 0.12  # of the way moved, by which ∫q̇ may be off
_WINDOWS = (8, 24, 64)  # periods over which q is held against ∫q̇
_SUDDEN = 0.05  # of the largest speed: by which q̇ may change in a millisecond
_BLOW = 0.5  # of the fastest joint's speed, by which an arm that meets something may change it
_WAY = 0.02  # rad or m, commanded motion to which a joint has to respond
_STOPPED = 30.0  # rad/s², by which no joint stops by itself
_REPEATS = 8  # readings of q to the bit, after which a joint that moved is taken for frozen
_STANDS = 0.03  # s, for which q of a joint is the same to the bit where it is at rest
_MEAN = 0.005  # s, over which the acceleration of others is averaged, of a fine encoder
_FINE = 1e-4  # rad or m, standard deviation of q with which the two before are so small
_REMEMBERED = 200  # readings of both clocks
_FASTER = 0.15  # of its largest speed, by which a joint may exceed the commanded one
_SLOW = {"rad": 0.4, "m": 0.1}  # per s; or by this, where its largest speed is low
_FADES = 0.5  # s, in which that fades: joints that share a motion swing on
_FALLS, _FALL = 0.1, 0.75  # s from the start, and share of the largest speed, by an unknown load
_GROWTH, _STEPS, _TIME = 1.4, 5, 0.03  # of speed, over so many times of so many seconds


class FaultWatch:
    """Consistency checks of q, q̇, the clock and commands, without a dynamic model but gravity.

    Thresholds come from noise, the largest joint speeds `fastest` (n_v,) and the period; two states
    may be at most `late` [s] apart. They are narrower than those of `controllers.Guard`, which
    knows no noise of q̇ and lets impacts pass, and a run ends at the first fault. Believed gravity
    is no torque that a joint at rest has to answer, unless the robot `adds_gravity` itself.
    `detail` says which joint is at fault, and by how much.
    """

    def __init__(
        self,
        robot: Robot,
        dt: float,
        accuracy: Accuracy,
        fastest: Array,
        late: float,
        commands_velocity: bool,
        adds_gravity: bool = False,
    ) -> None:
        n = robot.nv
        self._robot, self._model, self._is_vector = robot, robot.model, robot.nq == n
        self._dt, self._fastest, self._late = dt, fastest, late
        self._names, self._units, self.detail = robot.joint_names, robot.joint_units, ""
        sd = np.broadcast_to(np.asarray(accuracy.q, float), n)
        self._q_noise = _SIGMAS * np.sqrt(2.0) * sd
        self._v_noise = _SIGMAS * np.broadcast_to(np.asarray(accuracy.v, float), n)
        self._lag = 1.5 * accuracy.velocity_filter + 0.5 * dt
        # of q̇: what is stated, or what one step of the encoder makes of it in the filter, if less
        step = math.sqrt(12.0) * sd / (accuracy.velocity_filter + dt)
        self._peak = np.minimum(self._v_noise, step)
        known = np.where(np.isfinite(fastest), fastest, 3.0)
        self._q_jump = self._q_noise + 0.6 * dt * known
        self._v_jump = np.sqrt(2.0) * self._v_noise + _SUDDEN * known * (dt / 1e-3)
        self._v_stop = np.maximum(np.sqrt(2.0) * self._v_noise, _STOPPED * dt)
        # motion of q, ∫q̇, way, each since the beginning; q̇; and the time since the one before
        nothing = np.zeros((3, n)), np.zeros(n), dt
        self._past: deque[tuple[Array, Array, float]] = deque([nothing], maxlen=_WINDOWS[-1] + 1)
        self._unknown = self._still = 0
        self._halted = np.zeros(n)  # the speed at which a joint stopped, else 0
        self._last: Measurement | None = None
        # a command that a joint at rest must answer: a change of torque beside gravity, or a way
        self._commands_velocity = commands_velocity
        self._dynamics, self._adds_gravity = Dynamics(robot), adds_gravity
        usual, stated = Friction.usual(robot), accuracy.stiction
        self._by_load = 2.0 * np.asarray(usual.load) if stated is None else np.zeros(n)
        stiction = (
            usual.stribeck * np.asarray(usual.coulomb) if stated is None else np.asarray(stated)
        )
        self._answered = np.full(n, np.inf) if commands_velocity else 2.0 * stiction
        self._way, self._stood = np.zeros((2, n))
        coarse = np.maximum(1.0, sd / _FINE)  # a slow joint takes long from step to step
        self._stands = np.maximum(_REPEATS, np.round(_STANDS * coarse / dt))
        # friction may hold one that is led by torques; what q̇ of its last step adds to them fades
        self._most_led = _WAY * coarse if commands_velocity else np.full(n, np.inf)
        # where a joint that stands would be by now, and how fast, with a usual rotor
        self._inertia = np.asarray(Drives.usual(robot).rotor_inertia) + usual_inertia(
            robot, held=True
        )
        self._gone, self._goes, self._mean_v, self._mean_push = np.zeros((4, n))
        self._mean = _MEAN * coarse
        self._settles = np.ceil((3.0 * accuracy.velocity_filter + 2.0 * self._mean) / dt)
        self._command, self._push, self._held_by, self._led, self._recent = np.zeros((5, n))
        self._fades = math.exp(-dt / _FADES)
        self._faster = np.maximum(_FASTER * fastest, [_SLOW[unit] for unit in self._units])
        # of a fall as it begins: |q̇| at first, the sum of what it gained, how often, until when
        self._released, self._fallen, self._falls, self._lands = np.zeros(n), np.zeros(n), 0, 0.0
        self._peaks = [0.0] * (_STEPS + 1)  # of speed beyond that, relative to the fastest
        self._peak_until = 0.0
        self._ahead = deque([-math.inf], maxlen=_REMEMBERED)

    def look(self, measurement: Measurement, now: float) -> Fault | None:
        """Return the fault of a period's measurement, read at `now` by this machine's clock [s]."""
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
            self._peak_until, self._lands, self._released = t + _TIME, t + _FALLS, np.abs(v)
            return None
        elapsed = t - last.t
        if not 0.0 <= elapsed <= self._late + missed * self._dt:
            is_late = elapsed > 0.0 and not ahead
            most = f", at most {1e3 * self._late:.3g}" if is_late else ""
            self.detail = f"{1e3 * elapsed:.3g} ms from state to state{most}"
            return Fault.TORQUE_LATE if is_late else Fault.CLOCK_JUMPED
        if elapsed < 0.1 * self._dt:
            self._still += 1
            self._last = last._replace(t=t)  # later states are compared with the last one
            return Fault.CLOCK_STOOD_STILL if self._still >= _STILL else None
        self._still = 0
        way = q - last.q if self._is_vector else pin.difference(self._model, last.q, q)
        return self._compare(way, v, last.v, elapsed, missed) or self._speed(t, v)

    def commanded(self, command: Array, reference: Array | None) -> Fault | None:
        """Return the fault of a joint that is faster than recent commands explain."""
        self._command = self._push = command
        if not (self._commands_velocity or self._adds_gravity or self._last is None):
            self._push = command - self._dynamics.g(self._last.q)
        if len(self._past) == 1:  # what holds a joint at rest from the beginning
            self._held_by = self._mean_push = self._push
        led = np.abs(np.zeros_like(command) if reference is None else reference)
        self._led = led + led.max()  # joints need not share the motion as it is led
        if reference is None or self._unknown or self._last is None:
            return None
        self._recent = np.maximum(self._fades * self._recent, self._led + led)
        v, most = self._last.v, self._recent + self._faster + self._peak
        if self._last.t < self._lands:  # let go with a load that is not known, it falls at first
            gained = np.abs(v) - self._released
            self._fallen, self._falls = self._fallen + gained, self._falls + 1
            # by the mean of what it gained, as a joint with springs falls in waves, and q̇ lags
            since = self._falls - self._lag / self._dt
            is_braked = 2.0 * self._fallen > since * np.maximum(gained - self._peak, 0.0)
            most = np.where(is_braked, np.maximum(most, _FALL * self._fastest), most)
            if self._last.t + 1.5 * self._dt > self._lands:  # then it is slower and slower
                self._recent = np.maximum(self._recent, gained * is_braked)
        return self._too_fast(v, most)

    def _too_fast(self, v: Array, most: Array) -> Fault | None:
        share = np.abs(v) / most
        if not (share > 1.0).any():
            return None
        j = int(share.argmax())
        message = f"{abs(v[j]):.3g} {self._units[j]}/s, at most {most[j]:.3g}"
        return self._fault(Fault.TOO_FAST, j, message)

    def _fault(self, fault: Fault, j: int, message: str) -> Fault:
        self.detail = f"{self._names[j]}: {message}"
        return fault

    def _compare(
        self, way: Array, v: Array, before: Array, elapsed: float, missed: int
    ) -> Fault | None:
        periods = elapsed / self._dt
        mean = (0.5 * elapsed) * (v + before)
        off, sudden = np.abs(way - mean), np.abs(v - before)
        moved = self._past[-1][0] + (way, mean, np.abs(mean))
        self._past.append((moved, v, elapsed))
        # first what has a cause in this period alone
        if (off > self._q_jump * periods).any():
            j = int(np.argmax(off / self._q_jump))
            # a q̇ that does not belong to q is off as much in every period
            if not abs(way[j]) > self._q_jump[j] + self._dt * self._fastest[j]:
                return self._disagrees(j, way, elapsed * v, self._q_jump, 1)
            message = f"by {way[j]:.3g} {self._units[j]} in {1e3 * elapsed:.3g} ms"
            return self._fault(Fault.POSITION_JUMPED, j, message)
        most = self._v_jump * (periods + missed)
        if (sudden > most).any():  # a blow, or a light joint under its own torque, may do so
            most = most + _BLOW * np.abs(before).max()
            if not self._commands_velocity:
                mobility = usual_accelerations(self._robot)[0]
                most = most + elapsed * (mobility @ np.abs(self._command))
        if (sudden > most).any():
            j = int(np.argmax(sudden / most))
            message = f"from {before[j]:.3g} to {v[j]:.3g} {self._units[j]}/s"
            return self._fault(Fault.VELOCITY_JUMPED, j, message)
        for window in _WINDOWS:
            if len(self._past) > window:
                sums, speed, _ = self._past[-1 - window]
                q_way, v_way, path = moved - sums
                slack = (
                    self._q_noise + _SHARE * path + self._lag * np.abs(v - speed)
                    + self._v_noise * (math.sqrt(window) * self._dt + 0.1 * window * self._dt)
                )  # fmt: skip
                beyond = np.abs(q_way - v_way) - slack
                if (beyond > 0.0).any():
                    return self._disagrees(int(np.argmax(beyond)), q_way, v_way, slack, window)
        # a joint that stops from one period to the next, and then has the same q again and again
        same = way == 0.0
        stops = (sudden > self._v_stop) & (np.abs(before) > self._v_noise)
        halted = np.maximum(self._halted, np.where(stops, np.abs(before), 0.0))
        self._halted = np.where(same, halted, 0.0)
        self._stood = np.where(same, self._stood + 1.0, 0.0)
        # unless it may be on its way to the next step of the encoder
        frozen = self._stood * self._dt * self._halted > self._q_noise
        frozen &= self._stood >= _REPEATS
        if frozen.any():
            j = int(frozen.argmax())
            return self._fault(Fault.ENCODER_FROZEN, j, f"{_REPEATS} times the same q")
        self._way = np.where(same, self._way + self._dt * self._command, 0.0)
        share = self._dt / (self._dt + self._mean)
        self._mean_v = self._mean_v + share * (v - self._mean_v)
        self._mean_push = self._mean_push + share * (self._push - self._mean_push)
        self._held_by = np.where(self._stood > self._settles, self._held_by, self._mean_push)
        # by what friction does not hold, which jitters with q̇ of others, it would move by now
        pushed, per = self._push - self._held_by, self._dt / self._inertia
        answered = self._answered + self._by_load * np.abs(self._command)
        goes = self._goes + per * pushed
        slower = np.maximum(np.abs(goes) - per * answered, 0.0)
        self._goes = np.where(self._stood >= self._settles, np.copysign(slower, goes), 0.0)
        self._gone = np.where(self._goes != 0.0, self._gone + self._dt * self._goes, 0.0)
        led = np.abs(self._way)
        unanswered = (led > self._most_led) | (np.abs(self._gone) > self._q_noise)
        unanswered &= self._stood >= self._stands
        if unanswered.any() and not self._commands_velocity and self._last is not None:
            # torque that goes into the motion of others is none of its own
            moving = self._dynamics.M(self._last.q) @ ((v - self._mean_v) / self._mean)
            explained = np.minimum(np.abs(pushed), np.abs(pushed - moving)) <= answered
            self._gone = np.where(unanswered & explained, 0.0, self._gone)
            unanswered &= ~explained
        if not unanswered.any():
            return None
        j = int(unanswered.argmax())
        message = f"its torque changed by {abs(pushed[j]):.3g} {self._robot.force_units[j]}"
        if led[j] > self._most_led[j]:
            message = f"it was led {led[j]:.3g} {self._units[j]}"
        return self._fault(Fault.COMMAND_UNANSWERED, j, message)

    def _disagrees(self, j: int, way: Array, mean: Array, slack: Array, window: int) -> Fault:
        """Return the cause of different motions of q and ∫q̇: q̇, or one step of t."""
        recent = pairwise(list(self._past)[-1 - window :])
        (before, *_), (after, _, odd) = max(recent, key=lambda two: abs(two[1][2] - self._dt))
        off = way - mean + (1.0 - self._dt / odd) * (after - before)[1]
        if abs(odd - self._dt) > 0.5 * self._dt and (np.abs(off) <= slack).all():
            self.detail = (
                f"by {1e3 * odd:.3g} ms, in which the arm moved as in {1e3 * self._dt:.3g}"
            )
            return Fault.CLOCK_JUMPED
        ways = f"{way[j]:.3g} {self._units[j]} by q and {mean[j]:.3g} by q̇"
        message = f"moved {ways} in {1e3 * window * self._dt:.3g} ms"
        return self._fault(Fault.VELOCITY_DISAGREES, j, message)

    def _speed(self, t: float, v: Array) -> Fault | None:
        """Check speeds, and whether they grow as in an unstable loop."""
        if fault := self._too_fast(v, self._fastest + self._v_noise):
            return fault
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
_SURELY = 3.0  # standard deviations, by which what is predicted may be off
_IMAGE = 0.5  # share of Ĵ by which an image may move otherwise than is believed


MotionSd = Callable[[Array], Callable[[Array], Array] | None]


class _Frame(NamedTuple):
    """One value of x, and the believed state at the instant when it was taken."""

    t: float
    x: Array
    x_hat: Array
    path: float  # ∫‖q̇‖ dt until then
    rotation: Array  # of the tip link in the axes of x, shape (3, 3)
    x_d: Array  # the target when it came


class SensorWatch:
    """Consistency checks of x and q.

    x̂ = h(q) of the believed robot is only approximate. A tip displaced on its link by d moves by
    (R' − R) d more from one configuration to another, so the error of motions between two frames is
    at most

        7√2 σ + ℓ ‖R' − R‖ + κ ‖Ĵ‖ ∫‖q̇‖ dt

    with σ the largest noise, ℓ and κ those of `Accuracy` (`tool`, `jacobian`) and ‖Ĵ‖ the largest
    singular value. (R' − R) d is perpendicular to the axis about which the link has turned: along
    it, the tool explains no error. Coordinates of different units are checked separately. If the
    kinematics are learnt, the sensor may be rotated, so that lengths of motions are compared. While
    x is lost, it may move by `unseen` (m,) at most, or its prediction be off by as much. `detail`
    says of a lost x by how much.
    """

    def __init__(
        self, task: Task, dt: float, accuracy: Accuracy, unseen: Array, is_learnt: bool
    ) -> None:
        self._task, self._dt, self._unseen = task.measured, dt, unseen
        self._is_learnt, self._tool = is_learnt, accuracy.tool
        # a task of several ends has no one tip; its tool counts as known then
        tip, self._turn, features = task.robot.tip, np.eye(3), self._task.features
        units = list(self._task.units)
        # positions along all axes, in the axes of a tracker where one is believed
        self._is_spatial = len(features) == 1 and features[0].axes == "xyz"
        self._is_spatial &= units.count("m") == 3
        if self._is_spatial:
            tip = features[0].frame
            self._turn = self._turn if features[0].placed is None else features[0].placed[0]
        self._link = None if tip is None else FrameKinematics(task.robot, tip)
        names = np.array(list(dict.fromkeys(units)))
        self._groups = [np.flatnonzero(np.array(units) == name) for name in names]
        self._is_place = names == "m"
        self._share = np.where(names == "px", _IMAGE, accuracy.jacobian)
        sd = np.broadcast_to(np.asarray(accuracy.for_units(units).x, float), self._task.m)
        spread = _LENGTH_SIGMAS * math.sqrt(2.0)
        self._noise = spread * np.array([sd[group].max() for group in self._groups])
        self._norms = np.zeros(len(names))  # of Ĵ
        self._longest = _FRAMES * accuracy.x_period
        # time, q and ∫‖q̇‖ dt of the last periods
        self._past: deque[tuple[float, Array, float]] = deque(maxlen=_KEPT)
        self._path = 0.0
        self._frames: deque[_Frame] = deque(maxlen=round(1.2 * _SPANS[-1] / _APART))
        self._last: _Frame | None = None
        self._seen = -math.inf
        self._q_seen: Array | None = None  # in the last period in which there was an x
        self._sd: Callable[[Array], Array] | None = None  # of the motion since that is predicted
        self.detail, self._units = "", units

    def look(
        self, measurement: Measurement, x_d: Array, motion_sd: MotionSd = lambda q: None
    ) -> Fault | None:
        """Return the fault of x, with target x_d (n_x,), assuming that q and q̇ are right.

        `motion_sd` is `Kinematics.motion_sd` of a law that predicts x.
        """
        self.detail = ""
        t, q, v, x, t_x = measurement
        self._path += self._dt * math.hypot(*v.tolist())
        self._past.append((t, q, self._path))
        last = self._last
        if not math.isfinite(math.hypot(*x.tolist())):
            return None if self._q_seen is None else self._lost(q, self._q_seen, motion_sd)
        self._q_seen, self._sd = q, None
        if last is not None and (x == last.x).all():  # repeated, whatever t_x says
            if t - self._seen <= self._longest:
                return None
            now = self._frame(self._past[-1], x, x_d)
            frozen = self._is_off(now, last) or self._is_still(now, last)
            return Fault.SENSOR_FROZEN if frozen else None
        self._seen = t
        instant = self._instant(t if t_x is None else t_x)
        if instant is None:
            return None
        self._last = frame = self._frame(instant, x, x_d)
        if last is not None and self._is_off(frame, last):
            return Fault.SENSOR_JUMPED
        if self._frames and frame.t - self._frames[-1].t < _APART:
            return None
        J = self._task.jacobian(instant[1])
        self._norms = np.array([np.linalg.norm(J[group], 2) for group in self._groups])
        self._frames.append(frame)
        for span in _SPANS:
            old = next((old for old in reversed(self._frames) if frame.t - old.t >= span), None)
            if old is not None and self._is_off(frame, old):
                return Fault.SENSOR_DISAGREES
            if old is not None and self._is_still(frame, old):
                return Fault.SENSOR_FROZEN
        return None

    def _lost(self, q: Array, q_seen: Array, motion_sd: MotionSd) -> Fault | None:
        way, what = self._task.error(self._task.value(q), self._task.value(q_seen)), "moved by"
        beyond = self._sizes(way / self._unseen)
        if (beyond > 1.0).any():
            # what is learnt stays the same until x is seen again
            self._sd = self._sd or motion_sd(q_seen)
            if self._sd is not None:
                way, what = _SURELY * self._sd(q), "may differ from what is predicted by"
                beyond = self._sizes(way / self._unseen)
        if not (beyond > 1.0).any():
            return None
        group = self._groups[int(beyond.argmax())]
        size, unit = math.hypot(*way[group].tolist()), self._units[group[0]]
        most = f"at most {size / beyond.max():.3g} {unit} (max_blind_motion)"
        self.detail = f"since it was seen it {what} {size:.3g} {unit}, {most}"
        return Fault.BLIND

    def _instant(self, taken: float) -> tuple[float, Array, float] | None:
        periods = (self._past[-1][0] - taken) / self._dt
        if not -0.5 <= periods < len(self._past) - 0.5:
            return None  # from before the run, or by an unknown clock
        near = self._past[-1 - round(periods)]
        if abs(near[0] - taken) > 2.0 * self._dt:  # periods were missed
            near = min(self._past, key=lambda each: abs(each[0] - taken))
        return near if abs(near[0] - taken) <= 2.0 * self._dt else None

    def _frame(self, instant: tuple[float, Array, float], x: Array, x_d: Array) -> _Frame:
        t, q, path = instant
        rotation = self._turn if self._link is None else self._turn @ self._link.placement(q)[0]
        return _Frame(t, x, self._task.value(q), path, rotation, x_d)

    def _is_off(self, new: _Frame, old: _Frame) -> bool:
        seen, believed = self._motions(new, old)
        turned, besides = self._slack(new, old)
        if self._is_learnt:
            off = np.abs(self._sizes(seen) - self._sizes(believed))
            return bool((off > self._noise + besides + turned * self._is_place).any())
        slack = self._noise + besides
        off = seen - believed
        if not (self._sizes(off) > slack).any():  # mostly nothing needs a tool
            return False
        return bool((self._sizes(self._unexplained(off, turned, new, old)) > slack).any())

    def _is_still(self, new: _Frame, old: _Frame) -> bool:
        """Return True if x stands still although its target and the joints move.

        Half of the slack is allowed for. The target has to move, too, as joints may turn about a
        tip that rests.
        """
        seen, believed = self._motions(new, old)
        if (self._sizes(seen) > self._noise).any():
            return False
        turned, besides = self._slack(new, old)
        led = self._sizes(self._task.error(new.x_d, old.x_d))
        way = np.minimum(self._sizes(seen - believed), led)
        return bool((way > self._noise + 0.5 * (besides + turned * self._is_place)).any())

    def _motions(self, new: _Frame, old: _Frame) -> tuple[Array, Array]:
        return self._task.error(new.x, old.x), self._task.error(new.x_hat, old.x_hat)

    def _slack(self, new: _Frame, old: _Frame) -> tuple[float, Array]:
        """Return the errors of motion by a displaced tip [m], and by Ĵ (one per unit)."""
        # ‖R' − R‖ is √2 times smaller in the spectral norm than in Frobenius'
        turned = self._tool * float(np.linalg.norm(new.rotation - old.rotation)) / math.sqrt(2.0)
        return turned, self._share * self._norms * max(new.path - old.path, 0.0)

    def _unexplained(self, error: Array, turned: float, new: _Frame, old: _Frame) -> Array:
        left = error.copy()
        for group in (self._groups[i] for i in np.flatnonzero(self._is_place)):
            along = np.zeros(len(group))
            if self._is_spatial:
                turn = pin.log3(new.rotation @ old.rotation.T)
                along = turn * (turn @ error[group]) / max(turn @ turn, 1e-18)
            across = error[group] - along
            size = max(math.hypot(*across.tolist()), 1e-12)
            left[group] = along + max(1.0 - turned / size, 0.0) * across
        return left

    def _sizes(self, error: Array) -> Array:
        return np.array([math.hypot(*error[group].tolist()) for group in self._groups])
