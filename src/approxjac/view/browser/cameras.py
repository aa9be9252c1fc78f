"""Cameras as the page draws them: an apex, and the image on a rectangle before it."""

from __future__ import annotations

from typing import Any

import numpy as np

from approxjac.tasks import Camera, PinholeCamera, PlanarCamera, Task
from approxjac.tasks.analysis import features
from approxjac.tasks.task import Feature
from approxjac.validation import Array, plane_rows
from approxjac.view.style import display_unit

_NEAR = 0.18  # to the image as it is drawn, of the way to what the camera looks at
_IN_HAND = 0.12  # the same of a camera on the arm, of the arm's size
_BEYOND = 1.3  # to the end of lines of sight, of the way to what the camera looks at


def image_feature(task: Task | None) -> Feature | None:
    """Return the first part of a task that a camera sees."""
    return next((feature for feature in features(task) if feature.camera is not None), None)


def camera_view(task: Task | None, size: float, middle: Array) -> dict[str, Any] | None:
    """Return how the camera of a task is drawn, in the axes of what it is fixed to, if it has one.

    The image coordinates X are at `corner` + a `right` + b `down` with (a, b) = (X − low)/(high −
    low). Lens distortion is left out of the drawing.

    The arm has a size [m], and its middle (3,) in the world [m].

    Returns:
        "apex", "corner", "right", "down" (3,) [m]; "low", "high" (2,) [unit of the image];
        "reach", how far lines of sight go, in distances of the image; "mount", a frame or None.
    """
    feature = image_feature(task)
    camera = None if feature is None else feature.camera
    near, reach = _NEAR, _BEYOND / _NEAR
    if isinstance(camera, PinholeCamera):
        R, apex = camera.placement()
        f, c = np.array(camera.focal_length), np.array(camera.center, dtype=float)
        low, high = np.array([-0.5, -0.5]), np.array(camera.size) - 0.5
        near *= float(np.linalg.norm(middle - apex))
        if camera.mount is not None:
            near, reach = _IN_HAND * size, 0.5 / _IN_HAND

        def ray(x: Array) -> Array:
            return np.asarray(R @ np.append((x - c) / f, 1.0))

    elif isinstance(camera, PlanarCamera):
        # it sees without end: its image is as large as the arm, and it stands over the middle of
        # that, at the depth z − f of the equal pinhole camera
        rows, center = plane_rows(camera.plane), np.array(camera.offset)
        J = camera.interaction(np.zeros(3))[:, rows]
        half = 1.05 * size * camera.magnification * np.array([1.0, -1.0])  # y_s points up
        low, high = center - half, center + half
        normal = np.cross(*np.eye(3)[rows])
        apex = (camera.distance - camera.focal_length) * normal

        def ray(x: Array) -> Array:
            return np.eye(3)[:, rows] @ np.linalg.solve(J, x - center) - apex

    else:
        return None
    corner = apex + near * ray(low)
    return {
        "apex": apex, "corner": corner,
        "right": apex + near * ray(np.array([high[0], low[1]])) - corner,
        "down": apex + near * ray(np.array([low[0], high[1]])) - corner,
        "low": low, "high": high, "reach": reach, "mount": camera.mount,
    }  # fmt: skip


def image_axes(camera: Camera) -> dict[str, Any]:
    """Return names, unit and borders of the image's coordinates, as they are plotted."""
    unit, scale = display_unit(camera.unit)
    border = None
    if isinstance(camera, PinholeCamera):
        border = [-0.5, -0.5, camera.size[0] - 0.5, camera.size[1] - 0.5]
    down = border is not None  # v of a pinhole camera points down
    labels = list(camera.labels)
    return {"labels": labels, "unit": unit, "scale": scale, "border": border, "down": down}
