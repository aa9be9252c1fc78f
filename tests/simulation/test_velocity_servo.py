"""Robots that take velocities: the servo in the plant, and who may command it."""

import copy
import math
import pickle
from collections import deque
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.controllers import Controller, HeldMeasurement
from approxjac.robots import Dynamics, Friction
from approxjac.simulation import Computation, InitialState, Loop, VelocityServo
from approxjac.simulation.plant import INTEGRATORS

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
PLANTS = (aj.Plant, aj.MujocoPlant)
ROUGH = {"friction": Friction(0.5, 0.3)}


@pytest.fixture(autouse=True)
def _log_elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log


class Told(Controller):
    """A controller that commands a function of time, and keeps what it measured."""

    command = "velocity"

    def __init__(self, task, velocity):
        super().__init__(task)
        self.velocity, self.told = velocity, []

    def advance(self, state, measurement, target, dt):
        self.told.append(measurement)
        e = measurement.x - target
        return state, aj.Evaluation(self.velocity(measurement.t), None, aj.Status.OK, e)


class ResolvedRate(Controller):
    """Whitney's resolved motion rate control, q̇ = −k J⁺e, with the believed Jacobian."""

    command = "velocity"

    def __init__(self, task, gain):
        super().__init__(task)
        self.gain = gain

    def advance(self, state, measurement, target, dt):
        e = self.task.error(measurement.x, target)
        J_hat = self.task.jacobian(measurement.q, measurement.x)
        velocity = -self.gain * np.linalg.pinv(J_hat) @ e
        return state, aj.Evaluation(velocity, None, aj.Status.OK, e, J_hat)


def driven(plant, velocity, q0=None, duration=0.2, dt=1e-3, v0=None, **options):
    """A run in which joints are told a velocity, and what the controller measured."""
    told = Told(plant.sensor, velocity)
    q0 = plant.ready_configuration() if q0 is None else q0
    target, start = plant.sensor.value(q0), InitialState(q0, v0)
    return aj.simulate(plant, told, target, start, duration, dt=dt, **options), told


def constant(value, nv):
    return lambda t: np.full(nv, value)


# -- lag, delay, period -----------------------------------------------------------------


@pytest.mark.parametrize("dt", [1e-3, 8e-3, 20e-3])
@pytest.mark.parametrize("name", ["panda", "kinova"])
def test_a_step_has_the_lag_and_the_delay(name, dt):
    plant = aj.Plant(aj.load_robot(name), servo=VelocityServo(lag=0.03, delay=0.008), **ROUGH)
    run, _ = driven(plant, constant(0.1, plant.robot.nv), dt=dt)
    since = np.maximum(run.t - 0.008, 0.0)
    assert_allclose(run.v, 0.1 * (1.0 - np.exp(-since / 0.03))[:, None] + 0.0 * run.v, atol=1e-9)
    assert run.v[-1].min() > 0.0995


def test_semi_implicit_euler_has_the_lag_to_first_order(panda):
    plant = aj.Plant(panda, servo=VelocityServo(lag=0.03, delay=0.0))
    run, _ = driven(plant, constant(0.1, 7), computation=Computation("semi_implicit_euler"))
    exact = 0.1 * (1.0 - np.exp(-run.t / 0.03))
    assert np.abs(run.v - exact[:, None]).max() < 0.1 * 0.01


@pytest.mark.parametrize(("period", "delay"), [(0.008, 0.008), (0.005, 0.0), (0.0025, 0.0034)])
def test_a_command_is_taken_at_the_servos_period_and_held(panda, period, delay):
    lag, h = 0.01, 1e-3
    plant = aj.Plant(panda, servo=VelocityServo(lag, delay, period))
    run, _ = driven(plant, lambda t: np.full(7, np.sin(20.0 * t)), duration=0.1)
    late, v, expected = round(delay / h), 0.0, [0.0]
    for k in range(100):
        held = 0.0
        if k >= late:
            frame = math.floor((k - late) * h / period + 1e-6)  # taken at the next sample
            held = np.sin(20.0 * h * math.ceil(frame * period / h - 1e-6))
        v = held + (v - held) * math.exp(-h / lag)
        expected.append(v)
    assert_allclose(run.v, np.tile(expected, (7, 1)).T, atol=1e-6)


