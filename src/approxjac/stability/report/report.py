"""`StabilityReport`: the tests over a region, before anything moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from approxjac.controllers import CrossWeight, Latency, TorqueLimited
from approxjac.stability.certificates.attraction import Attraction, attraction
from approxjac.stability.certificates.certificate import (
    MatrixTest,
    refine_constants,
    refine_weights,
)
from approxjac.stability.certificates.families import Family
from approxjac.stability.certificates.limit_cost import LimitCost, within_limits
from approxjac.stability.certificates.matrix_form import Best, MatrixForm, on_more
from approxjac.stability.certificates.sampled_test import SampledTest, largest, sampled_test
from approxjac.stability.certificates.theorem1 import Theorem1, theorem1
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import EXACT_GRAVITY, SHARED, ClosedLoop
from approxjac.stability.loop.local import LocalTest, local_test
from approxjac.stability.loop.samples import Samples
from approxjac.stability.report import render, rows
from approxjac.stability.report.rows import Row
from approxjac.stability.rollouts.rollouts import Rollouts
from approxjac.validation import Array, as_integer

_TARGETS = 1000  # that the sampled loop is linearised at
_WORST = 60
_CHOOSE = 1000  # samples at most that functions are chosen on: more of them check instead


@dataclass(frozen=True, eq=False, repr=False)
class StabilityReport:
    """Findings of the tests about a controller.

    The word "certified" is about the sampled loop with its delays. Theorem 1 and the matrix
    form are about continuous time. All three are sufficient conditions that sampling found to hold;
    that a region has no other configuration where they fail is not proven, only bounded
    (`MatrixTest.violating_at_most`). They speak of motions that stay in the region.

    Attributes:
        loop: The closed loop: controller, truth, region and target.
        latency: When it measures and acts.
        samples: What all but the local test and the rollouts were evaluated on; those that the
            Lyapunov functions were chosen on come first.
        sampled: The loop as it runs, or None where gravity is learnt, which it does not cover.
        theorem1: Test 1, in continuous time.
        matrix: Test 2 in continuous time by family, from the smallest to the first that certifies.
        local: Test 3, in continuous time.
        spectral_radii: By what errors near targets are multiplied from one frame of x to the next
            at most, in the exact linearisation of the sampled loop with its delays, shape (k,);
            below 1 where it is stable.
        rollouts: Test 4, or None if it was not asked for.
        gravity_error: Largest gravity torque in the region that the controller neither
            compensates nor can learn [N m or N]. All tests but the rollouts take it as zero.
        singular_q: A configuration of the region where Ĵ loses rank, shape (nq,), with which
            nothing certifies the region; None if none was found.
        damped_q: The same where the Ĵ⁺ of learning is damped, which no certificate covers.
        seed: Of all drawing.
        limits: What limits of torques cost; None of a controller without them.
    """

    loop: ClosedLoop
    latency: Latency
    samples: Samples
    sampled: SampledTest | None
    theorem1: Theorem1
    matrix: Mapping[Family, MatrixTest]
    local: LocalTest
    spectral_radii: Array
    rollouts: Rollouts | None
    gravity_error: float
    singular_q: Array | None
    damped_q: Array | None
    seed: int
    limits: LimitCost | None = None

    @property
    def gravity_is_exact(self) -> bool:
        """Return whether gravity is compensated, or can be learnt, to within 1e-5 N m."""
        return self.gravity_error <= EXACT_GRAVITY

    @property
    def is_as_assumed(self) -> bool:
        """Return whether gravity, the rank of Ĵ and Ĵ⁺ are as every certificate assumes."""
        return self.gravity_is_exact and self.singular_q is None and self.damped_q is None

    @property
    def certified_by(self) -> str | None:
        """Return "sampled form" if that certifies the sampled loop, else None; see `reason`."""
        return None if self.reason else "sampled form"

    @property
    def passed(self) -> bool:
        """Return whether it is certified as far as there are certificates.

        Where gravity is learnt there is none of the sampled loop: the one in continuous time has
        to do, with nothing that contradicts it.
        """
        learns = self.sampled is None and not self.contradiction
        return self.certified_by is not None or (
            learns and self.certified_in_continuous_time is not None
        )

    @property
    def certified_in_continuous_time(self) -> str | None:
        """The strongest test that certifies the region, "theorem1" or "matrix", or None.

        It says nothing of what sampling and delays do.
        """
        if not self.is_as_assumed or not self.local.stable:
            return None
        if self.theorem1.holds:
            return "theorem1"
        return "matrix" if any(test.certified for test in self.matrix.values()) else None

    @property
    def cross_weight(self) -> CrossWeight | None:
        """G of the V that certifies, which `TorqueLimited` can keep falling; None if none does."""
        if not self.passed:
            return None
        test: MatrixTest | None = self.sampled
        if test is None:  # gravity is learnt
            test = max(self.matrix.values(), key=lambda test: (test.certified, test.margin))
        return CrossWeight(test.weights.A1, test.weights.A2, self.loop.setting.B)

    @property
    def reason(self) -> str:
        """Return what keeps the sampled loop from being certified; empty where it is certified.

        A contradiction; "violated", "too slow" or "none" of the Lyapunov functions found; or
        "learnt" or "learnt, none" where gravity is learnt, which has certificates in continuous
        time only.
        """
        if self.contradiction:
            return self.contradiction
        nowhere = self.certified_in_continuous_time is None
        if self.sampled is None:
            return "learnt, none" if nowhere else "learnt"
        return "none" if self.sampled.margin <= 0.0 and nowhere else self.sampled.reason

    @property
    def contradiction(self) -> str:
        """Return what no certificate can stand beside; empty where there is nothing."""
        rollouts = self.rollouts
        found = {
            "gravity": not self.gravity_is_exact,
            "rank": self.singular_q is not None,
            "damped": self.damped_q is not None,
            "motors": self.limits is not None and not self.limits.holds,
            "unstable": bool((self.spectral_radii >= 1.0).any()),
            "unstable in continuous time": not self.local.stable,
            "rollouts diverged": rollouts is not None and rollouts.n_diverged > 0,
        }
        return next((reason for reason, is_so in found.items() if is_so), "")

    def describe_truth(self, index: int) -> str:
        """Return in words which true robot the index of a sample's `truth` means."""
        truth = self.loop.truth
        if isinstance(truth, Uncertainty) and truth.d > 0:
            return truth.describe(self.loop.values[index])
        return "the true robot"

    @cached_property
    def largest_period(self) -> tuple[float, float]:
        """Largest period that is certified, and that is stable by the exact linearisation [s].

        All else the same; 0 where none is. Worked out when it is asked for, such as to be printed.
        """
        assert self.sampled is not None
        worst = self.samples.take(np.argsort(-self.spectral_radii)[:_WORST])
        exact = largest(
            lambda latency: bool((self.loop.spectral_radii(worst, latency) < 1.0).all()),
            lambda period: replace(self.latency, period=period),
            self.latency.period,
        )
        return self.sampled.largest_period(), exact

    @cached_property
    def largest_delay(self) -> float:
        """Largest delay of torques that is certified, all else the same [s]; 0 where none is."""
        assert self.sampled is not None
        return self.sampled.largest_delay()

    @cached_property
    def attraction(self) -> Attraction | None:
        """Starts that never leave the region; None where nothing is certified, or it is no box."""
        if self.sampled is None or self.reason:
            return None
        return attraction(self.loop, self.sampled, np.random.default_rng(self.seed))

    @property
    def has_starts_that_stay(self) -> bool:
        """Return whether there are starts from which the region is proven not to be left."""
        return self.attraction is not None and bool(self.attraction.radius)

    @cached_property
    def rows(self) -> list[Row]:
        """The findings: of which part of the report, what was tested, its verdict and figures."""
        return rows.rows_of(self)

    def verdict(self) -> str:
        """Return in one line whether the sampled loop is certified, and why not."""
        return render.headline(rows.verdict(self))

    def __repr__(self) -> str:
        name, where = self.loop.controller.task.robot.name, repr(self.loop.region)
        return f"StabilityReport({name!r}: {self.verdict()}, on {where}; print it for the tests)"

    def __str__(self) -> str:
        return render.text(self.rows)

    def summary(self) -> dict[str, Any]:
        """Return what goes into summary.json: the rows by part and name, and what is certified."""
        found = {
            "robot": self.loop.controller.task.robot.name,
            "seed": self.seed,
            "certified_by": self.certified_by,
            "certified_in_continuous_time": self.certified_in_continuous_time,
            "reason": self.reason,
        }
        return found | render.as_json(self.rows)


