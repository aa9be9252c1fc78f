"""Tasks as a file keeps them: `saved` and `restored`."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np

from approxjac.robots import Robot
from approxjac.tasks.camera import Camera, PlanarCamera
from approxjac.tasks.image import ImageTask
from approxjac.tasks.pinhole import PinholeCamera
from approxjac.tasks.pose import PoseTask
from approxjac.tasks.position import PositionTask
from approxjac.tasks.stacked import StackedTask
from approxjac.tasks.task import Task
from approxjac.tasks.wrapped import WrappedTask

_KINDS: Mapping[str, Any] = {
    "position": PositionTask,
    "pose": PoseTask,
    "image": ImageTask,
    "PinholeCamera": PinholeCamera,
    "PlanarCamera": PlanarCamera,
}


def saved(task: Task | Camera | None) -> dict[str, Any] | None:
    """Return what a file keeps of a task or camera; None of a class that `restored` does not know.

    Of a wrapped task it is the task inside: what the law changes is no affair of a picture.
    """
    if isinstance(task, WrappedTask):
        return saved(task.task)
    if type(task) is StackedTask:
        parts = [saved(part) for part in task.tasks]
        return None if None in parts else {"kind": "stacked", "tasks": parts}
    kinds = [kind for kind, made in _KINDS.items() if type(task) is made]
    if not kinds:
        return None
    kept: dict[str, Any] = {"kind": kinds[0]}
    for name in inspect.signature(type(task)).parameters:
        if name != "robot":
            value = getattr(task, name)
            kept[name] = value.tolist() if isinstance(value, np.ndarray) else value
    if "camera" in kept:
        kept["camera"] = saved(kept["camera"])
        return kept if kept["camera"] else None
    return kept


def restored(kept: Mapping[str, Any] | None, robot: Robot | None) -> Task | None:
    """Return the task of a robot that a file keeps, as it was before it was saved, if it does.

    Raises:
        ApproxJacError, KeyError, TypeError: The file keeps something else.
    """
    if kept is None or robot is None:
        return None
    if kept["kind"] == "stacked":
        parts: list[Any] = [restored(part, robot) for part in kept["tasks"]]
        return StackedTask(*parts)
    given = {**kept}
    made = _KINDS[given.pop("kind")]
    if "camera" in given:
        camera = {**given["camera"]}
        given["camera"] = _KINDS[camera.pop("kind")](**camera)
    task: Task = made(robot, **given)
    return task
