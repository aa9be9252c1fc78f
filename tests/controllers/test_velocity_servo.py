"""`VelocityServo`: its formula, its decay, its limits and what it does without a measurement."""

import copy
import functools
import pickle

import numpy as np
import pinocchio as pin
import pytest
import test_fuzz as fuzz
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac import law

START = fuzz.START
EMPTY = np.zeros(0)
SAMPLED = {"dt": 1e-3, "integrator": "semi_implicit_euler"}


@functools.cache
def controllers():
    panda, kinova = aj.load_robot("panda"), aj.load_robot("kinova")
    task, regressor = aj.PositionTask(panda), aj.GravityRegressor(panda)
    two_link = aj.load_robot("two_link").with_object(0.5, 0.5, radius=0.0, axis="x")
    slider = fuzz.prismatic_arm()
    two = aj.StackedTask(
        aj.PositionTask(panda, axes="xz"), aj.PositionTask(panda, "panda_link4", axes="y")
    )
    return {
        "panda": aj.VelocityServo(task),
        "panda, fast": aj.VelocityServo(task, 10.0, inner_bandwidth=200.0),
        "panda, saturated": aj.VelocityServo(task, saturation=aj.Tanh((0.05, 0.1, 0.2))),
        "panda, no gravity": aj.VelocityServo(task, gravity=aj.NoGravity(panda)),
        "panda, theta": aj.VelocityServo(
            task, gravity=aj.RegressorGravity(regressor, 1.1 * regressor.theta)
        ),
        "panda, pose": aj.VelocityServo(aj.PoseTask(panda)),
        "panda, stacked": aj.VelocityServo(two),
        "panda, coupled fingers": aj.VelocityServo(
            aj.PositionTask(aj.load_robot("panda", free="all"))
        ),
        "kinova": aj.VelocityServo(aj.PositionTask(kinova)),
        "two_link, camera": aj.VelocityServo(
            aj.ImageTask(two_link, aj.PlanarCamera(0.05, 3.0, 0.3))
        ),
        "slider": aj.VelocityServo(aj.PositionTask(slider, axes="xy")),
    }


NAMES = (
    "panda", "panda, fast", "panda, saturated", "panda, no gravity", "panda, theta", "panda, pose",
    "panda, stacked", "panda, coupled fingers", "kinova", "two_link, camera", "slider",
)  # fmt: skip


@pytest.fixture(params=NAMES)
def controller(request):
    return controllers()[request.param]


def regular_posture(task, rng):
    """A posture at which Ĵ⁺ is not damped."""
    while True:
        q = task.robot.random_configuration(rng)
        values = np.linalg.svd(task.jacobian(q), compute_uv=False)
        if values[-1] > 0.05 * values[0]:
            return q


def answer_to(controller, q, v, x, target):
    return controller.evaluate(EMPTY, aj.Measurement(0.0, q, v, x), target)


def test_every_controller_is_tested():
    assert tuple(controllers()) == NAMES


def test_the_torque_is_the_formula(controller, rng):
    task = controller.task
    for _ in range(3):
        q, v = regular_posture(task, rng), rng.normal(size=task.robot.nv)
        target = task.value(q)
        x = task.displaced(target, 0.1 * rng.normal(size=task.m))
        answer = answer_to(controller, q, v, x, target)
        J, s = task.jacobian(q), controller.saturation.s(task.error(x, target))
        reference = -controller.rate * np.linalg.pinv(J) @ s
        reference /= max(1.0, np.abs(reference / task.robot.velocity_limits).max())
        dynamics, g = aj.Dynamics(task.robot), np.array(controller.gravity.torque(q))
        wanted = controller.inner_bandwidth * (reference - v)
        expected = dynamics.M(q) @ wanted + dynamics.coriolis(q, v) + g
        assert_allclose(answer.torque, expected, rtol=1e-9, atol=1e-9)
        assert_allclose(controller.velocity_reference(answer), reference)
        assert answer.status is aj.Status.OK
        assert_array_equal(answer.J_hat, J)
        assert_allclose(controller.gravity_torque(EMPTY, q), g)
    assert answer.state_rate.size == 0
    assert controller.initial_state(aj.Measurement(0.0, q, v, x)).shape == (0,)


# -- the references -------------------------------------------------------------------------


def test_no_reference_is_beyond_a_speed_limit_and_its_direction_is_kept(rng):
    controller = controllers()["panda"]
    task, limits = controller.task, controller.velocity_limits
    assert_array_equal(limits, task.robot.velocity_limits)
    limited = 0
    for _ in range(200):
        q, x = task.robot.random_configuration(rng), rng.normal(size=3)
        J = task.jacobian(q)
        answer = answer_to(controller, q, np.zeros(7), x, np.zeros(3))
        reference = controller.velocity_reference(answer)
        assert (np.abs(reference) <= limits * (1.0 + 1e-12)).all()
        asked, _ = law.velocity_reference(J, x, controller.rate, controller._scale)
        share = np.abs(asked / limits).max()
        limited += share > 1.0
        assert_allclose(reference * max(share, 1.0), asked)
    assert limited > 50


