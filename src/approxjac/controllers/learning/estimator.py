"""`Kinematics`, which predict the controlled error: known ones, and `Estimator`, which learns."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.controllers.arguments import LONGEST_DELAY, from_another_clock, time_of_x
from approxjac.controllers.learning.kinematic_report import SILENT, KinematicReport, LearntNumber
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement, Status, Target
from approxjac.law import PredictedError
from approxjac.robots import KinematicRegressor, Robot
from approxjac.robots.traced import motion_between, moved
from approxjac.tasks import Task
from approxjac.tasks.analysis import combination
from approxjac.validation import Array, Immutable, as_number, as_vector, read_only, require

_OK, _PREDICTED = Status.OK, Status.PREDICTED  # members of an enum are slow to look up
_LOST = Status.MEASUREMENT_LOST
_SPACING = 10e-3  # between remembered configurations, from which others are interpolated [s]
_HORIZON = 0.25  # age up to which a frame finds its configuration [s]
_LONG_AGO = -1e6  # [s]
_FOREVER = 1e15  # t of no clock [s]
_AHEAD = 1e-9  # by which a clock is on time [s]
_OTHER = 1.0  # by which it is another one [s]
_CLOSEST = 4e-3  # between frames, below which there is nothing to learn from the second one [s]
_FARTHEST = 1e3  # that anything is from the sensor [m]
_ROUND_OFF = 1e-9  # of times [s]
_SMOOTHING = 20.0  # β, how fast what is controlled follows what is learnt [1/s]
_INTEGRAL = 1.0  # ω_b, how fast what the parameters do not explain is taken up [1/s]
_EASED_SPEED = 0.5  # of x̂, by what is learnt [m/s]
_EASED_TURN = 2.0 * math.pi  # of the estimate of a rotation [rad/s]
_LONGEST_FRAME = 0.1  # time that one frame counts for [s]
_NOISE_MEMORY = 2.0  # of the noise that is seen [s]
_DIFFERENCE = 1e-5  # of values, either way, from which a rate is taken [unit of the task]
_TURNS_BACK = 10.0  # times as fast as what moves: an error that has jumped, as at half a turn
_JUMP = 8.0  # standard deviations of x, beyond which it has jumped


class Sight(NamedTuple):
    """A frame as kinematics expect it, in the units of their noise, (m,) numbers.

    Attributes:
        left: x minus what is predicted, (m,), the first point's place first; NaN where x is lost.
        H: Derivative of the prediction by what was learnt, shape (m, p).
        tool: Derivative by a motion of the tool on its flange, along its axes [m], (m, k).
        tool_turn: The same about its axes [rad], (m, 3) if x is a pose, else (m, 0).
        shift: Derivative by a motion of all that is seen along the sensor's axes [m], (m, d).
        turn: The same about the sensor's origin [rad], (m, 0) where x does not show it.
    """

    left: Array
    H: Array
    tool: Array
    tool_turn: Array
    shift: Array
    turn: Array


class Expectation(NamedTuple):
    """Expectation of the frames to come, by a state.

    Attributes:
        covariance: Covariance of what was learnt, shape (p, p).
        noise: Standard deviation of x, with what is not explained.
        sight: Function of a frame.
    """

    covariance: Array
    noise: float
    sight: Callable[[Measurement], Sight]


class Kinematics(Immutable, ABC):
    """Kinematics, known or learnt, that predict the error that a law controls.

    They learn only from the measured x in `step`. Immutable, but with scratch memory: one
    instance a thread.

    Attributes:
        task: The task of the believed robot.
        n_state: Length of a state.
    """

    task: Task
    n_state: int = 0
    names: tuple[str, ...] = ()  # of what `learnt` returns
    units: tuple[str, ...] = ()

    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step, shape (n_state,); by default none."""
        return np.zeros(self.n_state)

    def resumed(self, state: Array, measurement: Measurement) -> Array:
        """Return an initial state with the learnt numbers of another state, without its times.

        Raises an InvalidInputError for a state of other kinematics.
        """
        return self.initial_state(measurement)

    def step(self, state: Array, measurement: Measurement, dt: float) -> Array:
        """Return the state after learning from a measurement, and dt [s] later.

        An x that is lost, was seen before or jumps is ignored.
        """
        self.check(state, measurement, dt)
        state = state.copy()
        self.correct(state, measurement, dt)
        return state

    def check(self, state: Array, measurement: Measurement, dt: float) -> None:
        """Raise an InvalidInputError for a measurement unfit for `correct`, as one without time."""

    def correct(self, state: Array, measurement: Measurement, dt: float) -> None:
        """Do the work of `step` on a state, in place; by default nothing."""

    def status(self, state: Array, measurement: Measurement) -> Status:
        """Return the status of the prediction by a state.

        `MEASUREMENT_LOST` before x was ever seen, when the prediction is the believed one;
        `PREDICTED` if there has been no x to learn from for a second; else `OK`.
        """
        return Status.OK

    @abstractmethod
    def predict(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        """Return the predicted error at q (nq,) and q̇ (n_v,) [rad/s or m/s]."""

    def learnt(self, state: Array) -> Array:
        """Return the learnt numbers (…, p) of a state, or of a series of states (…, n_state).

        They are in the order of `names`, in `units`; by default none.
        """
        return state[..., :0]

    @property
    def parameters(self) -> Mapping[str, str]:
        """Name → unit of the numbers from `learnt`."""
        return dict(zip(self.names, self.units, strict=True))

    def sd_of(self, state: Array) -> Array:
        """Return the standard deviations of `learnt`, shape (p,)."""
        return np.array([row.sd for row in self.report(state).rows] if self.names else [])

    def motion_sd(self, state: Array, q_0: Array) -> Callable[[Array], Array] | None:
        """Return q → standard deviation (m,) [unit of the task] of the predicted motion from q_0.

        It is that of what a state has learnt. By default None, for kinematics that do not know.
        """
        return None

    def left_over(self, state: Array) -> Array:
        """Return the residual of the last x, (m,) in its units, or an empty array without one."""
        return np.zeros(0)

    def relearnt(self, state: Array) -> Array:
        """Return a state that learns anew, about what it has learnt and as unsure as at first.

        By default the state, for kinematics that do not learn.
        """
        return state

    def robot(self, state: Array) -> Robot:
        """Return the believed robot with the tool and joint origins that a state has learnt.

        It is without learnt masses, friction and tracker, which only the state has. Raises the
        errors of `report`.
        """
        raise InvalidInputError(f"kinematics must learn, got {self!r}", given=self)

    def report(self, state: Array) -> KinematicReport:
        """Return a report of a state: learnt numbers, standard deviations, and how well seen.

        Raises an InvalidInputError if the kinematics do not learn, or for a state of others.
        """
        raise InvalidInputError(f"kinematics must learn, got {self!r}", given=self)


class KnownKinematics(Kinematics):
    """z = h(q) − x_d of the believed arm; the measured x is not used.

    With a wrong model the arm reaches a wrong place. Raises an InvalidInputError for a task
    whose Jacobian depends on the measured x.
    """

    def __init__(self, task: Task) -> None:
        require("task", task, Task, "a task of the believed robot, such as PositionTask(robot)")
        if task.uses_x:
            raise InvalidInputError(
                f"task must have a Jacobian that depends on q only, such as an ImageTask with "
                f"depth='believed', got {task!r}",
                given=task,
            )
        self.task = task
        self._combination = combination(task)  # a target moves as what is measured does
        own = type(task).sensor_jacobian is not Task.sensor_jacobian
        self._exact = task.subtracts and not own  # ż = Ĵq̇ − ẋ_d
        self._none = read_only(np.zeros(task.m))

    def predict(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        task, (x_d, x_d_dot, x_d_ddot) = self.task, target
        x = task.value(q)
        z, J, drift = task.error(x, x_d), task.jacobian(q), self._none
        x_d_dot, x_d_ddot = (
            self._none if rate is None else np.asarray(self._combination.dot(rate))
            for rate in (x_d_dot, x_d_ddot)
        )
        if not self._exact:
            x_dot = task.sensor_jacobian(q).dot(v)
            drift = x_dot - x_d_dot if task.subtracts else self._rate(x, x_dot, x_d, x_d_dot)
            drift = drift + x_d_dot - J.dot(v)
        return PredictedError(z, J, task.jacobian_dot(q, v), x_d_dot, x_d_ddot, drift)

    def __repr__(self) -> str:
        return f"KnownKinematics({self.task!r})"

    def _rate(self, x: Array, x_dot: Array, x_d: Array, x_d_dot: Array) -> Array:
        size = math.hypot(*x_dot.tolist(), *x_d_dot.tolist())
        if size == 0.0:
            return self._none
        task, h = self.task, _DIFFERENCE / size
        after, before = (
            task.error(task.displaced(x, k * x_dot), task.displaced(x_d, k * x_d_dot))
            for k in (h, -h)
        )
        rate = (after - before) / (2.0 * h)
        jumped = not math.hypot(*rate.tolist()) < _TURNS_BACK * size
        return x_dot - x_d_dot if jumped else np.asarray(rate)


class Estimator(Kinematics):
    """Kinematics learnt from frames of x: frame, gate, correct, smooth, predict.

    A *frame* is a measurement whose x is new, with the t and q at which it was taken; a *gate*
    rejects those that jump; `_correct` learns from the others; *smoothed* estimates follow the
    learnt ones, and `predict` uses them. All run on numbers and on symbols.
    """

    # points of the robot, linear in the translations of tool and joint origins
    regressor: KinematicRegressor
    noise: float  # standard deviation of x
    delay: float  # age of x where `Measurement.t_x` is None [s]
    _at: dict[str, slice]
    _believed: Array  # values of `names` before the first frame, and their standard deviations
    _sd: Array
    _window = 0.3  # over which residuals are averaged: noise goes, what is not explained stays [s]
    _noise_unit = "m"
    _pixels: Array | float = 1.0  # units of the noise in one of `_points`

    def _lay_out(self, own: Mapping[str, int], delay: float, dt: float, n_points: int) -> None:
        """Define the layout of the state: frames, gate, then the named parts of a subclass.

        Each smoothed estimate has a rate, with the suffix "_dot" or, of a rotation, "_spin"; those
        with "_dot" stand in the estimates' order, without a gap. `n_points` is that of `_points`.
        """
        task, m = self.task, self.task.m
        self.delay = as_number("delay", delay, unit="s", minimum=0.0, most=LONGEST_DELAY)
        dt = as_number("dt", dt, unit="s", above=0.0)
        self._frames = Frames(task.robot, task.n_x, self.delay, dt)
        jump = _JUMP * self.noise / float(np.min(self._pixels))
        self._gate = Gate(task.robot, n_points, jump, self._reach)
        sizes = {
            "frames": self._frames.size, "gate": self._gate.size, "time": 1,
            "learnt": len(self.names), "integral": m, "averaged": m, "left": m, "noted": 3, **own,
        }  # fmt: skip
        ends = np.cumsum(list(sizes.values())).tolist()
        each = zip(sizes.items(), ends, strict=True)
        self._at = at = {name: slice(end - size, end) for (name, size), end in each}
        self.n_state = ends[-1]
        rates = [name for name in own if name.endswith("_dot")]
        spins = [name for name in own if name.endswith("_spin") and own[name]]
        fresh = {"frames", "gate", "time", *rates, *spins}
        self._kept = tuple(part for name, part in at.items() if name not in fresh)
        self._rates = slice(at[rates[0]].start, at[rates[-1]].stop)
        first, last = (at[name.removesuffix("_dot")] for name in (rates[0], rates[-1]))
        self._moving = slice(first.start, last.stop)
        self._turning = tuple((name.removesuffix("_spin"), name) for name in spins)

    # -- what one derived from it has --------------------------------------------------------

    def _late(self, state: Array) -> Any:
        """Return by how much x is older than it is stamped, as far as that is learnt [s]."""
        return 0.0

    def _own(self, measurement: Measurement) -> Measurement:
        return measurement

    def _points(self, x: Array) -> Array:
        """Return the entries of an x that are learnt from, NaN where they are lost."""
        return x

    @abstractmethod
    def _is_state(self, state: Array) -> bool:
        """Return True if finite numbers (n_state,) are a possible state."""

    @abstractmethod
    def _begin(self, state: Array) -> None:
        """Write the believed values into a state."""

    @abstractmethod
    def _has_begun(self, state: Array) -> Any:
        """Return True once x was seen and x̂ was set to it."""

    @abstractmethod
    def _place(self, state: Array, frame: Measurement) -> None:
        """Set x̂ to the first x that is seen, in place."""

    @abstractmethod
    def _reach(self, q_0: Array, q: Array) -> Array:
        """Return the largest motion of each of `_points` between configurations, without noise."""

    @abstractmethod
    def _correct(self, state: Array, frame: Measurement, since: Any, is_anew: Any) -> None:
        """Learn in place from a frame that counts for a time `since` [s]; `_account` the residual.

        The frame's x is that of `_points`; `is_anew` is True if the sensor was moved before it.
        """

    @abstractmethod
    def _aim(self, state: Array, q: Array, dt: float) -> None:
        """Set the rates of the smoothed estimates in place, by `_smoothing_rate`."""

    @abstractmethod
    def _covariance(self, state: Array) -> tuple[Array, float]:
        """Return the covariance (p, p) of `learnt` by the noise as given, and χ² as it is seen."""

    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step, shape (n_state,), with the believed values.

        x̂ starts at the first x that is not lost, so that learning begins without a jump.
        """
        measurement, at = self._own(measurement), self._at
        if not hasattr(measurement.q, "arm_of"):  # or it is of symbols
            _time(measurement)
            as_vector("q of a measurement", measurement.q, self.task.robot.nq)
        state, frames = np.zeros_like(measurement.q, shape=self.n_state), at["frames"]
        self._frames.begin(state[frames], measurement.t, measurement.q)
        state[at["time"]] = measurement.t
        state[at["noted"]] = 0.0, 0.0, self.noise**2
        self._begin(state)
        measurement = self._frames.by_own_clock(state[frames].copy(), measurement, 0.0)
        frame, is_new = self._frames.new(state[frames].copy(), measurement)
        if frame is not None:
            law.alter(is_new, state, lambda state: self._place(state, frame))
        return state

    def check(self, state: Array, measurement: Measurement, dt: float) -> None:
        """Raise an InvalidInputError if t is not finite, or t_x is on another clock."""
        t, t_x, frames = _time(measurement), time_of_x(measurement.t_x), state[self._at["frames"]]
        if t_x is not None and t_x > t:
            ahead = self._frames.by_own_clock(frames.copy(), measurement, dt).t
            if why := from_another_clock(ahead, t_x, _OTHER):
                raise InvalidInputError(f"t_x must be by the clock of t: {why}", given=measurement)

    def correct(self, state: Array, measurement: Measurement, dt: float) -> None:
        numbers, gate = state[self._at["frames"]], self._at["gate"]
        measurement = self._frames.by_own_clock(numbers, self._own(measurement), dt)
        is_time = self._frames.remember(numbers, measurement)
        frame, is_new = self._frames.new(numbers, measurement, self._late(state))

        if frame is not None:
            own = frame._replace(x=self._points(frame.x))
            begins = is_new & law.complement(self._has_begun(state))
            law.alter(begins, state, lambda state: self._place(state, frame))
            judged = state[gate]
            law.alter(is_new, judged, lambda gate: self._gate.judge(gate, own))
            believed, is_anew = is_new & (judged[-2] > 0.0), judged[-1] > 0.0
            is_seen = law.any_of(np.isfinite(own.x))

            def learn(state: Array) -> None:
                time = state[self._at["time"]]
                since = np.minimum(np.maximum(own.t - time[0], 0.0), _LONGEST_FRAME)
                time[0] = own.t
                self._correct(state, own, since, is_anew)

            law.alter(believed & is_seen, state, learn)
            is_time = is_time | believed
        # the rates of smoothed estimates may wait for some milliseconds
        law.alter(is_time, state, lambda state: self._aim(state, measurement.q, dt))
        self.advance(state, dt)

    def advance(self, state: Array, dt: float) -> None:
        """Move the smoothed estimates towards the learnt ones for dt [s], in place."""
        state[self._moving] += dt * state[self._rates]
        for name, spin in self._turning:
            turn = law.rotation_exp(dt * state[self._at[spin]])
            state[self._at[name]] = turn.dot(state[self._at[name]].reshape(turn.shape)).ravel()

    def _account(self, state: Array, left: Array, since: Any) -> None:
        """Average the residual of x (m,), NaN where lost; take its changes as noise."""
        at, seen = self._at, np.isfinite(left)
        n, before = np.where(seen, 1.0, 0.0).sum(), state[at["left"]]
        integral, averaged, noted = (state[at[name]] for name in ("integral", "averaged", "noted"))
        integral += np.where(seen, -np.expm1(-_INTEGRAL * since) * (left - integral), 0.0)
        averaged += np.where(seen, -np.expm1(-since / self._window) * (left - averaged), 0.0)
        change = np.where(seen, left - before, 0.0) * self._pixels
        state[at["left"]] = np.where(seen, left, before)
        noted[0] += since
        share = since / np.minimum(noted[0] + 0.3, _NOISE_MEMORY)
        noted[2] += share * (0.5 * change.dot(change) / np.maximum(n, 1.0) - noted[2])

    @abstractmethod
    def _renew(self, state: Array) -> None:
        """Begin to learn anew in place, about what was learnt, as unsure as at first."""

    def _forget(self, state: Array) -> None:
        noted = state[self._at["noted"]]
        noted[0], noted[1] = 0.0, noted[1] + 1.0
        state[self._at["integral"]] = state[self._at["averaged"]] = 0.0

    @staticmethod
    def _smoothing_rate(dt: float, away: Any, *turns: Array) -> Any:
        """Return the rate β of what is smoothed, or a slower one if x̂ is `away` [m], or turned."""
        rate = _EASED_SPEED / np.maximum(away, 1e-9)
        rate = np.minimum(rate, np.minimum(_SMOOTHING, 0.5 / dt))
        for turn in turns:
            rate = np.minimum(rate, _EASED_TURN / np.maximum(law.length(turn), 1e-9))
        return rate

    def status(self, state: Array, measurement: Measurement) -> Status:
        t_x: Any = math.nan if measurement.t_x is None else measurement.t_x
        is_old = self._frames.silence(state[self._at["frames"]]) > SILENT
        status = law.select(is_old & (t_x == t_x), _PREDICTED, _OK)  # NaN is not known
        return law.select(self._has_begun(state), status, _LOST)

    def _required(self, state: Array) -> Array:
        state = as_vector("state", state, self.n_state)
        if not self._is_state(state):
            raise InvalidInputError(
                f"state must be one of {self!r}, as initial_state and step return it, got numbers "
                "that are not",
                given=state,
            )
        return state

    def resumed(self, state: Array, measurement: Measurement) -> Array:
        state, fresh = self._required(state), self.initial_state(measurement)
        for part in self._kept:
            fresh[part] = state[part]
        return fresh

    def relearnt(self, state: Array) -> Array:
        state = self._required(state).copy()
        self._renew(state)
        return state

    def last_frame(self, state: Array, measurement: Measurement) -> Measurement | None:
        """Return the last frame that a state has seen before a measurement; None without one.

        It has the t, q and q̇ at which it was taken; None is also for one that the gate rejected.
        """
        at = self._at
        if state[at["gate"]][-2] == 0.0:
            return None
        return self._frames.last(state[at["frames"]].copy(), measurement, self._late(state))

    def expectation(self, state: Array) -> Expectation | None:
        """Return the expectation of frames by a state; None, the default, if there is none."""
        return None

    def seconds(self, state: Array) -> float:
        """Return the time covered by frames since learning last began [s]."""
        return float(state[self._at["noted"]][0])

    def learnt(self, state: Array) -> Array:
        return state[..., self._at["learnt"]]

    def left_over(self, state: Array) -> Array:
        return state[self._at["left"]]

    def report(self, state: Array) -> KinematicReport:
        at, state = self._at, self._required(state)
        learnt, (P, chi) = self.learnt(state), self._covariance(state)
        seconds, restarts, variance = state[at["noted"]].tolist()
        share = 1.0 - P.diagonal() / self._sd**2
        P = P * (max(chi, 1.0) * max(1.0, variance / self.noise**2))
        numbers = np.array([self._believed, learnt, np.sqrt(P.diagonal()), share]).T.tolist()
        each = zip(self.names, self.units, numbers, strict=True)
        rows = tuple(LearntNumber(name, unit, *row) for name, unit, row in each)
        turn = [r.value for r in rows if r.unit == "rad" and r.name.startswith("camera.")]
        return KinematicReport(
            rows, P, math.hypot(*turn), chi, (self.noise, math.sqrt(variance)),
            seconds, int(restarts), self._noise_unit,
            self._frames.silence(state[at["frames"]]), self.regressor.movers[-1],
        )  # fmt: skip


def _time(measurement: Measurement) -> float:
    """Return the time of a measurement [s]; raise an error without it, as learning needs it."""
    name, most = "t of a measurement", _FOREVER
    return as_number(name, measurement.t, unit="s", minimum=-most, most=most)


def motion_of_points(
    before: tuple[Array, Array], after: tuple[Array, Array], u: Array, sd: Array
) -> tuple[Array, Array]:
    """Return the distances that points move by u (n_u,), and the sd of these; (k,) [m] each."""
    (H_0, o_0), (H, o) = before, after
    k, n = o.size // 3, len(u)
    H = (H - H_0).reshape(k, 3, n)
    moved = (o - o_0).reshape(-1, 3) + H.dot(u)
    return np.sqrt((moved**2).sum(axis=1)), np.sqrt(((H * sd).reshape(k, 3 * n) ** 2).sum(axis=1))


class Frames:
    """Detection of new frames of x and the configurations at which they were taken.

    A frame is new by a new `Measurement.t_x`, the time it was taken. If that is None or in the
    future, it is new by a change of x and was taken `delay` ago. Frames older than 0.25 s, or twice
    the delay, are ignored, and so are those faster than 250 Hz.

    Its numbers in the state: the last x, the time it was taken, the last t, the offset of its own
    clock to that, the time of the last frame, and (t, q) of the last few hundred milliseconds.
    """

    def __init__(self, robot: Robot, n_x: int, delay: float, dt: float) -> None:
        self._robot, self._delay, self._n_x = robot, delay, n_x
        self._spacing = dt * math.ceil(_SPACING / dt - _ROUND_OFF)  # whole periods
        self._horizon = max(_HORIZON, 2.0 * delay)
        self._count = math.ceil(self._horizon / self._spacing) + 2
        self._width = 1 + robot.nq
        self._head = n_x + 4
        self.size = self._head + self._count * self._width

    def begin(self, numbers: Array, t: float, q: Array) -> None:
        """Write the numbers before the first frame, for an arm at rest."""
        n, times = self._n_x, self._spacing * np.arange(1 - self._count, 1)
        numbers[:n], numbers[n] = 0.0, _LONG_AGO
        numbers[n + 1], numbers[n + 2], numbers[n + 3] = t - self._spacing, 0.0, t
        ring = self._ring(numbers)
        ring[:, 0], ring[:, 1:] = t + times, q

    def by_own_clock(self, numbers: Array, measurement: Measurement, dt: float) -> Measurement:
        """Return the measurement, t advanced by dt [s] if it did not change, t_x NaN for None."""
        n, (t, q, v, x, t_x) = self._n_x, measurement
        (last, ahead), t = numbers[n + 1 : n + 3].tolist(), t if hasattr(t, "graph") else float(t)
        since = ahead - abs(t - last)
        ahead = law.select(t == last, ahead + dt, law.select(since > 0.0, since, 0.0))
        numbers[n + 1], numbers[n + 2] = t, ahead
        if t_x is None or (isinstance(t_x, float) and t_x == -math.inf):
            t_x = math.nan
        return Measurement(t + ahead, q, v, x, t_x + ahead)

    def silence(self, numbers: Array) -> Any:
        """Return the time since the last frame to learn from [s]."""
        t, ahead, last = numbers[self._n_x + 1 : self._head].tolist()
        since = t + ahead - last
        return law.select(since > 0.0, since, 0.0)

    def remember(self, numbers: Array, measurement: Measurement) -> Any:
        """Store the configuration if it is time; return whether it was, or t did not change."""
        t, q, *_ = measurement
        (last,) = numbers[-self._width : 1 - self._width].tolist()
        since = t - last  # since the last one that is remembered

        def shift(numbers: Array) -> None:
            ring = self._ring(numbers)
            ring[:-1] = ring[1:].copy()
            ring[-1, 0], ring[-1, 1:] = t, q

        is_due = since >= self._spacing - _ROUND_OFF
        law.alter(is_due, numbers, shift)
        # time starts anew
        law.alter(since < -_ROUND_OFF, numbers, lambda numbers: self.begin(numbers, t, q))
        return is_due | (since < _ROUND_OFF)

    def new(
        self, numbers: Array, measurement: Measurement, late: Any = 0.0
    ) -> tuple[Measurement | None, Any]:
        """Return a frame (None if it is surely old) and whether it is new, and store it.

        Its q and q̇ are those of a time `late` [s] before it was taken, as far as they are known;
        how long before is its `t_x`.
        """
        n, (t, _, _, x, _) = self._n_x, measurement
        t_x: Any = measurement.t_x
        (taken_before,) = numbers[n : n + 1].tolist()  # a number of Python is quicker than NumPy's
        knows_time = t_x <= t + _AHEAD
        if law.surely(knows_time & (t_x <= taken_before) & (taken_before > _LONG_AGO)):
            return None, False
        head, seen = numbers[: n + 4], np.abs(x) < _FARTHEST
        known = np.where(seen, x, 0.0)
        # a clock that is ahead is wrong, and would say of one frame that it is always new
        is_old = law.select(knows_time, t_x <= taken_before, law.all_equal(known, numbers[:n]))
        is_old = is_old & (taken_before > _LONG_AGO)
        if law.surely(is_old):
            return None, False
        taken = law.select(knows_time, law.select(t_x < t, t_x, t), t - self._delay)
        since = taken - taken_before
        passed = is_old | ((since > 0.0) & (since < _CLOSEST - _ROUND_OFF))
        passed = passed | law.complement(law.any_of(seen))
        if law.surely(passed):
            return None, False
        is_noted = law.complement(passed)
        (oldest,) = self._ring(numbers)[0, :1].tolist()
        then, is_known = taken - late, t - taken <= self._horizon + _ROUND_OFF
        then = law.select(then < t, then, t)
        then = law.select(then > oldest + _ROUND_OFF, then, law.select(is_known, taken, t))
        q, v = self._at(numbers, then, measurement)

        def note(head: Array) -> None:
            head[:n], head[n] = known, taken
            head[n + 3] = law.select(is_known, t, head[n + 3])

        law.alter(is_noted, head, note)
        frame = Measurement(taken, q, v, np.where(seen, x, math.nan), taken - then)
        return frame, is_noted & is_known

    def last(self, numbers: Array, measurement: Measurement, late: float) -> Measurement | None:
        """Return the last frame as `new` did, from a copy of the numbers; None if it is unknown."""
        x, taken = numbers[: self._n_x], float(numbers[self._n_x])
        measurement = self.by_own_clock(numbers, measurement, 0.0)
        then = min(taken - late, measurement.t)
        if taken <= _LONG_AGO or then <= self._ring(numbers)[0, 0]:
            return None
        q, v = self._at(numbers, then, measurement)
        return Measurement(taken, q, v, np.where(x == 0.0, math.nan, x), taken - then)

    def _at(self, numbers: Array, t: Any, measurement: Measurement) -> tuple[Array, Array]:
        """Return q and q̇ at a time [s] not longer ago than is known; else those of now."""
        ring = self._ring(numbers)
        times = np.append(ring[:, 0], measurement.t)
        rows = np.concatenate([ring[:, 1:], measurement.q[np.newaxis]])
        before, after = times[:-1], times[1:]
        here = np.where((before < t) & (after >= t), 1.0, 0.0)
        gaps = np.maximum(after - before, _ROUND_OFF)
        # of the gaps that t is not in, anything
        share = here.dot(np.minimum(np.maximum(t - before, 0.0), gaps) / gaps)
        begins, ends = here.dot(rows[:-1]), here.dot(rows[1:])
        robot, is_known = self._robot, before[0] < t
        begins = np.where(is_known, begins, measurement.q)
        ends = np.where(is_known, ends, measurement.q)
        way = motion_between(robot, begins, ends)
        v = np.where(here[-1] > 0.0, measurement.v, way / np.maximum(here.dot(gaps), _SPACING))
        return moved(robot, begins, share * way), v

    def _ring(self, numbers: Array) -> Array:
        return numbers[self._head :].reshape(self._count, self._width)


class Gate:
    """A gate that rejects frames in which x moved farther than the arm, until it is back or stays.

    Its numbers in the state: rejected frames in a row; of the last accepted and the last rejected
    frame q, x, and 1 for each entry of x that was seen; 1 if the last frame was accepted, and 1 if
    it was the first after the sensor moved. x (n_x,) may move by `reach(q_0, q)` plus `jump`.
    """

    PASSED_OVER = 8  # frames in a row that agree after which the sensor is believed

    def __init__(
        self, robot: Robot, n_x: int, jump: float, reach: Callable[[Array, Array], Array]
    ) -> None:
        self._nq, self._n_x, self._jump, self._reach = robot.nq, n_x, jump, reach
        self.size = 3 + 2 * (robot.nq + 2 * n_x)

    def judge(self, numbers: Array, frame: Measurement) -> None:
        """Store whether to accept a frame, and whether it is the first after the sensor moved."""
        last, other = numbers[1:-2].reshape(2, -1)
        fits = self._fits(last, frame)
        jumps = law.complement(fits)
        agrees = (numbers[0] > 0.0) & self._fits(other, frame)
        count = law.select(agrees, numbers[0] + 1.0, 1.0)
        believed = fits | (count >= self.PASSED_OVER)
        numbers[0] = law.select(believed, 0.0, count)
        law.alter(jumps, other, lambda other: self._note(other, frame))
        law.alter(believed, last, lambda last: self._note(last, frame))
        numbers[-2] = law.select(believed, 1.0, 0.0)
        numbers[-1] = law.select(believed & jumps, 1.0, 0.0)

    def _fits(self, last: Array, frame: Measurement) -> Any:
        """Return True if the motion since the last frame explains x, or if there was none."""
        nq, n = self._nq, self._nq + self._n_x
        compared = (last[n:] > 0.0) & np.isfinite(frame.x)
        change = np.where(compared, np.abs(frame.x - last[nq:n]), 0.0)
        is_near = change.max() <= self._jump
        if law.surely(is_near):  # which is usual
            return True
        return is_near | law.all_of(change <= self._reach(last[:nq], frame.q) + self._jump)

    def _note(self, where: Array, frame: Measurement) -> None:
        n, seen = self._nq, np.isfinite(frame.x)
        where[:n] = frame.q
        where[n : n + self._n_x] = np.where(seen, frame.x, where[n : n + self._n_x])
        where[n + self._n_x :] = np.where(seen, 1.0, 0.0)
