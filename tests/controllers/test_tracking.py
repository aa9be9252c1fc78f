"""`TrackingController`: the tracking law on the believed arm's own kinematics."""

import copy

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from potentials import V2

import approxjac as aj
from approxjac import law
from approxjac.controllers import (
    AdaptiveDynamics,
    AdaptiveKinematics,
    KnownKinematics,
    ModelDynamics,
    TrackingController,
)
from approxjac.controllers.adaptive_dynamics import (
    squared_rates,
    usual_motions,
)
from approxjac.controllers.limits.limits import sure_deceleration
from approxjac.controllers.tracking import RestConfiguration, VelocityCommand
from approxjac.robots import Dynamics, Robot
from approxjac.robots.dynamics import DynamicsRegressor
from approxjac.simulation import VelocityServo
from approxjac.tasks import CombinedTask, NonsingularTask

STARTS = {
    "panda": np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]),
    "ur5": np.array([0.0, -1.2, 1.5, -1.0, -1.5, 0.0]),
}


def circle(task, q):
    """A circle of 10 cm in 4 s that starts 19 cm away from the tip."""
    return aj.Circle(task.value(q) + [0.05, -0.1, 0.05], 0.1, 4.0, normal=(0.0, 1.0, -0.6))


def measured(task, q, v=None, x=None):
    v = np.zeros(task.robot.nv) if v is None else v
    return aj.Measurement(0.0, q, v, task.value(q) if x is None else x)


def known(task, **options):
    """The law on the believed arm's own kinematics."""
    return TrackingController(task, kinematics=KnownKinematics(task), **options)


@pytest.fixture(scope="module")
def panda_law(panda):
    return known(aj.PositionTask(panda))


# -- runs -----------------------------------------------------------------------------------------


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "moves"),
    [
        ("panda", True),
        pytest.param("ur5", True, marks=pytest.mark.long),
        pytest.param("panda", False, marks=pytest.mark.long),
    ],
)
def test_with_the_exact_model_a_target_is_reached_and_followed(name, moves):
    robot, q0 = aj.load_robot(name), STARTS[name]
    task = aj.PositionTask(robot)
    path = circle(task, q0)
    controller = known(task, dynamics=ModelDynamics(robot))
    target = path if moves else path.at(0.0).x
    run = aj.simulate(aj.Plant(robot), controller, target, q0, 4.0)
    assert run.error_norm[3500:].max() < 2e-5  # 0.007 mm measured
    assert run.error_norm.max() <= run.error_norm[0] + 1e-3
    assert set(run.status) == {aj.Status.OK}


class Watched:
    """V₂ of the true arm at every step, and κσᵀM̂σ."""

    def __init__(self, truth, controller):
        self.law, self.dynamics = controller, Dynamics(truth)
        self.a = np.concatenate([DynamicsRegressor(truth).a])
        self.V, self.W, self.statuses = [], [], []

    def __call__(self, loop):
        q, v = loop.truth.q, loop.truth.v
        sigma, inside = v - loop.answer.reference, self.law.dynamics
        a_error = self.a - loop.state[: self.law.resting]
        M = self.dynamics.M(q)
        self.V.append(V2(sigma, M, a_error, inside.gamma))
        gain = inside.inertia(q) @ sigma + self.law._added * sigma
        self.W.append(self.law.kappa * sigma @ gain)
        self.statuses.append(loop.answer.limit_status)


def watched_run(dt, limits=None, duration=0.5):
    """A circle with an object of 1 kg that nobody told of."""
    belief, q0 = aj.load_robot("panda"), STARTS["panda"]
    truth = belief.with_object(0.2, 1.0, axis="x")
    task = aj.PositionTask(belief, "panda_hand_tcp")
    controller = known(task, dt=dt)
    plant = aj.Plant(truth, aj.PositionTask(truth, "panda_hand_tcp"))
    watched = Watched(truth, controller)
    limited = controller if limits is None else aj.TorqueLimited(controller, limits, dt=dt)
    options = {"dt": dt, "observer": watched, "record_every": 0.01}
    run = aj.simulate(plant, limited, circle(task, q0), q0, duration, **options)
    return watched, run


@pytest.mark.study
def test_v2_never_rises_and_falls_by_what_the_gain_dissipates():
    """The rest, of samples, goes with dt: 2.9 % at 1 ms, 0.73 % at 0.25 ms over 3 s."""
    off = []
    for dt in (1e-3, 2.5e-4):
        watched, _ = watched_run(dt)
        V, W = np.array(watched.V), np.array(watched.W)
        assert (np.diff(V) < 0.0).all()
        predicted = -0.5 * dt * (W[1:] + W[:-1])
        off.append(np.abs(np.diff(V) - predicted).sum() / np.abs(predicted).sum())
    assert off[0] < 0.05
    assert 3.0 < off[0] / off[1] < 5.0


def test_limits_of_torques_with_y_sigma_keep_what_v2_does():
    effort = 0.5 * aj.load_robot("panda").effort_limits
    watched, run = watched_run(1e-3, aj.Limits(effort=effort))
    assert (np.abs(run.tau) <= effort + 1e-9).all()
    statuses, V, W = np.array(watched.statuses), np.array(watched.V), np.array(watched.W)
    kept = np.flatnonzero(statuses[:-1] == aj.LimitStatus.PROOF_KEPT)
    assert len(kept) > 10
    change = np.diff(V)
    assert (change[kept] <= -0.5 * 1e-3 * W[kept]).all()  # V̇₂ ≤ −κσᵀM̂σ, half for samples
    free = np.flatnonzero(statuses[:-1] == aj.LimitStatus.FREE)
    assert (change[free] < 0.0).all()


