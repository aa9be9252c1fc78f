import numpy as np
import pinocchio as pin
from numpy.testing import assert_allclose

import approxjac as aj


def test_forward_and_inverse_dynamics_agree_on_every_arm(arm, rng):
    dynamics = aj.Dynamics(arm)
    for _ in range(10):
        q, v = arm.random_configuration(rng), rng.uniform(-1, 1, arm.nv)
        tau = rng.uniform(-1, 1, arm.nv)
        a = dynamics.forward(q, v, tau)
        terms = dynamics.M(q) @ a + dynamics.coriolis(q, v) + dynamics.g(q)
        assert_allclose(terms, tau, atol=1e-9 * max(1.0, np.abs(a).max()))
        assert_allclose(dynamics.inverse(q, v, a), tau, atol=1e-9 * max(1.0, np.abs(a).max()))


def test_inertia_rate_by_finite_differences_and_skew_symmetry(arm, rng):
    dynamics = aj.Dynamics(arm)
    q, v = arm.random_configuration(rng), rng.uniform(-1, 1, arm.nv)
    h = 1e-5
    ahead, behind = (pin.integrate(arm.model, q, step * v) for step in (h, -h))
    expected = (dynamics.M(ahead) - dynamics.M(behind)) / (2 * h)
    assert_allclose(dynamics.M_dot(q, v), expected, atol=1e-7 * np.abs(dynamics.M(q)).max())
    skew = dynamics.M_dot(q, v) - 2 * dynamics.C(q, v)
    assert_allclose(skew, -skew.T, atol=1e-12)


def test_gravity_is_the_slope_of_potential_energy(arm, rng):
    dynamics = aj.Dynamics(arm)
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
    g = [aj.Dynamics(panda.with_gravity(9.81 * axis)).g(q) for axis in np.eye(3)]
    both = aj.Dynamics(panda.with_gravity((1.0, -2.0, 3.0))).g(q)
    assert_allclose(both, (g[0] - 2 * g[1] + 3 * g[2]) / 9.81, atol=1e-12)
    assert_allclose(aj.Dynamics(panda).g(q), -g[2], atol=1e-12)


def test_what_is_returned_is_not_scratch_memory(panda, rng):
    dynamics = aj.Dynamics(panda)
    q, v = panda.random_configuration(rng), rng.uniform(-1, 1, 7)
    calls = (dynamics.M, dynamics.g)
    first = [call(q) for call in calls] + [dynamics.C(q, v)]
    copies = [array.copy() for array in first]
    other = panda.random_configuration(rng)
    _ = [call(other) for call in calls] + [dynamics.C(other, -v)]
    for array, copy in zip(first, copies, strict=True):
        assert np.array_equal(array, copy)
