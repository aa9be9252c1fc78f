"""Families of Lyapunov functions: their `Weights` and `FamilyNumbers`, and a loop's `Setting`."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from approxjac import law
from approxjac.validation import Array

Family = Literal["paper", "free", "wide", "full"]
"""The Lyapunov functions that are tried.

"paper" is G = αĴ⁺ with w = k_p + αk_v, "free" is G = αĴ⁺ with any w, "wide" is
G = Ĵ⁺A₁ + D⁻¹ĴᵀK_vA₂ with any m × m matrices A₁ and A₂, and any w, and "full" is "wide" with any
coupling Ω besides. (For m > 3 A₁ and A₂ are diagonal: full ones have so many entries that finding
them takes minutes.)
"""
FAMILIES: tuple[Family, ...] = ("paper", "free", "wide", "full")

_FULL = 3  # task coordinates up to which the matrices of "wide" are full
BOX = 30.0  # unknowns are sought within so many times their natural size


class Weights(NamedTuple):
    """A Lyapunov function V = ½q̇ᵀMq̇ + q̇ᵀM(Ĵ⁺A₁ + D⁻¹ĴᵀK_vA₂)s + Σ wᵢSᵢ(eᵢ) + ½sᵀΩs."""

    A1: Array  # shape (m, m) [1/s]; αI in the paper
    A2: Array  # shape (m, m) [1/s]; zero in the paper
    w: Array  # shape (m,) [N per unit of the task]; k_p + αk_v in the paper
    multiplier: float = 0.0  # λ of `law.sampled_form`
    X: Array | float = 0.0  # its X, shape (m,)
    coupling: Array | float = 0.0  # Ω, symmetric with a diagonal of zeros, shape (m, m)

    def plus(self, share: float, other: Weights) -> Weights:
        """Return these weights and a share of others."""
        return Weights(*(mine + share * its for mine, its in zip(self, other, strict=True)))  # type: ignore[arg-type]

    def at_rest(self, S: Array, s: Array) -> Array:
        """Return V at rest [J], of S(e) and s(e), any leading axes."""
        return law.potential(S, s, self.w, self.coupling + np.zeros_like(self.A1))

    def block(self, c_bar: float) -> Array:
        """Return 2c̄ W + Ω, shape (m, m)."""
        return law.potential_block(self.w, self.coupling + np.zeros_like(self.A1), c_bar)


@dataclass(frozen=True, eq=False)
class Setting:
    """The closed loop's part of the conditions, the same in every sample."""

    kp: Array  # diagonal of K_p, shape (m,)
    kv: Array  # diagonal of K_v, shape (m,)
    B: Array  # diagonal of all viscous damping, shape (n_v,)
    c_bar: float  # c̄ of eq. (8)
    fixed_alpha: float | None = None  # α where gravity is learnt with it by (29) [1/s]
    weight: Array | None = None  # of `law.cross_weight_pinv`, shape (n_v,)
    large_gains: bool = False  # leave out what inertia takes, as in the limit of large gains

    @property
    def alpha(self) -> float:
        """α, or its natural size where it is free, half the mean rate k_p/k_v [1/s]."""
        if self.fixed_alpha is not None:
            return self.fixed_alpha
        return 0.5 * float(np.mean(self.kp / self.kv))

    @property
    def families(self) -> tuple[Family, ...]:
        """Families that apply, as (29) learns along q̇ + αĴ⁺s(e), which G then has to match."""
        return FAMILIES if self.fixed_alpha is None else ("paper", "free")


class FamilyNumbers(NamedTuple):
    """The unknowns y of a family, scaled to be of the order of one: `fixed` + Σ yₖ `basis`ₖ."""

    fixed: Weights
    basis: list[Weights]
    start: Array  # y to begin with, and the least that are sought, shape (d,)
    least: Array

    def with_positive(self, more: list[Weights]) -> FamilyNumbers:
        """Return these and others that are not negative, each 1 to begin with."""
        start = np.append(self.start, np.ones(len(more)))
        least = np.append(self.least, np.zeros(len(more)))
        return FamilyNumbers(self.fixed, [*self.basis, *more], start, least)

    def weights(self, y: Array) -> Weights:
        """Return the Lyapunov function of some unknowns."""
        found = self.fixed
        for k, part in zip(y, self.basis, strict=True):
            found = found.plus(k, part)
        return found


def family_numbers(family: Family, setting: Setting) -> FamilyNumbers:
    """Return the unknowns of a family."""
    m = len(setting.kp)
    one, zero, none = np.eye(m), np.zeros((m, m)), np.zeros(m)
    alpha, kp, kv = setting.alpha, setting.kp, setting.kv
    potentials = [Weights(zero, zero, row) for row in np.diag(kp + alpha * kv)]
    fixed, start = Weights(zero, zero, none), [1.0]
    cross = [Weights(alpha * one, zero, none)]
    if family == "paper":
        fixed = Weights(zero, zero, kp)
        cross, potentials = [Weights(alpha * one, zero, alpha * kv)], []
    elif family != "free":  # any A₁ and A₂, from αĴ⁺ on
        entries = [(i, j) for i in range(m) for j in range(m) if i == j or m <= _FULL]
        units = [alpha * np.outer(one[i], one[j]) for i, j in entries]
        cross = [Weights(unit, zero, none) for unit in units]
        cross += [Weights(zero, unit, none) for unit in units]
        start = [float(i == j) for i, j in entries] + [0.0] * len(units)
    couplings = []
    if family == "full":  # of the size of the potentials that it couples
        sizes = np.sqrt(kp + alpha * kv)
        for i, j in itertools.combinations(range(m), 2):
            pair = np.outer(one[i], one[j]) * sizes[i] * sizes[j]
            couplings.append(Weights(zero, zero, none, coupling=pair + pair.T))
    if setting.fixed_alpha is not None:
        fixed, cross, start = fixed.plus(1.0, cross[0]), [], []
    begun = np.array([*start, *np.ones(len(potentials)), *np.zeros(len(couplings))])
    return FamilyNumbers(fixed, [*cross, *potentials, *couplings], begun, np.full(len(begun), -BOX))
