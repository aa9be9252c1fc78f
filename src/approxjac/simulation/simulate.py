"""`simulate`: a plant and a controller run together, continuously or sampled."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from types import NoneType
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError, MeasurementError, SimulationError, UnknownNameError
from approxjac.extras import package_of
from approxjac.interface import Target, TargetPath
from approxjac.robots.joint_limits import require_radians
from approxjac.simulation.engines import require_engine, run_in_code
from approxjac.simulation.integrators import INTEGRATORS
from approxjac.simulation.loop import Loop
from approxjac.simulation.plant import Plant
from approxjac.simulation.record import Record
from approxjac.simulation.sampled_loop import SampledLoop
from approxjac.simulation.targets import (
    Wanted,
    diverged,
    first_state,
    require_fit,
    target_at,
    wanted_of,
)
from approxjac.simulation.trajectory import Trajectory
from approxjac.validation import Array, as_array, as_integer, as_number, require

Progress = Callable[[float], None]
Observer = Callable[[Loop], None]
_FUNCTION: Any = (Callable, NoneType)
_STALL_STEPS = 1000


def simulate(
    plant: Plant,
    controller: Controller,
    target: Sequence[float] | Array | Target | TargetPath,
    q0: Sequence[float] | Array | None = None,
    duration: float = 10.0,
    *,
    dt: float | None = 1e-3,
    v0: Sequence[float] | Array | None = None,
    state: Array | None = None,
    record_every: float | None = None,
    integrator: str = "rk4",
    seed: int = 0,
    rtol: float = 1e-9,
    atol: float = 1e-11,
    engine: str | None = None,
    progress: Progress | None = None,
    observer: Observer | None = None,
) -> Trajectory:
    """Run a controller against a plant.

    Args:
        plant: The true robot.
        controller: A controller, such as a `SetpointController`, or one of your own.
        target: x_d, shape (n_x,) [unit of the task]; a `Target` that moves; or a path, any object
            with `at(t) → Target`, such as `Circle`.
        q0: Start configuration, shape (nq,); `plant.ready_configuration()` by default.
        duration: > 0 [s].
        dt: Sampling time [s]: torques are held over it, as a robot does. None integrates
            (q, v, controller state) as one differential equation with LSODA, as the paper does,
            for laws in continuous time. A controller that limits speeds or positions has a `dt`
            of its own, which it must be.
        v0: Start velocity, shape (n_v,); at rest by default.
        state: State of the controller to begin with, such as `controller.resumed(...)` gives; by
            default its `initial_state`.
        record_every: Time between recorded instants [s]: dt, or duration/1000 where dt is None.
            A whole number of them fits into duration where dt is None; it is a whole number of dt
            otherwise, and the last instant is recorded too.
        integrator: Of the plant between samples: "rk4" or "semi_implicit_euler".
        seed: Of the noise and the dropouts of the plant's sensing, ≥ 0.
        rtol: Relative tolerance of the continuous integration.
        atol: Absolute tolerance of the continuous integration.
        engine: "compiled" traces the closed loop and runs it as machine code, some 20 times as
            fast; "python" takes its steps one by one, with anything. By default machine code where
            it covers the run, llvmlite is installed (the extra `fast`) and the run takes 5000 steps
            or more; the record says which it was.
        progress: Called now and then with the time reached [s].
        observer: Called with the `Loop`, which says what it may do, at every step of
            sampled control. An observer that is a context manager is entered before the run and
            left after it, however it ends.

    Returns:
        The record of the run; its first instant is the start, its last the end. Status is
        recorded at these instants only.

    Raises:
        InvalidInputError: Wrong shapes, numbers that are not finite or out of range.
        UnknownNameError: No such integrator or engine.
        SimulationError: The closed loop diverged, or the integration could not reach the end.
    """
    require("plant", plant, Plant, "a Plant (the first argument; the controller is the second)")
    if dt is not None:
        dt = as_number("dt", dt, unit="s", above=0.0)
    require_fit(plant, controller, dt)
    robot = plant.robot
    wanted = wanted_of(plant.sensor, target, 0.0)
    q0 = plant.ready_configuration() if q0 is None else q0
    q = as_array("q0", robot.configuration(q0, "q0"), (robot.nq,))
    require_radians("q0", robot, q)
    v = as_array("v0", np.zeros(robot.nv) if v0 is None else v0, (robot.nv,), "rad/s")
    duration = as_number("duration", duration, unit="s", above=0.0)
    rtol, atol = as_number("rtol", rtol, above=0.0), as_number("atol", atol, above=0.0)
    if not isinstance(integrator, str) or integrator not in INTEGRATORS:
        raise UnknownNameError("integrator", integrator, "the integrators", INTEGRATORS)
    as_integer("seed", seed, 0)
    require("progress", progress, _FUNCTION, "a function of the time reached [s]")
    require("observer", observer, _FUNCTION, "a function of a Loop")
    reason = "an observer" if observer is not None else ""
    require_engine(engine, "dt=None" if dt is None else reason)
    # a loop that diverges overflows before the error says so
    with np.errstate(over="ignore", invalid="ignore"):
        if dt is None:
            if state is not None:
                raise InvalidInputError("dt must be given for a state, got None", given=None)
            law = _continuous_law(plant, controller, observer)
            count = 1000 if record_every is None else whole("record_every", record_every, duration)
            return _continuous(plant, law, wanted, q, v, duration, count, rtol, atol, progress)
        steps, stride = whole("dt", dt, duration), 1
        if record_every is not None:
            record_every = as_number("record_every", record_every, unit="s", above=0.0)
            stride = whole("dt", dt, record_every, of="record_every")
        loop = SampledLoop(plant, controller, wanted, q, v, dt, steps, integrator, seed, state)
        progress = None if progress is None else _onwards(progress)
        ran, why = None, "an observer looks at each step" if observer is not None else ""
        if engine != "python" and observer is None:
            ran, why = run_in_code(loop, stride, engine, progress)
        if ran is not None:
            return replace(ran, engine="machine code")
        run = _sampled(loop, stride, observer, progress)
        return replace(run, engine=f"Python: {why}" if why else "Python")


def _onwards(progress: Progress) -> Progress:
    """Return a progress function that gets each time once, also where a run begins anew."""
    reached = -math.inf

    def tell(t: float) -> None:
        nonlocal reached
        if t > reached:
            reached = t
            progress(t)

    return tell


def _continuous_law(plant: Plant, controller: Controller, observer: Observer | None) -> Controller:
    """Return the controller, unless it or something else needs samples."""
    if observer is not None:
        why = "an observer: it looks at every step of sampled control"
    elif plant.needs_sampling:
        why = "a plant with sensing, actuator delay or servo: they are those of sampled control"
    elif not controller.is_continuous:
        why = f"a controller that runs in samples, got None for {controller!r}"
    else:
        return controller
    raise InvalidInputError(f"dt must be given for {why}", given=None)


def whole(name: str, part: float, total: float, *, of: str = "duration") -> int:
    """Return the ratio of two times; refuse one that is no integer."""
    part = as_number(name, part, unit="s", above=0.0)
    if part < 1e-9 * total:
        raise InvalidInputError(
            f"{name} must be at least 1e-9 of {of} = {total:g} [s], got {part:g}", given=part
        )
    count = round(total / part)
    if count < 1 or abs(count * part - total) > 1e-9 * total:
        raise InvalidInputError(
            f"{of} must be a whole number of {name} = {part:g} [s], got {total:g}", given=total
        )
    return count


def _continuous(
    plant: Plant,
    controller: Controller,
    wanted: Wanted,
    q0: Array,
    v0: Array,
    duration: float,
    count: int,
    rtol: float,
    atol: float,
    progress: Progress | None,
) -> Trajectory:
    """Integrate (q, v, controller state) together, and record on a grid."""
    LSODA = package_of("study", "scipy.integrate").LSODA
    model, n = plant.robot.model, plant.robot.nv
    # the motion since the start, ξ with ξ̇ = q̇, is a coordinate of continuous joints, too

    def flow(t: float, z: Array) -> Array:
        v = z[n : 2 * n]
        measurement = plant.measure(t, pin.integrate(model, q0, z[:n]), v)
        answer = controller.evaluate(z[2 * n :], measurement, target_at(wanted, t))
        return np.concatenate(
            [v, plant.acceleration(measurement.q, v, answer.torque), answer.state_rate]
        )

    times = np.linspace(0.0, duration, count + 1)
    state = first_state(plant, controller, target_at(wanted, 0.0), plant.measure(0.0, q0, v0), 1.0)
    records = np.empty((count + 1, 2 * n + len(state)))
    records[0] = np.concatenate([np.zeros(n), v0, state])
    solver = LSODA(flow, 0.0, records[0], duration, rtol=rtol, atol=atol)
    done, steps, checked = 1, 0, 0.0
    while solver.status == "running":
        try:
            message = solver.step()
        except (InvalidInputError, MeasurementError) as error:
            raise diverged(solver.t, duration, error) from error
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
    kept = Record(plant, len(times))
    for t, z in zip(times, records, strict=True):
        truth = plant.measure(t, pin.integrate(model, q0, z[:n]), z[n : 2 * n])
        state, target = z[2 * n :].copy(), target_at(wanted, t)
        answer = controller.evaluate(state, truth, target)
        x_d = target.x if isinstance(target, Target) else target
        kept.add(truth, truth.x, state, answer, answer.torque, x_d, controller)
    return kept.trajectory()


def _sampled(
    loop: SampledLoop, stride: int, observer: Observer | None, progress: Progress | None
) -> Trajectory:
    """Run a sampled loop to its end, and record every so many steps."""
    record = Record(loop.plant, loop.steps // stride + 2, loop.dt)
    with observer if isinstance(observer, AbstractContextManager) else nullcontext():
        while True:
            # as they are before an observer changes them
            instant = (
                loop.truth, loop.measurement.x, loop.state, loop.answer, loop.tau, loop.target,
                loop.controller,
            )  # fmt: skip
            wanted = loop.step % stride == 0 or loop.ended
            if wanted:
                record.add(*instant)
                if progress is not None:
                    progress(loop.t)
            if observer is not None:
                observer(loop)
            if loop.ended:
                if not wanted:
                    record.add(*instant)
                return record.trajectory()
            loop.advance()
