"""Walking the nodes of a robot gives Pinocchio's placement of every link."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.view.tree import Tree, held_objects, joint_positions

INERTIAL = """<inertial><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>"""


def placements(tree, positions):
    """Placement of every link in the world, as the page works it out."""
    found = {tree.joints[0].parent: pin.SE3.Identity()}
    for joint in tree.joints:
        moved = pin.SE3.Identity()
        if joint.kind == "revolute":
            moved.rotation = pin.exp3(joint.axis * positions[joint.column])
        elif joint.kind == "prismatic":
            moved.translation = joint.axis * positions[joint.column]
        found[joint.child] = found[joint.parent] * pin.SE3(joint.origin) * moved
    return found


def test_the_nodes_place_every_link_of_every_arm(arm, rng):
    tree = Tree(arm, "true")
    q = np.array([arm.random_configuration(rng) for _ in range(3)])
    positions = joint_positions(arm, q)
    data = arm.model.createData()
    for row, angles in zip(q, positions, strict=True):
        pin.framesForwardKinematics(arm.model, data, row)
        for link, placed in placements(tree, angles).items():
            expected = data.oMf[arm.frame_id(link)].homogeneous
            assert_allclose(placed.homogeneous, expected, atol=1e-9, err_msg=link)


def test_links_are_nested_under_their_parents(two_link):
    tree = Tree(two_link, "true")
    assert tree.paths["link2"] == ("true", "link base_link", "link link1", "link link2")
    assert tree.paths["joint2"] == tree.paths["link2"]
    assert [joint.kind for joint in tree.joints][:2] == ["revolute", "revolute"]
    assert tree.drivers["link1"] == 0
    assert tree.drivers["object_tip"] == 1
    assert tree.drivers["base_link"] == -1


def test_a_mimic_joint_moves_and_is_driven_by_its_leader():
    arm = aj.load_robot("panda", free="all")
    tree = Tree(arm, "true")
    fingers = {joint.name: joint for joint in tree.joints if "finger" in joint.name}
    q = arm.neutral()
    q[-1] = 0.03
    found = joint_positions(arm, q[np.newaxis])[0]
    moving = [joint for joint in fingers.values() if joint.column >= 0]
    assert len(moving) == 2
    assert_allclose([found[joint.column] for joint in moving], 0.03)
    assert {tree.drivers[joint.child] for joint in moving} == {arm.nv - 1}


@pytest.mark.parametrize("multiplier", [-2.0, 0.5])
@pytest.mark.parametrize("leader", ["j1", "j2"])
def test_a_mimic_joint_is_driven_by_its_leader_whichever_way_it_turns(leader, multiplier):
    names = ("base", "a", "b", "c")
    text = "".join(f'<link name="{name}">{INERTIAL}</link>' for name in names)
    for k, (parent, child) in enumerate(pairwise(names), 1):
        mimic = f'<mimic joint="{leader}" multiplier="{multiplier}" offset="0.1"/>' * (k == 3)
        text += f'''<joint name="j{k}" type="revolute"><parent link="{parent}"/>
          <child link="{child}"/><origin xyz="0.1 0 0.2"/><axis xyz="0 1 0"/>
          <limit lower="-2" upper="2" effort="5" velocity="1"/>{mimic}</joint>'''
    arm = aj.Robot(f'<robot name="coupled">{text}</robot>')
    tree = Tree(arm, "true")
    assert tree.drivers == {"base": -1, "a": 0, "b": 1, "c": int(leader[1]) - 1}
    q = np.array([[0.3, -0.4]])
    (found,) = joint_positions(arm, q)
    columns = {joint.name: joint.column for joint in tree.joints}
    expected = {"j1": 0.3, "j2": -0.4}
    expected["j3"] = multiplier * expected[leader] + 0.1
    assert {name: found[column] for name, column in columns.items()} == pytest.approx(expected)


def test_an_object_is_as_long_as_it_is_whichever_way_it_points(two_link):
    arm = aj.load_robot("two_link")
    for axis in ("x", "-y", (0.0, 1.0, 1.0)):
        assert held_objects(arm.with_object(0.3, axis=axis)) == pytest.approx({"object": 0.3})
    assert held_objects(arm) == {}


def test_continuous_joints_do_not_jump():
    arm = aj.load_robot("kinova")
    assert arm.nq > arm.nv
    motion = np.zeros((50, arm.nv))
    motion[:, 0] = np.linspace(0.0, 9.0, 50)  # more than a turn
    q = np.array([pin.integrate(arm.model, arm.neutral(), row) for row in motion])
    positions = joint_positions(arm, q)
    assert_allclose(positions[:, 0], motion[:, 0], atol=1e-9)
    assert joint_positions(arm, q[:0]).shape == (0, arm.nv)
