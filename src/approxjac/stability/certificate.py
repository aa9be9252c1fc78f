"""Tests 1 and 2 over a region: constants and Lyapunov functions, with their worst cases."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from approxjac.stability.matrix_form import (
    Best,
    Family,
    MatrixForm,
    Setting,
    Weights,
    best_weights,
)
from approxjac.stability.rollouts import clopper_pearson
from approxjac.stability.samples import Sampler, Scenarios
from approxjac.stability.theorem1 import CONSTANTS, badness, constants
from approxjac.validation import Array

_REFINED = 6  # closer looks at the worst scenario, each from the worst of the last
_NEAR = 40  # scenarios of a closer look
_CLOSER = 0.15  # of the region's spread
_NOTABLE = 1e-3  # margin
_MISSED = 0.05 / 3  # three families share the 5 %


@dataclass(frozen=True, eq=False, repr=False)
class MatrixTest:
    """What the matrix form says over a region with one family of Lyapunov functions.

    Attributes:
        family: Which functions were tried.
        weights: The one with the largest margin.
        margins: Its margin in each scenario that it was chosen on, shape (N,).
        checked: In how many further scenarios, drawn independently, it was checked.
        violations: In how many of them its margin is not positive.
        independent: Whether postures were drawn independently of each other.
    """

    family: Family
    weights: Weights
    margins: Array
    checked: int
    violations: int
    independent: bool

    def __repr__(self) -> str:
        verdict = "certified" if self.certified else "not certified"
        return f"MatrixTest({self.family!r}: {verdict}, margin {self.margin:.3g})"

    @property
    def margin(self) -> float:
        """Share of the designed dissipation that is left in the worst scenario, at most 1."""
        return float(self.margins.min())

    @property
    def worst(self) -> int:
        """Index of the worst scenario."""
        return int(self.margins.argmin())

    @property
    def share(self) -> float:
        """Share of the scenarios with a positive margin under this one function."""
        return float((self.margins > 0.0).mean())

    @property
    def certified(self) -> bool:
        """Whether the function passed in every scenario it was chosen or checked on."""
        return self.margin > 0.0 and self.violations == 0

    @property
    def violating_at_most(self) -> float:
        """Share of the combinations drawn (posture, target, true robot) that may violate.

        An exact upper bound, at 95 % confidence for all families together; NaN where postures
        are not drawn independently.
        """
        if not self.independent:
            return math.nan
        # of a two-sided interval the upper end is missed half as often
        return clopper_pearson(self.violations, self.checked, 1.0 - 2.0 * _MISSED)[1]


def refine_constants(
    sampler: Sampler, scenarios: Scenarios, setting: Setting, rng: np.random.Generator
) -> Scenarios:
    """Look closer around the worst scenario of each constant of Theorem 1."""
    values = constants(scenarios, setting)
    for name in CONSTANTS:
        for _ in range(_REFINED):
            k = int(badness(name, values[name]).argmax())
            nearby = sampler.near(scenarios, k, _NEAR, _CLOSER, rng)
            found = constants(nearby, setting)
            worst = np.array([badness(name, found[name]).argmax()])
            if badness(name, found[name]).max() <= badness(name, values[name])[k]:
                break
            scenarios = scenarios.join(nearby.take(worst))
            values = {key: np.append(values[key], found[key][worst]) for key in values}
    return scenarios


def refine_weights(
    sampler: Sampler, form: MatrixForm, family: Family, rng: np.random.Generator
) -> tuple[MatrixForm, Best]:
    """Choose a Lyapunov function, with a closer look around its worst scenario."""
    best = best_weights(form, family)
    worst, k, least = form.scenarios, int(best.margins.argmin()), float(best.margins.min())
    found = []
    for _ in range(_REFINED):
        worst = sampler.near(worst, k, _NEAR, _CLOSER, rng)
        nearby = MatrixForm(worst, form.setting)
        margins = nearby.margins(best.weights)
        k = int(margins.argmin())
        if margins[k] > least - _NOTABLE:
            break
        least = float(margins[k])
        found.append(nearby.take(np.array([k])))
    for nearby in found:
        form = form.join(nearby)
    return form, best_weights(form, family, best) if found else best
