"""The numbers that the documentation gives of rules and limits are those of what the rules do.

A figure is read from the page, so that whoever changes a constant has to change the page, too.
"""

import functools
import math
import re
from pathlib import Path

import numpy as np
import pytest
from heavy_arms import THREE_JOINT, HeavyArm
from numpy.testing import assert_allclose
from own_controller import OwnController

import approxjac as aj
from approxjac import Status
from approxjac.controllers import KnownKinematics, Latency, NoGravity, TrackingGains, tuned
from approxjac.robots import Dynamics, GravityRegressor
from approxjac.stability import local_stability

# of motors that are chosen for what they decide
pytestmark = pytest.mark.filterwarnings("ignore::approxjac.errors.ImplausibleRobotWarning")
DOCS = Path(__file__).parents[2] / "docs"


@functools.cache
def documented(page, pattern):
    """The numbers of the first match, as floats."""
    text = " ".join((DOCS / page).read_text(encoding="utf-8").split())
    found = re.search(pattern, text)
    assert found, f"docs/{page} gives no figure of the form {pattern!r}"
    return [float(number) for number in found.groups()]


@functools.cache
def heavy(name):
    return HeavyArm(name)


def weak(effort=None, velocity=None):
    """The arm of three joints with other motors."""
    urdf = THREE_JOINT
    if effort is not None:
        urdf = re.sub(r'effort="(\d+)"', lambda m: f'effort="{effort * float(m[1])}"', urdf)
    if velocity is not None:
        urdf = urdf.replace('velocity="3"', f'velocity="{velocity}"')
    return aj.load_robot(urdf, tip="tip")


def drawn(task, n=300):
    """Configurations of one's own that are not near singular."""
    rng, found = np.random.default_rng(11), []
    while len(found) < n:
        q = task.robot.random_configuration(rng)
        values = np.linalg.svd(task.jacobian(q), compute_uv=False)
        if values[-1] > 0.05 * values[0]:
            found.append(q)
    return found


def planar():
    return aj.PositionTask(aj.load_robot("two_link"), axes="xz")


# -- the rule for all defaults --------------------------------------------------------------------

RATES = r"\*Rate\* r from ([\d.]+) to ([\d.]+) 1/s, at most ([\d.]+)/\(lag of x\)"


def test_the_rate_is_within_its_range_and_below_what_the_lag_allows():
    slowest, fastest, share = documented("control.md", RATES)
    rates = []
    for name in ("two_link", "three_joint", "panda"):
        task = heavy(name).task
        for latency in (Latency(), Latency(image_age=0.02), Latency(image_age=0.06)):
            chosen = tuned(task, latency)
            assert chosen.rate <= share / latency.of_position * (1.0 + 1e-9)
            assert chosen.rate <= fastest
            rates.append(chosen.rate)
        # so late that the lag decides alone: that rate, or where the check asks for it a slower one
        late = Latency(image_age=1.5 * share / slowest)
        rate = tuned(task, late).rate
        assert 0.3 * share / late.of_position < rate <= share / late.of_position * (1.0 + 1e-9)
    assert max(rates) > 0.5 * fastest
    late = Latency(image_age=1.5 * share / slowest)
    assert_allclose(tuned(planar(), late).rate, share / late.of_position)


def test_the_saturation_is_an_eighth_of_a_usual_distance_where_motors_have_no_limit():
    """Of an arm without limits of effort and speed; the distance of random configurations."""
    assert "an eighth of a usual distance" in (DOCS / "control.md").read_text(encoding="utf-8")
    task = planar()
    assert not np.isfinite(task.robot.effort_limits).any()
    x = np.array([task.value(q) for q in drawn(task, 1500)])
    usual = np.median(np.linalg.norm(x[1:] - x[:-1], axis=1))
    gamma = tuned(task).gamma
    assert_allclose(gamma, gamma[0])
    assert_allclose(gamma[0], usual / 8.0, rtol=0.1)


