"""`simulate` and its loops of controller and plant, continuous or sampled."""

import importlib
import math
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.controllers.arguments import overflow
from approxjac.controllers.controller import Controller
from approxjac.errors import (
    ControllerError,
    InvalidInputError,
    MeasurementError,
    SimulationError,
    failed,
    package_of,
    require_known,
)
from approxjac.formatting import short_fields
from approxjac.interface import Evaluation, Measurement, Target, TargetPath
from approxjac.simulation.plant import INTEGRATORS, Plant
from approxjac.simulation.sensing import SensorReadings
from approxjac.simulation.trajectory import Record, Trajectory
from approxjac.simulation.transmission import Motors
from approxjac.tasks import Task
from approxjac.validation import Array, as_array, as_integer, as_number, require, shape_of

_STEP = 1e-3  # of the arm under a servo, at most [s]
_TINY = 1e-6  # of a step: more than round-off, less than anyone means
_FOREVER = 1e15  # steps
_DIVERGED = 1e6  # rad, m and their rates, with which no arm moves
Wanted = Target | TargetPath | Array
"""A target that has been checked: an array at rest, a `Target`, or a path."""


def wanted_of(sensor: Task, target: object, t: float) -> Wanted:
    """Return a target or path, checked against the sensor at t [s]."""
    if isinstance(target, type) or not isinstance(target, Target | TargetPath):
        return sensor.target(target)
    now = target.at(t) if isinstance(target, TargetPath) else target
    require("at(t) of a path", now, Target, "a Target(x, v, a)")
    x = sensor.target(now.x)
    if isinstance(target, TargetPath):
        return target
    rates = {
        name: None if value is None else as_array(f"{name} of the target", value, (sensor.m,))
        for name, value in (("v", now.v), ("a", now.a))
    }
    return Target(x, **rates)


def target_at(wanted: Wanted, t: float) -> Target | Array:
    """Return the target at t [s]."""
    if isinstance(wanted, np.ndarray | Target):
        return wanted
    return wanted.at(t)


def x_of(target: Target | Array) -> Array:
    """Return x_d, shape (n_x,)."""
    return target.x if isinstance(target, Target) else target


def diverged(t: float, duration: float, error: Exception) -> SimulationError:
    """Return the error of a loop that diverged."""
    return SimulationError(
        f"the simulation diverged at t = {t:g} of {duration:g} s: {error} (a smaller dt or smaller "
        "gains may help; drives=Drives() tells a law with a latency that joints have no rotors)",
        given=t,
    )


def _stopped(t: float, duration: float, why: str) -> SimulationError:
    return SimulationError(
        f"the integration stopped at t = {t:g} of {duration:g} s: {why}", given=t
    )


def first_state(
    plant: Plant,
    controller: Controller,
    wanted: Target | Array,
    measurement: Measurement,
    dt: float,
    given: Array | None = None,
    *,
    rests: bool = False,
) -> Array:
    """Return a controller's first state, after a trial step that checks the controller.

    Where its guard `rests`, it is without its memory.
    """
    state = controller.initial_state(measurement)
    if given is not None:
        size = len(state) if shape_of(given) == state.shape else controller.size
        own = as_array("state", given, (size,))[: controller.size]
        state = np.concatenate([own, state[controller.size :]])  # a guard begins anew
    state = as_array("the controller's initial_state", state, (np.size(state),))
    own = state[: controller.size]
    stepped = controller.advance(own, measurement, wanted, dt)
    require_answer(plant, controller, own, measurement, stepped)
    learnt = controller.learnt(own)
    require("learnt of the controller", learnt, np.ndarray, "an array")
    if len(learnt) != len(controller.parameters):
        raise InvalidInputError(
            f"parameters of the controller must name the {len(learnt)} numbers that learnt(state) "
            f"returns, got {controller.parameters!r}",
            given=controller,
        )
    return own if rests else state


