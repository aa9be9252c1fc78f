"""Let every arm reach targets with an object that its controller believes absent.

From random starts to random targets, once with gravity known and once learnt, with default gains
at 1 kHz and motors that saturate. docs/simulate.md has the table that comes out.

    python examples/studies/every_arm.py --out results/every_arm

Exit code 1 means that fewer than 95 % of the runs with known gravity converged.
"""

import math
import sys
from typing import NamedTuple

import numpy as np
from common import carried_object, head, parser, row, run_all, write

import approxjac as aj
from approxjac.scenario import Scenario, run_scenario

WANTED = 0.95  # share of the runs with known gravity that has to converge


class Case(NamedTuple):
    """One run: an arm, gravity "exact" or "learnt", the seed of start and target, duration [s]."""

    robot: str
    gravity: str
    seed: int
    duration: float


class Outcome(NamedTuple):
    """What became of one run."""

    case: Case
    start_error: float = math.nan  # [m]
    final_error: float = math.inf  # [m]
    settling_time: float = math.nan  # [s]
    peak_torque: float = math.nan  # as a share of the effort limit
    converged: bool = False
    reason: str = ""  # that it did not


def run_case(case):
    """Run one case; what cannot run is an outcome too."""
    length, mass = carried_object(case.robot)
    try:
        result = run_scenario(
            Scenario(
                case.robot,
                true={"object": {"length": length, "mass": mass}},
                controller={"gravity": case.gravity, "limits": "none"},
                run={"start": "random", "duration": case.duration, "seed": case.seed},
            )
        )
    except aj.errors.ApproxJacError as error:
        return Outcome(case, reason=f"{error}")
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


def table(outcomes):
    """Return the outcomes as Markdown, an arm a row, and every failure below it."""
    lines = head(
        "arm", "object", "gravity known: converged", "settled, median (slowest)",
        "gravity learnt: converged", "settled, median (slowest)", "peak torque",
    )  # fmt: skip
    for robot in dict.fromkeys(outcome.case.robot for outcome in outcomes):
        length, mass = carried_object(robot)
        mine = [outcome for outcome in outcomes if outcome.case.robot == robot]
        cells = [f"{100 * length:.3g} cm, {mass:.3g} kg"]
        for gravity in ("exact", "learnt"):
            runs = [o for o in mine if o.case.gravity == gravity]
            times = [o.settling_time for o in runs if o.converged]
            cells += [
                f"{len(times)} of {len(runs)}",
                f"{np.median(times):.1f} s ({max(times):.1f} s)" if times else "–",
            ]
        peaks = [o.peak_torque for o in mine if math.isfinite(o.peak_torque)]
        lines.append(row(robot, *cells, f"{max(peaks):.2f}" if peaks else "no limit known"))
    failures = [outcome for outcome in outcomes if not outcome.converged]
    lines += ["", f"{len(failures)} of {len(outcomes)} runs did not converge to 1 mm."]
    lines += ["", *map(failure, failures)] if failures else []
    return "\n".join(lines) + "\n"


def failure(outcome):
    """Return a line on a run that did not converge."""
    case, start, final = outcome.case, outcome.start_error, outcome.final_error
    known = "known" if case.gravity == "exact" else "learnt"
    errors = f"{1e3 * start:.0f} mm -> {1e3 * final:.2g} mm; " if math.isfinite(final) else ""
    return f"- {case.robot}, gravity {known}, seed {case.seed}: {errors}{outcome.reason}"


def main(arguments=None):
    """Run the study; return the exit code."""
    options = parser(__doc__, "results/every_arm")
    options.add_argument(
        "--robots", nargs="+", default=aj.robots.robot_names(), help="all by default"
    )
    options.add_argument("--starts", type=int, default=20, help="for each arm and gravity")
    options.add_argument("--duration", type=float, default=30.0, help="of each run [s]")
    given = options.parse_args(arguments)
    starts = 2 if given.quick else given.starts
    cases = [
        Case(robot, gravity, seed, given.duration)
        for robot in given.robots
        for gravity in ("exact", "learnt")
        for seed in range(starts)
    ]
    outcomes = run_all(run_case, cases, given.jobs)
    shares = {
        gravity: float(np.mean([o.converged for o in outcomes if o.case.gravity == gravity]))
        for gravity in ("exact", "learnt")
    }
    write(given.out, {"every_arm.md": table(outcomes)}, {"converged": shares, "runs": outcomes})
    return 0 if shares["exact"] >= WANTED else 1


if __name__ == "__main__":
    sys.exit(main())
