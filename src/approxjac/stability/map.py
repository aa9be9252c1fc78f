"""`stability_map`: where in the plane of two parameters each of the four tests passes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from approxjac.controllers import Gains, SetpointController
from approxjac.controllers.setpoint import require_setpoint
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.stability.closed_loop import (
    default_region,
    require_gravity,
    require_law,
    setting_of,
    true_plants,
)
from approxjac.stability.matrix_form import MatrixForm, first_that_passes
from approxjac.stability.region import Region
from approxjac.stability.rollouts import rollouts
from approxjac.stability.samples import Sampler, Scenarios, Targets
from approxjac.stability.singularity import singular_posture
from approxjac.stability.targets import local_test
from approxjac.stability.theorem1 import theorem1
from approxjac.stability.uncertainty import Uncertainty
from approxjac.stability.visibility import UnattainedError
from approxjac.validation import Array, as_array, require

PARAMETERS: Mapping[str, str] = MappingProxyType(
    {
        "error": "scale of the errors [–]",
        "a": "gain ratio k_p / k_v, k_v kept [1/s]",
        "kv": "K_v and K_p, times the controller's [–]",
        "damping": "added damping B_c, times the controller's [–]",
    }
)
"""What a map can have along its axes."""

_POOL = 200  # targets that the hard ones are chosen from


@dataclass(frozen=True, eq=False, repr=False)
class StabilityMap:
    """What the tests say over a grid of two parameters.

    Attributes:
        names: Of the two parameters, along x and y.
        x: Values of the first, shape (N_x,).
        y: Values of the second, shape (N_y,).
        decay_rate: Test 3: slowest decay over some targets, hard ones among them, and the true
            robots, shape (N_y, N_x) [1/s].
        targets: How many targets that were.
        coarse_x: Values where the tests 2 and 4 were made, shape (n_x,).
        coarse_y: Shape (n_y,).
        theorem1: Test 1: margin, shape (N_y, N_x), at least −1; NaN where it was not made.
        matrix: Test 2: margin, shape (n_y, n_x), at least −1.
        rollouts: Test 4: share of the runs that converge, shape (n_y, n_x); NaN where none were
            made.
    """

    names: tuple[str, str]
    x: Array
    y: Array
    decay_rate: Array
    targets: int
    coarse_x: Array
    coarse_y: Array
    theorem1: Array
    matrix: Array
    rollouts: Array

    def __repr__(self) -> str:
        stable = float((self.decay_rate > 0.0).mean())
        certified = float((self.matrix > 0.0).mean())
        grid = f"{self.names[0]} {self.x[0]:g} to {self.x[-1]:g}"
        grid += f", {self.names[1]} {self.y[0]:g} to {self.y[-1]:g}"
        return (
            f"StabilityMap({grid}: locally stable in {100 * stable:.3g} %, "
            f"certified by the matrix form in {100 * certified:.3g} %)"
        )


def stability_map(
    controller: SetpointController,
    uncertainty: Uncertainty,
    region: Region | None = None,
    *,
    names: tuple[str, str],
    x: Sequence[float] | Array,
    y: Sequence[float] | Array,
    target: Sequence[float] | Array | None = None,
    targets: int = 16,
    coarse: int = 8,
    postures: int = 100,
    runs: int = 0,
    duration: float = 10.0,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Callable[[float], None] | None = None,
) -> StabilityMap:
    """Make the four tests over a grid of two parameters.

    Tests 1 and 3 at every point of the grid, the others at every point of a coarser one with the
    same ends.

    Args:
        controller: The controller, whose gains the parameters change.
        uncertainty: The errors at scale 1.
        region: Where to look; see `stability_report`.
        names: The two parameters, of "error", "a", "kv" and "damping" (see `PARAMETERS`).
        x: Values of the first: numbers that grow, > 0 (≥ 0 of "error").
        y: Values of the second, alike.
        target: x_d, shape (n_x,); see `stability_report`.
        targets: Postures that test 3 takes as targets, ≥ 2: half of them the worst of 200 with the
            controller's own gains, the true robots in turn.
        coarse: Values of each parameter where tests 2 and 4 are made, ≥ 2; 0 makes test 3 alone.
        postures: Postures for tests 1 and 2.
        runs: Rollouts at each coarse point.
        duration: Of a rollout [s].
        seed: Of all drawing.
        executor: Where the rollouts run; see `rollouts`.
        progress: Called with the share that is done.

    Raises:
        InvalidInputError: Values that are no growing numbers > 0 (≥ 0 of "error"), twice the same
            parameter, or what `stability_report` refuses.
        UnknownNameError: No such parameter.
    """
    require_setpoint(controller)
    require("uncertainty", uncertainty, Uncertainty, "an Uncertainty")
    require_law(controller)
    for name in names:
        if name not in PARAMETERS:
            raise UnknownNameError("parameter", name, "the map", PARAMETERS)
    if len(set(names)) != 2:
        raise InvalidInputError(f"names must be two different parameters, got {names}", given=names)
    region = default_region(controller) if region is None else region
    require("region", region, Region, "a Region, such as JointBox(robot)")
    require_gravity(controller, uncertainty, region)
    grid = _Grid(controller, uncertainty, region, target, seed)
    xs, ys = (_values(name, values) for name, values in zip(names, (x, y), strict=True))
    few_x, few_y = (np.interp(np.linspace(0, 1, coarse), np.linspace(0, 1, len(v)), v)
                    for v in (xs, ys))  # fmt: skip
    fine = len(xs) * len(ys)
    costs = {"local": 1, "theorem1": 1, "matrix": 60, "rollouts": 60 * runs}  # roughly, in ms
    total = fine + (fine + coarse**2 * (costs["matrix"] + costs["rollouts"]) if coarse else 0)
    done = 0

    def over(
        first: Array, second: Array, kind: str, test: Callable[[Mapping[str, float]], float]
    ) -> Array:
        nonlocal done
        found = np.full((len(second), len(first)), np.nan)
        # the true robots change with "error" only: keep it in the outer loop
        for i, j in grid.order(names, len(first), len(second)):
            at = {names[0]: float(first[i]), names[1]: float(second[j])}
            try:
                found[j, i] = test(at)
            except UnattainedError:
                if at.get("error", 1.0) <= 1.0:
                    raise  # grown errors may put the target out of reach, the given ones not
            done += costs[kind]
            if progress is not None:
                progress(done / total)
        return found

    decay = over(xs, ys, "local", lambda at: grid.decay_rate(at, targets))
    first = np.full_like(decay, np.nan)
    if coarse:
        first = over(xs, ys, "theorem1", lambda at: grid.theorem1(at, postures))
    second = over(few_x, few_y, "matrix", lambda at: grid.matrix(at, postures))
    shares = np.full_like(second, np.nan)
    if runs:
        shares = over(
            few_x, few_y, "rollouts", lambda at: grid.converging(at, runs, duration, executor)
        )
    return StabilityMap(names, xs, ys, decay, targets, few_x, few_y, first, second, shares)


class _Grid:
    """The closed loops of a map, with the true robots of one scale of the errors kept."""

    def __init__(
        self,
        controller: SetpointController,
        uncertainty: Uncertainty,
        region: Region,
        target: Sequence[float] | Array | None,
        seed: int,
    ) -> None:
        self._base, self._errors, self._region, self._seed = controller, uncertainty, region, seed
        self._target = None if target is None else controller.task.target(target)
        # those of one scale of the errors, and what they are for
        self._drawn: tuple[object, Scenarios, Sampler] | None = None
        self._hard: tuple[object, Targets, Sampler] | None = None
        self._singular: bool | None = None
        self._controllers: dict[tuple[float | None, ...], SetpointController] = {}

    def order(self, names: tuple[str, str], nx: int, ny: int) -> list[tuple[int, int]]:
        """All pairs of indices, those of "error" in the outer loop."""
        if names[0] == "error":
            return [(i, j) for i in range(nx) for j in range(ny)]
        return [(i, j) for j in range(ny) for i in range(nx)]

    def decay_rate(self, at: Mapping[str, float], targets: int) -> float:
        """The slowest decay over targets and true robots [1/s]."""
        hard, sampler = self._targets(at, targets)
        return float(local_test(sampler, hard, self._controller(at)).decay_rates.min())

    def theorem1(self, at: Mapping[str, float], postures: int) -> float:
        """Margin of test 1, at least −1."""
        scenarios, sampler = self._scenarios(at, postures)
        if self._is_singular(scenarios, sampler):
            return -1.0
        setting = setting_of(self._controller(at), sampler.plants[0])
        return max(-1.0, theorem1(scenarios, setting).margin)

    def matrix(self, at: Mapping[str, float], postures: int) -> float:
        """Margin of test 2, at least −1."""
        scenarios, sampler = self._scenarios(at, postures)
        if self._is_singular(scenarios, sampler):
            return -1.0
        setting = setting_of(self._controller(at), sampler.plants[0])
        return max(-1.0, float(first_that_passes(MatrixForm(scenarios, setting)).margins.min()))

    def converging(
        self, at: Mapping[str, float], runs: int, duration: float, executor: Executor | None
    ) -> float:
        """Share of the rollouts that converge."""
        return rollouts(
            self._controller(at), self._scaled(at), self._region, target=self._target,
            runs=runs, duration=duration, seed=self._seed, executor=executor,
        ).share  # fmt: skip

    def _is_singular(self, scenarios: Scenarios, sampler: Sampler) -> bool:
        """Whether Ĵ loses rank in the region, which no parameter of the map changes."""
        if self._singular is None:
            task = self._base.task
            self._singular = singular_posture(sampler.parts, task, scenarios) is not None
        return self._singular

    def _scaled(self, at: Mapping[str, float]) -> Uncertainty:
        return self._errors.scaled(at.get("error", 1.0))

    def _controller(self, at: Mapping[str, float]) -> SetpointController:
        key = tuple(at.get(name) for name in ("a", "kv", "damping"))
        if key not in self._controllers:
            self._controllers[key] = self._changed(at)
        return self._controllers[key]

    def _changed(self, at: Mapping[str, float]) -> SetpointController:
        base = self._base
        kp, kv, damping = base.diagonals
        factor = at.get("kv", 1.0)
        kv = factor * kv
        kp = at["a"] * kv if "a" in at else factor * kp
        return SetpointController(
            base.task, Gains(kp, kv, at.get("damping", 1.0) * damping), gravity=base.gravity,
            saturation=base.saturation,
        )  # fmt: skip

    def _scenarios(self, at: Mapping[str, float], n: int) -> tuple[Scenarios, Sampler]:
        key = (at.get("error", 1.0), n)
        if self._drawn is None or self._drawn[0] != key:
            sampler, rng = self._sampler(at)
            self._drawn = (key, sampler.draw(n, rng), sampler)
        return self._drawn[1:]

    def _targets(self, at: Mapping[str, float], n: int) -> tuple[Targets, Sampler]:
        key = (at.get("error", 1.0), n)
        if self._hard is None or self._hard[0] != key:
            sampler, rng = self._sampler(at)
            targets = sampler.targets(max(n, _POOL), rng)
            rates = local_test(sampler, targets).decay_rates
            hard = np.argsort(rates, kind="stable")[: n // 2]
            others = np.setdiff1d(np.arange(len(rates)), hard)
            chosen = targets.take(np.concatenate([hard, others[: n - n // 2]]))
            self._hard = (key, chosen, sampler)
        return self._hard[1:]

    def _sampler(self, at: Mapping[str, float]) -> tuple[Sampler, np.random.Generator]:
        _, plants = true_plants(self._base, self._scaled(at))
        sampler = Sampler(self._base, plants, self._region, self._target)
        return sampler, np.random.default_rng(self._seed)


def _values(name: str, given: Sequence[float] | Array) -> Array:
    values = as_array(f"values of {name}", given, (np.size(given),))
    low = 0.0 if name == "error" else np.nextafter(0.0, 1.0)
    if len(values) < 2 or values[0] < low or not (np.diff(values) > 0.0).all():
        wanted = ">= 0" if name == "error" else "> 0"
        raise InvalidInputError(
            f"values of {name} must be at least two growing numbers {wanted}, got "
            f"{values.tolist()}",
            given=given,
        )
    return values
