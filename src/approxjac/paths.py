"""Paths of a target: `Circle`, `Line`, `Waypoints`, for tasks whose error is x − x_d.

Any object with `at(t) → Target` is a path.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.formatting import short_fields
from approxjac.interface import Target
from approxjac.validation import Array, as_array, as_number

_APART = 1e-12  # relative: points that are no nearer than this are two


@dataclass(frozen=True, eq=False, repr=False)
class Circle:
    """A circle at constant speed, starting on the plane's first axis.

    Attributes:
        center: Center, shape (2,) or (3,) [unit of the task].
        radius: > 0 [unit of the task].
        period: Time of one turn > 0 [s].
        normal: Normal of the plane, about which it turns counter-clockwise, shape (3,); z by
            default. Not for a center of two coordinates, where it points towards the viewer.

    Raises:
        InvalidInputError: Numbers out of range, or a normal of length zero.
    """

    center: Sequence[float] | Array
    radius: float
    period: float
    normal: Sequence[float] | Array | None = None
    __repr__ = short_fields

    def __post_init__(self) -> None:
        center = as_array("center", self.center, ("m",))
        as_number("radius", self.radius, above=0.0)
        as_number("period", self.period, unit="s", above=0.0)
        if len(center) not in (2, 3) or (len(center) == 2 and self.normal is not None):
            raise InvalidInputError(
                f"center must have 3 coordinates, or 2 without a normal, got {center.tolist()} "
                f"with normal {self.normal!r} (a path of poses is any object with at(t) → Target)",
                given=self.center,
            )
        normal = as_array("normal", (0.0, 0.0, 1.0) if self.normal is None else self.normal, (3,))
        length = float(np.linalg.norm(normal))
        if length == 0.0:
            raise InvalidInputError("normal must have a length, got [0, 0, 0]", given=self.normal)
        n = normal / length
        # the world axis that lies most in the plane, x where several do
        u = np.eye(3)[int(np.argmin(np.round(np.abs(n), 9)))]
        u = u - n * n.dot(u)
        u = u / np.linalg.norm(u)
        plane = np.array([u, np.cross(n, u)])[:, : len(center)]
        vars(self).update(center=center, _plane=plane)  # frozen once it is built

    def at(self, t: float) -> Target:
        """Return the target at t [s]."""
        rate = 2.0 * math.pi / self.period
        c, s = self.radius * math.cos(rate * t), self.radius * math.sin(rate * t)
        u, w = self._plane  # type: ignore[attr-defined]  # set above
        out = c * u + s * w
        return Target(self.center + out, rate * (c * w - s * u), -(rate**2) * out)


@dataclass(frozen=True, eq=False, repr=False)
class Line:
    """A straight line from rest to rest with minimum jerk; the target stays at its end.

    Attributes:
        start: Shape (m,) [unit of the task].
        end: Shape (m,) [unit of the task].
        duration: > 0 [s].

    Raises:
        InvalidInputError: Points of different shapes, or numbers out of range.
    """

    start: Sequence[float] | Array
    end: Sequence[float] | Array
    duration: float
    __repr__ = short_fields

    def __post_init__(self) -> None:
        start = as_array("start", self.start, ("m",))
        vars(self).update(start=start, end=as_array("end", self.end, start.shape))
        as_number("duration", self.duration, unit="s", above=0.0)

    def at(self, t: float) -> Target:
        """Return the target at t [s]."""
        T = self.duration
        r = min(max(t / T, 0.0), 1.0)
        way: Array = self.end - self.start  # type: ignore[operator]  # arrays, set above
        return Target(
            self.start + r**3 * (10.0 - 15.0 * r + 6.0 * r * r) * way,
            30.0 * r * r * (1.0 - r) ** 2 / T * way,
            60.0 * r * (1.0 - r) * (1.0 - 2.0 * r) / T**2 * way,
        )


@dataclass(frozen=True, eq=False, repr=False)
class Waypoints:
    """Straight lines from point to point, at rest in each, within limits of speed.

    Each line has a trapezoidal speed profile, as fast as the limits allow.

    Attributes:
        points: Shape (k, m), at least two [unit of the task].
        speed: Largest ‖ẋ_d‖ > 0 [unit of the task/s].
        acceleration: Largest ‖ẍ_d‖ > 0 [unit of the task/s²].

    Raises:
        InvalidInputError: Fewer than two points, the same one twice in a row, or limits that are
            not positive.
    """

    points: Sequence[Sequence[float]] | Array
    speed: float
    acceleration: float
    __repr__ = short_fields

    def __post_init__(self) -> None:
        points = as_array("points", self.points, ("k", "m"))
        speed = as_number("speed", self.speed, above=0.0)
        acceleration = as_number("acceleration", self.acceleration, above=0.0)
        lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if len(points) < 2 or not (lengths > _APART * np.abs(points).max()).all():
            raise InvalidInputError(
                f"points must be at least two points that differ from one to the next, got "
                f"{points.tolist()}",
                given=self.points,
            )
        tops = np.minimum(speed, np.sqrt(lengths * acceleration))
        times = lengths / tops + tops / acceleration
        starts, lines = np.append(0.0, np.cumsum(times)), np.column_stack([lengths, tops, times])
        vars(self).update(points=points, _starts=starts, _lines=lines)

    @property
    def duration(self) -> float:
        """Time at which the last point is reached [s]."""
        return float(self._starts[-1])  # type: ignore[attr-defined]

    def at(self, t: float) -> Target:
        """Return the target at t [s]."""
        points: Array = self.points  # type: ignore[assignment]  # set above
        starts, lines = self._starts, self._lines  # type: ignore[attr-defined]
        k = min(max(int(np.searchsorted(starts, t, side="right")) - 1, 0), len(lines) - 1)
        length, top, time = lines[k]
        direction = (points[k + 1] - points[k]) / length
        now = min(max(t - starts[k], 0.0), time)
        ramp, left = top / self.acceleration, time - now
        if now < ramp:
            way, speed, rate = 0.5 * self.acceleration * now**2, self.acceleration * now, 1.0
        elif left <= ramp:
            way = length - 0.5 * self.acceleration * left**2
            speed, rate = self.acceleration * left, -1.0
        else:
            way, speed, rate = top * (now - 0.5 * ramp), top, 0.0
        if not 0.0 < now < time:
            rate = 0.0
        return Target(
            points[k] + way * direction, speed * direction, rate * self.acceleration * direction
        )
