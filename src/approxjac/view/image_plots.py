"""Plots of what cameras see. Each draws into axes, by default new ones, and returns them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from approxjac.cameras import Camera, PinholeCamera
from approxjac.errors import InvalidInputError
from approxjac.simulation import Trajectory
from approxjac.tasks import ImageTask
from approxjac.validation import Array, require
from approxjac.view.plots import skeleton
from approxjac.view.style import COLORS, SERIES, formulas, styled

_PIECES = 20  # of each link: a lens bends what is straight
_AROUND = 0.06  # of the image, shown around its border
POINTS = (COLORS["true"], SERIES[4], SERIES[5], SERIES[6], SERIES[1])
"""Of the paths of points: none of them is that of targets or of what is believed."""


def plot_image(
    run: Trajectory,
    camera: Camera,
    ax: Axes | None = None,
    *,
    title: str = "Paths of the points in the image",
) -> Axes:
    """Draw the true path of each point through the image, from its start to its target.

    The images that were measured are faint dots. The border of a pinhole camera's image is its
    field of view; as in all images v points down.

    Args:
        run: A run whose task is an image.
        camera: The true camera.
        ax: Axes to draw into; new ones by default.
        title: Of the axes.

    Raises:
        InvalidInputError: A run of another task, or no camera.
    """
    require("camera", camera, Camera, "a camera, such as that of the plant's ImageTask")
    if run.error.shape[1] % 2 or set(run.task_units) != {camera.unit}:
        raise InvalidInputError(
            f"run must be that of an image task, with coordinates in {camera.unit}, got "
            f"{', '.join(run.task_labels)} in {run.task_unit}",
            given=run,
        )
    k = run.error.shape[1] // 2
    true, measured = (x.reshape(len(run.t), k, -1)[:, :, :2] for x in (run.x, run.x_measured))
    target, grey = run.target.reshape(k, -1)[:, :2], COLORS["neutral"]
    with styled(ax, columns=3) as ax:
        for i in range(k):
            color = POINTS[i % len(POINTS)]
            label = "path" if k == 1 else f"path {i + 1}"
            # an image that is held is one image; as pixels, or files would grow with the run
            new = np.append(True, (np.diff(measured[:, i], axis=0) != 0.0).any(axis=1))
            ax.plot(*measured[new, i].T, ".", color=color, ms=4, mew=0, alpha=0.5, zorder=1,
                    rasterized=True)  # fmt: skip
            ax.plot(*true[:, i].T, color=color, label=label)
        ax.plot(*true[0].T, "o", color=grey, mfc="white", ms=7, label="start", zorder=4)
        ax.plot(*target.T, "x", color=COLORS["target"], ms=9, mew=2, label="target", zorder=5)
        ax.plot(*true[-1].T, "o", color=grey, ms=4, label="end", zorder=6)
        ax.plot([], [], ".", color=grey, alpha=0.5, label="measured")
        _frame(ax, camera, title)
    return ax


def plot_camera_view(
    sensor: ImageTask,
    q: Sequence[float] | Array,
    ax: Axes | None = None,
    *,
    believed: ImageTask | None = None,
    target: Sequence[float] | Array | None = None,
    title: str = "What the camera sees",
) -> Axes:
    """Draw what a camera sees of an arm, and what a controller believes it to see.

    A camera in the world sees the arm, drawn as its skeleton, with the points that it watches. One
    that the arm carries sees the points.

    Args:
        sensor: Task of the true robot with the true camera.
        q: Configuration, shape (nq,).
        ax: Axes to draw into; new ones by default.
        believed: Task of the believed robot with the believed camera; drawn dashed if given.
        target: Images of the points at the target, shape (n_x,), drawn as crosses if given.
        title: Of the axes.

    Raises:
        InvalidInputError: No image tasks, or a configuration or a target of another shape.
    """
    require("sensor", sensor, ImageTask, "an ImageTask of the true robot")
    q = sensor.robot.configuration(q)
    with styled(ax, columns=3) as ax:
        points = _draw(ax, sensor, q, "true", color=COLORS["true"], zorder=4)
        _number(ax, points, COLORS["true"], (6, 5))
        if believed is not None:
            require("believed", believed, ImageTask, "an ImageTask of the believed robot")
            look = {"linestyle": "--", "zorder": 3}
            _draw(ax, believed, q, "believed", color=COLORS["believed"], **look)
        if target is not None:
            images = sensor.target(target).reshape(len(sensor.points), -1)[:, :2]
            ax.plot(*images.T, "x", color=COLORS["target"], ms=9, mew=2, label="target", zorder=6)
            _number(ax, images, COLORS["target"], (-12, -10))
        _frame(ax, sensor.camera, title)
    return ax


def _draw(ax: Axes, task: ImageTask, q: Array, name: str, **look: Any) -> Array:
    """Draw an arm, where it is seen from outside, and the points; return their images (k, 2)."""
    camera = task.camera
    dots = {key: value for key, value in look.items() if key != "linestyle"}
    if camera.mount is None and task.frame is not None:
        corners = skeleton(task.robot, task.frame, q)
        share = np.linspace(0.0, 1.0, _PIECES, endpoint=False)[:, None]
        line = np.concatenate([*(a + share * (b - a) for a, b in pairwise(corners)), corners[-1:]])
        ax.plot(*_images(camera, line), linewidth=2.0, label=f"arm, {name}", **look)
        ax.plot(*_images(camera, corners), "o", ms=4, **dots)
    points: Array = task.value(q).reshape(len(task.points), -1)[:, :2]
    ax.plot(*np.concatenate([points, points[:1]]).T, linewidth=1.0, **look)
    ax.plot(*points.T, "s", ms=7, mfc="none", mew=1.6, label=f"points, {name}", **dots)
    return points


def _number(ax: Axes, points: Array, color: str, offset: tuple[int, int]) -> None:
    """Write the number of each of several points beside it."""
    for i, point in enumerate(points, start=1):
        if len(points) > 1 and np.isfinite(point).all():
            look: dict[str, Any] = {"color": color, "fontsize": 8, "annotation_clip": True}
            ax.annotate(str(i), point, offset, textcoords="offset points", **look)


def _images(camera: Camera, points: Array) -> Array:
    """Return images of points of the world, shape (2, N); NaN for those that have none."""
    return np.array([camera.project(r) for r in points]).T


def _frame(ax: Axes, camera: Camera, title: str) -> None:
    """Draw the border of an image, and name the axes."""
    (u, v), unit = camera.labels, camera.unit
    ax.set_aspect("equal", adjustable="box", anchor="N")
    if isinstance(camera, PinholeCamera):
        width, height = camera.size
        border = np.array([[0, 0, 1, 1, 0], [0, 1, 1, 0, 0]]) * np.array([[width], [height]]) - 0.5
        ax.plot(*border, color=COLORS["neutral"], linewidth=1.2, zorder=2)
        around = _AROUND * max(width, height)
        ax.set_xlim(-around, width + around)
        ax.set_ylim(height + around, -around)  # v points down
    ax.set(xlabel=formulas(f"{u} [{unit}]"), ylabel=formulas(f"{v} [{unit}]"), title=title)
