"""Tool, camera and focal length learnt from images, while an arm follows a circle of 60 px."""

import copy
import math
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.controllers import AdaptiveCamera, PredictedMeasurement, RegressorGravity
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.law import rotation_exp
from approxjac.robots import GravityRegressor, KinematicRegressor
from approxjac.tasks import FrameKinematics
from approxjac.tasks.analysis import seen_configurations

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
CAMERA = aj.PinholeCamera.looking_at(
    (0.45, 0.0, 0.4), (1.5, -0.8, 0.9), focal_length=600.0, size=(640, 480)
)
ALPHA, FASTEST, DT = 4.0, 300.0, 5e-3
NAMES = ("tool.x", "tool.y", "tool.z", *(f"camera.{a}" for a in ("x", "y", "z", "rx", "ry", "rz")))


def believed(camera, roll, tilt=8.0, back=0.7, focal_factor=1.3):
    """A camera that is believed farther away, tilted and rolled."""
    moved = camera.with_error(
        shift=(0.0, 0.0, -back), rotation=(math.radians(tilt), 0.0, 0.0), focal_factor=focal_factor
    )
    return moved.with_error(rotation=(0.0, 0.0, math.radians(roll)))


def circle(center, t, radius=60.0, period=4.0):
    """A circle in the image that is eased into."""
    w = 2 * np.pi / period
    phase, rate, bend = (w * (t - 0.5), w, 0.0) if t > 1 else (w * t * t / 2, w * t, w)
    a = radius * np.array([np.cos(phase), np.sin(phase)])
    b = radius * np.array([-np.sin(phase), np.cos(phase)])
    k = len(center) // 2
    return aj.Target(
        center + np.tile(a, k), np.tile(rate * b, k), np.tile(bend * b - rate**2 * a, k)
    )


