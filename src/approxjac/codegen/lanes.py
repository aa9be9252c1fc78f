"""`Lanes`: many runs of a closed loop at once, each in a lane of the machine's vectors."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from approxjac.codegen import traced_law as laws
from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.arm_numbers import ArmNumbers, arm_numbers
from approxjac.codegen.backends.llvm import LlvmLanes, packed, unpacked
from approxjac.codegen.loop_program import TracedLoop
from approxjac.codegen.sensors import TracedSensing
from approxjac.codegen.trace.program import Block, Program
from approxjac.codegen.trace.symbols import Number, Scalar, Symbols, select
from approxjac.controllers.controller import Controller
from approxjac.controllers.gains.gains import Diagonals
from approxjac.interface import Measurement, Target, TargetPath
from approxjac.simulation import Plant
from approxjac.simulation.transmission import Motors
from approxjac.validation import Array

_BLOCK = 256  # steps that are drawn at once: some 20 MB of 1024 runs
OUTCOME = "last_bad", "error", "torque", "speed", "outside", "diverged", "left"
"""Names of a run's outcome, a number each.

The last step at which the error was not below the tolerance, or −1; ‖e‖ at the end; the largest
shares of a motor's limit and of a limit of speed; whether a configuration was outside the region,
all these of steps that are recorded; whether numbers became too large; and whether the run is left
to Python, as it came to what is not covered.
"""


class LaneStart(NamedTuple):
    """The numbers of the start of a run that lanes keep."""

    q: Array  # configuration, at rest, shape (nq,)
    target: Array  # x_d, shape (n_x,)
    state: Array  # of the controller, shape (n_state,)
    numbers: ArmNumbers  # of the true robot
    sensor: dict[str, Array]  # numbers of its sensor, as `tasks.numbers` has them
    seed: int  # of noise and dropouts
    holding: Array  # torque that holds it until the first one acts, shape (n_v,)
    gains: Array  # diagonals of the law, one after the other, shape (2 m + n_v,)
    motors: Motors | None = None  # at rest, of joints that are not ideal

    @classmethod
    def of(
        cls,
        controller: Controller,
        plant: Plant,
        q: Array,
        target: Array,
        seed: int = 0,
        frames: tuple[str, ...] | None = None,
    ) -> LaneStart:
        """Return the start of a plant at rest.

        `frames` are those that its sensor looks at, where they are known: to find them takes as
        long as many steps.
        """
        x, motors = plant.sensor.value(q), plant.motors_at(q)
        begin = controller.begin if plant.is_exact else controller.initial_state
        first = Measurement(0.0, q, np.zeros(plant.robot.nv), x)
        state = begin(plant.encoded(first, motors))
        frames = tasks.frames(plant.sensor) if frames is None else frames
        numbers = arm_numbers(plant.robot, frames)
        holding = plant.dynamics.g(q) if plant.actuator_delay > 0.0 else np.zeros(plant.robot.nv)
        sensor = tasks.numbers([plant.sensor])
        gains = np.concatenate(controller.law.diagonals or [np.zeros(0)])
        return cls(q, target, state, numbers, sensor, seed, holding, gains, motors)


class Lanes:
    """Closed loops that differ in their true robots, starts and targets."""

    def __init__(
        self,
        controller: Controller,  # the law with its wrappers
        plant: Plant,  # a true robot, with its sensor and friction
        examples: Sequence[LaneStart],  # runs that differ in every number that may differ later
        region: Any,  # region that runs should stay in, by its contains(q)
        dt: float,  # sampling time [s]
        steps: int,  # number of steps of a run
        tolerance: float,  # error below which a task counts as done
        integrator: str = "semi_implicit_euler",  # integrator of the plant: one of `INTEGRATORS`
        # path of the target of all runs, in place of their own; None is at rest
        path: Target | TargetPath | None = None,
    ) -> None:
        self.program = program = Program()  # of a step
        m = controller.task.m
        numbers, sensors, others = _stacked(examples)
        given = {name: program.given(name, each) for name, each in (others | sensors).items()}
        self._sensing = sensing = TracedSensing(plant, dt, steps, path)
        target = sensing.target(program) or Target(given["target"])
        if "gains" in given:
            own = Diagonals(*np.split(given["gains"], (m, 2 * m)))
            controller = laws.with_gains(controller, own)
        loop = TracedLoop(
            program, controller, plant, numbers, target, dt, integrator, given, sensing
        )
        self.frames = tuple(loop.truth.frames)  # that the sensor looks at
        self._truth, judged = loop.truth, [each for each in OUTCOME if each not in loop.after]
        before = {name: program.kept(name, 1)[0] for name in judged}
        program.step(loop.after)
        error = np.sqrt((loop.error * loop.error).sum())
        is_inside = tasks.traced("region", region, lambda: region.contains(loop.q))
        program.record({
            "last_bad": select(error < tolerance, before["last_bad"], program.k),
            "error": error,
            "torque": _larger(before["torque"], loop.answer.torque / plant.motor_limits),
            "speed": _larger(before["speed"], loop.v / plant.robot.velocity_limits),
            "outside": select(is_inside, before["outside"], 1.0),
        })  # fmt: skip

    @functools.cached_property
    def compiled(self) -> LlvmLanes:
        """The program, compiled when it first runs."""
        return LlvmLanes(self.program)

    def packed(self, starts: Sequence[LaneStart]) -> tuple[Array, Array]:
        """Return the memory of some runs before a first step, and their constants, as vectors."""
        program, width = self.program, self.compiled.width
        kept = np.zeros((len(starts), program.n_rows))
        columns = {name: kept[:, at : at + size] for name, (at, size) in program.rows.items()}
        columns["q"][:] = [start.q for start in starts]
        columns["state"][:] = [start.state for start in starts]
        columns["last_bad"][:] = -1.0
        if starts[0].motors is not None:
            for name in Motors._fields:
                columns[name][:] = [getattr(start.motors, name) for start in starts]
        self._sensing.start(program, kept, np.array([start.holding for start in starts]))
        numbers, sensors, others = _stacked(starts)
        named = self._truth.named(numbers) | sensors | others
        return packed(kept, width), packed(program.filled(named), width)

    def run(self, starts: Sequence[LaneStart], every: int) -> dict[str, Array]:
        """Return the outcome of some runs: the names of `OUTCOME`, each with an array (N,).

        Args:
            starts: Starts of the runs.
            every: Steps between recorded instants; the last is recorded, too.
        """
        kept, parameters = self.packed(starts)
        program, width = self.program, self.compiled.width
        draws = self._sensing.drawn(program, [start.seed for start in starts], width)
        times = self._sensing.times(program, every)
        for first in range(0, len(times), _BLOCK):
            now = times[first : first + _BLOCK]
            block = Block(first, now, draws(first, first + len(now)))
            self.compiled.run(kept, parameters, block)
        columns = unpacked(kept, len(starts))
        return {name: columns[:, program.rows[name][0]] for name in OUTCOME}


def _stacked(starts: Sequence[LaneStart]) -> tuple[ArmNumbers, dict[str, Array], dict[str, Array]]:
    """Return numbers of robots, of sensors, and others by name, each with an axis in front."""
    sensors = {
        name: np.concatenate([start.sensor[name] for start in starts]) for name in starts[0].sensor
    }
    others = {"target": np.array([start.target for start in starts])}
    if starts[0].gains.size:
        others["gains"] = np.array([start.gains for start in starts])
    return ArmNumbers.stacked([start.numbers for start in starts]), sensors, others


def _larger(known: Number, shares: Symbols) -> Number:
    for share in np.abs(shares).tolist():
        if isinstance(share, Scalar):
            known = select(share > known, share, known)
    return known
