"""Let things happen to arms that no threshold was chosen on, and see what a monitor calls them.

Each arm, with an unknown tool (20 cm, 0.5 kg), reaches for a random target under `aj.control`.
The plant is MuJoCo: forces act on its bodies, and the table is a contact with friction. Joints are
ideal, or as `Drives.usual` and `Friction.usual` have them (without static friction above Coulomb's
and friction by load, which MuJoCo has not), and then q̇ is filtered and x late and noisy. The table
gives how often the first name after the event is the right one (of a motor, with its joint; of a
load, with its sign), the median delay until then, and how far the tip was then from where it is in
the same run without, in the median and at most.

    python examples/studies/faults_held_out.py --out results/faults_held_out
"""

import functools
import math
import sys
from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np
import pinocchio as pin
from common import head, parser, row, run_all, write
from faults import DT, MASS, MOTORS, PUSH, TOOL, Broken, tolerances

import approxjac as aj
from approxjac.realtime import SimulatedDriver, Tolerances, control
from approxjac.robots import Drives, Friction
from approxjac.robots.meshes import share_dir

ROBOTS = "example-robot-data/robots"
ARMS = {  # file in example-robot-data, tip, base
    "pr2_left_arm": ("pr2_left_arm", None, None),
    "tiago_pro": ("tiago_pro_description/robots/tiago_pro.urdf", "arm_left_tool_link", None),
    "centauro": ("centauro_description/urdf/centauro.urdf", "arm1_8", "torso_2"),
    "g1": ("g1_description/urdf/g1_29dof_rev_1_0.urdf", "left_wrist_yaw_link", "torso_link"),
}
LOAD, DURATION, AWAY = 1.0, 3.0, 0.4  # kg, s, rad of each joint to the target at most
DEPTH, GAP = 0.12, 0.05  # m, of the target that is under the table; to the table from the start
SENSING = aj.Sensing(x_noise=5e-4, x_rate=60.0, x_delay=0.03, q_noise=1e-5, velocity_filter=2e-3)
KINDS = {  # what happens: how it is to be called
    "nothing": "",
    "a motor without power": "MOTOR_WEAK",
    "a motor reversed": "MOTOR_WEAK",
    "a motor at half its torque": "MOTOR_WEAK",
    "a push of 20 N for 1 s": "PUSHED",
    "the tip presses on a table": "PRESSES",
    "1 kg grasped": "TOOL_CHANGED",
    "1 kg dropped": "TOOL_CHANGED",
}
GRASPED, DROPPED, TABLE, PUSHED = "1 kg grasped", "1 kg dropped", *list(KINDS)[5:3:-1]


class Case(NamedTuple):
    """One run."""

    joints: str  # "ideal" or "usual"
    arm: str
    seed: int
    kind: str
    happens: bool = True


class Outcome(NamedTuple):
    """What it was called."""

    case: Case
    name: str  # the first one after the event; empty without
    where: str
    is_right: bool
    fault: str  # what ended the run
    before: str  # a name before the event
    after: float  # from the event to the name [s]
    moved: float  # tip, from where it would be without [m]


@functools.cache
def loaded(arm):
    """Return an arm by its name here, or by FILE:TIP."""
    source, tip, base = ARMS.get(arm) or (*arm.split(":"), None)
    path = share_dir() / ROBOTS / source
    return aj.load_robot(path if path.is_file() else source, tip=tip, base=base)


def plant_with(case, mass):
    """Return the true arm with a tool of a mass, and a table far below that only the tool meets."""
    arm = loaded(case.arm)
    truth, real = arm.with_object(TOOL, mass, axis="x"), {}
    if case.joints == "usual":
        friction = replace(Friction.usual(arm), stribeck=1.0, load=0.0)
        real = {"friction": friction, "drives": Drives.usual(arm), "sensing": SENSING}
    plant = aj.MujocoPlant(truth, floor=-5.0, **real)
    model = plant.mujoco_model
    model.geom_contype[model.geom_bodyid != model.body("object").id] = 0
    return plant


class Meddled(Broken):
    """A driver of an arm to which something happens, in MuJoCo itself."""

    def __init__(self, driver, case, at):
        super().__init__(driver, case.arm, case.kind if case.happens else "nothing", at, case.seed)
        if self.kind in (GRASPED, DROPPED):
            self.other = plant_with(case, MASS + LOAD * (self.kind == GRASPED))

    def broken(self, m):
        """Return a measurement as it is: no sensor breaks here."""
        return m

    def send(self, command):
        """Send a command, and let it happen."""
        driver, data = self.driver, self.driver.plant._mujoco_data
        if self.kind == TABLE and self.broken_at is None and not driver.plant._is_free(driver.q):
            self.broken_at = self.state()
        if self.broken_at is not None and self.kind in (GRASPED, DROPPED):
            driver.plant = self.other
        elif self.broken_at is not None and self.kind == PUSHED:
            body = driver.plant.mujoco_model.body("object").id
            force = PUSH * self.direction * (driver.t - self.broken_at[0] < 1.0)
            arm = self.tips[driver.samples] - data.xipos[body]
            data.xfrc_applied[body] = [*force, *np.cross(arm, force)]
        super().send(command)


def goal_of(case, plant, q0):
    """Return the target, which the motors can hold 1.5 kg at, and the height of the table."""
    rng, heavy = np.random.default_rng([36, case.seed]), plant_with(case, MASS + LOAD).dynamics
    x0 = plant.sensor.value(q0)
    while True:
        q = pin.integrate(plant.robot.model, q0, rng.uniform(-AWAY, AWAY, plant.robot.nv))
        goal = plant.sensor.value(q)
        holds = np.all(np.abs(heavy.g(q)) < 0.7 * plant.robot.effort_limits)
        if holds and (case.kind != TABLE or goal[2] < x0[2] - DEPTH):
            return goal


