"""What tasks made from another task have in common."""

from __future__ import annotations

from approxjac.robots import Robot
from approxjac.tasks.task import Task
from approxjac.validation import Array


class WrappedTask(Task):
    """A task made from another one, whose values, targets and sensor it keeps.

    Everything here is that of the other task; what differs is for the class that derives.
    """

    _task: Task

    @property
    def task(self) -> Task:
        """The task that this one is made from."""
        return self._task

    @property
    def robot(self) -> Robot:
        return self._task.robot

    @property
    def labels(self) -> tuple[str, ...]:
        return self._task.labels

    @property
    def units(self) -> tuple[str, ...]:
        return self._task.units

    @property
    def n_x(self) -> int:
        return self._task.n_x

    @property
    def parts(self) -> tuple[tuple[slice, slice], ...]:
        return self._task.parts

    @property
    def measured(self) -> Task:
        return self._task.measured

    def measured_rate(self, Jv: Array) -> Array:
        return self._task.measured_rate(Jv)

    @property
    def jacobian_uses_x(self) -> bool:
        return self._task.jacobian_uses_x

    def seen(self, x: Array) -> Array:
        return self._task.seen(x)

    def value(self, q: Array) -> Array:
        return self._task.value(q)

    def error(self, x: Array, x_d: Array) -> Array:
        return self._task.error(x, x_d)

    @property
    def subtracts(self) -> bool:
        return self._task.subtracts

    @property
    def origin(self) -> Array:
        return self._task.origin

    def displaced(self, x: Array, e: Array) -> Array:
        return self._task.displaced(x, e)

    def with_error(self, x: Array, x_d: Array, e: Array) -> Array:
        return self._task.with_error(x, x_d, e)

    def error_rate(self, e: Array, Jv: Array) -> Array:
        return self._task.error_rate(e, Jv)

    def target(self, x_d: object) -> Array:
        return self._task.target(x_d)

    def sensor_jacobian(self, q: Array) -> Array:
        return self._task.sensor_jacobian(q)
