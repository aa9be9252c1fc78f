"""Tasks: what is measured and brought to a target, with its Jacobian."""

from approxjac.tasks.combined import CombinedTask
from approxjac.tasks.frame_kinematics import FrameKinematics
from approxjac.tasks.frame_tasks import (
    PoseTask,
    PoseTrackerTask,
    PositionTask,
    TrackerTask,
    best_axes,
)
from approxjac.tasks.image import ImageTask
from approxjac.tasks.nonsingular import NonsingularTask
from approxjac.tasks.stacked import StackedTask
from approxjac.tasks.task import Task

__all__ = [
    "CombinedTask",
    "FrameKinematics",
    "ImageTask",
    "NonsingularTask",
    "PoseTask",
    "PoseTrackerTask",
    "PositionTask",
    "StackedTask",
    "Task",
    "TrackerTask",
    "best_axes",
]
