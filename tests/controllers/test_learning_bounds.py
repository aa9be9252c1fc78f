"""When gravity is learnt and when not, and that no bound of what is learnt is passed."""

import functools

import numpy as np
import pytest
from heavy_arms import HeavyArm
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac import Status
from approxjac.robots import Dynamics, GravityRegressor


@functools.cache
def heavy(name):
    return HeavyArm(name)


@pytest.fixture(params=["panda", "ur5", "two_link", "three_joint"])
def arm(request):
    return heavy(request.param)


def seen(arm, q=None, v=None, x=None):
    q = arm.q if q is None else q
    v = np.zeros(len(q)) if v is None else v
    return aj.Measurement(0.0, q, v, arm.sensor.value(q) if x is None else x)


# -- statuses -------------------------------------------------------------------------------------


def test_what_is_learnt_rests_where_there_is_nothing_to_learn_from(arm):
    """Lost, saturated, out of reach: each with its status, and θ̂ as it was."""
    limits = np.abs(Dynamics(arm.belief).g(arm.q)) + 2.0
    law = aj.SetpointController(
        arm.task, arm.gains, gravity=aj.AdaptiveGravity(
            arm.belief, L=0.05, alpha=0.5, torque_limits=limits
        ),
    )  # fmt: skip
    now = seen(arm, v=2e-3 * np.cos(np.arange(arm.bare.nv)))
    state = law.begin(now)
    usual = law.evaluate(state, now, now.x + 1e-4)
    assert usual.status is Status.OK
    assert (usual.state_rate != 0.0).any()
    for lost in (np.nan * now.x, np.where(np.arange(arm.task.m) == 0, np.inf, now.x)):
        answer = law.evaluate(state, now._replace(x=lost), now.x)
        assert answer.status is Status.MEASUREMENT_LOST
        assert_array_equal(answer.state_rate, 0.0)
    saturated = 0
    for e in (*np.eye(arm.task.m), *-np.eye(arm.task.m)):
        answer = law.evaluate(state, now, now.x + 0.2 * e)
        beyond = np.abs(answer.torque) > limits
        if answer.status is Status.TORQUE_SATURATED:
            assert beyond.any()
            assert_array_equal(answer.state_rate, 0.0)
            saturated += 1
        else:
            assert answer.status is Status.OUT_OF_REACH or not beyond.any()
    assert saturated > 1
    loose = arm.learning  # without such limits
    far = loose.evaluate(state, now, now.x + 50.0)
    assert far.status is Status.OUT_OF_REACH
    assert_array_equal(far.state_rate, 0.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_one_torque_beyond_its_limit_to_either_side_is_saturated(side):
    """A joint about a vertical axis, which gravity does not pull at."""
    arm = heavy("three_joint")
    limits = np.array([3.0, 500.0, 500.0])
    gravity = aj.AdaptiveGravity(arm.belief, L=0.05, alpha=0.5, torque_limits=limits)
    law = aj.SetpointController(arm.task, arm.gains, gravity=gravity)
    turn = arm.task.jacobian(arm.q)[:, 0]
    now = seen(arm)
    for share, saturated in ((0.99, False), (1.01, True)):
        # along the way of the column alone: τ₀ = k_p |J₀|² · size
        x_d = now.x + side * share * 3.0 / arm.kp / (turn @ turn) * turn
        answer = law.evaluate(law.begin(now), now, x_d)
        assert_allclose(answer.torque[0], side * share * 3.0, rtol=1e-6)
        assert (answer.status is Status.TORQUE_SATURATED) == saturated
        assert answer.state_rate.any() != saturated


def test_near_a_singular_pose_gravity_is_learnt_all_the_same():
    arm = heavy("two_link")
    q, v = np.array([0.3, 0.005]), np.array([0.2, -0.1])
    now = seen(arm, q, v)
    answer = arm.learning.evaluate(arm.theta, now, now.x - 0.01)
    assert answer.status is Status.NEAR_SINGULAR
    assert (answer.state_rate != 0.0).any()
    assert np.isfinite(answer.state_rate).all()


@pytest.mark.parametrize("side", [1.0, pytest.param(-1.0, marks=pytest.mark.study)])
def test_a_joint_at_its_torque_to_either_side_counts_as_locked(side):
    """One joint is held back by its speed, another one asks for nearly all that its motor has.

    Learning is that of the arm without both: y = q̇ + α(ĴP)⁺e of what is free.
    """
    arm, rng, compared = heavy("ur5"), np.random.default_rng(7), 0
    n, L, alpha, Z = 6, 0.05, 0.5, GravityRegressor(arm.belief).Z
    for _ in range(150):
        if compared > 2:
            break
        q, v = arm.q + 0.1 * rng.normal(size=n), 0.05 * rng.normal(size=n)
        now = seen(arm, q, v)
        x_d = now.x + 0.05 * rng.normal(size=3)
        wanted = arm.learning.evaluate(arm.theta, now, x_d).torque
        i = int((side * wanted).argmax())
        if side * wanted[i] < 1.0:
            continue
        effort = 3.0 * np.abs(wanted) + 20.0
        effort[i] = side * wanted[i] / 0.995
        velocity = np.full(n, 30.0)
        j = int(rng.choice(np.setdiff1d(np.arange(n), [i])))
        velocity[j] = abs(v[j]) / 0.99
        limits = aj.Limits(effort=effort, velocity=velocity)
        limited = aj.TorqueLimited(arm.learning, limits, dt=2e-3)
        state = limited.initial_state(now)
        state[: len(arm.theta)] = arm.theta
        after, answer = limited.step(state, now, x_d, 2e-3)
        if answer.limit_status is not aj.LimitStatus.PROOF_GIVEN_UP:
            continue
        locked = np.abs(answer.torque) > 0.98 * effort
        if not locked[i] or (np.abs(wanted) > effort).any():
            continue
        locked[j] = True
        J_free = answer.J_hat * ~locked
        if np.linalg.cond(J_free) > 20.0:
            continue  # Ĵ⁺ is damped there
        compared += 1
        y = v * ~locked + alpha * np.linalg.pinv(J_free) @ (now.x - x_d)
        p = len(arm.theta)
        assert_allclose(after[:p] - arm.theta, -2e-3 * L * Z(q).T @ y, rtol=1e-6, atol=1e-12)
    assert compared > 2


@pytest.mark.parametrize("proof", [True, False])
def test_where_x_is_lost_no_joint_learns_whatever_is_limited(proof):
    """Not those that are at no limit either: there is no e to learn from."""
    arm = heavy("ur5")
    effort = 2.0 * np.abs(Dynamics(arm.belief).g(arm.q)) + 200.0
    limits = aj.Limits(effort=effort, velocity=0.5)
    gravity = aj.AdaptiveGravity(arm.belief, L=0.05, alpha=0.5, torque_limits=np.inf)
    gentle = aj.SetpointController(arm.task, aj.Gains(100.0, 1.0, 0.5), gravity=gravity)
    limited = aj.TorqueLimited(gentle, limits, proof=proof)
    v = np.array([0.01, 0.52, -0.01, 0.01, 0.02, 0.0])  # one is too fast
    now = seen(arm, v=v, x=np.full(3, np.nan))
    state = limited.initial_state(now)
    p = len(arm.theta)
    state[:p] = arm.theta
    after, answer = limited.step(state, now, arm.sensor.value(arm.q), 1e-3)
    assert answer.status is Status.MEASUREMENT_LOST
    assert answer.limit_status is aj.LimitStatus.LIMITED
    assert_array_equal(after[:p], state[:p])


# -- bounds ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["panda", "ur5", "three_joint"])
def test_bounds_are_around_what_is_believed_and_what_one_motor_can_hold(name):
    """By default: the torque that a parameter alone makes, RMS, is what the first motor has."""
    arm = heavy(name)
    law = aj.SetpointController(arm.task, gravity=aj.AdaptiveGravity(arm.belief))
    lower, upper = law.adaptation.bounds
    regressor = GravityRegressor(arm.belief)
    assert_allclose(0.5 * (lower + upper)[: regressor.p], regressor.theta, atol=1e-9)
    assert_allclose(0.5 * (lower + upper)[regressor.p :], 0.0, atol=1e-12)
    width, rng = 0.5 * (upper - lower)[: regressor.p], np.random.default_rng(5)
    drawn = []
    while len(drawn) < 300:
        q = arm.belief.random_configuration(rng)
        values = np.linalg.svd(arm.task.jacobian(q), compute_uv=False)
        if values[-1] > 0.05 * values[0]:
            drawn.append(regressor.Z(q))
    usual = np.sqrt(np.mean(np.square(drawn), axis=0))
    share = (usual * width / arm.belief.effort_limits[:, None]).max(axis=0)
    assert_allclose(share, 1.0, rtol=0.25)
    assert_allclose(0.5 * (upper - lower)[-arm.bare.nv :], arm.belief.effort_limits)


def test_at_its_bounds_a_parameter_only_moves_inwards(arm):
    """θ̂ at a corner of its box: the sign of each rate, and V's part of it falls no slower."""
    theta = arm.theta
    bounds = theta - 0.2, theta + 0.3
    gravity = aj.AdaptiveGravity(
        arm.belief, L=0.05, alpha=0.5, theta0=theta, bounds=bounds, torque_limits=np.inf
    )
    law = aj.SetpointController(arm.task, arm.gains, gravity=gravity)
    rng, stopped, free = np.random.default_rng(2), 0, 0
    for _ in range(40):
        side = rng.choice([-1, 0, 1], len(theta))
        state = np.where(side < 0, bounds[0], np.where(side > 0, bounds[1], theta + 0.01))
        q = arm.q + 0.2 * rng.normal(size=arm.bare.nv)
        now = seen(arm, q, rng.normal(size=arm.bare.nv))
        x_d = now.x + 0.02 * rng.normal(size=arm.task.m)
        rate = law.evaluate(state, now, x_d).state_rate
        raw = arm.learning.evaluate(state, now, x_d).state_rate
        outward = raw * side > 0.0
        # of a diagonal L each parameter on its own
        assert_allclose(rate, np.where(outward, 0.0, raw), atol=1e-12)
        assert (theta - state) @ (rate - raw) >= -1e-12
        stopped, free = stopped + outward.sum(), free + (raw * side < 0.0).sum()
        after, _ = law.step(state, now, x_d, 1e-3)
        assert_allclose(after - state, 1e-3 * rate, atol=1e-12)
    assert stopped > 10
    assert free > 10


@pytest.mark.parametrize("name", ["panda", "ur5", "three_joint"])
def test_what_is_learnt_asks_for_no_more_than_the_motors_have(name):
    """Where |Yθ̂| of a joint is beyond its motor, to either side, it does not grow.

    And V's part of it falls no slower than without: the truth can be held.
    """
    arm = heavy(name)
    law = aj.SetpointController(arm.task, gravity=aj.AdaptiveGravity(arm.belief))
    limited = aj.TorqueLimited(law, aj.Limits(effort=arm.belief.effort_limits))
    learning, effort, n = law.adaptation, arm.belief.effort_limits, arm.bare.nv
    lower, upper = learning.bounds
    true = np.concatenate([arm.theta, np.zeros(len(learning.theta0) - len(arm.theta))])
    assert ((lower < true) & (true < upper)).all()
    rng, seen_sides = np.random.default_rng(4), {-1.0: 0, 1.0: 0}
    Z = GravityRegressor(arm.belief).Z
    for _ in range(250):
        if min(seen_sides.values()) > 8:
            break
        q = arm.belief.random_configuration(rng)
        now = seen(arm, q, 0.5 * rng.normal(size=n))
        J_hat = arm.task.jacobian(q)
        Y = np.concatenate([Z(q), J_hat.T, np.eye(n)], axis=1)
        if (np.abs(Y @ true) > effort).any():
            continue  # which nobody can hold
        state = true.copy()
        i, side = rng.integers(n), rng.choice([-1.0, 1.0])
        state[-n + i] = side * 0.98 * effort[i]  # a constant torque of almost all that it has
        g = Y @ state
        beyond = np.abs(g) > effort
        if not beyond.any():
            continue
        after, answer = limited.step(state, now, now.x + 0.02 * rng.normal(size=arm.task.m), 1e-3)
        if answer.limit_status not in (aj.LimitStatus.FREE, aj.LimitStatus.PROOF_KEPT):
            continue
        growing = np.sign(g) * (Y @ (after - state))
        assert (growing[beyond] <= 1e-9 * (1.0 + np.abs(growing).max())).all()
        for each in np.sign(g[beyond]):
            seen_sides[each] += 1
    assert min(seen_sides.values()) > 3


@pytest.mark.parametrize("name", ["panda", pytest.param("three_joint", marks=pytest.mark.study)])
def test_a_run_out_of_reach_winds_nothing_up(name):
    """A target that is far away, with limits: what is learnt stays within its bounds."""
    arm = heavy(name)
    law = aj.SetpointController(arm.task, gravity=aj.AdaptiveGravity(arm.belief))
    limited = aj.TorqueLimited(law, aj.Limits.of(arm.belief))
    lower, upper = law.adaptation.bounds
    x_d = arm.sensor.value(arm.q) + np.array([0.25, -0.1, -0.15])
    run = aj.simulate(arm.plant, limited, x_d, arm.q, 0.5, dt=1e-3, record_every=5e-3)
    learnt = law.learnt(run.state[:, : len(lower)])
    slack = 1e-3 * (upper - lower)
    assert ((learnt >= lower - slack) & (learnt <= upper + slack)).all()
    assert np.ptp(learnt, axis=0).max() > 1e-3
