"""One visual servoing run: what is believed, what is true, what is drawn and the verdict."""

import json
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

import approxjac as aj
from approxjac.interface import Measurement
from approxjac.studies import servo, servo_report
from approxjac.studies.servo import ServoSettings

HOME = (0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7)
WRONG = {"roll": 0.3, "focal_factor": 1.3, "depth_factor": 1.5, "rate": 400.0}
NEARLY = {"roll": 0.05, "depth_factor": 1.1, "rate": 250.0}


def made(robot="panda", **options):
    return servo.run(servo.prepare(robot, ServoSettings(**options)))


@pytest.fixture(scope="module")
def done():
    return made(points=2, seed=1, duration=4.0, **WRONG)


@pytest.fixture(scope="module")
def in_hand():
    return made("ur5", eye="in-hand", duration=4.0, **WRONG)


# -- it converges -----------------------------------------------------------------------


def test_a_redundant_arm_brings_two_points_to_within_the_noise(done):
    assert done.run.error.shape[1] == 4 < done.run.v.shape[1]
    assert done.errors[0].min() > 50.0
    assert done.converged
    assert done.final_error < 0.5 == done.servo.tolerance
    assert done.stays_in_view
    assert done.reason == ""


def test_an_eye_in_hand_brings_a_point_to_within_the_noise(in_hand):
    assert in_hand.servo.sensor.camera.mount == "tool0"
    assert in_hand.errors[0].min() > 50.0
    assert in_hand.converged


@pytest.mark.parametrize(
    ("robot", "options"),
    [
        ("panda", {"duration": 6.0, **WRONG}),
        ("panda", {"duration": 6.0, "depth": "constant", **WRONG}),
        ("panda", {"duration": 6.0, "depth": "measured", **WRONG}),
        ("two_link", {"duration": 3.0, **NEARLY}),  # as many coordinates as joints
        ("ur5", {"eye": "in-hand", "points": 3, "seed": 1, "duration": 6.0, **NEARLY}),  # again
    ],
)
def test_it_converges_to_within_the_noise(robot, options):
    result = made(robot, **options)
    assert result.errors[0].max() > 50.0
    assert result.converged, result.reason


def test_the_classical_control_runs_beside_it_and_says_what_it_is():
    result = made(law="ibvs", duration=3.0, **WRONG)
    assert isinstance(result.servo.controller, aj.VelocityServo)
    assert result.converged
    assert "ibvs" in servo_report.text(result)


def test_law_5_differentiates_the_image_and_approaches():
    result = made(law="5", differentiator=0.05, duration=3.0, **WRONG)
    assert result.servo.controller.velocity.time_constant == 0.05
    assert result.errors[-1].max() < 0.3 * result.errors[0].max()


# -- images that do not come ------------------------------------------------------------


@pytest.mark.parametrize(
    "outage",
    [{"lost": (0.3, 1.3), "lost_point": 1}, {"lost": (0.3, 1.3)}, {"frozen": (0.3, 1.3)}],
    ids=["one point", "all points", "frozen"],
)
def test_without_images_the_arm_stops_and_goes_on_after(done, outage):
    result = made(points=2, seed=1, duration=4.0, unseen=20.0, **outage, **WRONG)
    run, undisturbed = result.run, done.run
    # torques keep within a little of those of the run that sees
    peaks = np.abs(run.tau).max(axis=0) / np.abs(undisturbed.tau).max(axis=0)
    assert peaks.max() < 1.1
    # it moved `unseen` without images, then it brakes, and says so
    lost = result.braked
    start, end = run.t[lost][[0, -1]]
    assert 0.3 < start < 0.6
    assert 1.3 <= end < 1.4
    assert (run.status[lost] == aj.Status.MEASUREMENT_LOST).all()
    assert lost[(run.t > start) & (run.t < end)].all()
    assert kinetic_energy(result, 1.29) < 0.01 * kinetic_energy(result, 0.3)
    assert kinetic_energy(result, 1.29) < 0.5 * kinetic_energy(done, 1.29)  # which settles
    # and it goes on
    assert result.converged
    assert f"{100.0 * lost.mean():.3g} %" in servo_report.text(result)
    assert result.summary()["braked_share"] == lost.mean() > 0.1
    assert result.summary()["status_counts"]["MEASUREMENT_LOST"] == lost.sum()


def test_what_never_comes_is_named_as_the_reason():
    result = made(duration=1.0, dropout=1.0, **WRONG)
    assert result.reason == "no new image comes: without it there are only brakes"
    assert result.braked.all()


def test_images_that_are_held_longer_than_usual_are_told_from_those_that_come(done):
    assert not done.waiting.any()
    result = made(points=2, seed=1, duration=1.0, frozen=(0.3, 0.6), unseen=1e9, **WRONG)
    held = result.run.t[result.waiting]
    assert_allclose(held[[0, -1]], (0.34, 0.64), atol=0.04)
    assert not result.braked.any()


