"""Realistic measurement: noise, quanta, delay, dropouts, encoders, friction, slow actuators."""

import dataclasses
import math
from fractions import Fraction

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from own_controller import OwnController
from scipy.integrate import cumulative_simpson

import approxjac as aj
from approxjac import view
from approxjac.controllers import DifferentiatedVelocity, RegressorGravity
from approxjac.errors import MeasurementError
from approxjac.robots import GravityRegressor
from approxjac.simulation.sensing import DRAWN, SensorReadings, generator
from approxjac.tasks import CombinedTask

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


class Probe(OwnController):
    """A controller whose torque is a function of time, and which keeps what it was told."""

    def __init__(self, task, torque):
        super().__init__(task)
        self.torque = torque
        self.told = []

    def evaluate(self, state, measurement, target):
        self.told.append(measurement)
        return aj.Evaluation(self.torque(measurement.t), state, aj.Status.OK, np.zeros(2))


def readings(sensing, truths, task, dt=1e-3, seed=0):
    """What is measured of a series of true measurements."""
    read = SensorReadings(sensing, task, dt, seed).read
    return [read(truth) for truth in truths]


def still(task, q, count, dt=1e-3):
    """The truth of an arm at rest."""
    x = task.value(q)
    return [aj.Measurement(k * dt, q, np.zeros(task.robot.nv), x) for k in range(count)]


def moving(task, q0, v, count, dt=1e-3):
    """The truth of an arm whose joints move at constant rates."""
    qs = [pin.integrate(task.robot.model, q0, k * dt * v) for k in range(count)]
    return [aj.Measurement(k * dt, q, v, task.value(q)) for k, q in enumerate(qs)]


def swing(sensing, *, robot=None, dt=1e-3, duration=0.2, seed=0, **plant):
    """A two-link arm that swings under a constant torque, and what the controller was told."""
    robot = aj.load_robot("two_link") if robot is None else robot
    plant = aj.Plant(robot, aj.PositionTask(robot, axes="xz"), sensing=sensing, **plant)
    probe = Probe(plant.sensor, lambda t: np.array([0.5, -0.2])).guarded(None)  # coarse sensors
    target, q0 = np.zeros(2), np.array([0.3, 0.8])
    run = aj.simulate(
        plant,
        probe,
        target,
        aj.simulation.InitialState(q0, v0=(0.4, -0.3)),
        duration,
        dt=dt,
        seed=seed,
    )
    return run, probe.told[1:]  # the first evaluation looks at the controller


@pytest.fixture(scope="module")
def position(panda):
    return aj.PositionTask(panda)


@pytest.fixture(scope="module")
def pose(panda):
    return aj.PoseTask(panda)


@pytest.fixture(scope="module")
def kinova():
    return aj.load_robot("kinova")


# -- noise ----------------------------------------------------------------------------------


def assert_is_white(errors, sigma):
    """Errors (N, k) have these standard deviations, no mean and no memory."""
    count = len(errors)
    deviations = errors.std(axis=0)
    assert_allclose(deviations, sigma, rtol=0.05)
    unit = errors / deviations
    assert np.abs(unit.mean(axis=0)).max() < 4.5 / np.sqrt(count)
    assert np.abs((unit[1:] * unit[:-1]).mean(axis=0)).max() < 4.5 / np.sqrt(count)
    apart = unit.T @ unit / count - np.eye(unit.shape[1])
    assert np.abs(apart[np.triu_indices_from(apart, 1)]).max() < 4.5 / np.sqrt(count)


def test_noise_on_x_has_its_standard_deviation_in_each_coordinate(position):
    sigma = np.array([1e-3, 5e-3, 2e-2])
    truths = still(position, START, 5000)
    seen = readings(aj.Sensing(x_noise=sigma), truths, position)
    assert_is_white(np.array([m.x for m in seen]) - truths[0].x, sigma)
    for measured, truth in zip(seen, truths, strict=True):
        assert measured.t == truth.t
        assert np.array_equal(measured.q, truth.q)
        assert np.array_equal(measured.v, truth.v)


def test_noise_on_a_pose_turns_it_by_a_rotation_vector(pose):
    sigma = np.array([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.04])
    truths = still(pose, START, 5000)
    seen = readings(aj.Sensing(x_noise=sigma), truths, pose)
    assert_is_white(np.array([pose.error(m.x, truths[0].x) for m in seen]), sigma)
    assert_allclose([np.linalg.norm(m.x[3:]) for m in seen], 1.0, atol=1e-12)


def test_noise_on_stacked_tasks_is_that_of_their_parts(panda):
    task = aj.StackedTask(aj.PoseTask(panda), aj.PositionTask(panda, "panda_link4", axes="z"))
    sigma = np.array([1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.01, 5e-3])
    truths = still(task, START, 5000)
    seen = readings(aj.Sensing(x_noise=sigma), truths, task)
    assert_is_white(np.array([task.error(m.x, truths[0].x) for m in seen]), sigma)


def test_encoder_noise_has_its_standard_deviation_in_each_joint(position):
    sigma = np.geomspace(1e-5, 1e-2, 7)
    truths = still(position, START, 5000)
    seen = readings(aj.Sensing(q_noise=sigma), truths, position)
    assert_is_white(np.array([m.q for m in seen]) - START, sigma)
    assert all(np.array_equal(m.x, truths[0].x) for m in seen)
    assert all(np.array_equal(m.v, np.zeros(7)) for m in seen)


def test_encoder_noise_leaves_continuous_joints_on_the_circle(kinova, rng):
    task = aj.PositionTask(kinova)
    q, sigma = kinova.random_configuration(rng), np.geomspace(1e-3, 0.1, 6)
    seen = readings(aj.Sensing(q_noise=sigma), still(task, q, 5000), task)
    assert_is_white(np.array([pin.difference(kinova.model, q, m.q) for m in seen]), sigma)
    assert all(pin.isNormalized(kinova.model, m.q, 1e-12) for m in seen)


@pytest.mark.study
def test_the_record_holds_what_is_true_and_what_was_measured():
    run, told = swing(aj.Sensing(x_noise=0.01, q_noise=1e-3), duration=5.0)
    assert_allclose((run.x_measured - run.x).std(axis=0), 0.01, rtol=0.05)
    assert np.array_equal(run.x_measured, [m.x for m in told])
    assert_allclose((run.q - [m.q for m in told]).std(axis=0), 1e-3, rtol=0.05)
    exact, _ = swing(None, duration=5.0)
    assert np.array_equal(run.q, exact.q)  # noise is in the measurement, not in the motion
    assert np.array_equal(run.x, exact.x)
    assert np.array_equal(exact.x_measured, exact.x)


