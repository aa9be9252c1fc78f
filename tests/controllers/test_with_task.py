"""`with_task`: every controller goes on with another believed robot, and keeps the rest."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.controllers import DifferentiatedVelocity, Posture
from approxjac.law import Tanh
from approxjac.robots import GravityRegressor

Q = np.array([0.1, -0.4, 0.2, -1.9, 0.1, 1.7, 0.5])
V = np.linspace(-0.2, 0.3, 7)
LIMITS = aj.Limits(effort=40.0, rate=2000.0)


@pytest.fixture
def beliefs(panda):
    return panda.with_object(0.0, axis="x"), panda.with_object(0.25, axis="x")


def learning(task):
    regressor = GravityRegressor(task.robot)
    return aj.SetpointController(task, gravity=aj.AdaptiveGravity(regressor))


MADE = {
    "setpoint": lambda task: aj.SetpointController(
        task, aj.Gains(kp=300.0, kv=70.0, damping=2.0), saturation=Tanh(0.1),
        posture=Posture(Q, 5.0),
    ),
    "law 5": lambda task: aj.SetpointController(task, velocity=DifferentiatedVelocity()),
    "learning": learning,
    "limited": lambda task: aj.TorqueLimited(learning(task), LIMITS),
    "clipped": lambda task: aj.TorqueLimited(learning(task), LIMITS, proof=False),
    "held": lambda task: aj.HeldMeasurement(aj.TorqueLimited(learning(task), LIMITS), 0.5),
}  # fmt: skip


@pytest.mark.parametrize("name", MADE)
def test_it_takes_the_jacobian_of_the_other_and_goes_on_from_its_state(beliefs, name):
    first, second = (aj.PositionTask(robot) for robot in beliefs)
    controller = MADE[name](first)
    x = first.value(Q) + 0.03
    x_d = x + [0.04, -0.03, 0.02]
    measurement = aj.Measurement(0.0, Q, V, x)
    state = controller.initial_state(measurement)
    other = controller.with_task(second)
    assert type(other) is type(controller)
    assert other.task is second
    assert controller.task is first
    _, answer = other.step(state, measurement, x_d, 1e-3)
    assert_array_equal(answer.J_hat, second.jacobian(Q))
    after, before = controller.step(state, measurement, x_d, 1e-3)
    assert np.abs(answer.torque - before.torque).max() > 1e-3
    # back again it is the first one, to the last bit but for gains that are shared out anew
    state, again = other.with_task(first).step(state, measurement, x_d, 1e-3)
    assert_allclose(again.torque, before.torque, rtol=1e-12, atol=1e-12)
    assert_allclose(state, after, rtol=1e-12, atol=1e-12)


def test_gravity_and_what_learns_it_stay(beliefs):
    first, second = (aj.PositionTask(robot) for robot in beliefs)
    controller = learning(first)
    other = controller.with_task(second)
    assert other.adaptation.regressor is controller.adaptation.regressor
    assert_array_equal(other.adaptation.L, controller.adaptation.L)
    assert other.adaptation.alpha == controller.adaptation.alpha
    theta = controller.adaptation.theta0
    assert_array_equal(other.gravity_torque(theta, Q), controller.gravity_torque(theta, Q))


def test_what_a_controller_was_built_with_is_not_exchanged(panda):
    law = aj.SetpointController(aj.PositionTask(panda), gravity=aj.AdaptiveGravity(panda))
    limited = aj.TorqueLimited(law)
    held = aj.HeldMeasurement(limited, 0.02)
    for thing, name, value in (
        (law, "gains", aj.Gains(1.0, 1.0, 1.0)),
        (law, "gravity", aj.NoGravity(panda)),
        (law.gravity, "alpha", 3.0),
        (limited, "limits", aj.Limits.of(panda, scale=0.01)),
        (held, "unseen", 1.0),
    ):
        before, kind = repr(thing), type(thing).__name__
        text = f"{name} of a {kind} cannot be changed once it is built; build a new {kind}"
        with pytest.raises(aj.InvalidInputError, match=text):
            setattr(thing, name, value)
        assert repr(thing) == before