@pytest.mark.parametrize("dt", [2e-3, 4e-3])
def test_a_servo_ignores_commands_within_its_period_at_any_sampling_time(panda, dt):
    lag, period, each = 0.01, 0.016, []
    plant = aj.Plant(panda, servo=VelocityServo(lag, 0.0, period))
    run, _ = driven(plant, lambda t: np.full(7, np.sin(20.0 * t)), duration=0.1, dt=dt)
    v = 0.0
    for k in range(len(run.t)):
        each.append(v)
        held = np.sin(20.0 * period * math.floor(k * dt / period + 1e-6))
        v = held + (v - held) * math.exp(-dt / lag)
    assert_allclose(run.v, np.tile(each, (7, 1)).T, atol=1e-5)


@pytest.mark.parametrize("late", [(12, 0), (4, 8)])
@pytest.mark.parametrize("dt", [1e-3, 4e-3])
def test_the_delays_of_actuators_and_of_their_servo_add_up(panda, late, dt):
    of_actuators, of_servo = (1e-3 * each for each in late)
    plant, alone = (
        aj.Plant(panda, servo=VelocityServo(delay=delay, period=dt), actuator_delay=more)
        for delay, more in ((of_servo, of_actuators), (12e-3, 0.0))
    )
    run, expected = (
        driven(each, lambda t: np.full(7, np.cos(20.0 * t)), START, 0.04, dt)[0]
        for each in (plant, alone)
    )
    assert_array_equal(run.v, expected.v)
    assert_array_equal(run.tau, expected.tau)
    moves = np.abs(run.v).max(axis=1) > 1e-9
    assert run.t[moves][0] == pytest.approx(12e-3 + dt)


def test_the_arm_rests_until_the_first_command_acts(panda):
    plant = aj.Plant(panda, servo=VelocityServo(delay=0.05), **ROUGH)
    run, _ = driven(plant, constant(1.0, 7), START, duration=0.05)
    assert_allclose(run.q, np.tile(START, (len(run.t), 1)), atol=1e-12)
    braked, _ = driven(plant, constant(1.0, 7), START, duration=0.05, v0=np.ones(7))
    assert_allclose(braked.v[-1], np.exp(-0.05 / 0.03), rtol=1e-6)


# -- torque -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", PLANTS)
def test_the_recorded_torque_is_the_servos(panda, kind):
    plant = kind(panda, servo=VelocityServo(delay=0.0), **ROUGH)
    run, _ = driven(plant, constant(0.2, 7), START, duration=0.05)
    for q, v, tau in zip(run.q, run.v, run.tau, strict=True):
        assert_allclose(plant.acceleration(q, v, tau), (0.2 - v) / 0.03, atol=1e-8)


@pytest.mark.parametrize("kind", PLANTS)
def test_the_torque_is_clipped_at_the_limits_of_the_motors(panda, kind):
    for options in ({}, {"torque_limits": 60.0}):
        plant = kind(panda, servo=VelocityServo(delay=0.0), **options)
        run, _ = driven(plant, constant(2.0, 7), START, duration=0.1)
        assert (np.abs(run.tau) <= plant.motor_limits).all()
        assert (np.abs(run.tau[0]) == plant.motor_limits).any()
        bare = kind(panda)
        slope = (run.v[1] - run.v[0]) / 1e-3
        assert_allclose(slope, bare.acceleration(START, np.zeros(7), run.tau[0]), rtol=0.05, atol=1)
        ideal = 2.0 * (1.0 - np.exp(-run.t / 0.03))
        assert np.abs(run.v - ideal[:, None]).max() > 0.1  # which the motors cannot


# -- stops, and another engine ----------------------------------------------------------


def test_mujoco_moves_as_the_plant_does(panda):
    truth = panda.with_object(length=0.2, mass=1.0)
    options = {"servo": VelocityServo(), "torque_limits": 25.0, **ROUGH}
    ours, theirs = (
        driven(kind(truth, **options), lambda t: np.full(7, np.sin(10.0 * t)), START, 0.5)[0]
        for kind in PLANTS
    )
    assert (np.abs(ours.tau) == 25.0).any()
    for name in ("q", "v", "x"):
        assert np.abs(getattr(ours, name) - getattr(theirs, name)).max() < 1e-10
    assert np.abs(ours.tau - theirs.tau).max() < 1e-8


