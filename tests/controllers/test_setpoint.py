"""`SetpointController`: Eq. (5), Eq. (6), Eq. (10), Eq. (28), Eq. (29); truth and belief."""

import gc
from types import FunctionType, ModuleType

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.controllers import DifferentiatedVelocity, ModelGravity, RegressorGravity
from approxjac.controllers.controller import Instant
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.law import Sine, Tanh
from approxjac.paper import experiments as paper
from approxjac.robots import Dynamics, GravityRegressor
from approxjac.scenario import Scenario, build_scenario
from approxjac.tasks import CombinedTask

TARGET = np.array([0.4, 0.1, 0.5])


def state_of(arm, rng, m=3):
    return aj.Measurement(
        0.0, arm.random_configuration(rng), rng.uniform(-1, 1, arm.nv), rng.uniform(-1, 1, m)
    )


def near(arm, rng):
    """A state from which the target is within reach: x is told somewhere near it."""
    return state_of(arm, rng)._replace(x=TARGET + rng.uniform(-0.1, 0.1, 3))


def controllers(robot):
    """One controller of each law on a redundant arm."""
    task = aj.PositionTask(robot)
    gains = aj.Gains(kp=400.0, kv=(80.0, 70.0, 60.0), damping=1.0)
    regressor = GravityRegressor(robot)
    return {
        "(6)": aj.SetpointController(task, gains),
        "(6), saturated": aj.SetpointController(task, gains, saturation=Sine(0.05)),
        "(6), no gravity": aj.SetpointController(task, gains, gravity=aj.NoGravity(robot)),
        "(6), theta": aj.SetpointController(
            task, gains, gravity=RegressorGravity(regressor, regressor.theta)
        ),
        "(28)": aj.SetpointController(
            task,
            gains,
            gravity=aj.AdaptiveGravity(regressor, L=0.1, alpha=1.0, torque_limits=np.inf),
        ),
        "(5)": aj.SetpointController(task, gains, velocity=DifferentiatedVelocity(0.01)),
        "(5), learnt": aj.SetpointController(
            task,
            gains,
            gravity=aj.AdaptiveGravity(regressor, L=0.1, alpha=1.0, torque_limits=np.inf),
            velocity=DifferentiatedVelocity(0.01),
        ),
    }


@pytest.fixture(scope="module", params=list(controllers(aj.load_robot("panda"))))
def controller(request):
    return controllers(aj.load_robot("panda"))[request.param]


def expected_torque(controller, measurement, x_dot_hat, g):
    """The law written out with dense matrices."""
    kp, kv, damping = controller.diagonals
    J_hat = controller.task.jacobian(measurement.q)
    s = controller.saturation.s(measurement.x - TARGET)
    force = np.diag(kp) @ s + np.diag(kv) @ x_dot_hat
    return -J_hat.T @ force - np.diag(damping) @ measurement.v + g


@pytest.mark.parametrize("law", ["(6)", "(6), saturated", "(6), no gravity", "(6), theta", "(28)"])
def test_torque_is_the_law(panda, law, rng):
    controller = controllers(panda)[law]
    measurement = near(panda, rng)
    answer = controller.evaluate(controller.begin(measurement), measurement, TARGET)
    x_dot_hat = controller.task.jacobian(measurement.q) @ measurement.v
    g = np.zeros(7) if law == "(6), no gravity" else Dynamics(panda).g(measurement.q)
    assert_allclose(answer.torque, expected_torque(controller, measurement, x_dot_hat, g))
    assert_allclose(answer.e, measurement.x - TARGET)
    assert answer.status is aj.Status.OK


def test_law_5_differentiates_the_measured_value(panda, rng):
    controller = controllers(panda)["(5)"]
    measurement = state_of(panda, rng)
    state = controller.begin(measurement)
    assert_allclose(state, measurement.x)
    behind = state - 0.002
    answer = controller.evaluate(behind, measurement, TARGET)
    x_dot = np.full(3, 0.2)  # 0.002 / time constant
    assert_allclose(answer.state_rate, x_dot)
    g = Dynamics(panda).g(measurement.q)
    assert_allclose(answer.torque, expected_torque(controller, measurement, x_dot, g))