def test_while_the_proof_is_given_up_the_dynamics_rest(panda):
    task, q = aj.PositionTask(panda), STARTS["panda"]
    law_ = known(task)
    limited = aj.TorqueLimited(law_, aj.Limits(effort=1.0))
    far = task.value(q) + [0.2, 0.2, 0.2]
    state = limited.initial_state(measured(task, q))
    after, answer = limited.step(state, measured(task, q), far, 1e-3)
    assert answer.limit_status is aj.LimitStatus.PROOF_GIVEN_UP
    assert answer.slack > 0.0
    assert (np.abs(answer.torque) <= 1.0 + 1e-9).all()
    assert_array_equal(after[: law_.resting], state[: law_.resting])
    unlimited, _ = law_.step(state, measured(task, q), far, 1e-3)
    assert (unlimited != state).any()


@pytest.mark.long
def test_payload_rotors_and_friction_are_learnt():
    """As good as the exact model's circle after a few seconds; the model as it is stays behind."""
    belief, q0 = aj.load_robot("panda"), STARTS["panda"]
    truth = Robot.like(belief.with_object(0.2, 1.0, axis="x"))
    truth.model.armature[:] = 0.1
    task = aj.PositionTask(belief, "panda_hand_tcp")
    sensor = aj.PositionTask(truth, "panda_hand_tcp")
    plant = aj.Plant(truth, sensor, friction=aj.robots.Friction(1.0, coulomb=0.2))
    rms = {}
    for kind in (AdaptiveDynamics, ModelDynamics):
        controller = known(task, dynamics=kind(belief))
        run = aj.simulate(plant, controller, circle(task, q0), q0, 3.0)
        rms[kind] = np.sqrt(np.mean(run.error_norm[2000:] ** 2))
        if kind is AdaptiveDynamics:
            a, regressor = run.state[-1], controller.dynamics.regressor
            torque = regressor.Z(q0) @ a[: regressor.links]
    assert rms[AdaptiveDynamics] < 1e-3  # 0.48 mm
    assert rms[ModelDynamics] > 5.0 * rms[AdaptiveDynamics]
    true = Dynamics(truth).g(q0)
    before = np.abs(Dynamics(belief).g(q0) - true).max()
    assert np.abs(torque - true).max() < 0.2 * before


@pytest.mark.parametrize(
    "kind",
    [
        "planar",
        *(
            pytest.param(kind, marks=pytest.mark.study)
            for kind in ("pose", "continuous", "stacked", "combined", "coupled")
        ),
    ],
)
def test_other_tasks_and_arms_are_followed(kind):
    panda, kinova, q0 = aj.load_robot("panda"), aj.load_robot("kinova"), STARTS["panda"]
    position = aj.PositionTask(panda)
    task = {
        "pose": lambda: aj.PoseTask(panda),
        "continuous": lambda: aj.PoseTask(kinova),
        "stacked": lambda: aj.StackedTask(position, aj.PositionTask(panda, "panda_link4", "y")),
        "combined": lambda: CombinedTask(position, [[2, 1, 0], [0, 1, 0], [0, 0.3, 1]]),
        "planar": lambda: aj.PositionTask(aj.load_robot("two_link")),
        "coupled": lambda: aj.PositionTask(aj.load_robot("tiago_arm")),
    }[kind]()
    plant = aj.Plant(task.robot, task)
    q0 = q0 if task.robot is panda else plant.ready_configuration()
    e = np.full(task.m, 0.05)
    e[3:] = 0.2 if len(e) == 6 else -0.02
    if kind == "planar":
        e[:] = -0.1
    target = task.target(task.displaced(task.value(q0), e))
    controller = known(task, dynamics=ModelDynamics(task.robot))
    run = aj.simulate(plant, controller, target, q0, 1.5, record_every=0.01)
    errors = [task.error(x, target) for x in run.x]
    assert np.linalg.norm(errors[-1]) < 2e-2 * np.linalg.norm(errors[0])


# -- the reference --------------------------------------------------------------------------------


def along(task, q, v, a):
    """q(t) and q̇(t) of a motion with constant q̈."""
    model = task.robot.model
    return (
        lambda t: np.array(pin.integrate(model, q, t * v + 0.5 * t * t * a)),
        lambda t: v + t * a,
    )


