"""Projection of the adaptation, Eq. (29), onto a box."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose

from approxjac import law

P = 4
LOWER, UPPER = np.full(P, -1.0), np.full(P, 2.0)
boxed = arrays(np.float64, P, elements=st.sampled_from([-1.0, -0.5, 0.0, 1.5, 2.0]))
rates = arrays(np.float64, P, elements=st.floats(-10.0, 10.0))


def test_inside_nothing_changes(rng):
    theta, rate = rng.uniform(-0.9, 1.9, P), rng.normal(size=P)
    assert np.array_equal(law.within_bounds(rate, theta, LOWER, UPPER), rate)


@pytest.mark.parametrize(
    ("theta", "rate", "kept"),
    [
        (-1.0, -3.0, 0.0),
        (-1.0, 3.0, 3.0),
        (2.0, 3.0, 0.0),
        (2.0, -3.0, -3.0),
        (-1.5, -3.0, 0.0),  # a step too far, on sampled control: it comes back, no further out
        (-1.5, 3.0, 3.0),
        (2.5, 3.0, 0.0),
        (2.5, -3.0, -3.0),
        (2.0, 0.0, 0.0),
        (2.0, 1e-9, 0.0),  # however slowly it would lead out
        (-1.0, -1e-9, 0.0),
        (2.0, -1e-9, -1e-9),
        (-1.0, 1e-9, 1e-9),
    ],
)
def test_at_a_bound_only_what_leads_out_is_left_out(theta, rate, kept):
    around = np.array([0.5, theta, 0.5, 0.5])
    given_rate = np.array([7.0, rate, -7.0, 7.0])
    answer = law.within_bounds(given_rate, around, LOWER, UPPER)
    assert_allclose(answer, [7.0, kept, -7.0, 7.0], atol=0)


@given(boxed, rates, boxed, arrays(np.float64, P, elements=st.floats(0.1, 10.0)))
def test_the_potential_of_eq_31_falls_at_least_as_fast(theta_hat, rate, theta, L):
    """−Δθᵀ L⁻¹ dθ̂/dt only becomes smaller, for any θ in the box and any diagonal L."""
    projected = law.within_bounds(rate, theta_hat, LOWER, UPPER)
    error = theta - theta_hat
    assert -error @ (projected / L) <= -error @ (rate / L) + 1e-9
    # no step leads out of the box
    ahead = theta_hat + 1e-6 * projected
    assert ((ahead >= LOWER) & (ahead <= UPPER)).all()
