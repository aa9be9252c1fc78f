"""Position or pose of a frame as a tracker gives it that nobody has lined up with the base."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from approxjac import law
from approxjac.robots import Robot
from approxjac.tasks.frame_kinematics import FrameKinematics
from approxjac.tasks.pose import PoseTask
from approxjac.tasks.task import Feature, Task
from approxjac.validation import Array, as_array, require


class TrackerTask(Task):
    """X = R p + b: position p of a frame's origin in the axes of a tracker [m].

    Targets are in the tracker's axes, too. A controller that knows nothing of the tracker takes a
    `PositionTask` for it.

    Args:
        robot: The robot, true or believed.
        rotation: R, from the axes of the world to those of the tracker, as a rotation vector,
            shape (3,) [rad].
        offset: b, the origin of the world in the axes of the tracker, shape (3,) [m].
        frame: Frame name; the robot's `tip` by default.

    Raises:
        UnknownNameError: No such frame.
        InvalidInputError: Vectors of another length or not finite.
    """

    _kind = "tracker"

    def __init__(
        self,
        robot: Robot,
        rotation: Sequence[float] | Array = (0.0, 0.0, 0.0),
        offset: Sequence[float] | Array = (0.0, 0.0, 0.0),
        frame: str | None = None,
    ) -> None:
        require("robot", robot, Robot, "a Robot")
        super().__init__(robot, ("x", "y", "z"), ("m", "m", "m"))
        self.rotation = as_array("rotation", rotation, (3,), "rad")
        self.offset = as_array("offset", offset, (3,), "m")
        self.frame = robot.tip_or(frame)
        self._R: Array = pin.exp3(self.rotation)
        self._frame = FrameKinematics(robot, self.frame)
        placed = self._R, self.offset
        self._features = (Feature(slice(0, 3), self.frame, "xyz", placed=placed),)

    def value(self, q: Array) -> Array:
        return self._R @ self._frame.position(q) + self.offset

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        J: Array = self._R @ self._frame.jacobian(q)[:3]
        return J

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        return np.asarray(self._R @ self._frame.jacobian_dot(q, v)[:3])

    def on(self, robot: Robot) -> TrackerTask:
        return TrackerTask(robot, self.rotation, self.offset, self.frame)

    def __repr__(self) -> str:
        rotation, offset = self.rotation.tolist(), self.offset.tolist()
        return f"TrackerTask({self.robot.name!r}, {self.frame!r}, {rotation}, {offset})"


class PoseTrackerTask(PoseTask):
    """X = (R p + b, R R_f): the pose of a frame in the axes of a tracker; m = 6.

    As a `PoseTask` in all else; targets are in the tracker's axes, too. A controller that knows
    nothing of the tracker takes a `PoseTask` for it.

    Args:
        robot: The robot, true or believed.
        rotation: R, from the axes of the world to those of the tracker, as a rotation vector,
            shape (3,) [rad].
        offset: b, the origin of the world in the axes of the tracker, shape (3,) [m].
        frame: Frame name; the robot's `tip` by default.

    Raises:
        UnknownNameError: No such frame.
        InvalidInputError: Fewer than six joints, or vectors of another length or not finite.
    """

    _kind = "pose tracker"

    def __init__(
        self,
        robot: Robot,
        rotation: Sequence[float] | Array = (0.0, 0.0, 0.0),
        offset: Sequence[float] | Array = (0.0, 0.0, 0.0),
        frame: str | None = None,
    ) -> None:
        super().__init__(robot, frame)
        self.rotation = as_array("rotation", rotation, (3,), "rad")
        self.offset = as_array("offset", offset, (3,), "m")
        self._R: Array = pin.exp3(self.rotation)
        placed = self._R, self.offset
        self._features = (Feature(slice(0, 7), self.frame, "xyz", placed=placed),)

    def value(self, q: Array) -> Array:
        R, p = self._placement(q)
        return np.concatenate([p, law.quaternion(R)])

    def _placement(self, q: Array) -> tuple[Array, Array]:
        """Return the rotation (3, 3) and position (3,) [m] of the frame as the tracker sees it."""
        R, p = self._frame.placement(q)
        return self._R @ R, self._R @ p + self.offset

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        return self._turned(self._frame.jacobian(q))

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        return self._turned(self._frame.jacobian_dot(q, v))

    def on(self, robot: Robot) -> PoseTrackerTask:
        return PoseTrackerTask(robot, self.rotation, self.offset, self.frame)

    def _turned(self, J: Array) -> Array:
        return np.concatenate([self._R @ J[:3], self._R @ J[3:]])

    def __repr__(self) -> str:
        rotation, offset = self.rotation.tolist(), self.offset.tolist()
        return f"PoseTrackerTask({self.robot.name!r}, {self.frame!r}, {rotation}, {offset})"
