"""Quadratic programs: right answers on awkward problems, and no harm from bad solvers."""

import copy
import gc
import importlib.util
import os
import pickle
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from approxjac import ApproxJacError
from approxjac.controllers.quadratic import QuadraticProgram, Verdict, as_solver, choice
from approxjac.errors import InvalidInputError, MissingPackageError, UnknownNameError

INF = np.inf
MODULES = {name: name for name in ("daqp", "osqp", "quadprog", "clarabel", "piqp", "scs")}
OTHERS = ("clarabel", "piqp", "quadprog", "scs")


def is_installed(name):
    return importlib.util.find_spec(MODULES[name]) is not None


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(name, marks=[] if is_installed(name) else pytest.mark.skip("not installed"))
        for name in MODULES
    ],
)
def solver(request):
    return as_solver(request.param, 2.0)


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
    reference = as_solver("daqp", 2.0)
    for problem in problems(kind):
        z, verdict = solver.solve(problem)
        assert verdict is Verdict.SOLVED
        assert residual(problem, z) < 1e-6
        assert (problem.lower <= z).all()
        assert (z <= problem.upper).all()
        exact = reference.solve(problem)[0]
        np.testing.assert_allclose(z, exact, rtol=0, atol=1e-6 * max(1.0, np.abs(exact).max()))
    assert capfd.readouterr().out == ""  # in a loop of 1 kHz nothing may print


@pytest.mark.parametrize("kind", INFEASIBLE)
def test_infeasible_problems_are_called_so(solver, kind):
    rng = np.random.default_rng(1)
    for _ in range(8):
        problem = ordinary(rng, int(rng.integers(2, 9)), int(rng.integers(1, 9)))
        assert solver.solve(INFEASIBLE[kind](problem, rng)) == (None, Verdict.INFEASIBLE)


MALFORMED = {
    "NaN in H": simple(H=np.array([[np.nan, 0.0], [0.0, 1.0]])),
    "NaN in f": simple(f=np.array([np.nan, 0.0])),
    "NaN in a bound": simple(upper=np.array([1.0, np.nan])),
    "NaN in A": simple(A=np.array([[1.0, np.nan]])),
    "NaN in a row": simple(row_upper=np.array([np.nan])),
    "inf in H": simple(H=np.array([[INF, 0.0], [0.0, 1.0]])),
    "inf in f": simple(f=np.array([INF, 0.0])),
    "inf in A": simple(A=np.array([[1.0, INF]]), row_upper=np.array([INF])),
    "lower inf": simple(lower=np.array([INF, 0.0]), upper=np.array([INF, 1.0])),
    "lower inf, upper 1": simple(lower=np.array([INF, 0.0])),
    "upper -inf": simple(lower=np.full(2, -INF), upper=np.array([-INF, 1.0])),
    "row at inf": simple(row_lower=np.full(1, INF), row_upper=np.full(1, INF)),
    "shape of H": simple(H=np.eye(3)),
    "shape of f": simple(f=np.zeros((1, 2))),
    "shape of a bound": simple(lower=-np.ones(1)),
    "shape of A": simple(A=np.ones(2)),
    "too few rows": simple(row_lower=np.zeros(0)),
    "no variables": QuadraticProgram(
        np.zeros((0, 0)), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 0)), np.zeros(0),
        np.zeros(0),
    ),
    "texts": simple(f=np.array(["a", "b"])),
    "complex": simple(H=np.eye(2) * 1j),
    "ragged": simple(A=[[1.0], [1.0, 2.0]]),
    "no problem": None,
}  # fmt: skip


@pytest.mark.parametrize("why", MALFORMED)
def test_malformed_problems_fail(solver, why):
    assert solver.solve(MALFORMED[why]) == (None, Verdict.FAILED)
    assert solver.solve(simple())[1] is Verdict.SOLVED


