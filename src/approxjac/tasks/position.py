"""The position of a frame along some of the world's axes."""

from __future__ import annotations

from functools import cache

import numpy as np

from approxjac.robots import Robot
from approxjac.tasks.frame_kinematics import FrameKinematics
from approxjac.tasks.task import Feature, Task
from approxjac.validation import Array, axis_rows, require

_STILL = 1e-4  # share of the fastest axis below which nothing moves along it (URDFs are rounded)


class PositionTask(Task):
    """X = position of a frame's origin along world axes [m].

    Args:
        robot: The robot, true or believed.
        frame: Frame name; the robot's `tip` by default.
        axes: World axes in the order wanted, such as "xyz" or "xz"; by default those that the arm
            commands: all three, or of a planar arm or one with fewer joints the best of them
            (`best_axes`).

    Raises:
        UnknownNameError: No such frame, or an axis that is not x, y or z.
        InvalidInputError: No or doubled axes, or more of them than joints.
    """

    _kind = "position"

    def __init__(self, robot: Robot, frame: str | None = None, axes: str | None = None) -> None:
        require("robot", robot, Robot, "a Robot")
        self.frame = robot.tip_or(frame)
        self.axes = best_axes(robot, self.frame) if axes is None else axes
        self._rows = _as_slice(tuple(axis_rows("axes", self.axes)))
        super().__init__(robot, tuple(self.axes), ("m",) * len(self.axes))
        self._frame = FrameKinematics(robot, self.frame)
        self._features = (Feature(slice(0, self.m), self.frame, self.axes),)

    def value(self, q: Array) -> Array:
        return self._frame.position(q)[self._rows]

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        return self._frame.jacobian(q)[self._rows]

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        return self._frame.jacobian_dot(q, v)[self._rows]

    def on(self, robot: Robot) -> PositionTask:
        return PositionTask(robot, self.frame, self.axes)

    def __repr__(self) -> str:
        return f"PositionTask({self.robot.name!r}, {self.frame!r}, {self.axes!r})"


@cache
def _as_slice(rows: tuple[int, ...]) -> slice | list[int]:
    """Return rows at equal distances as a slice, which NumPy takes without a copy."""
    step = rows[1] - rows[0] if len(rows) > 1 else 1
    end = rows[-1] + step
    found = slice(rows[0], end if end >= 0 else None, step)
    return found if tuple(range(3))[found] == rows else list(rows)


def best_axes(robot: Robot, frame: str | None = None) -> str:
    """Return world axes along which an arm commands a frame (its `tip` by default).

    "xyz" without the axes along which nothing moves the frame, as of a planar arm; and of an arm
    with fewer joints as many as joints, those along which it moves fastest, in the mean over seeded
    configurations.
    """
    rng, kinematics = np.random.default_rng(0), FrameKinematics(robot, robot.tip_or(frame))
    drawn = [robot.random_configuration(rng) for _ in range(20)]
    jacobians = np.array([kinematics.jacobian(q)[:3] for q in drawn])
    speeds = np.linalg.norm(jacobians, axis=2).sum(axis=0)
    moving = int((speeds > _STILL * speeds.max()).sum()) or 3
    return "".join("xyz"[i] for i in sorted(np.argsort(-speeds)[: min(moving, robot.nv)]))
