"""`Scene`: who took part in a run, as one needs it to draw the run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from approxjac.robots import Robot
from approxjac.tasks import (
    Camera,
    ImageTask,
    PinholeCamera,
    PlanarCamera,
    PoseTask,
    PositionTask,
    StackedTask,
    Task,
)
from approxjac.tasks.wrapped import WrappedTask
from approxjac.validation import Array


@dataclass(frozen=True, eq=False)
class Scene:
    """The true and the believed robot of a run, and what each of them takes x for.

    Attributes:
        truth: The true robot.
        belief: The robot that the controller believes; None for one that tells none.
        sensor: The task that is measured on the true robot; None if it is of a kind that a file
            cannot hold.
        task: The controller's task of the believed robot; None as above.
        torque_limits: What the motors deliver, shape (n_v,) [N m or N]; infinite where unknown.
    """

    truth: Robot
    belief: Robot | None
    sensor: Task | None
    task: Task | None
    torque_limits: Array

    def to_dict(self) -> dict[str, Any]:
        """What a file holds of it: texts, numbers, lists and dictionaries."""
        return {
            "truth": _robot_to_dict(self.truth),
            "belief": None if self.belief is None else _robot_to_dict(self.belief),
            "sensor": _task_to_dict(self.sensor),
            "task": _task_to_dict(self.task),
            # JSON knows no infinity
            "torque_limits": [x if np.isfinite(x) else None for x in self.torque_limits.tolist()],
        }

    @classmethod
    def from_dict(cls, kept: Mapping[str, Any]) -> Scene:
        """The scene that `to_dict` described.

        Raises:
            ApproxJacError, KeyError, TypeError, ValueError: It did not.
        """
        truth = _robot_from_dict(kept["truth"])
        belief = None if kept["belief"] is None else _robot_from_dict(kept["belief"])
        limits = [np.inf if x is None else float(x) for x in kept["torque_limits"]]
        if len(limits) != truth.nv or (belief is not None and belief.nv != truth.nv):
            raise ValueError("its robots and torque limits have different numbers of joints")
        return cls(
            truth,
            belief,
            _task_from_dict(kept["sensor"], truth),
            None if belief is None else _task_from_dict(kept["task"], belief),
            np.array(limits),
        )


class Feature(NamedTuple):
    """What one elementary task follows: the origin of a frame, or points that a camera sees.

    Attributes:
        entries: Where its values are in x.
        frame: Frame that is followed, or that the points are fixed to; None is the world.
        axes: World axes of the position that x gives, such as "xyz"; none of an image.
        camera: What sees it, if anything does.
        points: Points of the frame, shape (k, 3) [m].
    """

    entries: slice
    frame: str | None
    axes: str
    camera: Camera | None
    points: Array


def features(task: Task | None) -> tuple[Feature, ...]:
    """What a task follows, part by part; nothing of kinds of tasks that are not this library's."""
    return tuple(_features(task, 0))


def _features(task: Task | None, start: int) -> Iterator[Feature]:
    if isinstance(task, StackedTask):
        for part in task.tasks:
            yield from _features(part, start)
            start += part.n_x
    elif isinstance(task, WrappedTask):
        yield from _features(task.task, start)
    elif isinstance(task, PositionTask | PoseTask):
        axes = "xyz" if isinstance(task, PoseTask) else "".join(task.labels)
        entries = slice(start, start + task.n_x)
        yield Feature(entries, task.frame, axes, None, np.zeros((1, 3)))
    elif isinstance(task, ImageTask):
        entries = slice(start, start + task.n_x)
        yield Feature(entries, task.frame, "", task.camera, task.points)


def _robot_to_dict(robot: Robot) -> dict[str, Any]:
    return {
        "urdf": robot.urdf,
        "gravity": robot.gravity.tolist(),
        "tip": robot.tip,
        "urdf_dir": None if robot.urdf_dir is None else str(robot.urdf_dir),
    }


def _robot_from_dict(kept: Mapping[str, Any]) -> Robot:
    folder = kept["urdf_dir"]
    return Robot(
        kept["urdf"],
        gravity=kept["gravity"],
        tip=kept["tip"],
        urdf_dir=None if folder is None else Path(folder),
        source="the URDF of a run",
    )


def _task_to_dict(task: Task | None) -> dict[str, Any] | None:
    if isinstance(task, WrappedTask):  # what it changes is the law's affair, not that of a picture
        return _task_to_dict(task.task)
    if type(task) is StackedTask:  # not of a class made from it, which may differ
        tasks = [_task_to_dict(part) for part in task.tasks]
        return None if None in tasks else {"kind": "stacked", "tasks": tasks}
    if type(task) is PositionTask:
        return {"kind": "position", "frame": task.frame, "axes": "".join(task.labels)}
    if type(task) is PoseTask:
        return {"kind": "pose", "frame": task.frame}
    if type(task) is ImageTask and type(task.camera).__name__ in _CAMERAS:
        depth = task.depth
        return {
            "kind": "image",
            "camera": _camera_to_dict(task.camera),
            "frame": task.frame,
            "points": task.points.tolist(),
            "depth": depth if isinstance(depth, str) else np.asarray(depth).tolist(),
        }
    return None


def _task_from_dict(kept: Mapping[str, Any] | None, robot: Robot) -> Task | None:
    if kept is None:
        return None
    if kept["kind"] == "stacked":
        parts = [_task_from_dict(part, robot) for part in kept["tasks"]]
        return StackedTask(*(part for part in parts if part is not None))
    if kept["kind"] == "position":
        return PositionTask(robot, kept["frame"], kept["axes"])
    if kept["kind"] == "pose":
        return PoseTask(robot, kept["frame"])
    if kept["kind"] == "image":
        camera = _camera_from_dict(kept["camera"])
        return ImageTask(robot, camera, kept["frame"], kept["points"], depth=kept["depth"])
    raise ValueError(f"its task is of an unknown kind, {kept['kind']!r}")


_CAMERAS: Mapping[str, Callable[..., Camera]] = {
    "PinholeCamera": PinholeCamera,
    "PlanarCamera": PlanarCamera,
}


def _camera_to_dict(camera: Camera) -> dict[str, Any]:
    given = {f.name: getattr(camera, f.name) for f in fields(camera) if f.init}  # type: ignore[arg-type]
    return {"kind": type(camera).__name__, **given}


def _camera_from_dict(kept: Mapping[str, Any]) -> Camera:
    given = dict(kept)
    return _CAMERAS[given.pop("kind")](**given)
