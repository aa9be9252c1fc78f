"""A tool that nobody told of: how long it may be."""

from __future__ import annotations

import math

import numpy as np

from approxjac.robots import Robot
from approxjac.robots.joint_limits import reach_bound
from approxjac.robots.urdf_edit import direction
from approxjac.tasks.frame_kinematics import FrameKinematics

UNKNOWN_TOOL = 0.18
"""Length of a tool that nobody told of, as a share of the arm's reach."""


def with_unknown_tool(robot: Robot) -> Robot:
    """Return a robot whose tip is farther out, by the length of a tool that nobody told of."""
    if robot.tip is None:
        return robot
    joint = next(each for each in robot.tree.joints.values() if each.child == robot.tip)
    neutral = robot.neutral()
    of_parent, of_tip = (
        FrameKinematics(robot, frame).placement(neutral)[0] for frame in (joint.parent, robot.tip)
    )
    _, reach = reach_bound(robot, robot.tip)
    length = UNKNOWN_TOOL * reach if math.isfinite(reach) else 0.0
    shift = length * of_parent.T @ of_tip @ np.asarray(direction(robot.outward_axis()))
    return robot.with_kinematic_error({joint.name: shift.tolist()})
