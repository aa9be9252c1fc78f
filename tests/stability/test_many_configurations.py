"""Many configurations at once, compared with one after the other."""

import functools

import numpy as np
import pytest
from numpy.testing import assert_allclose
from random_trees import random_tree

import approxjac as aj
from approxjac.controllers.gains.gains import Timing
from approxjac.robots import GravityRegressor
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.linearization import linear_loop, stabilities
from approxjac.stability.loop.samples import TracedTerms, terms_alone
from approxjac.tasks import CombinedTask, NonsingularTask, PoseTrackerTask, TrackerTask
from approxjac.tasks.analysis import jacobian_gradient
from approxjac.tasks.frame_tasks import FrameKinematics

PLANE = functools.partial(aj.PositionTask, axes="xz")
Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.8, 0.0])
CAMERA = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))


def require_same(found, expected, differences=()):
    for name, each in expected.items():
        bound = 1e-9 if name in differences else 1e-12
        size = max(1.0, np.abs(each).max(initial=0.0))
        assert np.abs(found[name] - np.array(each)).max(initial=0.0) <= bound * size, name


def test_terms_of_every_arm(arm, rng):
    require_same_terms(arm, arm.tip, rng)


@pytest.mark.parametrize(
    "seed", [*range(4), *(pytest.param(k, marks=pytest.mark.study) for k in range(4, 12))]
)
def test_terms_of_random_trees(seed):
    rng = np.random.default_rng(seed)
    text, (frame, _) = random_tree(rng)
    require_same_terms(aj.Robot(text), frame, rng)


def require_same_terms(arm, frame, rng):
    arm = arm.with_gravity((1.0, 2.0, -9.0))
    q = np.array([arm.random_configuration(rng) for _ in range(10)])
    task, x_d = aj.PositionTask(arm, frame, "x"), np.zeros((10, 1))
    plant = aj.Plant(arm, task)
    traced = TracedTerms([plant], task)
    found = traced.at(traced.numbers([plant] * 10), q, x_d)
    each = [vars(terms_alone(plant, plant.dynamics, task, *at)) for at in zip(q, x_d, strict=True)]
    require_same(vars(found), {name: [row[name] for row in each] for name in each[0]})


class Distance(aj.Task):
    """Of the tip to the base, as a user writes it."""

    def __init__(self, robot):
        super().__init__(robot, labels=("distance",), units=("m",))
        self._tip = FrameKinematics(robot, robot.tip)

    def value(self, q):
        return np.array([np.linalg.norm(self._tip.position(q))])

    def jacobian(self, q, x=None):
        away = self._tip.position(q)
        return (away / np.linalg.norm(away))[np.newaxis] @ self._tip.jacobian(q)[:3]

    def on(self, robot):
        return Distance(robot)


class Doubtful(aj.PositionTask):
    """Of a class of the library, with a Jacobian of its own."""

    def jacobian(self, q, x=None):
        return 0.9 * super().jacobian(q, x)

    def jacobian_dot(self, q, v):
        return 0.9 * super().jacobian_dot(q, v)

    def on(self, robot):
        return Doubtful(robot, self.frame, self.axes)


TASKS = {
    "position": aj.PositionTask,
    "two axes": lambda robot: aj.PositionTask(robot, axes="zx"),
    "elbow": lambda robot: aj.PositionTask(robot, "panda_link5"),
    "pose": aj.PoseTask,
    "tracker": lambda robot: TrackerTask(robot, (0.1, 0.2, 0.8), (0.3, 0.0, 0.1)),
    "pose tracker": lambda robot: PoseTrackerTask(robot, (0.1, 0.2, 0.8), (0.3, 0.0, 0.1)),
    "image": lambda robot: aj.ImageTask(robot, CAMERA),
    "own": Distance,
    "derived": Doubtful,
    "stacked": lambda robot: aj.StackedTask(aj.PositionTask(robot, axes="xz"), Distance(robot)),
    "combined": lambda robot: CombinedTask(aj.PositionTask(robot), np.tri(3)),
    "stack of combined": lambda robot: aj.StackedTask(
        CombinedTask(aj.PoseTask(robot), np.tri(6)), aj.PositionTask(robot, "panda_link4", "z")
    ),
    "nonsingular": lambda robot: NonsingularTask(aj.PositionTask(robot), {"panda_joint4": 0.2}),
}
SIMILAR = ("two axes", "elbow", "pose", "tracker", "derived", "combined", "stacked")


