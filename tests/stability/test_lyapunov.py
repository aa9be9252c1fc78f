"""dV/dt = −W along the closed loop: the sharpest test of the law, the models and the misprints.

Tests Eq. (6), Eq. (12), Eq. (13), Eq. (28), Eq. (29) and Eq. (31) together.
"""

import numpy as np
import pinocchio as pin
import pytest
from lyapunov_decrease import lyapunov

import approxjac as aj
from approxjac import law
from approxjac.cameras import PlanarCamera
from approxjac.controllers import Posture, RegressorGravity
from approxjac.law import Linear, Sine, Tanh
from approxjac.robots import GravityRegressor


def flow_V(plant, controller, target, alpha, theta):
    """V as a function of (q, v, state), and one Runge–Kutta step of the closed loop."""

    def rate(q, v, state):
        answer = controller.evaluate(state, plant.measure(0.0, q, v), target)
        return v, plant.acceleration(q, v, answer.torque), answer.state_rate

    def step(q, v, state, h):
        model = plant.robot.model
        v1, a1, r1 = rate(q, v, state)
        v2, a2, r2 = rate(pin.integrate(model, q, h / 2 * v1), v + h / 2 * a1, state + h / 2 * r1)
        v3, a3, r3 = rate(pin.integrate(model, q, h / 2 * v2), v + h / 2 * a2, state + h / 2 * r2)
        v4, a4, r4 = rate(pin.integrate(model, q, h * v3), v + h * a3, state + h * r3)
        q_new = pin.integrate(model, q, h / 6 * (v1 + 2 * v2 + 2 * v3 + v4))
        v_new = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        return q_new, v_new, state + h / 6 * (r1 + 2 * r2 + 2 * r3 + r4)

    def value(q, v, state):
        return lyapunov(plant, controller, q, v, target, alpha, state=state, theta=theta)

    return value, step


def v_dot(value, step, q, v, state, h):
    """dV/dt by central differences along the flow, extrapolated to fourth order."""

    def central(h):
        ahead, behind = step(q, v, state, h), step(q, v, state, -h)
        return (value(*ahead).V - value(*behind).V) / (2 * h)

    return (4 * central(h / 2) - central(h)) / 3


def assert_v_dot_is_minus_w(plant, controller, target, alpha, samples, h, theta=None):
    """Compare dV/dt with −W, to 1e-6 of W, at random states."""
    robot = plant.robot
    value, step = flow_V(plant, controller, target, alpha, theta)
    checked = 0
    rng = np.random.default_rng(5)
    while checked < samples:
        q, v = robot.random_configuration(rng), rng.uniform(-1, 1, robot.nv)
        singular = np.linalg.svd(controller.task.jacobian(q), compute_uv=False)
        if singular[-1] < 0.15 * singular[0]:
            continue  # Ĵ⁺ is damped near singular poses, and the identity is for the exact one
        state = controller.begin(plant.measure(0.0, q, v))
        state = state + rng.normal(size=state.shape)
        W = value(q, v, state).W
        assert v_dot(value, step, q, v, state, h) == pytest.approx(-W, rel=1e-6)
        checked += 1


@pytest.mark.parametrize("saturation", [Sine(0.01), Linear(), Tanh(0.01)])
def test_two_link_with_the_wrong_camera(two_link, saturation):
    """THEORY.md's case: K_p = 5000, K_v = 10000, γ = 0.01, B = 0.3, δ̂ = 60°."""
    camera = PlanarCamera(0.05, 3.0)
    rolled = PlanarCamera(0.05, 3.0, roll=np.radians(60.0))
    plant = aj.Plant(two_link, aj.ImageTask(two_link, camera), friction=0.3)
    controller = aj.SetpointController(
        aj.ImageTask(two_link, rolled), aj.Gains(5000.0, 10000.0), saturation=saturation
    )
    target = plant.sensor.value(np.radians([90.0, 90.0]))
    assert_v_dot_is_minus_w(plant, controller, target, alpha=0.3, samples=10, h=1e-4)


