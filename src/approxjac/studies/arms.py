"""Every arm, from random starts to random targets, with a tool its controller believes absent."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from approxjac.errors import ApproxJacError, InvalidInputError, UnknownNameError
from approxjac.robots import load_robot, robot_names
from approxjac.studies import reach
from approxjac.studies.processes import run_in_processes
from approxjac.validation import as_number

LENGTH, MASS = 0.20, 0.5
_LARGEST_SHARE = 0.15  # of the arm's moving mass that an object may have
_WANTED = 0.95  # share of runs with known gravity that has to converge


class Case(NamedTuple):
    """One run: an arm, whether gravity is known or learnt, and the seed of start and target."""

    robot: str
    gravity: str
    seed: int
    duration: float


class Outcome(NamedTuple):
    """What became of one run; the fields of `reach.Result`, and the error at the end [m]."""

    case: Case
    start_error: float
    final_error: float
    settling_time: float
    peak_torque_ratio: float
    converged: bool
    reason: str


@cache
def carried_object(robot: str) -> tuple[float, float]:
    """Length [m] and mass [kg] of the object for an arm.

    20 cm and 0.5 kg; for arms that this would be more than 15 % of the moving mass of, 15 % of it
    and the length of a body of the same shape.
    """
    share = MASS / (_LARGEST_SHARE * load_robot(robot).mass)
    if share <= 1.0:
        return LENGTH, MASS
    return round(LENGTH / share ** (1.0 / 3.0), 3), round(MASS / share, 3)


def cases(robots: Sequence[str], starts: int, duration: float) -> list[Case]:
    """Return the runs of the study.

    Raises:
        UnknownNameError: A robot that does not load by name.
        InvalidInputError: No starts, or a duration that is not positive.
    """
    for robot in robots:
        if robot not in robot_names():
            raise UnknownNameError("robot", robot, "the robots known by name", robot_names())
    if starts < 1:
        raise InvalidInputError(f"starts must be at least 1, got {starts}", given=starts)
    as_number("duration", duration, unit="s", above=0.0)
    return [
        Case(robot, gravity, seed, duration)
        for robot in robots or robot_names()
        for gravity in ("exact", "learnt")
        for seed in range(starts)
    ]


def run_case(case: Case) -> Outcome:
    """Run one case with default gains, sampled at 1 kHz, with motors that saturate."""
    length, mass = carried_object(case.robot)
    settings = reach.Settings(
        object_length=length,
        object_mass=mass,
        start="random",
        gravity=case.gravity,  # type: ignore[arg-type]
        duration=case.duration,
        seed=case.seed,
    )
    try:
        result = reach.run(reach.prepare(case.robot, settings))
    except ApproxJacError as error:
        return Outcome(case, math.nan, math.inf, math.nan, math.nan, False, f"{error}")
    norm = result.run.error_norm
    return Outcome(
        case,
        float(norm[0]),
        float(norm[-1]),
        result.settling_time,
        result.peak_torque_ratio,
        result.converged,
        result.reason,
    )


def run(
    cases: Sequence[Case],
    jobs: int | None = None,
    progress: Callable[[], None] | None = None,
) -> list[Outcome]:
    """Run cases in several processes, and return their outcomes in the order of the cases."""
    return run_in_processes(run_case, cases, jobs, progress)


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the outcomes as a Markdown table, an arm a row, and every failure below it."""
    lines = [
        "| arm | object | gravity known: converged | settled, median (slowest) | gravity learnt: "
        "converged | settled, median (slowest) | peak torque |",
        "|---|---|---|---|---|---|---|",
    ]
    for robot in dict.fromkeys(outcome.case.robot for outcome in outcomes):
        length, mass = carried_object(robot)
        mine = [outcome for outcome in outcomes if outcome.case.robot == robot]
        cells = [robot, f"{100 * length:.3g} cm, {mass:.3g} kg"]
        for gravity in ("exact", "learnt"):
            cells += _cells([outcome for outcome in mine if outcome.case.gravity == gravity])
        peaks = [o.peak_torque_ratio for o in mine if math.isfinite(o.peak_torque_ratio)]
        cells.append(f"{max(peaks):.2f}" if peaks else "no limit known")
        lines.append(f"| {' | '.join(cells)} |")
    failures = [outcome for outcome in outcomes if not outcome.converged]
    lines += ["", f"{len(failures)} of {len(outcomes)} runs did not converge to 1 mm."]
    lines += [""] if failures else []
    for case, start, final, _, _, _, reason in failures:
        known = "known" if case.gravity == "exact" else "learnt"
        errors = f"{1e3 * start:.0f} mm -> {1e3 * final:.2g} mm; " if math.isfinite(final) else ""
        lines.append(f"- {case.robot}, gravity {known}, seed {case.seed}: {errors}{reason}")
    return "\n".join(lines) + "\n"


def summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """What goes into summary.json."""
    shares = {
        gravity: float(np.mean([o.converged for o in outcomes if o.case.gravity == gravity]))
        for gravity in ("exact", "learnt")
    }
    return {
        "converged_gravity_known": shares["exact"],
        "converged_gravity_learnt": shares["learnt"],
        "wanted": _WANTED,
        "verdict": "ok" if shares["exact"] >= _WANTED else "fell short",
        "runs": [
            {
                **outcome.case._asdict(),
                **{
                    name: value if not isinstance(value, float) or math.isfinite(value) else None
                    for name, value in outcome._asdict().items()
                    if name != "case"
                },
            }
            for outcome in outcomes
        ],
    }


def _cells(outcomes: Sequence[Outcome]) -> list[str]:
    times = [outcome.settling_time for outcome in outcomes if outcome.converged]
    count = f"{len(times)} of {len(outcomes)}"
    return [count, f"{np.median(times):.1f} s ({max(times):.1f} s)" if times else "–"]
