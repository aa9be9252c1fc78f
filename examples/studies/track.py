"""Reach and follow with tool, joint origins and tracker unknown, and learnt while the arm moves.

Setups are those of tracks.py, with noise, frames and delay of a tracker, and the torques of the
motors. docs/learning_kinematics.md has what came out.

    python examples/studies/track.py --out results/track

Exit code 1 means that a run was less accurate than that page says.
"""

import math
import sys
import time
from typing import NamedTuple

import numpy as np
import tracks
from circle import AtRest
from common import head, parser, row, run_all, write
from operational_space import OperationalSpace
from tracks import DELAY, DT, NOISE, RATE, Setup

import approxjac as aj
from approxjac.controllers import (
    ControllerWrapper,
    KnownKinematics,
    ModelDynamics,
    PredictedMeasurement,
)

LAWS = {
    "tracking law, learnt": "TrackingController with AdaptiveKinematics",
    "set-point law, learnt": "SetpointController on x̂, with ẋ_d",
    "tracking law, exact model": "TrackingController that knows everything",
    "set-point law, ẋ_d": "SetpointController with the believed Jacobian, ẋ_d fed forward",
    "set-point law": "the same as if the target stood still",
    "operational space": "Khatib's loop with integral action and the believed model",
}
LEARNT, ON_X, EXACT, FED, FIXED, KHATIB = LAWS
WINDOWS = ((2.0, 3.0), (5.0, 6.0), (7.0, 8.0), (10.0, 11.0), (19.0, 20.0))
TILTED = math.radians(2.0)


class Case(NamedTuple):
    """One run."""

    name: str
    setup: Setup
    circle: bool
    law: str
    duration: float = 11.0  # [s]
    delay: float = DELAY  # that the controller believes [s]
    most: tuple[tuple[float, float], ...] = ()  # end of a window [s], RMS at most [mm]


class Outcome(NamedTuple):
    """What became of one run."""

    case: Case
    rms: dict = {}  # noqa: RUF012 - window → RMS [mm], never changed
    first: float = math.nan  # error [mm]
    largest: float = math.inf  # error [mm]
    asked: float = math.nan  # largest torque of the law, as a share of the motor's
    nees: float = math.nan  # normalized squared error of the tool at the end, of three coordinates
    chi2: float = math.nan  # per degree of freedom, of what is learnt
    seconds: float = math.nan  # of computing
    reason: str = ""


def controller_of(case, plant):
    """Return the controller of a case."""
    setup, belief = case.setup, case.setup.belief
    task = aj.PositionTask(belief)
    if case.law == EXACT:
        return aj.TrackingController(
            plant.sensor, kinematics=KnownKinematics(plant.sensor),
            dynamics=ModelDynamics(plant.robot),
        )  # fmt: skip
    latency = aj.Latency(image_period=1.0 / RATE, image_age=case.delay)
    if case.law == KHATIB:
        return OperationalSpace(task, 6.0, 0.5, 0.5, setup.q0, belief.effort_limits)
    kinematics = aj.AdaptiveKinematics(task, noise=NOISE, delay=case.delay)
    if case.law == LEARNT:
        return aj.TrackingController(task, kinematics=kinematics)
    gravity = aj.AdaptiveGravity(belief)
    if case.law == ON_X:
        return PredictedMeasurement(aj.SetpointController(task, gravity=gravity), kinematics)
    return aj.SetpointController(task, gravity=gravity, latency=latency)


class WithoutTime(ControllerWrapper):
    """A controller that is not told when x was taken."""

    def __init__(self, controller):
        self.controller, self._memory = controller, 0

    def begin(self, measurement):
        """Return that of the controller."""
        return self.controller.begin(measurement._replace(t_x=None))

    def advance(self, state, measurement, target, dt):
        """Return what the controller does."""
        return self.controller.advance(state, measurement._replace(t_x=None), target, dt)


def run_case(case):
    """Run one case."""
    setup, begun = case.setup, time.perf_counter()
    plant = setup.plant()
    controller = controller_of(case, plant)
    target = setup.circle(plant) if case.circle else setup.target(plant)
    if case.law == FIXED and case.circle:
        target = AtRest(target)
    asked, last = [0.0], [None]

    def look(loop):
        asked[0] = max(asked[0], float(np.max(np.abs(loop.answer.torque) / plant.motor_limits)))
        last[0] = loop.state

    # of another delay nobody says when x was taken
    sent = controller if case.delay == DELAY else WithoutTime(controller)
    try:
        run = aj.simulate(
            plant,
            sent,
            target,
            setup.q0,
            case.duration,
            dt=DT,
            record_every=5 * DT,
            computation=aj.simulation.Computation("semi_implicit_euler"),
            seed=setup.seed,
            observer=look,
        )
    except aj.errors.SimulationError as error:
        return Outcome(case, reason=str(error))
    windows = {w: tracks.rms(run, *w) for w in WINDOWS if w[1] <= case.duration + 1e-9}
    nees = chi2 = math.nan
    if case.law == LEARNT:
        report = controller.kinematics.report(last[0][-controller.kinematics.n_state :])
        nees, chi2 = nees_of_tool(controller.kinematics, report, plant), report.chi_squared
    norm = 1e3 * run.error_norm
    return Outcome(
        case, windows, float(norm[0]), float(norm.max()), asked[0], nees, chi2,
        time.perf_counter() - begun,
    )  # fmt: skip


