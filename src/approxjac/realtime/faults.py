"""`Fault`: what can be wrong with a robot's loop, and what to do about it."""

from __future__ import annotations

import enum


class Fault(enum.Enum):
    """Reason to end a run before its time.

    Attributes:
        message: In words.
        stops: Whether the controller brings the arm to rest before the brake; else the robot
            brakes at once, as what it would be controlled by is what is wrong.
    """

    message: str
    stops: bool

    def __new__(cls, message: str, stops: bool = False) -> Fault:  # noqa: D102
        fault = object.__new__(cls)
        fault._value_ = len(cls.__members__)
        fault.message, fault.stops = message, stops
        return fault

    def __str__(self) -> str:
        return self.name

    JOINTS_UNKNOWN = "q or q̇ was not finite for several periods"
    POSITION_JUMPED = "q jumped further than a joint can move in a period"
    VELOCITY_JUMPED = "q̇ jumped further than the motors can change it in a period"
    VELOCITY_DISAGREES = (
        "q̇ is not the rate of q: a sign, a unit, a joint that stands still in one of them, or a "
        "clock that runs at another pace than the arm"
    )
    ENCODER_FROZEN = "q of a joint that moved stands still from one period to the next"
    COMMAND_UNANSWERED = "a joint does not move under a command that must move it"
    SENSOR_JUMPED = (
        "x jumped further than the tip can move; Accuracy(x=..., x_period=...) tells of more noise "
        "or a longer period"
    )
    SENSOR_DISAGREES = (
        "x does not move as the joints do: its axes, its unit, or an encoder; Accuracy(x=..., "
        "x_period=...) tells of more noise or a longer period"
    )
    SENSOR_FROZEN = "the joints move, and x does not"
    CLOCK_STOOD_STILL = "the robot's clock stands still: its state is an old one"
    CLOCK_JUMPED = "the clock of the robot, or that of x, jumped"
    READ_HUNG = "the driver or the controller did not come back in time"
    TORQUE_LATE = "a command was sent too late", True
    TOO_FAST = "a joint is faster than it may be"
    SPEED_GREW = "the joints become faster and faster"
    ASTRAY = "the error to the moving target is too large"
    BLIND = "x was lost for too long"
    LIMITS = "limits held the torque back from what keeps the proof for too long", True
    FAILED = "the driver or the controller raised an error"
