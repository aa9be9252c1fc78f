"""Forward differentiation on a graph, against differences of the functions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from approxjac import law
from approxjac.codegen.backends.numpy_function import numpy_function
from approxjac.codegen.trace.derivatives import rates
from approxjac.codegen.trace.symbols import Graph, inputs, symbols

FUNCTIONS = {
    "arithmetic": lambda x: (x[0] - 2.0 * x[1]) * x[1] / (3.0 + x[0] * x[0]) - x[0],
    "root": lambda x: np.sqrt(x[0] * x[0] + x[1] * x[1]),
    "sines": lambda x: np.sin(3.0 * x[0]) * np.cos(x[1]),
    "tanh": lambda x: np.tanh(x[0] * x[1]),
    "size": lambda x: np.abs(x[0]) * np.abs(x[1]),
    "choice": lambda x: np.where(x[0] < x[1], x[0] * x[1], x[1] / (2.0 + x[0])),
    "angle": lambda x: np.arctan2(x[0], x[1]),
}


def gradient(function, at):
    graph = Graph()
    x = inputs(graph, "x", 2)
    found = symbols(function(x))
    outputs = [rates(found, [(each, 1.0)]).item() for each in x]
    return np.array(numpy_function(graph, outputs)(x=list(at)), dtype=float)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_rates_are_those_of_differences(name, rng):
    function, h = FUNCTIONS[name], 1e-6
    for at in rng.uniform(-2.0, 2.0, (20, 2)):
        steps = h * np.eye(2)
        expected = [(function(at + d) - function(at - d)) / (2.0 * h) for d in steps]
        assert_allclose(gradient(function, at), expected, atol=1e-8)


def test_the_rate_of_a_sine_is_exact():
    for angle in np.linspace(-7.0, 7.0, 50):
        found = gradient(lambda x: np.sin(x[0]), (angle, 0.0))
        assert_allclose(found, [np.cos(angle), 0.0], atol=2e-15)


def test_what_depends_on_nothing_has_no_rate_and_a_loop_has_none_yet():
    graph = Graph()
    x, y = inputs(graph, "x", 2), inputs(graph, "y", 3)
    assert rates(symbols([y[0], 2.0]), [(x[0], 1.0)]).tolist() == [0.0, 0.0]
    (total,) = law.repeat(3, lambda i, v: (v[0] + law.take(y, i) * x[0],), (x[1],))
    with pytest.raises(TypeError, match="loop"):
        rates(symbols([total]), [(x[0], 1.0)])