def require_answer(
    plant: Plant, controller: Controller, state: Array, measurement: Measurement, stepped: Any
) -> None:
    """Raise an InvalidInputError if what a step returned is no state and answer."""
    if not (isinstance(stepped, tuple) and len(stepped) == 2):
        message = f"step of a controller must return (state, Evaluation), got {stepped!r}"
        raise InvalidInputError(message, given=stepped)
    after, answer = stepped
    require("the controller's answer", answer, Evaluation, "an Evaluation")
    require("the controller's state", after, np.ndarray, "an array")
    require("the controller's torque", answer.torque, np.ndarray, "an array")
    checked: dict[str, tuple[Any, tuple[int, ...]]] = {
        plant.command: (answer.torque, (plant.robot.nv,)),
        "state": (after, state.shape),
    }
    if controller.is_continuous:
        checked["state_rate"] = answer.state_rate, (controller.size,)
    if np.isfinite(measurement.x).all():  # a lost x has no error
        checked["e"] = answer.e, (controller.task.m,)
    for name, (value, shape) in checked.items():
        as_array(f"the controller's {name}", value, shape)


def require_fit(plant: Plant, controller: Controller, dt: float | None) -> None:
    """Raise an InvalidInputError for a controller of another task, command or sampling time."""
    like = "a controller, such as SetpointController(...)"
    require("controller", controller, Controller, like)
    require("task of the controller", controller.task, Task, "the task of the believed robot")
    plant.require_measured(controller.task)
    if controller.command != plant.command:
        without = "Plant(..., servo=VelocityServo()) takes velocities, one without servo torques"
        raise InvalidInputError(
            f"command of the controller must be {plant.command!r}, which the plant takes, got "
            f"{controller.command!r} of {controller!r}; {without}",
            given=controller,
        )
    wanted = controller.dt
    if wanted is not None and (dt is None or not np.isclose(dt, wanted, rtol=1e-9, atol=0.0)):
        raise InvalidInputError(
            f"dt must be that of the controller, {wanted:g} [s], for which it was built, got "
            f"{dt!r}",
            given=dt,
        )


class InitialState(NamedTuple):
    """Start of a run.

    Attributes:
        q0: Configuration, shape (nq,); `plant.ready_configuration()` by default.
        v0: Velocity, shape (n_v,); at rest by default.
        state: State of the controller, such as `controller.resumed(...)` gives; by default its
            `initial_state`.
    """

    q0: Sequence[float] | Array | None = None
    v0: Sequence[float] | Array | None = None
    state: Array | None = None

    def checked(self, plant: Plant) -> tuple[Array, Array, Array | None]:
        """Return configuration, velocity and state, checked for a plant."""
        robot = plant.robot
        q0 = plant.ready_configuration() if self.q0 is None else self.q0
        q = as_array("q0", robot.configuration(q0, "q0"), (robot.nq,))
        robot.require_radians("q0", q)
        v0 = np.zeros(robot.nv) if self.v0 is None else self.v0
        return q, as_array("v0", v0, (robot.nv,), "rad/s"), self.state


