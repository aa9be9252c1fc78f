"""`JointRange`: bounds that no posture exceeds, and that are not much above what postures reach."""

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.robots.ranges import JointRange

SLIDER = """<robot name="slider"><link name="base"/>
  <link name="carriage"><inertial><mass value="2"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="arm"><inertial><origin xyz="0.3 0 0.1"/><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tool"><inertial><origin xyz="0.2 0 0"/><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="carriage"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="50" velocity="2"/></joint>
  <joint name="slide" type="prismatic"><parent link="carriage"/><child link="arm"/>
    <axis xyz="0.6 0 0.8"/><limit lower="0" upper="1" effort="50" velocity="2"/></joint>
  <joint name="swing" type="revolute"><parent link="arm"/><child link="tool"/>
    <origin xyz="0.5 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="50" velocity="2"/></joint>
</robot>"""

NONE = np.zeros((0, 3))


def arms():
    return {
        "two_link": aj.load_robot("two_link").with_object(0.5, 0.5),
        "panda": aj.load_robot("panda").with_object(0.2, 0.5, axis=(1.0, 0.0, 1.0)),
        "panda, mimic finger": aj.load_robot("panda", free="all", tip="panda_leftfinger"),
        "panda on a wall": aj.load_robot("panda").with_gravity((9.81, 0.0, 0.0)),
        "kinova": aj.load_robot("kinova"),
        "talos_arm": aj.load_robot("talos_arm"),
        "slider": aj.load_robot(SLIDER),
    }


@pytest.fixture(scope="module", params=list(arms()))
def robot(request):
    return arms()[request.param]


def drawn(robot, lower, upper, rng, count):
    """The largest torques and sums of columns over random postures."""
    dynamics, task = aj.Dynamics(robot), aj.PositionTask(robot, axes="xz")
    largest = np.zeros((2, robot.nv))
    for _ in range(count):
        q = pin.integrate(robot.model, robot.neutral(), rng.uniform(lower, upper))
        J = task.jacobian(q)
        largest = np.maximum(largest, [np.abs(dynamics.g(q)), 2.0 * np.abs(J[0]) + np.abs(J[1])])
    return largest


def bounds(robot, lower, upper):
    where = JointRange(robot, lower, upper)
    pulls = np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return (
        where.largest([where.own_weight()]),
        where.largest([where.point_load(robot.tip, pulls, NONE)]),
    )


def test_no_posture_exceeds_the_bounds_and_some_come_near(robot, rng):
    lower, upper = robot.usual_range()
    found = drawn(robot, lower, upper, rng, 3000)
    near = (1.15, 1.3)  # columns of a position depend on more joints at once
    for bound, largest, ratio in zip(bounds(robot, lower, upper), found, near, strict=True):
        assert (largest <= bound).all()
        # joints that turn the load hardest, which decide; 3000 postures do not find the largest
        most = bound.argmax()
        assert bound[most] < ratio * largest[most]


@pytest.mark.parametrize("width", [0.0, 0.05, 0.5])
def test_in_a_narrow_range_they_are_as_narrow(robot, width, rng):
    low, high = robot.usual_range()
    middle = rng.uniform(low, high)
    lower, upper = middle - width, middle + width
    found = drawn(robot, lower, upper, rng, 300 if width else 1)
    scales = bounds(robot, *robot.usual_range())
    for bound, largest, scale in zip(bounds(robot, lower, upper), found, scales, strict=True):
        assert (largest <= bound + 1e-12).all()
        if robot.coupling.G is None:  # parts of a coupled joint may cancel
            assert (bound <= largest + (0.02 + 0.8 * width) * scale.max()).all()


def test_at_one_posture_they_are_exact(robot, rng):
    motion = rng.uniform(*robot.usual_range())
    q = pin.integrate(robot.model, robot.neutral(), motion)
    weight, _ = bounds(robot, motion, motion)
    expected = np.abs(aj.Dynamics(robot).g(q))
    alone = slice(None) if robot.coupling.G is None else slice(7)  # fingers' weights may cancel
    assert_allclose(weight[alone], expected[alone], rtol=1e-6, atol=1e-6)
    assert (weight >= expected).all()


def test_turning_and_sliding_columns(rng):
    """Rows of angular velocity: a joint that slides has none."""
    robot = aj.load_robot(SLIDER)
    motion = rng.uniform(*robot.usual_range())
    where = JointRange(robot, motion, motion)
    J = aj.tasks.frame.FrameKinematics(robot, "tool").jacobian(motion)
    rows = where.largest([where.point_load("tool", np.eye(3)[:1], np.eye(3)[1:])])
    assert_allclose(rows, np.abs(J[[0, 4, 5]]).sum(axis=0), rtol=1e-6, atol=1e-6)


def test_masses_of_a_regressor_make_its_gravity(robot, rng):
    regressor = aj.GravityRegressor(robot)
    theta = rng.normal(size=regressor.p)
    motion = rng.uniform(*robot.usual_range())
    q = pin.integrate(robot.model, robot.neutral(), motion)
    where = JointRange(robot, motion, motion)
    expected = np.abs(regressor.Z(q) @ theta)
    got = where.largest([where.weight(*regressor.masses(theta))])
    if robot.coupling.G is None:
        assert_allclose(got, expected, rtol=1e-6, atol=1e-6)
    assert (got >= expected).all()
