"""How far from its target an arm with known gravity may stand, against runs that stick exactly."""

import numpy as np
import pinocchio as pin
import pytest

import approxjac as aj
from approxjac.robots import Friction
from approxjac.simulation import Computation
from approxjac.stability import rest_error


def test_on_one_joint_it_is_the_closed_form():
    # |l cos(q) k e| <= F for a force along z on a link of length l
    robot = aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0))
    task = aj.PositionTask(robot, axes="xz")
    controller = aj.SetpointController(task, aj.Gains(100.0, 20.0), gravity=aj.NoGravity(robot))
    q, friction = np.array([0.3, 0.9]), Friction(coulomb=(2.0, 1.0), stribeck=1.5)
    # as many joints as coordinates: the corners of |JᵀKe| <= F
    corners = [
        np.linalg.solve(task.jacobian(q).T * 100.0, [a * 3.0, b * 1.5])
        for a in (-1, 1) for b in (-1, 1)
    ]  # fmt: skip
    np.testing.assert_allclose(rest_error(controller, friction, q), np.abs(corners).max(axis=0))
    assert rest_error(controller, Friction(1.0), q).max() < 1e-15


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_friction_by_load_is_of_its_size_whichever_way_a_joint_is_loaded(name):
    robot = aj.load_robot(name)
    controller, g = aj.SetpointController(aj.PositionTask(robot)), aj.Plant(robot).dynamics.g
    for q in robot.configurations(3):
        dry = 0.02 * robot.effort_limits
        assert (g(q) < -0.1).any()
        by_load = rest_error(controller, Friction(coulomb=dry, load=0.06), q)
        dry = dry + 0.06 * np.abs(g(q))
        np.testing.assert_allclose(by_load, rest_error(controller, Friction(coulomb=dry), q))


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "share"),
    [("ur3", 0.02), *(pytest.param(arm, 0.02, marks=pytest.mark.long) for arm in ("z1", "panda"))],
)
def test_no_move_ends_farther_away(name, share):
    robot, rng = aj.load_robot(name), np.random.default_rng(31)
    dry = share * robot.effort_limits
    friction, task = Friction(0.5 * dry, dry, stribeck=1.2), aj.PositionTask(robot)
    controller = aj.SetpointController(task, saturation=aj.law.Linear())  # or it may be infinite
    plant = aj.Plant(robot, friction=friction)
    computation, shares = Computation("semi_implicit_euler", engine="compiled"), []
    q0 = plant.ready_configuration()
    for _ in range(12):
        target = plant.sensor.value(pin.integrate(robot.model, q0, rng.normal(0.0, 0.3, robot.nv)))
        run = aj.simulate(plant, controller, target, q0, 8.0, computation=computation)
        if np.abs(run.v[-1]).max() > 1e-6:  # it has not come to rest
            continue
        bound = rest_error(controller, friction, run.q[-1])
        shares.append((np.abs(run.error[-1]) / bound).max())
    assert len(shares) >= 4
    assert max(shares) <= 1.0
    assert max(shares) > 0.1  # which is no empty bound


def test_it_stands_just_within_and_moves_just_beyond():
    robot = aj.load_robot("ur5")
    task = aj.PositionTask(robot)
    friction = Friction(coulomb=3.0)
    controller, plant = aj.SetpointController(task), aj.Plant(robot, friction=friction)
    q0 = plant.ready_configuration()
    bound = rest_error(controller, friction, q0)
    k = int(np.argmin(bound))
    moved = []
    for share in (1.0, 1.001):  # along a coordinate alone it stands within less, or as far
        target = plant.sensor.value(q0)
        target[k] += share * bound[k]
        run = aj.simulate(plant, controller, target, q0, 0.05)
        moved.append(np.abs(run.q[-1] - q0).max())
    assert moved[1] > 0.0


def test_laws_that_do_not_rest_are_refused():
    robot = aj.load_robot("panda")
    task = aj.PositionTask(robot)
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    learns = aj.SetpointController(task, gravity=aj.AdaptiveGravity(robot))
    compensates = aj.SetpointController(task, friction=aj.controllers.FrictionCompensation())
    for controller in (learns, compensates):
        with pytest.raises(aj.InvalidInputError, match="do not rest"):
            rest_error(controller, Friction(coulomb=1.0), q)
    flat = aj.SetpointController(aj.PositionTask(aj.load_robot("two_link"), axes="xz"))
    with pytest.raises(aj.InvalidInputError, match="full rank"):
        rest_error(flat, Friction(coulomb=1.0), np.zeros(2))
    much = rest_error(aj.SetpointController(task), Friction(coulomb=1e3), q)
    assert np.isinf(much).all()