def follow(
    kinematics, sensor, start, way=(90.0, -60.0), *, seconds=3.0, rate=30.0, delay=0.05, noise=0.5,
    seed=0, spoil=None, tells_t_x=True,
):  # fmt: skip
    """Let an arm follow the circle by q̇ = Ĵ⁺(feed − α s(z)); images are late and noisy."""
    rng, n = np.random.default_rng(seed), len(start)
    q, v, state, frames, taken, errors = start.copy(), np.zeros(n), None, [], -1, []
    x = sensor.value(q)
    center, arrived = x + np.tile(way, len(x) // 2), (x, 0.0)
    for k in range(round(seconds / DT)):
        t = k * DT
        x = sensor.value(q)
        if int(t * rate + 1e-6) > taken:
            taken = int(t * rate + 1e-6)
            seen = x + noise * rng.standard_normal(len(x))
            frames.append((seen if spoil is None else spoil(t, seen), t))
        while frames and frames[0][1] + delay <= t + 1e-9:
            arrived = frames.pop(0)
        measurement = aj.Measurement(t, q, v, arrived[0], arrived[1] if tells_t_x else None)
        if state is None:
            state = kinematics.initial_state(measurement)
        state = kinematics.step(state, measurement, DT)
        target = circle(center, t)
        z, J, _, feed, _, _ = kinematics.predict(state, q, v, target)
        wanted = feed - ALPHA * z / np.sqrt(1.0 + (ALPHA * np.linalg.norm(z) / FASTEST) ** 2)
        G = J @ J.T
        G += 1e-4 * np.trace(G) * np.eye(len(z))
        v = start - q + J.T @ np.linalg.solve(G, wanted - J @ (start - q))
        q = q + DT * v
        errors.append(np.linalg.norm(x - target.x))
    return SimpleNamespace(state=state, errors=np.array(errors), q=q, v=v, x=x)


def late(run, start, end):
    """Root mean square of the error in an interval [px]."""
    return np.sqrt(np.mean(run.errors[round(start / DT) : round(end / DT)] ** 2))


@pytest.fixture(scope="module")
def room(panda):
    """An arm with a tool, and what is believed: none, and another camera."""
    sensor = aj.ImageTask(panda.with_object(0.15, axis="x"), CAMERA)
    return sensor, aj.ImageTask(panda.with_object(0.0), believed(CAMERA, 120.0))


@pytest.fixture(scope="module")
def hand():
    """A camera on the hand, which watches two points of the room."""
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    camera = aj.PinholeCamera(600.0, (640, 480), (0.0, 0.0, 0.05), axes, mount="tool0")
    arm, goal = aj.load_robot("ur5"), np.array([0.0, -1.2, 1.8, -0.6, 0.3, 0.0])
    R, p = FrameKinematics(arm, "tool0").placement(goal)
    points = (np.array([[-0.1, 0.02, 0.5], [0.1, -0.02, 0.5]]) @ axes.T + camera.position) @ R.T + p
    wrong = believed(camera, 120.0, back=0.05)
    return (
        goal,
        aj.ImageTask(arm, camera, points=points),
        aj.ImageTask(arm, wrong, points=points + [0.05, -0.1, 0.05]),
    )


@pytest.fixture(scope="module")
def room_run(room):
    kinematics = AdaptiveCamera(room[1])
    return kinematics, follow(kinematics, room[0], START, seconds=4.0)


def test_a_camera_that_is_rolled_is_learnt(room_run, room):
    kinematics, run = room_run
    assert kinematics.names == (*NAMES, "focal_length")
    assert late(run, 3.0, 4.0) < 2.5
    found, state = kinematics.camera(run.state), run.state
    learnt = dict(zip(kinematics.names, kinematics.learnt(state), strict=True))
    assert found.focal_length[0] == pytest.approx(learnt["focal_length"])
    assert_allclose(found.position, [learnt[f"camera.{axis}"] for axis in "xyz"])
    turn = rotation_exp(np.array([learnt[f"camera.r{axis}"] for axis in "xyz"]))
    assert_allclose(found.rotation, np.array(room[1].camera.rotation) @ turn, atol=1e-9)
    apart = np.array(found.rotation).T @ CAMERA.rotation
    assert np.degrees(np.arccos((np.trace(apart) - 1.0) / 2.0)) < 12.0
    # what tells where images are is the whole
    robot = room[0].robot
    theta = KinematicRegressor(robot).theta[-3:] - [learnt[f"tool.{axis}"] for axis in "xyz"]
    assert np.linalg.norm(theta) < 0.1


def test_a_camera_on_the_hand_is_learnt(hand):
    goal, sensor, task = hand
    kinematics = AdaptiveCamera(task)
    assert kinematics.names[:3] == ("points.x", "points.y", "points.z")
    start = goal + [0.05, 0.05, -0.06, 0.05, 0.1, -0.1]
    run = follow(kinematics, sensor, start, (20.0, -15.0))
    assert late(run, 2.0, 3.0) < 6.0
    assert run.errors.max() < 1.6 * run.errors[0]


@pytest.mark.study
@pytest.mark.parametrize("around", [-90.0, 100.0])
def test_a_camera_that_is_elsewhere_is_found(room, around):
    """Believed on another side of the arm, and rolled: no turn of the image explains it."""
    angle = math.radians(around)
    c, s, middle = math.cos(angle), math.sin(angle), np.array([0.45, 0.0, 0.4])
    away = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ (CAMERA.position - middle)
    elsewhere = aj.PinholeCamera.looking_at(middle, middle + away, 600.0, (640, 480))
    task = aj.ImageTask(room[1].robot, believed(elsewhere, 40.0))
    run = follow(AdaptiveCamera(task), room[0], START, seconds=6.0)
    assert late(run, 5.0, 6.0) < 3.0


def test_what_was_learnt_is_told(room_run, room):
    kinematics, run = room_run
    report = kinematics.report(run.state)
    assert tuple(row.name for row in report.rows) == kinematics.names
    learnt = [row.value for row in report.rows]
    assert np.array_equal(learnt, kinematics.learnt(run.state))
    believed = [row.believed for row in report.rows]
    camera = room[1].camera
    assert_allclose(believed[3:], [*camera.position, 0.0, 0.0, 0.0, camera.focal_length[0]])
    true = [*KinematicRegressor(room[0].robot).theta[-3:], *CAMERA.position]
    d = np.array(learnt[:6]) - true
    assert d @ np.linalg.solve(report.covariance[:6, :6], d) < 22.5
    assert report.rows[0].is_seen
    assert report.rows[-1].unit == "px"
    assert report.angle == pytest.approx(np.radians(120.0), abs=0.2)
    assert report.is_explained
    assert report.restarts == 0
    assert report.noise == pytest.approx((0.5, 0.5), rel=0.3)
    assert "px, assumed 0.5 px" in str(report)
    assert report.last_joint == "panda_joint7"


def test_before_the_first_frame_what_is_believed_is_told(room):
    kinematics = AdaptiveCamera(room[1])
    lost = aj.Measurement(0.0, START, 0.0 * START, np.full(2, np.nan))
    report = kinematics.report(kinematics.initial_state(lost))
    for row in report.rows:
        assert row.value == pytest.approx(row.believed)
        assert not row.is_seen


def test_the_learnt_robot_and_camera_say_where_x_is(room_run, room, rng):
    kinematics, run = room_run
    camera, robot = kinematics.camera(run.state), kinematics.robot(run.state)
    found = aj.ImageTask(robot, camera)
    for q in run.q + 0.05 * rng.standard_normal((5, 7)):
        assert_allclose(found.value(q), room[0].value(q), atol=4.0)


def test_the_next_run_begins_with_what_was_learnt(room_run, room):
    kinematics, run = room_run
    elsewhere = START + 0.05
    x = room[0].value(elsewhere)
    state = kinematics.resumed(run.state, aj.Measurement(0.0, elsewhere, 0.0 * START, x))
    assert np.array_equal(kinematics.learnt(state), kinematics.learnt(run.state))
    z = kinematics.predict(state, elsewhere, 0.0 * START, aj.Target(x)).z
    assert_allclose(z, 0.0, atol=6.0)


def as_real_ones(drawing, rng):
    """An arm that differs from its drawing by 1 mm of origins, 3 mrad of axes, 15 of encoders."""
    regressor = KinematicRegressor(drawing, axes=True)
    sd = {"tilt1": 3e-3, "tilt2": 3e-3, "encoder": 15e-3}
    off = rng.normal(size=regressor.p) * [sd.get(n.split(".")[1], 1e-3) for n in regressor.names]
    off[regressor.n_lengths - 3 : regressor.n_lengths] = 0.0
    return drawing.with_kinematic_error(*regressor.errors(regressor.theta + off)[:2])


def seen_after(kinematics, sensor, places, rng):
    """The state after images of a way through places, of 0.5 px noise, 30 Hz and 30 s."""
    state = None
    for k in range(900):
        i, part = divmod(k * (len(places) - 1) / 900, 1.0)
        before, after = places[int(i) : int(i) + 2]
        q = before + part * (after - before)
        x = sensor.value(q) + 0.5 * rng.normal(size=sensor.n_x)
        seen = aj.Measurement(k / 30, q, 0.0 * q, x, k / 30)
        state = kinematics.initial_state(seen) if state is None else state
        state = kinematics.step(state, seen, 1 / 30)
    return state


@pytest.mark.study
@pytest.mark.parametrize("case", ["known", "near", "unknown", "hand"])
def test_axes_and_encoders_are_learnt_from_images(panda, hand, case):
    """Of arms that differ as real ones do; what is seen elsewhere is predicted, too.

    Known: the camera, not the tool; near: known to 2 cm, 2° and 2 %; unknown: as in the room.
    """
    errors, is_carried = {(): [], ("axes",): []}, case == "hand"
    for seed in range(3):
        rng = np.random.default_rng([5, seed])
        if is_carried:
            (start, sensor, task), span = hand, 0.35
            truth = as_real_ones(task.robot, rng)
            sensor = aj.ImageTask(truth, sensor.camera, points=sensor.points)
            camera = sensor.camera
            task = aj.ImageTask(task.robot, camera, points=sensor.points + [0.05, -0.1, 0.05])
        else:
            start, span, shift, turn = START, 0.7, rng.normal(0.0, 0.02, 3), rng.normal(0, 0.03, 3)
            near = CAMERA.with_error(shift=shift, rotation=turn, focal_factor=1.02)
            camera = {"near": near, "unknown": believed(CAMERA, 60.0)}.get(case, CAMERA)
            truth = as_real_ones(panda, rng).with_object(0.2, axis="x")
            sensor, task = aj.ImageTask(truth, CAMERA), aj.ImageTask(panda, camera)
        places = []
        while len(places) < 124:
            q = start + rng.uniform(-span, span, len(start))
            off = np.abs(sensor.value(q).reshape(-1, 2) - [320.0, 240.0])
            places += [q] if (off < [300.0, 220.0]).all() else []
        kinds = ("points",) if is_carried else ("tool",)
        kinds += ("camera", "focal_length") if case in ("near", "unknown") else ()
        sd = {"position": 0.02, "rotation": 0.03, "focal_length": 0.02} if case == "near" else {}
        for axes, found in errors.items():
            kinematics = AdaptiveCamera(task, kinds + axes, sd, dt=1 / 30)
            state = seen_after(kinematics, sensor, places[:24], rng)
            robot, points = kinematics.robot(state), None
            if is_carried:
                names = [f"points.{axis}" for axis in "xyz"]
                moved = kinematics.learnt(state)[list(map(kinematics.names.index, names))]
                points = np.asarray(task.points) + moved
            told = aj.ImageTask(robot, kinematics.camera(state), points=points)
            off = [np.abs(told.value(q) - sensor.value(q)).max() for q in places[24:]]
            found.append(np.nanmedian(off))
    without, with_axes = (np.median(found) for found in errors.values())
    assert with_axes < 0.8  # px
    assert without > 2.0 * with_axes


@pytest.mark.parametrize("case", ["room", "lens", "hand"])
def test_prediction_has_exact_derivatives(case, room, hand, rng):
    if case == "hand":
        q, _, task = hand
    else:
        q, (_, task) = START, room
    if case == "lens":
        camera = aj.PinholeCamera(
            (600.0, 580.0), (640, 480), CAMERA.position, CAMERA.rotation, distortion=(-0.1, 0.02)
        )
        task = aj.ImageTask(task.robot, camera, points=[(0.0, 0.0, 0.0), (0.0, 0.1, 0.05)])
    unknown = ("points" if case == "hand" else "tool", "origins", "axes", "camera", "focal_length")
    kinematics, m = AdaptiveCamera(task, unknown), task.m
    x = np.tile([330.0, 210.0], m // 2) + 30.0 * rng.standard_normal(m)
    state = kinematics.initial_state(aj.Measurement(0.0, q, 0.0 * q, x))
    at, v, h = kinematics._at, rng.standard_normal(len(q)), 1e-5
    for name in ("u_dot", "t_dot", "b_dot", "R_spin", "stretch_dot", "b"):
        state[at[name]] = 0.1 * rng.standard_normal(len(state[at[name]]))
    x_dot, x_ddot = 100.0 * rng.standard_normal((2, m))

    def later(s):
        new = state.copy()
        kinematics.advance(new, s)
        target = aj.Target(x + s * x_dot + s * s / 2 * x_ddot, x_dot + s * x_ddot, x_ddot)
        return kinematics.predict(new, q + s * v, v, target)

    now, after, before = later(0.0), later(h), later(-h)
    assert_allclose((after.z - before.z) / (2 * h), now.J @ v - now.x_d_dot + now.drift, rtol=1e-6)
    assert_allclose((after.J - before.J) / (2 * h), now.J_dot, rtol=1e-6, atol=1e-3)
    assert_allclose((after.x_d_dot - before.x_d_dot) / (2 * h), now.x_d_ddot, rtol=1e-5)


def test_the_prediction_of_a_camera_that_is_known_is_that_of_the_image(room):
    """z is the error in the image, at its own depth and in believed pixels."""
    sensor, _ = room
    kinematics = AdaptiveCamera(sensor, ("origins",))
    q, x_d = START + 0.1, sensor.value(START)
    state = kinematics.initial_state(aj.Measurement(0.0, q, 0.0 * q, sensor.value(q)))
    z = kinematics.predict(state, q, 0.0 * q, aj.Target(x_d)).z
    share = float(sensor.depths(q)[0]) / kinematics._usual_depth
    assert_allclose(z, share * (sensor.value(q) - x_d), rtol=1e-6)
    at_target = kinematics.predict(state, START, 0.0 * q, aj.Target(x_d))
    share = float(sensor.depths(START)[0]) / kinematics._usual_depth
    assert_allclose(at_target.J, share * sensor.jacobian(START), rtol=1e-6)


def test_at_a_usual_depth_errors_are_in_pixels(room):
    """That of the points in the middle of the places where the camera sees them."""
    sensor, _ = room
    kinematics, shares = AdaptiveCamera(sensor, ("origins",)), []
    for q in seen_configurations(sensor, 20):
        x = sensor.value(q)
        state = kinematics.initial_state(aj.Measurement(0.0, q, 0.0 * q, x))
        z = kinematics.predict(state, q, 0.0 * q, aj.Target(x + 3.0)).z
        shares.append(np.linalg.norm(z) / np.linalg.norm(np.full(len(x), 3.0)))
    assert np.median(shares) == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_camera_that_was_shifted_to_either_side_is_learnt_anew(room_run, room, side):
    """All that is seen is then off to the same side."""
    kinematics, _ = room_run
    moved = aj.ImageTask(room[0].robot, CAMERA.with_error(shift=(side * 0.1, side * 0.06, 0.0)))
    state = room_run[1].state
    q, v = room_run[1].q, 0.3 * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0])
    for k in range(30):
        t, place = 4.0 + k / 30.0, q + v * np.sin(k / 15.0)
        state = kinematics.step(state, aj.Measurement(t, place, v, moved.value(place), t), DT)
    assert kinematics.report(state).restarts > 0


