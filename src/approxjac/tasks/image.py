"""The image of points in a camera, eqs. (32) and (33)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.robots import Robot
from approxjac.tasks.camera import Camera
from approxjac.tasks.pinhole import PinholeCamera
from approxjac.tasks.point_kinematics import PointKinematics
from approxjac.tasks.task import Task, require_rows
from approxjac.validation import Array, as_array, as_number, is_scalar, require, shape_of

_APART = 1e-9  # points nearer to one another, or to one line, count as there [m]


class ImageTask(Task):
    """X = image of one or several points; J = J_I J_e, eq. (33).

    On the believed robot with the believed camera its Jacobian is the paper's Ĵ = Ĵ_I Ĵ_e. A
    camera fixed in the world watches points of the robot (eye-to-hand), one with a `mount` is
    carried by the robot and watches points of the world (eye-in-hand).

    With k points x is (u₁, v₁, u₂, v₂, …) and m = 2k.

    What Ĵ_I needs of a point is where it is. By default that is where the believed robot and the
    believed camera have it. With a depth of its own, a point is on the ray of its *measured*
    image, at that depth, as classical visual servoing has it.

    Args:
        robot: The robot, true or believed.
        camera: The camera, true or believed.
        frame: Frame that the points are fixed to. By default the robot's `tip`, or the world where
            the camera is carried by the robot.
        points: Positions of the points in that frame, shape (k, 3) [m]; its origin by default. To
            be given for points of the world.
        depth: "believed"; or Z > 0 that is taken for every point, or one for each point [m]; or
            "measured" for a camera that measures it: then x is (u₁, v₁, Z₁, …) and has n_x = 3k
            entries. The depths are no part of the error, and those of a target are not used. Where
            none is measured (Z is not finite, or not > 0) it is the believed one.

    Raises:
        UnknownNameError: No such frame.
        InvalidInputError: More image coordinates than joints; points that are the same or three
            that lie on one line, whose image never tells how the body is turned about it; points
            that move with the camera; a depth for a camera that has none.
    """

    def __init__(
        self,
        robot: Robot,
        camera: Camera,
        frame: str | None = None,
        points: Sequence[Sequence[float]] | Array | None = None,
        *,
        depth: str | float | Sequence[float] | Array = "believed",
    ) -> None:
        require("robot", robot, Robot, "a Robot")
        require("camera", camera, Camera, "a camera, such as PlanarCamera(f, z)")
        self._camera = camera
        if points is None and frame is None and camera.mount is not None:
            raise InvalidInputError(
                f"points must be given for a camera that is carried by the robot: positions in the "
                f"world, shape (k, 3) [m], which it watches; got None with {camera!r}",
                given=points,
            )
        self._points = _points(((0.0, 0.0, 0.0),) if points is None else points)
        require_rows(2 * len(self._points), robot)
        if frame is not None or camera.mount is None:
            frame = robot.tip_or(frame)
        self._kinematics = PointKinematics(robot, self._points, frame, camera.mount)
        if camera.mount is not None and _joint_of(robot, frame) == _joint_of(robot, camera.mount):
            watched = "the world" if frame is None else repr(frame)
            raise InvalidInputError(
                f"frame must move relative to the camera, or its image never changes, got "
                f"{watched} and a camera on {camera.mount!r}",
                given=frame,
            )
        self._depth = _depth(depth, camera, len(self._points))

    @property
    def robot(self) -> Robot:
        return self._kinematics.robot

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self._camera

    @property
    def frame(self) -> str | None:
        """Name of the frame that the points are fixed to; None is the world."""
        return self._kinematics.frame

    @property
    def points(self) -> Array:
        """Positions of the points in that frame, shape (k, 3) [m]."""
        return self._points

    @property
    def depth(self) -> str | Array:
        """What was chosen: a word, or the depth that is taken for each point, shape (k,) [m]."""
        return self._depth

    @property
    def labels(self) -> tuple[str, ...]:
        labels = self._camera.labels
        if len(self._points) == 1:
            return labels
        return tuple(f"{label}{i}" for i in range(1, len(self._points) + 1) for label in labels)

    @property
    def units(self) -> tuple[str, ...]:
        return (self._camera.unit,) * (2 * len(self._points))

    @property
    def n_x(self) -> int:
        return self._stride * len(self._points)

    @property
    def _stride(self) -> int:
        """Entries of x for each point."""
        return 3 if self._measures_depth else 2

    @property
    def _measures_depth(self) -> bool:
        return isinstance(self._depth, str) and self._depth == "measured"

    @property
    def parts(self) -> tuple[tuple[slice, slice], ...]:
        n = self._stride
        return tuple(
            (slice(n * i, n * i + n), slice(2 * i, 2 * i + 2)) for i in range(len(self._points))
        )

    @property
    def jacobian_uses_x(self) -> bool:
        return not (isinstance(self._depth, str) and self._depth == "believed")

    @property
    def subtracts(self) -> bool:
        return not self._measures_depth

    def error(self, x: Array, x_d: Array) -> Array:
        return self._images(x - x_d).ravel()

    def displaced(self, x: Array, e: Array) -> Array:
        moved = x.reshape(-1, self._stride).copy()
        moved[:, :2] += e.reshape(-1, 2)
        return moved.ravel()

    def with_error(self, x: Array, x_d: Array, e: Array) -> Array:
        placed = x.reshape(-1, self._stride).copy()
        placed[:, :2] = self._images(x_d) + e.reshape(-1, 2)
        return placed.ravel()

    def error_jacobian(self, e: Array, J: Array) -> Array:
        return J

    def value(self, q: Array) -> Array:
        images = []
        for r in self._kinematics.positions(q):
            image = self._camera.project(r)
            if self._measures_depth:
                image = np.append(image, self._pinhole.in_camera(r)[2])
            images.append(image)
        return np.concatenate(images)

    def seen(self, x: Array) -> Array:
        delivered = x.reshape(-1, self._stride).copy()
        for point in delivered:
            if not np.isfinite(self._camera.seen(point[:2])).all():
                point[:] = np.nan
        return delivered.ravel()

    def target(self, x_d: object) -> Array:
        target = super().target(x_d)
        outside = np.nonzero(~np.isfinite(self._images(self.seen(target))).all(axis=1))[0]
        if len(outside):
            size = ""
            if isinstance(self._camera, PinholeCamera):
                size = f" of {self._camera.size[0]} x {self._camera.size[1]} px"
            wrong = self._images(target)[outside[0]].tolist()
            raise InvalidInputError(
                f"target must be within the image{size}, got {wrong} for point {outside[0] + 1}",
                given=x_d,
            )
        return target

    def depths(self, q: Array) -> Array:
        """Depths Z of the points in the camera, negative behind it, shape (k,) [m].

        Raises:
            InvalidInputError: A q that is none, or a camera without depth.
        """
        if not isinstance(self._camera, PinholeCamera):
            raise InvalidInputError(
                f"depths are those of a PinholeCamera, got {self._camera!r}", given=self._camera
            )
        return np.array([self._camera.in_camera(r)[2] for r in self._kinematics.positions(q)])

    def compute_jacobian(self, q: Array, x: Array | None = None) -> Array:
        return self._jacobian(q, self._located(q, x) if self.jacobian_uses_x else None)

    def sensor_jacobian(self, q: Array) -> Array:
        return self._jacobian(self.robot.configuration(q), None)  # at the depths that are so

    def _jacobian(self, q: Array, at: Array | None) -> Array:
        """J with the points where they are, or elsewhere (k, 3); see `PointKinematics`."""
        r, J = self._kinematics.jacobians(q, at)
        if len(r) == 1:
            image_jacobian: Array = self._camera.interaction(r[0]) @ J[0]
            return image_jacobian
        return np.vstack([self._camera.interaction(p) @ A for p, A in zip(r, J, strict=True)])

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        if self.jacobian_uses_x:
            raise InvalidInputError(
                f"the rate of a Jacobian that uses the measured x is not known: it takes "
                f"depth='believed', got {self!r}",
                given=self._depth,
            )
        motion, camera = self._kinematics.motion(q, v), self._camera
        return np.vstack(
            [
                camera.interaction_dot(r, r_dot) @ J + camera.interaction(r) @ J_dot
                for r, J, r_dot, J_dot in zip(*motion, strict=True)
            ]
        )

    def on(self, robot: Robot) -> ImageTask:
        depth: Any = self._depth
        return ImageTask(robot, self._camera, self.frame, self._points, depth=depth)

    def _images(self, x: Array) -> Array:
        """Image coordinates of each point of a value, shape (k, 2)."""
        return x.reshape(-1, self._stride)[:, :2]

    def _located(self, q: Array, x: Array | None) -> Array:
        """Where the points are by their measured images, shape (k, 3).

        Images that are lost are those that this robot would see; NaN if it would not either.
        """
        if x is None:
            x = self.value(q)
        elif not math.isfinite(math.hypot(*x.tolist())):
            x = np.where(np.isfinite(x), x, self.value(q))
        images = x.reshape(-1, self._stride)
        depths = images[:, 2] if self._measures_depth else np.asarray(self._depth)
        found = np.empty((len(images), 3))
        for i, Z in enumerate(depths.tolist()):
            # NaN where an image is that of a point that this robot would not see either
            found[i] = np.nan
            if Z > 0.0:  # within the image, as a lever arm grows with the ray
                found[i] = self._pinhole.locate(self._pinhole.nearest(images[i, :2]), Z)
        return found

    @property
    def _pinhole(self) -> PinholeCamera:
        assert isinstance(self._camera, PinholeCamera)  # no other has depths or edges
        return self._camera

    def __repr__(self) -> str:
        name = "the world" if self.frame is None else repr(self.frame)
        shown = f"ImageTask({self.robot.name!r}, {self._camera!r}, {name}"
        if len(self._points) > 1 or self._points.any():
            shown += f", {self._points.tolist()}"
        if self.jacobian_uses_x:
            depth = self._depth if isinstance(self._depth, str) else self._depth.tolist()
            shown += f", depth={depth!r}"
        return shown + ")"


def _joint_of(robot: Robot, frame: str | None) -> int:
    """Index of the joint that a frame moves with; 0 is the world."""
    return 0 if frame is None else int(robot.model.frames[robot.frame_id(frame)].parentJoint)


def _points(points: object) -> Array:
    """Points as an array of shape (k, 3), no two the same and no three on one line."""
    shape = shape_of(points)
    if len(shape) != 2 or shape[0] == 0:
        raise InvalidInputError(
            f"points must be a list of positions (x, y, z) [m], got {points!r}", given=points
        )
    array = as_array("points", points, (shape[0], 3), "m")
    for i, point in enumerate(array):
        same = np.linalg.norm(array[:i] - point, axis=1) < _APART
        if same.any():
            raise InvalidInputError(
                f"points must be different ones, got {point.tolist()} twice", given=points
            )
    spread = np.linalg.svd(array - array.mean(axis=0), compute_uv=False)
    if len(array) > 2 and spread[1] < _APART:
        raise InvalidInputError(
            f"points must not lie on one line: their images do not change as it turns about "
            f"itself, so that the Jacobian is singular in every posture; got {array.tolist()}",
            given=points,
        )
    return array


def _depth(depth: object, camera: Camera, k: int) -> str | Array:
    if isinstance(depth, str):
        if depth not in ("believed", "measured"):
            raise InvalidInputError(
                f"depth must be 'believed', 'measured' or numbers > 0 [m], got {depth!r}",
                given=depth,
            )
        chosen: str | Array = depth
    elif is_scalar(depth):
        chosen = np.full(k, as_number("depth", depth, unit="m", above=0.0))
        chosen.flags.writeable = False
    else:
        chosen = as_array("depth", depth, (k,), "m")
        if not (chosen > 0.0).all():
            raise InvalidInputError(
                f"depth must be > 0 [m] for each point, got {chosen.tolist()}", given=depth
            )
    if not (isinstance(chosen, str) and chosen == "believed"):
        require("camera of a task with depths", camera, PinholeCamera, "a PinholeCamera")
    return chosen
