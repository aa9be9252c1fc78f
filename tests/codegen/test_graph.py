"""Arithmetic on numbers that are not known yet, and what carries it out."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy_lanes import NumpyLanes

from approxjac import law
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.backends.numpy_function import numpy_function
from approxjac.codegen.trace.program import Block, Program
from approxjac.codegen.trace.symbols import Graph, eigensystem, inputs, select, symbols
from approxjac.law.factors import Factors


@pytest.fixture
def graph():
    return Graph()


def outcome(graph, numbers, **values):
    with np.errstate(all="ignore"):
        return [float(each) for each in numpy_function(graph, list(numbers))(**values)]


def test_constants_fold_and_equal_operations_stand_once(graph):
    a, b = graph.input("x", 2)
    assert (a * 0.0, a * 1.0 is a, a + 0.0 is a, a / 1.0 is a) == (0.0, True, True, True)
    assert (a * b).place == (b * a).place
    assert (a - b).place == (a + -b).place
    opposite = -a
    assert (-opposite).place == a.place
    assert ((-a) * b).place == (-(a * b)).place
    size = len(graph.nodes)
    _ = a * b - (a * b)
    assert len(graph.nodes) == size + 1


@given(x=st.floats(-1e3, 1e3), y=st.floats(-1e3, 1e3))
def test_arithmetic_is_that_of_numbers(x, y):
    graph = Graph()
    a, b = graph.input("x", 2)

    def terms(a, b, root, c):
        return [
            a + b,
            a - b,
            2.0 - a,
            a * b,
            -a * b - b,
            c(a),
            root(a * a + 1.0),
            1.0 / (b * b + 1),
        ]

    found = outcome(
        graph, [*terms(a, b, lambda c: c.sqrt(), lambda c: c**3), abs(a), a.rounded()], x=[x, y]
    )
    assert found == [*terms(x, y, math.sqrt, lambda c: c * c * c), abs(x), round(x)]


def test_no_branch_on_what_is_not_known(graph):
    (a,) = graph.input("x", 1)
    for branch in (bool, float, int, lambda a: max(a, 0.0)):
        with pytest.raises(TypeError, match=r"choose with np\.where"):
            branch(a)
    with pytest.raises(ValueError, match="of another graph"):
        _ = a + Graph().input("x", 1)[0]


def test_conditions(graph):
    a, b = graph.input("x", 2)
    chosen = select((a < b) & ~(a == 0.0) | (a >= 2.0), a < 1.0, b < 1.0)
    found = [outcome(graph, [select(chosen, 1.0, 0.0)], x=x)[0] for x in ([-1.0, 0.0], [3.0, 0.0])]
    assert found == [1.0, 0.0]


def test_functions_are_within_some_units_of_the_last_place(graph):
    x = inputs(graph, "x", 1)
    function = numpy_function(graph, [np.sin(x)[0], np.cos(x)[0], np.tanh(x)[0]])
    for values in (np.linspace(-30.0, 30.0, 100_001), np.geomspace(1e-300, 1.0, 1001)):
        for ours, known, units in zip(
            function(x=[values]), (np.sin, np.cos, np.tanh), (2.0, 2.0, 4.0), strict=True
        ):
            expected = known(values)
            assert (np.abs(ours - expected) <= units * np.spacing(np.abs(expected))).all()
    far = np.linspace(-1e6, 1e6, 10_001)
    for ours, known in zip(function(x=[far])[:2], (np.sin, np.cos), strict=True):
        assert np.abs(ours - known(far)).max() <= 2.3e-16


def test_further_functions_are_those_of_numpy(graph):
    """Exponentials of what is beyond ±700 are those of ±700, which are finite."""
    (x,), (y,) = inputs(graph, "x", 1), inputs(graph, "y", 1)
    a, b = symbols([x]), symbols([y])
    made = [np.exp(a), np.arctan2(a, b), np.hypot(a, b), np.copysign(a, b), np.sign(a)]
    function = numpy_function(graph, [each[0] for each in (*made, np.rint(a), np.expm1(0.01 * a))])
    sizes = np.concatenate([np.geomspace(1e-9, 650.0, 80), [710.0, 4e3, 1e5]])
    x, y = (each.ravel() for each in np.meshgrid(np.append(-sizes, sizes), [-3.1, -0.2, 0.4, 7.0]))
    exp, *others = function(x=[x], y=[y])
    np.testing.assert_allclose(exp, np.exp(np.clip(x, -700.0, 700.0)), rtol=1e-14, atol=1e-15)
    some = np.abs(x) < 1e4
    expected = np.arctan2(x, y), np.hypot(x, y), np.copysign(x, y), np.sign(x), np.rint(x)
    for found, wanted in zip(
        others, (*expected, np.expm1(np.where(some, 0.01 * x, 0.0))), strict=True
    ):
        np.testing.assert_allclose(found[some], wanted[some], rtol=1e-14)


@pytest.mark.study
@pytest.mark.parametrize("m", [1, 2, 3, 4, 6])
def test_damped_solutions_are_those_of_the_law(graph, m, rng):
    """Far from singular, near to it and at it."""
    G, b = inputs(graph, "G", (m, m)), inputs(graph, "b", m)
    for i in range(m):
        G[i, :i] = G[:i, i]
    w, damping = law.damped_gram_solve(G, b, scale=0.01)
    may_be = law.may_be_singular(G, law.SINGULAR_RATIO, 0.01)
    function = numpy_function(graph, [*w, damping, select(may_be, 1.0, 0.0)])
    seen = set()
    for i in range(200):
        J = rng.standard_normal((m, 7)) * 10.0 ** rng.uniform(-3, 1)
        if i % 2:
            J[-1] = J[0] * rng.standard_normal() + J[-1] * 10.0 ** rng.uniform(-4, 0)
        if i % 20 == 19:
            J[-1] = 0.0
        right, matrix = rng.standard_normal(m), J @ J.T
        expected, rate = law.damped_gram_solve(matrix, right, scale=0.01)
        with np.errstate(all="ignore"):
            *found, damped, unsure = map(float, function(G=matrix.ravel(), b=right))
        condition = np.linalg.cond(matrix + rate**2 * np.eye(m))
        assert (
            np.abs(np.array(found) - expected).max() <= 1e-14 * condition * np.abs(expected).max()
        )
        assert abs(damped**2 - rate**2) <= 1e-13 * np.trace(matrix) + 1e-20
        assert unsure or rate == 0.0
        seen.add((bool(unsure), rate > 0.0))
    assert seen >= {(False, False), (True, True)}


def test_factors_and_eigenvalues(graph, rng):
    A = inputs(graph, "A", (5, 5))
    b = inputs(graph, "b", 5)
    function = numpy_function(
        graph, [*Factors(A).solve(b), *eigensystem(A)[0], *eigensystem(A)[1].ravel()]
    )
    for _ in range(20):
        root = rng.standard_normal((5, 5))
        matrix, right = root @ root.T + 0.1 * np.eye(5), rng.standard_normal(5)
        with np.errstate(all="ignore"):
            found = np.array(function(A=matrix.ravel(), b=right), dtype=float)
        np.testing.assert_allclose(matrix @ found[:5], right, atol=1e-10)
        values, vectors = found[5:10], found[10:].reshape(5, 5)
        np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(matrix), atol=1e-12)
        np.testing.assert_allclose(matrix @ vectors, vectors * values, atol=1e-12)


def program():
    """Pendulums with a late v, noise, a record and two rare blocks, one needs the other."""
    p = Program()
    q, v, late, n = p.kept("q", 3), p.kept("v", 3), p.history("late", 3, 5), p.kept("n", 1)
    noise, wave = p.drawn("noise", 3), p.timed("wave", 2)
    stiffness = p.given("stiffness", np.linspace(0.5, 2.0, 48).reshape(16, 3))
    same = p.given("same", np.full((16, 3), 0.1))
    push = noise * wave[1] - 0.1 * late
    v_end = v + 0.01 * (-stiffness * np.sin(q) - same * np.tanh(v) + push)
    q_end = q + 0.01 * v_end
    far = law.any_of(np.abs(q_end) > 0.5)
    held = np.where(np.abs(q_end) > 0.5, 0.5 * np.cos(q_end), q_end)
    first = symbols(p.graph.rare(far, held.tolist(), q_end.tolist()))
    fast = law.any_of(np.abs(v_end) > 0.6)
    second = p.graph.rare(fast, (first * np.sqrt(np.abs(v_end))).tolist(), v_end.tolist())
    p.step({"q": first, "v": second, "late": v})
    p.record({"n": n[0] + np.abs(v).max() + 1e-3 * p.k})
    return p


def kept_after(lanes, program, blocks=(0, 301), last=300):
    rng = np.random.default_rng(0)
    k = np.arange(last + 1.0)
    # v of three steps ago: written to another place than the one that is read
    known = {"late.from": k % 5, "late.to": (k + 3) % 5, "wave": np.sin(k)}
    known["recorded"] = (k % 7 == 0) | (k == last)
    times = np.zeros((last + 1, program.n_times))
    for name, (at, size) in program.times.items():
        times[:, at : at + size] = known[name][:, np.newaxis]
    draws = rng.standard_normal((last + 1, program.n_draws, 16))
    state = np.zeros((16, program.n_rows))
    state[:, :6] = rng.standard_normal((16, 6))
    given = program.filled(
        {"stiffness": np.linspace(0.5, 2.0, 48).reshape(16, 3), "same": np.full((16, 3), 0.1)}
    )

    def packed(columns):
        return np.array(
            columns.reshape(-1, lanes.width, columns.shape[1]).swapaxes(1, 2), order="C"
        )

    kept = packed(state)
    for first, end in itertools.pairwise(blocks):
        own = draws[first:end].reshape(end - first, program.n_draws, -1, lanes.width)
        block = Block(first, times[first:end], np.array(np.moveaxis(own, 2, 0), order="C"))
        lanes.run(kept, packed(given), block)
    return kept.swapaxes(1, 2).reshape(16, -1)


@pytest.mark.parametrize(
    ("width", "features"),
    [
        (1, None),
        (8, "+sse2"),
        *(
            pytest.param(*each, marks=pytest.mark.study)
            for each in ((2, "+sse2"), (4, None), (8, None), (16, None))
        ),
    ],
)
def test_the_same_bits_on_vectors_of_any_width(width, features):
    p = program()
    expected = kept_after(NumpyLanes(p), p)
    assert np.isfinite(expected).all()
    lanes = LlvmLanes(p, width, features)
    np.testing.assert_array_equal(kept_after(lanes, p), expected)
    np.testing.assert_array_equal(kept_after(lanes, p, (0, 1, 128, 301)), expected)


def test_the_same_bits_where_a_block_is_cut(monkeypatch):
    """LLVM's code of many operations is cut into blocks, in what is rare, too."""
    p = program()
    expected = kept_after(NumpyLanes(p), p)
    monkeypatch.setattr("approxjac.codegen.backends.llvm._PART", 3)
    np.testing.assert_array_equal(kept_after(LlvmLanes(p, 4), p), expected)


