"""Let tools slip and trackers be bumped, and see what a `DriftWatch` says, and when of nothing.

The arms have origins, axes and encoders that are off as those of real ones, a tool of 15 cm and
0.5 kg that is not known, joints that bend and rub (`Drives.usual`, `Friction.usual`), and a tracker
of 60 Hz with 1 mm of noise, 30 ms late. *Steps*: the arm follows a circle; after 8 s the tool
slips, or the tracker turns about its own place, 1.6 m away, and is shifted. *Clean*: nothing
happens. Joints move from one random configuration to another, and bend under their weight; the
law's kinematics learn from what the tracker sees, anew in each run of two minutes.

    python examples/studies/drift.py --out results/drift
"""

import math

import numpy as np
from common import head, parser, row, run_all, write

import approxjac as aj
from approxjac.interface import Measurement
from approxjac.robots import Drives, Dynamics, Friction
from approxjac.simulation.drift import DriftWatch
from approxjac.simulation.simulate import MovingArm
from approxjac.tasks import TrackerTask

ARMS = "xarm7", "ur10", "baxter_left_arm"  # no threshold was chosen on these
LAWS = {
    "learns the tool": ("tool", "origins"),
    "learns the tool and the tracker": ("tool", "origins", "camera"),
    "learns axes, too": ("tool", "origins", "axes"),
    "set-point law": None,
}
NOISE, LATE, RATE, AT, RUN = 1e-3, 0.03, 60.0, 8.0, 120.0
CHANGES = {
    "tool by 5 mm": (5e-3, 0.0, 0.0),
    "tool by 10 mm": (10e-3, 0.0, 0.0),
    "tracker by 1 deg and 1 cm": (0.0, math.radians(1.0), 10e-3),
}
EYE = np.array([1.3, 0.7, 0.6])  # of the tracker [m]


def direction(rng):
    """Return a random direction."""
    way = rng.normal(size=3)
    return way / np.linalg.norm(way)


def true_arm(arm, rng, slip=(0.0, 0.0, 0.0)):
    """Return an arm as it is, whose tool has slipped."""
    joints = [name for name, each in arm.tree.joints.items() if each.type != "fixed"]
    shifts = {name: rng.normal(0.0, 4e-4, 3).tolist() for name in joints}
    turns = {name: rng.normal(0.0, [2e-3, 2e-3, 1e-2]).tolist() for name in joints}
    held = arm.with_kinematic_error(shifts, turns).with_object(0.15, 0.5, axis="x")
    return held.with_kinematic_error({"object_tip_joint": list(slip)})


def law_of(task, unknown, restarts=True):
    """Return a controller that learns some numbers, or none."""
    late = aj.Latency(image_period=1.0 / RATE, image_age=LATE)
    if unknown is None:
        gravity = aj.AdaptiveGravity(task.robot)
        return aj.SetpointController(task, gravity=gravity, latency=late)
    kinematics = aj.AdaptiveKinematics(task, unknown, noise=NOISE, delay=LATE, restarts=restarts)
    return aj.TrackingController(task, kinematics=kinematics, latency=late)


def stepped(name, law, change, seed):
    """Return what is said of a run with a change, and by how much x moved [m]."""
    arm, rng = aj.load_robot(name), np.random.default_rng([11, seed])
    errors = int(rng.integers(1 << 30))
    size, angle, shift = CHANGES[change]
    slip, turn = size * direction(rng), angle * direction(rng)
    R = aj.law.rotation_exp(turn)
    moves = EYE - R @ EYE + shift * direction(rng)
    sensing = aj.Sensing(x_noise=NOISE, x_rate=RATE, x_delay=LATE)

    def plant(slip, turn, moves):
        truth = true_arm(arm, np.random.default_rng(errors), slip)
        sensor = TrackerTask(truth, rotation=turn, offset=moves)
        usual = {"drives": Drives.usual(arm), "friction": Friction.usual(arm)}
        return aj.Plant(truth, sensor, sensing=sensing, torque_limits=arm.effort_limits, **usual)

    before, after = plant(np.zeros(3), np.zeros(3), np.zeros(3)), plant(slip, turn, moves)
    controller = law_of(aj.PositionTask(arm.with_object(0.0)), LAWS[law])
    moving = MovingArm(
        before, before.ready_configuration(), np.zeros(arm.nv), 1e-3, "semi_implicit_euler", seed
    )
    measured = moving.sense()[1]
    path = aj.Circle(measured.x + rng.uniform(-0.05, 0.05, 3), 0.08, 5.0, direction(rng))
    state, watch, said, size = controller.initial_state(measured), DriftWatch(controller), [], 0.0
    for k in range(round((AT + 3.0) / 1e-3)):
        if k == round(AT / 1e-3):
            moving.plant = after
            size = np.linalg.norm(after.sensor.value(moving.q) - before.sensor.value(moving.q))
        if found := watch.look(measured, state):
            said.append(found)
        state, answer = controller.step(state, measured, path.at(k * 1e-3), 1e-3)
        moving.move(moving.take(answer.torque))
        measured = moving.sense()[1]
    return said, size


class Learner(aj.Controller):
    """Kinematics that learn, as a controller that moves nothing."""

    def __init__(self, kinematics):
        super().__init__(kinematics.task)
        self.kinematics = kinematics

    def kinematics_of(self, state):
        """Return both as they are."""
        return self.kinematics, state