def true_and_believed(name):
    """A true arm with a tool, and a believed one without it and with a wrong joint origin."""
    arm = aj.load_robot(name)
    truth = arm.with_object(0.2, 0.5, axis=(0.3, 0.0, 1.0))
    shift = {arm.joint_names[3]: (0.0, 0.02, -0.01)}
    return truth, arm.with_object(0.0).with_kinematic_error(shift)


@pytest.mark.parametrize("name", ["panda", "xarm7"])
def test_seven_joints_with_an_unknown_tool(name):
    truth, belief = true_and_believed(name)
    plant = aj.Plant(truth, aj.PositionTask(truth), friction=np.linspace(0.1, 0.7, 7))
    regressor = GravityRegressor(belief)
    theta, residual = regressor.fit(truth)
    assert residual < 1e-10
    controller = aj.SetpointController(
        aj.PositionTask(belief),
        aj.Gains((400.0, 300.0, 500.0), (80.0, 60.0, 90.0), damping=1.0),
        gravity=RegressorGravity(regressor, theta),
        saturation=Sine(0.1),
    )
    target = plant.sensor.value(truth.neutral()) + [0.1, 0.2, -0.1]
    assert_v_dot_is_minus_w(plant, controller, target, alpha=0.5, samples=8, h=2e-5)


def test_seven_joints_with_learnt_gravity():
    """Eq. (31): the potential of the parameter error makes up for the gravity not yet learnt."""
    truth, belief = true_and_believed("panda")
    plant = aj.Plant(truth, aj.PositionTask(truth), friction=0.2)
    regressor = GravityRegressor(belief)
    theta, _ = regressor.fit(truth)
    controller = aj.SetpointController(
        aj.PositionTask(belief),
        aj.Gains(400.0, 80.0, damping=1.0),
        gravity=aj.AdaptiveGravity(
            regressor, L=np.linspace(0.1, 2.0, 12), alpha=0.5, torque_limits=np.inf
        ),
        saturation=Sine(0.1),
    )
    target = plant.sensor.value(truth.neutral()) + [0.1, 0.2, -0.1]
    assert_v_dot_is_minus_w(plant, controller, target, alpha=0.5, samples=6, h=2e-5, theta=theta)


class Pushed(aj.Plant):
    """An arm on which constant joint torques act, and a constant force as the belief has it."""

    def __init__(self, truth, force, torque, task, **options):
        super().__init__(truth, aj.PositionTask(truth), **options)
        self.push = lambda q: task.jacobian(q).T @ force + torque

    def acceleration(self, q, v, tau):
        return super().acceleration(q, v, tau + self.push(q))


def test_a_force_and_joint_torques_that_are_learnt_beside_gravity():
    """Eq. (29) and Eq. (31) with the regressor [Z, Ĵᵀ, I], a full L, and by the rule for gains.

    What lacks is gravity, a constant task force and constant joint torques.
    """
    truth, belief = true_and_believed("panda")
    rng, task, regressor = (
        np.random.default_rng(3),
        aj.PositionTask(belief),
        GravityRegressor(belief),
    )
    force, torque = rng.normal(size=3), rng.normal(size=7)
    plant = Pushed(truth, force, torque, task, friction=0.2)
    theta = np.concatenate([regressor.fit(truth)[0], -force, -torque])
    root = rng.normal(size=(12, 12))
    given = aj.AdaptiveGravity(
        regressor, 0.1 * root @ root.T + 0.1 * np.eye(12), 0.5, torque_limits=np.inf,
        task_force=(5.0, 10.0, 20.0), joint_torque=np.linspace(0.5, 3.0, 7),
    )  # fmt: skip
    rule = aj.AdaptiveGravity(regressor, bounds=(-100.0, 100.0), torque_limits=np.inf)
    gains = aj.Gains(400.0, 80.0, damping=1.0)
    target = plant.sensor.value(truth.neutral()) + [0.1, 0.2, -0.1]
    for controller in (
        aj.SetpointController(task, gains, gravity=given, saturation=Sine(0.1)),
        aj.SetpointController(task, gravity=rule),
    ):
        assert controller.adaptation.sizes == (12, 3, 7)
        alpha = controller.adaptation.alpha
        assert_v_dot_is_minus_w(plant, controller, target, alpha, samples=4, h=2e-5, theta=theta)