@pytest.mark.parametrize("age", [0.0, 0.02])
def test_the_motors_shares_are_those_of_the_page(age):
    """Where motors decide γ: the share of them that force and gravity ask for, at its quantile."""
    (share,) = documented("control.md", r"need at most ([\d.]+) % of the motors' torques")
    task = aj.PositionTask(weak(effort=0.7, velocity=1e3))
    latency = Latency(1e-6, image_age=age)
    chosen, robot = tuned(task, latency), task.robot
    asked = []
    for q in drawn(task):
        g = np.abs(Dynamics(robot).g(q))
        if (g > 0.7 * robot.effort_limits).any():
            continue  # which the motors can hardly hold
        # at rest, the target far away in the worst direction of the whole force
        pull = np.linalg.norm(task.jacobian(q).T * chosen.gains.kp, axis=1)
        asked.append(((g + chosen.gamma[0] * pull) / robot.effort_limits).max())
    found = np.quantile(asked, 0.75)
    if not age:
        assert_allclose(found, share / 100.0, atol=0.05)
    else:  # what is late overshoots
        assert found < share / 100.0 * (1.0 - 0.5 * chosen.rate * age)


def test_the_joints_speeds_are_those_of_the_page():
    (share,) = documented("control.md", r"and ([\d.]+) % of the joints' speeds in half of them")
    task = aj.PositionTask(weak(effort=100.0, velocity=0.1))
    chosen = tuned(task)
    fastest = []
    for q in drawn(task):
        J = task.jacobian(q)
        D = J.T * chosen.gains.kv @ J + np.diag(chosen.gains.damping)
        # D q̇ = −ĴᵀK_p s is the speed that a constant s leads to
        speed = np.linalg.norm(np.linalg.solve(D, J.T * chosen.gains.kp), axis=1)
        fastest.append((chosen.gamma[0] * speed / 0.1).max())
    assert_allclose(np.median(fastest), share / 100.0, atol=0.05)


def test_forces_and_torques_are_learnt_as_the_page_says():
    """Where they need not be reduced: L_d = ½K_p; L_w = ¼B_c²/Mⱼⱼ, M of the last link constant."""
    text = (DOCS / "theory.md").read_text(encoding="utf-8")
    assert r"L_d=\frac12K_p" in text
    assert r"L_w=\frac14B_c^2/M_{jj}" in text
    task = planar()
    gains = aj.Gains(kp=30.0, kv=60.0, damping=20.0)
    chosen = tuned(task, regressor=GravityRegressor(task.robot), gains=gains)
    assert chosen.share == 1.0
    last = Dynamics(task.robot).M(np.zeros(2))[1, 1]
    assert_allclose(chosen.learning.task_force, 15.0)
    assert chosen.learning.joint_torque[1] <= 0.25 * 20.0**2 / last * (1.0 + 1e-9)
    soft = aj.Gains(kp=1.0, kv=40.0, damping=0.5)
    chosen = tuned(task, regressor=GravityRegressor(task.robot), gains=soft)
    assert_allclose(chosen.learning.joint_torque[1], 0.25 * 0.5**2 / last, rtol=1e-9)
    assert_allclose(chosen.learning.task_force, 0.5)


@pytest.mark.parametrize(
    ("name", "dt", "delay"),
    [
        *(pytest.param(k, 5e-3, 10e-3, marks=pytest.mark.study) for k in ("panda", "ur5")),
        ("three_joint", 5e-3, 10e-3),
        ("two_link", 20e-3, 0.0),
    ],
)
def test_what_was_chosen_is_stable_with_all_of_it_larger(name, dt, delay):
    """Of an arm of 70 % of the inertia, which is as if gains were larger by as much.

    Of the sampled loop whose torques may be late, at configurations of one's own.
    """
    (margin,) = documented("control.md", r"must be stable with all of these ([\d.]+) times larger")
    belief = heavy(name).bare.with_gravity((0.0, 0.0, 0.0))
    axes = "xz" if name == "two_link" else "xyz"
    task, latency = aj.PositionTask(belief, axes=axes), Latency(dt, torque_delay=delay)
    chosen = tuned(task, latency)
    assert chosen.stable
    parts = (chosen.gains.kp, chosen.gains.kv, chosen.gains.damping)
    larger = aj.Gains(*(margin / 0.7 * np.asarray(each) for each in parts))
    law = aj.SetpointController(task, larger, gravity=NoGravity(belief))
    plant = aj.Plant(belief, task, actuator_delay=delay)
    assert all(local_stability(plant, law, q, dt=dt).stable for q in drawn(task, 20))