# -- quanta ---------------------------------------------------------------------------------


def assert_on_grid(values, quantum):
    steps = values / quantum
    assert_allclose(steps, np.round(steps), atol=1e-6)
    assert len(np.unique(np.round(steps), axis=0)) > 20


def test_measured_values_lie_on_the_grid():
    run, _ = swing(aj.Sensing(x_quantum=(0.002, 0.0005)), duration=1.0)
    assert_on_grid(run.x_measured, (0.002, 0.0005))
    assert (np.abs(run.x_measured - run.x) <= np.array([0.001, 0.00025]) + 1e-12).all()
    run, _ = swing(aj.Sensing(x_noise=0.01, x_quantum=(0.002, 0.0)), duration=1.0)
    assert_on_grid(run.x_measured[:, :1], 0.002)  # noise is rounded too, for it comes first
    assert not np.allclose(run.x_measured[:, 1] % 0.002, 0.0, atol=1e-6)


def test_a_pose_is_rounded_in_its_position_and_rotation_vector(pose):
    quantum = np.array([1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.01])
    truths = moving(pose, START, np.array([0.5, 0.3, -0.4, 0.2, 0.6, -0.3, 0.4]), 500)
    seen = readings(aj.Sensing(x_quantum=quantum), truths, pose)
    rotations = [pin.log3(pin.Quaternion(m.x[3:]).toRotationMatrix()) for m in seen]
    assert_on_grid(np.array(rotations), 0.01)
    assert_on_grid(np.array([m.x[:3] for m in seen]), 1e-3)
    errors = np.array([pose.error(m.x, t.x) for m, t in zip(seen, truths, strict=True)])
    assert (np.abs(errors[:, :3]) <= 0.5e-3 + 1e-12).all()
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.02  # ½ √3 quanta, curvature aside


@pytest.mark.parametrize("name", ["panda", "kinova"])
def test_encoders_read_multiples_of_their_quantum(name, kinova, panda, rng):
    robot = {"kinova": kinova, "panda": panda}[name]
    task, quantum = aj.PositionTask(robot), np.linspace(1e-3, 4e-3, robot.nv)
    truths = moving(task, robot.neutral(), rng.uniform(0.3, 1.0, robot.nv), 1000)
    seen = readings(aj.Sensing(q_quantum=quantum), truths, task)
    motions = np.array([pin.difference(robot.model, robot.neutral(), m.q) for m in seen])
    assert_on_grid(motions, quantum)
    errors = [pin.difference(robot.model, t.q, m.q) for m, t in zip(seen, truths, strict=True)]
    assert (np.abs(errors) <= 0.5 * quantum + 1e-9).all()
    assert all(pin.isNormalized(robot.model, m.q, 1e-12) for m in seen)


def test_encoders_that_are_noisy_read_multiples_of_their_quantum_all_the_same(panda):
    truths = moving(aj.PositionTask(panda), START, np.zeros(7), 200)
    noisy = aj.Sensing(q_noise=2e-3, q_quantum=1e-3)
    q = np.array([m.q for m in readings(noisy, truths, aj.PositionTask(panda))])
    assert_allclose(q / 1e-3, np.round(q / 1e-3), atol=1e-6)
    # rounding adds a twelfth of its square
    assert_allclose(q.std(axis=0).mean(), np.hypot(2e-3, 1e-3 / np.sqrt(12.0)), rtol=0.1)


# -- delay and dropouts ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("delay", "samples"),
    [(0.0, 0), (0.02, 20), (1e-3, 1), (0.4e-3, 0), (0.6e-3, 1), (2.4e-3, 2), (2.6e-3, 3)],
)
def test_x_is_as_old_as_the_delay_in_whole_samples(delay, samples):
    run, told = swing(aj.Sensing(x_delay=delay))
    assert np.array_equal(run.x_measured[samples:], run.x[: len(run.x) - samples])
    # until the first one arrives, the first is seen
    assert np.array_equal(run.x_measured[:samples], np.repeat(run.x[:1], samples, axis=0))
    assert np.array_equal([m.q for m in told], run.q)  # encoders are not late
    assert np.abs(np.diff(run.x, axis=0)).min(axis=0).max() > 0.0


def test_a_delay_longer_than_the_run_shows_the_start():
    for delay in (0.5, 10.0):
        run, _ = swing(aj.Sensing(x_delay=delay))
        assert np.array_equal(run.x_measured, np.repeat(run.x[:1], len(run.x), axis=0))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2, 0.9, 1.0])
def test_the_share_that_is_lost_is_the_probability(share, position):
    count = 6000
    seen = readings(aj.Sensing(x_dropout=share), still(position, START, count), position)
    lost = np.array([np.isnan(m.x).all() for m in seen])
    assert np.array_equal(lost, [np.isnan(m.x).any() for m in seen])
    deviation = np.sqrt(share * (1.0 - share) / count)
    assert abs(lost.mean() - share) <= 4.5 * deviation
    if 0.0 < share < 1.0:  # one loss says nothing about the next
        both = (lost[1:] & lost[:-1]).mean()
        assert abs(both - share**2) < 4.5 * deviation


def test_what_is_not_lost_is_as_old_as_the_delay():
    run, _ = swing(aj.Sensing(x_delay=0.01, x_dropout=0.3), duration=1.0)
    kept = np.isfinite(run.x_measured).all(axis=1)
    kept[:10] = False
    assert 600 < kept.sum() < 780
    assert np.array_equal(run.x_measured[kept], run.x[np.flatnonzero(kept) - 10])


def test_the_status_says_where_a_measurement_was_lost(panda, position):
    controller = aj.SetpointController(position)
    plant = aj.Plant(panda, position, sensing=aj.Sensing(x_dropout=0.2))
    target = position.value(START) + [0.05, 0.0, 0.05]
    run = aj.simulate(plant, controller, target, START, 1.0, dt=1e-3)
    lost = np.isnan(run.x_measured).any(axis=1)
    assert 150 < lost.sum() < 250
    assert np.array_equal(run.status == aj.Status.MEASUREMENT_LOST, lost)
    assert np.isfinite(run.error).all()  # that is the true one