def test_indefinite_problems_fail_or_are_held(solver):
    z, verdict = solver.solve(simple(H=-np.eye(2)))
    assert verdict is not Verdict.INFEASIBLE
    assert z is None or (np.abs(z) <= 1.0).all()
    np.testing.assert_allclose(solver.solve(simple())[0], [1.0, 0.0], atol=1e-6)


def test_memory_layout_does_not_matter(solver):
    p = next(problems("ordinary", seed=5))
    expected = solver.solve(p)[0]
    read_only = QuadraticProgram(*(array.copy() for array in p))
    for array in read_only:
        array.flags.writeable = False
    apart = QuadraticProgram(*(np.repeat(array, 2, axis=-1)[..., ::2] for array in p))
    columns = p._replace(H=np.asfortranarray(p.H), A=np.asfortranarray(p.A))
    lists = QuadraticProgram(*(array.tolist() for array in p))
    integers = simple(H=np.eye(2, dtype=int), A=np.ones((1, 2), dtype=np.int32))
    np.testing.assert_allclose(solver.solve(integers)[0], [1.0, 0.0], atol=1e-6)
    for other in (read_only, apart, columns, lists):
        np.testing.assert_allclose(solver.solve(other)[0], expected, atol=1e-9)


def test_problems_are_left_as_they_were(solver):
    for problem in problems("equalities", 3):
        before = QuadraticProgram(*(array.copy() for array in problem))
        z, _ = solver.solve(problem)
        z[:] = 7.0  # the answer is the caller's, too
        assert all(map(np.array_equal, before, problem))
        assert residual(problem, solver.solve(problem)[0]) < 1e-6


def test_answers_do_not_depend_on_what_was_solved_before(solver):
    rng = np.random.default_rng(2)
    some = [ordinary(rng, 4, 5) for _ in range(15)]
    some += [FEASIBLE[kind](ordinary(rng, 4, 5), rng) for kind in ("scaled", "far_minimum")]
    some += [INFEASIBLE["crossed_rows"](some[0], rng), simple(), MALFORMED["NaN in A"]]
    some += [some[1]._replace(A=np.vstack([some[1].A[:3], [some[1].A[0], -some[1].A[0]]]),
                              row_lower=np.full(5, -INF), row_upper=np.full(5, -0.1))]  # fmt: skip
    fresh = [pickle.loads(pickle.dumps(solver)).solve(problem) for problem in some]
    for order in (range(len(some)), rng.permutation(len(some)), rng.permutation(len(some))):
        for i in order:
            z, verdict = solver.solve(some[i])
            assert verdict is fresh[i][1]
            assert z is None or z.tobytes() == fresh[i][0].tobytes()


def test_large_bounds_are_not_lost_to_round_off():
    rng = np.random.default_rng(3)
    for _ in range(50):
        p = all_equalities(ordinary(rng, 5, 12), rng)
        p = p._replace(
            lower=1e6 * p.lower, upper=1e6 * p.upper,
            row_lower=1e6 * p.row_lower, row_upper=1e6 * p.row_upper,
        )  # fmt: skip
        z, verdict = as_solver("daqp", 1.0).solve(p)
        assert verdict is Verdict.SOLVED
        assert residual(p, z) < 1e-6


def test_small_rows_are_rows():
    small = simple(H=1e6 * np.eye(2), f=np.array([-1e6, 0.0]), A=np.array([[1e-3, 0.0]]))
    z, verdict = DAQP.solve(small._replace(row_lower=np.array([-1e-3]), row_upper=np.zeros(1)))
    assert verdict is Verdict.SOLVED
    assert z[0] < 2e-3  # the row holds to 1e-6
    for size in (1e-6, 1e-9, 1e-12):
        p = simple(
            A=np.array([[size, 0.0]]), row_lower=np.array([size]), row_upper=np.array([size])
        )
        np.testing.assert_allclose(DAQP.solve(p)[0], [1.0, 0.0], atol=1e-6)


numbers = st.integers(-1000, 1000).map(lambda number: number / 100.0)


