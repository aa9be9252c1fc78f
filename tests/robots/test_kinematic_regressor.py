"""p(q, θ) against forward kinematics of robots whose origins, axes and encoders are off."""

import copy
import pickle

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.robots import KinematicRegressor
from approxjac.robots.kinematic_regressor import Unknowns
from approxjac.tasks.frame_tasks import FrameKinematics, PointKinematics

INERTIA = '<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/>'
LINK = f'<link name="{{0}}"><inertial><mass value="1"/>{INERTIA}</inertial></link>'
LIMIT = '<limit lower="-1" upper="1" effort="9" velocity="9"/>'
JOINT = (
    '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/>'
    f'<origin xyz="{{4}}" rpy="{{5}}"/><axis xyz="{{6}}"/>{LIMIT}{{7}}</joint>'
)


def every_kind():
    """An arm with a branch, oblique axes, joints that slide, turn without end, follow and rest."""
    follows = '<mimic joint="turn" multiplier="-0.5" offset="0.2"/>'
    joints = [
        ("foot", "fixed", "world", "base", "0.1 0 0.2", "0.3 0 0", "0 0 1", ""),
        ("turn", "revolute", "base", "a", "0 0.1 0.3", "0.1 0.2 0.3", "0 1 0", ""),
        ("slide", "prismatic", "a", "b", "0.2 0 0.1", "0 0.4 0", "1 0 1", ""),
        ("spacer", "fixed", "b", "c", "0 0 0.1", "0 0 0.7", "0 0 1", ""),
        ("wheel", "continuous", "c", "d", "0.2 0.1 0", "0.5 0 0", "0 0 1", ""),
        ("follower", "revolute", "d", "e", "0.3 0 0", "0 0 1", "1 2 0", follows),
        ("wrist", "revolute", "e", "f", "0.1 0 0.2", "0 1 0", "0 0 -1", ""),
        ("flange", "fixed", "f", "hand", "0 0.1 0.1", "0.2 0 0", "0 0 1", ""),
        ("held", "fixed", "hand", "tip", "0.1 0 0.1", "0 0 0.3", "0 0 1", ""),
        ("other", "prismatic", "b", "arm2", "0 0.2 0", "0 0 0", "0 1 0", ""),
        ("end2", "fixed", "arm2", "tip2", "0 0.1 0.2", "0.4 0 0", "0 0 1", ""),
    ]
    links = ["world", *(joint[3] for joint in joints)]
    text = "".join(LINK.format(name) for name in links) + "".join(JOINT.format(*j) for j in joints)
    return aj.Robot(f'<robot name="every_kind">{text}</robot>', tip="tip")


@pytest.fixture(scope="module")
def kinds():
    return every_kind()


def drawn(regressor, rng):
    """A configuration, a velocity, parameters a few centimetres off, and their rates."""
    robot, p = regressor.robot, regressor.p
    theta = regressor.theta + 0.03 * rng.standard_normal(p)
    q = robot.random_configuration(rng)
    return q, rng.standard_normal(robot.nv), theta, rng.standard_normal(p)


def jacobian(regressor, q, theta):
    return regressor.motion(q, np.zeros(regressor.robot.nv), theta, np.zeros(regressor.p)).J


def linear(regressor, q, theta):
    Y, o = regressor.linear(q, theta)
    return Y @ theta + o


def moved(robot, q, v, h):
    return np.array(pin.integrate(robot.model, q, h * v))


@pytest.mark.parametrize("axes", [False, True])
def test_positions_and_jacobians_are_those_of_the_robot_with_them(arm, rng, axes):
    regressor = KinematicRegressor(arm, axes=axes)
    q, v, theta, _ = drawn(regressor, rng)
    robot = regressor.robot_with(theta)  # whose tip is another frame where a joint moves the arm's
    other = FrameKinematics(robot, robot.tip)
    assert_allclose(
        linear(regressor, q, regressor.theta), FrameKinematics(arm, arm.tip).position(q), atol=1e-12
    )
    assert_allclose(regressor.position(q, theta), other.position(q), atol=1e-12)
    assert_allclose(jacobian(regressor, q, theta), other.jacobian(q)[:3], atol=1e-12)
    assert_allclose(
        regressor.motion(q, v, theta, 0.0 * theta).J_dot, other.jacobian_dot(q, v)[:3], atol=1e-12
    )


