"""Paths of a target: their rates are derivatives, their limits hold, wrong ones are refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import approxjac as aj

PATHS = {
    "circle": aj.Circle([0.4, 0.1, 0.5], 0.1, 4.0),
    "tilted circle": aj.Circle([0.4, 0.1, 0.5], 0.1, 4.0, normal=[1.0, 2.0, -1.0]),
    "plane circle": aj.Circle([0.4, 0.1], 0.2, 3.0),
    "line": aj.Line([0.4, 0.0, 0.3], [0.2, 0.3, 0.5], 2.0),
    "waypoints": aj.Waypoints([[0.0, 0.0], [0.3, 0.4], [0.3, 0.0]], speed=0.2, acceleration=0.5),
    "short waypoints": aj.Waypoints([[0.0], [0.01]], speed=10.0, acceleration=0.5),
}


@pytest.mark.parametrize("name", PATHS)
def test_rates_are_derivatives(name):
    path, h = PATHS[name], 1e-6
    for t in np.linspace(0.0137, 5.0, 60):
        before, here, after = path.at(t - h), path.at(t), path.at(t + h)
        assert_allclose((after.x - before.x) / (2 * h), here.v, atol=1e-8)
        if abs(np.abs(after.a).sum() - np.abs(before.a).sum()) < 1e-3:  # not where it jumps
            assert_allclose((after.v - before.v) / (2 * h), here.a, atol=1e-6)


@pytest.mark.parametrize("normal", [None, [0, 0, 1], [0, 0, -2], [1, 0, 0], [1.0, 2.0, -1.0]])
def test_a_circle_keeps_its_radius_and_plane_and_turns_to_the_left(normal):
    circle = aj.Circle([0.4, 0.1, 0.5], 0.1, 4.0, normal=normal)
    n = np.array([0.0, 0.0, 1.0] if normal is None else normal)
    for t in np.linspace(0.0, 4.0, 9):
        x, v, _ = circle.at(t)
        assert_allclose(np.linalg.norm(x - circle.center), 0.1)
        assert_allclose((x - circle.center) @ n, 0.0, atol=1e-12)
        turns = np.cross(x - circle.center, v)
        assert_allclose(turns / np.linalg.norm(turns), n / np.linalg.norm(n), atol=1e-12)
    assert_allclose(circle.at(4.0).x, circle.at(0.0).x)
    plane = aj.Circle([0.4, 0.1], 0.1, 4.0)
    assert_allclose(plane.at(1.0).x, [0.4, 0.2])


def test_a_line_rests_at_both_ends():
    line = PATHS["line"]
    for t, end in ((-1.0, line.start), (0.0, line.start), (2.0, line.end), (9.0, line.end)):
        x, v, a = line.at(t)
        assert_allclose(x, end)
        assert_allclose([v, a], 0.0, atol=1e-12)


@given(
    st.lists(st.tuples(*[st.floats(-1, 1)] * 3), min_size=2, max_size=5, unique=True),
    st.floats(0.01, 3.0),
    st.floats(0.1, 20.0),
)
def test_waypoints_keep_their_limits_and_reach_each_point(points, speed, acceleration):
    points = np.array(points)
    if not (np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6).all():
        return
    path = aj.Waypoints(points, speed, acceleration)
    targets = [path.at(t) for t in np.linspace(0.0, path.duration, 200)]
    assert max(np.linalg.norm(target.v) for target in targets) <= speed * (1 + 1e-9)
    assert max(np.linalg.norm(target.a) for target in targets) <= acceleration * (1 + 1e-9)
    for start, point in zip(path._starts, points, strict=True):
        assert_allclose(path.at(start).x, point, atol=1e-9)
        assert_allclose(path.at(start).v, 0.0, atol=1e-6)
    assert_allclose(path.at(path.duration + 1.0).x, points[-1], atol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (lambda: aj.Circle([0.4, 0.1, 0.5], 0.0, 4.0), "radius must be a finite number > 0"),
        (lambda: aj.Circle([0.4], 0.1, 4.0), "center must have 3 coordinates, or 2 without"),
        (lambda: aj.Circle([0.4, 0.1, 0.5, 0, 0, 0, 1], 0.1, 4.0), "a path of poses is any object"),
        (lambda: aj.Circle([0.4, 0.1], 0.1, 4.0, normal=[0, 0, 1]), "or 2 without a normal"),
        (lambda: aj.Circle([0, 0, 0], 0.1, 4.0, normal=[0, 0, 0]), "normal must have a length"),
        (lambda: aj.Circle(0.4, 0.1, 4.0), r"center must have shape \(m,\), got shape \(\)"),
        (lambda: aj.Line([0, 0], [1, 0, 0], 1.0), r"end must have shape \(2,\)"),
        (lambda: aj.Line([0, 0], [1, 0], 0.0), "duration must be a finite number > 0"),
        (lambda: aj.Waypoints([[0, 0]], 1.0, 1.0), "points must be at least two points"),
        (lambda: aj.Waypoints([[0, 0], [0, 0]], 1.0, 1.0), "two points that differ from one"),
        (lambda: aj.Waypoints([[0, 0], [1, 0]], -1.0, 1.0), "speed must be a finite number > 0"),
    ],
)
def test_wrong_paths_are_refused(wrong, text):
    with pytest.raises(aj.InvalidInputError, match=text):
        wrong()


# -- followed by the set-point law ----------------------------------------------------------

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


class WithoutRate:
    """A path whose velocity is not told."""

    def __init__(self, path):
        self.path = path

    def at(self, t):
        return aj.Target(self.path.at(t).x)


@pytest.fixture(scope="module")
def loop(panda):
    plant = aj.Plant(panda)
    circle = aj.Circle(plant.sensor.value(START) - [0.1, 0.0, 0.0], 0.1, 4.0)
    return plant, aj.SetpointController(aj.PositionTask(panda)), circle


def rms(run):
    late = run.t > 4.0
    return float(np.sqrt((run.error_norm[late] ** 2).mean()))


@pytest.mark.study
def test_feed_forward_follows_a_circle_more_closely(loop):
    plant, law, circle = loop
    options = {"q0": START, "duration": 6.0, "record_every": 0.02}
    led = aj.simulate(plant, law, circle, **options)
    behind = aj.simulate(plant, law, WithoutRate(circle), **options)
    assert_allclose(led.x_d, [circle.at(t).x for t in led.t])
    assert rms(led) < 0.5 * rms(behind)
    late = aj.simulate(plant, law, circle, dt=None, **options | {"record_every": 0.1})
    assert_allclose(late.x[::2], led.x[::10], atol=2e-3)  # continuous control follows it alike


def test_every_controller_takes_a_path(loop):
    plant, law, circle = loop
    limited = aj.TorqueLimited(law, aj.Limits.of(law.task.robot))
    for controller in (limited, aj.HeldMeasurement(limited, 0.1)):
        run = aj.simulate(plant, controller, circle, START, duration=0.5)
        assert run.error_norm[-1] < 0.1


def test_the_law_acts_on_the_motion_relative_to_that_of_the_target(loop):
    """It is that of a target at rest with q̇ − Ĵ⁺ẋ_d in place of q̇, in what learns too."""
    _, law, _ = loop
    x = law.task.value(START)
    v = np.array([0.1, -0.3, 0.2, 0.4, 0.1, -0.2, 0.3])
    here = aj.Measurement(0.0, START, v, x)
    moving = aj.Target(x, law.task.jacobian(START) @ v)
    still = law.evaluate(np.zeros(0), here._replace(v=np.zeros(7)), x)
    answer = law.evaluate(np.zeros(0), here, moving)
    J_hat = law.task.jacobian(START)
    relative = v - np.linalg.pinv(J_hat) @ J_hat @ v
    assert_allclose(answer.torque, still.torque - law.diagonals.damping * relative, atol=1e-9)
    learner = aj.SetpointController(law.task, gravity=aj.AdaptiveGravity(law.task.robot))
    state, x_d = learner.begin(here), x + [0.02, -0.01, 0.03]
    along = learner.evaluate(state, here, aj.Target(x_d, J_hat @ v))
    at_rest = learner.evaluate(state, here._replace(v=relative), x_d)
    assert_allclose(along.torque, at_rest.torque, atol=1e-9)
    assert_allclose(along.state_rate, at_rest.state_rate, atol=1e-9)
    lost = law.evaluate(np.zeros(0), here._replace(x=np.full(3, np.nan)), moving)
    blind = law.evaluate(np.zeros(0), here._replace(x=np.full(3, np.nan)), x)
    assert_allclose(lost.torque, blind.torque)  # nobody follows a target blindly


def test_wrong_targets_are_refused(loop):
    plant, law, circle = loop
    here = plant.measure(0.0, START, np.zeros(7))
    for target, text in (
        (aj.Target(here.x, np.zeros(2)), r"v of the target must have shape \(3,\)"),
        (aj.Target(here.x, np.full(3, np.nan)), "v of the target must be finite"),
        (aj.Target(np.zeros(2)), r"target must be an array of shape \(3,\)"),
    ):
        with pytest.raises(aj.InvalidInputError, match=text):
            law.evaluate(np.zeros(0), here, target)
    with pytest.raises(aj.InvalidInputError, match=r"target must have shape \(3,\)"):
        aj.simulate(plant, law, aj.Circle([0.4, 0.1], 0.1, 4.0), START)
    with pytest.raises(aj.InvalidInputError, match=r"v of the target must have shape \(3,\)"):
        aj.simulate(plant, law, aj.Target(here.x, np.zeros(2)), START)
    path = WithoutRate(circle)
    path.at = lambda t: here.x
    with pytest.raises(aj.InvalidInputError, match=r"at\(t\) of a path must be a Target"):
        aj.simulate(plant, law, path, START)
