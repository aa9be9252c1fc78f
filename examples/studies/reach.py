"""Reach random targets with an unknown tool, without and with joint stops and limits.

All defaults: gravity is learnt, nothing is tuned for an arm. The law is the set-point law on x, and
of the kind `simulated` what `approxjac simulate` takes: kinematics are learnt, too, and joints are
elastic and rub; `rigid` is the same with ideal joints.
docs/studies/reaching.md has what came out.

    python examples/studies/reach.py --out results/reach

Exit code 1 means that fewer reached their target, or asked for more torque, than that page says.
"""

import math
import sys

import reaches
from common import parser, run_all, write
from reaches import ARMS, DONE, OTHERS, SOON, Case

from approxjac.scenario import build_scenario, recommended

# limits that the controller keeps
KINDS = {"free": "none", "stops": "none", "limits": "urdf", "rigid": "urdf", "simulated": "urdf"}
DRIVES = {"rigid": "ideal", "simulated": "usual"}  # of the law that a simulation chooses
WANTED = {  # shares within 4 s, and within 10 s
    "free": (0.75, 0.97),
    "limits": (0.70, 0.90),
    "rigid": (0.75, 0.90),
    "simulated": (0.75, 0.92),
}


def run_case(case):
    """Run one reach."""
    more = {"true": {"drives": DRIVES[case.kind]}} if case.kind in DRIVES else {}
    scenario = reaches.scenario(case, controller={"limits": KINDS[case.kind]}, **more)
    built = build_scenario(recommended(scenario) if case.kind in DRIVES else scenario)
    return reaches.run(case, reaches.without_stops(built) if case.kind == "free" else built)


def shortcomings(outcomes):
    """Return what fell short of what is wanted; nothing if nothing did."""
    found = []
    for kind, (soon, ever) in WANTED.items():
        mine = [o for o in outcomes if o.case.kind == kind]
        if not mine:
            continue
        done = {
            f"{SOON:g} s": (soon, sum(o.time <= SOON for o in mine) / len(mine)),
            "its duration": (ever, sum(math.isfinite(o.time) for o in mine) / len(mine)),
        }
        found += [
            f"{kind}: {100 * got:.0f} % within {time}, {100 * least:.0f} % wanted"
            for time, (least, got) in done.items()
            if got < least
        ]
        if kind == "free":
            found += free_shortcomings(mine)
    return found


def free_shortcomings(mine):
    """Return what falls short of a median of 2.6 s, 20 mm of overshoot and the motors' torque."""
    times = [o.time for o in mine]
    measured = {
        "median [s]": (reaches.quantile(times, 0.5), 2.6),
        "overshoot [mm]": (1e3 * reaches.quantile([o.overshoot for o in mine]), 20.0),
        "asked of the motors": (reaches.quantile([o.asked for o in mine], 0.97), 1.0),
    }
    return [
        f"free: {name} {got:.3g}, at most {most:g} wanted"
        for name, (got, most) in measured.items()
        if got > most
    ]


def paired(outcomes):
    """Return what became, without limits, of the runs that failed with them."""
    free = {(o.case.robot, o.case.seed): o for o in outcomes if o.case.kind == "free"}
    kept = [o for o in outcomes if o.case.kind == "limits" and not math.isfinite(o.time)]
    other = [free[o.case.robot, o.case.seed] for o in kept if (o.case.robot, o.case.seed) in free]
    done = sum(math.isfinite(o.time) for o in other)
    out = sum(o.beyond > 0.05 for o in other)
    return (
        f"Of the {len(kept)} that fail with stops and limits, {done} get to {1e3 * DONE:g} mm "
        f"without, {out} of them by way of more than 0.05 rad beyond a joint's end."
    )


def main(arguments=None):
    """Run the study; return the exit code."""
    options = parser(__doc__, "results/reach")
    options.add_argument("--arms", nargs="+", default=ARMS, help="names, or file:tip[:base]")
    options.add_argument("--seeds", nargs="+", type=int, default=range(8))
    options.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    options.add_argument("--duration", type=float, default=10.0, help="of each run [s]")
    given = options.parse_args(arguments)
    cases = [
        Case(robot, seed, kind, given.duration)
        for kind in given.kinds
        for robot in (*given.arms, *(OTHERS if kind in DRIVES and not given.quick else ()))
        for seed in (list(given.seeds)[:2] if given.quick else given.seeds)
    ]
    outcomes = run_all(run_case, cases, given.jobs)
    lines = [*reaches.table(outcomes, "stops and limits"), "", paired(outcomes)]
    short = shortcomings(outcomes)
    summary = {"shortcomings": short, "runs": outcomes}
    tables = {"reach.md": lines, "reach_failures.md": reaches.failures(outcomes)}
    write(given.out, {name: "\n".join(each) + "\n" for name, each in tables.items()}, summary)
    print("\n".join(f"fell short: {text}" for text in short) or "all kept")
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
