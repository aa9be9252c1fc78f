"""Tasks on symbols, compared with the tasks themselves."""

import functools

import numpy as np
import pytest

import approxjac as aj
from approxjac.cameras import PlanarCamera, tag_corners
from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.rigid_body import Arm
from approxjac.codegen.backends.numpy_function import numpy_function
from approxjac.codegen.step import compiled
from approxjac.codegen.trace.program import Program
from approxjac.codegen.trace.symbols import arctangent, inputs
from approxjac.controllers import KnownKinematics
from approxjac.errors import InvalidInputError
from approxjac.tasks import (
    CombinedTask,
    FrameKinematics,
    NonsingularTask,
    PoseTrackerTask,
    TrackerTask,
)

CAMERA = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))
LENS = aj.PinholeCamera.looking_at(
    (0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480), distortion=(-0.2, 0.05, 0.01)
)
BENT = aj.PinholeCamera.looking_at(
    (0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480),
    distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, 0.0, 0.0, 2e-3, -1e-3, -3e-3, 0.0, 0.05, 0.1),
)  # fmt: skip
FISHEYE = aj.PinholeCamera(
    150.0, (640, 480), distortion=(0.05, -0.01, 0.003, -0.001), fisheye=True
).standing_at((0.9, -0.3, 0.6), looking_at=(0.4, 0.0, 0.4))
HAND = aj.PinholeCamera(500.0, (640, 480), (0.02, 0.0, 0.05), mount="panda_hand_tcp")
SQUARE = ((0.0, 0.0, 0.05), (0.1, 0.0, 0.05), (0.0, 0.1, 0.05))
FLOOR = ((0.4, 0.0, -0.5), (0.6, 0.1, -0.5), (0.5, -0.2, -0.4))


@functools.cache
def kinds():
    """Tasks by name, one for each way through their functions."""
    panda, kinova = aj.load_robot("panda"), aj.load_robot("kinova")
    position = aj.PositionTask(panda)
    image = aj.ImageTask(panda, CAMERA, points=SQUARE)
    tag = aj.ImageTask(panda, LENS, points=tag_corners(0.1))
    two = aj.StackedTask(position, aj.PositionTask(panda, "panda_link4", "yz"))
    return {
        "position": position,
        "axes in another order": aj.PositionTask(kinova, axes="yx"),
        "tracker": TrackerTask(panda, (0.1, 0.2, 0.3), (1.0, 2.0, 3.0)),
        "pose of a tracker": PoseTrackerTask(panda, (0.1, 0.2, 0.3), (1.0, 2.0, 3.0)),
        "pose": aj.PoseTask(panda),
        "pose, continuous joints": aj.PoseTask(kinova),
        "planar camera": aj.ImageTask(
            aj.load_robot("two_link"), PlanarCamera(0.016, 0.8, 0.3, (0.01, 0.0))
        ),
        "pinhole camera": aj.ImageTask(panda, CAMERA),
        "three points": image,
        "three points, a lens": aj.ImageTask(panda, LENS, points=SQUARE),
        "in the hand": aj.ImageTask(panda, HAND, points=FLOOR),
        "in the hand, of a link": aj.ImageTask(panda, HAND, "panda_link3", points=SQUARE[:2]),
        "a depth": aj.ImageTask(panda, CAMERA, points=SQUARE, depth=(1.5, 2.0, 2.5)),
        "a depth, a lens": aj.ImageTask(panda, LENS, depth=1.5),
        "all that a lens may have": aj.ImageTask(panda, BENT),
        "a depth, all that a lens may have": aj.ImageTask(panda, BENT, depth=1.5),
        "a fisheye lens": aj.ImageTask(panda, FISHEYE),
        "a depth, a fisheye lens": aj.ImageTask(panda, FISHEYE, depth=0.5),
        "measured depths": aj.ImageTask(panda, CAMERA, points=SQUARE, depth="measured"),
        "stacked": two,
        "stacked, image and position": aj.StackedTask(
            aj.ImageTask(panda, CAMERA), aj.PositionTask(panda, axes="z")
        ),
        "combined": CombinedTask.balanced(image, image.value(SEEN)),
        "a tag": CombinedTask.balanced(tag, tag.value(SEEN)),
        "stacked, combined": aj.StackedTask(
            CombinedTask(aj.ImageTask(panda, CAMERA), [[1.0, 0.5], [0.0, 1.0]]),
            aj.PositionTask(panda, axes="z"),
        ),
        "nonsingular": NonsingularTask(position, {"panda_joint4": 0.3}, 0.3),
        "nonsingular, stacked": NonsingularTask(two, {"panda_joint4": 0.3}, 0.3),
        "nonsingular, image": NonsingularTask(image, {"panda_joint4": 0.3}, 0.3),
    }


