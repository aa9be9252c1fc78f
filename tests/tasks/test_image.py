"""Image tasks: points of the arm in a fixed camera, points of the world in a camera on the arm."""

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.errors import UnknownNameError
from approxjac.robots import Dynamics
from approxjac.tasks import CombinedTask, FrameKinematics, NonsingularTask
from approxjac.tasks.analysis import sees

SIZE = (640, 480)
POINTS = ((0.0, 0.0, 0.0), (0.03, 0.02, 0.05), (-0.02, 0.04, 0.02))


def watching(robot, q, frame=None, points=1, *, distortion=(-0.2, 0.05), **options):
    """A camera in the world that sees points of the arm at q, and the task."""
    tip = FrameKinematics(robot, robot.tip_or(frame)).position(q)
    away = max(0.4, 0.7 * float(np.linalg.norm(tip)))
    camera = aj.PinholeCamera.looking_at(
        tip + [0.01, -0.02, 0.02], tip + away * np.array([0.7, -0.8, 0.5]), (600.0, 580.0), SIZE,
        distortion=distortion,
    )  # fmt: skip
    return aj.ImageTask(robot, camera, frame, POINTS[:points], **options)


def carried(robot, q, points=1, **options):
    """A camera at the tip of the arm that sees points of the world at q, and the task."""
    eye = aj.PinholeCamera(
        (600.0, 580.0), SIZE, (0.01, 0.02, 0.03), pin.exp3(np.array([0.1, -0.2, 0.3])),
        distortion=(-0.2, 0.05), mount=robot.tip,
    )  # fmt: skip
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    tip = data.oMf[robot.frame_id(robot.tip)]
    pixels = ((200.0, 150.0), (450.0, 200.0), (300.0, 400.0))[:points]
    seen = [tip.act(eye.locate(np.array(x), 0.5 + 0.1 * i)) for i, x in enumerate(pixels)]
    return aj.ImageTask(robot, eye, points=seen, **options)


