"""Reaches of the studies: random starts and targets of an arm with an unmodelled tool.

They are scenarios with all defaults, run as `approxjac simulate` runs them.
"""

import math
from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from common import head, row, two_digits

import approxjac as aj
from approxjac.robots.meshes import share_dir
from approxjac.scenario import Scenario, run_scenario

ARMS = (
    "panda", "ur3", "ur5", "ur10", "kinova", "xarm7", "talos_arm", "z1", "so101", "tiago_arm",
)  # fmt: skip
SMALL = {"z1": (0.15, 0.3), "so100": (0.10, 0.1), "so101": (0.10, 0.1)}  # tools of small arms
OTHERS = (  # of example-robot-data, on which nothing was chosen: file, tip
    "alex_description/urdf/alex_nub_hands.urdf:LeftGripperYawLink",
    "centauro_description/urdf/centauro.urdf:arm1_8",
    "g1_description/urdf/g1_29dof_rev_1_0.urdf:left_wrist_yaw_link",
    "romeo_description/urdf/romeo.urdf:l_wrist",
    "tiago_pro_description/robots/tiago_pro.urdf:arm_left_tool_link",
)
DONE = 1e-3  # [m]
SOON = 4.0  # [s]
AT_STOP = 0.02  # a joint as near to its end as this is at it [rad or m]
EVERY = 5  # steps of which the torque that the law asks for is looked at


class Case(NamedTuple):
    """One reach: an arm, the seed of start and target, and how it is run."""

    robot: str
    seed: int
    kind: str  # what a study tells apart, such as whether limits are kept
    duration: float = 10.0  # [s]


class Outcome(NamedTuple):
    """What became of one reach."""

    case: Case
    start_error: float = math.nan  # [m]
    final_error: float = math.inf  # [m]
    time: float = math.nan  # from which on the error is below 1 mm [s]
    first: float = math.nan  # at which it is below 1 mm for the first time [s]
    near: float = math.nan  # from which on it is below 5 mm [s]
    rms: float = math.inf  # of the error over the last 2 s [m]
    mean: float = math.inf  # of the error over the last 2 s [m]
    worst: float = math.inf  # error in the last 2 s [m]
    overshoot: float = math.nan  # largest distance beyond the target, along the way to it [m]
    asked: float = math.nan  # largest torque of the law, as a share of the motor's
    speed: float = math.nan  # largest speed as a share of the joint's limit
    beyond: float = math.nan  # distance of a joint beyond its position limits at most [rad or m]
    stops: str = ""  # joints at their ends when the run ended, by name
    limited: float = 0.0  # share of the steps in which a limit changed the torque
    statuses: dict = {}  # noqa: RUF012 - steps by name of the status or limit status, never changed
    reason: str = ""  # that it is not done


def tool(robot):
    """Return length [m] and mass [kg] of the tool of an arm."""
    return SMALL.get(robot, (0.20, 0.5))


def scenario(case, **more):
    """Return the scenario of a reach; further tables are those of `Scenario`."""
    length, mass = tool(case.robot)
    more["true"] = {"object": {"length": length, "mass": mass}} | more.get("true", {})
    run = {"start": "random", "duration": case.duration, "seed": case.seed}
    more["run"] = run | more.get("run", {})
    robot, *parts = case.robot.split(":")
    if parts:
        robot = str(share_dir() / "example-robot-data/robots" / robot)
    return Scenario(robot, **dict(zip(("tip", "base"), parts, strict=False)), **more)


def without_stops(built):
    """Return a reach whose joints do not stop at their ends."""
    plant = built.plant
    free = aj.Plant(
        plant.robot, plant.sensor, sensing=plant.sensing, actuator_delay=plant.actuator_delay,
        torque_limits=plant.torque_limits, joint_limits=False,
    )  # fmt: skip
    return replace(built, plant=free)


def run(case, built):
    """Run a reach that was built and measure it; one that diverges is an outcome too."""
    tally = Tally(built)
    try:
        result = run_scenario(built, observer=tally)
    except aj.errors.SimulationError as error:
        return Outcome(case, reason=f"{error}", asked=tally.asked)
    record, steps = result.run, max(1, tally.counts.total())
    norm, last = record.error_norm, record.t > record.t[-1] - 2.0
    ends = built.plant.robot.beyond_limits(record.q)
    limits = built.plant.robot.velocity_limits
    way = record.error @ record.error[0] / norm[0]  # what is left of the way to the target
    return Outcome(
        case,
        start_error=float(norm[0]),
        final_error=float(norm[-1]),
        time=time_within(record, DONE),
        first=float(min(record.t[norm <= DONE], default=math.nan)),
        near=time_within(record, 5.0 * DONE),
        rms=float(np.sqrt(np.mean(norm[last] ** 2))),
        mean=float(np.mean(norm[last])),
        worst=float(norm[last].max()),
        overshoot=max(0.0, -float(way.min())),
        asked=tally.asked,
        speed=float((np.abs(record.v) / limits).max()),
        beyond=max(0.0, float(ends.max())),
        stops=", ".join(np.array(record.joint_names)[ends[-1] > -AT_STOP]),
        limited=sum(n for name, n in tally.counts.items() if name not in FREELY) / steps,
        statuses=dict(tally.counts + tally.said),
        reason=result.reason if built.controller.law is built.law else "",
    )


