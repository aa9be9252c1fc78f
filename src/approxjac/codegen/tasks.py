"""Task values and Jacobians on symbols."""

from __future__ import annotations

import numpy as np

from approxjac.codegen.rigid_body import Configured
from approxjac.codegen.symbols import Symbols
from approxjac.errors import InvalidInputError
from approxjac.tasks import PositionTask, Task

COVERED = (PositionTask,)
"""Tasks of which code can be made."""


def require_covered(task: Task) -> None:
    """Refuse a task of which no code can be made."""
    if type(task) not in COVERED:
        names = " or a ".join(each.__name__ for each in COVERED)
        raise InvalidInputError(
            f"task must be a {names} to make code of it, got {task!r}", given=task
        )


def frames(task: Task) -> tuple[str, ...]:
    """Return the frames of the robot that a task looks at."""
    return (task.frame,)  # type: ignore[attr-defined]


def value(task: Task, arm: Configured) -> Symbols:
    """Return x at a configuration, shape (n_x,)."""
    assert isinstance(task, PositionTask)
    return arm.frame(task.frame)[1][_rows(task)]


def jacobian(task: Task, arm: Configured) -> Symbols:
    """Return Ĵ at a configuration, shape (m, n_v)."""
    assert isinstance(task, PositionTask)
    return arm.jacobian(task.frame)[_rows(task)]


def _rows(task: PositionTask) -> list[int]:
    return ["xyz".index(axis) for axis in task.axes]


def norm(e: Symbols) -> object:
    """Return ‖e‖."""
    return np.sqrt((e * e).sum())
