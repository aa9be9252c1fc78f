"""Random closed loops to try the stability tests on: arm, errors, gains, region, start, target."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from approxjac import paper
from approxjac.controllers import Gains, NoGravity, SetpointController, default_gains
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.law import Linear, Saturation, Sine
from approxjac.robots import Robot, load_robot
from approxjac.simulation import Plant
from approxjac.stability import JointBox
from approxjac.studies.arms import carried_object
from approxjac.tasks import ImageTask, PlanarCamera, PositionTask, Task
from approxjac.validation import Array

KINDS = ("two-link, camera", "two-link, lengths", "ur5", "panda", "xarm7", "kinova", "so100")
"""The paper's arm and camera, the paper's arm with lengths wrong, and arms that hold an object."""
_REGULAR = 0.1  # σ_min of J and of Ĵ at the middle of the region, as a share of σ_max
_SHIFT, _TURN = 0.05, 0.3  # of joint origins for errors of size 1 [m], [rad]
_ERRORS, _POSTURES = 100, 200  # that are tried


class Case(NamedTuple):
    """A case: all of it follows from its kind and seeds."""

    kind: str
    seed: int
    number: int


@dataclass(frozen=True, eq=False)
class Loop:
    """A closed loop as eq. (9) has it, without gravity, and what is asked of it.

    Attributes:
        plant: The true robot.
        controller: The controller.
        region: Where the tests look.
        q_target: Posture that attains the target, shape (nq,).
        q0: Start, at rest, shape (nq,).
        error_size: Size of the errors, from negligible 0 to gross 3.
        radius: Half the width of the region [rad].
    """

    plant: Plant
    controller: SetpointController
    region: JointBox
    q_target: Array
    q0: Array
    error_size: float
    radius: float

    @property
    def target(self) -> Array:
        """x_d, shape (n_x,)."""
        return self.plant.sensor.value(self.q_target)

    def with_damping(self, kv: float, damping: float) -> Loop:
        """The same with K_v and B_c times a factor each; a B_c of 0 is that of `default_gains`."""
        gains, task = self.controller.gains, self.controller.task
        added = np.asarray(gains.damping)
        if not added.any():
            added = np.asarray(default_gains(task).damping)
        changed = Gains(gains.kp, kv * np.asarray(gains.kv), damping * added)
        controller = SetpointController(
            task,
            changed,
            gravity=self.controller.gravity,
            saturation=self.controller.saturation,
        )
        return replace(self, controller=controller)


def cases(count: int, seed: int = 0, kinds: Sequence[str] = ()) -> list[Case]:
    """Return so many cases, the kinds in turn.

    Raises:
        InvalidInputError: No case, or a negative seed.
        UnknownNameError: No such kind.
    """
    for name, value, least in (("cases", count, 1), ("seed", seed, 0)):
        if type(value) is not int or value < least:
            raise InvalidInputError(
                f"{name} must be an integer >= {least}, got {value!r}", given=value
            )
    for kind in kinds:
        if kind not in KINDS:
            raise UnknownNameError("kind", kind, "the kinds of cases", KINDS)
    chosen = kinds or KINDS
    return [Case(chosen[k % len(chosen)], seed, k) for k in range(count)]


def build(case: Case) -> Loop:
    """Draw the closed loop of a case."""
    rng = np.random.default_rng([case.seed, case.number])
    size = 3.0 * rng.uniform() ** 2
    sensor, task, q = _regular(case.kind, size, rng)
    radius = 0.05 * 10.0 ** rng.uniform(0.0, 1.0)
    robot = sensor.robot
    gains = _gains(task, rng)
    saturation = _saturation(task, q, radius, rng)
    q_target, share = q, rng.uniform(0.2, 1.0)
    if rng.random() < 0.5:
        q_target = JointBox.around(robot, q, 0.5 * radius).sample(1, rng)[0]
    return Loop(
        Plant(robot, sensor),
        SetpointController(task, gains, gravity=NoGravity(task.robot), saturation=saturation),
        JointBox.around(robot, q, radius),
        q_target,
        JointBox.around(robot, q, share * radius).sample(1, rng)[0],
        size,
        radius,
    )


def _camera(_: str, size: float, rng: np.random.Generator) -> tuple[Task, Task]:
    """The paper's camera with another roll, focal length and distance, and lengths wrong too."""
    roll, focal, distance = size * rng.uniform(-1.0, 1.0, 3)
    believed = PlanarCamera(
        focal_length=paper.CAMERA.focal_length * math.exp(0.7 * focal),
        distance=paper.CAMERA.distance * math.exp(0.4 * distance),
        roll=math.radians(90.0) * roll,
    )
    truth, belief = _two_links(0.2 * size, rng)
    return ImageTask(truth, paper.CAMERA), ImageTask(belief, believed)


