"""`Scene`: who took part in a run, as one needs it to draw the run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from approxjac.robots import Robot
from approxjac.tasks import Task
from approxjac.tasks.restored import restored, saved
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
        """Return what a file holds of it: texts, numbers, lists and dictionaries."""
        return {
            "truth": _robot_to_dict(self.truth),
            "belief": None if self.belief is None else _robot_to_dict(self.belief),
            "sensor": None if self.sensor is None else saved(self.sensor),
            "task": None if self.task is None else saved(self.task),
            # JSON knows no infinity
            "torque_limits": [x if np.isfinite(x) else None for x in self.torque_limits.tolist()],
        }

    @classmethod
    def from_dict(cls, kept: Mapping[str, Any]) -> Scene:
        """Return the scene that `to_dict` described.

        Raises:
            ApproxJacError, KeyError, TypeError, ValueError: It did not.
        """
        truth = _robot_from_dict(kept["truth"])
        belief = None if kept["belief"] is None else _robot_from_dict(kept["belief"])
        limits = [np.inf if x is None else float(x) for x in kept["torque_limits"]]
        if len(limits) != truth.nv or (belief is not None and belief.nv != truth.nv):
            raise ValueError("its robots and torque limits have different numbers of joints")
        sensor, task = kept["sensor"], kept["task"]
        return cls(
            truth,
            belief,
            None if sensor is None else restored(sensor, truth),
            None if task is None or belief is None else restored(task, belief),
            np.array(limits),
        )


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
