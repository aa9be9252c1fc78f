"""Unknowns of an image, in words and plausible errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from approxjac.cameras import PinholeCamera
from approxjac.controllers.arguments import chosen_deviations, chosen_kinds
from approxjac.controllers.learning.image_estimator import Deviations, ImageEstimate
from approxjac.controllers.learning.watched_points import WatchedPoints
from approxjac.errors import InvalidInputError
from approxjac.tasks import CombinedTask, ImageTask
from approxjac.tasks.analysis import controllable_coordinates, require_controllable
from approxjac.validation import Array, require

USUAL_SD: Mapping[str, float] = {
    "tool": 0.2, "points": 0.2, "origins": 0.02, "position": 0.5, "rotation": 1.0,
    "focal_length": 0.3,
}  # fmt: skip
"""Plausible errors: of translations along each axis [m], rotation [rad], and the log of f."""
_THREE = "; of a tag take three corners, ImageTask(robot, camera, points=points[:3])"


class CameraUnknowns:
    """Unknowns of the image of points in a pinhole camera.

    Args:
        task: Image of the points, of the believed robot.
        unknown: What may be wrong, or None for the usual.
        sd: Plausible errors in place of those of `USUAL_SD`.

    Attributes:
        camera: The believed camera.
        kinds: What may be wrong.
        points: The points, linear in translations.
        believed: What is believed.
        sd: Plausible errors of it, 0 of what is known.
        names: Names of what is learnt, in the order of an estimate.
        units: Their units.
    """

    def __init__(self, task: Any, unknown: Any, sd: Any) -> None:
        self.camera = camera = _camera(task)
        where = "tool" if camera.mount is None else "points"
        valid = (where, "origins", "camera", "focal_length")
        self.kinds = kinds = chosen_kinds(
            (where, *valid[2:]) if unknown is None else unknown, valid
        )
        used = {*kinds, *(("position", "rotation") if "camera" in kinds else ())}
        sds = chosen_deviations(sd, USUAL_SD, used)
        self.points = points = WatchedPoints(task, where in kinds, "origins" in kinds)
        R, p = np.asarray(camera.rotation).T, np.asarray(camera.position)
        self.believed = ImageEstimate(points.u, R, p, 0.0)
        moves, zooms = "camera" in kinds, "focal_length" in kinds
        self.sd = Deviations(
            np.where(points.is_points, sds[where], sds["origins"]),
            moves * sds["position"],
            moves * sds["rotation"],
            zooms * sds["focal_length"],
        )
        pose = [f"camera.{each}" for each in ("x", "y", "z", "rx", "ry", "rz")] if moves else []
        zoom = ["focal_length"] if zooms else []
        self.names = (*points.names, *pose, *zoom)
        self.units = tuple(
            "px" if name in zoom else "rad" if name in pose[3:] else "m" for name in self.names
        )

    def unsure(self, moved: Array) -> Array:
        """Return the standard deviation of moves (k, 3, n_u) of the points, shape (k,) [m]."""
        return np.asarray(np.sqrt(((moved * self.sd.u) ** 2).sum(axis=(1, 2))))


def _camera(task: Any) -> PinholeCamera:
    """Return the camera of a task that can be learnt."""
    wanted = "an ImageTask of the believed robot"
    if isinstance(task, CombinedTask):
        wanted += f" without a combination of coordinates{_THREE}"
    require("task", task, ImageTask, wanted)
    if task.m > controllable_coordinates(task) == 6:
        raise InvalidInputError(
            f"task must have at most 6 coordinates, got {task!r} with {task.m}{_THREE}",
            given=task,
        )
    require_controllable(task)
    camera = task.camera
    if not isinstance(camera, PinholeCamera):
        raise InvalidInputError(
            f"task must have a PinholeCamera, got {task!r}; AdaptivePlanarCamera is for one that "
            "looks straight at the plane of an arm",
            given=task,
        )
    if task._uses_x:
        raise InvalidInputError(
            f"task must have depth='believed', as depth is learnt, got {task!r}", given=task
        )
    if camera.mount is not None and task.frame is not None:
        raise InvalidInputError(
            f"task of a camera that is carried must watch points of the world, frame=None, "
            f"got {task!r}",
            given=task,
        )
    return camera
