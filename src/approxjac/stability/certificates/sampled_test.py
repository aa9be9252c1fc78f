"""The certificate of the sampled loop: one function for all samples, and its starts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from approxjac.controllers.gains.latency import Latency
from approxjac.law import Saturation
from approxjac.stability.certificates.certificate import MatrixTest
from approxjac.stability.certificates.families import Family
from approxjac.stability.certificates.matrix_form import Best, MatrixForm, best_weights
from approxjac.stability.certificates.sampled_form import Hold, SampledForm
from approxjac.stability.loop.closed_loop import ClosedLoop
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
        level: c [J]: motions that begin with V ≤ c stay below v̄.
        form: What it rests on; the samples that it was chosen on come first.
        saturation: Of the loop.
    """

    latency: Latency
    level: float
    form: SampledForm
    saturation: Saturation

    def __repr__(self) -> str:
        verdict = "certified" if self.certified else "not certified"
        return f"SampledTest({self.latency!r}: {verdict}, margin {self.margin:.3g})"

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
    def covered(self) -> float:
        """Share of the samples away from their targets that may be started from, at rest."""
        e = self.form.samples.e
        e = e[e.any(axis=1)]  # a third is at the target
        energies = self.weights.at_rest(self.saturation.S(e), self.saturation.s(e))
        return float((energies <= self.level).mean()) if len(e) else 1.0

    @cached_property
    def certified_error(self) -> Array:
        """Largest error of one task coordinate to start from at rest, others being zero, (m,)."""
        return largest_errors(self.saturation, self.weights.w, self.level)

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
        """Return whether some multiplier certifies other times in the worst samples."""
        hold = Hold.of(replace(self.latency, **other))
        form = self.form.take(np.argsort(self.margins)[:_WORST]).changed(hold=hold)
        return form.is_possible() and bool(form.best_multiplier(self.weights).margins.min() > 0.0)


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
    """Choose a function that certifies the loop with a latency, for starts at rest.

    v̄ is such that all samples may be started from, or less where that is not certified.

    Args:
        loop: The closed loop, with gravity that is known.
        known: What was found for continuous time, to begin with.
        chosen: The form of continuous time at the samples to choose it on.
        fresh: The same to check it on.
        latency: Of the loop.
    """
    setting, saturation, n = loop.setting, loop.controller.saturation, len(chosen.samples)
    form = chosen.join(fresh)
    potential = setting.kp + setting.alpha * setting.kv
    needed = _SPARE * float((saturation.S(form.samples.e) @ potential).max(initial=0.0))
    dg = loop.gravity_gradients(form.samples)
    fastest = math.sqrt(2.0 * needed)
    most_s = fastest / math.sqrt(2.0 * setting.c_bar * float(potential.min()))

    def at_speed(form: SampledForm) -> SampledTest:
        """Choose a function on the first samples, and check it on the others if it passes."""
        best, family = _best(form.take(slice(n)), known)
        most_s = form.largest_s(best.weights)
        if most_s > form.most_s:  # of smaller weights than were begun with, errors may be larger
            form = form.changed(most_s=most_s)
            best = best._replace(margins=form.take(slice(n)).margins(best.weights))
        violations = checked = len(fresh.samples)
        if best.margins.min() > 0.0:
            margins = form.take(slice(n, None)).margins(best.weights)
            violations = int((margins <= 0.0).sum())
        return SampledTest(
            family, best.weights, best.margins, checked, violations, loop.region.independent,
            latency, max(0.0, form.level(best.weights)), form, saturation,
        )  # fmt: skip

    whole = SampledForm(form, loop.plants[0].friction, latency, fastest, most_s, dg)
    found = at_speed(whole)
    if not found.certified and fastest > 0.0:  # and it may be that no speed is slow enough
        found = at_speed(whole.with_speed(_SLOWEST * fastest))
        slower = _SLOWER if found.certified else ()
        tries = (at_speed(whole.with_speed(k * fastest)) for k in slower)
        found = next((each for each in tries if each.certified), found)
    if found.margin <= 0.0 and found.form.is_possible():
        margins = found.form.take(slice(n, None)).margins(found.weights)
        found = replace(found, violations=int((margins <= 0.0).sum()))
    return found


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
