"""Keep limits of speeds and positions while gravity is learnt, against clipping and known gravity.

Two parts on five arms, each on the plant that the controller believes ("exact") and on one with
an unknown tool ("tool"). *States*: an arm at a random configuration and velocity, with a θ̂ that is
wrong at random, is sent to a random target for 0.1 s; a tenth of them with the tool, and for
what it is compared with. *Reaches*: from rest, with θ̂(0) of the belief, for 2.5 s. Half of the
targets are out of reach. The plants have no joint stops, which would hide what was not kept.

A state counts as one that limits can be kept from where every joint that moves towards its stop
can brake before it with the deceleration that its motors surely have (`sure_deceleration`). Others
are told apart, and what they say in the first step is counted. States are the same for each
settling time.

    python examples/studies/limits_while_learning.py --out results/limits_while_learning

Exit code 1 means that on the plant that the controller believes, from a start that counts, a joint
was faster than 1.05 × its limit or further than 0.01 rad beyond a position limit; or that it was
from another start, and the first step or the one in which it was is said FREE.
"""

import math
import sys
from functools import cache
from itertools import chain, product
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import usual_limiters
from common import carried_object, head, parser, row, run_all, write

import approxjac as aj
from approxjac.controllers import RegressorGravity
from approxjac.controllers.limits.limits import sure_deceleration
from approxjac.robots import GravityRegressor
from approxjac.scenario.starts import regular_configuration
from approxjac.simulation.plant import rk4

ROBOTS = ("xarm7", "ur5", "panda", "kinova", "tiago_arm")
SETTLING_TIMES = (0.3, 0.5, 1.0, 2.0)
PLANTS = ("exact", "tool")
LIMITERS = ("limited", "known", "clipped")  # "known" is limited, with gravity known exactly
FASTEST, FURTHEST = 1.05, 0.01  # share of the limit, and [rad or m]
WRONG = 0.3  # of the efforts: how wrong the torque of a random θ̂ is
DT = 1e-3


class Case(NamedTuple):
    """Random states, or a reach, of one arm."""

    robot: str
    plant: str
    settling_time: float
    limiter: str
    seed: int
    states: int  # 0 is a reach
    duration: float


class Outcome(NamedTuple):
    """What became of one start."""

    case: Case
    far: bool  # the target is out of reach
    counts: bool  # limits can be kept from the start
    speed: float  # the largest, as a share of its limit
    beyond: float  # the furthest that a joint was beyond its position limits [rad or m]
    first: str  # LimitStatus of the first step
    broken: str  # LimitStatus of the first step in which a limit was broken by more than allowed
    error: float  # at the end [m]


@cache
def law_of(robot, settling_time):
    """Return the law that learns gravity, tuned by the rule for a loop with ideal sensors."""
    belief = aj.load_robot(robot).with_object(0.0)
    return aj.SetpointController(
        aj.PositionTask(belief), gravity=aj.AdaptiveGravity(belief), settling_time=settling_time
    )


@cache
def arm(robot, plant, settling_time, limiter):
    """Return the plant, without joint stops, and the limited law."""
    length, mass = carried_object(robot)
    law = law_of(robot, settling_time)
    belief = law.task.robot
    tool = aj.load_robot(robot).with_object(length, mass, axis="x")
    truth = belief if plant == "exact" else tool
    if limiter == "known":
        regressor = GravityRegressor(belief)
        law = law.with_gravity(RegressorGravity(regressor, regressor.fit(truth)[0]))
    limits = aj.Limits.of(belief)
    clipped = limiter == "clipped"
    limited = (
        usual_limiters.clipped(law, limits)
        if clipped
        else aj.TorqueLimited(law, limits, braking=0.3 / DT)
    )
    sensor = aj.PositionTask(truth)
    motors = aj.Plant(truth, sensor, torque_limits=belief.effort_limits, joint_limits=False)
    return motors, limited


