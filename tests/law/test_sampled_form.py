"""The form of the loop that runs: its rate of torque, and its lemma on signals."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from wrong_loop import closed_loop, terms

from approxjac import law
from approxjac.law import Sine, sampled_form


def setup(name, saturation, seed):
    """A loop away from its target, with all that the form is made of."""
    plant, controller, rng = closed_loop(name, saturation, seed)
    robot = plant.robot
    q, v = rng.uniform(0.3, 1.2, robot.nv), rng.normal(size=robot.nv)
    x_d = plant.sensor.value(q) + rng.uniform(-0.1, 0.1, plant.sensor.m)
    kp, kv, damping = controller.diagonals
    M, dM, J, J_hat, dJ_hat = terms(plant, controller, q)
    D_c, D = (law.dissipation(J_hat, kv, B) for B in (damping, plant.friction + damping))
    e = plant.sensor.value(q) - x_d
    s, slope = controller.saturation.s(e), controller.saturation.ds(e)
    at = {
        "M": M, "dM": dM, "J_e": J, "J_hat": J_hat, "dJ_hat": dJ_hat, "D": D, "D_c": D_c, "s": s,
        "slope": slope, "kp": kp, "kv": kv,
    }  # fmt: skip
    return plant, controller, x_d, q, v, at, rng


def torque(controller, plant, x_d, q, v):
    """The law but for gravity, which is exact."""
    kp, kv, damping = controller.diagonals
    J_hat = controller.task.jacobian(q)
    s = controller.saturation.s(plant.sensor.value(q) - x_d)
    return -J_hat.T @ (kp * s + kv * (J_hat @ v)) - damping * v


@pytest.mark.parametrize("saturation", [law.Linear(), Sine(0.2)])
@pytest.mark.parametrize(("name", "seed"), [("two_link", 0), ("panda", 1)])
def test_the_rate_of_the_torque_is_its_finite_difference(name, saturation, seed):
    plant, controller, x_d, q, v, at, rng = setup(name, saturation, seed)
    w = rng.normal(size=len(v))
    acting = torque(controller, plant, x_d, q, v) + w
    v_dot = plant.dynamics.forward(q, v, acting - plant.friction * v + plant.dynamics.g(q))

    def ahead(t):
        there = q + t * v
        return torque(controller, plant, x_d, there, v + t * v_dot)

    u_dot = (ahead(1e-6) - ahead(-1e-6)) / 2e-6
    names = ("M", "D", "D_c", "J_hat", "dJ_hat", "J_e", "s", "slope", "kp")
    rate = sampled_form.torque_rate(*(at[name] for name in names))
    rest = u_dot - rate.T @ np.concatenate([v, at["s"]]) - rate.U @ w
    bound = sampled_form.torque_curvature(
        *(at[name] for name in ("M", "dM", "D", "D_c", "J_hat", "dJ_hat", "kv"))
    )
    M, D = at["M"], at["D"]
    size = np.sqrt(rest @ np.linalg.solve(D, rest))
    most = bound * np.sqrt(v @ M @ v) * np.sqrt(v @ D @ v)
    assert size <= most * (1.0 + 1e-6)
    # what is quadratic in q̇ is all that is left
    slow = 1e-3
    acting = torque(controller, plant, x_d, q, slow * v) + w
    v_dot = plant.dynamics.forward(
        q, slow * v, acting - slow * plant.friction * v + plant.dynamics.g(q)
    )
    v = slow * v
    u_dot = (ahead(1e-5) - ahead(-1e-5)) / 2e-5
    rest = u_dot - rate.T @ np.concatenate([v, at["s"]]) - rate.U @ w
    assert np.abs(rest).max() <= 1e-4 * np.abs(u_dot).max()


@pytest.mark.parametrize("seed", range(3))
def test_bounds_of_what_turns_hold_in_every_direction(seed):
    _, controller, _, q, _, at, rng = setup("panda", law.Linear(), seed)
    M, D, kv, kp = at["M"], at["D"], at["kv"], at["kp"]
    turn = sampled_form.damping_turn(M, D, at["J_hat"], at["dJ_hat"], kv)
    along = sampled_form.damping_turn(M, D, at["J_hat"], at["dJ_hat"], kv, along=True)
    stiff = sampled_form.stiffness_turn(D, at["dJ_hat"], kp)
    root = np.linalg.inv(np.linalg.cholesky(D))
    for _ in range(50):
        v, s = rng.normal(size=7), rng.normal(size=3)
        there = q + 1e-6 * v
        J_hat = controller.task.jacobian(there)
        changed = law.dissipation(J_hat, kv, np.zeros(7)) - law.dissipation(
            at["J_hat"], kv, np.zeros(7)
        )
        most = np.abs(np.linalg.eigvalsh(root @ changed @ root.T / 1e-6)).max()
        assert most <= turn * np.sqrt(v @ M @ v) * (1.0 + 1e-4)
        p = rng.normal(size=7)
        size = np.linalg.norm(root @ changed @ p) / 1e-6
        assert size <= along * np.sqrt((v @ D @ v) * (p @ M @ p)) * (1.0 + 1e-4)
        pushed = (J_hat - at["J_hat"]).T @ (kp * s) / 1e-6
        size = np.linalg.norm(root @ pushed)
        assert size <= stiff * np.sqrt(v @ D @ v) * np.linalg.norm(s) * (1.0 + 1e-4)


@given(st.integers(0, 10_000), st.floats(0.0, 2.5), st.floats(0.05, 1.0))
def test_the_lemma_on_signals(seed, late, shortest):
    """∫w² ≤ γ²∫u̇² up to every time, of a signal that is sampled at uneven times and acts late."""
    rng = np.random.default_rng(seed)
    fine, n = 1e-3, 6000
    t = fine * np.arange(n)
    u = np.zeros(n)
    for _ in range(4):
        frequency, phase = rng.uniform(0.1, 8.0), rng.uniform(0.0, 6.3)
        u += rng.normal() * (np.sin(frequency * t + phase) - np.sin(phase))
    gaps = rng.uniform(shortest, 1.0, 20)
    samples = np.concatenate([[0.0], np.cumsum(gaps)])
    at = np.searchsorted(samples, t, side="right") - 1
    held = np.interp(samples[at] - late, t, u, left=0.0)
    begun = np.interp(t - late, t, u, left=0.0)
    assert np.abs(begun[t < late]).max(initial=0.0) == 0.0
    acting = held
    error = np.cumsum((acting - u) ** 2) * fine
    rate = np.cumsum(np.gradient(u, fine) ** 2) * fine
    gain = sampled_form.hold_gain(1.0, late)
    assert (error <= gain**2 * rate * (1.0 + 5e-3) + 1e-6).all()


@pytest.mark.parametrize("time_constant", [1e-3, 0.5, 3.0])
@pytest.mark.parametrize("share", [0.05, 0.3, 0.8])
def test_what_a_filter_makes_older_grows_less_than_by_its_bound(time_constant, share):
    """E σe^(rσ) of the ages σ of the filter of differences, with samples of 1 s."""
    a, lag = 1.0 / (1.0 + time_constant), time_constant + 0.5
    rate, fine = share / lag, 200
    ages = (np.arange(fine * int(100.0 * lag)) + 0.5) / fine
    weights = a * (1.0 - a) ** np.floor(ages) / fine
    assert_allclose(weights.sum(), 1.0)
    assert_allclose(weights @ ages, lag, rtol=1e-4)
    grown = weights @ (ages * np.exp(rate * ages))
    assert lag <= grown <= lag * sampled_form.growth(rate, 0.0, lag)


def test_nothing_bounds_what_grows_faster_than_a_filter_forgets():
    assert np.isinf(sampled_form.growth(1.0, 0.1, 1.0))
    assert_allclose(sampled_form.growth(2.0, 0.1), np.exp(0.2))


@pytest.mark.parametrize("has_frames", [False, True])
def test_the_form_is_what_its_integrals_are_made_of(has_frames):
    _, _, _, _, v, at, rng = setup("panda", Sine(0.2), 3)
    kp, D, J_hat, s = at["kp"], at["D"], at["J_hat"], at["s"]
    n, m, alpha = 7, 3, 1.3
    G, dG = law.cross_weight_pinv(J_hat, at["dJ_hat"])
    G, dG = alpha * G, alpha * dG
    N = law.inertial_block(at["M"], at["dM"], at["J_e"], G, dG, s, at["slope"])
    Q = law.decrease_matrix(D, N, at["J_e"], J_hat, G, kp, 500.0 * np.ones(m))
    names = ("M", "D", "D_c", "J_hat")
    multiplier, gain, b, gain_x = 0.4, 1.7e-6, 0.2, 2.3e-4
    w, w_x, z = rng.normal(size=n), rng.normal(size=m), np.concatenate([v, s])
    R, y, frames = np.linalg.inv(D), v + G @ s, None
    if has_frames:
        rate = sampled_form.damping_rate_of_torque(*(at[name] for name in names), kp)
        X, seen = np.array([1.0, 2.0, 3.0]), at["slope"][:, None] * at["J_e"]
        frames, whole = (X, seen, gain_x), np.concatenate([z, w, w_x])
        u_dot = rate.T @ z + rate.U @ w + rate.T_x @ w_x
        expected = y @ (J_hat.T @ (kp * w_x)) + w_x @ (X * w_x)
        expected -= gain_x * (seen @ v) @ (X * (seen @ v))
    else:
        names = (*names, "dJ_hat", "J_e", "s", "slope", "kp")
        rate, whole = sampled_form.torque_rate(*(at[name] for name in names)), None
        whole, u_dot, expected = np.concatenate([z, w]), rate.T @ z + rate.U @ w, 0.0
    expected += z @ Q @ z - y @ w + multiplier * (w @ R @ w)
    expected -= multiplier * (gain * (1.0 + b) * u_dot @ R @ u_dot + (b + b * b) * v @ D @ v)
    F = sampled_form.held_form(Q, G, D, J_hat, kp, rate, multiplier, gain, b, frames)
    assert_allclose(whole @ F @ whole, expected, rtol=1e-10)
    assert_allclose(F, F.T, atol=1e-12)


def test_the_margin_is_that_of_the_whole_form():
    """F − μ diag(D, sym K_pĴG, 0) is only just semidefinite at the margin."""
    _, _, _, _, _, at, _ = setup("panda", law.Linear(), 4)
    kp, kv, D, J_hat, n, m = at["kp"], at["kv"], at["D"], at["J_hat"], 7, 3
    G, dG = law.cross_weight_pinv(J_hat, at["dJ_hat"])
    N = law.inertial_block(at["M"], at["dM"], J_hat, G, dG, 0.0 * at["s"], np.ones(m))
    Q = law.decrease_matrix(D, N, J_hat, J_hat, G, kp, kp + kv)
    rate = sampled_form.torque_rate(
        at["M"], D, at["D_c"], J_hat, at["dJ_hat"], J_hat, 0.0 * at["s"], np.ones(m), kp
    )
    F = sampled_form.held_form(
        Q, G, D, J_hat, kp, rate, 0.5, sampled_form.hold_gain(5e-4, 0.0) ** 2, 0.0
    )
    margin = float(sampled_form.held_margin(F[None], D[None], J_hat[None], G[None], kp)[0])
    Y = np.zeros_like(F)
    Y[:n, :n], Y[n : n + m, n : n + m] = D, law.stiffness_block(J_hat, G, kp)
    least = np.linalg.eigvalsh(F - margin * Y)[0]
    assert np.isfinite(margin)
    assert abs(least) <= 1e-6 * np.abs(F).max()
    assert np.linalg.eigvalsh(F - (margin + 1e-3) * Y)[0] < 0.0


@pytest.mark.parametrize("turns", [-0.8, 0.3, 2.0])
def test_the_curvature_of_one_joint_is_exact(turns):
    """Of one coordinate D_c M^-1 C(q, v)v - dD_c[v]v is a number times v^2, with C = M'/2.

    Both parts have signs: where they cancel the bound is small, where they add up it is large.
    """
    M, dM, J, kv, damping, friction = 1.7, 0.9, 0.6, 3.0, 0.4, 0.2
    D_c = J * kv * J + damping
    D = D_c + friction
    quadratic = 0.5 * D_c * dM / M - 2.0 * kv * J * turns
    found = sampled_form.torque_curvature(
        np.array([[M]]), np.array([[[dM]]]), np.array([[D]]), np.array([[D_c]]),
        np.array([[J]]), np.array([[[turns]]]), np.array([kv]),
    )  # fmt: skip
    # |u|_{1/D} = |quadratic| v^2 / sqrt(D), |v|_M |v|_D = sqrt(M D) v^2
    np.testing.assert_allclose(found, abs(quadratic) / (D * math.sqrt(M)), rtol=1e-9)
