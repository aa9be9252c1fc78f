"""Time of one control step of every law, as ratios within one run.

To the same law typed in with NumPy and Pinocchio (`naive_laws`), bare and with the checks that ours
makes, and to what other libraries offer on the same arm (`other_libraries`): Pinocchio's forward
dynamics, an operational-space torque with MuJoCo, an inverse-kinematics step of Pink.

    python tests/benchmarks/control_step.py
"""

from functools import partial
from typing import NamedTuple

import naive_laws as naive
import numpy as np
import other_libraries as others
import pinocchio as pin
import turns

import approxjac as aj
from approxjac.codegen import compiled
from approxjac.controllers import (
    ControllerWrapper,
    DifferentiatedVelocity,
    KnownKinematics,
    ModelDynamics,
    Posture,
)
from approxjac.law import Sine
from approxjac.robots import GravityRegressor

ROBOTS = {"two_link": ("xz", [0, 2]), "ur5": ("xyz", slice(0, 3)), "panda": ("xyz", slice(0, 3))}
ROUNDS, STEPS = 60, 200
HEADS = ("robot", "law", "µs", "bare", "checked", "`pin.aba`", "MuJoCo", "Pink")


class Law(NamedTuple):
    """A law on one robot: ours, and the same typed in, bare and with checks (or None)."""

    name: str
    controller: object
    bare: object = None
    checked: object = None
    image: bool = False

    @property
    def ours(self):
        """Our step, of which an image is given the first entries of x."""
        step = our_step(self.controller)
        return _cut(2)(step) if self.image else step


def arm(name):
    """A robot, a configuration, and inputs (q, v, x) around it within its limits, x near 0."""
    robot, rng = aj.load_robot(name), np.random.default_rng(0)
    middle, (low, high) = robot.random_configuration(rng), robot.position_limits
    inputs = [
        (
            np.clip(middle + rng.uniform(-0.3, 0.3, robot.nv), low + 0.01, high - 0.01),
            rng.uniform(-0.1, 0.1, robot.nv),
            rng.uniform(-0.05, 0.05, len(ROBOTS[name][0])),
        )
        for _ in range(STEPS)
    ]
    return robot, middle, inputs


def laws(name):
    """Every law that the robot of this name can have."""
    robot, middle, _ = arm(name)
    axes, rows = ROBOTS[name]
    m, n = len(axes), robot.nv
    task, gains = aj.PositionTask(robot, axes=axes), aj.Gains(naive.KP, naive.KV, naive.DAMPING)
    J_of, x_d = naive.jacobian(robot, rows), np.zeros(m)
    law = partial(aj.SetpointController, task, gains)
    typed = partial(naive.setpoint, robot, J_of, m, x_d, naive.KP, naive.KV)
    with_checks = partial(naive.checked, robot, J_of, x_d)
    learnt = aj.AdaptiveGravity(GravityRegressor(robot), L=naive.LEARNING, alpha=naive.ALPHA)
    sine = Sine(naive.GAMMA)

    def both(step, learning=False):
        return step, with_checks(step, learning)

    found = [
        Law("(5)", law(velocity=DifferentiatedVelocity(naive.LAG)), *both(typed(lag=naive.LAG)))
    ]
    for title, options, step, learning in (
        ("(6)", {}, typed(), False),
        ("(6), s = sine", {"saturation": sine}, typed(sine=True), False),
        ("(28), (29)", {"gravity": learnt}, typed(learning=True), True),
        (
            "(28), (29), s = sine",
            {"gravity": learnt, "saturation": sine},
            typed(sine=True, learning=True),
            True,
        ),
    ):
        found.append(Law(title, law(**options), *both(step, learning)))
        found.append(Law(f"{title}, compiled", compiled(law(**options)), *both(step, learning)))
    if n > m:
        posture = Posture(middle, naive.STIFFNESS)
        found.append(Law("(6), posture", law(posture=posture), *both(typed(posture=middle))))
    limits = np.minimum(robot.effort_limits, 150.0)  # the two-link arm has none
    limited = aj.TorqueLimited(law(), aj.Limits(effort=limits))
    found.append(Law("(6), `TorqueLimited`", limited))
    found.append(Law("(6), `TorqueLimited`, held", aj.HeldMeasurement(limited, 0.05)))
    exact = KnownKinematics(task)
    for title, options in (
        ("tracking, exact model", {"kinematics": exact, "dynamics": ModelDynamics(robot)}),
        ("tracking, learnt dynamics", {"kinematics": exact}),
        ("tracking, all learnt, a frame each step", {}),
        ("tracking, velocities", {"kinematics": exact, "command": "velocity"}),
    ):
        found.append(Law(title, aj.TrackingController(task, **options)))
    found.append(_image_law(robot, middle))
    return found


