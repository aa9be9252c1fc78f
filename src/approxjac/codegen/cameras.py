"""Cameras on symbols: those of `tasks`, with a choice where they branch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from approxjac.codegen.graph import Number, select
from approxjac.codegen.symbols import Symbols, any_of, symbols
from approxjac.tasks import Camera, PinholeCamera, PlanarCamera
from approxjac.tasks.distortion import HALVINGS, LONGEST, RadialDistortion
from approxjac.validation import Array

_DOUBLINGS = 12  # of a radius of 1, which no ray within an image is longer than


class _Lens(RadialDistortion):
    def undistorted(self, shown: Symbols) -> Symbols:
        if self._none:
            return shown
        wanted: Any = np.sqrt((shown * shown).sum())
        low: Number = 0.0
        high: Number = self.largest_radius
        if math.isinf(high):
            high = 1.0
            for _ in range(_DOUBLINGS):
                is_short = (high < LONGEST * wanted) & (self.radius(high) < wanted)
                high = select(is_short, high + high, high)
        for _ in range(HALVINGS):
            middle: Any = 0.5 * (low + high)
            is_short = self.radius(middle) < wanted
            low, high = select(is_short, middle, low), select(is_short, high, middle)
        return np.where(wanted == 0.0, shown, shown * (0.5 * (low + high) / wanted))


class _Pinhole(PinholeCamera):
    def project(self, r: Symbols) -> Symbols:
        own = symbols(self.in_camera(r))
        p, Z = own[:2] / own[2], own[2]
        is_seen = (self.near <= Z) & (math.inf > Z)
        if math.isfinite(self._lens.largest_radius):
            is_seen = is_seen & ((p * p).sum() < self._lens.largest_radius**2)
        return np.where(is_seen, symbols(self.shown(p)), math.nan)

    def seen(self, x: Symbols) -> Symbols:
        outside = any_of((x < -0.5) | (x > np.array(self.size) - 0.5))
        return np.where(outside, math.nan, x)

    def nearest(self, x: Symbols) -> Symbols:
        return np.minimum(np.maximum(x, -0.5), np.array(self.size) - 0.5)

    def _within(self, own: Symbols) -> Symbols:
        low, high = np.array(self._edges).T
        Z = np.maximum(symbols(own)[2], self.near)
        x, y = np.minimum(np.maximum(symbols(own)[:2] / Z, low), high)
        return x, y, Z


_KINDS: dict[type[Camera], type[Camera]] = {PlanarCamera: PlanarCamera, PinholeCamera: _Pinhole}
_NUMBERS = {PlanarCamera: ("_J", "_d"), PinholeCamera: ("_f", "_c", "_R", "_p")}
COVERED = tuple(_KINDS)
"""Cameras of which code can be made."""


def numbers(camera: Camera) -> dict[str, Array]:
    """Return the numbers of a camera that may differ from run to run, by name."""
    return {name: getattr(camera, name) for name in _NUMBERS[type(camera)]}


def on_symbols(camera: Camera, numbers: Mapping[str, Symbols] | None = None) -> Any:
    """Return a camera that takes symbols, with the numbers that it has or with others."""
    found = object.__new__(_KINDS[type(camera)])
    vars(found).update(vars(camera), **(numbers or {}))
    if isinstance(found, PinholeCamera):
        lens = object.__new__(_Lens)
        vars(lens).update(vars(found._lens))
        vars(found).update(_lens=lens, _R_t=found._R.T)
    return found
