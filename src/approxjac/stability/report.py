"""`stability_report`: the four tests over a region, before anything moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from approxjac.controllers import SetpointController
from approxjac.controllers.setpoint import require_setpoint
from approxjac.errors import InvalidInputError
from approxjac.robots import Robot
from approxjac.simulation import Plant
from approxjac.stability.certificate import MatrixTest, refine_constants, refine_weights
from approxjac.stability.closed_loop import (
    EXACT_GRAVITY,
    default_region,
    gravity_error,
    require_law,
    setting_of,
    true_plants,
)
from approxjac.stability.matrix_form import Family, MatrixForm, Weights
from approxjac.stability.region import Region
from approxjac.stability.rollouts import Rollouts, rollouts
from approxjac.stability.samples import Sampler, Scenarios
from approxjac.stability.singularity import singular_posture
from approxjac.stability.targets import LocalTest, local_test
from approxjac.stability.theorem1 import CONSTANTS, Theorem1, theorem1
from approxjac.stability.uncertainty import Uncertainty
from approxjac.validation import Array, require


@dataclass(frozen=True, eq=False, repr=False)
class StabilityReport:
    """What the four tests say about a controller, strongest claim first.

    The first two are sufficient conditions that sampling found to hold; that a region has no
    other posture where they fail is not proven, only bounded (`MatrixTest.violating_at_most`).
    They speak of motions that stay in the region.

    Attributes:
        controller: The controller.
        truth: The true robot, or the set of them.
        region: Where it was looked.
        target: x_d, or None for the values of other postures of the region.
        scenarios: What the tests 1 and 2 were evaluated on; those that the Lyapunov functions
            were chosen on come first.
        theorem1: Test 1.
        matrix: Test 2 by family.
        local: Test 3.
        rollouts: Test 4, or None if it was not asked for.
        corners: Values of the uncertain coordinates of each true robot, shape (k, d).
        gravity_error: Largest gravity torque in the region that the controller neither
            compensates nor can learn [N m or N]. All tests but the rollouts take it as zero.
        singular_q: A posture of the region where Ĵ loses rank, shape (nq,), with which nothing
            certifies the region; None if none was found.
        seed: Of all drawing.
    """

    controller: SetpointController
    truth: Plant | Uncertainty
    region: Region
    target: Array | None
    scenarios: Scenarios
    theorem1: Theorem1
    matrix: Mapping[Family, MatrixTest]
    local: LocalTest
    rollouts: Rollouts | None
    corners: Array
    gravity_error: float
    singular_q: Array | None
    seed: int

    @property
    def gravity_is_exact(self) -> bool:
        """Whether gravity is compensated, or can be learnt, to within 1e-5 N m."""
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
        """Which true robot the index of a scenario's `truth` means."""
        if isinstance(self.truth, Uncertainty) and self.truth.d > 0:
            return self.truth.describe(self.corners[index])
        return "the true robot"

    def _verdict(self, holds: bool) -> str:
        """Of a sufficient condition, which says nothing where gravity or rank are missing."""
        if not holds:
            return "not certified"
        assumed = self.gravity_is_exact and self.singular_q is None
        return "certified" if assumed else "would certify"

    def _case(self, among: Scenarios | LocalTest, index: int) -> str:
        """One of the cases in words: the true robot and the posture."""
        posture = ", ".join(f"{value + 0.0:.2f}" for value in among.q[index])
        return f"{self.describe_truth(int(among.truth[index]))} at q = [{posture}]"

    def lines(self) -> list[tuple[str, str, str]]:
        """The table: test, verdict, and the figures it rests on."""
        first, checked = self.theorem1, next(iter(self.matrix.values())).checked
        verdict = self._verdict(first.holds)
        sign = "<" if first.holds else ">="
        rows = []
        if not self.gravity_is_exact:
            rows.append(
                (
                    "0 gravity",
                    "not exact",
                    f"off by up to {self.gravity_error:.3g} N m: the error does not go to 0 but to "
                    "where K_p makes up for it, unless gravity is learnt (AdaptiveGravity); if "
                    "it is known exactly, leave it out (Robot.with_gravity((0, 0, 0)), NoGravity)",
                )
            )
        if self.singular_q is not None:
            rows.append(
                (
                    "0 rank",
                    "not regular",
                    "the estimated Jacobian loses rank in the region, where the arm may stand "
                    f"still away from its target: at q = {self.singular_q.round(3).tolist()}; "
                    "nothing below holds there; RegularPart leaves such postures out",
                )
            )
        rows += [
            (
                "1 Theorem 1",
                verdict,
                f"p = {first.p:.3g} {sign} {max(first.allowed_p, 0.0):.3g} allowed at "
                f"alpha = {first.alpha:.3g}/s; worst p with "
                f"{self._case(self.scenarios, first.worst['p'])}",
            )
        ]
        titles = {"paper": "paper's weights", "free": "free potential", "wide": "widened"}
        for family, test in self.matrix.items():
            worst = self._case(self.scenarios, test.worst)
            if test.certified:
                text = f"none of {checked} further ones violates it"
                if test.independent:
                    text += f", at most {100 * test.violating_at_most:.2g} % of all do (95 %)"
            else:
                text = f"holds in {100 * test.share:.3g} % of the postures"
            if test.margin > 0.0 and test.violations:
                text = f"violated in {test.violations} of {checked} further postures"
            rows.append(
                (
                    f"2 matrix form, {titles[family]}",
                    self._verdict(test.certified),
                    f"margin {test.margin:.3g}; {text}; worst with {worst}",
                )
            )
        local = self.local
        learns = self.controller.adaptation is not None
        learnt = " (learnt parameters, often slow, included)" if learns else ""
        rows.append(
            (
                "3 local",
                "stable" if local.stable else "not stable",
                f"at {100 * local.share:.4g} % of {len(local.q)} postures; slowest decay "
                f"{local.decay_rates.min():.3g}/s{learnt}, damping ratio "
                f"{local.damping_ratios.min():.2g}; worst with {self._case(local, local.worst)}",
            )
        )
        if self.rollouts is not None:
            rows.append(("4 rollouts", "", str(self.rollouts)))
        return rows

    def __repr__(self) -> str:
        name, by = self.controller.task.robot.name, self.certified_by
        verdict = "not certified" if by is None else f"certified by {by}"
        return f"StabilityReport({name!r}: {verdict} on {self.region!r}; print it for the tests)"

    def __str__(self) -> str:
        rows = self.lines()
        widths = [max(len(row[k]) for row in rows) for k in range(2)]
        table = "\n".join(
            f"{test:<{widths[0]}}  {verdict:<{widths[1]}}  {text}" for test, verdict, text in rows
        )
        checked = next(iter(self.matrix.values())).checked
        return (
            f"{self.controller!r}\non {self.region!r}: {len(self.scenarios) - checked} postures, "
            f"{checked} further ones to check, seed {self.seed}\n{table}"
        )

    def summary(self) -> dict[str, Any]:
        """What goes into summary.json."""
        first = self.theorem1
        low, high = first.alpha_range
        return {
            "robot": self.controller.task.robot.name,
            "region": repr(self.region),
            "postures": len(self.scenarios) - next(iter(self.matrix.values())).checked,
            "seed": self.seed,
            "certified_by": self.certified_by,
            "singular_q": None if self.singular_q is None else self.singular_q.tolist(),
            "theorem1": {
                "holds": first.holds,
                "margin": _number(first.margin),
                "p": first.p,
                "allowed_p": first.allowed_p,
                "allowed_p_large_gains": first.allowed_p_large_gains,
                "alpha": first.alpha,
                "alpha_range": [_number(low), _number(high)],
                "constants": {name: getattr(first, name) for name in CONSTANTS},
                "worst_q": {
                    name: self.scenarios.q[first.worst[name]].tolist() for name in CONSTANTS
                },
            },
            "matrix": {
                family: {
                    "certified": test.certified,
                    "margin": _number(test.margin),
                    "share": test.share,
                    "violations": test.violations,
                    "checked": test.checked,
                    "violating_at_most": test.violating_at_most,
                    "worst_q": self.scenarios.q[test.worst].tolist(),
                    "worst_truth": self.describe_truth(int(self.scenarios.truth[test.worst])),
                    "A1": test.weights.A1.tolist(),
                    "A2": test.weights.A2.tolist(),
                    "w": test.weights.w.tolist(),
                }
                for family, test in self.matrix.items()
            },
            "local": {
                "stable": self.local.stable,
                "share": self.local.share,
                "postures": len(self.local.q),
                "slowest_decay_rate": float(self.local.decay_rates.min()),
                "smallest_damping_ratio": float(self.local.damping_ratios.min()),
                "worst_q": self.local.q[self.local.worst].tolist(),
                "worst_truth": self.describe_truth(int(self.local.truth[self.local.worst])),
            },
        }


