"""`RobotLoop`: a controller and a robot, period by period."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import Any

import numpy as np

from approxjac.controllers.controller import Controller
from approxjac.interface import LimitStatus, Measurement, Status, Target, TargetPath
from approxjac.realtime.accuracy import Tolerances
from approxjac.realtime.brake import Brake
from approxjac.realtime.driver import Driver
from approxjac.realtime.easing import Eased, Halt
from approxjac.realtime.faults import Fault
from approxjac.realtime.reading import read, two_clocks
from approxjac.realtime.start_checks import require_able
from approxjac.realtime.watches import FaultWatch, SensorWatch
from approxjac.simulation.loop import Loop
from approxjac.simulation.plant import Plant
from approxjac.simulation.record import Record
from approxjac.simulation.targets import Wanted, first_state, wanted_of, x_of
from approxjac.validation import Array, as_vector

_ROWS = 60_000  # recorded at most
_TAIL = 1000  # periods before the end of which each is recorded
_HALT = 0.3  # s, within which the target of a controlled stop comes to rest
_AT_REST = 0.05  # rad/s or m/s
_FASTER = 0.15  # of its largest speed, by which a joint may be faster than it is led to be
_SLOW = {"rad": 0.4, "m": 0.1}  # per s; or by this, where its largest speed is low
_FADES = 0.5  # s, in which that fades: joints that share a motion swing on
_LOST = (Status.MEASUREMENT_LOST, Status.NOT_PREDICTED)


class RobotLoop(Loop):
    """A loop whose measurements come from a robot, with a watch over them.

    Args:
        driver: The robot.
        brake: Its brake.
        plant: What is believed of it.
        controller: The controller.
        path: Where the target is.
        first: The measurement it begins with.
        steps: Of the whole run.
        tolerances: What is no fault, with bounds for each coordinate of the task.
        speeds: How fast targets are eased in, shape (m,) [unit/s].
        state: Of the controller; its initial one by default.

    Attributes:
        fault: What is wrong, or None.
        learns_sensor: Whether the controller learns where the sensor is.
        detail: Of the fault, in words: which joint, and by how much; "" for none.
        halting: Whether it is being brought to rest.
    """

    _wanted: Target
    _knows_truth = False

    def __init__(
        self,
        driver: Driver,
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
        super().__init__(plant, controller, path, driver.dt, steps)
        self._driver, self._brake, self._speeds = driver, brake, speeds
        self._tolerances, self._timeout = tolerances, tolerances.timeout
        self._max_error = np.asarray(tolerances.max_error)
        task, accuracy = controller.task._measured, tolerances.accuracy
        fastest = driver.limits.for_joints(plant.robot.nv).velocity
        fastest = np.minimum(plant.robot.velocity_limits, np.asarray(fastest))
        still = np.zeros(task.m)
        self._begun = first.t
        self.measurement = self._timed(first)
        self.truth = self.measurement
        self._eased: Eased | Halt = Eased(task, path, 0.0, first.x, still, speeds)
        self._aim()
        self.state = first_state(plant, controller, self._wanted, self.measurement, self.dt, state)
        self._control()
        commands_velocity = driver.command == "velocity"
        self._watch = FaultWatch(
            plant.robot, self.dt, accuracy, fastest, tolerances.max_period, commands_velocity
        )
        kinematics = controller.kinematics
        self.learns_sensor = kinematics is not None and bool(kinematics.names)
        self._sensor = self._sensor_watch()
        self.fault: Fault | None = None
        self.detail = ""
        self.halting = False
        self._lost = self._limited = self._halted = 0
        self._blind, self._asked = False, np.zeros(plant.robot.nv)
        slow = [_SLOW[unit] for unit in plant.robot.joint_units]
        self._fades = math.exp(-self.dt / _FADES)
        self._faster = np.maximum(_FASTER * fastest, slow)
        self._sent = self._read = time.perf_counter()
        self.stop_distance = self.stop_bound = np.nan
        self._stopped_at = first.x
        self._stride = max(1, math.ceil(steps / _ROWS))
        rounds = steps + math.ceil(self._timeout / self.dt) + 2  # with those of a stop
        self._record = Record(plant, rounds // self._stride + _TAIL + 2, self.dt)
        self._tail: deque[tuple[int, tuple[Any, ...], tuple[Array, Array, float]]] = deque()
        self._errors: list[Array] = []
        self.gaps = np.zeros(rounds, dtype=np.float32)
        self.works = np.zeros(rounds, dtype=np.float32)

    def advance(self) -> bool:
        """Carry out a period; return whether the run goes on. It never sends after a fault."""
        measurement = self._timed(read(self._driver, self.controller.task))
        self._read = time.perf_counter()
        self.measurement = measurement
        fault = self._watch.look(measurement, self._read)
        known = bool(np.isfinite(measurement.q).all() and np.isfinite(measurement.v).all())
        late = fault is Fault.TORQUE_LATE
        self._note(fault, self._watch.detail + (self.describe_work() if late else ""))
        if fault is None and known:
            self._note(self._sensor.look(measurement, self.target))
            if message := two_clocks(measurement, self.dt):
                self._note(Fault.CLOCK_JUMPED, message)
        if known and not self._brakes():
            self._look(measurement)
            if not self._brakes():
                self._control()
                self.tau = as_vector("the controller's command", self.tau, self.plant.robot.nv)
                self._judge()
        if self._brakes():
            return False
        # without q and q̇ the last command goes out once more, which no limit has to object to
        self._brake.send(self.tau)
        self._watch.sent(self.tau, self.answer.reference)
        now = time.perf_counter()
        self.gaps[self.step], self.works[self.step] = now - self._sent, now - self._read
        self._sent = now
        if known:
            self._keep()
            self.state = self._after
        self.step += 1
        return not self._rests()

    def halt(self) -> None:
        """Bring the arm to rest with the controller, from the next period on."""
        if self.halting:
            return
        self.halting = True
        task, velocity = self.controller.task._measured, self._velocity
        stop = Halt(task, self.step * self.dt, self.target, velocity, _HALT)
        error = task.error(self.truth.x, self.target)
        faster = task.jacobian(self.truth.q) @ self.truth.v - velocity
        self._eased, self._stopped_at = stop, self.truth.x
        ways = error, stop.distance, _HALT * faster, 6.0 * np.asarray(self._tolerances.accuracy.x)
        self.stop_bound = float(sum(np.linalg.norm(way) for way in ways))
        self.stop_distance = 0.0

    def aim_at(self, target: Target | TargetPath | Array) -> None:
        """Move the target, which is eased in from where it is now."""
        now = self.step * self.dt
        path = wanted_of(self.plant.sensor, target, now)
        if self.halting:
            return
        task, velocity = self.controller.task._measured, self._velocity
        self._eased = Eased(task, path, now, self.target, velocity, self._speeds)
        self.path = path

    def exchange(self, controller: Controller) -> None:
        """Let another controller go on, from the next step on."""
        require_able(self._driver, controller)
        super().exchange(controller)
        self._sensor = self._sensor_watch()

    def _sensor_watch(self) -> SensorWatch:
        blind = np.asarray(self._tolerances.max_blind_motion)
        accuracy, task = self._tolerances.accuracy, self.controller.task
        return SensorWatch(task, self.dt, accuracy, blind, self.learns_sensor)

    def record(self) -> Record:
        """Return the record, with each of the last periods."""
        if not self._tail:  # nothing was known: the instant before it
            self._keep()
        while self._tail:
            self._evict(last=True)
        return self._record

    @property
    def errors(self) -> Array:
        """Errors of x to the target when x was taken, at the instants of `record`, (N, m)."""
        return np.array(self._errors)

    def _timed(self, measurement: Measurement) -> Measurement:
        """Return it in the time of the run."""
        t_x = measurement.t_x
        return measurement._replace(
            t=measurement.t - self._begun, t_x=None if t_x is None else t_x - self._begun
        )

    @property
    def _velocity(self) -> Array:
        """Velocity of the moving target, shape (m,)."""
        v = self._wanted.v
        return np.zeros(self.controller.task._measured.m) if v is None else v

    def _aim(self) -> None:
        self._wanted = self._eased.at(self.step * self.dt)
        self.target = x_of(self._wanted)

    def _look(self, measurement: Measurement) -> None:
        """Take the new measurement: where is the target, and is the arm where it should be?"""
        x, task = measurement.x, self.controller.task._measured
        sees = bool(np.isfinite(x).all())
        if self._blind and sees and not self.halting:
            # from where it is seen again
            now, still = self.step * self.dt, np.zeros(task.m)
            self._eased = Eased(task, self.path, now, x, still, self._speeds)
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
        """Look at what the controller says of its answer."""
        asked = self.answer.reference
        if asked is not None:
            fastest = np.abs(asked)
            self._asked = np.maximum(self._fades * self._asked, 2.0 * fastest + fastest.max())
            share = np.abs(self.measurement.v) / (self._asked + self._faster)
            if (share > 1.0).any():
                j = int(share.argmax())
                self._note(Fault.TOO_FAST, self._watch.too_fast(j, share[j], self.measurement.v))
        lost = self.answer.status in _LOST
        self._lost = self._lost + 1 if lost else 0
        self._blind = self._blind or lost
        voids = self.answer.limit_status >= LimitStatus.PROOF_GIVEN_UP
        voids &= self.answer.limit_status is not LimitStatus.EXCEEDED
        self._limited = self._limited + 1 if voids else 0
        if self._lost * self.dt > self._timeout:
            self._note(Fault.BLIND)
        elif self._limited * self.dt > self._timeout:
            self._note(Fault.LIMITS)

    def describe_work(self) -> str:
        """Return in words how long it took from a state to its command, before and usually."""
        works = 1e3 * self.works[: self.step]
        if not len(works):
            return ""
        last, usual = works[-1], np.median(works)
        return f"; the command before took this machine {last:.3g} ms, {usual:.3g} in the median"

    def describe_hang(self, longest: float) -> str:
        """Return in words what did not come back within a time after the last command [s]."""
        came = self._read - self._sent  # later: the state came after the brake, to another thread
        message = "no state came"
        if 0.0 < came < longest:
            message = f"the state was read after {1e3 * came:.3g} ms; the command, or sending it, "
            message += "did not come back"
        return (
            f"no command for {1e3 * longest:.3g} ms, twice `max_period`: {message}"
            + self.describe_work()
        )

    def describe_fault(self) -> str:
        """Return the fault in words."""
        if self.fault is None:
            return ""
        detail = f" ({self.detail})" if self.detail else ""
        return f"{self.fault}: {self.fault.message}{detail}"

    def _note(self, fault: Fault | None, detail: str = "") -> None:
        """Keep the first fault, or the first at which the robot brakes at once."""
        if self.fault is None or (fault is not None and self.fault.stops and not fault.stops):
            self.fault, self.detail = fault, detail

    def _brakes(self) -> bool:
        """Return True after a fault at which the robot brakes at once."""
        return self.fault is not None and not self.fault.stops

    def _rests(self) -> bool:
        """Return True where the run is over: at rest after a stop, or with no time left for it."""
        if not self.halting:
            return False
        self._halted += 1
        slow = bool(np.abs(self.measurement.v).max() < _AT_REST)
        since = self._halted * self.dt
        return (slow and since > _HALT) or since > self._timeout

    def _keep(self) -> None:
        instant = (
            self.truth, self.measurement.x, self.state, self.answer, self.tau, self.target,
            self.controller,
        )  # fmt: skip
        self._tail.append((self.step, instant, self._led()))
        if len(self._tail) > _TAIL:
            self._evict(last=False)

    def _evict(self, last: bool) -> None:
        step, instant, (before, after, share) = self._tail.popleft()
        if last or step % self._stride == 0:
            self._record.add(*instant)
            error, x = self.plant.sensor.error, instant[0].x
            self._errors.append((1.0 - share) * error(x, before) + share * error(x, after))

    def _led(self) -> tuple[Array, Array, float]:
        """Return the targets between which x was taken, and how far between; now if that is all."""
        t, _, _, _, t_x = self.truth
        if t_x is None or not t_x < t:
            return self.target, self.target, 0.0
        targets = self._tail  # of the periods before
        ago = min((t - t_x) / self.dt, float(len(targets)))
        k = math.ceil(ago)
        before, after = (self.target if i <= 0 else targets[-i][1][5] for i in (k, k - 1))
        return before, after, k - ago
