"""Distortion of a fisheye lens, as OpenCV has it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.tasks.distortion import Lens, inverse
from approxjac.validation import Array

WIDEST = math.radians(85.0)
"""No ray is shown that is farther from the optical axis [rad]: at 90° its X/Z is infinite."""


class Fisheye(Lens):
    """OpenCV's fisheye lens, also called equidistant, or of Kannala and Brandt.

    It shows a ray at the angle θ = atan ‖p‖ from the optical axis at the distance
    θ_d = θ (1 + k₁θ² + k₂θ⁴ + k₃θ⁶ + k₄θ⁸) from the middle, in the ray's direction. Rays are shown
    up to where θ_d stops growing, and to 85°.

    Attributes:
        widest: Angle up to which rays are shown [rad].
        shown_radius: Distance from the middle up to which there are rays, in focal lengths.

    Args:
        coefficients: (k₁, k₂, k₃, k₄), or none, which are 0.

    Raises:
        InvalidInputError: Another number of them.
    """

    is_straight = False

    def __init__(self, coefficients: Sequence[float]) -> None:
        if len(coefficients) not in (0, 4):
            raise InvalidInputError(
                "distortion of a fisheye lens must be OpenCV's (k1, k2, k3, k4), or none, got "
                f"{len(coefficients)}: {list(coefficients)}",
                given=coefficients,
            )
        self._k = tuple(coefficients) or (0.0,) * 4
        growth = [1.0, *(n * k for n, k in zip((3.0, 5.0, 7.0, 9.0), self._k, strict=True))]
        slope = np.array(growth) * WIDEST ** (2.0 * np.arange(5))  # of θ_d, in (θ/widest)²
        slope = np.trim_zeros(np.where(np.abs(slope) > 1e-15, slope, 0.0), "b")
        turns = [
            float(root.real)
            for root in np.polynomial.polynomial.polyroots(slope)
            if abs(root.imag) < 1e-9 * abs(root.real) and 0.0 < root.real < 1.0
        ]
        self.widest = WIDEST * math.sqrt(min(turns, default=1.0))
        self.largest_radius, self.shown_radius = math.tan(self.widest), self.bent(self.widest)

    def bent(self, angle: float) -> float:
        """Return θ_d of an angle θ [rad]."""
        k1, k2, k3, k4 = self._k
        square = angle * angle
        return angle * (1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4))))

    def growth(self, angle: float) -> float:
        """Return dθ_d/dθ at an angle θ [rad]."""
        k1, k2, k3, k4 = self._k
        s = angle * angle
        return 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))

    def distorted(self, p: Array) -> Array:
        length = math.hypot(*p.tolist())
        return p if length == 0.0 else p * (self.bent(math.atan(length)) / length)

    def slopes(self, x: float, y: float) -> tuple[float, float, float, float]:
        rho = x * x + y * y
        if rho == 0.0:
            return 1.0, 0.0, 0.0, 1.0
        length = math.sqrt(rho)
        angle = math.atan(length)
        factor = self.bent(angle) / length
        rate = (self.growth(angle) / (1.0 + rho) - factor) / rho
        across = rate * x * y
        return factor + rate * x * x, across, across, factor + rate * y * y

    def undistorted(self, shown: Array) -> Array:
        wanted = math.hypot(*shown.tolist())
        if wanted == 0.0:
            return np.zeros(2)
        return shown * (math.tan(inverse(self.bent, wanted, self.widest)) / wanted)
