import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.errors import UnknownNameError
from approxjac.robots import Dynamics, GravityRegressor


def held(robot):
    """The robot with a heavy, long, thick tool, well off the axes."""
    return robot.with_object(0.2, 1.3, radius=0.03, axis=(1.0, 2.0, 3.0))


def shifted(robot, rng, size=0.1):
    return robot.with_kinematic_error(
        {joint: rng.uniform(-size, size, 3) for joint in robot.joint_names}
    )


def test_regressor_times_parameters_is_gravity_on_every_arm(arm, rng):
    robot = held(arm)
    regressor, dynamics = GravityRegressor(robot), Dynamics(robot)
    for _ in range(50):
        q = robot.random_configuration(rng)
        g = dynamics.g(q)
        scale = max(1.0, np.abs(g).max())
        assert_allclose(regressor.Z(q) @ regressor.theta, g, rtol=0, atol=1e-12 * scale)


def test_the_parameters_are_independent_on_every_arm(arm, rng):
    regressor = GravityRegressor(held(arm))
    Z = np.vstack([regressor.Z(regressor.robot.random_configuration(rng)) for _ in range(100)])
    values = np.linalg.svd(Z / np.linalg.norm(Z, axis=0), compute_uv=False)
    assert values[-1] > 1e-4 * values[0]
    assert len(regressor.names) == regressor.p == Z.shape[1]


def test_gravity_is_in_the_span_with_wrong_lengths_on_every_arm(arm, rng):
    truth = held(arm)
    belief = shifted(arm, rng)
    theta, residual = GravityRegressor(belief).fit(truth)
    assert residual < 1e-10
    g = Dynamics(truth).g(q := truth.random_configuration(rng))
    assert_allclose(GravityRegressor(belief).Z(q) @ theta, g, atol=1e-9)


def test_wrong_axis_directions_break_the_span(panda, rng):
    """By some 6 % where every axis of a Panda is 3° off, in random directions."""
    truth = panda.with_object(0.2, 1.3)
    residuals = []
    for _ in range(10):
        directions = rng.normal(size=(7, 3))
        turns = np.radians(3.0) * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        rotations = dict(zip(panda.joint_names, turns, strict=True))
        belief = panda.with_kinematic_error(rotations=rotations)
        residuals.append(GravityRegressor(belief).fit(truth)[1])
    assert 0.04 < np.median(residuals) < 0.08
    assert 0.03 < min(residuals) < max(residuals) < 0.12


def test_panda_has_twelve_base_parameters(panda):
    assert GravityRegressor(panda).p == 12


def test_the_general_two_link_arm_has_two_more_parameters_that_are_zero(two_link):
    regressor = GravityRegressor(two_link)
    assert regressor.names == ("joint1.mx", "joint1.mz", "joint2.mx", "joint2.mz")
    assert_allclose(regressor.theta, [3.5, 0.0, 1.625, 0.0], atol=1e-14)


def test_bad_moments_are_refused(two_link):
    with pytest.raises(aj.InvalidInputError, match="moments must name each axis once, such as"):
        GravityRegressor(two_link, moments="xx")
    with pytest.raises(UnknownNameError, match="axis 'w' not in moments; valid are x, y, z"):
        GravityRegressor(two_link, moments="xw")


def test_moments_that_do_not_cover_the_robot_are_refused(panda):
    with pytest.raises(aj.InvalidInputError, match="moments must cover the centres of mass of pan"):
        GravityRegressor(panda, moments="x")


ROD = """<link name="{name}"><inertial><origin xyz="0.1 0.2 0.3"/><mass value="1"/>
  <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="j_{name}" type="{kind}"><parent link="{parent}"/><child link="{name}"/>
  <origin xyz="0.3 0 0.1"/><axis xyz="{axis}"/>
  <limit lower="{low}" upper="{high}" effort="0" velocity="0"/></joint>"""


def chain(*joints):
    """A chain of equal links, for joints (type, axis, lower, upper)."""
    parts = [
        ROD.format(
            name=f"l{i}", parent=f"l{i - 1}" if i else "base", kind=k, axis=a, low=lo, high=hi
        )
        for i, (k, a, lo, hi) in enumerate(joints)
    ]
    return aj.load_robot(f'<robot name="chain"><link name="base"/>{"".join(parts)}</robot>')


@pytest.mark.parametrize(
    "joints",
    [
        [("revolute", "0 1 0", 3.3, 6.0), ("revolute", "1 0 0", 3.3, 6.0)],
        [("prismatic", "0 0 1", 1.5, 2.0), ("revolute", "0 1 0", -1, 1)],
        [("prismatic", "0 0 1", 0, 0.3), ("prismatic", "1 0 0", 0, 0.3)],
        [("revolute", "0 1 0", -1e-4, 1e-4), ("prismatic", "1 0 0", 0, 1),
         ("revolute", "1 1 0", -1, 1)],
        [("continuous", "0 1 0", 0, 0), ("revolute", "1 0 0", -9, -7)],
    ],
)  # fmt: skip
def test_limits_and_prismatic_joints_do_not_hide_a_parameter(joints, rng):
    robot = chain(*joints)
    regressor, dynamics = GravityRegressor(robot), Dynamics(robot)
    lower, upper = robot.position_limits
    for _ in range(50):
        q = robot.random_configuration(rng)
        assert_allclose(regressor.Z(q) @ regressor.theta, dynamics.g(q), atol=1e-11)
        motion = pin.difference(robot.model, robot.neutral(), q)
        if robot.nq == robot.nv:
            assert (motion >= lower).all()
            assert (motion <= upper).all()
    spread = np.ptp([robot.random_configuration(rng) for _ in range(50)], axis=0)
    assert (spread > 0.0).all()


def test_nothing_to_learn_without_gravity(two_link):
    with pytest.raises(aj.InvalidInputError, match="gravity exerts no torque on two_link"):
        GravityRegressor(two_link.with_gravity((0.0, 0.0, 0.0)))


def test_fit_refuses_another_arm(two_link, panda):
    with pytest.raises(
        aj.InvalidInputError, match=r"robot must have the joints of Robot\('two_link'"
    ):
        GravityRegressor(two_link).fit(panda)
    with pytest.raises(
        aj.InvalidInputError, match=r"be under its gravity of \[0.0, 0.0, -9.81\] m/s"
    ):
        GravityRegressor(panda).fit(panda.with_gravity((0.0, 0.0, 9.81)))


@pytest.mark.parametrize("name", ["panda", "ur5", "so100"])  # so100: a joint named as its link
def test_a_change_of_parameters_is_told_as_a_load_on_the_last_link(name):
    """A rod of 0.5 kg, 0.2 m from the tip outwards, whose moment is in the link's own axes."""
    robot = aj.load_robot(name)
    truth = robot.with_object(0.2, 0.5)
    regressor = GravityRegressor(robot)
    load = regressor.payload(regressor.fit(truth)[0] - regressor.theta)
    last = truth.model.frames[truth.model.getFrameId(truth.tip, pin.FrameType.BODY)].parentJoint
    bodies = [model.inertias[last] for model in (truth.model, robot.model)]
    moments = bodies[0].mass * bodies[0].lever - bodies[1].mass * bodies[1].lever
    assert_allclose(load, [0.5, *moments], atol=1e-9)
    assert_allclose(regressor.payload(np.zeros(regressor.p)), 0.0, atol=1e-12)
