"""`control`: the loop on a robot, which it always leaves braked; `RobotRun`, its record."""

from __future__ import annotations

import contextlib
import copy
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from approxjac.controllers import Limits
from approxjac.controllers.controller import Controller
from approxjac.errors import ControlError, InvalidInputError
from approxjac.formatting import listed
from approxjac.interface import Evaluation, LimitStatus, Measurement, Target, TargetPath
from approxjac.realtime.brake import Brake, HungError, Watchdog
from approxjac.realtime.driver import Driver, read, two_clocks
from approxjac.realtime.faults import Fault, Tolerances, task_bounds
from approxjac.realtime.robot_loop import AT_REST, RobotLoop, require_able
from approxjac.realtime.scheduling import Scheduling, StopSignals, real_time
from approxjac.robots import Dynamics
from approxjac.simulation.plant import Plant, VelocityServo
from approxjac.simulation.simulate import Loop, Observer, require_fit, wanted_of
from approxjac.simulation.trajectory import Trajectory
from approxjac.tasks import Task
from approxjac.tasks.analysis import features, require_unmirrored
from approxjac.validation import Array, as_number, require

_PERIOD = 1.0 / 30.0  # s, of observers
_PATIENCE = 30.0  # s, for which an observer may prepare before the arm moves
_ANSWER = 1.0  # s, within which an observer has to end
_SEEN = "path", "step", "target", "truth", "measurement", "answer", "state", "tau", "events"
_READS = 5
_HELD = 0.2  # share of the largest torque by which what is believed of gravity may be off
_WARM = 50  # steps before the first that counts: caches, and whatever is made at first use
_FAR, _REACHES = 50.0, 20.0  # m and reaches of the arm, beyond both of which no x is in metres
_HANGS = 2.0  # times `max_period`, after which the watchdog brakes
_SPEED = {"m": 0.2, "rad": 0.5, "px": 100.0}  # of targets that are eased in, per s


@dataclass(frozen=True, eq=False, repr=False)
class RobotRun(Trajectory):
    """The record of a run on a robot, a `Trajectory` for plots and pages.

    Its x is the last measured one, and its true robot is the believed one, as the true one is
    unknown. The error is that to the target at the time x was taken, if `Measurement.t_x` is known.

    Attributes:
        stop_distance: Distance that x moved from the start of a controlled stop to the brake, NaN
            without one [length in the units of the task].
        stop_bound: Expected bound on it: the error then, the target's stopping distance, and the
            excess speed over the target times the 0.3 s that decelerating takes.
        gap: Time from command to command in each period, shape (K,) [s].
        work: Time from the measurement to the command in each period, shape (K,) [s].
    """

    stop_distance: float = field(kw_only=True)
    stop_bound: float = field(kw_only=True)
    gap: Array = field(kw_only=True)
    work: Array = field(kw_only=True)

    @property
    def fault(self) -> Fault | None:
        """The fault that ended it, or None."""
        return Fault[self.fault_name] if self.fault_name else None

    def _error_line(self) -> str:
        return f"error {self.error_norm[-1]:.3g} {self.task_unit} at the end"

    def _figures(self) -> dict[str, str]:
        figures = super()._figures() | self.describe_events()
        if np.isfinite(self.stop_distance):
            figures["stop"] = (
                f"within {self.stop_distance:.3g} {self.task_unit} "
                f"(at most {self.stop_bound:.3g} was foreseen)"
            )
        if len(self.work):
            half, most, worst = 1e6 * np.percentile(self.work, [50.0, 99.0, 100.0])
            figures["work"] = (
                f"{half:.0f} µs in the median, 99 % within {most:.0f}, worst {worst:.0f}; "
                f"longest gap {1e3 * self.gap.max():.3g} ms"
            )
        return figures


