"""`Suggestion`: gains that pass a test for a set of errors."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from approxjac.controllers import Gains, NoGravity, SetpointController
from approxjac.controllers.gains.tuning import default_gains, position_gains
from approxjac.errors import require_known
from approxjac.formatting import short_fields, wrapped
from approxjac.stability.certificates.certificate import sampled_test
from approxjac.stability.loop.closed_loop import SHARED
from approxjac.stability.search.tolerance import TESTS, Test
from approxjac.stability.studied_loop import Progress, StudiedLoop, progress_report
from approxjac.validation import Array, as_integer, as_limits, as_number

_RATES = (1.0, 1.5, 2.5, 4.0)  # of the position gain, times what settles the believed arm
_STIFFNESS = (1.0, 0.5, 2.0, 4.0)  # of K_v, times the default
_DAMPING = (1.0, 2.0, 4.0, 8.0, 16.0)  # of B_c, times the default
_TARGETS = 40  # configurations that the settling time is taken over
_SETTLED = 4.0  # time constants until 2 % are left


@dataclass(frozen=True, eq=False, repr=False)
class Candidate:
    """Gains, and their figures for the three requirements."""

    gains: Gains
    # of the chosen test, at most 0 where the sampled loop fails; NaN where both others do
    margin: float
    torque_ratio: float  # largest torque at the start as a share of the limits
    settling_time: float  # to 2 % of a small error in the worst case [s]; inf if not stable

    def met(self, settling_time: float) -> tuple[bool, bool, bool]:
        """Compare test, torque and time with the requirements, the last one in s: True if met."""
        return self.margin > 0.0, self.torque_ratio <= 1.0, self.settling_time <= settling_time

    def __str__(self) -> str:
        torque = f"starts with {self.torque_ratio:.2g} of the torque limits"
        return f"{self.gains}: {torque}, settles in {self.settling_time:.3g} s"

    __repr__ = short_fields


@dataclass(frozen=True, eq=False, repr=False)
class Suggestion:
    """Result of `Study.gains`.

    Attributes:
        test: The test that had to pass, besides the sampled loop.
        found: The lowest gains that meet all requirements; None if none do.
        tried: All candidates that were tried.
        settling_time: The required settling time [s].
    """

    test: Test
    found: Candidate | None
    tried: tuple[Candidate, ...]
    settling_time: float

    def __repr__(self) -> str:
        gains = "nothing" if self.found is None else repr(self.found.gains)
        return f"Suggestion({self.test!r}: {gains})"

    def __str__(self) -> str:
        if self.found is not None:
            margin = "slowest decay [1/s]" if self.test == "stable" else "margin"
            heading = f"gains: found, passing with {margin} {self.found.margin:.2g}"
            return "\n".join([*wrapped(heading), *wrapped(str(self.found), "  ")])
        met = np.array([each.met(self.settling_time) for each in self.tried])
        tests, torques, times = met.sum(axis=0)
        text = (
            f"gains: none found that meet all demands: of {len(met)} tried {tests} pass the test, "
            f"{torques} start within the torque limits, {times} settle within "
            f"{self.settling_time:g} s, and {(met[:, 1] & met[:, 2]).sum()} do the last two; try "
            "smaller errors, larger limits or a longer time"
        )
        return "\n".join(wrapped(text))


def suggested_gains(
    study: StudiedLoop,
    settling_time: float = 1.0,
    *,
    test: Test = "certified",
    torque_limits: float | Sequence[float] | Array | None = None,
    configurations: int = 200,
    progress: Progress = None,
) -> Suggestion:
    """Find gains of law (6) that pass a test, with gravity that is known exactly.

    There are three requirements: the test passes for every configuration drawn, and the sampled
    loop by a report or, for "stable", by its exact linearisation; the torque at a start at rest,
    gravity compensated, is within the limits; and a small error settles to 2 % in time with every
    true robot (a far reach takes longer). Candidates are multiples of the default gains, from low
    to high, with K_p such that the believed arm settles in time.

    Args:
        study: The study.
        settling_time: Required settling time > 0 [s].
        test: The test to pass: "certified" or "stable".
        torque_limits: A number or shape (n_v,), infinite for no limit [N m or N]; the
            arm's effort limits by default.
        configurations: Number of configurations to draw, ≥ 20, for the test "stable" ≥ 1.
        progress: Function called with "gains" and the share done; True shows a bar.

    Raises:
        InvalidInputError: Numbers out of range, or an empty region.
        UnknownNameError: No such test.
    """
    uncertainty, latency, seed = study.errors, study.timing, study.seed
    tell = progress_report(progress)
    require_known("test", test, "the tests", TESTS)
    settling_time = as_number("settling_time", settling_time, unit="s", above=0.0)
    as_integer("configurations", configurations, 1 if test == "stable" else 20)  # as of a report
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
    truths, q = loop.targets(_TARGETS, rng)
    targets, timing = loop.terms(truths, q), latency.in_samples()
    singular = loop.singular_configuration(samples) is not None
    weighing = [uncertainty.plant(values).dynamics for values in loop.values]
    weight = np.array([weighing[t].g(q) for t, q in zip(samples.truth, samples.q, strict=True)])

    def demands(gains: Gains) -> Candidate:
        own = loop.with_gains(gains)
        pull = samples.J_hat.mT @ (own.setting.kp * samples.s)[..., None]
        ratio = float((np.abs(weight - pull[..., 0]) / limits).max())
        slowest = min(each.decay_rate for each in own.stabilities(q, targets, timing))
        time = _SETTLED / slowest if slowest > 0.0 else np.inf
        left = np.nan  # of no use where both of the others are missed
        if test != "stable" and singular:
            left = -np.inf  # whatever the gains: the arm may stand still there
        elif ratio <= 1.0 or time <= settling_time:
            left = min(slowest, -float(own.growth(samples, timing).max()))
            if test == "certified" and left > 0.0:
                left = sampled_test(own, samples, latency).margin
        return Candidate(gains, left, ratio, time)

    def confirmed(candidate: Candidate) -> Candidate:
        """Return a candidate with the margin that a report has for the sampled loop."""
        if test == "stable":
            return candidate
        own = replace(known, controller=first.with_gains(candidate.gains))
        report: Any = own.report(configurations)
        left = report.test.margin
        return replace(candidate, margin=left if report.passed else min(left, 0.0))

    tried: list[Candidate] = []
    # gentle gains first: by how far they are from the default ones together
    grid = sorted(
        itertools.product(_RATES, _STIFFNESS, _DAMPING),
        key=lambda f: (f[0] * max(f[1], 1.0 / f[1]) * f[2] ** 0.5, f[0]),
    )
    for k, (rate, stiffness, damping) in enumerate(grid):
        kv, added = stiffness * np.asarray(base.kv), damping * np.asarray(base.damping)
        kp = rate * position_gains(task, kv, added, settling_time)
        tried.append(demands(Gains(kp, kv, added)))
        tell("gains", (k + 1) / len(grid))
        if all(tried[-1].met(settling_time)):
            tried[-1] = confirmed(tried[-1])
            if all(tried[-1].met(settling_time)):
                return Suggestion(test, tried[-1], tuple(tried), settling_time)
    return Suggestion(test, None, tuple(tried), settling_time)