@pytest.mark.parametrize(
    "integrator", ["semi_implicit_euler", pytest.param("rk4", marks=pytest.mark.study)]
)
@pytest.mark.parametrize("kind", PLANTS)
def test_joints_stop_and_come_back(panda, kind, integrator):
    plant = kind(panda, servo=VelocityServo(), **ROUGH)
    away = np.zeros(7)
    away[5] = 1.0  # towards 3.75 rad
    q0 = START + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.8, 0.0])
    options = {"duration": 1.5, "computation": Computation(integrator)}
    run, _ = driven(plant, lambda t: away if t < 1.0 else -away, q0, **options)
    limit = panda.position_limits[1][5]
    assert limit < run.q[:, 5].max() < limit + 0.02
    assert np.abs(run.tau).max() <= plant.motor_limits.max()
    assert abs(run.v[900, 5]) < 1e-3  # it presses, and rests
    assert np.abs(run.v[900]).max() < 0.2  # which disturbs the others
    assert_allclose(run.v[-1], -away, atol=1e-4)  # nothing has wound up


@pytest.mark.study
def test_the_floor_holds_an_arm_that_is_told_to_go_on(panda):
    plant = aj.MujocoPlant(panda, servo=VelocityServo(), floor=0.0)
    q0 = plant.ready_configuration()
    x = plant.sensor.value(q0)
    law = ResolvedRate(aj.PositionTask(panda), 2.0)
    run = aj.simulate(plant, law, [x[0], x[1], -0.05], q0, 3.0, dt=8e-3)
    assert run.x[:, 2].min() > -5e-3
    assert run.x[-1, 2] < 0.02
    assert (np.abs(run.tau) <= plant.motor_limits).all()


# -- controllers ------------------------------------------------------------------------


@pytest.mark.study
@pytest.mark.parametrize(
    "name", ["ur5", *(pytest.param(k, marks=pytest.mark.long) for k in ("so101", "xarm7"))]
)
def test_a_resolved_rate_controller_reaches_its_target(name):
    arm = aj.load_robot(name)
    truth, belief = arm.with_object(length=0.05, mass=0.1), arm.with_object(length=0.0)
    sensing = aj.Sensing(q_quantum=2.0 * np.pi / 4096)
    runs = []
    for kind in PLANTS:
        friction = Friction(0.05, 0.02)
        plant = kind(truth, None, friction, servo=VelocityServo(), sensing=sensing)
        q0 = plant.ready_configuration()
        target = plant.sensor.value(q0) + [0.03, -0.03, -0.02]
        law = ResolvedRate(aj.PositionTask(belief), 3.0)
        runs.append(aj.simulate(plant, law, target, q0, 4.0, dt=8e-3))
        assert runs[-1].error_norm[-1] < 1e-4
    assert np.abs(runs[0].q - runs[1].q).max() < 1e-9


@pytest.mark.study
def test_what_holds_measurements_commands_what_is_inside(panda):
    law = ResolvedRate(aj.PositionTask(panda), 3.0)
    held = HeldMeasurement(law, unseen=0.02)
    assert (held.command, law.command) == ("velocity", "velocity")
    plant = aj.Plant(panda, servo=VelocityServo(), sensing=aj.Sensing(x_rate=30.0))
    target = plant.sensor.value(START) + 0.05
    assert aj.simulate(plant, held, target, START, 3.0, dt=8e-3).error_norm[-1] < 1e-3


