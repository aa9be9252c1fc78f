"""What the limiter predicts of the next period, and what the last one shows of that."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.controllers import NoGravity
from approxjac.controllers.limits.torque_limited import AccelerationObserver

DT, RATE = 1e-3, 100.0
FASTEST = np.full(7, 2.0)
Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


def law_of(robot, gravity=None):
    return aj.SetpointController(aj.PositionTask(robot), gravity=gravity)


def measured(q, v, t=0.0):
    return aj.Measurement(t, q, v, np.zeros(3))


def test_what_is_learnt_does_not_change_what_is_predicted(panda, rng):
    law = law_of(panda, aj.AdaptiveGravity(panda))
    prediction = AccelerationObserver(law, DT, RATE, FASTEST)
    torque, measurement = rng.normal(size=7), measured(Q, rng.normal(size=7))
    f = [prediction.forward(measurement, 10.0 * rng.normal(size=7), torque) for _ in range(2)]
    assert_array_equal(*f)
    assert_allclose(f[0], aj.Plant(panda).acceleration(Q, measurement.v, torque))


def test_of_a_robot_that_compensates_itself_no_weight_is_predicted(panda):
    prediction = AccelerationObserver(law_of(panda, NoGravity(panda)), DT, RATE, FASTEST)
    rest = measured(Q, np.zeros(7))
    assert_allclose(prediction.forward(rest, np.zeros(7), np.zeros(7)), 0.0, atol=1e-9)


@pytest.mark.parametrize("dt", [DT, 4e-3])
def test_periods_show_what_the_believed_arm_lacks(panda, dt):
    """A constant lack of q̈ is found as a filter of the rate does, 1 − (1 − rate dt)ᵏ."""
    prediction = AccelerationObserver(law_of(panda, aj.AdaptiveGravity(panda)), dt, RATE, FASTEST)
    lack, v, memory = np.linspace(-3.0, 3.0, 7), np.zeros(7), prediction.nothing
    f = prediction.forward(measured(Q, v), np.zeros(7), np.zeros(7))
    for k in range(60):
        measurement = measured(Q, v, k * dt)
        memory, rho, rest = prediction.observed(memory, measurement)
        assert_allclose(rest, lack * (1.0 - (1.0 - RATE * dt) ** k), atol=1e-9)
        assert_allclose(rho, 1.0)
        memory = prediction.expecting(measurement, f, memory)
        v = v + dt * (f + lack)


def share_seen(prediction, f_of, share, periods, noise=0.0):
    """Return ρ after periods in which q̈ follows `share` of f_of(k), all joints alike."""
    rng, v, memory = np.random.default_rng(0), np.zeros(7), prediction.nothing
    for k in range(periods):
        seen = v + noise * rng.normal(size=7)
        memory, rho, _ = prediction.observed(memory, measured(Q, seen, k * DT))
        memory = prediction.expecting(measured(Q, seen, k * DT), np.full(7, f_of(k)), memory)
        v = v + DT * (share * f_of(k) - 3.0)
    return rho


@pytest.mark.parametrize("share", [0.01, 0.2, 0.7])
@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_a_few_torques_show_inertia_that_the_believed_arm_lacks(panda, share, noise):
    prediction = AccelerationObserver(law_of(panda), DT, RATE, FASTEST)
    rho = share_seen(prediction, lambda k: 30.0 * 1.4**k if k > 1 else 0.0, share, 16, noise)
    assert_allclose(rho, share, atol=0.02)


@pytest.mark.parametrize("dt", [5e-4, DT, 4e-3])
@pytest.mark.parametrize("filtered", [2e-3, 5e-3, 20e-3])
def test_a_velocity_that_is_filtered_makes_no_arm_heavier(panda, filtered, dt):
    """Torques that turn again and again, on an arm that is as it is believed to be."""
    late = aj.Latency(dt, velocity_filter=filtered)
    law = aj.SetpointController(aj.PositionTask(panda), latency=late)
    prediction = AccelerationObserver(law, dt, RATE, FASTEST)
    v, seen, memory = np.zeros(7), np.zeros(7), prediction.nothing
    for k in range(200):
        memory, rho, rest = prediction.observed(memory, measured(Q, seen, k * dt))
        f = np.full(7, 0.0 if k == 0 else 100.0 if k // 20 % 2 else -100.0)
        memory = prediction.expecting(measured(Q, seen, k * dt), f, memory)
        v = v + dt * f
        seen = seen + dt / (filtered + dt) * (v - seen)
    assert_allclose(rho, 1.0, atol=0.02)
    assert_allclose(rest, 0.0, atol=1.0)  # nothing else moves the arm


@pytest.mark.parametrize("dt", [5e-4, DT, 4e-3])
def test_what_torques_have_shown_is_forgotten_in_time_not_in_periods(panda, dt):
    """Once f no longer changes, its squares S fall at 0.3 of the rate: ρ = (S/5 + c)/(S + c)."""
    rate = 50.0
    prediction = AccelerationObserver(law_of(panda), dt, rate, FASTEST)
    v, memory, known = np.zeros(7), prediction.nothing, []
    for k in range(round(1.0 / dt) + 1):
        memory, rho, _ = prediction.observed(memory, measured(Q, v, k * dt))
        f = 200.0 * np.sin(60.0 * k * dt) * (k * dt < 0.4)
        memory = prediction.expecting(measured(Q, v, k * dt), np.full(7, f), memory)
        v = v + dt * 0.2 * f
        known.append(rho[0])
    assert known[round(0.4 / dt)] == pytest.approx(0.2, abs=0.02)
    some = np.array([known[round(t / dt)] for t in (0.8, 1.0)])
    squares = (1.0 - some) / (some - 0.2)  # over c
    assert squares[0] / squares[1] == pytest.approx(np.exp(0.3 * rate * 0.2), rel=0.12)


@pytest.mark.parametrize("f_of", [lambda k: 100.0, lambda k: 0.05 * k, lambda k: 5.0 * (k > 0)])
def test_torques_that_hardly_change_show_no_inertia(panda, f_of):
    """Nor does a q̇ that rests against a slowly growing f."""
    rho = share_seen(AccelerationObserver(law_of(panda), DT, RATE, FASTEST), f_of, 0.0, 300)
    assert (rho > 0.8).all()


def test_inertia_is_not_less_than_believed(panda):
    """For a start under a load that is not known looks alike."""
    prediction = AccelerationObserver(law_of(panda), DT, RATE, FASTEST)
    assert_array_equal(share_seen(prediction, lambda k: 30.0 * 1.3**k, 5.0, 12), 1.0)


@pytest.mark.parametrize("t", [-1.0, 0.0, 3.0 * DT, 1e9, np.inf, np.nan])
def test_a_clock_that_jumps_shows_nothing(panda, t):
    prediction = AccelerationObserver(law_of(panda, aj.AdaptiveGravity(panda)), DT, RATE, FASTEST)
    first = measured(Q, np.zeros(7), 0.0)
    memory = prediction.expecting(first, np.zeros(7), prediction.nothing)
    late = measured(Q, np.full(7, 5.0), t)
    assert_array_equal(prediction.observed(memory, late)[0], memory)
    due, _, rest = prediction.observed(memory, late._replace(t=1.3 * DT))
    assert (rest > 1.0).all()
    assert (due != memory).any()
    assert np.isfinite(prediction.expecting(late, np.zeros(7), due)).all()


def test_what_overflows_is_forgotten(panda):
    prediction = AccelerationObserver(law_of(panda), DT, RATE, FASTEST)
    first = measured(Q, np.zeros(7))
    memory = prediction.expecting(first, np.full(7, np.inf), prediction.nothing)
    assert_array_equal(memory, prediction.nothing)
    assert np.isfinite(memory).all()