@pytest.mark.parametrize("roll", np.arange(0.0, 360.0, 45.0))
def test_the_jacobian_is_regular_at_any_roll_and_behind_the_camera(room, roll):
    kinematics = AdaptiveCamera(room[1])
    seen = aj.Measurement(0.0, START, 0.0 * START, np.array([300.0, 250.0]))
    state, at = kinematics.initial_state(seen), kinematics._at
    turn = rotation_exp(np.array([0.0, 0.0, math.radians(roll)]))
    state[at["R"]] = (turn @ state[at["R"]].reshape(3, 3)).ravel()
    usual = np.linalg.svd(room[1].jacobian(START), compute_uv=False)[-1]
    for depth in (1.0, 0.0, -1.0):
        state[at["t"]] = [0.1, 0.1, depth]
        J = kinematics.predict(state, START, 0.0 * START, aj.Target(np.array([400.0, 100.0]))).J
        assert np.linalg.svd(J, compute_uv=False)[-1] > 0.3 * usual


def test_a_state_goes_in_and_another_comes_out(room_run):
    kinematics, run = room_run
    state = run.state.copy()
    measurement = aj.Measurement(9.0, run.q, run.v, run.x, 8.99)
    copies = kinematics, copy.copy(kinematics), pickle.loads(pickle.dumps(kinematics))
    once, again, elsewhere = (each.step(state, measurement, DT) for each in copies)
    assert np.array_equal(once, again)
    assert np.array_equal(once, elsewhere)
    assert np.array_equal(state, run.state)
    assert kinematics.learnt(np.stack([state, once])).shape == (2, len(kinematics.names))
    with pytest.raises(InvalidInputError, match="delay of a AdaptiveCamera cannot be changed"):
        kinematics.delay = 0.1


