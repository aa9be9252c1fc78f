"""`stability_report`: the four tests over a region, before anything moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from approxjac import law
from approxjac.checks import Array, require
from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.robots import Robot
from approxjac.simulation import Plant
from approxjac.stability.attain import attain
from approxjac.stability.matrix_form import (
    Best,
    Family,
    MatrixForm,
    Setting,
    Weights,
    best_weights,
)
from approxjac.stability.region import JointBox, Region, RegularPart
from approxjac.stability.rollouts import Rollouts, rollouts
from approxjac.stability.scenarios import Sampler, Scenarios
from approxjac.stability.theorem1 import CONSTANTS, Theorem1, badness, constants, theorem1
from approxjac.stability.uncertainty import Uncertainty
from approxjac.tasks.task import vanishing

_REGULAR = 0.5  # times a tenth of the typical σ_max, below which postures are left out
_REFINED = 6  # closer looks at the worst scenario, each from the worst of the last
_NEAR = 40  # scenarios of a closer look
_CLOSER = 0.15  # of the region's spread
_NOTABLE = 1e-3  # margin
_LOCAL = 1000  # postures at most that the local test takes as targets
_STARTS = 20  # of the search for postures that attain a target
_CONFIDENCE = 0.95
_EXACT = 1e-5  # gravity torque [N m] that counts as none


@dataclass(frozen=True, eq=False)
class MatrixTest:
    """What the matrix form says over a region with one family of Lyapunov functions.

    Attributes:
        family: Which functions were tried.
        weights: The one with the largest margin.
        margins: Its margin in each scenario that it was chosen on, shape (N,).
        checked: In how many further scenarios, drawn independently, it was checked.
        violations: In how many of them its margin is not positive.
    """

    family: Family
    weights: Weights
    margins: Array
    checked: int
    violations: int

    @property
    def margin(self) -> float:
        """Share of the designed dissipation that is left in the worst scenario, at most 1."""
        return float(self.margins.min())

    @property
    def worst(self) -> int:
        """Index of the worst scenario."""
        return int(self.margins.argmin())

    @property
    def share(self) -> float:
        """Share of the scenarios with a positive margin under this one function."""
        return float((self.margins > 0.0).mean())

    @property
    def certified(self) -> bool:
        """Whether the function passed in every scenario it was chosen or checked on."""
        return self.margin > 0.0 and self.violations == 0

    @property
    def violating_at_most(self) -> float:
        """Share of the region that may violate, an exact upper bound at 95 % confidence."""
        return _upper_bound(self.violations, self.checked)


@dataclass(frozen=True, eq=False)
class LocalTest:
    """What the exact linearisation says with each posture taken as a target.

    Attributes:
        decay_rates: −max Re λ without the self-motion's zeros, shape (N,) [1/s].
        damping_ratios: Smallest −Re λ/‖λ‖, shape (N,).
        q: The postures, shape (N, nq).
        truth: Which of the true robots, shape (N,).
    """

    decay_rates: Array
    damping_ratios: Array
    q: Array
    truth: Array

    @property
    def share(self) -> float:
        """Share of the postures that are stable."""
        return float((self.decay_rates > 0.0).mean())

    @property
    def worst(self) -> int:
        """Index of the posture with the slowest decay."""
        return int(self.decay_rates.argmin())

    @property
    def stable(self) -> bool:
        """Whether all are."""
        return bool((self.decay_rates > 0.0).all())


@dataclass(frozen=True, eq=False)
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
        scenarios: What the tests 1 and 2 were evaluated on.
        theorem1: Test 1.
        matrix: Test 2 by family.
        local: Test 3.
        rollouts: Test 4, or None if it was not asked for.
        corners: Values of the uncertain coordinates of each true robot, shape (k, d).
        gravity_error: Largest gravity torque in the region that the controller neither
            compensates nor can learn [N m or N]. All tests but the rollouts take it as zero.
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
    seed: int

    @property
    def gravity_is_exact(self) -> bool:
        """Whether gravity is compensated, or can be learnt, to within 1e-5 N m."""
        return self.gravity_error <= _EXACT

    @property
    def certified_by(self) -> str | None:
        """The strongest test that certifies the region: "theorem1", "matrix", or None."""
        if not self.gravity_is_exact:
            return None
        if self.theorem1.holds:
            return "theorem1"
        return "matrix" if any(test.certified for test in self.matrix.values()) else None

    def describe_truth(self, index: int) -> str:
        """Which true robot the index of a scenario's `truth` means."""
        if isinstance(self.truth, Uncertainty) and self.truth.d > 0:
            return self.truth.describe(self.corners[index])
        return "the true robot"

    def lines(self) -> list[tuple[str, str, str]]:
        """The table: test, verdict, and the figures it rests on."""
        first, checked = self.theorem1, next(iter(self.matrix.values())).checked
        verdict = "certified" if first.holds else "not certified"
        sign = "<" if first.holds else ">="
        rows = []
        if not self.gravity_is_exact:
            rows.append(
                (
                    "0 gravity",
                    "not exact",
                    f"off by up to {self.gravity_error:.3g} N m: the error does not go to 0 but to "
                    "where K_p makes up for it, unless gravity is learnt (AdaptiveGravity)",
                )
            )
        rows += [
            (
                "1 Theorem 1",
                verdict,
                f"p = {first.p:.3g} {sign} {max(first.allowed_p, 0.0):.3g} allowed at "
                f"alpha = {first.alpha:.3g}/s; worst p with "
                f"{self.describe_truth(int(self.scenarios.truth[first.worst['p']]))}",
            )
        ]
        titles = {"paper": "paper's weights", "free": "free potential", "wide": "widened"}
        for family, test in self.matrix.items():
            worst = self.describe_truth(int(self.scenarios.truth[test.worst]))
            if test.certified:
                text = f"at most {100 * test.violating_at_most:.2g} % of the region violates it"
            else:
                text = f"holds in {100 * test.share:.3g} % of the postures"
            if test.margin > 0.0 and test.violations:
                text = f"violated in {test.violations} of {checked} further postures"
            rows.append(
                (
                    f"2 matrix form, {titles[family]}",
                    "certified" if test.certified else "not certified",
                    f"margin {test.margin:.3g}; {text}; worst with {worst}",
                )
            )
        local = self.local
        rows.append(
            (
                "3 local",
                "stable" if local.stable else "not stable",
                f"at {100 * local.share:.4g} % of {len(local.q)} postures; slowest decay "
                f"{local.decay_rates.min():.3g}/s, damping ratio {local.damping_ratios.min():.2g}; "
                f"worst with {self.describe_truth(int(local.truth[local.worst]))}",
            )
        )
        if self.rollouts is not None:
            rows.append(("4 rollouts", "", str(self.rollouts)))
        return rows

    def __str__(self) -> str:
        rows = self.lines()
        widths = [max(len(row[k]) for row in rows) for k in range(2)]
        table = "\n".join(
            f"{test:<{widths[0]}}  {verdict:<{widths[1]}}  {text}" for test, verdict, text in rows
        )
        checked = next(iter(self.matrix.values())).checked
        return (
            f"{self.controller!r}\non {self.region!r}: {len(self.scenarios)} postures, "
            f"{checked} further ones to check, seed {self.seed}\n{table}"
        )

    def summary(self) -> dict[str, Any]:
        """What goes into summary.json."""
        first = self.theorem1
        low, high = first.alpha_range
        return {
            "robot": self.controller.task.robot.name,
            "region": repr(self.region),
            "postures": len(self.scenarios),
            "seed": self.seed,
            "certified_by": self.certified_by,
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
        region: Where to look; the joint limits without near-singular postures by default.
        target: x_d, shape (n_x,), for the one target; by default the values of other postures of
            the region, so that the report speaks of all targets within it.
        postures: How many to draw, ≥ 20.
        runs: How many rollouts to add; none by default.
        seed: Of all drawing, ≥ 0.
        executor: Where the rollouts run; here by default.
        progress: Called with what is being done and the share of it.

    Raises:
        InvalidInputError: Law (5) or a posture torque, an empty region, a target that no posture of a
            true robot attains, or numbers out of range.
    """
    require("controller", controller, SetpointController, "a SetpointController")
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
    x_d = None if target is None else plants[0].sensor.target(target)
    rng = np.random.default_rng(seed)
    tell = progress or (lambda what, share: None)
    sampler = Sampler(controller, plants, region, x_d)
    targets = None if x_d is None else attaining(sampler, rng)
    half = postures // 2
    scenarios = sampler.draw(half, rng, lambda k: tell("postures", k / postures))
    fresh = sampler.draw(postures - half, rng, lambda k: tell("postures", (half + k) / postures))
    setting = setting_of(controller, plants[0])

    scenarios = _refine_constants(sampler, scenarios, setting, rng)
    form, check = MatrixForm(scenarios, setting), MatrixForm(fresh, setting)
    chosen: dict[Family, Weights] = {}
    for k, family in enumerate(setting.families):
        tell("matrix form", k / len(setting.families))
        form, best = _refine(sampler, form, family, rng)
        chosen[family] = best.weights
    scenarios = form.scenarios
    matrix: dict[Family, MatrixTest] = {}
    for family, weights in chosen.items():
        violations = int((check.margins(weights) <= 0.0).sum())
        matrix[family] = MatrixTest(family, weights, form.margins(weights), len(fresh), violations)
    tell("local", 0.0)
    local = local_test(controller, scenarios if targets is None else targets, setting)
    outcome = None
    if runs:
        if uncertainty is None:
            raise InvalidInputError(
                "runs needs truth to be an Uncertainty, from which rollouts draw true robots, "
                f"got {truth!r}",
                given=truth,
            )
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
        truth if uncertainty is not None else plants[0],
        region,
        x_d,
        scenarios,
        theorem1(scenarios, setting),
        matrix,
        local,
        outcome,
        corners,
        gravity_error(controller, plants, scenarios.q[:: max(1, len(scenarios) // 20)]),
        seed,
    )


def require_law(controller: SetpointController) -> None:
    """Refuse controllers whose closed loop is neither eq. (9) nor that of (28), (29)."""
    if controller.velocity is not None or controller.posture is not None:
        raise InvalidInputError(
            "the conditions are those of the laws (6) and (28) without a posture torque, got "
            f"{controller!r} with velocity = {controller.velocity!r} and "
            f"posture = {controller.posture!r}",
            given=controller,
        )


def true_plants(
    controller: SetpointController, truth: Plant | Robot | Uncertainty
) -> tuple[Array, list[Plant]]:
    """The corners (k, d) of a set of true robots and their plants; of a single one, that."""
    if isinstance(truth, Uncertainty):
        corners = truth.corners()
        return corners, [truth.plant(values) for values in corners]
    if isinstance(truth, Robot):
        truth = Plant(truth, controller.task.on(truth))
    require("truth", truth, Plant, "a Plant, a Robot or an Uncertainty")
    return np.zeros((1, 0)), [truth]


def default_region(controller: SetpointController) -> Region:
    """The joint limits of the believed robot, without postures where Ĵ is near singular."""
    task = controller.task
    return RegularPart(JointBox(task.robot), task, _REGULAR * vanishing(task))


def setting_of(controller: SetpointController, plant: Plant) -> Setting:
    """Gains and damping of a closed loop."""
    kp, kv, damping = controller.diagonals
    alpha = None if controller.adaptation is None else controller.adaptation.alpha
    return Setting(kp, kv, damping + plant.friction, controller.saturation.c_bar, alpha)


def local_test(controller: SetpointController, scenarios: Scenarios, setting: Setting) -> LocalTest:
    """Eigenvalues of the closed loop with each posture (of the first thousand) as a target."""
    few = scenarios.take(np.arange(min(len(scenarios), _LOCAL)))
    n, m = few.J.shape[-1], few.J.shape[-2]
    A = law.closed_loop_matrix(few.M, few.J, few.J_hat, setting.kp, setting.kv, setting.B)
    still = np.full(len(few), n - m)
    learning = controller.adaptation
    if learning is not None:
        Z = np.array([learning.regressor.Z(q) for q in few.q])
        still += learning.regressor.p - np.linalg.matrix_rank(Z)
        pinv, _ = law.cross_weight_pinv(few.J_hat, few.dJ_hat)
        A = np.array(
            [
                law.adaptive_closed_loop_matrix(
                    *at, setting.kp, setting.kv, setting.B, Z_at, learning.L, learning.alpha
                )
                for *at, Z_at in zip(few.M, few.J, few.J_hat, pinv, Z, strict=True)
            ]
        )
    values = np.linalg.eigvals(A)
    order = np.argsort(np.abs(values), axis=-1)
    values = np.take_along_axis(values, order, axis=-1)
    values[np.arange(values.shape[-1]) < still[:, None]] = -np.inf  # the equilibria's own zeros
    moving = np.where(np.isfinite(values), values, -1.0)
    ratios = -moving.real / np.maximum(np.abs(moving), 1e-300)
    return LocalTest(-values.real.max(axis=-1), ratios.min(axis=-1), few.q, few.truth)


def attaining(sampler: Sampler, rng: np.random.Generator) -> Scenarios:
    """Postures that attain the target, for each true robot at least one.

    Raises:
        InvalidInputError: The target is out of reach of a true robot.
    """
    x_d = sampler.target
    if x_d is None:
        raise InvalidInputError("a target must be given", given=None)
    found: list[tuple[int, Array]] = []
    for index, plant in enumerate(sampler.plants):
        starts = sampler.region.sample(_STARTS, rng)
        postures = [attain(plant.sensor, x_d, q) for q in starts]
        attained = [(index, q) for q in postures if q is not None]
        within = [(index, q) for _, q in attained if sampler.region.contains(q)]
        if not attained:
            raise InvalidInputError(
                f"target must be within reach of every true robot, got {x_d.tolist()}, which no "
                f"posture of {plant.robot!r} was found to attain",
                given=x_d,
            )
        if not within:
            raise InvalidInputError(
                f"target must be attained by a posture of the region for every true robot, got "
                f"{x_d.tolist()}, which {plant.robot.name} attains outside {sampler.region!r} only",
                given=x_d,
            )
        found += within
    truths, postures_found = zip(*found, strict=True)
    return sampler.at(np.array(truths), np.array(postures_found))


def gravity_error(
    controller: SetpointController, plants: Sequence[Plant], postures: Array
) -> float:
    """Largest gravity torque that the controller does not compensate, nor learn to [N m or N]."""
    if controller.adaptation is not None:
        regressor = controller.adaptation.regressor
        worst = 0.0
        for plant in plants:
            residual = regressor.fit(plant.robot)[1]
            worst = max(
                worst, residual * max(float(np.abs(plant.dynamics.g(q)).max()) for q in postures)
            )
        return worst
    gravity = controller.gravity
    return max(
        float(np.abs(gravity.torque(q) - plant.dynamics.g(q)).max())  # type: ignore[union-attr]
        for plant in plants
        for q in postures
    )


def _refine_constants(
    sampler: Sampler, scenarios: Scenarios, setting: Setting, rng: np.random.Generator
) -> Scenarios:
    """Look closer around the worst scenario of each constant of Theorem 1."""
    values = constants(scenarios, setting)
    for name in CONSTANTS:
        for _ in range(_REFINED):
            k = int(badness(name, values[name]).argmax())
            nearby = sampler.near(scenarios, k, _NEAR, _CLOSER, rng)
            found = constants(nearby, setting)
            worst = badness(name, found[name]).argmax(keepdims=True)
            if badness(name, found[name])[worst] <= badness(name, values[name])[k]:
                break
            scenarios = scenarios.join(nearby.take(worst))
            values = {key: np.append(values[key], found[key][worst]) for key in values}
    return scenarios


def _refine(
    sampler: Sampler, form: MatrixForm, family: Family, rng: np.random.Generator
) -> tuple[MatrixForm, Best]:
    """Choose a Lyapunov function, with a closer look around its worst scenario."""
    best = best_weights(form, family)
    worst, k, least = form.scenarios, int(best.margins.argmin()), float(best.margins.min())
    found = []
    for _ in range(_REFINED):
        worst = sampler.near(worst, k, _NEAR, _CLOSER, rng)
        nearby = MatrixForm(worst, form.setting)
        margins = nearby.margins(best.weights)
        k = int(margins.argmin())
        if margins[k] > least - _NOTABLE:
            break
        least = float(margins[k])
        found.append(nearby.take(np.array([k])))
    for nearby in found:
        form = form.join(nearby)
    return form, best_weights(form, family, best) if found else best


def _upper_bound(violations: int, checked: int) -> float:
    """Clopper–Pearson: one-sided upper bound of a share."""
    from scipy.stats import beta

    if violations >= checked:
        return 1.0
    return float(beta.ppf(_CONFIDENCE, violations + 1, checked - violations))


def _number(value: float) -> float | None:
    """A number as JSON knows it: None where it is not finite."""
    return float(value) if np.isfinite(value) else None
