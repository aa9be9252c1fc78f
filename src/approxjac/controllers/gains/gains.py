"""Diagonal gains, and `Latency`: the delays of a control loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from approxjac.formatting import numbers, short_fields
from approxjac.validation import Array, as_delay, as_diagonal, as_number, is_scalar


@dataclass(frozen=True, eq=False, repr=False)
class Gains:
    """Gains of the laws (5), (6) and (28), each a number or one number per coordinate.

    Attributes:
        kp: K_p > 0, a number or shape (m,) [N/m for a task in metres, else J per unit squared].
        kv: K_v > 0, a number or shape (m,) [N s/m for a task in metres, likewise].
        damping: Added joint damping B_c ≥ 0, a number or shape (n_v,) [N m s/rad or N s/m]; must be
            positive if the arm has more joints than the task has coordinates.

    Raises:
        InvalidInputError: Not finite, kp or kv not positive, damping negative.
    """

    kp: float | Sequence[float] | Array
    kv: float | Sequence[float] | Array
    damping: float | Sequence[float] | Array = 0.0

    def __post_init__(self) -> None:
        for name, positive in (("kp", True), ("kv", True), ("damping", False)):
            value = getattr(self, name)
            diagonal = as_diagonal(name, value, positive=positive)
            # a copy, so that nobody changes it later
            object.__setattr__(self, name, float(value) if is_scalar(value) else diagonal)

    __repr__ = short_fields

    def __str__(self) -> str:
        parts = [f"K_p {numbers(self.kp)}", f"K_v {numbers(self.kv)}"]
        return ", ".join([*parts, f"joint damping {numbers(self.damping)}"])

    def diagonals(self, m: int, nv: int) -> Diagonals:
        """Return the diagonals for a task of m coordinates on an arm of n_v joints.

        Raises:
            InvalidInputError: A vector of another length.
        """
        return Diagonals(
            as_diagonal("kp", self.kp, m),
            as_diagonal("kv", self.kv, m),
            as_diagonal("damping", self.damping, nv, positive=False),
        )


class Diagonals(NamedTuple):
    """Gains as vectors: kp (m,), kv (m,), damping (n_v,)."""

    kp: Array
    kv: Array
    damping: Array


@dataclass(frozen=True, repr=False)
class Latency:
    """Delays of a control loop; by default those of 1 kHz with ideal sensors.

    Attributes:
        period: Control period, > 0 [s].
        torque_delay: Time from a torque command to its effect [s].
        velocity_filter: Time constant of the filter of q̇ [s]; 0 is an exact q̇.
        image_period: Time between two frames of x [s]; 0 is one at each step.
        image_age: Age of x when it arrives [s].

    Raises:
        InvalidInputError: Negative, longer than 10 s (as milliseconds are), or no period.
    """

    period: float = 1e-3
    torque_delay: float = 0.0
    velocity_filter: float = 0.0
    image_period: float = 0.0
    image_age: float = 0.0
    __repr__ = short_fields

    def __post_init__(self) -> None:
        as_number("period", self.period, unit="s", above=0.0)
        for name in ("period", "torque_delay", "velocity_filter", "image_period", "image_age"):
            as_delay(name, getattr(self, name))

    @property
    def of_velocity(self) -> float:
        """Lag from q̇ to the torque that depends on it [s]."""
        return self.period + self.torque_delay + self.velocity_filter

    @property
    def of_position(self) -> float:
        """Mean lag from x to the torque that depends on it [s]."""
        return self.period + self.torque_delay + self.image_age + 0.5 * self.image_period

    @property
    def is_felt_by_motors(self) -> bool:
        """True if q̇ or torques are late, which motors behind elastic gears feel."""
        return self.torque_delay > 0.0 or self.velocity_filter > 0.0

    def in_samples(self) -> Timing:
        """Return the times in whole samples, longer than the period where delays are long."""
        dt = max(self.period, 0.25 * self.torque_delay)
        frame = self.image_period or max(dt, 0.25 * self.image_age)
        age, late = round(self.image_age / dt), round(self.torque_delay / dt)
        return Timing(dt, max(1, round(frame / dt)), age, late, self.velocity_filter or None)


class Timing(NamedTuple):
    """Times at which things happen in sampled control."""

    dt: float  # sampling time [s]
    samples: int = 1  # from one frame of x to the next
    x_late: int = 0  # samples from a frame of x to the first torque that uses it
    torque_late: int = 0  # samples from a torque to its effect
    velocity_filter: float | None = None  # of q̇ from differences of q [s]; None is a tachometer

    @property
    def frame(self) -> float:
        """Time from one frame of x to the next [s]."""
        return self.samples * self.dt

    @property
    def dead_time(self) -> float:
        """Longest time from a motion to the end of the first torque that answers it [s]."""
        return (self.samples + self.x_late + self.torque_late) * self.dt
