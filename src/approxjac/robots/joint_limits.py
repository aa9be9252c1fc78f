"""Where joints may be, and how far they bring a frame."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.robots.robot import Robot
from approxjac.validation import Array


def beyond_positions(robot: Robot, q: Array) -> Array:
    """How far each joint is beyond its position limits, negative within.

    Args:
        robot: The robot.
        q: Configurations, shape (N, nq).

    Returns:
        Shape (N, n_v) [rad or m]; −∞ where a joint has no limits.
    """
    low, high = robot.position_limits
    motions = np.array([pin.difference(robot.model, robot.neutral(), each) for each in q])
    return np.asarray(np.maximum(motions - high, low - motions))


def farthest_beyond(robot: Robot, q: Array) -> str:
    """Which joint was how far beyond its position limits at most, in words.

    Args:
        robot: The robot.
        q: Configurations, shape (N, nq), at least one beyond them.
    """
    beyond = beyond_positions(robot, q).max(axis=0)
    i = int(beyond.argmax())
    name, unit = robot.joint_names[i], robot.joint_units[i]
    return f"{name} was {beyond[i]:.2g} {unit} beyond its position limits"


def require_radians(name: str, robot: Robot, q: Array) -> None:
    """Refuse a configuration that is a turn or more beyond the limits of a joint: it is in degrees.

    One that is a little beyond them may be where a run ended.

    Raises:
        InvalidInputError: It is.
    """
    beyond = beyond_positions(robot, q[np.newaxis])[0]
    beyond[np.array(robot.joint_units) != "rad"] = 0.0
    if beyond.max() > 2.0 * np.pi:
        raise InvalidInputError(
            f"{name} must be in radians: it is {beyond.max():.4g} rad beyond the limits of "
            f"{robot.joint_names[int(beyond.argmax())]}; numpy.radians turns degrees into them",
            given=q,
        )


def reach_bound(robot: Robot, frame: str) -> tuple[Array, float]:
    """Where the first joint before a frame stands, shape (3,), and how far from it the frame gets.

    The second is a bound [m]: the arm stretched out along its links, whatever its joints allow;
    infinite with a prismatic joint without limits, or one that mimics another.
    """
    model, there = robot.model, robot.model.frames[robot.frame_id(frame)]
    joints = list(model.supports[there.parentJoint])[1:]
    links = [float(np.linalg.norm(model.jointPlacements[j].translation)) for j in joints[1:]]
    slides = {
        name: max(-low, high)
        for name, unit, low, high in zip(
            robot.joint_names, robot.joint_units, *robot.position_limits, strict=True
        )
        if unit == "m"
    }
    all_joints = robot.mimic_joints.model  # those that mimic others as joints of their own
    for name in (model.names[j] for j in joints):
        kind = all_joints.joints[all_joints.getJointId(name)].shortname()
        if kind.startswith("JointModelP"):
            links.append(float(slides.get(name, math.inf)))
    first = np.array(model.jointPlacements[joints[0]].translation) if joints else np.zeros(3)
    return first, float(sum(links) + np.linalg.norm(there.placement.translation))
