"""Scenarios with a pinhole camera: what is believed, what is true, what is drawn, the verdict."""

import json
import math

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scenarios import HOME, camera

import approxjac as aj
from approxjac.scenario import Scenario, build_scenario, run_scenario
from approxjac.scenario import outcome as report
from approxjac.scenario.judge import prepare

WRONG = {"camera": {"roll": 0.3, "focal_factor": 1.3, "depth_factor": 1.5}}
NEARLY = {"camera": {"roll": 0.05, "depth_factor": 1.1}}
BARE = {"object": {"length": 0.0, "mass": 0.0}}
LEARNS = {
    "law": "tracking", "unknown": ["tool", "camera"], "gravity": "learnt", "settling_time": None,
    "unseen": None,
}  # fmt: skip
IN_HAND = BARE | {"camera": {"mount": "tip"}}


def made(robot="panda", **parts):
    return run_scenario(camera(robot, **{"believed": WRONG, **parts}))


@pytest.fixture(scope="module")
def done():
    return made(task={"points": 2}, run={"seed": 1, "duration": 4.0})


def test_a_redundant_arm_brings_two_points_to_within_the_noise(done):
    assert done.run.error.shape[1] == 4 < done.run.v.shape[1]
    assert done.errors[0].min() > 50.0
    assert done.converged
    assert done.final_error["px"] < 0.5 == done.tolerance
    assert done.reason == ""


@pytest.mark.parametrize(
    ("robot", "parts"),
    [
        pytest.param(
            "panda",
            {"task": {"depth": "constant"}, "run": {"seed": 1, "duration": 5.5}},
            marks=pytest.mark.long,
        ),
        pytest.param(
            "panda",
            {"task": {"depth": "measured"}, "run": {"seed": 1, "duration": 7.0}},
            marks=pytest.mark.study,
        ),
        pytest.param("ur5", {"true": IN_HAND, "run": {"duration": 5.0}}, marks=pytest.mark.study),
        ("two_link", {"believed": NEARLY, "run": {"duration": 8.0}}),  # joints as coordinates
    ],
)
def test_it_converges_to_within_the_noise(robot, parts):
    result = made(robot, **parts)
    assert result.errors[0].max() > 50.0
    assert result.converged, result.reason


def test_law_5_differentiates_the_image_and_approaches():
    result = made(controller={"differentiator": 0.05}, run={"duration": 3.0, "seed": 1})
    assert result.built.law.velocity.time_constant == 0.05
    assert result.errors[-1].max() < 0.3 * result.errors[0].max()


@pytest.mark.study
@pytest.mark.parametrize(
    "outage",
    [{"lost": (0.3, 1.3)}, {"frozen": (0.3, 1.3)}],
    ids=["lost", "frozen"],
)
def test_without_images_the_arm_stops_and_goes_on_after(done, outage):
    result = made(
        task={"points": 2}, run={"seed": 1, "duration": 4.0}, controller={"unseen": 20.0},
        sensor=outage,
    )  # fmt: skip
    lost, t = result.run.status == aj.Status.MEASUREMENT_LOST, result.run.t
    start, end = t[lost][[0, -1]]
    assert 0.3 < start < 0.6  # it moved `unseen` without images, then it brakes, and says so
    assert 1.3 <= end < 1.4
    assert lost[(t > start) & (t < end)].all()
    assert np.abs(result.run.v[np.argmax(t >= 1.29)]).max() < 0.5
    assert result.converged  # and it goes on


def test_the_believed_camera_differs_as_the_scenario_says():
    built = build_scenario(camera(believed=WRONG))
    true, believed = built.plant.sensor.camera, built.law.task.camera
    assert believed.focal_length == (780.0, 780.0)
    assert believed.distortion == ()
    (R, p), (R_hat, p_hat) = true.placement(), believed.placement()
    c, s = math.cos(0.3), math.sin(0.3)
    assert_allclose((R.T @ R_hat)[:2, :2], [[c, -s], [s, c]], atol=1e-12)
    back = R.T @ (p_hat - p)
    assert_allclose(back[:2], 0.0, atol=1e-12)
    assert back[2] < -0.3


def test_all_errors_of_a_camera_are_along_and_about_its_own_axes():
    """First it is rolled, then turned in the axes that it has then; moved along the true ones."""
    wrong = {"roll": 0.3, "rotation": (0.1, -0.2, 0.05), "shift": (0.02, -0.03, 0.01)}
    built = build_scenario(camera(believed={"camera": wrong}))
    (R, p), (R_hat, p_hat) = (
        task.camera.placement() for task in (built.plant.sensor, built.law.task)
    )
    turned = pin.exp3(np.array([0.0, 0.0, 0.3])) @ pin.exp3(np.array(wrong["rotation"]))
    assert_allclose(R.T @ R_hat, turned, atol=1e-12)
    assert_allclose(R.T @ (p_hat - p), wrong["shift"], atol=1e-12)


