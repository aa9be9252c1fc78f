"""Several tasks of one robot at once."""

from __future__ import annotations

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.robots import Robot
from approxjac.tasks.task import Task, require_rows
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
        self._tasks = tasks
        require_rows(self.m, self.robot)
        ends = np.cumsum([task.n_x for task in tasks]).tolist()
        self._parts = [slice(end - task.n_x, end) for end, task in zip(ends, tasks, strict=True)]
        ends = np.cumsum([task.m for task in tasks]).tolist()
        self._rows = [slice(end - task.m, end) for end, task in zip(ends, tasks, strict=True)]

    @property
    def tasks(self) -> tuple[Task, ...]:
        """The tasks."""
        return self._tasks

    @property
    def robot(self) -> Robot:
        return self._tasks[0].robot

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(
            f"{i}.{label}" for i, task in enumerate(self._tasks, start=1) for label in task.labels
        )

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(unit for task in self._tasks for unit in task.units)

    @property
    def n_x(self) -> int:
        return sum(task.n_x for task in self._tasks)

    @property
    def measured(self) -> Task:
        plain = [task.measured for task in self._tasks]
        same = all(a is b for a, b in zip(plain, self._tasks, strict=True))
        return self if same else StackedTask(*plain)

    def measured_rate(self, Jv: Array) -> Array:
        each = zip(self._tasks, self._rows, strict=True)
        return np.concatenate([task.measured_rate(Jv[rows]) for task, rows in each])

    @property
    def parts(self) -> tuple[tuple[slice, slice], ...]:
        each = zip(self._tasks, self._parts, self._rows, strict=True)
        return tuple(
            (_moved(entries, part.start), _moved(coordinates, rows.start))
            for task, part, rows in each
            for entries, coordinates in task.parts
        )

    @property
    def jacobian_uses_x(self) -> bool:
        return any(task.jacobian_uses_x for task in self._tasks)

    def seen(self, x: Array) -> Array:
        each = zip(self._tasks, self._parts, strict=True)
        return np.concatenate([task.seen(x[part]) for task, part in each])

    def value(self, q: Array) -> Array:
        return np.concatenate([task.value(q) for task in self._tasks])

    def compute_jacobian(self, q: Array, x: Array | None = None) -> Array:
        if x is None:
            return np.vstack([task.compute_jacobian(q) for task in self._tasks])
        each = zip(self._tasks, self._parts, strict=True)
        return np.vstack([task.compute_jacobian(q, x[part]) for task, part in each])

    def sensor_jacobian(self, q: Array) -> Array:
        return np.vstack([task.sensor_jacobian(q) for task in self._tasks])

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        return np.vstack([task.jacobian_dot(q, v) for task in self._tasks])

    def error(self, x: Array, x_d: Array) -> Array:
        return np.concatenate(
            [t.error(x[part], x_d[part]) for t, part in zip(self._tasks, self._parts, strict=True)]
        )

    @property
    def subtracts(self) -> bool:
        return all(task.subtracts for task in self._tasks)

    @property
    def origin(self) -> Array:
        return np.concatenate([task.origin for task in self._tasks])

    def displaced(self, x: Array, e: Array) -> Array:
        each = zip(self._tasks, self._parts, self._rows, strict=True)
        return np.concatenate([task.displaced(x[part], e[rows]) for task, part, rows in each])

    def with_error(self, x: Array, x_d: Array, e: Array) -> Array:
        each = zip(self._tasks, self._parts, self._rows, strict=True)
        return np.concatenate(
            [task.with_error(x[part], x_d[part], e[rows]) for task, part, rows in each]
        )

    def error_rate(self, e: Array, Jv: Array) -> Array:
        each = zip(self._tasks, self._rows, strict=True)
        return np.concatenate([task.error_rate(e[rows], Jv[rows]) for task, rows in each])

    def target(self, x_d: object) -> Array:
        target = super().target(x_d)
        for task, part in zip(self._tasks, self._parts, strict=True):
            task.target(target[part])  # as it may have edges, such as those of an image
        return target

    def on(self, robot: Robot) -> StackedTask:
        return StackedTask(*(task.on(robot) for task in self._tasks))

    def __repr__(self) -> str:
        return f"StackedTask({', '.join(map(repr, self._tasks))})"


def _moved(entries: slice, start: int) -> slice:
    return slice(entries.start + start, entries.stop + start)