def cases(robot, q):
    """Every camera with as many points as the arm has joints for."""
    for points in range(1, min(3, robot.nv // 2) + 1):
        yield watching(robot, q, points=points)
        yield carried(robot, q, points=points)
        yield watching(robot, q, points=points, depth="measured")
        yield aj.ImageTask(robot, PlanarCamera(0.05, 3.0, 0.3), points=POINTS[:points])


def test_jacobians_by_finite_differences_on_every_arm_and_camera(arm, rng):
    h = 1e-6
    robot = arm.with_object(0.2, 0.5)
    q = arm.random_configuration(rng)
    for task in cases(robot, q):
        J = task.jacobian(q, task.value(q))
        assert J.shape == (task.m, arm.nv)
        columns = [
            task.error(
                task.value(pin.integrate(arm.model, q, h * unit)),
                task.value(pin.integrate(arm.model, q, -h * unit)),
            )
            / (2 * h)
            for unit in np.eye(arm.nv)
        ]
        assert_allclose(J, np.array(columns).T, rtol=0, atol=1e-6 * max(1.0, np.abs(J).max()))


def test_jacobian_rates_by_differences_of_order_four_on_every_arm_and_camera(arm, rng):
    h = 1e-4
    robot = arm.with_object(0.2, 0.5)
    q, v = arm.random_configuration(rng), rng.uniform(-1, 1, arm.nv)
    for task in cases(robot, q):
        if task.uses_x:
            continue
        steps = (h, -h, 2 * h, -2 * h)
        a, b, aa, bb = (task.jacobian(pin.integrate(arm.model, q, s * v)) for s in steps)
        J_dot = task.jacobian_dot(q, v)
        scale = max(1.0, np.abs(J_dot).max())
        slope = (8 * (a - b) - (aa - bb)) / (12 * h)
        assert_allclose(J_dot, slope, rtol=0, atol=1e-6 * scale)


def test_values_are_projections_of_the_points(panda, rng):
    q = panda.random_configuration(rng)
    task = watching(panda, q, points=3)
    R, p = FrameKinematics(panda, "panda_hand_tcp").placement(q)
    expected = [task.camera.project(R @ point + p) for point in POINTS]
    assert_allclose(task.value(q).reshape(3, 2), expected)
    assert task.labels == ("u1", "v1", "u2", "v2", "u3", "v3")
    assert task.units == ("px",) * 6
    assert set(task.units) == {"px"}
    assert [task.value(q)[x] for x, _ in task.parts][1] == pytest.approx(expected[1])
    assert watching(panda, q).labels == ("u", "v")
    assert_allclose(task.depths(q), [task.camera.in_camera(R @ x + p)[2] for x in POINTS])


def test_depths_that_are_measured_are_part_of_x_and_not_of_the_error(panda, rng):
    q, other = (panda.random_configuration(rng) for _ in range(2))
    task = watching(panda, q, points=2, depth="measured")
    plain = watching(panda, q, points=2)
    x = task.value(q)
    assert (task.n_x, task.m, len(x)) == (6, 4, 6)
    assert_allclose(x.reshape(2, 3)[:, 2], plain.depths(q))
    assert_allclose(task.error(task.value(other), x), plain.value(other) - plain.value(q))
    e = rng.normal(size=4)
    assert_allclose(task.error(task.displaced(x, e), x), e)
    assert_array_equal(task.displaced(x, e)[2::3], x[2::3])


def test_an_exact_depth_gives_the_exact_jacobian(panda, rng):
    q = panda.random_configuration(rng)
    exact = watching(panda, q, points=2)
    x, depths = exact.value(q), exact.depths(q)
    constant = watching(panda, q, points=2, depth=depths)
    assert_allclose(constant.jacobian(q, x), exact.jacobian(q), atol=1e-7)
    assert_allclose(constant.jacobian(q), exact.jacobian(q), atol=1e-7)  # its own image


@pytest.mark.parametrize("depth", ["believed", 0.5, "measured"])
def test_a_sensor_moves_by_the_depths_that_are_so(panda, rng, depth):
    q = panda.random_configuration(rng)
    exact, sensor = watching(panda, q, points=2), watching(panda, q, points=2, depth=depth)
    assert_allclose(sensor.sensor_jacobian(q), exact.jacobian(q))
    position = aj.PositionTask(panda, axes="z")
    stacked = aj.StackedTask(sensor, position)
    assert_allclose(stacked.sensor_jacobian(q)[:4], exact.jacobian(q))
    assert_allclose(stacked.sensor_jacobian(q)[4:], position.jacobian(q))
    designed = NonsingularTask(sensor, {"panda_joint4": 0.3})
    assert_allclose(designed.sensor_jacobian(q), exact.jacobian(q))
    with pytest.raises(aj.InvalidInputError, match=r"q must have shape \(7,\)"):
        sensor.sensor_jacobian(q[:3])


def test_all_points_must_be_seen(panda, rng):
    q = panda.random_configuration(rng)
    task = watching(panda, q, points=2)
    assert sees(task, q)
    assert sees(aj.PositionTask(panda), q)
    camera = task.camera
    for size in ((640, 480), (2, 2)):  # the second sees at most the first point
        small = aj.PinholeCamera(
            camera.focal_length, size, *camera.placement()[::-1],
            center=task.value(q)[:2], distortion=(),
        )  # fmt: skip
        assert sees(aj.ImageTask(panda, small, points=POINTS[:2]), q) == (size == (640, 480))


def test_with_a_depth_of_its_own_the_measured_image_counts(panda, rng):
    """Half the depth doubles Ĵ_I, and the ray is that of the measured image."""
    q = panda.random_configuration(rng)
    task = watching(panda, q, depth=1.0, distortion=())
    nearer = watching(panda, q, depth=0.5, distortion=())
    x = np.array([100.0, 400.0])
    assert_allclose(nearer.jacobian(q, x), 2.0 * task.jacobian(q, x), rtol=1e-9)
    J_e = aj.PositionTask(panda).jacobian(q)
    located = task.camera.locate(x, 1.0)
    assert_allclose(task.jacobian(q, x), task.camera.interaction(located) @ J_e)


def test_a_camera_on_the_arm_turns_about_where_points_are_measured(panda, rng):
    """However wrong the believed place of a point is: image and depth tell where it is."""
    q = panda.random_configuration(rng)
    truth = carried(panda, q, 2, depth="measured")
    wrong = truth.points + [[0.1, -0.05, 0.08], [-0.07, 0.02, 0.1]]
    believed = aj.ImageTask(panda, truth.camera, points=wrong, depth="measured")
    assert np.abs(believed.jacobian(q) - truth.jacobian(q)).max() > 1.0
    assert_allclose(believed.jacobian(q, truth.value(q)), truth.jacobian(q), atol=1e-7)


@pytest.mark.parametrize("depth", [0.8, "measured"])
def test_lost_images_are_replaced_by_what_the_belief_sees(panda, rng, depth):
    q = panda.random_configuration(rng)
    task = watching(panda, q, points=2, depth=depth)
    x = task.value(q)
    x[:2] += 30.0
    partly = x.copy()
    partly[task.parts[1][0]] = np.nan
    expected = task.jacobian(q, x)
    assert_allclose(task.jacobian(q, partly), expected)  # the second one was the belief's own
    assert_allclose(task.jacobian(q, np.full(task.n_x, np.nan)), task.jacobian(q))


@pytest.mark.parametrize("depth", [0.0, -0.0, -1.0, np.nan, -np.inf])
def test_a_depth_that_is_none_is_taken_as_the_belief_has_it(panda, rng, depth):
    """As cameras say that they measured none; of the other point it is as measured."""
    q = panda.random_configuration(rng)
    task, believed = (watching(panda, q, points=2, depth=each) for each in ("measured", "believed"))
    x = task.value(q) * [1.0, 1.0, 1.0, 1.0, 1.0, 1.2]
    as_measured, as_believed = task.jacobian(q, x), believed.jacobian(q)
    x[2] = depth
    J = task.jacobian(q, x)
    assert_allclose(J[:2], as_believed[:2], rtol=1e-12)
    assert_allclose(J[2:], as_measured[2:], rtol=1e-12)
    assert np.abs(J[2:] - as_believed[2:]).max() > 0.1 * np.abs(J[2:]).max()


def test_the_believed_depth_needs_no_measurement(panda, rng):
    q = panda.random_configuration(rng)
    task = watching(panda, q)
    assert not task.uses_x
    assert_array_equal(task.jacobian(q, rng.normal(size=2)), task.jacobian(q))
    assert watching(panda, q, depth=1.0).uses_x


def test_stacked_with_other_tasks(panda, rng):
    q = panda.random_configuration(rng)
    image = watching(panda, q, points=2, depth="measured")
    position = aj.PositionTask(panda, "panda_link4", "z")
    stack = aj.StackedTask(position, image)
    x = stack.value(q)
    assert stack.labels == ("1.z", "2.u1", "2.v1", "2.u2", "2.v2")
    assert (stack.n_x, stack.m) == (7, 5)
    assert stack.uses_x
    assert stack.parts == (
        (slice(0, 1), slice(0, 1)), (slice(1, 4), slice(1, 3)), (slice(4, 7), slice(3, 5)),
    )  # fmt: skip
    assert_allclose(stack.jacobian(q, x)[1:], image.jacobian(q, x[1:]))
    x[1] = 1e5
    seen = stack.visible(x)
    assert_array_equal(np.isnan(seen), [False, True, True, True, False, False, False])


def test_what_is_out_of_view_is_lost_and_the_arm_is_damped(panda, rng):
    q = panda.random_configuration(rng)
    task = watching(panda, q)
    behind = aj.ImageTask(panda, task.camera.with_error(rotation=(0.0, np.pi, 0.0)))
    assert np.isnan(behind.value(q)).all()
    assert behind.depths(q)[0] < 0.0
    aside = aj.ImageTask(panda, task.camera.with_error(rotation=(0.0, 0.9, 0.0)))
    assert np.isfinite(aside.value(q)).all()
    for sensor in (behind, aside):
        measured = aj.Plant(panda, sensor).measure(0.0, q, np.zeros(7))
        assert np.isnan(measured.x).all()
        controller = aj.SetpointController(task)
        state = controller.begin(measured)
        answer = controller.evaluate(state, measured, np.array([320.0, 240.0]))
        assert answer.status is aj.Status.MEASUREMENT_LOST
        assert_allclose(answer.torque, Dynamics(panda).g(q))


def test_a_run_out_of_view_records_where_the_point_really_is(panda):
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    task = watching(panda, q, distortion=())
    aside = task.camera.with_error(rotation=(0.0, 0.9, 0.0))
    plant = aj.Plant(panda, aj.ImageTask(panda, aside))
    run = aj.simulate(plant, aj.SetpointController(task), (300.0, 200.0), q, 0.01, dt=1e-3)
    assert np.isnan(run.x_measured).all()
    assert np.isfinite(run.x).all()
    assert set(run.status_counts()) == {aj.Status.MEASUREMENT_LOST}


def test_default_gains_in_pixels(panda):
    """Twice the focal length shows all errors twice as large: a quarter of the gain does."""
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    task = watching(panda, q, points=2, distortion=())
    finer = aj.PinholeCamera(
        (1200.0, 1160.0), (1280, 960), *task.camera.placement()[::-1],
        center=(2 * task.camera.center[0], 2 * task.camera.center[1]),
    )  # fmt: skip
    kp = aj.default_gains(task).kp
    assert_allclose(aj.default_gains(aj.ImageTask(panda, finer, None, POINTS[:2])).kp, kp / 4,
                    rtol=0.03)  # fmt: skip  # postures at the edges differ by half a pixel
    assert (kp == kp[0]).all()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"camera": None}, r"camera must be a camera, such as PlanarCamera\(f, z\), got None"),
        ({"frame": "tcp"}, "frame 'tcp' not in panda; did you mean 'panda_hand_tcp'"),
        ({"points": (0.0, 0.0, 0.0)}, r"points must have shape \(k, 3\) \[m\], got shape \(3,\)"),
        ({"points": ()}, r"points must have shape \(k, 3\) \[m\], got shape \(0,\)"),
        ({"points": ((0.0, 0.0),)}, r"points must have shape \(k, 3\) \[m\], got shape \(1, 2\)"),
        ({"points": ((0.0, 0.0, 0.1),) * 2}, r"points must be different ones, got \[0.0, 0.0, 0.1"),
        (
            {"points": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.1), (0.0, 0.0, 0.3))},
            "points must not lie on one line: their images do not change as it turns about itself",
        ),
        ({"depth": "known"}, r"depth must be 'believed', 'measured' or numbers > 0 \[m\], got"),
        ({"depth": 0.0}, r"depth must be > 0 in every entry \[m\], .*got \[0.0\]"),
        ({"depth": (1.0, 2.0)}, r"depth must have shape \(1,\) \[m\], got shape \(2,\)"),
        ({"depth": (-1.0,)}, r"depth must be > 0 in every entry \[m\], .*got \[-1.0\]"),
        (
            {"camera": PlanarCamera(0.05, 3.0), "depth": 1.0},
            "camera of a task with depths must be a PinholeCamera, got PlanarCamera",
        ),
    ],
)
def test_bad_image_tasks_are_refused(panda, options, text):
    arguments = {"camera": aj.PinholeCamera(500.0, SIZE), **options}
    with pytest.raises((aj.InvalidInputError, UnknownNameError), match=text):
        aj.ImageTask(panda, **arguments)


