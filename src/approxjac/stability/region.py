"""Regions of joint space."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from approxjac.checks import Array


@runtime_checkable
class Region(Protocol):
    """A set of postures that can be drawn from."""

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Postures of the region, shape (n, nq)."""
        ...

    def contains(self, q: Array) -> bool:
        """Whether a posture (nq,) is in the region."""
        ...
