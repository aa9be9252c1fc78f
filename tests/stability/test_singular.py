"""Regions that hold a posture where Ĵ loses rank: no test may certify them."""

import functools

import numpy as np
import pytest

import approxjac as aj
from approxjac.controllers import NoGravity
from approxjac.robots import GravityRegressor
from approxjac.stability import JointBox, RegularPart
from approxjac.stability.loop.configurations import inverse_kinematics
from approxjac.stability.search import suggested_gains

INERTIAL = """<inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>"""


@pytest.fixture(scope="module")
def straight():
    """An exact model, a target that bends the arm, and a start where it points at the target."""
    arm = aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0))
    task = aj.PositionTask(arm, axes="xz")
    controller = aj.SetpointController(task, aj.Gains(kp=100.0, kv=50.0), gravity=NoGravity(arm))
    q_target = np.array([0.3, 0.4])
    q0 = np.array([q_target[0] + 0.5 * q_target[1], 0.0])  # links of one length
    return aj.Plant(arm, task), controller, task.value(q_target), q0


def test_an_arm_stands_still_where_the_jacobian_is_singular(straight):
    plant, controller, target, q0 = straight
    run = aj.simulate(plant, controller, target, q0, duration=5.0, dt=None)
    assert run.error_norm[-1] == pytest.approx(run.error_norm[0], rel=1e-6)
    assert np.abs(run.q - q0).max() < 1e-6


@pytest.mark.parametrize("configurations", [40, 200])
def test_so_no_test_certifies_a_region_with_such_a_posture(straight, configurations):
    plant, controller, target, q0 = straight
    box = JointBox.around(plant.robot, q0, 0.45)
    report = aj.Study(controller, plant, box, target=target).report(configurations)
    # samples alone do not tell: none is exactly there
    assert np.linalg.svd(report.samples.J_hat)[1][:, -1].min() > 1e-6
    assert report.singular_q is not None
    assert box.contains(report.singular_q)
    assert report.singular_q[1] == pytest.approx(0.0, abs=1e-3)
    assert not report.passed
    assert report.reason == "rank"
    assert ("beware", "rank") in {row[:2] for row in report.rows}
    assert report.summary()["beware"]["rank"]["q"] == report.singular_q.tolist()


@pytest.mark.study
def test_the_regular_part_of_the_region_is_certified(straight):
    plant, controller, target, q0 = straight
    box = JointBox.around(plant.robot, q0, 0.45)
    regular = RegularPart(box, controller.task, 0.05)
    report = aj.Study(controller, plant, regular, target=target).report(100)
    assert report.singular_q is None
    assert report.passed


def test_a_redundant_arm_is_singular_in_fewer_postures():
    arm = aj.load_robot("panda").with_gravity((0.0, 0.0, 0.0))
    task = aj.PositionTask(arm)
    controller = aj.SetpointController(task, gravity=NoGravity(arm))
    q = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.8])
    report = aj.Study(controller, arm, JointBox.around(arm, q, 0.2), target=task.value(q)).report(
        20
    )
    assert report.singular_q is None


def test_a_stop_bars_the_way_on_either_side_alike():
    """Mirrored starts have mirrored ways to mirrored targets; the other joints go on."""
    text = f'<link name="l0">{INERTIAL}</link>'
    for k in (1, 2, 3):
        text += f'''<link name="l{k}">{INERTIAL}</link><joint name="j{k}" type="revolute">
          <parent link="l{k - 1}"/><child link="l{k}"/><origin xyz="{0.4 * (k > 1)} 0 0"/>
          <axis xyz="0 -1 0"/><limit lower="-1.2" upper="1.2" effort="5" velocity="1"/></joint>'''
    text += """<link name="tip"/><joint name="t" type="fixed"><parent link="l3"/>
      <child link="tip"/><origin xyz="0.4 0 0"/></joint>"""
    arm = aj.Robot(f'<robot name="three">{text}</robot>', tip="tip")
    task, rng, barred, attained = aj.PositionTask(arm, axes="xz"), np.random.default_rng(0), 0, 0
    for q0, q in rng.uniform(-1.2, 1.2, (30, 2, 3)):
        x_d = task.value(q)
        free = inverse_kinematics(task, x_d, q0)
        one = inverse_kinematics(task, x_d, q0, within_limits=True)
        other = inverse_kinematics(task, x_d * [1.0, -1.0], -q0, within_limits=True)
        assert (one is None) == (other is None)
        if free is not None and np.abs(free).max() > 1.2:
            barred += 1
            attained += one is not None
        if one is not None:
            np.testing.assert_allclose(other, -one, atol=1e-6)
            np.testing.assert_allclose(task.value(one), x_d, atol=1e-8)
            assert np.abs(one).max() <= 1.2
    assert 0 < attained < barred


def test_nor_does_tolerance_or_a_suggestion(straight, monkeypatch):
    monkeypatch.setattr(suggested_gains, "_TARGETS", 4)
    plant, controller, _, q0 = straight
    errors = aj.Uncertainty(
        plant.robot, functools.partial(aj.PositionTask, axes="xz"),
        joint_shifts={"joint2": (0.01, 0.0, 0.0)},
    )  # fmt: skip
    box = JointBox.around(plant.robot, q0, 0.45)
    found = aj.Study(controller, errors, box).tolerance("certified", draws=40)
    assert found["certified"].scale == 0.0
    suggested = aj.Study(controller, errors, box).gains(5.0, configurations=40)
    assert suggested.found is None


def test_a_drawn_posture_where_the_rank_is_lost_is_named(straight):
    plant, controller, _target, q0 = straight
    point = JointBox.around(plant.robot, q0, 0.0)
    with pytest.raises(aj.InvalidInputError, match="where the estimated Jacobian loses rank, got"):
        aj.Study(controller, plant, point).report(20)


@pytest.mark.study
def test_where_learning_is_damped_no_certificate_says_anything():
    arm = aj.load_robot("two_link")
    task = aj.PositionTask(arm, axes="xz")
    learns = aj.AdaptiveGravity(GravityRegressor(arm, moments="x"), L=5.0, alpha=0.1)  # stable
    learnt = aj.SetpointController(task, aj.Gains(100.0, 50.0), gravity=learns)
    known = aj.SetpointController(task, aj.Gains(100.0, 50.0))
    near = JointBox(arm, (0.0, 0.02), (1.0, 0.9))  # straight it is for a joint at 0

    found = aj.Study(learnt, arm, near).report(20)
    q = found.damped_q
    x = task.value(q)
    answer = learnt.evaluate(np.zeros(2), aj.Measurement(0.0, q, np.zeros(2), x), x)
    assert answer.status is aj.Status.NEAR_SINGULAR
    assert found.singular_q is None
    assert not found.growth.grows
    assert not found.passed
    assert found.reason == "damped"
    assert "learning uses a damped pseudo-inverse" in str(found)
    assert found.summary()["beware"]["learning"]["q"] == q.tolist()

    regular = RegularPart(near, task, 0.1)
    assert aj.Study(learnt, arm, regular).report(20).damped_q is None
    # with known gravity no pseudo-inverse is in the law
    assert aj.Study(known, arm, near).report(20).damped_q is None
