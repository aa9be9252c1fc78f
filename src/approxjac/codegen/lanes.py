"""`Lanes`: many runs of a closed loop at once, each in a lane of the machine's vectors."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from approxjac.codegen import tasks
from approxjac.codegen.arm_numbers import ArmNumbers, arm_numbers
from approxjac.codegen.closed_loop import TOLD, Box, ClosedLoop, closed_loop
from approxjac.codegen.llvm import LlvmLanes
from approxjac.codegen.numpy_source import NumpyLanes
from approxjac.codegen.program import Program
from approxjac.controllers.setpoint import SetpointController
from approxjac.interface import Controller
from approxjac.simulation import Plant
from approxjac.validation import Array


class Start(Protocol):
    """How a run begins.

    Attributes:
        plant: The true robot.
        q: Configuration, at rest, shape (nq,).
        target: x_d, shape (n_x,).
    """

    @property
    def plant(self) -> Plant: ...  # noqa: D102
    @property
    def q(self) -> Array: ...  # noqa: D102
    @property
    def target(self) -> Array: ...  # noqa: D102


class Lanes:
    """Closed loops that differ in their true robots, starts and targets.

    Args:
        controller: The law.
        examples: Starts that differ in all that will ever differ.
        region: Where runs are to stay.
        dt: Sampling time [s].
        tolerance: Error below which a task counts as done.
        integrator: Of the plant: one of `INTEGRATORS`.
        engine: What carries the program out.
    """

    def __init__(
        self,
        controller: Controller,
        examples: Sequence[Start],
        region: Box,
        dt: float,
        tolerance: float,
        integrator: str = "semi_implicit_euler",
        engine: Callable[[Program], LlvmLanes | NumpyLanes] = LlvmLanes,
    ) -> None:
        assert isinstance(controller, SetpointController)
        self._controller = controller
        targets = np.array([start.target for start in examples])
        self._loop: ClosedLoop = closed_loop(
            controller,
            examples[0].plant,
            _numbers(examples),
            _sensors(examples),
            targets,
            region,
            dt,
            tolerance,
            integrator,
        )
        self._engine = engine

    @functools.cached_property
    def compiled(self) -> LlvmLanes | NumpyLanes:
        """The program, compiled when it first runs."""
        return self._engine(self._loop.program)

    def begun(self, starts: Sequence[Start]) -> tuple[Array, Array]:
        """Return what is kept of some runs before their first step, and what stays, as vectors."""
        program, width = self._loop.program, self.compiled.width
        kept = np.zeros((len(starts), program.n_rows))
        columns = {name: kept[:, at : at + size] for name, (at, size) in program.rows.items()}
        columns["q"][:] = [start.q for start in starts]
        columns["state"][:] = self._states(starts)
        columns[TOLD.last_bad][:] = -1.0
        named = self._loop.truth.named(_numbers(starts)) | _sensors(starts)
        named["target"] = np.array([start.target for start in starts])
        return _packed(kept, width), _packed(program.filled(named), width)

    def run(self, starts: Sequence[Start], steps: int, every: int) -> dict[str, Array]:
        """Return what is told of some runs: the names of `TOLD`, each with an array (N,).

        Args:
            starts: How they begin.
            steps: Number of steps.
            every: Which instants are recorded: each so many steps, and the last.
        """
        kept, parameters = self.begun(starts)
        self.compiled.run(kept, parameters, steps, every)
        rows = self._loop.program.rows
        columns = kept.swapaxes(1, 2).reshape(-1, kept.shape[1])[: len(starts)]
        return {name: columns[:, rows[name][0]] for name in TOLD}

    def _states(self, starts: Sequence[Start]) -> Array:
        controller = self._controller
        each = starts if controller.velocity is not None else starts[:1]
        still = np.zeros(controller.task.robot.nv)
        return np.array([
            controller.initial_state(start.plant.measure(0.0, start.q, still)) for start in each
        ])  # fmt: skip


def _numbers(starts: Sequence[Start]) -> ArmNumbers:
    frames = tasks.frames(starts[0].plant.sensor)
    return ArmNumbers.stacked([arm_numbers(start.plant.robot, frames) for start in starts])


def _sensors(starts: Sequence[Start]) -> dict[str, Array]:
    return tasks.numbers([start.plant.sensor for start in starts])


def _packed(columns: Array, width: int) -> Array:
    """Return columns (N, rows) as vectors (groups, rows, width); the last one fills the rest."""
    n, rows = columns.shape
    groups = -(-n // width)
    filled = columns[np.minimum(np.arange(groups * width), n - 1)]
    return np.array(filled.reshape(groups, width, rows).swapaxes(1, 2), order="C")
