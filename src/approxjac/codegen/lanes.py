"""`Lanes`: many runs of a closed loop at once, each in a lane of the machine's vectors."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.arm_numbers import ArmNumbers, arm_numbers
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.backends.numpy_source import NumpyLanes
from approxjac.codegen.loop_program import TOLD, LoopProgram, closed_loop
from approxjac.codegen.regions import Box
from approxjac.codegen.trace.program import Block, Program
from approxjac.controllers.controller import Controller
from approxjac.controllers.setpoint import SetpointController
from approxjac.interface import Measurement, Target, TargetPath
from approxjac.simulation import Plant
from approxjac.tasks.analysis import image_feature
from approxjac.validation import Array

_BLOCK = 256  # steps that are drawn at once: some 20 MB of 1024 runs


class Begun(NamedTuple):
    """Numbers that lanes keep of a run that begins, which are few beside its plant.

    Attributes:
        q: Configuration, at rest, shape (nq,).
        target: x_d, shape (n_x,).
        state: State of the controller, shape (n_state,).
        numbers: Those of the true robot.
        sensor: Those of its sensor, as `tasks.numbers` has them.
        seed: Of noise and dropouts.
        holding: Torque that holds it until the first one acts, shape (n_v,).
        gains: Diagonals of the law, one after the other, shape (2 m + n_v,).
    """

    q: Array
    target: Array
    state: Array
    numbers: ArmNumbers
    sensor: dict[str, Array]
    seed: int
    holding: Array
    gains: Array

    @classmethod
    def of(
        cls,
        controller: Controller,
        plant: Plant,
        q: Array,
        target: Array,
        seed: int = 0,
        frames: tuple[str, ...] | None = None,
    ) -> Begun:
        """Return that of a plant at rest.

        `frames` are those that its sensor looks at, where they are known: to find them takes as
        long as many steps.
        """
        # only law (5) begins with x, once it is measured, and of images the points' order is seen
        law = controller.law
        is_setpoint = isinstance(law, SetpointController)
        needed = not is_setpoint or law.velocity is not None  # type: ignore[attr-defined]
        needed = needed or image_feature(law.task) is not None
        x = plant.sensor.value(q) if needed else target
        state = controller.initial_state(Measurement(0.0, q, np.zeros(plant.robot.nv), x))
        frames = tasks.frames(plant.sensor) if frames is None else frames
        numbers = arm_numbers(plant.robot, frames)
        holding = plant.dynamics.g(q) if plant.actuator_delay > 0.0 else np.zeros(plant.robot.nv)
        sensor, gains = tasks.numbers([plant.sensor]), np.zeros(0)
        if isinstance(law, SetpointController):
            gains = np.concatenate(law.diagonals)
        return cls(q, target, state, numbers, sensor, seed, holding, gains)


class Lanes:
    """Closed loops that differ in their true robots, starts and targets.

    Args:
        controller: The law, with what is around it.
        plant: A true robot, with its sensor and friction.
        examples: Runs that differ in all that will ever differ.
        region: Where runs are to stay.
        dt: Sampling time [s].
        steps: Number of steps of a run.
        tolerance: Error below which a task counts as done.
        integrator: Of the plant: one of `INTEGRATORS`.
        engine: What carries the program out.
        path: Where the target of all runs moves, in place of their own; None is at rest.
    """

    def __init__(
        self,
        controller: Controller,
        plant: Plant,
        examples: Sequence[Begun],
        region: Box,
        dt: float,
        steps: int,
        tolerance: float,
        integrator: str = "semi_implicit_euler",
        engine: Callable[[Program], LlvmLanes | NumpyLanes] = LlvmLanes,
        path: Target | TargetPath | None = None,
    ) -> None:
        numbers, sensors, targets = _stacked(examples)
        gains = np.array([each.gains for each in examples])
        self._loop: LoopProgram = closed_loop(
            controller, plant, numbers, sensors, targets, gains, region, dt, steps, tolerance,
            integrator, path,
        )  # fmt: skip
        self._steps = steps
        self._engine = engine

    @functools.cached_property
    def compiled(self) -> LlvmLanes | NumpyLanes:
        """The program, compiled when it first runs."""
        return self._engine(self._loop.program)

    def packed(self, starts: Sequence[Begun]) -> tuple[Array, Array]:
        """Return what is kept of some runs before their first step, and what stays, as vectors."""
        program, width = self._loop.program, self.compiled.width
        kept = np.zeros((len(starts), program.n_rows))
        columns = {name: kept[:, at : at + size] for name, (at, size) in program.rows.items()}
        columns["q"][:] = [start.q for start in starts]
        columns["state"][:] = [start.state for start in starts]
        columns[TOLD.last_bad][:] = -1.0
        self._loop.senses.begun(program, kept, np.array([start.holding for start in starts]))
        numbers, sensors, targets = _stacked(starts)
        named = self._loop.truth.named(numbers) | sensors | {"target": targets}
        gains = np.array([start.gains for start in starts])
        if gains.size:
            named["gains"] = gains
        return _packed(kept, width), _packed(program.filled(named), width)

    @functools.cached_property
    def _times(self) -> Array:
        return self._loop.senses.times(self._loop.program)

    def run(self, starts: Sequence[Begun], every: int) -> dict[str, Array]:
        """Return what is told of some runs: the names of `TOLD`, each with an array (N,).

        Args:
            starts: How they begin.
            every: Which instants are recorded: each so many steps, and the last.
        """
        kept, parameters = self.packed(starts)
        program, width = self._loop.program, self.compiled.width
        draws = self._loop.senses.drawn(program, [start.seed for start in starts], width)
        for first in range(0, self._steps + 1, _BLOCK):
            times = self._times[first : first + _BLOCK]
            block = Block(first, times, draws.block(first, first + len(times)))
            self.compiled.run(kept, parameters, self._steps, every, block)
        columns = kept.swapaxes(1, 2).reshape(-1, kept.shape[1])[: len(starts)]
        return {name: columns[:, program.rows[name][0]] for name in TOLD}


def _stacked(starts: Sequence[Begun]) -> tuple[ArmNumbers, dict[str, Array], Array]:
    """Return numbers of the robots and of the sensors, and targets, each with an axis in front."""
    sensors = {
        name: np.concatenate([start.sensor[name] for start in starts]) for name in starts[0].sensor
    }
    numbers = ArmNumbers.stacked([start.numbers for start in starts])
    return numbers, sensors, np.array([start.target for start in starts])


def _packed(columns: Array, width: int) -> Array:
    """Return columns (N, rows) as vectors (groups, rows, width); the last one fills the rest."""
    n, rows = columns.shape
    groups = -(-n // width)
    filled = columns[np.minimum(np.arange(groups * width), n - 1)]
    return np.array(filled.reshape(groups, width, rows).swapaxes(1, 2), order="C")