def control(
    driver: Driver,
    controller: Controller,
    target: Sequence[float] | Array | Target | TargetPath,
    duration: float = 60.0,
    *,
    state: Array | None = None,
    tolerances: Tolerances | None = None,
    speed: float | Sequence[float] | Array | None = None,
    stop: threading.Event | None = None,
    observer: Observer | None = None,
    scheduling: Scheduling | None = None,
) -> RobotRun:
    """Run a controller on a robot, and brake the robot however the run ends.

    It starts only if the robot is at rest, x is measured, and the controller's first command
    would hold the arm. The target starts at the measured tip and joins the given path. Every period
    is checked for faults (`Fault`). SIGINT, SIGTERM, SIGHUP and SIGQUIT bring the arm to rest and
    end the run; a second signal brakes at once. A watchdog brakes if the driver hangs.

    Args:
        driver: The robot.
        controller: A controller for the driver's period, inside `TorqueLimited` if the robot has
            limits.
        target: x_d, a `Target` that moves, or a path, whose time is that of the run (periods × dt).
        duration: Time after which the arm is brought to rest [s].
        state: Initial state of the controller, such as from `controller.resumed(...)`.
        tolerances: Bounds of normal operation: sensors, kinematics, errors, lost x, late commands.
        speed: Speed of the target until it joins the path, a number or shape (m,) [unit of the
            task/s]; 0.2 m/s, 0.5 rad/s and 100 px/s by default.
        stop: Event that brings the arm to rest when another thread sets it.
        observer: Function called with a copy of the loop about 30 times a second, in a thread of
            its own, such as `view.LiveView()`.
        scheduling: Processor and priority of the loop's thread; the system's by default.

    Returns:
        The record of the run, with the reason why it ended.

    Raises:
        InvalidInputError: Arguments out of range, a controller that does not fit the driver, or an
            arm that is not ready to start; nothing was sent then.
        ControlError: The driver or the controller raised an error, which is its cause. The arm was
            braked, and `given` is the run until then.
    """
    require("driver", driver, Driver, "a Driver, with read, send and brake")
    # the robot as it is believed to be, which takes what the controller commands
    as_number("dt of the driver", driver.dt, unit="s", above=0.0)
    require("limits of the driver", driver.limits, Limits, "Limits(...)")
    task, robot = controller.task.measured, controller.task.robot
    servo = VelocityServo() if controller.command == "velocity" else None
    adds = robot if driver.adds_gravity and servo is None else None
    plant = Plant(robot, task, adds_gravity=adds, servo=servo)
    require_fit(plant, controller, driver.dt)
    require_able(driver, controller)
    wanted = wanted_of(controller.task, target, 0.0)
    duration = as_number("duration", duration, unit="s", above=0.0)
    steps = math.ceil(duration / driver.dt)
    require("tolerances", tolerances, Tolerances | None, "Tolerances(...)")
    require("scheduling", scheduling, Scheduling | None, "Scheduling(...)")
    require("stop", stop, threading.Event | None, "a threading.Event")
    require("observer", observer, Callable | None, "a function of a Loop")
    speeds = task_bounds("speed", speed, task, _SPEED, "/s")
    tolerances = (tolerances or Tolerances()).for_task(task, driver.dt, controller.unseen)
    brake, signals = Brake(driver), StopSignals()
    with contextlib.ExitStack() as held:
        held.enter_context(signals)  # a signal that comes while this begins is looked at, too
        held.callback(brake.close)  # whatever happens from here on
        first = require_at_rest(driver, task, tolerances.timeout)
        if isinstance(wanted, np.ndarray):
            require_unmirrored(task, "target", wanted, first.x, "the measured x")
        loop = RobotLoop(brake, plant, controller, wanted, first, steps, tolerances, speeds, state)
        if not loop.learns_sensor:
            require_near(task, first.x)
        require_held(driver, controller, first.q, loop.answer)
        for _ in range(_WARM):
            controller.step(loop.state, loop.measurement, loop._wanted, driver.dt)
        if observer is not None:
            held.enter_context(ObserverThread(loop, observer))
        held.enter_context(real_time(scheduling or Scheduling()))
        error: BaseException | None = None
        watchdog, why = Watchdog(brake, _HANGS * tolerances.max_period), ""
        try:
            with watchdog:
                signals.looked_at = True
                why = _run(loop, watchdog, signals, stop)
        except HungError:
            pass
        except Exception as raised:
            error, why = raised, f"{type(raised).__name__}: {raised}"
        finally:  # before threads are waited for
            brake.close()
        if watchdog.bit:
            loop.fault, loop.detail = Fault.READ_HUNG, loop.describe_hang(watchdog.longest)
        elif error is not None:
            loop.fault, loop.detail = Fault.FAILED, ""
        run = _run_of(loop, why)
    error = error or brake.error
    if error is not None:
        raise ControlError(
            f"{type(error).__name__} at {run.t[-1]:.3f} s: {error}; the arm was "
            + ("braked" if brake.error is None else "NOT braked, as the driver's brake() failed"),
            given=run,
        ) from error
    return run


