"""Kinematics and speeds of the tracking law where none are given."""

from __future__ import annotations

import numpy as np

from approxjac.cameras import PlanarCamera
from approxjac.controllers.learning.estimator import Kinematics
from approxjac.controllers.learning.learnt_camera import AdaptiveCamera
from approxjac.controllers.learning.positions import AdaptiveKinematics, AdaptivePlanarCamera
from approxjac.errors import InvalidInputError
from approxjac.tasks import ImageTask, PoseTask, PositionTask, StackedTask, Task
from approxjac.tasks.analysis import seen_configurations

_SPEEDS = {"m": 0.5, "rad": 1.0}
_TURN = 0.5  # [rad/s], at which other tasks go by their Jacobian


def usual_kinematics(task: Task, dt: float) -> Kinematics:
    """Return kinematics that learn: tool and joint origins; of an image the camera as well.

    Raises:
        InvalidInputError: Another task.
    """
    parts = task.tasks if isinstance(task, StackedTask) else (task,)
    if isinstance(task, PoseTask) or all(isinstance(part, PositionTask) for part in parts):
        return AdaptiveKinematics(task, unknown=("tool", "origins"), dt=dt)
    if isinstance(task, ImageTask):
        planar = isinstance(task.camera, PlanarCamera)
        return AdaptivePlanarCamera(task, dt=dt) if planar else AdaptiveCamera(task, dt=dt)
    raise InvalidInputError(
        f"kinematics must be given for {task!r}: what is learnt by itself are positions, poses "
        "and images; KnownKinematics(task) takes the believed arm for true",
        given=task,
    )


def usual_speeds(task: Task) -> list[float]:
    """Return the largest speeds of a task's coordinates [unit of the task/s], length m."""
    known = {} if isinstance(task, ImageTask) else _SPEEDS  # of a sensor's metres nothing is
    if set(task.units) <= set(known):
        return [known[unit] for unit in task.units]
    rows = [np.linalg.norm(task.jacobian(q), axis=1) for q in seen_configurations(task, 20)]
    usual = _TURN * np.median(rows, axis=0)
    return [known.get(unit, value) for unit, value in zip(task.units, usual, strict=True)]