def test_bad_mounts_targets_and_uses_are_refused(panda, rng):
    q = panda.random_configuration(rng)
    with pytest.raises(UnknownNameError, match="frame 'hand' not in panda"):
        aj.ImageTask(panda, aj.PinholeCamera(500.0, SIZE, mount="hand"), points=POINTS[:1])
    with pytest.raises(aj.InvalidInputError, match="points must be given for a camera"):
        aj.ImageTask(panda, aj.PinholeCamera(500.0, SIZE, mount="panda_hand"))
    task = watching(panda, q, points=2)
    for x_d in ((10.0, 10.0, 700.0, 20.0), (10.0, 10.0, 20.0, -3.0)):
        with pytest.raises(
            aj.InvalidInputError,
            match=r"target must be within the image of 640 x 480 px, got .* for point 2",
        ):
            task.target(x_d)
    with pytest.raises(aj.InvalidInputError, match="target must be within the image"):
        aj.simulate(
            aj.Plant(panda, task), aj.SetpointController(task), (1e3, 0, 0, 0), q, 0.1, dt=1e-3
        )
    constant = watching(panda, q, depth=1.0)
    with pytest.raises(aj.InvalidInputError, match="takes depth='believed', got ImageTask"):
        constant.jacobian_dot(q, np.zeros(7))
    with pytest.raises(
        aj.InvalidInputError, match="camera of a task with depths must be a PinholeCamera"
    ):
        aj.ImageTask(panda, PlanarCamera(0.05, 3.0)).depths(q)
    measured = watching(panda, q, depth="measured")
    with pytest.raises(aj.InvalidInputError, match="the coordinates of the plant's sensor"):
        aj.simulate(
            aj.Plant(panda, watching(panda, q)), aj.SetpointController(measured),
            (10.0, 10.0), q, 0.1, dt=1e-3,
        )  # fmt: skip
    away = aj.PinholeCamera.looking_at((9, 9, 9), (5, 5, 5), 500.0, SIZE)
    with pytest.raises(aj.InvalidInputError, match="task must be one that its own sensor sees"):
        aj.default_gains(aj.ImageTask(panda, away))


