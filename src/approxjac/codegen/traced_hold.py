"""`HeldMeasurement` on symbols: the last x that was seen, until the arm has moved too far."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.trace.symbols import Condition, Symbols, any_of, select, symbols
from approxjac.controllers import HeldMeasurement
from approxjac.controllers.controller import Controller
from approxjac.validation import Array


def inside(controller: Controller) -> Controller:
    """Return what a controller holds x for, or the controller."""
    return controller.controller if isinstance(controller, HeldMeasurement) else controller


class Held(NamedTuple):
    """Measurement that is held at one step, as `HeldMeasurement.step` has it.

    Attributes:
        x: What the controller inside is told, shape (n_x,); NaN where it is too old.
        memory: What is remembered, but for the motion of this step.
        still: Whether p of each error stands still, shape (m,).
        moves: Where p is in the memory.
        uncombined: From the task's errors to those of what is measured, shape (m, m), or None.
    """

    x: Symbols
    memory: Symbols
    still: Symbols
    moves: slice
    uncombined: Array | None

    @classmethod
    def of(cls, controller: HeldMeasurement, memory: Symbols, x: Symbols, t_x: Any) -> Held:
        """Return what is held where x arrives, which was taken at t_x [s]."""
        n_x, moves, measured = len(x), controller._moved, controller._measured
        last, p, seen = memory[:n_x], memory[moves], memory[moves.stop :]
        later = (t_x > memory[n_x]) | ~any_of(seen > 0.0)
        told = x
        if not measured._subtracts:
            told = tasks.error(measured, x, symbols(controller._origin))
        used, remembered, still = x.copy(), memory.copy(), symbols([False] * len(p))
        any_new: Condition = False
        for k, (entries, rows) in enumerate(controller._parts):
            here = x[entries]
            finite = ~any_of(~np.isfinite(np.concatenate([here, told[rows]])))
            never, far = seen[k] == 0.0, any_of(np.abs(p[rows]) > controller.unseen[rows])
            is_new = finite & (never | later)
            is_old = ~is_new & (never | far)
            used[entries] = np.where(
                symbols(is_new), here, np.where(symbols(is_old), np.nan, last[entries])
            )
            remembered[entries] = np.where(symbols(is_new), here, last[entries])
            remembered[moves][rows] = np.where(symbols(is_new), 0.0, p[rows])
            remembered[moves.stop + k] = select(is_new, 1.0, seen[k])
            still[rows] = is_old
            any_new = any_new | is_new
        remembered[n_x] = select(any_new & later, t_x, memory[n_x])
        return cls(used, remembered, still, moves, controller._uncombined)

    def after(self, J_hat: Symbols, v: Symbols, dt: float) -> Symbols:
        """Return the memory after a step dt [s] in which the image moves by Ĵq̇."""
        rate = J_hat @ v
        moved = dt * (rate if self.uncombined is None else self.uncombined @ rate)
        memory = self.memory.copy()
        memory[self.moves] = memory[self.moves] + np.where(self.still, 0.0, moved)
        return memory
