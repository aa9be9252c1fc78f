"""`stability_map`: where in the plane of two parameters each of the four tests passes."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from approxjac.controllers import Gains, SetpointController
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.formatting import rows, wrapped
from approxjac.stability.certificates.certificate import margin
from approxjac.stability.errors.coordinates import spoken
from approxjac.stability.errors.region import Region
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import SHARED, ClosedLoop, usual_region
from approxjac.stability.loop.local import local_test
from approxjac.stability.loop.samples import Samples
from approxjac.stability.loop.target_samples import Targets
from approxjac.stability.loop.visibility import UnattainedError
from approxjac.stability.rollout.rollout_map import (
    PLACES,
    Shares,
    gains_at,
    is_drawn,
    shares_over_parameters,
    shares_over_runs,
)
from approxjac.validation import Array, as_array, as_integer, require

PARAMETERS = {
    "error": "scale of the errors [–]",
    "a": "gain ratio k_p / k_v, k_v kept [1/s]",
    "kv": "K_v and K_p, times the controller's [–]",
    "damping": "added damping B_c, times the controller's [–]",
}
"""Parameters that a map can have along its axes."""

By = Literal["tests", "rollouts"]
_POOL = 200  # targets that the hard ones are chosen from


@dataclass(frozen=True, eq=False, repr=False)
class StabilityMap:
    """Verdicts of the tests over a grid of two parameters.

    `view.plot_shares(m.x, m.y, m.rollouts, labels=m.names)` draws one that is by rollouts.

    Attributes:
        names: Of the two parameters, along x and y.
        x: Values of the first, shape (N_x,).
        y: Values of the second, shape (N_y,).
        decay_rate: Test 3: slowest decay over some targets, hard ones among them, and the true
            robots, shape (N_y, N_x) [1/s].
        targets: Number of these targets.
        coarse_x: Values where the tests 2 and 4 were made, shape (n_x,).
        coarse_y: Shape (n_y,).
        theorem1: Test 1: margin, shape (N_y, N_x), at least −1; NaN where it was not made.
        matrix: Test 2: margin, shape (n_y, n_x), at least −1.
        rollouts: Test 4: share of the runs that converge, shape (n_y, n_x); NaN where none were
            made.
        intervals: 95 % interval for the probability to converge, after Clopper and Pearson (1934),
            shape (n_y, n_x, 2).
        runs: Number of runs, shape (n_y, n_x).
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
    intervals: Array
    runs: Array

    def __repr__(self) -> str:
        if self.targets == 0:
            n, width = self.runs, np.ptp(self.intervals, axis=-1)
            return (
                f"StabilityMap({' × '.join(self.names)}: {n.sum()} runs at {n.shape} points, "
                f"{100 * np.nansum(self.rollouts * n) / max(1, n.sum()):.1f} % converged; 95 % "
                f"intervals at most {100 * width.max():.2g} % wide)"
            )
        stable, size = 100.0 * (self.decay_rate > 0.0).mean(), self.decay_rate.shape
        return f"StabilityMap({' × '.join(self.names)}: {stable:.3g} % of {size} locally stable)"

    def __str__(self) -> str:
        over = " and ".join(spoken(name) for name in self.names)
        if self.targets == 0:
            n, width = self.runs, np.ptp(self.intervals, axis=-1)
            good = 100 * np.nansum(self.rollouts * n) / max(1, n.sum())
            told = {
                "points": f"{n.shape[1]} by {n.shape[0]}, {n.sum()} runs in all",
                "sure": f"95 % intervals of points are at most {100 * width.max():.2g} % wide",
            }
            return "\n".join([*wrapped(f"converged: {good:.1f} % over {over}"), *rows(told, 2)])
        j, i = self.decay_rate.shape
        told = {"near targets": f"stable at {_points(self.decay_rate)}"}
        if self.coarse_x.size:
            told |= {
                "Theorem 1": f"holds at {_points(self.theorem1)}",
                "matrix form": f"holds at {_points(self.matrix)}; between these its boundary is "
                "interpolated",
            }
        if self.runs.any():
            told["rollouts"] = f"all converge at {_points(self.rollouts - 1.0 + 1e-9)}"
        return "\n".join([*wrapped(f"map over {over}: {i} by {j} points"), *rows(told, 2)])


def _points(values: Array) -> str:
    """Return at how many of the points a value is positive."""
    return f"{int((values > 0.0).sum())} of {values.size} points"


