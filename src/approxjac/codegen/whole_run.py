"""One run of a compiled law, with all that `simulate` records."""

from __future__ import annotations

import hashlib
import importlib.util
import pickle
import threading
import uuid
from collections import OrderedDict
from collections.abc import Callable

import numpy as np

from approxjac.codegen import traced_law as laws
from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.arm_numbers import ArmNumbers, arm_numbers
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.loop_program import TracedLoop, require_covered
from approxjac.codegen.trace.program import Block, Program
from approxjac.codegen.trace.symbols import select
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError
from approxjac.interface import LimitStatus, Target
from approxjac.simulation import Plant
from approxjac.simulation.simulate import SampledLoop
from approxjac.simulation.trajectory import Record, Trajectory
from approxjac.validation import Array

_KEPT = 8  # loops
_NOT_INSTALLED = "llvmlite is not installed: pip install 'approxjac[fast]'"
_STEPS = 5000  # that take Python longer than to trace and to compile the loop
_SOLVER_STEPS = 50_000  # where limits need a solver, whose code is ten times as long
_loops: OrderedDict[str, _Loop] = OrderedDict()
_lock = threading.Lock()


def whole_run(
    loop: SampledLoop, stride: int, progress: Callable[[float], None], *, must: bool
) -> tuple[Trajectory | None, str]:
    """Return a run that machine code carried out; or None, and why it did not.

    Args:
        loop: At the beginning.
        stride: Which steps are recorded: each so many, and the last.
        progress: Called now and then with the time reached [s].
        must: Make code of a short run, too, and raise an error where that is not possible.
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
    try:  # what may have been changed since is compared by its value
        values = pickle.dumps((law, plant, loop.dt, loop.integrator))
        key = hashlib.sha256(values).hexdigest()
    except (pickle.PicklingError, AttributeError, TypeError):
        key = uuid.uuid4().hex
    with _lock:
        if key not in _loops:
            require_covered(law, plant)
            while len(_loops) >= _KEPT:
                _loops.popitem(last=False)
            _loops[key] = _Loop(law, plant, loop.dt, loop.integrator)
        _loops.move_to_end(key)
        return _loops[key]


def _recorded(controller: Controller, plant: Plant, dt: float, integrator: str) -> Program:
    """Return the program of a run with ideal sensors, which keeps what is recorded of a step."""
    program = Program()
    target = Target(program.kept("target", plant.sensor.n_x))
    numbers = ArmNumbers.stacked([arm_numbers(plant.robot, tasks.frames(plant.sensor))])
    loop = TracedLoop(program, controller, plant, numbers, target, dt, integrator)
    answer, unknown = loop.answer, np.zeros((plant.sensor.m, plant.robot.nv))
    flags = {
        name: (select(condition, 1.0, program.kept(name, 1)[0]))
        for name, condition in (("diverged", loop.diverged), ("left", loop.left))
    }
    found = {
        "x": loop.x, "torque": answer.torque, "e": answer.e,
        "J_hat": unknown if answer.J_hat is None else answer.J_hat, "status": answer.status,
        "limit_status": answer.limit_status, "slack": answer.slack,
    }  # fmt: skip
    program.step(loop.after | flags | found)
    return program


class _Loop:
    """A compiled loop."""

    def __init__(self, law: Controller, plant: Plant, dt: float, integrator: str) -> None:
        program = _recorded(law, plant, dt, integrator)
        self._lanes, self._rows = LlvmLanes(program, width=1), program.n_rows
        self._place = {name: slice(at, at + size) for name, (at, size) in program.rows.items()}
        self._n_before = self._place["state"].stop  # rows of what is known before a step
        self._shape = plant.sensor.m, plant.robot.nv

    def run(
        self, loop: SampledLoop, stride: int, progress: Callable[[float], None]
    ) -> list[Array] | None:
        """Return the columns of a run, or None of one that is not covered."""
        place, steps, lanes = self._place, loop.steps, self._lanes
        # of each run its own, as others may be under way
        buffer, nothing = np.zeros((1, self._rows, 1)), np.zeros((1, 1, 1))
        flat, first = buffer[0, :, 0], lanes.bound(buffer, nothing)
        for name, value in (
            ("target", loop.target), ("q", loop.truth.q), ("v", loop.truth.v),
            ("state", loop.state),
        ):  # fmt: skip
            flat[place[name]] = value
        at = [*range(0, steps, stride), steps]
        n_before = self._n_before
        before, answered = flat[:n_before], flat[n_before:]
        table = np.empty((len(at), len(flat)))
        for row, (k, following) in zip(
            table, zip(at, [*at[1:], steps + 1], strict=True), strict=True
        ):
            row[:n_before] = before
            first()
            row[n_before:] = answered
            if following - k > 1:
                lanes.run(buffer, nothing, Block.plain(following - k - 1))
            if flat[place["left"]].any() or flat[place["diverged"]].any():
                return None
            progress(k * loop.dt)
        n = len(at)
        q, v, x, x_d, tau, state, e = (
            table[:, place[name]] for name in ("q", "v", "x", "target", "torque", "state", "e")
        )
        J_hat = table[:, place["J_hat"]].reshape(n, *self._shape)
        status, limit_status, slack = (
            table[:, place[name]][:, 0] for name in ("status", "limit_status", "slack")
        )
        slack[limit_status == LimitStatus.LIMITED] = np.nan  # without the proof there is none
        t = np.array(at) * loop.dt
        return [
            t, q, v, x, x.copy(), x_d, tau, state, status, limit_status, slack, e, J_hat,
        ]  # fmt: skip
