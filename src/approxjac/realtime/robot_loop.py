"""`RobotLoop`: a controller and a robot, period by period, with smoothly joined targets."""

from __future__ import annotations

import dataclasses
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from approxjac.controllers import Latency
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError
from approxjac.formatting import listed
from approxjac.interface import Condition, LimitStatus, Measurement, Status, Target, TargetPath
from approxjac.realtime.brake import Brake
from approxjac.realtime.driver import Driver, read, two_clocks
from approxjac.realtime.faults import Fault, Tolerances
from approxjac.realtime.watches import FaultWatch, SensorWatch
from approxjac.simulation.monitor import Event, Monitor
from approxjac.simulation.plant import Plant
from approxjac.simulation.simulate import Loop, Wanted, first_state, target_at, wanted_of, x_of
from approxjac.simulation.trajectory import Record, Trajectory
from approxjac.tasks import Task
from approxjac.validation import Array

_ROWS = 60_000  # recorded at most
_TAIL = 1000  # periods before the end of which each is recorded
_HALT = 0.3  # s, within which the target of a controlled stop comes to rest
AT_REST = 0.05  # rad/s or m/s, below which every joint of an arm at rest is
_FAST = (Fault.TOO_FAST, Fault.SPEED_GREW)
_LOST = (Status.MEASUREMENT_LOST, Status.NOT_PREDICTED)
_PEAK = 1.875  # of a least-jerk motion: its fastest speed by its mean speed
_SHORTEST = 0.2  # s
_SLOWER = 1.2  # times the period that gains were chosen for


