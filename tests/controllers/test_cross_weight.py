"""`TorqueLimited(cross_weight=...)`: limits let that V fall which a report certifies."""

import pickle

import numpy as np
import pinocchio as pin
import pytest

import approxjac as aj
from approxjac.codegen.traced_law import require_covered
from approxjac.controllers import CrossWeight
from approxjac.stability.certificates.matrix_form import MatrixForm, best_weights
from approxjac.stability.loop.closed_loop import ClosedLoop

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
DT, FRICTION = 1e-3, 0.7


@pytest.fixture(scope="module")
def loop():
    """A Panda with a tool that its law does not know of, and friction that it does not know."""
    arm = aj.load_robot("panda").with_gravity((0.0, 0.0, 0.0))
    belief, truth = arm.with_object(0.0), arm.with_object(0.2, 0.5, axis="x")
    law = aj.SetpointController(
        aj.PositionTask(belief), aj.Gains((400.0, 300.0, 500.0), (80.0, 60.0, 90.0), damping=2.0)
    )
    plant = aj.Plant(truth, aj.PositionTask(truth), friction=FRICTION)
    return ClosedLoop(law, plant, aj.JointBox.around(arm, Q, 0.3))


@pytest.fixture(scope="module")
def weights(loop):
    """A function of the widest family, with A₂ ≠ 0."""
    samples = loop.draw(80, np.random.default_rng(0))
    found = best_weights(MatrixForm(samples, loop.setting), "wide").weights
    assert np.abs(found.A2).max() > 0.01
    return found


@pytest.fixture(scope="module")
def cross_weight(loop, weights):
    return CrossWeight(weights.A1, weights.A2, loop.setting.B)


def V(loop, weights, q, v, x_d):
    """½q̇ᵀMq̇ + q̇ᵀMGs + Σ wS, without what `CrossWeight` has of it."""
    plant, task = loop.plants[0], loop.controller.task
    M, J_hat, kv = plant.dynamics.M(q), task.jacobian(q), loop.setting.kv
    e = plant.sensor.value(q) - x_d
    D = J_hat.T @ np.diag(kv) @ J_hat + np.diag(loop.setting.B)
    G = np.linalg.pinv(J_hat) @ weights.A1 + np.linalg.inv(D) @ J_hat.T @ np.diag(kv) @ weights.A2
    s = loop.controller.saturation
    return 0.5 * v @ M @ v + v @ M @ G @ s.s(e) + weights.w @ s.S(e)


def V_dot(loop, weights, q, v, tau, x_d, h=1e-6):
    plant = loop.plants[0]
    a = plant.acceleration(q, v, tau)

    def along(t):
        there = pin.integrate(plant.robot.model, q, t * v + 0.5 * t * t * a)
        return V(loop, weights, there, v + t * a, x_d)

    return (along(h) - along(-h)) / (2.0 * h)


def decrease(loop, weights, q, v, x_d):
    """zᵀQz, by the matrix form."""
    at = loop.samples_at(np.zeros(1, int), q[None], x_d[None])
    Q_matrix, _ = MatrixForm(at, loop.setting)._decrease(weights)
    z = np.concatenate([v, at.s[0]])
    return z @ Q_matrix[0] @ z


def random_state(loop, rng):
    plant = loop.plants[0]
    q = loop.region.sample(1, rng)[0]
    x = plant.sensor.value(q)
    return aj.Measurement(0.0, q, 0.4 * rng.normal(size=7), x), x + 0.2 * rng.normal(size=3)


def test_the_reports_own_V_falls_where_the_proof_is_kept(loop, weights, cross_weight):
    """And with the law's own α it would not, where it says the same."""
    rng = np.random.default_rng(1)
    limits = aj.Limits(effort=0.45 * loop.controller.task.robot.effort_limits)
    ours = aj.TorqueLimited(loop.controller, limits, cross_weight=cross_weight)
    other = aj.TorqueLimited(loop.controller, limits)
    kept, given_up, broken = 0, 0, 0
    for _ in range(150):
        measurement, x_d = random_state(loop, rng)
        q, v = measurement.q, measurement.v
        W = decrease(loop, weights, q, v, x_d)
        for limiter in (ours, other):
            answer = limiter.step(limiter.initial_state(measurement), measurement, x_d, DT)[1]
            if answer.limit_status is aj.LimitStatus.FREE:
                continue
            rate = V_dot(loop, weights, q, v, answer.torque, x_d)
            if limiter is ours:  # and where it is given up, V̇ has what it says
                assert rate <= -W + answer.slack + 1e-5 * (1.0 + abs(W))
                kept += answer.limit_status is aj.LimitStatus.PROOF_KEPT
                given_up += answer.limit_status is aj.LimitStatus.PROOF_GIVEN_UP
            elif answer.limit_status is aj.LimitStatus.PROOF_KEPT:
                broken += rate > -W + 1e-2
    assert kept > 20
    assert given_up > 5
    assert broken > 2


