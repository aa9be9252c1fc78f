"""`simulate`: a plant and a controller run together, continuously or sampled."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np
import pinocchio as pin

from approxjac.checks import Array, as_array, as_number, require
from approxjac.errors import InvalidInputError, MeasurementError, SimulationError, UnknownNameError
from approxjac.interface import Controller, Evaluation, Measurement
from approxjac.simulation.integrators import INTEGRATORS
from approxjac.simulation.plant import Plant
from approxjac.simulation.sensing import SensorReadings
from approxjac.simulation.trajectory import Trajectory
from approxjac.tasks import Task

Progress = Callable[[float], None]
_STALL_STEPS = 1000


def simulate(
    plant: Plant,
    controller: Controller,
    target: Sequence[float] | Array,
    q0: Sequence[float] | Array,
    duration: float,
    *,
    dt: float | None = None,
    v0: Sequence[float] | Array | None = None,
    record_every: float | None = None,
    integrator: str = "rk4",
    seed: int = 0,
    rtol: float = 1e-9,
    atol: float = 1e-11,
    progress: Progress | None = None,
) -> Trajectory:
    """Run a controller against a plant.

    Args:
        plant: The true robot.
        controller: Anything with the interface of `Controller`.
        target: x_d, shape (n_x,) [unit of the task].
        q0: Start configuration, shape (nq,).
        duration: > 0 [s].
        dt: Sampling time [s]: torques are held over it, as a robot does. None integrates
            (q, v, controller state) as one differential equation with LSODA, as the paper does.
            A controller that limits rates or speeds, or that holds measurements, has a `dt` of
            its own, which it must be.
        v0: Start velocity, shape (n_v,); at rest by default.
        record_every: Time between recorded instants [s]: dt, or duration/1000 where dt is None.
            A whole number of them fits into duration where dt is None; it is a whole number of dt
            otherwise, and the last instant is recorded too.
        integrator: Of the plant between samples: "rk4" or "semi_implicit_euler".
        seed: Of the noise and the dropouts of the plant's sensing, ≥ 0.
        rtol: Relative tolerance of the continuous integration.
        atol: Absolute tolerance of the continuous integration.
        progress: Called now and then with the time reached [s].

    Returns:
        The record of the run; its first instant is the start, its last the end. Status is
        recorded at these instants only.

    Raises:
        InvalidInputError: Wrong shapes, numbers that are not finite or out of range.
        UnknownNameError: No such integrator.
        SimulationError: The closed loop diverged, or the integration could not reach the end.
    """
    require("plant", plant, Plant, "a Plant (the first argument; the controller is the second)")
    if isinstance(controller, type) or not hasattr(controller, "evaluate"):
        raise InvalidInputError(
            f"controller must be a controller, such as SetpointController(...), got {controller!r}",
            given=controller,
        )
    task = getattr(controller, "task", None)
    if isinstance(task, Task):
        plant.require_measured(task)
    robot = plant.robot
    x_d = plant.sensor.target(target)
    q = robot.configuration(as_array("q0", q0, (robot.nq,), "rad"), "q0")
    v = as_array("v0", np.zeros(robot.nv) if v0 is None else v0, (robot.nv,), "rad/s")
    duration = as_number("duration", duration, unit="s", above=0.0)
    if not isinstance(integrator, str) or integrator not in INTEGRATORS:
        raise UnknownNameError("integrator", integrator, "the integrators", INTEGRATORS)
    if type(seed) is not int or seed < 0:
        raise InvalidInputError(f"seed must be an integer >= 0, got {seed!r}", given=seed)
    if progress is not None and not callable(progress):
        raise InvalidInputError(
            f"progress must be a function of the time reached [s], got {progress!r}", given=progress
        )
    if dt is not None:
        dt = as_number("dt", dt, unit="s", above=0.0)
    wanted = getattr(controller, "dt", None)
    if isinstance(wanted, float) and (dt is None or not math.isclose(dt, wanted)):
        raise InvalidInputError(
            f"dt must be that of the controller, {wanted:g} [s], which keeps limits of torque "
            f"rates, speeds or positions, or a held measurement, from step to step, got {dt!r}",
            given=dt,
        )
    if dt is None:
        if plant.needs_sampling:
            raise InvalidInputError(
                "dt must be given for a plant with sensing or an actuator delay: they are those "
                "of sampled control",
                given=dt,
            )
        count = 1000 if record_every is None else _whole("record_every", record_every, duration)
        rtol = as_number("rtol", rtol, above=0.0)
        atol = as_number("atol", atol, above=0.0)
        with _overflow_is_expected():
            record = _continuous(
                plant, controller, x_d, q, v, duration, count, rtol, atol, progress
            )
    else:
        steps = _whole("dt", dt, duration)
        stride = 1
        if record_every is not None:
            record_every = as_number("record_every", record_every, unit="s", above=0.0)
            stride = _whole("dt", dt, record_every, whole="record_every")
        with _overflow_is_expected():
            record = _sampled(
                plant, controller, x_d, q, v, dt, steps, stride, integrator, seed, progress
            )
    return _trajectory(plant, x_d, *record)


def _trajectory(
    plant: Plant,
    x_d: Array,
    truths: list[Measurement],
    seen: list[Array],
    states: Array,
    evaluations: list[Evaluation],
) -> Trajectory:
    """Put what was recorded into arrays with time as their first axis."""
    robot = plant.robot
    x = np.array([truth.x for truth in truths])
    for k in np.nonzero(~np.isfinite(x).all(axis=1))[0]:  # the record has what no sensor sees too
        x[k] = plant.sensor.value(truths[k].q)
    return Trajectory(
        t=np.array([truth.t for truth in truths]),
        q=np.array([truth.q for truth in truths]),
        v=np.array([truth.v for truth in truths]),
        x=x,
        x_measured=np.array(seen),
        error=np.array([plant.sensor.error(value, x_d) for value in x]),
        tau=np.array([e.torque for e in evaluations]),
        state=states,
        status=np.array([int(e.status) for e in evaluations], dtype=np.int64),
        limit_status=np.array([int(e.limit_status) for e in evaluations], dtype=np.int64),
        slack=np.array([e.slack for e in evaluations]),
        sigma_min=np.array([e.sigma_min for e in evaluations]),
        target=x_d,
        robot_name=robot.name,
        joint_names=robot.joint_names,
        joint_units=robot.joint_units,
        task_labels=plant.sensor.labels,
        task_units=plant.sensor.units,
    )


def _overflow_is_expected() -> np.errstate:
    """A loop that diverges overflows before it is told; the error says so, no warning is needed."""
    return np.errstate(over="ignore", invalid="ignore")


def _diverged(t: float, duration: float, error: Exception) -> SimulationError:
    return SimulationError(
        f"the simulation diverged at t = {t:g} of {duration:g} s: {error} (a smaller dt or smaller "
        "gains may help)",
        given=t,
    )


def _copied(answer: Evaluation) -> Evaluation:
    """Return an answer to keep: a controller may use one buffer for all its torques."""
    return answer._replace(torque=answer.torque.copy())


def _first_state(
    plant: Plant, controller: Controller, x_d: Array, measurement: Measurement
) -> Array:
    """Initial state of a controller, after one evaluation whose answer is looked at.

    What is wrong with the arguments or the controller shows here, and not as a divergence.
    """
    state = as_array(
        "the controller's initial_state",
        controller.initial_state(measurement),
        (controller.n_state,),
    )
    answer = controller.evaluate(state, measurement, x_d)
    require("the controller's answer", answer, Evaluation, "an Evaluation")
    as_array("the controller's torque", answer.torque, (plant.robot.nv,), "N m or N")
    as_array("the controller's state_rate", answer.state_rate, state.shape)
    if np.isfinite(measurement.x).all():  # a lost x has no error
        as_array("the controller's e", answer.e, (plant.sensor.m,), plant.sensor.unit)
    return state


def _whole(name: str, part: float, total: float, *, whole: str = "duration") -> int:
    """Return how often a time fits into another; refuse one that does not fit evenly."""
    part = as_number(name, part, unit="s", above=0.0)
    if part < 1e-9 * total:
        raise InvalidInputError(
            f"{name} must be at least 1e-9 of {whole} = {total:g} [s], got {part:g}", given=part
        )
    count = round(total / part)
    if count < 1 or abs(count * part - total) > 1e-9 * total:
        raise InvalidInputError(
            f"{whole} must be a whole number of {name} = {part:g} [s], got {total:g}", given=total
        )
    return count


def _continuous(
    plant: Plant,
    controller: Controller,
    x_d: Array,
    q0: Array,
    v0: Array,
    duration: float,
    count: int,
    rtol: float,
    atol: float,
    progress: Progress | None,
) -> tuple[list[Measurement], list[Array], Array, list[Evaluation]]:
    """Integrate (q, v, controller state) together, and record on a grid.

    Every joint has one degree of freedom, so the motion since the start, ξ with ξ̇ = q̇, is a
    coordinate of the whole configuration space, continuous joints included.
    """
    from scipy.integrate import LSODA

    model, n = plant.robot.model, plant.robot.nv

    def flow(t: float, z: Array) -> Array:
        v = z[n : 2 * n]
        measurement = plant.measure(t, pin.integrate(model, q0, z[:n]), v)
        answer = controller.evaluate(z[2 * n :], measurement, x_d)
        return np.concatenate(
            [v, plant.acceleration(measurement.q, v, answer.torque), answer.state_rate]
        )

    times = np.linspace(0.0, duration, count + 1)
    state = _first_state(plant, controller, x_d, plant.measure(0.0, q0, v0))
    records = np.empty((count + 1, 2 * n + len(state)))
    records[0] = np.concatenate([np.zeros(n), v0, state])
    solver = LSODA(flow, 0.0, records[0], duration, rtol=rtol, atol=atol)
    done, steps, checked = 1, 0, 0.0
    while solver.status == "running":
        try:
            message = solver.step()
        except (InvalidInputError, MeasurementError) as error:
            raise _diverged(solver.t, duration, error) from error
        steps += 1
        if steps % _STALL_STEPS == 0:  # LSODA creeps towards a pole for ever and calls it running
            if solver.t - checked <= 1e-9 * duration:
                message = "the steps have become vanishingly small"
            checked = solver.t
        if not np.isfinite(solver.y).all():
            message = "the state is no longer finite"
        if message is not None:
            raise SimulationError(
                f"the integration stopped at t = {solver.t:g} of {duration:g} s: {message}",
                given=solver.y.copy(),
            )
        reached = int(np.searchsorted(times, solver.t, side="right"))
        if reached > done:
            records[done:reached] = solver.dense_output()(times[done:reached]).T
            done = reached
            if progress is not None:
                progress(solver.t)
    records[-1] = solver.y
    measurements = [
        plant.measure(t, pin.integrate(model, q0, record[:n]), record[n : 2 * n])
        for t, record in zip(times, records, strict=True)
    ]
    states = records[:, 2 * n :].copy()
    evaluations = [
        _copied(controller.evaluate(state, measurement, x_d))
        for state, measurement in zip(states, measurements, strict=True)
    ]
    return measurements, [measurement.x for measurement in measurements], states, evaluations


def _sampled(
    plant: Plant,
    controller: Controller,
    x_d: Array,
    q: Array,
    v: Array,
    dt: float,
    steps: int,
    stride: int,
    integrator: str,
    seed: int,
    progress: Progress | None,
) -> tuple[list[Measurement], list[Array], Array, list[Evaluation]]:
    """Hold each torque over dt; the controller's state takes an Euler step."""
    step = INTEGRATORS[integrator]
    readings = None
    if plant.sensing is not None:
        readings = SensorReadings(plant.sensing, plant.sensor, dt, seed)
    truth = plant.measure(0.0, q, v)
    measurement = truth if readings is None else readings.read(truth)
    state = _first_state(plant, controller, x_d, measurement)
    late = round(min(plant.actuator_delay / dt, float(steps)))
    waiting = deque([plant.dynamics.g(q)] * late)
    truths: list[Measurement] = []
    seen: list[Array] = []
    states: list[Array] = []
    evaluations: list[Evaluation] = []
    for k in range(steps + 1):
        try:
            answer = controller.evaluate(state, measurement, x_d)
        except (InvalidInputError, MeasurementError) as error:
            raise _diverged(k * dt, steps * dt, error) from error
        if k % stride == 0 or k == steps:
            truths.append(truth)
            seen.append(measurement.x)
            states.append(state)
            evaluations.append(_copied(answer))
            if progress is not None:
                progress(truth.t)
        if k < steps:
            waiting.append(answer.torque.copy())
            state = state + dt * answer.state_rate
            try:
                q, v = step(plant, q, v, waiting.popleft(), dt)
                as_array("state", state, state.shape)
                truth = plant.measure((k + 1) * dt, q, v)
            except InvalidInputError as error:
                raise _diverged((k + 1) * dt, steps * dt, error) from error
            measurement = truth if readings is None else readings.read(truth)
    return truths, seen, np.array(states), evaluations