def _lengths(_: str, size: float, rng: np.random.Generator) -> tuple[Task, Task]:
    truth, belief = _two_links(0.6 * size, rng)
    return PositionTask(truth), PositionTask(belief)


def _two_links(size: float, rng: np.random.Generator) -> tuple[Robot, Robot]:
    """The paper's arm, and one with lengths wrong by factors."""
    l1, l2, lo = np.array(paper.LENGTHS) * np.exp(size * rng.uniform(-1.0, 1.0, 3))
    return _weightless(paper.build_arm()), _weightless(paper.build_arm((l1, l2, lo)))


def _arm(name: str, size: float, rng: np.random.Generator) -> tuple[Task, Task]:
    """An arm that holds an object believed absent, and whose joints are elsewhere."""
    length, mass = carried_object(name)
    arm = _weightless(load_robot(name))
    held = size * rng.uniform(size=2)
    truth = arm.with_object(held[0] * length, held[1] * mass)
    belief = arm.with_object(0.0, 0.0)
    shift, turn = size * rng.uniform(size=2) * (_SHIFT * length / 0.2, _TURN)
    joints = arm.joint_names
    belief = belief.with_kinematic_error(
        {joint: shift * rng.uniform(-1.0, 1.0, 3) for joint in joints},
        {joint: turn * rng.uniform(-1.0, 1.0, 3) for joint in joints},
    )
    return PositionTask(truth), PositionTask(belief)


_DRAW: dict[str, Callable[[str, float, np.random.Generator], tuple[Task, Task]]] = {
    "two-link, camera": _camera,
    "two-link, lengths": _lengths,
}


def _weightless(robot: Robot) -> Robot:
    """Gravity that is compensated exactly is no gravity."""
    return robot.with_gravity((0.0, 0.0, 0.0))


def _regular(kind: str, size: float, rng: np.random.Generator) -> tuple[Task, Task, Array]:
    """A sensor, a believed task, and a posture where neither is near singular."""
    draw = _DRAW.get(kind, _arm)
    for _ in range(_ERRORS):  # some leave no regular posture, such as a very short second link
        sensor, task = draw(kind, size, rng)
        for _ in range(_POSTURES):
            q = sensor.robot.random_configuration(rng)
            values = [np.linalg.svd(t.jacobian(q), compute_uv=False) for t in (sensor, task)]
            if all(v[-1] > _REGULAR * v[0] for v in values):
                return sensor, task, q
    raise InvalidInputError(f"no regular posture of {kind} was found", given=kind)


def _gains(task: Task, rng: np.random.Generator) -> Gains:
    """Default gains times random factors; where the joints are as many as m, at times B_c = 0."""
    gains = default_gains(task)
    kp, kv, damping = 10.0 ** rng.uniform((-0.5, -0.5, -1.5), (0.5, 0.5, 1.0))
    if rng.random() < 0.4 and task.robot.nv == task.m:
        damping = 0.0
    return Gains(
        *(
            k * np.asarray(g)
            for k, g in zip((kp, kv, damping), (gains.kp, gains.kv, gains.damping), strict=True)
        )
    )


def _saturation(task: Task, q: Array, radius: float, rng: np.random.Generator) -> Saturation:
    """s(e) = e, or in a third of the cases one that bends within or near the region."""
    gamma = radius * float(np.linalg.norm(task.jacobian(q), 2)) * 10.0 ** rng.uniform(-1.0, 0.5)
    return Sine(gamma) if rng.random() < 1.0 / 3.0 else Linear()
