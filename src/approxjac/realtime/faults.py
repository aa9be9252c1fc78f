"""`Fault`: faults of a robot's loop; `Accuracy` and `Tolerances`: bounds of normal operation."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from approxjac.formatting import joined, short_fields
from approxjac.tasks import Task
from approxjac.validation import Array, as_diagonal, as_limits, as_number, require

_X = {"m": 2e-3, "rad": 2e-3, "px": 1.0}
_ERROR = {"m": 0.15, "rad": 0.5, "px": 150.0}
_BLIND = {"m": 0.01, "rad": 0.04, "px": 10.0}


class Fault(enum.Enum):
    """Reason to end a run early."""

    JOINTS_UNKNOWN = "q or q̇ was not finite for several periods"
    POSITION_JUMPED = "q jumped further than a joint can move in a period"
    VELOCITY_JUMPED = "q̇ jumped further than the motors can change it in a period"
    VELOCITY_DISAGREES = (
        "q̇ is not the rate of q: check signs, units, a joint that moves in only one of them, and "
        "the rate of the robot's clock"
    )
    ENCODER_FROZEN = "q of a moving joint stopped changing from one period to the next"
    COMMAND_UNANSWERED = "a joint does not move under a command that must move it"
    SENSOR_JUMPED = (
        "x jumped further than the tip can move; Accuracy(x=..., x_period=...) allows more noise "
        "or a longer period"
    )
    SENSOR_DISAGREES = (
        "x does not move as the joints do: check its axes and unit, and the encoders; "
        "Accuracy(x=..., x_period=...) allows more noise or a longer period"
    )
    SENSOR_FROZEN = "the joints move, but x does not"
    CLOCK_STOOD_STILL = "the robot's clock does not advance: its state is old"
    CLOCK_JUMPED = "the clock of the robot, or that of x, jumped"
    MOTOR_WEAK = "a motor does not give the torque that it is asked for"
    READ_HUNG = "a call of the driver or the controller did not return in time"
    TORQUE_LATE = "a command was sent too late"
    TOO_FAST = "a joint exceeds its speed limit"
    SPEED_GREW = "the joints become faster and faster"
    ASTRAY = "the error to the moving target is too large"
    BLIND = "x was lost for too long, or while the arm moved too far"
    LIMITS = "limits reduced the torque and gave up the proof for too long"
    FAILED = "the driver or the controller raised an error"

    @property
    def message(self) -> str:
        """Text that says what is wrong."""
        return str(self.value)

    @property
    def stops(self) -> bool:
        """True if the controller brings the arm to rest first; else it brakes at once."""
        return self in (Fault.TORQUE_LATE, Fault.LIMITS)

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, eq=False, repr=False)
class Accuracy:
    """Accuracy of the sensors and of the believed arm: errors within it are no fault.

    Attributes:
        q: Standard deviation of q, a number or (n_v,) [rad or m]; that of an encoder's step is its
            size/√12, 4.4e-4 rad for 12 bits.
        v: Standard deviation of q̇, likewise [rad/s or m/s].
        velocity_filter: Time constant of the filter of q̇ [s].
        x: Standard deviation of x, a number or (m,) [unit of the task]; 2 mm, 2 mrad and 1 px by
            default.
        x_period: Longest time between new values of x while none is lost [s].
        stiction: Torque within which a joint may stick, a number or (n_v,) [N m or N]; by default
            that of `Friction.usual`, 6 % of its effort limit and of its torque.
        tool: Largest error of the believed tip position on its link [m].
        jacobian: Further error of Ĵ, as a share of it.

    Raises:
        InvalidInputError: Numbers that are negative or not finite.
    """

    q: float | Sequence[float] | Array = 1e-4
    v: float | Sequence[float] | Array = 0.01
    velocity_filter: float = 0.0
    x: float | Sequence[float] | Array | None = None
    x_period: float = 0.04
    stiction: float | Sequence[float] | Array | None = None
    tool: float = 0.25
    jacobian: float = 0.15
    __repr__ = short_fields

    def __post_init__(self) -> None:
        for name in ("q", "v", "x", "stiction"):
            value = getattr(self, name)
            if value is not None:
                as_diagonal(name, value, positive=False)
        as_number("tool", self.tool, unit="m", minimum=0.0)
        as_number("jacobian", self.jacobian, minimum=0.0)
        as_number("x_period", self.x_period, unit="s", above=0.0)
        as_number("velocity_filter", self.velocity_filter, unit="s", minimum=0.0)

    def for_units(self, units: Sequence[str]) -> Accuracy:
        """Return this accuracy with x filled in, by default from the units."""
        return self if self.x is not None else replace(self, x=[_X.get(u, 2e-3) for u in units])


@dataclass(frozen=True, eq=False, repr=False)
class Tolerances:
    """Bounds of normal operation on a robot: anything beyond them is a fault.

    Attributes:
        accuracy: Accuracy of the sensors and of Ĵ.
        max_error: Largest error to the moving target, a number or shape (m,) [unit of the task];
            0.15 m, 0.5 rad and 150 px by default.
        max_blind_motion: Largest motion of x while it is lost, as believed, a number or shape (m,)
            [unit of the task]; 0.01 m, 0.04 rad and 10 px by default, or what a `HeldMeasurement`
            goes on for, if that is more. Where positions are predicted by `AdaptiveKinematics`, it
            is the largest error of that: three standard deviations of what was learnt.
        timeout: Longest time for which x may be lost (also at the start) or limits may give up the
            proof, and which a controlled stop may take [s].
        max_period: Longest time between commands, by the robot's clock, more than one period [s];
            the watchdog brakes after twice that by this machine's clock.

    Raises:
        InvalidInputError: Numbers that are not positive.
    """

    accuracy: Accuracy = Accuracy()
    max_error: float | Sequence[float] | Array | None = None
    max_blind_motion: float | Sequence[float] | Array | None = None
    timeout: float = 1.0
    max_period: float = 0.02
    __repr__ = short_fields

    def __post_init__(self) -> None:
        require("accuracy", self.accuracy, Accuracy, "Accuracy(...)")
        as_number("timeout", self.timeout, unit="s", above=0.0)
        as_number("max_period", self.max_period, unit="s", above=0.0)

    def for_task(self, task: Task, dt: float, unseen: Array | None = None) -> Tolerances:
        """Return these for each coordinate of a task, a period of dt [s], and `unseen`."""
        as_number("max_period", self.max_period, unit="s", above=dt)
        blind = task_bounds("max_blind_motion", self.max_blind_motion, task, _BLIND)
        if self.max_blind_motion is None and unseen is not None:
            # as far as a motion goes that is within it in each coordinate
            blind = np.maximum(blind, math.sqrt(task.m) * unseen)
        return replace(
            self,
            accuracy=self.accuracy.for_units(task.units),
            max_error=task_bounds("max_error", self.max_error, task, _ERROR),
            max_blind_motion=blind,
        )


def task_bounds(
    name: str, given: Any, task: Task, usual: Mapping[str, float], per: str = ""
) -> Array:
    """Return bounds (m,), by default the usual ones for the units, infinite for other units."""
    if given is None:
        return np.array([usual.get(unit, math.inf) for unit in task.units])
    return as_limits(name, given, task.m, unit=joined(task.units) + per)
