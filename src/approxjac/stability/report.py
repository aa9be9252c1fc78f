"""`stability_report`: the four tests over a region, before anything moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.formatting import plain
from approxjac.robots import Robot
from approxjac.simulation import Plant
from approxjac.stability.certificate import MatrixTest, refine_constants, refine_weights
from approxjac.stability.closed_loop import EXACT_GRAVITY, ClosedLoop
from approxjac.stability.local import LocalTest, local_test
from approxjac.stability.matrix_form import Best, Family, MatrixForm
from approxjac.stability.region import Region
from approxjac.stability.rollouts import Rollouts, rollouts
from approxjac.stability.samples import Samples
from approxjac.stability.theorem1 import CONSTANTS, Theorem1, theorem1
from approxjac.stability.uncertainty import Uncertainty
from approxjac.validation import Array, as_integer

_THEOREM1 = ("holds", "p", "allowed_p", "alpha", "margin", "allowed_p_large_gains", "alpha_range")


@dataclass(frozen=True, eq=False, repr=False)
class StabilityReport:
    """Findings of the four tests about a controller, strongest claim first.

    The first two are sufficient conditions that sampling found to hold; that a region has no
    other configuration where they fail is not proven, only bounded
    (`MatrixTest.violating_at_most`). They speak of motions that stay in the region.

    Attributes:
        loop: The closed loop: controller, truth, region and target.
        samples: What the tests 1 and 2 were evaluated on; those that the Lyapunov functions were
            chosen on come first.
        theorem1: Test 1.
        matrix: Test 2 by family.
        local: Test 3.
        rollouts: Test 4, or None if it was not asked for.
        gravity_error: Largest gravity torque in the region that the controller neither
            compensates nor can learn [N m or N]. All tests but the rollouts take it as zero.
        singular_q: A configuration of the region where Ĵ loses rank, shape (nq,), with which
            nothing certifies the region; None if none was found.
        seed: Of all drawing.
    """

    loop: ClosedLoop
    samples: Samples
    theorem1: Theorem1
    matrix: Mapping[Family, MatrixTest]
    local: LocalTest
    rollouts: Rollouts | None
    gravity_error: float
    singular_q: Array | None
    seed: int

    @property
    def gravity_is_exact(self) -> bool:
        """Return whether gravity is compensated, or can be learnt, to within 1e-5 N m."""
        return self.gravity_error <= EXACT_GRAVITY

    @property
    def certified_by(self) -> str | None:
        """The strongest test that certifies the region: "theorem1", "matrix", or None."""
        if not self.gravity_is_exact or self.singular_q is not None or not self.local.stable:
            return None
        if self.theorem1.holds:
            return "theorem1"
        return "matrix" if any(test.certified for test in self.matrix.values()) else None

    def describe_truth(self, index: int) -> str:
        """Return in words which true robot the index of a sample's `truth` means."""
        truth = self.loop.truth
        if isinstance(truth, Uncertainty) and truth.d > 0:
            return truth.describe(self.loop.corners[index])
        return "the true robot"

    def _case(self, among: Samples | LocalTest, index: int) -> str:
        """One of the cases in words: the true robot and the configuration."""
        q = ", ".join(f"{value + 0.0:.2f}" for value in among.q[index])
        return f"{self.describe_truth(int(among.truth[index]))} at q = [{q}]"

    def lines(self) -> list[tuple[str, str, str]]:
        """Return the table: test, verdict, and the figures it rests on."""
        rows = []
        assumed = self.gravity_is_exact and self.singular_q is None
        passed = "certified" if assumed else "would certify"
        if not self.gravity_is_exact:
            figures = (
                f"off by up to {self.gravity_error:.3g} N m: the error does not go to 0 but to "
                "where K_p makes up for it, unless gravity is learnt (AdaptiveGravity); if it is "
                "known exactly, leave it out (Robot.with_gravity((0, 0, 0)), NoGravity)"
            )
            rows.append(("0 gravity", "not exact", figures))
        if self.singular_q is not None:
            figures = (
                "the estimated Jacobian loses rank in the region, where the arm may stand still "
                f"away from its target: at q = {self.singular_q.round(3).tolist()}; nothing below "
                "holds there; RegularPart leaves such configurations out"
            )
            rows.append(("0 rank", "not regular", figures))
        first = self.theorem1
        figures = (
            f"p = {first.p:.3g} {'<' if first.holds else '>='} {max(first.allowed_p, 0.0):.3g} "
            f"allowed at alpha = {first.alpha:.3g}/s; worst p with "
            f"{self._case(self.samples, first.worst['p'])}"
        )
        rows.append(("1 Theorem 1", passed if first.holds else "not certified", figures))
        titles = {"paper": "paper's weights", "free": "free potential", "wide": "widened"}
        for family, test in self.matrix.items():
            if test.certified:
                text = f"none of {test.checked} further ones violates it"
                if test.independent:
                    text += f", at most {100 * test.violating_at_most:.2g} % of all do (95 %)"
            elif test.margin > 0.0:
                text = f"violated in {test.violations} of {test.checked} further configurations"
            else:
                text = f"holds in {100 * test.share:.3g} % of the configurations"
            verdict = passed if test.certified else "not certified"
            worst = self._case(self.samples, test.worst)
            figures = f"margin {test.margin:.3g}; {text}; worst with {worst}"
            rows.append((f"2 matrix form, {titles[family]}", verdict, figures))
        local = self.local
        learns = self.loop.controller.adaptation is not None
        learnt = " (learnt parameters, often slow, included)" if learns else ""
        figures = (
            f"at {100 * local.share:.4g} % of {len(local.q)} configurations; slowest decay "
            f"{local.decay_rates.min():.3g}/s{learnt}, damping ratio "
            f"{local.damping_ratios.min():.2g}; worst with {self._case(local, local.worst)}"
        )
        rows.append(("3 local", "stable" if local.stable else "not stable", figures))
        if self.rollouts is not None:
            rows.append(("4 rollouts", "", str(self.rollouts)))
        return rows

    def __repr__(self) -> str:
        name, by = self.loop.controller.task.robot.name, self.certified_by
        verdict = "not certified" if by is None else f"certified by {by}"
        where = repr(self.loop.region)
        return f"StabilityReport({name!r}: {verdict} on {where}; print it for the tests)"

    def __str__(self) -> str:
        rows, paper = self.lines(), self.matrix["paper"]
        first, second = (max(len(row[k]) for row in rows) for k in range(2))
        table = [f"{test:<{first}}  {verdict:<{second}}  {text}" for test, verdict, text in rows]
        head = (
            f"{self.loop.controller!r}\non {self.loop.region!r}: "
            f"{len(paper.margins)} configurations, {paper.checked} further ones to "
            f"check, seed {self.seed}"
        )
        return "\n".join([head, *table])

    def summary(self) -> dict[str, Any]:
        """Return what goes into summary.json."""
        first, local, samples = self.theorem1, self.local, self.samples
        names = ("certified", "margin", "share", "violations", "checked", "violating_at_most")
        found = {
            "robot": self.loop.controller.task.robot.name,
            "region": repr(self.loop.region),
            "configurations": len(self.matrix["paper"].margins),
            "seed": self.seed,
            "certified_by": self.certified_by,
            "singular_q": self.singular_q,
            "theorem1": {
                **{name: getattr(first, name) for name in _THEOREM1},
                "constants": {name: getattr(first, name) for name in CONSTANTS},
                "worst_q": {name: samples.q[first.worst[name]] for name in CONSTANTS},
            },
            "matrix": {
                family: {
                    **{name: getattr(test, name) for name in names},
                    "worst_q": samples.q[test.worst],
                    "worst_truth": self.describe_truth(int(samples.truth[test.worst])),
                    **test.weights._asdict(),
                }
                for family, test in self.matrix.items()
            },
            "local": {
                "stable": local.stable,
                "share": local.share,
                "configurations": len(local.q),
                "slowest_decay_rate": local.decay_rates.min(),
                "smallest_damping_ratio": local.damping_ratios.min(),
                "worst_q": local.q[local.worst],
                "worst_truth": self.describe_truth(int(local.truth[local.worst])),
            },
        }
        return {name: plain(value) for name, value in found.items()}


