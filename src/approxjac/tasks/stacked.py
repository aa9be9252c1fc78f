"""Several tasks of one robot at once."""

from __future__ import annotations

from itertools import accumulate
from typing import Any

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.robots import Robot
from approxjac.tasks.task import Task
from approxjac.validation import Array, require


class StackedTask(Task):
    """X = the values of several tasks, one after the other, and so the errors and Jacobians.

    The labels are those of the tasks with their number, such as "1.x" or "2.x".

    Args:
        *tasks: At least one task, all of the same robot.

    Raises:
        InvalidInputError: No task, something else than tasks, tasks of different robots, or more
            coordinates than joints.
    """

    def __init__(self, *tasks: Task) -> None:
        if not tasks:
            raise InvalidInputError("tasks must be at least one task, got none", given=tasks)
        for task in tasks:
            require("each of tasks", task, Task, "a task, such as PositionTask(robot)")
            if task.robot != tasks[0].robot:
                raise InvalidInputError(
                    f"tasks must be of one robot, got {tasks[0].robot!r} and {task.robot!r}",
                    given=tasks,
                )
        self.tasks = tasks
        self._overdetermined = any(task._overdetermined for task in tasks)
        super().__init__(
            tasks[0].robot,
            [f"{i}.{label}" for i, task in enumerate(tasks, start=1) for label in task.labels],
            [unit for task in tasks for unit in task.units],
            sum(task.n_x for task in tasks),
        )
        entries = _one_after_the_other([task.n_x for task in tasks])
        rows = _one_after_the_other([task.m for task in tasks])
        self._each = list(zip(tasks, entries, rows, strict=True))
        self._uses_x = any(task._uses_x for task in tasks)
        self._subtracts = all(task._subtracts for task in tasks)
        self._origin = np.concatenate([task._origin for task in tasks])
        self._untold = [where.start + i for task, where, _ in self._each for i in task._untold]
        measured = _one_after_the_other([task._measured.m for task in tasks])
        self._parts = tuple(
            (_moved(part, entries.start), _moved(coordinates, own.start))
            for (task, entries, _), own in zip(self._each, measured, strict=True)
            for part, coordinates in task._parts
        )
        self._features = tuple(
            feature._replace(entries=_moved(feature.entries, entries.start))
            for task, entries, _ in self._each
            for feature in task._features
        )

    def value(self, q: Array) -> Array:
        return np.concatenate([task.value(q) for task in self.tasks])

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        given = [(task, None if x is None else x[i]) for task, i, _ in self._each]
        return np.concatenate([task.jacobian(q, part) for task, part in given])

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        return np.concatenate([task.jacobian_dot(q, v) for task in self.tasks])

    def error(self, x: Array, x_d: Array) -> Array:
        return np.concatenate([task.error(x[i], x_d[i]) for task, i, _ in self._each])

    def displaced(self, x: Array, e: Array) -> Array:
        return np.concatenate([task.displaced(x[i], e[rows]) for task, i, rows in self._each])

    def target(self, x_d: object) -> Array:
        target = super().target(x_d)
        for task, entries, _ in self._each:
            task.target(target[entries])  # as it may have edges, such as those of an image
        return target

    def on(self, robot: Robot) -> StackedTask:
        return StackedTask(*(task.on(robot) for task in self.tasks))

    @property
    def _measured(self) -> Task:
        plain = [task._measured for task in self.tasks]
        same = all(a is b for a, b in zip(plain, self.tasks, strict=True))
        return self if same else StackedTask(*plain)

    def _seen(self, x: Array) -> Array:
        return np.concatenate([task._seen(x[i]) for task, i, _ in self._each])

    def _is_mirrored(self, x: Array, other: Array) -> bool:
        return any(task._is_mirrored(x[i], other[i]) for task, i, _ in self._each)

    def _sensor_jacobian(self, q: Array) -> Array:
        return np.concatenate([task._sensor_jacobian(q) for task in self.tasks])

    def _error_jacobian(self, e: Array, J: Array) -> Array:
        return np.concatenate([task._error_jacobian(e[i], J[i]) for task, _, i in self._each])

    def _saved(self) -> dict[str, Any] | None:
        parts = [task._saved() for task in self.tasks]
        return None if None in parts else {"kind": "stacked", "tasks": parts}

    def __repr__(self) -> str:
        return f"StackedTask({', '.join(map(repr, self.tasks))})"


def _one_after_the_other(sizes: list[int]) -> list[slice]:
    return [slice(end - size, end) for size, end in zip(sizes, accumulate(sizes), strict=True)]


def _moved(entries: slice, start: int) -> slice:
    return slice(entries.start + start, entries.stop + start)
