import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.robots import Dynamics, GravityRegressor


def test_forward_and_inverse_dynamics_agree_on_every_arm(arm, rng):
    dynamics = Dynamics(arm)
    for _ in range(10):
        q, v = arm.random_configuration(rng), rng.uniform(-1, 1, arm.nv)
        tau = rng.uniform(-1, 1, arm.nv)
        a = dynamics.forward(q, v, tau)
        terms = dynamics.M(q) @ a + dynamics.coriolis(q, v) + dynamics.g(q)
        assert_allclose(terms, tau, atol=1e-9 * max(1.0, np.abs(a).max()))
        assert_allclose(dynamics.inverse(q, v, a), tau, atol=1e-9 * max(1.0, np.abs(a).max()))


def test_inertia_rate_by_finite_differences_and_skew_symmetry(arm, rng):
    dynamics = Dynamics(arm)
    q, v = arm.random_configuration(rng), rng.uniform(-1, 1, arm.nv)
    h = 1e-5
    ahead, behind = (pin.integrate(arm.model, q, step * v) for step in (h, -h))
    expected = (dynamics.M(ahead) - dynamics.M(behind)) / (2 * h)
    assert_allclose(dynamics.M_dot(q, v), expected, atol=1e-7 * np.abs(dynamics.M(q)).max())
    skew = dynamics.M_dot(q, v) - 2 * dynamics.C(q, v)
    assert_allclose(skew, -skew.T, atol=1e-12)


def test_gravity_is_the_slope_of_potential_energy(arm, rng):
    dynamics = Dynamics(arm)
    q = arm.random_configuration(rng)
    h = 1e-6
    rest = np.zeros(arm.nv)
    slope = [
        (
            dynamics.energy(pin.integrate(arm.model, q, h * unit), rest)
            - dynamics.energy(pin.integrate(arm.model, q, -h * unit), rest)
        )
        / (2 * h)
        for unit in np.eye(arm.nv)
    ]
    assert_allclose(dynamics.g(q), slope, atol=1e-6)


def test_gravity_turns_with_its_direction(panda, rng):
    q = panda.random_configuration(rng)
    g = [Dynamics(panda.with_gravity(9.81 * axis)).g(q) for axis in np.eye(3)]
    both = Dynamics(panda.with_gravity((1.0, -2.0, 3.0))).g(q)
    assert_allclose(both, (g[0] - 2 * g[1] + 3 * g[2]) / 9.81, atol=1e-12)
    assert_allclose(Dynamics(panda).g(q), -g[2], atol=1e-12)


def test_what_is_returned_is_not_scratch_memory(panda, rng):
    dynamics = Dynamics(panda)
    q, v = panda.random_configuration(rng), rng.uniform(-1, 1, 7)
    calls = (dynamics.M, dynamics.g)
    first = [call(q) for call in calls] + [dynamics.C(q, v)]
    copies = [array.copy() for array in first]
    other = panda.random_configuration(rng)
    _ = [call(other) for call in calls] + [dynamics.C(other, -v)]
    for array, copy in zip(first, copies, strict=True):
        assert np.array_equal(array, copy)


def test_bad_states_are_refused_everywhere(panda):
    dynamics, task = Dynamics(panda), aj.PositionTask(panda)
    regressor, good = GravityRegressor(panda), np.zeros(7)
    bad = {
        r"q must have shape \(7,\) \[rad or m\], got shape \(6,\)": np.zeros(6),
        r"q must be finite \[rad or m\], got \[nan": np.full(7, np.nan),
        r"q must be numbers of shape \(7,\) \[rad or m\], got 'zero'": "zero",
    }
    for text, q in bad.items():
        for call in (dynamics.M, dynamics.g, task.value, task.jacobian, regressor.Z):
            with pytest.raises(aj.InvalidInputError, match=text):
                call(q)
        for call in (dynamics.C, dynamics.M_dot, dynamics.coriolis, dynamics.energy):
            with pytest.raises(aj.InvalidInputError, match=text):
                call(q, good)
        for call in (dynamics.forward, dynamics.inverse):
            with pytest.raises(aj.InvalidInputError, match=text):
                call(q, good, good)
        with pytest.raises(aj.InvalidInputError, match=text):
            task.jacobian_dot(q, good)
    for call in (dynamics.C, task.jacobian_dot, dynamics.energy):
        with pytest.raises(aj.InvalidInputError, match=r"v must be finite.*, got \[inf"):
            call(good, np.full(7, np.inf))
    with pytest.raises(
        aj.InvalidInputError, match=r"tau must have shape \(7,\).*, got shape \(3,\)"
    ):
        dynamics.forward(good, good, np.zeros(3))
    with pytest.raises(aj.InvalidInputError, match=r"a must be finite.*, got \[nan"):
        dynamics.inverse(good, good, np.full(7, np.nan))


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_each_number_that_is_not_finite_is_refused_by_forward_dynamics(arm, rng, wrong):
    dynamics = Dynamics(arm)
    v, tau = rng.uniform(-1, 1, (2, arm.nv))
    good = {"q": arm.random_configuration(rng), "v": v, "tau": tau}
    for name, value in good.items():
        for i in range(len(value)):
            bad = value.copy()
            bad[i] = wrong
            with pytest.raises(aj.InvalidInputError, match=rf"^{name} must be finite"):
                dynamics.forward(**{**good, name: bad})


def test_forward_dynamics_take_other_numbers_than_doubles(panda):
    q, dynamics = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.5]), Dynamics(panda)
    v, tau = np.arange(7), np.arange(7.0)[::-1]
    expected = dynamics.forward(q, v.astype(float), tau.copy())
    for given in ((q.astype(np.float32), v, tau), (q.tolist(), v, tau), (q, v[:, None].T[0], tau)):
        assert np.array_equal(dynamics.forward(*given), expected)
    with pytest.raises(
        aj.InvalidInputError, match=r"v must have shape \(7,\).*, got shape \(7, 1\)"
    ):
        dynamics.forward(q, v[:, None].astype(float), tau)


def test_lists_of_numbers_are_taken(panda):
    q = [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]
    assert_allclose(aj.PositionTask(panda).value(q), aj.PositionTask(panda).value(np.array(q)))
    assert_allclose(Dynamics(panda).g(q), Dynamics(panda).g(np.array(q)))


def test_the_gradient_of_gravity_by_finite_differences(arm, rng):
    dynamics, q, h = Dynamics(arm), arm.random_configuration(rng), 1e-5
    steps = h * np.eye(arm.nv)
    slopes = [
        dynamics.g(pin.integrate(arm.model, q, step))
        - dynamics.g(pin.integrate(arm.model, q, -step))
        for step in steps
    ]
    assert_allclose(
        dynamics.g_gradient(q),
        np.array(slopes).T / (2 * h),
        atol=1e-7 * np.abs(dynamics.g(q)).max(),
    )
