"""`tolerance`: how much larger or smaller errors may be before each test gives way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from approxjac.controllers import SetpointController
from approxjac.controllers.setpoint import require_setpoint
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.stability.certificate import refine_constants, refine_weights
from approxjac.stability.closed_loop import (
    default_region,
    require_gravity,
    require_law,
    setting_of,
    true_plants,
)
from approxjac.stability.matrix_form import MatrixForm
from approxjac.stability.region import Region
from approxjac.stability.rollouts import rollouts
from approxjac.stability.samples import Sampler
from approxjac.stability.singularity import singular_posture
from approxjac.stability.targets import local_test
from approxjac.stability.theorem1 import theorem1
from approxjac.stability.uncertainty import Uncertainty
from approxjac.stability.visibility import UnattainedError
from approxjac.validation import Array, as_number, require

Test = Literal["theorem1", "matrix", "local", "rollouts"]
TESTS: tuple[Test, ...] = ("theorem1", "matrix", "local")
"""The tests that need no simulation."""
_STEPS = 20  # of bisection


@dataclass(frozen=True, eq=False, repr=False)
class Tolerance:
    """How far a set of errors may be scaled while a test passes.

    Attributes:
        test: Which test.
        scale: The largest scale at which it passed, with the test passing at all the smaller
            ones that bisection tried; 0 if it does not even pass without errors.
        fails_at: The smallest scale at which it failed; infinite if it never did.
        worst: The true values that fail there, shape (d,); those at `scale` if nothing fails.
        uncertainty: The set at `scale`.
        worst_text: The true values in words.
    """

    test: Test
    scale: float
    fails_at: float
    worst: Array
    uncertainty: Uncertainty
    worst_text: str

    def __repr__(self) -> str:
        return f"Tolerance({self})"

    def __str__(self) -> str:
        allowed = self.uncertainty.describe_box()
        if not np.isfinite(self.fails_at):
            return (
                f"{self.test}: passes up to the largest scale tried, {self.scale:.3g} ({allowed})"
            )
        return (
            f"{self.test}: passes up to scale {self.scale:.3g} ({allowed}); fails at "
            f"{self.fails_at:.3g} with {self.worst_text}"
        )


def tolerance(
    controller: SetpointController,
    uncertainty: Uncertainty,
    region: Region | None = None,
    *,
    tests: Sequence[Test] = TESTS,
    target: Sequence[float] | Array | None = None,
    largest: float = 10.0,
    precision: float = 0.02,
    postures: int = 400,
    runs: int = 20,
    duration: float = 10.0,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> dict[Test, Tolerance]:
    """Find the largest scaling of a set of errors for which each test still passes.

    A region with a posture where Ĵ loses rank passes neither of the first two tests, at any scale.

    By bisection, with the same postures at every scale. Sets grow with their scale, so for the
    first two tests whatever passes at one scale passes at all smaller ones (as far as corners and
    postures tell). The local test looks at corners and might pass again beyond a gap.

    Args:
        controller: The controller.
        uncertainty: The errors at scale 1.
        region: Where to look; see `stability_report`.
        tests: Which tests: "theorem1", "matrix", "local", and "rollouts", which passes if all
            runs converge. The first two are not for a task whose Jacobian uses the measured x.
        target: x_d, shape (n_x,); see `stability_report`.
        largest: Scale at most > 0; less where robots beyond it cannot exist.
        precision: Of the scale, relative, > 0.
        postures: How many to draw.
        runs: Rollouts at each scale, if they are asked for.
        duration: Of a rollout [s].
        seed: Of the drawing.
        progress: Called with the share that is done.

    Raises:
        InvalidInputError: Numbers out of range, or what `stability_report` refuses.
        UnknownNameError: No such test.
    """
    require("uncertainty", uncertainty, Uncertainty, "an Uncertainty")
    require_setpoint(controller)
    require_law(controller)
    if uncertainty.d == 0:
        raise InvalidInputError(
            f"uncertainty must have a range to scale, got {uncertainty!r}", given=uncertainty
        )
    for test in tests:
        if test not in get_args(Test):
            raise UnknownNameError("test", test, "the tests", get_args(Test))
    largest = uncertainty.largest_scale(as_number("largest", largest, above=0.0))
    precision = as_number("precision", precision, above=0.0)
    region = default_region(controller) if region is None else region
    require("region", region, Region, "a Region, such as JointBox(robot)")
    require_gravity(controller, uncertainty, region)
    found: dict[Test, Tolerance] = {}
    for k, test in enumerate(tests):

        def failing(scale: float, test: Test = test) -> Array | None:
            errors = uncertainty.scaled(scale)
            if test == "rollouts":
                try:
                    outcome = rollouts(
                        controller, errors, region, target=target, runs=runs, duration=duration,
                        seed=seed,
                    )  # fmt: skip
                except UnattainedError as error:
                    if scale <= 1.0:
                        raise
                    return np.array(error.given)  # grown errors: a camera that looks elsewhere
                failed = [run for run in outcome.runs if not run.converged]
                return max(failed, key=lambda run: run.final_error).values if failed else None
            return _failing(
                controller, errors, region, test, target, postures, seed, uncertainty.factor
            )

        def tell(share: float, k: int = k) -> None:
            if progress is not None:
                progress((k + share) / len(tests))

        found[test] = _bisect(test, failing, uncertainty, largest, precision, tell)
    return found


def _bisect(
    test: Test,
    failing: Callable[[float], Array | None],
    uncertainty: Uncertainty,
    largest: float,
    precision: float,
    tell: Callable[[float], None],
) -> Tolerance:
    passes, fails, worst = 0.0, np.inf, failing(0.0)
    if worst is not None:
        fails = 0.0
    scale = min(1.0, largest)
    for step in range(_STEPS):
        if passes == largest or (np.isfinite(fails) and fails - passes <= precision * fails):
            break
        tell(step / _STEPS)
        culprit = failing(scale)
        if culprit is None:
            passes = scale
        else:
            fails, worst = scale, culprit
        scale = min(2.0 * passes, largest) if np.isinf(fails) else 0.5 * (passes + fails)
    held = uncertainty.scaled(passes)
    if worst is None:
        return Tolerance(test, passes, fails, held.believed, held, "")
    return Tolerance(test, passes, fails, worst, held, uncertainty.scaled(fails).describe(worst))


def _failing(
    controller: SetpointController,
    uncertainty: Uncertainty,
    region: Region,
    test: Test,
    target: Sequence[float] | Array | None,
    postures: int,
    seed: int,
    least_factor: float,
) -> Array | None:
    """The true values with which a test fails on a set, or None if it passes."""
    corners, plants = true_plants(controller, uncertainty)
    rng = np.random.default_rng(seed)
    x_d = None if target is None else plants[0].sensor.target(target)
    sampler = Sampler(controller, plants, region, x_d)
    try:
        if test == "local":
            local = local_test(sampler, sampler.targets(postures, rng))
            return None if local.stable else np.array(corners[local.truth[local.worst]])
        scenarios = sampler.draw(postures, rng)
    except UnattainedError as error:
        if uncertainty.factor <= least_factor:
            raise
        return np.array(corners[error.truth])  # grown errors have put the target out of reach
    if singular_posture(sampler.parts, controller.task, scenarios) is not None:
        return np.array(corners[0])  # whatever the errors: the arm may stand still there
    setting = setting_of(controller, plants[0])
    if test == "theorem1":
        scenarios = refine_constants(sampler, scenarios, setting, rng)
        first = theorem1(scenarios, setting)
        culprit = None if first.holds else scenarios.truth[first.worst["p"]]
    else:
        form = MatrixForm(scenarios, setting)
        for family in setting.families:
            form, best = refine_weights(sampler, form, family, rng)
            if best.margins.min() > 0.0:
                return None
        culprit = form.scenarios.truth[best.margins.argmin()]
    return None if culprit is None else corners[int(culprit)]
