"""`Driver`: what the loop needs of a robot, and `read`: arrays of its own from one."""

from __future__ import annotations

from typing import Literal, Protocol, runtime_checkable

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
    """A robot as the loop sees it. One thread calls `read` and `send`; any may call `brake`.

    Attributes:
        dt: Period of the loop [s].
        command: What `send` takes: joint torques, or joint velocities.
        adds_gravity: Whether the robot adds the torque that holds it, by its own model, to those
            sent.
        limits: What the robot enforces itself, such as by refusing a command or by stopping.
    """

    dt: float
    command: Literal["torque", "velocity"]
    adds_gravity: bool
    limits: Limits

    def read(self) -> Measurement:
        """Wait for the state of the next period and return it.

        t is the robot's clock [s]; q, v in the order of `Robot.joint_names`; q has one number a
        joint, angles of continuous ones too, or (cos, sin) of those as `Robot.neutral` has; x is
        the last value that the sensor gave, taken at t_x of the same clock, or NaN where there is
        none.
        """
        ...

    def send(self, command: Array) -> None:
        """Send joint torques or velocities, shape (n_v,), for this period."""
        ...

    def brake(self) -> None:
        """End control and hold the arm by the robot's own means; does nothing the second time."""
        ...


def read(driver: Driver, task: Task) -> Measurement:
    """Return the next measurement, copied, as drivers may write to the same arrays each time.

    Masked entries become NaN. Encoders may give angles of continuous joints, too.

    Raises:
        InvalidInputError: q, q̇ or x with another number of entries.
    """
    t, *arrays, t_x = driver.read()
    masked = (np.ma.asarray(each, np.float64) for each in arrays)
    q, v, x = (np.array(np.ma.filled(each, np.nan)) for each in masked)
    robot = task.robot
    if q.shape == (robot.nv,) and robot.nq != robot.nv:
        q = np.array(pin.integrate(robot.model, robot.neutral(), q))
    measured = Measurement(float(t), q, v, x, t_x)
    if (q.shape, v.shape, x.shape) != ((robot.nq,), (robot.nv,), (task.n_x,)):
        raise InvalidInputError(
            f"driver must read q, q̇ and x with {robot.nq}, {robot.nv} and {task.n_x} numbers, "
            f"got shapes {q.shape}, {v.shape}, {x.shape}",
            given=measured,
        )
    return measured


def two_clocks(measurement: Measurement, dt: float) -> str:
    """Return in words that x was taken after t, which no one clock can show, or ""."""
    return from_another_clock(measurement.t, measurement.t_x, dt + _AHEAD)