FREELY = ("UNLIMITED", "FREE")


def time_within(record, tolerance):
    """Return the first recorded time from which on the error stays within a tolerance, or NaN."""
    outside = np.nonzero(~(record.error_norm <= tolerance))[0]
    if len(outside) == 0:
        return 0.0
    return float(np.append(record.t, math.nan)[outside[-1] + 1])


class Tally:
    """An observer of what the law asks of the motors, before limits, and of what limits did."""

    def __init__(self, built):
        self.law, self.motors = built.controller.law, built.plant.motor_limits
        self.asked, self.counts, self.said = 0.0, Counter(), Counter()

    def __call__(self, loop):
        """Look at a step."""
        answer = loop.answer
        self.counts[answer.limit_status.name] += 1
        self.said[answer.status.name] += 1
        torque = answer.torque
        if loop.controller is not self.law:
            if loop.controller.kinematics is not self.law.kinematics:  # its x is predicted
                self.asked = math.nan
            if loop.step % EVERY or math.isnan(self.asked):
                return
            state = loop.state[: self.law.size]
            torque = self.law.step(state, loop.measurement, loop.target, loop.dt)[1].torque
        self.asked = max(self.asked, float(np.max(np.abs(torque) / self.motors)))


# -- tables ---------------------------------------------------------------------------------------

COLUMNS = (
    "runs", "1 mm within 4 s", "within 10 s", "median", "overshoot, 90 % of runs",
    "asked of the motors, 90 % (most)", "above 1", "speed, most", "beyond joint ends, most",
)  # fmt: skip


def cells(mine):
    """Return the cells of COLUMNS for some outcomes."""
    times = [o.time for o in mine if math.isfinite(o.time)]
    asked = [o.asked for o in mine if math.isfinite(o.asked)]
    return (
        len(mine),
        share(o.time <= SOON for o in mine),
        share(math.isfinite(o.time) for o in mine),
        f"{np.median(times):.2f} s" if times else "–",
        f"{1e3 * quantile([o.overshoot for o in mine]):.0f} mm",
        f"{quantile(asked):.2f} ({max(asked):.2f})" if asked else "–",
        share(o.asked > 1.0 for o in mine),
        f"{max((o.speed for o in mine if math.isfinite(o.speed)), default=math.nan):.2f}",
        f"{max((o.beyond for o in mine if math.isfinite(o.beyond)), default=math.nan):.2f} rad",
    )


def share(flags):
    """Return how many of some are true, and as a percentage."""
    flags = list(flags)
    return f"{sum(flags)} ({100.0 * sum(flags) / max(1, len(flags)):.0f} %)"


def quantile(values, q=0.9):
    """Return a quantile of the finite numbers; NaN of none."""
    finite = [value for value in values if math.isfinite(value)]
    return float(np.quantile(finite, q)) if finite else math.nan


def table(outcomes, label):
    """Return all outcomes and those of each arm as lines of Markdown, a kind after the other."""
    lines = head(label, "arm", *COLUMNS)
    for kind in dict.fromkeys(o.case.kind for o in outcomes):
        mine = [o for o in outcomes if o.case.kind == kind]
        lines.append(row(f"**{kind}**", "**all**", *cells(mine)))
        for robot in dict.fromkeys(o.case.robot for o in mine):
            name = robot.split(":")[0].rpartition("/")[-1].removesuffix(".urdf")
            lines.append(row(kind, name, *cells([o for o in mine if o.case.robot == robot])))
    return lines


def failures(outcomes):
    """Return a line on each run that is not within 1 mm at its end."""
    lines = [failure(o) for o in outcomes if not math.isfinite(o.time)]
    return lines or ["- none"]


def failure(outcome):
    """Return a line on one run: how far it got, what its limits and joint ends did, and why."""
    case, told = outcome.case, []
    if math.isfinite(outcome.final_error):
        told.append(
            f"{1e3 * outcome.start_error:.0f} -> {two_digits(1e3 * outcome.final_error)} mm"
        )
    if outcome.stops:
        told.append(f"{outcome.stops} at the end of its range")
    if outcome.limited > 0.0:
        told.append(f"limited in {100.0 * outcome.limited:.0f} % of the steps")
    told.append(outcome.reason or "not within 1 mm to the end")
    return f"- {case.kind}, {case.robot}, seed {case.seed}: {'; '.join(told)}"