@pytest.mark.parametrize("law", ["tracking", "set-point"])
def test_the_torque_knows_nothing_but_the_measurement(room, law):
    """And a frame that was seen before teaches nothing."""
    kinematics = AdaptiveCamera(room[1])
    if law == "tracking":
        controller = aj.TrackingController(room[1])
        assert isinstance(controller.kinematics, AdaptiveCamera)
    else:
        regressor = GravityRegressor(room[1].robot)
        gravity = RegressorGravity(regressor, regressor.theta)
        controller = PredictedMeasurement(
            aj.SetpointController(room[1], gravity=gravity), kinematics
        )
    x, x_d = np.array([300.0, 200.0]), np.array([350.0, 260.0])
    measurement = aj.Measurement(0.0, START, 0.1 * START, x, 0.0)
    state = controller.initial_state(measurement)
    once, again = (controller.step(state, measurement, x_d, 1e-3) for _ in range(2))
    assert np.array_equal(once[1].torque, again[1].torque)
    assert np.array_equal(once[0], again[0])
    later = START + 1e-3 * measurement.v
    lost = measurement._replace(t=1e-3, q=later, x=np.full(2, np.nan))
    state, answer = controller.step(once[0], lost, x_d, 1e-3)
    assert np.isfinite(answer.torque).all()
    assert answer.status is aj.Status.PREDICTED


