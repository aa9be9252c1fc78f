"""`tolerance`: how much larger or smaller errors may be before each test gives way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.formatting import rows, wrapped
from approxjac.stability.certificates.certificate import refine_constants, refine_weights
from approxjac.stability.certificates.matrix_form import MatrixForm
from approxjac.stability.certificates.theorem1 import theorem1
from approxjac.stability.errors.region import Region
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import SHARED, ClosedLoop
from approxjac.stability.loop.local import local_test
from approxjac.stability.loop.visibility import UnattainedError
from approxjac.stability.rollout.rollouts import rollouts
from approxjac.validation import Array, as_number, require

Test = Literal["theorem1", "matrix", "local", "rollouts"]
TESTS: tuple[Test, ...] = ("theorem1", "matrix", "local")
"""The tests that need no simulation."""
_WORDS = {
    "theorem1": "Theorem 1 (not checked in other configurations)",
    "matrix": "the matrix form (not checked in other configurations)",
    "local": "the linearisation (near targets only)",
    "rollouts": "rollouts (no proof)",
}
_STEPS = 20  # of bisection


@dataclass(frozen=True, eq=False, repr=False)
class Tolerance:
    """Factor by which a set of errors may be scaled while a test passes.

    Attributes:
        test: The test.
        scale: The largest scale at which it passed, with the test passing at all the smaller
            ones that bisection tried; 0 if it does not even pass without errors.
        fails_at: The smallest scale at which it failed, or could not be tested; infinite if it
            never did, up to `largest`.
        is_tested: Whether it was tested there. Not so where a true robot attains the target outside
            the region only, or hardly sees the region.
        worst: The true values that fail there, shape (d,); those at `scale` if nothing fails.
        uncertainty: The set at `scale`.
    """

    test: Test
    scale: float
    fails_at: float
    worst: Array
    uncertainty: Uncertainty
    is_tested: bool = True

    @property
    def worst_text(self) -> str:
        """`worst` in words; empty if nothing fails."""
        return self.uncertainty.describe(self.worst) if np.isfinite(self.fails_at) else ""

    def __repr__(self) -> str:
        if not np.isfinite(self.fails_at):
            return f"Tolerance({self.test!r}: did not fail up to {self.scale:.3g}, the largest)"
        ends = "fails" if self.is_tested else "not tested"
        return f"Tolerance({self.test!r}: scale {self.scale:.3g}, {ends} at {self.fails_at:.3g})"

    def __str__(self) -> str:
        box = f"{self.scale:.3g} times the errors"
        what = _WORDS[self.test]
        if self.scale == 0.0:
            return "\n".join(wrapped(f"tolerated by {what}: no errors"))
        told = {"errors": self.uncertainty.describe_box()}
        at = f"at {self.fails_at:.3g} times, with {self.worst_text}"
        if not self.is_tested:
            told["not tested"] = (
                f"{at}: the target is attained outside the region only, or not seen; a larger "
                "region would tell"
            )
        elif np.isfinite(self.fails_at):
            told["fails"] = at
        else:
            box += ", the most that was tried"
        return "\n".join([*wrapped(f"tolerated by {what}: {box}"), *rows(told, 2)])


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
    runs: int = 100,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
    **options: Any,
) -> dict[Test, Tolerance]:
    """Find the largest scaling of a set of errors for which each test still passes.

    Theorem 1 and the matrix form are about motions that stay in the region, in continuous time. The
    configurations that choose the Lyapunov function are the only ones it is tried in: this finds
    how large errors may be about, and `stability_report`, which checks it in others, may find none
    a little below. The local test speaks of what begins near its target only, and rollouts prove
    nothing.

    A region with a configuration where Ĵ loses rank passes neither of the first two tests, at any
    scale.

    By bisection, with the same configurations at every scale. Sets grow with their scale, so for
    the first two tests whatever passes at one scale passes at all smaller ones (as far as corners
    and configurations tell). The local test looks at corners and might pass again beyond a gap, and
    so might rollouts, which pass where all of them converge.

    Args:
        controller: The controller.
        uncertainty: The errors at scale 1.
        region: Where to look; see `stability_report`.
        tests: "theorem1", "matrix", "local" or "rollouts". The first two are not for a task whose
            Jacobian uses the measured x.
        target: x_d, shape (n_x,); see `stability_report`.
        largest: Scale at most > 0; less where robots beyond it cannot exist.
        precision: Of the scale, relative, > 0.
        configurations: How many to draw.
        runs: Rollouts at each scale, which end with the first that does not converge.
        seed: Of the drawing.
        progress: Called with the share that is done.
        options: Others of `rollouts`, such as duration, dt, tolerance, executor.

    Raises:
        InvalidInputError: Numbers out of range, options without rollouts, or what
            `stability_report` refuses.
        UnknownNameError: No such test.
    """
    require("uncertainty", uncertainty, Uncertainty, "an Uncertainty")
    loop = ClosedLoop(controller, uncertainty, region, target)
    if uncertainty.d == 0:
        raise InvalidInputError(
            f"uncertainty must have a range to scale, got {uncertainty!r}", given=uncertainty
        )
    for test in tests:
        if test not in (*TESTS, "rollouts"):
            raise UnknownNameError("test", test, "the tests", (*TESTS, "rollouts"))
    if options and "rollouts" not in tests:
        raise InvalidInputError(
            f"options must be of a chosen test, got {', '.join(options)} with tests = "
            f"{tuple(tests)}; options are those of 'rollouts'",
            given=options,
        )
    largest = uncertainty.largest_scale(as_number("largest", largest, above=0.0))
    precision = as_number("precision", precision, above=0.0)
    loop.require_gravity()

    untested: set[tuple[Test, float]] = set()

    def failing(test: Test, scale: float) -> Array | None:
        """The true values with which a test fails at a scale, or None if it passes."""
        scaled = loop.scaled(scale)
        try:
            if test == "rollouts":
                many = rollouts(
                    controller, uncertainty.scaled(scale), loop.region, target=loop.target,
                    runs=runs, failures=1, seed=seed, **options,
                )  # fmt: skip
                return None if many.n_converged == many.n else many.runs[-1].values
            return _failing(scaled, test, configurations, np.random.default_rng(seed))
        except UnattainedError as error:
            if scale <= 1.0:
                raise
            # grown errors have put the target out of reach, or have a camera look elsewhere
            untested.add((test, scale))
            of_run = test == "rollouts"
            return np.array(error.given if of_run else scaled.values[error.truth])

    found: dict[Test, Tolerance] = {}
    for k, test in enumerate(tests):
        passes, worst = 0.0, failing(test, 0.0)
        fails, scale = np.inf if worst is None else 0.0, min(1.0, largest)
        for step in range(_STEPS):
            if passes == largest or (np.isfinite(fails) and fails - passes <= precision * fails):
                break
            if progress is not None:
                progress((k + step / _STEPS) / len(tests))
            culprit = failing(test, scale)
            if culprit is None:
                passes = scale
            else:
                fails, worst = scale, culprit
            scale = min(2.0 * passes, largest) if np.isinf(fails) else 0.5 * (passes + fails)
        worst = uncertainty.believed if worst is None else worst
        is_tested = (test, fails) not in untested
        found[test] = Tolerance(test, passes, fails, worst, uncertainty.scaled(passes), is_tested)
    return found


def _failing(
    loop: ClosedLoop, test: Test, configurations: int, rng: np.random.Generator
) -> Array | None:
    """The true values with which a test without simulation fails, or None if it passes."""
    if test == "local":
        local = local_test(loop, *loop.targets(configurations, rng))
        return None if local.stable else np.array(loop.values[local.truth[local.worst]])
    samples = loop.draw(configurations, rng, inside=SHARED)
    if loop.singular_configuration(samples) is not None:
        return np.array(loop.values[0])  # whatever the errors: the arm may stand still there
    if test == "theorem1":
        samples, constants = refine_constants(loop, samples, rng)
        first = theorem1(samples, loop.setting, constants)
        return None if first.holds else np.array(loop.values[samples.truth[first.worst["p"]]])
    form = MatrixForm(samples, loop.setting)
    for family in form.setting.families:
        form, best = refine_weights(loop, form, family, rng)
        if best.margins.min() > 0.0:
            return None
    return np.array(loop.values[int(form.samples.truth[best.margins.argmin()])])