def closed_loop(make, learns=False):
    arm = aj.load_robot("panda")
    arm = arm if learns else arm.with_gravity((0.0, 0.0, 0.0))
    errors = aj.Uncertainty(
        arm, make, object_length=(0.0, 0.3), object_mass=(0.0, 1.0), believed_length=0.1,
        joint_rotations={"panda_joint2": (0.05, 0.0, 0.05)},
    )  # fmt: skip
    task = errors.believed_task()
    gains = aj.Gains(40.0, 8.0, 10.0)
    gravity = aj.AdaptiveGravity(task.robot, 0.5, 1.5) if learns else None
    return ClosedLoop(
        aj.SetpointController(task, gains, gravity=gravity), errors,
        aj.JointBox.around(arm, Q, 0.3),
    )  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.study if name in SIMILAR else []) for name in TASKS],
)
def test_samples_are_what_each_configuration_gives_alone(name, rng):
    loop = closed_loop(TASKS[name])
    samples, task = loop.draw(16, rng), loop.controller.task
    plants = [loop.plants[t] for t in samples.truth]
    each = list(zip(plants, samples.q, samples.x_d, strict=True))
    e = [p.sensor.error(p.sensor.value(q), x_d) for p, q, x_d in each]
    J = [p.sensor.sensor_jacobian(q) for p, q, _ in each]
    J_e = [p.sensor.error_jacobian(*at) for (p, *_), *at in zip(each, e, J, strict=True)]
    expected = {
        "M": [p.dynamics.M(q) for p, q, _ in each],
        "dM": [p.dynamics.M_gradient(q) for p, q, _ in each],
        "J": J, "J_e": J_e, "s": e,
        "J_hat": [task.jacobian(q) for q in samples.q],
        "dJ_hat": [jacobian_gradient(task, q) for q in samples.q],
    }  # fmt: skip
    # alone, such tasks have their rate by differences
    differences = ("dJ_hat",) if name in ("image", "own", "stacked") else ()
    require_same(vars(samples), expected, differences)
    assert len(set(samples.truth.tolist())) > 4


@pytest.mark.parametrize(
    "timing", [None, Timing(0.002, 1, 2, 3, 0.004)], ids=["continuous", "late"]
)
@pytest.mark.parametrize(
    "learns",
    [pytest.param(False, id="(6)", marks=pytest.mark.study), pytest.param(True, id="(28)")],
)
def test_targets_are_what_each_gives_alone(learns, timing, rng):
    loop = closed_loop(aj.PositionTask, learns)
    truths, q = loop.targets(12, rng)
    found = loop.stabilities(q, loop.terms(truths, q), timing)
    for t, each, own in zip(truths, q, found, strict=True):
        plant = loop.plants[t]
        parts = linear_loop(plant, loop.controller, each)
        (alone,) = stabilities(parts, 9.81, timing)
        expected = alone.eigenvalues
        dead_time = 0.0 if timing is None else timing.dead_time
        assert not alone.singular
        assert_allclose(own.decay_rate, -expected.real.max(), rtol=1e-8)
        lasting = expected[expected.real * dead_time > -np.log(10.0)]
        assert_allclose(
            own.damping_ratio, min(1.0, (-lasting.real / np.abs(lasting)).min()), rtol=1e-8
        )


def test_targets_that_do_not_feel_the_same_parameters_stand_side_by_side(two_link):
    """Hanging straight down, or nearly so: the regressor has another rank."""
    task, regressor = aj.PositionTask(two_link, axes="xz"), GravityRegressor(two_link, "x")
    gravity = aj.AdaptiveGravity(regressor, 0.5, 1.5)
    controller = aj.SetpointController(task, aj.Gains(50.0, 20.0), gravity=gravity)
    plant = aj.Plant(two_link, task)
    configurations = np.array([[0.3, 1.2], [np.pi / 2, 0.0], [0.5, 0.9]])
    loops = [linear_loop(plant, controller, q) for q in configurations]
    own = ("M", "G", "J", "J_hat", "J_hat_pinv", "Z")
    parts = {name: np.concatenate([getattr(each, name) for each in loops]) for name in own}
    together = stabilities(loops[0]._replace(**parts), 9.81)
    assert len({found.unseen_parameters for found in together}) == 2
    for each, found in zip(loops, together, strict=True):
        (alone,) = stabilities(each, 9.81)
        values, known = np.sort_complex(found.eigenvalues), np.sort_complex(alone.eigenvalues)
        assert_allclose(values, known, atol=1e-8)
        assert found.singular == alone.singular
