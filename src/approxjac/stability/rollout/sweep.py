"""`sweep`: the same rollouts with several controllers, or several sets of errors."""

from __future__ import annotations

import hashlib
import itertools
import pickle
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np

from approxjac.controllers import Gains, SetpointController
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.formatting import joined, percent
from approxjac.stability.errors.region import Region
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.rollout.rollout_portions import Progress, carried_out
from approxjac.stability.rollout.rollout_study import Study
from approxjac.stability.rollout.rollouts import Rollouts, as_study, checked
from approxjac.validation import Array

Label = Any


class _Points(dict[Label, Rollouts]):
    def __missing__(self, label: Label) -> Rollouts:
        raise UnknownNameError("point", label, "the sweep", map(repr, self))


@dataclass(frozen=True, eq=False, repr=False)
class Sweep:
    """Rollouts at several points. Its text is a line for each.

    Attributes:
        names: What differs from point to point: "controller", "uncertainty", or both.
        points: Label → the runs there; an UnknownNameError for a label that there is not. A label
            is a key of what was given; where both differ, a pair of keys.
    """

    names: tuple[str, ...]
    points: dict[Label, Rollouts]

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", _Points(self.points))

    @property
    def table(self) -> dict[str, Array]:
        """The points, a row each, as `pandas.DataFrame` takes them.

        The labels; "runs", "share" that converges, with the ends "low" and "high" of its interval;
        "diverged" and "left" the region; "settling_time" [s], the median, with runs that have not
        settled as infinite; "final_error" [units of the task], "peak_torque" and "peak_speed"
        [shares of the limits], the largest, the last two of runs that did not diverge.
        """
        pairs = [label if len(self.names) == 2 else (label,) for label in self.points]
        found = {name: _column(each) for name, each in zip(self.names, zip(*pairs), strict=True)}  # noqa: B905
        rows = [_row(runs) for runs in self.points.values()]
        return found | {name: np.array([row[name] for row in rows]) for name in rows[0]}

    def __repr__(self) -> str:
        study = next(iter(self.points.values())).study
        unit, lines = joined(study.controller.task.units), []
        for label, runs in self.points.items():
            row = _row(runs)
            half = row["settling_time"]
            settled = f"half settle within {half:.3g} s" if half < np.inf else "half never settle"
            lines.append(
                f"{label}: {runs.n_converged} of {runs.n} converged, "
                f"{percent(row['share'])} % ({percent(row['low'])} to {percent(row['high'])} %);"
                f" {settled}; worst {row['final_error']:.3g} {unit} off"
            )
        return "\n".join(lines)