# -- sensors as they are ---------------------------------------------------------------------


@pytest.mark.study
def test_points_that_jump_or_are_lost_do_not_spoil_what_was_learnt(room_run, room):
    def spoil(t, x):
        if 2.5 < t < 2.59:
            return x + [150.0, -100.0]
        return np.full(2, np.nan) if 3.0 < t < 3.5 else x

    kinematics, clean = room_run
    run = follow(kinematics, room[0], START, spoil=spoil, seconds=4.0)
    assert late(run, 2.5, 4.0) < late(clean, 2.5, 4.0) + 2.0


def test_a_point_that_is_never_seen_does_not_cost_the_memory(hand):
    """Frames at one place are one key frame, whichever points they show."""
    goal, sensor, task = hand
    kinematics, estimator = AdaptiveCamera(task), AdaptiveCamera(task)._estimator
    H, o = kinematics._watched(goal)
    y = kinematics._rays(sensor.value(goal) / 600.0)
    y[1] = np.nan
    numbers = estimator.about(kinematics._first)
    for _ in range(5):
        numbers = estimator.learn(numbers, H, o, y)
    (weights, *_) = estimator._terms(numbers)
    assert_allclose(weights, 5.0 * estimator._weight[np.newaxis])


def test_frames_at_one_place_count_as_their_mean(room):
    """Each as much as any other, the first one, too."""
    sensor, task = room
    kinematics, estimator = AdaptiveCamera(task), AdaptiveCamera(task)._estimator
    H, o = kinematics._watched(START)
    y = kinematics._rays((sensor.value(START) - CAMERA.center) / 600.0)
    frames = y + 0.1 * np.arange(5.0)[:, np.newaxis, np.newaxis]
    numbers = estimator.about(kinematics._first)
    for each in frames:
        numbers = estimator.learn(numbers, H, o, each)
    assert_allclose(estimator._terms(numbers)[1], frames.mean(axis=0), atol=1e-12)