class Loop:
    """Base of the control loops, simulated and on a robot.

    An observer may read all of it, move the target, exchange the controller, or stop the run.

    Attributes:
        plant: The simulated plant, or the believed one of a real robot.
        controller: The controller.
        path: The target from now on: an array at rest, a `Target` or a path.
        target: x_d, shape (n_x,).
        dt: Sampling time [s].
        step: Number of the step.
        steps: Number of the last step.
        truth: Measurement of ideal sensors; its x is NaN where the sensor does not see. On a robot
            the last measurement.
        measurement: Measurement that the controller gets.
        state: State of the controller before this step, shape (n_state,).
        answer: Output of the controller.
        tau: Torque at this instant: the controller's, or that of a simulated servo; NaN for a robot
            that takes velocities, shape (n_v,).
        stopped: True if an observer stopped it.
        motors: The true motors where joints are not ideal, else None.
        events: Each `Event` so far in a loop on a robot; those of a simulation are in its record.
    """

    truth: Measurement
    measurement: Measurement
    state: Array
    answer: Evaluation
    tau: Array
    target: Array
    motors: Motors | None = None
    events: Sequence[Any] = ()
    _wanted: Target | Array
    _after: Array  # state after this step
    _knows_truth: ClassVar[bool] = True  # False on a robot

    def __init__(
        self, plant: Plant, controller: Controller, path: Wanted, dt: float, steps: int
    ) -> None:
        self.plant = plant
        self.controller = controller
        self.path = path
        self.dt = dt
        self.step = 0
        self.steps = steps
        self.stopped = False

    @property
    def t(self) -> float:
        """Time [s]."""
        return self.truth.t

    @property
    def instant(self) -> tuple[Any, ...]:
        """The values of this step that a `Record` keeps."""
        x, state, answer = self.measurement.x, self.state, self.answer
        return self.truth, x, state, answer, self.tau, self.target, self.controller, self.motors

    @property
    def ended(self) -> bool:
        """True after the last step."""
        return self.stopped or self.step == self.steps

    def aim_at(self, target: Target | TargetPath | Array) -> None:
        """Move the target, from the next step on."""
        path = wanted_of(self.plant.sensor, target, self.t)
        wanted = target_at(path, self.t)
        self.controller.step(self.state, self.measurement, wanted, self.dt)  # which may refuse it
        self.path = path
        self.target = x_of(wanted)

    def exchange(self, controller: Controller) -> None:
        """Replace the controller from the next step on; the new one gets the current state."""
        require_fit(self.plant, controller, self.dt)
        rests = len(self.state) == self.controller.size
        state = first_state(
            self.plant, controller, self._wanted, self.measurement, self.dt, rests=rests
        )
        if state.shape != self.state.shape:
            raise InvalidInputError(
                f"controller must have a state of length {len(self.state)}, as the one before, got "
                f"{controller!r} with {len(state)}",
                given=controller,
            )
        self.controller = controller

    def relearn(self) -> None:
        """Begin to learn kinematics anew, as unsure as at first, from the next step on."""
        self.state = self._after = self.controller.relearnt(self._after)

    def stop(self) -> None:
        """End the run at this step."""
        self.stopped = True

    def _aim(self) -> None:
        self._wanted = target_at(self.path, self.step * self.dt)
        self.target = x_of(self._wanted)

    def _control(self) -> None:
        controller, state, measurement = self.controller, self.state, self.measurement
        try:
            stepped = controller.step(state, measurement, self._wanted, self.dt)
        except Exception as error:
            raise _error_of(controller, measurement, error) from error
        try:
            self._after, answer = stepped
            # a controller may use one buffer for all its torques, and `aim_at` asks it once more
            self.answer = type(answer)._make((answer.torque.copy(), *answer[1:]))
            command = self.answer.torque
            self.tau = command if self.plant.servo is None else np.full_like(command, np.nan)
            fits = self._after.shape == state.shape and command.shape == measurement.v.shape
            fits = fits and math.isfinite(math.hypot(*self._after.tolist(), *command.tolist()))
        except (AttributeError, TypeError, ValueError):
            fits = False
        if not fits:
            try:
                require_answer(self.plant, controller, state, measurement, stepped)
            except InvalidInputError as error:
                raise _error_of(controller, measurement, error) from error


def _error_of(controller: Controller, measurement: Measurement, error: Exception) -> Exception:
    """Return the error of a step that raised one: a MeasurementError of a loop that diverged."""
    _, q, v, *_ = measurement
    if isinstance(error, ControllerError | MeasurementError):
        return error
    if math.hypot(*q.tolist(), *v.tolist()) > _DIVERGED:
        return overflow(measurement)
    return failed(f"step of {controller!r}", measurement.t, error)


class MovingArm:
    """A plant in motion: measured at each sample and moved by zero-order-held commands.

    Torques act after the actuator delay; velocities are also sampled at the servo's period. Until
    the first command acts the arm is held. `samples` is their number so far.
    """

    def __init__(
        self, plant: Plant, q: Array, v: Array, dt: float, integrator: str, seed: int
    ) -> None:
        self.plant, self.q, self.v, self.samples = plant, q, v, 0
        self.motors = plant.motors_at(q)
        if self.motors is not None:
            self.motors = self.motors._replace(rate=v)
        self.dt, self._integrate = dt, INTEGRATORS[integrator]
        self._readings = None
        if plant.sensing is not None:
            self._readings = SensorReadings(plant.sensing, plant.sensor, dt, seed)
        self._first, delay = plant.holding_torque(q), plant.actuator_delay
        self._per_sample, self._taken_per_step = 1, 1.0
        if plant.servo is not None:
            self._first, delay = np.zeros(plant.robot.nv), delay + plant.servo.delay
            self._per_sample = max(1, math.ceil(dt / _STEP - _TINY))
            self._taken_per_step = min(dt / self._per_sample / plant.servo.period, 1.0)
        self._h = dt / self._per_sample  # for which a command that acts is held
        self._late = round(min(delay / self._h, _FOREVER))
        self._waiting: deque[Array] = deque()
        self._steps, self._number, self._taken = 0, -1, self._first

    @property
    def t(self) -> float:
        """Time [s]."""
        return self.samples * self.dt

    def sense(self) -> tuple[Measurement, Measurement]:
        """Return the measurement of ideal sensors, and that of the plant's own."""
        truth = self.plant.measure(self.t, self.q, self.v)
        seen = self.plant.encoded(truth, self.motors)
        return truth, seen if self._readings is None else self._readings.read(seen)

    def take(self, command: Array) -> list[Array]:
        """Queue a command; return those that act during the next sample, in order."""
        return [self._next(command) for _ in range(self._per_sample)]

    def _next(self, command: Array) -> Array:
        # counted from the start, so that no rounding adds up
        number = math.floor(self._steps * self._taken_per_step + _TINY)
        if number != self._number:
            self._number, self._taken = number, command
        self._steps += 1
        self._waiting.append(self._taken)
        return self._waiting.popleft() if len(self._waiting) > self._late else self._first

    def move(self, acting: list[Array]) -> None:
        """Integrate over one sample under the commands that act."""
        self.samples += 1
        for command in acting:
            self.q, self.v, self.motors = self.plant.advance(
                self.q, self.v, command, self._h, self._integrate, self.motors
            )