class RobotLoop(Loop):
    """A loop with a robot, which checks its measurements for faults.

    It begins with the measurement `first`, has `steps` in all, and moves to new targets with
    `speeds` (m,) [unit/s]; tolerances have bounds for each coordinate of the task.
    """

    _wanted: Target
    _blended: BlendedTarget | Halt
    _knows_truth = False

    def __init__(
        self,
        brake: Brake,
        plant: Plant,
        controller: Controller,
        path: Wanted,
        first: Measurement,
        steps: int,
        tolerances: Tolerances,
        speeds: Array,
        state: Array | None,
    ) -> None:
        driver, robot = brake.driver, plant.robot
        super().__init__(plant, controller, path, driver.dt, steps)
        self._brake, self._speeds, self._tolerances = brake, speeds, tolerances
        # held in each step, and by other threads that change the loop
        self.between_steps = threading.Lock()
        self._max_error = np.asarray(tolerances.max_error)
        fastest = np.asarray(driver.limits.for_joints(robot.nv).velocity)
        self._t_first = first.t
        self.truth = self.measurement = self._timed(first)
        self._blend(first.x, np.zeros(controller.task.measured.m))
        self._aim()
        self.state = first_state(plant, controller, self._wanted, self.measurement, self.dt, state)
        self._control()
        self._watch = FaultWatch(
            robot, self.dt, tolerances.accuracy, np.minimum(robot.velocity_limits, fastest),
            tolerances.max_period, driver.command == "velocity", plant.adds_gravity is not None,
        )  # fmt: skip
        self.monitor = Monitor(controller, plant.adds_gravity)  # of what happens to the arm
        self._watch_sensor()
        self.fault: Fault | None = None
        self.detail = ""  # which joint, and by how much
        self.halting = self._blind = False  # True while the arm is brought to rest
        self._lost = self._limited = self._halted = 0
        self._sent = self._read = time.perf_counter()
        self.stop_distance = self.stop_bound = np.nan
        self._stopped_at = first.x
        self._stride = max(1, math.ceil(steps / _ROWS))
        rounds = steps + math.ceil(tolerances.timeout / self.dt) + 2  # with those of a stop
        self._record = Record(plant, rounds // self._stride + _TAIL + 2, self.dt)
        self._tail: deque[tuple[int, tuple[Any, ...], float]] = deque()
        self._taken: list[float] = []  # when the x of each instant was
        self.gaps = np.zeros(rounds, dtype=np.float32)
        self.works = np.zeros(rounds, dtype=np.float32)

    def advance(self) -> bool:
        """Carry out a period; return True if the run continues. Nothing is sent after a fault."""
        measurement = self._timed(read(self._brake.driver, self.controller.task))
        self._read = time.perf_counter()
        with self.between_steps:
            return self._period(measurement)

    def _period(self, measurement: Measurement) -> bool:
        self.measurement = measurement
        fault = self._watch.look(measurement, self._read)
        known = math.isfinite(math.hypot(*measurement.q.tolist(), *measurement.v.tolist()))
        self._note(fault, self._watch.detail)
        if fault is None and known:
            self._note(
                self._sensor.look(measurement, self.target, self._motion_sd), self._sensor.detail
            )
            if message := two_clocks(measurement, self.dt):
                self._note(Fault.CLOCK_JUMPED, message)
        if known and (fault is None or fault in _FAST):
            answer = self.answer  # to the sample before
            if self.monitor.look(measurement, answer.torque, answer.reference, self.state):
                event = self.monitor.events[-1]
                if event.condition is Condition.MOTOR_WEAK:
                    self._note(Fault.MOTOR_WEAK, f"{event.where}: {event.figure}")
        if known and not self._brakes():
            self._look(measurement)
            if not self._brakes():
                self._control()
                self._judge()
        command = self.answer.torque
        fault = self._watch.commanded(command, self.answer.reference)
        self._note(fault, self._watch.detail)
        if self._brakes():
            # by what, if that can be seen: of a jump, by the samples before it
            if self.fault in (*_FAST, Fault.POSITION_JUMPED):
                count = len(self.monitor.events)
                self.monitor.explain()
                for event in self.monitor.events[count:]:
                    self.detail += f"; {event.condition}: {event.where}, {event.figure}"
            return False
        # without q and q̇ the last command goes out once more, which no limit has to object to
        self._brake.send(command)
        now = time.perf_counter()
        self.gaps[self.step], self.works[self.step] = now - self._sent, now - self._read
        self._sent = now
        if known:
            self._keep()
            self.state = self._after
        self.step += 1
        return not self._rests()

    @property
    def events(self) -> tuple[Event, ...]:  # type: ignore[override]
        """Events of the monitor so far."""
        return tuple(self.monitor.events)

    def halt(self) -> None:
        """Bring the arm to rest with the controller, from the next period on."""
        with self.between_steps:
            if self.halting:
                return
            self.halting, noise = True, 6.0 * np.asarray(self._tolerances.accuracy.x)
            task, velocity = self.controller.task.measured, self._velocity
            stop = Halt(task, self.step * self.dt, self.target, velocity, _HALT)
            error = task.error(self.truth.x, self.target)
            faster = task.jacobian(self.truth.q) @ self.truth.v - velocity
            self._blended, self._stopped_at = stop, self.truth.x
            ways = error, stop.distance, _HALT * faster, noise
            self.stop_bound = float(sum(np.linalg.norm(way) for way in ways))
            self.stop_distance = 0.0

    def aim_at(self, target: Target | TargetPath | Array) -> None:
        """Change the target, smoothly from the current one."""
        path = wanted_of(self.plant.sensor, target, self.step * self.dt)
        if not self.halting:
            self.path = path
            self._blend(self.target, self._velocity)

    def exchange(self, controller: Controller) -> None:
        require_able(self._brake.driver, controller)
        super().exchange(controller)
        self.monitor = self.monitor.with_controller(controller)
        self._watch_sensor()

    def _watch_sensor(self) -> None:
        accuracy, blind = self._tolerances.accuracy, np.asarray(self._tolerances.max_blind_motion)
        task, kinematics = self.controller.task, self.controller.kinematics
        self.learns_sensor = kinematics is not None and bool(kinematics.names)
        self._sensor = SensorWatch(task, self.dt, accuracy, blind, self.learns_sensor)

    def _motion_sd(self, q: Array) -> Callable[[Array], Array] | None:
        if not self.learns_sensor:
            return None
        kinematics, known = self.controller.kinematics_of(self.state)
        return kinematics.motion_sd(known, q)

    def _blend(self, x: Array, velocity: Array) -> None:
        task, now = self.controller.task.measured, self.step * self.dt
        self._blended = BlendedTarget(task, self.path, now, x, velocity, self._speeds)

    def trajectory(self) -> Trajectory:
        """Return the record, including every last period; errors are at the time x was taken."""
        if not self._tail:  # nothing was known: the instant before it
            self._keep()
        while self._tail:
            self._evict(last=True)
        run = self._record.trajectory()
        error, x_d = self.plant.sensor.error, run.x_d
        errors = []
        for x, at in zip(run.x, np.interp(self._taken, run.t, np.arange(len(run.t))), strict=True):
            share, before, after = at % 1.0, math.floor(at), math.ceil(at)
            errors.append((1.0 - share) * error(x, x_d[before]) + share * error(x, x_d[after]))
        return dataclasses.replace(run, error=np.array(errors))

    def _timed(self, measurement: Measurement) -> Measurement:
        t_x = measurement.t_x
        return measurement._replace(
            t=measurement.t - self._t_first, t_x=None if t_x is None else t_x - self._t_first
        )

    @property
    def _velocity(self) -> Array:
        return _complete(self.controller.task.measured, self._wanted)[1]

    def _aim(self) -> None:
        self._wanted = self._blended.at(self.step * self.dt)
        self.target = x_of(self._wanted)

    def _look(self, measurement: Measurement) -> None:
        x, task = measurement.x, self.controller.task.measured
        sees = bool(np.isfinite(x).all())
        if self._blind and sees and not self.halting:
            self._blend(x, np.zeros(task.m))  # from where it is seen again
            self._blind = False
        self._aim()
        seen = measurement if sees else self.truth
        self.truth = measurement._replace(x=seen.x, t_x=seen.t_x)
        if not sees:
            return
        error = task.error(x, self.target)
        if (np.abs(error) > self._max_error).any():
            i = int(np.argmax(np.abs(error) / self._max_error))
            most = f"at most {self._max_error[i]:.3g}"
            message = f"{task.labels[i]}: {abs(error[i]):.3g} {task.units[i]}, {most}"
            self._note(Fault.ASTRAY, message)
        if self.halting:
            way = float(np.linalg.norm(task.error(x, self._stopped_at)))
            self.stop_distance = max(self.stop_distance, way)

    def _judge(self) -> None:
        lost = self.answer.status in _LOST
        self._blind = self._blind or lost
        lost = lost or not np.isfinite(self.measurement.x).all()
        self._lost = self._lost + 1 if lost else 0
        status = self.answer.limit_status
        voids = status >= LimitStatus.PROOF_GIVEN_UP and status is not LimitStatus.EXCEEDED
        self._limited = self._limited + 1 if voids else 0
        if self._lost * self.dt > self._tolerances.timeout:
            since, most = self._lost * self.dt, self._tolerances.timeout
            self._note(Fault.BLIND, f"for {since:.3g} s, at most {most:.3g} s")
        elif self._limited * self.dt > self._tolerances.timeout:
            self._note(Fault.LIMITS)

    def describe_hang(self, longest: float) -> str:
        """Describe which call hung for longer than a time after the last command [s]."""
        came = self._read - self._sent  # later: the state came after the brake, to another thread
        what = "no state came"
        if 0.0 < came < longest:
            what = f"the state was read after {1e3 * came:.3g} ms; the command, or sending it, "
            what += "did not come back"
        return f"no command for {1e3 * longest:.3g} ms, twice `max_period`: {what}"

    def describe_fault(self) -> str:
        """Describe the fault and its place."""
        assert self.fault is not None
        detail = f" ({self.detail})" if self.detail else ""
        return f"{self.fault}: {self.fault.message}{detail}"

    def _note(self, fault: Fault | None, detail: str = "") -> None:
        """Keep the first fault, or the first at which the robot brakes at once."""
        if self.fault is None or (fault is not None and self.fault.stops and not fault.stops):
            self.fault, self.detail = fault, detail

    def _brakes(self) -> bool:
        return self.fault is not None and not self.fault.stops

    def _rests(self) -> bool:
        """Return True where the run is over: at rest after a stop, or with no time left for it."""
        if not self.halting:
            return False
        self._halted += 1
        slow = bool(np.abs(self.measurement.v).max() < AT_REST)
        since = self._halted * self.dt
        return (slow and since > _HALT) or since > self._tolerances.timeout

    def _keep(self) -> None:
        t, t_x = self.truth.t, self.truth.t_x
        self._tail.append((self.step, self.instant, t if t_x is None else min(t_x, t)))
        if len(self._tail) > _TAIL:
            self._evict(last=False)

    def _evict(self, last: bool) -> None:
        step, instant, taken = self._tail.popleft()
        if last or step % self._stride == 0:
            self._record.add(*instant)
            self._taken.append(taken)


def require_able(driver: Driver, controller: Controller) -> None:
    """Raise an InvalidInputError for a controller that does not fit the robot."""
    if controller.command != driver.command:
        raise InvalidInputError(
            f"command of the controller must be {driver.command!r}, which the driver sends, got "
            f"{controller.command!r} of {controller!r}",
            given=controller,
        )
    law, nv = controller.law, controller.task.robot.nv
    tuning = law.tuning
    if tuning is not None and driver.dt > _SLOWER * tuning.latency.period:
        # as it was given: the rule's own has the lag of law (5), too
        latency = dataclasses.replace(law.latency or Latency(), period=driver.dt)
        raise InvalidInputError(
            f"latency of the law must be that of the loop, {latency!r}: what it chose by itself "
            f"(gains or learning) is for a period of {tuning.latency.period:g} s, and the "
            f"driver's dt is {driver.dt:g} s",
            given=controller,
        )
    if driver.command != "torque":
        return
    most = np.asarray(driver.limits.for_joints(nv).effort)
    kept = controller.limits
    own = np.full(nv, np.inf) if kept is None else np.asarray(kept.effort)
    if (own > most * (1.0 + 1e-9)).any():
        raise InvalidInputError(
            f"controller must keep the robot's limits of effort, {listed(most)} [N m or N], such "
            f"as TorqueLimited(controller, driver.limits), got {controller!r}",
            given=controller,
        )


class BlendedTarget:
    """A target's path with an initial offset that goes to zero with minimum jerk.

    It begins at x (n_x,) with a velocity in the error coordinates of the task (m,) [unit/s], and
    joins the path within its `duration` [s], no faster relative to it than a speed (m,).
    """

    def __init__(
        self, task: Task, path: Wanted, begin: float, x: Array, velocity: Array, speed: Array
    ) -> None:
        self._task, self._path, self._begin = task, path, begin
        goal, goal_v, _ = _complete(task, target_at(path, begin))
        self._offset = task.error(x, goal)
        self._rate = velocity - goal_v
        self.duration = max(
            _SHORTEST,
            _PEAK * float(np.max(np.abs(self._offset) / speed)),
            4.0 * float(np.max(np.abs(self._rate) / speed)) * _SHORTEST,
        )

    def at(self, t: float) -> Target:
        """Return the target at t [s] of the path's time."""
        goal = target_at(self._path, t)
        r = (t - self._begin) / self.duration
        if r >= 1.0 or not (self._offset.any() or self._rate.any()):
            return goal if isinstance(goal, Target) else Target(goal)
        x, v, a = _complete(self._task, goal)
        # quintics that are 1 and 0 in value and slope at r = 0, and vanish with both at r = 1
        e, w, T = self._offset, self.duration * self._rate, self.duration
        place = 1.0 - r**3 * (10.0 - 15.0 * r + 6.0 * r * r)
        place_rate = -30.0 * r * r * (1.0 - r) ** 2
        place_rate2 = -60.0 * r * (1.0 - r) * (1.0 - 2.0 * r)
        slope = r - r**3 * (6.0 - 8.0 * r + 3.0 * r * r)
        slope_rate = 1.0 - r * r * (18.0 - 32.0 * r + 15.0 * r * r)
        slope_rate2 = -r * (36.0 - 96.0 * r + 60.0 * r * r)
        return Target(
            self._task.displaced(x, place * e + slope * w),
            v + (place_rate * e + slope_rate * w) / T,
            a + (place_rate2 * e + slope_rate2 * w) / T**2,
        )


class Halt:
    """A target that comes to rest from x and a velocity, with constant deceleration.

    It takes a duration [s] and covers a `distance`, shape (m,).
    """

    def __init__(
        self, task: Task, begin: float, x: Array, velocity: Array, duration: float
    ) -> None:
        self._task, self._begin, self._x, self._v = task, begin, x, velocity
        self._duration = duration
        self.distance = 0.5 * duration * velocity

    def at(self, t: float) -> Target:
        """Return the target at t [s]."""
        r = min(max((t - self._begin) / self._duration, 0.0), 1.0)
        way = self._duration * (r - 0.5 * r * r) * self._v
        a = -self._v / self._duration if r < 1.0 else np.zeros_like(self._v)
        return Target(self._task.displaced(self._x, way), (1.0 - r) * self._v, a)


def _complete(task: Task, target: Target | Array) -> tuple[Array, Array, Array]:
    if not isinstance(target, Target):
        target = Target(target)
    still = np.zeros(task.m)
    v, a = (still if rate is None else rate for rate in (target.v, target.a))
    return target.x, v, a
