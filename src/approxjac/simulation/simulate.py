"""`simulate`: a plant and a controller run together, continuously or sampled."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from types import NoneType
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.controllers.controller import Controller
from approxjac.errors import (
    InvalidInputError,
    MeasurementError,
    SimulationError,
    UnknownNameError,
    package_of,
)
from approxjac.formatting import short_fields
from approxjac.interface import Target, TargetPath
from approxjac.simulation.loop import (
    InitialState,
    Loop,
    SampledLoop,
    Wanted,
    diverged,
    first_state,
    require_fit,
    target_at,
    wanted_of,
    x_of,
)
from approxjac.simulation.plant import INTEGRATORS, Plant
from approxjac.simulation.trajectory import Record, Trajectory
from approxjac.validation import Array, as_integer, as_number, require

Progress = Callable[[float], None]
Observer = Callable[[Loop], None]
_FUNCTION: Any = (Callable, NoneType)
_STALL_STEPS = 1000
_MACHINE_CODE = "approxjac.codegen.whole_run"  # which builds on this, and so is loaded by its name


@dataclass(frozen=True, repr=False)
class Computation:
    """How a run is computed.

    Attributes:
        integrator: Of the plant between samples: "rk4" or "semi_implicit_euler".
        engine: "compiled" traces the closed loop and runs it as machine code, some 20 times as
            fast; "python" takes its steps one by one, with anything. By default machine code where
            it covers the run, llvmlite is installed (the extra `fast`) and the run takes 5000 steps
            or more; the record says which it was.
        rtol: Relative tolerance of the continuous integration (dt=None).
        atol: Absolute tolerance of it.
        progress: Called now and then with the time reached [s].

    Raises:
        InvalidInputError: A tolerance that is not positive, or a progress that is no function.
        UnknownNameError: No such integrator or engine.
    """

    integrator: str = "rk4"
    engine: str | None = None
    rtol: float = 1e-9
    atol: float = 1e-11
    progress: Progress | None = None
    __repr__ = short_fields

    def __post_init__(self) -> None:
        for kind, name, valid in (
            ("integrator", self.integrator, list(INTEGRATORS)),
            ("engine", "python" if self.engine is None else self.engine, ["compiled", "python"]),
        ):
            if not isinstance(name, str) or name not in valid:
                raise UnknownNameError(kind, name, f"the {kind}s", valid)
        as_number("rtol", self.rtol, above=0.0)
        as_number("atol", self.atol, above=0.0)
        require("progress", self.progress, _FUNCTION, "a function of the time reached [s]")


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
        q0: Start configuration, shape (nq,), at rest; or an `InitialState`, with a velocity or a
            state of the controller. `plant.ready_configuration()` by default.
        duration: > 0 [s].
        dt: Sampling time [s]: torques are held over it, as a robot does. None integrates
            (q, v, controller state) as one differential equation with LSODA, as the paper does,
            for laws in continuous time. A controller that limits speeds or positions has a `dt`
            of its own, which it must be.
        record_every: Time between recorded instants [s]: dt, or duration/1000 where dt is None.
            A whole number of them fits into duration where dt is None; it is a whole number of dt
            otherwise, and the last instant is recorded too.
        seed: Of the noise and the dropouts of the plant's sensing, ≥ 0.
        computation: Integrator, tolerances, machine code or Python, and a report of progress.
        observer: Called with the `Loop`, which says what it may do, at every step of
            sampled control. An observer that is a context manager is entered before the run and
            left after it, however it ends.

    Returns:
        The record of the run; its first instant is the start, its last the end. Status is
        recorded at these instants only.

    Raises:
        InvalidInputError: Wrong shapes, numbers that are not finite or out of range.
        SimulationError: The closed loop diverged, or the integration could not reach the end.
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
    require("observer", observer, _FUNCTION, "a function of a Loop")
    engine, progress = computation.engine, computation.progress
    reason = "" if observer is None else "an observer"
    reason = "dt=None" if dt is None else reason
    if engine == "compiled" and reason:
        raise InvalidInputError(
            f'engine must be "python" or None for {reason}, got {engine!r}', given=engine
        )
    # a loop that diverges overflows before the error says so
    with np.errstate(over="ignore", invalid="ignore"):
        if dt is None:
            _require_continuous(plant, controller, observer)
            count = 1000 if record_every is None else whole("record_every", record_every, duration)
            return _continuous(plant, controller, wanted, start, duration, count, computation)
        steps, stride = whole("dt", dt, duration), 1
        if record_every is not None:
            record_every = as_number("record_every", record_every, unit="s", above=0.0)
            stride = whole("dt", dt, record_every, of="record_every")
        loop = SampledLoop(
            plant, controller, wanted, start, dt, steps, computation.integrator, seed
        )
        ran: Trajectory | None = None
        why = "an observer looks at each step" if observer is not None else ""
        if engine != "python" and observer is None:
            progress = None if progress is None else _onwards(progress)
            ran, why = importlib.import_module(_MACHINE_CODE).whole_run(
                loop, stride, progress, must=engine == "compiled"
            )
        if ran is not None:
            return replace(ran, engine="machine code")
        run = _sampled(loop, stride, observer, progress)
        return replace(run, engine=f"Python: {why}" if why else "Python")


def _onwards(progress: Progress) -> Progress:
    """Return a progress function that gets each time once, also where a run begins anew."""
    reached = -math.inf

    def report(t: float) -> None:
        nonlocal reached
        if t > reached:
            reached = t
            progress(t)

    return report


def _require_continuous(plant: Plant, controller: Controller, observer: Observer | None) -> None:
    """Refuse what needs samples."""
    if observer is not None:
        why = "an observer: it looks at every step of sampled control"
    elif plant.needs_sampling:
        why = "a plant with sensing, actuator delay or servo: they are those of sampled control"
    elif not controller.is_continuous:
        why = f"a controller that runs in samples, got None for {controller!r}"
    else:
        return
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
    start: InitialState,
    duration: float,
    count: int,
    computation: Computation,
) -> Trajectory:
    """Integrate (q, v, controller state) together, and record on a grid."""
    LSODA = package_of("study", "scipy.integrate").LSODA
    model, n = plant.robot.model, plant.robot.nv
    q0, v0, given = start.checked(plant)
    # the motion since the start, ξ with ξ̇ = q̇, is a coordinate of continuous joints, too

    def flow(t: float, z: Array) -> Array:
        v = z[n : 2 * n]
        measurement = plant.measure(t, pin.integrate(model, q0, z[:n]), v)
        answer = controller.evaluate(z[2 * n :], measurement, target_at(wanted, t))
        return np.concatenate(
            [v, plant.acceleration(measurement.q, v, answer.torque), answer.state_rate]
        )

    times, truth = np.linspace(0.0, duration, count + 1), plant.measure(0.0, q0, v0)
    state = first_state(plant, controller, target_at(wanted, 0.0), truth, 1.0, given)
    records = np.empty((count + 1, 2 * n + len(state)))
    records[0] = np.concatenate([np.zeros(n), v0, state])
    rtol, atol = computation.rtol, computation.atol
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
            if computation.progress is not None:
                computation.progress(solver.t)
    records[-1] = solver.y
    kept = Record(plant, len(times))
    for t, z in zip(times, records, strict=True):
        truth = plant.measure(t, pin.integrate(model, q0, z[:n]), z[n : 2 * n])
        state, target = z[2 * n :].copy(), target_at(wanted, t)
        answer = controller.evaluate(state, truth, target)
        kept.add(truth, truth.x, state, answer, answer.torque, x_of(target), controller)
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