def _run(
    loop: RobotLoop, watchdog: Watchdog, signals: StopSignals, stop: threading.Event | None
) -> str:
    why = ""
    # a stop at the end of time takes some periods more
    while loop.step < len(loop.gaps):
        if not why:
            if signals.name:
                why = f"{signals.name}: brought to rest"
            elif (stop is not None and stop.is_set()) or loop.stopped:
                why = "asked to stop: brought to rest"
            elif loop.step >= loop.steps:
                why = "its time was over: brought to rest"
            elif loop.fault is not None:
                why = f"{loop.describe_fault()}; brought to rest"
            if why:
                loop.halt()
        if signals.count > 1:
            return f"{signals.name}, twice: braked at once"
        if not loop.advance():
            break
        watchdog.beat()
    return why


def _run_of(loop: RobotLoop, why: str) -> RobotRun:
    fault = loop.fault
    if fault is not None and not fault.stops:
        why = f"{loop.describe_fault()}; braked at once" + (f" ({why})" if why else "")
    run = loop.trajectory()
    scene = None if run.scene is None else replace(run.scene, knows_truth=False)
    done = slice(1, max(loop.step, 1))
    kept = {field.name: getattr(run, field.name) for field in fields(Trajectory)}
    events, derived = tuple(loop.monitor.events), run.derived
    kept["derived"] = lambda run, name, at: events if name == "events" else derived(run, name, at)
    return RobotRun(
        **kept | {"scene": scene, "ended": why, "fault_name": "" if fault is None else fault.name},
        stop_distance=float(loop.stop_distance),
        stop_bound=float(loop.stop_bound),
        gap=loop.gaps[done].astype(float),
        work=loop.works[done].astype(float),
    )


class ObserverThread(Loop):
    """A copy of a robot's loop for an observer, which it calls about 30 times a second.

    Requests of the observer are carried out between two steps of the loop.
    """

    _knows_truth = False

    def __init__(self, loop: RobotLoop, observer: Observer) -> None:
        # controllers and plants have scratch memory: one instance per thread
        plant, controller = copy.deepcopy((loop.plant, loop.controller))
        super().__init__(plant, controller, loop.path, loop.dt, loop.steps)
        self._loop, self._observer = loop, observer
        self._ready, self._over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._show, name="approxjac observer", daemon=True)

    def __enter__(self) -> ObserverThread:
        self._thread.start()
        self._ready.wait(_PATIENCE)
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(_ANSWER)

    def aim_at(self, target: Any) -> None:
        with self._loop.between_steps:
            self._loop.aim_at(target)

    def exchange(self, controller: Any) -> None:
        own = copy.deepcopy(controller)  # which may take long, and nobody is to wait for it
        with self._loop.between_steps:
            self._loop.exchange(own)
        self.controller = controller

    def relearn(self) -> None:
        with self._loop.between_steps:
            self._loop.relearn()

    def stop(self) -> None:
        self._loop.stop()

    def _show(self) -> None:
        observer: Any = self._observer
        scope = observer if hasattr(observer, "__exit__") else contextlib.nullcontext()
        # an error of whoever looks on is no reason to stop an arm
        with contextlib.suppress(Exception), scope:
            while not self.stopped:
                self.stopped = self._over.is_set()
                for name in _SEEN:
                    setattr(self, name, getattr(self._loop, name))
                observer(self)
                self._ready.set()
                self._over.wait(_PERIOD)
        self._ready.set()


