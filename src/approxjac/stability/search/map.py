"""`StabilityMap`: shares of rollouts that converge over parameters, or over what they draw."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from approxjac.controllers import Gains, SetpointController
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.formatting import percent, rows, wrapped
from approxjac.stability.errors.region import require_setpoint
from approxjac.stability.errors.uncertainty import Uncertainty, spoken
from approxjac.stability.loop.configurations import UnattainedError
from approxjac.stability.rollouts.rollouts import Execution, Rollouts, carried_out, clopper_pearson
from approxjac.stability.rollouts.setting import RolloutSetting, sharing
from approxjac.stability.studied_loop import StudiedLoop
from approxjac.tasks import FrameKinematics
from approxjac.validation import Array, as_array, require

PARAMETERS = {
    "error": "scale of the errors [–]",
    "a": "gain ratio k_p / k_v, k_v kept [1/s]",
    "kv": "K_v and K_p, times the controller's [–]",
    "damping": "added damping B_c, times the controller's [–]",
}
"""Parameters that a map can have along its axes."""
PLACES = ("x", "y", "z")
"""Places of the believed tip at the start [m]."""


@dataclass(frozen=True, eq=False, repr=False)
class StabilityMap:
    """Shares of runs that converge over a grid of one or two parameters.

    `view.plot_shares(m.x, m.y, m.share, labels=m.names)` draws one of two.

    Attributes:
        names: Of the parameters: along x, and along y if there are two.
        values: Of each, shape (N_x,) and (N_y,).
        share: Of the runs at each point that converge, shape (N_y, N_x), or (N_x,); NaN where there
            are none.
        intervals: 95 % interval for the probability to converge, after Clopper and Pearson (1934),
            shape (…, 2).
        runs: Number of runs, as `share`.
        points: Values of the parameters → the runs there; empty where they are of what is drawn.
    """

    names: tuple[str, ...]
    values: tuple[Array, ...]
    share: Array
    intervals: Array
    runs: Array
    points: Mapping[tuple[float, ...], Rollouts] = field(default_factory=dict)

    @property
    def x(self) -> Array:
        """Values of the first parameter, shape (N_x,)."""
        return self.values[0]

    @property
    def y(self) -> Array:
        """Values of the last one, shape (N_y,)."""
        return self.values[-1]

    @property
    def converged(self) -> int:
        """Number of runs that converged."""
        return round(float(np.nansum(self.share * self.runs)))

    def __repr__(self) -> str:
        shape = " by ".join(map(str, reversed(self.runs.shape)))
        return f"StabilityMap({' × '.join(self.names)}: {shape} points, {self.runs.sum()} runs)"

    def __str__(self) -> str:
        n, width = self.runs, np.ptp(self.intervals, axis=-1)
        points = " by ".join(map(str, reversed(n.shape)))
        texts = {
            "points": f"{points}, {n.sum()} runs in all",
            "sure": f"95 % intervals of points are at most {100 * width.max():.2g} % wide",
        }
        if len(self.names) == 1:
            texts |= {f"at {x:.4g}": self._outcome(k) for k, x in enumerate(self.x)}
        elif (made := np.flatnonzero(n)).size:
            share = self.share.ravel()[made]
            for what, k in (("least", made[share.argmin()]), ("most", made[share.argmax()])):
                j, i = np.unravel_index(k, n.shape)
                at = f"at {self.names[0]} {self.x[i]:.3g}, {self.names[1]} {self.y[j]:.3g}"
                texts[what] = f"{at}: {self._outcome(k)}"
        good, total, over = self.converged, int(n.sum()), " and ".join(map(spoken, self.names))
        if self.names[0] not in PARAMETERS:  # or points share what is drawn
            texts["in all"] = _surely(good / max(1, total), total, clopper_pearson(good, total))
        heading = f"converged: {100 * good / max(1, total):.1f} % over {over}"
        return "\n".join([*wrapped(heading), *rows(texts, 2)])

    def _outcome(self, k: int) -> str:
        """Return how the runs of point k ended."""
        interval = self.intervals.reshape(-1, 2)[k]
        return _surely(self.share.ravel()[k], self.runs.ravel()[k], interval)


def _surely(share: float, runs: int, interval: Iterable[float]) -> str:
    low, high = map(percent, interval)
    return f"{percent(share)} % of {runs}, with 95 % confidence {low} to {high} %"


def map_of(
    study: StudiedLoop,
    over: Mapping[str, Sequence[float] | Array],
    n: int,
    execution: Execution,
    tell: Callable[[float], None],
) -> StabilityMap:
    """Return the map of a study over some parameters; see `Study.map`."""
    require("over", over, Mapping, "a dict of one or two parameters and their values")
    if len(over) not in (1, 2):
        raise InvalidInputError(
            f"over must have one or two parameters, got {list(over)}", given=over
        )
    made = _of_what_is_drawn if are_drawn(tuple(over), study.errors) else _of_parameters
    axes = {name: _values(name, each) for name, each in over.items()}
    converged, runs, points = made(study, axes, n, execution, tell)
    pairs = zip(converged.ravel().tolist(), runs.ravel().tolist(), strict=True)
    intervals = np.array([clopper_pearson(good, total) for good, total in pairs])
    intervals = intervals.reshape(*runs.shape, 2)
    share = np.where(runs > 0, converged / np.maximum(runs, 1), np.nan)
    return StabilityMap(tuple(axes), tuple(axes.values()), share, intervals, runs, points)


_Counts = tuple[Any, Any, Mapping[tuple[float, ...], Rollouts]]
"""Converged and all runs, y first, and those at each point."""


def _of_parameters(
    study: StudiedLoop,
    axes: Mapping[str, Array],
    n: int,
    execution: Execution,
    tell: Callable[[float], None],
) -> _Counts:
    """Count runs with other gains, or scales of the errors.

    There are none where grown errors have a camera look elsewhere.
    """
    settings: dict[tuple[float, ...], RolloutSetting] = {}
    scales = axes.get("error", np.ones(1)).tolist()
    errors = {scale: study.errors.scaled(scale) for scale in scales}
    grid = list(itertools.product(*(each.tolist() for each in axes.values())))
    for point in grid:
        at = dict(zip(axes, point, strict=True))
        scale = at.pop("error", 1.0)
        law = _with_gains(study.controller, at) if at else study.controller
        own = replace(study, controller=law, uncertainty=errors[scale]).setting()
        if scale <= 1.0 or _is_seen(own, n):
            settings[point] = own.with_engine(execution.engine, n)
    together = sharing([*settings.values()]) if settings else []
    columns = carried_out(together, n, None, execution, tell) if together else []
    points = {
        point: Rollouts(each, setting)
        for (point, setting), each in zip(settings.items(), columns, strict=True)
    }
    counts = [(points[at].n_converged, points[at].n) if at in points else (0, 0) for at in grid]
    shape = [each.size for each in axes.values()]
    converged, runs = (np.reshape(each, shape).T for each in zip(*counts, strict=True))
    return converged, runs, points


def _of_what_is_drawn(
    study: StudiedLoop,
    axes: Mapping[str, Array],
    n: int,
    execution: Execution,
    tell: Callable[[float], None],
) -> _Counts:
    """Count runs by what was drawn: true values, or the place of the start.

    A run counts at the point that it is nearest to, but not beyond half a step from the ends.
    """
    uncertainty, shape = study.errors, tuple(each.size for each in axes.values())
    many = study.rollouts(
        n * int(np.prod(shape)), execution=execution, progress=lambda _, share: tell(share)
    )
    robot = uncertainty.belief()
    tip = FrameKinematics(robot, robot.tip_or(None))
    cells = []
    for name, each in axes.items():
        if name in PLACES:
            drawn = np.array([tip.position(q)[PLACES.index(name)] for q in many.columns["q0"]])
        else:
            drawn = many.columns["values"][:, uncertainty.names.index(name)]
        cells.append(np.searchsorted(_edges(each), drawn) - 1)
    inside = np.all([(k >= 0) & (k < N) for k, N in zip(cells, shape, strict=True)], axis=0)
    counts = np.zeros((2, *shape), dtype=int)
    for row, counted in zip(counts, (inside & many.columns["converged"], inside), strict=True):
        np.add.at(row, tuple(k[counted] for k in cells), 1)
    return counts[0].T, counts[1].T, {}


def _with_gains(controller: Controller, at: Mapping[str, float]) -> SetpointController:
    """Return a controller with the gains of some parameters of a map."""
    law: Any = controller
    require_setpoint(law)
    assert isinstance(law, SetpointController)
    kp, kv, damping = law.diagonals
    times = at.get("kv", 1.0)
    own_kv = times * kv
    own_kp = at["a"] * own_kv if "a" in at else times * kp
    return law.with_gains(Gains(own_kp, own_kv, at.get("damping", 1.0) * damping))


def own_values(controller: SetpointController) -> dict[str, float]:
    """Return parameter → where a controller and its errors are themselves."""
    kp, kv, _ = controller.diagonals
    return {"error": 1.0, "a": float(np.mean(kp / kv)), "kv": 1.0, "damping": 1.0}


def _is_seen(setting: RolloutSetting, runs: int) -> bool:
    """Return whether cameras see something of the region in all runs; whatever else sees all."""
    if setting.uncertainty.camera is None:
        return True
    try:
        for index in range(runs):
            setting.start(index)
    except UnattainedError:
        return False
    return True


def are_drawn(names: Sequence[str], uncertainty: Uncertainty) -> bool:
    """Return whether a map is over what is drawn, and not over parameters; refuse some of each."""
    known = labels(uncertainty)
    for name in names:
        if name not in known:
            raise UnknownNameError("parameter", name, "the map", known)
    drawn = [name not in PARAMETERS for name in names]
    if any(drawn) and not all(drawn):
        raise InvalidInputError(
            "names must all be of what is drawn (x, y, z, and the errors) or all be parameters, "
            f"got {tuple(names)}",
            given=names,
        )
    return all(drawn)


def labels(uncertainty: Uncertainty) -> dict[str, str]:
    """Return name → label of all that a map can have along its axes."""
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


def _edges(values: Array) -> Array:
    middle = 0.5 * (values[1:] + values[:-1])
    return np.array([2.0 * values[0] - middle[0], *middle, 2.0 * values[-1] - middle[-1]])
