"""Compare the defaults with an operational-space loop with integral, and with joint impedance.

The same starts, targets, wrong model and sensors for each; joint impedance gets the true model,
too. The operational-space loop is tuned for each arm with ideal sensing, on starts and targets that
are not those of the comparison. docs/studies/reaching.md has what came out.

    python examples/studies/compare_laws.py --out results/compare_laws
    python examples/studies/compare_laws.py --tune   # finds TUNED anew
"""

import math
import sys
from dataclasses import replace
from itertools import product

import numpy as np
import reaches
from common import head, parser, row, run_all, two_digits, write
from joint_impedance import JointImpedance
from operational_space import OperationalSpace
from reach_mujoco import SENSORS
from reaches import ARMS, Case

from approxjac.scenario import build_scenario, recommended

IMPEDANCE = "joint impedance", "joint impedance, true model"
LAWS = ("defaults", "operational space", *IMPEDANCE)
IDEAL = {"drives": "ideal"}
KINDS = {
    "ideal": {"controller": {"limits": "none"}, "true": IDEAL},
    "sensors": {
        "controller": {"limits": "none"},
        "sensor": SENSORS,
        "loop": {"actuator_delay": 2e-3},
        "true": IDEAL,
    },
    "stops": {"controller": {"limits": "urdf"}, "true": IDEAL},
    "joints": {
        "controller": {"limits": "urdf"},
        "sensor": SENSORS,
        "loop": {"actuator_delay": 2e-3},
        "true": {"drives": "usual"},
    },
}
HAS_STOPS = "stops", "joints"
LEVEL = {"ideal": 1e-3, "sensors": 5e-3}  # error that the time of which is tuned [m]
TUNING_SEEDS, TUNING_TIME = (100, 101, 102, 103), 8.0  # [s]
# frequency ω [1/s], integral time × ω, speed [m/s]
GRID = ((4.0, 6.0, 9.0, 13.0, 18.0), (1.5, 3.0, 6.0), (0.5, 1.0, 2.0))
MIDDLE = (9.0, 3.0, 1.0)
TUNED = {  # by --tune; after each the score, 12 s where it never gets there
    ("ideal", "panda"): (18.0, 3.0, 1.0),  # 1.97 s
    ("ideal", "ur3"): (18.0, 6.0, 0.5),  # 5.01 s
    ("ideal", "ur5"): (18.0, 3.0, 1.0),  # 2.30 s
    ("ideal", "ur10"): (18.0, 6.0, 2.0),  # 2.54 s
    ("ideal", "kinova"): (18.0, 6.0, 2.0),  # 2.16 s
    ("ideal", "xarm7"): (13.0, 6.0, 1.0),  # 2.94 s
    ("ideal", "talos_arm"): (13.0, 6.0, 1.0),  # 4.37 s
    ("ideal", "z1"): (18.0, 3.0, 1.0),  # 1.35 s
    ("ideal", "so101"): (18.0, 6.0, 2.0),  # 2.75 s
    ("ideal", "tiago_arm"): (4.0, 1.5, 0.5),  # 12.00 s
}


def built_for(kind, robot, seed, duration):
    """Return a reach with the sensing of a kind."""
    scenario = reaches.scenario(Case(robot, seed, kind, duration), **KINDS[kind])
    built = build_scenario(recommended(scenario))
    return built if kind in HAS_STOPS else reaches.without_stops(built)


def run_case(case):
    """Run one reach with each law."""
    built, outcomes = built_for(case.kind, case.robot, case.seed, case.duration), []
    for law in LAWS:
        loop = built
        if law in IMPEDANCE:
            arm = built.plant.robot if law == IMPEDANCE[1] else built.law.task.robot
            loop = replace(built, controller=JointImpedance(built, arm))
        elif law == "operational space":
            loop = replace(built, controller=operational_space(built, *tuned(case)))
        outcomes.append(reaches.run(case._replace(kind=f"{case.kind}, {law}"), loop))
    return outcomes


def tuned(case):
    """Return ω, T ω and V for an arm; those of the ideal loop where stops are added."""
    kind = "ideal" if case.kind == "stops" else case.kind
    return TUNED.get((kind, case.robot), MIDDLE)