@pytest.mark.study
def test_an_arm_that_sees_nothing_slows_down_and_does_not_fall(panda, position):
    plant = aj.Plant(panda, position, sensing=aj.Sensing(x_dropout=1.0))
    controller = aj.SetpointController(position)
    target = position.value(START) + [0.1, 0.1, 0.1]
    v0 = np.array([0.5, -0.4, 0.3, 0.6, -0.5, 0.4, 1.0])
    run = aj.simulate(
        plant, controller, target, aj.simulation.InitialState(START, v0=v0), 4.0, dt=1e-3
    )
    assert run.status_counts() == {aj.Status.MEASUREMENT_LOST: 4001}
    kinetic = [0.5 * v @ plant.dynamics.M(q) @ v for q, v in zip(run.q, run.v, strict=True)]
    assert (np.diff(kinetic) < 0.0).all()
    assert np.abs(run.v[-1]).max() < 1e-5
    assert np.linalg.norm(run.x - run.x[0], axis=1).max() < 0.1
    assert_allclose(run.tau[-1], plant.dynamics.g(run.q[-1]), atol=1e-3)


# -- velocities -----------------------------------------------------------------------------


def test_without_a_filter_velocities_are_differences_of_the_measured_q():
    dt = 2e-3
    for sensing in (
        aj.Sensing(velocity_filter=0.0),
        aj.Sensing(velocity_filter=0.0, q_noise=1e-4),
        aj.Sensing(velocity_filter=0.0, q_quantum=1e-3),
    ):
        _, told = swing(sensing, dt=dt)
        q, v = (np.array([getattr(m, name) for m in told]) for name in "qv")
        assert_allclose(v[1:], np.diff(q, axis=0) / dt, atol=1e-12)
        assert np.array_equal(v[0], np.zeros(2))  # nothing is known before the second sample


def test_a_tachometer_is_exact():
    run, told = swing(aj.Sensing(q_noise=0.01, q_quantum=0.01, x_noise=0.1))
    assert np.array_equal([m.v for m in told], run.v)


@pytest.mark.parametrize("T", [5e-3, 0.02, 0.1])
def test_the_velocity_filter_has_its_time_constant(position, T):
    """A joint that is set in motion: 1 − e⁻¹ of its velocity after T, all of it in the end."""
    dt, v = 1e-4, np.array([1.0, -2.0, 0.5, 0.1, 0.3, -0.7, 1.5])
    truths = moving(position, START, v, round(12 * T / dt), dt)
    seen = readings(aj.Sensing(velocity_filter=T), truths, position, dt)
    ratio = np.array([m.v for m in seen]) / v
    t = np.array([m.t for m in seen])
    assert_allclose(ratio, np.tile(1.0 - np.exp(-t / T), (7, 1)).T, atol=1.1 * dt / T)
    assert ratio[round(T / dt)] == pytest.approx(1.0 - np.exp(-1.0), abs=0.02)
    assert_allclose(ratio[-1], 1.0, atol=1e-4)


@pytest.mark.parametrize("T", [0.0, 5e-4, 2e-3])
@pytest.mark.parametrize("dt", [1e-3, 4e-3])
def test_a_filter_shorter_than_a_sample_does_not_overshoot(position, T, dt):
    """T q̈ + q̇ = Δq/dt with q̈ over the sample before: each leaves T/(T + dt) of what is off."""
    v = np.linspace(-0.5, 0.7, 7)
    seen = readings(aj.Sensing(velocity_filter=T), moving(position, START, v, 9, dt), position, dt)
    for k, reading in enumerate(seen):
        assert_allclose(reading.v, v * (1.0 - (T / (T + dt)) ** k), atol=1e-10)


def test_the_velocity_filter_smooths_noise(position):
    """White noise σ on q makes √2 σ/dt as plain differences, and about σ/T where dt ≪ T."""
    sigma, dt = 1e-5, 1e-3
    truths = still(position, START, 8000, dt)
    for T, expected in ((0.0, np.sqrt(2.0) * sigma / dt), (0.02, sigma / 0.02)):
        sensing = aj.Sensing(q_noise=sigma, velocity_filter=T)
        v = np.array([m.v for m in readings(sensing, truths, position, dt)])[1000:]
        assert_allclose(v.std(), expected, rtol=0.06)


def test_continuous_joints_have_velocities_across_the_turn(kinova):
    task = aj.PositionTask(kinova)
    v = np.array([2.0, -1.5, 1.0, 3.0, -2.5, 2.0])
    truths = moving(task, kinova.neutral(), v, 5000)  # more than a turn
    seen = readings(aj.Sensing(velocity_filter=0.0, q_quantum=1e-9), truths, task)
    assert_allclose([m.v for m in seen[1:]], np.tile(v, (4999, 1)), atol=1e-5)


# -- repeatability --------------------------------------------------------------------------

EVERYTHING = aj.Sensing(
    x_noise=1e-3, x_quantum=5e-4, x_delay=0.02, x_dropout=0.2, q_noise=1e-5, velocity_filter=5e-3
)
FIELDS = [
    *(f.name for f in dataclasses.fields(aj.Trajectory) if f.name not in ("scene", "derived")),
    "task_torque",
    "V",
]


def closed_loop(panda, sensing, seed=0):
    task = aj.PositionTask(panda)
    plant = aj.Plant(
        panda,
        task,
        sensing=sensing,
        actuator_delay=2e-3,
        friction=aj.robots.Friction(coulomb=0.1),
    )
    controller = aj.SetpointController(task, gravity=aj.AdaptiveGravity(GravityRegressor(panda)))
    target = task.value(START) + [0.1, 0.1, 0.1]
    return aj.simulate(plant, controller, target, START, 0.3, dt=1e-3, seed=seed)


@pytest.fixture(scope="module")
def seventh(panda):
    return closed_loop(panda, EVERYTHING, 7)


def same(a, b, name):
    a, b = getattr(a, name), getattr(b, name)
    return np.array_equal(a, b, equal_nan=True) if isinstance(a, np.ndarray) else a == b


def test_the_same_seed_gives_the_same_bits(panda, seventh):
    again = closed_loop(panda, EVERYTHING, 7)
    assert all(same(seventh, again, name) for name in FIELDS)


def test_another_seed_gives_another_run(panda, seventh):
    other = closed_loop(panda, EVERYTHING, 8)
    assert [name for name in FIELDS if not same(seventh, other, name)] == [
        "q", "v", "motor_v", "x", "x_measured", "error", "command", "tau", "state", "learnt",
        "status", "task_torque", "V",
    ]  # fmt: skip


