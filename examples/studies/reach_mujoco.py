"""Reach in MuJoCo with real sensing, with a slow camera, and with joints that stick.

All defaults, and an unmodelled tool. MuJoCo stops the joints at
their ends, but where friction is looked at. docs/studies/reaching.md has what came out.

    python examples/studies/reach_mujoco.py --out results/reach_mujoco

Exit code 1 means that a run diverged, or that one was less accurate than that page says.
"""

import math
import sys

import numpy as np
import reaches
from common import head, parser, row, run_all, two_digits, write
from reaches import Case

from approxjac.scenario import build_scenario

STICTION = 0.2  # MuJoCo's frictionloss of every joint [N m]
SENSORS = {"noise": 5e-4, "rate": 60.0, "q_quantum": 1e-5, "velocity_filter": 5e-3}
CAMERA = SENSORS | {"rate": 30.0, "delay": 0.06}
KINDS = {
    "sensors": {"sensor": SENSORS, "loop": {"actuator_delay": 2e-3}},
    "camera": {"sensor": CAMERA, "loop": {"actuator_delay": 2e-3}},
    "friction": {"controller": {"gravity": "exact", "integral_action": True}},
}
ARMS = {
    "sensors": ("panda", "ur5", "xarm7", "kinova", "z1"),
    "camera": ("panda", "ur5", "xarm7", "kinova", "z1"),
    "friction": ("panda", "ur5", "xarm7"),
}
SEEDS = {"sensors": 3, "camera": 1, "friction": 2}


def run_case(case):
    """Run one reach in MuJoCo."""
    built = build_scenario(reaches.scenario(case, true={"engine": "mujoco"}, **KINDS[case.kind]))
    if case.kind == "friction":
        built.plant.mujoco_model.dof_frictionloss[:] = STICTION
        built.plant.mujoco_model.jnt_limited[:] = 0  # what is left is friction's, and no stop's
    return reaches.run(case, built)


def shortcomings(outcomes):
    """Return what fell short of what is wanted; nothing if nothing did."""
    found = [f"{o.case.kind}, {o.case.robot} diverged" for o in outcomes if diverged(o)]
    by_kind = {kind: [o for o in outcomes if o.case.kind == kind] for kind in KINDS}
    for kind, name, value, most in (
        ("sensors", "median of the RMS [mm]", lambda mine: middle(o.rms for o in mine), 1.5),
        ("sensors", "largest RMS [mm]", lambda mine: 1e3 * max(o.rms for o in mine), 5.0),
        ("sensors", "asked of the motors", lambda mine: max(o.asked for o in mine), 0.9),
        ("camera", "largest RMS [mm]", lambda mine: 1e3 * max(o.rms for o in mine), 12.0),
        ("friction", "mean error [mm]", lambda mine: 1e3 * np.mean([o.mean for o in mine]), 0.25),
        ("friction", "largest error [mm]", lambda mine: 1e3 * max(o.worst for o in mine), 1.0),
    ):
        if by_kind[kind] and value(by_kind[kind]) > most:
            got = value(by_kind[kind])
            found.append(f"{kind}: {name} {got:.3g}, at most {most:g} wanted")
    return found


def diverged(outcome):
    """Return whether a run diverged, or ended farther away than it began."""
    return not outcome.final_error < outcome.start_error


def middle(lengths):
    """Return the median of lengths in m, in mm."""
    return 1e3 * float(np.median(list(lengths)))


COLUMNS = (
    "runs", "diverged", "RMS of the last 2 s, median (most)", "mean of the last 2 s",
    "largest error in the last 2 s", "5 mm reached, median", "asked of the motors, most",
)  # fmt: skip


def cells(mine):
    """Return the cells of COLUMNS."""
    near = [o.near if math.isfinite(o.near) else math.inf for o in mine]
    return (
        len(mine),
        sum(diverged(o) for o in mine),
        f"{two_digits(middle(o.rms for o in mine))} mm "
        f"({two_digits(1e3 * max(o.rms for o in mine))} mm)",
        f"{two_digits(1e3 * np.mean([o.mean for o in mine]))} mm",
        f"{two_digits(1e3 * max(o.worst for o in mine))} mm",
        f"{np.median(near):.2f} s",
        f"{max(o.asked for o in mine):.2f}",
    )


def table(outcomes):
    """Return all outcomes of each kind, and those of each arm, as lines of Markdown."""
    lines = head("loop", "arm", *COLUMNS)
    for kind in dict.fromkeys(o.case.kind for o in outcomes):
        mine = [o for o in outcomes if o.case.kind == kind]
        lines.append(row(f"**{kind}**", "**all**", *cells(mine)))
        for robot in dict.fromkeys(o.case.robot for o in mine):
            lines.append(row(kind, robot, *cells([o for o in mine if o.case.robot == robot])))
    bad = [o for o in outcomes if o.rms > 5e-3]
    lines += ["", "More than 5 mm RMS:", ""]
    return [*lines, *(map(reaches.failure, bad) if bad else ["- none"])]


def main(arguments=None):
    """Run the study; return the exit code."""
    options = parser(__doc__, "results/reach_mujoco")
    options.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    options.add_argument("--arms", nargs="+", help="those of the page by default")
    options.add_argument("--seeds", nargs="+", type=int, help="those of the page by default")
    options.add_argument("--duration", type=float, default=10.0, help="of each run [s]")
    given = options.parse_args(arguments)
    cases = [
        Case(robot, seed, kind, given.duration)
        for kind in given.kinds
        for robot in given.arms or ARMS[kind]
        for seed in given.seeds or range(1 if given.quick else SEEDS[kind])
    ]
    outcomes = run_all(run_case, cases, given.jobs)
    short = shortcomings(outcomes)
    tables = {"reach_mujoco.md": "\n".join(table(outcomes)) + "\n"}
    write(given.out, tables, {"shortcomings": short, "runs": outcomes})
    print("\n".join(f"fell short: {text}" for text in short) or "all kept")
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