class SampledLoop(Loop):
    """The loop of `simulate`, whose command is held over dt (zero-order hold)."""

    def __init__(
        self,
        plant: Plant,
        controller: Controller,
        path: Wanted,
        start: InitialState,
        dt: float,
        steps: int,
        integrator: str,
        seed: int = 0,
    ) -> None:
        super().__init__(plant, controller, path, dt, steps)
        self.integrator = integrator
        q, v, state = start.checked(plant)
        self._arm = MovingArm(plant, q, v, dt, integrator, seed)
        self._aim()
        self.motors = self._arm.motors
        self.truth, self.measurement = self._arm.sense()
        now, rests = (self._wanted, self.measurement, dt, state), plant.is_exact
        self.state = first_state(plant, controller, *now, rests=rests)
        self._control()

    def advance(self) -> None:
        """Advance by dt, measure and control; raise a SimulationError if the loop diverged."""
        self.state = self._after
        self.step += 1
        self._aim()
        try:
            self._arm.move(self._acting)
            self.motors = self._arm.motors
            self.truth, self.measurement = self._arm.sense()
            self._control()
        except (InvalidInputError, MeasurementError) as error:
            raise diverged(self.step * self.dt, self.steps * self.dt, error) from error

    def _control(self) -> None:
        super()._control()
        self._acting = self._arm.take(self.answer.torque)
        if self.plant.servo is not None:
            self.tau = self.plant.applied(self.truth.q, self.truth.v, self._acting[0])


Progress = Callable[[float], None]
Observer = Callable[[Loop], None]
_REPORTED, _STALL = 200, 5000  # evaluations
_MACHINE_CODE = "approxjac.codegen.whole_run"  # which builds on this, and so is loaded by its name


@dataclass(frozen=True, repr=False)
class Computation:
    """Numerical options of a run.

    Attributes:
        integrator: Integrator of the plant between samples, "rk4" or "semi_implicit_euler".
        engine: "compiled" traces the closed loop and runs it as machine code, some 20 times as
            fast; "python" can run everything. By default machine code if it covers the run,
            llvmlite is installed (the extra `fast`) and the run has at least 5000 steps; the
            record's `engine` names the choice.
        rtol: Relative tolerance of the continuous integration (dt=None).
        atol: Absolute tolerance of it.
        progress: Function that is called now and then with the time reached [s].

    Raises:
        InvalidInputError: A tolerance that is not positive, or `progress` is no function.
        UnknownNameError: No such integrator or engine.
    """

    integrator: str = "rk4"
    engine: str | None = None
    rtol: float = 1e-9
    atol: float = 1e-11
    progress: Progress | None = None
    __repr__ = short_fields

    def __post_init__(self) -> None:
        require_known("integrator", self.integrator, "the integrators", list(INTEGRATORS))
        if self.engine is not None:
            require_known("engine", self.engine, "the engines", ["compiled", "python"])
        as_number("rtol", self.rtol, above=0.0)
        as_number("atol", self.atol, above=0.0)
        require("progress", self.progress, Callable | None, "a function of the time reached [s]")