@pytest.mark.study
def test_perfect_sensing_is_no_sensing_to_the_bit(panda):
    ideal = closed_loop(panda, None)
    zeros = aj.Sensing(x_noise=np.zeros(3), q_noise=np.zeros(7), q_quantum=0, x_delay=0)
    for sensing in (aj.Sensing(), zeros):
        run = closed_loop(panda, sensing)
        run = dataclasses.replace(run, state=run.state[:, : ideal.state.shape[1]])  # no guard
        assert all(same(ideal, run, name) for name in FIELDS)


def test_a_run_with_lost_measurements_saves_and_loads(panda, tmp_path):
    run = closed_loop(panda, EVERYTHING)
    assert np.isnan(run.x_measured).any()
    loaded = aj.Trajectory.load(run.save(tmp_path / "run"))
    assert all(same(run, loaded, name) for name in FIELDS)


def test_units_of_the_task_coordinates_are_recorded(panda, pose):
    plant = aj.Plant(panda, pose)
    run = aj.simulate(plant, aj.SetpointController(pose), pose.value(START), START, 2e-3, dt=1e-3)
    assert run.task_units == ("m", "m", "m", "rad", "rad", "rad")
    assert run.task_unit == run.units["x"] == "m or rad"
    assert run.x_measured.shape == run.x.shape == (3, 7)
    assert run.error.shape == (3, 6)


# -- actuators ------------------------------------------------------------------------------


def accelerations(run, dt):
    """q̈ over each sample, of a run with semi-implicit Euler."""
    return np.diff(run.v, axis=0) / dt


def probed(torque, *, dt=1e-3, duration=0.1, q0=(0.3, 0.8), v0=(0.0, 0.0), **plant):
    robot = aj.load_robot("two_link")
    plant = aj.Plant(robot, aj.PositionTask(robot, axes="xz"), **plant)
    options = {"dt": dt, "computation": aj.simulation.Computation("semi_implicit_euler")}
    probe = Probe(plant.sensor, torque)
    start = aj.simulation.InitialState(np.array(q0), v0)
    return plant, aj.simulate(plant, probe, np.zeros(2), start, duration, **options)


def wavy(t):
    return np.array([30.0 + 5.0 * np.sin(40.0 * t), 8.0 - 3.0 * np.cos(30.0 * t)])


@pytest.mark.parametrize(
    ("delay", "samples"), [(0.0, 0), (1e-3, 1), (0.02, 20), (0.4e-3, 0), (0.6e-3, 1), (10.0, 100)]
)
def test_a_torque_takes_effect_after_the_delay(delay, samples):
    dt = 1e-3
    plant, run = probed(wavy, dt=dt, actuator_delay=delay)
    assert_allclose(run.tau, [wavy(t) for t in run.t])  # what is commanded is recorded
    held = plant.dynamics.g(run.q[0])
    measured = accelerations(run, dt)
    for k, acceleration in enumerate(measured):
        applied = held if k < samples else run.tau[k - samples]
        expected = plant.dynamics.forward(run.q[k], run.v[k], applied)
        assert_allclose(acceleration, expected, atol=1e-9)
    assert_allclose(measured[:samples], 0.0, atol=1e-9)  # it is held at rest until then
    if samples < 100:
        assert np.abs(measured[samples]).max() > 1.0


@pytest.mark.parametrize("limits", [12.0, (20.0, 3.0), (np.inf, 3.0)])
def test_motors_deliver_no_more_than_their_limits(limits):
    dt = 1e-3
    plant, run = probed(wavy, dt=dt, torque_limits=limits, friction=0.3)
    assert_allclose(run.tau, [wavy(t) for t in run.t])
    for k, acceleration in enumerate(accelerations(run, dt)):
        delivered = np.clip(wavy(run.t[k]), -np.array(limits), limits)
        assert np.abs(delivered - wavy(run.t[k])).max() > 1.0
        expected = plant.dynamics.forward(run.q[k], run.v[k], delivered - 0.3 * run.v[k])
        assert_allclose(acceleration, expected, atol=1e-9)


def at_the_joints(plant, v, tau, q=(0.3, 0.8)):
    """Return the torque that moves the arm as a commanded one does."""
    q = np.array(q)
    return plant.dynamics.inverse(q, v, plant.acceleration(q, v, tau))


def test_friction_is_not_clipped_with_the_torque():
    robot = aj.load_robot("two_link")
    plant = aj.Plant(
        robot, aj.PositionTask(robot, axes="xz"), friction=2.0, torque_limits=(1.0, 1.0)
    )
    v, tau = np.array([3.0, -2.0]), np.array([-5.0, 0.5])
    assert_allclose(at_the_joints(plant, v, tau), [-1.0 - 6.0, 0.5 + 4.0])


# -- friction -------------------------------------------------------------------------------


def test_friction_is_the_formula(rng):
    robot = aj.load_robot("two_link")
    B, coulomb = np.array([0.3, 0.7]), np.array([1.5, 0.4])
    plant = aj.Plant(
        robot,
        aj.PositionTask(robot, axes="xz"),
        friction=aj.robots.Friction(B, coulomb=coulomb),
    )
    for _ in range(20):
        v, tau, q = rng.normal(0.0, 0.05, 2), rng.normal(size=2), rng.normal(size=2)
        arrives = tau - B * v - coulomb * np.tanh(v / 0.05)
        assert_allclose(at_the_joints(plant, v, tau, q), arrives, atol=1e-9)
    fast = at_the_joints(plant, np.array([5.0, -5.0]), np.zeros(2))
    assert_allclose(fast, [-1.5 - 1.5, 0.4 + 3.5], atol=1e-9)  # all of τ_c, and viscous friction


@pytest.mark.parametrize("viscous", [0.0, 0.3])
def test_coulomb_friction_dissipates_exactly_its_power(viscous):
    robot = aj.load_robot("two_link")
    coulomb, width = np.array([0.8, 0.3]), 0.05
    plant = aj.Plant(
        robot,
        aj.PositionTask(robot, axes="xz"),
        friction=aj.robots.Friction(viscous, coulomb=coulomb),
    )
    probe = Probe(plant.sensor, lambda t: np.zeros(2))
    run = aj.simulate(plant, probe, np.zeros(2), (0.3, 0.8), 2.0, record_every=1e-3, dt=None)
    energy = np.array([plant.dynamics.energy(q, v) for q, v in zip(run.q, run.v, strict=True)])
    power = (run.v * np.tanh(run.v / width)) @ coulomb + viscous * (run.v**2).sum(axis=1)
    lost = cumulative_simpson(power, x=run.t, initial=0.0)
    assert lost[-1] > 1.0
    assert_allclose(energy[0] - energy, lost, atol=1e-5)


