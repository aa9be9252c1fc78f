"""A robot as a tree of nodes, each link under its parent, as MeshCat nests them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.robots import Robot
from approxjac.robots import urdf as urdf_xml
from approxjac.validation import Array

_KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}


class Joint(NamedTuple):
    """How a link sits on its parent: at `origin`, then turned about or moved along `axis`.

    Attributes:
        name: In the URDF.
        parent: Link that carries it.
        child: Link that it carries.
        kind: "revolute", "prismatic" or "fixed".
        origin: In the parent's node, shape (4, 4) [m].
        axis: Unit vector in the child's node, shape (3,).
        column: Which of the `joint_positions` moves it; −1 for a fixed one.
    """

    name: str
    parent: str
    child: str
    kind: str
    origin: Array
    axis: Array
    column: int


class Tree(NamedTuple):
    """The nodes of a robot.

    Attributes:
        paths: Link → names of the nodes down to it, the root first.
        joints: From the base outwards.
        drivers: Link → index (into v and τ) of the joint that moves it last; −1 if none does.
    """

    paths: Mapping[str, tuple[str, ...]]
    joints: tuple[Joint, ...]
    drivers: Mapping[str, int]

    def path_of(self, frame: str) -> tuple[str, ...]:
        """Node at a frame, which is a link, or a joint: that is where its child is."""
        if frame in self.paths:
            return self.paths[frame]
        return self.paths[next(joint.child for joint in self.joints if joint.name == frame)]


def robot_tree(robot: Robot, root: str) -> Tree:
    """Return the nodes of a robot.

    Args:
        robot: The robot.
        root: Name of the node that the whole robot is under, such as "true".
    """
    xml = urdf_xml.parse(robot.urdf, robot.name)
    urdf = urdf_xml.read(xml, robot.name)
    columns = {name: i for i, name in enumerate(list(robot.mimic_joints.model.names)[1:])}
    carried: dict[str, list[Any]] = {}
    for joint in urdf.robot.joints:
        carried.setdefault(joint.parent, []).append(joint)
    children = {joint.child for joint in urdf.robot.joints}
    base = next(link.name for link in urdf.robot.links if link.name not in children)
    paths: dict[str, tuple[str, ...]] = {base: (root, _node(base))}
    drivers = {base: -1}
    joints, G = [], robot.mimic_joints.G
    waiting = [base]
    while waiting:
        parent = waiting.pop()
        for joint in carried.get(parent, []):
            column = columns.get(joint.name, -1)
            axis = np.array([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, dtype=float)
            joints.append(
                Joint(
                    joint.name,
                    parent,
                    joint.child,
                    _KINDS[joint.type] if column >= 0 else "fixed",
                    np.eye(4) if joint.origin is None else np.array(joint.origin, dtype=float),
                    axis / (np.linalg.norm(axis) or 1.0),
                    column,
                )
            )
            paths[joint.child] = (*paths[parent], _node(joint.child))
            drivers[joint.child] = drivers[parent]
            if column >= 0:
                # a mimic joint is moved by the torque of the one that it follows
                drivers[joint.child] = column if G is None else int(np.abs(G[column]).argmax())
            waiting.append(joint.child)
    return Tree(paths, tuple(joints), drivers)


def joint_positions(robot: Robot, q: Array) -> Array:
    """Positions of all moving joints, mimic ones and continuous ones too.

    Args:
        robot: The robot.
        q: Configurations, shape (N, nq).

    Returns:
        In the order of `Joint.column`, shape (N, n_all) [rad or m]; those of continuous joints
        without jumps.
    """
    mimic_joints = robot.mimic_joints
    q_all = np.array([mimic_joints.q(row) for row in q]).reshape(len(q), mimic_joints.model.nq)
    columns = []
    for joint in list(mimic_joints.model.joints)[1:]:
        own = q_all[:, joint.idx_q : joint.idx_q + joint.nq]
        columns.append(np.unwrap(np.arctan2(own[:, 1], own[:, 0])) if joint.nq == 2 else own[:, 0])
    return np.column_stack(columns)


def placements(tree: Tree, positions: Array) -> dict[str, Array]:
    """Placement of every link in the world, shape (4, 4), as the page works it out.

    Args:
        tree: The robot's nodes.
        positions: Of its joints, shape (n_all,) [rad or m].
    """
    carried = {joint.child for joint in tree.joints}
    found = {link: np.eye(4) for link in tree.paths if link not in carried}
    for joint in tree.joints:
        moved = np.eye(4)
        if joint.kind == "revolute":
            moved[:3, :3] = pin.exp3(joint.axis * positions[joint.column])
        elif joint.kind == "prismatic":
            moved[:3, 3] = joint.axis * positions[joint.column]
        found[joint.child] = found[joint.parent] @ joint.origin @ moved
    return found


def _node(name: str) -> str:
    # MeshCat takes a slash for the next level; and no link is to have the name of a shape
    return "link " + name.replace("/", "∕")
