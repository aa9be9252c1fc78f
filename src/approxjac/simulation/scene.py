"""`Scene`: who took part in a run, as one needs it to draw the run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from approxjac.cameras import PinholeCamera, PlanarCamera
from approxjac.robots import Robot
from approxjac.tasks import (
    ImageTask,
    PoseTask,
    PoseTrackerTask,
    PositionTask,
    StackedTask,
    Task,
    TrackerTask,
)
from approxjac.validation import Array

_KINDS: Mapping[str, Any] = {
    made._kind: made
    for made in (
        PositionTask,
        TrackerTask,
        PoseTask,
        PoseTrackerTask,
        ImageTask,
        PinholeCamera,
        PlanarCamera,
    )
}


@dataclass(frozen=True, eq=False)
class Scene:
    """The true and the believed robot of a run, and what each of them takes x for.

    None stands for what a controller does not tell, and for tasks that a file cannot hold.
    """

    truth: Robot
    belief: Robot | None
    sensor: Task | None  # the task that is measured on the true robot
    task: Task | None  # the controller's, of the believed robot
    torque_limits: Array  # of the motors, shape (n_v,) [N m or N]; infinite where unknown
    parameters: Mapping[str, str] = field(default_factory=dict)  # that are learnt: their units
    knows_truth: bool = True  # else the true robot is the believed one, as nobody knows more

    def to_dict(self) -> dict[str, Any]:
        """Return it as a file holds it: texts, numbers, lists and dictionaries."""
        return {
            "truth": _saved_robot(self.truth),
            "belief": None if self.belief is None else _saved_robot(self.belief),
            "sensor": self.sensor and self.sensor._saved(),
            "task": self.task and self.task._saved(),
            # JSON knows no infinity
            "parameters": dict(self.parameters),
            "knows_truth": self.knows_truth,
            "torque_limits": [x if np.isfinite(x) else None for x in self.torque_limits.tolist()],
        }

    @classmethod
    def from_dict(cls, kept: Mapping[str, Any]) -> Scene:
        """Return the scene that `to_dict` described."""
        truth = _restored_robot(kept["truth"])
        belief = None if kept["belief"] is None else _restored_robot(kept["belief"])
        limits = [np.inf if x is None else float(x) for x in kept["torque_limits"]]
        if len(limits) != truth.nv or (belief is not None and belief.nv != truth.nv):
            raise ValueError("its robots and torque limits have different numbers of joints")
        sensor = _restored_task(kept["sensor"], truth)
        task = _restored_task(kept["task"], belief)
        return cls(
            truth,
            belief,
            sensor,
            task,
            np.array(limits),
            kept.get("parameters", {}),
            kept.get("knows_truth", True),
        )


def _saved_robot(robot: Robot) -> dict[str, Any]:
    folder = None if robot.urdf_dir is None else str(robot.urdf_dir)
    kept = {"urdf": robot.urdf, "gravity": robot.gravity.tolist(), "tip": robot.tip}
    return kept | {"urdf_dir": folder, "name": robot.name}


def _restored_robot(kept: Mapping[str, Any]) -> Robot:
    folder = None if kept["urdf_dir"] is None else Path(kept["urdf_dir"])
    return Robot(**{**kept, "urdf_dir": folder}, source="the URDF of a run")


def _restored_task(kept: Mapping[str, Any] | None, robot: Robot | None) -> Task | None:
    """Return the task of a robot that a file keeps, as it was before it was saved, if it does."""
    if kept is None or robot is None:
        return None
    if kept["kind"] == "stacked":
        parts: list[Any] = [_restored_task(part, robot) for part in kept["tasks"]]
        return StackedTask(*parts)
    given = {**kept}
    made = _KINDS[given.pop("kind")]
    if "camera" in given:
        camera = {**given["camera"]}
        given["camera"] = _KINDS[camera.pop("kind")](**camera)
    task: Task = made(robot, **given)
    return task