# -- bad input ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"x_noise": -1e-3},
        {"x_noise": (1e-3, np.nan)},
        {"x_noise": "much"},
        {"x_noise": [[1.0], [1.0, 2.0]]},
        {"x_quantum": -1.0},
        {"q_noise": np.inf},
        {"q_quantum": (1.0, -1.0)},
        {"x_delay": -0.01},
        {"x_delay": np.nan},
        {"x_delay": None},
        {"x_dropout": 1.1},
        {"x_dropout": -0.1},
        {"x_dropout": np.nan},
        {"velocity_filter": -1.0},
        {"velocity_filter": np.inf},
        {"x_rate": 0.0},
        {"x_rate": -30},
        {"x_rate": np.inf},
        {"x_rate": "30 Hz"},
        *(
            {"x_lost": value}
            for value in (
                1.0,
                None,
                (1.0, 2.0),
                [(1.0,)],
                [(1, 2, 0, 0)],
                [(1, 2, 0.0)],
                [(1, 2, -1)],
                [(1, 2, True)],
                [(1, 2, "hand")],
                "ab",
            )
        ),
        {"x_lost": [(2.0, 1.0)]},
        {"x_lost": [(1.0, 1.0)]},
        {"x_lost": [(0, np.inf)]},
        {"x_lost": [(np.nan, 1)]},
        {"x_lost": [("a", 1)]},
        {"x_frozen": (1.0, 2.0)},
        {"x_frozen": [(1.0, 2.0, 0)]},
        {"x_frozen": [(3, 2)]},
    ],
)
def test_bad_sensing_is_refused(changes):
    with pytest.raises(aj.InvalidInputError):
        aj.Sensing(**changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"x_noise": (1.0, 1.0, 1.0)},
        {"x_quantum": (1.0,)},
        {"q_noise": (1.0, 1.0, 1.0)},
        {"q_quantum": np.ones(7)},
        {"x_lost": [(0, 1, 0), (1, 2, 1)]},
    ],
)
def test_sensing_of_the_wrong_length_is_refused_by_the_plant(changes):
    robot = aj.load_robot("two_link")
    sensing = aj.Sensing(**changes)
    with pytest.raises(aj.InvalidInputError):
        aj.Plant(robot, aj.PositionTask(robot, axes="xz"), sensing=sensing)


@pytest.mark.parametrize(
    "changes",
    [
        {"friction": aj.robots.Friction(coulomb=-1.0)},
        {"friction": aj.robots.Friction(coulomb=(1.0,))},
        {"friction": aj.robots.Friction(coulomb=np.nan)},
        {"actuator_delay": -1e-3},
        {"actuator_delay": np.nan},
        {"torque_limits": 0.0},
        {"torque_limits": (1.0, np.nan)},
        {"torque_limits": np.ones(3)},
        {"torque_limits": True},
        {"sensing": 1e-3},
        {"sensing": aj.Sensing},
    ],
)
def test_a_bad_plant_is_refused(changes):
    robot = aj.load_robot("two_link")
    with pytest.raises(aj.InvalidInputError):
        aj.Plant(robot, aj.PositionTask(robot, axes="xz"), **changes)


@pytest.mark.parametrize("changes", [{"sensing": aj.Sensing()}, {"actuator_delay": 1e-3}])
def test_late_and_lost_measurements_need_sampled_control(changes):
    with pytest.raises(aj.InvalidInputError, match="dt must be given for a plant with sensing"):
        probed(wavy, dt=None, **changes)


@pytest.mark.parametrize("seed", [-1, 1.0, None, True, "0"])
def test_a_bad_seed_is_refused(seed):
    with pytest.raises(aj.InvalidInputError, match=r"seed must be an integer >= 0, got"):
        swing(aj.Sensing(x_noise=1.0), seed=seed)


def test_progress_must_be_a_function(panda, position):
    plant, controller = aj.Plant(panda, position), aj.SetpointController(position)
    with pytest.raises(aj.InvalidInputError, match="progress must be a function of the time reac"):
        aj.simulate(
            plant,
            controller,
            np.ones(3),
            START,
            1.0,
            dt=0.1,
            computation=aj.simulation.Computation(progress=True),
        )


# -- all of it together ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gravity", "settled", "final", "offset", "seed"),
    # measured over 4 runs: 4.5 to 6.6, as friction holds the arm there; 0.3 to 0.9, 0.2 to 0.5
    [
        ("known", 8e-3, 8e-3, (0.1, -0.15, 0.16), 0),
        pytest.param("learnt", 2e-3, 1e-3, (-0.1, 0.2, 0.1), 1, marks=pytest.mark.long),
        pytest.param("known", 8e-3, 8e-3, (-0.1, 0.2, 0.1), 1, marks=pytest.mark.long),
        pytest.param("learnt", 2e-3, 1e-3, (0.1, -0.15, 0.16), 0, marks=pytest.mark.long),
    ],
)
def test_the_target_is_reached_with_realistic_measurements(
    panda, gravity, settled, final, offset, seed
):
    """A 20 cm, 0.5 kg tool believed absent, default gains, friction that nobody models.

    1 kHz; x with 1 mm noise, 0.5 mm quanta, 20 ms late and every fifth lost; encoders with 10 µrad
    noise and their filtered differences for q̇; torques 2 ms late; 0.5 N m s/rad of viscous and
    0.5 N m of Coulomb friction. Where gravity is known nothing integrates the error, so the arm
    rests as soon as no joint's torque exceeds its friction.
    """
    truth, belief = panda.with_object(0.20, 0.5), panda.with_object(0.0, 0.0)
    regressor = GravityRegressor(belief)
    controller = aj.SetpointController(
        aj.PositionTask(belief),
        gravity=aj.AdaptiveGravity(regressor)
        if gravity == "learnt"
        else RegressorGravity(regressor, regressor.fit(truth)[0]),
    )
    plant = aj.Plant(
        truth,
        aj.PositionTask(truth),
        friction=aj.robots.Friction(0.5, coulomb=0.5),
        sensing=EVERYTHING,
        actuator_delay=2e-3,
    )
    target = plant.sensor.value(START) + offset
    options = {
        "dt": 1e-3,
        "computation": aj.simulation.Computation("semi_implicit_euler"),
        "seed": seed,
    }
    run = aj.simulate(plant, controller, target, START, 8.0, **options)
    assert run.error_norm[0] > 0.24
    assert run.error_norm.max() < 1.05 * run.error_norm[0]
    assert run.error_norm[run.t >= 6.0].max() < settled
    assert run.error_norm[-1] < final
    assert np.abs(run.v[run.t >= 6.0]).max() < 0.02
    lost = np.isnan(run.x_measured).any(axis=1)
    assert lost.mean() == pytest.approx(0.2, abs=0.02)
    # what was measured scatters more than what was reached
    scatter = np.linalg.norm((run.x_measured - run.x)[~lost & (run.t >= 6.0)], axis=1)
    if gravity == "learnt":
        assert scatter.mean() > 1.5e-3 > run.error_norm[-1]
    else:  # nothing but friction holds it there
        asked = np.abs(run.task_torque[~lost & (run.t >= 7.0)]).mean(axis=0)
        assert asked.max() < 1.1 * 0.5