# -- default gains --------------------------------------------------------------------------------


def test_default_gains_have_the_constants_of_the_page():
    """K_v = 4rΛ with r = 4/T; B_c its two terms; K_p = r(K_v + K_b): of a two-link arm."""
    (settled,) = documented("control.md", r"with \$r=(\d+)/T\$")
    (stiff,) = documented("control.md", r"\$\$K_v=(\d+)r\\Lambda")
    (quiet,) = documented("control.md", r"r?M_\{ii\}\+([\d.]+)\\lambda_\{max\}")
    task, T = planar(), 2.0
    rate = settled / T
    gains = aj.default_gains(task, T)
    J = [task.jacobian(q) for q in drawn(task, 1500)]
    M = [Dynamics(task.robot).M(q) for q in drawn(task, 1500)]
    shown = [1.0 / np.diag(j @ np.linalg.inv(m) @ j.T) for j, m in zip(J, M, strict=True)]
    usual = np.median(shown, axis=0).mean()
    assert_allclose(gains.kv, stiff * rate * usual, rtol=0.12)
    quieting = quiet * np.median(
        [np.linalg.norm(np.sqrt(gains.kv)[:, None] * j, 2) ** 2 for j in J]
    )
    # the last joint's own inertia is the same everywhere
    last = M[0][1, 1]
    assert_allclose(gains.damping[1], rate * last + quieting, rtol=0.08)
    felt = np.median([1.0 / np.diag(j / gains.damping @ j.T) for j in J], axis=0).mean()
    assert_allclose(gains.kp / gains.kv, rate * (1.0 + felt / gains.kv), rtol=0.05)


@pytest.mark.parametrize("bandwidth", [None, 200.0])
def test_nothing_is_damped_faster_than_half_of_the_bandwidth(bandwidth):
    (usual,) = documented("control.md", r"half of `bandwidth` \((\d+) 1/s\)")
    options = {} if bandwidth is None else {"bandwidth": bandwidth}
    half = 0.5 * (usual if bandwidth is None else bandwidth)
    task = planar()
    gains = aj.default_gains(task, 1e-3, **options)
    damped, driven = [], []
    for q in drawn(task, 1500):
        M_inv, J = np.linalg.inv(Dynamics(task.robot).M(q)), task.jacobian(q)
        damped.append(np.diag(M_inv) * gains.damping)
        driven.append(np.linalg.eigvals(M_inv @ (J.T * gains.kv @ J)).real.max())
    assert_allclose(np.max(damped, axis=0), half, rtol=0.05)
    assert_allclose(np.max(driven), half, rtol=0.05)


# -- statuses and limits --------------------------------------------------------------------------


@pytest.mark.parametrize("near", [0.97, 1.03])
def test_a_pose_is_near_singular_by_the_share_of_the_page(near):
    (percent,) = documented("control.md", r"σ_min\(Ĵ\) below ([\d.]+) % of σ_max")
    task = planar()

    def ratio(bend):
        values = np.linalg.svd(task.jacobian(np.array([0.3, bend])), compute_uv=False)
        return values[-1] / values[0]

    low, high = 0.0, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if ratio(middle) < near * percent / 100.0 else (low, middle)
    q = np.array([0.3, high])
    law = aj.SetpointController(task, aj.Gains(10.0, 10.0, 1.0))
    x = task.value(q)
    answer = law.evaluate(np.zeros(0), aj.Measurement(0.0, q, np.zeros(2), x), x)
    assert answer.status is (Status.NEAR_SINGULAR if near < 1.0 else Status.OK)


