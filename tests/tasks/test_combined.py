"""Combinations of coordinates: the same task with gains along other directions."""

import copy
import pickle

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.robots import Dynamics
from approxjac.tasks import CombinedTask, NonsingularTask
from approxjac.tasks.analysis import uncombined

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
POINTS = ((0.0, 0.0, 0.0), (0.0, 0.15, 0.0))


@pytest.fixture(scope="module")
def image(panda):
    camera = aj.PinholeCamera.looking_at((0.5, 0.0, 0.5), (1.5, -0.7, 0.9), 600.0, (640, 480))
    return aj.ImageTask(panda, camera, points=POINTS)


@pytest.fixture
def C(rng):
    return rng.normal(size=(4, 4))


def test_error_and_jacobian_are_combined_and_values_are_not(image, C, rng):
    task = CombinedTask(image, C)
    other = pin.integrate(image.robot.model, Q, 0.1 * rng.normal(size=7))
    x, x_d = image.value(other), image.value(Q)
    assert_array_equal(task.value(other), x)
    assert_allclose(task.error(x, x_d), C @ (x - x_d))
    assert_allclose(task.jacobian(Q), C @ image.jacobian(Q))
    assert_allclose(task.sensor_jacobian(Q), C @ image.sensor_jacobian(Q))
    v = rng.normal(size=7)
    assert_allclose(task.jacobian_dot(Q, v), C @ image.jacobian_dot(Q, v))
    assert_allclose(uncombined(task) @ task.jacobian(Q) @ v, image.jacobian(Q) @ v)
    assert task.measured is image
    assert task.labels == ("c1", "c2", "c3", "c4")
    assert set(task.units) == {"px"}
    e = rng.normal(size=4)
    assert_allclose(task.error(task.displaced(x, e), x), e)
    assert_allclose(task.on(image.robot.with_object(0.1, 0.2)).C, C)


def test_of_a_pose_the_error_is_combined_too(panda, rng):
    C = rng.normal(size=(6, 6))
    pose = aj.PoseTask(panda)
    task = CombinedTask(pose, C)
    h, other = 1e-6, pin.integrate(panda.model, Q, 0.3 * rng.normal(size=7))
    x_d = pose.value(Q)
    J_e = task.error_jacobian(task.error(task.value(other), x_d), task.jacobian(other))
    columns = [
        (
            task.error(task.value(pin.integrate(panda.model, other, h * unit)), x_d)
            - task.error(task.value(pin.integrate(panda.model, other, -h * unit)), x_d)
        )
        / (2 * h)
        for unit in np.eye(7)
    ]
    assert_allclose(J_e, np.array(columns).T, atol=1e-7)
    assert (task.n_x, task.m) == (7, 6)


def test_gains_along_coordinates_are_the_same_as_with_the_identity(image):
    """A combination by a multiple of an orthogonal matrix changes nothing but the gains' size."""
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(4, 4)))[0]
    plain = aj.SetpointController(image, aj.Gains(4e-3, 1e-3, 1.0))
    turned = aj.SetpointController(
        CombinedTask(image, 2.0 * rotation), aj.Gains(1e-3, 0.25e-3, 1.0)
    )
    x_d = image.value(Q)
    measured = aj.Measurement(0.0, Q, np.full(7, 0.1), x_d + [30.0, -20.0, 5.0, 8.0])
    torques = [c.evaluate(np.zeros(0), measured, x_d).torque for c in (plain, turned)]
    assert_allclose(torques[1], torques[0], rtol=1e-12)


def test_balanced_makes_the_arm_as_heavy_along_all_directions(image):
    task = CombinedTask.balanced(image, image.value(Q))
    assert np.linalg.norm(task.C, 2) == pytest.approx(1.0)
    M_inv = np.linalg.inv(Dynamics(image.robot).M(Q))

    def spread(one):
        J = one.jacobian(Q)
        values = np.linalg.eigvalsh(J @ M_inv @ J.T)
        return values[-1] / values[0]

    assert spread(task) < 0.5 * spread(image)
    again = CombinedTask.balanced(image, image.value(Q))
    assert_array_equal(again.C, task.C)


