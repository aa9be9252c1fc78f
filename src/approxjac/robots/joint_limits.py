"""Joints against their position limits, and how far they bring a frame."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.robots.robot import Robot
from approxjac.validation import Array


def beyond_positions(robot: Robot, q: Array) -> Array:
    """Return the excess of each joint over its limits at q (N, nq); shape (N, n_v) [rad or m].

    Negative within them, −∞ where a joint has none.
    """
    low, high = robot.position_limits
    motions = np.array([pin.difference(robot.model, robot.neutral(), each) for each in q])
    return np.asarray(np.maximum(motions - high, low - motions))


def require_radians(name: str, robot: Robot, q: Array) -> None:
    """Refuse a configuration that is a turn or more beyond the limits of a joint: it is in degrees.

    One that is a little beyond them may be where a run ended.
    """
    beyond = beyond_positions(robot, q[np.newaxis])[0]
    beyond[np.array(robot.joint_units) != "rad"] = 0.0
    if beyond.max() > 2.0 * np.pi:
        raise InvalidInputError(
            f"{name} must be in radians: it is {beyond.max():.4g} rad beyond the limits of "
            f"{robot.joint_names[int(beyond.argmax())]}, as degrees would be",
            given=q,
        )


def reach_bound(robot: Robot, frame: str) -> tuple[Array, float]:
    """Return the place of the first joint before a frame (3,), and a bound [m] on its reach.

    The bound is the arm stretched out along its links, whatever its joints allow; infinite with a
    prismatic joint without limits, or one that mimics another.
    """
    model, there = robot.model, robot.model.frames[robot.frame_id(frame)]
    joints = list(model.supports[there.parentJoint])[1:]
    origins = [model.jointPlacements[j].translation for j in joints]
    reach = sum(float(np.linalg.norm(part)) for part in (*origins[1:], there.placement.translation))
    slides = dict(zip(robot.joint_names, np.abs(robot.position_limits).max(axis=0), strict=True))
    every = robot.mimic_joints.model  # in which mimic joints move on their own
    for name in (model.names[j] for j in joints):
        if every.joints[every.getJointId(name)].shortname().startswith("JointModelP"):
            reach += float(slides.get(name, np.inf))
    return np.array(origins[0]) if joints else np.zeros(3), reach
