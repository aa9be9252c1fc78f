"""A report of a controller within limits: where they act, and what is certified then."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

import approxjac as aj
from approxjac.formatting import plain
from approxjac.stability.certificates.certificate import sampled_test
from approxjac.stability.certificates.limit_cost import limit_cost
from approxjac.stability.certificates.matrix_form import Weights
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.report.report import of_limits

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


@pytest.fixture(scope="module")
def arm():
    return aj.load_robot("panda").with_gravity((0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def tools(arm):
    return aj.Uncertainty(arm, object_length=(0.0, 0.2), object_mass=(0.0, 0.5), object_axis="x")


@pytest.fixture(scope="module")
def law(arm, tools):
    gains = aj.Gains(kp=400.0, kv=80.0, damping=5.0)
    return aj.SetpointController(tools.believed_task(), gains, gravity=aj.NoGravity(arm))


@pytest.fixture(scope="module")
def box(arm):
    return aj.JointBox.around(arm, Q, 0.15)


@pytest.fixture(scope="module")
def report(law, tools, box):
    return aj.Study(law, tools, box).report(60)


@pytest.fixture(scope="module")
def kept(report, law, arm, tools, box):
    limits = aj.Limits(effort=0.5 * arm.effort_limits)
    limiter = aj.TorqueLimited(law, limits)
    return aj.Study(limiter, tools, box).report(60)


@pytest.mark.study
def test_certified_are_fewer_starts(report, kept):
    assert report.limits is None
    assert report.passed
    assert kept.passed
    assert 0.0 < kept.test.level == kept.limits.level < 0.1 * report.test.level
    assert (kept.test.certified_error < 0.5 * report.test.certified_error).all()
    at_rest, certified, acting, _ = rows = of_limits(kept.limits)
    assert acting.verdict == kept.limits.verdict == "another V"
    assert at_rest.figures["free"]["m"] == pytest.approx(0.066, abs=5e-4)
    assert certified.figures["level"] == kept.limits.level
    assert all(row.text for row in rows)


@pytest.mark.study
def test_without_it_nothing_is_proven_where_limits_act(law, arm, tools, box, report):
    limiter = aj.TorqueLimited(law, aj.Limits(effort=0.5 * arm.effort_limits))
    cost = limit_cost(report.loop, limiter, report.samples, report.test, None)
    assert cost.verdict == "another V"
    limiter = aj.TorqueLimited(law, aj.Limits(effort=0.5 * arm.effort_limits), proof=False)
    cost = limit_cost(report.loop, limiter, report.samples, report.test, None)
    assert cost.verdict == "no proof"


def test_from_where_torques_are_clipped_is_sharp(law, arm, tools, box, kept):
    """No torque at rest is beyond its limit for smaller errors; for 1 % larger ones one is."""
    samples, effort = kept.samples, 0.5 * arm.effort_limits
    free = kept.limits.free["m"]
    pull = samples.J_hat.mT * law.diagonals.kp
    asked = free * np.linalg.norm(pull, axis=2)  # in the worst direction
    assert (asked <= effort * (1.0 + 1e-9)).all()
    assert (1.01 * asked > effort).any()


def test_no_motion_that_begins_below_the_level_is_ever_limited(law, kept, tools, arm):
    """From states anywhere on the level V = c, moving or at rest, with every true robot."""
    rng, effort = np.random.default_rng(0), 0.5 * arm.effort_limits
    weights, least = kept.test.weights, np.inf
    limiter = aj.TorqueLimited(law, aj.Limits(effort=effort))
    for k in range(6):
        plant = tools.plant(kept.loop.corners[k % 4])
        q0 = Q + rng.uniform(-0.05, 0.05, 7)
        e = rng.normal(size=3)
        e *= 0.999 * np.sqrt(kept.test.level / weights.at_rest(e, law.saturation))
        run = aj.simulate(
            plant, limiter, target=plant.sensor.value(q0) - e, q0=q0, duration=0.3, dt=1e-3
        )
        assert (run.limit_status == aj.LimitStatus.FREE).all()
        least = min(least, float((effort / np.abs(run.tau).max(axis=0)).min()))
    assert least > 1.0


def test_motors_that_cannot_hold_the_arm_certify_nothing():
    arm = aj.load_robot("panda")
    law = aj.SetpointController(aj.PositionTask(arm), aj.Gains(400.0, 80.0, 5.0))
    limiter = aj.TorqueLimited(law, aj.Limits(effort=5.0))
    report = aj.Study(limiter, arm, aj.JointBox.around(arm, Q, 0.05)).report(20)
    assert not report.passed
    assert report.certifying is None
    assert report.reason == "motors"
    assert [row.verdict for row in report.rows if row.part == "limits"] == ["cannot hold"]
    assert report.limits.free == {"m": 0.0}


def test_a_saturated_law_may_never_ask_for_more(law, arm, tools, box):
    gentle = aj.SetpointController(
        law.task, law.gains, gravity=aj.NoGravity(arm), saturation=aj.law.Tanh(0.005)
    )
    report = aj.Study(aj.TorqueLimited(gentle), tools, box).report(20)
    assert report.limits.free == {"m": np.inf}
    assert report.limits.clipped == 0.0
    assert json.dumps(plain(asdict(report.limits)), allow_nan=False)


def test_where_gravity_is_learnt_the_limiter_keeps_this_V_by_itself():
    arm = aj.load_robot("panda")
    belief, truth = arm.with_object(0.0), arm.with_object(0.05, 0.2, axis="x")
    law = aj.SetpointController(
        aj.PositionTask(belief),
        aj.Gains(400.0, 80.0, 5.0),
        gravity=aj.AdaptiveGravity(belief, L=0.01, alpha=0.5),
    )
    region = aj.JointBox.around(arm, Q, 0.05)
    report = aj.Study(aj.TorqueLimited(law), truth, region).report(20)
    assert report.passed
    assert report.limits.protects
    assert report.limits.level == 0.0
    assert "certified" not in {row.name for row in of_limits(report.limits)}


@pytest.fixture(scope="module")
def posed():
    """A loop of two units on an arm that weighs something, its limits, samples and their cost."""
    arm = aj.load_robot("ur5")
    law = aj.SetpointController(aj.PoseTask(arm), aj.Gains((400.0,) * 3 + (40.0,) * 3, 40.0, 5.0))
    limiter = aj.TorqueLimited(law, aj.Limits(effort=arm.effort_limits))
    loop = ClosedLoop(law, arm, aj.JointBox.around(arm, (0.0, -1.2, 1.4, -1.0, -1.5, 0.0), 0.5))
    samples = loop.draw(40, np.random.default_rng(0))
    return law, limiter, samples, limit_cost(loop, limiter, samples, None, None)


def test_only_the_V_whose_output_the_limiter_has_is_protected(posed):
    """y = q̇ + αĴ⁺s of the limiter's own α, and of no other matrix."""
    law, limiter, samples, _ = posed
    loop = ClosedLoop(law, law.task.robot, aj.JointBox.around(law.task.robot, samples.q[0], 0.1))
    own, none = limiter.alpha * np.eye(6), np.zeros((6, 6))
    for A1, A2, protects in (
        (own, none, True), (1.01 * own, none, False), (own + 0.01, none, False),
        (own, 0.01 * own, False),
    ):  # fmt: skip
        known = Weights(A1, A2, np.ones(6))
        assert limit_cost(loop, limiter, samples, None, known).protects == protects