def test_the_differentiator_converges_to_the_velocity_of_a_ramp(panda, rng):
    controller = controllers(panda)["(5)"]
    measurement = state_of(panda, rng)
    state, dt, slope = controller.begin(measurement), 1e-4, np.array([0.1, -0.2, 0.3])
    for k in range(1000):
        x = measurement.x + slope * k * dt
        rate = controller.evaluate(state, measurement._replace(x=x), TARGET).state_rate
        state = state + dt * rate
    assert_allclose(rate, slope, rtol=1e-3)


def test_adaptation_is_eq_29(panda, rng):
    regressor = GravityRegressor(panda)
    root = rng.normal(size=(12, 12))
    for L in (0.1, rng.uniform(0.1, 1, 12), root @ root.T + np.eye(12)):
        gravity = aj.AdaptiveGravity(
            regressor, L=L, alpha=0.7, theta0=np.zeros(12), torque_limits=np.inf
        )
        controller = aj.SetpointController(
            aj.PositionTask(panda), aj.Gains(400, 80, 1.0), gravity=gravity
        )
        measurement = near(panda, rng)
        state = controller.begin(measurement)
        assert np.array_equal(state, np.zeros(12))
        answer = controller.evaluate(state, measurement, TARGET)
        J_hat = controller.task.jacobian(measurement.q)
        y = measurement.v + 0.7 * np.linalg.pinv(J_hat) @ (measurement.x - TARGET)
        dense = np.diag(np.full(12, L)) if np.ndim(L) == 0 else np.diag(L) if np.ndim(L) == 1 else L
        assert_allclose(answer.state_rate, -dense @ regressor.Z(measurement.q).T @ y)
        assert_allclose(answer.J_hat, J_hat)
        assert_allclose(controller.learnt(np.arange(12.0)), np.arange(12.0))


def behind(controller, measurement):
    """A first state, of which the differentiator of law (5) has an x from 2 mm away."""
    state = controller.begin(measurement)
    if controller.velocity is not None:
        state[-3:] -= [0.002, -0.001, 0.003]
    return state


def measured_velocity(controller, measurement, state):
    """Ẋ as the law has it."""
    if controller.velocity is None:
        return controller.task.jacobian(measurement.q) @ measurement.v
    return (measurement.x - state[-3:]) / controller.velocity.time_constant


def test_on_a_path_the_motion_is_relative_to_it(controller, panda, rng):
    """In the torque of every law, and in what learns; and where x is lost it is at rest."""
    measurement, v_d = near(panda, rng), np.array([0.3, -0.2, 0.1])
    state = behind(controller, measurement)
    answer = controller.evaluate(state, measurement, aj.Target(TARGET, v_d))
    J_hat = controller.task.jacobian(measurement.q)
    reference = np.linalg.pinv(J_hat) @ v_d
    assert_allclose(answer.reference, reference)
    relative = measurement._replace(v=measurement.v - reference)
    x_dot = measured_velocity(controller, measurement, state) - v_d
    expected = expected_torque(controller, relative, x_dot, answer.gravity)
    assert_allclose(answer.torque, expected)
    s = controller.saturation.s(measurement.x - TARGET)
    if (learning := controller.adaptation) is not None:
        y = relative.v + learning.alpha * np.linalg.pinv(J_hat) @ s
        rate = -learning.L * (learning.Y(measurement.q, J_hat).T @ y)
        assert_allclose(answer.state_rate[: controller.resting], rate)
    lost = measurement._replace(x=np.full(3, np.nan))
    for_good, on_path = (
        controller.evaluate(state, lost, target) for target in (TARGET, aj.Target(TARGET, v_d))
    )
    assert_array_equal(on_path.torque, for_good.torque)
    assert_array_equal(on_path.state_rate, for_good.state_rate)


def test_the_velocity_of_a_target_is_of_what_is_measured_however_it_is_combined(panda, rng):
    """In other axes, with one gain for all, a law is the same."""
    task, turned = aj.PositionTask(panda), np.linalg.qr(rng.normal(size=(3, 3)))[0]
    measurement, target = near(panda, rng), aj.Target(TARGET, np.array([0.3, -0.2, 0.1]))
    one, other = (
        aj.SetpointController(each, aj.Gains(400.0, 80.0, 1.0)).evaluate(
            np.zeros(0), measurement, target
        )
        for each in (task, CombinedTask(task, turned))
    )
    assert_allclose(other.torque, one.torque)
    assert_allclose(other.reference, one.reference)


