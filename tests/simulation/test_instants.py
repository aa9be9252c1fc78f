"""What belongs to which instant of a run: targets, delays, learnt numbers, V and figures."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from own_controller import OwnController

import approxjac as aj
from approxjac.simulation import InitialState, VelocityServo

START, DT = np.array([0.4, 1.2]), 2e-3


class Counting(OwnController):
    """A controller whose state counts its steps, and which tells one of its numbers."""

    def __init__(self, task, name="steps", torque=(0.0, 0.0)):
        super().__init__(task)
        self.parameters, self.torque, self.told = {name: "N"}, np.array(torque), []

    def begin(self, measurement):
        return np.zeros(1)

    def learnt(self, state):
        return state

    def advance(self, state, measurement, target, dt):
        self.told.append((measurement.t, target))
        e = measurement.x - (target.x if isinstance(target, aj.Target) else target)
        return state + 1.0, aj.Evaluation(self.torque, None, aj.Status.OK, e)

    def lyapunov(self, at):
        return float(at.e[0])


@pytest.fixture(scope="module")
def plant():
    arm = aj.load_robot("two_link")
    return aj.Plant(arm, aj.PositionTask(arm, axes="xz"))


def ran(plant, law, target=None, steps=20, **options):
    target = plant.sensor.value(START) if target is None else target
    return aj.simulate(plant, law, target, START, steps * DT, dt=DT, **options)


def test_a_target_that_moves_is_where_it_is_at_each_sample(plant):
    class Ramp:
        def at(self, t):
            return aj.Target(np.array([1.0 + t, -t]), np.array([1.0, -1.0]))

    law, path = Counting(plant.sensor), Ramp()
    run = ran(plant, law, path)
    assert_array_equal(run.x_d, [path.at(k * DT).x for k in range(21)])
    assert_array_equal(run.error, run.x - run.x_d)
    for t, target in law.told:
        assert_array_equal(target.x, path.at(t).x)


@pytest.mark.parametrize(("delay", "samples"), [(2.4, 2), (2.6, 3), (6.999999, 7), (0.4, 0)])
def test_a_torque_is_late_by_the_nearest_number_of_samples(plant, delay, samples):
    late = aj.Plant(plant.robot, plant.sensor, actuator_delay=delay * DT)
    torque = plant.holding_torque(START) + [0.5, 0.3]
    run, at_once = (ran(each, Counting(plant.sensor, torque=torque)) for each in (late, plant))
    assert np.argmax(np.abs(run.v).max(axis=1) > 1e-9) == samples + 1
    assert_allclose(run.v[samples:], at_once.v[: 21 - samples], atol=1e-9)


def test_v_is_of_the_true_error_though_another_one_is_measured(plant):
    noisy = aj.Plant(plant.robot, plant.sensor, sensing=aj.Sensing(x_noise=0.01))
    run = ran(noisy, Counting(plant.sensor))
    assert_array_equal(run.V, run.error[:, 0])
    assert np.abs(run.x - run.x_measured).max() > 1e-3


@pytest.mark.parametrize("name", ["steps", "other"])
def test_what_an_earlier_law_learnt_stands_beside_the_later_ones_if_it_is_the_same(plant, name):
    later = Counting(plant.sensor, name)

    def exchange(loop):
        if loop.step == 7:
            loop.exchange(later)

    run = ran(plant, Counting(plant.sensor), observer=exchange)
    assert dict(run.parameters) == {name: "N"}
    assert_array_equal(run.state[:, 0], np.arange(21.0))
    own = np.arange(21) > 7 if name == "other" else np.full(21, True)
    assert_array_equal(run.learnt[:, 0], np.where(own, np.arange(21.0), np.nan))


@pytest.mark.parametrize("last", [0, 7, 19])
def test_the_error_is_said_to_be_small_from_the_first_instant_on_at_which_it_stays_so(plant, last):
    run = ran(plant, Counting(plant.sensor))
    error = np.zeros((21, 2))
    error[last], error[0] = [0.04, 0.04], [3.0, 4.0]
    said = str(dataclasses.replace(run, error=error))
    assert f"below 1 % of the start from {run.t[last + 1]:.3g} s on" in said


@pytest.mark.parametrize("record_every", [DT, 2 * DT])
def test_the_time_at_stops_is_that_of_the_run_whatever_is_recorded_of_it(record_every):
    arm = aj.load_robot("panda")
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    q0[5] = arm.position_limits[1][5] - 1e-4
    plant, law = aj.Plant(arm), Counting(aj.PositionTask(arm))
    law.torque = plant.holding_torque(q0)
    start, v0 = plant.sensor.value(q0), np.eye(7)[5]
    run = aj.simulate(
        plant, law, start, InitialState(q0, v0), 20 * DT, dt=DT, record_every=record_every
    )
    beyond = run.q[:, 5] > arm.position_limits[1][5]
    assert 3 < beyond.sum() <= len(run.t)
    assert run.at_stops["panda_joint6"] == pytest.approx(0.04 * beyond.mean())


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_servo_asks_motors_for_no_more_than_they_have_to_either_side(side):
    arm = aj.load_robot("panda")
    plant = aj.Plant(arm, servo=VelocityServo(), torque_limits=np.linspace(60.0, 10.0, 7))
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    tau = plant.applied(q, np.zeros(7), side * np.linspace(20.0, 200.0, 7))
    assert (np.abs(tau) <= plant.torque_limits).all()
    assert (tau == side * plant.torque_limits).sum() > 2
