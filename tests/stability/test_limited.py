"""A report of a controller within limits: where they act, and what is certified then."""

import json

import numpy as np
import pytest

import approxjac as aj
from approxjac.stability.certificates.certificate import effort_room, sampled_test
from approxjac.stability.loop.closed_loop import ClosedLoop

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
    rows = {row.name: row for row in kept.rows if row.part == "limits"}
    assert rows["certified"].figures["level"] == kept.limits.level
    assert all(row.text for row in rows.values())
    assert json.dumps(kept.summary(), allow_nan=False)


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
    assert report.reason == "motors"
    assert [row.verdict for row in report.rows if row.part == "limits"] == ["cannot hold"]
    assert report.limits == (False, 0.0)


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
    assert report.limits == (True, 0.0)


def test_speeds_that_a_filter_keeps_count_with_the_inertia_of_where_they_were():
    """Of a filtered q̇ the arm may have been anywhere, light or heavy, when it was as fast."""
    arm = aj.load_robot("two_link").with_object(0.5, 2.0, axis="x")
    task = aj.PositionTask(arm, axes="xz")
    law = aj.SetpointController(task, aj.Gains(30.0, 20.0, 5.0))
    loop = ClosedLoop(law, arm, aj.JointBox.around(arm, (0.3, 1.2), 0.4))
    samples = loop.draw(24, np.random.default_rng(0))
    latency = aj.Latency(2e-3, velocity_filter=4e-3)
    sampled = sampled_test(loop, samples, latency)
    assert sampled.certified
    effort = np.full(2, 130.0)
    cost = effort_room(loop, effort, samples, sampled)
    speed = sampled.speed * np.sqrt(cost.level / sampled.level)  # |q̇|_M and |s|_U at most
    room = 130.0 - np.abs([aj.Plant(arm).dynamics.g(q) for q in samples.q])
    kp, kv, damping = law.diagonals
    D = (samples.J_hat.mT * kv) @ samples.J_hat + np.diag(damping)
    damped = np.sqrt(np.einsum("nij,kjl,nil->nki", D, np.linalg.inv(samples.M), D))
    pull, U = samples.J_hat.mT * kp, sampled.weights.block(loop.setting.saturation.c_bar)
    pulled = np.sqrt(np.einsum("nij,jk,nik->ni", pull, np.linalg.inv(U), pull))
    assert 0.0 < cost.level < sampled.level
    assert effort_room(loop, effort, samples, None) == (True, 0.0)
    assert (speed * (damped + pulled[:, None]) <= room[:, None] * (1.0 + 1e-9)).all()