@pytest.mark.parametrize("seen", [True, False])
def test_the_torque_of_the_task_is_what_gravity_and_damping_leave(controller, panda, rng, seen):
    measurement = near(panda, rng)
    state, x = behind(controller, measurement), measurement.x
    if not seen:
        measurement = measurement._replace(x=np.full(3, np.nan))
    answer, dynamics = controller.evaluate(state, measurement, TARGET), Dynamics(panda)
    at = Instant(measurement.q, measurement.v, x - TARGET, TARGET, state, answer, dynamics)
    damped = controller.diagonals.damping * measurement.v
    expected = answer.torque - answer.gravity + damped
    assert_allclose(controller.task_torque(at), expected, atol=1e-9)


def test_a_singular_pose_is_reported_and_the_rate_stays_bounded(two_link):
    regressor = GravityRegressor(two_link, moments="x")
    controller = aj.SetpointController(
        aj.PositionTask(two_link, axes="xz"),
        aj.Gains(100.0, 50.0),
        gravity=aj.AdaptiveGravity(regressor, L=0.1, alpha=1.0, torque_limits=np.inf),
    )
    rates = []
    for bend in (0.1, 0.03, 0.01, 1e-4, 0.0, -1e-4, -0.01):
        measurement = aj.Measurement(0.0, np.array([0.3, bend]), np.zeros(2), np.array([1.0, 1.0]))
        answer = controller.evaluate(np.zeros(2), measurement, np.zeros(2))
        near = np.linalg.norm(answer.J_hat, -2) < 0.02 * 3.0
        assert (answer.status is aj.Status.NEAR_SINGULAR) == near
        rates.append(answer.state_rate)
    assert np.abs(rates).max() < 1e3
    assert "pseudo-inverse is damped" in aj.Status.NEAR_SINGULAR.message


@pytest.mark.parametrize("bend", [0.5, 0.05, 0.02, 0.0])
def test_a_jacobian_near_a_singular_one_is_reported(two_link, bend):
    task = aj.PositionTask(two_link, axes="xz")
    controller = aj.SetpointController(task, aj.Gains(100.0, 50.0))
    q = np.array([0.3, bend])
    answer = controller.evaluate(
        np.zeros(0), aj.Measurement(0.0, q, np.zeros(2), np.zeros(2)), np.ones(2)
    )
    values = np.linalg.svd(task.jacobian(q), compute_uv=False)
    assert (answer.status is aj.Status.NEAR_SINGULAR) == (values[-1] < 0.02 * values[0])


def test_the_differentiator_goes_on_while_the_measurement_is_lost(panda, rng):
    controller = controllers(panda)["(5)"]
    measurement = state_of(panda, rng)
    state = controller.begin(measurement)
    lost = measurement._replace(x=np.full(3, np.nan))
    rate = controller.evaluate(state, lost, TARGET).state_rate
    assert_allclose(rate, controller.task.jacobian(measurement.q) @ measurement.v)
    with pytest.raises(MeasurementError, match=r"the first x must be finite for law \(5\)"):
        controller.begin(lost)


def test_a_saturation_of_the_wrong_length_is_refused(panda):
    task, gains = aj.PositionTask(panda), aj.Gains(1.0, 1.0, 1.0)
    for saturation in (Sine((0.1, 0.2)), Tanh(np.ones(4))):
        with pytest.raises(
            aj.InvalidInputError, match=r"saturation must be Linear\(\), .* one gamma or 3"
        ):
            aj.SetpointController(task, gains, saturation=saturation)
    aj.SetpointController(task, gains, saturation=Sine((0.1, 0.2, 0.3)))