def stretched_out(angle):
    """A two-link arm whose elbow is bent by `angle`: singular at zero."""
    return np.array([0.4, angle])


def test_near_a_singular_pose_the_reference_is_bounded_and_continuous():
    arm = aj.load_robot("two_link")
    task = aj.PositionTask(arm, axes="xz")
    controller = aj.VelocityServo(task)  # its URDF has no velocity limits
    assert np.isinf(controller.velocity_limits).all()
    e = np.array([0.3, -0.2])
    angles = np.linspace(-0.2, 0.2, 2001)
    references, statuses = [], set()
    for angle in angles:
        q = stretched_out(angle)
        answer = answer_to(controller, q, np.zeros(2), e, np.zeros(2))
        references.append(controller.velocity_reference(answer))
        statuses.add(answer.status)
        sigma_max = np.linalg.norm(task.jacobian(q), 2)
        most = controller.rate * np.linalg.norm(e) / (law.SINGULAR_RATIO * sigma_max)
        assert np.linalg.norm(references[-1]) <= 1.001 * most
    assert statuses == {aj.Status.OK, aj.Status.NEAR_SINGULAR}
    steps = np.linalg.norm(np.diff(references, axis=0), axis=1)
    largest = np.linalg.norm(references, axis=1).max()
    assert steps.max() < 0.02 * largest  # of 2000 steps: no jump where damping sets in
    still = answer_to(controller, stretched_out(0.0), np.zeros(2), e, np.zeros(2))
    assert still.status is aj.Status.NEAR_SINGULAR
    assert np.isfinite(still.torque).all()


# -- the loop -------------------------------------------------------------------------------


def second_order(rate, bandwidth, t):
    """Share of e that ë = ω(−λe − ė) leaves after t, from rest."""
    fast, slow = np.roots([1.0, bandwidth, bandwidth * rate])
    return (fast * np.exp(slow * t) - slow * np.exp(fast * t)) / (fast - slow)


@pytest.mark.parametrize("name", ["panda", "panda, fast"])
def test_with_the_exact_model_the_error_decays_as_it_should(name, rng):
    """As the second-order loop says to 1 %, with every coordinate's direction kept."""
    controller = controllers()[name]
    task = controller.task
    rate, bandwidth = controller.rate, controller.inner_bandwidth
    target = task.value(START) + 0.02 * rng.normal(size=3)
    run = aj.simulate(aj.Plant(task.robot, task), controller, target, START, 4.0 / rate, dt=None)
    share = run.error / run.error[0]
    expected = second_order(rate, bandwidth, run.t)
    assert_allclose(share, np.broadcast_to(expected[:, np.newaxis], share.shape), atol=0.01)


def test_with_a_quick_inner_loop_the_error_decays_like_exp_minus_rate_t():
    task = controllers()["panda"].task
    controller = aj.VelocityServo(task, 4.0, inner_bandwidth=1000.0)
    target = task.value(START) + np.array([0.03, -0.02, 0.03])
    run = aj.simulate(aj.Plant(task.robot, task), controller, target, START, 1.5, dt=None)
    assert_allclose(run.error_norm / run.error_norm[0], np.exp(-4.0 * run.t), atol=0.005)


@pytest.mark.parametrize("seed", [0])
@pytest.mark.parametrize("name", ["panda", "two_link"])
def test_it_reaches_the_target_with_a_tool_that_it_does_not_know_of(name, seed):
    rng = np.random.default_rng(seed)
    axes, goal = ("xz", np.array([0.6, 1.2])) if name == "two_link" else ("xyz", START)
    robot = aj.load_robot(name)
    truth, belief = robot.with_object(0.15, axis="xz"[name == "panda"]), robot.with_object(0.0)
    controller = aj.VelocityServo(aj.PositionTask(belief, axes=axes))
    plant = aj.Plant(truth, aj.PositionTask(truth, axes=axes))
    q0 = goal + rng.uniform(-0.3, 0.3, truth.nv)
    run = aj.simulate(plant, controller, plant.sensor.value(goal), q0, 3.0, **SAMPLED)
    assert run.error_norm[0] > 0.02
    assert run.error_norm[-1] < 0.001 * run.error_norm[0]
    assert run.error_norm[1000] < 0.05 * run.error_norm[0]  # about as soon as with a right model


