"""The conditions of Theorem 1 that have c₀, c₁ and gains that differ: eqs. (14), (22) and (24)."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from approxjac import law

KP, KV = np.array([5.0, 3.0, 4.0]), np.array([6.0, 8.0, 7.0])


def test_eq_14_holds_below_the_largest_alpha_and_not_above():
    c_bar, lambda_m = 0.5, 0.2
    alpha = law.largest_alpha(KV, c_bar, lambda_m)
    assert type(alpha) is float
    assert alpha == 15.0  # of the weakest gain, 6 · 0.5 / 0.2
    assert (KV * c_bar - 0.99 * alpha * lambda_m > 0.0).all()
    assert (KV * c_bar - 1.01 * alpha * lambda_m).min() < 0.0


@pytest.mark.parametrize(("alpha", "lambda1", "c0", "c1"), [(0.5, 0.3, 0.7, 0.9), (2, 0.1, 0, 0)])
def test_eq_22_is_an_equality_at_the_p_that_is_allowed(alpha, lambda1, c0, c1):
    """Of W ≥ l₁k abs(q̇)² + l₂k abs(s)², what inertia and the mismatch take is all there was."""
    velocity, position = law.allowed_p(alpha, KP, KV, lambda1, c0, c1)
    largest = 5.0 + alpha * 8.0  # of K_p + αK_v; each p takes half of it from l₁ and from l₂
    assert_allclose(8.0 * lambda1 - 0.5 * velocity * largest, alpha * c0)
    assert_allclose(alpha * 3.0 - 0.5 * position * largest, alpha * c1)


@given(
    st.lists(st.floats(1.0, 1e4), min_size=2, max_size=2),
    st.lists(st.floats(1.0, 1e4), min_size=2, max_size=2),
    st.floats(1e-4, 10.0),
    st.floats(0.0, 1e3),
    st.floats(0.0, 1e3),
    st.floats(1e-3, 1e4),
)
def test_best_alpha_allows_the_largest_p(kp, kv, lambda1, c0, c1, alpha_max):
    """Against a scan over α: nowhere do both bounds of (22) allow more."""
    kp, kv = np.array(kp), np.array(kv)
    alpha = law.best_alpha(kp, kv, lambda1, c0, c1, alpha_max)
    best = min(law.allowed_p(alpha, kp, kv, lambda1, c0, c1))
    scan = [
        min(law.allowed_p(a, kp, kv, lambda1, c0, c1))
        for a in np.geomspace(1e-6 * alpha_max, alpha_max, 700)
    ]
    if best > 0.0:
        assert max(scan) <= best * (1.0 + 1e-9)
        assert max(scan) >= 0.98 * best or alpha < 2e-6 * alpha_max
    else:
        assert max(scan) <= 0.0


def test_large_gains_give_eq_24():
    """With c₀ = c₁ = 0 and equal gains the crossing of (22) is that of (23), eq. (24)."""
    lambda2, kp, kv = 0.04, np.full(3, 300.0), np.full(3, 100.0)
    alpha = law.best_alpha(kp, kv, lambda2, 0.0, 0.0, math.inf)
    assert_allclose(alpha, lambda2 * 100.0 / 300.0)
    crossing = law.allowed_p_at_crossing(alpha, lambda2)
    assert_allclose(law.allowed_p(alpha, kp, kv, lambda2, 0.0, 0.0), [crossing, crossing])


def test_best_alpha_is_where_the_bounds_cross_or_the_largest():
    lambda1, c0, c1 = 0.3, 0.7, 0.9
    alpha = law.best_alpha(KP, KV, lambda1, c0, c1, math.inf)
    assert_allclose(*law.allowed_p(alpha, KP, KV, lambda1, c0, c1))
    assert law.best_alpha(KP, KV, lambda1, c0, c1, 0.5 * alpha) == 0.5 * alpha
    # where c₁ takes more than k_p + c₀, the bounds do not cross: the second is always the lower
    for c1 in (4.0, 9.0):
        assert law.best_alpha(KP, KV, lambda1, 1.0, c1, 7.0) == 7.0


@pytest.mark.parametrize("lambda2", [1e-6, 0.04, 1.0, 9.0])
def test_eq_24_is_eq_23_where_its_curves_cross(lambda2):
    for alpha in (0.1, 2.0):
        told = law.allowed_p_at_crossing(alpha, lambda2)
        assert_allclose(told, law.allowed_p_position(np.array([lambda2 / alpha]), alpha)[0])


def test_without_damping_no_p_is_allowed():
    assert law.allowed_p_at_crossing(0.0, 0.0) == law.allowed_p_at_crossing(1.0, 0.0) == 0.0
    assert law.largest_allowed_p(0.0) == 0.0
