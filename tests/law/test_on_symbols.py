"""What a step is made of: on numbers, and on symbols that become those numbers later."""

from itertools import chain

import numpy as np
import pytest
from numpy.testing import assert_allclose

from approxjac import law
from approxjac.codegen.backends.numpy_function import numpy_function
from approxjac.codegen.trace.symbols import Graph, inputs, symbols
from approxjac.law.branches import all_finite, fold, is_finite, leave, surely
from approxjac.law.limits import largest, within
from approxjac.law.tracking import within_speeds


def altered(condition, x):
    after = x.copy()
    law.alter(condition, after, lambda values: values.__setitem__(slice(0, 2), 7.0))
    return after


def passes(x):
    def body(i, values):
        (total,) = values
        return total + law.take(x, i) * total, (total * 2.0,)

    def added(i, values):
        return (values[0] + law.take(x, i),)

    def collected(i, values):
        after, row = body(i, values)
        return (after,), row

    (end,), (rows,) = law.collect(3, collected, (x[0],))
    return [end, *rows, law.repeat(3, added, (x[1],))[0]]


STEPS = {
    "all_equal": lambda x: [
        law.select(law.all_equal(*pair), x[1], x[2]) for pair in ((x, x), (x, x * x))
    ],
    "select": lambda x: [law.select(x[0] > 0.0, x[1], x[2])],
    "complement": lambda x: [law.select(law.complement(x[0] > 0.0), 1.0, 2.0)],
    "is_finite": lambda x: [law.select(is_finite(x), 1.0, 0.0)],
    "all_finite": lambda x: [law.select(all_finite(x.tolist()), 1.0, 0.0)],
    "any_of": lambda x: [law.select(law.any_of(x > 0.5), 1.0, 0.0)],
    "all_of": lambda x: [law.select(law.all_of(x > 0.5), 1.0, 0.0)],
    "alter": lambda x: altered(x[0] > 0.0, x),
    "choose": lambda x: law.choose(x[0] > 0.0, lambda: (x[1],), lambda: (x[2] * 3.0,)),
    "repeat and collect": passes,
    "within": lambda x: [
        law.select(within([-1.0, -np.inf], x[:2].tolist(), [1.0, np.inf]), 1.0, 0.0)
    ],
    "largest": lambda x: [largest(x.tolist(), 0.5)],
    "array": lambda x: law.array([x[0], 2.0, x[1]]),
    "within speeds": lambda x: [*chain(*within_speeds(x, 2.0 * x[::-1], np.ones(3)))],
}
MATRICES = {
    "angle": lambda x: [law.products.angle(x[0], x[1])],
    "sine and cosine": lambda x: law.products.sine_and_cosine(x[0]),
    "length": lambda x: [law.length(x)],
    "solve, 2 rows": lambda x: solved(x, 2),
    "solve, 4 rows": lambda x: solved(x, 4),
    "rotation, plane": lambda x: law.nearest_rotation(x[:4].reshape(2, 2)).ravel(),
    "rotation, space": lambda x: law.nearest_rotation(x[:9].reshape(3, 3)).ravel(),
    "most explained": lambda x: law.rotation.most_explained(
        x[:1] * np.eye(4), x[:4], x[4:16].reshape(3, 4)
    ),
}


def solved(x, m):
    """Ĵ is of full rank, or has two equal rows."""
    J = x[: 5 * m].reshape(m, 5)
    w, damping = law.damped_gram_solve(J.dot(J.T), x[:m])
    return [*w, damping]


VALUES = np.array([[1.0, 2.0, 3.0], [-1.0, 0.25, 0.1], [0.0, -0.9, 0.6], [0.6, 0.7, 0.8]])


@pytest.mark.parametrize("name", STEPS)
def test_a_step_on_symbols_is_that_on_numbers(name):
    step, graph = STEPS[name], Graph()
    traced = numpy_function(graph, symbols(np.array(step(inputs(graph, "x", 3)))).tolist())
    values = VALUES
    if name.endswith("finite"):
        values = np.concatenate([VALUES, [[np.nan, 1.0, 2.0], [1.0, -np.inf, 2.0]]])
    for x in values:
        found = [float(np.ravel(each)[0]) for each in traced(x=x[:, np.newaxis])]
        assert_allclose(found, np.array(step(x), dtype=float), rtol=1e-15)


@pytest.mark.parametrize("kind", ["any", "singular", "zero"])
@pytest.mark.parametrize("name", MATRICES)
def test_what_decomposes_on_numbers_is_the_same_on_symbols(name, kind, rng):
    step, graph = MATRICES[name], Graph()
    traced = numpy_function(graph, symbols(np.array(step(inputs(graph, "x", 20)))).tolist())
    for _ in range(20):
        x = rng.normal(size=20)
        if kind == "singular":
            x[5:10] = x[:5]
            x[3:6] = x[:3]
        if kind == "zero":
            if name in ("angle", "rotation, space", "most explained"):
                return  # there is none
            x[:] = 0.0
        found = [float(np.ravel(each)[0]) for each in traced(x=x[:, np.newaxis])]
        expected = np.array(step(x), dtype=float)
        if name.startswith("solve"):
            assert_allclose(found, expected, rtol=1e-6, atol=1e-9 * (1.0 + np.abs(expected).max()))
        elif name != "rotation, space" or kind == "any":
            assert_allclose(found, expected, atol=1e-7)


def test_what_is_left_is_written_down():
    graph = Graph()
    x = inputs(graph, "x", 1)
    leave(False)  # nothing to say on numbers
    assert graph.left is False
    leave(x[0] > 0.0)
    (left,) = numpy_function(graph, symbols([law.select(graph.left, 1.0, 0.0)]).tolist())(
        x=np.array([[2.0, -2.0]])
    )
    assert left.tolist() == [1.0, 0.0]


def test_only_what_is_known_to_hold_is_sure():
    assert surely(True)
    assert surely(np.bool_(True))
    assert not surely(False)
    assert not surely(inputs(Graph(), "x", 1)[0] > 0.0)


@pytest.mark.parametrize("count", [1, 12, 13, 31])  # beyond 12 symbols are a loop
def test_rows_are_folded_alike_on_numbers_and_symbols(count, rng):
    def body(values, a, b):
        total, last = values
        return (total * a + b, a), (total - b, last * a)

    numbers = rng.normal(size=(2, count))
    total, last, rows = 0.7, 0.2, []
    for a, b in numbers.T:
        rows.append((total - b, last * a))
        total, last = total * a + b, a
    for columns in (numbers, inputs(Graph(), "x", (2, count))):
        (end, before), collected = fold(body, (0.7, 0.2), *columns.tolist())
        flat = [end, before, *collected[0], *collected[1]]
        if columns is not numbers:
            flat = numpy_function(columns[0, 0].graph, flat)(x=numbers.ravel())
        expected = [total, last, *np.transpose(rows).ravel()]
        assert_allclose(np.array(flat, dtype=float), expected, rtol=1e-13)
