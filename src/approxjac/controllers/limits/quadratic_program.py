"""Small dense quadratic programs, their minimum, and the check of what a solver answers."""

from __future__ import annotations

import enum
import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from approxjac.errors import InvalidInputError, MissingPackageError, UnknownNameError
from approxjac.validation import Array

_HUGE = 1e100  # below it nothing overflows in a check
_TOLERANCE = 1e-6  # of bounds and rows, relative to their size and at least absolute
_FIRST_TOLERANCE = 1e-9  # what DAQP is asked for first
_EXACT = 1e-12  # violations that bring nothing out of tolerance when taken away
_DAQP_SETTINGS = {
    "iter_limit": 1000,
    "zero_tol": 1e-24,  # of |a|² of a row in the metric of H; 1e-11 loses rows if H is 1e6
}
_OPTIMAL = 1  # exit flags of DAQP
_CONTRADICTORY = -1, -6  # -6: equalities


class QuadraticProgram(NamedTuple):
    """min ½ zᵀHz + fᵀz subject to lower ≤ z ≤ upper and row_lower ≤ A z ≤ row_upper.

    Its arrays are of float64 and contiguous.

    Attributes:
        H: Symmetric positive definite, shape (n, n).
        f: Shape (n,).
        lower: Lower bounds, shape (n,), −inf where there is none.
        upper: Upper bounds, shape (n,), inf where there is none.
        A: Rows, shape (k, n); k may be 0.
        row_lower: Lower bounds of the rows, shape (k,), −inf where there is none.
        row_upper: Upper bounds of the rows, shape (k,), inf where there is none.
    """

    H: Array
    f: Array
    lower: Array
    upper: Array
    A: Array
    row_lower: Array
    row_upper: Array


class Verdict(enum.Enum):
    """Outcome of a problem."""

    SOLVED = "solved"
    INFEASIBLE = "no z holds all bounds and rows"
    FAILED = "the problem has no finite numbers, or the solver found no valid answer"