def test_theta_of_the_regressor_means_that_no_constant_forces_are_there():
    truth, belief = true_and_believed("panda")
    plant = aj.Plant(truth, aj.PositionTask(truth))
    controller = aj.SetpointController(aj.PositionTask(belief), gravity=aj.AdaptiveGravity(belief))
    theta = controller.adaptation.regressor.fit(truth)[0]
    q, v, target = truth.neutral(), np.full(7, 0.1), plant.sensor.value(truth.neutral()) + 0.1
    state = controller.begin(plant.measure(0.0, q, v)) + 0.5

    def V(theta):
        return lyapunov(plant, controller, q, v, target, state=state, theta=theta).V

    assert (len(theta), len(state)) == (12, 22)
    assert (
        V(list(theta)) == V(np.append(theta, np.zeros(10))) != V(np.append(theta, np.full(10, 2.0)))
    )
    run = aj.simulate(plant, controller, target, q, 0.002, dt=1e-3)
    start = {"state": run.state[0], "theta": theta}
    found = lyapunov(plant, controller, run.q[0], run.v[0], run.x_d[0], **start).V
    assert found == pytest.approx(run.V[0], rel=1e-9)


@pytest.fixture
def adaptive_two_link(two_link):
    """A closed loop of (28), (29), its V along the flow, and one state of it."""
    plant = aj.Plant(two_link, aj.PositionTask(two_link, axes="xz"), friction=0.3)
    regressor = GravityRegressor(two_link, "x")
    gravity = aj.AdaptiveGravity(regressor, L=(0.1, 0.4), alpha=0.5)
    controller = aj.SetpointController(
        aj.PositionTask(two_link, axes="xz"), aj.Gains(50.0, 20.0), gravity=gravity
    )
    target = np.array([0.5, 1.0])
    value, step = flow_V(plant, controller, target, 0.5, regressor.theta)
    q, v, state = np.array([0.4, 1.1]), np.array([0.7, -0.9]), np.array([2.0, 1.0])
    return plant, controller, target, value, (q, v, state), v_dot(value, step, q, v, state, 1e-4)


def test_the_printed_13_does_not_hold(adaptive_two_link):
    """Without the dot on d/dt Ĵ⁺, and with ½Ṁ + S read as Pinocchio's C less Ṁ/2."""
    plant, _, target, value, (q, v, state), slope = adaptive_two_link
    alpha, task = 0.5, plant.sensor
    assert slope == pytest.approx(-value(q, v, state).W, rel=1e-6)
    M, M_dot = plant.dynamics.M(q), plant.dynamics.M_dot(q, v)
    s, pinv = task.value(q) - target, np.linalg.pinv(task.jacobian(q))
    pinv_dot = law.cross_weight_pinv(task.jacobian(q), task.jacobian_dot(q, v)[None])[1][0]
    W = value(q, v, state).W
    without_the_dot = W + alpha * (pinv_dot @ s - pinv @ s) @ (M @ v)
    with_half_of_M_dot = W + alpha * (pinv @ s) @ (0.5 * M_dot @ v)
    for wrong in (without_the_dot, with_half_of_M_dot):
        assert slope != pytest.approx(-wrong, rel=1e-3)