@pytest.mark.parametrize(
    "kind",
    ["position", "pose", "continuous", "nonsingular", "combined", "image", "singular", "stops"],
)
def test_the_reference_acceleration_is_exact(kind, rng):
    """Whatever the task: also where its error is no difference, and where Ĵ⁺ is damped."""
    panda = aj.load_robot("panda")
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))
    position = aj.PositionTask(panda)
    task = {
        "position": lambda: position,
        "singular": lambda: aj.PositionTask(aj.load_robot("ur5")),
        "pose": lambda: aj.PoseTask(panda),
        "continuous": lambda: aj.PoseTask(aj.load_robot("kinova")),
        "nonsingular": lambda: NonsingularTask(position, {"panda_joint4": 0.3}, ratio=0.9),
        "combined": lambda: CombinedTask(aj.PoseTask(panda), np.diag(np.arange(1.0, 7.0))),
        "stops": lambda: position,
        "image": lambda: aj.ImageTask(panda, camera),
    }[kind]()
    robot = task.robot
    controller = known(task, dynamics=ModelDynamics(robot))
    state, q = np.zeros(0), STARTS["panda"].copy()
    if robot is not panda:
        q = robot.random_configuration(rng)
    if kind == "stops":  # some of which are near, on both sides, and one is passed
        low, high = panda.position_limits
        q[[0, 1, 3, 4, 6]] = high[0] - 0.1, low[1] + 0.2, high[3] - 0.3, high[4] + 0.1, low[6] + 0.3
    if kind == "singular":  # stretched out upwards, nearly
        q = np.array([0.1, -1.55, 0.03, -1.57, 0.0, 0.0])
    v, a = 0.3 * rng.normal(size=robot.nv), rng.normal(size=robot.nv)
    q_of, v_of = along(task, q, v, a)
    x, rates = task.value(q), 0.1 * rng.normal(size=(2, task.m))
    ahead = task.displaced(x, 0.1 * rng.normal(size=task.m))
    if kind == "image":
        ahead, rates = x + [5.0, -8.0], 50.0 * rates

    def target(t):
        back = rates if kind != "combined" else np.linalg.solve(task.C, rates.T).T
        moved = task.displaced(ahead, t * rates[0] + 0.5 * t * t * rates[1])
        return aj.Target(moved, back[0] + t * back[1], back[1])

    def reference(t):
        return controller._reference(state, q_of(t), v_of(t), target(t))

    J, _, a_r, is_damped, *_ = reference(0.0)
    damped = np.linalg.svd(J, compute_uv=False)
    ratio = 0.08 if len(set(task.units)) == 1 else 0.02
    assert is_damped == (damped[-1] < ratio * damped[0])
    assert (kind == "singular") <= is_damped
    h = 1e-5
    expected = (reference(h)[1] - reference(-h)[1]) / (2.0 * h)
    if kind in ("pose", "continuous", "combined"):  # ω_d is constant in neither frame: 1e-4
        assert_allclose(a_r, expected, atol=2e-3 * np.abs(expected).max())
    else:
        assert_allclose(a_r, expected, atol=2e-6 * max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize("deep", [0.0, 0.5, 1.0])
def test_near_a_stop_the_other_joints_do_the_motion(panda, rng, deep):
    """Of a joint that would go on towards it; Ĵq̇_r = u, so that the error falls as before."""
    low, high = panda.position_limits
    task = aj.PositionTask(panda)
    controller = known(
        task, dynamics=ModelDynamics(panda), gains=aj.controllers.TrackingGains(self_motion=0.0)
    )
    zone, q, target = 0.12 * (high - low)[0], STARTS["panda"].copy(), aj.Target(np.zeros(3))
    for side in (-1.0, 1.0):
        q[0] = (high if side > 0 else low)[0] - side * (1.0 - deep) * min(zone, 0.6)
        J = task.jacobian(q)
        for towards in (-1.0, 1.0):
            turn = np.array([0.3 * side * towards, 0.0, 0.1, 0.0, 0.0, 0.1, 0.0])
            target = aj.Target(task.value(q) + 0.5 * J @ turn)
            v_r = controller._reference(np.zeros(0), q, np.zeros(7), target)[1]
            u = (
                -controller.alpha
                * law.saturated(
                    task.value(q) - target.x, np.zeros(3), controller.alpha / controller.speed
                )[0]
            )
            assert_allclose(J @ v_r, u, atol=1e-9)
            usual = np.linalg.pinv(J) @ u
            if towards > 0 and deep > 0.0:
                assert 0.0 < side * v_r[0] < (0.7 if deep < 1.0 else 0.3) * side * usual[0]
            else:
                assert_allclose(v_r, usual, atol=1e-9)


def test_the_self_motion_goes_to_the_posture(panda):
    task, q0 = aj.PositionTask(panda), STARTS["panda"]
    wanted = q0 + [0.3, 0.0, -0.3, 0.0, 0.2, 0.0, 0.5]
    controller = known(task, dynamics=ModelDynamics(panda), posture=wanted)
    options = {"dt": 1e-3, "record_every": 0.1}
    run = aj.simulate(aj.Plant(panda), controller, task.value(wanted), q0, 5.0, **options)
    assert_allclose(run.q[-1], wanted, atol=2e-2)
    assert run.error_norm[-1] < 1e-4


@pytest.mark.parametrize("name", ["panda", "pr2_left_arm"])
def test_without_a_posture_joints_are_only_pulled_back_from_their_ends(name, rng):
    """Nothing within 90 % of each range; beyond, towards the middle; the exact derivative."""
    robot = aj.load_robot(name)
    rest = RestConfiguration(aj.PositionTask(robot), None, 1.0)
    low, high = robot.usual_range
    limited = high - low < 0.999 * 2.0 * np.pi
    for share in (0.06, 0.94, 0.5, 0.02, 0.98):
        motion = low + share * (high - low)
        v = rng.normal(size=robot.nv)
        n, n_dot = rest.velocity(robot.configuration(motion), v)
        if 0.05 < share < 0.95:
            assert not n.any()
            assert not n_dot.any()
            continue
        assert (np.sign(n[limited]) == np.sign(0.5 - share)).all()
        assert (np.abs(n) <= 0.5).all()
        ahead, behind = (
            rest.velocity(robot.configuration(motion + h * v), v)[0] for h in (1e-6, -1e-6)
        )
        assert_allclose(n_dot, (ahead - behind) / 2e-6, atol=1e-6)


def test_self_motion_is_drawn_to_a_posture_the_short_way_round(rng):
    """Of continuous joints by the sine of the angle; and its rate is that of the motion."""
    robot = aj.load_robot("kinova")
    task = aj.PositionTask(robot)
    wanted, q = (robot.random_configuration(rng) for _ in range(2))
    away = pin.difference(robot.model, wanted, q)
    turns = np.isinf(robot.position_limits[0])
    assert 0 < turns.sum() < 6
    away = np.where(turns, np.sin(away), away)
    rest = RestConfiguration(task, wanted, 1.5)
    v, h = rng.normal(size=6), 1e-6
    n_0, rate = rest.velocity(q, v)
    assert_allclose(n_0, -1.5 * away / np.sqrt(1.0 + ((3.0 * away) ** 2).sum()), rtol=1e-12)
    after, before = (rest.velocity(pin.integrate(robot.model, q, s * h * v), v)[0] for s in (1, -1))
    assert_allclose(rate, (after - before) / (2.0 * h), atol=1e-7)
    assert_allclose(rest.velocity(wanted, v)[0], np.zeros(6), atol=1e-15)


@pytest.mark.long
def test_joints_that_turn_a_whole_turn_are_drawn_nowhere():
    """The middle of their ranges would be an arm that is stretched out."""
    ur5 = aj.load_robot("ur5")
    task, q0 = aj.PositionTask(ur5), np.array([0.0, -1.2, 1.6, -1.9, -1.57, 0.0])
    controller, plant = known(task, dynamics=ModelDynamics(ur5)), aj.Plant(ur5)
    circle = aj.Circle(task.value(q0) + [-0.08, 0.0, 0.05], radius=0.08, period=4.0)
    run = aj.simulate(plant, controller, circle, q0, duration=8.0, dt=1e-3, record_every=0.1)
    assert np.abs(run.q - q0).max() < 0.5  # 1.3 rad to the middle


def test_joints_are_led_no_faster_than_they_may_move(panda, panda_law):
    task = aj.PositionTask(panda)
    law_ = known(task, gains=aj.controllers.TrackingGains(speed=100.0))
    q = STARTS["panda"]
    state = law_.initial_state(measured(task, q))
    _, answer = law_.step(state, measured(task, q), task.value(q) + 0.5, 1e-3)
    share = np.abs(answer.reference) / panda.velocity_limits
    assert share.max() == pytest.approx(0.9)


# -- the measurement ------------------------------------------------------------------------------


def test_the_torque_does_not_depend_on_the_true_robot(panda_law, panda):
    """With the measurement held it has nothing to know it by; nor does x enter control."""
    task, q, rng = panda_law.task, STARTS["panda"], np.random.default_rng(1)
    target = aj.Target(task.value(q) + 0.1, np.full(3, 0.1), np.zeros(3))
    measurement = measured(task, q, rng.normal(size=7))
    state = panda_law.initial_state(measurement)
    after, answer = panda_law.step(state, measurement, target, 1e-3)
    truth = panda.with_object(0.2, 1.0, axis="x")
    other = known(aj.PositionTask(truth))
    aj.simulate(aj.Plant(truth), other, [0.4, 0.0, 0.5], q, 5e-3)
    again, same = panda_law.step(state, measurement, target, 1e-3)
    assert_array_equal(answer.torque, same.torque)
    assert_array_equal(after, again)
    moved, n = measurement._replace(x=measurement.x + 1.0), panda_law.size
    other, elsewhere = panda_law.step(state, moved, target, 1e-3)
    assert_array_equal(elsewhere.torque, answer.torque)
    assert_array_equal(other[:n], after[:n])
    assert_allclose(elsewhere.e, answer.e + 1.0)


def test_control_goes_on_where_x_is_lost(panda_law):
    task, q = panda_law.task, STARTS["panda"]
    seen, lost = (measured(task, q, x=x) for x in (task.value(q), np.full(3, np.nan)))
    state, target = panda_law.initial_state(lost), task.value(q) + 0.1
    _, answer = panda_law.step(state, seen, target, 1e-3)
    _, unseen = panda_law.step(state, lost, target, 1e-3)
    assert_array_equal(answer.torque, unseen.torque)
    assert unseen.status is aj.Status.PREDICTED
    assert np.isnan(unseen.e).all()


def test_a_point_that_the_believed_camera_does_not_see_brings_the_arm_to_rest(panda):
    camera = aj.PinholeCamera.looking_at((3.0, 0.0, 0.4), (2.0, 0.0, 0.4), 600.0, (640, 480))
    seeing = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, 0.0, 0.4), 600.0, (640, 480))
    robot = panda
    task = aj.ImageTask(robot, seeing)
    law_ = known(task, dynamics=ModelDynamics(robot))
    vars(law_)["kinematics"] = Unseeing(task)
    assert camera is not seeing
    q, v = STARTS["panda"], np.full(7, 0.1)
    _, answer = law_.step(np.zeros(0), measured(task, q, v), task.value(q), 1e-3)
    assert answer.status is aj.Status.NOT_PREDICTED
    assert_array_equal(answer.reference, 0.0)
    assert np.isfinite(answer.torque).all()


