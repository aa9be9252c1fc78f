"""The interior minimum against DAQP's."""

import numpy as np
import pytest
from controllers import test_quadratic_program as programs

from approxjac.controllers.limits.quadratic_program import Solver
from approxjac.law import interior_minimum
from approxjac.law.factors import Factors

DAQP = Solver()


@pytest.mark.parametrize(
    "kind",
    ["ordinary", "parallel", "duplicated", "redundant", "around", "scaled", "half_open", "no_rows"],
)
def test_it_is_the_minimum(kind):
    found = 0
    rng = np.random.default_rng(0)
    for _ in range(25):
        problem = programs.ordinary(rng, int(rng.integers(2, 9)), int(rng.integers(0, 17)))
        if kind == "around":
            problem = programs.around(problem, rng)[0]
        elif kind != "ordinary":
            problem = programs.FEASIBLE[kind](problem, rng)
        z, verdict = interior_minimum(problem)
        exact = DAQP.solve(problem)[0]
        assert (problem.lower <= z).all()
        assert (z <= problem.upper).all()
        if verdict == 0:
            found += 1
            assert np.abs(z - exact).max() < 1e-4 * max(1.0, np.abs(exact).max())
    assert found >= 24  # it does not say so of a minimum that it has not found


@pytest.mark.parametrize("kind", ["out_of_reach", "opposed", "zero_row"])
def test_what_nothing_keeps_is_not_found(kind):
    rng = np.random.default_rng(1)
    for _ in range(8):
        problem = programs.ordinary(rng, int(rng.integers(2, 9)), int(rng.integers(1, 9)))
        problem = programs.INFEASIBLE[kind](problem, rng)
        if kind == "opposed":  # by more than what counts as kept
            problem = problem._replace(row_upper=problem.row_upper - 0.1)
        with np.errstate(all="ignore"):
            assert interior_minimum(problem)[1] == 1


def test_the_last_row_may_have_a_price():
    rng, paid = np.random.default_rng(5), []
    for problem in programs.problems("ordinary", count=60):
        if len(problem.A) == 0:
            continue
        low = problem.row_lower.copy()
        low[-1] = -np.inf
        problem, price = problem._replace(row_lower=low), 10.0 ** rng.uniform(-1.0, 2.0)
        exact, _ = DAQP.solve(problem, price)
        z, verdict = interior_minimum(problem, price)
        assert verdict == 0
        np.testing.assert_allclose(z, exact, atol=1e-4 * max(1.0, np.abs(exact).max()))
        paid.append(problem.A[-1] @ z > problem.row_upper[-1] + 1e-6)
    assert any(paid)
    assert not all(paid)


def test_factors_solve(rng):
    for n in (1, 3, 8):
        root = rng.normal(size=(n, n))
        A, b = root @ root.T + 0.1 * np.eye(n), rng.normal(size=(n, 2))
        np.testing.assert_allclose(A @ Factors(A).solve(b), b, atol=1e-9)