@settings(max_examples=100, deadline=None)
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
    z, verdict = OSQP.solve(problem)
    if verdict is Verdict.SOLVED:
        assert ((lower <= z) & (z <= upper)).all()
        assert residual(problem, z) < 1e-6


DAQP, OSQP = as_solver("daqp", 2.0), as_solver("osqp", 2.0)


# ---------------------------------------------------------------- functions of the user's own


def test_a_function_solves():
    solver = as_solver(DAQP_FUNCTION, 2.0)
    assert solver.name == "daqp_function"
    for problem in problems("ordinary"):
        z, verdict = solver.solve(problem)
        assert verdict is Verdict.SOLVED
        np.testing.assert_array_equal(z, DAQP.solve(problem)[0])


def daqp_function(problem):
    return DAQP.solve(problem)[0]


DAQP_FUNCTION = daqp_function


def test_answers_a_little_outside_are_brought_inside():
    z, verdict = as_solver(lambda p: [1.0 + 5e-7, -1.0 - 5e-7], 1.0).solve(simple())
    assert verdict is Verdict.SOLVED
    np.testing.assert_array_equal(z, [1.0, -1.0])
    big = simple(lower=np.full(2, -1e3), upper=np.full(2, 1e3), row_upper=np.array([INF]))
    z, verdict = as_solver(lambda p: np.array([1e3 + 5e-4, 0.0]), 1.0).solve(big)
    assert verdict is Verdict.SOLVED
    np.testing.assert_array_equal(z, [1e3, 0.0])


def test_a_solver_that_is_there_and_does_not_run_is_refused(monkeypatch):
    def without_a_licence(name):
        raise RuntimeError("no licence")

    monkeypatch.setattr(choice, "_Qpsolvers", without_a_licence)
    with pytest.raises(
        InvalidInputError, match="'clarabel' is installed but does not run: no licence"
    ):
        as_solver("clarabel", 1.0)


GARBAGE = {
    "NaN": [np.nan, 0.0],
    "inf": [INF, 0.0],
    "huge": [2e9, 2e9],
    "immense": [1e308, -1e308],
    "outside": [1.0 + 1e-5, 0.0],
    "row violated": [1.0, 0.6],
    "row violated a little": [1.0, 0.50001],
    "too long": [0.0, 0.0, 0.0],
    "a column": [[0.0], [0.0]],
    "a number": 0.0,
    "nothing": [],
    "text": "solved",
    "texts": ["0", "0"],
    "complex": [0j, 0j],
    "booleans": [False, False],
    "ragged": [[0.0], [0.0, 1.0]],
    "an object": object(),
    "a type": float,
}


def test_an_immense_answer_is_none_where_nothing_is_bounded():
    free = nothing_bounded(simple(), None)
    assert as_solver(lambda p: [1e308, 1e308], 1.0).solve(free) == (None, Verdict.FAILED)


@pytest.mark.parametrize("what", GARBAGE)
def test_garbage_is_no_answer(what):
    answers = [GARBAGE[what], np.zeros(2)]
    solver = as_solver(lambda p: answers.pop(0), 1.0)
    assert solver.solve(simple()) == (None, Verdict.FAILED)
    assert solver.solve(simple())[1] is Verdict.SOLVED


def test_nothing_found_is_judged_by_daqp():
    solver = as_solver(lambda p: None, 1.0)
    assert solver.solve(simple()) == (None, Verdict.FAILED)
    out = simple(row_lower=np.array([3.0]), row_upper=np.array([INF]))
    assert solver.solve(out) == (None, Verdict.INFEASIBLE)


@pytest.mark.parametrize("error", [ValueError, SystemExit, KeyboardInterrupt, MemoryError])
def test_a_function_that_raises_fails(error):
    def broken(problem):
        raise error("no")

    solver = as_solver(broken, 1.0)
    infeasible = simple(row_lower=np.array([3.0]), row_upper=np.array([INF]))
    for problem in (simple(), infeasible, simple()):
        assert solver.solve(problem) == (None, Verdict.FAILED)