class Unseeing(KnownKinematics):
    """Kinematics that predict nothing."""

    def predict(self, state, q, v, target):
        return super().predict(state, q, v, target)._replace(z=np.full(self.task.m, np.nan))


def test_by_default_tool_origins_and_axes_are_learnt(panda):
    """A tool of 20 cm and 1 kg that nobody told of, and a circle with it: 277 mm, then 1 mm."""
    truth, q0 = panda.with_object(0.2, 1.0, axis="x"), STARTS["panda"]
    task, sensor = aj.PositionTask(panda), aj.PositionTask(truth)
    controller = aj.TrackingController(task)
    assert controller.kinematics.unknown == ("tool", "origins", "axes")
    plant = aj.Plant(truth, sensor, sensing=aj.Sensing(x_noise=1e-3, x_rate=60.0))
    run = aj.simulate(plant, controller, circle(sensor, q0), q0, 4.0, record_every=0.01)
    assert run.error_norm[0] > 0.18
    assert np.sqrt(np.mean(run.error_norm[300:] ** 2)) < 3e-3
    learnt = controller.learnt(run.state[-1])
    assert len(learnt) == controller.resting + len(controller.kinematics.names)


@pytest.mark.parametrize("command", ["torque", pytest.param("velocity", marks=pytest.mark.study)])
def test_nonsense_is_answered_finitely_or_refused_while_kinematics_learn(panda, command):
    """One number in some of the steps is absurd; the state goes on from what came before."""
    task, q0, rng = aj.PositionTask(panda), STARTS["panda"], np.random.default_rng(3)
    kinematics = AdaptiveKinematics(task, delay=2e-3)
    law_ = TrackingController(task, kinematics=kinematics, command=command)
    limited = aj.TorqueLimited(law_) if command == "torque" else law_
    limited = limited.guarded(None)  # which would refuse most of it
    state, refused = limited.initial_state(measured(task, q0)), 0
    absurd = [np.nan, np.inf, -np.inf, 5e-324, 1e16, -1e29, 1e31, 1e154, -1e308]
    for k in range(300):
        q, v = q0 + 0.1 * rng.normal(size=7), 0.3 * rng.normal(size=7)
        told = {"q": q, "v": v, "x": task.value(q) + 0.01 * rng.normal(size=3)}
        if rng.random() < 0.5:
            spoilt = told[rng.choice(list(told))]
            spoilt[rng.integers(len(spoilt))] = rng.choice(absurd)
        measurement = aj.Measurement(k * 1e-3, **told)
        try:
            after, answer = limited.step(state, measurement, task.value(q0) + 0.1, 1e-3)
        except aj.errors.ApproxJacError:
            refused += 1
        else:
            assert np.isfinite(answer.torque).all()
            assert np.isfinite(after).all()
            state = after
    assert 25 < refused < 125


