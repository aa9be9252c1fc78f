"""Where an object leads on from an arm, and how far an arm gets."""

import numpy as np
import pytest

import approxjac as aj
from approxjac.robots import robot_names
from approxjac.robots.load import NAMED, urdf_path
from approxjac.tasks import FrameKinematics

AXES = {"panda": "z", "ur5": "z", "two_link": "x", "z1": "x", "talos_arm": "-z", "so100": "-y"}


@pytest.mark.parametrize("name", sorted(AXES))
def test_an_object_leads_on_from_the_arm(name):
    arm = aj.load_robot(name)
    assert arm.outward_axis() == AXES[name]
    assert arm.with_object(0.1) == arm.with_object(0.1, axis=AXES[name])
    longer = arm.with_object(0.1).with_object(0.1, name="second")  # on from the first
    assert longer == arm.with_object(0.1).with_object(0.1, name="second", axis=AXES[name])


@pytest.mark.parametrize("name", ["panda", "ur5", "xarm7", "kinova"])
def test_neither_locked_joints_nor_errors_turn_it(name):
    arm = aj.load_robot(name)
    shift = {arm.joint_names[-1]: (0.03, 0.0, 0.0)}
    for k in (1, 2, 3):
        locked = arm.with_locked_joints(dict.fromkeys(arm.joint_names[-k:], 0.0))
        assert locked.outward_axis() == arm.outward_axis()
    one, other = (
        arm.with_kinematic_error(shift).with_object(0.2),
        arm.with_object(0.2).with_kinematic_error(shift),
    )
    assert one == other


def test_of_another_parent_it_is_asked_anew():
    panda = aj.load_robot("panda")
    assert panda.outward_axis("panda_link0") == "z"  # nothing moves it
    assert panda.outward_axis("panda_link4") == "y"  # along the upper arm
    elbow = panda.with_object(0.1, parent="panda_link4")
    assert elbow == panda.with_object(0.1, parent="panda_link4", axis="y")
    branched = aj.load_robot(urdf_path(NAMED["panda"]))
    with pytest.raises(aj.InvalidInputError, match="a frame must be named: panda has more than"):
        branched.with_object(0.1)


@pytest.mark.parametrize("name", robot_names())
def test_no_posture_is_beyond_the_reach(name, rng):
    robot = aj.load_robot(name).with_object(0.1)
    first, most = robot.reach_bound("object_tip")
    tip = FrameKinematics(robot, "object_tip")
    tips = [tip.position(robot.random_configuration(rng)) for _ in range(200)]
    farthest = np.linalg.norm(np.array(tips) - first, axis=1).max()
    assert 0.3 * most < farthest <= most + 1e-9


@pytest.mark.parametrize(("kind", "bounded"), [("revolute", True), ("prismatic", False)])
def test_the_reach_with_a_joint_that_mimics_another(kind, bounded):
    text = aj.load_robot("two_link").urdf
    joint = f"""<joint name="third" type="{kind}"><origin xyz="0.3 0 0"/><parent link="tool0"/>
    <child link="end"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
    <mimic joint="joint2" multiplier="0.5"/></joint><link name="end"><inertial><mass value="0.1"/>
    <inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
    robot = aj.Robot(text.replace("</robot>", joint + "</robot>"), tip="end")
    _, most = robot.reach_bound("end")
    assert np.isfinite(most) == bounded
    if bounded:
        assert most == pytest.approx(2.3)
