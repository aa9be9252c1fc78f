"""Solvers of quadratic programs by name, through qpsolvers."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from approxjac.controllers.quadratic_program import QuadraticProgram, Solver
from approxjac.errors import InvalidInputError, MissingPackageError, UnknownNameError
from approxjac.validation import Array

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
