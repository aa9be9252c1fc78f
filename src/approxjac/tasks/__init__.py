"""Tasks: quantities that are measured and brought to a target, with their Jacobians."""

from approxjac.tasks.frame_tasks import (
    FrameKinematics,
    PoseTask,
    PoseTrackerTask,
    PositionTask,
    TrackerTask,
    best_axes,
)
from approxjac.tasks.image import ImageTask
from approxjac.tasks.task import Task
from approxjac.tasks.wrapped import CombinedTask, NonsingularTask, StackedTask

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
