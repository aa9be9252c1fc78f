"""Large symmetric matrices of symbols, as the code that is generated has them."""

import numpy as np
import pytest

from approxjac import law
from approxjac.codegen.backends.numpy_function import numpy_function
from approxjac.codegen.trace.symbols import Graph, inputs
from approxjac.law.factors import inverse, product, solved


@pytest.mark.parametrize("n", [1, 2, 5, 20])
def test_matrices_are_inverted_and_multiplied_by_loops(n, rng):
    """As ill-conditioned as covariances of lengths and angles are."""
    graph, scale = Graph(), np.geomspace(1.0, 1e-4, n)
    root = rng.normal(size=(n, n)) + 3.0 * np.eye(n)
    A, b = scale[:, None] * (root @ root.T) * scale, rng.normal(size=(n, 3))
    rows, columns = np.triu_indices(n)
    of_A, of_b = inputs(graph, "A", len(rows)), inputs(graph, "b", 3 * n).reshape(n, 3)
    symmetric = np.zeros_like(of_A, shape=(n, n))
    symmetric[rows, columns] = symmetric[columns, rows] = of_A
    terms = inverse(symmetric), solved(symmetric, of_b), product(symmetric, of_b)
    outputs = [number for term in terms for number in np.ravel(term).tolist()]
    found = np.array(numpy_function(graph, outputs)(A=A[rows, columns], b=b.ravel()), dtype=float)
    sizes = np.cumsum([n * n, 3 * n])
    A_inv, x, Ab = np.split(found, sizes)
    units = scale[:, None] * A_inv.reshape(n, n) * scale  # as all entries are of one size then
    np.testing.assert_allclose(units, np.linalg.inv(root @ root.T), rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(A @ x.reshape(n, 3), b, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(Ab.reshape(n, 3), A @ b, rtol=1e-12, atol=1e-14)
    assert len(graph.nodes) < 20 * n * n + 60 * n + 100


def test_a_gain_of_symbols_is_that_of_numbers(rng):
    """With a measurement of several coordinates, and a covariance of numbers or symbols."""
    n, m, graph = 6, 4, Graph()
    root, H = rng.normal(size=(n, n)), rng.normal(size=(m, n))
    P = root @ root.T
    rows, columns = np.triu_indices(n)
    of_P = inputs(graph, "P", len(rows))
    symmetric = np.zeros_like(of_P, shape=(n, n))
    symmetric[rows, columns] = symmetric[columns, rows] = of_P
    K = law.gain(symmetric, H.astype(object).view(type(of_P)), 0.1)
    found = numpy_function(graph, np.ravel(K).tolist())(P=P[rows, columns])
    np.testing.assert_allclose(np.array(found, dtype=float).reshape(n, m), law.gain(P, H, 0.1))


def test_products_without_a_symbol_stay_what_they_are(rng):
    A, b = rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
    np.testing.assert_array_equal(product(A, b), A @ b)
    np.testing.assert_allclose(product(A.astype(object), b).astype(float), A @ b)
