"""Tasks: what is measured and brought to a target, with its Jacobian."""

from approxjac.tasks.camera import Camera, PlanarCamera
from approxjac.tasks.combined import CombinedTask
from approxjac.tasks.frame_kinematics import FrameKinematics
from approxjac.tasks.image import ImageTask
from approxjac.tasks.nonsingular import NonsingularTask
from approxjac.tasks.pinhole import PinholeCamera
from approxjac.tasks.pose import PoseTask
from approxjac.tasks.position import PositionTask, best_axes
from approxjac.tasks.stacked import StackedTask
from approxjac.tasks.tag import tag_corners
from approxjac.tasks.task import Task
from approxjac.tasks.tracker import PoseTrackerTask, TrackerTask

__all__ = [
    "Camera",
    "CombinedTask",
    "FrameKinematics",
    "ImageTask",
    "NonsingularTask",
    "PinholeCamera",
    "PlanarCamera",
    "PoseTask",
    "PoseTrackerTask",
    "PositionTask",
    "StackedTask",
    "Task",
    "TrackerTask",
    "best_axes",
    "tag_corners",
]
