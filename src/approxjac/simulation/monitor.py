"""`Monitor`: what happens to an arm, by its measurements, its torques and the believed robot."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.controllers.controller import Controller
from approxjac.controllers.learning.kinematic_report import UNEXPLAINED
from approxjac.errors import InvalidInputError
from approxjac.interface import Condition, Measurement
from approxjac.robots import Dynamics, Robot
from approxjac.simulation.drift import DriftWatch
from approxjac.tasks.frame_tasks import FrameKinematics
from approxjac.validation import Array

_GAP = 0.1  # s, after which it begins anew
_FILTER = 0.006  # s, of the observed torque
_TICK = 0.004  # s, from look to look at it
_WINDOW = 25  # looks, over which causes are compared
_BEGINS = 0.15  # s, in which the load is found before anything is named
_EFFORT = 50.0  # N m, of a joint without a limit
_MODEL, _INERTIA = 0.004, 0.08  # of the largest torque, and of inertial ones: what is not known
_TURNED = 0.004  # kg m², of an unknown load about the tip
_LOADS = np.array([3.0, 0.5, 0.5, 0.5])  # kg and kg m, which are expected at the tip
_LEVERS = np.array([3.0, 0.2, 0.2, 0.2])  # the same, of what is grasped
_FRICTION, _CONSTANT = 0.05, 0.01  # of the largest torque: friction, other errors
_BY_LOAD, _STICKS = 0.06, 1.2  # share of a joint's torque that adds to its friction; at rest
_ROTOR = 5e-3  # s², of the largest torque: the inertia of a rotor
_DRIFT = 0.07  # per √s, of these: how they change
_OPENS = 0.02  # s of that drift a look, while something lasts
_SLIDES = 0.02  # rad/s or m/s, from which on a joint slides
_SURE = 16.0  # of χ² of a joint: what is no noise
_LIKELY, _TESTED = 9.0, 25  # of the same: what may be a motor alone; looks in which it has to show
_TELLS = 60.0  # χ² that a cause explains at least
_USED, _STUCK = 0.05, 0.1  # of the largest torque, which a motor has to lack; more if it stood
_SIX_SD = 36.0  # χ² of one number
_LIKE = 30.0  # looks that tell the same
_SOON, _ALONE = 0.0075, 0.02  # s, after which a motor is named that explains all, or nearly
_SLOWLY, _LOAD = 0.06, 0.7  # s, after which another cause is, or a load
_SAMPLES = 12  # in which a joint has become too fast
_SUDDEN = 0.4  # s, within which a motor's fault shows
_EXPLAINS, _FITS = 0.1, 0.35  # share of χ² that one motor, or a force or load, may leave
_ONE_FITS = 0.1  # of χ², by which one number may explain less than three
_TURNED_BACK, _SOON_SURE = 0.15, 6.0  # of a share of 2, as of a reversed motor; χ² enough then
_LONE, _BESIDE = 0.05, 0.2  # share of χ² that one joint's motion may leave; of what others leave
_MOST_LACKS, _LEAST_JOINTS = 3.0, 5  # of its torque, behind a rotor; joints that tell one from all
_COARSE = 0.3  # of the jump of q̇ at a step of an encoder: its standard deviation
_STEPS = 3.0  # of an encoder, by which a joint has moved otherwise than before
_ONSET, _BETTER = 0.02, 12.0  # s, in which no motor is at fault if a load or force explains more χ²
_CLEAR = 0.06  # share that a motor may leave to be clear, where a force leaves five times that
_WEAK, _DEAD = 0.35, 0.65  # share of its torque that a weak or a dead motor lacks
_STOP = 0.01  # rad or m, so near to which a joint may be at its stop
_LEAST_FORCE = 3.0  # N
_LIGHTEST, _SURELY = 0.2, 2.0  # kg, and standard deviations, of a change of the mass at the tip
_UPRIGHT = math.cos(math.radians(50.0))  # from which on a force may be a weight
_MEETS = 0.01  # m/s, of a tip that meets something
_ENDS = 0.15  # s, without a disturbance
_ABSORBED = 1.5  # s, after which what lasts is taken for a load
_HALF_WAVES = 6  # that are much alike
_ALIKE = 1.7  # times by which the lengths of two waves may differ
_LASTS, _KEEPS = 0.25, 0.75  # s, for which it swings at least, and what is left of it then
_OVER = 1.5  # periods without a turn, after which it is over
_SLOW = 0.5  # s, over which the speed is averaged about which a joint swings
_SWINGS = 0.01  # rad/s or m/s, at least
_VISIBLE, _VISIBLE_LED, _TOOL = 1e-4, 2e-3, 0.1  # m, of motion, while led, of a tool so long
_NOISY, _FRAME = 0.5, 0.1  # of the noise of x: what that may cause; a sample's share in an average
_NO_PLACE = 1e9  # m, rad or px
_SHAKES, _SHAKEN = 0.1, 0.1  # of the largest torque, on the average over s: else by torques
_LAGS = 0.5  # of what torques shake by, which shows in q̇ at another time than was thought
_STILL, _QUICK = 0.3, 0.4  # s: since the target moved; the longest period while it does
_COMPARED, _FRAMES = 2.0, 10  # s and frames, over which x is compared with what was learnt
_OFTEN = 0.25  # s, from one such comparison to the next


class Event(NamedTuple):
    """Something that happened to an arm in a run.

    Attributes:
        condition: Kind of the event.
        begin: Time at which it began [s].
        named: Time at which it was detected [s].
        end: Time at which it ended [s], infinite if it lasts.
        where: Joint, or direction in the world.
        figure: Its size, with the unit.
    """

    condition: Condition
    begin: float
    named: float
    end: float
    where: str
    figure: str

    @property
    def described(self) -> str:
        """The event as text: time, place, figure and remedy."""
        until = "on" if math.isinf(self.end) else f"to {self.end:.2f} s"
        when = f"from {self.begin:.2f} s {until}"
        return f"{when}, {self.where}: {self.figure}; {self.condition.message}"

    def __str__(self) -> str:
        return f"{self.condition.label} {self.described}"


class Monitor:
    """A monitor that detects each `Condition` of an arm, period by period.

    Torques that the believed robot does not explain are observed by its momentum [De Luca 2003].
    A Kalman filter takes what lasts for a load at the tip, friction and constant errors. What comes
    suddenly is compared with its possible causes: one motor that lacks a share of its torque, a
    force at the tip, a load. The torques of a robot that takes velocities are unknown, so that only
    oscillations, an unexplained x, and a slipped tool or moved sensor of x (`DriftWatch`) are
    detected.

    Args:
        controller: The controller, which knows the believed robot and perhaps learns its
            kinematics.
        adds_gravity: Robot whose gravity is added to the commands by the real one; None for none.

    Attributes:
        events: Events so far, in the order of their detection.
    """

    def __init__(self, controller: Controller, adds_gravity: Robot | None = None) -> None:
        robot = controller.task.robot
        self.events: list[Event] = []
        self._controller, self._robot, self._dynamics = controller, robot, Dynamics(robot)
        self._adds = None if adds_gravity is None else Dynamics(adds_gravity)
        self._tip = FrameKinematics(robot, robot.tip or robot.model.frames[-1].name)
        self._knows_torque = controller.command == "torque"
        known = np.isfinite(robot.effort_limits) & (robot.effort_limits > 0.0)
        self._scale = np.where(known, robot.effort_limits, _EFFORT)
        self._swings = [_Swing() for _ in range(robot.nv)]
        self._swinging = np.zeros(robot.nv, bool)
        self._t: float | None = None
        self._begun, self._looked, self._moved = 0.0, 0.0, -math.inf
        self._noise, self._slow, self._shakes, self._shaken, self._impulse = np.zeros((5, robot.nv))
        self._v, self._v_before, self._smooth_v, self._smooth_torque = np.zeros((4, robot.nv))
        self._stood = np.ones(robot.nv)  # until lately
        self._active: dict[str, int] = {}  # name of a cause → its event
        self._window: deque[_Tick] = deque(maxlen=_WINDOW)
        # the last looks, as long as each is nearly too far off; how joints moved before, and by how
        # much they moved otherwise since; the smallest step of their encoders
        self._lately: list[_Tick] = []
        self._coasts, self._swept, self._step, self._jump, self._q = np.zeros((5, robot.nv))
        self._samples: deque[tuple[float, Array, Array, Array]] = deque(maxlen=_SAMPLES)
        self._since, self._quiet, self._speed = math.nan, 0.0, np.zeros(3)
        self._is_outside = False  # what happened to the arm, as its onset tells
        shares = np.outer([_CONSTANT, _FRICTION, _FRICTION, _ROTOR], self._scale)
        sd = np.concatenate([_LOADS, *shares, np.full(robot.nv, _BY_LOAD)])
        self._estimate, self._P = np.zeros(len(sd)), np.diag(sd**2)
        self._drift = (_DRIFT * sd) ** 2
        self._brakes = slice(4 + robot.nv, None)  # what only brakes, in these
        self._weighed, self._lighter = math.inf, 0.0  # when, and the mass at the tip before
        kinematics = controller.kinematics
        self._learns = kinematics is not None and bool(kinematics.names)
        self._left, self._compares = np.zeros(0), 0.0
        self._changes = DriftWatch(controller)
        self._x: deque[Array] = deque(maxlen=3)  # of the last frames
        self._x_variance = np.zeros(controller.task.measured.m)
        self._frames: deque[tuple[float, Array, Array]] = deque()

    def look(
        self, measurement: Measurement, torque: Array, reference: Array | None, state: Array
    ) -> bool:
        """Process a sample; return True if an event was detected.

        Args:
            measurement: The sample.
            torque: Command since the sample before, shape (n_v,) [N m or N].
            reference: Desired joint velocity, shape (n_v,) [rad/s or m/s]; None is zero.
            state: State of the controller.
        """
        t, q, v, x, _ = measurement
        count, last, self._t = len(self.events), self._t, t
        if not math.isfinite(math.hypot(*q.tolist(), *v.tolist())):
            self._t = last
            return False
        if change := self._changes.look(measurement, state):
            condition, begin, *_ = change
            moved = {Condition.TOOL_SLIPPED: self._tip.frame, Condition.SENSOR_MOVED: "sensor of x"}
            where = moved.get(condition, " or ".join(moved.values()))
            self.events.append(Event(condition, begin, t, math.inf, where, change.figure))
        if last is None or not 0.0 < t - last < _GAP:
            self._begin(t, q, v, torque)
        else:
            if self._adds is not None:
                torque = torque + self._adds.g(q)
            self._samples.append((t, q, v, torque))
            h = t - last
            way = pin.difference(self._robot.model, self._q, q)
            self._swept = self._swept + way - h * self._coasts
            self._step = np.where(way == 0.0, self._step, np.minimum(self._step, np.abs(way)))
            self._q = q
            # how q̇ jumps as its encoder makes one step
            steps = (way != 0.0) & (np.abs(way) < 1.5 * self._step)
            jump = self._jump + _FRAME * (np.abs(v - self._v) - self._jump)
            self._jump = np.where(steps, jump, self._jump)
            odd = v - 2.0 * self._v + self._v_before
            odd = np.minimum(odd * odd / 6.0, 9.0 * self._noise + 1e-6)
            self._noise = self._noise + min(5.0 * h, 1.0) * (odd - self._noise)
            self._v_before, self._v = self._v, v
            self._impulse = self._impulse + h * torque
            self._shaken = self._shaken + h * np.abs(torque - self._smooth_torque)
            if t >= self._looked + _TICK * (1.0 - 1e-6):
                if self._knows_torque:
                    self._observe(t - self._looked, q, v)
                    self._tick(t, t - self._looked, q)
                self._looked = t
                if self._learns:
                    self._compare(t, q, v, state)
                elif self._controller.kinematics is None:
                    self._watch(x)
            self._swing(t, h, q, v, reference)
        return len(self.events) > count

    def with_controller(self, controller: Controller) -> Monitor:
        """Return a monitor of the same arm with another controller, which keeps the events."""
        monitor = Monitor(controller, None if self._adds is None else self._adds.robot)
        monitor.events = self.events
        return monitor

    # -- oscillations ---------------------------------------------------------------------

    def _swing(self, t: float, h: float, q: Array, v: Array, reference: Array | None) -> None:
        beyond = v
        if reference is not None and reference.any():
            beyond, self._moved = v - reference, t
        moves = t - self._moved < _STILL
        # what swings may move slowly meanwhile, unless it is led
        self._slow = self._slow + h / (h + _SLOW) * (v - self._slow)
        if moves:  # both the joint and what it differs by from its reference turn back
            least = np.minimum(np.abs(v), np.abs(beyond))
            v = np.where(v * beyond > 0.0, np.sign(v) * least, 0.0)
        else:
            v = v - self._slow
        for j in np.flatnonzero((np.abs(v) >= _SWINGS) | self._swinging).tolist():
            swing, name = self._swings[j], f"swing {j}"
            if self._swinging[j] and t - swing.turned > _OVER * swing.period:
                self._end(name, swing.turned)
                self._swinging[j] = False
            if not swing.look(t, h, float(v[j])) or self._swinging[j] or not swing.lasts:
                continue
            amplitude, period = swing.amplitude, swing.period
            # less than a step of its encoder is that step to and fro
            if (moves and period > _QUICK) or amplitude < self._step[j]:
                continue
            unit, joint = self._robot.joint_units[j], self._robot.joint_names[j]
            away, turns = self._tip.jacobian(q).reshape(2, 3, -1)
            way = np.linalg.norm(away[:, j]) + _TOOL * np.linalg.norm(turns[:, j])
            visible = way * amplitude > (_VISIBLE_LED if moves else _VISIBLE)
            if visible and self._x_variance.any():
                # x moves as the tip does, as far as one can tell of joints and tool
                rows = np.linalg.norm(self._controller.task.measured.jacobian(q), axis=1)
                of_x = way * amplitude * rows / np.linalg.norm(away)
                visible = (of_x > _NOISY * np.sqrt(self._x_variance)).any()
            if visible or self._shakes[j] > _SHAKES * self._scale[j]:
                figure = f"{amplitude:.2g} {unit} at {1.0 / period:.3g} Hz"
                self._note(name, Condition.OSCILLATES, swing.begin, joint, figure)
                self._swinging[j] = True

    def _watch(self, x: Array) -> None:
        """Estimate the noise of x, which a law on the measured x follows."""
        if not (np.abs(x) < _NO_PLACE).all() or (self._x and np.array_equal(x, self._x[-1])):
            return
        self._x.append(x)
        if len(self._x) == 3:
            error, (a, b, c) = self._controller.task.measured.error, self._x
            odd = error(c, b) - error(b, a)
            self._x_variance = self._x_variance + _FRAME * (odd * odd / 6.0 - self._x_variance)

    # -- what was learnt ------------------------------------------------------------------

    def _compare(self, t: float, q: Array, v: Array, state: Array) -> None:
        """Compare x with the learnt kinematics, and check whether it is late."""
        try:
            kinematics, known = self._controller.kinematics_of(state)
        except InvalidInputError:  # a controller of a user's own that does not tell
            self._learns = False
            return
        left = kinematics.left_over(known)
        if not np.array_equal(left, self._left):  # a new frame
            self._left = left
            speed = self._controller.task.measured.jacobian(q) @ v
            if speed.shape == left.shape:
                self._frames.append((t, left, speed))
        while self._frames and t - self._frames[0][0] > _COMPARED:
            self._frames.popleft()
        if t < self._compares or len(self._frames) < _FRAMES:
            return
        self._compares = t + _OFTEN
        report = kinematics.report(known)
        chi = report.chi_squared
        is_off = chi > UNEXPLAINED and report.seconds > _COMPARED
        if not is_off:
            if "x" in self._active and chi < 0.8 * UNEXPLAINED:
                self._end("x", t)
            return
        if "x" in self._active:
            return
        _, lefts, speeds = (np.array(each) for each in zip(*self._frames, strict=True))
        along, moved = float(np.sum(lefts * speeds)), float(np.sum(speeds**2))
        share = along**2 / max(moved * float(np.sum(lefts**2)), 1e-30)
        where, figure = "kinematics", f"chi squared {chi:.2g} per degree of freedom"
        if share > 0.5:
            late = -along / moved
            sense = "later" if late > 0.0 else "earlier"
            where, figure = "delay", f"x is {1e3 * abs(late):.0f} ms {sense} than it is stamped"
        self._note("x", Condition.NOT_EXPLAINED, t - _COMPARED, where, figure)

    # -- disturbances ---------------------------------------------------------------------

    def _begin(self, t: float, q: Array, v: Array, torque: Array) -> None:
        self._v = self._v_before = self._smooth_v = self._coasts = v
        self._q, self._swept, self._step = q, np.zeros(len(v)), np.full(len(v), math.inf)
        self._begun = self._looked = t
        self._over(t)
        self._samples.clear()
        self._lately = []
        self._weighed = math.inf
        self._residual, self._smooth_torque = np.zeros(len(v)), torque
        self._impulse = self._shaken = np.zeros(len(v))
        if self._knows_torque:
            self._M = self._dynamics.M(q)
            self._momentum, self._rate = self._M @ v, self._rest(q, v)
            self._smooth_tip = self._tip.jacobian(q) @ v

    def _rest(self, q: Array, v: Array) -> Array:
        """Return Cᵀq̇ − g."""
        return self._dynamics.C(q, v).T @ v - self._dynamics.g(q)

    def _observe(self, h: float, q: Array, v: Array) -> None:
        """Filter the torque that changes the momentum more than motors and gravity do."""
        share = h / (h + _FILTER)
        rest, self._M = self._rest(q, v), self._dynamics.M(q)
        momentum, torque = self._M @ v, self._impulse / h
        gained = (momentum - self._momentum) / h - torque - 0.5 * (rest + self._rate)
        self._momentum, self._rate = momentum, rest
        self._residual = self._residual + share * (gained - self._residual)
        self._smooth_torque = self._smooth_torque + share * (torque - self._smooth_torque)
        self._smooth_v = self._smooth_v + share * (v - self._smooth_v)
        stands = 1.0 - np.abs(np.tanh(self._smooth_v / _SLIDES))
        self._stood = np.maximum(stands, self._stood - h / _SUDDEN)
        self._shakes = self._shakes + h / (h + _SHAKEN) * (self._shaken / h - self._shakes)
        self._impulse = self._shaken = np.zeros(len(v))
        self._smooth_tip = self._smooth_tip + share * (self._tip.jacobian(q) @ v - self._smooth_tip)

    def _tick(self, t: float, h: float, q: Array) -> None:
        """Compare the observed torque with what is expected; h is the time since the last look."""
        H, variance, stuck, J, load = self._expected(q)
        _diagonal(self._P)[:] += h * self._drift
        PH = self._P @ H.T
        S = H @ PH
        _diagonal(S)[:] += variance + stuck**2
        off = self._residual - H @ self._estimate
        likely = self._likely(H, off)
        spread = np.einsum("ij,jk,ik->i", likely, self._P, likely) + variance + stuck**2
        chi = float((off**2 / spread).max()) if t - self._begun > _BEGINS else 0.0
        is_off = chi > _SURE
        weight = 1.0 / np.sqrt(spread)
        tick = _Tick(off, weight, self._smooth_torque, J, load, likely, variance, stuck)
        self._lately = [*self._lately[-_TESTED:], tick] if chi > _LIKELY else []
        if not self._lately:
            self._coasts, self._swept = self._smooth_v, np.zeros(len(off))
        if is_off or self._window:
            if not self._window:
                self._since, self._lighter = t, float(self._estimate[0])
                self._is_outside = False
                self._speed = self._smooth_tip[:3]
            self._quiet = 0.0 if is_off else self._quiet + h
            self._window.append(tick)
            if self._quiet > _ENDS:
                self._over(t)
            else:
                self._name(t)
        is_free = not self._active.keys() & {"motor", "force"}
        if is_free and 1 < len(self._lately) < _TESTED and (lone := self._lone(self._lately)):
            if not self._window:
                self._since, self._quiet = t - h * (len(self._lately) - 1), 0.0
                self._window.extend(self._lately)
            self._weak_motor(lone[0], max(lone[1], self._lacks(lone[0])), lone[2])
        lasts = bool(self._window) and t - self._since > _ABSORBED
        if lasts:
            _diagonal(self._P)[:] += _OPENS * self._drift
        if lasts or not self._window:
            _diagonal(S)[:] += (_LIKE - 1.0) * (variance + stuck**2)
            gain = np.linalg.solve(S, PH.T).T
            self._estimate = self._estimate + gain @ off
            P = self._P - gain @ PH.T
            self._P = P = 0.5 * (P + P.T)
            first = self._brakes.start
            wrong = first + np.flatnonzero(self._estimate[first:] < 0.0)  # what would drive
            if wrong.size:  # the estimate nearest to it, in the metric of P, without these
                least = np.linalg.solve(P[np.ix_(wrong, wrong)], self._estimate[wrong])
                self._estimate = self._estimate - P[:, wrong] @ least
        if t > self._weighed:
            self._weigh()

    def _likely(self, H: Array, off: Array) -> Array:
        """Return H as far as its numbers may explain `off`.

        Friction and rotors brake: that they are less than expected explains no more than they are.
        """
        brakes = H[:, self._brakes]
        sd = np.sqrt(np.diag(self._P)[self._brakes])
        less = np.clip(self._estimate[self._brakes] / sd, 0.0, 1.0)
        H = H.copy()
        H[:, self._brakes] = np.where(brakes * off[:, np.newaxis] > 0.0, brakes, less * brakes)
        return H

    def _whitened(self, ticks: list[_Tick]) -> tuple[Array, ...]:
        """Return off, torque, J and load of looks as multiples of what else may explain them."""
        off, _, torque, J, load, likely, variance, stuck = map(np.array, zip(*ticks, strict=True))
        J = np.concatenate([J, np.swapaxes(load, 1, 2)], axis=1)
        C = np.einsum("tij,jk,sik->its", likely, self._P, likely)
        C += np.einsum("ti,ts->its", variance, np.eye(len(ticks)))
        C += np.einsum("ti,si->its", stuck, stuck)  # what holds a joint lasts
        W = np.linalg.inv(np.linalg.cholesky(C))  # (n, t, t)
        J = np.einsum("its,ski->tki", W, J)
        return *(np.einsum("its,si->ti", W, each) for each in (off, torque)), J[:, :3], J[:, 3:]

    def _expected(self, q: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return the expected unexplained torque as a linear model.

        Its parts: the derivative by the filter's numbers (load; of each joint, constant error, dry
        and viscous friction, rotor, friction by load; n_v, 4 + 5 n_v), the variance of the rest
        (n_v,), the standard deviation of what holds joints that stand (n_v,), J of the tip
        (3, n_v), and the derivative by the load (n_v, 4).
        """
        n, v, rate = len(self._residual), self._smooth_v, 1.0 / _FILTER
        J, R, _ = self._tip.motion(q)
        J, R = J.copy(), R.copy()
        # a load at the tip: its mass, and its first moment in the tip's axes
        moves = self._smooth_tip
        speeds = rate * (J @ self._v - moves)
        spin, turn = pin.skew(moves[3:]), pin.skew(speeds[3:])
        pull = self._robot.gravity - speeds[:3]
        load = np.empty((n, 4))
        load[:, 0] = J[:3].T @ pull
        load[:, 1:] = (-J[:3].T @ (turn + spin @ spin) - J[3:].T @ pin.skew(pull)) @ R
        slides, carried, gains = np.tanh(v / _SLIDES), np.abs(self._smooth_torque), self._v - v
        own = np.ones(n), slides, v, rate * gains, slides * carried
        H = np.hstack([load, *(-np.diag(each) for each in own)])
        rubs = np.hstack([np.zeros((n, 4 + n)), np.eye(n), np.zeros((n, 2 * n)), np.diag(carried)])
        variance = (_MODEL * self._scale) ** 2 + rate**2 * self._M**2 @ self._of_v
        variance += _INERTIA**2 * self._M**2 @ (rate * gains) ** 2
        variance += (_TURNED * float(np.linalg.norm(speeds[3:]))) ** 2 * (J[3:] ** 2).sum(axis=0)
        variance += (_LAGS * self._shakes) ** 2
        friction = np.einsum("ij,jk,ik->i", rubs, self._P, rubs) + (rubs @ self._estimate) ** 2
        stuck = _STICKS * (1.0 - np.abs(slides)) * np.sqrt(friction)
        at_stop = self._robot.beyond_limits(q[None])[0] > -_STOP
        return H, np.where(at_stop, variance + self._scale**2, variance), stuck, J[:3], load

    @property
    def _of_v(self) -> Array:
        """Variance of q̇, by noise and by the steps of encoders, (n_v,)."""
        return np.asarray(self._noise + (_COARSE * self._jump) ** 2)

    def _name(self, t: float) -> None:
        """Name the cause that explains the last looks, if one does."""
        since, ticks = t - self._since, list(self._window)
        ticks = ticks[1:] if len(ticks) > 3 else ticks
        if len(ticks) < 3 or self._active.keys() & {"motor", "force"}:
            return
        off, torque, J, load = self._whitened(ticks)
        even = np.ones_like(off)
        j, share, left, force, left_force, whole = _causes(off, even, torque, J)
        used, tells = float(abs(ticks[-1].torque[j])), whole * (1.0 - left_force) > _TELLS
        other = min(left_force, _fit(load, off, even, whole, _LEVERS)[1])
        if since <= _ONSET:
            self._is_outside |= whole * (left - other) > _BETTER
        alone = whole * (1.0 - left) > _TELLS and left < min(_CLEAR, 0.3 * other)
        # a share that is surely not 0, leaves what noise does, and is likelier than a force or load
        alone |= (
            whole * (1.0 - left) > _SIX_SD and share > _DEAD
            and whole * left < off.size and whole * (other - left) > _SURE
        )  # fmt: skip
        # without what noise leaves
        above = max(whole - off.size, 1e-12)
        left, beside = (max(each * whole - off.size, 0.0) / above for each in (left, other))
        fits = above > _TELLS and left < min(_EXPLAINS, 0.3 * beside)
        fits = (fits or alone) and share > _WEAK
        is_sudden = since < _SUDDEN and self._since > self._begun + _BEGINS + 1.5 * _TICK
        is_sudden &= not self._is_outside
        least = (_USED + _STUCK * self._stood[j]) * self._scale[j]
        if is_sudden and fits and used > least:
            if since < _SLOWLY:
                share = self._lacks(j)
            is_clear = share > _DEAD and left < _CLEAR < 0.2 * beside
            if since >= (_SOON if is_clear else _ALONE if alone else _SLOWLY):
                self._weak_motor(j, share, used)
        elif since >= _SLOWLY and tells and not self._quiet:
            off, weight, _, J, load, *_ = map(np.array, zip(*ticks, strict=True))
            w2 = weight**2
            whole = float((w2 * off**2).sum())
            force, left_force = _fit(J, off, w2, whole)
            carried, left_load = _fit(np.swapaxes(load, 1, 2), off, w2, whole, _LEVERS)
            if np.linalg.norm(force) > _LEAST_FORCE:
                self._force(since, force, left_force, float(carried[0]), left_load)

    def _lone(self, ticks: list[_Tick]) -> tuple[int, float, float] | None:
        """Return the motor that alone moves its joint otherwise than it is asked to, if one does.

        With a rotor and behind a spring, its momentum is not the believed one. So its torque and
        acceleration are free in each look: what that leaves to the other joints is compared with
        what a force at the tip or a load leaves. Returned are the joint, the share of its torque
        that it lacks (behind a spring roughly), and the torque.
        """
        off, weight, torque, J, load, *_ = map(np.array, zip(*ticks, strict=True))
        w2, z, loads = weight**2, weight * off, np.swapaxes(load, 1, 2)
        whole, j = float((z**2).sum()), int((z**2).sum(axis=0).argmax())
        share = -float(off[:, j].sum()) / (float(torque[:, j].sum()) or 1e-12)
        used = float(abs(torque[-1, j]))
        # friction may hold a joint, but turns none back
        stuck = 0.0 if share > 1.0 + _WEAK else _STUCK * self._stood[j]
        if not (
            _DEAD < share < _MOST_LACKS and used > (_USED + stuck) * self._scale[j]
            and abs(self._swept[j]) > _STEPS * self._step[j] and z.shape[1] >= _LEAST_JOINTS
        ):  # fmt: skip
            return None
        rest, moves = np.delete(z, j, axis=1), np.delete(weight * self._M[j], j, axis=1)
        along, size = (rest * moves).sum(axis=1), (moves**2).sum(axis=1)
        left = float((rest**2).sum() - (along**2 / np.maximum(size, 1e-12)).sum())
        beside = min(_fit(J, off, w2, whole)[1], _fit(loads, off, w2, whole, _LEVERS)[1])
        if whole - left < _SIX_SD or left > whole * min(_LONE, _BESIDE * beside):
            return None
        return j, share, used

    def explain(self) -> None:
        """Name what made a joint too fast, a motor or a force, if the last samples show it.

        What is seen in a few milliseconds is clear only where an arm gets out of control.
        """
        if not self._knows_torque:
            return
        ticks = [self._last(k) for k in range(1, len(self._samples))]  # since when, nobody knows
        causes = [_causes(*(each[None] for each in tick[:4])) for tick in ticks]
        explained = [-each.whole * (1.0 - min(each.left, each.left_force)) for each in causes]
        for i in np.argsort(explained).tolist():
            j, share, left, force, left_force, whole = causes[i]
            self._since = self._samples[-2 - i][0]
            # a force has three numbers to fit, a motor one
            is_motor = left < min(_FITS, left_force + _ONE_FITS) and _WEAK < share < 2.0 + _WEAK
            turns_back = abs(share - 2.0) < _TURNED_BACK and left < 0.5 * left_force
            is_motor = is_motor or turns_back
            least = _SOON_SURE if turns_back else _SURE
            if whole <= least or self._active.keys() & {"motor", "force"}:
                break
            if lone := self._lone([ticks[i]]):
                self._weak_motor(*lone)
            elif is_motor:
                self._weak_motor(j, share, float(abs(ticks[i].torque[j])))
            elif left_force < _FITS and np.linalg.norm(force) > _LEAST_FORCE:
                self._force(_SLOWLY, force, left_force, 0.0, 1.0)

    def _last(self, k: int) -> _Tick:
        """Return the torques that nothing explains, on the average over the last k samples."""
        samples = list(self._samples)[-1 - k :]
        times, (_, q0, v0, _), (_, q, v, _) = [each[0] for each in samples], samples[0], samples[-1]
        H, variance, stuck, J, load = self._expected(q)
        steps, h = np.diff(times), times[-1] - times[0]
        given = steps @ np.array([each[3] for each in samples[1:]]) / h
        gained = (self._M @ v - self._dynamics.M(q0) @ v0) / h - given
        off = gained - 0.5 * (self._rest(q, v) + self._rest(q0, v0)) - H @ self._estimate
        variance = variance + 2.0 / h**2 * self._M**2 @ self._of_v
        return _Tick(off, 1.0 / np.sqrt(variance + stuck**2), given, J, load, H, variance, stuck)

    def _lacks(self, j: int) -> float:
        """Return the share of its torque that a motor lacks, before the filter has settled."""
        since = sum(t > self._since - 0.5 * _TICK for t, *_ in self._samples)
        last = self._last(min(_SAMPLES // 2, len(self._samples) - 1, max(since, 1)))
        return -float(last.off[j]) / float(last.torque[j] or 1e-12)

    def _weak_motor(self, j: int, share: float, torque: float) -> None:
        gives = "nothing" if share > _DEAD else f"{100.0 * (1.0 - share):.0f} %"
        what = "turns the wrong way, with" if share > 1.0 + _WEAK else f"gives {gives} of"
        figure = f"it {what} {torque:.3g} {self._robot.force_units[j]}"
        self._note("motor", Condition.MOTOR_WEAK, self._since, self._robot.joint_names[j], figure)

    def _force(
        self, since: float, force: Array, left_force: float, mass: float, left_load: float
    ) -> None:
        """Name a force at the tip [N], or a mass [kg], by the shares of χ² that they leave."""
        strength, g = float(np.linalg.norm(force)), self._robot.gravity
        toward = force / strength
        before, now = float(toward @ self._speed), float(toward @ self._smooth_tip[:3])
        upright = float(toward @ g) / max(float(np.linalg.norm(g)), 1e-9)
        condition = Condition.PUSHED
        if before < -_MEETS and -0.5 < now / -before < 0.3 and upright < _UPRIGHT:
            condition = Condition.PRESSES  # it moved towards what stopped it
        elif abs(upright) > _UPRIGHT and not (
            since > 2.0 * _SLOWLY and left_load > 2.0 * left_force + 0.1
        ):
            if since < _LOAD:
                return
            if left_load < _FITS:
                condition = Condition.TOOL_CHANGED
                self._note("force", condition, self._since, self._tip.frame, f"{mass:+.2g} kg")
                return
        if left_force < _FITS:
            x, y, z = toward
            where = f"towards ({x:.2f}, {y:.2f}, {z:.2f})"
            self._note("force", condition, self._since, where, f"{strength:.2g} N")

    def _weigh(self) -> None:
        """Compare the mass at the tip with that before a disturbance that nothing explained."""
        self._weighed = math.inf
        mass, sd = float(self._estimate[0]) - self._lighter, math.sqrt(float(self._P[0, 0]))
        if abs(mass) > max(_LIGHTEST, _SURELY * sd) and self._robot.gravity.any():
            figure = f"{mass:+.2g} kg"
            self._note("load", Condition.TOOL_CHANGED, self._since, self._tip.frame, figure)
            self._active.pop("load")

    def _over(self, t: float) -> None:
        named = self._active.keys() & {"motor", "force"}
        for name in named:
            self._end(name, t - self._quiet)
        if self._window and not named:
            _diagonal(self._P)[:] += self._drift
            self._weighed = t + _LOAD
        self._window.clear()
        self._quiet = 0.0

    def _note(self, name: str, condition: Condition, begin: float, where: str, figure: str) -> None:
        assert self._t is not None
        self._active[name] = len(self.events)
        self.events.append(Event(condition, begin, self._t, math.inf, where, figure))

    def _end(self, name: str, t: float) -> None:
        k = self._active.pop(name)
        self.events[k] = self.events[k]._replace(end=t)


def _diagonal(matrix: Array) -> Array:
    """Return the diagonal of a matrix, to be changed in place."""
    return np.einsum("ii->i", matrix)


def _fit(
    A: Array, off: Array, w2: Array, whole: float, sd: float | Array = 100.0
) -> tuple[Array, float]:
    """Return the constant that explains torques best by rows A (t, k, n), and the share left.

    It is about 0, with a standard deviation.
    """
    a = np.einsum("tin,tn,tjn->ij", A, w2, A)
    _diagonal(a)[:] += len(off) / np.square(sd)
    b = np.einsum("tin,tn->i", A, w2 * off)
    best: Array = np.linalg.solve(a, b)
    return best, 1.0 - float(b @ best) / max(whole, 1e-300)


class _Causes(NamedTuple):
    """Shares of torques that one motor, or a force at the tip, explains and leaves."""

    j: int  # the motor
    share: float  # of its torque that it lacks
    left: float  # share of χ² that it does not explain
    force: Array  # [N]
    left_force: float
    whole: float  # χ²


def _causes(off: Array, weight: Array, torque: Array, J: Array) -> _Causes:
    w2 = weight**2
    whole = float((w2 * off**2).sum())
    force, left_force = _fit(J, off, w2, whole)
    # of each motor alone: the share of its torque that it lacks
    along, size = -(w2 * off * torque).sum(axis=0), (w2 * torque**2).sum(axis=0) + 1e-12
    left = 1.0 - along**2 / (size * max(whole, 1e-300))
    j = int(left.argmin())
    return _Causes(j, float(along[j] / size[j]), float(left[j]), force, left_force, whole)


class _Tick(NamedTuple):
    """A sample of torques that nothing explains so far."""

    off: Array
    weight: Array
    torque: Array
    J: Array  # of the tip's position
    load: Array
    likely: Array  # derivative by what is known of joints and load, as far as it explains this
    variance: Array  # of the rest
    stuck: Array  # standard deviation of what holds joints that stand


class _Swing:
    """The half waves of one joint, as long as they are alike."""

    def __init__(self) -> None:
        self._sign, self._way, self._farthest = 0.0, 0.0, 0.0
        self.turned = 0.0  # when it last did
        self._times: deque[float] = deque(maxlen=4)  # of half waves
        self._sizes: deque[float] = deque(maxlen=4)
        self._count, self._begun, self._first = 0, math.nan, 0.0

    def look(self, t: float, h: float, rate: float) -> bool:
        """Add a sample that holds for h [s]; return True where the joint turned back."""
        self._way += h * rate
        if self._way * self._sign > self._farthest * self._sign:
            self._farthest = self._way
        if abs(rate) < _SWINGS or rate * self._sign > 0.0:
            return False
        if self._sign != 0.0:
            self._add(t)
        self._way -= self._farthest
        self._sign, self.turned, self._farthest = math.copysign(1.0, rate), t, self._way
        return True

    def _add(self, t: float) -> None:
        self._times.append(t - self.turned)
        self._sizes.append(abs(self._farthest))
        if len(self._times) < 4:
            return
        a, b, c, d = self._times
        low, high = sorted((a + b, c + d))
        size = self.amplitude
        if high > _ALIKE * low or max(self._sizes) > 4.0 * min(self._sizes):
            self._count = 0
        self._count += 1
        if self._count == 1 or (self._count > 2 * _HALF_WAVES and t - self._begun > 2.0 * _LASTS):
            self._count, self._begun, self._first = 1, t, size

    @property
    def lasts(self) -> bool:
        """True if it swung long enough and kept `_KEEPS` of its first amplitude."""
        enough = self._count + 3 >= _HALF_WAVES and self.turned - self._begun >= _LASTS
        return enough and self.amplitude >= _KEEPS * self._first

    @property
    def begin(self) -> float:
        """Time at which it began to swing [s], four half waves before it was seen to."""
        return max(self._begun - 2.0 * self.period, 0.0)

    @property
    def amplitude(self) -> float:
        """Amplitude of the last waves [rad or m]."""
        return 0.5 * sum(self._sizes) / max(len(self._sizes), 1)

    @property
    def period(self) -> float:
        """Their period [s]."""
        return 2.0 * sum(self._times) / len(self._times) if self._times else math.inf
