"""Follow a circle with the set-point law: with and without feed-forward, tools right and wrong.

A Panda follows a horizontal circle of 10 cm radius in 4 s with the defaults, while gravity is
learnt. docs/studies/reaching.md has what came out.

    python examples/studies/circle.py --out results/circle

Exit code 1 means that with known kinematics and feed-forward the RMS error is above 8 mm.
"""

import sys
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import reaches
from common import head, parser, row, run_all, write
from reach_mujoco import SENSORS

import approxjac as aj
from approxjac.scenario import build_scenario, run_scenario

WANTED = 8e-3  # [m]
LENGTH = 0.2  # of the true tool [m]
BELIEVED = {"known": LENGTH, "10 cm short": 0.1, "no tool": 0.0}
LOOPS = {"ideal": {}, "sensors": {"sensor": SENSORS, "loop": {"actuator_delay": 2e-3}}}


class Case(NamedTuple):
    """One run."""

    robot: str
    belief: str
    loop: str
    feed_forward: bool
    radius: float  # [m]
    period: float  # [s]
    seed: int
    turns: int = 4


class Outcome(NamedTuple):
    """What became of one run."""

    case: Case
    rms: float = np.inf  # from the second turn on [m]
    worst: float = np.inf  # from the second turn on [m]
    first: float = np.inf  # RMS of the first turn, which begins at rest [m]
    asked: float = np.nan  # largest torque of the law, as a share of the motor's
    reason: str = ""


class AtRest:
    """A path whose targets do not say how they move."""

    def __init__(self, path):
        self.path = path

    def at(self, t):
        """Return the target at t [s]."""
        return aj.Target(self.path.at(t).x)


def run_case(case):
    """Follow a circle."""
    length, mass = reaches.tool(case.robot)
    share = BELIEVED[case.belief] / LENGTH
    built = build_scenario(
        aj.Scenario(
            case.robot,
            true={"object": {"length": length, "mass": mass}},
            believed={"object": {"length": share * length}},
            run={
                "target": {"circle": {"radius": case.radius, "period": case.period}},
                "duration": case.turns * case.period,
                "seed": case.seed,
            },
            **LOOPS[case.loop],
        )
    )
    if not case.feed_forward:
        built = replace(built, target=AtRest(built.target))
    tally = reaches.Tally(built)
    try:
        result = run_scenario(built, observer=tally)
    except aj.errors.SimulationError as error:
        return Outcome(case, reason=f"{error}")
    run = result.run
    norm, turned = run.error_norm, run.t >= case.period
    return Outcome(
        case, rms(norm[turned]), float(norm[turned].max()), rms(norm[~turned]), tally.asked,
        result.reason,
    )  # fmt: skip


def rms(values):
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def table(outcomes):
    """Return the outcomes as lines of Markdown."""
    lines = head(
        "arm", "tool believed", "loop", "ẋ_d", "first turn, RMS", "after it, RMS", "largest",
        "asked of the motors",
    )  # fmt: skip
    for o in outcomes:
        c, errors = o.case, (f"{1e3 * e:.1f} mm" for e in (o.first, o.rms, o.worst))
        told = "fed forward" if c.feed_forward else "not told"
        lines.append(row(c.robot, c.belief, c.loop, told, *errors, f"{o.asked:.2f}"))
    ended = [f"- {o.case.robot}: {o.reason}" for o in outcomes if o.reason]
    return [*lines, *(["", *ended] if ended else [])]


def main(arguments=None):
    """Run the study; return the exit code."""
    options = parser(__doc__, "results/circle")
    options.add_argument("--arms", nargs="+", default=["panda"])
    options.add_argument("--seeds", nargs="+", type=int, default=[0], help="of the noise")
    options.add_argument("--radius", type=float, default=0.1, help="[m]")
    options.add_argument("--period", type=float, default=4.0, help="[s]")
    given = options.parse_args(arguments)
    cases = [
        Case(robot, belief, loop, told, given.radius, given.period, seed)
        for robot in given.arms
        for loop in LOOPS
        for belief in BELIEVED
        for told in (True, False)
        for seed in given.seeds
    ][: 1 if given.quick else None]
    outcomes = run_all(run_case, cases, given.jobs)
    write(given.out, {"circle.md": "\n".join(table(outcomes)) + "\n"}, {"runs": outcomes})
    judged = [
        o for o in outcomes
        if o.case.feed_forward and (o.case.belief, o.case.loop) == ("known", "ideal")
    ]  # fmt: skip
    short = [f"{o.case.robot}: {1e3 * o.rms:.1f} mm RMS" for o in judged if o.rms > WANTED]
    print("\n".join(f"fell short: {text}" for text in short) or "all kept")
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
