"""Kinematics that learn wait for a first frame that says where x is, and say what they wait for."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.controllers import AdaptiveCamera, AdaptiveKinematics, PredictedMeasurement
from approxjac.simulation import VelocityServo
from approxjac.tasks import PoseTrackerTask, TrackerTask

START, DT = np.array([0.0, -1.2, 1.6, -1.9, -1.57, 0.0]), 1e-3
WITHOUT_X = np.full(3, np.nan)


@pytest.fixture(scope="module")
def task():
    return aj.PositionTask(aj.load_robot("ur5"))


def law_of(task, kind, **arguments):
    """Return a law with kinematics that learn."""
    kinematics = AdaptiveKinematics(task, **arguments)
    if kind == "set-point":
        law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(task.robot))
        return PredictedMeasurement(law, kinematics)
    return aj.TrackingController(task, kinematics=kinematics, command=kind)


@pytest.mark.parametrize(
    "kind",
    ["torque", *(pytest.param(k, marks=pytest.mark.study) for k in ("velocity", "set-point"))],
)
def test_the_arm_waits_for_the_first_x_and_then_begins_as_if_it_had_been_there(task, kind):
    """Of a tracker two metres off, whose x is lost for 0.1 s, with the target where the arm is."""
    truth = task.robot.with_object(0.2, 0.5, axis="y")
    tracker = TrackerTask(truth, offset=(2.0, 1.0, 0.0))
    sensing = aj.Sensing(x_noise=2e-3, x_rate=60.0, x_delay=0.03, x_lost=[(0.0, 0.1)])
    moves = {"torque_limits": truth.effort_limits}
    if kind == "velocity":
        moves = {"servo": VelocityServo(lag=0.03, delay=0.008, period=0.008)}
    plant = aj.Plant(truth, tracker, sensing=sensing, **moves)
    law = law_of(task, kind, noise=2e-3, delay=0.03)
    run = aj.simulate(plant, law, tracker.value(START), START, duration=1.0, dt=DT)
    waits = run.t < 0.13
    assert set(run.status[waits]) == {aj.Status.MEASUREMENT_LOST}
    assert aj.Status.MEASUREMENT_LOST not in run.status[~waits][2:]
    assert run.error_norm[waits].max() < 3e-3
    assert run.error_norm.max() < 40e-3


@pytest.mark.parametrize("kind", ["torque", "set-point"])
def test_a_first_x_that_comes_late_begins_the_same_state(task, kind):
    law, x = law_of(task, kind), task.value(START) + [2.0, 1.0, 0.0]
    ends = []
    for first in (x, WITHOUT_X):
        state = law.initial_state(aj.Measurement(0.0, START, np.zeros(6), first))
        for k in range(1, 4):
            measurement = aj.Measurement(k * DT, START, np.zeros(6), x)
            state, answer = law.step(state, measurement, x + 0.01, DT)
        ends.append(answer)
    there, late = ends
    assert there.status is late.status is aj.Status.OK
    assert_array_equal(late.J_hat, there.J_hat)
    if kind == "torque":
        assert_allclose(late.reference, there.reference, atol=1e-12)


def test_a_pose_begins_with_the_first_orientation_that_is_seen(task):
    sensor = PoseTrackerTask(task.robot, rotation=(0.0, 0.0, 2.0), offset=(1.0, 0.0, 0.0))
    kinematics = AdaptiveKinematics(aj.PoseTask(task.robot))
    x = sensor.value(START)
    target = aj.Target(x)
    state = kinematics.initial_state(aj.Measurement(0.0, START, np.zeros(6), np.nan * x))
    for k, part in enumerate(([0, 1, 2], [3, 4, 5, 6])):
        measurement = aj.Measurement(0.02 * (k + 1), START, np.zeros(6), np.full(7, np.nan))
        assert kinematics.status(state, measurement) is aj.Status.MEASUREMENT_LOST
        measurement.x[part] = x[part]
        state = kinematics.step(state, measurement, 0.02)
    assert kinematics.status(state, measurement) is aj.Status.OK
    # all but what was learnt meanwhile, which is eased in
    assert np.abs(kinematics.predict(state, START, np.zeros(6), target).z).max() < 0.02


def test_a_camera_is_placed_where_it_sees_the_first_x(task):
    robot = task.robot
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))
    images = aj.ImageTask(robot, camera)
    law = aj.TrackingController(images, kinematics=AdaptiveCamera(images))
    x, ends = images.value(START) + [40.0, -30.0], []
    for first in (x, np.full(2, np.nan)):
        state = law.initial_state(aj.Measurement(0.0, START, np.zeros(6), first))
        for k in range(1, 4):
            measurement = aj.Measurement(k * DT, START, np.zeros(6), x, k * DT)
            state, answer = law.step(state, measurement, x + 5.0, DT)
            if k == 1 and first is not x:
                assert answer.status is aj.Status.MEASUREMENT_LOST
                assert_array_equal(answer.reference, 0.0)
        ends.append(answer)
    assert_allclose(ends[1].reference, ends[0].reference, rtol=1e-3, atol=1e-5)


def test_a_state_that_is_gone_on_with_knows_what_it_saw(task):
    law, x = law_of(task, "torque"), task.value(START) + 1.0
    lost, seen = (aj.Measurement(0.0, START, np.zeros(6), each) for each in (WITHOUT_X, x))
    state = law.initial_state(lost)
    assert law.step(law.resumed(state, lost), lost, x, DT)[1].status is aj.Status.MEASUREMENT_LOST
    state, _ = law.step(state, seen, x, DT)
    assert law.step(law.resumed(state, lost), lost, x, DT)[1].status is aj.Status.PREDICTED


# -- clocks ------------------------------------------------------------------------------------


def led(kinematics, clock, clock_of_x, seconds=3.0):
    """Return the state, status and largest error of x̂ late, of an arm that is moved about."""
    sensor, state = aj.PositionTask(kinematics.task.robot.with_object(0.2, axis="y")), None
    q, seen = START.copy(), {}
    for k in range(round(seconds / DT)):
        t, v = k * DT, 0.3 * np.sin(0.9 * k * DT * np.arange(1, 7))
        seen[k] = sensor.value(q)
        taken = max(k - k % 16 - 32, 0)
        t_x = clock_of_x(taken * DT)
        measurement = aj.Measurement(clock(t), q, v, seen[taken], t_x)
        state = kinematics.initial_state(measurement) if state is None else state
        state = kinematics.step(state, measurement, DT)
        q = q + DT * v
    away = kinematics.predict(state, q, v, aj.Target(sensor.value(q))).z
    return state, kinematics.status(state, measurement), np.linalg.norm(away)


@pytest.mark.parametrize(
    ("clock", "clock_of_x"),
    [
        (lambda t: t, lambda t: t - 1.0),
        (lambda t: t + 1.7e9, lambda t: t),
        (lambda t: 1e3 * t, lambda t: 1e3 * t),
    ],
    ids=["a second behind", "another one", "milliseconds"],
)
def test_frames_that_are_all_too_old_are_said_to_teach_nothing(task, clock, clock_of_x):
    kinematics = AdaptiveKinematics(task, ("tool", "origins"), delay=0.03)
    state, status, _ = led(kinematics, clock, clock_of_x, 1.5)
    assert status in (aj.Status.MEASUREMENT_LOST, aj.Status.PREDICTED)
    report = kinematics.report(state)
    assert not report.is_explained
    assert "no frame to learn from" in str(report)


def test_a_clock_of_x_that_is_another_one_is_refused(task):
    seen = aj.Measurement(0.0, START, np.zeros(6), task.value(START), 1.7e9)
    for law in (law_of(task, "torque"), law_of(task, "set-point")):
        with pytest.raises(aj.InvalidInputError, match=r"x was taken 1.7e\+09 s after t: two cl"):
            law.step(law.initial_state(seen), seen, seen.x, DT)


@pytest.mark.study
def test_frames_that_become_too_old_are_said_to_teach_nothing_any_more(task):
    law = law_of(task, "torque", delay=0.03)
    x, state, said = task.value(START), None, []
    for k in range(1700):
        t_x = k * DT - (0.03 if k < 200 else 0.8)
        measurement = aj.Measurement(k * DT, START, np.zeros(6), x + 1e-4 * math.sin(k), t_x)
        state = law.initial_state(measurement) if state is None else state
        state, answer = law.step(state, measurement, x, DT)
        said.append(answer.status)
    assert set(said[:1100]) == {aj.Status.OK}
    assert set(said[1300:]) == {aj.Status.PREDICTED}
    assert "no frame to learn from for the last 1.5 s" in str(law.kinematics_learnt(state))


@pytest.mark.parametrize(
    ("clock", "clock_of_x"),
    [
        (lambda _: 0.0, lambda _: None),
        pytest.param(lambda _: 0.0, lambda t: t, marks=pytest.mark.study),
        pytest.param(
            lambda t: 0.016 * (t // 0.016),
            lambda t: 0.016 * (t // 0.016),
            marks=pytest.mark.study,
        ),
    ],
    ids=["none at all", "only of x", "coarse"],
)
def test_a_clock_that_stands_still_is_gone_on_with_by_dt(task, clock, clock_of_x):
    kinematics = AdaptiveKinematics(task, ("tool", "origins"), delay=0.032)
    state, status, away = led(kinematics, clock, clock_of_x)
    right = led(kinematics, lambda t: t, lambda t: t)
    assert status is right[1] is aj.Status.OK
    assert right[2] < 1e-3
    assert away < 5e-3
    assert kinematics.report(state).is_explained


@pytest.mark.parametrize("t_x", [np.nan, np.inf, "now"])
def test_a_time_of_x_that_is_none_is_refused(task, t_x):
    measurement = aj.Measurement(0.0, START, np.zeros(6), task.value(START))
    for kind in ("torque", "set-point"):
        law = law_of(task, kind)
        state = law.initial_state(measurement)
        with pytest.raises(aj.errors.InvalidInputError, match="t_x of a measurement"):
            law.step(state, measurement._replace(t_x=t_x), measurement.x, DT)


@pytest.mark.parametrize(("t_x", "status"), [(None, "OK"), (0.0, "PREDICTED")])
def test_an_x_that_stays_is_old_only_if_its_time_says_so(t_x, status):
    """Of an arm at rest an ideal sensor gives the same x again and again."""
    arm, dt = aj.load_robot("ur3"), 5e-3
    task, q = aj.PositionTask(arm), next(arm.configurations(1))
    kinematics = AdaptiveKinematics(task, ("tool",), dt=dt)
    now = aj.Measurement(0.0, q, np.zeros(6), task.value(q), t_x)
    state = kinematics.initial_state(now)
    for k in range(300):
        now = now._replace(t=k * dt)
        state = kinematics.step(state, now, dt)
        if k * dt < 0.9:
            assert kinematics.status(state, now).name == "OK"
    assert kinematics.status(state, now).name == status