def test_of_more_places_than_are_remembered_the_last_are(room, rng):
    """Each as it was seen, and not mixed with what was seen elsewhere."""
    sensor, task = room
    kinematics, estimator = AdaptiveCamera(task), AdaptiveCamera(task)._estimator
    numbers, seen = estimator.about(kinematics._first), []
    for _ in range(60):
        q = START + rng.uniform(-0.5, 0.5, 7)
        H, o = kinematics._watched(q)
        y = kinematics._rays((sensor.value(q) - CAMERA.center) / 600.0)
        numbers = estimator.learn(numbers, H, o, y)
        seen.append(np.concatenate([y[0], o[0], H[0].ravel()]))
    weights, *columns = estimator._terms(numbers)
    kept = np.concatenate([each.reshape(len(weights), -1) for each in columns], axis=1)
    assert_allclose(weights, estimator._weight[np.newaxis].repeat(40, axis=0))
    assert_allclose(kept[np.argsort(kept[:, 0])], sorted(seen[-40:], key=lambda row: row[0]))


def test_a_camera_that_was_moved_is_learnt_anew(room_run, room):
    """Rolled by 90°, all of a sudden."""
    kinematics, _ = room_run
    moved = aj.ImageTask(room[0].robot, CAMERA.with_error(rotation=(0.0, 0.0, math.pi / 2)))
    state, x = room_run[1].state, []
    q, v = room_run[1].q, 0.3 * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0])
    for k in range(60):
        t, place = 4.0 + k / 30.0, q + v * np.sin(k / 15.0)
        x = moved.value(place)
        state = kinematics.step(state, aj.Measurement(t, place, v, x, t), DT)
    assert kinematics.report(state).restarts == 1
    camera, robot = kinematics.camera(state), kinematics.robot(state)
    assert_allclose(aj.ImageTask(robot, camera).value(place), x, atol=3.0)


