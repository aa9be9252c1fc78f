"""`Tolerance`: the largest scale of the errors at which each test passes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from approxjac.controllers import Latency
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.formatting import rows, wrapped
from approxjac.stability.errors.region import uncovered
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import SHARED, ClosedLoop
from approxjac.stability.loop.configurations import UnattainedError
from approxjac.stability.report.other_laws import near_targets
from approxjac.stability.search.worst import fastest_growth, searched_test
from approxjac.stability.studied_loop import Progress, StudiedLoop, progress_report
from approxjac.validation import Array, as_integer, as_number

Test = Literal["certified", "stable", "rollouts"]
TESTS: tuple[Test, ...] = ("stable", "certified")  # the tests that need no simulation
_WORDS = {
    "certified": "one Lyapunov function (searched, not checked in further configurations)",
    "stable": "the linearisation (near targets only)",
    "rollouts": "rollouts (no proof)",
}
_STEPS = 20  # of bisection
_CONFIGURATIONS, _RUNS = 400, 100  # by default
_STARTS = 6  # of a search


@dataclass(frozen=True, eq=False, repr=False)
class Tolerance:
    """Factor by which a set of errors may be scaled while a test passes.

    Attributes:
        test: The test.
        scale: The largest scale at which it passed, as at all smaller ones that bisection tried;
            0 if it fails even without errors.
        fails_at: The smallest scale at which it failed, or a true robot does not attain the target
            in the region, or hardly sees it; infinite if none up to `largest`.
        worst: The true values that fail there, shape (d,); those at `scale` if nothing fails.
        uncertainty: The set at `scale`.
    """

    test: Test
    scale: float
    fails_at: float
    worst: Array
    uncertainty: Uncertainty

    @property
    def worst_text(self) -> str:
        """`worst` as text; "" if nothing fails."""
        return self.uncertainty.describe(self.worst) if np.isfinite(self.fails_at) else ""

    def __repr__(self) -> str:
        return f"Tolerance({self.test!r}: scale {self.scale:.3g}, fails at {self.fails_at:.3g})"

    def __str__(self) -> str:
        what = f"tolerated by {_WORDS[self.test]}"
        if self.scale == 0.0:
            return "\n".join(wrapped(f"{what}: no errors"))
        fails = f"at {self.fails_at:.3g} times, with {self.worst_text}"
        texts = {
            "errors": self.uncertainty.describe_box(),
            "fails": fails if np.isfinite(self.fails_at) else "not up to the most that was tried",
        }
        return "\n".join([*wrapped(f"{what}: {self.scale:.3g} times the errors"), *rows(texts, 2)])


def tolerances(
    study: StudiedLoop,
    tests: Sequence[Test] | Test = TESTS,
    *,
    largest: float = 10.0,
    precision: float = 0.1,
    draws: int | None = None,
    progress: Progress = None,
) -> dict[Test, Tolerance]:
    """Find the largest scaling of the errors for which each test still passes.

    It bisects, with the same configurations at every scale. Functions are not checked on further
    samples, so a report may tolerate a little less. A test might pass again beyond a gap.

    Args:
        study: The study.
        tests: Names of tests, or one: "certified" (only if Ĵ does not use x), "stable" or
            "rollouts".
        largest: Largest scale > 0; less if robots beyond it cannot exist.
        precision: Relative precision of the scale, > 0.
        draws: Number ≥ 1 of configurations, 400 by default, or of rollouts per scale, 100 then.
        progress: Function called with "tolerance" and the share done; True shows a bar.

    Raises:
        InvalidInputError: Numbers out of range, or the errors of a report.
        UnknownNameError: No such test.
    """
    uncertainty, tell = study.errors, progress_report(progress)
    tests = [tests] if isinstance(tests, str) else tests
    reason = uncovered(study.controller)
    if reason and (without := set(tests) - {"stable", "rollouts"}):
        raise InvalidInputError(
            f'tests must be "stable" or "rollouts", got {sorted(without)}: no certificate is for '
            f"this law; {reason}",
            given=tests,
        )
    loop = None if reason else study.loop()
    region = study.region if loop is None else loop.region
    if uncertainty.d == 0:
        message = f"uncertainty must have a range to scale, got {uncertainty!r}"
        raise InvalidInputError(message, given=uncertainty)
    if unknown := [test for test in tests if test not in _WORDS]:
        raise UnknownNameError("test", unknown[0], "the tests", _WORDS)
    largest = uncertainty.largest_scale(as_number("largest", largest, above=0.0))
    precision = as_number("precision", precision, above=0.0)
    draws = None if draws is None else as_integer("draws", draws, 1)
    if loop is not None:
        loop.require_gravity()

    def failing(test: Test, scale: float) -> Array | None:
        """The true values with which a test fails at a scale, or None if it passes."""
        own = replace(study, uncertainty=uncertainty.scaled(scale), region=region)
        scaled = loop.scaled(scale) if loop is not None and test != "rollouts" else None
        try:
            if scaled is not None:
                rng = np.random.default_rng(study.seed)
                return _failing(scaled, study.timing, test, draws or _CONFIGURATIONS, rng)
            if test == "stable":
                setting = own.setting()
                local, values, refused = near_targets(setting, own.timing, draws or _CONFIGURATIONS)
                if refused:
                    raise InvalidInputError("; ".join(refused), given=study.controller)
                return None if local.stable else values[local.worst]
            many = own.rollouts(draws or _RUNS, failures=1)
            return None if many.n_converged == many.n else many.runs[-1].values
        except UnattainedError as error:
            if scale <= 1.0:
                raise
            return np.array(error.given if scaled is None else scaled.values[error.truth])

    tolerated: dict[Test, Tolerance] = {}
    for k, test in enumerate(tests):
        passes, worst = 0.0, failing(test, 0.0)
        fails, scale = np.inf if worst is None else 0.0, min(1.0, largest)
        if test == "certified" and "stable" in tolerated and worst is None:
            fails, worst = tolerated["stable"].fails_at, tolerated["stable"].worst
            scale = min(scale, 0.5 * fails)
        for step in range(_STEPS):
            if passes == largest or (np.isfinite(fails) and fails - passes <= precision * fails):
                break
            tell("tolerance", (k + step / _STEPS) / len(tests))
            culprit = failing(test, scale)
            if culprit is None:
                passes = scale
            else:
                fails, worst = scale, culprit
            scale = min(2.0 * passes, largest) if np.isinf(fails) else 0.5 * (passes + fails)
        worst = uncertainty.believed if worst is None else worst
        tolerated[test] = Tolerance(test, passes, fails, worst, uncertainty.scaled(passes))
    return tolerated


def _failing(
    loop: ClosedLoop, latency: Latency, test: Test, draws: int, rng: np.random.Generator
) -> Array | None:
    """The true values with which a test without simulation fails, or None if it passes."""
    loop.targets(draws, rng)  # refuses what no true robot sees
    growth = fastest_growth(loop, latency.in_samples(), _STARTS, rng)
    if growth.grows or test == "stable":
        return growth.values if growth.grows else None
    samples = loop.draw(draws, rng, inside=SHARED)
    if loop.singular_configuration(samples) is not None:
        return np.array(loop.values[0])  # whatever the errors: the arm may stand still there
    held = None if loop.controller.adaptation is not None else latency
    found = searched_test(loop, held, samples, rng)
    return None if found.certified else np.array(loop.values[found.form.samples.truth[found.worst]])
