"""Small dense quadratic programs, their solver, and the check of its solutions."""

import enum
import logging
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from approxjac import law
from approxjac.law import QuadraticProgram
from approxjac.validation import Array

_HUGE = 1e100  # below it nothing overflows in a check
_TOLERANCE = 1e-6  # of bounds and rows, relative to their size and at least absolute
_FIRST_TOLERANCE = 1e-9  # what DAQP is asked for first
_EXACT = 1e-12  # violations that bring nothing out of tolerance when taken away
_SETTINGS = {  # of DAQP
    "iter_limit": 1000,
    "zero_tol": 1e-24,  # of |a|² of a row in the metric of H; 1e-11 loses rows if H is 1e6
}
_OPTIMAL = 1  # exit flags of DAQP
_CONTRADICTORY = -1, -6  # -6: equalities


class Verdict(enum.IntEnum):
    """Outcome of a quadratic program."""

    SOLVED = 0
    INFEASIBLE = 1  # no z holds all bounds and rows
    FAILED = 2  # the problem has no finite numbers, or the solver gave no valid answer


class Solver:
    """A checked solver: DAQP, an exact active-set method, or a user's function.

    Problems and solutions are checked, so that a returned solution satisfies the bounds.

    Args:
        function: Function of a problem (its arrays are copies) that returns z of shape (n,), or
            None if it finds none; then DAQP decides whether the problem is infeasible. None is
            DAQP itself.
    """

    def __init__(self, function: Callable[[QuadraticProgram], Any] | None = None) -> None:
        self._function, self._has_raised = function, False

    def solve(
        self, problem: QuadraticProgram, price: float | None = None, pays: bool = False
    ) -> tuple[Array | None, Verdict]:
        """Return z, shape (n,), and SOLVED, or None and the outcome; never raise for numbers.

        z satisfies the bounds exactly, and each row to 1e-6 of the size of its terms |A||z|, at
        least 1e-6.

        Args:
            problem: The problem.
            price: Cost per unit of exceeding the upper bound of the last row; by default that is
                a hard bound.
            pays: True if that bound is probably exceeded; it saves time only.
        """
        if price is None:
            return self._solved(problem)[:2]
        # The minimum exceeds the bound only where it is that with the price in the cost instead of
        # the bound; where that one does not, the bound has a multiplier of the price at most.
        kept = None
        if not pays and self._function is None:
            kept, _, multiplier = self._solved(problem)
            if multiplier <= price:
                return kept, Verdict.SOLVED
        H, f, lower, upper, A, row_lower, row_upper = problem
        unbounded = row_upper.copy()
        unbounded[-1] = np.inf
        dear = QuadraticProgram(H, f + price * A[-1], lower, upper, A, row_lower, unbounded)
        z, verdict, _ = self._solved(dear)
        if kept is None and z is not None and float(A[-1].dot(z)) < row_upper[-1]:
            kept, _, _ = self._solved(problem)
            return (z if kept is None else kept), verdict  # z keeps the bound, too
        return (z, verdict) if kept is None or z is not None else (kept, Verdict.SOLVED)

    def minimum(
        self, problem: QuadraticProgram, price: Any = None, pays: Any = False
    ) -> tuple[Array, Any]:
        """Solve as a `law.Minimum`; with symbols by `law.interior_minimum`."""
        if problem.f.dtype.hasobject:
            return law.interior_minimum(problem, price)
        z, verdict = self.solve(problem, price, pays)
        return (problem.f if z is None else z), verdict

    def _solved(self, problem: QuadraticProgram) -> tuple[Array | None, Verdict, float]:
        """Return z or None, the verdict, and the last row's multiplier, NaN with `function`."""
        H, f, lower, upper, A, row_lower, row_upper = problem
        low, high = np.concatenate([lower, row_lower]), np.concatenate([upper, row_upper])
        # the quickest ways to see both
        if not math.isfinite(np.vdot(H, H) + f.dot(f) + np.vdot(A, A)):
            return None, Verdict.FAILED, math.nan
        if False in (low <= high).tolist():  # of NaN, too
            return None, Verdict.INFEASIBLE if (low > high).any() else Verdict.FAILED, math.nan
        if self._function is None:
            z, verdict, multiplier = self._minimum(problem, low, high)
        else:
            (z, verdict), multiplier = self._answer(problem, low, high), math.nan
        z = None if z is None else _admitted(z, problem, low, high)
        if z is None:
            return None, Verdict.FAILED if verdict is Verdict.SOLVED else verdict, math.nan
        return z, verdict, multiplier

    def _minimum(
        self, problem: QuadraticProgram, low: Array, high: Array
    ) -> tuple[Array | None, Verdict, float]:
        """Solve by DAQP, as `_solved`; low and high are of z, then of A z."""
        import daqp

        H, f, A = problem.H, problem.f, problem.A
        # what the first tolerance refuses may be the round-off of large bounds
        for tolerance in (_FIRST_TOLERANCE, _TOLERANCE):
            z, _, flag, more = daqp.solve(H, f, A, high, low, primal_tol=tolerance, **_SETTINGS)
            if flag == _OPTIMAL:
                return z, Verdict.SOLVED, float(more["lam"][-1])
        return None, Verdict.INFEASIBLE if flag in _CONTRADICTORY else Verdict.FAILED, math.nan

    def _answer(
        self, problem: QuadraticProgram, low: Array, high: Array
    ) -> tuple[Array | None, Verdict]:
        """Return z of a user's function, None unless it is valid, and the verdict."""
        try:
            answer = self._function(QuadraticProgram(*map(np.copy, problem)))  # type: ignore[misc]
            if answer is None:
                exact, verdict, _ = self._minimum(problem, low, high)
                return None, verdict if exact is None else Verdict.FAILED
            z: Array = np.asarray(answer)
        except Exception:  # a control loop gets a verdict instead
            if not self._has_raised:
                self._has_raised = True
                logging.getLogger(__name__).warning(
                    "%r raised, which is logged once", self._function, exc_info=True
                )
            return None, Verdict.FAILED
        is_numbers = z.dtype.kind in "iuf" and z.shape == problem.f.shape
        return (z if is_numbers and (np.abs(z) < _HUGE).all() else None), Verdict.SOLVED


def _admitted(z: Array, problem: QuadraticProgram, low: Array, high: Array) -> Array | None:
    """Return z brought inside its bounds; None if it is too far out or a row does not hold."""
    n, A = len(z), problem.A
    y = np.concatenate([z, A.dot(z)])
    held = np.minimum(np.maximum(y, low), high)
    inside: Array = held[:n]
    farthest = math.hypot(*(held - y).tolist())  # NaN of NaN
    if farthest <= _EXACT or (farthest <= _TOLERANCE and inside.tolist() == z.tolist()):
        return inside  # what is not moved holds its rows as it does
    rows, size = A.dot(inside), np.abs(inside)
    moved = np.concatenate([inside - z, np.clip(rows, low[n:], high[n:]) - rows])
    sizes = np.concatenate([size, np.abs(A).dot(size)])
    within = (np.abs(moved) <= _TOLERANCE * np.maximum(1.0, sizes)).all()
    return inside if within and farthest < math.inf else None
