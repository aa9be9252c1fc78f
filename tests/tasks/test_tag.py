"""Four corners of a tag: eight image coordinates, of which a rigid body moves six."""

import sys

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.cameras import tag_corners
from approxjac.controllers import KnownKinematics
from approxjac.controllers.gains.sample_configurations import singular_ratio
from approxjac.errors import package_of
from approxjac.robots import Dynamics
from approxjac.tasks import CombinedTask

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
AWAY = np.array([0.2, -0.15, 0.1, 0.2, -0.1, 0.15, 0.1])


def tag_in_view(arm, size=0.1, distance=0.7, tilt=30.0, count=4, q=Q):
    """The image of a tag at the tip that a camera looks at, tilted by some degrees."""
    R_tip, tip = aj.tasks.FrameKinematics(arm, arm.tip).placement(q)
    way = np.array([0.75, -0.5, 0.45])
    camera = aj.PinholeCamera.looking_at(
        tip, tip + distance * way / np.linalg.norm(way), 600.0, (640, 480),
        distortion=(-0.2, 0.05, 1e-3, -1e-3, 0.0),
    )  # fmt: skip
    facing = camera.placement()[0] @ np.diag([1.0, -1.0, -1.0])
    pose = np.eye(4)
    pose[:3, :3] = R_tip.T @ facing @ pin.exp3(np.array([np.radians(tilt), 0.2, 0.0]))
    return aj.ImageTask(arm, camera, points=tag_corners(size, pose)[:count])


def believed(image, roll, factor):
    camera = image.camera.with_error(
        rotation=(0.05, 0.0, np.radians(roll)), focal_factor=factor, shift=(0.02, 0.0, -0.05)
    )
    return aj.ImageTask(image.robot, camera, points=image.points)


def test_the_corners_are_those_of_opencv():
    """As cv2.SOLVEPNP_IPPE_SQUARE has them, which takes detections of cv2.aruco."""
    corners = 0.5 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    assert_allclose(tag_corners(1.0), corners)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = pin.exp3(np.array([0.1, 0.2, 0.3])), (1.0, 2.0, 3.0)
    homogeneous = np.column_stack([corners, np.ones(4)])
    assert_allclose(tag_corners(1.0, pose), (homogeneous @ pose.T)[:, :3])
    with pytest.raises(aj.InvalidInputError, match=r"size must be a finite number > 0 \[m\]"):
        tag_corners(0.0)
    with pytest.raises(aj.InvalidInputError, match="tag_pose must have axes as orthonormal"):
        tag_corners(1.0, np.diag([2.0, 1.0, 1.0, 1.0]))


def test_controllers_say_what_makes_eight_coordinates_six(panda):
    image = tag_in_view(panda)
    for build in (aj.SetpointController, aj.default_gains, aj.TrackingController):
        with pytest.raises(aj.InvalidInputError, match=r"m = 8 .* n_v = 7: CombinedTask.balanced"):
            build(image)
    q = np.array([0.4, -1.6, 1.9, -1.9, -1.57, 0.3])
    image = tag_in_view(aj.load_robot("ur5"), q=q)
    assert CombinedTask.balanced(image, image.value(q)).m == 6


def test_six_coordinates_tell_all_that_the_corners_do(panda):
    image = tag_in_view(panda)
    task = CombinedTask.balanced(image, image.value(Q))
    assert task.C.shape == (6, 8)
    assert np.linalg.norm(task.C, 2) == pytest.approx(1.0)
    # the rows are those in which the corners move: nothing of J is lost
    J = image.jacobian(Q)
    assert_allclose(np.linalg.pinv(task.C) @ task.C @ J, J, atol=1e-6 * np.abs(J).max())
    inertia = np.linalg.inv(Dynamics(panda).M(Q))
    spreads = [np.linalg.eigvalsh(K @ inertia @ K.T)[-6:] for K in (J, task.jacobian(Q))]
    assert spreads[1][-1] / spreads[1][0] < 0.05 * spreads[0][-1] / spreads[0][0]


