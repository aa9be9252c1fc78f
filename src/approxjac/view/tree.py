"""A robot as drawn: its links as a tree of nodes, and the tip that is followed."""

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.robots import KinematicRegressor, Robot
from approxjac.simulation.trajectory import Scene
from approxjac.tasks import Task
from approxjac.tasks.analysis import features
from approxjac.tasks.task import Feature
from approxjac.validation import Array


class Joint(NamedTuple):
    """A joint of a tree: the child sits at `origin`, turned about or moved along `axis`."""

    name: str  # in the URDF
    parent: str  # link that carries it
    child: str  # link that it carries
    kind: str  # "revolute", "prismatic" or "fixed"
    origin: Array  # in the parent's node, shape (4, 4) [m]
    axis: Array  # unit vector in the child's node, shape (3,); zero for a fixed one
    column: int  # which of the `joint_positions` moves it; −1 for a fixed one


def robot_joints(robot: Robot) -> tuple[Joint, ...]:
    """Return all joints of a robot, fixed ones too, from the base outwards."""
    model = robot.mimic_joints.model  # in which mimic joints move
    data, frames = model.createData(), list(model.frames)
    pin.computeJointJacobians(model, data, pin.neutral(model))
    joints = []
    for link in frames:
        joint = frames[link.parentFrame]
        parent = frames[joint.parentFrame]
        if link.type != pin.FrameType.BODY or parent.type != pin.FrameType.BODY:
            continue
        kind, origin, axis, column = "fixed", link.placement, np.zeros(3), -1
        if joint.type == pin.FrameType.JOINT:
            index, column = link.parentJoint, link.parentJoint - 1
            J = pin.getJointJacobian(model, data, index, pin.ReferenceFrame.LOCAL).reshape(6, -1)
            move, turn = np.split(J[:, model.joints[index].idx_v], 2)
            kind, axis = ("revolute", turn) if np.linalg.norm(turn) > 0.5 else ("prismatic", move)
            origin = model.jointPlacements[index]
        placed = (parent.placement.inverse() * origin).homogeneous
        joints.append(Joint(joint.name, parent.name, link.name, kind, placed, axis, column))
    return tuple(joints)


def held_objects(robot: Robot) -> dict[str, float]:
    """Return the length [m] of each object that `Robot.with_object` made, by its link."""
    return {
        joint.parent: float(np.linalg.norm(joint.origin[:3, 3]))
        for joint in robot_joints(robot)
        if (joint.name, joint.child) == (f"{joint.parent}_tip_joint", f"{joint.parent}_tip")
    }


class Tree:
    """The nodes of a robot, all under one that is named `root`."""

    def __init__(self, robot: Robot, root: str) -> None:
        self.joints = robot_joints(robot)  # from the base outwards
        base = self.joints[0].parent
        # link → names of the nodes down to it; also of joints, whose node is that of their child
        self.paths: dict[str, tuple[str, ...]] = {base: (root, _node(base))}
        self.drivers = {base: -1}  # link → index of the joint that moves it last; −1 if none does
        G = robot.mimic_joints.G
        leaders = np.arange(robot.nv) if G is None else np.abs(G).argmax(axis=1)  # of all columns
        for joint in self.joints:
            self.paths[joint.child] = (*self.paths[joint.parent], _node(joint.child))
            moves, before = joint.column >= 0, self.drivers[joint.parent]
            self.drivers[joint.child] = int(leaders[joint.column]) if moves else before
        for joint in self.joints:
            self.paths.setdefault(joint.name, self.paths[joint.child])

    def listed(self) -> list[dict[str, Any]]:
        """Return the joints as the page reads them: matrices columns first, as in three.js."""
        return [
            joint._asdict()
            | {"path": self.paths[joint.child], "axis": joint.axis.tolist()}
            | {"origin": joint.origin.T.ravel().tolist()}
            for joint in self.joints
        ]


def joint_positions(robot: Robot, q: Array) -> Array:
    """Return positions of all moving joints, by their `column`, in configurations q (N, nq).

    Of shape (N, n_all), mimic joints included [rad or m]; those of continuous joints do not jump.
    """
    mimic = robot.mimic_joints
    q_all = np.array([mimic.q(row) for row in q]).reshape(len(q), mimic.model.nq)
    columns = []
    for joint in list(mimic.model.joints)[1:]:
        own = q_all[:, joint.idx_q : joint.idx_q + joint.nq]
        columns.append(np.unwrap(np.arctan2(own[:, 1], own[:, 0])) if joint.nq == 2 else own[:, 0])
    return np.column_stack(columns)


def _node(name: str) -> str:
    # MeshCat takes a slash for the next level; and no link is to have the name of a shape
    return "link " + name.replace("/", "∕")


def followed(task: Task | None) -> Feature | None:
    """Return the part of a task that is looked at: its first position, or else its first image."""
    parts = features(task)
    return next((part for part in parts if part.axes), parts[0] if parts else None)


def learnt_regressor(scene: Scene) -> KinematicRegressor | None:
    """Return p(q) of the tip that is followed, where a run learns its translations, or None."""
    feature = followed(scene.task) if scene.parameters else None
    if scene.belief is None or feature is None or feature.frame is None:
        return None  # or a camera in hand, which watches points of the world
    regressor = KinematicRegressor(scene.belief, feature.frame, feature.points[:1])
    return regressor if set(regressor.names) & set(scene.parameters) else None


def learnt_tips(scene: Scene, q: Array, learnt: Array) -> Array | None:
    """Return the tip's positions by the translations learnt so far, shape (N, 3) [m].

    For configurations q (N, nq) and what was learnt (N, p); None where a run does not learn them.
    """
    regressor = learnt_regressor(scene)
    if regressor is None:
        return None
    theta = np.tile(regressor.theta, (len(q), 1))
    for name, values in zip(scene.parameters, learnt.T, strict=True):
        if name in regressor.names:
            theta[:, regressor.names.index(name)] = values
    return np.array([regressor.position(*row) for row in zip(q, theta, strict=True)])