def _image_law(robot, middle):
    """Law (6) with the image of the tip, seen from two metres away."""
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, middle)
    tip = np.array(data.oMf[model.getFrameId(robot.tip)].translation)
    camera = aj.PinholeCamera.looking_at(tip, tip + [0.5, -1.9, 0.4], 600.0, (640, 480))
    task = aj.ImageTask(robot, camera)
    gains = aj.Gains(naive.IMAGE_KP, naive.IMAGE_KV, naive.DAMPING)
    J_of, x_d = naive.image_jacobian(robot, camera), np.zeros(2)
    step = naive.setpoint(robot, J_of, 2, x_d, naive.IMAGE_KP, naive.IMAGE_KV)
    with_checks = naive.checked(robot, J_of, x_d, step)
    return Law("(6), one image point", aj.SetpointController(task, gains), step, with_checks, True)


def our_step(controller):
    """`evaluate`, or `step` of what only steps, of (q, v, x), with its target at zero."""
    x_d, measurement = np.zeros(controller.task.n_x), aj.Measurement
    first = measurement(0.0, controller.task.robot.neutral(), np.zeros(1), x_d)
    first = first._replace(v=np.zeros(controller.task.robot.nv))
    state = controller.begin(first)  # no motion has these samples: without a guard
    if isinstance(controller, ControllerWrapper | aj.TrackingController):
        step = controller.step
        return lambda q, v, x: step(state, measurement(0.0, q, v, x), x_d, 1e-3)[1]
    evaluate = controller.evaluate
    return lambda q, v, x: evaluate(state, measurement(0.0, q, v, x), x_d)


def rows():
    """Our time [µs] of every law on every robot, and its ratios to the others."""
    found = []
    for name, (_, axis_rows) in ROBOTS.items():
        robot, _, inputs = arm(name)
        here = laws(name)
        steps = {
            "aba": others.aba(robot),
            "mujoco": others.operational_space(robot, axis_rows, np.zeros_like(inputs[0][2])),
            "pink": others.pink_step(robot),
        }
        for law in here:
            cut = _cut(2) if law.image else lambda step: step
            steps[law.name, "ours"] = law.ours
            steps[law.name, "bare"] = law.bare and cut(law.bare)
            steps[law.name, "checked"] = law.checked and cut(law.checked)
        steps = {key: step for key, step in steps.items() if step is not None}
        taken = turns.medians(steps, inputs, ROUNDS)
        for law in here:
            ours = taken[law.name, "ours"]
            against = ((law.name, "bare"), (law.name, "checked"), "aba", "mujoco", "pink")
            ratios = [ours / taken[key] if key in taken else None for key in against]
            found.append((name, law.name, 1e6 * ours, *ratios))
    return found


def _cut(size):
    """A step that is given the first entries of x."""
    return lambda step: lambda q, v, x: step(q, v, x[:size])


def main():
    print(turns.table(HEADS, rows()))
    print("\nµs: our median; then our time over that of the others")


if __name__ == "__main__":
    main()