def test_a_controller_starts_from_its_first_reading_not_from_the_truth(panda):
    """Law (5) differentiates x from the first one on, and that one is a measured one."""
    task = aj.PositionTask(panda)
    controller = aj.SetpointController(
        task, aj.Gains(100.0, 20.0, 1.0), velocity=DifferentiatedVelocity(0.02)
    )
    plant = aj.Plant(panda, task, sensing=aj.Sensing(x_quantum=0.1))
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    run = aj.simulate(plant, controller, task.value(q0), q0, 0.01, dt=1e-3)
    assert np.array_equal(run.state[0, : controller.size], run.x_measured[0])
    assert np.abs(run.x_measured[0] - run.x[0]).max() > 0.01
    lost = aj.Plant(panda, task, sensing=aj.Sensing(x_dropout=1.0))
    with pytest.raises(MeasurementError, match=r"the first x must be finite for law \(5\)"):
        aj.simulate(lost, controller, task.value(q0), q0, 0.01, dt=1e-3)


# -- frames ---------------------------------------------------------------------------------


class Blind(aj.PositionTask):
    """A sensor that sees nothing to the right of a wall."""

    wall = 0.0

    def visible(self, x):
        return x if x[0] <= self.wall else np.full(3, np.nan)


@pytest.fixture(scope="module")
def plane():
    return aj.PositionTask(aj.load_robot("two_link"), axes="xz")


@pytest.fixture(scope="module")
def pair(panda):
    return aj.StackedTask(aj.PositionTask(panda), aj.PositionTask(panda, "panda_link4", axes="z"))


def numbered(task, count, dt=1e-3):
    """Truths whose x is the number of their sample, so that a reading tells what was taken."""
    q, v = task.robot.neutral(), np.zeros(task.robot.nv)
    return [aj.Measurement(k * dt, q, v, np.full(task.n_x, float(k))) for k in range(count)]


def taken(sensing, task, count, dt=1e-3, seed=0):
    """Number of the sample whose x is read at each sample, shape (count, n_x)."""
    return np.array([m.x for m in readings(sensing, numbered(task, count, dt), task, dt, seed)])


def frames(rate, count, dt=1e-3):
    """At each sample, the number of the sample at which its frame was taken, in exact numbers."""
    per_sample = Fraction(str(rate)) * Fraction(str(dt))
    return np.array([math.ceil((k * per_sample).__floor__() / per_sample) for k in range(count)])


@pytest.mark.parametrize(
    ("rate", "dt"),
    [(30, 1e-3), (60, 1e-3), (29.97, 1e-3), (333.3, 1e-3), (999, 1e-3), (0.7, 0.01), (24, 2e-3)],
)
def test_a_frame_is_taken_at_the_first_sample_at_or_after_its_time(plane, rate, dt):
    shown = taken(aj.Sensing(x_rate=rate), plane, 5000, dt)
    assert_array_equal(shown[:, 0], frames(rate, 5000, dt))
    assert_array_equal(shown[:, 0], shown[:, 1])


def test_frames_of_a_long_run_stay_in_time(plane):
    """An hour at 10 Hz: the last frame is where exact numbers have it, as the first is."""
    count, dt = 36_000, 0.1
    read = SensorReadings(aj.Sensing(x_rate=7.4925), plane, dt, 0).read
    q, v = np.zeros(2), np.zeros(2)
    shown = [read(aj.Measurement(k * dt, q, v, np.full(2, float(k)))).x[0] for k in range(count)]
    assert_array_equal(shown, frames(7.4925, count, dt))
    assert len(np.unique(shown)) == math.floor((count - 1) * 0.74925) + 1


@pytest.mark.parametrize("rate", [None, 30.0, 100.0, 470.0])
@pytest.mark.parametrize("late", [0, 1, 7, 40])
def test_what_is_lost_or_frozen_is_so_from_its_first_instant_to_before_its_last(pair, rate, late):
    """By the time at which a frame is taken, and of one part where there is one; in exact numbers.

    Ends are instants at which a frame is taken, and at which none is.
    """
    lost, of_part, frozen, dt, count = (0.03, 0.06), (0.08, 0.105), (0.13, 0.16), 1e-3, 260
    sensing = aj.Sensing(
        x_rate=rate, x_delay=late * dt, x_lost=[lost, (*of_part, 1)], x_frozen=[frozen]
    )
    seen = readings(sensing, numbered(pair, count), pair)
    shown, images = np.arange(count) if rate is None else frames(rate, count), {}
    last = 0
    for k in range(count):
        if shown[k] == k and not 130 <= k < 160:
            last = k
        images[k] = last
    for k, reading in enumerate(seen):
        number = images[max(k - late, 0)]
        expected = np.full(4, np.nan if 30 <= number < 60 else float(number))
        if 80 <= number < 105:
            expected[3] = np.nan
        assert_array_equal(reading.x, expected, err_msg=f"at sample {k}")
        assert reading.t_x == pytest.approx(number * dt)


def test_between_frames_the_last_one_is_read_again_to_the_bit(position):
    v = np.array([0.5, 0.3, -0.4, 0.2, 0.6, -0.3, 0.4])
    sensing = aj.Sensing(x_rate=30.0, x_noise=1e-3, x_quantum=1e-6)
    seen = readings(sensing, moving(position, START, v, 1000), position)
    x = np.array([m.x for m in seen])
    changes = np.flatnonzero((np.diff(x, axis=0) != 0.0).any(axis=1)) + 1
    assert_array_equal(np.unique(frames(30.0, 1000))[1:], changes)


@pytest.mark.parametrize(
    "rate",
    [999.9999999, *(pytest.param(k, marks=pytest.mark.study) for k in (1e3, 1000.1, 60e3, 1e300))],
)
def test_a_camera_no_slower_than_control_is_read_at_every_sample(panda, seventh, rate):
    again = closed_loop(panda, dataclasses.replace(EVERYTHING, x_rate=rate), 7)
    assert all(same(seventh, again, name) for name in FIELDS)