def clean(name, law, seed, duration=RUN, dt=0.01):
    """Return what is said of a run in which nothing happens."""
    arm, rng = aj.load_robot(name), np.random.default_rng([12, seed])
    truth = true_arm(arm, rng)
    tip, dynamics, drives = aj.PositionTask(truth), Dynamics(truth), Drives.usual(arm)
    soft, limits = 1.0 / np.broadcast_to(drives.stiffness, arm.nv), truth.effort_limits
    belief = arm.with_object(0.0)
    controller = law_of(aj.PositionTask(belief), LAWS[law])
    if LAWS[law] is not None:
        controller = Learner(controller.kinematics)
    watch, said = DriftWatch(controller), []
    rest = aj.Plant(truth, tip).ready_configuration()
    start = goal = rest
    begun, takes, frames, state, rubs = 0.0, 1.0, [], None, np.zeros(arm.nv)
    friction = 0.05 * np.where(np.isfinite(limits), limits, 0.0)
    x, taken = np.full(3, np.nan), 0
    for k in range(round(duration / dt)):
        t = k * dt
        if t >= begun + takes:
            start, begun, takes = goal, t, rng.uniform(1.0, 4.0)
            goal = rest + rng.uniform(-0.4, 0.4, arm.nv) * (rng.uniform() > 0.2)
        r = (t - begun) / takes
        q = start + r**3 * (10.0 - 15.0 * r + 6.0 * r * r) * (goal - start)
        v = 30.0 * r * r * (1.0 - r) ** 2 / takes * (goal - start)
        rubs = np.where(np.abs(v) > 1e-3, np.sign(v), rubs)  # what bends a joint stays at rest
        bent = soft * (dynamics.g(q) + friction * rubs)
        if t * RATE >= taken:
            taken += 1
            frames.append((t + LATE, tip.value(q - bent) + rng.normal(0.0, NOISE, 3)))
        while frames and frames[0][0] <= t + 1e-9:
            x = frames.pop(0)[1]
        seen = Measurement(t, q + rng.normal(0.0, 2e-5, arm.nv), v, x)
        if state is None:
            state = np.zeros(0)
            if isinstance(controller, Learner):
                state = controller.kinematics.initial_state(seen)
        if found := watch.look(seen, state):
            said.append(found)
        if isinstance(controller, Learner):
            state = controller.kinematics.step(state, seen, dt)
    return said


def case_of(kind, name, law, change, seed):
    """Run one case; return what is said, with the size of the change if there is one."""
    said, size = (
        (clean(name, law, seed), 0.0) if kind == "clean" else stepped(name, law, change, seed)
    )
    return {
        "arm": name, "law": law, "change": change, "seed": seed, "size": float(size),
        "said": [each._replace(condition=each.condition.name)._asdict() for each in said],
    }  # fmt: skip


def called(case):
    """Run a case of `run_all`."""
    return case_of(*case)


def step_rows(cases):
    """Return a row for each change and law: when it is told, and how large."""
    for change in CHANGES:
        for law in LAWS:
            those = [c for c in cases if (c["change"], c["law"]) == (change, law)]
            if not those:
                continue
            told = [(c, said) for c in those for said in c["said"] if said["named"] > AT]
            told = list({id(c): (c, said) for c, said in reversed(told)}.values())  # the first
            after = [said["named"] - AT for _, said in told]
            off = [1e3 * abs(said["size"] - c["size"]) for c, said in told]
            beyond = [abs(said["size"] - c["size"]) / said["sd"] for c, said in told]
            right, wrong = "TOOL_SLIPPED", "SENSOR_MOVED"
            if not change.startswith("tool"):
                right, wrong = wrong, right
            names = [said["condition"] for _, said in told]
            yield row(
                change, law, f"{len(told)} of {len(those)}",
                f"{np.median(after):.1f}, {max(after):.1f}" if told else "–",
                f"{np.median([1e3 * c['size'] for c in those]):.1f}",
                f"{np.median(off):.1f}, {max(off):.1f}" if told else "–",
                f"{np.median(beyond):.1f}, {max(beyond):.1f}" if told else "–",
                f"{names.count(right)}, {names.count(wrong)}",
            )  # fmt: skip


def clean_rows(cases):
    """Return a row for each law: hours, and how often a change is told."""
    for law in LAWS:
        those = [c for c in cases if c["law"] == law]
        if not those:
            continue
        hours = len(those) * RUN / 3600.0
        said = sum(len(c["said"]) for c in those)
        yield row(law, f"{hours:.2g}", said, f"{said / hours:.2g}")


def main():
    """Run the study and write its tables."""
    options = parser(__doc__, "results/drift")
    options.add_argument("--arms", nargs="+", default=ARMS)
    options.add_argument("--seeds", type=int, default=1, help="runs with each change")
    options.add_argument("--clean", type=int, default=3, help="runs of two minutes without one")
    given = options.parse_args()
    every = [(name, law) for name in given.arms for law in LAWS]
    steps = [
        ("step", *one, c, seed) for seed in range(given.seeds) for one in every for c in CHANGES
    ]
    rests = [("clean", *one, "", seed) for seed in range(given.clean) for one in every]
    if given.quick:
        steps, rests = steps[:3], rests[:1]
    results = run_all(called, [*steps, *rests], given.jobs)
    stepped, rested = results[: len(steps)], results[len(steps) :]
    first = head(
        "change", "law", "told", "after [s]", "x moved by [mm]", "told wrong by [mm]",
        "in its sd", "cause right, wrong",
    )  # fmt: skip
    quiet = head("law", "hours", "told", "an hour")
    tables = {
        "drift.md": "\n".join([*first, *step_rows(stepped), ""]),
        "drift_clean.md": "\n".join([*quiet, *clean_rows(rested), ""]),
    }
    write(given.out, tables, results)


if __name__ == "__main__":
    main()