def simulate(
    plant: Plant,
    controller: Controller,
    target: Sequence[float] | Array | Target | TargetPath,
    q0: Sequence[float] | Array | InitialState | None = None,
    duration: float = 10.0,
    *,
    dt: float | None = 1e-3,
    record_every: float | None = None,
    seed: int = 0,
    computation: Computation = Computation(),
    observer: Observer | None = None,
) -> Trajectory:
    """Run a controller against a plant.

    Args:
        plant: The true robot.
        controller: A controller, such as a `SetpointController`, or one of your own.
        target: x_d, shape (n_x,) [unit of the task]; a `Target` that moves; or a path, any object
            with `at(t) → Target`, such as `Circle`.
        q0: Start configuration at rest, shape (nq,) [rad or m]; or an `InitialState`, with a
            velocity or a state of the controller. By default `plant.ready_configuration()`.
        duration: > 0 [s].
        dt: Sampling time [s], over which commands are held; that of the controller if it has one.
            None integrates (q, v, controller state) as one differential equation with LSODA, as
            in the paper, for laws in continuous time.
        record_every: Time between recorded instants [s], a multiple of dt, by default dt; the last
            instant is always recorded. With dt=None a fraction 1/n of the duration, 1/1000 by
            default.
        seed: Seed of the noise and dropouts of the plant's sensing, ≥ 0.
        computation: Integrator, tolerances, machine code or Python, and progress reports.
        observer: Function of the `Loop`, called at every step of sampled control. A context manager
            is entered before the run and exited after it, however it ends.

    Returns:
        The record of the run.

    Raises:
        InvalidInputError: Wrong shapes, or numbers that are not finite or out of range.
        SimulationError: The closed loop diverged, or the integration failed.
        ControllerError: A step of the controller failed, or returned no valid answer.
    """
    require("plant", plant, Plant, "a Plant (the first argument; the controller is the second)")
    if dt is not None:
        dt = as_number("dt", dt, unit="s", above=0.0)
    require_fit(plant, controller, dt)
    wanted = wanted_of(plant.sensor, target, 0.0)
    start = q0 if isinstance(q0, InitialState) else InitialState(q0)
    duration = as_number("duration", duration, unit="s", above=0.0)
    as_integer("seed", seed, 0)
    require("computation", computation, Computation, "a Computation(..., engine=...)")
    require("observer", observer, Callable | None, "a function of a Loop")
    engine, progress = computation.engine, _onwards(computation.progress)
    reason = "" if observer is None else "an observer"
    reason = "dt=None" if dt is None else reason
    if engine == "compiled" and reason:
        message = f'engine must be "python" or None for {reason}, got {engine!r}'
        raise InvalidInputError(message, given=engine)
    # a loop that diverges overflows before the error says so
    with np.errstate(over="ignore", invalid="ignore"):
        if dt is None:
            for wrong, why in (
                (observer is not None, "an observer, which looks at every sample"),
                (plant.needs_sampling, "a plant with sensing, actuator delay or servo"),
                (plant.is_stepped, "a plant with drives, or a MujocoPlant with dry friction"),
                (
                    not controller.is_continuous,
                    f"a controller that runs in samples, {controller!r}",
                ),
            ):
                if wrong:
                    raise InvalidInputError(f"dt must be given for {why}, got None", given=None)
            count = 1000 if record_every is None else whole("record_every", record_every, duration)
            return _continuous(plant, controller, wanted, start, duration, count, computation)
        steps, stride = whole("dt", dt, duration), 1
        if record_every is not None:
            record_every = as_number("record_every", record_every, unit="s", above=0.0)
            stride = whole("dt", dt, record_every, of="record_every")
        loop = SampledLoop(
            plant, controller, wanted, start, dt, steps, computation.integrator, seed
        )
        why = "an observer looks at each step" if observer is not None else ""
        if engine != "python" and observer is None:
            ran, why = importlib.import_module(_MACHINE_CODE).whole_run(
                loop, stride, progress, must=engine == "compiled"
            )
            if ran is not None:
                return replace(ran, engine="machine code")
        run = _sampled(loop, stride, observer, progress)
        return replace(run, engine=f"Python: {why}" if why else "Python")


def _onwards(progress: Progress | None) -> Progress:
    """Return a progress function that gets each time once, also where a run begins anew."""
    reached = -math.inf

    def report(t: float) -> None:
        nonlocal reached
        if progress is not None and t > reached:
            reached = t
            progress(t)

    return report


