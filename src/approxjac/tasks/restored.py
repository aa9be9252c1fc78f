"""Tasks as a file keeps them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from approxjac.robots import Robot
from approxjac.tasks.camera import Camera, PlanarCamera
from approxjac.tasks.image import ImageTask
from approxjac.tasks.pinhole import PinholeCamera
from approxjac.tasks.pose import PoseTask
from approxjac.tasks.position import PositionTask
from approxjac.tasks.stacked import StackedTask
from approxjac.tasks.task import Task

_CAMERAS: Mapping[str, Callable[..., Camera]] = {
    "PinholeCamera": PinholeCamera,
    "PlanarCamera": PlanarCamera,
}
_TASKS: Mapping[str, Callable[..., Task]] = {
    "position": PositionTask,
    "pose": PoseTask,
    "image": ImageTask,
}


def restored(saved: Mapping[str, Any], robot: Robot) -> Task:
    """Return the task of a robot that a file keeps, as it was before it was saved.

    Raises:
        ApproxJacError, KeyError, TypeError: The file keeps something else.
    """
    given: dict[str, Any] = {**saved}
    kind = given.pop("kind")
    if kind == "stacked":
        return StackedTask(*(restored(part, robot) for part in given["tasks"]))
    if "camera" in given:
        camera = {**given["camera"]}
        given["camera"] = _CAMERAS[camera.pop("kind")](**camera)
    return _TASKS[kind](robot, **given)