def test_the_same_inputs_give_the_same_outputs(controller, rng):
    robot = controller.task.robot
    measurements = [state_of(robot, rng) for _ in range(5)]
    states = [controller.begin(m) for m in measurements]
    first = [controller.evaluate(s, m, TARGET) for s, m in zip(states, measurements, strict=True)]
    kept = [(a.torque.copy(), a.state_rate.copy()) for a in first]
    again = [
        controller.evaluate(s, m, TARGET)
        for s, m in reversed(list(zip(states, measurements, strict=True)))
    ]
    for (torque, rate), a, b in zip(kept, first, reversed(again), strict=True):
        assert np.array_equal(torque, a.torque)  # nothing returned is scratch memory
        assert np.array_equal(torque, b.torque)
        assert np.array_equal(rate, b.state_rate)


def test_the_torque_never_depends_on_the_true_robot(controller, rng):
    """Bit-identical torque when the truth changes and the measurement does not."""
    panda = controller.task.robot
    q, v = panda.random_configuration(rng), rng.uniform(-1, 1, 7)
    x = aj.PositionTask(panda).value(q)
    state = controller.begin(aj.Measurement(0.0, q, v, x))
    answers = []
    for length in (0.0, 0.1, 0.2):
        truth = panda.with_object(length, 0.5 * length).with_kinematic_error(
            {"panda_joint4": (0.0, 0.1 * length, 0.0)}
        )
        plant = aj.Plant(truth, aj.PositionTask(truth), friction=length)
        measured = plant.measure(0.0, q, v)
        plant.acceleration(q, v, rng.normal(size=7))
        answers.append(controller.evaluate(state, measured._replace(x=x), TARGET))
    for answer in answers[1:]:
        assert np.array_equal(answer.torque, answers[0].torque)
        assert np.array_equal(answer.state_rate, answers[0].state_rate)


def robots_reachable_from(controller):
    """Every robot that an object can get at, through attributes, closures and defaults."""
    seen: dict[int, object] = {}
    frontier: list[object] = [controller]
    while frontier:
        found = frontier.pop()
        if id(found) in seen or isinstance(found, type | ModuleType):
            continue
        seen[id(found)] = found
        if isinstance(found, FunctionType):  # but not its globals, which reach everything
            frontier += [found.__closure__, found.__defaults__, found.__kwdefaults__]
        else:
            frontier += gc.get_referents(found)
    return [found for found in seen.values() if isinstance(found, aj.Robot)]


@pytest.mark.parametrize("figure", paper.EXPERIMENTS)
def test_the_true_robot_cannot_be_reached_from_a_controller(figure):
    experiment = paper.EXPERIMENTS[figure]
    plant, controller = paper.build(experiment)
    robots = robots_reachable_from(controller)
    assert controller.task.robot in robots
    assert not any(robot is plant.robot for robot in robots)
    if experiment.lengths != paper.LENGTHS:  # then no robot like the true one either
        assert plant.robot not in robots


def test_the_true_robot_cannot_be_reached_from_a_limiter():
    built = build_scenario(Scenario("panda", controller={"limits": 0.5}))
    robots = robots_reachable_from(built.controller)
    assert built.law.task.robot in robots
    assert built.plant.robot not in robots


def test_the_walk_finds_what_is_hidden():
    _, controller = paper.build(paper.EXPERIMENTS[7])
    truth = paper.build_arm()
    assert truth not in robots_reachable_from(controller)
    controller.hidden = lambda: truth
    assert truth in robots_reachable_from(controller)


@pytest.mark.parametrize("figure", paper.EXPERIMENTS)
def test_the_studys_torques_are_bit_identical_when_the_truth_changes(figure, rng):
    """Whatever truth stands beside it, the same belief and measurement give the same bits."""
    plant, controller = paper.build(paper.EXPERIMENTS[figure])
    measurement = plant.measure(0.0, rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2))
    state = controller.begin(measurement)
    target = np.array([-0.02, 0.02])
    before = controller.evaluate(state, measurement, target)
    for lengths in ((1.1, 0.9, 0.3), (0.8, 1.2, 0.7)):
        other = paper.build_arm(lengths)
        changed = aj.Plant(other, aj.ImageTask(other, paper.CAMERA))
        own = changed.measure(0.0, measurement.q, measurement.v)
        assert not np.array_equal(own.x, measurement.x)
        changed.acceleration(own.q, own.v, before.torque)
        after = controller.evaluate(state, own._replace(x=measurement.x), target)
        assert np.array_equal(after.torque, before.torque)
        assert np.array_equal(after.state_rate, before.state_rate)