@pytest.mark.study
def test_a_plant_whose_sensor_is_the_task_itself(image):
    x_d = image.value(Q)
    task = CombinedTask.balanced(image, x_d)
    start = pin.integrate(image.robot.model, Q, np.full(7, 0.1))
    plant = aj.Plant(image.robot, image)
    run = aj.simulate(plant, aj.SetpointController(task), x_d, start, 4.0, dt=2e-3)
    assert run.task_labels == ("u1", "v1", "u2", "v2")
    assert_allclose(run.error, run.x - x_d)
    assert run.error_norm[0] > 50.0
    assert run.error_norm[-1] < 0.5
    # stability tests compare J and Ĵ, so they take both combined alike
    with pytest.raises(aj.InvalidInputError, match="the coordinates of the plant's sensor"):
        aj.local_stability(plant, aj.SetpointController(task), Q)
    combined = aj.Plant(image.robot, CombinedTask(image, task.C))
    report = aj.local_stability(combined, aj.SetpointController(task), Q)
    assert report.stable
    late = run.t > 2.0
    slope = np.polyfit(run.t[late], np.log(run.error_norm[late]), 1)[0]
    assert slope == pytest.approx(-report.decay_rate, rel=0.2)


def test_held_measurements_count_in_pixels(image):
    """Whatever C is, `unseen` is how far an image moves."""
    x_d = image.value(Q)
    v = np.full(7, 0.5)
    for C in (np.eye(4), np.diag([1e-3, 1e3, 1.0, 1.0])):
        task = CombinedTask(image, C)
        held = aj.HeldMeasurement(aj.SetpointController(task), unseen=20.0).guarded(None)
        measured = aj.Measurement(0.0, Q, v, x_d + 50.0)
        state = held.initial_state(measured)
        bridged, status = -1, aj.Status.OK
        while status is not aj.Status.MEASUREMENT_LOST:
            state, answer = held.step(state, measured, x_d, 1e-3)
            bridged, status = bridged + 1, answer.status
        expected = 20.0 / np.abs(image.jacobian(Q) @ v).max() / 1e-3
        assert bridged == pytest.approx(expected, abs=2)
        lost = measured._replace(x=np.array([np.nan, np.nan, *x_d[2:]]))
        _, fresh = held.step(held.initial_state(lost), lost, x_d, 1e-3)
        assert fresh.status is aj.Status.MEASUREMENT_LOST


def test_a_target_moves_in_the_coordinates_of_what_is_measured(image, C, rng):
    """Its velocity acts as the error of a longer way does, whatever is combined."""
    posture = aj.PositionTask(image.robot, "panda_link4", axes="z")
    tasks = (image, CombinedTask(image, C), aj.StackedTask(CombinedTask(image, C), posture))
    for task in tasks:
        law = aj.SetpointController(task, aj.Gains(2e-3, 2e-3, 1e-9))
        x_d, v_d = task.value(Q), rng.normal(size=task.m)
        measured = aj.Measurement(0.0, Q, np.zeros(7), x_d)
        moving = law.evaluate(np.zeros(0), measured, aj.Target(x_d, v_d))
        ahead = law.evaluate(np.zeros(0), measured, aj.Target(x_d + v_d))
        assert_allclose(moving.torque, ahead.torque, rtol=1e-6)


def test_copies(image, C):
    task = CombinedTask(image, C)
    for other in (pickle.loads(pickle.dumps(task)), copy.deepcopy(task)):
        assert repr(other) == repr(task)
        assert_array_equal(other.jacobian(Q), task.jacobian(Q))