def set_table(plant, q0):
    """Move the table to below the tool."""
    model = plant.mujoco_model
    table = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)[0]
    model.geom_pos[table, 2] = plant.sensor.value(q0)[2] + TOOL
    while not plant._is_free(q0):
        model.geom_pos[table, 2] -= 0.005
    model.geom_pos[table, 2] -= GAP


@functools.cache
def ran(case):
    """Return the driver of a run, and the run."""
    plant = plant_with(case, MASS + LOAD * (case.kind == DROPPED))
    belief, is_usual = loaded(case.arm).with_object(0.0), case.joints == "usual"
    q0 = plant.ready_configuration()
    goal = goal_of(case, plant, q0)
    if case.kind == TABLE and case.happens:
        set_table(plant, q0)
    rng = np.random.default_rng([36, case.seed, list(KINDS).index(case.kind)])
    at = rng.uniform(0.25, 1.0) if case.kind in MOTORS else rng.uniform(0.6, 1.1)
    driver = SimulatedDriver(plant, q0, dt=DT, pace=math.inf, seed=case.seed)
    silent = case.kind in (TABLE, "nothing") or not case.happens
    meddled = Meddled(driver, case, math.inf if silent else at)
    latency = aj.Latency(period=DT, image_period=1 / 60, image_age=0.03, velocity_filter=2e-3)
    law = aj.SetpointController(
        aj.PositionTask(belief), gravity=aj.AdaptiveGravity(belief),
        latency=latency if is_usual else None, drives=None if is_usual else Drives(),
    )  # fmt: skip
    told = tolerances(plant)
    if is_usual:
        stiction = 0.07 * plant.robot.effort_limits
        accuracy = replace(told.accuracy, v=0.01, x=5e-4, velocity_filter=2e-3, stiction=stiction)
        told = Tolerances(accuracy, max_period=0.5)
    controller = aj.TorqueLimited(law, aj.Limits.of(belief))
    return meddled, control(meddled, controller, goal, DURATION, tolerances=told)


def outcome(case):
    """Run one case, and judge the name."""
    meddled, run = ran(case)
    first, joint = meddled.first, loaded(case.arm).joint_names[meddled.joint]
    t0 = meddled.broken_at[0] if meddled.broken_at else math.nan
    before = [e for e in run.events if not e.named + first > t0]
    after = [e for e in run.events if e.named + first > t0]
    told = str(before[0].condition.name) if before else ""
    if case.kind == "nothing" or not after:
        return Outcome(case, "", "", False, run.fault_name, told, math.nan, math.nan)
    event, named = after[0], after[0].named + first
    is_right = event.condition.name == KINDS[case.kind]
    if case.kind in MOTORS:
        is_right &= event.where == joint
    elif is_right and case.kind in (GRASPED, DROPPED):
        is_right = event.figure.startswith("+" if case.kind == GRASPED else "-")
    ways = ran(case._replace(happens=False))[0].tips
    k = round(named / DT)
    moved = float(np.linalg.norm(meddled.tips[k] - ways.get(k, ways[max(ways)])))
    name, where = event.condition.name, f"{event.where}: {event.figure}"
    return Outcome(case, name, where, is_right, run.fault_name, told, named - t0, moved)


def table(outcomes):
    """Return a row for each kind of joints and of events."""
    lines = head(
        "joints", "what happens", "named rightly", "wrongly", "not (of these stopped)",
        "a false name before", "median delay [ms]", "tip median, most [mm]", "wrong names",
    )  # fmt: skip
    for joints in ("ideal", "usual"):
        for kind in KINDS:
            of = [o for o in outcomes if (o.case.joints, o.case.kind) == (joints, kind)]
            right, none = [o for o in of if o.is_right], [o for o in of if not o.name]
            wrong = [o for o in of if o.name and not o.is_right]
            names = Counter(
                [o.name for o in wrong] + [f"{o.before} before" for o in of if o.before]
            )
            delay, tip = "", ""
            if right:
                delay = f"{1e3 * np.median([o.after for o in right]):.0f}"
                moved = 1e3 * np.array([o.moved for o in right])
                tip = f"{np.median(moved):.1f}, {moved.max():.1f}"
            lines.append(
                row(
                    joints,
                    kind,
                    f"{len(right)} of {len(of)}",
                    len(wrong),
                    f"{len(none)} ({sum(bool(o.fault) for o in none)})",
                    sum(bool(o.before) for o in of),
                    delay,
                    tip,
                    ", ".join(f"{name} {n}" for name, n in sorted(names.items())),
                )  # fmt: skip
            )
    return "\n".join(lines) + "\n"


def main(arguments=None):
    """Run all cases and write the table."""
    options = parser(__doc__, "results/faults_held_out")
    options.add_argument("--seeds", type=int, default=3)
    options.add_argument("--arms", nargs="+", default=list(ARMS), help="names, or FILE:TIP")
    args = options.parse_args(arguments)
    seeds = 1 if args.quick else args.seeds
    cases = [
        Case(j, a, s, k)
        for j in ("ideal", "usual")
        for a in args.arms
        for s in range(seeds)
        for k in KINDS
    ]
    outcomes = run_all(outcome, cases, args.jobs)
    write(args.out, {"faults_held_out.md": table(outcomes)}, {"outcomes": outcomes})
    return 0


if __name__ == "__main__":
    sys.exit(main())