def report_of(
    loop: ClosedLoop,
    latency: Latency,
    configurations: int,
    seed: int,
    tell: Callable[[str, float], None],
    limiter: TorqueLimited | None = None,
    rollouts: Rollouts | None = None,
) -> StabilityReport:
    """Return the report of a loop; see `Study.report`.

    Args:
        loop: The loop.
        latency: When it measures and acts.
        configurations: How many to draw, ≥ 20.
        seed: Of all drawing.
        tell: Called with what is being done and the share of it.
        limiter: Around the loop's controller, or None.
        rollouts: That were made of it, or None.
    """
    half = min(as_integer("configurations", configurations, 20) // 2, _CHOOSE)
    rng = np.random.default_rng(seed)
    tell("configurations", 0.0)
    samples = loop.draw(half, rng, inside=SHARED)
    tell("configurations", 0.5)
    fresh = loop.draw(configurations - half, rng, inside=1)
    setting = loop.setting
    samples, constants = refine_constants(loop, samples, rng)
    form, check = MatrixForm(samples, setting), MatrixForm(fresh, setting)
    found: dict[Family, Best] = {}
    best: Best | None = None
    for k, family in enumerate(setting.families):
        tell("matrix form", k / len(setting.families))
        form, best = refine_weights(loop, form, family, rng)
        found[family] = best
        if best.margins.min() > 0.0 and not check.violations(best.weights):
            break
    assert best is not None
    samples = form.samples
    matrix: dict[Family, MatrixTest] = {}
    for family, each in found.items():
        last = on_more(form, family, each)  # a later family may have found worse ones
        matrix[family] = MatrixTest(
            family, last.weights, last.margins, len(fresh), check.violations(last.weights),
            loop.region.independent,
        )  # fmt: skip
    sampled = None
    if loop.controller.adaptation is None:
        tell("sampled form", 0.0)
        sampled = sampled_test(loop, best, form, check, latency)
    tell("local", 0.0)
    truths, configured = samples.truth, samples.q
    if loop.target is not None:
        truths, configured = loop.targets(0, rng)
    local = local_test(loop, truths, configured)
    everywhere = samples.join(fresh)
    first = theorem1(everywhere, setting, constants)
    singular_q = loop.singular_configuration(samples)
    damped_q = loop.damped_configuration(everywhere)
    gravity_error = loop.gravity_error(samples.q[:: max(1, len(samples) // 20)])
    radii = loop.spectral_radii(samples.take(slice(_TARGETS)), latency)
    report = StabilityReport(
        loop, latency, everywhere, sampled, first, matrix, local, radii, rollouts, gravity_error,
        singular_q, damped_q, seed,
    )  # fmt: skip
    return report if limiter is None else within_limits(report, limiter)
