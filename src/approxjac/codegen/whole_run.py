"""One run of a compiled law, with all that `simulate` records."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.loop_program import TOLD, recorded_loop, require_covered
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError
from approxjac.interface import LimitStatus
from approxjac.simulation import Plant
from approxjac.simulation.record import Record
from approxjac.simulation.sampled_loop import SampledLoop
from approxjac.simulation.trajectory import Trajectory
from approxjac.validation import Array

_KEPT = 4  # loops that a law keeps
_STEPS = 2000  # that are worth compiling for


class WholeLoops:
    """Loops of one law with some plants, compiled when they first run.

    Args:
        law: The law, or one within limits of effort, without machine code.
    """

    def __init__(self, law: Controller) -> None:
        self._law = law
        self._loops: dict[tuple[int, float, str], tuple[Plant, _Loop]] = {}

    def run(
        self, loop: SampledLoop, stride: int, progress: Callable[[float], None] | None
    ) -> Trajectory | None:
        """Return a run from its beginning to its end, or None where `SampledLoop` has to do it.

        So it is where code does not cover it, where it diverges, and for a run that is shorter than
        it takes to compile it.
        """
        plant, key = loop.plant, (id(loop.plant), loop.dt, loop.integrator)
        if key not in self._loops:
            if loop.steps < _STEPS or not isinstance(loop.path, np.ndarray):
                return None
            if plant.needs_sampling:
                return None
            try:
                require_covered(self._law, plant)
            except InvalidInputError:
                return None
            while len(self._loops) >= _KEPT:
                del self._loops[next(iter(self._loops))]
            self._loops[key] = plant, _Loop(self._law, plant, loop.dt, loop.integrator)
        columns = self._loops[key][1].run(loop, stride, progress)
        return (
            None
            if columns is None
            else Record.of(plant, loop.controller, columns, loop.dt).trajectory()
        )


class _Loop:
    """A compiled loop."""

    def __init__(self, law: Controller, plant: Plant, dt: float, integrator: str) -> None:
        program = recorded_loop(law, plant, dt, integrator)
        buffer = np.zeros((1, program.n_rows, 1))
        lanes, nothing = LlvmLanes(program, width=1), np.zeros((1, 1, 1))
        self._flat = buffer[0, :, 0]
        self._first = lanes.bound(buffer, nothing)
        self._lanes, self._arrays = lanes, (buffer, nothing)
        self._place = {name: slice(at, at + size) for name, (at, size) in program.rows.items()}
        self._n_before = self._place["state"].stop  # rows of what is known before a step
        self._shape = plant.sensor.m, plant.robot.nv

    def run(
        self, loop: SampledLoop, stride: int, progress: Callable[[float], None] | None
    ) -> list[Array] | None:
        """Return the columns of a run, or None of one that is not covered."""
        flat, place, steps = self._flat, self._place, loop.steps
        flat[:] = 0.0
        for name, value in (
            ("target", loop.target), ("q", loop.truth.q), ("v", loop.truth.v),
            ("state", loop.state),
        ):  # fmt: skip
            flat[place[name]] = value
        at = [*range(0, steps, stride), steps]
        n_before, first = self._n_before, self._first
        before, answered = flat[:n_before], flat[n_before:]
        table = np.empty((len(at), len(flat)))
        for row, (k, following) in zip(
            table, zip(at, [*at[1:], steps + 1], strict=True), strict=True
        ):
            row[:n_before] = before
            first()
            row[n_before:] = answered
            if following - k > 1:
                self._lanes.run(*self._arrays, following - k - 2, 1)
            if flat[place[TOLD.left]].any() or flat[place[TOLD.diverged]].any():
                return None
            if progress is not None:
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
