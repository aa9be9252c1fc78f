"""`Suggestion`: gains that pass a test for a set of errors, or what to relax."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from approxjac.controllers import Gains, NoGravity, SetpointController
from approxjac.controllers.gains.tuning import default_gains, position_gains
from approxjac.errors import UnknownNameError
from approxjac.formatting import rows, short_fields, wrapped
from approxjac.stability.certificates.certificate import margin
from approxjac.stability.loop.closed_loop import SHARED
from approxjac.stability.loop.linearization import Timing
from approxjac.stability.loop.local import local_test
from approxjac.stability.search.tolerance import TESTS, Test, tolerances
from approxjac.stability.studied_loop import StudiedLoop
from approxjac.validation import Array, as_limits, as_number

_RATES = (1.0, 1.5, 2.5, 4.0)  # of the position gain, times what settles the believed arm
_STIFFNESS = (1.0, 0.5, 2.0, 4.0)  # of K_v, times the default
_DAMPING = (1.0, 2.0, 4.0, 8.0, 16.0)  # of B_c, times the default
_TARGETS = 40  # configurations that the settling time is taken over
_SETTLED = 4.0  # time constants until 2 % are left
_LOOKED = 100  # configurations that show the unstable ones among dampings
_CONFIRMED = 5  # gains that a report is asked about to relax a demand
_SEVERAL = "at least two of"
SETTLES = "to 2 % of a small error, linearised near the target, at worst; far reaches take longer"
_SHARES = (1.0, 0.9, 0.8, 0.65, 0.5)  # of the largest scale


@dataclass(frozen=True, eq=False, repr=False)
class Candidate:
    """Gains, and how they meet the three demands."""

    gains: Gains
    # of the chosen test, at most 0 where the sampled loop fails; NaN where both others do
    margin: float
    torque_ratio: float  # largest torque at the start as a share of the limits
    settling_time: float  # to 2 % of a small error in the worst case [s]; inf if not stable

    def met(self, settling_time: float) -> tuple[bool, bool, bool]:
        """Return whether the test, the torque and the time [s] are as demanded."""
        return self.margin > 0.0, self.torque_ratio <= 1.0, self.settling_time <= settling_time

    def __str__(self) -> str:
        torque = f"starts with {self.torque_ratio:.2g} of the torque limits"
        return f"{self.gains}: {torque}, settles in {self.settling_time:.3g} s"

    __repr__ = short_fields


@dataclass(frozen=True, eq=False, repr=False)
class Suggestion:
    """Answer of `Study.gains`.

    Attributes:
        test: The test that had to pass, and the sampled loop besides.
        found: The gentlest gains that meet all demands; None if none do.
        relax: What to relax if none do, in words, one line a demand; empty otherwise.
        tried: All candidates that were tried.
    """

    test: Test
    found: Candidate | None
    relax: tuple[str, ...]
    tried: tuple[Candidate, ...]

    @property
    def heading(self) -> str:
        """The first line, whether gains were found and what is to be done if not."""
        if self.found is None:
            what = "relax" if self.relax[0].startswith(_SEVERAL) else "one of these would do"
            return f"gains: none found that meet all demands; {what}"
        left = f"margin {self.found.margin:.2g}"
        if self.test == "local":
            left = f"slowest decay {self.found.margin:.2g}/s"
        passes = "certified" if self.test == "matrix" else "passing"
        return f"gains: found, {passes} with {left}"

    def __repr__(self) -> str:
        found = "nothing" if self.found is None else repr(self.found.gains)
        return f"Suggestion({self.test!r}: {found})"

    def __str__(self) -> str:
        if self.found is None:
            lines = [wrapped(self.heading), *(wrapped(each, "- ") for each in self.relax)]
            return "\n".join(itertools.chain(*lines))
        share = f"at the start at most {100 * self.found.torque_ratio:.2g} % of the limits"
        texts = {
            "gains": str(self.found.gains),
            "torque": share if self.found.torque_ratio else "no limits known",
            "settles": f"in {self.found.settling_time:.3g} s {SETTLES}",
        }
        return "\n".join([*wrapped(self.heading), *rows(texts, 2)])


def suggested_gains(
    study: StudiedLoop,
    settling_time: float,
    test: Test,
    torque_limits: float | Sequence[float] | Array | None,
    configurations: int,
    tell: Callable[[float], None],
) -> Suggestion:
    """Return gains that pass a test for a study's errors; see `Study.gains`."""
    uncertainty, latency, seed = study.errors, study.timing, study.seed
    if test not in TESTS:
        raise UnknownNameError("test", test, "the tests", TESTS)
    settling_time = as_number("settling_time", settling_time, unit="s", above=0.0)
    # gravity counts for the torque at the start; the tests take it as compensated
    weightless = replace(uncertainty, arm=uncertainty.arm.with_gravity((0.0, 0.0, 0.0)))
    task = weightless.believed_task()
    limits = task.robot.effort_limits if torque_limits is None else torque_limits
    limits = as_limits("torque_limits", limits, task.robot.nv, unit="N m or N")
    base = default_gains(task, settling_time, 1.0 / latency.of_velocity)
    first = SetpointController(task, base, gravity=NoGravity(task.robot))
    known = replace(study, controller=first, uncertainty=weightless, latency=latency)
    loop = known.loop()
    known = replace(known, region=loop.region)
    rng = np.random.default_rng(seed)
    samples = loop.draw(configurations, rng, inside=SHARED)
    targets = loop.targets(_TARGETS, rng)
    singular = loop.singular_configuration(samples) is not None
    weighing = [uncertainty.plant(values).dynamics for values in loop.values]
    weight = np.array([weighing[t].g(q) for t, q in zip(samples.truth, samples.q, strict=True)])

    def demands(gains: Gains) -> Candidate:
        own = loop.with_gains(gains)
        pull = samples.J_hat.mT @ (own.setting.kp * samples.s)[..., None]
        ratio = float((np.abs(weight - pull[..., 0]) / limits).max())
        slowest = local_test(own, *targets, Timing.of(latency)).decay_rates.min()
        time = _SETTLED / slowest if slowest > 0.0 else np.inf
        left = np.nan  # of no use where both of the others are missed
        if test != "local" and singular:
            left = -np.inf  # whatever the gains: the arm may stand still there
        elif ratio <= 1.0 or time <= settling_time:
            grown = float(own.spectral_radii(samples, latency).max())
            if grown >= 1.0:
                left = 1.0 - grown
            else:
                left = slowest if test == "local" else margin(test, samples, own.setting)
        return Candidate(gains, left, ratio, time)

    def confirmed(candidate: Candidate) -> Candidate:
        """Return a candidate with the margin that a report has for the sampled loop."""
        if test == "local":
            return candidate
        own = replace(known, controller=first.with_gains(candidate.gains))
        report: Any = own.report(configurations)
        assert report.sampled is not None
        left = report.sampled.margin
        return replace(candidate, margin=left if report.passed else min(left, 0.0))

    tried: list[Candidate] = []
    grid = sorted(itertools.product(_RATES, _STIFFNESS, _DAMPING), key=_strength)
    for k, (rate, stiffness, damping) in enumerate(grid):
        kv, added = stiffness * np.asarray(base.kv), damping * np.asarray(base.damping)
        kp = rate * position_gains(task, kv, added, settling_time)
        tried.append(demands(Gains(kp, kv, added)))
        tell((k + 1) / len(grid))
        if all(tried[-1].met(settling_time)):
            tried[-1] = confirmed(tried[-1])
            if all(tried[-1].met(settling_time)):
                return Suggestion(test, tried[-1], (), tuple(tried))

    def tolerated(gains: Gains) -> float:
        own = replace(known, controller=first.with_gains(gains))
        scale = tolerances(own, (test,), largest=1.0, draws=configurations)[test].scale
        for share in _SHARES if scale > 0.0 else ():
            part = replace(own, uncertainty=weightless.scaled(share * scale))
            if test == "local":
                smaller = part.loop()
                few = smaller.draw(_LOOKED, np.random.default_rng(seed))
                passes = bool((smaller.spectral_radii(few, latency) < 1.0).all())
            else:
                passes = part.report(configurations).passed
            if passes:
                return share * scale
        return 0.0

    relax = _relaxations(tried, settling_time, tolerated, confirmed)
    return Suggestion(test, None, relax, tuple(tried))