@pytest.mark.parametrize("axes", [False, True])
@pytest.mark.parametrize("frame", ["tip", "tip2", "hand", "f", "wheel", ["tip", "tip2", "hand"]])
def test_every_kind_of_joint(kinds, frame, rng, axes):
    regressor = KinematicRegressor(kinds, frame, axes=axes)
    assert len(regressor.names) == len(regressor.units) == regressor.p
    assert ("turn.encoder" in regressor.names) == axes
    q, v, theta, theta_dot = drawn(regressor, rng)
    if frame in ("f", "wheel"):  # links that a joint moves have no tool
        theta[regressor.n_lengths - 3 : regressor.n_lengths] = 0.0
    robot = regressor.robot_with(theta)
    frames = [frame] if isinstance(frame, str) else frame
    kinematics = [FrameKinematics(robot, name) for name in frames]
    assert_allclose(
        regressor.position(q, theta), np.ravel([k.position(q) for k in kinematics]), atol=1e-12
    )
    J = np.concatenate([k.jacobian(q)[:3] for k in kinematics])
    assert_allclose(jacobian(regressor, q, theta), J, atol=1e-12)
    assert_allclose(linear(regressor, q, theta), regressor.position(q, theta), atol=1e-12)
    h = 1e-6
    motion = regressor.motion(q, v, theta, theta_dot)
    after, before = (
        jacobian(regressor, moved(kinds, q, v, s), theta + s * theta_dot) for s in (h, -h)
    )
    assert_allclose(motion.J_dot, (after - before) / (2 * h), atol=1e-8)
    assert_allclose(motion.J, J, atol=1e-12)
    Y = regressor.linear(q, theta)[0]
    sides = zip(
        *([regressor.position(q, theta + s * e) for s in (h, -h)] for e in np.eye(regressor.p)),
        strict=True,
    )
    after, before = map(np.array, sides)
    assert_allclose(Y, (after - before).T / (2 * h), atol=1e-8)
    assert_allclose(motion.drift, Y @ theta_dot, atol=1e-12)
    assert_allclose(motion.p, regressor.position(q, theta), atol=1e-12)


@pytest.mark.parametrize("axes", [False, True])
@pytest.mark.parametrize("frame", ["tip", "tip2", "hand", "wheel"])
def test_orientations_turn_with_axes_and_encoders(kinds, frame, rng, axes):
    regressor = KinematicRegressor(kinds, frame, axes=axes)
    q, v, theta, theta_dot = drawn(regressor, rng)
    theta[regressor.n_lengths - 3 : regressor.n_lengths] = 0.0
    turn, h = regressor.turn(q, v, theta, theta_dot), 1e-6
    frame = FrameKinematics(regressor.robot_with(theta), frame)
    assert_allclose(turn.R, frame.placement(q)[0], atol=1e-12)
    assert_allclose(turn.J, frame.jacobian(q)[3:], atol=1e-12)

    def at(s, way):
        later = moved(kinds, q, v, s * way[0]), v, theta + s * way[1] * theta_dot, theta_dot
        return regressor.turn(*later)

    after, before = at(h, (1.0, 1.0)), at(-h, (1.0, 1.0))
    assert_allclose(turn.J_dot, (after.J - before.J) / (2 * h), atol=1e-8)
    spin = pin.log3(at(h, (0.0, 1.0)).R @ at(-h, (0.0, 1.0)).R.T) / (2 * h)
    assert_allclose(turn.A @ theta_dot, spin, atol=1e-8)
    assert turn.A.any() == axes


@pytest.mark.parametrize("frame", ["panda_link7", "panda_hand"])
def test_a_tool_that_is_only_turned_stays_where_it_is(frame, panda, rng):
    """On a link that a joint moves, and on a fixed one."""
    turn, q = np.array([0.3, -0.2, 0.5]), panda.random_configuration(rng)
    regressor = KinematicRegressor(panda, frame)
    robot = regressor.robot_with(regressor.theta, turn)
    R, p = FrameKinematics(panda, frame).placement(q)
    turned = robot.tip if frame == "panda_link7" else frame
    found, there = FrameKinematics(robot, turned).placement(q)
    assert_allclose(there, p, atol=1e-12)
    assert_allclose(found, R @ pin.exp3(turn), atol=1e-9)


def test_the_jacobian_is_the_derivative_of_the_position(arm, rng):
    regressor = KinematicRegressor(arm)
    q, v, theta, _ = drawn(regressor, rng)
    h = 1e-6
    after, before = (regressor.position(moved(arm, q, v, s), theta) for s in (h, -h))
    assert_allclose(jacobian(regressor, q, theta) @ v, (after - before) / (2 * h), atol=1e-8)


def test_points_of_a_frame(kinds, rng):
    points = np.array([[0.1, 0.0, 0.0], [0.0, 0.2, -0.1]])
    regressor = KinematicRegressor(kinds, "tip", points)
    q, _, theta, _ = drawn(regressor, rng)
    robot = regressor.robot_with(theta)
    expected = PointKinematics(robot, points, "tip", None)
    assert_allclose(regressor.position(q, theta), expected.positions(q).ravel(), atol=1e-12)
    J = expected.jacobians(q)[1].reshape(6, -1)
    assert_allclose(jacobian(regressor, q, theta), J, atol=1e-12)
    assert_allclose(linear(regressor, q, theta), regressor.position(q, theta), atol=1e-12)
    assert regressor.k == 2
    assert regressor.p == KinematicRegressor(kinds, "tip").p


