"""Tests 1 and 2 over a region, in continuous time and sampled: functions and worst cases."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from approxjac.controllers.gains.gains import Latency
from approxjac.law import Saturation
from approxjac.stability.certificates.matrix_form import (
    FAMILIES,
    Best,
    Family,
    MatrixForm,
    Setting,
    Weights,
    best_weights,
    on_more,
)
from approxjac.stability.certificates.sampled_form import Hold, SampledForm
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
_SLOWER, _SLOWEST = (0.5, 0.25), 0.06  # times the speed that all starts need, that are tried
_SPARE = 1.4  # c is at most so many times what starts need: σ² is known afterwards only
_WORST = 120  # samples that largest periods and delays are sought with
_HALVINGS = 7
_LONGEST = 64.0  # times the period of the loop


@dataclass(frozen=True, eq=False, repr=False)
class MatrixTest:
    """Verdict of the matrix form over a region with one family of Lyapunov functions.

    Attributes:
        family: The functions that were tried.
        weights: The one with the largest margin.
        margins: Its margin in each sample that it was chosen on, shape (N,).
        checked: Number of further samples, drawn independently, that it was checked in.
        violations: Number of these in which its margin is not positive.
    """

    family: Family
    weights: Weights
    margins: Array
    checked: int
    violations: int

    def __repr__(self) -> str:
        verdict = "certified" if self.certified else "not certified"
        return f"{type(self).__name__}({self.family!r}: {verdict}, margin {self.margin:.3g})"

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
        """True if the function passed in every sample it was chosen or checked on."""
        return self.margin > 0.0 and self.violations == 0

    @property
    def violating_at_most(self) -> float:
        """Share of the combinations drawn (configuration, target, true robot) that may violate.

        An exact upper bound, at 95 % confidence for all families together.
        """
        # of a two-sided interval the upper end is missed half as often
        return clopper_pearson(self.violations, self.checked, 1.0 - 2.0 * _MISSED)[1]


@dataclass(frozen=True, eq=False, repr=False)
class SampledTest(MatrixTest):
    """Verdict of the form that is held and late, over a region.

    Attributes:
        latency: Of the loop that it speaks of.
        level: c [J]: motions that begin with V ≤ c stay below v̄.
        form: What it rests on; the samples that it was chosen on come first.
    """

    latency: Latency
    level: float
    form: SampledForm

    @property
    def reason(self) -> str:
        """Return why it is not certified: "violated", or "too slow" a loop; empty where it is."""
        if self.certified:
            return ""
        return "violated" if self.margin > 0.0 else "too slow"

    @property
    def speed(self) -> float:
        """v̄ of `law.sampled_form`: √(q̇ᵀMq̇) stays below it along the motions meant here [√J]."""
        return self.form.speed

    @cached_property
    def certified_error(self) -> Array:
        """Largest error of one task coordinate to start from at rest, others being zero, (m,)."""
        return largest_errors(self.form.setting.saturation, self.weights.w, self.level)

    def below(self, level: float) -> SampledTest:
        """Return this of motions that begin with V ≤ level only, if that is less than its own."""
        return replace(self, level=min(level, self.level))

    def largest_period(self) -> float:
        """Return the largest period that this function certifies, all else the same [s]."""
        return largest(lambda period: self._passes(period=period), self.latency.period)

    def largest_delay(self) -> float:
        """Return the largest delay of torques that this certifies, all else the same [s], or 0."""
        return largest(lambda delay: self._passes(torque_delay=delay), self.latency.period)

    def _passes(self, **other: float) -> bool:
        """True if some multiplier certifies other times in the worst samples."""
        hold = Hold.of(replace(self.latency, **other))
        form = self.form.take(np.argsort(self.margins)[:_WORST]).changed(hold=hold)
        return form.is_possible() and bool(form.best_multiplier(self.weights).margins.min() > 0.0)


def refine_constants(loop: ClosedLoop, samples: Samples, rng: np.random.Generator) -> Samples:
    """Add samples from around the worst of each constant of Theorem 1."""
    values = constants(samples, loop.setting)
    more: list[Samples] = []
    for name in CONSTANTS:
        for _ in range(_REFINED):
            bad = badness(name, values[name])
            k = _first_largest(bad)
            known, k = (samples, k) if k < len(samples) else (more[k - len(samples)], 0)
            nearby = loop.near(known, k, _NEAR, _CLOSER, rng)
            its_values = constants(nearby, loop.setting)
            its_bad = badness(name, its_values[name])
            if its_bad.max() <= bad.max() + _SAME * abs(bad.max()):
                break
            worst = np.array([_first_largest(its_bad)])
            more.append(nearby.take(worst))
            values = {key: np.append(values[key], its_values[key][worst]) for key in values}
    return samples.join(*more)


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
    for _ in range(_REFINED):
        worst = loop.near(worst, k, _NEAR, _CLOSER, rng)
        its = MatrixForm(worst, form.setting)
        margins = its.margins(best.weights)
        k = int(margins.argmin())
        if margins[k] > least - _NOTABLE:
            break
        least = float(margins[k])
        form = form.join(its.take(np.array([k])))
    return form, on_more(form, family, best)


def smallest_family(form: MatrixForm, families: Sequence[Family]) -> tuple[Best, Family]:
    """Return the function of the first family that is positive everywhere, or the best of all."""
    tried: list[tuple[Best, Family]] = []
    for family in families:
        tried.append((best_weights(form, family), family))
        if tried[-1][0].margins.min() > 0.0:
            break
    return max(tried, key=lambda each: float(each[0].margins.min()))


def margin(test: str, samples: Samples, setting: Setting) -> float:
    """Return the margin of "theorem1" or "matrix" on samples, without a closer look."""
    if test == "theorem1":
        return theorem1(samples, setting).margin
    best, _ = smallest_family(MatrixForm(samples, setting), setting.families)
    return float(best.margins.min())


def largest(passes: Callable[[float], bool], first: float) -> float:
    """Return the largest time that passes, by halving from `first` on; 0 where none does."""
    low, high = 0.0, first
    while high < _LONGEST * first and passes(high):
        low, high = high, 2.0 * high
    halvings = int(low > 0.0)
    while halvings <= _HALVINGS and high > first / _LONGEST:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if passes(middle) else (low, middle)
        halvings += low > 0.0
    return low


def sampled_test(
    loop: ClosedLoop, known: Best, chosen: MatrixForm, fresh: MatrixForm, latency: Latency
) -> SampledTest:
    """Choose a function that certifies a loop of known gravity with a latency, for starts at rest.

    v̄ is such that all samples may be started from, or less where that is not certified. `known`,
    and the forms at samples to choose it on and to check it on, are of continuous time.
    """
    setting, n = loop.setting, len(chosen.samples)
    form = chosen.join(fresh)
    potential = setting.kp + setting.alpha * setting.kv
    needed = _SPARE * float((setting.saturation.S(form.samples.e) @ potential).max(initial=0.0))
    fastest = math.sqrt(2.0 * needed)
    most_s = fastest / math.sqrt(2.0 * setting.c_bar * float(potential.min()))

    def at_speed(form: SampledForm) -> SampledTest:
        """Choose a function on the first samples, and check it on the others."""
        first, weights = form.take(slice(n)), known.weights._replace(multiplier=0.5)
        family, margins, violations = setting.families[1], np.full(n, -np.inf), len(fresh.samples)
        if form.is_possible():
            best, family = smallest_family(first, setting.families[1:])
            weights, margins, most_s = best.weights, best.margins, form.largest_s(best.weights)
            if most_s > form.most_s:  # of smaller weights errors may be larger
                form = form.changed(most_s=most_s)
                margins = form.take(slice(n)).margins(weights)
            violations = int((form.take(slice(n, None)).margins(weights) <= 0.0).sum())
        level, checked = max(0.0, form.level(weights)), len(fresh.samples)
        return SampledTest(family, weights, margins, checked, violations, latency, level, form)

    whole = SampledForm(form, loop.plants[0].friction, Hold.of(latency), fastest, most_s)
    test = at_speed(whole)
    if not test.certified and fastest > 0.0:  # and it may be that no speed is slow enough
        test = at_speed(whole.with_speed(_SLOWEST * fastest))
        slower = _SLOWER if test.certified else ()
        tries = (at_speed(whole.with_speed(k * fastest)) for k in slower)
        test = next((each for each in tries if each.certified), test)
    return test


def largest_errors(saturation: Saturation, w: Array, level: float) -> Array:
    """The largest eᵢ with wᵢSᵢ(eᵢ) ≤ c, the others being zero, shape (m,)."""
    low, high = np.zeros(len(w)), np.full(len(w), 1e-9)
    while ((w * saturation.S(high) < level) & (high < 1e6)).any():
        high = np.where(w * saturation.S(high) < level, 2.0 * high, high)
    for _ in range(60):
        middle = 0.5 * (low + high)
        inside = w * saturation.S(middle) <= level
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return low