def memory(seed):
    """What rare blocks change, some of it taken back, all of it read before, after and elsewhere.

    As a law that learns does, and its guard.
    """
    rng, p = np.random.default_rng(seed), Program()
    before, n = p.kept("memory", 8), p.kept("n", 8)
    known = before[0] * n[1] > 0.2  # some conditions stand before what is changed
    after = before.copy()

    def some(count=1):
        everything = [*before, *after, *n, p.k]
        return symbols([
            0.4 * everything[i] - 0.5 * everything[j] * everything[i] + 0.1
            for i, j in rng.integers(0, len(everything), (count, 2))
        ])  # fmt: skip

    def change(values):
        at = rng.choice(8, rng.integers(1, 8), replace=False)
        values[at] = some(len(at))
        if rng.random() < 0.5:  # a block in a block
            inner = some(len(at))
            law.alter(some()[0] > 0.1, values, lambda values: values.__setitem__(at, inner))

    for _ in range(rng.integers(1, 4)):
        law.alter(some()[0] > 0.0, after, change)
    refused = known if rng.random() < 0.7 else some()[0] > 0.3
    changed = after
    (after,) = law.choose(refused, lambda: (before,), lambda: (changed,))
    other = law.choose(some()[0] > 0.1, lambda: (np.tanh(some(8)),), lambda: (n,))[0]
    p.step({"memory": np.clip(after, -4.0, 4.0) if rng.random() < 0.2 else after, "n": other})
    return p


