"""Wishes of a page as targets that a run can be given: a page cannot be trusted."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np

from approxjac.cameras import PlanarCamera
from approxjac.errors import InvalidInputError
from approxjac.simulation.loop import Loop
from approxjac.tasks.analysis import features, image_feature
from approxjac.validation import Array, as_array

LONG = 80  # characters of what a page sent, in errors
_LONGEST = 300  # of an error
_FAR = 2.0  # from the base on each axis, of what the arm reaches: runs diverge at light years
_STEP = 10.0  # of what is neither place nor image, such as joints or a quaternion


def numbers(name: str, value: Any) -> Array:
    """Return the numbers that a page sent, or raise an InvalidInputError."""
    entries = value if isinstance(value, list) else [value]
    if all(type(entry) in (int, float) for entry in entries):
        with contextlib.suppress(OverflowError):
            return np.array(entries, dtype=float)
    raise InvalidInputError(f"{name} must be numbers, got {repr(value)[:LONG]}", given=value)


def with_point(loop: Loop, point: Array) -> Array:
    """Return the target with the position of what is followed moved to a point (3,) [m]."""
    place, target = as_array("point", point, (3,), "m"), np.array(loop.target)
    for feature in features(loop.plant.sensor):
        if feature.axes:
            rows = ["xyz".index(axis) for axis in feature.axes]
            target[feature.entries][: len(rows)] = place[rows]
            return target
    raise InvalidInputError("the target is no position, which a point could be", given=point)


def with_pixel(loop: Loop, pixel: Array) -> Array:
    """Return the target with the image of point i moved to (u, v), for `pixel` (i, u, v)."""
    i, u, v = as_array("pixel", pixel, (3,))
    feature = image_feature(loop.plant.sensor)
    if feature is None or i not in range(len(feature.points)):
        raise InvalidInputError(f"there is no point {i:g} in an image", given=pixel)
    target = np.array(loop.target)
    target[feature.entries].reshape(len(feature.points), -1)[int(i), :2] = u, v
    return target


def target_of(loop: Loop, target: Array, size: float) -> Array:
    """Return a target of the sensor that an arm of this size [m] can be sent to.

    Raises:
        InvalidInputError: No target of the sensor, or one far from all that the arm reaches.
    """
    target, other = loop.plant.sensor.target(target), np.ones(len(loop.target), dtype=bool)
    for feature in features(loop.plant.sensor):
        camera, rows = feature.camera, np.arange(len(target))[feature.entries]
        if feature.axes:
            place = rows[: len(feature.axes)]
            other[place] = False
            R, b = (np.eye(len(place)), 0.0) if feature.placed is None else feature.placed
            _require_near(target, (target[place] - b) @ R, _FAR * size, "m from the arm's base")
        elif camera is not None:
            points = rows.reshape(len(feature.points), -1)[:, :2]
            other[points] = False
            if isinstance(camera, PlanarCamera):  # images of others have a border
                far, where = _FAR * size * camera.magnification, "from where the base appears"
                _require_near(target, target[points] - camera.offset, far, f"{camera.unit} {where}")
    _require_near(target, (target - loop.target)[other], _STEP, "from what it was")
    return target


def _require_near(target: Array, way: Array, far: float, words: str) -> None:
    if not (np.abs(way) <= far).all():
        message = f"target must be at most {far:.3g} {words}, got {target.tolist()}"
        raise InvalidInputError(message[:_LONGEST], given=target)
