"""`tuned`: gains, saturation and learning from inertia, motors and latency, and what it refuses."""

import math

import numpy as np
import pytest
from arms import among
from numpy.testing import assert_allclose
from scenarios import reach

import approxjac as aj
from approxjac.controllers import DifferentiatedVelocity, Latency, tuned
from approxjac.controllers.gains.motors import least_rotors
from approxjac.controllers.gains.sample_configurations import sample_configurations
from approxjac.controllers.gains.tuning import Learning, _Arm, slow_rate, with_unknown_tool
from approxjac.errors import InvalidInputError
from approxjac.robots import Drives, Dynamics, GravityRegressor
from approxjac.scenario import build_scenario
from approxjac.scenario.build import latency_of

IDEAL = Latency()
SENSORS = Latency(torque_delay=2e-3, velocity_filter=5e-3, image_period=1 / 60)
CAMERA = Latency(torque_delay=2e-3, velocity_filter=5e-3, image_period=1 / 30, image_age=0.06)


def position_task(robot):
    axes = "yz" if robot.name == "double_pendulum" else "xz" if robot.nv == 2 else "xyz"
    return aj.PositionTask(robot, axes=axes)


def learning_of(name, latency, **options):
    task = position_task(aj.load_robot(name))
    return task, tuned(task, latency, regressor=GravityRegressor(task.robot), **options)


# -- what is chosen -------------------------------------------------------------------------


def test_it_is_what_a_controller_without_gains_has(panda):
    task = aj.PositionTask(panda)
    for latency in (None, CAMERA):
        chosen = tuned(task, latency, drives=Drives())
        law = aj.SetpointController(task, latency=latency, drives=Drives())
        bandwidth = 1.0 / (latency or IDEAL).of_velocity
        by_rate = aj.default_gains(task, 4.0 / chosen.rate, bandwidth)
        for name in ("kp", "kv", "damping"):
            assert_allclose(getattr(law.gains, name), getattr(by_rate, name), rtol=1e-12)
        far = np.array([1.0, -2.0, 0.5])
        assert_allclose(law.saturation.s(far), chosen.gamma * np.tanh(far / chosen.gamma))
        assert chosen.learning is None
    given_gains = aj.SetpointController(task, aj.default_gains(task))
    assert given_gains.tuning is None
    assert_allclose(given_gains.saturation.s(far), far)


def test_one_number_makes_all_of_it_slower():
    _, quick = learning_of("panda", IDEAL)
    _, slow = learning_of("panda", IDEAL, settling_time=4.0)
    assert slow.rate == 1.0 < quick.rate
    for name in ("kp", "kv"):
        assert (getattr(slow.gains, name) < getattr(quick.gains, name)).all()
    assert slow.learning.alpha < quick.learning.alpha
    assert (slow.gamma > quick.gamma).all()  # softer gains may act from farther away
    parts = ("gravity", "task_force", "joint_torque")
    assert all(
        np.trace(np.atleast_2d(getattr(slow.learning, part)))
        < np.trace(np.atleast_2d(getattr(quick.learning, part)))
        for part in parts
    )


@pytest.mark.parametrize("name", among("panda", "ur5", "so100"))
def test_learning_is_as_fast_as_inertia_allows(name):
    """λ_max(W Y L Yᵀ) of each part at 95 % of the postures, with D and M found by torques."""
    task, chosen = learning_of(name, IDEAL)
    robot, dynamics, rest = task.robot, Dynamics(task.robot), np.zeros(task.robot.nv)
    kp, kv, damping = chosen.gains.diagonals(task.m, robot.nv)
    share, learning = chosen.share, chosen.learning
    regressor = GravityRegressor(robot)
    fastest = []
    for q in sample_configurations(task).q:
        g, J = dynamics.g(q), task.jacobian(q)
        D = J.T * kv @ J + np.diag(damping)
        M = np.array([dynamics.inverse(q, rest, unit) - g for unit in np.eye(robot.nv)]).T
        W = np.linalg.solve(D, np.linalg.solve(D, M).T)
        Z = regressor.Z(q)
        parts = (
            Z @ learning.gravity @ Z.T, J.T * learning.task_force @ J,
            np.diag(learning.joint_torque),
        )  # fmt: skip
        fastest.append([np.linalg.eigvals(W @ part).real.max() for part in parts])
    gravity, force, torque = np.quantile(fastest, 0.95, axis=0)
    assert_allclose(gravity, 0.5 * share, rtol=1e-6)
    assert force <= 0.6 * max(share, 0.35) * (1 + 1e-6)
    assert torque <= 0.5 * share * (1 + 1e-6)
    assert (learning.task_force <= 0.5 * kp * (1 + 1e-9)).all()
    assert_allclose(learning.alpha, chosen.rate, rtol=1e-6)
    assert (np.linalg.eigvalsh(learning.gravity) > 0.0).all()