@pytest.mark.parametrize("rate", [30.0, 60.0, 217.0])
@pytest.mark.parametrize("delay", [0.0, 1e-3, 0.03, 0.12])
def test_a_frame_arrives_after_the_delay(plane, rate, delay):
    late, count = round(delay * 1e3), 1000
    shown = taken(aj.Sensing(x_rate=rate, x_delay=delay), plane, count)[:, 0]
    expected = frames(rate, count)
    assert_array_equal(shown[late:], expected[: count - late])
    assert_array_equal(shown[:late], np.zeros(late))  # until one arrives, the first is seen


def test_noise_comes_once_a_frame(position):
    sigma = np.array([1e-3, 5e-3, 2e-2])
    truths = still(position, START, 12_000, dt=0.01)
    seen = readings(aj.Sensing(x_rate=30.0, x_noise=sigma), truths, position, dt=0.01)
    errors = np.array([m.x for m in seen]) - truths[0].x
    first = np.unique(frames(30.0, len(truths), dt=0.01))
    assert_is_white(errors[first], sigma)
    assert len(np.unique(errors[:, 0])) == len(first) == 3_600


@pytest.mark.parametrize(
    ("share", "delay"), [pytest.param(0.05, 0.0, marks=pytest.mark.study), (0.3, 0.03), (1.0, 0.0)]
)
def test_a_lost_frame_is_lost_until_the_next_one_arrives(plane, share, delay):
    count, dt, late = 12_000, 0.01, round(delay / 0.01)
    shown = taken(aj.Sensing(x_rate=30.0, x_dropout=share, x_delay=delay), plane, count, dt)
    expected = frames(30.0, count, dt)
    expected = np.concatenate([np.zeros(late), expected[: count - late]])
    lost = np.isnan(shown)
    assert_array_equal(lost[:, 0], lost[:, 1])
    assert_array_equal(shown[~lost[:, 0], 0], expected[~lost[:, 0]])
    numbers, first, sizes = np.unique(expected, return_index=True, return_counts=True)
    in_frame = np.add.reduceat(lost[:, 0], first)
    assert set(in_frame / sizes) <= {0.0, 1.0}  # all of a frame's readings, or none
    deviation = np.sqrt(share * (1.0 - share) / len(numbers))
    assert abs((in_frame > 0).mean() - share) <= 4.5 * deviation


@pytest.mark.study
def test_the_same_seed_takes_the_same_frames(panda):
    sensing = dataclasses.replace(
        EVERYTHING, x_rate=60.0, x_lost=[(0.1, 0.15)], x_frozen=[(0.2, 0.25)]
    )
    first, again = closed_loop(panda, sensing, 7), closed_loop(panda, sensing, 7)
    assert all(same(first, again, name) for name in FIELDS)
    assert not same(first, closed_loop(panda, sensing, 8), "x_measured")


# -- what is hidden, and a camera that hangs ------------------------------------------------


def test_x_is_lost_in_its_intervals(plane):
    shown = taken(aj.Sensing(x_lost=[(0.1, 0.2), (1.009, 1.01), (0.15, 0.3)]), plane, 2000)
    lost = np.isnan(shown).any(axis=1)
    assert_array_equal(np.flatnonzero(lost), [*range(100, 300), 1009])
    assert_array_equal(shown[~lost, 0], np.flatnonzero(~lost))


def test_a_hidden_frame_is_lost_for_as_long_as_it_is_read(plane):
    """An interval is that of the exposure: what arrives late is lost late."""
    sensing = aj.Sensing(x_rate=50.0, x_delay=0.03, x_lost=[(0.39, 0.41)])  # the frame at 0.4 s
    shown = taken(sensing, plane, 1000)[:, 0]
    assert_array_equal(np.flatnonzero(np.isnan(shown)), range(430, 450))
    between = aj.Sensing(x_rate=50.0, x_lost=[(0.381, 0.399)])  # no frame is taken then
    assert not np.isnan(taken(between, plane, 1000)).any()


@pytest.mark.parametrize("period", ["0.0024", "0.0045", "0.007"])
def test_where_round_off_puts_an_instant_beside_an_end_it_counts_as_there(plane, period):
    """k dt in doubles is often less than the number that is written: a frame is lost as it says."""
    exact = Fraction(period)
    ends = [(float(3 * k * exact), float((3 * k + 1) * exact)) for k in range(1, 60)]
    shown = taken(aj.Sensing(x_lost=ends), plane, 180, float(period))[:, 0]
    assert_array_equal(np.flatnonzero(np.isnan(shown)), range(3, 180, 3))


def test_one_part_is_lost_and_the_others_are_not(pair):
    shown = taken(aj.Sensing(x_lost=[(0.1, 0.2, 0), (0.15, 0.25, 1)]), pair, 300)
    samples = np.arange(300.0)
    hidden = (samples >= 100) & (samples < 200)
    assert_array_equal(shown[:, :3], np.where(hidden, np.nan, samples)[:, None] * np.ones(3))
    assert_array_equal(shown[:, 3], np.where((samples >= 150) & (samples < 250), np.nan, samples))


def test_a_camera_that_hangs_delivers_its_last_image(position):
    v = np.array([0.5, 0.3, -0.4, 0.2, 0.6, -0.3, 0.4])
    truths = moving(position, START, v, 600)
    for sensing, last, back in (
        (aj.Sensing(x_noise=1e-3, x_frozen=[(0.2, 0.4)]), 199, 400),
        # frames at 0.1980, 0.2310, ... 0.3960, 0.4290 s
        (aj.Sensing(x_noise=1e-3, x_rate=1e3 / 33, x_frozen=[(0.2, 0.4)]), 198, 429),
        (aj.Sensing(x_noise=1e-3, x_frozen=[(0.2, 0.4)], x_delay=0.05), 249, 450),
    ):
        x = np.array([m.x for m in readings(sensing, truths, position)])
        assert (x[last:back] == x[last]).all()
        assert (x[back] != x[last]).all()
        assert (x[last - 40] != x[last]).all()


def test_a_camera_that_hangs_from_the_start_has_one_image(plane):
    shown = taken(aj.Sensing(x_frozen=[(0.0, 0.5)]), plane, 600)[:, 0]
    assert_array_equal(shown, [0] * 500 + list(range(500, 600)))


