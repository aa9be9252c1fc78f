"""The certificate of the sampled loop: one function for all samples, and its starts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from approxjac.controllers.gains.latency import Latency
from approxjac.law import Saturation
from approxjac.stability.certificates.certificate import MatrixTest
from approxjac.stability.certificates.families import Family
from approxjac.stability.certificates.matrix_form import Best, MatrixForm, best_weights
from approxjac.stability.certificates.sampled_form import SampledForm
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.samples import Samples
from approxjac.validation import Array

_SLOWER, _SLOWEST = (0.5, 0.25), 0.06  # times the speed that all starts need, that are tried
_SPARE = 1.4  # c is at most so many times what starts need: σ² is known afterwards only
_WORST = 120  # samples that largest periods and delays are sought with
_HALVINGS = 7
_LONGEST = 64.0  # times the period of the loop


@dataclass(frozen=True, eq=False, repr=False)
class SampledTest(MatrixTest):
    """Verdict of the form that is held and late, over a region.

    Attributes:
        latency: Of the loop that it speaks of.
        speed: v̄ of `law.sampled_form`: √(q̇ᵀMq̇) stays below it along the motions that this speaks
            of [√J].
        level: c [J]: motions that begin with V ≤ c stay below v̄.
        covered: Share of the samples away from their targets that may be started from, at rest.
        certified_error: Largest error of one task coordinate that may be started from at rest, the
            others being zero, shape (m,) [units of the task].
        form: What it rests on; the samples that it was chosen on come first.
    """

    latency: Latency
    speed: float
    level: float
    covered: float
    certified_error: Array
    form: SampledForm

    def __repr__(self) -> str:
        verdict = "certified" if self.certified else "not certified"
        return f"SampledTest({self.latency!r}: {verdict}, margin {self.margin:.3g})"

    @property
    def reason(self) -> str:
        """Return why it is not certified: "violated", or "too slow" a loop; empty where it is."""
        if self.certified:
            return ""
        return "violated" if self.margin > 0.0 else "too slow"

    def largest_period(self) -> float:
        """Return the largest period that this function certifies, all else the same [s]."""
        return largest(self._passes, self._of_period, self.latency.period)

    def largest_delay(self) -> float:
        """Return the largest delay of torques that this function certifies, all else the same [s].

        0 where it certifies none.
        """
        return largest(self._passes, self._of_delay, self.latency.period)

    def _of_period(self, period: float) -> Latency:
        return replace(self.latency, period=period)

    def _of_delay(self, delay: float) -> Latency:
        return replace(self.latency, torque_delay=delay)

    def _passes(self, latency: Latency) -> bool:
        """Return whether some multiplier certifies another latency in the worst samples."""
        worst = np.argsort(self.margins)[:_WORST]
        form = self.form.take(worst).with_latency(latency)
        return form.is_possible() and bool(form.best_multiplier(self.weights).margins.min() > 0.0)


def largest(
    passes: Callable[[Latency], bool], at: Callable[[float], Latency], first: float
) -> float:
    """Return the largest time that passes, by halving from `first` on; 0 where none does."""
    low, high = 0.0, first
    while high < _LONGEST * first and passes(at(high)):
        low, high = high, 2.0 * high
    while low == 0.0 and high > first / _LONGEST:
        if passes(at(0.5 * high)):
            low = 0.5 * high
        else:
            high *= 0.5
    if low == 0.0:
        return 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if passes(at(middle)) else (low, middle)
    return low


def sampled_test(
    loop: ClosedLoop, known: Best, chosen: MatrixForm, fresh: MatrixForm, latency: Latency
) -> SampledTest:
    """Choose a function that certifies the loop with a latency, for starts at rest.

    v̄ is such that all samples may be started from, or less where that is not certified.

    Args:
        loop: The closed loop, with gravity that is known.
        known: What was found for continuous time, to begin with.
        chosen: The form of continuous time at the samples to choose it on.
        fresh: The same to check it on.
        latency: Of the loop.
    """
    setting, saturation = loop.setting, loop.controller.saturation
    friction = loop.plants[0].friction
    form, first = chosen.join(fresh), len(chosen.samples)
    everywhere = form.samples
    potential = setting.kp + setting.alpha * setting.kv
    needed = _SPARE * float((saturation.S(everywhere.e) @ potential).max(initial=0.0))
    dg = loop.gravity_gradients(everywhere)
    fastest = math.sqrt(2.0 * needed)
    most_s = fastest / math.sqrt(2.0 * setting.c_bar * float(potential.min()))
    whole = SampledForm(form, friction, latency, fastest, most_s, dg)
    found = _at_speed(whole, first, known)
    if not found.passes and fastest > 0.0:  # and it may be that no speed is slow enough
        found = _at_speed(whole.with_speed(_SLOWEST * fastest), first, known)
        if found.passes:
            tries = (_at_speed(whole.with_speed(k * fastest), first, known) for k in _SLOWER)
            found = next((each for each in tries if each.passes), found)
    whole, best, family, violations = found
    if violations is None and not whole.is_possible():
        violations = len(fresh.samples)
    elif violations is None:
        violations = int((whole.take(slice(first, None)).margins(best.weights) <= 0.0).sum())
    level = max(0.0, whole.level(best.weights))
    test = SampledTest(
        family, best.weights, best.margins, len(fresh.samples), violations, loop.region.independent,
        latency, whole.speed, level, 1.0, np.zeros(len(potential)), whole,
    )  # fmt: skip
    return below(test, level, saturation, everywhere)


class _AtSpeed(NamedTuple):
    """Finding for a v̄."""

    whole: SampledForm
    best: Best  # in the samples that it was chosen on
    family: Family
    violations: int | None  # in the others; None where it fails in those already

    @property
    def passes(self) -> bool:
        """Return whether it holds in all samples."""
        return self.violations == 0


def _at_speed(whole: SampledForm, first: int, known: Best) -> _AtSpeed:
    """Choose a function on the first samples, and check it on the others."""
    best, family = _best(whole.take(slice(first)), known)
    # s̄ is of the weights that were begun with: of smaller ones errors may be larger
    most_s = whole.largest_s(best.weights)
    if most_s > whole.most_s:
        whole = whole.with_largest_s(most_s)
        best = best._replace(margins=whole.take(slice(first)).margins(best.weights))
    if best.margins.min() <= 0.0:
        return _AtSpeed(whole, best, family, None)
    margins = whole.take(slice(first, None)).margins(best.weights)
    return _AtSpeed(whole, best, family, int((margins <= 0.0).sum()))


def below(test: SampledTest, level: float, saturation: Saturation, samples: Samples) -> SampledTest:
    """Return a test for motions that begin with V ≤ level only, if that is less than its own."""
    level = min(level, test.level)
    away = samples.take(np.flatnonzero(samples.e.any(axis=1)))  # a third is at the target
    energies = test.weights.at_rest(saturation.S(away.e), away.s)
    covered = float((energies <= level).mean()) if len(away) else 1.0
    error = largest_errors(saturation, test.weights.w, level)
    return replace(test, level=level, covered=covered, certified_error=error)


def _best(form: SampledForm, known: Best) -> tuple[Best, Family]:
    """Return the function of the smallest family that is positive, or the best."""
    if not form.is_possible():
        nowhere = np.full(len(form.samples), -np.inf)
        return known._replace(
            weights=known.weights._replace(multiplier=0.5), margins=nowhere
        ), "free"
    found: list[tuple[Best, Family]] = []
    for family in form.setting.families[1:]:
        found.append((best_weights(form, family), family))
        if found[-1][0].margins.min() > 0.0:
            break
    return max(found, key=lambda each: float(each[0].margins.min()))


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