def stability_map(
    controller: SetpointController,
    uncertainty: Uncertainty,
    region: Region | None = None,
    *,
    names: tuple[str, str],
    x: Sequence[float] | Array,
    y: Sequence[float] | Array,
    by: By = "tests",
    target: Sequence[float] | Array | None = None,
    targets: int = 16,
    coarse: int = 8,
    configurations: int = 100,
    runs: int | None = None,
    duration: float = 10.0,
    seed: int = 0,
    executor: Executor | None = None,
    progress: Callable[[float], None] | None = None,
    **options: Any,
) -> StabilityMap:
    """Make the four tests over a grid of two parameters, or rollouts over these or what they draw.

    Tests 1 and 3 at every point of the grid, the others at every point of a coarser one with the
    same ends.

    By rollouts it is test 4 alone, at every point. Over two parameters each point has the same
    runs. Over the errors (`uncertainty.names`) and the place of the believed tip at the start ("x",
    "y", "z" [m]) there are so many runs in all, drawn from the whole set and the whole region: each
    counts at the point that it is nearest to.

    Args:
        controller: The controller, whose gains the parameters change; by rollouts over anything
            else it may be any `Controller`.
        uncertainty: The errors at scale 1.
        region: Where to look; see `stability_report`.
        names: The two parameters, of "error", "a", "kv" and "damping" (see `PARAMETERS`); by
            rollouts also two errors, places, or one of each.
        x: Values of the first: numbers that grow, > 0 of gains, ≥ 0 of "error".
        y: Values of the second, alike.
        by: "tests" or "rollouts".
        target: x_d, shape (n_x,); see `stability_report`.
        targets: Configurations that test 3 takes as targets, ≥ 2: half of them the worst of 200
            with the controller's own gains, the true robots in turn.
        coarse: At most so many values of each parameter where tests 2 and 4 are made, ≥ 2: the
            first, the last and the controller's own among them; 0 makes test 3 alone.
        configurations: How many to draw for tests 1 and 2.
        runs: Rollouts at each coarse point, by default none; or by rollouts at each point, on
            average over what is drawn, by default 100.
        duration: Of a rollout [s].
        seed: Of all drawing.
        executor: Where the rollouts run; see `rollouts`.
        progress: Called with the share that is done.
        options: Others of `rollouts`, such as dt, tolerance, sensing, engine, folder.

    Raises:
        InvalidInputError: Values that are no growing numbers > 0 (≥ 0 of "error"), twice the same
            parameter, one of gains and one of what is drawn, or what `stability_report` or
            `rollouts` refuses.
        UnknownNameError: No such parameter, or no such kind of map.
    """
    require("uncertainty", uncertainty, Uncertainty, "an Uncertainty")
    if by not in get_args(By):
        raise UnknownNameError("by", by, "stability_map", get_args(By))
    known = labels(uncertainty) if by == "rollouts" else PARAMETERS
    for name in names:
        if name not in known:
            likely = 'errors and places need by="rollouts"' if name in labels(uncertainty) else ""
            raise UnknownNameError("parameter", name, "the map", known, likely)
    if len(set(names)) != 2:
        raise InvalidInputError(f"names must be two different parameters, got {names}", given=names)
    xs, ys = (_values(name, values) for name, values in zip(names, (x, y), strict=True))
    tell = progress or (lambda share: None)
    if by == "rollouts":
        region = usual_region(controller.task) if region is None else region
        runs = as_integer("runs", 100 if runs is None else runs, 1)
        total = runs * xs.size * ys.size
        made = shares_over_runs if is_drawn(names, uncertainty) else shares_over_parameters
        shares = made(
            controller, uncertainty, region, names, xs, ys, target=target, runs=runs,
            duration=duration, seed=seed, executor=executor,
            progress=lambda done: tell(done / total), **options,
        )  # fmt: skip
        none = np.full((len(ys), len(xs)), np.nan)
        return StabilityMap(names, xs, ys, none, 0, xs, ys, none, none, *shares)
    runs = 0 if runs is None else runs
    loop = ClosedLoop(controller, uncertainty, region, target)
    loop.require_gravity()
    own = own_values(controller)
    few = tuple(_some(v, coarse, own[name]) for name, v in zip(names, (xs, ys), strict=True))
    rank_is_lost: list[bool] = []  # whether Ĵ loses rank in the region: no parameter changes that

    # the true robots and what is drawn change with "error" only, which is in the outer loop
    @functools.lru_cache(maxsize=1)
    def drawn(scale: float) -> tuple[ClosedLoop, Samples]:
        scaled = loop.scaled(scale)
        return scaled, scaled.draw(configurations, np.random.default_rng(seed), inside=SHARED)

    @functools.lru_cache(maxsize=1)
    def hard_targets(scale: float) -> Targets:
        scaled = loop.scaled(scale)
        truths, pool = scaled.targets(max(targets, _POOL), np.random.default_rng(seed))
        rates = local_test(scaled, truths, pool).decay_rates
        hard = np.argsort(rates, kind="stable")[: targets // 2]
        others = np.setdiff1d(np.arange(len(rates)), hard)
        chosen = np.concatenate([hard, others[: targets - targets // 2]])
        return scaled.linearised(truths[chosen], pool[chosen])

    def result(kind: str, scale: float, gains: Gains) -> float:
        if kind == "local":
            rates, _ = hard_targets(scale).rates(loop.with_gains(gains).diagonals)
            return float(rates.min())
        scaled, samples = drawn(scale)
        if not rank_is_lost:
            rank_is_lost.append(scaled.singular_configuration(samples) is not None)
        if rank_is_lost[0]:
            return -1.0
        return max(-1.0, margin(kind, samples, scaled.with_gains(gains).setting))

    grids = {"local": (xs, ys), "theorem1": (xs, ys), "matrix": few}
    costs = {"local": 1, "theorem1": bool(coarse), "matrix": 60}  # about, ms
    per_run = 5  # ms, too
    total = sum(costs[kind] * len(a) * len(b) for kind, (a, b) in grids.items())
    total += per_run * runs * len(few[0]) * len(few[1])
    done, found = 0, {}
    for kind, (first, second) in grids.items():
        found[kind] = np.full((len(second), len(first)), np.nan)
        points = itertools.product(range(len(second)), range(len(first)) if costs[kind] else ())
        for j, i in sorted(points, key=lambda point: point[names[0] == "error"]):
            at = {names[0]: float(first[i]), names[1]: float(second[j])}
            scale = at.get("error", 1.0)
            try:
                found[kind][j, i] = result(kind, scale, gains_at(controller, at))
            except UnattainedError:
                if scale <= 1.0:
                    raise  # grown errors may put the target out of reach, the given ones not
            done += costs[kind]
            tell(done / total)
    shares = Shares.of(*np.zeros((2, len(few[1]), len(few[0])), dtype=int))
    if runs and coarse:
        shares = shares_over_parameters(
            controller, uncertainty, loop.region, names, few[0], few[1], target=loop.target,
            runs=runs, duration=duration, seed=seed, executor=executor,
            progress=lambda ran: tell((done + per_run * ran) / total), **options,
        )  # fmt: skip
    return StabilityMap(
        names, xs, ys, found["local"], targets, few[0], few[1], found["theorem1"], found["matrix"],
        *shares,
    )  # fmt: skip


def own_values(controller: SetpointController) -> dict[str, float]:
    """Return parameter → where a controller and its errors are themselves."""
    kp, kv, _ = controller.diagonals
    return {"error": 1.0, "a": float(np.mean(kp / kv)), "kv": 1.0, "damping": 1.0}


def _some(values: Array, count: int, own: float) -> Array:
    """Return at most `count` of the values: the ends, and the own one if it is among them."""
    at = np.unique(np.linspace(0, len(values) - 1, count).round().astype(int))
    k = np.flatnonzero(values == own)
    if len(k) and len(at) > 2 and k[0] not in at:
        at[1 + np.abs(at[1:-1] - k[0]).argmin()] = k[0]
    return np.sort(values[at])


def labels(uncertainty: Uncertainty) -> dict[str, str]:
    """Return name → label of all parameters that a map by rollouts can have along its axes."""
    errors = zip(uncertainty.names, uncertainty.units, strict=True)
    places = {name: f"{name} of the believed tip at the start [m]" for name in PLACES}
    return PARAMETERS | places | {name: f"true {name} [{unit}]" for name, unit in errors}


def _values(name: str, given: Sequence[float] | Array) -> Array:
    values = as_array(f"values of {name}", given, (np.size(given),))
    wanted, low = "", -np.inf
    if name in PARAMETERS:
        wanted, low = (" >= 0", 0.0) if name == "error" else (" > 0", np.nextafter(0.0, 1.0))
    if len(values) < 2 or values[0] < low or not (np.diff(values) > 0.0).all():
        raise InvalidInputError(
            f"values of {name} must be at least two growing numbers{wanted}, got {values.tolist()}",
            given=given,
        )
    return values
