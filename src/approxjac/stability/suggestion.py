"""Gains that pass a test for a set of errors, or what to relax; what would certify a loop."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from approxjac.controllers import Gains, NoGravity, SetpointController, default_gains
from approxjac.controllers.default_gains import position_gains
from approxjac.errors import UnknownNameError
from approxjac.stability.certificate import margin
from approxjac.stability.closed_loop import SHARED, ClosedLoop
from approxjac.stability.linearization import Timing
from approxjac.stability.local import local_test
from approxjac.stability.region import Region
from approxjac.stability.report import stability_report
from approxjac.stability.tolerance import TESTS, Test, tolerance
from approxjac.stability.uncertainty import Uncertainty
from approxjac.validation import Array, as_limits, as_number, require

_RATES = (1.0, 1.5, 2.5, 4.0)  # of the position gain, times what settles the believed arm
_STIFFNESS = (1.0, 0.5, 2.0, 4.0)  # of K_v, times the default
_DAMPING = (1.0, 2.0, 4.0, 8.0, 16.0)  # of B_c, times the default
_TARGETS = 40  # configurations that the settling time is taken over
_SETTLED = 4.0  # time constants until 2 % are left
_RAISED = (1.5, 2.0, 3.0, 5.0, 10.0, 20.0)  # times the damping
_SHARES = (1.0, 0.9, 0.8, 0.65, 0.5)  # of the largest scale


@dataclass(frozen=True, eq=False, repr=False)
class Candidate:
    """Gains, and how they meet the three demands."""

    gains: Gains
    margin: float  # of the chosen test; NaN where it was not asked, as both others are missed
    torque_ratio: float  # largest torque at the start as a share of the limits
    settling_time: float  # to 2 % of a small error in the worst case [s]; inf if not stable

    def met(self, settling_time: float) -> tuple[bool, bool, bool]:
        """Return whether the test, the torque and the time [s] are as demanded."""
        return self.margin > 0.0, self.torque_ratio <= 1.0, self.settling_time <= settling_time

    def __repr__(self) -> str:
        torque = f"starts with {self.torque_ratio:.2g} of the torque limits"
        return f"{self.gains!r}: {torque}, settles in {self.settling_time:.3g} s"


@dataclass(frozen=True, eq=False, repr=False)
class Suggestion:
    """Answer of `suggest_gains`.

    Attributes:
        test: The test that had to pass.
        found: The gentlest gains that meet all demands; None if none do.
        relax: What to relax if none do, in words, one line a demand; empty otherwise.
        tried: All candidates that were tried.
    """

    test: Test
    found: Candidate | None
    relax: tuple[str, ...]
    tried: tuple[Candidate, ...]

    def __repr__(self) -> str:
        if self.found is None:
            return "\n".join(["no gains meet all demands:", *(f"- {line}" for line in self.relax)])
        return f"{self.found} ({self.test} passes with margin {self.found.margin:.3g})"


def suggest_gains(
    uncertainty: Uncertainty,
    region: Region | None = None,
    *,
    test: Test = "matrix",
    settling_time: float = 1.0,
    target: Sequence[float] | Array | None = None,
    torque_limits: float | Sequence[float] | Array | None = None,
    dt: float = 1e-3,
    configurations: int = 200,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Suggestion:
    """Find gains of law (6) that pass a test for a set of errors.

    Three demands: the test passes for every corner of the set and every configuration drawn; the
    torque of a start at rest, gravity compensated, is within the limits; and a small error settles
    to 2 % in the wanted time with every true robot, sampled at dt. Tried are the default gains and
    multiples of them, from gentle to strong, K_p along with K_v and the damping so that the
    believed arm settles in time.

    Args:
        uncertainty: The errors.
        region: Where starts and targets are; see `stability_report`.
        test: The test to pass: "theorem1", "matrix" or "local".
        settling_time: Wanted > 0 [s].
        target: x_d, shape (n_x,); by default all targets within the region.
        torque_limits: A number or shape (n_v,), infinite where there is none [N m or N]; the
            arm's effort limits by default.
        dt: Sampling time > 0 [s].
        configurations: How many to draw.
        seed: Of the drawing.
        progress: Called with the share that is done.

    Raises:
        InvalidInputError: Numbers out of range, or an empty region.
        UnknownNameError: No such test.
    """
    require("uncertainty", uncertainty, Uncertainty, "an Uncertainty")
    if test not in TESTS:
        raise UnknownNameError("test", test, "the tests", TESTS)
    settling_time = as_number("settling_time", settling_time, unit="s", above=0.0)
    dt = as_number("dt", dt, unit="s", above=0.0)
    # gravity counts for the torque at the start; the tests take it as compensated
    weightless = replace(uncertainty, arm=uncertainty.arm.with_gravity((0.0, 0.0, 0.0)))
    task = weightless.believed_task()
    limits = task.robot.effort_limits if torque_limits is None else torque_limits
    limits = as_limits("torque_limits", limits, task.robot.nv, unit="N m or N")
    base = default_gains(task, settling_time, 1.0 / dt)
    first = SetpointController(task, base, gravity=NoGravity(task.robot))
    loop = ClosedLoop(first, weightless, region, target)
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
        slowest = local_test(own, *targets, Timing(dt)).decay_rates.min()
        time = _SETTLED / slowest if slowest > 0.0 else np.inf
        left = np.nan  # of no use where both of the others are missed
        if test != "local" and singular:
            left = -np.inf  # whatever the gains: the arm may stand still there
        elif ratio <= 1.0 or time <= settling_time:
            left = slowest if test == "local" else margin(test, samples, own.setting)
        return Candidate(gains, left, ratio, time)

    tried: list[Candidate] = []
    grid = sorted(itertools.product(_RATES, _STIFFNESS, _DAMPING), key=_strength)
    for k, (rate, stiffness, damping) in enumerate(grid):
        kv, added = stiffness * np.asarray(base.kv), damping * np.asarray(base.damping)
        kp = rate * position_gains(task, kv, added, settling_time)
        tried.append(demands(Gains(kp, kv, added)))
        if progress is not None:
            progress((k + 1) / len(grid))
        if all(tried[-1].met(settling_time)):
            return Suggestion(test, tried[-1], (), tuple(tried))

    def tolerated(gains: Gains) -> float:
        return tolerance(
            first.with_gains(gains), weightless, loop.region, tests=(test,), target=target,
            largest=1.0, configurations=configurations, seed=seed,
        )[test].scale  # fmt: skip

    return Suggestion(test, None, _relaxations(tried, settling_time, tolerated), tuple(tried))


def _strength(factors: tuple[float, float, float]) -> tuple[float, float]:
    """Gentle gains first: by how far they are from the default ones together."""
    rate, stiffness, damping = factors
    return rate * max(stiffness, 1.0 / stiffness) * damping**0.5, rate


def _relaxations(
    tried: list[Candidate], settling_time: float, tolerated: Callable[[Gains], float]
) -> tuple[str, ...]:
    """For each demand what it would have to be if the two others are kept."""
    met = [(candidate, *candidate.met(settling_time)) for candidate in tried]
    lines = []
    if known := [c for c, _, torque, time in met if torque and time]:
        best = max(known, key=lambda c: c.margin)
        lines.append(f"the errors: {tolerated(best.gains):.2g} of them pass with {best}")
    if known := [c for c, test, _, time in met if test and time]:
        best = min(known, key=lambda c: c.torque_ratio)
        lines.append(f"the torque limits: {best.torque_ratio:.3g} times them: {best}")
    if known := [c for c, test, torque, _ in met if test and torque]:
        best = min(known, key=lambda c: c.settling_time)
        lines.append(f"the settling time: {best.settling_time:.3g} s: {best}")
    return tuple(lines) or ("at least two of them: no gains tried meet any two demands together",)


def damping_that_certifies(
    controller: SetpointController,
    uncertainty: Uncertainty,
    region: Region | None = None,
    *,
    progress: Callable[[float], None] | None = None,
    **options: Any,
) -> float | None:
    """Return the smallest factor of the added damping, of six from 1.5 to 20, that is certified.

    That is, by a whole `stability_report`, whose are the other arguments and `options` (`target`,
    `configurations` and `seed`); None if none is. `progress` is called with the share that is done.

    Raises:
        InvalidInputError: What `stability_report` refuses.
    """
    kp, kv, damping = controller.diagonals
    for k, factor in enumerate(_RAISED):
        if progress is not None:
            progress(k / len(_RAISED))
        raised = controller.with_gains(Gains(kp, kv, factor * damping))
        if stability_report(raised, uncertainty, region, **options).passed:
            return factor
    return None


def part_that_certifies(
    controller: SetpointController,
    uncertainty: Uncertainty,
    region: Region | None = None,
    *,
    largest: float = 1.0,
    progress: Callable[[float], None] | None = None,
    **options: Any,
) -> Uncertainty | None:
    """Return the largest part of the errors, of five tried, that a report certifies; or None.

    A report asks for more than `tolerance` does: it draws more configurations, and checks on others
    what it chose. `largest` is the scale to begin with, such as what `tolerance` tells; half of it
    is the last tried. The other arguments are those of `damping_that_certifies`.
    """
    for k, share in enumerate(_SHARES if largest > 0.0 else ()):
        if progress is not None:
            progress(k / len(_SHARES))
        part = uncertainty.scaled(share * largest)
        if stability_report(controller, part, region, **options).passed:
            return part
    return None
