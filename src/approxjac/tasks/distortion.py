"""Radial distortion of a lens, as OpenCV has it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from approxjac.validation import Array

HALVINGS = 55
"""Of an interval that a radius is in."""
_TINY = 1e-15  # a coefficient below it folds nothing
LONGEST = 10.0
"""Times what it shows: no ray of a lens that never folds is longer."""
_FAR = 1e12  # a fold beyond this ρ is none


class RadialDistortion:
    """The radial distortion of a lens, which shows a ray p at p (1 + k₁ρ + k₂ρ² + k₃ρ³), ρ = ‖p‖².

    p = (X/Z, Y/Z) is the ray in the camera's axes. Of OpenCV's five coefficients
    (k₁, k₂, p₁, p₂, k₃) these are the radial ones; those that are not given are 0.
    """

    def __init__(self, coefficients: Sequence[float]) -> None:
        self._k = (*coefficients, 0.0, 0.0, 0.0)[:3]
        self._none = not any(self._k)
        self.largest_radius = self._largest_radius()

    def _factors(self, rho: float) -> tuple[float, float]:
        """Return 1 + k₁ρ + k₂ρ² + k₃ρ³ and its derivative by ρ."""
        k1, k2, k3 = self._k
        factor = 1.0 + rho * (k1 + rho * (k2 + rho * k3))
        return factor, k1 + rho * (2.0 * k2 + rho * 3.0 * k3)

    def _largest_radius(self) -> float:
        """Return ‖p‖ from which on the image folds back; infinite where it never does."""
        k1, k2, k3 = self._k
        slope = np.array([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3])  # of the radius, in ρ
        slope = np.trim_zeros(np.where(np.abs(slope) > _TINY, slope, 0.0), "b")
        turns = [
            float(root.real)
            for root in np.polynomial.polynomial.polyroots(slope)
            if abs(root.imag) < 1e-12 and 0.0 < root.real < _FAR
        ]
        return math.sqrt(min(turns)) if turns else math.inf

    def distorted(self, p: Array) -> Array:
        """Return where the lens shows a ray p (2,), shape (2,)."""
        return p if self._none else p * self._factors(p @ p)[0]  # type: ignore[arg-type]

    def radius(self, length: float) -> float:
        """Return how far from the middle the lens shows a ray of a length."""
        return length * self._factors(length * length)[0]

    def slopes(self, x: float, y: float) -> tuple[float, float, float]:
        """Return ∂(distorted)/∂p at p = (x, y), a symmetric matrix: its entries 11, 12 and 22."""
        if self._none:
            return 1.0, 0.0, 1.0
        factor, slope = self._factors(x * x + y * y)
        twice = 2.0 * slope
        return factor + twice * x * x, twice * x * y, factor + twice * y * y

    def undistorted(self, shown: Array) -> Array:
        """Return the ray (2,) shown at `shown` (2,) by the lens; beyond the fold, the last one."""
        wanted = math.hypot(*shown.tolist())
        if self._none or wanted == 0.0:
            return shown
        # the radius grows up to the fold: bisection cannot fail, and nothing here is in a hurry
        low, high = 0.0, self.largest_radius
        if math.isinf(high):
            high, most = 1.0, LONGEST * wanted
            while high < most and self.radius(high) < wanted:
                high *= 2.0
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            if self.radius(middle) < wanted:
                low = middle
            else:
                high = middle
        return shown * (0.5 * (low + high) / wanted)