@pytest.mark.study
@pytest.mark.parametrize(
    ("options", "roll", "factor"),
    [
        pytest.param({}, 20.0, 1.2, marks=pytest.mark.long),
        pytest.param({}, 0.0, 1.0, marks=pytest.mark.long),
        pytest.param(
            {"size": 0.06, "distance": 0.9, "tilt": 10.0}, 20.0, 1.2, marks=pytest.mark.long
        ),
        ({"size": 0.15, "distance": 0.8, "tilt": 45.0}, 30.0, 1.3),
        ({"count": 3}, 20.0, 1.2),
        pytest.param({"count": 3, "size": 0.06, "distance": 0.9}, 0.0, 1.0, marks=pytest.mark.long),
    ],
)
def test_a_tag_reaches_its_place_in_the_image_and_nothing_is_singular(panda, options, roll, factor):
    sensor = tag_in_view(panda, **options)
    x_d = sensor.value(Q)
    task = CombinedTask.balanced(believed(sensor, roll, factor), x_d)
    law = aj.SetpointController(task, aj.default_gains(task, settling_time=1.5))
    law = aj.HeldMeasurement(law, unseen=60.0)
    start = Q + AWAY
    assert np.isfinite(sensor.visible(sensor.value(start))).all()
    plant = aj.Plant(panda, sensor, torque_limits=panda.effort_limits)
    run = aj.simulate(
        plant,
        law,
        x_d,
        start,
        6.0,
        dt=2e-3,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    assert np.abs(run.error[0]).max() > 100.0
    assert np.abs(run.error[-1]).max() < 8.0
    assert run.error.shape[1] == 2 * len(sensor.points)
    assert not (run.status == aj.Status.NEAR_SINGULAR).any()


def test_three_corners_are_not_near_singular_where_they_are_usual(panda):
    image = tag_in_view(panda, count=3)
    J = image.jacobian(Q)
    values = np.linalg.svd(J, compute_uv=False)
    assert values[-1] / values[0] < aj.law.SINGULAR_RATIO
    law = aj.SetpointController(image)
    x_d = image.value(Q)
    for q, status in ((Q, aj.Status.OK), (np.zeros(7), aj.Status.NEAR_SINGULAR)):
        answer = law.evaluate(np.zeros(0), aj.Measurement(0.0, q, np.zeros(7), x_d), x_d)
        assert answer.status == status
    assert singular_ratio(aj.PoseTask(panda)) == aj.law.SINGULAR_RATIO


def test_a_target_moves_in_the_image(panda):
    """Its velocity is that of the eight coordinates."""
    image = tag_in_view(panda)
    x_d = image.value(Q)
    task = CombinedTask.balanced(image, x_d)
    law = aj.SetpointController(task)
    v = np.full(7, 0.1)
    moving = aj.Target(x_d, image.jacobian(Q) @ v)
    measured = aj.Measurement(0.0, Q, v, x_d)
    along = law.evaluate(np.zeros(0), measured, moving)
    assert_allclose(task.jacobian(Q) @ along.reference, task.jacobian(Q) @ v, rtol=1e-6)
    with pytest.raises(aj.InvalidInputError, match=r"v of the target must have shape \(8,\)"):
        law.evaluate(np.zeros(0), measured, aj.Target(x_d, np.zeros(6)))
    held = aj.HeldMeasurement(law, unseen=30.0)
    state = held.initial_state(measured)
    for _ in range(3):
        state, answer = held.step(state, measured, moving, 1e-3)
        assert np.isfinite(answer.torque).all()
    stacked = aj.StackedTask(task, aj.PositionTask(panda, "panda_link4", axes="z"))
    assert (stacked.m, stacked.measured.m) == (7, 9)
    held = aj.HeldMeasurement(aj.SetpointController(stacked), unseen=[30.0] * 8 + [0.1])
    measured = aj.Measurement(0.0, Q, v, stacked.value(Q))
    state = held.initial_state(measured)
    assert np.isfinite(held.step(state, measured, stacked.value(Q), 1e-3)[1].torque).all()


def the_other_way(x):
    return x.reshape(-1, 2)[::-1].ravel()


def held(task):
    return aj.HeldMeasurement(aj.SetpointController(task, aj.Gains(50.0, 10.0, 1.0)), unseen=60.0)


def at(q, x):
    return aj.Measurement(0.0, q, np.zeros(7), x)


def test_corners_in_the_order_of_pupil_apriltags_are_refused(panda):
    sensor = tag_in_view(panda)
    x = sensor.value(Q)
    combined = CombinedTask(believed(sensor, 30.0, 1.2), np.eye(6, 8))
    stacked = aj.StackedTask(combined, aj.PositionTask(panda, "panda_link4", axes="z"))
    z = stacked.value(Q)[-1:]
    follows = aj.TrackingController(combined, kinematics=KnownKinematics(combined))
    for law, more in ((held(combined), []), (held(stacked), z), (follows, [])):
        law.initial_state(at(Q, np.append(x, more)))
        with pytest.raises(aj.InvalidInputError, match=r"^x must .* pupil.*corners\[::-1\]"):
            law.initial_state(at(Q, np.append(the_other_way(x), more)))
    driver = aj.realtime.SimulatedDriver(aj.Plant(panda, sensor), Q, pace=np.inf)
    limited = aj.TorqueLimited(held(combined).controller, driver.limits)
    with pytest.raises(aj.InvalidInputError, match=r"^target must .*in the measured x"):
        aj.control(driver, limited, the_other_way(x), 0.01)


def test_a_triangle_may_be_seen_from_either_side(panda):
    """Targets of few points are drawn, too, and then from anywhere."""
    sensor = tag_in_view(panda, count=3)
    law = aj.SetpointController(believed(sensor, 30.0, 1.2), aj.Gains(50.0, 10.0, 1.0))
    behind = at(Q, the_other_way(sensor.value(Q)))
    assert np.isfinite(law.evaluate(law.begin(behind), behind, behind.x).torque).all()


def test_corners_as_rows_are_told_how_to_become_a_vector_in_few_words(panda):
    sensor = tag_in_view(panda)
    task = CombinedTask(sensor, np.eye(6, 8))
    assert repr(sensor).endswith("'panda_hand_tcp', 4 points)")
    assert repr(tag_in_view(panda, count=1)).endswith("tcp', [-0.01399, 0.04457, -0.05308])")
    assert repr(task) == f"CombinedTask({sensor!r}, C of shape (6, 8))"
    rows = sensor.value(Q).reshape(4, 2)
    with pytest.raises(aj.InvalidInputError, match=r"got \(4, 2\); x.ravel\(\) makes one$") as told:
        held(task).initial_state(at(Q, rows))
    assert len(str(told.value)) < 350
    with pytest.raises(aj.InvalidInputError, match=r"shape \(8,\) .*, got shape \(4, 2\)"):
        task.target(rows)


def test_corners_in_the_right_order_are_accepted_with_a_wrong_camera(panda):
    sensor = tag_in_view(panda)
    x = sensor.value(Q)
    for nothing in (np.zeros(8), np.full(8, 1e200), np.tile([1e300, -1e300], 4), x * np.inf):
        assert not sensor.is_mirrored(nothing, x)
        assert not sensor.is_mirrored(the_other_way(x), nothing)
    for roll in (80.0, -170.0):
        task = CombinedTask(believed(sensor, roll, 1.5), np.eye(6, 8))
        held(task).initial_state(at(Q, x))
        lost = np.where(np.arange(8) < 2, np.nan, the_other_way(x))
        held(task).initial_state(at(Q, lost))  # nothing to compare
    steep = tag_in_view(panda, tilt=78.0)  # nearly edge on
    assert not steep.is_mirrored(steep.value(Q), the_other_way(steep.value(Q)))
    eye = aj.PinholeCamera(600.0, (640, 480), position=(0.05, 0.0, 0.0), mount=panda.tip)
    R, p = aj.tasks.FrameKinematics(panda, panda.tip).placement(Q)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R @ np.diag([1.0, -1.0, -1.0]), p + 0.4 * R[:, 2]
    image = aj.ImageTask(panda, eye, points=tag_corners(0.06, pose))
    wrong = CombinedTask(believed(image, 80.0, 1.3), np.eye(6, 8))
    held(wrong).initial_state(at(Q, image.value(Q)))
    with pytest.raises(aj.InvalidInputError, match="as if in a mirror"):
        held(wrong).initial_state(at(Q, the_other_way(image.value(Q))))
    crossed = aj.ImageTask(panda, sensor.camera, points=sensor.points[[0, 2, 1, 3]])
    assert not crossed.is_mirrored(crossed.value(Q), the_other_way(crossed.value(Q)))


@pytest.mark.long
def test_a_camera_on_the_hand_needs_only_to_know_roughly_where_the_tag_is(panda):
    eye = aj.PinholeCamera(600.0, (640, 480), position=(0.05, 0.0, -0.03), mount=panda.tip)
    R, p = aj.tasks.FrameKinematics(panda, panda.tip).placement(Q)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R @ np.diag([1.0, -1.0, -1.0]), p + R @ [0.07, 0.01, 0.35]
    held_load = panda.with_object(0.1, 0.3)
    sensor = aj.ImageTask(held_load, eye, points=tag_corners(0.06, pose))
    x_d = sensor.value(Q)
    wrong = aj.ImageTask(panda, eye, points=sensor.points + [0.05, -0.06, 0.04])
    task = CombinedTask.balanced(wrong, x_d)
    final = {}
    for known in (held_load, panda):
        law = aj.SetpointController(
            task,
            gravity=aj.controllers.ModelGravity(known),
            latency=aj.Latency(period=2e-3, image_period=1 / 30, image_age=0.04),
        )
        plant = aj.Plant(held_load, sensor, sensing=aj.Sensing(x_rate=30.0, x_delay=0.04))
        held = aj.HeldMeasurement(law, unseen=60.0)
        run = aj.simulate(plant, held, x_d, Q + 0.05, 6.0, dt=2e-3)
        final[known] = np.abs(run.error[-1]).max()
    assert final[held_load] < 1.0
    assert final[panda] > 5.0


def test_what_finds_tags_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(aj.errors.MissingPackageError, match=r"pip install 'approxjac\[vision\]'"):
        package_of("vision", "cv2")


def test_a_tag_that_a_camera_in_the_room_sees_is_a_pose_of_the_hand(panda):
    camera = aj.PinholeCamera.looking_at((0.45, 0.0, 0.5), (1.6, 0.4, 0.9), 600.0, (640, 480))
    tracker = pin.SE3(*camera.placement()).inverse()
    task = aj.tasks.PoseTrackerTask(panda, pin.log3(tracker.rotation), tracker.translation)
    tag = pin.SE3(pin.exp3(np.array([0.3, -0.2, 0.5])), np.array([0.02, 0.0, 0.06]))  # in the hand
    hand = pin.SE3(*aj.tasks.FrameKinematics(panda, panda.tip).placement(Q))
    seen = pin.SE3(*camera.placement()).actInv(hand * tag)  # what cv2.solvePnP would say
    center = seen.translation * 600.0 / seen.translation[2] + [319.5, 239.5, 0.0]
    assert_allclose(camera.project((hand * tag).translation), center[:2], atol=1e-6)
    assert_allclose(pin.SE3ToXYZQUAT(seen * tag.inverse()), task.value(Q), atol=1e-9)
