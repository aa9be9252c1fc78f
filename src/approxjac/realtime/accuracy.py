"""`Accuracy`: how well the sensors of a robot, and what is believed of it, are known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from approxjac.formatting import short_fields
from approxjac.validation import Array, as_diagonal, as_number, shape_of

_X = {"m": 2e-3, "rad": 2e-3, "px": 1.0}


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
