"""The image of a frame in a camera, eqs. (32) and (33)."""

from __future__ import annotations

from approxjac.checks import Array, require
from approxjac.robots import Robot
from approxjac.tasks.camera import Camera
from approxjac.tasks.frame import FrameKinematics
from approxjac.tasks.task import Task, require_rows


class ImageTask(Task):
    """X = image of a frame's origin; J = J_I J_e, eq. (33).

    On the believed robot with the believed camera its Jacobian is the paper's Ĵ = Ĵ_I Ĵ_e.

    Args:
        robot: The robot, true or believed.
        camera: The camera, true or believed.
        frame: Frame that is seen; the robot's `tip` by default.

    Raises:
        UnknownNameError: No such frame.
        InvalidInputError: More image coordinates than joints.
    """

    def __init__(self, robot: Robot, camera: Camera, frame: str | None = None) -> None:
        require("robot", robot, Robot, "a Robot")
        require("camera", camera, Camera, "a camera, such as PlanarCamera(f, z)")
        self._frame = FrameKinematics(robot, robot.tip_or(frame))
        self._camera = camera
        require_rows(len(camera.labels), robot)

    @property
    def robot(self) -> Robot:
        return self._frame.robot

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self._camera

    @property
    def frame(self) -> str:
        """Name of the frame that is seen."""
        return self._frame.frame

    @property
    def labels(self) -> tuple[str, ...]:
        return self._camera.labels

    @property
    def units(self) -> tuple[str, ...]:
        return (self._camera.unit,) * len(self._camera.labels)

    def value(self, q: Array) -> Array:
        return self._camera.project(self._frame.position(q))

    def compute_jacobian(self, q: Array, x: Array | None = None) -> Array:
        r = self._frame.position(q)
        return self._camera.interaction(r) @ self._frame.compute_jacobian(q)[:3]

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        r, J_e = self._frame.position(q), self._frame.jacobian(q)[:3]
        J_e_dot = self._frame.jacobian_dot(q, v)[:3]
        J_I_dot = self._camera.interaction_dot(r, J_e @ v)
        return self._camera.interaction(r) @ J_e_dot + J_I_dot @ J_e

    def on(self, robot: Robot) -> ImageTask:
        return ImageTask(robot, self._camera, self.frame)

    def __repr__(self) -> str:
        return f"ImageTask({self.robot.name!r}, {self.camera!r}, {self.frame!r})"
