"""Combinations of a task's coordinates, so that all directions of an error count alike."""

from __future__ import annotations

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.formatting import joined
from approxjac.robots import Dynamics, Robot
from approxjac.tasks.analysis import seen_configurations, with_error
from approxjac.tasks.task import Task, WrappedTask
from approxjac.validation import Array, as_array, require

_CONFIGURATIONS = 400
_NEAREST = 30  # of these, by their value's distance to the target
_LEAST = 0.01  # mobility that a direction is taken to have at least, as a share of the largest
_REGULAR = 1e-9  # σ_min/σ_max of C below which it has no inverse


class CombinedTask(WrappedTask):
    """e = C (error of another task): the same task, with gains along other directions.

    K_p and K_v are diagonal, so they weigh the coordinates and nothing between them. The images of
    several points move together when the hand moves sideways and hardly apart when it comes
    nearer: one gain for all coordinates makes the second slow. With C the directions that a motion
    shows well and those that it shows little become coordinates of their own kind. What is
    measured, and a target, stay those of the task itself; C changes what is stable no more than
    gains do.

    Source: the combination matrix of B. Espiau, F. Chaumette and P. Rives, "A new approach to
    visual servoing in robotics", IEEE Trans. Robotics and Automation 8 (1992).

    For controllers: the plant's sensor is the task itself, also that of rollouts. The other
    stability tests, which need errors of both in the same coordinates, take a plant whose sensor
    is `CombinedTask(sensor, C)` with the same C.

    Args:
        task: The task of the believed robot.
        C: Regular matrix, shape (m, m). Its size does not matter, as gains go with it.

    Raises:
        InvalidInputError: A matrix of another shape, not finite or singular.
    """

    def __init__(self, task: Task, C: object) -> None:
        require("task", task, Task, "a task, such as ImageTask(robot, camera, points=points)")
        self.C = as_array("C", C, (task.m, task.m))
        values = np.linalg.svd(self.C, compute_uv=False)
        if not values[-1] > _REGULAR * values[0]:
            raise InvalidInputError(
                f"C must be regular, got singular values {values.tolist()}", given=C
            )
        super().__init__(
            task, [f"c{i}" for i in range(1, task.m + 1)], (joined(task.units),) * task.m
        )
        self._inverse = np.linalg.inv(self.C)
        self._subtracts = False

    @classmethod
    def balanced(cls, task: Task, target: object) -> CombinedTask:
        """Combine coordinates such that the arm shows the same inertia along all of them.

        C = Ā^(−1/2), with Ā the mean of the mobility Ĵ M̂⁻¹ Ĵᵀ, its trace set to one, over the 30 of
        400 seeded configurations whose values are nearest to a target; with ‖C‖ = 1, so that it
        makes no error larger.

        Args:
            task: The task of the believed robot.
            target: x_d, shape (n_x,).

        Raises:
            InvalidInputError: A target that is none, a task that no sensor sees, or coordinates of
                different units, whose inertias do not compare.
        """
        require("task", task, Task, "a task, such as ImageTask(robot, camera, points=points)")
        if len(set(task.units)) > 1:
            raise InvalidInputError(
                f"task must have coordinates of one unit to be balanced, got {joined(task.units)}: "
                "balance each part, StackedTask(CombinedTask.balanced(image, x_d), position)",
                given=task,
            )
        x_d = task.target(target)
        seen = seen_configurations(task, _CONFIGURATIONS)
        far = [np.linalg.norm(task.error(task.value(q), x_d)) for q in seen]
        dynamics, A = Dynamics(task.robot), np.zeros((task.m, task.m))
        for k in np.argsort(far)[:_NEAREST]:
            q = seen[k]
            J = task.jacobian(q, with_error(task, task.value(q), x_d, np.zeros(task.m)))
            mobility = J @ np.linalg.solve(dynamics.M(q), J.T)
            A += mobility / np.trace(mobility)
        values, U = np.linalg.eigh(A)
        values = np.maximum(values, _LEAST * values[-1])
        return cls(task, (U * np.sqrt(values[0] / values)) @ U.T)

    def error(self, x: Array, x_d: Array) -> Array:
        return np.asarray(self.C @ self.task.error(x, x_d))

    def displaced(self, x: Array, e: Array) -> Array:
        return self.task.displaced(x, self._inverse @ e)

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        return np.asarray(self.C @ self.task.jacobian(q, x))

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        return np.asarray(self.C @ self.task.jacobian_dot(q, v))

    def on(self, robot: Robot) -> CombinedTask:
        return CombinedTask(self.task.on(robot), self.C)

    def _sensor_jacobian(self, q: Array) -> Array:
        return np.asarray(self.C @ self.task._sensor_jacobian(q))

    def _error_jacobian(self, e: Array, J: Array) -> Array:
        inverse = self._inverse
        return np.asarray(self.C @ self.task._error_jacobian(inverse @ e, inverse @ J))

    def __repr__(self) -> str:
        return f"CombinedTask({self.task!r}, C={np.round(self.C, 4).tolist()})"