def kinetic_energy(result, t):
    """½ q̇ᵀM q̇ at the first recorded instant from t on [J]."""
    k = int(np.argmax(result.run.t >= t))
    v = result.run.v[k]
    return 0.5 * v @ result.servo.plant.dynamics.M(result.run.q[k]) @ v


# -- truth and belief -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("robot", "options"),
    [
        ("panda", {"points": 2, "target": (300.0, 200.0, 320.0, 250.0)}),
        ("panda", {"depth": "constant"}),
        ("panda", {"depth": "measured", "law": "ibvs"}),
        ("ur5", {"eye": "in-hand", "seed": 2}),
    ],
)
def test_the_controller_never_sees_the_truth(robot, options):
    """Two truths, one belief, one measurement: the torque is the same to the bit."""
    options = {"gravity": "believed", **options}
    if robot == "panda":  # where the camera stands is no truth to hide here
        options |= {"camera_position": (1.7, -0.8, 1.1), "camera_target": (0.5, 0.0, 0.5)}
    a = servo.prepare(
        robot, ServoSettings(focal_length=600.0, focal_factor=1.3, object_length=0.15, **options)
    )
    b = servo.prepare(
        robot,
        ServoSettings(focal_length=780.0, distortion=(-0.02,), object_length=0.05, **options),
    )
    assert a.sensor.camera != b.sensor.camera
    assert a.sensor.robot != b.sensor.robot
    x, v = a.sensor.value(a.q0), np.full(a.sensor.robot.nv, 0.1)
    assert not np.array_equal(b.sensor.value(a.q0), x)
    measurement = Measurement(0.0, a.q0, v, x)
    torques = [
        ready.held.evaluate(ready.held.initial_state(measurement), measurement, a.target).torque
        for ready in (a, b)
    ]
    assert np.array_equal(*torques)


def test_the_believed_camera_differs_as_the_settings_say():
    ready = servo.prepare("panda", ServoSettings(roll=0.3, focal_factor=1.3, depth_factor=1.5))
    true, believed = ready.sensor.camera, ready.controller.task.camera
    assert believed.focal_length == (780.0, 780.0)
    assert believed.distortion == ()
    (R, p), (R_hat, p_hat) = true.placement(), believed.placement()
    assert_allclose((R.T @ R_hat)[:2, :2], rotation(0.3), atol=1e-12)
    back = R.T @ (p_hat - p)
    assert_allclose(back[:2], 0.0, atol=1e-12)
    assert back[2] < -0.3


def rotation(angle):
    return [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]


def test_the_same_seed_is_the_same_run_and_another_is_not():
    a, b = (made(duration=0.2, rate=200.0, seed=4).run for _ in range(2))
    assert np.array_equal(a.q, b.q)
    assert np.array_equal(a.x_measured, b.x_measured)
    other = servo.prepare("panda", ServoSettings(duration=0.2, rate=200.0, seed=5))
    assert not np.array_equal(other.q0, a.q[0])


def test_a_start_and_a_target_may_be_given():
    for depth in ("believed", "measured"):  # which has depths in its values
        settings = ServoSettings(start=HOME, points=2, target=(300, 200, 320, 250), depth=depth)
        ready = servo.prepare("panda", settings)
        assert np.array_equal(ready.q0, HOME)
        images = ready.target.reshape(2, -1)[:, :2]
        assert images.tolist() == [[300.0, 200.0], [320.0, 250.0]]


@pytest.mark.parametrize("robot", ["kinova", "xarm7", "z1", "so100"])
def test_other_arms_are_seen_by_the_camera_where_it_stands(robot):
    settings = ServoSettings(roll=0.3, depth_factor=1.5, duration=0.1, rate=200.0)
    result = servo.run(servo.prepare(robot, settings))
    assert result.stays_in_view


# -- words, files and pictures ----------------------------------------------------------


def test_it_writes_everything(done, tmp_path):
    servo_report.write(done, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        "run.png", "run.svg", "image.png", "image.svg", "views.png", "views.svg", "run.npz",
        "summary.json",
    }  # fmt: skip
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["verdict"] == "converged"
    assert summary["final_error_px"] == done.final_error
    assert summary["start_error_px"] == done.errors[0].max()
    assert summary["tolerance_px"] == 0.5
    assert 0.0 < summary["settling_time_s"] < 4.0
    assert summary["stays_in_view"] is True
    assert summary["waiting_share"] == summary["braked_share"] == 0.0
    assert len(summary["start"]) == len(summary["target"]) == len(summary["end"]) == 4
    assert len(summary["q_start"]) == len(summary["q_end"]) == 7
    assert summary["settings"]["focal_factor"] == 1.3
    again = aj.Trajectory.load(tmp_path / "run.npz")
    assert np.array_equal(again.x_measured, done.run.x_measured, equal_nan=True)
    for name in ("run", "image", "views"):
        picture = Image.open(tmp_path / f"{name}.png")
        assert len(np.unique(np.asarray(picture.convert("L")))) > 50


