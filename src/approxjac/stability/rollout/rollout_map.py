"""Shares of runs that converge over two parameters, for `stability_map(by="rollouts")`."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from approxjac.controllers import Gains, SetpointController
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError
from approxjac.stability.errors.region import Region, require_setpoint
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.visibility import UnattainedError
from approxjac.stability.rollout.rollout_study import Study
from approxjac.stability.rollout.rollouts import as_study, clopper_pearson, rollouts
from approxjac.stability.rollout.sweep import sweep
from approxjac.tasks import FrameKinematics
from approxjac.validation import Array

PLACES = ("x", "y", "z")
"""Places of the believed tip at the start [m]."""


class Shares(NamedTuple):
    """Outcome of the runs at each point.

    Attributes:
        share: Of those that converged, shape (N_y, N_x); NaN where there are none.
        intervals: 95 % interval for the probability to converge, shape (N_y, N_x, 2).
        runs: Number of them, shape (N_y, N_x).
    """

    share: Array
    intervals: Array
    runs: Array

    @classmethod
    def of(cls, converged: Array, runs: Array) -> Shares:
        """Return that of two numbers of runs, both of shape (N_y, N_x)."""
        share = np.where(runs > 0, converged / np.maximum(runs, 1), np.nan)
        pairs = zip(converged.ravel().tolist(), runs.ravel().tolist(), strict=True)
        intervals = np.array([clopper_pearson(int(good), int(n)) for good, n in pairs])
        return cls(share, intervals.reshape(*runs.shape, 2), runs)


def gains_at(controller: SetpointController, at: Mapping[str, float]) -> Gains:
    """Return the gains where some parameters of a map have values."""
    kp, kv, damping = controller.diagonals
    times = at.get("kv", 1.0)
    own_kv = times * kv
    own_kp = at["a"] * own_kv if "a" in at else times * kp
    return Gains(own_kp, own_kv, at.get("damping", 1.0) * damping)


def shares_over_parameters(
    controller: Controller,
    uncertainty: Uncertainty,
    region: Region,
    names: tuple[str, str],
    x: Array,
    y: Array,
    *,
    runs: int,
    target: Sequence[float] | Array | None,
    seed: int,
    **options: Any,
) -> Shares:
    """Return the shares with other gains, or scales of the errors; each point its own runs.

    There are none where grown errors have a camera look elsewhere.
    """
    where: dict[str, Any] = {"target": target, "seed": seed}
    axes = dict(zip(names, (x.tolist(), y.tolist()), strict=True))
    scales = axes.pop("error", [1.0])
    laws: dict[tuple[float, ...], Controller] = {(): controller}
    if axes:
        setpoint: Any = controller
        require_setpoint(setpoint)
        laws = {}
        for values in itertools.product(*axes.values()):
            gains = gains_at(setpoint, dict(zip(axes, values, strict=True)))
            laws[values] = setpoint.with_gains(gains)
    study = as_study(controller, uncertainty, region, engine="python", **where)
    errors = {scale: uncertainty.scaled(scale) for scale in scales}
    reached = {
        scale: each
        for scale, each in errors.items()
        if scale <= 1.0 or _is_seen(replace(study, uncertainty=each), runs)
    }
    found = sweep(laws, reached, region, runs=runs, **where, **options).points if reached else {}
    counts = np.zeros((2, y.size, x.size), dtype=int)
    for j, i in itertools.product(range(y.size), range(x.size)):
        at = dict(zip(names, (float(x[i]), float(y[j])), strict=True))
        point = found.get((tuple(at[name] for name in axes), at.get("error", 1.0)))
        if point is not None:
            counts[:, j, i] = point.n_converged, point.n
    return Shares.of(*counts)


def shares_over_runs(
    controller: Controller,
    uncertainty: Uncertainty,
    region: Region,
    names: tuple[str, str],
    x: Array,
    y: Array,
    *,
    runs: int,
    **options: Any,
) -> Shares:
    """Return the shares by what was drawn: true values, or the place of the start.

    A run counts at the point that it is nearest to, but not beyond half a step from the ends.
    """
    many = rollouts(controller, uncertainty, region, runs=runs * x.size * y.size, **options)
    robot = uncertainty.belief()
    tip = FrameKinematics(robot, robot.tip_or(None))
    cells = []
    for name, values in zip(names, (x, y), strict=True):
        if name in PLACES:
            drawn = np.array([tip.position(q)[PLACES.index(name)] for q in many.columns["q0"]])
        else:
            drawn = many.columns["values"][:, uncertainty.names.index(name)]
        cells.append(np.searchsorted(_edges(values), drawn) - 1)
    i, j = cells
    inside = (i >= 0) & (i < x.size) & (j >= 0) & (j < y.size)
    counts = np.zeros((2, y.size, x.size), dtype=int)
    np.add.at(counts[1], (j[inside], i[inside]), 1)
    good = np.logical_and(inside, many.columns["converged"])
    np.add.at(counts[0], (j[good], i[good]), 1)
    return Shares.of(*counts)


def _is_seen(study: Study, runs: int) -> bool:
    """Return whether cameras see something of the region in all runs; whatever else sees all."""
    if study.uncertainty.camera is None:
        return True
    try:
        for index in range(runs):
            study.start(index)
    except UnattainedError:
        return False
    return True


def is_drawn(names: tuple[str, str], uncertainty: Uncertainty) -> bool:
    """Return whether a map is over what is drawn, and not over parameters.

    Raises:
        InvalidInputError: One of each.
    """
    drawn = [name in PLACES or name in uncertainty.names for name in names]
    if any(drawn) and not all(drawn):
        raise InvalidInputError(
            "names must both be of what is drawn (x, y, z, and the errors) or both be parameters, "
            f"got {names}",
            given=names,
        )
    return all(drawn)


def _edges(values: Array) -> Array:
    middle = 0.5 * (values[1:] + values[:-1])
    return np.array([2.0 * values[0] - middle[0], *middle, 2.0 * values[-1] - middle[-1]])