@pytest.mark.parametrize(
    ("C", "text"),
    [
        (np.eye(3), r"C must have shape \(k, 4\), got shape \(3, 3\)"),
        (np.ones((5, 4)), r"C must have full row rank, with at most 4 rows, got shape \(5, 4\)"),
        (
            np.diag([1.0, 1.0, 1.0, 0.0]),
            r"full row rank, .* and singular values \[1.0, 1.0",
        ),
        (np.full((4, 4), np.nan), "C must be finite"),
        ("balanced", r"C must be numbers of shape \(k, 4\), got 'balanced'"),
    ],
)
def test_bad_combinations_are_refused(image, C, text):
    with pytest.raises(aj.InvalidInputError, match=text):
        CombinedTask(image, C)


def test_what_is_no_task_or_no_target_is_refused(image):
    with pytest.raises(aj.InvalidInputError, match=r"task must be a task, such as ImageTask\("):
        CombinedTask(None, np.eye(4))
    with pytest.raises(aj.InvalidInputError, match="target must be within the image of 640 x 480"):
        CombinedTask.balanced(image, [700.0, 0.0, 10.0, 10.0])


def test_a_plant_with_another_combination_is_refused_by_the_local_test(image, C, rng):
    controller = aj.SetpointController(CombinedTask(image, C))
    aj.local_stability(aj.Plant(image.robot, CombinedTask(image, C)), controller, Q)
    for other in (rng.normal(size=(4, 4)), 2.0 * C):
        plant = aj.Plant(image.robot, CombinedTask(image, other))
        with pytest.raises(aj.InvalidInputError, match="must combine its coordinates as"):
            aj.local_stability(plant, controller, Q)


def test_stacked_and_designed_tasks_take_what_is_measured(image, rng):
    C = rng.normal(size=(4, 4))
    posture = aj.PositionTask(image.robot, "panda_link4", axes="z")
    stacked = aj.StackedTask(CombinedTask(image, C), posture)
    designed = NonsingularTask(CombinedTask(image, C), {"panda_joint4": 0.2})
    v = rng.normal(size=7)
    for task, sensor in ((stacked, aj.StackedTask(image, posture)), (designed, image)):
        assert task.measured.labels == sensor.labels
        if task is stacked:
            assert_allclose(uncombined(task) @ task.jacobian(Q) @ v, sensor.jacobian(Q) @ v)
        else:  # as the design has it
            assert_allclose(C @ uncombined(task) @ task.jacobian(Q) @ v, task.jacobian(Q) @ v)
        held = aj.HeldMeasurement(aj.SetpointController(task), unseen=50.0)
        x_d = sensor.value(Q)
        record = aj.simulate(aj.Plant(image.robot, sensor), held, x_d, Q, 0.01, dt=1e-3)
        assert record.error_norm.max() < 1e-2


def test_depths_of_a_target_are_not_used_to_balance(image):
    depth = aj.ImageTask(image.robot, image.camera, points=POINTS, depth="measured")
    x_d = depth.value(Q)
    other = x_d.copy()
    other[2::3] = 1e3
    found = [CombinedTask.balanced(depth, target).C for target in (x_d, other)]
    assert_array_equal(*found)


@pytest.mark.study
def test_inertias_along_pixels_and_metres_do_not_compare(image):
    height = aj.PositionTask(image.robot, "panda_link4", "z")
    stack = aj.StackedTask(image, height)
    with pytest.raises(aj.InvalidInputError, match="must have coordinates of one unit to be"):
        CombinedTask.balanced(stack, stack.value(Q))
    parts = aj.StackedTask(CombinedTask.balanced(image, image.value(Q)), height)
    start = pin.integrate(image.robot.model, Q, np.full(7, 0.05))
    run = aj.simulate(
        aj.Plant(image.robot, stack), aj.SetpointController(parts), stack.value(Q), start, 3.0,
        dt=2e-3,
    )  # fmt: skip
    assert np.abs(run.error[-1]).max() < 0.5
