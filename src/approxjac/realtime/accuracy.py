"""`Accuracy` of sensors and beliefs, and `Tolerances`: what is a fault, and what is none."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from approxjac.formatting import joined, short_fields
from approxjac.tasks import Task
from approxjac.validation import Array, as_diagonal, as_limits, as_number, require, shape_of

_X = {"m": 2e-3, "rad": 2e-3, "px": 1.0}
_ERROR = {"m": 0.15, "rad": 0.5, "px": 150.0}
_BLIND = {"m": 0.01, "rad": 0.04, "px": 10.0}


@dataclass(frozen=True, eq=False, repr=False)
class Accuracy:
    """Accuracy of the sensors, and of what is believed of the arm.

    What is no more than this is no fault.

    Attributes:
        q: Standard deviation of q, with the steps of the encoders, a number or (n_v,) [rad or m].
        v: The same of q̇ [rad/s or m/s].
        velocity_filter: Time constant by which q̇ is late [s].
        x: Standard deviation of x, a number or (m,) [unit of the task]; 2 mm, 2 mrad and 1 px by
            default.
        x_period: Longest time between new values of x, as long as none is lost [s].
        stiction: Torque within which a joint may stick, a number or (n_v,) [N m or N]; 5 % of
            its largest one by default.
        tool: How far the tip may be from where it is believed on its link [m].
        jacobian: Share of Ĵ by which the true Jacobian may differ besides.

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
                as_diagonal(name, value, math.prod(shape_of(value)), positive=False)
        as_number("tool", self.tool, unit="m", minimum=0.0)
        as_number("jacobian", self.jacobian, minimum=0.0)
        as_number("x_period", self.x_period, unit="s", above=0.0)
        as_number("velocity_filter", self.velocity_filter, unit="s", minimum=0.0)

    def for_units(self, units: Sequence[str]) -> Accuracy:
        """Return it with an x, by default what is usual for the units of a task."""
        return self if self.x is not None else replace(self, x=[_X.get(u, 2e-3) for u in units])

    def stiction_of(self, effort: Array) -> Array:
        """Return within which torque each joint may stick, for its largest ones (n_v,)."""
        if self.stiction is None:
            return 0.05 * effort
        return np.broadcast_to(np.asarray(self.stiction, float), effort.shape)


@dataclass(frozen=True, eq=False, repr=False)
class Tolerances:
    """Bounds of what is normal in a loop on a robot: anything beyond them is a fault.

    Attributes:
        accuracy: How well the sensors, and Ĵ, are known.
        max_error: Largest error to the moving target, a number or shape (m,) [unit of the task];
            0.15 m, 0.5 rad and 150 px by default.
        max_blind_motion: How far the tip may move while x is lost, as it is believed, a number or
            shape (m,) [unit of the task]; 0.01 m, 0.04 rad and 10 px by default.
        timeout: Longest time for which x may be lost, at the start too, or limits void the proof,
            and which a controlled stop may take [s].
        max_period: Longest time from command to command, by the robot's clock, longer than a
            period; after twice as long by this machine's the watchdog brakes [s].

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

    def for_task(self, task: Task, dt: float) -> Tolerances:
        """Return them with a bound for each coordinate of a task, for a period of dt [s].

        Raises:
            InvalidInputError: Bounds of another size, or a `max_period` of at most dt.
        """
        as_number("max_period", self.max_period, unit="s", above=dt)
        return replace(
            self,
            accuracy=self.accuracy.for_units(task.units),
            max_error=task_bounds("max_error", self.max_error, task, _ERROR),
            max_blind_motion=task_bounds("max_blind_motion", self.max_blind_motion, task, _BLIND),
        )


def task_bounds(
    name: str, given: Any, task: Task, usual: Mapping[str, float], per: str = ""
) -> Array:
    """Return bounds for each coordinate of a task, by default the usual ones of its units.

    Args:
        name: Of the argument, for errors.
        given: A number, shape (m,), or None.
        task: The task.
        usual: Unit -> usual bound; infinite where there is none.
        per: What follows the unit, such as "/s".

    Returns:
        Shape (m,) [unit of the task].
    """
    if given is None:
        return np.array([usual.get(unit, math.inf) for unit in task.units])
    return as_limits(name, given, task.m, unit=joined(task.units) + per)
