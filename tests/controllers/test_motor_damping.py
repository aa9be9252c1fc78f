"""Damping that motors behind elastic gears allow, and the tracking law that keeps it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm

import approxjac as aj
from approxjac import law
from approxjac.codegen.step import compiled
from approxjac.controllers import (
    AdaptiveDynamics,
    KnownKinematics,
    ModelDynamics,
    TrackingGains,
)
from approxjac.controllers.gains.motors import (
    JointGains,
    integral_rate,
    largest_inertia,
    largest_rate,
    least_rotors,
    motor_damping,
    slow_feedback,
)
from approxjac.robots import Drives, Dynamics, Friction
from approxjac.simulation import Computation

LATE = aj.Latency(
    1e-3, torque_delay=1e-3, velocity_filter=5e-3, image_period=1 / 60, image_age=0.03
)

HOME = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


@pytest.fixture(scope="module")
def task(panda):
    return aj.PositionTask(panda.with_object(0.0))


# -- the rate c ----------------------------------------------------------------------------------


def largest_stable(J, M, K, damping_ratio, delay, filtered, integral):
    """The least k at which k(1 + i/s) P(s) exp(−sT_d)/(1 + sT_f) passes −1, by a fine grid."""
    reduced = J * M / (J + M)
    D, resonance = 2.0 * damping_ratio * np.sqrt(K * reduced), np.sqrt(K / reduced)
    omega = np.unique(np.concatenate([
        np.geomspace(1.0, 20.0 / delay, 20000),
        resonance * np.linspace(0.7, 1.3, 20000),  # a resonance is narrow
    ]))  # fmt: skip
    s = 1j * omega
    P = (M * s**2 + D * s + K) / (s * (M * J * s**2 + (M + J) * (D * s + K)))
    loop = (1.0 + integral / s) * P * np.exp(-s * delay) / (1.0 + s * filtered)
    crosses = (loop.imag[:-1] * loop.imag[1:] < 0.0) & (loop.real[:-1] < 0.0)
    return 1.0 / np.abs(loop.real[:-1][crosses]).max()


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize(
    ("torque_delay", "velocity_filter"), [(0.0, 0.0), (1e-3, 0.0), (1e-3, 5e-3), (2e-3, 8e-3)]
)
def test_no_joint_is_unstable_below_c_and_one_is_above(torque_delay, velocity_filter, learns, rng):
    """Any link, spring and rotor, over three decades; the bound is tight."""
    late = aj.Latency(1e-3, torque_delay, velocity_filter)
    integral = integral_rate(late) if learns else 0.0
    c = largest_rate(late, integral=integral)
    delay = torque_delay + 0.5e-3 + (0.5e-3 if velocity_filter else 0.0)
    shares = []
    for _ in range(150):
        J, M, K = 10.0 ** rng.uniform((-2.0, -2.0, 2.0), (0.5, 1.0, 6.0))
        shares.append(largest_stable(J, M, K, 0.05, delay, velocity_filter, integral) / (c * J))
    assert min(shares) > 0.8
    assert min(shares) < 1.3


@pytest.mark.parametrize("late", [(4e-3, 1e-3, 0.02), (2.5e-3, 7e-3, 0.0)])
@pytest.mark.parametrize("share", [0.0, 0.4, 0.8])
def test_behind_gears_that_do_not_ring_c_is_the_gain_margin_of_a_rotor_alone(late, share):
    """To all digits: the gain at which (1 + i/s) exp(−sT_d)/(s(1 + sT_f)) passes −1."""
    period, torque_delay, filtered = late
    delay = torque_delay + (period if filtered else 0.5 * period)
    integral = share / (delay + filtered)

    def loop(omega):
        s = 1j * omega
        return (1.0 + integral / s) * np.exp(-s * delay) / (s * (1.0 + s * filtered))

    omega = np.linspace(0.2, 30.0, 100_001) / (delay + filtered)
    (at,) = np.flatnonzero(np.diff(np.sign(loop(omega).imag)) > 0.0)[:1]
    crosses = np.interp(0.0, loop(omega[at : at + 2]).imag, omega[at : at + 2])
    margin = 1.0 / np.abs(loop(crosses))
    assert_allclose(largest_rate(aj.Latency(*late), 1.0, integral), margin, rtol=1e-6)


def test_damping_grows_with_rotors_and_shrinks_with_lag(panda):
    told, later = motor_damping(panda, LATE, Drives(0.2, 1e4)), aj.Latency(1e-3, 2e-3, 5e-3)
    assert_allclose(told, 0.75 * largest_rate(LATE) * 0.2)  # a quarter less than it may be
    assert_allclose(motor_damping(panda, LATE, Drives(0.4, 1e4)), 2.0 * told)
    assert (motor_damping(panda, later, Drives(0.2, 1e4)) < told).all()
    assert np.isinf(motor_damping(panda, LATE, Drives().of(panda))).all()
    assert (least_rotors(panda) < 0.06).all()
    assert (least_rotors(panda) > 0.0).all()
    undamped = motor_damping(panda, LATE, Drives(0.2, 1e4, damping_ratio=0.0))
    assert (undamped > 0.0).all()


# -- K_σ -----------------------------------------------------------------------------------------


def test_bounded_damping_is_symmetric_and_below_both(rng):
    for _ in range(50):
        root = rng.normal(size=(6, 6))
        A, most = root @ root.T + 0.01 * np.eye(6), 10.0 ** rng.uniform(-2.0, 2.0, 6)
        K = np.array([law.bounded_damping(A, A @ unit, most) for unit in np.eye(6)]).T
        assert_allclose(K, K.T, atol=1e-9 * np.abs(K).max())
        for less in (K, A - K, np.diag(most) - K):
            assert np.linalg.eigvalsh(0.5 * (less + less.T)).min() > -1e-8 * np.abs(A).max()


def test_rates_are_as_of_rigid_joints_unless_a_lag_or_drives_are_told(task):
    plain, told = aj.TrackingController(task), aj.TrackingController(task, latency=LATE)
    assert (plain.alpha, plain.kappa) == (6.0, 60.0)
    assert "taken for granted" in str(plain)
    assert told.alpha < 2.0
    assert "damping at most" in " ".join(str(told).split())
    known = aj.TrackingController(task, latency=LATE, drives=Drives.usual(task.robot))
    assert known.alpha > 2.0 * told.alpha  # motors of 0.4 kg m² may damp more
    own = aj.TrackingController(task, latency=LATE, gains=TrackingGains(alpha=3.0))
    assert own.alpha == 3.0
    rigid = aj.TrackingController(task, latency=LATE, drives=Drives())
    assert rigid.kappa == min(60.0, 0.5 / LATE.of_velocity)


def test_the_gain_at_a_motor_is_within_what_it_allows(task, rng):
    """By finite differences of the torque by σ: K_σ ≤ B in each direction."""
    controller = aj.TrackingController(task, latency=LATE)
    q, v = task.robot.random_configuration(rng), np.zeros(7)
    x = task.value(q)
    state = controller.begin(aj.Measurement(0.0, q, v, x, 0.0))
    told = [
        controller.advance(state, aj.Measurement(0.0, q, v + 1e-6 * dv, x, 0.0), x, 1e-3)[1].torque
        for dv in (np.zeros(7), *np.eye(7))
    ]
    gain = -(np.array(told[1:]) - told[0]).T / 1e-6
    most = motor_damping(task.robot, LATE, None, integral_rate(LATE))
    # with αM̂ of the reference acceleration, which the posture's rate may add to
    felt = np.linalg.eigvals(gain / np.sqrt(most[:, None] * most)).real.max()
    assert felt < 1.2


def test_the_damping_of_an_arm_with_unknown_rotors_is_symmetric_and_within_it(task, rng):
    """K_σ alone, by differences of the torque: nearly without α, n₀ and what is learnt."""
    controller = aj.TrackingController(
        task, latency=LATE, kinematics=KnownKinematics(task), dynamics=ModelDynamics(task.robot),
        gains=TrackingGains(alpha=1e-6, self_motion=0.0),
    )  # fmt: skip
    q, state = task.robot.random_configuration(rng), np.zeros(controller.n_state)
    x = task.value(q)
    K = np.array([
        controller.advance(state, aj.Measurement(0.0, q, -1e-4 * way, x, 0.0), x, 1e-3)[1].torque
        - controller.advance(state, aj.Measurement(0.0, q, 1e-4 * way, x, 0.0), x, 1e-3)[1].torque
        for way in np.eye(7)
    ]) / 2e-4  # fmt: skip
    assert_allclose(K, K.T, atol=1e-5 * np.abs(K).max())
    most = motor_damping(task.robot, LATE, None, integral_rate(LATE))
    assert np.linalg.eigvalsh(K / np.sqrt(most[:, None] * most)).max() < 1.0


def test_constants_are_learnt_as_an_integral_that_the_lag_bears(task):
    """At the rate iK_σ, K_σ within what motors allow; the rest as it would be without."""
    late = aj.TrackingController(task, latency=LATE)
    dynamics, most, n = late.dynamics, late._most, 7
    without = AdaptiveDynamics(
        task.robot, rotor_inertia=dynamics.rotor_inertia, fastest=dynamics.fastest,
        most_damping=most,
    )  # fmt: skip
    assert_allclose(dynamics.gamma[: -2 * n], without.gamma[: -2 * n])
    spring, before = (each.gamma[-2 * n :].reshape(2, n).sum(0) for each in (dynamics, without))
    assert (spring <= integral_rate(LATE) * most).all()
    assert (spring > 0.3 * integral_rate(LATE) * most).all()
    assert (spring >= before).all()
    assert (spring[:2] > 4.0 * before[:2]).all()  # of the joints that carry the arm


@pytest.mark.parametrize(
    "wrong", [{"latency": 1e-3}, {"drives": 0.1}, {"drives": Drives(0.0, 1e3)}]
)
def test_what_is_no_lag_or_no_drives_is_refused(task, wrong):
    with pytest.raises(aj.InvalidInputError):
        aj.TrackingController(task, **wrong)


def test_compiled_steps_have_the_same_damping(task, rng):
    controller = aj.TrackingController(task, latency=LATE, kinematics=KnownKinematics(task))
    step = compiled(controller)
    q, v = task.robot.random_configuration(rng), rng.normal(0.0, 0.3, 7)
    measured = aj.Measurement(0.0, q, v, task.value(q), 0.0)
    target = measured.x + [0.05, 0.0, -0.05]
    state = controller.begin(measured)
    ours = controller.step(state, measured, target, 1e-3)
    theirs = step.step(state, measured, target, 1e-3)
    assert_allclose(theirs[0], ours[0], rtol=1e-9, atol=1e-9)
    assert_allclose(theirs[1].torque, ours[1].torque, rtol=1e-9, atol=1e-9)


# -- gains of the set-point law -------------------------------------------------------------------


def felt_by_motors(law_, most, postures=60):
    """The largest eigenvalues of B^-1/2 (JᵀK_vJ + B_c) B^-1/2 at random postures."""
    task, (_, kv, damping) = law_.task, law_.diagonals
    rng, found = np.random.default_rng(5), []
    for _ in range(postures):
        J = task.jacobian(task.robot.random_configuration(rng)) / np.sqrt(most)
        found.append(np.linalg.eigvalsh(J.T * kv @ J + np.diag(damping / most))[-1])
    return np.array(found)


@pytest.mark.parametrize("arm", ["panda", "ur10"])
@pytest.mark.parametrize("drives", [None, Drives(0.2, 1e4)])
def test_damping_of_a_set_point_law_is_within_what_motors_allow(arm, drives):
    task = aj.PositionTask(aj.load_robot(arm).with_object(0.0))
    most = motor_damping(task.robot, LATE, drives)
    controller = aj.SetpointController(task, latency=LATE, drives=drives)
    assert np.mean(felt_by_motors(controller, most) <= 1.0) >= 0.9
    as_rigid = aj.SetpointController(task, latency=LATE, drives=Drives())
    assert drives is not None or np.median(felt_by_motors(as_rigid, most)) > 1.2


def test_a_set_point_law_counts_springs_only_if_a_lag_or_drives_are_told(task):
    camera = aj.Latency(1e-3, image_period=1 / 60, image_age=0.03)
    for latency in (None, aj.Latency(), camera):
        ours, rigid = (
            aj.SetpointController(task, latency=latency, **told)
            for told in ({}, {"drives": Drives()})
        )
        for gain, as_rigid in zip(ours.diagonals, rigid.diagonals, strict=True):
            assert (gain == as_rigid).all()
    late = aj.SetpointController(task, latency=LATE)
    assert "elastic gears" in str(late)
    known = aj.SetpointController(task, latency=LATE, drives=Drives.usual(task.robot))
    assert (known.diagonals.kp > 3.0 * late.diagonals.kp).all()  # the motors may damp more
    assert "elastic" not in str(aj.SetpointController(task, latency=LATE, drives=Drives()))


def multipliers(controller, rotor, stiffness, latency, q):
    """Of the sampled, delayed loop about q, with springs: its state is (q, q̇, θ, θ̇, …)."""
    (kp, kv, damping), task, dt = controller.diagonals, controller.task, latency.period
    J, M, n = task.jacobian(q), Dynamics(task.robot).M(q), len(damping)
    drives = Drives(rotor, stiffness).of(task.robot)
    K, D = np.diag(np.asarray(drives.stiffness)), np.diag(drives.damping(np.diag(M)))
    M_inv, R_inv = np.linalg.inv(M), np.eye(n) / rotor
    none, eye = np.zeros((n, n)), np.eye(n)
    A = np.vstack([
        np.hstack([none, eye, none, none]),
        np.hstack([-M_inv @ K, -M_inv @ D, M_inv @ K, M_inv @ D]),
        np.hstack([none, none, none, eye]),
        np.hstack([R_inv @ K, R_inv @ D, -R_inv @ K, -R_inv @ D]),
    ])  # fmt: skip
    full = np.zeros((5 * n, 5 * n))
    full[: 4 * n, : 4 * n], full[3 * n : 4 * n, 4 * n :] = A, R_inv
    flow = expm(dt * full)[: 4 * n]
    a, late = dt / (latency.velocity_filter + dt), round(latency.torque_delay / dt)
    # beside those θ and q̇ filtered of the step before, and torques that are late
    size = (6 + late) * n
    rows = np.eye(size).reshape(6 + late, n, size)
    seen = (1.0 - a) * rows[5] + a / dt * (rows[2] - rows[4])
    torque = -(J.T * kp @ J) @ rows[2] - (J.T * kv @ J + np.diag(damping)) @ seen
    acting = [*rows[6:], torque]
    moved = flow @ np.vstack([rows[:4].reshape(-1, size), acting[0]])
    step = np.vstack([moved, rows[2], seen, *acting[1:]])
    return np.abs(np.linalg.eigvals(step))


@pytest.mark.parametrize("arm", ["panda", "ur5", "ur10"])
def test_no_spring_or_rotor_makes_the_sampled_loop_of_a_set_point_law_grow(arm, rng):
    """Fast modes, beyond 1 %/s; as of rigid joints it does."""
    task, late = aj.PositionTask(aj.load_robot(arm).with_object(0.0)), aj.Latency(1e-3, 1e-3, 5e-3)
    ours, rigid = (
        aj.SetpointController(task, latency=late, **told) for told in ({}, {"drives": Drives()})
    )
    grows = []
    for _ in range(6):
        q = task.robot.random_configuration(rng)
        rotor, stiffness = rng.uniform(0.05, 0.3), 10.0 ** rng.uniform(3.5, 4.5)
        assert multipliers(ours, rotor, stiffness, late, q).max() < 1.0 + 1e-5
        grows.append(multipliers(rigid, 0.05, 1e4, late, q).max())
    assert max(grows) > 1.01


# -- in a loop -----------------------------------------------------------------------------------


def followed(arm, true, duration=4.0, **options):
    """A circle with an unknown tool, a late camera and filtered q̇; late errors, and speeds."""
    robot = aj.load_robot(arm)
    truth, belief = robot.with_object(0.2, 0.02 * robot.mass, axis="x"), robot.with_object(0.0)
    sensing = aj.Sensing(x_noise=1e-3, x_rate=60.0, x_delay=0.03, velocity_filter=5e-3)
    plant = aj.Plant(
        truth, sensing=sensing, actuator_delay=1e-3, drives=true,
        torque_limits=robot.effort_limits,
    )  # fmt: skip
    task = aj.PositionTask(belief)
    kinematics = aj.controllers.AdaptiveKinematics(task, noise=1e-3, delay=0.03)
    controller = aj.TrackingController(task, kinematics=kinematics, **options)
    q0 = plant.ready_configuration()
    x0 = plant.sensor.value(q0)
    path = aj.Circle(2.0 * x0 - aj.Circle(x0, 0.1, 4.0).at(0.0).x, 0.1, 4.0)
    run = aj.simulate(
        plant,
        controller,
        path,
        q0,
        duration,
        seed=1,
        computation=Computation("semi_implicit_euler"),
    )
    late = run.t > 0.5 * duration
    return 1e3 * np.sqrt((run.error_norm[late] ** 2).mean()), np.abs(run.v).max()


@pytest.mark.study
@pytest.mark.parametrize(
    ("arm", "rotor", "stiffness"),
    [
        ("talos_arm", 0.1, 1e4),
        pytest.param("panda", 0.05, 1e4, marks=pytest.mark.long),
        pytest.param("panda", 0.1, 3e4, marks=pytest.mark.long),
        pytest.param("ur5", 0.1, 1e4, marks=pytest.mark.long),
        pytest.param("kinova", 0.05, 3e3, marks=pytest.mark.long),
        pytest.param("xarm7", 0.05, 1e4, marks=pytest.mark.long),
        pytest.param("z1", 0.5, 3e3, marks=pytest.mark.long),
    ],
)  # fmt: skip
def test_no_elastic_joint_makes_it_run_away(arm, rotor, stiffness):
    """With rotors that nobody told it of; as of rigid joints it is 0.1 to 0.5 m off."""
    rms, speed = followed(arm, Drives(rotor, stiffness), 6.0, latency=LATE)
    assert rms < 4.5
    assert speed < 2.0


@pytest.mark.study
def test_as_of_rigid_joints_it_runs_away():
    rms, _ = followed("panda", Drives(0.1, 1e4), duration=2.0)
    assert rms > 30.0


@pytest.mark.study
def test_told_gains_rise_too_where_no_joint_swings():
    """Rigid joints stand more than c of the worst spring: 2.3 mm with what rotors allow."""
    light = Drives(0.05)
    rms, _ = followed("ur5", light, 6.0, latency=LATE, drives=light)
    assert rms < 1.0


@pytest.mark.study
@pytest.mark.parametrize(("bits", "filtered"), [(14, 5e-3), (13, 2e-3)])
def test_a_circle_with_joints_that_rub_and_coarse_encoders(bits, filtered):
    """The friction of a UR10e, 2.8 kg at 15 cm and a camera that nobody told of, but the lag."""
    robot = aj.load_robot("ur10")
    coulomb, viscous = (20.9, 19.5, 7.6, 2.9, 3.5, 2.8), (27.9, 19.2, 10.8, 3.2, 2.4, 3.1)
    sensing = aj.Sensing(
        x_noise=1e-3, x_rate=60.0, x_delay=0.03, velocity_filter=filtered,
        q_quantum=2.0 * np.pi / 2**bits,
    )  # fmt: skip
    plant = aj.Plant(
        robot.with_object(0.15, 2.8, axis="z"), sensing=sensing, drives=Drives.usual(robot),
        friction=Friction(viscous, coulomb, stribeck=1.3, load=0.06),
    )  # fmt: skip
    task = aj.PositionTask(robot.with_object(0.0))
    kinematics = aj.controllers.AdaptiveKinematics(task, noise=1e-3, delay=0.03)
    late = aj.Latency(velocity_filter=filtered)
    law = aj.TrackingController(task, kinematics=kinematics, latency=late)
    q0 = plant.ready_configuration()
    x0 = plant.sensor.value(q0)
    path = aj.Circle(x0 - [0.0, 0.1, 0.0], 0.1, 4.0, normal=(1.0, 0.0, 0.0))
    law = aj.TorqueLimited(law, aj.Limits.of(robot))
    run = aj.simulate(
        plant, law, path, q0, 10.0, seed=2, computation=Computation("semi_implicit_euler")
    )
    late = run.t > 6.0
    assert 1e3 * np.sqrt((run.error_norm[late] ** 2).mean()) < 2.0
    assert np.abs(np.diff(run.tau[late], axis=0)).mean() < 0.03 * robot.effort_limits.max()


@pytest.mark.parametrize("name", ["panda", "ur10", "tiago_arm"])
def test_what_is_slow_is_together_the_spring_that_c_allows_for(name):
    """P, κ₀ and α₀ of the heaviest joint: 0.7 of its damping over the lag, 0.4 of that learnt."""
    robot = aj.load_robot(name)
    first = JointGains.of(robot, None, None, 6.0, 1e-3, LATE, None, True)
    slow = slow_feedback(robot, LATE, 1e-3, first)
    inertia = largest_inertia(robot) + first.rotors
    heaviest = int((first.most / inertia).argmin())
    allowed = integral_rate(LATE, True) * first.most[heaviest]
    kappa, learnt = slow.share * first.kappa, first.integral * first.most[heaviest]
    assert_allclose(learnt, 0.4 * allowed)
    acts = learnt + slow.omega * (kappa + slow.alpha) * inertia[heaviest]
    assert 0.4 * allowed < acts <= allowed * (1.0 + 1e-9)


def test_the_next_run_goes_on_with_the_damping_and_how_fast_it_may_rise(panda):
    law = aj.TrackingController(aj.PositionTask(panda), latency=LATE)
    first = aj.Measurement(0.0, HOME, np.zeros(7), law.task.value(HOME), 0.0)
    state, rises = law.initial_state(first), []
    memory = slice(law._end, law._end + 14)
    state[memory] = np.append(np.full(7, 0.3), np.linspace(0.1, 2.0, 7))
    for each in (state, law.resumed(state, first._replace(t=9.0, t_x=9.0))):
        after, _ = law.step(each, first, first.x, LATE.period)
        rises.append((after - each)[memory][:7])
    assert np.abs(rises[0]).min() > 0.0
    assert_allclose(rises[1], rises[0], rtol=1e-9)


def test_what_is_slow_does_not_wind_up_before_a_first_x(panda):
    """Until then the joints rest, whatever the target is; then all is as if it had just begun."""
    law = aj.TrackingController(aj.PositionTask(panda), latency=LATE)
    assert law._slow is not None
    blind = aj.Measurement(0.0, HOME, np.zeros(7), np.full(3, np.nan), 0.0)
    state, ways = law.initial_state(blind), slice(law._led + 7, law._ways)
    state[ways] = 0.05
    state, _ = law.step(state, blind, law.task.value(HOME) + 0.2, LATE.period)
    assert not state[ways].any()


class Later:
    """A path some seconds later."""

    def __init__(self, path, by):
        self.path, self.by = path, by

    def at(self, t):
        return self.path.at(t + self.by)


@pytest.mark.study
def test_a_moving_arm_is_taken_over_on_its_path():
    """An eased target begins with the arm's velocity: one that began at rest is 15 mm off."""
    arm = aj.load_robot("panda")
    plant, task = aj.Plant(arm), aj.PositionTask(arm)
    controller = aj.TrackingController(task, latency=aj.Latency(1e-3, velocity_filter=1e-3))
    q0 = plant.ready_configuration()
    path = aj.Circle(plant.sensor.value(q0) - [0.08, 0.0, 0.0], 0.08, 3.0)
    moving = aj.simulate(plant, controller, path, q0, 4.0)
    start = aj.simulation.InitialState(moving.q[-1], moving.v[-1])
    run = aj.simulate(plant, controller, Later(path, 4.0), start, 1.0)
    assert moving.error_norm[-1] < 2e-3
    assert run.error_norm.max() < 4e-3
