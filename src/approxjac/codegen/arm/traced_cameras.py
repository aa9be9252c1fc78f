"""Cameras on symbols: those of `tasks`, with a choice where they branch."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from approxjac.cameras import Camera, PinholeCamera, PlanarCamera
from approxjac.cameras.lenses import BEFORE, HALVINGS, NEWTON_STEPS, Distortion, Fisheye, Lens
from approxjac.cameras.pinhole import WITHIN
from approxjac.codegen.trace.symbols import Number, Symbols, any_of, arctangent, select, symbols
from approxjac.validation import Array

_TINY = 1e-300


class _Distortion(Distortion):
    def distorted(self, p: Symbols) -> Symbols:
        return p if self.is_straight else symbols(self.shown_at(p[0], p[1]))

    def undistorted(self, shown: Symbols) -> Symbols:
        if self.is_straight:
            return shown
        u, v = shown
        if self._T_inverse is not None:
            own = self._T_inverse @ symbols([u, v, 1.0])
            u, v = own[:2] / np.maximum(own[2], BEFORE)
        wanted: Any = np.sqrt(u * u + v * v)
        length = _halved(self.radius, self.largest_radius, wanted)
        x, y = np.where(wanted == 0.0, 0.0, symbols([u, v]) * (length / wanted))
        for _ in range(0 if self._is_round else NEWTON_STEPS):
            x, y = _within(self.largest_radius, *self._newton(x, y, u, v))
        return symbols([x, y])


class _Fisheye(Fisheye):
    def distorted(self, p: Symbols) -> Symbols:
        length: Any = np.sqrt((p * p).sum())
        bent = self.bent(arctangent(length, 1.0))
        return np.where(length == 0.0, p, p * (bent / length))

    def slopes(self, x: Number, y: Number) -> tuple[Number, Number, Number, Number]:
        rho = x * x + y * y
        length: Any = np.sqrt(rho)
        angle = arctangent(length, 1.0)
        factor = self.bent(angle) / length
        rate = (self.growth(angle) / (1.0 + rho) - factor) / rho
        is_middle, across = rho == 0.0, rate * x * y
        return (
            select(is_middle, 1.0, factor + rate * x * x),
            select(is_middle, 0.0, across),
            select(is_middle, 0.0, across),
            select(is_middle, 1.0, factor + rate * y * y),
        )

    def undistorted(self, shown: Symbols) -> Symbols:
        wanted: Any = np.sqrt((shown * shown).sum())
        angle = _halved(self.bent, self.widest, wanted)
        length = np.sin(angle) / np.cos(angle)
        return np.where(wanted == 0.0, 0.0, shown * (length / wanted))


def _halved(function: Callable[[Number], Number], high: Number, wanted: Number) -> Number:
    """Return where a function that grows from 0 has a value, by halvings."""
    low: Number = 0.0
    for _ in range(HALVINGS):
        middle: Any = 0.5 * (low + high)
        is_short = function(middle) < wanted
        low, high = select(is_short, middle, low), select(is_short, high, middle)
    return 0.5 * (low + high)


def _within(radius: float, x: Number, y: Number) -> tuple[Number, Number]:
    """Return a ray (x, y), shortened to a length."""
    length = np.maximum(np.sqrt(symbols([x * x + y * y])), _TINY)[0]
    back = select(length > radius, radius / length, 1.0)
    return back * x, back * y


_LENSES: dict[type[Lens], type[Lens]] = {Distortion: _Distortion, Fisheye: _Fisheye}


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
        if not self._sees_all:
            assert isinstance(self._lens, Fisheye)
            w = (x - self._c) / self._f
            outside = outside | ((w * w).sum() > self._lens.shown_radius**2)
        return np.where(outside, math.nan, x)

    def nearest(self, x: Symbols) -> Symbols:
        inside = np.minimum(np.maximum(x, -0.5), np.array(self.size) - 0.5)
        if self._sees_all:
            return inside
        assert isinstance(self._lens, Fisheye)
        w = (inside - self._c) / self._f
        return self._c + self._f * symbols(_within(WITHIN * self._lens.shown_radius, *w))

    def ray(self, x: Symbols) -> Symbols:
        return self._lens.undistorted((x - self._c) / self._f)  # of what is in the image

    def _within(self, own: Symbols) -> Symbols:
        low, high = np.array(self._edges).T
        Z = np.maximum(symbols(own)[2], self.near)
        x, y = np.minimum(np.maximum(symbols(own)[:2] / Z, low), high)
        if not self._lens.is_straight:
            x, y = _within(self._lens.largest_radius, x, y)
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
        lens = object.__new__(_LENSES[type(found._lens)])
        vars(lens).update(vars(found._lens))
        vars(found).update(_lens=lens, _R_t=found._R.T)
    return found
