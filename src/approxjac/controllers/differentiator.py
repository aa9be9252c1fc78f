"""`DifferentiatedVelocity`: the task velocity of law (5)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from approxjac.controllers.gains.latency import Latency
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.tasks import Task
from approxjac.validation import Array, as_number


@dataclass(frozen=True)
class DifferentiatedVelocity:
    """Ẋ of the earlier law (5): the measured x, filtered with a time constant T and differentiated.

    Attributes:
        time_constant: T > 0 [s]. Sampled control needs dt well below it.
    """

    time_constant: float = 0.02

    def __post_init__(self) -> None:
        as_number("time_constant", self.time_constant, unit="s", above=0.0)

    def late(self, latency: Latency) -> Latency:
        """Return a latency with the damping of law (5), which acts as late as x tells Ẋ."""
        lag = latency.image_age + 0.5 * latency.image_period + self.time_constant
        return replace(latency, velocity_filter=latency.velocity_filter + lag)

    def require_difference(self, task: Task) -> None:
        """Refuse a task whose error is another one than x − x_d."""
        if not task._subtracts:
            raise InvalidInputError(
                f"law (5) differentiates x and needs a task whose error is x - x_d, got {task!r}",
                given=self,
            )

    def require_finite(self, x: Array) -> None:
        """Refuse a first x that is lost."""
        if not np.isfinite(x).all():
            raise MeasurementError(
                f"the first x must be finite for law (5), which differentiates it, "
                f"got {x.tolist()}",
                given=x,
            )
