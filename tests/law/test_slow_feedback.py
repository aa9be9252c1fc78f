"""Feedback of what is slow beside what motors stand, and targets that are eased."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.law.test_raised_damping import flow

import approxjac as aj
from approxjac import law
from approxjac.controllers.gains.motors import integral_rate, largest_rate

LATE = aj.Latency(1e-3, torque_delay=1e-3, velocity_filter=5e-3)
DT = LATE.period


def positive(rng, n):
    """A random symmetric matrix, positive definite."""
    A = rng.normal(size=(n, n))
    return A @ A.T + 0.1 * np.eye(n)


def test_the_lyapunov_function_falls_as_stated(rng):
    """Mσ̇ = −K_σσ − Kφ, as with exact parameters: V = σᵀMσ/2 + φᵀKφ/2ω₀."""
    for n in (1, 3, 7):
        slow = law.SlowFeedback(5.0, 0.05, 1.0, 1e-6)
        M, A, most = positive(rng, n), 60.0 * positive(rng, n), rng.uniform(0.5, 50.0, n)
        sigma, phi = rng.normal(size=(2, n))
        K_sigma = np.linalg.inv(np.linalg.inv(A) + np.diag(1.0 / most))
        K = slow.share * (A - K_sigma)
        assert np.linalg.eigvalsh(K).min() > 0.0
        after, K_phi = slow.damping(phi, sigma, A, most)
        assert_allclose(K_phi, K @ phi, atol=1e-9)
        sigma_dot = np.linalg.solve(M, -law.bounded_damping(A, A @ sigma, most) - K_phi)
        phi_dot = (after - phi) / slow.dt
        V_dot = sigma @ M @ sigma_dot + phi @ K @ phi_dot / slow.omega
        assert_allclose(V_dot, -sigma @ K_sigma @ sigma - phi @ K @ phi, rtol=1e-6)


def test_an_error_alone_goes_to_zero_by_its_function(rng):
    """ż = −s(αz) − w: S(α₀z)/α₀ + w²/2ω₀ falls, S the integral of s, with one speed for all."""
    slow = law.SlowFeedback(5.0, 0.05, 1.2, 1e-3)
    for alpha in (0.0, 0.4, 2.0):
        z, w, before = rng.normal(size=3), np.zeros(3), np.inf
        rest = max(slow.alpha - alpha, 0.0)
        for _ in range(8000):
            w_dot = slow.rate(w, z, alpha, 2.0)
            s, _ = law.saturated(alpha * z, 0.0 * z, 2.0)
            z, w = z - slow.dt * (s + w), w + slow.dt * w_dot
            size = np.sqrt(1.0 + 4.0 * rest**2 * (z @ z)) - 1.0
            V = (size / (4.0 * rest) if rest else 0.5 * z @ z) + w @ w / (2.0 * slow.omega)
            assert before + 1e-6 > V
            before = V
        assert np.linalg.norm(z) < 0.02


def slowest_decay(J, M, K, slow, damping, alpha, spring):
    """Rate of the slowest motion [1/s] of a linear joint behind a spring, with a lag."""
    rows = flow(J, M, K, 0.1 * np.sqrt(K * J * M / (J + M)))
    filtered = LATE.velocity_filter

    def step(state):
        seen, v, late, learnt, phi, w = state[4:]
        theta = state[2]
        v = v + DT / (filtered + DT) * ((theta - seen) / DT - v)
        w_dot = slow.rate(np.array([w]), np.array([theta]), alpha, 1e-6)[0] if slow else 0.0
        sigma = v + alpha * theta + w
        torque = -damping * sigma - learnt - M * (alpha * v + w_dot)
        if slow:
            A, B = np.array([[60.0 * M]]), np.array([damping])
            after, held = slow.damping(np.array([phi]), np.array([sigma]), A, B)
            phi, torque = after[0], torque - held[0]
        moved = rows @ np.append(state[:4], late)
        return np.array(
            [*moved, theta, v, torque, learnt + DT * spring * sigma, phi, w + DT * w_dot]
        )

    n = 10
    matrix = np.array([step(each) for each in np.eye(n)]).T
    if not slow:  # without what does not act
        matrix = matrix[: n - 2, : n - 2]
    return -np.log(np.abs(np.linalg.eigvals(matrix)).max()) / DT


@pytest.mark.parametrize("K", [3e3, 1e4, 1e5])
@pytest.mark.parametrize("M", [2.0, 8.0, 18.0])
def test_a_heavy_link_behind_a_light_rotor_settles_in_seconds(M, K):
    """Behind a rotor of 0.05 kg m²: alone, what its motor may damp takes ten seconds and more."""
    J, alone = 0.05, integral_rate(LATE)
    damping = 0.75 * largest_rate(LATE, integral=alone) * J
    alpha = 0.5 * damping / M
    before = slowest_decay(J, M, K, None, damping - alpha * M, alpha, alone * damping)
    total = integral_rate(LATE, slowly=True)
    damping = 0.75 * largest_rate(LATE, integral=total) * J
    spring, alpha = total * damping / M, 0.5 * damping / M
    slow = law.SlowFeedback(
        5.0, min(0.4 * spring / 5.0, 5.0) / 60.0, min(0.2 * spring / 5.0, 1.25), DT
    )
    now = slowest_decay(J, M, K, slow, damping - alpha * M, alpha, 0.4 * total * damping)
    assert 0.0 < before < 0.15
    assert now > 0.4


def test_nothing_acts_slowly_where_joints_are_stiff_or_quick(rng):
    slow, A = law.SlowFeedback(5.0, 0.05, 1.2, DT), positive(rng, 4)
    _, held = slow.damping(rng.normal(size=4), rng.normal(size=4), A, np.full(4, 1e9))
    assert_allclose(held, 0.0, atol=1e-6)
    assert_allclose(slow.rate(np.zeros(3), rng.normal(size=3), 1.2, 1.0), 0.0, atol=1e-12)


@pytest.mark.parametrize("alpha", [0.0, 0.35, 0.8, 2.0])
def test_slowly_an_error_comes_back_by_the_larger_alpha_alone(rng, alpha):
    """Of a small error that stays, αz and w in the end make up max(α, α₀)z."""
    slow, z = law.SlowFeedback(3.0, 0.1, 0.9, 2.5e-3), 1e-6 * rng.normal(size=2)
    w = np.zeros(2)
    for _ in range(2000):
        w = w + slow.dt * slow.rate(w, z, alpha, np.array([3.0, 0.7]))
    assert_allclose(alpha * z + w, max(alpha, 0.9) * z, rtol=1e-6)


def led(memory, eased, path, x, steps, waits=False):
    """Memory, and x_r, ẋ_r and ẍ_r of each step."""
    found = []
    for k in range(steps):
        memory, now = eased.step(memory, x, path(k * eased.dt), 4.0, waits)
        found.append(np.concatenate(now))
    return memory, np.array(found)


def test_a_target_that_jumps_is_approached_as_a_critically_damped_oscillator():
    eased = law.EasedTarget(4.0, 1e-6 * np.ones(2), 1e-4)  # without a limit of speed
    still, begin, goal = np.zeros(2), np.array([0.3, -0.1]), np.array([0.5, 0.2])
    _, found = led(
        eased.start(begin, np.zeros(2)), eased, lambda t: (goal, still, still), begin, 8000
    )
    t = 8.0 * 1e-4 * np.arange(8000)
    exact = goal + np.outer((1.0 + t) * np.exp(-t), begin - goal)
    assert_allclose(found[:, :2], exact, atol=1e-4)
    assert_allclose(found[1:, :2] - found[:-1, :2], 1e-4 * found[:-1, 2:4], atol=2e-7)


def test_it_is_no_faster_than_its_speed_and_follows_a_path_exactly():
    eased = law.EasedTarget(4.0, 1.0 / np.array([0.5, 0.2]), 1e-3)
    still, begin, goal = np.zeros(2), np.zeros(2), np.array([3.0, -2.0])
    _, found = led(
        eased.start(begin, np.zeros(2)), eased, lambda t: (goal, still, still), begin, 30000
    )
    assert (np.abs(found[:, 2:4]).max(axis=0) <= [0.5, 0.2]).all()
    assert_allclose(found[-1, :2], goal, atol=1e-3)

    def path(t):
        s, c = np.sin(2.0 * t), np.cos(2.0 * t)
        return 0.1 * np.array([s, c]), 0.2 * np.array([c, -s]), -0.4 * np.array([s, c])

    _, found = led(eased.start(*path(0.0)[:2]), eased, path, path(0.0)[0], 3000)
    wanted = np.array([np.concatenate(path(1e-3 * k)) for k in range(3000)])
    assert_allclose(found, wanted, atol=2e-3)


def test_it_begins_where_x_is_first_seen_and_rests_while_the_law_waits():
    eased, still = law.EasedTarget(4.0, np.ones(2), 1e-3), np.zeros(2)
    lost, goal, x = np.full(2, np.nan), np.ones(2), np.array([0.2, 0.4])
    memory, found = led(
        eased.start(0.5 * x, still), eased, lambda t: (goal, still, still), lost, 5, True
    )
    assert np.isfinite(memory).all()
    assert_allclose(found[:, :2] - 0.5 * x, 0.0, atol=1e-12)
    memory, found = led(memory, eased, lambda t: (goal, still, still), x, 50)
    assert_allclose(found[0, :2], x)
    assert found[-1, 2] > 0.0
    place = found[-1, :2]
    _, found = led(memory, eased, lambda t: (goal, still, still), x, 50, True)
    assert_allclose(found[:, :2] - place, 0.0, atol=2e-3)


def test_a_first_x_that_is_absurd_is_not_chased():
    eased, still, x = law.EasedTarget(4.0, np.ones(2), 1e-3), np.zeros(2), np.array([0.2, 0.4])
    for lost in (0, 20):  # x may be lost before
        memory, goal = eased.start(x, still), lambda t: (np.ones(2), still, still)
        memory, _ = led(memory, eased, goal, np.full(2, np.nan), lost, True)
        memory, found = led(memory, eased, goal, np.full(2, 1e8), 1)
        _, after = led(memory, eased, goal, x, 4000)
        assert_allclose(found[0, :2], x)
        assert_allclose(after[-1, :2], 1.0, atol=1e-3)