def operational_space(built, frequency, times, speed):
    """Return the operational-space loop with what the controller of a reach knows."""
    motors = built.law.task.robot.effort_limits
    return OperationalSpace(built.law.task, frequency, times / frequency, speed, built.q0, motors)


# -- tuning ---------------------------------------------------------------------------------------


def tune(case):
    """Return the best of the grid for an arm and a kind of sensing, one number after the other.

    The score is the mean over the seeds of the time from which on the error is below `LEVEL`, half
    as much again as the run lasts where it is not, plus 1 s for each time the motors' torque that
    it asks for beyond that, 2 s at most.
    """
    reach = [built_for(case.kind, case.robot, seed, case.duration) for seed in TUNING_SEEDS]
    known = {}

    def score(choice):
        if choice not in known:
            known[choice] = np.mean([loss(case, built, choice) for built in reach])
        return known[choice]

    best = MIDDLE
    for _, i in product(range(2), range(len(GRID))):
        best = min((best[:i] + (value,) + best[i + 1 :] for value in GRID[i]), key=score)
    return (case.kind, case.robot), best, score(best)


def loss(case, built, choice):
    """Return the score of one run."""
    run = replace(built, controller=operational_space(built, *choice))
    outcome = reaches.run(case, run)
    time = outcome.time if LEVEL[case.kind] == reaches.DONE else outcome.near
    time = time if math.isfinite(time) else 1.5 * case.duration
    return time + min(max(outcome.asked - 1.0, 0.0), 2.0)


# -- table ----------------------------------------------------------------------------------------

COLUMNS = (*reaches.COLUMNS, "5 mm, median of all", "RMS of the last 2 s, median (most)")


def cells(mine):
    """Return the cells of a row."""
    near = np.median([o.near if math.isfinite(o.near) else math.inf for o in mine])
    rms = [1e3 * o.rms for o in mine]
    told = f"{two_digits(np.median(rms))} mm ({two_digits(max(rms))} mm)"
    return *reaches.cells(mine), f"{near:.2f} s", told


def by_kind(outcomes):
    """Return the outcomes of each kind of loop and law."""
    found = {}
    for outcome in outcomes:
        found.setdefault(outcome.case.kind, []).append(outcome)
    return found


def table(outcomes):
    """Return a row for each kind of loop and law."""
    rows = [row(kind, *cells(mine)) for kind, mine in by_kind(outcomes).items()]
    return [*head("loop, law", *COLUMNS), *rows]


def arms(outcomes):
    """Return a row for each kind of loop and law on each arm."""
    lines = head("loop, law", "arm", *COLUMNS)
    for kind, mine in by_kind(outcomes).items():
        for robot in dict.fromkeys(o.case.robot for o in mine):
            lines.append(row(kind, robot, *cells([o for o in mine if o.case.robot == robot])))
    return lines


def main(arguments=None):
    """Run the comparison, or tune."""
    options = parser(__doc__, "results/compare_laws")
    options.add_argument("--arms", nargs="+", default=ARMS)
    options.add_argument("--seeds", nargs="+", type=int, default=range(8))
    options.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    options.add_argument("--duration", type=float, default=10.0, help="of each run [s]")
    options.add_argument("--tune", action="store_true", help="print TUNED instead")
    given = options.parse_args(arguments)
    if given.tune:
        cases = [
            Case(robot, 0, kind, TUNING_TIME)
            for kind in given.kinds if kind in LEVEL
            for robot in given.arms
        ]  # fmt: skip
        for key, best, score in run_all(tune, cases, given.jobs):
            print(f"    {key}: {best},  # {score:.2f} s")
        return 0
    cases = [
        Case(robot, seed, kind, given.duration)
        for kind in given.kinds
        for robot in given.arms
        for seed in (list(given.seeds)[:2] if given.quick else given.seeds)
    ]
    found = run_all(run_case, cases, given.jobs)
    outcomes = [each for law in zip(*found, strict=True) for each in law]
    outcomes.sort(key=lambda o: given.kinds.index(o.case.kind.split(",")[0]))
    each = [*arms(outcomes), "", "Not within 1 mm at the end:", "", *reaches.failures(outcomes)]
    tables = {"compare_laws.md": table(outcomes), "compare_laws_arms.md": each}
    write(
        given.out,
        {name: "\n".join(lines) + "\n" for name, lines in tables.items()},
        {"runs": outcomes},
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
