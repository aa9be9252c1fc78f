"""Random closed loops as eq. (9) has them, without gravity: arm, errors, gains, region, target."""

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from common import carried_object

import approxjac as aj
from approxjac.paper import experiments as paper


class Case(NamedTuple):
    """A case: all of it follows from its kind and seeds."""

    kind: str
    seed: int
    number: int


class Loop(NamedTuple):
    """A closed loop, and what is asked of it."""

    plant: aj.Plant
    controller: aj.SetpointController
    region: aj.JointBox
    target: np.ndarray
    q_target: np.ndarray
    q0: np.ndarray
    radius: float  # half the width of the region [rad]


def camera(size, rng):
    """Return the paper's arm and camera, with camera and lengths wrong."""
    roll, focal, distance = size * rng.uniform(-1.0, 1.0, 3)
    believed = aj.cameras.PlanarCamera(
        focal_length=paper.CAMERA.focal_length * math.exp(0.7 * focal),
        distance=paper.CAMERA.distance * math.exp(0.4 * distance),
        roll=math.radians(90.0) * roll,
    )
    truth, belief = two_links(0.2 * size, rng)
    return aj.ImageTask(truth, paper.CAMERA), aj.ImageTask(belief, believed)


def lengths(size, rng):
    """Return the paper's arm with its lengths wrong."""
    truth, belief = two_links(0.6 * size, rng)
    return aj.PositionTask(truth), aj.PositionTask(belief)


def two_links(size, rng):
    """Return the paper's arm, and one with lengths wrong by factors."""
    wrong = np.array(paper.LENGTHS) * np.exp(size * rng.uniform(-1.0, 1.0, 3))
    return weightless(paper.build_arm()), weightless(paper.build_arm(tuple(wrong)))


def arm(name, size, rng):
    """Return an arm that holds an object believed absent, and whose joints are elsewhere."""
    length, mass = carried_object(name)
    robot = weightless(aj.load_robot(name))
    held = size * rng.uniform(size=2)
    truth = robot.with_object(held[0] * length, held[1] * mass)
    belief = robot.with_object(0.0, 0.0)
    shift, turn = size * rng.uniform(size=2) * (0.05 * length / 0.2, 0.3)  # [m], [rad]
    shifts = {joint: shift * rng.uniform(-1.0, 1.0, 3) for joint in robot.joint_names}
    turns = {joint: turn * rng.uniform(-1.0, 1.0, 3) for joint in robot.joint_names}
    return aj.PositionTask(truth), aj.PositionTask(belief.with_kinematic_error(shifts, turns))


def weightless(robot):
    """Return the robot without gravity: where it is compensated exactly there is none."""
    return robot.with_gravity((0.0, 0.0, 0.0))


KINDS = {
    "two-link, camera": camera,
    "two-link, lengths": lengths,
    **{name: partial(arm, name) for name in ("ur5", "panda", "xarm7", "kinova", "so100")},
}


def cases(count, seed=0):
    """Return so many cases, the kinds in turn."""
    return [Case(tuple(KINDS)[k % len(KINDS)], seed, k) for k in range(count)]


def build(case):
    """Draw the closed loop of a case."""
    rng = np.random.default_rng([case.seed, case.number])
    size = 3.0 * rng.uniform() ** 2
    sensor, task, q = regular(KINDS[case.kind], size, rng)
    radius = 0.05 * 10.0 ** rng.uniform(0.0, 1.0)
    robot = sensor.robot
    gains = aj.default_gains(task)
    kp, kv, damping = 10.0 ** rng.uniform((-0.5, -0.5, -1.5), (0.5, 0.5, 1.0))
    if rng.random() < 0.4 and task.robot.nv == task.m:
        damping = 0.0
    factors = zip((kp, kv, damping), (gains.kp, gains.kv, gains.damping), strict=True)
    gains = aj.Gains(*(factor * np.asarray(gain) for factor, gain in factors))
    # s(e) bends within or near the region in a third of the cases
    size = radius * float(np.linalg.norm(task.jacobian(q), 2))
    gamma = size * 10.0 ** rng.uniform(-1.0, 0.5)
    saturation = aj.law.Sine(gamma) if rng.random() < 1.0 / 3.0 else aj.law.Linear()
    q_target, share = q, rng.uniform(0.2, 1.0)
    if rng.random() < 0.5:
        q_target = aj.JointBox.around(robot, q, 0.5 * radius).sample(1, rng)[0]
    q0 = aj.JointBox.around(robot, q, share * radius).sample(1, rng)[0]
    controller = aj.SetpointController(
        task, gains, gravity=aj.NoGravity(task.robot), saturation=saturation
    )
    region = aj.JointBox.around(robot, q, radius)
    return Loop(
        aj.Plant(robot, sensor), controller, region, sensor.value(q_target), q_target, q0, radius
    )


def regular(draw, size, rng):
    """Draw a sensor, a believed task, and a configuration where neither is near singular."""
    while True:  # some errors leave no regular configuration, such as a very short second link
        sensor, task = draw(size, rng)
        for _ in range(200):
            q = sensor.robot.random_configuration(rng)
            values = [np.linalg.svd(t.jacobian(q), compute_uv=False) for t in (sensor, task)]
            if all(v[-1] > 0.1 * v[0] for v in values):
                return sensor, task, q


def damped(loop, kv, damping):
    """Return the loop with K_v and B_c times a factor each; B_c of 0 is that of default_gains."""
    gains, task = loop.controller.gains, loop.controller.task
    added = np.asarray(gains.damping)
    if not added.any():
        added = np.asarray(aj.default_gains(task).damping)
    controller = aj.SetpointController(
        task,
        aj.Gains(gains.kp, kv * np.asarray(gains.kv), damping * added),
        gravity=loop.controller.gravity,
        saturation=loop.controller.saturation,
    )
    return loop._replace(controller=controller)