def test_the_text_says_where_it_started_went_and_ended(done):
    text = servo_report.text(done)
    for word in (
        "believed ", "law ", "joints ", "start ", "target ", "end ", "error ", "in view ",
        "settled ", "torque ", "images ", "status ", "verdict ",
    ):  # fmt: skip
        assert f"\n{word}" in text
    assert "camera rolled by 17.2°, focal length × 1.3, depth × 1.5" in text
    assert "verdict     converged" in text


def test_the_pictures_show_the_points_the_lanes_and_both_cameras(done, in_hand):
    error, torque, lanes = servo_report.draw_run(done).axes
    labels = [line.get_label() for line in error.get_lines()]
    assert labels == ["point 1", "point 2", "tolerance"]
    assert_allclose(error.get_lines()[0].get_ydata(), done.errors[:, 0])
    assert torque.get_ylabel() == "τ / limit [–]"
    assert [label.get_text() for label in lanes.get_yticklabels()] == [
        "new images", "last one held", "too old: brakes", "out of view",
    ]  # fmt: skip
    views = servo_report.draw_views(done).axes
    for ax, k in zip(views, (0, -1), strict=True):
        lines = {line.get_label(): np.array(line.get_data()).T for line in ax.get_lines()}
        assert_allclose(lines["points, true"], done.run.x[k].reshape(2, 2), atol=1e-9)
        wrong = done.servo.controller.task._measured.value(done.run.q[k]).reshape(2, 2)
        assert_allclose(lines["points, believed"], wrong, atol=1e-9)
    own = servo_report.draw_views(in_hand).axes[0]
    assert "arm, true" not in [line.get_label() for line in own.get_lines()]


def test_what_is_believed_is_said_in_words():
    nothing = ServoSettings(distortion=(), object_length=0.0, object_mass=0.0)
    assert servo_report.believed(nothing) == "what is true"
    said = servo_report.believed(
        ServoSettings(camera_shift=(0.0, 0.03, 0.04), camera_rotation=(0.0, 0.0, math.pi / 18.0))
    )
    assert said.startswith("camera turned by 10°, camera 50 mm off, no distortion, object 0 m")


def test_a_run_that_is_too_short_is_not_converged_and_says_why():
    result = made(duration=0.5, **WRONG)
    assert not result.converged
    assert math.isnan(result.settling_time)
    summary = result.summary()
    assert summary["verdict"] == "not converged"
    assert summary["settling_time_s"] is None
    assert result.reason == "still approaching its target at the end"
    json.dumps(summary, allow_nan=False)


def test_a_point_that_leaves_the_view_is_named_as_the_reason():
    result = made(roll=math.pi, seed=1, duration=4.0, rate=400.0, distortion=())
    assert not result.stays_in_view
    assert result.reason == "a point left the camera's view: without it there are only brakes"
    assert "in view     not for" in servo_report.text(result)
    assert np.isfinite(result.run.tau).all()
    servo_report.draw_run(result)


def test_an_arm_that_creeps_near_a_singular_posture_is_told_from_one_at_rest():
    wrong = {"roll": 0.2, "focal_factor": 1.2, "depth_factor": 1.3, "rate": 300.0}
    result = made("ur3", duration=8.0, **wrong)
    assert result.reason.startswith("hardly moves: the believed Jacobian shows little of the error")
    heavy = made("two_link", gravity="none", duration=8.0, rate=300.0)
    assert heavy.reason.endswith("or gravity, which is not compensated as it is")
    short = made("two_link", gravity="none", duration=4.0, rate=300.0)
    assert short.reason == "too short to tell: 4 s, of 1.5 s to settle, where 6 s do"


# -- bad settings -----------------------------------------------------------------------

ASIDE = {"camera_position": (1.7, -0.8, 0.6), "camera_target": (1.7, 0.5, 0.6)}
AWAY = {"camera_position": (-1.0, 0.0, 1.5), "camera_target": (-2.0, 0.0, 1.5)}


