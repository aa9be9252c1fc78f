"""Saturated functions s(e), their potentials S(e) and the constant c̄ of eq. (8).

All act entry by entry. γ may be a number or an array with one entry for each task coordinate. Of
the constants of (8), c̄ is the one that conditions ask for: d is 1 of a slope that is 1 at most, and
no bounded s has a d̄.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.validation import Array, as_array, shape_of

_QUARTER = 0.5 * math.pi  # the angle at which the sine is at its top
# as arrays, which a ufunc takes in two thirds of the time of numbers
_TOP, _BOTTOM = np.array(_QUARTER), np.array(-_QUARTER)


class Saturation(Protocol):
    """A function s with the properties (1)–(3) that the paper asks for, and slope 1 at 0.

    Any object with these four members can be the `saturation` of a controller, without inheritance.
    Requirements, entry by entry:

    - s(0) = 0 and s'(0) = 1: another slope belongs into the gains. All stability tests assume
      it to be 1.
    - s(θ) has the sign of θ and never falls. ds is its slope.
    - S(0) = 0, and s is the slope of S.
    - S(θ) ≥ c̄ s(θ)², of (8). If s' is never above 1, c̄ = ½ is enough.

    Controllers call s with e of shape (m,), stability tests call s, S and ds with (N, m). A
    controller checks the requirements at some hundred errors when it is built.
    """

    @property
    def c_bar(self) -> float:
        """Constant c̄ of (8)."""

    def s(self, e: Array) -> Array:
        """Return the saturated error s(e), same shape and unit as e."""

    def S(self, e: Array) -> Array:
        """Return the potential S(e) with dS/de = s, same shape as e, unit of e squared."""

    def ds(self, e: Array) -> Array:
        """Return the slope s'(e), same shape as e, dimensionless."""


@dataclass(frozen=True, eq=False)
class Linear:
    """s(e) = e: no saturation, the limit γ → ∞. Implements Eq. (8) with c̄ = ½."""

    c_bar: float = 0.5

    def s(self, e: Array) -> Array:
        """Return s(e) = e."""
        return e

    def S(self, e: Array) -> Array:
        """Return S(e) = e² / 2."""
        return 0.5 * e * e

    def ds(self, e: Array) -> Array:
        """Return s'(e) = 1."""
        return np.ones_like(e)


@dataclass(frozen=True, eq=False)
class _Bounded:
    """Base of saturations with a γ."""

    gamma: float | Sequence[float] | Array
    c_bar: float = 0.5
    _gamma: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        gamma = as_array("gamma", self.gamma, shape_of(self.gamma), "unit of the task")
        if not (gamma > 0.0).all():
            message = f"gamma must be > 0 [unit of the task], got {gamma.tolist()}"
            raise InvalidInputError(message, given=self.gamma)
        object.__setattr__(self, "_gamma", gamma)
        object.__setattr__(self, "gamma", gamma if gamma.ndim else float(gamma))


class Sine(_Bounded):
    """The paper's example: γ sin(e/γ) up to an error of γπ/2, ±γ beyond.

    Implements Eq. (8) with c̄ = ½, for S(e) = γ²(1 − cos(e/γ)) inside and
    γ² + γ(abs(e) − γπ/2) outside. (The paper calls γ the error at which s saturates; here, as
    in its simulations, γ is the value it saturates at.)

    Attributes:
        gamma: Saturation value γ > 0, a number or shape (m,) [unit of the task].
    """

    def s(self, e: Array) -> Array:
        """Return s(e), between −γ and γ."""
        u: Array = e / self._gamma
        if u.ndim == 1 and not u.dtype.hasobject and math.hypot(*u.tolist()) < _QUARTER:
            return self._gamma * np.sin(u)  # near the target, where nothing saturates
        return self._gamma * np.sin(_within(u))

    def S(self, e: Array) -> Array:
        """Return S(e) ≥ 0."""
        u = _within(e / self._gamma)
        beyond = np.abs(e / self._gamma) - np.abs(u)  # inside exactly 0, however large γ is
        # 1 − cos u = 2 sin²(u/2), which keeps its digits near zero
        return np.asarray(self._gamma**2 * (2.0 * np.sin(0.5 * u) ** 2 + beyond))

    def ds(self, e: Array) -> Array:
        """Return s'(e), between 0 and 1."""
        inside = np.abs(e) < 0.5 * np.pi * self._gamma
        return np.where(inside, np.cos(_within(e / self._gamma)), 0.0)


class Tanh(_Bounded):
    """s(e) = γ tanh(e/γ): smooth everywhere, strictly increasing, bounded by γ.

    Implements Eq. (8) with c̄ = ½, for S(e) = γ² log cosh(e/γ). Departure from the
    paper's property (2): γ is reached only in the limit, which no proof step needs.

    Attributes:
        gamma: Saturation value γ > 0, a number or shape (m,) [unit of the task].
    """

    def s(self, e: Array) -> Array:
        """Return s(e), between −γ and γ."""
        return self._gamma * np.tanh(e / self._gamma)

    def S(self, e: Array) -> Array:
        """Return S(e) ≥ 0."""
        u = np.abs(e / self._gamma)
        # log cosh u: the first form cancels for large u, the second for small u
        near = 0.5 * np.log1p(np.sinh(np.minimum(u, 1.0)) ** 2)
        far = u - np.log(2.0) + np.log1p(np.exp(-2.0 * u))
        return np.asarray(self._gamma**2 * np.where(u < 1.0, near, far))

    def ds(self, e: Array) -> Array:
        """Return s'(e), between 0 and 1."""
        return np.asarray(1.0 - np.tanh(e / self._gamma) ** 2)


def _within(u: Array) -> Array:
    return np.minimum(np.maximum(u, _BOTTOM), _TOP)
