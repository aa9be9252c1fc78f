"""`StabilityMap`: shares of rollouts that converge over gains and the size of the errors."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from approxjac.controllers import Gains, SetpointController
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError, require_known
from approxjac.formatting import percent, rows, wrapped
from approxjac.stability.errors.region import require_setpoint
from approxjac.stability.loop.configurations import UnattainedError
from approxjac.stability.rollouts.rollouts import Execution, Rollouts, carried_out
from approxjac.stability.rollouts.setting import RolloutSetting, with_engine
from approxjac.stability.studied_loop import Progress, StudiedLoop, progress_report
from approxjac.validation import Array, as_array, as_integer, require

PARAMETERS = {
    "error": "scale of the errors [–]",
    "a": "gain ratio k_p / k_v, k_v kept [1/s]",
    "kv": "K_v and K_p, times the controller's [–]",
    "damping": "added damping B_c, times the controller's [–]",
}
"""Parameters that a map can have along its axes."""


@dataclass(frozen=True, eq=False, repr=False)
class StabilityMap:
    """Rollouts over a grid of one or two parameters.

    `view.plot_shares(m.x, m.y, m.share, labels=m.names)` draws one of two.

    Attributes:
        names: Names of the parameters: along x, and along y if there are two.
        values: Values of each, shape (N_x,) and (N_y,).
        points: Values of the parameters → the runs there; missing if with scaled errors a camera
            sees nothing.
    """

    names: tuple[str, ...]
    values: tuple[Array, ...]
    points: Mapping[tuple[float, ...], Rollouts]

    @property
    def x(self) -> Array:
        """Values of the first parameter, shape (N_x,)."""
        return self.values[0]

    @property
    def y(self) -> Array:
        """Values of the last one, shape (N_y,)."""
        return self.values[-1]

    @property
    def share(self) -> Array:
        """Share of the runs that converge, (N_y, N_x) or (N_x,); NaN where there are none."""
        return self._each(lambda runs: runs.share)

    @property
    def intervals(self) -> Array:
        """95 % intervals for it, after Clopper and Pearson (1934), shape (…, 2)."""
        low = self._each(lambda runs: runs.interval[0])
        return np.stack([low, self._each(lambda runs: runs.interval[1])], axis=-1)

    def _each(self, of: Callable[[Rollouts], float]) -> Array:
        values = [
            of(self.points[at]) if at in self.points else np.nan
            for at in itertools.product(*(each.tolist() for each in self.values))
        ]
        return np.array(values).reshape([each.size for each in self.values]).T

    def __repr__(self) -> str:
        return f"StabilityMap({' × '.join(self.names)}: {len(self.points)} points)"

    def __str__(self) -> str:
        ranked = sorted(self.points, key=lambda at: self.points[at].share)
        shown = sorted(ranked) if len(self.names) == 1 else [*ranked[:1], *ranked[1:][-1:]]
        texts = {}
        for at in shown:
            named = zip(self.names, at, strict=True)
            runs, point = self.points[at], ", ".join(f"{name} {value:.4g}" for name, value in named)
            low, high = map(percent, runs.interval)
            of_runs = f"{percent(runs.share)} % of {runs.n}"
            texts[point] = f"{of_runs}, with 95 % confidence {low} to {high} %"
        which = "" if len(self.names) == 1 else f"the least and most of {len(self.points)} points "
        heading = f"converged: {which}over {' and '.join(self.names)}"
        return "\n".join([*wrapped(heading), *rows(texts, 2)])


def stability_map(
    study: StudiedLoop,
    over: Mapping[str, Sequence[float] | Array],
    n: int = 100,
    *,
    execution: Execution | None = None,
    progress: Progress = None,
) -> StabilityMap:
    """Carry out rollouts over a grid of one or two parameters.

    Each point has the same n runs, except for the changed parameters.

    Args:
        study: The study.
        over: "error", "a", "kv" or "damping" (see `PARAMETERS`) → increasing values, > 0 for gains,
            ≥ 0 for "error".
        n: Runs at each point.
        execution: Engine and executor.
        progress: Function called with "map" and the share done; True shows a bar.

    Raises:
        InvalidInputError: Values that do not increase, or the errors of rollouts.
        UnknownNameError: No such parameter.
    """
    n, execution = as_integer("n", n, 1), Execution() if execution is None else execution
    require("over", over, Mapping, "a dict of one or two parameters and their values")
    if len(over) not in (1, 2):
        message = f"over must have one or two parameters, got {list(over)}"
        raise InvalidInputError(message, given=over)
    require_parameters(tuple(over))
    axes = {name: _values(name, each) for name, each in over.items()}
    settings: dict[tuple[float, ...], RolloutSetting] = {}
    scales = axes.get("error", np.ones(1)).tolist()
    errors = {scale: study.errors.scaled(scale) for scale in scales}
    laws: dict[tuple[float, ...], Controller] = {}
    for point in itertools.product(*(each.tolist() for each in axes.values())):
        at = dict(zip(axes, point, strict=True))
        scale, gains = at.pop("error", 1.0), tuple(at.values())
        if gains not in laws:
            laws[gains] = _with_gains(study.controller, at) if at else study.controller
        own = replace(study, controller=laws[gains], uncertainty=errors[scale]).setting()
        if scale <= 1.0 or _is_seen(own, n):
            settings[point] = own
    together = with_engine([*settings.values()], execution.engine, n)
    tell = partial(progress_report(progress), "map")
    columns = carried_out(together, n, None, execution, tell) if together else []
    points = {
        point: Rollouts(each, setting)
        for point, setting, each in zip(settings, together, columns, strict=True)
    }
    return StabilityMap(tuple(axes), tuple(axes.values()), points)


def _with_gains(controller: Controller, at: Mapping[str, float]) -> SetpointController:
    law = require_setpoint(controller)
    kp, kv, damping = law.diagonals
    times = at.get("kv", 1.0)
    own_kv = times * kv
    own_kp = at["a"] * own_kv if "a" in at else times * kp
    return law.with_gains(Gains(own_kp, own_kv, at.get("damping", 1.0) * damping))


def own_values(controller: SetpointController) -> dict[str, float]:
    """Return parameter → a controller's own value."""
    kp, kv, _ = controller.diagonals
    return {"error": 1.0, "a": float(np.mean(kp / kv)), "kv": 1.0, "damping": 1.0}


def _is_seen(setting: RolloutSetting, runs: int) -> bool:
    """Return True if cameras see part of the region in all runs; other sensors always do."""
    if setting.uncertainty.camera is None:
        return True
    try:
        for index in range(runs):
            setting.start(index)
    except UnattainedError:
        return False
    return True


def require_parameters(names: Sequence[str]) -> None:
    """Raise an UnknownNameError for a name that is no parameter of a map."""
    for name in names:
        require_known("parameter", name, "the map", PARAMETERS)


def _values(name: str, given: Sequence[float] | Array) -> Array:
    values = as_array(f"values of {name}", given, ("k",))
    wanted, low = (" >= 0", 0.0) if name == "error" else (" > 0", np.nextafter(0.0, 1.0))
    if len(values) < 2 or values[0] < low or not (np.diff(values) > 0.0).all():
        raise InvalidInputError(
            f"values of {name} must be at least two growing numbers{wanted}, got {values.tolist()}",
            given=given,
        )
    return values
