"""Quadratic programs: right answers on awkward problems, and no harm from bad solvers."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import nnls

from approxjac.controllers.limits.quadratic_program import (
    QuadraticProgram,
    Solver,
    Verdict,
)

INF = np.inf
DAQP = Solver()


@pytest.fixture(scope="module")
def solver():
    return Solver()


# ---------------------------------------------------------------- problems


def ordinary(rng, n, k):
    """One with two-sided and one-sided rows, and room inside all of them."""
    root = rng.normal(size=(n, n))
    A = rng.normal(size=(k, n))
    lower, upper = -rng.uniform(0.2, 3.0, n), rng.uniform(0.2, 3.0, n)
    inside = A @ rng.uniform(lower, upper)
    row_lower = np.where(rng.random(k) < 0.5, -INF, inside - rng.uniform(0.0, 1.0, k))
    return QuadraticProgram(
        root @ root.T + 0.1 * np.eye(n), 10.0 * rng.normal(size=n), lower, upper,
        A, row_lower, inside + rng.uniform(0.0, 1.0, k),
    )  # fmt: skip


def stacked(problem, A, row_lower, row_upper):
    return problem._replace(
        A=np.vstack([problem.A, A]),
        row_lower=np.concatenate([problem.row_lower, row_lower]),
        row_upper=np.concatenate([problem.row_upper, row_upper]),
    )


def parallel(p, rng):
    return stacked(p, 2.0 * p.A, 2.0 * p.row_lower - 0.1, 2.0 * p.row_upper + 0.1)


def duplicated(p, rng):
    return stacked(p, p.A, p.row_lower, p.row_upper)


def redundant(p, rng):
    return stacked(p, np.eye(len(p.f)), p.lower, p.upper)


def around(p, rng):
    """With rows around a point of the box, and that point."""
    point = rng.uniform(p.lower, p.upper)
    values, room = p.A @ point, rng.uniform(0.0, 1.0, len(p.A))
    return p._replace(row_lower=values - room, row_upper=values + room), point


def zero_width(p, rng):
    p, point = around(p, rng)
    fixed = rng.random(len(point)) < 0.5
    return p._replace(lower=np.where(fixed, point, p.lower), upper=np.where(fixed, point, p.upper))


def one_point(p, rng):
    p, point = around(p, rng)
    return p._replace(lower=point, upper=point)


def equalities(p, rng):
    p, point = around(p, rng)
    equal = np.arange(len(p.A)) < len(point) // 2
    values = p.A @ point
    return p._replace(
        row_lower=np.where(equal, values, p.row_lower),
        row_upper=np.where(equal, values, p.row_upper),
    )


def duplicated_equalities(p, rng):
    return duplicated(equalities(p, rng), rng)


def all_equalities(p, rng):
    p, point = around(p, rng)
    return p._replace(row_lower=p.A @ point, row_upper=p.A @ point)


def vertex(p, rng):
    """Three times as many rows as variables meet where the minimum lies."""
    n = len(p.f)
    A, point = rng.normal(size=(3 * n, n)), rng.uniform(-1.0, 1.0, n)
    pull = A.T @ rng.uniform(0.0, 3.0, 3 * n)
    return p._replace(
        f=-p.H @ point - pull, lower=np.full(n, -2.0), upper=np.full(n, 2.0),
        A=A, row_lower=np.full(3 * n, -INF), row_upper=A @ point,
    )  # fmt: skip


def far_minimum(p, rng):
    return around(p, rng)[0]._replace(f=1e3 * p.f)


def scaled_diagonal(p, rng):
    return p._replace(H=np.diag(10.0 ** rng.uniform(-3.0, 3.0, len(p.f))))


def scaled(p, rng):
    scale = 10.0 ** rng.uniform(-1.5, 1.5, len(p.f))
    return p._replace(H=scale[:, None] * p.H * scale)


def half_open(p, rng):
    n = len(p.f)
    return p._replace(
        lower=np.where(rng.random(n) < 0.5, -INF, p.lower),
        upper=np.where(rng.random(n) < 0.5, INF, p.upper),
    )


def nothing_bounded(p, rng):
    n, k = len(p.f), len(p.A)
    return p._replace(
        lower=np.full(n, -INF), upper=np.full(n, INF),
        row_lower=np.full(k, -INF), row_upper=np.full(k, INF),
    )  # fmt: skip


def no_rows(p, rng):
    return nothing_bounded(
        p._replace(A=p.A[:0], row_lower=p.row_lower[:0], row_upper=p.row_upper[:0]), rng
    )


def with_slack(p, rng):
    """What a controller asks: rows that may be violated, at a price."""
    n, k = len(p.f), len(p.A)
    H = np.zeros((n + 1, n + 1))
    H[:n, :n], H[n, n] = p.H, 1e3
    return QuadraticProgram(
        H, np.append(p.f, 0.0), np.append(p.lower, 0.0), np.append(p.upper, INF),
        np.column_stack([p.A, -np.ones(k)]), np.full(k, -INF), p.row_upper - 2.0,
    )  # fmt: skip


FEASIBLE = {
    make.__name__: make
    for make in (
        parallel, duplicated, redundant, zero_width, one_point, equalities,
        duplicated_equalities, all_equalities, vertex, far_minimum, scaled_diagonal, scaled,
        half_open, nothing_bounded, no_rows, with_slack,
    )
} | {"ordinary": lambda p, rng: p}  # fmt: skip


def problems(kind, count=25, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        n, k = int(rng.integers(2, 9)), int(rng.integers(0, 17))
        yield FEASIBLE[kind](ordinary(rng, n, k), rng)


def out_of_reach(p, rng):
    reach = np.abs(p.A[:1]) @ np.maximum(np.abs(p.lower), np.abs(p.upper))
    return stacked(p, p.A[:1], reach + 0.1, np.full(1, INF))


def opposed(p, rng):
    a = p.A[:1]
    return stacked(p, np.vstack([a, -a]), np.full(2, -INF), np.full(2, -1e-3))


def conflicting_equalities(p, rng):
    a = p.A[:1]
    return stacked(p, np.vstack([a, a]), np.array([0.1, 0.2]), np.array([0.1, 0.2]))


def opposed_without_box(p, rng):
    n = len(p.f)
    return opposed(p, rng)._replace(lower=np.full(n, -INF), upper=np.full(n, INF))


def zero_row(p, rng):
    return stacked(p, 0.0 * p.A[:1], np.ones(1), np.full(1, 2.0))


def crossed_bounds(p, rng):
    return p._replace(lower=np.nextafter(p.upper, INF))


def crossed_rows(p, rng):
    return p._replace(row_lower=np.nextafter(p.row_upper, INF))


INFEASIBLE = {
    make.__name__: make
    for make in (
        out_of_reach, opposed, conflicting_equalities, opposed_without_box, zero_row,
        crossed_bounds, crossed_rows,
    )
}  # fmt: skip


def residual(problem, z):
    """Violation of bounds and rows, and what is left of stationarity with the best multipliers."""
    H, f, lower, upper, A, row_lower, row_upper = problem
    normals = np.vstack([np.eye(len(f)), A])
    low, high = np.concatenate([lower, row_lower]), np.concatenate([upper, row_upper])
    values, size = normals @ z, np.maximum(1.0, np.abs(normals) @ np.abs(z))
    violation = max(0.0, ((low - values) / size).max(), ((values - high) / size).max())
    at_low, at_high = values - low <= 1e-6 * size, high - values <= 1e-6 * size
    active = np.vstack([normals[at_low], -normals[at_high]])
    gradient = H @ z + f
    left = nnls(active.T, gradient, maxiter=1000)[1] if len(active) else np.linalg.norm(gradient)
    return max(violation, left / max(1.0, np.linalg.norm(f)))


def simple(**changes):
    """The projection of (2, 0) on a unit box with z₀ + z₁ ≤ 1.5; the answer is (1, 0)."""
    box = np.ones(2)
    return QuadraticProgram(
        np.eye(2), np.array([-2.0, 0.0]), -box, box, np.ones((1, 2)), np.array([-INF]),
        np.array([1.5]),
    )._replace(**changes)  # fmt: skip


# ---------------------------------------------------------------- answers


@pytest.mark.parametrize("kind", FEASIBLE)
def test_answers_are_optimal_and_agree(solver, kind, capfd):
    for problem in problems(kind):
        z, verdict = solver.solve(problem)
        assert verdict is Verdict.SOLVED
        assert residual(problem, z) < 1e-9
        assert (problem.lower <= z).all()
        assert (z <= problem.upper).all()
    assert capfd.readouterr().out == ""  # in a loop of 1 kHz nothing may print


@pytest.mark.parametrize("kind", INFEASIBLE)
def test_infeasible_problems_are_called_so(solver, kind):
    rng = np.random.default_rng(1)
    for _ in range(8):
        problem = ordinary(rng, int(rng.integers(2, 9)), int(rng.integers(1, 9)))
        assert solver.solve(INFEASIBLE[kind](problem, rng)) == (None, Verdict.INFEASIBLE)


@pytest.mark.parametrize("value", [np.nan, INF])
@pytest.mark.parametrize("name", ["H", "f", "lower", "upper", "A", "row_upper"])
def test_a_problem_without_finite_numbers_is_not_solved(solver, name, value):
    if value == INF and name in ("upper", "row_upper"):
        value = -INF
    array = getattr(simple(), name).copy()
    array.flat[0] = value
    z, verdict = solver.solve(simple(**{name: array}))
    assert z is None
    assert verdict is not Verdict.SOLVED


def test_an_indefinite_problem_fails_or_is_held(solver):
    z, verdict = solver.solve(simple(H=-np.eye(2)))
    assert verdict is not Verdict.INFEASIBLE
    assert z is None or (np.abs(z) <= 1.0).all()


def test_large_bounds_are_not_lost_to_round_off():
    rng = np.random.default_rng(3)
    for _ in range(50):
        p = all_equalities(ordinary(rng, 5, 12), rng)
        p = p._replace(
            lower=1e6 * p.lower, upper=1e6 * p.upper,
            row_lower=1e6 * p.row_lower, row_upper=1e6 * p.row_upper,
        )  # fmt: skip
        z, verdict = DAQP.solve(p)
        assert verdict is Verdict.SOLVED
        assert residual(p, z) < 1e-6


def test_small_rows_are_rows():
    small = simple(H=1e6 * np.eye(2), f=np.array([-1e6, 0.0]), A=np.array([[1e-3, 0.0]]))
    z, verdict = DAQP.solve(small._replace(row_lower=np.array([-1e-3]), row_upper=np.zeros(1)))
    assert verdict is Verdict.SOLVED
    assert z[0] < 2e-3  # the row holds to 1e-6


numbers = st.integers(-1000, 1000).map(lambda number: number / 100.0)


@given(data=st.data(), n=st.integers(1, 5), k=st.integers(0, 6))
def test_answers_hold_their_bounds(data, n, k):
    def vector(size):
        return np.array(data.draw(st.lists(numbers, min_size=size, max_size=size)))

    A, point = vector(k * n).reshape(k, n), vector(n)
    lower, upper = point - np.abs(vector(n)), point + np.abs(vector(n))
    row_lower, row_upper = A @ point - np.abs(vector(k)), A @ point + np.abs(vector(k))
    root = vector(n * n).reshape(n, n)
    problem = QuadraticProgram(
        root @ root.T + 0.1 * np.eye(n), 10.0 * vector(n), lower, upper, A, row_lower, row_upper
    )
    z, verdict = DAQP.solve(problem)
    assert verdict is Verdict.SOLVED
    assert ((lower <= z) & (z <= upper)).all()
    slack = 1e-6 * np.maximum(1.0, np.abs(A) @ np.abs(z))
    assert ((row_lower - slack <= A @ z) & (A @ z <= row_upper + slack)).all()


def test_the_last_row_may_have_a_price():
    """The answer is that of the problem with a slack, whichever way it is found."""
    rng, paid = np.random.default_rng(5), []
    for problem in problems("ordinary", count=60):
        if len(problem.A) == 0:
            continue
        price, n = 10.0 ** rng.uniform(-1.0, 2.0), len(problem.f)
        H = np.zeros((n + 1, n + 1))
        H[:n, :n], H[n, n] = problem.H, 1e-9  # definite, and too little to count
        A = np.column_stack([problem.A, np.zeros(len(problem.A))])
        A[-1, n] = -1.0
        low = problem.row_lower.copy()
        low[-1] = -INF
        priced = QuadraticProgram(
            H, np.append(problem.f, price), np.append(problem.lower, 0.0),
            np.append(problem.upper, INF), A, low, problem.row_upper,
        )  # fmt: skip
        problem = problem._replace(row_lower=low)
        exact, _ = DAQP.solve(priced)
        ways = [DAQP.solve(problem, price, pays) for pays in (False, True)]
        ways.append(Solver(daqp_function).solve(problem, price))
        for z, verdict in ways:
            assert verdict is Verdict.SOLVED
            np.testing.assert_allclose(z, exact[:n], atol=1e-5)
        paid.append(exact[n] > 1e-6)
    assert any(paid)
    assert not all(paid)


# ---------------------------------------------------------------- functions of the user's own


def daqp_function(problem):
    return DAQP.solve(problem)[0]


def test_a_function_solves():
    solver = Solver(daqp_function)
    for problem in problems("ordinary"):
        np.testing.assert_array_equal(solver.solve(problem)[0], DAQP.solve(problem)[0])


def test_answers_a_little_outside_are_brought_inside():
    z, verdict = Solver(lambda p: [1.0 + 5e-7, -1.0 - 5e-7]).solve(simple())
    assert verdict is Verdict.SOLVED
    np.testing.assert_array_equal(z, [1.0, -1.0])
    big = simple(lower=np.full(2, -1e3), upper=np.full(2, 1e3), row_upper=np.array([INF]))
    z, verdict = Solver(lambda p: np.array([1e3 + 5e-4, 0.0])).solve(big)
    assert verdict is Verdict.SOLVED
    np.testing.assert_array_equal(z, [1e3, 0.0])


GARBAGE = {
    "NaN": [np.nan, 0.0],
    "inf": [INF, 0.0],
    "immense": [1e308, 1e308],
    "outside": [1.0 + 1e-5, 0.0],
    "row violated": [1.0, 0.6],
    "row violated a little": [1.0, 0.50001],
    "too long": [0.0, 0.0, 0.0],
    "a column": [[0.0], [0.0]],
    "nothing": [],
    "text": "solved",
    "texts": ["0", "0"],
    "complex": [0j, 0j],
    "booleans": [False, False],
    "ragged": [[0.0], [0.0, 1.0]],
    "a type": float,
}


@pytest.mark.parametrize("what", GARBAGE)
@pytest.mark.parametrize("bounded", [True, False])
def test_garbage_is_no_answer(what, bounded):
    if not bounded and ("outside" in what or "violated" in what):
        pytest.skip("nothing is violated without bounds")
    problem = simple() if bounded else nothing_bounded(simple(), None)
    assert Solver(lambda p: GARBAGE[what]).solve(problem) == (None, Verdict.FAILED)


def test_nothing_found_is_judged_by_daqp():
    solver = Solver(lambda p: None)
    assert solver.solve(simple()) == (None, Verdict.FAILED)
    out = simple(row_lower=np.array([3.0]), row_upper=np.array([INF]))
    assert solver.solve(out) == (None, Verdict.INFEASIBLE)


def test_a_function_that_raises_fails_and_is_told_of_once(caplog):
    def broken(problem):
        raise RuntimeError("no such luck")

    solver = Solver(broken)
    for _ in range(3):
        assert solver.solve(simple()) == (None, Verdict.FAILED)
    assert [record.message for record in caplog.records] == [
        f"{broken!r} raised, which is logged once"
    ]
    assert "no such luck" in caplog.text


def test_a_function_cannot_change_the_problem():
    def greedy(problem):
        problem.upper[:] = 100.0
        return np.array([50.0, -60.0])

    problem = simple()
    assert Solver(greedy).solve(problem) == (None, Verdict.FAILED)
    assert all(map(np.array_equal, problem, simple()))


def test_copies_solve(solver):
    for original in (solver, Solver(daqp_function)):
        for other in (copy.deepcopy(original), pickle.loads(pickle.dumps(original))):
            np.testing.assert_allclose(other.solve(simple())[0], [1.0, 0.0], atol=1e-6)