@pytest.mark.study
def test_the_age_of_x_is_told_by_the_delay_where_x_does_not_tell_it(room):
    told, wrong = (
        follow(AdaptiveCamera(room[1], delay=delay), room[0], START, tells_t_x=False)
        for delay in (0.05, 0.0)
    )
    assert late(told, 2.0, 3.0) < 0.7 * late(wrong, 2.0, 3.0)


@pytest.mark.parametrize("x", [np.full(2, np.nan), np.full(2, 1e30), [np.inf, 0.0]], ids=str)
def test_nothing_that_is_measured_makes_a_state_that_is_not_finite(room, x):
    kinematics = AdaptiveCamera(room[1])
    state = kinematics.initial_state(aj.Measurement(0.0, START, 0.0 * START, np.array(x)))
    for k in range(30):
        x_k = np.array(x) if k % 3 else np.array([300.0, 100.0])
        for t_x in (None, 0.02 * k):
            state = kinematics.step(
                state, aj.Measurement(0.02 * k, START, 0.0 * START, x_k, t_x), DT
            )
    assert np.isfinite(state).all()
    assert np.isfinite(kinematics.learnt(state)).all()


@pytest.mark.parametrize(
    "case", ["room", *(pytest.param(k, marks=pytest.mark.study) for k in ("hand", "known"))]
)
def test_nothing_that_is_seen_makes_a_prediction_that_is_not_finite(case, room, hand, rng):
    """Images from anywhere, of arms anywhere: no estimate is right, and all are finite."""
    task = hand[2] if case == "hand" else room[1]
    kinematics = AdaptiveCamera(task, ("origins",) if case == "known" else None)
    n, m, state = task.robot.nq, task.m, None
    for k in range(150):
        q, v = rng.uniform(-3.0, 3.0, n), rng.standard_normal(n)
        x = rng.choice([320.0, 1e3, 1e5, np.nan], size=m, p=[0.7, 0.1, 0.1, 0.1])
        x = x * rng.standard_normal(m)
        measurement = aj.Measurement(0.03 * k, q, v, x, 0.03 * k)
        if state is None:
            state = kinematics.initial_state(measurement)
        state = kinematics.step(state, measurement, 1e-3)
        assert np.isfinite(state).all()
        target = aj.Target(rng.uniform(0.0, 400.0, m), rng.standard_normal(m))
        for each in kinematics.predict(state, q, v, target):
            assert np.isfinite(each).all()
    assert np.isfinite(kinematics.report(state).covariance).all()


def test_points_that_are_believed_behind_the_camera_are_found(room):
    behind = aj.PinholeCamera.looking_at(
        (-0.5, 0.0, 0.4), (0.3, 0.0, 0.4), focal_length=600.0, size=(640, 480)
    )
    task = aj.ImageTask(room[1].robot, behind)
    assert task.depths(START)[0] < 0.0
    kinematics = AdaptiveCamera(task)
    x = room[0].value(START)
    state = kinematics.initial_state(aj.Measurement(0.0, START, 0.0 * START, x))
    z, J, *_ = kinematics.predict(state, START, 0.0 * START, aj.Target(x))
    assert_allclose(z, 0.0, atol=3.0)
    assert np.isfinite(J).all()