def _strength(factors: tuple[float, float, float]) -> tuple[float, float]:
    """Gentle gains first: by how far they are from the default ones together."""
    rate, stiffness, damping = factors
    return rate * max(stiffness, 1.0 / stiffness) * damping**0.5, rate


def _relaxations(
    tried: list[Candidate],
    settling_time: float,
    tolerated: Callable[[Gains], float],
    confirmed: Callable[[Candidate], Candidate],
) -> tuple[str, ...]:
    """For each demand what it would have to be if the two others are kept."""
    met = [(candidate, *candidate.met(settling_time)) for candidate in tried]

    def first_that_passes(known: list[Candidate]) -> Candidate | None:
        for candidate in known[:_CONFIRMED]:
            if (found := confirmed(candidate)).margin > 0.0:
                return found
        return None

    lines = list[str]()
    if known := [c for c, _, torque, time in met if torque and time]:
        best = max(known, key=lambda c: c.margin)
        if share := tolerated(best.gains):
            lines.append(f"with {share:.2g} of the errors: {best}")
    known = sorted((c for c, test, _, time in met if test and time), key=lambda c: c.torque_ratio)
    if found := first_that_passes(known):
        lines.append(f"with {found.torque_ratio:.3g} times the torque limits: {found}")
    known = sorted(
        (c for c, test, torque, _ in met if test and torque), key=lambda c: c.settling_time
    )
    if found := first_that_passes(known):
        lines.append(f"with a settling time of {found.settling_time:.3g} s: {found}")
    if lines:
        return tuple(lines)
    in_time, gentle = ({c for c, *each in met if each[k]} for k in (2, 1))
    return (
        f"{_SEVERAL} the errors, the settling time and the torque limits, as one alone is not "
        f"enough: of {len(tried)} gains tried {len(in_time)} settle within {settling_time:g} s, "
        f"{len(gentle)} start within the torque limits, {len(in_time & gentle)} do both, and none "
        "of all these passes with the errors",
    )
