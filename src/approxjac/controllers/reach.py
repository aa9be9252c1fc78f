"""`Reach`: whether a target is out of reach for sure."""

from __future__ import annotations

import math

from approxjac.controllers.unknown_tool import UNKNOWN_TOOL
from approxjac.robots.joint_limits import reach_bound
from approxjac.tasks import PoseTask, PositionTask, Task
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
        self._task, self.origin, self.most = task, [0.0], math.inf
        if isinstance(task, PositionTask | PoseTask):
            origin, self.most = reach_bound(task.robot, task.frame)
            self.origin = origin[["xyz".index(axis) for axis in task.labels[:3]]].tolist()

    def is_exceeded(self, q: Array, e: Array) -> bool:
        """Return whether a target is too far away for the arm, and a tool that nobody told of.

        It is e (m,) away from where the believed arm is at q: who measures x may stand anywhere.
        """
        k = len(self.origin)
        if math.hypot(*e[:k].tolist()) <= UNKNOWN_TOOL * self.most:
            return False
        there = self._task.value(q)[:k] - e[:k]
        return math.dist(there.tolist(), self.origin) > (1.0 + UNKNOWN_TOOL) * self.most