def test_an_image_with_a_camera_that_is_turned():
    robot = aj.load_robot("two_link").with_object(0.5, 0.5, radius=0.0, axis="x")
    believed, true = (aj.PlanarCamera(0.05, 3.0, roll) for roll in (np.radians(40.0), 0.0))
    controller = aj.VelocityServo(aj.ImageTask(robot, believed))
    plant = aj.Plant(robot, aj.ImageTask(robot, true))
    target = plant.sensor.value(np.array([0.6, 1.2]))
    run = aj.simulate(plant, controller, target, (0.4, 1.5), 4.0, **SAMPLED)
    assert run.error_norm[-1] < 1e-3 * run.error_norm[0]


def test_gravity_that_it_does_not_know_leaves_an_error():
    """ĴM̂⁻¹(g − ĝ)/(ωλ) to sign, the docs' estimate; there is no integral."""
    robot = aj.load_robot("two_link")
    truth, belief = robot.with_object(0.2, 0.5, axis="x"), robot.with_object(0.2, 0.0, axis="x")
    task = aj.PositionTask(belief, axes="xz")
    controller = aj.VelocityServo(task, 4.0)
    plant = aj.Plant(truth, aj.PositionTask(truth, axes="xz"))
    target = plant.sensor.value(np.array([0.6, 1.2]))
    run = aj.simulate(plant, controller, target, (0.5, 1.3), 6.0, **SAMPLED)
    q, dynamics = run.q[-1], aj.Dynamics(belief)
    unknown = aj.Dynamics(truth).g(q) - dynamics.g(q)
    expected = -task.jacobian(q) @ np.linalg.solve(dynamics.M(q), unknown) / (50.0 * 4.0)
    assert np.linalg.norm(expected) > 1e-3
    assert_allclose(run.error[-1], expected, rtol=1e-3)


def test_the_believed_robot_is_all_it_knows(panda, rng):
    """The torque has the same bits whatever the true robot is: it never sees it."""
    controller = controllers()["panda"]
    q, v = regular_posture(controller.task, rng), rng.normal(size=7)
    measured = aj.Plant(panda, controller.task).measure(0.0, q, v)
    torque = controller.evaluate(EMPTY, measured, np.zeros(3)).torque.copy()
    other = panda.with_object(0.3, 1.0)
    elsewhere = aj.Plant(other, aj.PositionTask(other)).measure(0.0, q, v)
    again = controller.evaluate(EMPTY, elsewhere._replace(x=measured.x), np.zeros(3))
    assert_array_equal(again.torque, torque)


# -- what comes in is bad -------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_without_a_measurement_the_arm_is_told_to_stop(controller, value, rng):
    task = controller.task
    q, v = regular_posture(task, rng), rng.normal(size=task.robot.nv)
    answer = answer_to(controller, q, v, np.full(task.n_x, value), task.value(q))
    assert answer.status is aj.Status.MEASUREMENT_LOST
    dynamics = aj.Dynamics(task.robot)
    brakes = dynamics.M(q) @ (-controller.inner_bandwidth * v) + dynamics.coriolis(q, v)
    assert_allclose(answer.torque, brakes + controller.gravity.torque(q), rtol=1e-9, atol=1e-9)
    assert_array_equal(controller.velocity_reference(answer), np.zeros(task.robot.nv))


def test_a_lost_measurement_brings_the_arm_to_rest(panda, rng):
    controller = controllers()["panda"]
    plant, v = aj.Plant(panda, controller.task), 0.5 * rng.normal(size=7)
    q, lost = START.copy(), np.full(3, np.nan)
    for k in range(500):
        measured = aj.Measurement(1e-3 * k, q, v, lost)
        torque = controller.evaluate(EMPTY, measured, np.zeros(3)).torque
        v = v + 1e-3 * plant.acceleration(q, v, torque)
        q = q + 1e-3 * v
    assert np.abs(v).max() < 1e-8
    assert np.abs(q - START).max() < 0.05  # |v|/ω