def test_other_tasks_need_kinematics(panda):
    nonsingular = NonsingularTask(aj.PositionTask(panda), {"panda_joint4": 0.3}, ratio=0.9)
    with pytest.raises(aj.InvalidInputError, match=r"kinematics must be given for Nonsing.*Known"):
        aj.TrackingController(nonsingular)


# -- velocities -----------------------------------------------------------------------------------


@pytest.mark.study
def test_velocity_commands_stay_within_limits(panda):
    task, q0 = aj.PositionTask(panda), STARTS["panda"]
    controller = known(task, command="velocity", dt=4e-3)
    assert controller.command == "velocity"
    state = controller.initial_state(measured(task, q0))
    assert controller.size == 22
    path, q, before = circle(task, q0), q0, np.zeros(7)
    most = np.minimum(sure_deceleration(panda, panda.effort_limits), 10.0 * panda.velocity_limits)
    errors = []
    for k in range(1500):  # an ideal servo
        target = path.at(k * 4e-3)
        now = measured(task, q, before)._replace(t=k * 4e-3)
        state, answer = controller.step(state, now, target, 4e-3)
        assert (np.abs(answer.torque - before) <= 4e-3 * most + 1e-12).all()
        assert (np.abs(answer.torque) <= panda.velocity_limits).all()
        before = answer.torque
        q = q + 4e-3 * before
        errors.append(np.linalg.norm(answer.e))
    assert max(errors[1000:]) < 1e-5  # at 0.16 m/s; by q̇, which is a period late, 0.3 mm
    assert controller.learnt(state) == pytest.approx([2e-3], abs=1e-4)
    low, _ = panda.position_limits
    near = q0.copy()
    near[3] = low[3] + 1e-3
    slow = measured(task, near)
    state = controller.initial_state(slow)
    _, answer = controller.step(state, slow, task.value(near) - [0.5, 0.0, 0.0], 4e-3)
    assert answer.torque[3] >= -5e-3 - 1e-12  # towards a stop that is 1 mrad away


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "filtered", "late"),
    [
        ("z1", 2e-3, 5e-3),
        ("panda", 5e-3, 2e-3),
        ("ur10", 2e-3, 5e-3),
        ("xarm7", 8e-3, 1e-3),
    ],
)
def test_a_lag_of_rigid_joints_slows_what_is_learnt(name, filtered, late):
    """Learning at twice κ throws each of these arms."""
    arm = aj.load_robot(name)
    truth, belief = arm.with_object(0.2, 0.5, axis="x"), arm.with_object(0.0)
    sensing = aj.Sensing(velocity_filter=filtered)
    plant = aj.Plant(truth, sensing=sensing, actuator_delay=late)
    latency = aj.Latency(velocity_filter=filtered, torque_delay=late)
    rigid = aj.robots.Drives()
    law = aj.TrackingController(aj.PositionTask(belief), latency=latency, drives=rigid)
    q0 = plant.ready_configuration()
    x_d = plant.sensor.value(q0) + [0.1, -0.15, 0.1]
    run = aj.simulate(plant, law, x_d, q0, 5.0)
    assert run.error_norm[run.t > 4.8].max() < 1e-3
    assert np.abs(run.v[run.t > 3.0]).max() < 0.5
    assert all(event.end < 2.0 for event in run.events)
    assert f"{latency.of_velocity:.2g} s taken for granted" in str(law)


@pytest.mark.parametrize(
    ("lag", "delay"),
    [
        (0.03, 0.008),
        pytest.param(0.01, 0.0, marks=pytest.mark.long),
        pytest.param(0.05, 0.02, marks=pytest.mark.study),
    ],
)
def test_the_lag_of_a_servo_is_learnt(lag, delay):
    """Delay and half a period count as lag; without it the circle is 3 mm behind."""
    robot, q0 = aj.load_robot("ur5"), STARTS["ur5"]
    task, dt = aj.PositionTask(robot), 8e-3
    servo = VelocityServo(lag=lag, delay=delay, period=dt)
    controller = known(task, command="velocity", dt=dt)
    run = aj.simulate(aj.Plant(robot, servo=servo), controller, circle(task, q0), q0, 6.0, dt=dt)
    assert run.error_norm[500:].max() < 4e-4  # 0.09 to 0.28 mm
    learnt = controller.learnt(run.state[-1])
    assert learnt == pytest.approx([lag + delay + 0.5 * dt], abs=4e-3)


@pytest.mark.parametrize("dt", [2e-3, 8e-3])
def test_a_late_velocity_is_no_lag_of_the_servo(dt):
    """Of joints without stops, too. By q̇, which is often filtered, it was 1 mm behind."""
    robot = aj.load_robot("kinova")
    task, q0 = aj.PositionTask(robot), robot.configuration([0.3, 3.6, 1.8, 0.5, 0.6, 0.4])
    servo, sensing = VelocityServo(lag=0.015, period=dt), aj.Sensing(velocity_filter=8e-3)
    controller = known(task, command="velocity", dt=dt)
    plant = aj.Plant(robot, servo=servo, sensing=sensing)
    path = aj.Circle(task.value(q0) + [0.0, -0.05, 0.0], 0.05, 3.0, normal=(1.0, 0.0, 0.0))
    run = aj.simulate(plant, controller, path, q0, 6.0, dt=dt)
    assert run.error_norm[run.t > 4.5].max() < 5e-5
    expected = servo.lag + servo.delay + 0.5 * dt
    assert controller.learnt(run.state[-1]) == pytest.approx([expected], abs=3e-4)