def test_a_frozen_image_lacks_what_was_hidden(pair):
    """What is hidden while the camera hangs is on the image still, and the other way round."""
    sensing = aj.Sensing(x_lost=[(0.0, 0.15, 0), (0.15, 0.2, 1)], x_frozen=[(0.1, 0.3)])
    shown = taken(sensing, pair, 400)
    assert np.isnan(shown[:300, :3]).all()
    assert_array_equal(shown[99:300, 3], np.full(201, 99.0))
    assert_array_equal(shown[300:, 0], range(300, 400))


PLANE = aj.PositionTask(aj.load_robot("two_link"), axes="xz")
MILLISECONDS = st.integers(0, 400)
PAIRS = st.lists(st.tuples(MILLISECONDS, MILLISECONDS).filter(lambda ab: ab[0] < ab[1]), max_size=3)


@given(st.integers(1, 40), st.integers(0, 60), PAIRS, PAIRS)
def test_every_reading_is_the_image_that_was_taken_then(period, late, lost, frozen):
    """Against a camera in whole milliseconds: rates, delays and intervals in any combination."""
    task, count = PLANE, 500
    sensing = aj.Sensing(
        x_rate=1e3 / period,
        x_delay=late * 1e-3,
        x_lost=[(a * 1e-3, b * 1e-3) for a, b in lost],
        x_frozen=[(a * 1e-3, b * 1e-3) for a, b in frozen],
    )
    images, image = [], None
    for k in range(count):
        hangs = image is not None and any(a <= k < b for a, b in frozen)
        if k % period == 0 and not hangs:
            image = np.nan if any(a <= k < b for a, b in lost) else float(k)
        images.append(image)
    expected = [images[max(0, k - late)] for k in range(count)]
    assert_array_equal(taken(sensing, task, count)[:, 0], expected)


def test_an_interval_of_a_part_that_the_task_does_not_have_is_refused(panda, pair):
    text = r"part of x_lost must be one of the 2 of StackedTask.*, counted from 0, got 2"
    with pytest.raises(aj.InvalidInputError, match=text):
        aj.Plant(panda, pair, sensing=aj.Sensing(x_lost=[(0.0, 1.0, 2)]))


def test_intervals_are_those_that_were_given():
    given = [[0.0, 1], (2, 3.5, 1)]
    sensing = aj.Sensing(x_lost=given, x_frozen=iter([(1, 2)]))
    given[0][0] = 0.5
    assert sensing.x_lost == ((0.0, 1.0), (2.0, 3.5, 1))
    assert sensing.x_frozen == ((1.0, 2.0),)
    assert dataclasses.replace(sensing, x_rate=30.0).x_lost == sensing.x_lost


@pytest.mark.parametrize(
    "frames", [{"x_rate": 30.0}, {"x_lost": [(0.0, 1.0)]}, {"x_frozen": [(0.0, 1.0)]}]
)
def test_frames_are_not_linear(panda, position, frames):
    assert aj.Sensing(x_delay=0.01).is_linear
    assert not aj.Sensing(x_delay=0.01, **frames).is_linear
    plant = aj.Plant(panda, position, sensing=aj.Sensing(**frames))
    with pytest.raises(aj.InvalidInputError, match="errors or delays of sensing"):
        aj.local_stability(plant, aj.SetpointController(position), START, dt=1e-3)


# -- what the sensor itself does not see ----------------------------------------------------


def test_noise_and_rounding_leave_what_is_not_seen_unseen_and_the_rest_as_it_is(panda):
    elbow = aj.PositionTask(panda, "panda_link4", axes="z")
    sensing = aj.Sensing(x_noise=1e-3, x_quantum=5e-4, x_rate=60.0)
    for hand in (aj.PositionTask(panda), aj.PoseTask(panda)):
        both = aj.StackedTask(hand, elbow)
        truths = still(both, START, 100)
        for entries, _ in both.parts:
            hidden = []
            for truth in truths:
                x = truth.x.copy()
                x[entries] = np.nan
                hidden.append(truth._replace(x=x))
            whole, parts = (
                np.array([m.x for m in readings(sensing, each, both)]) for each in (truths, hidden)
            )
            assert np.isnan(parts[:, entries]).all()
            parts[:, entries] = whole[:, entries]
            assert_array_equal(parts, whole)


@pytest.mark.study
@pytest.mark.parametrize("dt", [None, 1e-3])
def test_a_run_goes_on_where_the_sensor_sees_nothing(panda, dt, tmp_path):
    """On its way to the target the arm enters the blind zone, and damping stops it there."""
    sensor = Blind(panda)
    sensor.wall = sensor.value(START)[0] + 0.05
    plant = aj.Plant(panda, sensor)
    controller = aj.SetpointController(aj.PositionTask(panda))
    target = sensor.value(START) + [0.1, 0.0, 0.0]
    run = aj.simulate(plant, controller, target, START, 3.0, dt=dt)
    blind = np.isnan(run.x_measured).any(axis=1)
    assert_array_equal(blind, run.x[:, 0] > sensor.wall)
    assert_array_equal(blind, run.status == aj.Status.MEASUREMENT_LOST)
    assert blind.any()
    assert not blind.all()
    assert np.abs(run.v[-1]).max() < 1e-3
    for array in (run.x, run.error, run.tau, run.error_norm):
        assert np.isfinite(array).all()
    assert "measurement lost" in str(run)
    loaded = aj.Trajectory.load(run.save(tmp_path / "run"))
    assert all(same(run, loaded, name) for name in FIELDS)
    assert len(view.plot_run(run)[1]) == 2


def test_rounding_images_leaves_measured_depths_as_they_are(panda):
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (1.6, -0.8, 0.9), 600.0, (640, 480))
    points = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]
    image = aj.ImageTask(panda, camera, points=points, depth="measured")
    for task in (image, aj.StackedTask(image), CombinedTask(image, 2.0 * np.eye(4))):
        truth = still(task, START, 1)
        read = readings(aj.Sensing(x_quantum=0.5), truth, task)[0].x.reshape(2, 3)
        true = truth[0].x.reshape(2, 3)
        assert_array_equal(read[:, 2], true[:, 2])
        step = 0.25 if isinstance(task, CombinedTask) else 0.5
        assert_array_equal(read[:, :2], step * np.round(true[:, :2] / step))


@pytest.mark.parametrize("seed", [3, 2**60 + 1])
def test_no_two_errors_of_a_run_are_drawn_alike(seed):
    drawn = [generator(seed, kind).random(200) for kind in DRAWN]
    shared = np.corrcoef(drawn) - np.eye(len(DRAWN))
    assert np.abs(shared).max() < 0.3
    again = generator(seed, DRAWN[-1]).random(200)
    assert_array_equal(again, drawn[-1])