@pytest.mark.parametrize("mount", [None, "forearm_link"])
def test_a_camera_is_as_it_is_said_to_be_and_depths_are_believed_with_a_factor(mount):
    """In the room the depth of what it looks at is constant; on the arm, that at the goal."""
    given = {"focal_length": 333.0, "size": (320, 240), "distortion": ()}
    if mount is None:
        given |= {"position": (1.7, -0.8, 1.1), "looking_at": (0.5, 0.0, 0.5)}
        depth = np.linalg.norm(np.subtract(given["position"], given["looking_at"]))
    else:
        given, depth = given | {"position": (0.02, -0.04, 0.03), "mount": mount}, 0.35
    built = build_scenario(camera(
        "ur5", true=BARE | {"camera": given}, task={"depth": "constant"},
        believed={"camera": {"depth_factor": 1.5}},
    ))  # fmt: skip
    own = built.plant.sensor.camera
    assert (own.mount, own.size, own.focal_length) == (mount, (320, 240), (333.0, 333.0))
    R, p = own.placement()
    assert_allclose(p, given["position"])
    if mount is None:
        assert_allclose(np.cross(R[:, 2], np.subtract(given["looking_at"], p)), 0.0, atol=1e-9)
    assert_allclose(built.law.task.depth, 1.5 * depth, rtol=1e-9)


def test_the_controller_never_sees_the_truth():
    """Two truths, one belief, one measurement: the torque is the same to the bit."""
    stand = {"position": (1.7, -0.8, 1.1), "looking_at": (0.5, 0.0, 0.5)}
    usual = {"controller": {"gravity": "believed"}}
    a = build_scenario(camera(
        **usual, believed={"camera": {"focal_factor": 1.3}},
        true={"camera": {**stand, "focal_length": 600.0}},
    ))  # fmt: skip
    b = build_scenario(
        camera(
            **usual,
            true={
                "object": {"length": 0.05},
                "camera": {**stand, "focal_length": 780.0, "distortion": (-0.02,)},
            },
        )
    )
    x, v = a.plant.sensor.value(a.q0), np.full(7, 0.1)
    assert not np.array_equal(b.plant.sensor.value(a.q0), x)
    measurement = aj.Measurement(0.0, a.q0, v, x)
    torques = []
    for controller in (a.controller, b.controller):
        state = controller.initial_state(measurement)
        answer = controller.step(state, measurement, aj.Target(a.target), 0.0025)[1]
        torques.append(answer.torque)
    assert np.array_equal(*torques)


def test_a_start_and_a_target_may_be_given():
    for depth in ("believed", "measured"):  # which has depths in its values
        goal = {"start": HOME, "target": (300, 200, 320, 250)}
        built = build_scenario(camera(task={"points": 2, "depth": depth}, run=goal))
        assert np.array_equal(built.q0, HOME)
        images = built.target.reshape(2, -1)[:, :2]
        assert_allclose(images, [[300.0, 200.0], [320.0, 250.0]])


@pytest.mark.study
def test_it_writes_everything(done, tmp_path):
    report.write(done, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        "run.png", "run.svg", "run.npz", "summary.json", "scenario.toml",
    }  # fmt: skip
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["final_error_px"] == done.final_error["px"]
    assert summary["start_error_px"] == done.errors[0].max()
    assert summary["tolerance"] == 0.5
    assert 0.0 < summary["settling_time_s"] < 4.0
    assert Scenario.load(tmp_path / "scenario.toml") == done.built.scenario
    picture = Image.open(tmp_path / "run.png")
    assert len(np.unique(np.asarray(picture.convert("L")))) > 50
    said = " ".join(report.text(done).split())
    wrong = "camera roll 0.3 rad, camera focal_factor 1.3, camera depth_factor 1.5 law"
    assert f"believed object length 0 m, object mass 0 kg, {wrong} " in said


@pytest.mark.parametrize(
    ("robot", "parts", "reason"),
    [
        ("panda", {"run": {"seed": 1, "duration": 1.0}}, "still approaching its target at the end"),
        ("panda", {"run": {"duration": 1.0}, "sensor": {"dropout": 1.0}},
         "the measurement of x is lost"),
        pytest.param(
            "panda",
            {"true": {"camera": {"distortion": ()}}, "believed": {"camera": {"roll": math.pi}},
             "run": {"seed": 10, "duration": 4.0}},
            "the measurement of x is lost", marks=pytest.mark.study),
    ],
)  # fmt: skip
def test_what_kept_it_from_its_target_is_named(robot, parts, reason):
    result = made(robot, **parts)
    assert not result.converged
    assert result.reason == reason
    json.dumps(result.summary(), allow_nan=False)


