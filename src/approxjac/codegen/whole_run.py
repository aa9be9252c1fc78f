"""One run of a compiled law, with all that `simulate` records."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import numpy as np

from approxjac.codegen import traced_law as laws
from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.arm_numbers import ArmNumbers, arm_numbers
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.loop_program import TracedLoop, loop_key
from approxjac.codegen.trace.program import Block, Program
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError
from approxjac.interface import LimitStatus, Target
from approxjac.simulation import Plant
from approxjac.simulation.simulate import SampledLoop
from approxjac.simulation.trajectory import Record, Trajectory
from approxjac.validation import Array

_NOT_INSTALLED = "llvmlite is not installed: pip install 'approxjac[fast]'"
_STEPS = 5000  # that take Python longer than to trace and to compile the loop
_SOLVER_STEPS = 50_000  # where limits need a solver, whose code is ten times as long
_KEPT = 8
_loops: dict[bytes, _Loop] = {}
_COLUMNS = (
    "q", "v", "twist", "rate", "x", "x", "target", "torque", "torque", "state", "status",
    "limit_status", "slack", "e",
)  # fmt: skip


def whole_run(
    loop: SampledLoop, stride: int, progress: Callable[[float], None], *, must: bool
) -> tuple[Trajectory | None, str]:
    """Return a run carried out by machine code, or None, and a text on it.

    Args:
        loop: The loop at its start.
        stride: Number of steps between recorded ones; the last is recorded, too.
        progress: Function called now and then with the time reached [s].
        must: True to compile a short run, too, and raise an error if that is not possible.
    """
    try:
        code = _loop_of(loop, must)
    except InvalidInputError as error:
        if must:
            raise
        return None, str(error)
    if code is None:
        return None, ""
    columns = code.run(loop, stride, progress)
    if columns is None:  # the same again, from the beginning, to the error or past what is rare
        return None, "code does not cover what happened on the way"
    return Record.of(loop.plant, loop.controller, columns, loop.dt).trajectory(), ""


def _loop_of(loop: SampledLoop, must: bool) -> _Loop | None:
    """Return the compiled loop of a run, or None of one that is shorter than it takes to make it.

    Raises:
        InvalidInputError: Code cannot be made of it.
    """
    plant, law = loop.plant, getattr(loop.controller, "ordinary", loop.controller)
    enough = _SOLVER_STEPS if law.needs_solver else _STEPS
    is_ours = all(map(laws.is_ours, (law, getattr(law, "controller", law), law.law)))
    if loop.steps < enough and not (must or law is not loop.controller):
        return None
    for holds, which in (
        (not isinstance(loop.path, np.ndarray), "a target that moves"),
        (plant.needs_sampling, "sensing, delays or a servo"),
        (not must and not is_ours, 'a law of your own, unless engine="compiled" is asked for'),
        (not must and importlib.util.find_spec("llvmlite") is None, _NOT_INSTALLED),
    ):
        if holds:
            why = f'engine must be "python" or None for {which}, got "compiled"' if must else which
            raise InvalidInputError(why, given="compiled")
    given = law, plant, loop.dt, loop.integrator
    known = _loops.get(key := loop_key(*given))
    if known is None:
        known = _loops[key] = _Loop(*given)
        if len(_loops) > _KEPT:
            _loops.pop(next(iter(_loops)), None)
    return known


class _Loop:
    """A compiled loop, with ideal sensors."""

    def __init__(self, law: Controller, plant: Plant, dt: float, integrator: str) -> None:
        program, nv = Program(), plant.robot.nv
        target = Target(program.kept("target", plant.sensor.n_x))
        numbers = ArmNumbers.stacked([arm_numbers(plant.robot, tasks.frames(plant.sensor))])
        loop = TracedLoop(program, law, plant, numbers, target, dt, integrator)
        answer, unknown = loop.answer, np.zeros((plant.sensor.m, nv))
        program.step(loop.after | {
            "x": loop.x, "torque": answer.torque, "e": answer.e,
            "J_hat": unknown if answer.J_hat is None else answer.J_hat, "status": answer.status,
            "limit_status": answer.limit_status, "slack": answer.slack,
        })  # fmt: skip
        self._lanes, self._rows = LlvmLanes(program, width=1), program.n_rows
        self._place = {name: slice(at, at + size) for name, (at, size) in program.rows.items()}
        self._n_before = self._place["state"].stop  # rows of what is known before a step
        self._shape = plant.sensor.m, nv

    def run(
        self, loop: SampledLoop, stride: int, progress: Callable[[float], None]
    ) -> list[Array] | None:
        """Return the columns of a run, or None of one that is not covered."""
        place, steps, lanes = self._place, loop.steps, self._lanes
        # of each run its own, as others may be under way
        buffer, nothing = np.zeros((1, self._rows, 1)), np.zeros((1, 1, 1))
        flat, first = buffer[0, :, 0], lanes.bound(buffer, nothing)
        flat[place["target"]], flat[place["state"]] = loop.target, loop.state
        flat[place["q"]], flat[place["v"]] = loop.truth.q, loop.truth.v
        if loop.motors is not None:
            for name, value in loop.motors._asdict().items():
                flat[place[name]] = value
        at = [*range(0, steps, stride), steps]
        before, answered = flat[: self._n_before], flat[self._n_before :]
        table = np.empty((len(at), len(flat)))
        for row, k, following in zip(table, at, [*at[1:], steps + 1], strict=True):
            row[: self._n_before] = before
            first()
            row[self._n_before :] = answered
            if following - k > 1:
                lanes.run(buffer, nothing, Block.plain(following - k - 1))
            if flat[place["left"]].any() or flat[place["diverged"]].any():
                return None
            progress(k * loop.dt)
        named = {name: table[:, each] for name, each in place.items()}
        for name in ("status", "limit_status", "slack"):
            named[name] = named[name][:, 0]
        # without the proof there is none
        named["slack"][named["limit_status"] == LimitStatus.LIMITED] = np.nan
        if loop.motors is None:
            named |= {"twist": np.zeros_like(named["v"]), "rate": named["v"]}
        J_hat = named["J_hat"].reshape(-1, *self._shape)
        return [np.array(at) * loop.dt, *(named[name].copy() for name in _COLUMNS), J_hat]
