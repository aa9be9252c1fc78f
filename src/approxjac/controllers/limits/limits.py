"""`Limits` of torques and joints, and the bounds and rows that they make for one control step."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.formatting import short_fields
from approxjac.robots import Dynamics, Robot
from approxjac.validation import Array, as_limits, as_number, require, shape_of

_CONFIGURATIONS = 100
_SHARE, _RARE = 0.5, 0.05
_LEAST_LEFT = 0.05  # of the effort, where gravity takes all of it
_NO_INERTIA = 1e-12  # instead of none, which would divide by zero


@dataclass(frozen=True, eq=False, repr=False)
class Limits:
    """Limits of the motors and joints of an arm. Each is off where it is None, or infinite.

    `Limits.of(robot)` takes those of the URDF; `dataclasses.replace` changes one.

    Attributes:
        effort: Largest abs(τ), a number or shape (n_v,) [N m or N].
        rate: Largest change of τ in time, a number or shape (n_v,) [N m/s or N/s].
        position: Smallest and largest joint positions, each shape (n_v,) [rad or m].
        velocity: Largest abs(q̇), a number or shape (n_v,) [rad/s or m/s].

    Raises:
        InvalidInputError: Limits that are not positive, not numbers, or reversed.
    """

    effort: float | Sequence[float] | Array | None = None
    rate: float | Sequence[float] | Array | None = None
    position: tuple[Sequence[float] | Array, Sequence[float] | Array] | None = None
    velocity: float | Sequence[float] | Array | None = None

    def __post_init__(self) -> None:
        units = {"effort": "N m or N", "rate": "N m/s or N/s", "velocity": "rad/s or m/s"}
        for name, unit in units.items():
            value = getattr(self, name)
            if value is not None:
                size = shape_of(value)
                limits = as_limits(name, value, max(size[0], 1) if size else 1, unit=unit)
                object.__setattr__(self, name, limits if size else float(limits[0]))
        if self.position is not None:
            object.__setattr__(self, "position", _range(self.position))

    def __repr__(self) -> str:
        return short_fields(self)

    @classmethod
    def of(cls, robot: Robot, scale: float = 1.0) -> Limits:
        """Return the limits of effort, position and velocity of a robot's URDF.

        Args:
            robot: The believed robot.
            scale: Share of the effort limits that may be used, > 0.
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
        filled = {
            name: as_limits(name, np.inf if value is None else value, nv, unit="one a joint")
            for name, value in (
                ("effort", self.effort),
                ("rate", self.rate),
                ("velocity", self.velocity),
            )
        }
        lower, upper = (-np.inf, np.inf) if self.position is None else self.position
        if self.position is not None and len(lower) != nv:  # type: ignore[arg-type]
            raise InvalidInputError(
                f"position must hold a range for each of {nv} joints, got {len(lower)}",  # type: ignore[arg-type]
                given=self.position,
            )
        ranges = np.broadcast_to(np.array([lower, upper]).reshape(2, -1), (2, nv)).copy()
        return Limits(position=(ranges[0], ranges[1]), **filled)


def rate_bounds(
    before: Array, rate: Array, dt: float, lower: Array, upper: Array
) -> tuple[Array, Array]:
    """Return bounds (n_v,) that are also within reach of the torque before in one step of dt [s].

    It lies within the bounds and changes by `rate` (n_v,) [N m/s or N/s] at most.
    """
    return np.maximum(lower, before - dt * rate), np.minimum(upper, before + dt * rate)


def sure_deceleration(robot: Robot, effort: Array) -> Array:
    """Return how fast motors can surely brake each joint, shape (n_v,) [rad/s² or m/s²].

    Half of what is left of the efforts after gravity, in all but one of twenty configurations
    within the joint limits: while one joint brakes, every motor that this asks for a torque has to
    give it. The other half is for joints that brake together, for the terms in q̇, and for what the
    arm carries. Infinite where no effort is known.

    Args:
        robot: The believed robot.
        effort: Largest abs(τ), shape (n_v,).
    """
    dynamics, rng = Dynamics(robot), np.random.default_rng(0)
    found = []
    for _ in range(_CONFIGURATIONS):
        q = robot.random_configuration(rng)
        left = np.maximum(effort - np.abs(dynamics.g(q)), _LEAST_LEFT * effort)
        inertia = np.maximum(np.abs(dynamics.M(q)), _NO_INERTIA)
        found.append((left[:, np.newaxis] / inertia).min(axis=0))
    return np.asarray(_SHARE * np.quantile(found, _RARE, axis=0, method="lower"))


def speed_bounds(
    motion: Array, joints: Iterable[Sequence[float]], approach: float
) -> tuple[list[float], list[float]]:
    """Return the smallest and the largest speed of each joint, in plain numbers.

    A joint at a distance d from its limit may move towards it at κd at most, so it gets there as
    exp(−κt) and needs no sudden stop; and, where that takes more than the deceleration a, at
    √(2ad − (a/κ)²), along which it brakes with a until the two meet. One beyond its limit has to
    come back, no faster than it may move.

    Source: B. Faverjon and P. Tournassoud, "A local based approach for path planning of
    manipulators with a high number of degrees of freedom", ICRA 1987, for κd.

    Args:
        motion: Joint positions, shape (n_v,) [rad or m].
        joints: Smallest and largest position, largest speed, and a > 0 of each.
        approach: κ [1/s].
    """
    slowest, fastest = [], []
    for q, (low, high, most, a) in zip(motion.tolist(), joints, strict=True):
        slowest.append(-_towards(q - low, most, approach, a))
        fastest.append(_towards(high - q, most, approach, a))
    return slowest, fastest


def _towards(left: float, fastest: float, approach: float, a: float) -> float:
    """Return the largest speed towards a limit that is `left` away, negative beyond it."""
    speed, knee = approach * abs(left), a / approach
    if speed > knee:  # from there on it is a's turn
        speed = math.sqrt(knee * (2.0 * speed - knee))
    return math.copysign(speed if speed < fastest else fastest, left)


def acceleration_bounds(
    v: Array, speeds: Array, braking: float | Array, jerk: Array | None = None
) -> Array:
    """Return accelerations that lead speeds into their bounds, shape (2, n_v) [rad/s² or m/s²].

    Over the next step q̇ goes at most the share r dt of what is left to its bound, and at least
    that share of the way back from beyond it. A share well below one keeps the joints quiet
    although the believed inertia, which predicts the step, is wrong.

    Where torques change slowly, an acceleration has to be ramped down in time: over what is left to
    the bound, with half of what torques can do, so it is √(jd) at most.

    Args:
        v: Joint velocity q̇, shape (n_v,).
        speeds: Smallest and largest, shape (2, n_v), infinite where there is no bound.
        braking: r [1/s], at most 1/dt.
        jerk: j, how fast accelerations change, shape (n_v,) [rad/s³ or m/s³]; None is without end.
    """
    left: Array = speeds - v
    if jerk is None:
        return np.asarray(braking * left)
    return np.sign(left) * np.minimum(braking * np.abs(left), np.sqrt(jerk * np.abs(left)))


def _range(position: object) -> tuple[Array, Array]:
    """Check a range of joint positions, and return it as two arrays."""
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
    lower.flags.writeable = upper.flags.writeable = False
    return lower, upper