def run_case(case):
    """Run all starts of a case."""
    plant, limited = arm(case.robot, case.plant, case.settling_time, case.limiter)
    rng = np.random.default_rng([case.seed, ROBOTS.index(case.robot)])
    return [run_start(case, plant, limited, rng) for _ in range(case.states or 1)]


def run_start(case, plant, limited, rng):
    """Draw a start and a target, and follow the arm."""
    truth, sensor, belief = plant.robot, plant.sensor, limited.task.robot
    far = bool(rng.integers(2))
    goal = sensor.value(truth.random_configuration(rng))
    if far:
        base, reach = truth.reach_bound(sensor.frame)
        away = goal - base
        goal = base + away * (rng.uniform(1.1, 1.5) * min(reach, 3.0) / np.linalg.norm(away))
    v = np.zeros(truth.nv)
    if case.states:
        q = truth.random_configuration(rng)
        v = rng.uniform(-1.0, 1.0, truth.nv) * np.minimum(belief.velocity_limits, 3.0)
    else:
        q = regular_configuration(sensor, limited.task, rng)
    measurement = plant.measure(0.0, q, v)
    state = limited.initial_state(measurement)
    learning = limited.controller.adaptation
    if case.states and learning is not None:
        theta = rng.normal(size=learning.regressor.p)
        torque = learning.regressor.Z(q) @ theta
        share = rng.uniform(0.0, WRONG) / np.max(np.abs(torque) / belief.effort_limits)
        state[: len(theta)] += share * theta
    return follow(case, plant, limited, state, measurement, goal, far)


def follow(case, plant, limited, state, measurement, goal, far):
    """Run the loop and keep the extremes; the first instant is the start, which is given."""
    limits = aj.Limits.of(limited.task.robot).for_joints(plant.robot.nv)
    low, high = limits.position
    counts = can_stop(limited.task.robot, limits, measurement)
    speed = beyond = 0.0
    first = broken = ""
    for k in range(round(case.duration / DT)):
        q, v = measurement.q, measurement.v
        state, answer = limited.step(state, measurement, goal, DT)
        first = first or answer.limit_status.name
        here = motion(plant.robot, q)
        ratio = np.max(np.abs(v) / limits.velocity)
        excess = max((low - here).max(), (here - high).max())
        if k:
            speed, beyond = max(speed, ratio), max(beyond, excess)
        if not broken and (ratio > FASTEST or excess > FURTHEST):
            broken = answer.limit_status.name
        q, v, _ = plant.advance(q, v, answer.torque, DT, rk4)
        measurement = plant.measure((k + 1) * DT, q, v)
    error = float(np.linalg.norm(measurement.x - goal))
    return Outcome(case, far, counts, float(speed), float(beyond), first, broken, error)


def motion(robot, q):
    """Return joint positions (n_v,) of a configuration (nq,)."""
    return q if robot.nq == robot.nv else pin.difference(robot.model, robot.neutral(), q)


@cache
def deceleration(robot):
    """Return how fast the motors of a robot surely brake each joint."""
    return sure_deceleration(robot, robot.effort_limits)


def can_stop(robot, limits, measurement):
    """Return whether every joint is within its limits and can brake before its stop."""
    v, here = measurement.v, motion(robot, measurement.q)
    low, high = limits.position
    room = np.where(v > 0.0, high - here, here - low)
    within = (np.abs(v) <= limits.velocity).all() and (room >= 0.0).all()
    return bool(within and (v * v <= 2.0 * deceleration(robot) * room).all())


# -- tables ---------------------------------------------------------------------------------------


