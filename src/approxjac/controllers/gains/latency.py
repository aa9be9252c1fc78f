"""`Latency`: how late a loop measures and acts."""

from __future__ import annotations

from dataclasses import dataclass

from approxjac.formatting import short_fields
from approxjac.validation import as_number


@dataclass(frozen=True, repr=False)
class Latency:
    """Lags of a loop that measures and acts; by default those of 1 kHz with ideal sensors.

    Attributes:
        period: Of control, > 0 [s].
        torque_delay: From a torque to its effect [s].
        velocity_filter: Time constant of the filter of q̇ [s]; 0 is an exact q̇.
        image_period: Time between two frames of x [s]; 0 takes one at each step.
        image_age: Age of x when it arrives [s].

    Raises:
        InvalidInputError: Negative or not finite, or no period.
    """

    period: float = 1e-3
    torque_delay: float = 0.0
    velocity_filter: float = 0.0
    image_period: float = 0.0
    image_age: float = 0.0
    __repr__ = short_fields

    def __post_init__(self) -> None:
        as_number("period", self.period, unit="s", above=0.0)
        for name in ("torque_delay", "velocity_filter", "image_period", "image_age"):
            as_number(name, getattr(self, name), unit="s", minimum=0.0)

    @property
    def of_velocity(self) -> float:
        """Lag from q̇ to the torque that answers it [s]."""
        return self.period + self.torque_delay + self.velocity_filter

    @property
    def of_position(self) -> float:
        """Mean lag from x to the torque that answers it [s]."""
        return self.period + self.torque_delay + self.image_age + 0.5 * self.image_period

    def in_samples(self) -> tuple[float, int, int, int]:
        """Return time of a sample [s], samples between frames of x, its age, torques' lateness.

        The last two in samples, too. Long delays are counted in longer samples than those of
        control.
        """
        dt = max(self.period, 0.25 * self.torque_delay)
        frame = self.image_period or max(dt, 0.25 * self.image_age)
        samples = max(1, round(frame / dt))
        return dt, samples, round(self.image_age / dt), round(self.torque_delay / dt)