@pytest.mark.study
def test_noise_of_the_velocity_is_no_lag():
    """Neither encoders of 12 bits, whose differences are noisy, nor their filter, 10 ms late."""
    robot, q0, dt = aj.load_robot("ur5"), STARTS["ur5"], 8e-3
    task = aj.PositionTask(robot)
    sensing = aj.Sensing(velocity_filter=0.01, q_quantum=2.0 * np.pi / 4096)
    plant = aj.Plant(robot, servo=VelocityServo(), sensing=sensing)
    controller = known(task, command="velocity", dt=dt)
    run = aj.simulate(plant, controller, circle(task, q0), q0, 6.0, dt=dt)
    servo = plant.servo
    expected = servo.lag + servo.delay + 0.5 * dt
    assert controller.learnt(run.state[-1]) == pytest.approx([expected], abs=2e-3)


@pytest.mark.parametrize("limited", ["", "acceleration", "speed", "position", "of one joint"])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_lag_is_learnt_where_the_command_is_what_was_wanted_and_nowhere_else(
    panda, limited, side
):
    limits, dt = aj.Limits.of(panda).for_joints(7), 4e-3
    command = VelocityCommand(panda, limits, dt)
    q, v_r, w, lag = STARTS["panda"], side * np.full(7, 0.1), side * np.full(7, 2.0), 0.02
    wanted, change = v_r + lag * w, dt * command.acceleration
    v, before, expected = v_r - side * 0.05, wanted.copy(), wanted.copy()
    if limited == "acceleration":
        before = wanted - side * 2.0 * change
        expected = before + side * change
    if limited == "of one joint":
        before[3] -= side * 2.0 * change[3]
        expected[3] = before[3] + side * change[3]
    if limited == "speed":
        v_r = before = side * 1.1 * np.asarray(limits.velocity)
        v, expected = v_r - side * 0.05, side * np.asarray(limits.velocity)
        expected = np.where(np.abs(before - expected) > change, before - side * change, expected)
    if limited == "position":
        low, high = limits.position
        q, before = (high - 1e-3 if side > 0.0 else low + 1e-3), 0.0 * v
        expected = side * np.minimum(5e-3, change)  # 5/s of what is left
    led = v_r - side * 0.02  # a period before; q went at the speed v since
    memory = np.concatenate([before, q - dt * v, led])
    after, memory = command.step(np.array([lag]), memory, q, v_r, w)
    sent = memory[:7]
    assert_allclose(sent, expected, rtol=1e-9)
    assert_array_equal(memory[7:], np.concatenate([q, v_r]))
    rate = -w @ (v - 0.5 * (led + v_r))  # of V₃, with a gain of one
    assert rate > 0.5
    assert_allclose(after, lag if limited else lag + dt * rate, rtol=1e-12)


@pytest.mark.parametrize(("faster", "end"), [(0.5, 0.0), (-0.5, 0.1)])
def test_a_lag_is_learnt_within_what_servos_have(panda, faster, end):
    limits = aj.Limits.of(panda).for_joints(7)
    command, lag = VelocityCommand(panda, limits, 4e-3), np.array([0.05])
    v_r, w = np.full(7, 0.1), np.full(7, 2.0)
    for _ in range(10):
        q, before = STARTS["panda"], v_r + lag * w
        memory = np.concatenate([before, q - 4e-3 * (v_r + faster), v_r])
        lag, _ = command.step(lag, memory, q, v_r, w)
    assert lag == [end]


def test_the_first_command_goes_on_from_the_speed_that_there_is(panda):
    task, q, v = aj.PositionTask(panda), STARTS["panda"], np.linspace(-0.5, 0.5, 7)
    controller = known(task, command="velocity", dt=4e-3)
    here = measured(task, q, v)
    change = 4e-3 * VelocityCommand(panda, aj.Limits.of(panda).for_joints(7), 4e-3).acceleration
    for state in (
        controller.initial_state(here),
        controller.resumed(controller.initial_state(measured(task, q)), here),
    ):
        _, answer = controller.step(state, here, here.x, 4e-3)
        assert (np.abs(answer.torque - v) <= change + 1e-12).all()


@pytest.mark.parametrize("name", ["panda", "kinova"])
def test_an_arm_that_moves_as_wanted_from_the_start_shows_no_lag(name, rng):
    robot, dt = aj.load_robot(name), 8e-3
    command = VelocityCommand(robot, aj.Limits.of(robot).for_joints(robot.nv), dt)
    q = robot.random_configuration(rng)
    v, w = np.full(robot.nv, 0.2), rng.normal(size=robot.nv)
    lag, _ = command.step(np.array([0.02]), command.start(q, v), q, v, 0.1 * w)
    assert_allclose(lag, 0.02, atol=1e-12)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_beside_continuous_joints_others_are_slowed_down_at_their_stops(side):
    robot = aj.load_robot("kinova")
    limits, ends = aj.Limits.of(robot).for_joints(6), robot.position_limits
    command = VelocityCommand(robot, limits, 8e-3)
    with_stops = np.isfinite(ends[0])
    assert with_stops.any()
    assert not with_stops.all()
    angles = np.where(with_stops, ends[1] if side > 0.0 else ends[0], 2.0) - side * 1e-3
    v_r = side * np.full(6, 0.05)
    q = robot.configuration(angles)
    _, memory = command.step(np.zeros(1), command.start(q, v_r), q, v_r, np.zeros(6))
    sent = memory[:6]
    slowed = np.maximum(5e-3, 0.05 - 8e-3 * command.acceleration)
    assert_allclose(side * sent, np.where(with_stops, slowed, 0.05), rtol=1e-9)