@pytest.mark.parametrize("seed", [*range(12), 113, 114, 145])
@pytest.mark.parametrize("width", [1, 4])
def test_what_only_rare_blocks_change_is_written_in_place(width, seed):
    p, rng = memory(seed), np.random.default_rng(seed)
    starts = rng.uniform(-1.0, 1.0, (16, 16)).reshape(-1, width, 16)
    expected = np.array(starts.swapaxes(1, 2), order="C")
    found, nothing, block = expected.copy(), np.zeros((len(starts), 1, width)), Block.plain(20)
    block = block._replace(draws=np.zeros((len(starts), 20, 0, width)))
    NumpyLanes(p).run(expected, nothing, block)
    LlvmLanes(p, width).run(found, nothing, block)
    assert np.isfinite(expected).all()
    np.testing.assert_array_equal(found, expected)


def test_what_does_not_differ_is_a_constant():
    p = program()
    assert list(p.parameters) == ["stiffness"]
    with pytest.raises(ValueError, match="same differs from run to run where it did not"):
        p.filled({"same": np.full((2, 3), 0.2)})


def test_what_is_known_is_decomposed_at_once(graph):
    a, b = graph.input("x", 2)
    known = np.array([[2.0, 0.3, -0.4], [0.3, 1.0, 0.1], [-0.4, 0.1, 3.0]])
    values, vectors = eigensystem(symbols(known))
    np.testing.assert_allclose(known @ vectors, vectors * values, atol=1e-14)
    assert len(graph.nodes) == 2  # nothing was written down
    partly = symbols([[a, 0.0, b], [0.0, 2.0, 0.0], [b, 0.0, -a]])  # ±√(a² + b²) and 2
    found = np.sort(outcome(graph, eigensystem(partly)[0], x=[0.8, -1.5]))
    np.testing.assert_allclose(found, [-1.7, 1.7, 2.0], rtol=1e-14)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_any_matrix_of_three_rows_has_an_inverse(graph, n, rng):
    A, b, numbers = inputs(graph, "A", (n, n)), inputs(graph, "b", n), rng.normal(size=(n, n))
    made = [*np.linalg.solve(A, b), *np.linalg.inv(A).ravel()]
    found = outcome(graph, made, A=numbers.ravel(), b=np.arange(n) - 0.7)
    inverse = np.linalg.inv(numbers)
    np.testing.assert_allclose(found[:n], inverse @ (np.arange(n) - 0.7), rtol=1e-12)
    np.testing.assert_allclose(found[n:], inverse.ravel(), rtol=1e-12)


def test_what_no_symbols_can_do_is_refused(graph):
    x = inputs(graph, "x", 4)
    for refused in (
        lambda: x[0] ** 9,
        lambda: x[0] ** 0.5,
        lambda: np.linalg.norm(x, 1),
        lambda: np.linalg.solve(np.outer(x, np.arange(4.0)), x),  # neither small nor symmetric
        lambda: law.take(np.eye(3), x[0]),  # no number of a loop's pass
    ):
        with pytest.raises(TypeError):
            refused()
    assert +x[0] is x[0]
    assert (+x[0]).place == np.append(x, x[0])[4].place