@pytest.mark.parametrize("frame", ["panda_hand_tcp", "panda_hand", "panda_link7"])
def test_points_that_move_with_the_camera_are_refused(panda, frame):
    eye = aj.PinholeCamera(600.0, SIZE, (0.0, 0.0, -0.5), mount="panda_hand_tcp")
    with pytest.raises(aj.InvalidInputError, match="frame must move relative to the camera"):
        aj.ImageTask(panda, eye, frame)
    with pytest.raises(aj.InvalidInputError, match="got the world and a camera on 'panda_link0'"):
        aj.ImageTask(panda, aj.PinholeCamera(600.0, SIZE, mount="panda_link0"), points=POINTS[:1])


def test_a_target_that_a_camera_of_ones_own_does_not_see_is_refused(panda):
    class Narrow(PlanarCamera):
        def seen(self, x):
            return x if np.abs(x).max() < 0.01 else np.full(2, np.nan)

    with pytest.raises(aj.InvalidInputError, match="target must be within the image, got"):
        aj.ImageTask(panda, Narrow(0.05, 3.0)).target([1.0, 1.0])


def test_a_target_outside_the_image_is_refused_in_every_wrapping(panda):
    task = watching(panda, np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]))
    outside = [700.0, 100.0]
    text = r"target must be within the image of 640 x 480 px, got \[700.0, 100.0\] for point 1"
    height = aj.PositionTask(panda, "panda_link4", axes="z")
    for wrapped, x_d in (
        (task, outside),
        (CombinedTask(task, np.eye(2)), outside),
        (NonsingularTask(task, {"panda_joint4": 0.2}), outside),
        (aj.StackedTask(height, task), [0.3, *outside]),
    ):
        with pytest.raises(aj.InvalidInputError, match=text):
            wrapped.target(x_d)


def test_a_depth_cannot_be_changed(panda):
    task = watching(panda, np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]), depth=0.5)
    with pytest.raises(ValueError, match="read-only"):
        task.depth[0] = 1.0


def test_an_image_far_outside_does_not_lengthen_the_lever_of_a_camera_on_the_arm(panda, rng):
    q = panda.random_configuration(rng)
    task = carried(panda, q, 2, depth=0.5)
    usual = np.linalg.norm(task.jacobian(q))
    for far in (700.0, 1e6, -1e12):
        assert np.linalg.norm(task.jacobian(q, np.full(4, far))) < 3.0 * usual
    edge = task.jacobian(q, np.array([639.5, 200.0, 300.0, 479.5]))
    assert_allclose(task.jacobian(q, np.array([9e3, 200.0, 300.0, 9e3])), edge)
