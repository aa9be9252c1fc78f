"""Kinematics and speeds of law T where none are given."""

from __future__ import annotations

import numpy as np

from approxjac.controllers.kinematics import AdaptiveKinematics
from approxjac.controllers.predicted import Kinematics
from approxjac.errors import InvalidInputError
from approxjac.tasks import PoseTask, PositionTask, StackedTask, Task
from approxjac.tasks.analysis import seen_configurations

_SPEEDS = {"m": 0.5, "rad": 1.0}
_TURN = 0.5  # [rad/s], at which other tasks go by their Jacobian


def usual_kinematics(task: Task, dt: float) -> Kinematics:
    """Return kinematics that learn tool and joint origins, for a task of positions or a pose.

    Raises:
        InvalidInputError: Another task.
    """
    parts = task.tasks if isinstance(task, StackedTask) else (task,)
    if isinstance(task, PoseTask) or all(isinstance(part, PositionTask) for part in parts):
        return AdaptiveKinematics(task, unknown=("tool", "origins"), dt=dt)
    raise InvalidInputError(
        f"kinematics must be given for {task!r}: what is learnt by itself are positions and "
        "poses; KnownKinematics(task) takes the believed arm for true",
        given=task,
    )


def usual_speeds(task: Task) -> list[float]:
    """Return the largest speeds of a task's coordinates [unit of the task/s], length m."""
    if set(task.units) <= set(_SPEEDS):
        return [_SPEEDS[unit] for unit in task.units]
    rows = [np.linalg.norm(task.jacobian(q), axis=1) for q in seen_configurations(task, 20)]
    usual = _TURN * np.median(rows, axis=0)
    return [_SPEEDS.get(unit, value) for unit, value in zip(task.units, usual, strict=True)]