def test_clipped_are_starts_at_which_the_law_asks_some_motor_for_too_much(posed):
    law, limiter, samples, cost = posed
    asked = []
    for q, x, x_d in zip(samples.q, samples.x, samples.x_d, strict=True):
        here = aj.Measurement(0.0, q, np.zeros(len(q)), x)
        asked.append(law.evaluate(law.begin(here), here, x_d).torque)
    beyond = np.abs(asked) > limiter.limits.effort
    assert beyond.any(axis=0).sum() > 1  # one motor here, another one there
    assert cost.clipped == beyond.any(axis=1).mean() < 1.0


@pytest.mark.parametrize("share", [0.35, 0.5, 0.65])
def test_what_is_asked_of_weak_motors_is_beside_the_weight(share):
    """Towards some targets the weight helps, and to others it is in the way."""
    arm = aj.load_robot("ur10").with_object(0.1, 4.0)
    law = aj.SetpointController(aj.PositionTask(arm), aj.Gains(300.0, 40.0, 9.0))
    limiter = aj.TorqueLimited(law, aj.Limits(effort=share * arm.effort_limits))
    loop = ClosedLoop(law, arm, aj.JointBox.around(arm, (0.0, -0.7, 1.1, -1.0, -1.5, 0.0), 0.6))
    samples = loop.draw(30, np.random.default_rng(4))
    asked = []
    for q, x, x_d in zip(samples.q, samples.x, samples.x_d, strict=True):
        here = aj.Measurement(0.0, q, np.zeros(6), x)
        asked.append(law.evaluate(law.begin(here), here, x_d).torque)
    beyond = (np.abs(asked) > limiter.limits.effort).any(axis=1).mean()
    assert limit_cost(loop, limiter, samples, None, None).clipped == beyond
    assert 0.0 < beyond < 1.0


