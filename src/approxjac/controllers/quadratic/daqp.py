"""DAQP, an exact active-set method."""

from __future__ import annotations

from typing import Any

import numpy as np

from approxjac.controllers.quadratic.checking import TOLERANCE, Checking, absurd, coerced
from approxjac.controllers.quadratic.problem import QuadraticProgram, Verdict
from approxjac.validation import Array

# DAQP's exit flags; -6 is "initial working set overdetermined": equalities that are in conflict
_OPTIMAL, _INFEASIBLE, _OVERDETERMINED, _OUT_OF_TIME = 1, -1, -6, -7
_FIRST_TOLERANCE = 1e-9


class Daqp(Checking):
    """DAQP, called afresh each time: to keep and update its workspace was no quicker."""

    name = "daqp"

    def __init__(self, budget: float) -> None:
        import daqp

        super().__init__(budget)
        self._solve = daqp.solve
        self._settings = {
            "iter_limit": 1000,
            "time_limit": 0.5 * budget,  # there are two runs
            "zero_tol": 1e-24,  # of |a|² of a row in the metric of H; 1e-11 loses rows if H is 1e6
        }

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._budget,)

    def verdict(self, problem: QuadraticProgram, low: Array, high: Array) -> Verdict:
        """Of a valid problem that another solver found no answer to: INFEASIBLE or FAILED."""
        found = self._find(problem, low, high)
        return found if isinstance(found, Verdict) else Verdict.FAILED

    def _find(self, problem: QuadraticProgram, low: Array, high: Array) -> Array | Verdict:
        z, flag = self._run(problem, low, high, _FIRST_TOLERANCE)
        if flag != _OPTIMAL and flag != _OUT_OF_TIME:
            # what the first tolerance refuses may be the round-off of large bounds
            z, flag = self._run(problem, low, high, TOLERANCE)
        if flag == _OPTIMAL:
            return z
        if flag in (_INFEASIBLE, _OVERDETERMINED) and not absurd(low, high):
            return Verdict.INFEASIBLE
        return Verdict.FAILED

    def _run(
        self, problem: QuadraticProgram, low: Array, high: Array, tolerance: float
    ) -> tuple[Array, int]:
        # DAQP takes the address of H and f, whatever their strides
        H, f, A = np.ascontiguousarray(problem.H), np.ascontiguousarray(problem.f), problem.A
        try:
            z, _, flag, _ = self._solve(H, f, A, high, low, primal_tol=tolerance, **self._settings)
        except ValueError:  # it refuses arrays that are read-only or not of floats
            H, f, _, _, A, _, _ = coerced(problem)
            z, _, flag, _ = self._solve(H, f, A, high, low, primal_tol=tolerance, **self._settings)
        return z, flag
