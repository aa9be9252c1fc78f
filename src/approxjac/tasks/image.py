"""The image of points in a camera, eqs. (32) and (33)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from approxjac import law
from approxjac.cameras.camera import Camera, PinholeCamera
from approxjac.errors import InvalidInputError
from approxjac.formatting import listed, short
from approxjac.robots import Robot
from approxjac.tasks.frame_tasks import PointKinematics
from approxjac.tasks.task import Feature, Task
from approxjac.validation import Array, as_array, as_diagonal, require

_APART = 1e-9  # points nearer to one another, or to one line, count as there [m]
_FLAT = 0.05  # of their extent, by which points may leave their plane
_ROUND, _OPEN = 0.2, 0.5  # how round a polygon must be, and what of it must be left in an image


class ImageTask(Task):
    """X = image of one or several points; J = J_I J_e, eq. (33).

    A camera fixed in the world watches points of the robot (eye-to-hand), one with a `mount` is
    carried by the robot and watches points of the world (eye-in-hand). With k points x is
    (u₁, v₁, u₂, v₂, …) and m = 2k. A controller takes at most 6 coordinates, and no more than
    there are joints; `CombinedTask.balanced` reduces larger tasks to that.

    Args:
        robot: The robot, true or believed.
        camera: The camera, true or believed.
        frame: Frame that the points are fixed to. By default the robot's `tip`; for a camera on
            the robot the world (None).
        points: Positions of the points in that frame, shape (k, 3) [m]; by default its origin.
            Required for points of the world.
        depth: Depth of the points in Ĵ_I. "believed": position and depth from the believed robot
            and camera. A number Z > 0, or shape (k,) [m]: that depth on the ray of the *measured*
            image. "measured", for a camera that measures depth: x is (u₁, v₁, Z₁, …), the depths
            are no part of the error, and a lost one is replaced by the believed one.

    Raises:
        UnknownNameError: No such frame.
        InvalidInputError: Points that coincide, are collinear or move with the camera; or a
            depth for a camera without one.
    """

    _kind = "image"
    overdetermined = True

    def __init__(
        self,
        robot: Robot,
        camera: Camera,
        frame: str | None = None,
        points: Sequence[Sequence[float]] | Array | None = None,
        *,
        depth: str | float | Sequence[float] | Array = "believed",
    ) -> None:
        require("camera", camera, Camera, "a camera, such as PlanarCamera(f, z)")
        self.camera = camera
        self._pinhole: Any = camera  # as which only what has depths is used
        if points is None and frame is None and camera.mount is not None:
            raise InvalidInputError(
                f"points must be given for a camera that is carried by the robot: positions in the "
                f"world, shape (k, 3) [m], which it watches; got None with {camera!r}",
                given=points,
            )
        self.points = _points(((0.0, 0.0, 0.0),) if points is None else points)
        k = len(self.points)
        if isinstance(depth, str) and depth not in ("believed", "measured"):
            message = f"depth must be 'believed', 'measured' or numbers > 0 [m], got {depth!r}"
            raise InvalidInputError(message, given=depth)
        self.depth = depth if isinstance(depth, str) else as_diagonal("depth", depth, k, unit="m")
        measured = isinstance(self.depth, str) and self.depth == "measured"
        self.uses_x = not isinstance(self.depth, str) or measured
        if self.uses_x:
            require("camera of a task with depths", camera, PinholeCamera, "a PinholeCamera")
        self._stride = n = 3 if measured else 2  # entries of x for each point
        numbers = range(1, k + 1) if k > 1 else [""]
        labels = [f"{label}{number}" for number in numbers for label in camera.labels]
        super().__init__(robot, labels, (camera.unit,) * (2 * k), n * k)
        self._roundness = _roundness(self.points) if isinstance(camera, PinholeCamera) else 0.0
        vars(self).update(
            subtracts=not measured,
            ignored=list(range(2, n * k, 3)) if measured else [],
            parts=tuple((slice(n * i, n * i + n), slice(2 * i, 2 * i + 2)) for i in range(k)),
        )
        if frame is not None or camera.mount is None:
            frame = robot.tip_or(frame)
        self.frame = frame
        self._kinematics = PointKinematics(robot, self.points, frame, camera.mount)
        self.features = (Feature(slice(0, n * k), frame, "", camera, self.points),)
        if camera.mount is not None and _joint_of(robot, frame) == _joint_of(robot, camera.mount):
            watched = "the world" if frame is None else repr(frame)
            raise InvalidInputError(
                f"frame must move relative to the camera, or its image never changes, got "
                f"{watched} and a camera on {camera.mount!r}",
                given=frame,
            )

    def error(self, x: Array, x_d: Array) -> Array:
        return self._images(x - x_d).ravel()

    def displaced(self, x: Array, e: Array) -> Array:
        images = x.reshape(-1, self._stride)
        return np.concatenate([images[:, :2] + e.reshape(-1, 2), images[:, 2:]], axis=1).ravel()

    def value(self, q: Array) -> Array:
        places = self._kinematics.positions(q)
        entries = [self.camera.project(r) for r in places]
        if self._stride == 3:
            depths = (self._pinhole.in_camera(r)[2:] for r in places)
            entries = [part for pair in zip(entries, depths, strict=True) for part in pair]
        return np.concatenate(entries)

    def visible(self, x: Array) -> Array:
        points = x.reshape(-1, self._stride)
        lost = np.full(self._stride, np.nan)
        seen = (law.is_finite(self.camera.seen(point[:2])) for point in points)
        return np.concatenate([law.select(*each, lost) for each in zip(seen, points, strict=True)])

    def is_mirrored(self, x: Array, other: Array) -> bool:
        if not self._roundness:
            return False
        a, b = (_turn(self._images(each)) for each in (x, other))  # NaN of what is lost
        least = _OPEN * self._roundness  # a polygon that is seen edge on may go either way
        return min(a, b) < -least and max(a, b) > least

    def target(self, x_d: object) -> Array:
        target = super().target(x_d)
        outside = np.nonzero(~np.isfinite(self._images(self.visible(target))).all(axis=1))[0]
        if len(outside):
            size = getattr(self.camera, "size", None)
            where = "" if size is None else f" of {size[0]} x {size[1]} px"
            wrong = self._images(target)[outside[0]].tolist()
            raise InvalidInputError(
                f"target must be within the image{where}, got {wrong} for point {outside[0] + 1}",
                given=x_d,
            )
        return target

    def depths(self, q: Array) -> Array:
        """Return the depths Z of the points in the camera, negative behind it, shape (k,) [m]."""
        require("camera of a task with depths", self.camera, PinholeCamera, "a PinholeCamera")
        return np.array([self._pinhole.in_camera(r)[2] for r in self._kinematics.positions(q)])

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        return self._jacobian(q, self._located(q, x) if self.uses_x else None)

    def sensor_jacobian(self, q: Array) -> Array:
        return self._jacobian(q, None)

    def _jacobian(self, q: Array, at: Array | None) -> Array:
        """Return J with the points where they are, or at other places (k, 3)."""
        r, J = self._kinematics.jacobians(q, at)
        if len(r) == 1:
            return np.asanyarray(self.camera.interaction(r[0]) @ J[0])
        return np.vstack([self.camera.interaction(p) @ A for p, A in zip(r, J, strict=True)])

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        if self.uses_x:
            raise InvalidInputError(
                f"the rate of a Jacobian that uses the measured x is not known: it takes "
                f"depth='believed', got {self!r}",
                given=self.depth,
            )
        return super().jacobian_dot(q, v)

    def on(self, robot: Robot) -> ImageTask:
        depth: Any = self.depth
        return ImageTask(robot, self.camera, self.frame, self.points, depth=depth)

    def _images(self, x: Array) -> Array:
        return x.reshape(-1, self._stride)[:, :2]

    def _located(self, q: Array, x: Array | None) -> Array:
        """Return points (k, 3) on the rays of their images, or of expected ones; or NaN."""
        if x is None:
            x = self.value(q)
        elif law.is_finite(x) is not True:
            x = np.where(np.isfinite(x), x, self.value(q))
        images = x.reshape(-1, self._stride)
        depths = images[:, 2] if self._stride == 3 else np.asarray(self.depth)
        located, nowhere = [], np.full(3, np.nan)
        for image, Z in zip(images, depths.tolist(), strict=True):
            # within the image, as a lever arm grows with the ray
            place = self._pinhole.locate(self._pinhole.nearest(image[:2]), Z)
            located.append(law.select(Z > 0.0, place, nowhere))
        return np.vstack(located)

    def __repr__(self) -> str:
        name = "the world" if self.frame is None else repr(self.frame)
        shown = f"ImageTask({self.robot.name!r}, {self.camera!r}, {name}"
        if len(self.points) > 1 or self.points.any():
            k = len(self.points)
            shown += f", {listed(self.points) if k == 1 else f'{k} points'}"
        depth = self.depth if isinstance(self.depth, str) else short(self.depth)
        return f"{shown}, depth={depth})" if self.uses_x else f"{shown})"


def _joint_of(robot: Robot, frame: str | None) -> int:
    return 0 if frame is None else int(robot.model.frames[robot.frame_id(frame)].parentJoint)


def _points(points: object) -> Array:
    array = as_array("points", points, ("k", 3), "m")
    for i, point in enumerate(array):
        same = np.linalg.norm(array[:i] - point, axis=1) < _APART
        if same.any():
            message = f"points must be different ones, got {point.tolist()} twice"
            raise InvalidInputError(message, given=points)
    spread = np.linalg.svd(array - array.mean(axis=0), compute_uv=False)
    if len(array) > 2 and spread[1] < _APART:
        raise InvalidInputError(
            f"points must not lie on one line: their images do not change as it turns about "
            f"itself, so that the Jacobian is singular everywhere; got {array.tolist()}",
            given=points,
        )
    return array


def _turn(images: Array) -> float:
    """Return twice the area of a polygon (k, 2) over its squared sides, > 0 if clockwise.

    NaN of what is lost, of a single point, and beyond what squares may be.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        u, v = (images - images[0]).T
        sides = images - np.roll(images, -1, axis=0)
        return float((u @ np.roll(v, -1) - v @ np.roll(u, -1)) / np.sum(sides**2))


def _roundness(points: Array) -> float:
    if len(points) < 4:  # a triangle is often seen from either side
        return 0.0
    about = points - points.mean(axis=0)
    _, extent, axes = np.linalg.svd(about)
    turn = abs(_turn(about @ axes[:2].T))
    return turn if extent[2] < _FLAT * extent[1] and turn > _ROUND else 0.0