def nees_of_tool(kinematics, report, plant):
    """Return dᵀP⁻¹d of the error d of the tool's translation, with P its covariance."""
    rows = [kinematics.names.index(f"tool.{axis}") for axis in "xyz"]
    regressor = aj.robots.KinematicRegressor(plant.robot)
    true = regressor.theta[[regressor.names.index(f"tool.{axis}") for axis in "xyz"]]
    d = np.array([report.rows[i].value for i in rows]) - true
    return float(d @ np.linalg.solve(report.covariance[np.ix_(rows, rows)], d))


def cases(seeds):
    """Return all cases, with what is wanted of those that learn."""
    p60, half_turn, ur5 = Setup(), Setup(yaw=math.pi), Setup("ur5")
    found = []
    for law in LAWS:
        learns = law in (LEARNT, ON_X)
        for circle in (False, True):
            most = ((6.0, 2.0), (11.0, 1.5), (20.0, 1.5)) if circle else ((6.0, 1.5), (11.0, 1.0))
            whole = Case("60°", p60, circle, law, 20.0, most=most if learns else ())
            found.append(whole)
            least = ((6.0, 2.0),) if learns else ()
            found.append(Case("180°", half_turn, circle, law, most=least))
            found.append(Case("ur5, 60°", ur5, circle, law, most=least))
    for delay in (0.02, 0.0):
        most = ((6.0, 4.0), (11.0, 4.0)) if delay else ()
        found.append(
            Case(f"30 ms believed {1e3 * delay:.0f}", p60, True, LEARNT, 11.0, delay, most)
        )
    most = ((6.0, 3.0), (11.0, 1.5))
    found.append(Case("axes tilted by 2°", Setup(axes=TILTED), True, LEARNT, most=most))
    found += [Case("drawn", drawn(seed), True, LEARNT, 8.0, most=((8.0, 4.0),)) for seed in seeds]
    return found


def drawn(seed):
    """Return a Panda's circle with yaw, tilt, directions and centre drawn by a seed."""
    rng = np.random.default_rng([77, seed])
    tilt = math.radians(30.0) * rng.uniform(-1.0, 1.0, 2)
    way = np.array([0.10, -0.15, 0.12]) + rng.uniform(-0.05, 0.05, 3)
    return Setup(
        yaw=rng.uniform(-math.pi, math.pi), tilt=tuple(tilt), seed=100 + seed, way=tuple(way)
    )


def shortcomings(outcomes):
    """Return what fell short of what is wanted; nothing if nothing did."""
    found = []
    for o in outcomes:
        name = f"{o.case.name}, {'circle' if o.case.circle else 'set-point'}, {o.case.law}"
        if o.reason:
            found += [f"{name}: {o.reason}"] if o.case.most else []
        windows = {end: value for (_, end), value in o.rms.items()}
        for end, most in o.case.most:
            if not windows.get(end, math.inf) <= most:
                found.append(f"{name}: {windows.get(end, math.inf):.2f} mm, {most:g} wanted")
    return found


def table(outcomes):
    """Return the outcomes as lines of Markdown."""
    lines = head(
        "unknown", "target", "law", *(f"{a:g}–{b:g} s" for a, b in WINDOWS), "first, largest error",
        "asked of the motors",
    )  # fmt: skip
    for o in (o for o in outcomes if o.case.name != "drawn"):
        windows = [f"{o.rms[w]:.2f} mm" if w in o.rms else "–" for w in WINDOWS]
        size = f"{o.first:.0f}, {o.largest:.0f} mm"
        kind = "circle" if o.case.circle else "set-point"
        lines.append(row(o.case.name, kind, o.case.law, *windows, size, f"{o.asked:.2f}"))
    return lines


def of_drawn(outcomes):
    """Return a line on the circles that were drawn."""
    mine = [o for o in outcomes if o.case.name == "drawn"]
    if not mine:
        return []
    last = [o.rms.get((7.0, 8.0), math.inf) for o in mine]
    nees = np.array([o.nees for o in mine])
    return [
        "",
        f"Of {len(mine)} circles with tracker, origins, centre and noise drawn, RMS of 7 to 8 s: "
        f"median {np.median(last):.2f} mm, worst {max(last):.2f} mm; normalized squared error of "
        f"the tool (3 coordinates): median {np.median(nees):.2f}, {(nees > 7.8).sum()} beyond 7.8.",
    ]


def main(arguments=None):
    """Run the study; return the exit code."""
    options = parser(__doc__, "results/track")
    options.add_argument("--seeds", nargs="+", type=int, default=range(12), help="of the circles")
    options.add_argument("--names", nargs="+", help="of the cases, all by default")
    options.add_argument("--laws", nargs="+", default=list(LAWS), choices=LAWS)
    given = options.parse_args(arguments)
    chosen = [
        case
        for case in cases(given.seeds)
        if case.law in given.laws and (not given.names or case.name in given.names)
    ]
    outcomes = run_all(run_case, chosen[: 2 if given.quick else None], given.jobs)
    lines = [*table(outcomes), *of_drawn(outcomes)]
    kept = [o._replace(rms=[*o.rms.values()], case=repr(o.case)) for o in outcomes]
    write(given.out, {"track.md": "\n".join(lines) + "\n"}, {"runs": kept})
    short = shortcomings(outcomes)
    print("\n".join(f"fell short: {text}" for text in short) or "all kept")
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