def test_braking_and_alpha_are_those_of_the_page():
    (known,) = documented("torque_limits.md", r"is ([\d.]+) over the sum of dt and the delays")
    (ideal,) = documented("torque_limits.md", r"\(([\d.]+) 1/s at an ideal 1 kHz\)")
    least, most = documented("torque_limits.md", r"between ([\d.]+)/dt and ([\d.]+)/dt")
    (share,) = documented("torque_limits.md", r"else ([\d.]+) of the rate of the slow pole")
    task, limits = planar(), aj.Limits(effort=50.0)
    told = aj.SetpointController(task, latency=Latency())
    assert_allclose(aj.TorqueLimited(told, limits).braking, ideal)
    assert_allclose(known / 1e-3, ideal)
    late = aj.SetpointController(task, latency=Latency(torque_delay=2e-3, velocity_filter=5e-3))
    assert_allclose(aj.TorqueLimited(late, limits).braking, known / 8e-3)
    for damping, expected in ((1e-6, least), (1e6, most)):
        law = aj.SetpointController(task, aj.Gains(1.0, 1.0, damping))
        assert_allclose(aj.TorqueLimited(law, limits, dt=2e-3).braking, expected / 2e-3)
    # without joint damping the slow pole is at k_p/k_v
    bare = aj.SetpointController(task, aj.Gains(30.0, 10.0))
    assert_allclose(aj.TorqueLimited(bare, limits).alpha, share * 3.0, rtol=1e-6)


def test_what_counts_as_beyond_a_limit_is_what_the_page_says():
    fast, far = documented(
        "torque_limits.md", r"a limit of speed \(by ([\d.]+) %\) or position \(by ([\d.]+) mrad"
    )
    robot = aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0))
    task = aj.PositionTask(robot, axes="xz")
    law = aj.SetpointController(task, aj.Gains(1.0, 1.0, 2.0), gravity=NoGravity(robot))
    q = np.array([0.3, 1.2])
    for share, expected in ((0.95, aj.LimitStatus.FREE), (1.05, aj.LimitStatus.EXCEEDED)):
        v = np.array([0.5 * (1.0 + 0.01 * fast * share), 0.0])
        now = aj.Measurement(0.0, q, v, task.value(q))
        limited = aj.TorqueLimited(law, aj.Limits(velocity=[0.5, 9.0]), braking=20.0)
        state = limited.initial_state(now)
        assert limited.step(state, now, now.x, 1e-3)[1].limit_status is expected
        limits = aj.Limits(position=(q - 2.0, q + [-1e-3 * far * share, 2.0]))
        limited = aj.TorqueLimited(law, limits, braking=20.0)
        now = aj.Measurement(0.0, q, np.array([-0.05, 0.0]), task.value(q))
        state = limited.initial_state(now)
        assert limited.step(state, now, now.x, 1e-3)[1].limit_status is expected


@pytest.mark.parametrize("dt", [1e-3, 3e-3, 4e-3, 5e-3, 7e-3, 12e-3])
@pytest.mark.parametrize("delay", [0.0, 0.2])
def test_frames_are_too_old_when_the_page_says_so(delay, dt):
    """Within a period, at periods that divide those between remembered configurations or not."""
    (oldest,) = documented("learning_kinematics.md", r"Frames older than ([\d.]+) s, or twice")
    task = heavy("three_joint").task
    q = heavy("three_joint").q
    kinematics = aj.AdaptiveKinematics(task, unknown=("tool",), delay=delay, dt=dt)
    law = aj.TrackingController(task, kinematics=kinematics, dt=dt)
    most, x = max(oldest, 2.0 * delay), task.value(q)
    for age, expected in ((most - dt, Status.OK), (most + dt, Status.PREDICTED)):
        state = law.initial_state(aj.Measurement(0.0, q, np.zeros(3), x, 0.0))
        for k in range(round(1.3 / dt)):
            t = dt * k
            seen = aj.Measurement(t, q, np.zeros(3), x + 1e-6 * math.sin(k), t - age)
            state, answer = law.step(state, seen, x, dt)
        # the status says so after a second without a frame
        assert answer.status is expected


