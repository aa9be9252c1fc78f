"""`Driver`: what the loop needs of a robot."""

from __future__ import annotations

from typing import Literal, Protocol, runtime_checkable

from approxjac.controllers import Limits
from approxjac.interface import Measurement
from approxjac.validation import Array


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
