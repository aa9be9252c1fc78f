"""Tests 1 and 2 over a region, in continuous time and sampled: functions and worst cases."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from approxjac import law
from approxjac.controllers.gains.gains import Latency
from approxjac.law import Saturation
from approxjac.stability.certificates.matrix_form import (
    FAMILIES,
    Best,
    Family,
    Hold,
    MatrixForm,
    SampledForm,
    Setting,
    Weights,
    best_weights,
    on_more,
)
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
_FARTHEST = 1e6  # error that is looked at
_TIMES = 90  # that an interval of it is halved
_LONGEST = 64.0  # times the period of the loop


@dataclass(frozen=True, eq=False, repr=False)
class MatrixTest:
    """Verdict of the matrix form over a region with one family of Lyapunov functions.

    Attributes:
        family: The family of functions.
        weights: Weights of the function with the largest margin.
        margins: Its margin in each sample that it was chosen on, shape (N,).
        checked: Number of further, independent samples that it was checked on.
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
        """Share of the designed dissipation left in the worst sample, at most 1."""
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
    """Verdict of the matrix form of the sampled, late loop over a region."""

    latency: Latency  # latency of the loop
    level: float  # c [J]: motions that begin with V ≤ c stay below v̄
    form: SampledForm  # the form at all samples; those that the function was chosen on come first

    @property
    def reason(self) -> str:
        """Reason why it is not certified: "violated" or "too slow"; "" if it is."""
        if self.certified:
            return ""
        return "violated" if self.margin > 0.0 else "too slow"

    @property
    def speed(self) -> float:
        """v̄ of `law.sampled_form`: bound of √(q̇ᵀMq̇) along the certified motions [√J]."""
        return self.form.speed

    @cached_property
    def certified_error(self) -> Array:
        """Largest start error of each task coordinate alone, at rest, shape (m,)."""
        return largest_errors(self.form.setting.saturation, self.weights.w, self.level)

    def below(self, level: float) -> SampledTest:
        """Return this test for motions with V(0) ≤ level [J], if that is less than its own."""
        return replace(self, level=min(level, self.level))

    def largest_period(self) -> float:
        """Return the largest period that this function certifies, all else the same [s]."""
        return largest(self._passes, self.latency.period)

    def _passes(self, period: float) -> bool:
        """True if some multiplier certifies another period in the worst samples."""
        hold = Hold.of(replace(self.latency, period=period))
        form = self.form.take(np.argsort(self.margins)[:_WORST]).changed(hold=hold)
        return form.is_possible() and bool(form.best_multiplier(self.weights).margins.min() > 0.0)


@dataclass(frozen=True, eq=False, repr=False)
class Theorem1:
    """The constants of Theorem 1 over a region, and the p that they allow.

    Attributes:
        p: Largest ‖Jᵀ − Ĵᵀ‖, eq. (7), with ∂e/∂q for J where e is not x − x_d.
        b_J: Largest ‖J‖.
        lambda_m: Largest λ_max[Ĵ⁺ᵀ M Ĵ⁺], of eq. (14).
        lambda_1: Smallest λ_min[ĴᵀK_vĴ + B] / λ_max[K_v], of eq. (21).
        lambda_2: Smallest λ_min[ĴᵀĴ + B/λ_max[K_v]], of eq. (23).
        c0: c₀ of eq. (15); it mixes units as (18) does.
        c1: c₁ of eq. (15).
        setting: Gains and damping.
        worst: Name of a constant → index of the sample that it comes from.
    """

    p: float
    b_J: float
    lambda_m: float
    lambda_1: float
    lambda_2: float
    c0: float
    c1: float
    setting: Setting
    worst: Mapping[str, int]

    def __repr__(self) -> str:
        return f"Theorem1({self})"

    def __str__(self) -> str:
        sign = "<" if self.holds else ">="
        text = f"p = {self.p:.3g} {sign} {max(self.allowed_p, 0.0):.3g} allowed"
        if not self.is_too_fast:
            return text
        allowed = f"(14) allows {self.alpha_max:.3g}"
        return f"{text}: learning has alpha = {self.alpha:.3g} 1/s, {allowed}"

    @property
    def alpha_max(self) -> float:
        """The largest α that (14) allows [1/s]."""
        return law.largest_alpha(self.setting.kv, self.setting.saturation.c_bar, self.lambda_m)

    @property
    def alpha(self) -> float:
        """The α that allows the largest p, or that of learnt gravity [1/s]."""
        at = self.setting
        if at.fixed_alpha is not None:
            return at.fixed_alpha
        below = _BELOW * self.alpha_max
        return law.best_alpha(at.kp, at.kv, self.lambda_1, self.c0, self.c1, below)

    @property
    def allowed_p(self) -> float:
        """The largest p that (14) and (22) allow, at `alpha`; not positive if none."""
        if self.is_too_fast:
            return 0.0
        kp, kv = self.setting.kp, self.setting.kv
        return min(law.allowed_p(self.alpha, kp, kv, self.lambda_1, self.c0, self.c1))

    @property
    def is_too_fast(self) -> bool:
        """True if learning has a larger α than (14) allows."""
        return self.setting.fixed_alpha is not None and self.alpha >= self.alpha_max

    @property
    def margin(self) -> float:
        """1 − p / allowed p, positive if Theorem 1 holds; −∞ if it allows no p at all."""
        allowed = self.allowed_p
        return 1.0 - self.p / allowed if allowed > 0.0 else -np.inf

    @property
    def holds(self) -> bool:
        """True if (14) and (22) hold for some α."""
        return self.margin > 0.0