def whole(name: str, part: float, total: float, *, of: str = "duration") -> int:
    """Return total/part, or raise an InvalidInputError if that is no integer."""
    part = as_number(name, part, unit="s", above=0.0)
    if part < 1e-9 * total:
        message = f"{name} must be at least 1e-9 of {of} = {total:g} [s], got {part:g}"
        raise InvalidInputError(message, given=part)
    count = round(total / part)
    if count < 1 or abs(count * part - total) > 1e-9 * total:
        message = f"{of} must be a whole number of {name} = {part:g} [s], got {total:g}"
        raise InvalidInputError(message, given=total)
    return count


def _continuous(
    plant: Plant,
    controller: Controller,
    wanted: Wanted,
    start: InitialState,
    duration: float,
    count: int,
    computation: Computation,
) -> Trajectory:
    solve_ivp = package_of("study", "scipy.integrate").solve_ivp
    model, n = plant.robot.model, plant.robot.nv
    q0, v0, given = start.checked(plant)
    evaluations, checked, progress = 0, 0.0, _onwards(computation.progress)
    # the motion since the start, ξ with ξ̇ = q̇, is a coordinate of continuous joints, too

    def flow(t: float, z: Array) -> Array:
        nonlocal evaluations, checked
        evaluations += 1
        if evaluations % _STALL == 0:  # LSODA creeps towards a pole for ever
            if t - checked <= 1e-9 * duration:
                raise _stopped(t, duration, "the steps have become vanishingly small")
            checked = t
        if evaluations % _REPORTED == 0:
            progress(t)
        v = z[n : 2 * n]
        try:
            measurement = plant.measure(t, pin.integrate(model, q0, z[:n]), v)
            answer = controller.evaluate(z[2 * n :], measurement, target_at(wanted, t))
            shapes = np.shape(answer.torque), np.shape(answer.state_rate)  # type: ignore[arg-type]
        except (InvalidInputError, MeasurementError) as error:
            raise diverged(t, duration, error) from error
        except Exception as error:
            raise failed(f"evaluate of {controller!r}", t, error) from error
        if shapes != (v.shape, z[2 * n :].shape):
            raise ControllerError(
                f"evaluate of {controller!r} must return torque and state_rate of shapes "
                f"{v.shape} and {z[2 * n :].shape}, got {shapes} at t = {t:g} s",
                given=answer,
            )
        return np.concatenate(
            [v, plant.acceleration(measurement.q, v, answer.torque), answer.state_rate]
        )

    times, truth = np.linspace(0.0, duration, count + 1), plant.measure(0.0, q0, v0)
    first = target_at(wanted, 0.0)
    state = first_state(plant, controller, first, truth, 1.0, given, rests=True)
    start_of = np.concatenate([np.zeros(n), v0, state])
    rtol, atol = computation.rtol, computation.atol
    solved = solve_ivp(flow, (0.0, duration), start_of, "LSODA", times, rtol=rtol, atol=atol)
    if not solved.success or not np.isfinite(solved.y).all():
        reached = solved.t[-1] if len(solved.t) else 0.0
        raise _stopped(reached, duration, solved.message)
    progress(duration)
    records = [start_of, *solved.y.T[1:]]
    kept = Record(plant, len(times))
    for t, z in zip(times, records, strict=True):
        truth = plant.measure(t, pin.integrate(model, q0, z[:n]), z[n : 2 * n])
        state, target = z[2 * n :].copy(), target_at(wanted, t)
        answer = controller.evaluate(state, truth, target)
        kept.add(truth, truth.x, state, answer, answer.torque, x_of(target), controller)
    return kept.trajectory()


def _sampled(
    loop: SampledLoop, stride: int, observer: Observer | None, progress: Progress
) -> Trajectory:
    """Run a sampled loop to its end, and record every so many steps."""
    record = Record(loop.plant, loop.steps // stride + 2, loop.dt)
    with observer if isinstance(observer, AbstractContextManager) else nullcontext():
        while True:
            # as they are before an observer changes them
            instant = loop.instant
            wanted = loop.step % stride == 0 or loop.ended
            if wanted:
                record.add(*instant)
                progress(loop.t)
            if observer is not None:
                observer(loop)
            if loop.ended:
                if not wanted:
                    record.add(*instant)
                return record.trajectory()
            loop.advance()