def require_at_rest(driver: Driver, task: Task, timeout: float) -> Measurement:
    """Return a first measurement; raise an InvalidInputError if q moves or is out of limits.

    It waits up to `timeout` [s] for a first frame of x.
    """
    robot, last, measured = task.robot, -np.inf, None
    for count in range(max(_READS, math.ceil(timeout / driver.dt))):
        measured = read(driver, task)
        if not measured.t > last:
            message = f"the clock of the driver must go on, got {measured.t!r} s after {last!r} s"
            raise InvalidInputError(message, given=measured)
        last = measured.t
        if count + 1 >= _READS and np.isfinite(measured.x).all():
            break
    assert measured is not None
    unknown = [name for name in "qvx" if not np.isfinite(getattr(measured, name)).all()]
    moves = np.abs(measured.v).max() > AT_REST
    for wrong, why in (
        (unknown, f"{', '.join(unknown)} must be known before the arm moves"),
        (two_clocks(measured, driver.dt), "t_x must be by the clock of t"),
        (moves, f"the arm must be at rest, below {AT_REST} rad/s or m/s"),
    ):
        if wrong:
            raise InvalidInputError(f"{why}, got {measured!r}", given=measured)
    robot.require_radians("q", measured.q)
    beyond = np.flatnonzero(robot.beyond_limits(measured.q[None])[0] > 0.0)
    if beyond.size:
        low, high = robot.position_limits
        angles = robot.angles(measured.q)
        where = "; ".join(
            f"{robot.joint_names[j]} at {angles[j]:.4g} {robot.joint_units[j]}, limits "
            f"{low[j]:.4g} and {high[j]:.4g}"
            for j in beyond
        )
        raise InvalidInputError(f"q must be within the joints' limits, got {where}", given=measured)
    return measured


def require_near(task: Task, x: Array) -> None:
    """Raise an InvalidInputError if x is too far from the arm, as if in millimetres.

    The bound leaves room for a tracker with its origin elsewhere in a hall.
    """
    for feature in features(task):
        if not feature.axes or feature.frame is None:
            continue
        origin, reach = task.robot.reach_bound(feature.frame)
        origin = origin[["xyz".index(axis) for axis in feature.axes]]
        away = float(np.linalg.norm(feature.place(x) - origin))
        if away > max(_FAR, _REACHES * reach):
            raise InvalidInputError(
                f"x must be in m, got {listed(x)}: the tip would be {away:.3g} m from the base of "
                f"an arm that reaches {reach:.3g} m; 1 mm is 0.001",
                given=x,
            )


def require_held(driver: Driver, controller: Controller, q: Array, answer: Evaluation) -> None:
    """Raise an InvalidInputError if the first command would not hold the believed arm."""
    robot = controller.task.robot
    if answer.limit_status in (LimitStatus.INFEASIBLE, LimitStatus.SOLVER_FAILED):
        message = f"the limits do not hold the arm as it stands: {answer.limit_status.message}"
        raise InvalidInputError(message, given=answer)
    if driver.command != "torque" or answer.gravity is None:
        return
    most = np.asarray(driver.limits.for_joints(robot.nv).effort)
    needed = np.zeros(robot.nv) if driver.adds_gravity else Dynamics(robot).g(q)
    slack = _HELD * np.where(np.isfinite(most), most, np.abs(needed).max())
    if (np.abs(answer.gravity - needed) > slack).any():
        message = "compensate gravity, such as by AdaptiveGravity(robot)"
        if driver.adds_gravity:
            message = (
                "leave gravity to the robot, which adds its own: AdaptiveGravity(robot, "
                "theta0=0.0), NoGravity(robot), or a driver that takes it off, as "
                "FrankaDriver(gravity=robot) does"
            )
        raise InvalidInputError(
            f"the controller must {message}; it compensates {listed(answer.gravity)}, and the arm "
            f"takes {listed(needed)} [N m or N]",
            given=answer,
        )