# -- lost and bad measurements --------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_lost_measurement_leaves_damping_and_gravity(controller, value, rng):
    robot = controller.task.robot
    measurement = state_of(robot, rng)
    state = controller.begin(measurement)
    lost = measurement._replace(x=np.array([0.1, value, 0.2]))
    answer = controller.evaluate(state, lost, TARGET)
    assert answer.status is aj.Status.MEASUREMENT_LOST
    assert np.array_equal(controller.learnt(answer.state_rate), controller.learnt(0 * state))
    # the same as at the target with no measured velocity
    _, kv, damping = controller.diagonals
    J_hat = controller.task.jacobian(measurement.q)
    x_dot = J_hat @ measurement.v
    g = Dynamics(robot).g(measurement.q)
    if isinstance(controller.gravity, aj.NoGravity):
        g = 0.0 * g
    assert_allclose(answer.torque, g - J_hat.T @ (kv * x_dot) - damping * measurement.v)


@pytest.mark.parametrize("name", ["q", "v"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_joint_state_that_is_not_finite_is_a_named_error(controller, name, value, rng):
    measurement = state_of(controller.task.robot, rng)
    bad = getattr(measurement, name).copy()
    bad[2] = value
    with pytest.raises(MeasurementError, match=rf"{name} must be finite, got \[.*{value}.*stop"):
        controller.evaluate(
            controller.begin(measurement), measurement._replace(**{name: bad}), TARGET
        )


@pytest.mark.parametrize("size", [1e100, 1e200, 1e308])
def test_absurd_but_finite_numbers_give_a_finite_torque_or_a_named_error(controller, size, rng):
    measurement = state_of(controller.task.robot, rng)
    state = controller.begin(measurement)
    for name in ("v", "x"):
        absurd = measurement._replace(**{name: np.full_like(getattr(measurement, name), size)})
        try:
            with np.errstate(all="ignore"):
                answer = controller.evaluate(state, absurd, TARGET)
        except MeasurementError as error:
            assert "overflows" in str(error)  # noqa: PT017
        else:
            assert np.isfinite(answer.torque).all()
            assert np.isfinite(answer.state_rate).all()


def test_a_target_with_which_the_error_could_overflow_is_refused(panda, rng):
    controller = controllers(panda)["(6), saturated"]
    measurement = state_of(panda, rng)._replace(x=np.full(3, 1.7e308))
    with pytest.raises(InvalidInputError, match="target must be at most"):
        controller.evaluate(np.zeros(0), measurement, np.full(3, -1.7e308))


def test_wrong_shapes_are_named(panda, rng):
    controller = controllers(panda)["(28)"]
    good = state_of(panda, rng)
    state = controller.begin(good)
    cases = [
        ((state, good._replace(q=np.zeros(6)), TARGET), r"q must be an array of shape \(7,\) of"),
        ((state, good._replace(v=np.zeros(8)), TARGET), r"v must be an array of shape \(7,\) of"),
        ((state, good._replace(x=np.zeros(2)), TARGET), r"x must be .* \(3,\) .*got \(2,\)"),
        ((state, good._replace(x=[0, 0, 0]), TARGET), r"x must be an array .* got list"),
        ((state, good, np.zeros(2)), r"target must be an array of shape \(3,\)"),
        ((np.zeros(3), good, TARGET), r"state must be an array of shape \(12,\)"),
    ]
    for arguments, text in cases:
        with pytest.raises(aj.InvalidInputError, match=text):
            controller.evaluate(*arguments)
    with pytest.raises(aj.InvalidInputError, match=r"target must be finite \[m\], got \[nan"):
        controller.evaluate(state, good, np.full(3, np.nan))
    with pytest.raises(aj.InvalidInputError, match=r"state must be finite, got \[inf"):
        controller.evaluate(np.full(12, np.inf), good, TARGET)


# -- building -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"kp": -1.0, "kv": 1.0}, r"kp must be > 0 in every entry, .*got \[-1.0\]"),
        ({"kp": 1.0, "kv": 0.0}, r"kv must be > 0 in every entry, .*got \[0.0\]"),
        ({"kp": (1.0, np.nan), "kv": 1.0}, r"kp must be finite, got \[1.0, nan\]"),
        ({"kp": 1.0, "kv": 1.0, "damping": -0.1}, r"damping must be >= 0 in every entry, .*got"),
        ({"kp": "high", "kv": 1.0}, r"kp must be numbers of shape \(1,\), got \['high'\]"),
        ({"kp": "400", "kv": 1.0}, r"kp must be numbers of shape \(1,\), got \['400'\]"),
    ],
)
def test_bad_gains_are_refused(arguments, text):
    with pytest.raises(aj.InvalidInputError, match=text):
        aj.Gains(**arguments)


