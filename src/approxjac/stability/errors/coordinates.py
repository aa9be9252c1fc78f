"""Uncertain coordinates: what is believed of each, the range that it may be in, its words."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from approxjac.cameras import Camera
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.robots import Robot
from approxjac.validation import as_array, is_scalar, require

_PIECE = 0.25 * math.pi  # longest range of an angle that its two ends stand for [rad]
_LEAST_FOCAL = 0.1  # of the believed one
_TURN = 2.0 * math.pi * (1.0 + 1e-9)
_CALIBRATION = ("focal_length", "distance", "roll")  # of a camera


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

    @property
    def largest_factor(self) -> float:
        """The factor beyond which this grows to what no lens is: a tenth of the focal length."""
        if self.name != "camera focal_length" or self.low >= self.believed:
            return math.inf
        return max(1.0, (1.0 - _LEAST_FOCAL) * self.believed / (self.believed - self.low))

    def ends(self) -> tuple[float, ...]:
        """The ends of the range, or of the pieces that two ends of an angle can stand for.

        Between the ends of δ, a rotation is a convex combination of theirs times at most
        1/cos(δ/2): 1.08 for 45°, but without bound towards half a turn.

        Raises:
            InvalidInputError: An angle with a range beyond a full turn.
        """
        if self.unit != "rad" or self.high - self.low <= _PIECE:
            return tuple(dict.fromkeys((self.low, self.high)))
        if self.high - self.low > _TURN:
            raise InvalidInputError(
                f"{self.name} must have a range of at most a full turn, 6.283 [rad], got "
                f"{self.low:.4g} to {self.high:.4g}",
                given=(self.low, self.high),
            )
        pieces = math.ceil((self.high - self.low) / _PIECE - 1e-9)
        inner = (self.low + k / pieces * (self.high - self.low) for k in range(1, pieces))
        return (self.low, *inner, self.high)


def as_range(name: str, given: Any, believed: float, unit: str, of: str = "") -> list[Coordinate]:
    """Return the coordinate, named `of` + name, whose range was given as (low, high), if any was.

    Raises:
        InvalidInputError: Not two finite numbers, reversed, or without what is believed in it.
    """
    if given is None:
        return []
    if is_scalar(given):
        raise InvalidInputError(
            f"{name} must be (smallest, largest) [{unit}], such as (0.0, {given!r}), got {given!r}",
            given=given,
        )
    low, high = as_array(name, given, (2,), unit).tolist()
    if low > high:
        raise InvalidInputError(
            f"{name} must be (smallest, largest) [{unit}], got {(low, high)}; "
            f"{(high, low)} is such a range",
            given=given,
        )
    if not low <= believed <= high:
        remedy = ""
        if name.startswith("object_"):
            own = name.replace("object", "believed")
            remedy = f"; or believe the middle, {own} {0.5 * (low + high):g}"
        raise InvalidInputError(
            f"{name} must contain what is believed, {believed:g} [{unit}], got {(low, high)}; "
            f"{(min(low, believed), max(high, believed))} does{remedy}",
            given=given,
        )
    return [Coordinate(of + name, unit, float(believed), low, high)]


def as_bounds(name: str, given: Any, arm: Robot, unit: str) -> dict[str, tuple[float, ...]]:
    """Return how far joints of an arm may be off along x, y, z, checked, as a new dictionary.

    Raises:
        InvalidInputError: No mapping, wrong shapes, not finite or negative.
        UnknownNameError: No such joint.
    """
    require(name, given, Mapping, "a mapping from joint names to bounds of shape (3,)")
    bounds = {}
    for joint, bound in given.items():
        if joint not in arm.tree.joints:
            raise UnknownNameError("joint", joint, arm.name, arm.tree.joints)
        array = as_array(f"{name} of {joint}", bound, (3,), unit)
        if (array < 0.0).any():
            raise InvalidInputError(
                f"{name} of {joint} must be >= 0 [{unit}], as they are to either side, "
                f"got {array.tolist()}",
                given=bound,
            )
        bounds[joint] = tuple(array.tolist())
    return bounds


def joint_coordinates(
    joints: Sequence[str], shifts: Mapping[str, Any], rotations: Mapping[str, Any]
) -> list[Coordinate]:
    """Return the coordinates of joints whose origins may be off; bounds of 0 make none."""
    kinds = (("shift", "m", shifts), ("rotation", "rad", rotations))
    return [
        Coordinate(f"{joint} {kind} {axis}", unit, 0.0, -bound, bound)
        for joint, (kind, unit, bounds) in itertools.product(joints, kinds)
        for axis, bound in zip("xyz", bounds.get(joint, (0.0,) * 3), strict=True)
        if bound > 0.0
    ]


def camera_coordinates(camera: Camera | None, *ranges: Any) -> list[Coordinate]:
    """Return the coordinates of a camera's focal length, distance and roll that have a range.

    Raises:
        InvalidInputError: A range without a camera, or that is none.
        UnknownNameError: One that the camera's calibration does not have.
    """
    found: list[Coordinate] = []
    for name, given in zip(_CALIBRATION, ranges, strict=True):
        if given is None:
            continue
        if camera is None:
            raise InvalidInputError(
                f"{name} is that of a camera, got {given!r} without one: give the believed "
                "camera as camera, such as PlanarCamera(f, z)",
                given=given,
            )
        if name not in camera.calibration:
            where = f"the calibration of {type(camera).__name__}"
            raise UnknownNameError("range", name, where, camera.calibration)
        found += as_range(name, given, *camera.calibration[name], of="camera ")
    return found


def in_words(name: str, value: float, unit: str) -> str:
    """A coordinate at a value, such as "camera roll 0.349 rad (20.0 deg)"."""
    value += 0.0  # of -0 makes 0
    degrees = f" ({math.degrees(value):.1f} deg)" if unit == "rad" else ""
    return f"{spoken(name)} {value:.3g} {unit}{degrees}"


def spoken(name: str) -> str:
    """Return the name of a coordinate or parameter as text; joints keep theirs."""
    return name.replace("object_", "object ").replace("focal_length", "focal length")


def require_ranges_only(cls: type) -> None:
    """Refuse a class that says itself what the coordinates are: its box would be another one."""
    made = ("names", "units", "d", "believed", "low", "high")
    own = [name for name in made if name in vars(cls)]
    if own:
        raise InvalidInputError(
            f"a class derived from Uncertainty must leave {', '.join(made)} to the ranges that it "
            f"is given, as its corners and its scaling are made of them, got {cls.__name__} with "
            f"{', '.join(own)} of its own; give joint_shifts and joint_rotations that hold your "
            "errors (which are then independent), or judge one true robot at a time with "
            "Study(controller, robot) or simulate(Plant(robot), ...)",
            given=cls,
        )
