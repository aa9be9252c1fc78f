"""Let things happen to arms that no threshold was chosen on, and see what a monitor names.

As in `faults.py`, but in MuJoCo itself: forces act on its bodies, the table is a contact. Joints
are ideal, or as `Drives.usual` and `Friction.usual` have them as far as MuJoCo can, with q̇ filtered
and x late. The law is the one that `approxjac simulate` takes. *Rightly*: the first name after the
event is right, with joint or sign, of the runs that had not ended before; delay and motion of the
tip (from the same run without) are their medians.

    python examples/studies/faults_held_out.py --out results/faults_held_out
"""

import functools
import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pinocchio as pin
from common import head, parser, row, run_all, write
from faults import DT, MASS, MOTORS, PUSH, TOOL, Broken, controller_of, tolerances

import approxjac as aj
from approxjac.robots.meshes import share_dir

ARMS = (  # files of example-robot-data, tip, base
    "pr2_description/urdf/pr2.urdf:l_gripper_tool_frame:torso_lift_link",
    "tiago_pro_description/robots/tiago_pro.urdf:arm_left_tool_link:",
    "centauro_description/urdf/centauro.urdf:arm1_8:torso_2",
    "g1_description/urdf/g1_29dof_rev_1_0.urdf:left_wrist_yaw_link:torso_link",
)
JOINTS = "ideal", "usual"
REST, DEAD, PUSHED, TABLE = "nothing", MOTORS[1], "a push of 20 N for 1 s", "a table in the way"
LOADS = {"1 kg grasped": "+", "1 kg dropped": "-"}
KINDS = REST, DEAD, MOTORS[0], MOTORS[2], PUSHED, TABLE, *LOADS
NAMES = ["", *3 * ["MOTOR_WEAK"], "PUSHED", "PRESSES", *2 * ["TOOL_CHANGED"]]
SENSING = aj.Sensing(x_noise=5e-4, x_rate=60.0, x_delay=0.03, q_noise=1e-5, velocity_filter=2e-3)
LATENCY = aj.Latency(image_period=1 / 60, image_age=0.03, velocity_filter=2e-3)


def plant_with(joints, arm, mass):
    """Return the believed arm, and the true one with a tool; only that meets a table, far below."""
    name, tip, base = arm.split(":")
    path = share_dir() / "example-robot-data/robots" / name
    robot = aj.load_robot(path, tip=tip, base=base or None)
    friction = replace(aj.robots.Friction.usual(robot), stribeck=1.0, load=0.0)
    usual = {"friction": friction, "drives": aj.robots.Drives.usual(robot), "sensing": SENSING}
    real = usual if joints == "usual" else {}
    plant = aj.MujocoPlant(robot.with_object(TOOL, mass, axis="x"), floor=-5.0, **real)
    model = plant.mujoco_model
    model.geom_contype[model.geom_bodyid != model.body("object").id] = 0
    return robot.with_object(0.0), plant


class Meddled(Broken):
    """A driver of an arm to which something happens, at a time or when it meets the table."""

    other, broken = None, lambda _, measured: measured

    def send(self, command):
        """Send a command, and let it happen."""
        driver, data = self.driver, self.driver.plant._mujoco_data
        if self.kind == TABLE and self.broken_at is None and not driver.plant._is_free(driver.q):
            self.broken_at = self.state()
        if self.broken_at is not None and self.other is not None:
            driver.plant = self.other
        elif self.broken_at is not None and self.kind == PUSHED:
            body = driver.plant.mujoco_model.body("object").id
            force = PUSH * self.direction * (driver.t - self.broken_at[0] < 1.0)
            arm = self.tips[driver.samples] - data.xipos[body]
            data.xfrc_applied[body] = [*force, *np.cross(arm, force)]
        super().send(command)


