"""Follow a circle, and reach a point, with joints that give way; see which laws run away.

An arm with an unknown tool (20 cm, 2 % of its mass) and joint origins that are a few millimetres
off follows a circle of 10 cm in 4 s, with a camera of 60 Hz (30 ms late, 1 mm), q̇ by a filter of
5 ms, and torques 1 ms late, in closed loops of every stiffness and rotor. The tracking law knows
its lag, or takes joints as rigid; nobody tells it of rotors. Likewise the set-point law, on the x
that learnt kinematics predict, goes to a target 15 cm away.

    python examples/studies/joints.py --out results/joints

Exit code 1 means that a law that knew its lag ran away (more than 30 mm, the set-point law more
than the 150 mm that it began with, 3 to 6 s).
"""

import sys
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from common import head, parser, row, run_all, two_digits, write

import approxjac as aj
from approxjac.robots import Drives, Friction
from approxjac.simulation import Computation

ARMS = "panda", "ur5", "kinova", "xarm7", "z1"
STIFFNESS = {"3e3": 3e3, "1e4": 1e4, "3e4": 3e4, "rigid": np.inf}
ROTORS = 0.05, 0.15, 0.5  # [kg m²]
LATE = aj.Latency(
    1e-3, torque_delay=1e-3, velocity_filter=5e-3, image_period=1 / 60, image_age=0.03
)
LAWS = {"tracking": "joints.md", "set-point": "joints_setpoint.md"}
WITHOUT = "1e4", "rigid"  # stiffness, for laws that do not know their lag
RUNS_AWAY = {"tracking": 30.0, "set-point": 150.0}  # [mm]
WAY = np.array([-0.09, 0.09, -0.08])  # of the set-point law [m]


class Case(NamedTuple):
    """A closed loop."""

    law: str
    arm: str
    stiffness: str
    rotor: float
    knows: bool
    friction: float = 0.0  # dry, in the effort; if there is any, also 1 N m s/rad viscous
    seed: int = 7


def followed(case):
    """Return the rms error [mm] from 3 s to 6 s; infinite of a run that diverged."""
    robot, rng = aj.load_robot(case.arm), np.random.default_rng(case.seed)
    truth = robot.with_object(0.2, 0.02 * robot.mass, axis="x").with_kinematic_error(
        {name: tuple(rng.normal(0.0, 3e-3, 3)) for name in robot.joint_names}
    )
    sensing = aj.Sensing(x_noise=1e-3, x_rate=60.0, x_delay=0.03, velocity_filter=5e-3)
    plant = aj.Plant(
        truth, sensing=sensing, actuator_delay=1e-3, torque_limits=robot.effort_limits,
        drives=Drives(case.rotor, STIFFNESS[case.stiffness]),
        friction=Friction(float(case.friction > 0.0), case.friction * robot.effort_limits),
    )  # fmt: skip
    task = aj.PositionTask(robot.with_object(0.0))
    kinematics = aj.controllers.AdaptiveKinematics(task, noise=1e-3, delay=0.03)
    q0 = plant.ready_configuration()
    x0 = plant.sensor.value(q0)
    if case.law == "tracking":
        late = LATE if case.knows else None
        controller = aj.TrackingController(task, kinematics=kinematics, latency=late)
        path = aj.Circle(2.0 * x0 - aj.Circle(x0, 0.1, 4.0).at(0.0).x, 0.1, 4.0)
    else:  # frames of x are outside its loop
        late = replace(LATE, image_period=0.0, image_age=0.0) if case.knows else None
        law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(task.robot), latency=late)
        controller, path = aj.controllers.PredictedMeasurement(law, kinematics), x0 + WAY
    options = {"seed": case.seed, "computation": Computation("semi_implicit_euler")}
    try:
        run = aj.simulate(plant, controller, path, q0, 6.0, **options)
    except aj.errors.ApproxJacError:
        return float("inf")
    return 1e3 * float(np.sqrt((run.error_norm[run.t >= 3.0] ** 2).mean()))


def rows(stiffness):
    """Return what is tried of a law, in pairs of stiffness and whether it knows its lag."""
    return [(K, knows) for knows in (False, True) for K in stiffness if knows or K in WITHOUT]


def table(found, law, arms, stiffness, friction):
    """Return the rms errors of the rotors, for each arm and stiffness, of a law."""
    rotors = ", ".join(map(str, ROTORS))
    lines = head(f"stiffness [N m/rad]: rms [mm] with rotors of {rotors} kg m²", *arms)
    for K, knows in rows(stiffness):
        cells = []
        for arm in arms:
            each = [found[Case(law, arm, K, rotor, knows, friction)] for rotor in ROTORS]
            cells.append(", ".join("diverges" if e > 1e3 else two_digits(e) for e in each))
        lines.append(row(f"{K}, lag {'known' if knows else 'not known'}", *cells))
    return "\n".join(lines) + "\n"


def main(arguments=None):
    """Run all loops, write the table, and return the exit code."""
    options = parser(__doc__, "results/joints")
    options.add_argument("--arms", nargs="+", default=ARMS)
    options.add_argument("--laws", nargs="+", choices=list(LAWS), default=list(LAWS))
    options.add_argument("--friction", type=float, default=0.0, help="of the efforts [%%]")
    args = options.parse_args(arguments)
    friction = args.friction / 100.0
    arms, stiffness = (args.arms[:1], ["1e4"]) if args.quick else (args.arms, list(STIFFNESS))
    cases = [
        Case(law, arm, K, rotor, knows, friction)
        for law in args.laws for arm in arms for K, knows in rows(stiffness) for rotor in ROTORS
    ]  # fmt: skip
    found = dict(zip(cases, run_all(followed, cases, args.jobs), strict=True))
    away = [case for case, e in found.items() if case.knows and e > RUNS_AWAY[case.law]]
    tables = {LAWS[law]: table(found, law, arms, stiffness, friction) for law in args.laws}
    write(args.out, tables, {str(tuple(case)): e for case, e in found.items()})
    for case in away:
        print(f"ran away: {case}")
    return 1 if away else 0


if __name__ == "__main__":
    sys.exit(main())