SEEN = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
KINDS = (
    "position", "axes in another order", "tracker", "pose of a tracker", "pose",
    "pose, continuous joints", "planar camera", "pinhole camera", "three points",
    "three points, a lens", "in the hand",
    "in the hand, of a link", "a depth", "a depth, a lens",
    "all that a lens may have", "a depth, all that a lens may have", "a fisheye lens",
    "a depth, a fisheye lens", "measured depths", "stacked",
    "stacked, image and position", "combined", "a tag", "stacked, combined", "nonsingular",
    "nonsingular, stacked", "nonsingular, image",
)  # fmt: skip


def evaluated(task, q, x, x_d):
    """Return value, Jacobian and error on symbols, each (N, …), at inputs of shape (N, …)."""
    program = Program()
    ours = {"q": q, "x": x, "x_d": x_d}
    named = {name: inputs(program.graph, name, each.shape[1]) for name, each in ours.items()}
    arm = Arm(program.given, "arm", task.robot, tasks.frames(task))
    here = arm.at(named["q"])
    value = tasks.value(task, here)
    terms = (
        tasks.seen(task, value),
        value,
        tasks.jacobian(task, here, named["x"]),
        tasks.error(task, named["x"], named["x_d"]),
    )
    numbers = [number for term in terms for number in np.ravel(term).tolist()]
    with np.errstate(all="ignore"):
        rows = numpy_function(program.graph, numbers)(**{n: each.T for n, each in ours.items()})
    values = np.array([np.broadcast_to(row, len(q)) for row in rows]).T
    ends = np.cumsum([np.size(term) for term in terms])[:-1]
    parts = np.split(values, ends, axis=1)
    return [part.reshape(-1, *np.shape(term)) for part, term in zip(parts, terms, strict=True)]


@pytest.mark.parametrize("kind", KINDS)
def test_value_jacobian_and_error_are_those_of_the_task(kind, rng):
    task = kinds()[kind]
    q = np.array([task.robot.random_configuration(rng) for _ in range(40)])
    if len(SEEN) == q.shape[1]:
        q[:20] = SEEN + 0.3 * rng.normal(size=(20, len(SEEN)))
    exact = np.array([task.value(each) for each in q])
    x = exact + 0.01 * rng.normal(size=exact.shape) * (10.0 if "image" in kind else 1.0)
    x_d = np.roll(exact, 1, axis=0)
    seen, value, jacobian, error = evaluated(task, q, x, x_d)
    right = np.array([task.visible(each) for each in exact])
    np.testing.assert_allclose(seen, right, rtol=1e-12, atol=1e-12 * np.nanmax(np.abs(exact)))
    np.testing.assert_allclose(value, exact, rtol=1e-12, atol=1e-12 * np.nanmax(np.abs(exact)))
    right = np.array([task.jacobian(*each) for each in zip(q, x, strict=True)])
    np.testing.assert_allclose(jacobian, right, rtol=0, atol=1e-12 * np.abs(right).max())
    right = np.array([task.error(*each) for each in zip(x, x_d, strict=True)])
    np.testing.assert_allclose(error, right, rtol=1e-12, atol=1e-12 * np.nanmax(np.abs(right)))
    assert np.isfinite(right).any()


def test_every_kind_is_compared():
    assert tuple(kinds()) == KINDS


def test_small_turns_and_those_near_half_a_turn(panda, rng):
    """Where the angle has few digits left of the quaternion's w, or none of its sine."""
    task = aj.PoseTask(panda)
    x, x_d = np.zeros((2, 60, 7))
    for k, angle in enumerate(np.repeat([0.0, 1e-160, 1e-9, 1e-3, 3.1415926, np.pi], 10)):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        x_d[k, 3:] = rng.normal(size=4)
        e = np.concatenate([np.zeros(3), angle * axis])
        x[k] = task.displaced(np.append(x_d[k, :3], x_d[k, 3:] / np.linalg.norm(x_d[k, 3:])), e)
    x[::3, 3:] *= -2.0
    x[3, 3:] = 1e-7
    q = np.array([SEEN] * len(x))
    error = evaluated(task, q, x, x_d)[3]
    right = np.array([task.error(*each) for each in zip(x, x_d, strict=True)])
    assert np.isnan(right[3, 3:]).all()
    near = np.arange(len(x)) < 50
    np.testing.assert_allclose(error[near], right[near], rtol=1e-12, atol=1e-15)
    # at half a turn itself, whose two ways round are equally long, rounding may choose
    turned = np.abs(error - right).max(axis=1)[~near]
    back = np.abs(error + right).max(axis=1)[~near]
    assert (np.minimum(turned, back) < 1e-12).all()


