"""`WrappedTask`: the base of tasks made from another task."""

from __future__ import annotations

from collections.abc import Sequence

from approxjac.tasks.task import Feature, Task
from approxjac.validation import Array


class WrappedTask(Task):
    """A task made from another one, whose values, errors, targets and sensor it keeps.

    Attributes:
        task: The task that this one is made from.
    """

    def __init__(
        self, task: Task, labels: Sequence[str] | None = None, units: Sequence[str] | None = None
    ) -> None:
        super().__init__(task.robot, labels or task.labels, units or task.units, task.n_x)
        self.task = task
        self._uses_x, self._subtracts = task._uses_x, task._subtracts
        self._origin, self._untold, self._parts = task._origin, task._untold, task._parts

    def value(self, q: Array) -> Array:
        return self.task.value(q)

    def error(self, x: Array, x_d: Array) -> Array:
        return self.task.error(x, x_d)

    def displaced(self, x: Array, e: Array) -> Array:
        return self.task.displaced(x, e)

    def target(self, x_d: object) -> Array:
        return self.task.target(x_d)

    @property
    def _measured(self) -> Task:
        return self.task._measured

    def _seen(self, x: Array) -> Array:
        return self.task._seen(x)

    def _sensor_jacobian(self, q: Array) -> Array:
        return self.task._sensor_jacobian(q)

    def _error_jacobian(self, e: Array, J: Array) -> Array:
        return self.task._error_jacobian(e, J)

    def _features(self) -> tuple[Feature, ...]:
        return self.task._features()