def test_every_arm_is_tuned(arm):
    task = position_task(arm)
    chosen = tuned(task, regressor=GravityRegressor(arm))
    learning = chosen.learning
    gains = chosen.gains.diagonals(task.m, arm.nv)
    for values in (*gains, chosen.gamma, learning.task_force, learning.joint_torque):
        assert np.isfinite(values).all()
        assert (values > 0.0).all()
    assert np.isfinite(learning.gravity).all()
    assert (np.linalg.eigvalsh(learning.gravity) > 0.0).all()
    assert (learning.largest > 0.0).all()
    assert 0.0 < learning.alpha < math.inf
    assert chosen.stable


@pytest.mark.parametrize("name", among("panda", "ur5", "xarm7", "so100", "z1", "talos_arm"))
def test_the_saturation_keeps_the_motors_within_their_torques(name, rng):
    """At rest, however far the target: measured at 92 to 100 % of what they hold with 70 %."""
    robot = aj.load_robot(name)
    law = aj.SetpointController(position_task(robot))
    within = []
    for _ in range(300):
        q = robot.random_configuration(rng)
        J, direction = law.task.jacobian(q), rng.normal(size=3)
        values = np.linalg.svd(J, compute_uv=False)
        g = Dynamics(robot).g(q)
        if values[-1] < 0.05 * values[0] or (np.abs(g) > 0.7 * robot.effort_limits).any():
            continue
        x = law.task.value(q)
        far = x + 10.0 * direction / np.linalg.norm(direction)
        answer = law.evaluate(np.zeros(0), aj.Measurement(0.0, q, np.zeros(robot.nv), x), far)
        within.append((np.abs(answer.torque) <= robot.effort_limits).all())
    assert np.mean(within) > 0.88


def test_the_check_is_of_arms_lighter_and_heavier_than_believed(panda):
    arm = _Arm(aj.PositionTask(panda), None, IDEAL, None, None)
    loop = arm.cases(aj.default_gains(arm.task).diagonals(3, 7), None)
    true = np.linalg.inv(loop.M_inv).reshape(-1, 20, 7, 7)
    times = np.trace(true, axis1=2, axis2=3) / np.trace(arm.postures.M[:20], axis1=1, axis2=2)
    assert times.min() < 0.8
    assert times.max() > 1.2
    has_tool = np.abs(loop.J - np.tile(arm.postures.J_hat[:20], (4, 1, 1))).max(axis=(1, 2)) > 0.01
    assert times.ravel()[has_tool].max() > 1.2  # which is not without mass


# -- latency --------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "mass"), [("ur10", 5.0), ("kinova", 2.0), ("ur3", 3.0)])
def test_a_payload_that_is_told_is_held(name, mass):
    """Its weight is K_p γ, or all that motors have left for a force."""
    task = position_task(aj.load_robot(name))
    chosen, without = tuned(task, payload=(mass, 0.2)), tuned(task)
    weight = mass * 9.81 / chosen.gains.diagonals(3, task.robot.nv).kp.min()
    assert_allclose(chosen.gamma, weight)
    assert (chosen.gamma > without.gamma).all()
    assert f"for payloads up to {mass:g} kg on 0.2 m" in str(chosen)


def test_a_longer_tool_makes_learning_slower():
    """The check is of an arm with a tool of the told length."""
    shares = [
        learning_of("ur5", SENSORS, payload=(0.0, length))[1].share for length in (0.0, 0.4, 0.8)
    ]
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] < shares[0]


def test_where_rotors_are_not_known_joints_learn_as_with_three_times_the_least():
    task, unknown = learning_of("ur5", SENSORS)
    least, usual = least_rotors(task.robot), unknown.learning.joint_torque
    lighter, same = (
        learning_of("ur5", SENSORS, gains=unknown.gains, drives=Drives(times * least))[1].learning
        for times in (1.0, 3.0)
    )
    assert_allclose(same.joint_torque, usual)
    assert np.linalg.norm(lighter.joint_torque) > 1.2 * np.linalg.norm(usual)


@pytest.mark.parametrize("payload", [(1.0,), (-1.0, 0.2), (1.0, 200.0), (np.nan, 0.1), "heavy"])
def test_a_payload_that_is_none_is_refused(panda, payload):
    with pytest.raises(InvalidInputError, match="payload"):
        tuned(aj.PositionTask(panda), payload=payload)


def test_the_rate_is_a_third_of_what_the_lag_of_x_allows_at_most():
    task = position_task(aj.load_robot("two_link"))
    for latency in (CAMERA, Latency(0.02, 0.01), Latency(image_period=0.2, image_age=0.3)):
        chosen = tuned(task, latency)
        assert chosen.rate <= 0.3 / latency.of_position * (1 + 1e-9)
    assert "as x is 401 ms late" in str(chosen)