def test_a_stop_has_the_natural_frequency_of_the_page():
    """A joint that runs into it at v, critically damped: v/(eω) deep, and back at v/e²."""
    (omega,) = documented("simulate.md", r"with a natural frequency of ([\d.]+) rad/s")
    (deepest,) = documented("simulate.md", r"could press further than ([\d.]+) rad")
    assert deepest == 0.01
    for dt in (1e-4, 5e-4, 2e-3, 5e-3):
        low, speed, inward, stiff = bounce(dt)
        assert 0.0 < low <= 1.02 / (math.e * omega)
        assert speed <= 1.05 * math.e**-2
        if dt == 1e-4:
            assert_allclose(low, 1.0 / (math.e * omega), rtol=0.03)
            assert_allclose(speed, math.e**-2, rtol=0.1)
        assert inward
        assert_allclose(stiff, deepest, rtol=1e-6)


class Constant(OwnController):
    """A torque that stays as it is."""

    def __init__(self, task, torque):
        super().__init__(task)
        self.torque = np.array([torque])

    def evaluate(self, state, measurement, target):
        return aj.Evaluation(self.torque, state, Status.OK, measurement.x - target)


@functools.cache
def turntable():
    """One joint about a vertical axis: an inertia of 0.5 kg m² wherever it is."""
    urdf = (
        '<robot name="turntable"><link name="floor"/><link name="plate"><inertial>'
        '<mass value="2"/><inertia ixx="0.3" ixy="0" ixz="0" iyy="0.3" iyz="0" izz="0.5"/>'
        '</inertial></link><joint name="turn" type="revolute"><parent link="floor"/>'
        '<child link="plate"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="{effort}" velocity="9"/></joint>'
        '<link name="tip"/><joint name="end" type="fixed"><parent link="plate"/>'
        '<child link="tip"/><origin xyz="0.5 0 0"/></joint></robot>'
    )
    return [aj.load_robot(urdf.format(effort=effort), tip="tip") for effort in (10, 1e4)]


def bounce(dt):
    """How deep a joint sinks in at 1 rad/s, how fast it comes back; how deep a motor presses."""
    light, strong = turntable()
    task = aj.PositionTask(light, axes="y")
    options = {"dt": dt, "computation": aj.simulation.Computation("semi_implicit_euler")}
    run = aj.simulate(
        aj.Plant(light, task),
        Constant(task, 0.0),
        np.zeros(1),
        aj.simulation.InitialState(np.array([0.99]), v0=np.ones(1)),
        0.08,
        **options,
    )
    task = aj.PositionTask(strong, axes="y")
    pressed = aj.simulate(
        aj.Plant(strong, task), Constant(task, 1e4), np.zeros(1), np.array([0.99]), 0.2, **options
    )
    return (
        float(run.q.max() - 1.0),
        float(-run.v[-1, 0]),
        bool(run.v[-1, 0] < 0.0),
        float(pressed.q[-1, 0] - 1.0),
    )


def test_the_tracking_law_keeps_its_reach_of_speed():
    """At most 0.5 m/s of the tip by default: α s(z) of an error that is far, along it."""
    task = heavy("three_joint").task
    law = aj.TrackingController(
        task, kinematics=KnownKinematics(task), gains=TrackingGains(self_motion=0.0)
    )
    q = heavy("three_joint").q
    x = task.value(q)
    for far in (0.5, 5.0):
        now = aj.Measurement(0.0, q, np.zeros(3), x)
        e = far * np.array([0.6, 0.0, -0.8])
        answer = law.step(law.initial_state(now), now, x - e, 1e-3)[1]
        u = task.jacobian(q) @ answer.reference
        k = law.alpha / 0.5
        assert_allclose(u, -law.alpha * e / math.sqrt(1.0 + (k * far) ** 2), atol=1e-9)
        assert np.linalg.norm(u) <= 0.5
