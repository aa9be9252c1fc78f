"""What the limiter predicts of the next period, and what the last one shows of that."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.controllers import NoGravity
from approxjac.controllers.limits.torque_limited import AccelerationObserver

DT, RATE = 1e-3, 100.0
Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


def law_of(robot, gravity=None):
    return aj.SetpointController(aj.PositionTask(robot), gravity=gravity)


def measured(q, v, t=0.0):
    return aj.Measurement(t, q, v, np.zeros(3))


def test_what_is_learnt_does_not_change_what_is_predicted(panda, rng):
    law = law_of(panda, aj.AdaptiveGravity(panda))
    prediction = AccelerationObserver(law, DT, RATE)
    torque, measurement = rng.normal(size=7), measured(Q, rng.normal(size=7))
    f = [prediction.forward(measurement, 10.0 * rng.normal(size=7), torque) for _ in range(2)]
    assert_array_equal(*f)
    assert_allclose(f[0], aj.Plant(panda).acceleration(Q, measurement.v, torque))


def test_of_a_robot_that_compensates_itself_no_weight_is_predicted(panda):
    prediction = AccelerationObserver(law_of(panda, NoGravity(panda)), DT, RATE)
    rest = measured(Q, np.zeros(7))
    assert_allclose(prediction.forward(rest, np.zeros(7), np.zeros(7)), 0.0, atol=1e-9)


@pytest.mark.parametrize("dt", [DT, 4e-3])
def test_periods_show_what_the_believed_arm_lacks(panda, dt):
    """A constant lack of q̈ is found as a filter of the rate does, 1 − (1 − rate dt)ᵏ."""
    prediction = AccelerationObserver(law_of(panda, aj.AdaptiveGravity(panda)), dt, RATE)
    lack, v, memory = np.linspace(-3.0, 3.0, 7), np.zeros(7), prediction.nothing
    for k in range(60):
        measurement = measured(Q, v, k * dt)
        residual = prediction.residual(memory, measurement)
        assert_allclose(residual, lack * (1.0 - (1.0 - RATE * dt) ** k), atol=1e-9)
        f = prediction.forward(measurement, np.zeros(7), np.zeros(7))
        memory = prediction.expecting(measurement, f, residual)
        v = v + dt * (f + lack)


@pytest.mark.parametrize("t", [-1.0, 0.0, 3.0 * DT, 1e9, np.inf, np.nan])
def test_a_clock_that_jumps_shows_nothing(panda, t):
    prediction = AccelerationObserver(law_of(panda, aj.AdaptiveGravity(panda)), DT, RATE)
    before = np.linspace(1.0, 2.0, 7)
    memory = prediction.expecting(measured(Q, np.zeros(7), 0.0), np.zeros(7), before)
    late = measured(Q, np.full(7, 5.0), t)
    assert_array_equal(prediction.residual(memory, late), before)
    due = prediction.residual(memory, late._replace(t=1.3 * DT))
    assert (due > before + 1.0).all()
    assert np.isfinite(prediction.expecting(late, np.zeros(7), before)).all()


def test_what_overflows_is_forgotten(panda):
    prediction = AccelerationObserver(law_of(panda), DT, RATE)
    memory = prediction.expecting(measured(Q, np.zeros(7)), np.full(7, np.inf), np.zeros(7))
    assert_array_equal(memory, prediction.nothing)
    assert np.isfinite(memory).all()
