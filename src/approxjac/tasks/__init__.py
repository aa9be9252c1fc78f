"""Tasks: quantities that are measured and brought to a target, with their Jacobians."""

from approxjac.tasks.frame_tasks import FrameKinematics as FrameKinematics
from approxjac.tasks.frame_tasks import PoseTask as PoseTask
from approxjac.tasks.frame_tasks import PoseTrackerTask as PoseTrackerTask
from approxjac.tasks.frame_tasks import PositionTask as PositionTask
from approxjac.tasks.frame_tasks import TrackerTask as TrackerTask
from approxjac.tasks.frame_tasks import best_axes as best_axes
from approxjac.tasks.image import ImageTask as ImageTask
from approxjac.tasks.task import Task as Task
from approxjac.tasks.wrapped import CombinedTask as CombinedTask
from approxjac.tasks.wrapped import NonsingularTask as NonsingularTask
from approxjac.tasks.wrapped import StackedTask as StackedTask
