"""The plant: the true robot, its friction and the sensor that watches it."""

from __future__ import annotations

from collections.abc import Sequence

from approxjac.checks import Array, as_diagonal, as_vector, require
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement
from approxjac.robots import Dynamics, Robot
from approxjac.tasks import Task


class Plant:
    """M(q) q̈ + C(q, q̇)q̇ + B q̇ + g(q) = τ of the true robot, eq. (1).

    It yields measurements and takes torques; nothing else of it reaches a controller. The
    direction of gravity is the robot's: see `Robot.with_gravity`.

    Owns scratch memory: one instance a thread.

    Args:
        robot: The true robot.
        sensor: What measures X: a task of the true robot.
        friction: Natural viscous friction B ≥ 0, a number or shape (n_v,) [N m s/rad or N s/m].
            Damping that the URDF mentions is not used.

    Raises:
        InvalidInputError: A sensor on another robot, or friction that is negative.
    """

    def __init__(
        self, robot: Robot, sensor: Task, friction: float | Sequence[float] | Array = 0.0
    ) -> None:
        require("robot", robot, Robot, "the true Robot")
        require("sensor", sensor, Task, "a task of the true robot, such as PositionTask(robot)")
        if sensor.robot != robot:
            raise InvalidInputError(
                f"sensor must be a task of the plant's own robot {robot!r}, "
                f"got one of {sensor.robot!r}",
                given=sensor,
            )
        self.robot = robot
        self.sensor = sensor
        self.friction = as_diagonal(
            "friction", friction, robot.nv, unit="N m s/rad", positive=False
        )
        self.dynamics = Dynamics(robot)

    def require_task(self, task: Task) -> None:
        """Refuse a controller's task whose coordinates are not those that the sensor measures.

        Raises:
            InvalidInputError: Other coordinates, or another number of joints.
        """
        if self.sensor.labels != task.labels or self.robot.nv != task.robot.nv:
            raise InvalidInputError(
                f"the controller's task must have the coordinates of the plant's sensor "
                f"{self.sensor!r}, got {task!r}",
                given=task,
            )

    def acceleration(self, q: Array, v: Array, tau: Array) -> Array:
        """q̈ under a torque, shape (n_v,) [rad/s² or m/s²]."""
        v = as_vector("v", v, self.robot.nv)
        tau = as_vector("tau", tau, self.robot.nv)
        return self.dynamics.forward(q, v, tau - self.friction * v)

    def measure(self, t: float, q: Array, v: Array) -> Measurement:
        """What a controller gets to know at time t [s]."""
        q, v = self.robot.configuration(q), as_vector("v", v, self.robot.nv)
        return Measurement(t, q, v, self.sensor.value(q))

    def __repr__(self) -> str:
        return f"Plant({self.robot!r}, {self.sensor!r}, friction={self.friction.tolist()})"