def stability_report(
    controller: SetpointController,
    truth: Plant | Robot | Uncertainty,
    region: Region | None = None,
    *,
    target: Sequence[float] | Array | None = None,
    postures: int = 2000,
    runs: int = 0,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> StabilityReport:
    """Tell before anything moves whether a controller is stable, and by how much.

    Half of the postures find the worst cases and choose the Lyapunov functions, with a closer
    look around the worst of them; the other half check what was chosen.

    Args:
        controller: The controller, of law (6) or (28).
        truth: The true robot, as a plant or as a robot on which the controller's own task is
            measured; or the set of true robots, of which all corners are taken.
        region: Where to look, as far as the true robot's sensor sees; the joint limits without
            near-singular postures by default.
        target: x_d, shape (n_x,), for the one target; by default the values of other postures of
            the region, so that the report speaks of all targets within it.
        postures: How many to draw, ≥ 20.
        runs: How many rollouts to add; none by default.
        seed: Of all drawing, ≥ 0.
        executor: Where the rollouts run; here by default.
        progress: Called with what is being done and the share of it.

    Raises:
        InvalidInputError: Law (5) or a posture torque, a task whose Jacobian uses the measured x,
            an empty region or one that a true camera sees nothing of, a target that no posture of
            a true robot attains, or numbers out of range.
    """
    require_setpoint(controller)
    require_law(controller)
    uncertainty = truth if isinstance(truth, Uncertainty) else None
    corners, plants = true_plants(controller, truth)
    for plant in plants:
        plant.require_task(controller.task)
        plant.require_ideal("a stability report")
    if region is None:
        region = default_region(controller)
    require("region", region, Region, "a Region, such as JointBox(robot)")
    if type(postures) is not int or postures < 20:
        raise InvalidInputError(
            f"postures must be an integer >= 20, got {postures!r}", given=postures
        )
    if type(seed) is not int or seed < 0:
        raise InvalidInputError(f"seed must be an integer >= 0, got {seed!r}", given=seed)
    if runs and uncertainty is None:
        raise InvalidInputError(
            "runs needs truth to be an Uncertainty, from which rollouts draw true robots, "
            f"got {truth!r}",
            given=truth,
        )
    x_d = None if target is None else plants[0].sensor.target(target)
    rng = np.random.default_rng(seed)
    tell = progress or (lambda what, share: None)
    sampler = Sampler(controller, plants, region, x_d)
    half = postures // 2
    scenarios = sampler.draw(half, rng, lambda k: tell("postures", k / postures))
    fresh = sampler.draw(postures - half, rng, lambda k: tell("postures", (half + k) / postures))
    setting = setting_of(controller, plants[0])

    scenarios = refine_constants(sampler, scenarios, setting, rng)
    form, check = MatrixForm(scenarios, setting), MatrixForm(fresh, setting)
    chosen: dict[Family, Weights] = {}
    for k, family in enumerate(setting.families):
        tell("matrix form", k / len(setting.families))
        form, best = refine_weights(sampler, form, family, rng)
        chosen[family] = best.weights
        if k > 0:  # a family holds those before it, whatever the search for it has found
            before = chosen[setting.families[k - 1]]
            if form.margins(before).min() > best.margins.min():
                chosen[family] = before
    scenarios = form.scenarios
    matrix: dict[Family, MatrixTest] = {}
    for family, weights in chosen.items():
        violations = int((check.margins(weights) <= 0.0).sum())
        matrix[family] = MatrixTest(
            family, weights, form.margins(weights), len(fresh), violations, region.independent
        )
    tell("local", 0.0)
    local = local_test(sampler, scenarios if x_d is None else sampler.targets(0, rng))
    everywhere = scenarios.join(fresh)
    outcome = None
    if runs and uncertainty is not None:
        outcome = rollouts(
            controller,
            uncertainty,
            region,
            target=x_d,
            runs=runs,
            seed=seed,
            executor=executor,
            progress=lambda done: tell("rollouts", done / runs),
        )
    return StabilityReport(
        controller,
        plants[0] if uncertainty is None else uncertainty,
        region,
        x_d,
        everywhere,
        theorem1(everywhere, setting),
        matrix,
        local,
        outcome,
        corners,
        gravity_error(controller, plants, scenarios.q[:: max(1, len(scenarios) // 20)]),
        singular_posture(sampler.parts, controller.task, scenarios),
        seed,
    )


def _number(value: float) -> float | None:
    """A number as JSON knows it: None where it is not finite."""
    return float(value) if np.isfinite(value) else None
