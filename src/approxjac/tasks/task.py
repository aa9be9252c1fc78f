"""What a task is: X = h(q) and its Jacobian, for one robot, true or believed."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.robots import Robot
from approxjac.validation import Array, as_array

_TRIES = 20000  # random postures to look for ones that a camera sees


class Task(ABC):
    """A task X = h(q) of one robot.

    A controller uses the task of the *believed* robot, and of it only the Jacobian Ĵ: the value
    X comes from a measurement. A sensor is the same kind of object on the *true* robot.

    The error e of a value to a target has m coordinates. Mostly e = X − X_d and X has m entries
    too; a pose has 7 entries and an error of 6 coordinates.

    Owns scratch memory: one instance a thread.
    """

    @property
    @abstractmethod
    def robot(self) -> Robot:
        """The robot whose kinematics the task uses."""

    @property
    @abstractmethod
    def labels(self) -> tuple[str, ...]:
        """Names of the error's coordinates, length m."""

    @property
    @abstractmethod
    def units(self) -> tuple[str, ...]:
        """Units of the error's coordinates, length m."""

    @property
    def m(self) -> int:
        """Number of task coordinates: of the error, and rows of the Jacobian."""
        return len(self.labels)

    @property
    def n_x(self) -> int:
        """Length of a value X, and of a target."""
        return self.m

    @property
    def parts(self) -> tuple[tuple[slice, slice], ...]:
        """What is measured at once, such as each feature of an image: entries of x, and of e."""
        return ((slice(0, self.n_x), slice(0, self.m)),)

    @property
    def unit(self) -> str:
        """Unit of the task coordinates; different ones are joined by "or"."""
        return " or ".join(dict.fromkeys(self.units))

    @abstractmethod
    def value(self, q: Array) -> Array:
        """X = h(q), shape (n_x,)."""

    @property
    def measured(self) -> Task:
        """The task whose value x is and whose sensor the plant has; this one, unless combined."""
        return self

    def measured_rate(self, Jv: Array) -> Array:
        """Rate of the error of `measured` where this task's Jacobian gives J q̇; shape (m,)."""
        return Jv

    def seen(self, x: Array) -> Array:
        """What a sensor delivers of a value x (n_x,): NaN in the parts that it cannot see."""
        return x

    def sees(self, q: Array) -> bool:
        """Whether a sensor delivers all of its value at q (nq,)."""
        return bool(np.isfinite(self.seen(self.value(q))).all())

    @property
    def jacobian_uses_x(self) -> bool:
        """Whether the Jacobian depends on the measured x, and not on q only."""
        return False

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        """J of ė = J q̇ near e = 0 (∂h/∂q where e = X − X_d), shape (m, n_v).

        Args:
            q: Configuration, shape (nq,).
            x: Measured value, shape (n_x,), for a task that uses it (`jacobian_uses_x`). Parts of
                it that are lost, and None, are replaced by what this robot would measure.

        Raises:
            InvalidInputError: A q of the wrong length or not finite.
        """
        return self.compute_jacobian(self.robot.configuration(q), x)

    @abstractmethod
    def compute_jacobian(self, q: Array, x: Array | None = None) -> Array:
        """`jacobian` at a q that has been checked already, for loops."""

    def sensor_jacobian(self, q: Array) -> Array:
        """J by which what a sensor measures moves at q (nq,), shape (m, n_v).

        For analysis of the true robot: `jacobian`, less whatever a controller is to assume in it.
        """
        return self.jacobian(q)

    @abstractmethod
    def jacobian_dot(self, q: Array, v: Array) -> Array:
        """d/dt of `jacobian` along q̇, shape (m, n_v)."""

    def jacobian_gradient(self, q: Array) -> Array:
        """∂J/∂q_k, shape (n_v, m, n_v), k first: `jacobian_dot` along each joint."""
        return np.array([self.jacobian_dot(q, unit) for unit in np.eye(self.robot.nv)])

    def error(self, x: Array, x_d: Array) -> Array:
        """Error e of a value x to a target, both of shape (n_x,); shape (m,), NaN if x is lost."""
        return x - x_d

    @abstractmethod
    def on(self, robot: Robot) -> Task:
        """The same task of another robot, such as the true one.

        Raises:
            UnknownNameError: That robot has no such frame.
        """

    @property
    def subtracts(self) -> bool:
        """Whether the error is x − x_d."""
        return type(self).error is Task.error

    @property
    def origin(self) -> Array:
        """A value to measure others from: zero, or no rotation; shape (n_x,)."""
        return np.zeros(self.n_x)

    def displaced(self, x: Array, e: Array) -> Array:
        """Value whose error to x (n_x,) is e (m,); shape (n_x,)."""
        return x + e

    def with_error(self, x: Array, x_d: Array, e: Array) -> Array:
        """Value whose error to x_d (n_x,) is e (m,); what no error tells is as in x (n_x,)."""
        return self.displaced(x_d, e)

    def error_rate(self, e: Array, Jv: Array) -> Array:
        """ė where the error is e and the Jacobian gives J q̇; shape (m,)."""
        return Jv

    def error_jacobian(self, e: Array, J: Array) -> Array:
        """∂e/∂q where the error is e and the Jacobian is J; shape (m, n_v)."""
        if self.subtracts:
            return J
        return np.array([self.error_rate(e, column) for column in J.T]).T

    def target(self, x_d: object) -> Array:
        """Return a target as a read-only array of shape (n_x,).

        Raises:
            InvalidInputError: Wrong shape, not finite, or without an error to it.
        """
        target = as_array("target", x_d, (self.n_x,), self.unit)
        if not (np.abs(self.error(target, target)) < 1e-6).all():
            raise InvalidInputError(
                f"target must be a value of {self!r}, got {target.tolist()}", given=x_d
            )
        return target