@pytest.mark.study
def test_what_is_later_is_not_faster():
    """Mostly: of 38 random pairs one is, as filtered q̇ gets gains that an old x suits better."""
    later = [
        IDEAL, Latency(torque_delay=2e-3), Latency(torque_delay=0.01),
        Latency(torque_delay=0.01, image_age=0.03), Latency(0.01, 0.01, 5e-3, 1 / 30, 0.06),
        Latency(0.01, 0.02, 0.01, 0.1, 0.2),
    ]  # fmt: skip
    for name, some in (("two_link", later), ("ur5", later[1::4])):
        rates = [learning_of(name, latency)[1].rate for latency in some]
        assert (np.diff(rates) <= 1e-9).all()
        assert rates[-1] < 0.3 * rates[0]


def before(arm, gains, alpha):
    """The diagonal of L that the library had before, which is fast without latency."""
    J, Z = arm.postures.J_hat, arm.Z
    D = 1.0 / np.mean((Z * Z).sum(axis=1), axis=0)
    A = np.linalg.solve(J @ np.swapaxes(J, 1, 2), J) @ Z
    lack = np.linalg.eigvals(alpha * np.swapaxes(A * D, 1, 2) @ (A / gains.kp[:, None])).real
    swings = (Z * (arm.postures.M_inv @ Z)).sum(axis=1).max(axis=0)
    return np.minimum(3.0 * alpha / np.median(lack.max(axis=1)) * D, (10.0 * alpha) ** 2 / swings)


@pytest.mark.study
@pytest.mark.parametrize("name", ["panda", "ur5"])
@pytest.mark.parametrize("latency", [SENSORS, CAMERA], ids=["sensors", "camera"])
def test_the_check_refuses_what_diverges_and_passes_what_the_rule_chose(name, latency):
    """Gains for 0.5 s, three times the learning of before, and integral action of ½K_p."""
    task, chosen = learning_of(name, latency)
    arm = _Arm(task, GravityRegressor(task.robot), Latency(), None, None)
    gains = aj.default_gains(task, 0.5).diagonals(task.m, task.robot.nv)
    alpha = slow_rate(arm.task, gains)
    fast = Learning(
        alpha, 3.0 * np.diag(before(arm, gains, alpha)), 0.5 * gains.kp,
        np.zeros(task.robot.nv), np.zeros(0), None,
    )  # fmt: skip
    all_cases = np.ones(4 * len(arm.postures.q[:20]), dtype=bool)
    assert not arm.passes(gains, fast, latency, all_cases, math.inf)
    assert chosen.stable
    rule = chosen.gains.diagonals(task.m, task.robot.nv)
    assert arm.passes(rule, chosen.learning, latency, all_cases, math.inf)


def test_what_is_too_late_for_any_gains_says_so():
    task = position_task(aj.load_robot("panda"))
    hopeless = tuned(task, Latency(image_age=10.0), settling_time=0.01)
    assert not hopeless.stable
    assert "no gains passed the check: x is too late, or Ĵ too far off" in str(hopeless)


def test_nine_of_ten_loops_with_an_image_that_is_late_are_damped_as_is_told(panda):
    """By steps of the linear loop, in which x is that of the last frame but one."""
    task, frame = aj.PositionTask(panda), 0.1
    latency = Latency(image_period=frame, image_age=frame)
    chosen = tuned(task, latency, settling_time=0.8)
    postures, n = sample_configurations(task), 7
    J, (kp, kv, damping) = postures.J_hat, chosen.gains.diagonals(3, n)
    D = J.mT * kv @ J + np.diag(damping)
    q, v, x = (np.tile(part, (len(J), 1, 1)) for part in np.split(np.eye(2 * n + 3), [n, 2 * n]))
    new = J @ q
    for _ in range(round(frame / latency.period)):
        v = v - latency.period * postures.M_inv @ (J.mT * kp @ x + D @ v)
        q = q + latency.period * v
    poles = np.log(np.linalg.eigvals(np.concatenate([q, v, new], axis=1)).astype(complex)) / frame
    size, lag = np.abs(poles), latency.of_position
    slow = (size > 0.1 * chosen.rate) & (size < 2.3 / lag)
    ratios = np.where(slow, -poles.real / np.maximum(size, 1e-9), 1.0).min(axis=1)
    assert np.quantile(ratios, 0.1) > 0.15 + 0.36 * chosen.rate * lag


