"""`Limits` and the bounds and rows that they become."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from heavy_arms import HeavyArm
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac import law
from approxjac.controllers.limits.limits import sure_deceleration
from approxjac.robots import Dynamics

INF = np.inf


def test_of_a_robot_takes_what_its_urdf_says(panda):
    limits = aj.Limits.of(panda, scale=0.5)
    assert_allclose(limits.effort, 0.5 * panda.effort_limits)
    assert_allclose(limits.velocity, [2.175] * 4 + [2.61] * 3)
    assert_array_equal(limits.position, panda.position_limits)
    assert limits.rate is None
    assert_array_equal(aj.Limits.of(panda).effort, panda.effort_limits)


def test_unknown_limits_are_none(two_link):
    limits = aj.Limits.of(two_link).for_joints(2)
    assert np.isinf(limits.effort).all()
    assert np.isinf(limits.velocity).all()


def test_each_can_be_switched_off(panda):
    limits = replace(aj.Limits.of(panda), position=None, velocity=None).for_joints(7)
    assert np.isinf(limits.position).all()
    assert np.isinf(limits.velocity).all()
    assert np.isfinite(limits.effort).all()


def test_a_number_is_for_every_joint():
    assert_allclose(aj.Limits(effort=3.0).for_joints(4).effort, [3.0] * 4)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"effort": 0.0}, "effort must be numbers > 0 [N m or N]"),
        ({"effort": [1.0, -1.0]}, "effort must be numbers > 0 [N m or N], one or 2"),
        ({"rate": np.nan}, "rate must be numbers > 0 [N m/s or N/s]"),
        ({"velocity": "fast"}, "velocity must be numbers > 0 [rad/s or m/s]"),
        ({"position": ([0.0], [0.0])}, "position must be the smallest and the largest position"),
        ({"position": ([0.0, 0.0], [1.0])}, "position must be the smallest and the largest"),
        ({"position": 3.0}, "position must be the smallest and the largest position"),
    ],
)
def test_bad_limits_are_refused(options, text):
    with pytest.raises(aj.InvalidInputError) as error:
        aj.Limits(**options)
    assert text in str(error.value)
    assert error.value.given is next(iter(options.values()))


def test_a_range_of_whole_numbers_becomes_one_of_numbers_that_nobody_changes():
    limits = aj.Limits(position=([-1, -2], [1, 2]))
    for side in limits.position:
        assert side.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            side[0] = 0.0


@pytest.mark.parametrize(
    "options", [{"effort": [1.0, 1.0]}, {"position": ([0.0, 0.0], [1.0, 1.0])}]
)
def test_limits_of_other_joints_are_refused(panda, options):
    controller = aj.SetpointController(aj.PositionTask(panda))
    with pytest.raises(aj.InvalidInputError, match="7"):
        aj.TorqueLimited(controller, aj.Limits(**options))


def test_speed_bounds_let_a_joint_come_to_its_limit_exponentially():
    motion, joint = np.array([0.5]), law.JointRange.of([[-1.0], [1.0]], INF, 10.0, INF)
    for _ in range(1000):
        motion = motion + 1e-3 * joint.speed_bounds(motion)[1]
    assert_allclose(1.0 - motion, 0.5 * (1.0 - 0.01) ** 1000)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_joint_that_comes_to_its_limit_brakes_with_no_more_than_its_deceleration(side):
    joint, dt = law.JointRange.of([[-1.0], [1.0]], INF, 10.0, 3.0), 3e-4
    motion, before, hardest = np.array([-0.8 * side]), None, 0.0
    for _ in range(10_000):
        speed = joint.speed_bounds(motion)[int(side > 0.0)]
        if before is not None:
            hardest = max(hardest, float(np.abs(speed - before)[0]) / dt)
        before, motion = speed, motion + dt * speed
    assert hardest == pytest.approx(3.0, rel=1e-2)
    assert 0.0 < 1.0 - side * motion[0] < 1e-6  # it gets there, not further


@pytest.mark.parametrize("name", ["panda", "ur5", "tiago_arm"])
def test_motors_surely_brake_a_joint_in_almost_every_configuration(name, rng):
    robot = aj.load_robot(name)
    effort, dynamics = robot.effort_limits, Dynamics(robot)
    a = sure_deceleration(robot, effort)
    assert (a > 0.0).all()
    enough = []
    for _ in range(200):
        q = robot.random_configuration(rng)
        needed = np.abs(dynamics.g(q))[:, None] + np.abs(dynamics.M(q)) * a  # joint by joint
        enough.append((needed <= effort[:, None]).all(axis=0))
    assert np.mean(enough, axis=0).min() > 0.95
    unknown = sure_deceleration(robot, np.full(robot.nv, np.inf))
    assert np.isinf(unknown).all()


def test_motors_that_hardly_hold_the_arm_brake_it_hardly():
    """Whatever side its weight is on: a motor may have to brake against it."""
    robot = HeavyArm("three_joint").bare
    rng, dynamics = np.random.default_rng(8), Dynamics(robot)
    drawn = [robot.random_configuration(rng) for _ in range(300)]
    g = np.abs([dynamics.g(q) for q in drawn])
    effort = 1.1 * g.max(axis=0) + 0.5
    a = sure_deceleration(robot, effort)
    enough = [
        (gravity[:, None] + np.abs(dynamics.M(q)) * a <= effort[:, None]).all(axis=0)
        for q, gravity in zip(drawn, g, strict=True)
    ]
    assert (a > 0.0).all()
    assert np.mean(enough, axis=0).min() > 0.9


def test_acceleration_bounds_stop_what_is_too_fast():
    low, high = law.acceleration_bounds(np.array([3.0]), np.array([[-2.0], [2.0]]), 50.0)
    assert high == -50.0
    assert low == -250.0


def test_where_torques_change_slowly_braking_begins_in_time():
    """The last of the way to a bound, d, is ramped down: √(jd) there, and rd where that is less."""
    bounds = law.acceleration_bounds(
        np.array([3.0, 1.99]), np.array([[-2.0, -2.0], [2.0, 2.0]]), 50.0, np.array([100.0, 100.0])
    )
    assert_allclose(bounds, [[-np.sqrt(500.0), -np.sqrt(399.0)], [-10.0, 0.5]])


def test_forward_dynamics_invert_the_inverse_ones(arm, rng):
    dynamics = Dynamics(arm)
    q, v = arm.random_configuration(rng), rng.normal(size=arm.nv)
    tau = rng.normal(size=arm.nv)
    M = dynamics.M(q)
    assert_array_equal(M, M.T)
    assert_allclose(dynamics.M_inv(q) @ M, np.eye(arm.nv), atol=1e-8 * np.linalg.cond(M))
    assert_allclose(
        pin.rnea(arm.model, arm.model.createData(), q, v, dynamics.forward(q, v, tau)),
        tau,
        atol=1e-6,
    )
