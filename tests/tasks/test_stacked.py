"""`StackedTask`: several tasks of one robot, one after the other."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.tasks.analysis import with_error


@pytest.fixture
def parts(panda):
    """A height of the elbow, and the pose of the tip."""
    return aj.PositionTask(panda, "panda_link4", axes="z"), aj.PoseTask(panda)


@pytest.fixture
def stacked(parts):
    return aj.StackedTask(*parts)


def test_everything_is_that_of_the_parts_one_after_the_other(panda, parts, stacked, rng):
    height, pose = parts
    q, q_d = (panda.random_configuration(rng) for _ in range(2))
    v = rng.uniform(-1, 1, 7)
    x, x_d = stacked.value(q), stacked.value(q_d)
    assert (stacked.m, stacked.n_x) == (7, 8)
    assert stacked.robot is panda
    assert stacked.tasks == parts
    assert_allclose(x[:1], height.value(q), atol=0)
    assert_allclose(x[1:], pose.value(q), atol=0)
    error = stacked.error(x, x_d)
    assert_allclose(error[:1], height.value(q) - height.value(q_d), atol=0)
    assert_allclose(error[1:], pose.error(pose.value(q), pose.value(q_d)), atol=0)
    J, J_dot = stacked.jacobian(q), stacked.jacobian_dot(q, v)
    assert_allclose(J[:1], height.jacobian(q), atol=0)
    assert_allclose(J[1:], pose.jacobian(q), atol=0)
    assert_allclose(J_dot[:1], height.jacobian_dot(q, v), atol=0)
    assert_allclose(J_dot[1:], pose.jacobian_dot(q, v), atol=0)
    rate = stacked.error_jacobian(error, J) @ v
    assert_allclose(rate[:1], height.jacobian(q) @ v, atol=1e-15)
    assert_allclose(rate[1:], pose.error_jacobian(error[1:], pose.jacobian(q)) @ v, atol=1e-15)
    assert not np.allclose(rate[4:], (J @ v)[4:])  # the rotation vector has a rate of its own


def test_labels_carry_the_number_of_the_task(stacked):
    assert stacked.labels == ("1.z", "2.x", "2.y", "2.z", "2.rx", "2.ry", "2.rz")
    assert stacked.units == ("m", "m", "m", "m", "rad", "rad", "rad")
    assert repr(stacked) == (
        "StackedTask(PositionTask('panda', 'panda_link4', 'z'), PoseTask('panda', "
        "'panda_hand_tcp'))"
    )


def test_displaced_values_have_the_displacement_as_their_error(panda, stacked, rng):
    for _ in range(20):
        x = stacked.value(panda.random_configuration(rng))
        displacement = rng.uniform(-1.5, 1.5, 7)
        assert_allclose(stacked.error(stacked.displaced(x, displacement), x), displacement, 1e-12)
    assert_allclose(stacked.origin, [0, 0, 0, 0, 0, 0, 0, 1])


def test_a_stack_of_stacks_is_as_good_as_one(panda, parts, rng):
    height, pose = parts
    inner = aj.StackedTask(pose)
    outer = aj.StackedTask(height, inner)
    flat = aj.StackedTask(height, pose)
    q = panda.random_configuration(rng)
    assert outer.labels[1:] == tuple(f"2.{label}" for label in inner.labels)
    assert_allclose(outer.value(q), flat.value(q), atol=0)
    assert_allclose(outer.jacobian(q), flat.jacobian(q), atol=0)


def test_a_part_without_orientation_is_lost(panda, stacked, rng):
    x = stacked.value(panda.random_configuration(rng))
    bad = x.copy()
    bad[4:] = 0.0
    error = stacked.error(bad, x)
    assert np.isnan(error[4:]).all()
    assert_allclose(error[:4], np.zeros(4), atol=0)
    with pytest.raises(aj.InvalidInputError, match="target must be a value of StackedTask"):
        stacked.target(bad)


def test_what_cannot_be_stacked_is_refused(panda, two_link, parts):
    height, pose = parts
    for tasks, text in (
        ((), "tasks must be at least one task, got none"),
        ((panda,), "each of tasks must be a task, such as PositionTask"),
        (([height, pose],), "each of tasks must be a task, such as PositionTask"),
        (
            (height, aj.PositionTask(two_link, axes="x")),
            r"tasks must be of one robot, got .*'panda'.* and .*'two_link'",
        ),
        ((pose, height, height), r"got m = 8 for panda with n_v = 7"),
    ):
        with pytest.raises(aj.InvalidInputError, match=text):
            aj.StackedTask(*tasks)


def test_the_elbow_is_placed_while_the_tip_reaches_its_target(panda):
    """Closed loop of Eq. (6) with an unknown tool: the tip's position and the elbow's y."""
    truth, belief = panda.with_object(0.1), panda.with_object(0.0)
    q0 = np.array([0.0, -0.4, 0.3, -1.9, 0.2, 1.6, 0.4])
    sensor, task = (
        aj.StackedTask(aj.PositionTask(robot), aj.PositionTask(robot, "panda_link4", axes="y"))
        for robot in (truth, belief)
    )
    target = sensor.value(q0 + [0.4, 0.1, -0.3, 0.1, 0.1, -0.1, 0.2])
    run = aj.simulate(
        aj.Plant(truth, sensor), aj.SetpointController(task), target, q0, 20.0,
        dt=2e-3, record_every=20.0, computation=aj.simulation.Computation("semi_implicit_euler"),
    )  # fmt: skip
    assert np.abs(run.error[0]).min() > 0.01
    assert np.abs(run.error[-1]).max() < 1e-4
    assert run.task_labels == ("1.x", "1.y", "1.z", "2.y")


@pytest.fixture
def watched(panda):
    """Two images with depths in x that no error has, and a position behind them."""
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))
    points = ((0.0, 0.0, 0.0), (0.05, 0.0, 0.02))
    images = aj.ImageTask(panda, camera, points=points, depth="measured")
    height = aj.PositionTask(panda, "panda_link4", axes="z")
    return aj.StackedTask(height, images, aj.PositionTask(panda, axes="x"))


def test_each_part_of_x_is_in_its_own_coordinates_of_the_error(panda, watched, stacked, rng):
    """So that one of them can be lost, and held, without the others."""
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    for task, parts in ((watched, 4), (stacked, 2)):
        x, seen = task.value(q), np.zeros(task.m)
        assert len(task.parts) == parts
        for entries, rows in task.parts:
            lost = x.copy()
            lost[entries] = np.nan
            own = np.isnan(task.error(lost, x))
            assert np.flatnonzero(own).tolist() == list(range(task.m))[rows]
            seen += own
        assert_allclose(seen, 1.0)


def test_what_is_in_no_error_stays_as_it_was_measured(watched, rng):
    q, other = np.array(
        [[0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7], [0.1, -0.4, 0.1, -1.9, 0, 1.5, 0.6]]
    )
    x, x_d, e = watched.value(q), watched.value(other), rng.normal(size=watched.m)
    value = with_error(watched, x, x_d, e)
    assert_allclose(watched.error(value, x_d), e)
    depths = [3, 6]
    assert_allclose(value[depths], x[depths])
    assert np.abs(x[depths] - x_d[depths]).min() > 1e-3
