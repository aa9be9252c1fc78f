"""`Driver`: the interface of a robot to the loop, and `read`, which copies its arrays."""

from __future__ import annotations

from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import pinocchio as pin

from approxjac.controllers import Limits
from approxjac.controllers.arguments import from_another_clock
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement
from approxjac.tasks import Task
from approxjac.validation import Array

_AHEAD = 0.01  # s, and a period: by which x may be stamped later than the state it comes with


@runtime_checkable
class Driver(Protocol):
    """The interface of a robot. One thread calls `read` and `send`; any may call `brake`.

    Attributes:
        dt: Period of the loop [s].
        command: Kind of commands for `send`: joint torques, or joint velocities.
        adds_gravity: Whether the robot adds the gravity torque of its own model to commands.
        limits: Limits that the robot enforces itself, by refusing a command or stopping.
    """

    dt: float
    command: Literal["torque", "velocity"]
    adds_gravity: bool
    limits: Limits

    def read(self) -> Measurement:
        """Wait for the state of the next period and return it.

        t is the robot's clock [s]; q and v are in the order of `Robot.joint_names`; q has one
        number per joint, or (cos, sin) for continuous ones as in `Robot.neutral`; x is the sensor's
        last value, taken at t_x of the same clock, or NaN if there is none.
        """
        ...

    def send(self, command: Array) -> None:
        """Send joint torques or velocities, shape (n_v,), for this period."""
        ...

    def brake(self) -> None:
        """End control and hold the arm by the robot's own means; do nothing the second time."""
        ...


def read(driver: Driver, task: Task) -> Measurement:
    """Return a copy of the next measurement, as drivers may reuse their arrays.

    Masked entries become NaN, angles of continuous joints (cos, sin).

    Raises:
        InvalidInputError: q, q̇ or x with another number of entries.
    """
    t, *arrays, t_x = driver.read()
    q, v, x = map(_filled, arrays)
    robot = task.robot
    if q.shape == (robot.nv,) and robot.nq != robot.nv:
        q = np.array(pin.integrate(robot.model, robot.neutral(), q))
    measured = Measurement(float(t), q, v, x, None if t_x == -np.inf else t_x)
    if (q.shape, v.shape, x.shape) != ((robot.nq,), (robot.nv,), (task.n_x,)):
        raise InvalidInputError(
            f"driver must read q, q̇ and x with {robot.nq}, {robot.nv} and {task.n_x} numbers, "
            f"got shapes {q.shape}, {v.shape}, {x.shape}",
            given=measured,
        )
    return measured


def two_clocks(measurement: Measurement, dt: float) -> str:
    """Return an error text if x was taken after t, which proves two clocks, else ""."""
    return from_another_clock(measurement.t, measurement.t_x, dt + _AHEAD)


def _filled(values: Any) -> Array:
    """Return a copy of an array, with NaN for its masked entries."""
    if type(values) is not np.ndarray:
        values = np.ma.filled(np.ma.asarray(values, np.float64), np.nan)
    return np.array(values, np.float64)