def test_gains_of_the_wrong_length_are_refused(panda):
    with pytest.raises(aj.InvalidInputError, match=r"kp must have shape \(3,\), got shape \(2,\)"):
        aj.SetpointController(aj.PositionTask(panda), aj.Gains((1.0, 1.0), 1.0, damping=1.0))
    with pytest.raises(aj.InvalidInputError, match=r"damping must have shape \(7,\), got shape"):
        aj.SetpointController(aj.PositionTask(panda), aj.Gains(1.0, 1.0, damping=(1.0, 1.0)))


def test_a_redundant_arm_needs_added_damping(panda):
    with pytest.raises(aj.InvalidInputError, match="it has 7 joints for 3 task coordinates"):
        aj.SetpointController(aj.PositionTask(panda), aj.Gains(400.0, 80.0))


def test_gravity_of_another_arm_than_the_believed_one_is_printed_with_its_model(panda):
    truth, task = panda.with_object(0.2, 0.5, axis="x"), aj.PositionTask(panda)

    class Own(ModelGravity):
        pass

    moon = np.array([0.0, 0.0, -1.62])
    lighter, vector = aj.load_robot("panda", gravity=moon), "gravity vector [0, 0, -1.62] m/s²"
    both = truth.with_gravity(moon)
    for gravity, text in (
        (ModelGravity(truth), "as of another model: panda (17.32 kg)"),
        (ModelGravity(lighter), f"as of another model: panda ({vector})"),
        (ModelGravity(both), f"as of another model: panda (17.32 kg, {vector})"),
        (ModelGravity(aj.load_robot("panda")), "as of the believed arm"),
        (Own(truth), "by Own"),
    ):
        law = aj.SetpointController(task, aj.Gains(1, 1, 1), gravity=gravity)
        assert f"; gravity {text} position task" in " ".join(str(law).split())


def test_objects_of_the_wrong_kind_are_refused(panda):
    task, gains, regressor = aj.PositionTask(panda), aj.Gains(1, 1, 1), GravityRegressor(panda)
    cases = [
        (lambda: aj.SetpointController(panda, gains), "task must be a task of the believed robot"),
        (lambda: aj.SetpointController(task, (1, 1)), r"gains must be Gains\(kp=.*got \(1, 1\)"),
        (
            lambda: aj.SetpointController(task, gains, gravity=regressor),
            "gravity must be one of ModelGravity, RegressorGravity, AdaptiveGravity and NoGravity",
        ),
        (
            lambda: aj.SetpointController(task, gains, gravity=aj.NoGravity),
            "gravity must be one of .*, got the class NoGravity",
        ),
        (lambda: aj.SetpointController(task, gains, velocity=0.02), "velocity must be Different"),
        (
            lambda: aj.SetpointController(
                aj.PoseTask(panda), gains, velocity=DifferentiatedVelocity(0.01)
            ),
            r"law \(5\) differentiates x and needs a task whose error is x - x_d, got PoseTask",
        ),
        (lambda: aj.SetpointController(task, gains, saturation=Sine), "saturation must be Lin"),
        (lambda: aj.SetpointController(task, gains, saturation=0.2), "saturation must be Linear"),
        (lambda: aj.AdaptiveGravity(task, 1.0, 1.0), "model must be the believed Robot, or a Grav"),
        (lambda: RegressorGravity(panda, np.ones(12)), "regressor must be a GravityRegressor"),
        (lambda: GravityRegressor(task), "robot must be a Robot, got PositionTask"),
        (lambda: aj.PositionTask("panda"), "robot must be a Robot, got 'panda'"),
        (lambda: aj.ImageTask(panda, None), "camera must be a camera, such as PlanarCamera"),
        (lambda: aj.Plant(panda, panda), "sensor must be a task of the true robot, such as"),
        (lambda: aj.Plant(task, task), "robot must be the true Robot, got PositionTask"),
        (
            lambda: aj.simulate(aj.SetpointController(task, gains), None, 0, 0, 1, dt=None),
            "plant must be a Plant",
        ),
        (lambda: panda.with_locked_joints(["panda_joint1"]), "positions must be a mapping from"),
        (lambda: aj.Gains([], 1), r"kp must have shape \(1,\), got shape \(0,\)"),
        (lambda: aj.Gains(True, 1), "kp must be numbers"),
    ]
    for make, text in cases:
        with pytest.raises(aj.InvalidInputError, match=text):
            make()