ASIDE = {"position": (1.7, -0.8, 0.6), "looking_at": (1.7, 0.5, 0.6)}
AWAY = {"position": (-1.0, 0.0, 1.5), "looking_at": (-2.0, 0.0, 1.5)}


@pytest.mark.parametrize(
    ("robot", "parts", "text"),
    [
        ("panda", {"task": {"points": 4}}, "got 4; four, such as a tag's corners, are for Python"),
        ("two_link", {"task": {"points": 2}}, "task.points must be at most half.*: 1 for two_link"),
        ("panda", {"run": {"target": (900.0, 100.0)}}, "target must be within the image of 640 x"),
        ("panda", {"run": {"target": (90.0,)}}, r"run.target.at must be 2 numbers"),
        ("panda", {"run": {"start": HOME}, "true": {"camera": AWAY}}, "point 1 is 1.42 m behind i"),
        ("panda", {"run": {"start": HOME}, "true": {"camera": ASIDE}}, "px, outside its image"),
        pytest.param(
            "panda", {"believed": {"camera": {"rotation": (0.0, 3.0, 0.0)}}},
            "the believed camera m", marks=pytest.mark.study),
        ("two_link", {"true": IN_HAND}, "task.points must be such that two_link can move each"),
        ("panda", {"controller": {"differentiator": 0.2}, "task": {"depth": "measured"}},
         "task.depth must be believed or constant with a differentiator"),
        ("panda", {"controller": {"kp": 1, "kv": 1, "damping": 1, "settling_time": 2.0}},
         "controller.settling_time is for default gains, got 2.0 with given ones"),
        ("panda", {"sensor": {"frozen": (2.0, 1.0)}}, "sensor.frozen must be the start and the en"),
        ("panda", {"sensor": {"rate": 2000.0}}, "sensor.rate must be at most that of control, "),
        ("panda", {"task": {"spread": 0.1}}, "task.spread is for several points, got 0.1 with on"),
        ("ur5", {"true": IN_HAND | {"camera": {"mount": "tip", "looking_at": (1, 0, 0)}}},
         "true.camera.looking_at is for a camera in the world"),
        ("ur5", {"true": IN_HAND, "believed": {"object": {"length": 0.1}}},
         "believed.object.length needs believed.object.mass"),
        ("panda", {"believed": {"camera": {"roll": 30.0}}}, "roll must be within -pi and pi"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(robot, parts, text):
    with pytest.raises(aj.errors.ApproxJacError, match=text) as caught:
        build_scenario(camera(robot, **parts))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("law", ["tracking", "setpoint"])
def test_a_camera_that_is_turned_half_around_is_learnt(law):
    believed = BARE | {"camera": {"roll": 2.6, "focal_factor": 1.3, "depth_factor": 1.5}}
    control = LEARNS | {"law": law}
    built = build_scenario(
        camera("panda", believed=believed, controller=control, task={"points": 2})
    )
    kinematics = built.controller.kinematics if law == "setpoint" else built.law.kinematics
    assert kinematics.unknown == ("tool", "camera", "focal_length")
    assert kinematics.noise == built.scenario.sensor.noise


@pytest.mark.study
def test_points_of_the_world_are_learnt_where_the_camera_is_carried():
    built = build_scenario(camera("ur5", believed=NEARLY, true=IN_HAND, controller=LEARNS))
    assert built.law.kinematics.unknown == ("points", "camera", "focal_length")


@pytest.mark.long
def test_a_camera_that_is_turned_half_around_is_no_obstacle():
    believed = BARE | {"camera": {"roll": 2.6, "focal_factor": 1.3, "depth_factor": 1.5}}
    done = made(believed=believed, controller=LEARNS, run={"seed": 1, "duration": 8.0})
    assert done.converged
    assert done.final_error["px"] < 0.5


def test_a_report_is_of_a_camera_that_may_be_tilted_and_shifted():
    ranges = {"tilt": (0.1, 0.05), "shift": (0.0, 0.02, 0.1), "around": HOME}
    errors = prepare(camera(stability=ranges)).uncertainty
    assert errors.names == ("camera tilt x", "camera tilt y", "camera shift y", "camera shift z")
    assert_array_equal(errors.high, (0.1, 0.05, 0.02, 0.1))
    with pytest.raises(aj.errors.InvalidInputError, match=r"stability\.tilt"):
        prepare(Scenario("panda", stability={"tilt": (0.1, 0.1)}))