def test_V_never_rises_along_a_run_whose_proof_is_kept(loop, weights, cross_weight):
    limits = aj.Limits(effort=0.45 * loop.controller.task.robot.effort_limits)
    limiter = aj.TorqueLimited(loop.controller, limits, cross_weight=cross_weight, dt=2e-4)
    x_d = loop.plants[0].sensor.value(Q + [0.1, -0.1, 0.1, 0.1, 0.0, 0.1, 0.0])
    run = aj.simulate(loop.plants[0], limiter, target=x_d, q0=Q, duration=0.3, dt=2e-4)
    limited = run.limit_status == aj.LimitStatus.PROOF_KEPT
    assert limited.sum() > 10
    assert not (run.limit_status == aj.LimitStatus.PROOF_GIVEN_UP).any()
    values = [V(loop, weights, q, v, x_d) for q, v in zip(run.q, run.v, strict=True)]
    assert (np.diff(values) <= 1e-9 * values[0]).all()
    assert values[-1] < 0.2 * values[0]


def test_the_papers_cross_weight_is_that_of_alpha(loop):
    rng, law = np.random.default_rng(2), loop.controller
    limits = aj.Limits(effort=0.2 * law.task.robot.effort_limits)
    one = CrossWeight(0.7 * np.eye(3), np.zeros((3, 3)), loop.setting.B)
    pair = [
        aj.TorqueLimited(law, limits, **how)
        for how in ({"cross_weight": 0.7}, {"cross_weight": one})
    ]
    for _ in range(20):
        measurement, x_d = random_state(loop, rng)
        first, second = (
            each.step(each.initial_state(measurement), measurement, x_d, DT)[1] for each in pair
        )
        np.testing.assert_allclose(first.torque, second.torque, rtol=1e-9)
        assert first.limit_status is second.limit_status


def test_it_survives_a_copy_and_is_told(loop, cross_weight):
    limiter = aj.TorqueLimited(loop.controller, cross_weight=cross_weight)
    again = pickle.loads(pickle.dumps(limiter))
    assert again.cross_weight.is_like(cross_weight)
    assert "CrossWeight(Ĵ⁺A₁ + D⁻¹ĴᵀK_vA₂" in repr(limiter)
    assert "CrossWeight" not in repr(aj.TorqueLimited(loop.controller))


def test_without_x_y_is_the_velocity(loop, cross_weight):
    law, v = loop.controller, np.ones(7)
    lost = aj.Measurement(0.0, Q, v, np.full(3, np.nan))
    answer = law.step(law.initial_state(lost), lost, np.zeros(3), DT)[1]
    assert cross_weight.passive_output(law, answer, v) is v


def test_bad_ones_are_named(loop, cross_weight):
    law = loop.controller
    with pytest.raises(aj.InvalidInputError, match="cross_weight must be a finite number > 0"):
        aj.TorqueLimited(law, cross_weight="certified")
    wrong = CrossWeight(np.eye(2), np.eye(2), np.ones(7))
    with pytest.raises(aj.InvalidInputError, match=r"A1 of cross_weight must have shape \(3, 3\)"):
        aj.TorqueLimited(law, cross_weight=wrong)
    with pytest.raises(aj.InvalidInputError, match="damping of cross_weight must be >= 0"):
        aj.TorqueLimited(law, cross_weight=CrossWeight(np.eye(3), np.eye(3), -np.ones(7)))
    with pytest.raises(aj.InvalidInputError, match="controller must be a SetpointController"):
        aj.TorqueLimited(aj.TrackingController(law.task), cross_weight=cross_weight)
    learns = aj.SetpointController(
        law.task,
        law.gains,
        gravity=aj.AdaptiveGravity(
            law.task.robot.with_gravity((0.0, 0.0, -9.81)), L=0.1, alpha=1.0
        ),
    )
    with pytest.raises(aj.InvalidInputError, match="that with which gravity is learnt"):
        aj.TorqueLimited(learns, cross_weight=cross_weight)
    same = CrossWeight(np.eye(3), np.zeros((3, 3)), np.ones(7))
    assert aj.TorqueLimited(learns, cross_weight=same).cross_weight.is_like(same)
    limits = aj.Limits(effort=20.0)
    with pytest.raises(aj.InvalidInputError, match="cross_weight must be None to make code"):
        require_covered(aj.TorqueLimited(law, limits, cross_weight=cross_weight))


def test_its_G_is_that_of_the_matrix_form(loop, weights, cross_weight):
    at = loop.draw(5, np.random.default_rng(3))
    G = MatrixForm(at, loop.setting).cross_weight(weights)
    law = loop.controller
    for k, q in enumerate(at.q):
        measurement = aj.Measurement(0.0, q, np.zeros(7), loop.plants[0].sensor.value(q))
        answer = law.step(law.initial_state(measurement), measurement, at.x_d[k], DT)[1]
        y = cross_weight.passive_output(law, answer, np.zeros(7))
        np.testing.assert_allclose(y, G[k] @ law.saturation.s(at.e[k]), atol=1e-12)
