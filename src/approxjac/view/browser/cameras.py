"""Cameras as the page draws them: an apex, and the image on a rectangle before it."""

from __future__ import annotations

from typing import Any

import numpy as np

from approxjac.tasks import Camera, PinholeCamera, PlanarCamera
from approxjac.tasks.feature import Feature
from approxjac.validation import Array, axis_rows

_NEAR = 0.18  # where the image is drawn, of the way to what the camera looks at
_IN_HAND = 0.12  # the same of a camera on the arm, of the arm's size
_BEYOND = 1.3  # how far lines of sight are drawn, of the same way


def camera_view(feature: Feature | None, size: float, middle: Array) -> dict[str, Any] | None:
    """How a camera is drawn, in the axes of what it is fixed to.

    The image coordinates X are at `corner` + a `right` + b `down` with (a, b) = (X − low)/(high −
    low). Lens distortion is left out of the drawing.

    Args:
        feature: What sees it, and what it sees; None, or one without a camera, gives None.
        size: Of the arm [m].
        middle: Of the arm, in the world, shape (3,) [m].

    Returns:
        "apex", "corner", "right", "down" (3,) [m]; "low", "high" (2,) [unit of the image];
        "reach", how far lines of sight go, in distances of the image; "mount", a frame or None.
    """
    camera = None if feature is None else feature.camera
    if isinstance(camera, PinholeCamera):
        return _pinhole(camera, size, middle)
    if isinstance(camera, PlanarCamera):
        return _planar(camera, size)
    return None


def _pinhole(camera: PinholeCamera, size: float, middle: Array) -> dict[str, Any]:
    R, p = camera.placement()
    f, c = np.array(camera.focal_length), np.array(camera.center, dtype=float)
    away = float(np.linalg.norm(middle - p)) if camera.mount is None else np.inf
    depth = min(_NEAR * away, _IN_HAND * size) if camera.mount else _NEAR * away
    low = np.array([-0.5, -0.5])
    high = np.array(camera.size) - 0.5

    def at(u: float, v: float) -> Array:
        ray = np.append((np.array([u, v]) - c) / f, 1.0)
        return np.asarray(R @ (depth * ray) + p)

    corner = at(low[0], low[1])
    reach = (_BEYOND * away if camera.mount is None else 0.5 * size) / depth
    return {
        "apex": p, "corner": corner, "right": at(high[0], low[1]) - corner,
        "down": at(low[0], high[1]) - corner, "low": low, "high": high, "reach": reach,
        "mount": camera.mount,
    }  # fmt: skip


def _planar(camera: PlanarCamera, size: float) -> dict[str, Any]:
    """The paper's camera sees without end: it is drawn with an image as large as the arm.

    It stands over the middle of its image, at the depth z − f of the equal pinhole camera.
    """
    rows = axis_rows("plane", camera.plane)
    J = camera.interaction(np.zeros(3))[:, rows]
    half = 1.05 * size * camera.magnification
    low, high = np.array([-half, half]), np.array([half, -half])  # y_s points up

    def in_plane(x: Array) -> Array:
        point = np.zeros(3)
        point[rows] = np.linalg.solve(J, x)
        return point

    normal = np.cross(*np.eye(3)[rows])
    apex = in_plane(np.zeros(2)) + (camera.distance - camera.focal_length) * normal
    share = _NEAR

    def at(x: Array) -> Array:
        return np.asarray(apex + share * (in_plane(x) - apex))

    corner = at(low)
    return {
        "apex": apex, "corner": corner, "right": at(np.array([high[0], low[1]])) - corner,
        "down": at(np.array([low[0], high[1]])) - corner, "low": low, "high": high,
        "reach": _BEYOND / share, "mount": None,
    }  # fmt: skip


def image_axes(camera: Camera) -> dict[str, Any]:
    """Names, unit and borders of the image's coordinates, as they are plotted."""
    unit, scale = ("mm", 1e3) if camera.unit == "m" else (camera.unit, 1.0)
    border = None
    if isinstance(camera, PinholeCamera):
        width, height = camera.size
        border = [-0.5, -0.5, width - 0.5, height - 0.5]
    return {
        "labels": list(camera.labels),
        "unit": unit,
        "scale": scale,
        "border": border,
        "down": border is not None,  # v of a pinhole camera points down
    }
