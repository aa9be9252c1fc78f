"""OSQP, a first-order method, with a workspace that is kept."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from approxjac.controllers.quadratic.checking import Checking, absurd, coerced
from approxjac.controllers.quadratic.daqp import Daqp
from approxjac.controllers.quadratic.problem import QuadraticProgram, Verdict
from approxjac.validation import Array

_RHO = 0.1
_RHO_CHANGES = 10
_TURNS = 500  # of `max_iter` iterations each
_SETTINGS: dict[str, Any] = {
    "rho": _RHO,
    "adaptive_rho": 0,
    "max_iter": 200,
    "eps_abs": 1e-9,
    "eps_rel": 1e-9,
    "eps_prim_inf": 1e-6,
    "check_dualgap": 0,  # an absolute gap of 1e-9 is below round-off where f is large
    "polishing": 0,
    "verbose": False,
}


class Osqp(Checking):
    """OSQP with one workspace a problem shape, updated for each problem.

    Its own adaptation of ρ may swing between two values for ever, so it is done here: damped,
    and a limited number of times. Its polishing is off, since it prints on a problem where no
    bound is active, whatever `verbose` says.
    """

    name = "osqp"

    def __init__(self, budget: float) -> None:
        import osqp

        super().__init__(budget)
        status = osqp.SolverStatus
        self._solved = status.OSQP_SOLVED
        self._interrupted = status.OSQP_SIGINT
        self._unfinished = status.OSQP_MAX_ITER_REACHED, status.OSQP_SOLVED_INACCURATE
        self._workspaces: dict[tuple[int, int], _Workspace] = {}
        self._judge = Daqp(budget)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._budget,)

    def _find(self, problem: QuadraticProgram, low: Array, high: Array) -> Array | Verdict:
        if absurd(low, high):
            return Verdict.FAILED
        shape = self._n, self._k
        # taken out while it is used: one that raised is not used again
        workspace = self._workspaces.pop(shape, None) or _Workspace(*shape, self._budget)
        deadline = time.perf_counter() + self._budget
        rho = _RHO
        workspace.load(coerced(problem), low, high)
        for turn in range(_TURNS):
            result = workspace.model.solve(raise_error=False)
            if result.info.status_val == self._interrupted:
                raise KeyboardInterrupt  # while it solves, OSQP keeps Python from seeing it
            if result.info.status_val not in self._unfinished or time.perf_counter() > deadline:
                break
            if turn < _RHO_CHANGES:
                rho = math.sqrt(rho * min(max(result.info.rho_estimate, 1e-6), 1e6))
                workspace.model.update_settings(rho=rho)
        self._workspaces[shape] = workspace
        if result.info.status_val == self._solved:
            z: Array = result.x
            return z
        return self._judge.verdict(problem, low, high)


class _Workspace:
    """OSQP's memory for problems of n variables and k rows, with all entries of H and A."""

    def __init__(self, n: int, k: int, budget: float) -> None:
        import osqp
        from scipy.sparse import csc_matrix

        # column by column: the upper triangle of H, and of [I; A] the diagonal and all of A
        columns = np.repeat(np.arange(n), np.arange(1, n + 1))
        rows = np.concatenate([np.arange(j + 1) for j in range(n)])
        self._triangle = rows * n + columns
        self._entries = np.ones((n, k + 1))
        ends = np.concatenate([[0], np.cumsum(np.arange(1, n + 1))])
        pattern_H = csc_matrix((np.ones(len(rows)), rows, ends), shape=(n, n))
        below = np.concatenate([np.concatenate([[j], np.arange(n, n + k)]) for j in range(n)])
        ends = np.arange(n + 1) * (k + 1)
        pattern_A = csc_matrix((np.ones(n * (k + 1)), below, ends), shape=(n + k, n))
        self._zero, self._no_multipliers = np.zeros(n), np.zeros(n + k)
        self.model = osqp.OSQP(algebra="builtin")
        unbounded = np.full(n + k, np.inf)
        self.model.setup(
            pattern_H,
            self._zero,
            pattern_A,
            -unbounded,
            unbounded,
            time_limit=budget,
            **_SETTINGS,
        )

    def load(self, problem: QuadraticProgram, low: Array, high: Array) -> None:
        """Make the workspace what it would be had it solved nothing before, bit by bit.

        OSQP takes addresses, whatever the strides: the arrays must be contiguous.
        """
        H = problem.H.ravel()[self._triangle]
        self._entries[:, 1:] = problem.A.T
        A = self._entries.ravel()
        # Scaling depends on H, A and f, and scaling anew takes off the last one, which rounds.
        # A zero does not round: so first get rid of f, then of the last H and A.
        model = self.model
        model.update(q=self._zero)
        model.update(Px=H, Ax=A)
        model.update(q=problem.f)
        model.update(Px=H, Ax=A)
        model.update(q=problem.f, l=low, u=high)
        model.update_settings(rho=_RHO)
        model.warm_start(x=self._zero, y=self._no_multipliers)
