import numpy as np
import pytest
from numpy.testing import assert_allclose
from two_link_closed_form import TwoLink

import approxjac as aj
from approxjac.paper import experiments as paper
from approxjac.robots import Dynamics, GravityRegressor


@pytest.mark.parametrize("lengths", [paper.LENGTHS, (0.75, 1.25, 0.0), (1.3, 0.6, 0.2)])
def test_pinocchio_agrees_with_the_closed_form_to_1e_12(lengths, rng):
    robot = paper.build_arm(lengths)
    exact = TwoLink(*lengths)
    dynamics = Dynamics(robot)
    task = aj.PositionTask(robot, axes="xz")
    for _ in range(20):
        q, v = rng.uniform(-np.pi, np.pi, 2), rng.uniform(-5.0, 5.0, 2)
        assert_allclose(dynamics.M(q), exact.M(q), rtol=0, atol=1e-12)
        assert_allclose(dynamics.coriolis(q, v), exact.coriolis(q, v), rtol=1e-12, atol=1e-12)
        assert_allclose(dynamics.C(q, v) @ v, exact.coriolis(q, v), rtol=1e-12, atol=1e-12)
        assert_allclose(dynamics.g(q), exact.g(q), rtol=0, atol=1e-12)
        assert_allclose(task.jacobian(q), exact.J(q), rtol=0, atol=1e-12)
        assert_allclose(task.value(q), exact.h(q), rtol=0, atol=1e-12)


def test_the_two_link_arm_has_exactly_the_papers_parameters(two_link, rng):
    regressor = GravityRegressor(two_link, moments="x")
    exact = TwoLink()
    assert regressor.names == ("joint1.mx", "joint2.mx")
    assert_allclose(regressor.theta, [3.5, 1.625], rtol=1e-14)
    assert_allclose(regressor.theta, exact.theta(), rtol=1e-14)
    for _ in range(20):
        q = rng.uniform(-np.pi, np.pi, 2)
        assert_allclose(regressor.Z(q), exact.Z(q), rtol=0, atol=1e-13)
