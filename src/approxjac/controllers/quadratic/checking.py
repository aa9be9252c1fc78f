"""What stands before and after every solver of quadratic programs."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np

from approxjac.controllers.quadratic.problem import QuadraticProgram, Verdict
from approxjac.validation import Array

TOLERANCE = 1e-6  # of bounds and rows, relative to their size and at least absolute
_EXACT = 1e-24  # square of a violation that brings nothing out of tolerance when taken away
_SOLVED, _INFEASIBLE, _FAILED = Verdict.SOLVED, Verdict.INFEASIBLE, Verdict.FAILED


class Checking(ABC):
    """Everything about solving but the solver: checks of the problem and of the answer."""

    name: str

    def __init__(self, budget: float) -> None:
        self._budget = budget  # [s]
        self._shapes: tuple[tuple[int, ...], ...] = ()

    @abstractmethod
    def _find(self, problem: QuadraticProgram, low: Array, high: Array) -> Array | Verdict:
        """z of a valid problem, or a verdict; low and high are the bounds of z, then of A z."""

    def solve(self, problem: QuadraticProgram) -> tuple[Array | None, Verdict]:
        """Return z and SOLVED, or None and why not; see `Solver`."""
        try:
            if not self._fits(problem):
                problem = coerced(problem)
                self._resize(*problem.A.shape[::-1])
                if not self._fits(problem):
                    return None, _FAILED
            verdict = self._take(problem)
            if verdict is not _SOLVED:
                return None, verdict
            found = self._find(problem, self._low, self._high)
            if isinstance(found, Verdict):
                return None, found
            z = self._admitted(found, problem)
        except Exception:  # a solver's or a stranger's: a control loop gets a verdict instead
            return None, _FAILED
        return (None, _FAILED) if z is None else (z, _SOLVED)

    def _resize(self, n: int, k: int) -> None:
        self._n, self._k = n, k
        self._shapes = (n, n), (n,), (k, n)
        self._low, self._high, self._y = np.empty((3, n + k))  # y is [z, A z]
        self._views = self._low[:n], self._low[n:], self._high[:n], self._high[n:]
        self._y_z, self._y_rows = self._y[:n], self._y[n:]
        self._in_order = b"\1" * (n + k)

    def _fits(self, problem: QuadraticProgram) -> bool:
        """Whether a problem consists of arrays of the sizes that memory is laid out for."""
        H, f, lower, upper, A, row_lower, row_upper = problem
        try:
            return (
                (H.shape, f.shape, A.shape) == self._shapes
                and len(lower) == len(upper) == self._n
                and len(row_lower) == len(row_upper) == self._k
            )
        except (AttributeError, TypeError):
            return False

    def _take(self, problem: QuadraticProgram) -> Verdict:
        """Copy the bounds; SOLVED if the problem is one for a solver."""
        H, f, lower, upper, A, row_lower, row_upper = problem
        low_z, low_rows, high_z, high_rows = self._views
        low_z[:] = lower
        low_rows[:] = row_lower
        high_z[:] = upper
        high_rows[:] = row_upper
        h, a = H.ravel(), A.ravel()
        if not math.isfinite(h.dot(h) + f.dot(f) + a.dot(a)):  # the quickest way to see that
            return _FAILED
        low, high = self._low, self._high
        if (low <= high).tobytes() != self._in_order:  # twice as quick as all()
            unclear = np.isnan(low).any() or np.isnan(high).any() or absurd(low, high)
            return _FAILED if unclear else _INFEASIBLE
        return _SOLVED

    def _admitted(self, z: Array, problem: QuadraticProgram) -> Array | None:
        """z brought inside its bounds, or None if it is too far out or a row does not hold."""
        n, y = self._n, self._y
        self._y_z[:] = z
        problem.A.dot(z, out=self._y_rows)
        held = np.minimum(np.maximum(y, self._low), self._high)
        inside: Array = held[:n]
        off = held - y
        if off.dot(off) < _EXACT:
            return inside
        moved = np.abs(off[:n])
        if not (moved <= TOLERANCE * np.maximum(1.0, np.abs(inside))).all():
            return None
        rows = problem.A.dot(inside)
        slack = TOLERANCE * np.maximum(1.0, np.abs(problem.A).dot(np.abs(inside)))
        within = (self._low[n:] - slack <= rows) & (rows <= self._high[n:] + slack)
        return inside if within.all() and np.isfinite(inside).all() else None


def absurd(low: Array, high: Array) -> bool:
    """Whether a bound is infinite on the wrong side."""
    return bool((low == math.inf).any() or (high == -math.inf).any())


def coerced(problem: QuadraticProgram) -> QuadraticProgram:
    """A copy of a problem, of contiguous arrays of floats; raises if it is none."""
    arrays = [np.asarray(array) for array in problem]
    if any(array.dtype.kind not in "iuf" for array in arrays) or arrays[1].size == 0:
        raise TypeError
    return QuadraticProgram(*(np.array(array, dtype=np.float64, order="C") for array in arrays))
