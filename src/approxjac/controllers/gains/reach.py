"""`Reach`: whether a target is out of reach for sure."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from approxjac.law.products import length
from approxjac.robots import Robot
from approxjac.robots.urdf import direction
from approxjac.tasks import PoseTask, PositionTask, Task
from approxjac.tasks.frame_tasks import FrameKinematics
from approxjac.validation import Array


class Reach:
    """Bound on the reach of the believed arm; infinite for other tasks than positions and poses.

    Attributes:
        origin: Where the arm begins [unit of the task].
        most: How far it reaches from there.

    Args:
        task: The task of the believed robot.
    """

    def __init__(self, task: Task) -> None:
        self._task, self.origin, self.most = task, np.zeros(1), math.inf
        if isinstance(task, PositionTask | PoseTask):
            origin, self.most = task.robot.reach_bound(task.frame)
            self.origin = origin[["xyz".index(axis) for axis in task.labels[:3]]]

    def is_exceeded(self, q: Array, e: Array) -> Any:
        """Return whether a target is too far away for the arm, and an unmodelled tool.

        It is e (m,) away from where the believed arm is at q: who measures x may stand anywhere.
        """
        k = len(self.origin)
        if self.most == math.inf:
            return False
        is_far = length(e[:k]) > UNKNOWN_TOOL * self.most
        if is_far is False:
            return False
        there = self._task.value(q)[:k] - e[:k] - self.origin
        return is_far & (length(there) > (1.0 + UNKNOWN_TOOL) * self.most)


UNKNOWN_TOOL = 0.18
"""Length of an unmodelled tool, as a share of the arm's reach."""


def with_unknown_tool(robot: Robot) -> Robot:
    """Return a robot whose tip is farther out, by the length of an unmodelled tool."""
    if robot.tip is None:
        return robot
    joint = next(each for each in robot.tree.joints.values() if each.child == robot.tip)
    neutral = robot.neutral()
    of_parent, of_tip = (
        FrameKinematics(robot, frame).placement(neutral)[0] for frame in (joint.parent, robot.tip)
    )
    _, reach = robot.reach_bound(robot.tip)
    longer = UNKNOWN_TOOL * reach if math.isfinite(reach) else 0.0
    shift = longer * of_parent.T @ of_tip @ np.asarray(direction(robot.outward_axis()))
    return robot.with_kinematic_error({joint.name: shift.tolist()})