_BELOW = 0.999  # (14) is strict


def constants(samples: Samples, setting: Setting) -> dict[str, Array]:
    """Return each constant for each sample alone, shape (N,), by name."""
    J, J_hat, kv, B = samples.J, samples.J_hat, setting.kv, setting.B
    D = law.dissipation(J_hat, kv, B)
    G, dG = law.cross_weight_pinv(J_hat, samples.dJ_hat, setting.weight)
    N = law.inertial_block(samples.M, samples.dM, samples.J_e, G, dG, samples.s, samples.slope)
    metric = G.mT @ samples.M @ G
    smallest = np.maximum(np.linalg.eigvalsh(D)[:, 0], 0.0) / float(kv.max())
    also = smallest  # of equal gains D/k_v is the matrix of λ₂
    if (kv != kv[0]).any():
        uniform = law.dissipation(J_hat, np.ones_like(kv), B / float(kv.max()))
        also = np.maximum(np.linalg.eigvalsh(uniform)[:, 0], 0.0)
    # the damping's αs(e)ᵀĴ⁺ᵀBq̇ is shared out by (18)
    c1 = 0.5 * np.linalg.norm(B[:, None] * G, 2, axis=(1, 2))
    return {
        "p": np.linalg.norm(samples.J_e - J_hat, 2, axis=(1, 2)),
        "b_J": np.linalg.norm(J, 2, axis=(1, 2)),
        "lambda_m": np.linalg.eigvalsh(metric)[:, -1],
        "lambda_1": smallest,
        "lambda_2": also,
        "c0": c1 + np.abs(np.linalg.eigvalsh(N)).max(axis=-1),
        "c1": c1,
    }


def badness(name: str, values: Array) -> Array:
    """Return values that are large where a constant is unfavourable."""
    return -values if name in ("lambda_1", "lambda_2") else values


def theorem1(samples: Samples, setting: Setting) -> Theorem1:
    """Evaluate the constants of Theorem 1 over all samples."""
    each = constants(samples, setting)
    worst = {name: int(np.argmax(badness(name, values))) for name, values in each.items()}
    return Theorem1(
        **{name: float(each[name][k]) for name, k in worst.items()}, setting=setting, worst=worst
    )


def refine_constants(loop: ClosedLoop, samples: Samples, rng: np.random.Generator) -> Samples:
    """Add samples near the worst of each constant of Theorem 1."""
    values = constants(samples, loop.setting)
    more: list[Samples] = []
    for name in list(values):
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
    """Choose a Lyapunov function, with more samples near its worst one."""
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
    """Return the margin of "theorem1" or "matrix" on given samples."""
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

    v̄ is large enough for starts at all samples, or less if that is not certified. `known`, and the
    forms to choose it on and to check it on, are those of continuous time.
    """
    setting, n = loop.setting, len(chosen.samples)
    form = chosen.join(fresh)
    potential = setting.kp + setting.alpha * setting.kv
    needed = _SPARE * float((setting.saturation.S(form.samples.e) @ potential).max(initial=0.0))
    fastest = math.sqrt(2.0 * needed)
    most_s = fastest / math.sqrt(2.0 * setting.saturation.c_bar * float(potential.min()))

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
            violations = form.take(slice(n, None)).violations(weights)
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
    return inverse(lambda e: w * saturation.S(e), np.full(len(w), level), _FARTHEST)


def inverse(function: Callable[[Array], Array], values: Array, most: float) -> Array:
    """Return the largest arguments ≤ most at which a growing function is ≤ values, shape (m,)."""
    low, high = np.zeros(len(values)), np.full(len(values), most)
    for _ in range(_TIMES):
        middle = 0.5 * (low + high)
        inside = function(middle) <= values
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return low
