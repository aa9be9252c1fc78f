"""Reach and hold still with joints that rub, with and without friction compensation.

An arm with an unknown tool (15 cm, 2 kg) reaches and holds for 20 s. Coulomb friction is a share of
the motors' effort, static friction 1.3 times it; on ur10, as measured on a UR10e. Gravity is
learnt, or known with the tool. With --sensors x is that of a camera (60 Hz, 30 ms late, 1 mm), from
which kinematics learn, q̇ filtered (5 ms) and encoders of 14 bits.

    python examples/studies/friction.py --out results/friction

Exit code 1 means that an arm with compensation hunts: more than 0.5 mm (1.5 mm with sensors) after
10 s, or joints that turn again and again.
"""

import sys
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from common import head, parser, row, run_all, two_digits, write

import approxjac as aj
from approxjac.controllers import AdaptiveKinematics, FrictionCompensation, PredictedMeasurement
from approxjac.robots import Friction
from approxjac.simulation import Computation

OTHERS = "ur3", "kinova", "z1", "baxter_left_arm"  # that no number of the law was chosen on
ARMS = "ur10", "ur5", "xarm7", "panda"
FRICTION = "5 %", "10 %", "10 %, load", "UR10e"
UR10E = (20.9, 19.5, 7.6, 2.9, 3.5, 2.8), (27.9, 19.2, 10.8, 3.2, 2.4, 3.1)
STEP = 2.0 * np.pi / 2**14
MOST, MOST_TURNS = (0.5, 1.5), 10


class Case(NamedTuple):
    """A closed loop, run from the starts of some seeds."""

    arm: str
    friction: str
    gravity: str
    compensates: bool
    sensors: bool
    seeds: tuple[int, ...]


def rubbing(robot, kind):
    """Return the friction of a robot's joints."""
    if kind == "UR10e":
        return Friction(UR10E[1], UR10E[0], stribeck=1.3, load=0.06)
    dry = 0.01 * float(kind.split()[0]) * robot.effort_limits
    return Friction(0.5 * dry, dry, stribeck=1.3, load=0.05 if "load" in kind else 0.0)


def held(case, seed):
    """Return the error at 2 s and 5 s, its rms after 10 s [mm], and how often joints turn then."""
    robot, rng = aj.load_robot(case.arm), np.random.default_rng(seed)
    truth = robot.with_object(0.15, 2.0, axis="xz"[seed % 2])
    sensing = None
    if case.sensors:
        sensing = aj.Sensing(
            x_noise=1e-3, x_rate=60.0, x_delay=0.03, velocity_filter=5e-3, q_quantum=STEP
        )
    plant = aj.Plant(truth, friction=rubbing(robot, case.friction), sensing=sensing)
    learns = case.gravity == "learnt"
    task = aj.PositionTask(robot.with_object(0.0) if learns else truth)
    compensation = FrictionCompensation(encoder_step=STEP if case.sensors else 0.0)
    law = aj.SetpointController(
        task,
        gravity=aj.AdaptiveGravity(task.robot) if learns else None,
        friction=compensation if case.compensates else None,
        latency=aj.Latency(velocity_filter=5e-3) if case.sensors else None,
    )
    if case.sensors:
        kinematics = AdaptiveKinematics(task, noise=1e-3, delay=0.03)
        law = aj.codegen.compiled(PredictedMeasurement(law, kinematics))
    q0 = plant.ready_configuration()
    q1 = pin.integrate(robot.model, q0, rng.normal(0.0, 0.25, robot.nv))
    engine = None if case.sensors else "compiled"
    options = {"computation": Computation("semi_implicit_euler", engine=engine), "seed": seed}
    run = aj.simulate(plant, law, plant.sensor.value(q1), q0, 20.0, **options)
    late, e = run.t >= 10.0, 1e3 * run.error_norm
    turns = 0
    for speed in run.v[late].T:
        signs = np.sign(speed[np.abs(speed) > 1e-3])
        turns += int((signs[1:] != signs[:-1]).sum())
    at = np.searchsorted(run.t, (2.0, 5.0))
    return *e[at], float(np.sqrt((e[late] ** 2).mean())), turns


def worst(case):
    """Return the worst of all starts, figure by figure."""
    return np.max([held(case, seed) for seed in case.seeds], axis=0).tolist()


def table(found):
    """Return the figures of all cases, without and with compensation."""
    text = "{}, {}, {}, {:.0f}"
    lines = head("arm", "friction", "gravity", "without", "with compensation")
    for case, figures in found.items():
        if case.compensates:
            without = found[case._replace(compensates=False)]
            both = without, figures
            cells = [text.format(*map(two_digits, each[:3]), each[3]) for each in both]
            lines.append(row(case.arm, case.friction, case.gravity, *cells))
    return "\n".join(lines) + "\n"


def main(arguments=None):
    """Run all loops, write the table, and return the exit code."""
    options = parser(__doc__, "results/friction")
    options.add_argument("--arms", nargs="+", default=[*OTHERS, *ARMS])
    options.add_argument("--sensors", action="store_true", help="a camera, and encoders")
    args = options.parse_args(arguments)
    arms, kinds = (args.arms[:1], FRICTION[:1]) if args.quick else (args.arms, FRICTION)
    gravity = ("learnt",) if args.quick or args.sensors else ("learnt", "known")
    seeds = (21,) if args.quick or args.sensors else (21, 22, 23)
    cases = [
        Case(arm, kind, each, compensates, args.sensors, seeds)
        for arm in arms for kind in kinds if (kind == "UR10e") <= (arm == "ur10")
        for each in gravity if each == "learnt" or kind == "5 %"
        for compensates in (False, True)
    ]  # fmt: skip
    found = dict(zip(cases, run_all(worst, cases, args.jobs), strict=True))
    name = "friction_sensors.md" if args.sensors else "friction.md"
    write(args.out, {name: table(found)}, {str(tuple(case)): f for case, f in found.items()})
    hunts = [
        case for case, (*_, rms, turns) in found.items()
        if case.compensates and (rms > MOST[case.sensors] or turns > MOST_TURNS)
    ]  # fmt: skip
    for case in hunts:
        print(f"hunts: {case}")
    return 1 if hunts else 0


if __name__ == "__main__":
    sys.exit(main())
