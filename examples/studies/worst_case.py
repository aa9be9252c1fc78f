"""How much of what is stable a searched report certifies, and whether a foreign search refutes it.

Of each setup the errors are scaled. k* is the smallest scale at which the report's own search or
the foreign one, SciPy's differential evolution on the exact linearisation, finds an unstable robot.

python examples/studies/worst_case.py --out results/worst_case
"""

import sys
import time

import numpy as np
from common import head, parser, row, run_all, write
from scipy.optimize import differential_evolution

import approxjac as aj
from approxjac.stability.search.worst import CaseBox, fastest_growth, scored

SCALES = (0.3, 0.5, 0.7, 0.9, 1.15)
LOOKS, STARTS, SEED = 10_000, 12, 7
RADIUS = 0.15  # of regions to either side [rad]


def two_link(shift, turn, object_):
    """A two-link arm with wrong origins of joints and an unknown tool."""
    arm = aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0))
    joints = arm.joint_names
    errors = aj.Uncertainty(
        arm, object_length=object_, object_mass=(0.0, 0.3), believed_length=object_[0],
        joint_shifts={joints[1]: (shift, shift, 0.0)},
        joint_rotations=dict.fromkeys(joints, (0.0, 0.0, turn)),
    )  # fmt: skip
    return errors, [0.5, 1.2]


def many(name, q, shift, turn, joints=None):
    """An arm with wrong joint origins."""
    arm = aj.load_robot(name).with_gravity((0.0, 0.0, 0.0))
    joints = arm.joint_names if joints is None else arm.joint_names[:joints]
    shifts = dict.fromkeys(joints, (shift,) * 3) if shift else {}
    turns = dict.fromkeys(joints, (turn,) * 3) if turn else {}
    return aj.Uncertainty(arm, joint_shifts=shifts, joint_rotations=turns), q


PANDA, UR5 = [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7], [0.0, -1.2, 1.5, -1.9, -1.5, 0.3]
XARM, KINOVA = [0.0, 0.3, 0.0, 0.9, 0.0, 0.8, 0.0], [0.3, 3.6, 1.8, 0.5, 0.6, 0.4]
SETUPS = {
    "two-link, rotations": lambda: two_link(0.0, 0.2, (0.0, 0.1)),
    "two-link, shifts": lambda: two_link(0.1, 0.0, (0.0, 0.2)),
    "two-link, both": lambda: two_link(0.1, 0.2, (0.0, 0.2)),
    "two-link, long tool": lambda: two_link(0.05, 0.1, (0.0, 1.0)),
    "Panda, all": lambda: many("panda", PANDA, 0.039, 0.13),
    "Panda, rotations": lambda: many("panda", PANDA, 0.0, 0.15),
    "UR5, all": lambda: many("ur5", UR5, 0.05, 0.15),
    "UR5, rotations": lambda: many("ur5", UR5, 0.0, 0.2),
    "UR5, shifts": lambda: many("ur5", UR5, 0.1, 0.0),
}
HELD_OUT = {  # that nothing was tuned on
    "xArm 7, all": lambda: many("xarm7", XARM, 0.04, 0.13),
    "Kinova, rotations": lambda: many("kinova", KINOVA, 0.0, 0.15),
    "xArm 7, three joints": lambda: many("xarm7", XARM, 0.05, 0.2, 3),
}


def loop_of(setup, scale):
    """Return the study of a setup with scaled errors, and its closed loop."""
    errors, q = (SETUPS | HELD_OUT)[setup]()
    errors = errors.scaled(scale)
    law = aj.SetpointController(errors.believed_task(), gravity=aj.NoGravity(errors.arm))
    study = aj.Study(law, errors, aj.JointBox.around(errors.arm, q, RADIUS), seed=SEED)
    return study, study.loop()


def foreign(loop, score, pairs, looks=LOOKS, seed=SEED):
    """Return the largest score that differential evolution finds."""
    box = CaseBox(loop, pairs)
    of = scored(loop, box, score)
    each = max(1, round(40 / box.size))  # of the population, for each coordinate
    size = each * box.size
    best = differential_evolution(
        lambda z: -np.maximum(of(z.T), -1e6), [(-1.0, 1.0)] * box.size, vectorized=True,
        updating="deferred", maxiter=looks // size - 1, popsize=each, polish=False,
        rng=seed, tol=0.0,
    )  # fmt: skip
    return -float(best.fun)


def is_unstable(setup, scale, with_foreign):
    """Return whether a search finds an unstable robot: the report's own, and if asked the other."""
    study, loop = loop_of(setup, scale)
    timing = study.timing.in_samples()
    if fastest_growth(loop, timing, STARTS, np.random.default_rng(SEED)).grows:
        return True
    return with_foreign and foreign(loop, lambda at: loop.growth(at, timing), False) >= 0.0


def run_case(case):
    """Return k*, and per scale the verdict, its margin, the foreign one, growth, CPU seconds."""
    setup, quick = case
    low, high = 0.0, 1.0
    while high < 16.0 and not is_unstable(setup, high, False):
        low, high = high, 2.0 * high
    for _ in range(3 if quick else 6):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if is_unstable(setup, middle, False) else (middle, high)
    found = {"setup": setup, "k": high}
    for scale in SCALES[:2] if quick else SCALES:
        begun = time.process_time()
        study, loop = loop_of(setup, scale * high)
        report = study.report(2000)
        taken, margin, growth = time.process_time() - begun, np.nan, np.nan
        if report.passed and not quick:
            timing, test = study.timing.in_samples(), report.test
            growth = foreign(loop, lambda at: loop.growth(at, timing), False)  # noqa: B023
            margin = -foreign(
                loop, lambda at: -test.form.elsewhere(at).margins(test.weights), True  # noqa: B023
            )  # fmt: skip
        found[str(scale)] = (
            report.passed,
            report.refuted,
            report.test.margin,
            margin,
            growth,
            taken,
        )
    return found


def table(outcomes):
    """Return the table: verdict and margin, with what the foreign search has found below it."""
    scales = [str(scale) for scale in SCALES if str(scale) in outcomes[0]]
    lines = head("errors", "k*", *(f"{scale} k*" for scale in scales))
    for found in outcomes:
        cells = []
        for scale in scales:
            passed, refuted, margin, other, growth, _ = found[scale]
            text = "refuted" if refuted else "not certified"
            if passed:
                text = f"certified, {margin:.2f}; foreign {other:.2f}, {growth:.2g}/s"
            cells.append(text)
        lines.append(row(found["setup"], f"{found['k']:.2f}", *cells))
    return "\n".join(lines) + "\n"


def main(arguments=None):
    """Run the study; exit code 1 if anything certified is refuted by the foreign search."""
    given = parser(__doc__, "results/worst_case").parse_args(arguments)
    setups = [*SETUPS, *HELD_OUT]
    cases = [(setup, given.quick) for setup in (setups[:1] if given.quick else setups)]
    outcomes = run_all(run_case, cases, given.jobs)
    write(given.out, {"worst_case.md": table(outcomes)}, {"outcomes": outcomes})
    scales = [k for k in outcomes[0] if k not in ("setup", "k")]
    verdicts = [found[scale] for found in outcomes for scale in scales]
    wrong = sum(v[0] and (v[3] <= 0.0 or v[4] >= 0.0) for v in verdicts)
    print(table(outcomes) + f"\nRefuted by the foreign search: {wrong}.")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