# -- what is taken and what is refused ------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"kinematics": "known"},
            r"kinematics must be AdaptiveKinematics\(task\) or None, got 'kn",
        ),
        ({"dynamics": 3.0}, r"dynamics must be AdaptiveDynamics\(robot\) or ModelDyn"),
        ({"posture": np.zeros(6)}, r"posture must have shape \(7,\) \[rad or m\], got"),
        ({"posture": np.full(7, 90.0)}, "posture must be in radians"),
        (
            {"gains": aj.controllers.TrackingGains(speed=0.0)},
            r"speed must be numbers > 0 \[unit of the task/s\], one or 3, infinite",
        ),
        ({"gains": 60.0}, r"gains must be TrackingGains\(\.\.\.\) or None, got 60.0"),
        ({"dt": 0.0}, r"dt must be a finite number > 0 \[s\], got 0.0"),
        ({"command": "position"}, 'command must be "torque" or "velocity", got \'position\''),
    ],
)
def test_what_does_not_fit_is_refused(panda, changes, message):
    with pytest.raises(aj.InvalidInputError, match=message):
        TrackingController(aj.PositionTask(panda), **changes)


def test_parts_of_another_robot_are_refused(panda):
    ur5 = aj.load_robot("ur5")
    task = aj.PositionTask(panda)
    with pytest.raises(aj.InvalidInputError, match="kinematics must be of the task PositionTask"):
        TrackingController(task, kinematics=KnownKinematics(aj.PositionTask(ur5)))
    with pytest.raises(aj.InvalidInputError, match="dynamics must be of the task PositionTask"):
        known(task, dynamics=ModelDynamics(ur5))
    with pytest.raises(aj.InvalidInputError, match="posture is for arms with more joints than"):
        known(aj.PoseTask(ur5), posture=np.zeros(6))


def test_wrappers_take_it_or_say_why_not(panda_law):
    with pytest.raises(aj.InvalidInputError, match=r"controls the measured x, got Tracking.* pred"):
        aj.HeldMeasurement(panda_law, 0.05)
    with pytest.raises(aj.InvalidInputError, match=r"controls the measured x, got TorqueL.* pred"):
        aj.HeldMeasurement(aj.TorqueLimited(panda_law), 0.05)
    with pytest.raises(aj.InvalidInputError, match=r"inside.* TorqueLimited\(\.\.\., dt=0\.001"):
        aj.TorqueLimited(panda_law, dt=2e-3)
    limited = aj.TorqueLimited(panda_law)
    seen = measured(panda_law.task, STARTS["panda"])
    state = limited.initial_state(seen)
    with pytest.raises(aj.InvalidInputError, match=r"state must have shape \(\d+,\)"):
        panda_law.resumed(state, seen)
    assert_allclose(limited.resumed(state, seen), state)
    velocity = known(panda_law.task, command="velocity")
    with pytest.raises(aj.InvalidInputError, match=r'must command torques .*"velocity"'):
        aj.TorqueLimited(velocity)


def test_another_dt_is_refused(panda_law):
    q = STARTS["panda"]
    measurement = measured(panda_law.task, q)
    state = panda_law.initial_state(measurement)
    with pytest.raises(aj.InvalidInputError, match=r"dt must be that of the controller, 0.001 \[s"):
        panda_law.step(state, measurement, measurement.x, 2e-3)


def test_the_belief_can_be_changed_where_it_is_not_given(panda):
    other = aj.PositionTask(panda.with_object(0.1, 0.2))
    changed = TrackingController(aj.PositionTask(panda)).with_task(other)
    assert changed.dynamics.robot is other.robot
    assert changed.kinematics.task is other
    task = aj.PositionTask(panda)
    for name, part in (("kinematics", KnownKinematics(task)), ("dynamics", ModelDynamics(panda))):
        given = TrackingController(task, **{name: part})
        with pytest.raises(aj.InvalidInputError, match=f"{name} must be left to the controller"):
            given.with_task(other)


def test_it_is_copied_with_memory_of_its_own(panda_law):
    other = copy.deepcopy(panda_law)
    assert other.dynamics is not panda_law.dynamics
    measurement = measured(panda_law.task, STARTS["panda"])
    state = panda_law.initial_state(measurement)
    _, one = panda_law.step(state, measurement, measurement.x + 0.1, 1e-3)
    _, two = other.step(state, measurement, measurement.x + 0.1, 1e-3)
    assert_array_equal(one.torque, two.torque)
    assert_array_equal(panda_law.learnt(state), panda_law.dynamics.initial_state())


# -- the gain ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["panda", "ur5", "xarm7", "so101", "two_link"])
@pytest.mark.parametrize("dt", [1e-3, 8e-3])
def test_the_gain_is_stable_in_samples_for_an_arm_without_rotors(name, dt):
    """κ dt λ_max(M⁻¹M̂) ≤ 0.5, although drives are assumed that the URDF does not have."""
    robot = aj.load_robot(name)
    controller = known(aj.PositionTask(robot), dt=dt)
    rng, most = np.random.default_rng(1), 0.0
    for _ in range(20):
        M = Dynamics(robot).M(robot.random_configuration(rng))
        ratio = np.linalg.eigvals(np.linalg.solve(M, M + np.diag(controller._added))).real.max()
        most = max(most, controller.kappa * dt * ratio)
    assert most <= 0.55
    if name == "panda" and dt == 1e-3:
        assert controller.kappa == 60.0
        assert (controller._added > 0.01).all()