def test_an_error_of_each_unit_has_a_bound_of_its_own(posed):
    """To either side and beside the weight; for larger errors some motor has too little."""
    law, limiter, samples, cost = posed
    units = np.array(law.task.units)
    weight = [np.abs(aj.Plant(law.task.robot).dynamics.g(q)) for q in samples.q]
    assert set(cost.free) == {"m", "rad"}
    for unit, free in cost.free.items():
        pull = samples.J_hat.mT * np.where(units == unit, law.diagonals.kp, 0.0)
        share = (weight + free * np.linalg.norm(pull, axis=2)) / limiter.limits.effort
        assert share.max() == pytest.approx(1.0)


def test_speeds_that_a_filter_keeps_count_with_the_inertia_of_where_they_were():
    """Of a filtered q̇ the arm may have been anywhere, light or heavy, when it was as fast."""
    arm = aj.load_robot("two_link").with_object(0.5, 2.0, axis="x")
    task = aj.PositionTask(arm, axes="xz")
    law = aj.SetpointController(task, aj.Gains(30.0, 20.0, 5.0))
    limiter = aj.TorqueLimited(law, aj.Limits(effort=130.0))
    loop = ClosedLoop(law, arm, aj.JointBox.around(arm, (0.3, 1.2), 0.4))
    samples = loop.draw(24, np.random.default_rng(0))
    latency = aj.Latency(2e-3, velocity_filter=4e-3)
    sampled = sampled_test(loop, samples, latency)
    assert sampled.certified
    cost = limit_cost(loop, limiter, samples, sampled, None)
    speed = sampled.speed * np.sqrt(cost.level / sampled.level)  # |q̇|_M and |s|_U at most
    room = 130.0 - np.abs([aj.Plant(arm).dynamics.g(q) for q in samples.q])
    kp, kv, damping = law.diagonals
    D = (samples.J_hat.mT * kv) @ samples.J_hat + np.diag(damping)
    damped = np.sqrt(np.einsum("nij,kjl,nil->nki", D, np.linalg.inv(samples.M), D))
    pull, U = samples.J_hat.mT * kp, sampled.weights.block(loop.setting.saturation.c_bar)
    pulled = np.sqrt(np.einsum("nij,jk,nik->ni", pull, np.linalg.inv(U), pull))
    assert 0.0 < cost.level < sampled.level
    failed = replace(sampled, violations=1)
    assert limit_cost(loop, limiter, samples, failed, None).level == 0.0
    assert (speed * (damped + pulled[:, None]) <= room[:, None] * (1.0 + 1e-9)).all()