@pytest.mark.parametrize("name", among("panda", "ur5", "kinova", "tiago_arm"))
def test_an_unknown_tool_is_as_an_object_of_that_length(name):
    arm = aj.load_robot(name)
    longer, held = with_unknown_tool(arm, 0.2), arm.with_object(0.2)
    for q in arm.configurations(3):
        value = [aj.PositionTask(each, axes="xyz").value(q) for each in (longer, held)]
        assert_allclose(*value, atol=1e-9)


def test_law_5_is_damped_as_late_as_it_differentiates(panda):
    task = aj.PositionTask(panda)
    law_6 = aj.SetpointController(task, latency=CAMERA)
    law_5 = aj.SetpointController(task, latency=CAMERA, velocity=DifferentiatedVelocity(0.05))
    lag = law_5.tuning.latency.velocity_filter - law_6.tuning.latency.velocity_filter
    assert_allclose(lag, 0.05 + CAMERA.image_age + 0.5 * CAMERA.image_period)
    assert (law_5.gains.damping <= law_6.gains.damping).all()


@pytest.mark.study
def test_printing_a_controller_says_what_was_chosen_and_why():
    task = position_task(aj.load_robot("ur5"))
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(task.robot), latency=CAMERA)
    text = " ".join(str(law).split())  # long lines are wrapped
    chosen, text = text.split("position task (x, y, z) of ur5 ")
    assert chosen.startswith("set-point law (28), K_p ")
    told = f"saturation Tanh (gamma {float(law.saturation.gamma[0]):.4g} m); gravity learnt "
    assert chosen.endswith(told)
    time, learns = text.split("learns ")
    assert time.startswith("settling time ")
    assert ": a usual reach takes " in time
    assert "as x is 79.7 ms late" in time
    assert f"{4.0 / law.tuning.rate:.3g} s" in time
    assert learns == f"at {100.0 * law.tuning.share:.0f} % of what inertia allows"
    asked = aj.SetpointController(task, settling_time=2.0)
    assert "settling time 2 s as asked" in str(asked)
    assert "settling time" not in str(aj.SetpointController(task, aj.default_gains(task)))


def test_latency_tells_its_lags_and_refuses_what_is_none():
    assert_allclose(SENSORS.of_velocity, 8e-3)
    assert_allclose(SENSORS.of_position, 3e-3 + 0.5 / 60)
    assert_allclose(CAMERA.of_position, 0.063 + 0.5 / 30)
    assert Latency(1e-3, 0.0, 0.0, 0.0, 0.0) == IDEAL
    for period in (0.0, -1e-3, math.nan, math.inf, "1 ms", None):
        with pytest.raises(aj.InvalidInputError, match=r"period must be a finite number > 0 \[s\]"):
            Latency(period)
    for name in ("torque_delay", "velocity_filter", "image_period", "image_age"):
        for value in (-1e-9, 16.7, math.nan, math.inf, True):  # milliseconds, too
            text = rf"{name} must be a finite number >= 0 and <= 10 \[s\]"
            with pytest.raises(aj.InvalidInputError, match=text):
                Latency(**{name: value})
    with pytest.raises(aj.InvalidInputError, match="latency must be Latency"):
        aj.SetpointController(position_task(aj.load_robot("ur5")), latency=0.002)


def test_the_latency_of_a_scenario_is_that_of_its_loop():
    late = reach(
        sensor={"rate": 30.0, "delay": 0.06, "velocity_filter": 5e-3},
        loop={"dt": 2e-3, "actuator_delay": 4e-3},
    )
    assert latency_of(late) == Latency(2e-3, 4e-3, 5e-3, 1 / 30, 0.06)
    assert build_scenario(late).law.tuning.latency == latency_of(late)
    assert latency_of(reach(loop={"dt": "continuous"})) == IDEAL


@pytest.mark.parametrize(("name", "length"), [("panda", 0.3), ("ur10", 0.15), ("ur5", 0.2)])
def test_a_long_tool_without_mass_is_no_reason_for_slow_gains(name, length):
    """A light wrist rings with an unknown tool at any rate: then π is what gives way."""
    belief = aj.load_robot(name).with_object(length)
    chosen = tuned(aj.PositionTask(belief), regressor=GravityRegressor(belief))
    assert chosen.stable
    assert chosen.rate >= 6.0


def test_arms_without_joint_damping_learn_gravity_where_the_task_damps_all_joints(panda):
    flat = aj.load_robot("double_pendulum")
    law = aj.SetpointController(
        position_task(flat), aj.Gains(100.0, 10.0, 0.0), gravity=aj.AdaptiveGravity(flat)
    )
    assert np.isfinite(law.adaptation.L).all()
    with pytest.raises(InvalidInputError, match="damping must be > 0"):
        aj.SetpointController(
            position_task(panda), aj.Gains(100.0, 10.0, 0.0), gravity=aj.AdaptiveGravity(panda)
        )