def test_a_measurement_of_another_kind_is_refused(panda):
    controller = controllers(panda)["(6)"]
    for measurement in (None, (0.0, np.zeros(7), np.zeros(7))):
        with pytest.raises(
            aj.InvalidInputError, match=r"measurement must be Measurement\(t, q, v, x"
        ):
            controller.evaluate(np.zeros(0), measurement, TARGET)


def test_arrays_that_would_wrap_around_are_refused(panda, rng):
    """Unsigned pixels: 100 − 101 would be 65535."""
    controller = controllers(panda)["(6)"]
    good = state_of(panda, rng)
    pixels = np.array([100, 200, 300], dtype=np.uint16)
    for bad in (pixels, pixels.astype(np.float32), pixels + 0j, np.array([None] * 3)):
        with pytest.raises(
            aj.InvalidInputError, match=r"x must be .* of float64 for .*, got \w+; x.as"
        ):
            controller.evaluate(np.zeros(0), good._replace(x=bad), TARGET)
    with pytest.raises(
        aj.InvalidInputError, match=r"target must be .* of float64 for .*, got uint16"
    ):
        controller.evaluate(np.zeros(0), good, pixels)


def test_gains_are_copies():
    kp = np.array([1.0, 2.0])
    gains = aj.Gains(kp, [3.0, 4.0])
    kp[:] = -5.0
    assert_allclose(gains.kp, [1.0, 2.0])
    with pytest.raises(ValueError, match="read-only"):
        gains.kv[0] = -1.0


def test_continuous_joints_off_the_circle_are_refused(rng):
    kinova = aj.load_robot("kinova")
    task = aj.PositionTask(kinova)
    controller = aj.SetpointController(task, aj.Gains(1.0, 1.0, 1.0))
    q = 2.0 * kinova.neutral()
    with pytest.raises(
        aj.InvalidInputError, match=r"q must have cos\^2 \+ sin\^2 = 1 in the pairs"
    ):
        task.value(q)
    with pytest.raises(
        aj.InvalidInputError, match=r"q must have cos\^2 \+ sin\^2 = 1 in the pairs"
    ):
        controller.evaluate(np.zeros(0), aj.Measurement(0.0, q, np.zeros(6), np.zeros(3)), TARGET)


def test_a_status_prints_its_name():
    assert str(aj.Status.OK) == f"{aj.Status.OK}" == "OK"


