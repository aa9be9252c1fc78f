"""A set-point law on the x̂ that kinematics predict and learn."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.cameras import tag_corners
from approxjac.controllers import KnownKinematics, PredictedMeasurement
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.simulation import InitialState, Sensing
from approxjac.tasks import CombinedTask, TrackerTask
from approxjac.tasks.analysis import seen_configurations

HOME = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


def tracker_far_off(panda, **sensing):
    """A Panda with a 20 cm tool that a tracker looks at, turned by 100° and moved."""
    truth = panda.with_object(0.2, 1.0, axis="x").with_kinematic_error(
        {"panda_joint4": [0.02, 0.01, -0.02], "panda_joint2": [0.0, 0.02, 0.02]}
    )
    sensor = TrackerTask(truth, (0.0, 0.1, np.radians(100.0)), (0.3, -0.2, 0.1))
    noisy = {"x_noise": 1e-3, "x_rate": 60.0, "x_delay": 0.03} | sensing
    return aj.Plant(truth, sensor, sensing=Sensing(**noisy), torque_limits=truth.effort_limits)


def controller_of(panda, wrapped=lambda law: law):
    task = aj.PositionTask(panda)
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(panda))
    return PredictedMeasurement(wrapped(law), aj.AdaptiveKinematics(task, noise=1e-3, delay=0.03))


def run(plant, controller, duration, state=None):
    x_d = plant.sensor.value(HOME) + [0.1, -0.1, 0.1]
    return aj.simulate(
        plant, controller, x_d, InitialState(HOME, None, state), duration, dt=1e-3,
        record_every=0.01, computation=aj.simulation.Computation("semi_implicit_euler"),
    )  # fmt: skip


@pytest.mark.parametrize("axes", ["xyz", "xz"])
def test_with_known_kinematics_it_is_the_law_itself(panda, rng, axes):
    """With x as the believed arm would measure it, at rest and on a path."""
    task = aj.PositionTask(panda, axes=axes)
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(panda))
    predicted = PredictedMeasurement(law, KnownKinematics(task))
    for moves in (False, True):
        q, v = panda.random_configuration(rng), rng.uniform(-0.5, 0.5, 7)
        measurement = aj.Measurement(0.0, q, v, task.value(q))
        target = aj.Target(task.value(q) + 0.1, rng.normal(size=task.m) if moves else None)
        state = law.initial_state(measurement)
        after, wanted = law.step(state, measurement, target, 1e-3)
        found_state, found = predicted.step(state, measurement, target, 1e-3)
        assert_allclose(
            found.torque, wanted.torque, rtol=0, atol=1e-12 * np.abs(wanted.torque).max()
        )
        assert_allclose(found_state, after, atol=1e-12)
        assert_allclose(predicted.learnt(found_state), law.learnt(after), atol=1e-12)
        assert_allclose(found.e, wanted.e, atol=1e-15)


@pytest.mark.study
def test_a_set_point_is_reached_although_the_believed_jacobian_points_elsewhere(panda):
    """By 100° of the tracker, with a tool and origins that are wrong, too."""
    plant = tracker_far_off(panda)
    reached = run(plant, controller_of(panda), 3.0)
    last = reached.error_norm[reached.t > 2.0]
    assert np.sqrt(np.mean(last**2)) < 2e-3
    assert reached.error_norm.max() < 2.0 * reached.error_norm[0]


@pytest.mark.study
def test_within_limits_and_without_x(panda):
    """The torque stays within limits; where x is lost, x̂ goes on."""
    plant = tracker_far_off(panda, x_lost=((1.5, 2.5),))
    limited = controller_of(panda, lambda law: aj.TorqueLimited(law))
    reached = run(plant, limited, 3.0)
    assert (np.abs(reached.tau) <= plant.robot.effort_limits * (1.0 + 1e-9)).all()
    blind = (reached.t > 1.6) & (reached.t < 2.4)
    assert reached.error_norm[blind].max() < 5e-3
    assert set(reached.status[blind]) == {aj.Status.PREDICTED}
    assert (np.abs(reached.v) <= 1.05 * panda.velocity_limits).all()


def test_the_measured_x_moves_nothing_at_once(panda):
    """It teaches the kinematics, for the steps to come: noise is outside the loop."""
    controller = controller_of(panda)
    measurement = aj.Measurement(0.0, HOME, np.zeros(7), np.array([0.3, 0.2, 0.5]), 0.0)
    state = controller.initial_state(measurement)
    target = np.array([0.4, 0.2, 0.5])
    first, a = controller.step(state, measurement, target, 1e-3)
    other, b = controller.step(state, measurement._replace(x=measurement.x + 0.01), target, 1e-3)
    assert np.array_equal(a.torque, b.torque)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize(
    ("elbow", "status"), [(0.0, "NEAR_SINGULAR"), (np.pi, "NEAR_SINGULAR"), (1.1, "PREDICTED")]
)
def test_a_singular_arm_is_named_before_a_lost_x(two_link, elbow, status):
    task, q = aj.PositionTask(two_link, axes="xz"), np.array([0.4, elbow])
    law = aj.SetpointController(task, latency=aj.Latency(period=2e-3))
    predicted, x = PredictedMeasurement(law, KnownKinematics(task)), task.value(q)
    lost = aj.Measurement(0.0, q, np.zeros(2), np.full(2, np.nan))
    state = predicted.initial_state(lost)
    assert predicted.step(state, lost, x, 2e-3)[1].status.name == status


def test_what_does_not_fit_is_refused(panda, two_link):
    task = aj.PositionTask(panda)
    law = aj.SetpointController(task)
    with pytest.raises(InvalidInputError, match="kinematics must be of the controller's task"):
        PredictedMeasurement(law, KnownKinematics(aj.PositionTask(two_link)))
    with pytest.raises(InvalidInputError, match="must be AdaptiveKinematics"):
        PredictedMeasurement(law, None)
    with pytest.raises(InvalidInputError, match="build a new controller"):
        PredictedMeasurement(law, KnownKinematics(task)).with_task(task)


@pytest.mark.parametrize("law", ["set-point law", "tracking law"])
def test_what_makes_no_sense_has_an_error_with_a_name(panda, law):
    controller = controller_of(panda)
    if law == "tracking law":
        controller = aj.TrackingController(controller.task, kinematics=controller.kinematics)
    x = controller.task.value(HOME)
    good = aj.Measurement(0.0, HOME, np.zeros(7), x, 0.0)
    state = controller.initial_state(good)
    for wrong in ({"x": x[:2]}, {"q": HOME[:2]}, {"v": HOME[:2]}):
        with pytest.raises(InvalidInputError, match="must be an array of shape"):
            controller.initial_state(good._replace(**wrong))
        with pytest.raises(InvalidInputError, match="must be an array of shape"):
            controller.step(state, good._replace(**wrong), x, 1e-3)
    for lost in ({"q": np.nan * HOME}, {"v": np.full(7, np.inf)}):
        with pytest.raises(MeasurementError, match="stop the robot"):
            controller.step(state, good._replace(**lost), x, 1e-3)
    for target in (aj.Target(x, x[:2]), aj.Target(x, None, x[:2]), aj.Target(x, x, np.nan * x)):
        with pytest.raises(InvalidInputError, match="of the target must"):
            controller.step(state, good, target, 1e-3)
    for other in (state[:-1], np.append(state, 0.0), np.nan * state):
        with pytest.raises(InvalidInputError, match="state must"):
            controller.resumed(other, good)
        with pytest.raises(InvalidInputError, match="state must"):
            controller.step(other, good, x, 1e-3)


@pytest.mark.parametrize("wrapped", [lambda law: law, aj.TorqueLimited])
def test_a_run_that_goes_on_has_learnt_gravity_and_kinematics(panda, wrapped, rng):
    """And nothing else of the run before, as if it were the first one."""
    controller = controller_of(panda, wrapped)
    x = controller.task.value(HOME)
    first = aj.Measurement(0.0, HOME, np.zeros(7), x, 0.0)
    state, target = controller.initial_state(first), x + 0.1
    for k in range(1, 40):
        q = HOME + 0.02 * k * rng.uniform(-0.5, 0.5, 7)
        seen = aj.Measurement(1e-3 * k, q, np.zeros(7), controller.task.value(q) + 0.05, 1e-3 * k)
        state, _ = controller.step(state, seen, target, 1e-3)
    fresh, again = controller.initial_state(first), controller.resumed(state, first)
    p = controller.controller.learnt(state[: controller.controller.size]).size
    assert np.abs(controller.learnt(state) - controller.learnt(fresh))[:p].max() > 1e-3
    assert_allclose(controller.learnt(again)[:p], controller.learnt(state)[:p], atol=1e-12)
    size = controller.controller.size
    assert_allclose(again[p:size], fresh[p:size], atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("law", ["set-point law", "tracking law"])
def test_the_next_run_begins_with_what_was_learnt(panda, law):
    """A tracker turned by 100° is learnt once; the next target is reached straight away."""
    plant = tracker_far_off(panda)
    controller = controller_of(panda)
    if law == "tracking law":
        controller = aj.TrackingController(controller.task, kinematics=controller.kinematics)
    before = run(plant, controller, 2.5)
    state = controller.resumed(before.state[-1], plant.measure(0.0, HOME, np.zeros(7)))
    again = run(plant, controller, 1.5, state=state)
    assert_allclose(
        controller.kinematics_learnt(state).covariance,
        controller.kinematics_learnt(before.state[-1]).covariance,
    )
    for each in (before, again):
        assert each.error_norm[0] > 0.15
    path = [np.abs(np.diff(each.x[each.t <= 1.5], axis=0)).sum() for each in (before, again)]
    assert path[1] < 0.85 * path[0], path  # no detour
    assert again.error_norm[-1] < 3e-3


def test_a_combined_task_follows_a_target_of_what_is_measured(panda):
    """As the law itself does where the believed arm is the true one: ẋ_d is that of the image."""
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.3), (1.6, 0.2, 0.8), 600.0, (640, 480))
    image = aj.ImageTask(panda, camera, points=tag_corners(0.1))
    (q,) = seen_configurations(image, 1)
    x = image.value(q)
    law = aj.SetpointController(CombinedTask.balanced(image, x))
    predicted = PredictedMeasurement(law, KnownKinematics(law.task))
    now = aj.Measurement(0.0, q, np.linspace(-0.1, 0.1, panda.nv), x)
    target = aj.Target(x + 5.0, np.linspace(-20.0, 30.0, image.m))
    torques = [
        each.step(each.initial_state(now), now, target, 1e-3)[1].torque for each in (law, predicted)
    ]
    assert_allclose(*torques, rtol=1e-9)
