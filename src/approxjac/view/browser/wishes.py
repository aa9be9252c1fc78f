"""Wishes of a user for a run that goes on, as pages and people put them."""

from __future__ import annotations

import os
import select
import sys
from typing import Any

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.simulation.sampled_loop import SampledLoop
from approxjac.tasks.analysis import features
from approxjac.validation import Array, as_array
from approxjac.view.browser.cameras import image_feature

_LONG = 80  # characters of what was given, in errors


def with_point(loop: SampledLoop, point: Array) -> Array:
    """Return the target with the position of what is followed moved to a point (3,) [m]."""
    place = as_array("point", point, (3,), "m")
    for feature in features(loop.plant.sensor):
        if feature.axes:
            target = np.array(loop.target)
            start = feature.entries.start
            rows = ["xyz".index(axis) for axis in feature.axes]
            target[start : start + len(rows)] = place[rows]
            return target
    raise InvalidInputError("the target is no position, which a point could be", given=point)


def with_pixel(loop: SampledLoop, pixel: Array) -> Array:
    """Return the target with the image of point i moved to (u, v); `pixel` is (i, u, v)."""
    i, u, v = as_array("pixel", pixel, (3,))
    feature = image_feature(loop.plant.sensor)
    if feature is None or i not in range(len(feature.points)):
        raise InvalidInputError(f"there is no point {i:g} in an image", given=pixel)
    stride = (feature.entries.stop - feature.entries.start) // len(feature.points)
    start = feature.entries.start + stride * int(i)
    target = np.array(loop.target)
    target[start : start + 2] = u, v
    return target


def numbers(name: str, value: Any) -> Array:
    """Return numbers that a page or a person gave.

    Raises:
        InvalidInputError: Anything else.
    """
    entries = value if isinstance(value, list) else [value]
    try:
        if not any(isinstance(entry, bool) for entry in entries):
            return np.array([float(entry) for entry in entries])
    except (TypeError, ValueError, OverflowError):
        pass
    raise InvalidInputError(f"{name} must be numbers, got {_short(value)}", given=value)


def number(name: str, value: Any) -> float:
    """Return one number that a page or a person gave.

    Raises:
        InvalidInputError: Anything else.
    """
    found = numbers(name, value)
    if len(found) != 1:
        raise InvalidInputError(f"{name} must be one number, got {_short(value)}", given=value)
    return float(found[0])


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _LONG else f"{text[:_LONG]}…"


class Typed:
    """Lines that a person types, or a program writes, to standard input."""

    def __init__(self) -> None:
        self._text = ""
        try:
            self._file: int | None = sys.stdin.fileno()
        except (AttributeError, OSError, ValueError):  # there is none
            self._file = None

    def lines(self) -> list[str]:
        """Return those that were ended since this was asked for last, but for empty ones."""
        file = self._file
        # what reads from a terminal in the background is halted
        if file is not None and os.isatty(file) and os.tcgetpgrp(file) != os.getpgrp():
            return []
        # not by readline: what it reads ahead, `select` does not see
        if file is not None and select.select([file], [], [], 0)[0]:
            text = os.read(file, 4096).decode(errors="replace")
            if not text:
                self._file = None
            self._text += text
        *lines, self._text = self._text.split("\n")
        return [line for line in lines if line.strip()]