def test_the_printed_31_does_not_hold(adaptive_two_link):
    """With L for L⁻¹, dV/dt along the flow is another."""
    plant, controller, target, value, (q, v, state), slope = adaptive_two_link
    error = controller.gravity.regressor.theta - state
    L = controller.gravity.L
    rate = controller.evaluate(state, plant.measure(0.0, q, v), target).state_rate
    printed = slope + error @ (rate / L) - error @ (rate * L)
    assert slope == pytest.approx(-value(q, v, state).W, rel=1e-6)
    assert printed != pytest.approx(-value(q, v, state).W, rel=1e-3)


# -- orientation and posture ----------------------------------------------------------------


def unknown_tool(name):
    """An arm with a tool, and the same arm believed without it."""
    arm = aj.load_robot(name)
    return arm.with_object(0.15, 0.5, axis=(0.3, 0.0, 1.0)), arm.with_object(0.0)


def controller_of(truth, task, gains, **options):
    """A controller with wrong lengths, whose gravity is exact all the same."""
    regressor = GravityRegressor(task.robot)
    theta, residual = regressor.fit(truth)
    assert residual < 1e-10
    return aj.SetpointController(task, gains, gravity=RegressorGravity(regressor, theta), **options)


def states_with_large_orientation_errors(plant, controller, target, samples):
    """Random states, away from singular ones, with an orientation error from 2 rad to 3 rad."""
    robot, rng = plant.robot, np.random.default_rng(7)
    while samples:
        q, v = robot.random_configuration(rng), rng.uniform(-1, 1, robot.nv)
        angle = np.linalg.norm(plant.sensor.error(plant.sensor.value(q), target)[3:])
        values = np.linalg.svd(controller.task.jacobian(q), compute_uv=False)
        if 2.0 <= angle <= 3.0 and values[-1] > 0.04 * values[0]:
            samples -= 1
            yield q, v


@pytest.mark.parametrize("name", ["panda", "xarm7"])
@pytest.mark.parametrize("rotational", [(40.0, 40.0, 40.0), (40.0, 60.0, 20.0)])
def test_a_pose_with_a_large_orientation_error(name, rotational):
    """Eq. (13) holds for orientation, far away too, with ∂e/∂q for J; also where gains differ."""
    truth, belief = unknown_tool(name)
    plant = aj.Plant(truth, aj.PoseTask(truth), friction=0.3)
    kp = np.array([400.0, 300.0, 500.0, *rotational])
    controller = controller_of(truth, aj.PoseTask(belief), aj.Gains(kp, 0.2 * kp, damping=1.0))
    target = plant.sensor.value(truth.neutral())
    value, step = flow_V(plant, controller, target, 0.5, None)
    misses = []
    for q, v in states_with_large_orientation_errors(plant, controller, target, 6):
        W = value(q, v, np.zeros(0)).W
        misses.append(abs(v_dot(value, step, q, v, np.zeros(0), 5e-7) + W) / abs(W))
    assert max(misses) < 1e-6


@pytest.mark.parametrize("name", ["panda", "xarm7"])
def test_a_posture_adds_the_power_of_its_torque(name):
    """V̇ = −W + q̇ᵀN τ₀, Eq. (13): the part of N τ₀ along αĴ⁺s(e) vanishes."""
    truth, belief = unknown_tool(name)
    plant = aj.Plant(truth, aj.PositionTask(truth), friction=0.3)
    stiffness = np.linspace(5.0, 20.0, 7)
    wanted = belief.random_configuration(np.random.default_rng(3))
    controller = controller_of(
        truth,
        aj.PositionTask(belief),
        aj.Gains(400.0, 80.0, damping=1.0),
        posture=Posture(wanted, stiffness),
        saturation=Sine(0.1),
    )
    target = plant.sensor.value(truth.neutral()) + [0.1, 0.2, -0.1]
    value, step = flow_V(plant, controller, target, 0.5, None)
    rng, checked = np.random.default_rng(5), 0
    while checked < 10:
        q, v = truth.random_configuration(rng), rng.uniform(-1, 1, 7)
        J_hat = controller.task.jacobian(q)
        values = np.linalg.svd(J_hat, compute_uv=False)
        if values[-1] < 0.15 * values[0]:
            continue
        N = np.eye(7) - np.linalg.pinv(J_hat) @ J_hat
        power = v @ N @ (-stiffness * (q - wanted))
        W = value(q, v, np.zeros(0)).W
        slope = v_dot(value, step, q, v, np.zeros(0), 2e-6)
        assert slope == pytest.approx(-W + power, rel=1e-6)
        assert slope != pytest.approx(-W, rel=1e-4)
        checked += 1