@pytest.mark.parametrize("axes", [False, True])
@pytest.mark.parametrize(("name", "n"), [("panda", 7), ("xarm7", 7), ("ur5", 6), ("kinova", 6)])
def test_the_rank_is_that_of_a_serial_arm(name, n, axes):
    """2n + 3 translations show, 4n + 3 numbers with axes; two less as the tip is on the last."""
    regressor = KinematicRegressor(aj.load_robot(name), axes=axes)
    drawn = (regressor.robot.random_configuration(np.random.default_rng(i)) for i in range(60))
    Y = np.vstack([regressor.linear(q, regressor.theta)[0] for q in drawn])
    rank, p = (4 * n + 1, 6 * n + 3) if axes else (2 * n + 3, 3 * n + 3)
    assert (np.linalg.matrix_rank(Y, tol=1e-6), regressor.p) == (rank, p)
    assert regressor.names[regressor.n_lengths - 1] == "tool.z"


def test_some_sums_alone_show(panda, rng):
    regressor = KinematicRegressor(panda)
    at = {name: i for i, name in enumerate(regressor.names)}
    theta = regressor.theta.copy()
    theta[at["panda_joint3.y"]] += 0.1  # with a sum that stays as it was, p stays
    theta[at["panda_joint4.z"]] += 0.1
    q = panda.random_configuration(rng)
    assert_allclose(regressor.position(q, theta), regressor.position(q, regressor.theta))


def test_a_learnt_tool_is_saved(panda, tmp_path, rng):
    regressor = KinematicRegressor(panda, "panda_link7")  # a link that a joint moves
    theta = regressor.theta.copy()
    theta[-3:] = 0.1, -0.2, 0.05
    robot = regressor.robot_with(theta)
    assert robot.tip == "tool_tip"
    again = aj.load_robot(robot.save_urdf(tmp_path / "learnt.urdf"), tip="tool_tip")
    q = panda.random_configuration(rng)
    assert_allclose(
        FrameKinematics(again, "tool_tip").position(q), regressor.position(q, theta), atol=1e-9
    )


def test_a_learnt_arm_is_saved(panda, tmp_path, rng):
    regressor = KinematicRegressor(panda, axes=True)
    q, _, theta, _ = drawn(regressor, rng)
    path = regressor.robot_with(theta).save_urdf(tmp_path / "learnt.urdf")
    again = aj.load_robot(path, tip=panda.tip)
    found = FrameKinematics(again, again.tip).position(q)
    assert_allclose(found, regressor.position(q, theta), atol=1e-12)


@pytest.mark.parametrize("name", ["panda", "z1", "ur10"])
def test_what_is_of_second_order_grows_with_the_square_of_the_reach(name, rng):
    """tr P_angles(tr P_tool + L² tr P_angles)/3, by angles (rad) and a tool (m)."""
    robot = aj.load_robot(name)
    regressor = KinematicRegressor(robot, axes=True)
    unknowns = Unknowns(regressor, ("tool", "axes"), {"tool": 0.1, "axes": 0.01, "encoders": 0.02})
    reach, variances = robot.reach_bound(robot.tip)[1], rng.uniform(0.0, 1e-3, len(unknowns.u))
    ends = [name.split(".")[0] == "tool" for name in unknowns.names]
    tool = variances[ends].sum()
    angles = variances.sum() - tool
    assert_allclose(unknowns.bent(variances), angles * (tool + reach**2 * angles) / 3.0)


def test_copies_have_scratch_memory_of_their_own(panda, rng):
    regressor = KinematicRegressor(panda, axes=True)
    q, v, theta, theta_dot = drawn(regressor, rng)
    motion = regressor.motion(q, v, theta, theta_dot)
    kept = copy.deepcopy(motion)
    for other in (copy.copy(regressor), pickle.loads(pickle.dumps(regressor)), regressor):
        other.motion(*drawn(regressor, rng))
        for a, b in zip(motion, kept, strict=True):
            assert np.array_equal(a, b)
    assert regressor.linear(q, theta)[0] is not regressor.linear(q, theta)[0]


def test_what_makes_no_sense_is_refused(panda):
    with pytest.raises(aj.errors.UnknownNameError, match="'panda_hnd' not in panda"):
        KinematicRegressor(panda, "panda_hnd")
    with pytest.raises(aj.errors.InvalidInputError, match="frame must be one that a joint moves"):
        KinematicRegressor(panda, "panda_link0")
    with pytest.raises(aj.errors.InvalidInputError, match="points must be those of one frame"):
        KinematicRegressor(panda, ["panda_hand", "panda_link7"], [[0, 0, 0.1]])
    regressor = KinematicRegressor(panda)
    with pytest.raises(aj.errors.InvalidInputError, match=r"q must have shape \(7,\)"):
        regressor.linear(np.zeros(6), regressor.theta)
    with pytest.raises(aj.errors.InvalidInputError, match=r"theta must have shape \(24,\)"):
        regressor.robot_with(np.zeros(3))
