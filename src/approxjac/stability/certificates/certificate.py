"""Lyapunov functions over a region, sampled or in continuous time, and Theorem 1."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from approxjac import law
from approxjac.controllers.gains.gains import Latency
from approxjac.law import Saturation
from approxjac.stability.certificates.matrix_form import (
    Best,
    Family,
    Hold,
    MatrixForm,
    SampledForm,
    Setting,
    Weights,
    best_weights,
)
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.samples import Samples
from approxjac.stability.rollouts.rollouts import clopper_pearson
from approxjac.validation import Array

RESERVE = 0.02  # margin that a search may have missed
_SLOWEST = 0.06  # times the speed that all starts need, that is tried if that is too fast
_SPARE = 1.4  # c is at most so many times what starts need: σ² is known afterwards only
_FARTHEST = 1e6  # error that is looked at
_TIMES = 90  # that an interval of it is halved
_BELOW = 0.999  # (14) is strict
_KILOHERTZ = Latency()


@dataclass(frozen=True, eq=False, repr=False)
class MatrixTest:
    """Verdict of the matrix form over a region with one Lyapunov function.

    Attributes:
        family: The family of functions that it is of.
        weights: Weights of the function.
        margins: Its margin in each sample that it was chosen on, the worst that a search found
            among them, shape (N,).
        form: The form at these samples.
        checked: Number of further, independent samples that it was checked on.
        violations: Number of these in which its margin is not positive.
    """

    family: Family
    weights: Weights
    margins: Array
    form: MatrixForm
    best: Best | None = None  # what it was chosen by
    checked: int = 0
    violations: int = 0

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
        """True if the function passed in every sample, the worst found with `RESERVE` to spare."""
        return self.margin >= RESERVE and self.violations == 0

    @property
    def violating_at_most(self) -> float:
        """Share of the combinations drawn (configuration, target, true robot) that may violate.

        An exact upper bound, at 95 % confidence.
        """
        # of a two-sided interval the upper end is missed half as often
        return clopper_pearson(self.violations, self.checked, 0.9)[1]

    def checked_on(self, samples: Samples) -> Self:
        """Return this test, checked on further samples."""
        violations = self.form.widened(samples).violations(self.weights)
        return replace(self, checked=len(samples), violations=violations)

    def with_samples(self, samples: Samples) -> Self:
        """Return this test with more samples beside those that it was chosen on."""
        form = self.form.including(samples)
        return replace(self, form=form, margins=form.margins(self.weights))


@dataclass(frozen=True, eq=False, repr=False)
class SampledTest(MatrixTest):
    """Verdict of the matrix form of the sampled, late loop over a region."""

    form: SampledForm
    latency: Latency = _KILOHERTZ  # latency of the loop
    is_slow: bool = False  # of slower motions than starts at all samples need
    most: float = math.inf  # bound of `level`

    @cached_property
    def level(self) -> float:
        """c: motions that begin with V ≤ c stay below v̄ [J]."""
        return max(0.0, min(self.most, self.form.level(self.weights)))

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
        return replace(self, most=min(level, self.most))


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


class EffortRoom(NamedTuple):
    """Room that limits of effort leave to a loop."""

    holds: bool  # True if motors can hold the arm at all samples
    # certified motions that begin with V ≤ this never exceed the limits [J]; 0 if there are none
    level: float


def effort_room(
    loop: ClosedLoop, effort: Array, samples: Samples, certified: SampledTest | None
) -> EffortRoom:
    """Return the room of limits of effort, shape (n_v,) [N m or N].

    With σ² of `SampledForm.level` and U = 2c̄W + Ω, V ≥ ½(1 − σ²)|q̇|²_M and V ≥ ½(1 − σ²)sᵀUs, each
    by completing the square of the other. So V ≤ c bounds each torque, also of a held or late one,
    |τᵢ − gᵢ| ≤ (|dᵢ|_{M⁻¹} + |kᵢ|_{U⁻¹}) √(2c/(1 − σ²)), dᵢ and kᵢ the rows of ĴᵀK_vĴ + B_c and
    of ĴᵀK_p.

    `certified` is the test of the loop without limits; None if that is not certified.
    """
    (kp, kv, damping), g = loop.diagonals, samples.g
    if loop.controller.adaptation is None:  # what the law adds
        g = np.array([loop.controller.gravity.torque(q) for q in samples.q])  # type: ignore[union-attr]
    room = effort - np.abs(g)
    holds = bool((room > 0.0).all())
    if certified is None or not holds:
        return EffortRoom(holds, 0.0)
    D_c, M_inv = law.dissipation(samples.J_hat, kv, damping), np.linalg.inv(samples.M)
    along = np.sqrt(np.einsum("nij,njk,nik->ni", D_c, M_inv, D_c))
    if certified.latency.velocity_filter:  # q̇ of other configurations is in it, too
        lightest = np.linalg.eigvalsh(M_inv)[:, -1].max()
        along = np.sqrt(lightest) * np.linalg.norm(D_c, axis=2)
    pull = samples.J_hat.mT * kp
    potential = np.linalg.inv(certified.weights.block(loop.setting.saturation.c_bar))
    along = along + np.sqrt(np.einsum("nij,jk,nik->ni", pull, potential, pull))
    # ½(1 − σ²) is level/v̄²
    share = min(1.0, float((room / along).min() / certified.speed))
    return EffortRoom(True, certified.level * share**2)


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


def theorem1(samples: Samples, setting: Setting) -> Theorem1:
    """Evaluate the constants of Theorem 1 over all samples."""
    each = constants(samples, setting)
    least = {
        name: -values if name in ("lambda_1", "lambda_2") else values
        for name, values in each.items()
    }
    worst = {name: int(values.argmax()) for name, values in least.items()}
    return Theorem1(
        **{name: float(each[name][k]) for name, k in worst.items()}, setting=setting, worst=worst
    )


def best_family(form: MatrixForm, known: MatrixTest | None = None) -> tuple[Best, Family]:
    """Return the function of the first family that is positive everywhere, or the best of all.

    `known` is the best for the first of the samples: no smaller family is positive.
    """
    tried: list[tuple[Best, Family]] = []
    families = form.setting.families
    for family in families if known is None else families[families.index(known.family) :]:
        before = known.best if known is not None and known.family == family else None
        tried.append((best_weights(form, family, before), family))
        if tried[-1][0].margins.min() >= RESERVE:
            break
    return max(tried, key=lambda each: float(each[0].margins.min()))


def continuous_test(
    loop: ClosedLoop, samples: Samples, known: MatrixTest | None = None
) -> MatrixTest:
    """Choose a function for the loop in continuous time on some samples.

    `known` is that for the first of them.
    """
    form = MatrixForm(samples, loop.setting)
    best, family = best_family(form, known)
    return MatrixTest(family, best.weights, best.margins, form, best)


def sampled_form(loop: ClosedLoop, samples: Samples, latency: Latency) -> SampledForm:
    """Return the form of the sampled, late loop for starts at rest at all samples.

    Their energy at rest tells how fast motions get, with typical weights.
    """
    setting = loop.setting
    potential = setting.kp + setting.alpha * setting.kv
    needed = _SPARE * float((setting.saturation.S(samples.e) @ potential).max(initial=0.0))
    fastest = math.sqrt(2.0 * needed)
    most_s = fastest / math.sqrt(2.0 * setting.saturation.c_bar * float(potential.min()))
    form = MatrixForm(samples, setting)
    return SampledForm(form, loop.plants[0].friction, Hold.of(latency), fastest, most_s)


def sampled_test(
    loop: ClosedLoop, samples: Samples, latency: Latency, known: SampledTest | None = None
) -> SampledTest:
    """Choose a function for the sampled loop of known gravity on some samples, of starts at rest.

    v̄ is large enough for starts at all samples, or less if that is not certified. `known` is the
    function for the first of the samples.
    """
    whole, setting = sampled_form(loop, samples, latency), loop.setting

    def at_speed(form: SampledForm) -> SampledTest:
        family, margins, best = setting.families[0], np.full(len(samples), -np.inf), None
        zero = np.zeros((len(setting.kp), len(setting.kp)))
        weights = Weights(setting.alpha * np.eye(len(zero)), zero, setting.kp, 0.5)
        if form.is_possible():
            begun = known if known is not None and known.is_slow == (form is not whole) else None
            best, family = best_family(form, begun)
            weights, margins, most_s = best.weights, best.margins, form.largest_s(best.weights)
            if most_s > form.most_s:  # of smaller weights errors may be larger
                form = form.changed(most_s=most_s)
                margins = form.margins(weights)
        slow = form.speed < whole.speed
        return SampledTest(family, weights, margins, form, best, latency=latency, is_slow=slow)

    if known is None or not known.is_slow:
        test = at_speed(whole)
        if test.certified or whole.speed == 0.0:
            return test
    return at_speed(whole.with_speed(_SLOWEST * whole.speed))  # it may be that none is slow enough


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