def test_told_rotors_are_in_the_gain_and_in_what_is_learnt(panda):
    controller = known(aj.PositionTask(panda), dynamics=AdaptiveDynamics(panda, rotor_inertia=0.1))
    assert_array_equal(controller._added, 0.0)
    q = STARTS["panda"]
    v = np.arange(7.0)
    M = Dynamics(panda).M(q)
    assert_allclose(controller.dynamics.inertia(q) @ v, M @ v + 0.1 * v)
    regressor = controller.dynamics.regressor
    rotors = controller.dynamics.initial_state()[regressor.links : regressor.links + 7]
    assert_array_equal(rotors, 0.1)


@pytest.mark.parametrize("kind", [ModelDynamics, AdaptiveDynamics])
def test_told_rotors_are_in_the_torque_of_a_motion(panda, rng, kind):
    q, (v, v_r, a_r) = STARTS["panda"], rng.normal(size=(3, 7))
    rotors = np.linspace(0.1, 0.4, 7)
    dynamics, arm = kind(panda, rotor_inertia=rotors), Dynamics(panda)
    state = dynamics.initial_state()
    after, torque, g = dynamics.step(state, q, v, v_r, a_r, False, 1e-3)
    expected = (arm.M(q) + np.diag(rotors)) @ a_r + arm.C(q, v) @ v_r + arm.g(q)
    assert_allclose(torque, expected, atol=1e-9)
    assert_allclose(g, arm.g(q), atol=1e-9)
    assert_allclose(dynamics.gravity(state, q), arm.g(q), atol=1e-9)
    assert_array_equal(after, state)


def test_what_is_learnt_in_a_step_is_in_its_torque(panda, rng):
    q, (v, v_r, a_r), dt = STARTS["panda"], rng.normal(size=(3, 7)), 4e-3
    dynamics = AdaptiveDynamics(panda, rotor_inertia=0.1)
    state, Y_d = dynamics.initial_state(), dynamics.regressor.Y_d(q, v, v_r, a_r)
    after, torque, g = dynamics.step(state, q, v, v_r, a_r, True, dt)
    change = -dt * dynamics.gamma * (Y_d.T @ (v - v_r))
    joints = slice(dynamics.regressor.links, dynamics.regressor.links + 21)
    change[joints] = np.maximum(change[joints], -state[joints])  # of rotors and friction
    assert_allclose(after, state + change, rtol=1e-9)
    assert_allclose(torque, Y_d @ after)
    assert_allclose(g, dynamics.gravity(after, q))
    assert np.abs(torque - Y_d @ state).max() > 1e-3


@pytest.mark.parametrize("name", ["panda", "xarm7", "tiago_arm"])
def test_nothing_learns_faster_than_the_loop_stands(name):
    """A wrist of 5e-6 kg m², as in TIAGo's URDF, would have swung at 8000/s."""
    robot = aj.load_robot(name)
    dynamics = TrackingController(aj.PositionTask(robot)).dynamics
    assert dynamics.fastest == 120.0
    rates = squared_rates(*usual_motions(dynamics.regressor), dynamics.gamma)
    assert np.sqrt(rates.max()) <= 120.0 * (1.0 + 1e-9)
    reduced = dynamics.gamma < 0.999 * dynamics.gain * dynamics.sd**2
    dry = np.array([each.endswith(".coulomb") for each in dynamics.parameters])
    assert (not reduced[~dry].any()) == (name == "panda")


@pytest.mark.parametrize("name", ["panda", "ur10", "kinova", "so101"])
def test_what_an_arm_carries_is_learnt_at_one_rate_whatever_it_weighs(name):
    """From half a kilogram to thirty; with one gain for all it was 2/s to 25/s."""
    dynamics = AdaptiveDynamics(aj.load_robot(name))
    motions, links = (
        usual_motions(dynamics.regressor),
        slice(dynamics.regressor.links),
    )
    gamma = dynamics.gamma[links]
    rates = [
        np.trace(Y[:, links] * gamma @ Y[:, links].T) / np.trace(np.linalg.inv(M_inv))
        for Y, M_inv in zip(*motions, strict=True)
    ]
    assert 10.0 < np.sqrt(np.median(rates)) < 16.1
    # nothing is made faster than κ by it
    alone = np.sqrt(squared_rates(*motions, dynamics.gamma)[links])
    at_20 = np.sqrt(squared_rates(*motions, 20.0 * dynamics.sd**2)[links])
    assert (alone <= np.maximum(60.0, at_20) * (1.0 + 1e-9)).all()


@pytest.mark.study
def test_a_light_arm_learns_the_weight_of_its_object():
    """50 g in the jaws of 500 g: 1.8 mm RMS with the gain of a Panda, and more later on."""
    arm = aj.load_robot("so101")
    truth, q = arm.with_object(0.05, 0.05), np.array([0.0, -0.5, 0.6, 0.5, 0.0])
    task = aj.PositionTask(truth)
    law_ = known(task, dynamics=AdaptiveDynamics(arm))
    path = aj.Circle(task.value(q) - [0.04, 0.0, 0.0], 0.04, 4.0)
    run = aj.simulate(
        aj.Plant(truth, task),
        law_,
        path,
        q,
        4.0,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    assert np.sqrt(np.mean(run.error_norm[run.t > 2.0] ** 2)) < 1e-3


def test_what_is_learnt_stays_within_bounds(panda, rng):
    dynamics = AdaptiveDynamics(panda)
    object.__setattr__(dynamics, "gamma", 5e4 * dynamics.gamma)
    a, q = dynamics.initial_state(), STARTS["panda"]
    for _ in range(50):
        a, torque, _ = dynamics.step(a, q, *rng.normal(size=(3, 7)), True, 1e-3)
        assert np.isfinite(torque).all()
    links = dynamics.regressor.links
    assert (np.abs(a - dynamics.initial_state()) <= 20.0 * dynamics.sd + 1e-12).all()
    assert (a[links : links + 21] >= 0.0).all()
    assert_allclose(dynamics.sd[:10], [0.505, *[0.111] * 3, *[0.0244] * 6], rtol=0.02)
