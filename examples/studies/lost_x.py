"""Lose the measured x for a while, and see how far the arm goes on and how well.

A panda with an unknown tool (20 cm, 0.5 kg) is seen by a tracker: 60 frames a second, 30 ms late,
1 mm of noise. Under `aj.control` it follows a circle (8 cm, 4 s a turn, 0.13 m/s) by the tracking
law, which learns and predicts x, or goes to a target by the set-point law, which cannot. x is lost
early, when little is learnt, or late. Told are the motion of the tip without x, its error to the
target when x is seen again, or at the brake, and the verdict.

    python examples/studies/lost_x.py --out results/lost_x
"""

import math
import sys
from typing import NamedTuple

import numpy as np
from common import head, parser, row, run_all, write

import approxjac as aj
from approxjac.realtime import Accuracy, SimulatedDriver, Tolerances, control

START = (0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7)
WAY = (0.10, -0.15, 0.16)  # to the target of the set-point law [m]
LOST = (0.2, 0.6, 2.0)  # s
AT = {"tracking": (1.0, 6.0), "set-point": (0.4, 3.0)}  # s, early and late
SEEN = {"x_noise": 1e-3, "x_rate": 60.0, "x_delay": 0.03}


class Case(NamedTuple):
    """One run."""

    law: str
    at: float
    lost: float
    seed: int


class Outcome(NamedTuple):
    """What became of it."""

    case: Case
    fault: str
    braked: float  # without x until then [s], NaN if it was not
    moved: float  # by the tip meanwhile [m]
    before: float  # error to the target when x was lost [m]
    after: float  # and when it was seen again, or at the brake [m]


class Losing(SimulatedDriver):
    """A simulated robot whose x is lost for a while."""

    lost_at, lost_for = 0.0, 0.0

    def read(self):
        """Return a measurement, without x for a while."""
        measured = super().read()
        is_lost = 0.0 <= self.t - self.lost_at < self.lost_for
        return measured._replace(x=np.full(3, math.nan)) if is_lost else measured


def lose(case):
    """Run one case."""
    panda = aj.load_robot("panda")
    truth, belief = panda.with_object(0.2, 0.5, axis="x"), panda.with_object(0.0)
    plant, task = aj.Plant(truth, sensing=aj.Sensing(**SEEN)), aj.PositionTask(belief)
    tip = plant.sensor.value(np.array(START))
    if case.law == "tracking":
        kinematics = aj.AdaptiveKinematics(task, unknown=("tool", "origins"), noise=1e-3)
        law = aj.TrackingController(task, kinematics=kinematics)
        target = aj.Circle(tip + [-0.08, 0.0, 0.05], radius=0.08, period=4.0)
    else:
        latency = aj.Latency(image_period=1.0 / SEEN["x_rate"], image_age=SEEN["x_delay"])
        law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(belief), latency=latency)
        target = tip + WAY
    driver = Losing(plant, START, pace=math.inf, seed=case.seed)
    driver.lost_at, driver.lost_for = case.at, case.lost
    accuracy = Accuracy(q=1e-5, v=1e-3, x=1e-3)
    run = control(
        driver,
        aj.TorqueLimited(law, aj.Limits.of(belief)),
        target,
        case.at + case.lost + 1.0,
        tolerances=Tolerances(accuracy, max_period=5.0),
    )
    lost = np.flatnonzero(np.isnan(run.x_measured).any(axis=1))
    tips = np.array([plant.sensor.value(q) for q in run.q[[lost[0] - 1, *lost]]])
    errors = np.linalg.norm(tips - run.x_d[[lost[0] - 1, *lost]], axis=1)
    moved = float(np.linalg.norm(np.diff(tips, axis=0), axis=1).sum())
    braked = run.t[-1] - run.t[lost[0]] if run.fault_name else math.nan
    return Outcome(case, run.fault_name, float(braked), moved, float(errors[0]), float(errors[-1]))


def table(outcomes):
    """Return a row for each law, instant and time, with the worst of its runs."""
    titles = ("law", "x lost at [s]", "for [s]", "moves on [mm]", "error [mm]", "then [mm]")
    lines = head(*titles, "verdict")
    for name, at, lost in dict.fromkeys(o.case[:3] for o in outcomes):
        of = [o for o in outcomes if o.case[:3] == (name, at, lost)]
        ended = [o for o in of if o.fault]
        verdict = "goes on"
        if ended:
            after = ", ".join(
                f"{1e3 * t:.0f}"
                for t in sorted({min(o.braked for o in ended), max(o.braked for o in ended)})
            )
            verdict = f"{len(ended)} of {len(of)} {ended[0].fault} after {after} ms"
        worst = (max(getattr(o, key) for o in of) for key in ("moved", "before", "after"))
        lines.append(row(name, f"{at:g}", f"{lost:g}", *(f"{1e3 * w:.1f}" for w in worst), verdict))
    return "\n".join(lines) + "\n"


def main(arguments=None):
    """Run all cases and write the table."""
    options = parser(__doc__, "results/lost_x")
    options.add_argument("--seeds", type=int, default=5, help="runs of a kind")
    args = options.parse_args(arguments)
    seeds = range(1 if args.quick else args.seeds)
    cases = [
        Case(name, at, lost, seed)
        for name, instants in AT.items()
        for at in instants
        for lost in LOST
        for seed in seeds
    ]
    outcomes = run_all(lose, cases, args.jobs)
    write(args.out, {"lost_x.md": table(outcomes)}, {"outcomes": outcomes})
    return 0


if __name__ == "__main__":
    sys.exit(main())
