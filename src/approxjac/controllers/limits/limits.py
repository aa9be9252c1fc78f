"""`Limits` of torques and joints, and the deceleration that they allow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.formatting import short_fields
from approxjac.robots import Dynamics, Robot
from approxjac.validation import Array, as_limits, as_number, read_only, require, shape_of

_CONFIGURATIONS = 100
_SHARE, _RARE = 0.5, 0.05
_LEAST_LEFT = 0.05  # of the effort, where gravity takes all of it
_UNITS = {
    "effort": "N m or N",
    "rate": "N m/s or N/s",
    "velocity": "rad/s or m/s",
    "acceleration": "rad/s^2 or m/s^2",
}
_NO_INERTIA = 1e-12  # instead of none, which would divide by zero


@dataclass(frozen=True, eq=False, repr=False)
class Limits:
    """Limits of the motors and joints of an arm. None or infinite is no limit.

    `Limits.of(robot)` returns those of the URDF; `dataclasses.replace` changes one.

    Attributes:
        effort: Largest abs(τ), a number or shape (n_v,) [N m or N].
        rate: Largest change of τ in time, a number or shape (n_v,) [N m/s or N/s].
        position: Smallest and largest joint positions, each shape (n_v,) [rad or m].
        velocity: Largest abs(q̇), a number or shape (n_v,) [rad/s or m/s].
        acceleration: Largest abs(q̈), a number or shape (n_v,) [rad/s² or m/s²].

    Raises:
        InvalidInputError: Limits that are not positive, not numbers, or reversed.
    """

    effort: float | Sequence[float] | Array | None = None
    rate: float | Sequence[float] | Array | None = None
    position: tuple[Sequence[float] | Array, Sequence[float] | Array] | None = None
    velocity: float | Sequence[float] | Array | None = None
    acceleration: float | Sequence[float] | Array | None = None
    __repr__ = short_fields

    def __post_init__(self) -> None:
        for name, unit in _UNITS.items():
            value = getattr(self, name)
            if value is not None:
                size = shape_of(value)
                limits = as_limits(name, value, max(size[0], 1) if size else 1, unit=unit)
                object.__setattr__(self, name, limits if size else float(limits[0]))
        if self.position is not None:
            object.__setattr__(self, "position", _range(self.position))

    @classmethod
    def of(cls, robot: Robot, scale: float = 1.0) -> Limits:
        """Return the limits of effort, position and velocity of a robot's URDF.

        `scale` > 0 is the usable share of the effort limits.
        """
        require("robot", robot, Robot, "a Robot")
        scale = as_number("scale", scale, above=0.0)
        return cls(
            effort=scale * robot.effort_limits,
            position=robot.position_limits,
            velocity=robot.velocity_limits,
        )

    def for_joints(self, nv: int) -> Limits:
        """Return these limits with an entry for each of n_v joints, infinite where there is none.

        Raises:
            InvalidInputError: Limits of another number of joints.
        """
        filled = {}
        for name in _UNITS:
            value = getattr(self, name)
            given = np.inf if value is None else value
            filled[name] = as_limits(name, given, nv, unit="one per joint")
        lower, upper = self.position or (np.full(nv, -np.inf), np.full(nv, np.inf))
        if len(lower) != nv:
            message = f"position must hold a range for each of {nv} joints, got {len(lower)}"
            raise InvalidInputError(message, given=self.position)
        return Limits(position=(lower, upper), **filled)


def sure_deceleration(robot: Robot, effort: Array) -> Array:
    """Return the deceleration that motors guarantee for each joint, (n_v,) [rad/s² or m/s²].

    It needs at most half of the effort left after gravity, of every motor, in 19 of 20
    configurations within the joint limits. The other half is for joints that brake together, for
    the terms in q̇, and for a payload. Infinite if the effort limits (n_v,) [N m or N] are unknown.
    """
    dynamics, drawn = Dynamics(robot), [*robot.configurations(_CONFIGURATIONS)]
    left = np.maximum(effort - np.abs([*map(dynamics.g, drawn)]), _LEAST_LEFT * effort)
    inertias = np.maximum(np.abs([*map(dynamics.M, drawn)]), _NO_INERTIA)
    rates = (left[:, :, np.newaxis] / inertias).min(axis=1)
    return np.asarray(_SHARE * np.quantile(rates, _RARE, axis=0, method="lower"))


def _range(position: object) -> tuple[Array, Array]:
    try:
        lower, upper = (np.array(side, dtype=np.float64) for side in position)  # type: ignore[attr-defined]
        fits = lower.shape == upper.shape and lower.ndim == 1 and bool((lower < upper).all())
    except (TypeError, ValueError):
        fits = False
    if not fits:
        raise InvalidInputError(
            "position must be the smallest and the largest position of each joint [rad or m], "
            f"got {position!r}",
            given=position,
        )
    return read_only(lower), read_only(upper)