@pytest.mark.parametrize(
    ("robot", "options", "text"),
    [
        ("pando", {}, "robot 'pando' not in the robots known by name; did you mean 'panda'"),
        ("panda", {"points": 4}, "points must be at most half as many as joints.*: 3 for panda"),
        ("panda", {"points": 0}, "points must be 1, 2 or 3, got 0"),
        ("two_link", {"points": 2}, "points must be at most half as many.*: 1 for two_link"),
        ("panda", {"focal_length": 0.0}, r"focal_length must be > 0 \[px\], got 0.0"),
        ("panda", {"target": (900.0, 100.0)}, "target must be within the image of 640 x 480 px"),
        ("panda", {"target": (90.0,)}, r"target must have shape \(2,\)"),
        ("panda", {"start": HOME, **AWAY}, "point 1 is 1.42 m behind it: give another start"),
        ("panda", {"start": HOME, **ASIDE}, "point 1 is at .* px, outside its image"),
        ("panda", AWAY, "the true camera must see the points in some posture"),
        ("panda", {"camera_rotation": (0.0, 3.0, 0.0)}, "the believed camera must see the points"),
        ("panda", {"object_mass": 500.0}, "no posture of panda was found in which the camera"),
        ("two_link", {"eye": "in-hand"}, "points must be such that two_link can move each of thei"),
        ("panda", {"start": (9.0,) * 7}, "start must be within the joint limits"),
        ("panda", {"gravity": "learnt", "law": "ibvs"}, "exact, believed or none with ibvs"),
        ("panda", {"law": "5", "depth": "measured"}, "depth must be believed or constant with la"),
        ("panda", {"law": "ibvs", "kp": (1.0,)}, "kp is a gain of the laws 5 and 6, got"),
        ("panda", {"differentiator": 0.2}, "differentiator is for law 5, got 0.2 with law 6"),
        ("panda", {"law": "5", "differentiator": 0.0}, "differentiator must be a finite number >"),
        ("panda", {"kp": (1,), "kv": (1,), "damping": (1,), "settling_time": 2.0},
         "settling_time is for default gains, got 2.0 with given ones"),
        ("panda", {"lost_point": 1}, "lost_point must be one of the points, 1 to 1, with a time"),
        ("panda", {"lost": (20.0, 21.0)}, "lost must be the start and the end of a time within"),
        ("panda", {"frozen": (2.0, 1.0)}, "frozen must be the start and the end of a time within"),
        ("panda", {"spread": 0.1}, "spread is for several points, got 0.1 with one point"),
        ("panda", {"points": 2, "spread": 0.0}, "spread must be a finite number > 0"),
        ("ur5", {"eye": "in-hand", "camera_target": (1.0, 0.0, 0.0)}, "camera_target is for an e"),
        ("ur5", {"eye": "in-hand", "believed_length": 0.1}, "believed_length needs believed_mass"),
        ("panda", {"depth_factor": -1.0}, "depth_factor must be a finite number > 0"),
        ("panda", {"focal_factor": 0.0}, "focal_factor must be a finite number > 0"),
        ("panda", {"frame_rate": 2000.0}, "frame_rate must be at most the rate of control, 1000"),
        ("panda", {"noise": -1.0}, "noise must be a finite number >= 0"),
        ("panda", {"latency": -1.0}, "latency must be a finite number >= 0"),
        ("panda", {"dropout": 2.0}, "dropout must be a probability from 0 to 1, got 2.0"),
        ("panda", {"unseen": 0.0}, "unseen must be numbers > 0"),
        ("panda", {"velocity_filter": -1.0}, "velocity_filter must be a finite number >= 0"),
        ("panda", {"tolerance": 0.0}, "tolerance must be a finite number > 0"),
        ("panda", {"duration": 1e-4}, "duration must be a finite number >= 0.001"),
        ("panda", {"seed": -1}, "seed must be >= 0, got -1"),
    ],
)  # fmt: skip
def test_bad_settings_are_refused(robot, options, text):
    with pytest.raises(aj.ApproxJacError, match=text) as caught:
        servo.prepare(robot, ServoSettings(**options))
    assert "\n" not in str(caught.value)


# -- limits of the arm -------------------------------------------------------------------


@pytest.mark.parametrize("law", ["6", "ibvs"])
def test_limits_of_torques_and_joints_are_kept(law):
    """Without them a joint of this run leaves its range by a radian and more."""
    free = made(law=law, duration=6.0, **WRONG)
    kept = made(law=law, duration=6.0, torque_limits="0.7", **WRONG)
    assert free.joint_limit_excess > 0.5
    assert kept.joint_limit_excess < 0.01
    assert kept.peak_torque_ratio <= 1.0 + 1e-9
    assert_allclose(kept.motor_limits, 0.7 * free.motor_limits)
    assert kept.converged, kept.reason
    assert "beyond its position limits, which --torque-limits urdf keeps" in servo_report.text(free)
    assert "limits      FREE" in servo_report.text(kept)
    assert kept.summary()["joint_limit_excess"] == kept.joint_limit_excess


def test_torque_limits_that_are_none_are_refused():
    with pytest.raises(aj.InvalidInputError, match='torque_limits must be "urdf" or a positive'):
        made(torque_limits="half")