def test_another_command_than_the_plants_is_refused(panda):
    law, own = aj.SetpointController(aj.PositionTask(panda)), Told(aj.PositionTask(panda), None)
    bare, servoed = aj.Plant(panda), aj.Plant(panda, servo=VelocityServo())
    assert (bare.command, servoed.command, law.command) == ("torque", "velocity", "torque")
    target = bare.sensor.value(START)
    told = "command of the controller must be '{}', which the plant takes, got '{}' of"
    with pytest.raises(aj.InvalidInputError, match=told.format("velocity", "torque")):
        aj.simulate(servoed, law, target, START)
    with pytest.raises(aj.InvalidInputError, match=told.format("torque", "velocity")):
        aj.simulate(bare, own, target, START)

    def exchanging(loop: Loop):
        loop.exchange(own)

    with pytest.raises(aj.InvalidInputError, match=told.format("torque", "velocity")):
        aj.simulate(bare, law, target, START, 0.01, observer=exchanging)


def test_what_is_for_torques_refuses_a_servo(panda):
    plant = aj.Plant(panda, servo=VelocityServo())
    target = plant.sensor.value(START)
    with pytest.raises(aj.InvalidInputError, match="dt must be given for a plant with sensing"):
        aj.simulate(plant, ResolvedRate(plant.sensor, 3.0), target, START, dt=None)
    for refusing in (plant.require_ideal, partial(plant.require_ideal, late=True)):
        with pytest.raises(aj.InvalidInputError, match=r"this is for a plant without .*servo"):
            refusing("this")
    with pytest.raises(aj.InvalidInputError, match="the controller's velocity must have shape"):
        aj.simulate(plant, Told(plant.sensor, lambda t: np.zeros(6)), target, START)


def test_a_command_that_is_not_finite_ends_the_run(panda):
    plant = aj.Plant(panda, servo=VelocityServo())
    with pytest.raises(aj.errors.ControllerError, match=r"t = 0.051 s: .*velocity must be finite"):
        driven(plant, lambda t: np.full(7, np.nan if t > 0.05 else 0.0), START)


def test_commands_and_the_torques_of_the_servo_are_recorded(panda):
    plant = aj.Plant(panda, servo=VelocityServo(lag=0.03, delay=0.0, period=8e-3))
    law = aj.TrackingController(aj.PositionTask(panda), dt=8e-3, command="velocity")
    run = aj.simulate(plant, law, plant.sensor.value(START) + 0.05, START, 0.08, dt=8e-3)
    state = law.initial_state(plant.measure(0.0, START, np.zeros(7)))
    for at in range(len(run.t)):
        seen = plant.measure(run.t[at], run.q[at], run.v[at])
        state, answer = law.step(state, seen, run.target, 8e-3)
        assert_array_equal(run.command[at], answer.torque)
        assert_array_equal(run.tau[at], plant.applied(run.q[at], run.v[at], answer.torque))
    assert (run.units["command"], run.units["tau"]) == ("rad/s", "N m")
    assert "rad/s" in str(run)
    assert "N m" in str(run)


# -- and without ------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", sorted(INTEGRATORS))
def test_without_a_servo_a_run_is_the_plain_loop_bit_by_bit(panda, integrator):
    plant = aj.Plant(panda, friction=0.5, actuator_delay=3e-3, torque_limits=80.0)
    law = aj.SetpointController(aj.PositionTask(panda))
    target, dt = plant.sensor.value(START) + [0.1, -0.15, 0.16], 1e-3
    run = aj.simulate(
        plant, law, target, START, 0.3, dt=dt, computation=aj.simulation.Computation(integrator)
    )
    q, v, state = START, np.zeros(7), np.zeros(0)
    waiting = deque([Dynamics(panda).g(q)] * 3)
    for k in range(301):
        assert_array_equal(run.q[k], q)
        assert_array_equal(run.v[k], v)
        state, answer = law.step(state, plant.measure(k * dt, q, v), target, dt)
        assert_array_equal(run.tau[k], answer.torque)
        waiting.append(answer.torque)
        q, v, _ = plant.advance(q, v, waiting.popleft(), dt, INTEGRATORS[integrator])


def test_a_plant_with_a_servo_copies_and_prints_itself(panda):
    plant = aj.Plant(panda, servo=VelocityServo(lag=0.05))
    assert repr(plant).endswith("servo=VelocityServo(lag=0.05))")
    for other in (copy.deepcopy(plant), pickle.loads(pickle.dumps(plant))):
        assert other.servo == plant.servo
    assert repr(VelocityServo()) == "VelocityServo()"
