"""`tolerance`: how much larger or smaller errors may be before each test gives way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.stability.certificate import refine_constants, refine_weights
from approxjac.stability.closed_loop import ClosedLoop
from approxjac.stability.local_test import local_test
from approxjac.stability.matrix_form import MatrixForm
from approxjac.stability.region import Region
from approxjac.stability.rollouts import rollouts
from approxjac.stability.singularity import singular_configuration
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
        test: The test.
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
    configurations: int = 400,
    runs: int = 20,
    duration: float = 10.0,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> dict[Test, Tolerance]:
    """Find the largest scaling of a set of errors for which each test still passes.

    A region with a configuration where Ĵ loses rank passes neither of the first two tests, at any
    scale.

    By bisection, with the same configurations at every scale. Sets grow with their scale, so for
    the first two tests whatever passes at one scale passes at all smaller ones (as far as corners
    and configurations tell). The local test looks at corners and might pass again beyond a gap.

    Args:
        controller: The controller.
        uncertainty: The errors at scale 1.
        region: Where to look; see `stability_report`.
        tests: "theorem1", "matrix", "local", or "rollouts", which passes if all runs converge. The
            first two are not for a task whose Jacobian uses the measured x.
        target: x_d, shape (n_x,); see `stability_report`.
        largest: Scale at most > 0; less where robots beyond it cannot exist.
        precision: Of the scale, relative, > 0.
        configurations: How many to draw.
        runs: Rollouts at each scale, if they are asked for.
        duration: Of a rollout [s].
        seed: Of the drawing.
        progress: Called with the share that is done.

    Raises:
        InvalidInputError: Numbers out of range, or what `stability_report` refuses.
        UnknownNameError: No such test.
    """
    require("uncertainty", uncertainty, Uncertainty, "an Uncertainty")
    loop = ClosedLoop(controller, uncertainty, region, target)
    if uncertainty.d == 0:
        raise InvalidInputError(
            f"uncertainty must have a range to scale, got {uncertainty!r}", given=uncertainty
        )
    for test in tests:
        if test not in get_args(Test):
            raise UnknownNameError("test", test, "the tests", get_args(Test))
    largest = uncertainty.largest_scale(as_number("largest", largest, above=0.0))
    precision = as_number("precision", precision, above=0.0)
    loop.require_gravity()

    def failing(test: Test, scale: float) -> Array | None:
        """The true values with which a test fails at a scale, or None if it passes."""
        scaled = loop.scaled(scale)
        try:
            if test == "rollouts":
                return _diverting(scaled, runs, duration, seed)
            return _failing(scaled, test, configurations, np.random.default_rng(seed))
        except UnattainedError as error:
            if scale <= 1.0:
                raise
            # grown errors have put the target out of reach, or have a camera look elsewhere
            return np.array(error.given if test == "rollouts" else scaled.corners[error.truth])

    found: dict[Test, Tolerance] = {}
    for k, test in enumerate(tests):

        def tell(share: float, k: int = k) -> None:
            if progress is not None:
                progress((k + share) / len(tests))

        found[test] = _bisect(test, failing, uncertainty, largest, precision, tell)
    return found


def _bisect(
    test: Test,
    failing: Callable[[Test, float], Array | None],
    uncertainty: Uncertainty,
    largest: float,
    precision: float,
    tell: Callable[[float], None],
) -> Tolerance:
    passes, fails, worst = 0.0, np.inf, failing(test, 0.0)
    if worst is not None:
        fails = 0.0
    scale = min(1.0, largest)
    for step in range(_STEPS):
        if passes == largest or (np.isfinite(fails) and fails - passes <= precision * fails):
            break
        tell(step / _STEPS)
        culprit = failing(test, scale)
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
    loop: ClosedLoop, test: Test, configurations: int, rng: np.random.Generator
) -> Array | None:
    """The corner with which a test without simulation fails, or None if it passes."""
    corners: list[Array] = list(loop.corners)
    if test == "local":
        local = local_test(loop, *loop.targets(configurations, rng))
        return None if local.stable else corners[local.truth[local.worst]]
    samples = loop.draw(configurations, rng)
    if singular_configuration(loop, samples) is not None:
        return corners[0]  # whatever the errors: the arm may stand still there
    if test == "theorem1":
        samples = refine_constants(loop, samples, rng)
        first = theorem1(samples, loop.setting)
        return None if first.holds else corners[samples.truth[first.worst["p"]]]
    form = MatrixForm(samples, loop.setting)
    for family in form.setting.families:
        form, best = refine_weights(loop, form, family, rng)
        if best.margins.min() > 0.0:
            return None
    return corners[int(form.samples.truth[best.margins.argmin()])]


def _diverting(loop: ClosedLoop, runs: int, duration: float, seed: int) -> Array | None:
    """The true values of the worst run that does not converge, or None if all do."""
    assert isinstance(loop.truth, Uncertainty)
    outcome = rollouts(
        loop.controller, loop.truth, loop.region, target=loop.target, runs=runs,
        duration=duration, seed=seed,
    )  # fmt: skip
    failed = [run for run in outcome.runs if not run.converged]
    worst = max(failed, key=lambda run: run.final_error, default=None)
    return None if worst is None else worst.values