def stability_report(
    controller: SetpointController,
    truth: Plant | Robot | Uncertainty,
    region: Region | None = None,
    *,
    target: Sequence[float] | Array | None = None,
    configurations: int = 2000,
    runs: int = 0,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> StabilityReport:
    """Tell before anything moves whether a controller is stable, and by how much.

    Half of the configurations find the worst cases and choose the Lyapunov functions, with a
    closer look around the worst of them; the other half check what was chosen.

    Args:
        controller: The controller, of law (6) or (28).
        truth: The true robot, as a plant or as a robot on which the controller's own task is
            measured; or the set of true robots, of which all corners are taken.
        region: Where to look, as far as the true robot's sensor sees; the joint limits without
            near-singular configurations by default.
        target: x_d, shape (n_x,), for the one target; by default the values of other
            configurations of the region, so that the report speaks of all targets within it.
        configurations: How many to draw, ≥ 20.
        runs: How many rollouts to add; none by default.
        seed: Of all drawing, ≥ 0.
        executor: Where the rollouts run; here by default.
        progress: Called with what is being done and the share of it.

    Raises:
        InvalidInputError: Law (5) or a posture torque, a task whose Jacobian uses the measured x,
            an empty region or one that a true camera sees nothing of, a target that no
            configuration of a true robot attains, or numbers out of range.
    """
    loop = ClosedLoop(controller, truth, region, target)
    half = as_integer("configurations", configurations, 20) // 2
    rng = np.random.default_rng(as_integer("seed", seed, 0))
    if runs and not isinstance(truth, Uncertainty):
        raise InvalidInputError(
            "runs needs truth to be an Uncertainty, from which rollouts draw true robots, "
            f"got {truth!r}",
            given=truth,
        )
    tell = progress or (lambda what, share: None)
    tell("configurations", 0.0)
    samples = loop.draw(half, rng)
    tell("configurations", 0.5)
    fresh = loop.draw(configurations - half, rng)
    setting = loop.setting
    samples, constants = refine_constants(loop, samples, rng)
    form, check = MatrixForm(samples, setting), MatrixForm(fresh, setting)
    chosen: dict[Family, Best] = {}
    known: Best | None = None
    for k, family in enumerate(setting.families):
        tell("matrix form", k / len(setting.families))
        form, best = refine_weights(loop, form, family, rng)
        # a family holds those before it, whatever the search for it has found
        if known is not None:
            known = form.evaluated(known)
        if known is None or known.margins.min() <= best.margins.min():
            known = best
        chosen[family] = known
    samples = form.samples
    matrix: dict[Family, MatrixTest] = {}
    for family, best in chosen.items():
        weights, margins = best.weights, form.evaluated(best).margins
        matrix[family] = MatrixTest(
            family, weights, margins, len(fresh), check.violations(weights), loop.region.independent
        )
    tell("local", 0.0)
    truths, configured = samples.truth, samples.q
    if loop.target is not None:
        truths, configured = loop.targets(0, rng)
    local = local_test(loop, truths, configured)
    everywhere, outcome = samples.join(fresh), None
    if runs and isinstance(truth, Uncertainty):
        outcome = rollouts(
            controller, truth, loop.region, target=target, runs=runs, seed=seed, executor=executor,
            progress=lambda done: tell("rollouts", done / runs),
        )  # fmt: skip
    first = theorem1(everywhere, setting, constants)
    singular_q = loop.singular_configuration(samples)
    gravity_error = loop.gravity_error(samples.q[:: max(1, len(samples) // 20)])
    return StabilityReport(
        loop, everywhere, first, matrix, local, outcome, gravity_error, singular_q, seed
    )
