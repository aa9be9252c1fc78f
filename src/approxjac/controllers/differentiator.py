"""`DifferentiatedVelocity`: the task velocity of law (5)."""

from __future__ import annotations

from dataclasses import dataclass

from approxjac.validation import as_number


@dataclass(frozen=True)
class DifferentiatedVelocity:
    """Ẋ of the earlier law (5): the measured x, filtered with a time constant T and differentiated.

    Attributes:
        time_constant: T > 0 [s]. Sampled control needs dt well below it.
    """

    time_constant: float = 0.02

    def __post_init__(self) -> None:
        as_number("time_constant", self.time_constant, unit="s", above=0.0)