def table(outcomes):
    """Return what became of the limits, by part, plant and limiter, as Markdown."""
    lines = []
    for is_state, title in ((True, "Random states"), (False, "Reaches")):
        mine = [o for o in outcomes if (o.case.states > 0) == is_state]
        lines += [f"{title}:", ""]
        lines += head(
            "plant", "limiter", "starts", "FREE at first", "broken", "of these FREE",
            "speed / limit, largest", "99 %", "beyond position limits, largest [rad]", "99 %",
        )  # fmt: skip
        for plant, limiter in product(PLANTS, LIMITERS):
            for counts in (True, False):
                group = [
                    o for o in mine
                    if (o.case.plant, o.case.limiter, o.counts) == (plant, limiter, counts)
                ]  # fmt: skip
                if group:
                    name = limiter if counts else f"{limiter}, not sure to stop"
                    lines.append(row(plant, name, *numbers(group)))
        lines.append("")
    lines += ["The largest by arm with *limited*, from starts that count (states; reaches):", ""]
    lines += head("arm", *(f"{plant}, {what}" for plant in PLANTS for what in ("speed", "beyond")))
    for robot in dict.fromkeys(o.case.robot for o in outcomes):
        cells = (
            "; ".join(
                f"{largest(outcomes, robot, plant, what, part):.3f}" for part in (True, False)
            )
            for plant, what in product(PLANTS, ("speed", "beyond"))
        )
        lines.append(row(robot, *cells))
    return "\n".join(lines) + "\n"


def largest(outcomes, robot, plant, what, are_states):
    """Return the largest speed or excess of an arm that is limited; NaN of none."""
    mine = [o for o in outcomes if o.counts and (o.case.states > 0) == are_states]
    kind = (robot, plant, "limited")
    found = (getattr(o, what) for o in mine if (o.case.robot, o.case.plant, o.case.limiter) == kind)
    return max(found, default=math.nan)


def numbers(group):
    """Return the cells of one row."""
    speeds, beyond = ([getattr(o, name) for o in group] for name in ("speed", "beyond"))
    broken = [o for o in group if o.broken]
    free = sum(o.broken == "FREE" for o in broken)
    cells = (
        f"{value:.3f}"
        for values in (speeds, beyond)
        for value in (max(values), np.quantile(values, 0.99))
    )
    return len(group), sum(o.first == "FREE" for o in group), len(broken), free, *cells


def shortcomings(outcomes):
    """Return where a limit that can be kept was not, on the plant that the controller believes."""
    found = []
    for o in outcomes:
        if o.case.plant != "exact" or o.case.limiter == "clipped":
            continue
        if o.counts and o.broken:
            found.append(f"{o.case}: {o.speed:.3f} × the speed, {o.beyond:.4f} rad, {o.broken}")
        elif o.broken and "FREE" in (o.first, o.broken):
            found.append(f"{o.case}: broken from a start that is not sure to stop, but said FREE")
    return found


def number(states, plant, limiter):
    """Return how many states there are of a kind: fewer of what is there for comparison."""
    return states if (plant, limiter) == ("exact", "limited") else max(1, states // 10)


def main(arguments=None):
    """Run the study; return the exit code."""
    options = parser(__doc__, "results/limits_while_learning")
    options.add_argument("--robots", nargs="+", default=ROBOTS)
    options.add_argument("--states", type=int, default=10_000, help="random states, of all arms")
    options.add_argument("--reaches", type=int, default=100, help="reaches, of all arms")
    options.add_argument("--limiters", nargs="+", default=LIMITERS)
    given = options.parse_args(arguments)
    kinds = list(product(given.robots, SETTLING_TIMES))
    states, reaches = (200, 20) if given.quick else (given.states, given.reaches)
    cases = [
        Case(robot, plant, settling, limiter, seed, count, duration)
        for plant, limiter in product(PLANTS, given.limiters)
        for robot, settling in kinds
        for seed, count, duration in [
            (0, number(states // len(kinds), plant, limiter), 0.1),
            *((1 + k, 0, 2.5) for k in range(reaches // len(kinds))),
        ]
    ]
    outcomes = list(chain.from_iterable(run_all(run_case, cases, given.jobs)))
    short = shortcomings(outcomes)
    text = table(outcomes)
    write(given.out, {"limits_while_learning.md": text}, {"shortcomings": short, "runs": outcomes})
    print("\n".join(f"fell short: {text}" for text in short) or "all kept")
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main())
