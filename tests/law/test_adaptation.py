"""Projection of the adaptation, Eq. (29), onto a box."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac import law

P = 4
LOWER, UPPER = np.full(P, -1.0), np.full(P, 2.0)
boxed = arrays(np.float64, P, elements=st.sampled_from([-1.0, -0.5, 0.0, 1.5, 2.0]))
rates = arrays(np.float64, P, elements=st.floats(-10.0, 10.0))
diagonals = arrays(np.float64, P, elements=st.floats(0.1, 10.0))
roots = arrays(np.float64, (P, P), elements=st.floats(-1.0, 1.0))


@st.composite
def gains(draw):
    """L, a diagonal or a matrix."""
    if draw(st.booleans()):
        return draw(diagonals)
    root = draw(roots)
    return root @ root.T + 0.2 * np.eye(P)


@given(rates, arrays(np.float64, P, elements=st.floats(-0.99, 1.99)), gains())
def test_inside_nothing_changes(rate, theta, L):
    assert np.array_equal(law.within_bounds(rate, theta, LOWER, UPPER, L), rate)


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
    L = np.array([1.0, 2.0, 0.5, 3.0])
    for metric in (L, np.diag(L)):
        answer = law.within_bounds(given_rate, around, LOWER, UPPER, metric)
        assert_allclose(answer, [7.0, kept, -7.0, 7.0], atol=1e-20)


@given(boxed, rates, boxed, gains())
def test_the_potential_of_eq_31_falls_at_least_as_fast(theta_hat, rate, theta, L):
    """−Δθᵀ L⁻¹ dθ̂/dt only becomes smaller, for any θ in the box and any L."""
    given_rate = rate.copy()
    projected = law.within_bounds(rate, theta_hat, LOWER, UPPER, L)
    assert np.array_equal(rate, given_rate)
    error, L = theta - theta_hat, np.diag(L) if L.ndim == 1 else L
    assert error @ np.linalg.solve(L, projected - rate) >= -1e-9
    # no step leads out of the box
    ahead, round_off = theta_hat + 1e-6 * projected, 1e-16 * np.abs(rate).max()
    assert ((ahead >= LOWER - round_off) & (ahead <= UPPER + round_off)).all()


@given(boxed, rates, gains())
def test_it_changes_a_rate_no_more_than_needed(theta_hat, rate, L):
    """It is the rate nearest in the metric L⁻¹ of those that do not lead out."""
    projected = law.within_bounds(rate, theta_hat, LOWER, UPPER, L)
    change = np.linalg.solve(np.diag(L) if L.ndim == 1 else L, projected - rate)
    at = [theta_hat <= LOWER, theta_hat >= UPPER]
    assert np.abs(change[~at[0] & ~at[1]]).max(initial=0.0) <= 1e-9
    assert (change[at[0]] >= -1e-9).all()
    assert (change[at[1]] <= 1e-9).all()
    assert np.abs(change * projected).max() <= 1e-9 * (1.0 + rate @ rate)


def test_many_bounds_at_once_are_kept_with_what_is_learnt_with_by_default(panda, rng):
    task = aj.PositionTask(panda)
    L = aj.SetpointController(task, gravity=aj.AdaptiveGravity(panda)).adaptation.L
    size, one = np.sqrt(np.diag(L)), np.ones(len(L))
    for _ in range(200):
        rate, at = size * rng.normal(size=len(L)), rng.integers(-1, 2, len(L))
        projected = law.within_bounds(rate, at.astype(float), -one, one, L)
        assert (at * projected / size).max() <= 1e-10


@given(
    boxed, rates, boxed, gains(), arrays(np.float64, (2, P), elements=st.floats(-1.0, 1.0)),
    st.booleans(),
)  # fmt: skip
def test_further_bounds_are_kept_and_the_potential_falls(
    theta_hat, rate, theta, L, normals, depend
):
    """Of half-spaces that θ lies in and θ̂ is at or beyond, beside the box; also dependent ones."""
    if depend:
        normals = np.concatenate([np.eye(P)[:2], normals, normals[:1] + normals[1:], normals[:1]])
    beyond = normals @ (theta_hat - theta) >= 0.0  # a half-space through θ̂ has θ on its inside
    outward = normals[beyond & (np.abs(normals).max(axis=1) > 0.1)]
    projected = law.within_bounds(rate, theta_hat, LOWER, UPPER, L, outward)
    error, L = theta - theta_hat, np.diag(L) if L.ndim == 1 else L
    assert error @ np.linalg.solve(L, projected - rate) >= -1e-7
    assert projected @ np.linalg.solve(L, projected) <= (1 + 1e-9) * rate @ np.linalg.solve(L, rate)
    assert (outward @ projected <= 1e-7).all()
    assert (projected[theta_hat <= LOWER] >= 0.0).all()
    assert (projected[theta_hat >= UPPER] <= 0.0).all()


@pytest.mark.parametrize("is_full", [False, True])
def test_sweeps_end_where_the_active_set_does(is_full, rng):
    """Random rates, bounds and motors, at which some of each are reached."""
    ended = 0
    for _ in range(200):
        P, n = 6, 3
        A = rng.normal(size=(P, P))
        L = A @ A.T + np.eye(P) if is_full else rng.uniform(0.1, 2.0, P)
        theta, Y = rng.normal(size=P), rng.normal(size=(n, P))
        lower, upper = theta - rng.uniform(0.1, 1.0, P), theta + rng.uniform(0.1, 1.0, P)
        lower = np.where(rng.random(P) < 0.2, theta, lower)
        upper = np.where((rng.random(P) < 0.2) & (lower < theta), theta, upper)
        g = Y @ theta
        motors = np.where(rng.random(n) < 0.3, 0.5, 2.0) * np.abs(g)
        rate = law.theta_hat_rate(L, Y, rng.normal(size=n))
        beyond = np.abs(g) > motors
        outward = np.sign(g[beyond])[:, None] * Y[beyond] if beyond.any() else None
        expected = law.within_bounds(rate, theta, lower, upper, L, outward)
        found, unfinished = law.swept_within_bounds(rate, theta, (lower, upper), L, Y, g, motors)
        if not unfinished:
            ended += 1
            scale = 1.0 + np.abs(rate).max()
            np.testing.assert_allclose(found / scale, expected / scale, rtol=0, atol=1e-11)
    assert ended > 100