FUZZ = settings(
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@pytest.mark.parametrize("name", NAMES)
@FUZZ
@given(data=st.data())
def test_any_numbers_give_a_finite_torque_or_a_named_error(name, data):
    controller = controllers()[name]
    state, measurement, target = data.draw(fuzz.arguments(controller))
    kept = [np.copy(a) for a in (*measurement[1:], target)]
    answer = fuzz.checked(controller, state, measurement, target)
    for before, after in zip(kept, (*measurement[1:], target), strict=True):
        assert_array_equal(before, after)
    if answer is None:
        return
    assert np.isfinite(np.concatenate([measurement.q, measurement.v, target])).all()
    reference = controller.velocity_reference(answer)
    assert (np.abs(reference) <= controller.velocity_limits * (1.0 + 1e-12)).all()
    if not np.isfinite(measurement.x).all():
        assert answer.status is aj.Status.MEASUREMENT_LOST


@FUZZ
@given(data=st.data())
def test_wrong_types_and_shapes_are_named_errors(data):
    controller = controllers()["panda"]
    q = controller.task.robot.neutral()
    x = controller.task.value(q)
    good = {"q": q, "v": np.zeros(7), "x": x, "target": x}
    name = data.draw(st.sampled_from(["q", "v", "x", "target"]))
    good[name] = data.draw(fuzz.junk(good[name].size))
    with pytest.raises(aj.ApproxJacError, match="must be"):
        answer_to(controller, *good.values())


# -- with limits ----------------------------------------------------------------------------


def test_it_is_limited_without_a_proof(panda):
    servo = controllers()["panda"]
    with pytest.raises(aj.InvalidInputError, match="proof must be False for VelocityServo"):
        aj.TorqueLimited(servo)
    plant = aj.Plant(panda, servo.task)
    target = servo.task.value(START) + [0.1, 0.3, 0.1]
    limits = aj.Limits(effort=0.5 * panda.effort_limits)
    for limited in (
        aj.TorqueLimited(servo, limits, proof=False),
        aj.TorqueClipped(servo, limits),
        aj.TaskTorqueScaled(servo, limits),
    ):
        run = aj.simulate(plant, limited, target, START, 3.0, **SAMPLED)
        assert (np.abs(run.tau) <= 0.5 * panda.effort_limits + 1e-9).all()
        assert run.error_norm[-1] < 1e-3 * run.error_norm[0]


# -- building -------------------------------------------------------------------------------


def test_bad_arguments_are_refused(panda, two_link):
    task = aj.PositionTask(panda)
    cases = [
        (lambda: aj.VelocityServo(panda), "task must be a task of the believed robot"),
        (lambda: aj.VelocityServo(task, 0.0), r"rate must be a finite number > 0 \[1/s\], got 0"),
        (lambda: aj.VelocityServo(task, "4"), r"rate must be a finite number > 0 \[1/s\]"),
        (lambda: aj.VelocityServo(task, 1e100), r"rate must be at most 1e\+60"),
        (
            lambda: aj.VelocityServo(task, inner_bandwidth=-50.0),
            r"inner_bandwidth must be a finite number > 0 \[1/s\], got -50",
        ),
        (
            lambda: aj.VelocityServo(task, gravity=aj.AdaptiveGravity(aj.GravityRegressor(panda))),
            r"gravity must not be learnt by a velocity servo: eq. \(29\) goes with the laws of "
            r"SetpointController; give ModelGravity, RegressorGravity or NoGravity",
        ),
        (
            lambda: aj.VelocityServo(task, gravity=aj.ModelGravity(two_link)),
            "gravity must be that of a robot with the joints",
        ),
        (lambda: aj.VelocityServo(task, gravity=1), "gravity must be one of ModelGravity"),
        (
            lambda: aj.VelocityServo(task, saturation=aj.Sine((0.1, 0.2))),
            r"saturation must be Linear\(\), Sine\(gamma\) or Tanh\(gamma\) with one gamma or 3",
        ),
    ]
    for make, text in cases:
        with pytest.raises(aj.InvalidInputError, match=text):
            make()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))])
def test_copies_have_the_same_bits_and_scratch_of_their_own(controller, copied, rng):
    other = copied(controller)
    assert repr(other) == repr(controller)
    task = controller.task
    assert other.task is not task
    for _ in range(3):
        q, v = task.robot.random_configuration(rng), rng.normal(size=task.robot.nv)
        x, target = task.value(q), task.value(task.robot.random_configuration(rng))
        answer, again = (answer_to(c, q, v, x, target) for c in (controller, other))
        assert_array_equal(again.torque, answer.torque)
        assert again.status is answer.status
    torque = controller.gravity.torque(q)
    before = torque.copy()
    other.gravity.torque(pin.integrate(task.robot.model, q, v))
    assert_array_equal(torque, before)


def test_a_torque_is_not_scratch_memory(controller, rng):
    task = controller.task
    q, v = regular_posture(task, rng), rng.normal(size=task.robot.nv)
    torque = answer_to(controller, q, v, task.value(q), task.value(q)).torque
    before = torque.copy()
    answer_to(controller, regular_posture(task, rng), 2.0 * v, task.value(q), task.value(q))
    assert_array_equal(torque, before)


def test_what_it_is_called(panda):
    assert repr(controllers()["panda"]) == (
        "VelocityServo(PositionTask('panda', 'panda_hand_tcp', 'xyz'), rate=4, inner_bandwidth=50)"
    )