def sweep(
    controller: Controller | Mapping[Any, Controller],
    uncertainty: Uncertainty | Mapping[Any, Uncertainty],
    region: Region,
    *,
    runs: int = 100,
    failures: int | None = None,
    executor: Executor | None = None,
    folder: str | PathLike[str] | None = None,
    progress: Progress = None,
    **options: Any,
) -> Sweep:
    """Carry out the same rollouts with several controllers, sets of errors, or all pairs of both.

    Run k begins alike at all points: with the same start, and at the same place between the ends of
    each range of errors. So points differ by what was changed and not by what was drawn.

    Args:
        controller: The controller; or label → controller, such as
            `{kv: law.with_gains(aj.Gains(400, kv, 1)) for kv in (40, 80)}`.
        uncertainty: How the true robot may differ; or label → that, such as
            `{scale: errors.scaled(scale) for scale in (0.5, 1.0, 2.0)}`.
        region: Where starts and targets are drawn.
        runs: At each point, ≥ 1.
        failures: See `rollouts`; for each point.
        executor: See `rollouts`; the points share it.
        folder: See `rollouts`.
        progress: See `rollouts`; told of the runs of all points.
        options: The others of `rollouts`, such as target, duration, dt, tolerance, seed, sensing.

    Raises:
        InvalidInputError: Neither is a dict, or one is empty; or what `rollouts` refuses.

    Example:
        >>> arm = load_robot("two_link")
        >>> errors = Uncertainty(arm, object_length=(0.0, 0.2), object_axis="x")
        >>> law = SetpointController(errors.believed_task())
        >>> region = JointBox.around(arm, [0.5, 1.2], 0.4)
        >>> scales = {scale: errors.scaled(scale) for scale in (0.5, 1.0)}
        >>> sweep(law, scales, region, runs=3, duration=0.1).table["uncertainty"]
        array([0.5, 1. ])
    """
    given = {"controller": controller, "uncertainty": uncertainty}
    names = tuple(name for name, each in given.items() if isinstance(each, Mapping))
    if not names or not all(given[name] for name in names):
        raise InvalidInputError(
            "controller or uncertainty must be a dict that is not empty, such as {1: errors, "
            "2: errors.scaled(2)}, or {kv: law.with_gains(aj.Gains(400, kv, 1)) for kv in (40, 80)}"
            f", got a {type(controller).__name__} and a {type(uncertainty).__name__}",
            given=given,
        )
    choices = [given[name].items() for name in names]  # type: ignore[union-attr]
    studies = {}
    for choice in itertools.product(*choices):
        label = tuple(key for key, _ in choice)
        point = given | dict(zip(names, (each for _, each in choice), strict=True))
        study = as_study(region=region, runs=runs, **point, **options)
        studies[label if len(names) == 2 else label[0]] = study
    runs, failures = checked(runs, failures, executor, folder, progress)
    together = _sharing([*studies.values()])
    each = carried_out(together, runs, failures, executor, folder, progress)
    found = zip(studies, together, each, strict=True)
    return Sweep(names, {label: Rollouts(columns, study) for label, study, columns in found})


def _sharing(studies: list[Study]) -> list[Study]:
    """Return studies of which those that differ in gains and scale alone share a compiled loop."""
    groups: dict[bytes, list[int]] = {}
    gains = [np.zeros(0)] * len(studies)
    for k, study in enumerate(studies):
        law = study.controller
        # in code, gains are numbers like others; but limits and postures follow from them
        if type(law) is SetpointController and law.posture is None:
            gains[k] = np.concatenate(law.diagonals)
            law = law.with_gains(Gains(1.0, 1.0, 1.0))
        errors = replace(study.uncertainty, factor=1.0)
        try:
            rest = pickle.dumps(replace(study, controller=law, uncertainty=errors, key=""))
        except (pickle.PicklingError, AttributeError, TypeError):
            continue
        groups.setdefault(rest, []).append(k)
    found = list(studies)
    for group in groups.values():
        errors = max((studies[k].uncertainty for k in group), key=lambda each: each.factor)
        shown: list[Controller] = []
        known = np.zeros(gains[group[0]].shape, dtype=bool)  # numbers that differ
        for k in group:
            differs = gains[k] != gains[group[0]]
            if not shown or (differs & ~known).any():
                shown.append(studies[k].controller)
                known |= differs
        alike = tuple((law, errors) for law in shown)
        key = hashlib.sha256(pickle.dumps((studies[group[0]].key, alike))).hexdigest()
        for k in group if len(group) > 1 and studies[group[0]].engine == "lanes" else ():
            found[k] = replace(studies[k], key=key, alike=alike)
    return found


def _column(labels: tuple[Label, ...]) -> Array:
    """Return labels as a column, of objects where they are no numbers or words."""
    if all(isinstance(label, int | float | str) for label in labels):
        return np.array(labels)
    found = np.empty(len(labels), dtype=object)
    found[:] = labels
    return found


def _row(runs: Rollouts) -> dict[str, float]:
    columns, (low, high) = runs.columns, runs.interval
    settling = columns["settling_time"]
    return {
        "runs": runs.n,
        "share": runs.share,
        "low": low,
        "high": high,
        "diverged": runs.n_diverged,
        "left": runs.n_left,
        "settling_time": float(np.median(np.where(np.isnan(settling), np.inf, settling))),
        "final_error": float(columns["final_error"].max()),
        "peak_torque": float(np.fmax.reduce(columns["peak_torque"])),
        "peak_speed": float(np.fmax.reduce(columns["peak_speed"])),
    }
