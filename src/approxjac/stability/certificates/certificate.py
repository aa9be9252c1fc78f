"""Tests 1 and 2 over a region: constants and Lyapunov functions, with their worst cases."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from approxjac.stability.certificates.families import FAMILIES, Family, Setting, Weights
from approxjac.stability.certificates.matrix_form import Best, MatrixForm, best_weights, on_more
from approxjac.stability.certificates.theorem1 import CONSTANTS, badness, constants, theorem1
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.samples import Samples
from approxjac.stability.rollouts.rollouts import clopper_pearson
from approxjac.validation import Array

_REFINED = 6  # closer looks at the worst sample, each from the worst of the last
_NEAR = 40  # samples of a closer look
_CLOSER = 0.15  # of the region's spread
_NOTABLE = 1e-3  # margin
_SAME = 1e-9  # relative, of constants
_MISSED = 0.05 / (1 + len(FAMILIES))  # the families and the sampled loop share the 5 %


@dataclass(frozen=True, eq=False, repr=False)
class MatrixTest:
    """Verdict of the matrix form over a region with one family of Lyapunov functions.

    Attributes:
        family: The functions that were tried.
        weights: The one with the largest margin.
        margins: Its margin in each sample that it was chosen on, shape (N,).
        checked: Number of further samples, drawn independently, that it was checked in.
        violations: Number of these in which its margin is not positive.
        independent: Whether configurations were drawn independently of each other.
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
        """Share of the designed dissipation that is left in the worst sample, at most 1."""
        return float(self.margins.min())

    @property
    def worst(self) -> int:
        """Index of the worst sample."""
        return int(self.margins.argmin())

    @property
    def share(self) -> float:
        """Share of the samples with a positive margin under this one function."""
        return float((self.margins > 0.0).mean())

    @property
    def certified(self) -> bool:
        """Return whether the function passed in every sample it was chosen or checked on."""
        return self.margin > 0.0 and self.violations == 0

    @property
    def violating_at_most(self) -> float:
        """Share of the combinations drawn (configuration, target, true robot) that may violate.

        An exact upper bound, at 95 % confidence for all families together; NaN where
        configurations are not drawn independently.
        """
        if not self.independent:
            return math.nan
        # of a two-sided interval the upper end is missed half as often
        return clopper_pearson(self.violations, self.checked, 1.0 - 2.0 * _MISSED)[1]


def refine_constants(
    loop: ClosedLoop, samples: Samples, rng: np.random.Generator
) -> tuple[Samples, dict[str, Array]]:
    """Look closer around the worst sample of each constant of Theorem 1.

    Returns:
        The samples and those found, and their `constants`.
    """
    setting = loop.setting
    values = constants(samples, setting)
    more: list[Samples] = []
    for name in CONSTANTS:
        for _ in range(_REFINED):
            bad = badness(name, values[name])
            k = _first_largest(bad)
            known, k = (samples, k) if k < len(samples) else (more[k - len(samples)], 0)
            nearby = loop.near(known, k, _NEAR, _CLOSER, rng)
            found = constants(nearby, setting)
            its_bad = badness(name, found[name])
            if its_bad.max() <= bad.max() + _SAME * abs(bad.max()):
                break
            worst = np.array([_first_largest(its_bad)])
            more.append(nearby.take(worst))
            values = {key: np.append(values[key], found[key][worst]) for key in values}
    return samples.join(*more), values


def _first_largest(values: Array) -> int:
    """Return the first of the largest values, which round-off alone may tell apart.

    Such as ‖Jᵀ − Ĵᵀ‖ of a longer tool, which is the same wherever the tool can be turned to.
    """
    most = float(values.max())
    return int((values >= most - _SAME * abs(most)).argmax())


def refine_weights(
    loop: ClosedLoop, form: MatrixForm, family: Family, rng: np.random.Generator
) -> tuple[MatrixForm, Best]:
    """Choose a Lyapunov function, with a closer look around its worst sample."""
    best = best_weights(form, family)
    worst, k, least = form.samples, int(best.margins.argmin()), float(best.margins.min())
    found: list[MatrixForm] = []
    for _ in range(_REFINED):
        worst = loop.near(worst, k, _NEAR, _CLOSER, rng)
        its = MatrixForm(worst, form.setting)
        margins = its.margins(best.weights)
        k = int(margins.argmin())
        if margins[k] > least - _NOTABLE:
            break
        least = float(margins[k])
        found.append(its.take(np.array([k])))
    for more in found:
        form = form.join(more)
    return form, on_more(form, family, best)


def margin(test: str, samples: Samples, setting: Setting) -> float:
    """Return the margin of "theorem1" or "matrix" on samples, without a closer look.

    That of the smallest family of Lyapunov functions that passes everywhere, or the best of all.
    """
    if test == "theorem1":
        return theorem1(samples, setting).margin
    form, most = MatrixForm(samples, setting), -math.inf
    for family in setting.families:
        most = max(most, float(best_weights(form, family).margins.min()))
        if most > 0.0:
            break
    return most
