"""States that know what was learnt: of the same controller, also within torque limits."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.controllers import (
    AdaptiveCamera,
    AdaptiveKinematics,
    HeldMeasurement,
    Limits,
    PredictedMeasurement,
    TorqueLimited,
)
from approxjac.errors import InvalidInputError
from approxjac.tasks import ImageTask

CAMERA = aj.PinholeCamera.looking_at(
    (0.4, 0.1, 0.3), (1.5, -0.8, 0.9), focal_length=600.0, size=(640, 480)
)
HOME = np.array([0.0, -1.2, 1.5, -1.0, -1.5, 0.0])


@pytest.fixture(scope="module")
def task():
    return aj.PositionTask(aj.load_robot("ur5"), "tool0")


def at_home(task, x=None):
    return aj.Measurement(0.0, HOME, np.zeros(6), task.value(HOME) if x is None else x)


def wrong(state):
    return {
        "shorter": state[:-50],
        "longer": np.append(state, np.zeros(5)),
        "three": np.zeros(3),
        "zeros": 0.0 * state,
        "NaN": np.nan * state,
        "none": None,
    }


@pytest.mark.parametrize("kind", ["tracking law", "within limits", "set-point law"])
def test_a_state_of_another_controller_is_refused(task, kind):
    if kind == "set-point law":
        controller = PredictedMeasurement(aj.SetpointController(task), AdaptiveKinematics(task))
    else:
        controller = aj.TrackingController(task)
    if kind == "within limits":
        controller = TorqueLimited(controller)
    here = at_home(task)
    state = controller.initial_state(here)
    told = AdaptiveKinematics(task, unknown=("tool",))
    other = aj.TrackingController(task, kinematics=told).initial_state(here)
    for name, each in (wrong(state) | {"another": other}).items():
        for use in (
            lambda each: controller.resumed(each, here),
            controller.kinematics_learnt,
            controller.learnt_robot,
        ):
            with pytest.raises(InvalidInputError, match=r"^state must"):
                pytest.fail(f"{name}: {use(each)}")


def test_kinematics_refuse_what_is_no_state_of_theirs(task, two_link):
    image = ImageTask(task.robot, CAMERA, "tool0")
    planar = ImageTask(two_link, PlanarCamera(0.1, 4.0))
    for kinematics in (
        AdaptiveKinematics(task),
        AdaptiveKinematics(task, unknown=("tool", "offset")),
        AdaptiveCamera(image),
        AdaptiveKinematics(planar),
    ):
        of = kinematics.task
        q = HOME[: of.robot.nv]
        here = aj.Measurement(0.0, q, 0.0 * q, of.value(q))
        state = kinematics.initial_state(here)
        kinematics.robot(state), kinematics.report(state)
        kinematics.resumed(state, here)
        for name, each in wrong(state).items():
            match = "as initial_state and step return it" if name == "zeros" else "state must"
            for use in (kinematics.report, kinematics.robot):
                with pytest.raises(InvalidInputError, match=match):
                    pytest.fail(f"{kinematics}, {name}: {use(each)}")
            with pytest.raises(InvalidInputError, match=match):
                kinematics.resumed(each, here)


def test_an_error_counts_the_numbers_that_are_wrong_where_they_are_many(task):
    controller = aj.TrackingController(task)
    state = controller.initial_state(at_home(task))
    state[:7] = np.nan
    with pytest.raises(InvalidInputError, match=rf"got 7 of {controller.size} that are not$"):
        controller.kinematics_learnt(state)


def test_a_limiter_resumes_what_the_law_inside_learnt(task):
    truth = task.robot.with_object(0.15, 1.0)
    plant = aj.Plant(truth, aj.PositionTask(truth, "tool0"))
    limits = replace(Limits.of(task.robot), rate=5000.0)
    controller = TorqueLimited(aj.TrackingController(task), limits)
    x_d = plant.sensor.value(HOME) + [0.0, 0.0, 0.05]
    run = aj.simulate(plant, controller, x_d, HOME, 0.1, dt=1e-3)
    here = plant.measure(0.0, HOME, np.zeros(6))
    start = controller.resumed(run.state[-1], here)
    fresh = controller.initial_state(here)
    assert start.shape == fresh.shape
    assert not np.array_equal(start, fresh)
    inside, far = controller.controller, here.x + [0.5, 0.0, 0.0]  # the law asks for a lot
    hold = inside.gravity_torque(start[: inside.n_state], HOME)  # as it was learnt
    answer = controller.step(start, here, far, 1e-3)[1]
    assert_allclose(answer.gravity, hold, atol=0.5)
    assert_allclose(np.abs(answer.torque - hold).max(), 5.0)
    learnt = inside.kinematics_learnt(run.state[-1][: inside.size])
    assert_array_equal(controller.kinematics_learnt(run.state[-1]).covariance, learnt.covariance)
    assert_array_equal(controller.kinematics_learnt(start).covariance, learnt.covariance)
    assert controller.learnt_robot(start) == controller.learnt_robot(run.state[-1])
    after = aj.simulate(
        plant, controller, x_d, aj.simulation.InitialState(HOME, state=start), 0.01, dt=1e-3
    )
    assert np.isfinite(after.tau).all()


def test_a_wrapper_hands_on_what_the_law_inside_learnt(task):
    inside = PredictedMeasurement(aj.SetpointController(task), AdaptiveKinematics(task))
    controller, here = HeldMeasurement(inside, unseen=0.1), at_home(task)
    state = controller.initial_state(here)
    assert_array_equal(controller.resumed(state, here), state)
    assert len(controller.kinematics_learnt(state).rows) == len(inside.kinematics.names)


def test_a_limiter_around_a_law_that_learns_no_kinematics_says_so(task):
    controller, here = TorqueLimited(aj.SetpointController(task)), at_home(task)
    state = controller.initial_state(here)
    for use in (controller.kinematics_learnt, controller.learnt_robot):
        with pytest.raises(InvalidInputError, match="controller must learn kinematics"):
            use(state)
    assert_array_equal(controller.resumed(state, here), state)


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"delay": 30}, r"delay must be a finite number >= 0 and <= 1 \[s\], got 30"),
        ({"noise": 2}, r"noise must be a finite number > 0 and <= 0\.37\d* \[m\], got 2"),
        ({"angle_noise": 3}, r"angle_noise must .* <= 1 \[rad\], got 3"),
        ({"unknown": ("tool",), "sd": {"camera": 0.1}}, "unknown parameters, tool, got"),
        ({"unknown": "tool", "sd": {"orientation": 0.1}}, "got one of orientation"),
        ({"unknown": "tool", "sd": {"offset": 0.1}}, "got one of offset"),
    ],
)
def test_numbers_in_other_units_or_without_effect_are_refused(task, given, match):
    with pytest.raises(InvalidInputError, match=match):
        AdaptiveKinematics(task, **given)


def test_sd_of_what_is_unknown_by_another_name_is_taken(task):
    AdaptiveKinematics(task, unknown="camera", sd={"offset": 0.1, "camera": 2.0})
    AdaptiveKinematics(aj.PoseTask(task.robot, "tool0"), unknown="tool", sd={"orientation": 0.1})
    image = ImageTask(task.robot, CAMERA, "tool0")
    AdaptiveCamera(image, "camera", sd={"position": 0.1, "rotation": 0.1})
    for given in ({"delay": 30}, {"unknown": "tool", "sd": {"position": 0.1}}):
        with pytest.raises(InvalidInputError, match=r"delay must|sd must"):
            AdaptiveCamera(image, **given)


def test_equal_robots_are_one_and_others_are_said_to_be(task):
    same = aj.PositionTask(aj.load_robot("ur5"), "tool0")
    assert same.robot is not task.robot
    PredictedMeasurement(aj.SetpointController(same), AdaptiveKinematics(task))
    wrist = aj.PositionTask(task.robot, "wrist_3_link")
    with pytest.raises(InvalidInputError, match=r"'wrist_3_link'.* got .*'tool0', 'xyz'\)"):
        PredictedMeasurement(aj.SetpointController(wrist), AdaptiveKinematics(task))
    heavier = aj.PositionTask(task.robot.with_object(0.1, 1.0, parent="tool0"), "tool0")
    with pytest.raises(InvalidInputError, match="with its URDF and gravity"):
        PredictedMeasurement(aj.SetpointController(heavier), AdaptiveKinematics(task))