def test_a_function_cannot_change_the_problem():
    def greedy(problem):
        problem.upper[:] = 100.0
        return np.array([50.0, -60.0])

    problem, solver = simple(), as_solver(greedy, 1.0)
    for _ in range(2):
        assert solver.solve(problem) == (None, Verdict.FAILED)
        assert all(map(np.array_equal, problem, simple()))


class Stalling:
    """Answers once it is let go; then the answer it would have given at once."""

    def __init__(self):
        self.go, self.calls = threading.Event(), 0

    def __call__(self, problem):
        self.calls += 1
        self.go.wait(30.0)
        return np.clip(-problem.f, problem.lower, problem.upper)


def stall(budget):
    """A solver that is stuck, and how long the call took that found out [s]."""
    function = Stalling()
    solver = as_solver(function, budget)
    start = time.perf_counter()
    assert solver.solve(simple()) == (None, Verdict.FAILED)
    return solver, function, time.perf_counter() - start


def test_a_stall_costs_the_budget_and_no_more():
    took = []
    for _ in range(5):
        _, function, elapsed = stall(0.02)
        function.go.set()
        took.append(elapsed)
    assert min(took) >= 0.02
    assert min(took) < 0.02 + 0.05  # the quickest: the others may have waited for a processor


def test_a_stuck_solver_is_not_waited_for_and_not_asked():
    solver, function, _ = stall(0.2)
    start = time.perf_counter()
    for _ in range(20):
        assert solver.solve(simple()) == (None, Verdict.FAILED)
    assert time.perf_counter() - start < 0.2
    assert function.calls == 1
    function.go.set()


def test_after_a_stall_the_next_problem_gets_its_own_answer():
    solver, function, _ = stall(0.2)
    function.go.set()
    deadline = time.monotonic() + 10.0
    z = None
    while z is None and time.monotonic() < deadline:
        z, _ = solver.solve(simple(f=np.array([0.5, -0.25])))
    np.testing.assert_array_equal(z, [-0.5, 0.25])


@pytest.mark.skipif(os.name != "posix", reason="sends a signal to itself")
def test_osqp_can_be_interrupted():
    code = """
import signal, time
n, rng = 60, np.random.default_rng(0)
hard = QuadraticProgram(np.eye(n), 1e3 * rng.normal(size=n), np.full(n, -1.0), np.full(n, 1.0),
                        rng.normal(size=(600, n)), np.full(600, -1.0), np.full(600, 1.0))
solver = as_solver("osqp", 30.0)
def interrupt():
    while True:  # one that comes between OSQP's last look and its end is lost
        time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=interrupt, daemon=True).start()
try:
    while True:
        solver.solve(hard)
except KeyboardInterrupt:
    os.write(1, b" caught ")
    os._exit(0)
"""
    assert "caught" in run(code)


def run(code):
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SETUP + code],
        capture_output=True, text=True, timeout=60, check=True,
    ).stdout.split()  # fmt: skip


SETUP = """
import os, sys, threading
import numpy as np
from approxjac.controllers.quadratic import QuadraticProgram, as_solver
one = np.ones(1)
problem = QuadraticProgram(np.eye(1), one, -one, one, np.eye(1), -one, one)
"""