@functools.cache
def ran(joints, arm, seed, kind, happens=True):
    """Return the driver of a run, and the run."""
    (_, light), (belief, heavy) = (plant_with(joints, arm, MASS + m) for m in (0.0, 1.0))
    plant, other = (heavy, light) if LOADS.get(kind) == "-" else (light, heavy)
    q0, rng = plant.ready_configuration(), np.random.default_rng([36, seed])
    x0, effort, goal = plant.sensor.value(q0), plant.robot.effort_limits, None
    while goal is None or (kind == TABLE and goal[2] > x0[2] - 0.12):  # under the table
        q = pin.integrate(plant.robot.model, q0, rng.uniform(-0.4, 0.4, plant.robot.nv))
        if (np.abs(heavy.dynamics.g(q)) < 0.7 * effort).all():  # motors can hold it
            goal = plant.sensor.value(q)
    if kind == TABLE and happens:
        heights, floor = plant.mujoco_model.geom_pos[:, 2], plant.mujoco_model.geom_type.argmin()
        heights[floor] = x0[2] + TOOL
        while not plant._is_free(q0):
            heights[floor] -= 0.005
        heights[floor] -= 0.05
    rng = np.random.default_rng([36, seed, KINDS.index(kind)])
    at = rng.uniform(0.25, 1.0) if kind in MOTORS else rng.uniform(0.6, 1.1)
    at = at if happens and kind not in (TABLE, REST) else math.inf
    driver = aj.realtime.SimulatedDriver(plant, q0, dt=DT, pace=math.inf, seed=seed)
    meddled = Meddled(driver, arm, kind if happens else REST, at, seed)
    meddled.other = other if kind in LOADS else None
    told, known = tolerances(plant), {"drives": aj.robots.Drives()}
    if joints == "usual":
        of = {"v": 0.01, "x": 5e-4, "velocity_filter": 2e-3, "stiction": 0.07 * effort}
        told = aj.realtime.Tolerances(replace(told.accuracy, **of), max_period=0.5)
        known = {"latency": LATENCY}
    controller = controller_of(belief, "tracking", **known)
    return meddled, aj.realtime.control(meddled, controller, goal, 3.0, tolerances=told)


def judged(case):
    """Return verdict, names, whether it stopped, delay [ms] and motion of the tip [mm]."""
    (meddled, run), kind = ran(*case), case[3]
    t0 = meddled.broken_at[0] if meddled.broken_at else math.inf
    after = [e for e in run.events if e.named + meddled.first > t0]
    when = "" if kind == REST else " before"
    names = [f"{e.condition.name}{when}" for e in run.events if e not in after]
    if not after:
        verdict = "never" if math.isinf(t0) else "not"
        if kind == REST:
            verdict = "wrongly" if names else "not" if run.fault_name else "rightly"
        return verdict, names, bool(run.fault_name), 0.0, 0.0
    event, joint = after[0], meddled.driver.plant.robot.joint_names[meddled.joint]
    name, sign = NAMES[KINDS.index(kind)], LOADS.get(kind, "")
    is_right = event.condition.name == name and event.figure.startswith(sign)
    is_right &= event.where == joint or kind not in MOTORS
    delay, tips = event.named + meddled.first - t0, ran(*case, happens=False)[0].tips
    k = round((t0 + delay) / DT)
    away = 1e3 * float(np.linalg.norm(meddled.tips[k] - tips.get(k, tips[max(tips)])))
    names += [] if is_right else [event.condition.name]
    return "rightly" if is_right else "wrongly", names, bool(run.fault_name), 1e3 * delay, away


def table(outcomes):
    """Return a row for each kind of joints and of events."""
    columns = "rightly", "wrongly", "not (stopped)", "delay [ms]", "tip [mm]", "false names"
    lines = head("joints", "what happens", *columns)
    for group in [(j, k) for j in JOINTS for k in KINDS]:
        every = [o for c, o in outcomes.items() if (c[0], c[3]) == group]
        of = [o for o in every if o[0] != "never"]  # it happened before the run had ended
        right, wrong, none = ([o for o in of if o[0] == v] for v in ("rightly", "wrongly", "not"))
        names = sorted(Counter(name for o in every for name in {*o[1]}).items())
        sizes = [[o[i] for o in right if group[1] != REST] for i in (3, 4)]
        medians = [f"{np.median(each):.0f}" if each else "" for each in sizes]
        missed = f"{len(none)} ({sum(o[2] for o in none)})"
        told = ", ".join(f"{name} {n}" for name, n in names)
        lines.append(row(*group, f"{len(right)} of {len(of)}", len(wrong), missed, *medians, told))
    return "\n".join(lines) + "\n"


def main():
    """Run all cases and write the table."""
    options = parser(__doc__, "results/faults_held_out")
    options.add_argument("--arms", nargs="+", default=ARMS, help="each FILE:TIP:BASE")
    args = options.parse_args()
    seeds = range(1 if args.quick else 3)
    cases = [(j, a, s, k) for j in JOINTS for a in args.arms for s in seeds for k in KINDS]
    outcomes = dict(zip(cases, run_all(judged, cases, args.jobs), strict=True))
    rows = [[*case, *outcome] for case, outcome in outcomes.items()]
    write(args.out, {"faults_held_out.md": table(outcomes)}, {"runs": rows})


if __name__ == "__main__":
    main()