def vanishing(task: Task) -> float:
    """A tenth of the σ_max that the task's Jacobian typically has: below it, it is vanishing.

    The median over seeded random postures within the joint limits [unit of the task/rad].
    """
    largest = [np.linalg.norm(task.jacobian(q), 2) for q in seen_postures(task, 20)]
    return 0.1 * float(np.median(largest))


def seen_postures(task: Task, count: int) -> list[Array]:
    """Seeded random postures within the joint limits in which the task's own sensor sees it.

    Returns:
        `count` of them, or fewer where they are rare.

    Raises:
        InvalidInputError: None was found.
    """
    rng = np.random.default_rng(0)
    # as random_configuration, whose range is the same for all of them
    model, neutral, usual = task.robot.model, task.robot.neutral(), task.robot.usual_range()
    found: list[Array] = []
    for _ in range(max(count, _TRIES)):
        q = np.array(pin.integrate(model, neutral, rng.uniform(*usual)))
        if task.sees(q):
            found.append(q)
            if len(found) == count:
                break
    if not found:
        raise InvalidInputError(
            f"task must be one that its own sensor sees in some posture within the joint limits of "
            f"{task.robot.name}, got {task!r}",
            given=task,
        )
    return found


def require_jacobian_of_q(task: Task, what: str) -> None:
    """Refuse a task whose Jacobian uses the measured x, for an analysis that needs its rate."""
    if task.jacobian_uses_x:
        raise InvalidInputError(
            f"{what} is for a task whose Jacobian depends on q only and has a rate, such as an "
            f"ImageTask with depth='believed', got {task!r}; local_stability and rollouts are for "
            "every task",
            given=task,
        )


def require_rows(m: int, robot: Robot) -> None:
    """Refuse a task of more coordinates than the robot has joints: Ĵ⁺ would not exist."""
    if m > robot.nv:
        raise InvalidInputError(
            f"a task must have at most as many coordinates as the robot has joints "
            f"(m <= n_v), got m = {m} for {robot.name} with n_v = {robot.nv}",
            given=m,
        )