def test_a_stuck_solver_lets_the_interpreter_exit():
    code = "print(as_solver(lambda p: threading.Event().wait(), 0.01).solve(problem)[1].name)"
    assert run(code) == ["FAILED"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_solves():
    code = """
solver = as_solver(lambda p: -p.f, 1.0)
solver.solve(problem)
child = os.fork()
if not child:
    os._exit(0 if solver.solve(problem)[0] == -1.0 else 1)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), solver.solve(problem)[1].name)
"""
    assert run(code) == ["0", "SOLVED"]


def test_solvers_are_imported_when_asked_for():
    code = "print(*({'osqp', 'daqp', 'qpsolvers', 'scipy'} & set(sys.modules)))"
    assert run(code) == []


def test_the_thread_ends_with_its_solver():
    def one_of_its_own(problem):
        return None

    def threads():
        return [t for t in threading.enumerate() if t.name == "one_of_its_own"]

    solver = as_solver(one_of_its_own, 1.0)
    solver.solve(simple())
    (thread,) = threads()
    del solver
    gc.collect()
    thread.join(10.0)
    assert not threads()


def test_the_budget_is_kept_on_large_problems():
    rng = np.random.default_rng(4)
    n, k = 100, 1000
    problem = QuadraticProgram(
        np.eye(n), 100.0 * rng.normal(size=n), np.full(n, -INF), np.full(n, INF),
        rng.normal(size=(k, n)), np.full(k, -1.0), np.full(k, 1.0),
    )  # fmt: skip
    for name in ("daqp", "osqp"):
        solver = as_solver(name, 1e-3)
        solver.solve(problem._replace(f=np.zeros(n)))  # OSQP sets up its workspace
        took = []
        for _ in range(5):
            start = time.perf_counter()
            assert solver.solve(problem) == (None, Verdict.FAILED)
            took.append(time.perf_counter() - start)
        assert min(took) < 0.05


# ---------------------------------------------------------------- as_solver


def test_unknown_names_are_refused_with_those_there_are():
    with pytest.raises(UnknownNameError) as caught:
        as_solver("daq", 1e-3)
    assert str(caught.value) == ("QP solver 'daq' not in the installed ones; did you mean 'daqp'?")
    with pytest.raises(UnknownNameError, match=r"valid are .*daqp.*osqp"):
        as_solver("newton", 1e-3)


def test_solvers_that_are_not_installed_are_named_with_their_package():
    if importlib.util.find_spec("gurobipy") is not None:
        pytest.skip("it is installed")
    with pytest.raises(MissingPackageError) as caught:
        as_solver("gurobi", 1e-3)
    assert str(caught.value) == (
        "QP solver 'gurobi' is not installed: pip install 'qpsolvers[gurobi]'"
    )


@pytest.mark.parametrize("name", ["highs", "proxqp"])
def test_inaccurate_solvers_are_refused(name):
    with pytest.raises(InvalidInputError, match=f"QP solver '{name}' is not offered: of 2400"):
        as_solver(name, 1e-3)


@pytest.mark.parametrize("budget", [0.0, -1.0, np.nan, np.inf, "1", None])
@pytest.mark.parametrize("solver", ["daqp", "osqp", "quadprog", daqp_function])
def test_a_budget_is_positive(solver, budget):
    with pytest.raises(InvalidInputError, match=r"time_budget must be a finite number > 0 \[s\]"):
        as_solver(solver, budget)


@pytest.mark.parametrize("what", [None, 3, ["daqp"]])
def test_what_is_no_solver_is_refused(what):
    with pytest.raises(ApproxJacError, match="solver must be the name of a QP solver such as"):
        as_solver(what, 1e-3)


def test_an_immense_budget_is_no_error():
    assert as_solver(lambda p: np.zeros(2), 1e300).solve(simple())[1] is Verdict.SOLVED


@pytest.mark.parametrize(
    "again", [copy.copy, copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))]
)
def test_copies_solve(solver, again):
    own = as_solver(daqp_function, 1.0)
    for original in (solver, own):
        original.solve(simple())
        other = again(original)
        assert other is not original
        assert other.name == original.name
        np.testing.assert_allclose(other.solve(simple())[0], [1.0, 0.0], atol=1e-6)


def test_a_function_that_raises_is_told_of_once(caplog):
    def broken(problem):
        raise RuntimeError("no such luck")

    solver = as_solver(broken, 1.0)
    one = np.ones(1)
    problem = QuadraticProgram(np.eye(1), one, -one, one, np.eye(1), -one, one)
    for _ in range(3):
        assert solver.solve(problem) == (None, Verdict.FAILED)
    assert [record.message for record in caplog.records] == [
        "QP solver broken raised, which is told once"
    ]
    assert "no such luck" in caplog.text