# -- what wrong calls are told -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"unknown": ("points",)}, "unknown must be one or more of tool, origins, axes, camera"),
        ({"unknown": ()}, "unknown must be one or more of"),
        ({"unknown": 3}, "unknown must be one or more of"),
        ({"noise": 0.0}, r"noise must be a finite number > 0 \[px\]"),
        ({"delay": -1.0}, r"delay must be a finite number >= 0 and <= 1 \[s\]"),
        ({"sd": {"tool": 0.0}}, "sd of tool must be a finite number > 0"),
    ],
    ids=str,
)
def test_wrong_numbers_are_told(room, options, text):
    with pytest.raises(InvalidInputError, match=text):
        AdaptiveCamera(room[1], **options)


def test_wrong_tasks_are_told(panda, room, hand):
    with pytest.raises(InvalidInputError, match="task must be an ImageTask of the believed robot"):
        AdaptiveCamera(aj.PositionTask(panda))
    tag = aj.ImageTask(panda, CAMERA, points=aj.cameras.tag_corners(0.08))
    for task in (tag, aj.tasks.CombinedTask(tag, np.eye(8)[:6])):
        with pytest.raises(InvalidInputError, match=r"take three corners, .*points=points\[:3\]"):
            AdaptiveCamera(task)
    AdaptiveCamera(aj.ImageTask(panda, CAMERA, points=tag.points[:3]))
    planar = aj.ImageTask(aj.load_robot("two_link"), PlanarCamera(0.05, 3.0))
    with pytest.raises(InvalidInputError, match=r"ImageTask .* with a PinholeCamera"):
        AdaptiveCamera(planar)
    with pytest.raises(InvalidInputError, match="depth='believed'"):
        AdaptiveCamera(aj.ImageTask(panda, CAMERA, depth=1.0))
    robot, camera = hand[1].robot, hand[1].camera
    with pytest.raises(InvalidInputError, match="with points of the world"):
        AdaptiveCamera(aj.ImageTask(robot, camera, "base_link", [(0.5, 0.0, 0.0)]))
    with pytest.raises(UnknownNameError, match="offset"):
        AdaptiveCamera(room[1], sd={"offset": 0.1})


def test_where_an_image_was_seen_it_is_known_well_although_no_number_is(panda):
    """The covariance of x̂ by that of tool, camera and focal length, which belong together."""
    points = ((0.0, 0.0, 0.0), (0.1, 0.0, 0.05))
    images = aj.ImageTask(panda, CAMERA, points=points)
    kinematics = AdaptiveCamera(images, ("tool", "camera", "focal_length"))
    rng, state, frames = np.random.default_rng(1), None, 40
    for k in range(frames):
        q = START + 0.01 * rng.standard_normal(7)
        seen = aj.Measurement(k / 30.0, q, 0.0 * q, images.value(q), k / 30.0)
        state = kinematics.initial_state(seen) if state is None else state
        state = kinematics.step(state, seen, 1.0 / 30.0)
    report, camera, model = (
        kinematics.report(state), kinematics.camera(state), kinematics.regressor,
    )  # fmt: skip
    tool = kinematics.learnt(state)[:3]
    R, _ = camera.placement()

    def image(q, change):
        theta = model.theta.copy()
        theta[-3:] = tool + change[:3]
        moved = camera.with_error(
            shift=R.T @ change[3:6], rotation=change[6:9],
            focal_factor=1.0 + change[9] / camera.focal_length[0],
        )  # fmt: skip
        places = model.position(q, theta).reshape(-1, 3)
        return np.concatenate([moved.project(place) for place in places])

    def sd_of_x(q):
        h = 1e-5
        J = np.array([image(q, h * each) - image(q, -h * each) for each in np.eye(10)]).T / (2 * h)
        return np.sqrt(np.diag(J @ report.covariance @ J.T)), J

    assert len(report.covariance) == 10
    (known, J), (elsewhere, _) = sd_of_x(START), sd_of_x(START + 0.3)
    assert known.max() < 1.5 * kinematics.noise / np.sqrt(frames)
    assert elsewhere.max() > 5.0 * known.max()
    for part in (slice(0, 3), slice(3, 6), slice(6, 9)):  # none of which is known as well alone
        alone = J[:, part] @ report.covariance[part, part] @ J[:, part].T
        assert np.sqrt(np.diag(alone)).min() > 10.0 * known.max()