def test_arctangent_has_its_digits(rng):
    program = Program()
    y, x = inputs(program.graph, "y", 1), inputs(program.graph, "x", 1)
    function = numpy_function(program.graph, [arctangent(y[0], x[0])])
    angle = np.concatenate([np.linspace(0.0, 0.5 * np.pi, 20001), 10.0 ** rng.uniform(-300, 0, 99)])
    given = np.abs(np.sin(angle)), np.abs(np.cos(angle))
    (found,) = function(y=given[0][np.newaxis], x=given[1][np.newaxis])
    wanted = np.arctan2(*given)
    assert (np.abs(found - wanted) <= 2.0 * np.spacing(wanted)).all()


class Range(aj.Task):
    """Distance and height of the tip as a sensor on a post sees them."""

    def __init__(self, robot, post):
        super().__init__(robot, ("distance", "height"), ("m", "m"))
        self.post, self._tip = np.array(post), FrameKinematics(robot, robot.tip)

    def value(self, q):
        away = self._tip.position(q) - self.post
        return np.stack([np.linalg.norm(away), away[2]])

    def jacobian(self, q, x=None):
        away, J = self._tip.position(q) - self.post, self._tip.jacobian(q)[:3]
        return np.stack([away / np.linalg.norm(away) @ J, J[2]])

    def on(self, robot):
        return Range(robot, self.post)


class Turning(PlanarCamera):
    """A planar camera whose image is turned the more, the farther out a point is."""

    def project(self, r):
        u, v = super().project(r)
        return np.stack([u + 0.1 * u * v, v - 0.1 * u * u])

    def interaction(self, r):
        u, v = super().project(r)
        J = super().interaction(r)
        return np.stack([(1.0 + 0.1 * v) * J[0] + 0.1 * u * J[1], J[1] - 0.2 * u * J[0]])


def test_tasks_and_cameras_of_ones_own_are_those_of_python(panda, rng):
    camera = Turning(0.016, 0.8, 0.3)
    for task in (
        Range(panda, (0.0, 1.0, 0.0)),
        aj.StackedTask(aj.PositionTask(panda, axes="y"), Range(panda, (0.0, 1.0, 0.0))),
        NonsingularTask(Range(panda, (0.5, 1.0, 0.0)), {"panda_joint4": 0.3}, 0.5),
        aj.ImageTask(aj.load_robot("two_link"), camera),
    ):
        q = np.array([task.robot.random_configuration(rng) for _ in range(10)])
        x = np.array([task.value(each) for each in q])
        _, value, jacobian, error = evaluated(task, q, x, x[::-1])
        np.testing.assert_allclose(value, x, rtol=1e-12, atol=1e-12)
        right = np.array([task.jacobian(*each) for each in zip(q, x, strict=True)])
        np.testing.assert_allclose(jacobian, right, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(error, x - x[::-1], rtol=0, atol=1e-15)


def test_a_tracking_law_follows_a_task_of_ones_own_compiled(panda, rng):
    task = Range(panda, (0.0, 1.0, 0.0))
    plain = aj.TrackingController(task, kinematics=KnownKinematics(task))
    quick = compiled(plain)
    for fast in (0.0, 0.3, 1.0) * 10:
        q, v = panda.random_configuration(rng), fast * rng.normal(size=7)
        measured = aj.Measurement(0.0, q, v, task.value(q), 0.0)
        target = aj.Target(measured.x + 0.02, 0.1 * rng.normal(size=2))
        state = plain.initial_state(measured)
        torque, same = (
            each.step(state, measured, target, 1e-3)[1].torque for each in (plain, quick)
        )
        # what is a difference of Jacobians, 1e-5 apart, has their rounding a hundred thousand times
        np.testing.assert_allclose(same, torque, rtol=0, atol=1e-9 * np.abs(torque).max())


def test_what_branches_on_a_value_is_named(panda):
    class Folded(Range):
        def value(self, q):
            x = super().value(q)
            return x if x[1] > 0.0 else -x

    for task in (Folded(panda, (0.0, 1.0, 0.0)), aj.StackedTask(Folded(panda, (0.0, 1.0, 0.0)))):
        wanted = r"^task must take symbols .*which Folded.value does not: TypeError: no branch"
        with pytest.raises(InvalidInputError, match=wanted):
            tasks.frames(task)