@pytest.mark.parametrize("metric", ["diagonal", "full"])
def test_learning_within_bounds_keeps_v_falling(metric):
    """Projection, Eq. (29): at a bound, with θ in the box, V̇ ≤ −W, and < −W where it is at work."""
    truth, belief = unknown_tool("panda")
    plant = aj.Plant(truth, aj.PositionTask(truth), friction=0.2)
    regressor, rng = GravityRegressor(belief), np.random.default_rng(11)
    theta, _ = regressor.fit(truth)
    lower, upper = np.minimum(theta, regressor.theta) - 0.05, np.maximum(theta, regressor.theta)
    upper = upper + 0.05
    root = rng.normal(size=(12, 12))
    options = {"L": np.full(12, 0.5), "alpha": 0.5, "torque_limits": np.inf}
    if metric == "full":
        options |= {"L": 0.05 * root @ root.T + 0.1 * np.eye(12)}
        options |= {"task_force": 3.0, "joint_torque": 2.0}

    def controller_with(bounds):
        gravity = aj.AdaptiveGravity(regressor, bounds=bounds, **options)
        return aj.SetpointController(
            aj.PositionTask(belief), aj.Gains(400.0, 80.0, damping=1.0), gravity=gravity
        )

    bounded, free = controller_with((lower, upper)), controller_with(None)
    L, others = bounded.adaptation.L, np.zeros(sum(bounded.adaptation.sizes) - 12)
    L, theta = np.diag(L) if L.ndim == 1 else L, np.concatenate([theta, others])
    target = plant.sensor.value(truth.neutral()) + [0.1, 0.2, -0.1]
    at_work = 0
    for _ in range(20):
        q, v = truth.random_configuration(rng), rng.uniform(-1, 1, 7)
        inside = np.concatenate([rng.uniform(lower, upper), others])
        at_a_bound = np.concatenate([np.where(rng.random(12) < 0.5, lower, upper), others])
        measurement = plant.measure(0.0, q, v)
        rates = [c.evaluate(inside, measurement, target).state_rate for c in (bounded, free)]
        assert np.array_equal(*rates)
        # V̇ of both laws differs by −Δθᵀ L⁻¹ (dθ̂/dt bounded − dθ̂/dt free), as only θ̂'s rate does
        rates = [c.evaluate(at_a_bound, measurement, target).state_rate for c in (bounded, free)]
        change = -(theta - at_a_bound) @ np.linalg.solve(L, rates[0] - rates[1])
        assert change <= 0.0
        at_work += change < -1e-3
        round_off = 1e-12 * np.abs(rates[1]).max()
        assert (rates[0][:12][at_a_bound[:12] == lower] >= -round_off).all()
        assert (rates[0][:12][at_a_bound[:12] == upper] <= round_off).all()
    assert at_work >= 15


def test_alpha_is_the_controllers_by_default(adaptive_two_link):
    plant, controller, target, *_ = adaptive_two_link
    arguments = (np.array([0.4, 1.1]), np.array([0.1, -0.2]), target)
    learnt = {"state": np.zeros(2), "theta": np.ones(2)}
    given = lyapunov(plant, controller, *arguments, controller.alpha, **learnt)
    assert lyapunov(plant, controller, *arguments, **learnt) == given
