"""What a task is: X = h(q) and its Jacobian, for one robot, true or believed."""

from __future__ import annotations

from abc import ABC, abstractmethod

from approxjac.checks import Array
from approxjac.robots import Robot


class Task(ABC):
    """A task X = h(q) of one robot.

    A controller uses the task of the *believed* robot, and of it only the Jacobian Ĵ: the value
    X comes from a measurement. A sensor is the same kind of object on the *true* robot.

    Owns scratch memory: one instance a thread.
    """

    @property
    @abstractmethod
    def robot(self) -> Robot:
        """The robot whose kinematics the task uses."""

    @property
    @abstractmethod
    def labels(self) -> tuple[str, ...]:
        """Names of the task coordinates, length m."""

    @property
    @abstractmethod
    def unit(self) -> str:
        """Unit of the task coordinates."""

    @property
    def m(self) -> int:
        """Number of task coordinates."""
        return len(self.labels)

    @abstractmethod
    def value(self, q: Array) -> Array:
        """X = h(q), shape (m,)."""

    @abstractmethod
    def jacobian(self, q: Array) -> Array:
        """∂h/∂q in the tangent space, shape (m, n_v)."""

    @abstractmethod
    def jacobian_dot(self, q: Array, v: Array) -> Array:
        """d/dt of `jacobian` along q̇, shape (m, n_v)."""