class Solver:
    """DAQP, an exact active-set method, or a function that solves quadratic programs.

    Problems are checked before and answers after, so what comes out holds the bounds or is none.

    Args:
        name: Name of the solver.
        function: Takes a problem (its arrays are copies) and returns z of shape (n,), or None
            where it finds none; whether that problem is infeasible is decided by DAQP. None is
            DAQP itself.
    """

    def __init__(
        self, name: str, function: Callable[[QuadraticProgram], Any] | None = None
    ) -> None:
        import daqp

        self.name = name
        self._function = function
        self._daqp = daqp.solve
        self._has_raised = False

    def solve(
        self, problem: QuadraticProgram, price: float | None = None, pays: bool = False
    ) -> tuple[Array | None, Verdict]:
        """Return z, shape (n,), and SOLVED, or None and why not; never raise for its numbers.

        z holds the bounds exactly, and each row to 1e-6 of the size of its terms |A||z|, at
        least 1e-6.

        Args:
            problem: The problem.
            price: What it costs to exceed the upper bound of the last row, per unit; by default
                that is a bound like the others.
            pays: Whether it is likely that this price is paid, which saves time only.
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

    def _solved(self, problem: QuadraticProgram) -> tuple[Array | None, Verdict, float]:
        """Return z, or None, and why; and the multiplier of the last row, NaN of a function."""
        H, f, lower, upper, A, row_lower, row_upper = problem
        low, high = np.concatenate([lower, row_lower]), np.concatenate([upper, row_upper])
        # the quickest ways to see both
        if not math.isfinite(np.vdot(H, H) + f.dot(f) + np.vdot(A, A)):
            return None, Verdict.FAILED, math.nan
        if False in (low <= high).tolist():  # of NaN, too
            crossed = (low > high).any()
            return None, Verdict.INFEASIBLE if crossed else Verdict.FAILED, math.nan
        multiplier = math.nan
        if self._function is None:
            found, multiplier = self._minimum(problem, low, high)
        else:
            found = self._answer(problem, low, high)
        if not isinstance(found, Verdict):
            found = _admitted(found, problem, low, high)
        if isinstance(found, Verdict):
            return None, found, math.nan
        return found, Verdict.SOLVED, multiplier

    def _minimum(
        self, problem: QuadraticProgram, low: Array, high: Array
    ) -> tuple[Array | Verdict, float]:
        """Return z of DAQP, and the last multiplier; low and high are of z, then of A z."""
        H, f, A = problem.H, problem.f, problem.A
        # what the first tolerance refuses may be the round-off of large bounds
        for tolerance in (_FIRST_TOLERANCE, _TOLERANCE):
            z, _, flag, told = self._daqp(
                H, f, A, high, low, primal_tol=tolerance, **_DAQP_SETTINGS
            )
            if flag == _OPTIMAL:
                return z, float(told["lam"][-1])
        return (Verdict.INFEASIBLE if flag in _CONTRADICTORY else Verdict.FAILED), math.nan

    def _answer(self, problem: QuadraticProgram, low: Array, high: Array) -> Array | Verdict:
        """Return z of the function, if it is an array of numbers of that shape."""
        try:
            answer = self._function(QuadraticProgram(*map(np.copy, problem)))  # type: ignore[misc]
            if answer is None:
                exact, _ = self._minimum(problem, low, high)
                return exact if isinstance(exact, Verdict) else Verdict.FAILED
            z: Array = np.asarray(answer)
        except Exception:  # a control loop gets a verdict instead
            if not self._has_raised:
                self._has_raised = True
                import logging

                logging.getLogger(__name__).warning(
                    "QP solver %s raised, which is told once", self.name, exc_info=True
                )
            return Verdict.FAILED
        is_numbers = z.dtype.kind in "iuf" and z.shape == problem.f.shape
        return z if is_numbers and (np.abs(z) < _HUGE).all() else Verdict.FAILED

    def __reduce__(self) -> tuple[Any, ...]:
        return Solver, (self.name, self._function)


def _admitted(z: Array, problem: QuadraticProgram, low: Array, high: Array) -> Array | Verdict:
    """Return z brought inside its bounds; FAILED if it is too far out or a row does not hold."""
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
    return inside if within and farthest < math.inf else Verdict.FAILED


# With these the solvers of qpsolvers reach residuals of 1e-6 on the degenerate problems of the
# tests, which their own settings do not.
_SETTINGS: dict[str, dict[str, Any]] = {
    "clarabel": {"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-12},
    "osqp": {
        "eps_abs": 1e-9,
        "eps_rel": 1e-9,
        "eps_prim_inf": 1e-6,
        "max_iter": 100_000,
        "check_dualgap": 0,  # an absolute gap of 1e-9 is below round-off where f is large
        "raise_error": False,
    },
    "piqp": {
        "eps_abs": 1e-11,
        "eps_rel": 1e-12,
        "eps_duality_gap_abs": 1e-13,
        "eps_duality_gap_rel": 1e-13,
    },
    "scs": {"eps_abs": 1e-10, "eps_rel": 1e-10, "max_iters": 100_000},
}
_WIDER = {"quadprog": 1e-9}  # else it calls equal or redundant bounds inconsistent
# measured with highspy 1.15.1 and proxsuite 0.8.0, at the tightest settings that helped
_REFUSED = {
    "highs": "of 2400 degenerate problems it called 2 optimal with a residual above 0.1, and "
    "gave up on 4",
    "proxqp": "of 2400 degenerate problems it called 32 solved with a residual above 1e-6, and "
    "gave up on 75",
}


def as_solver(solver: str | Callable[[QuadraticProgram], Any]) -> Solver:
    """Return the solver of a name, or one that calls a function of the user's own.

    "daqp" is an exact active-set method, and the quickest here by a factor of eight. Other names
    are those of qpsolvers. Measured to reach residuals of 1e-6 on degenerate problems are clarabel,
    osqp, piqp, quadprog and scs (osqp and scs with absolute tolerances: H should have entries above
    1e-3); highs and proxqp were not able to, and are refused. Others that qpsolvers knows run with
    their own settings; the bounds of their answers are checked, their optimality is not.

    Args:
        solver: A name, or a function as `Solver` takes it.

    Raises:
        InvalidInputError: No name and no function, or a solver that is refused or does not run.
        MissingPackageError: A solver of qpsolvers that is not installed.
        UnknownNameError: No solver of that name.
    """
    if not isinstance(solver, str):
        if not callable(solver):
            raise InvalidInputError(
                f"solver must be the name of a QP solver such as 'daqp', or a function of a "
                f"QuadraticProgram, got {solver!r}",
                given=solver,
            )
        return Solver(getattr(solver, "__name__", type(solver).__name__), solver)
    if solver == "daqp":
        return Solver(solver)
    _require_offered(solver)
    function = partial(_minimum, name=solver)
    one = np.ones(1)
    try:  # solved once, so that nothing is loaded in a control step
        function(QuadraticProgram(np.eye(1), one, -one, one, np.eye(1), -one, one))
    except Exception as error:  # as of one that wants a licence
        raise InvalidInputError(
            f"QP solver {solver!r} is installed but does not run: {error}", given=solver
        ) from error
    return Solver(solver, function)


def _require_offered(name: str) -> None:
    """Refuse a name that is not one of an installed and accurate solver of qpsolvers."""
    import importlib.metadata
    import pkgutil

    import qpsolvers

    if name in _REFUSED:
        raise InvalidInputError(
            f"QP solver {name!r} is not offered: {_REFUSED[name]}; take 'daqp'", given=name
        )
    if name in qpsolvers.available_solvers:
        return
    known = {module.name.rstrip("_") for module in pkgutil.iter_modules(qpsolvers.solvers.__path__)}
    if name in known:
        extras = importlib.metadata.metadata("qpsolvers").get_all("Provides-Extra") or ()
        how = f"pip install 'qpsolvers[{name}]'" if name in extras else "see its own web page"
        raise MissingPackageError(f"QP solver {name!r} is not installed: {how}", given=name)
    offered = set(qpsolvers.available_solvers) - set(_REFUSED)
    raise UnknownNameError("QP solver", name, "the installed ones", offered)


def _minimum(problem: QuadraticProgram, name: str) -> Array | None:
    """Return the answer of a solver of qpsolvers, None where it finds nothing."""
    import qpsolvers
    from scipy.sparse import csc_matrix

    wider = _WIDER.get(name, 0.0)
    matrix = np.asarray if name in qpsolvers.dense_solvers else csc_matrix

    def widened(bound: Array) -> Array:
        return bound + wider * np.maximum(1.0, np.abs(bound)) if wider else bound

    H, f, lower, upper, A, row_lower, row_upper = problem
    below, above = np.isfinite(row_lower), np.isfinite(row_upper)
    G = h = None
    if below.any() or above.any():
        G = matrix(np.concatenate([A[above], -A[below]]))
        h = widened(np.concatenate([row_upper[above], -row_lower[below]]))
    stated = qpsolvers.Problem(matrix(H), f, G, h, lb=-widened(-lower), ub=widened(upper))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they tell that there is no solution
        solution = qpsolvers.solve_problem(stated, solver=name, **_SETTINGS.get(name, {}))
    if name == "osqp" and solution.extras["info"].status == "interrupted":
        raise KeyboardInterrupt  # while it solves, OSQP keeps Python from seeing it
    return np.asarray(solution.x) if solution.found else None
