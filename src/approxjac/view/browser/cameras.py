"""Cameras as the page draws them: an apex, and the image on a rectangle before it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from approxjac.tasks import Camera, PinholeCamera, PlanarCamera, Task
from approxjac.tasks.analysis import features
from approxjac.tasks.feature import Feature
from approxjac.validation import Array, axis_rows

_NEAR = 0.18  # where the image is drawn, of the way to what the camera looks at
_IN_HAND = 0.12  # the same of a camera on the arm, of the arm's size
_BEYOND = 1.3  # how far lines of sight are drawn, of the same way


def image_feature(task: Task | None) -> Feature | None:
    """Return the first part of a task that a camera sees."""
    return next((feature for feature in features(task) if feature.camera is not None), None)


def camera_view(task: Task | None, size: float, middle: Array) -> dict[str, Any] | None:
    """Return how the camera of a task is drawn, in the axes of what it is fixed to, if it has one.

    The image coordinates X are at `corner` + a `right` + b `down` with (a, b) = (X − low)/(high −
    low). Lens distortion is left out of the drawing.

    Args:
        task: A task with a camera, or another one.
        size: Of the arm [m].
        middle: Of the arm, in the world, shape (3,) [m].

    Returns:
        "apex", "corner", "right", "down" (3,) [m]; "low", "high" (2,) [unit of the image];
        "reach", how far lines of sight go, in distances of the image; "mount", a frame or None.
    """
    feature = image_feature(task)
    camera = None if feature is None else feature.camera
    if isinstance(camera, PinholeCamera):
        apex, at, low, high, reach = _pinhole(camera, size, middle)
    elif isinstance(camera, PlanarCamera):
        apex, at, low, high, reach = _planar(camera, size)
    else:
        return None
    corner = at(low)
    return {
        "apex": apex, "corner": corner, "right": at(np.array([high[0], low[1]])) - corner,
        "down": at(np.array([low[0], high[1]])) - corner, "low": low, "high": high,
        "reach": reach, "mount": camera.mount,
    }  # fmt: skip


_Drawn = tuple[Array, Callable[[Array], Array], Array, Array, float]


def _pinhole(camera: PinholeCamera, size: float, middle: Array) -> _Drawn:
    R, p = camera.placement()
    f, c = np.array(camera.focal_length), np.array(camera.center, dtype=float)
    away = float(np.linalg.norm(middle - p))
    depth = _NEAR * away if camera.mount is None else _IN_HAND * size
    reach = (_BEYOND * away if camera.mount is None else 0.5 * size) / depth

    def at(x: Array) -> Array:
        return np.asarray(R @ (depth * np.append((x - c) / f, 1.0)) + p)

    return p, at, np.array([-0.5, -0.5]), np.array(camera.size) - 0.5, reach


def _planar(camera: PlanarCamera, size: float) -> _Drawn:
    """Draw the paper's camera, which sees without end, with an image as large as the arm.

    It stands over the middle of its image, at the depth z − f of the equal pinhole camera.
    """
    rows = axis_rows("plane", camera.plane)
    J = camera.interaction(np.zeros(3))[:, rows]
    half = 1.05 * size * camera.magnification

    def in_plane(x: Array) -> Array:
        point = np.zeros(3)
        point[rows] = np.linalg.solve(J, x)
        return point

    normal = np.cross(*np.eye(3)[rows])
    apex = in_plane(np.zeros(2)) + (camera.distance - camera.focal_length) * normal

    def at(x: Array) -> Array:
        return np.asarray(apex + _NEAR * (in_plane(x) - apex))

    # y_s points up
    return apex, at, np.array([-half, half]), np.array([half, -half]), _BEYOND / _NEAR


def image_axes(camera: Camera) -> dict[str, Any]:
    """Return names, unit and borders of the image's coordinates, as they are plotted."""
    unit, scale = ("mm", 1e3) if camera.unit == "m" else (camera.unit, 1.0)
    border = None
    if isinstance(camera, PinholeCamera):
        border = [-0.5, -0.5, camera.size[0] - 0.5, camera.size[1] - 0.5]
    down = border is not None  # v of a pinhole camera points down
    labels = list(camera.labels)
    return {"labels": labels, "unit": unit, "scale": scale, "border": border, "down": down}