def test_gravity_of_another_arm_is_refused(panda, two_link):
    with pytest.raises(aj.InvalidInputError, match="gravity must be that of a robot with the joi"):
        aj.SetpointController(
            aj.PositionTask(panda),
            aj.Gains(400.0, 80.0, 1.0),
            gravity=aj.controllers.ModelGravity(two_link),
        )


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"L": -0.1, "alpha": 1.0}, r"L must be > 0 in every entry"),
        ({"L": np.ones(3), "alpha": 1.0}, r"L must have shape \(2,\), got shape \(3,\)"),
        ({"L": np.array([[1.0, 2.0], [2.0, 1.0]]), "alpha": 1.0}, "L must be symmetric positive d"),
        ({"L": np.array([[1.0, 2.0], [0.0, 1.0]]), "alpha": 1.0}, "L must be symmetric positive d"),
        ({"L": [[1.0], [2.0, 1.0]], "alpha": 1.0}, r"L must be numbers of shape \(2, 2\), got"),
        ({"L": [], "alpha": 1.0}, r"L must have shape \(2,\), got shape \(0,\)"),
        ({"L": [[1e-9, 0.0], [1e-9, 1e-9]], "alpha": 1.0}, "L must be symmetric positive definite"),
        ({"L": 1.0, "alpha": 0.0}, r"alpha must be a finite number > 0 \[1/s\], got 0.0"),
        ({"L": 1.0, "alpha": 1.0, "theta0": (1.0,)}, r"theta0 must have shape \(2,\), got"),
    ],
)
def test_bad_adaptation_is_refused(two_link, arguments, text):
    with pytest.raises(aj.InvalidInputError, match=text):
        aj.AdaptiveGravity(GravityRegressor(two_link, "x"), **arguments)


def test_bad_known_parameters_are_refused(two_link):
    with pytest.raises(aj.InvalidInputError, match=r"theta must have shape \(2,\), got shape"):
        RegressorGravity(GravityRegressor(two_link, "x"), (1.0, 2.0, 3.0))


def test_a_bad_time_constant_is_refused():
    with pytest.raises(aj.InvalidInputError, match=r"time_constant must be a finite number > 0"):
        DifferentiatedVelocity(0.0)


def test_repr_names_the_law(controller):
    assert "law (" in repr(controller)
    assert "PositionTask('panda', 'panda_hand_tcp', 'xyz')" in repr(controller)


@pytest.mark.parametrize("gains", [(1e300, 1.0), (1.0, 1e300), (1.0, 1.0, 1e300)])
def test_gains_that_could_overflow_in_a_step_are_refused(gains):
    with pytest.raises(aj.InvalidInputError, match=r"and at most 1e\+60, got"):
        aj.Gains(*gains)


def test_one_task_coordinate_is_bounded_through_its_singular_posture(two_link):
    """Its only singular value vanishes; the threshold is a share of what it typically is."""
    controller = aj.SetpointController(
        aj.PositionTask(two_link, axes="x"),
        aj.Gains(100.0, 50.0, 1.0),
        gravity=aj.AdaptiveGravity(GravityRegressor(two_link, "x"), L=0.1, alpha=1.0),
    )
    rates = []
    for turn in (1e-2, 1e-4, 1e-9, 1e-12, 0.0, -1e-12, -1e-4):
        q = np.array([turn, 0.0])  # stretched along x: x cannot be moved
        measurement = aj.Measurement(0.0, q, np.zeros(2), np.array([1.0]))
        answer = controller.evaluate(np.zeros(2), measurement, np.zeros(1))
        rates.append(answer.state_rate)
        assert (answer.status is aj.Status.NEAR_SINGULAR) == (abs(turn) < 1e-3)
    assert np.abs(rates).max() < 1e3
    assert np.abs(np.diff(rates[2:6], axis=0)).max() < 1e-3


def test_v_is_not_known_where_the_error_is_not(panda, rng):
    controller, q = aj.SetpointController(aj.PositionTask(panda)), panda.random_configuration(rng)
    x, v, dynamics = controller.task.value(q), rng.normal(size=7), Dynamics(panda)
    state = np.zeros(0)
    values = []
    for seen in (x, np.full(3, np.nan)):
        answer = controller.evaluate(state, aj.Measurement(0.0, q, v, seen), x)
        values.append(controller.lyapunov(Instant(q, v, answer.e, x, state, answer, dynamics)))
    assert_allclose(values, [0.5 * v @ dynamics.M(q) @ v, np.nan])


@pytest.mark.parametrize(("torque", "said"), [([0.0] * 6, r"\(7,\)"), ([np.nan] * 7, "finite")])
def test_gravity_of_ones_own_that_is_no_torque_of_the_arm_is_refused(torque, said, panda):
    class Own(aj.controllers.ModelGravity):
        def torque(self, q):
            return np.array(torque)

    with pytest.raises(aj.InvalidInputError, match=rf"torque\(q\).*{said}"):
        aj.SetpointController(aj.PositionTask(panda), gravity=Own(panda))
