"""A perturbed model is the one that Pinocchio builds of its URDF."""

import copy
import pickle

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.errors import UrdfError
from approxjac.robots import Dynamics, Perturbation


def assert_same(models, others):
    for ours, theirs in zip(models, others, strict=True):
        assert list(ours.names) == list(theirs.names)
        assert_array_equal(ours.gravity.linear, theirs.gravity.linear)
        assert_array_equal(ours.upperPositionLimit, theirs.upperPositionLimit)
        for a, b in zip(ours.jointPlacements, theirs.jointPlacements, strict=True):
            assert_allclose(a.homogeneous, b.homogeneous, rtol=0, atol=1e-12)
        for a, b in zip(ours.inertias, theirs.inertias, strict=True):
            expected = b.toDynamicParameters()
            atol = 1e-12 * max(1.0, np.abs(expected).max())
            assert_allclose(a.toDynamicParameters(), expected, rtol=0, atol=atol)
        for a, b in zip(ours.frames, theirs.frames, strict=True):
            assert (a.name, a.type, a.parentJoint, a.parentFrame) == (
                b.name, b.type, b.parentJoint, b.parentFrame
            )  # fmt: skip
            assert_allclose(a.placement.homogeneous, b.placement.homogeneous, rtol=0, atol=1e-12)
            assert_allclose(
                a.inertia.toDynamicParameters(), b.inertia.toDynamicParameters(), atol=1e-12
            )


def joints_of(robot, rng, k=6):
    """Some joints on the way to the tip, fixed ones too."""
    frames, at, found = list(robot.model.frames), robot.frame_id(robot.tip), []
    while at:
        if "JOINT" in str(frames[at].type):
            found.append(frames[at].name)
        at = frames[at].parentFrame
    return list(rng.permutation(found)[:k])


def drawn(arm, rng, held=(0.1, 0.2), axis=None, joints=None):
    joints = joints_of(arm, rng) if joints is None else joints
    perturbation = Perturbation(arm, held, axis, joints)
    shifts, rotations = rng.normal(scale=0.1, size=(2, len(joints), 3))
    turns = np.array([*map(pin.exp3, rotations)]).reshape(-1, 3, 3)
    return perturbation.robot(0.27, 0.6, shifts, turns)


@pytest.mark.parametrize("held", [None, (0.0, 0.0), (0.1, 0.2)])
def test_on_every_arm(arm, rng, held):
    before = pickle.dumps(arm.model)
    robot = drawn(arm, rng, held)
    built = aj.Robot(robot.urdf)
    assert robot == built
    assert robot.frame_names == built.frame_names
    assert_same(robot.models, built.models)
    assert pickle.dumps(arm.model) == before  # the copy is one
    q, v = robot.random_configuration(rng), rng.normal(size=robot.nv)
    ours, theirs = Dynamics(robot), Dynamics(built)
    assert_allclose(ours.inverse(q, v, v), theirs.inverse(q, v, v), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("name", "free"), [("panda", "panda_finger_joint1"), ("tiago_arm", "all")])
def test_with_mimic_joints(name, free, rng):
    arm = aj.load_robot(name, free=free)
    joints = (
        ["panda_finger_joint2", "panda_hand_joint", "panda_joint3"] if name == "panda" else None
    )
    robot = drawn(arm, rng, joints=joints)
    assert_same(robot.models, aj.Robot(robot.urdf).models)


def test_fixed_joints_that_carry_each_other_and_a_moving_one(rng):
    body = """<link name="{0}"><inertial><origin xyz="0.1 0 0.2"/><mass value="1"/><inertia
      ixx="0.1" ixy="0" ixz="0" iyy="0.2" iyz="0.01" izz="0.15"/></inertial></link>"""
    joint = """<joint name="{0}" type="{3}"><parent link="{1}"/><child link="{2}"/><axis
      xyz="0 1 1"/><origin xyz="0.3 0.1 0" rpy="0.1 0.2 0.3"/><limit lower="-1" upper="1"
      effort="5" velocity="1"/></joint>"""
    kinds = ("revolute", "fixed", "fixed", "prismatic", "fixed", "fixed")
    links = "".join(body.format(f"l{i}") for i in range(7))
    joints = "".join(joint.format(f"j{i}", f"l{i}", f"l{i + 1}", kinds[i]) for i in range(6))
    branch = body.format("side") + joint.format("js", "l2", "side", "continuous")
    arm = aj.Robot(f'<robot name="r">{links}{joints}{branch}</robot>', tip="l6")
    for order in ([*range(6)], [5, 2, 1, 3, 0, 4]):
        robot = drawn(arm, rng, axis=(1, -2, 0.5), joints=[*(f"j{i}" for i in order), "js"])
        assert_same(robot.models, aj.Robot(robot.urdf).models)


def test_it_is_a_robot_like_others(panda, rng):
    robot = drawn(panda, rng)
    assert robot.tip == "object_tip"
    assert copy.deepcopy(robot) is robot
    lighter = robot.with_gravity((0.0, 0.0, -1.62))
    assert lighter.urdf == robot.urdf
    for each in (robot, lighter):
        again = pickle.loads(pickle.dumps(each))
        assert again == each
        q = each.random_configuration(rng)
        assert_array_equal(Dynamics(again).g(q), Dynamics(each).g(q))
    longer = robot.with_kinematic_error({"object_tip_joint": (0.1, 0.0, 0.0)})
    assert_same(longer.models, aj.Robot(longer.urdf).models)
    assert robot.outward_axis() == panda.with_object(0.1).outward_axis()
    shoulder = drawn(panda, rng, None, joints=["panda_joint1"])
    assert shoulder.outward_axis() == panda.outward_axis()


def test_a_singular_inertia_matrix_is_refused():
    point = """<robot name="pendulum"><link name="base"/><link name="arm"/><link name="mass">
      <inertial><mass value="1"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>
      </inertial></link><joint name="j" type="continuous"><parent link="base"/><child link="arm"/>
      <axis xyz="0 1 0"/></joint><joint name="f" type="fixed"><parent link="arm"/>
      <child link="mass"/><origin xyz="0.5 0 0"/></joint></robot>"""
    perturbation = Perturbation(aj.Robot(point), joints=["f"])
    none = np.eye(3)[np.newaxis]
    assert perturbation.robot(0.0, 0.0, np.array([[0.1, 0.0, 0.0]]), none).nv == 1
    with pytest.raises(UrdfError, match="nothing with inertia is moved by joint 'j'"):
        perturbation.robot(0.0, 0.0, np.array([[-0.5, 0.0, 0.0]]), none)


def test_sizes_that_no_object_has_are_refused(panda):
    perturbation, none = Perturbation(panda, (0.1, 0.2)), np.zeros((0, 3))
    assert pin.neutral(perturbation.robot(0.2, 0.0, none, none).model).shape == (7,)
    with pytest.raises(aj.InvalidInputError, match=r"mass must be a finite number >= 0 \[kg\]"):
        perturbation.robot(0.1, -0.1, none, none)
    with pytest.raises(aj.InvalidInputError, match="length must be at most 10"):
        perturbation.robot(11.0, 0.1, none, none)
