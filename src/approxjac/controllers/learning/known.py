"""`KnownKinematics`: the believed kinematics, taken for true."""

from __future__ import annotations

import math

import numpy as np

from approxjac.controllers.learning.estimator import Kinematics, PredictedError
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement, Target
from approxjac.tasks import Task
from approxjac.tasks.analysis import combination
from approxjac.validation import Array, require

_DIFFERENCE = 1e-5  # of values, either way, from which a rate is taken [unit of the task]
_JUMP = 10.0  # times as fast as what moves: an error that has jumped, as at a rotation by 180°


class KnownKinematics(Kinematics):
    """z = h(q) − x_d of the believed arm. The measured x is not used.

    With a wrong model the arm goes where the model says, which is elsewhere.

    Args:
        task: The task of the believed robot.

    Raises:
        InvalidInputError: A task whose Jacobian depends on the measured x.
    """

    n_state = 0

    def __init__(self, task: Task) -> None:
        self._remember(locals())
        require("task", task, Task, "a task of the believed robot, such as PositionTask(robot)")
        if task._uses_x:
            raise InvalidInputError(
                f"task must have a Jacobian that depends on q only, such as an ImageTask with "
                f"depth='believed', got {task!r}",
                given=task,
            )
        self.task = task
        self._combination = combination(task)  # a target moves as what is measured does
        own = type(task)._sensor_jacobian is not Task._sensor_jacobian
        self._exact = task._subtracts and not own  # ż = Ĵq̇ − ẋ_d
        self._none = np.zeros(task.m)
        self._none.flags.writeable = False

    def initial_state(self, measurement: Measurement) -> Array:
        """Return no state, shape (0,)."""
        return np.zeros(0)

    def step(self, state: Array, measurement: Measurement, dt: float) -> Array:
        """Return the state as it is: there is nothing to learn."""
        return state

    def predict(self, state: Array, q: Array, v: Array, target: Target) -> PredictedError:
        """Return h(q) − x_d and its derivatives."""
        task, (x_d, x_d_dot, x_d_ddot) = self.task, target
        x = task.value(q)
        z, J, drift = task.error(x, x_d), task.jacobian(q), self._none
        x_d_dot = self._none if x_d_dot is None else self._combined(x_d_dot)
        x_d_ddot = self._none if x_d_ddot is None else self._combined(x_d_ddot)
        if not self._exact:
            x_dot = task._sensor_jacobian(q).dot(v)
            drift = x_dot - x_d_dot if task._subtracts else self._rate(x, x_dot, x_d, x_d_dot)
            drift = drift + x_d_dot - J.dot(v)
        return PredictedError(z, J, task.jacobian_dot(q, v), x_d_dot, x_d_ddot, drift)

    def learnt(self, state: Array) -> Array:
        """Return nothing, shape (…, 0)."""
        return state[..., :0]

    def __repr__(self) -> str:
        return f"KnownKinematics({self.task!r})"

    def _combined(self, rate: Array) -> Array:
        return np.asarray(self._combination.dot(rate))

    def _rate(self, x: Array, x_dot: Array, x_d: Array, x_d_dot: Array) -> Array:
        """Return ż of an error that is no difference, such as a rotation vector; shape (m,)."""
        size = math.hypot(*x_dot.tolist(), *x_d_dot.tolist())
        if size == 0.0:
            return self._none
        task, h = self.task, _DIFFERENCE / size
        after, before = (
            task.error(task.displaced(x, k * x_dot), task.displaced(x_d, k * x_d_dot))
            for k in (h, -h)
        )
        rate = (after - before) / (2.0 * h)
        jumped = not math.hypot(*rate.tolist()) < _JUMP * size
        return x_dot - x_d_dot if jumped else np.asarray(rate)
