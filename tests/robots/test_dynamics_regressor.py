"""Y_d(q, q̇, q̇_r, q̈_r) against M, C and g of `Dynamics`."""

import pickle

import numpy as np
import pinocchio as pin
import pytest
from arms import among
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.robots import Dynamics
from approxjac.robots.dynamics import REFERENCE_SPEED, DynamicsRegressor


@pytest.fixture(params=among("two_link", "panda", "kinova", "tiago_arm"))
def robot(request):
    return aj.load_robot(request.param)


def drawn(robot, rng):
    return robot.random_configuration(rng), *rng.normal(size=(3, robot.nv))


def test_it_is_linear_in_the_arms_own_parameters(robot, rng):
    """And C is the one with Ṁ − 2C skew: `Dynamics.C` is, and C is unique in the products used."""
    regressor, dynamics = DynamicsRegressor(robot), Dynamics(robot)
    for _ in range(5):
        q, v, v_r, a_r = drawn(robot, rng)
        expected = dynamics.M(q) @ a_r + dynamics.C(q, v) @ v_r + dynamics.g(q)
        torque = regressor.Y_d(q, v, v_r, a_r) @ regressor.a
        assert_allclose(torque, expected, atol=1e-12 * max(1.0, np.abs(expected).max()))
        assert_allclose(regressor.Z(q) @ regressor.a[: regressor.links], dynamics.g(q), atol=1e-12)


def test_units_are_those_of_joints_that_turn_and_that_slide():
    robot = aj.load_robot("tiago_arm", free="torso_lift_joint")
    assert set(robot.joint_units) == {"rad", "m"}
    regressor = DynamicsRegressor(robot)
    units = dict(zip(regressor.names, regressor.units, strict=True))
    wanted = {
        "rad": {"rotor": "kg m²", "viscous": "N m s/rad", "coulomb": "N m", "constant": "N m"},
        "m": {"rotor": "kg", "viscous": "N s/m", "coulomb": "N", "constant": "N"},
    }
    for joint, kind in zip(robot.joint_names, robot.joint_units, strict=True):
        found = {name: units[f"{joint}.{name}"] for name in wanted[kind]}
        assert found == wanted[kind]


def test_c_is_symmetric_and_dissipates_nothing(robot, rng):
    """C(q, v)w = C(q, w)v, and vᵀ(Ṁ − 2C)v = 0 along the motion."""
    regressor, q = DynamicsRegressor(robot), robot.random_configuration(rng)
    v, w, zero = *rng.normal(size=(2, robot.nv)), np.zeros(robot.nv)
    own = regressor.a

    def c(v, w):
        return (regressor.Y_d(q, v, w, zero) - regressor.Y_d(q, zero, zero, zero)) @ own

    assert_allclose(c(v, w), c(w, v), atol=1e-12)
    h = 1e-6
    M = [Dynamics(robot).M(pin.integrate(robot.model, q, s * v)) for s in (h, -h)]
    M_dot = (M[0] - M[1]) / (2.0 * h)
    C = np.column_stack([c(v, unit) for unit in np.eye(robot.nv)])
    assert_allclose(M_dot - 2.0 * C, -(M_dot - 2.0 * C).T, atol=1e-8)


def test_joints_have_rotors_friction_and_a_constant_torque(panda, rng):
    regressor = DynamicsRegressor(panda)
    q, v, v_r, a_r = drawn(panda, rng)
    rotor, viscous, coulomb, constant = rng.uniform(0.1, 1.0, (4, 7))
    a = np.concatenate([regressor.a[:70], rotor, viscous, coulomb, constant])
    expected = rotor * a_r + viscous * v_r + coulomb * np.tanh(v_r / REFERENCE_SPEED) + constant
    Y = regressor.Y_d(q, v, v_r, a_r)
    assert_allclose(Y @ (a - regressor.a), expected, atol=1e-12)
    assert regressor.names[0] == "panda_joint1.m"
    assert regressor.names[70] == "panda_joint1.rotor"
    assert regressor.p == len(regressor.names) == len(regressor.a) == 98
    assert regressor.last_link == slice(60, 70)


def test_any_truth_with_the_same_joints_is_in_its_span(panda, rng):
    """A payload and other link inertias, exactly."""
    truth = panda.with_object(0.2, 0.7, axis="x")
    regressor, true = DynamicsRegressor(panda), DynamicsRegressor(truth)
    q, v, v_r, a_r = drawn(panda, rng)
    a = true.a.copy()
    torque = Dynamics(truth).M(q) @ a_r + Dynamics(truth).C(q, v) @ v_r + Dynamics(truth).g(q)
    assert_allclose(regressor.Y_d(q, v, v_r, a_r) @ a, torque, atol=1e-11)
    assert_allclose((a - regressor.a)[:60], 0.0, atol=1e-12)  # the last link carries it


def test_a_copy_has_memory_of_its_own(panda, rng):
    regressor = DynamicsRegressor(panda)
    other = pickle.loads(pickle.dumps(regressor))
    inputs = drawn(panda, rng)
    assert_allclose(regressor.Y_d(*inputs), other.Y_d(*inputs))
    assert repr(other) == "DynamicsRegressor('panda': 98 parameters)"
