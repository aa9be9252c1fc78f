"""One uncertain coordinate: what is believed of it, the range that it may be in, its words."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from approxjac.errors import InvalidInputError
from approxjac.validation import as_array, is_scalar


class Coordinate(NamedTuple):
    """One number that is not known: what is believed of it, and the range that it may be in."""

    name: str
    unit: str
    believed: float
    low: float
    high: float

    def scaled(self, factor: float) -> Coordinate:
        """Shrunk or grown about what is believed.

        Exact for the factors 0 and 1, and never without what is believed, whatever is rounded.
        """
        believed = self.believed
        low, high = (factor * end + (1.0 - factor) * believed for end in (self.low, self.high))
        return self._replace(low=min(low, believed), high=max(high, believed))


def as_range(field_name: str, name: str, given: Any, believed: float, unit: str) -> Coordinate:
    """A coordinate whose range was given as (low, high).

    Raises:
        InvalidInputError: Not two finite numbers, reversed, or without what is believed in it.
    """
    if is_scalar(given):
        raise InvalidInputError(
            f"{field_name} must be (smallest, largest) [{unit}], such as (0.0, {given!r}), "
            f"got {given!r}",
            given=given,
        )
    low, high = as_array(field_name, given, (2,), unit).tolist()
    if low > high:
        raise InvalidInputError(
            f"{field_name} must be (smallest, largest) [{unit}], got {(low, high)}; "
            f"{(high, low)} is such a range",
            given=given,
        )
    if not low <= believed <= high:
        raise InvalidInputError(
            f"{field_name} must hold what is believed, {believed:g} [{unit}], got {(low, high)}; "
            f"{(min(low, believed), max(high, believed))} does",
            given=given,
        )
    return Coordinate(name, unit, float(believed), low, high)


def in_words(name: str, value: float, unit: str) -> str:
    """A coordinate at a value, such as "camera roll 0.349 rad (20.0 deg)"."""
    value += 0.0  # of -0 makes 0
    degrees = f" ({math.degrees(value):.1f} deg)" if unit == "rad" else ""
    return f"{name} {value:#.3g} {unit}{degrees}"
