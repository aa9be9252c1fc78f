"""Mimic joints are coupled: compared with the model in which every joint moves on its own."""

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.errors import UrdfError
from approxjac.robots import Dynamics, GravityRegressor


def link(name, mass):
    return f"""<link name="{name}"><inertial><origin xyz="0.2 0.05 0.1"/><mass value="{mass}"/>
      <inertia ixx="0.1" ixy="0.01" ixz="0" iyy="0.2" iyz="0" izz="0.15"/></inertial></link>"""


def joint(name, parent, child, axis, kind="revolute", mimic=""):
    return f"""<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
      <origin xyz="0.5 0 0.1"/><axis xyz="{axis}"/>
      <limit lower="-2" upper="2" effort="5" velocity="1"/>{mimic}</joint>"""


def mimic(leader, multiplier=0.5, offset=0.1):
    return f'<mimic joint="{leader}" multiplier="{multiplier}" offset="{offset}"/>'


def chain(*joints):
    links = "".join(link(name, mass) for name, mass in zip("abcd", (1, 2, 1.5, 0.7), strict=True))
    return f'<robot name="coupled"><link name="base"/>{links}{"".join(joints)}</robot>'


J1, J2 = joint("j1", "base", "a", "0 1 0"), joint("j2", "a", "b", "0 0 1")
J4 = joint("j4", "c", "d", "1 0 0")


HALF = mimic("j1")


def third(kind="revolute", follows=HALF):
    return joint("j3", "b", "c", "0 1 1", kind, follows)


@pytest.fixture(
    params=[
        (chain(J1, J2, third(), J4), 0.5, 0.1),
        (chain(J1, J2, third("prismatic"), J4), 0.5, 0.1),
        (chain(joint("j1", "base", "a", "0 1 0", "prismatic"), J2, third(), J4), 0.5, 0.1),
        (chain(J1, J2, third(follows='<mimic joint="j1"/>'), J4), 1.0, 0.0),
        (chain(J1, J2, third(follows=mimic("j1", -2, -0.3)), J4), -2.0, -0.3),
    ],
    ids=["revolute", "prismatic", "prismatic leader", "defaults", "negative"],
)
def coupled(request):
    """A chain whose third joint follows its first, and q_all = G q + b."""
    text, multiplier, offset = request.param
    G = np.array([[1, 0, 0], [0, 1, 0], [multiplier, 0, 0], [0, 0, 1]])
    return aj.load_robot(text), pin.buildModelFromXML(text), G, np.array([0, 0, offset, 0])


def test_a_mimic_joint_is_no_degree_of_freedom(coupled):
    robot = coupled[0]
    assert robot.nq == robot.nv == 3
    assert robot.joint_names == ("j1", "j2", "j4")
    assert robot.effort_limits.tolist() == [5, 5, 5]
    assert robot.position_limits[1].tolist() == [2, 2, 2]
    assert len(robot.joint_units) == 3
    assert robot.mass == pytest.approx(5.2)


def test_dynamics_are_those_of_all_joints_moving_together(coupled, rng):
    robot, model, G, b = coupled
    data, dynamics = model.createData(), Dynamics(robot)
    for _ in range(5):
        q, v, a = robot.random_configuration(rng), rng.normal(size=3), rng.normal(size=3)
        q_all, v_all, a_all = G @ q + b, G @ v, G @ a
        M = np.triu(pin.crba(model, data, q_all))
        M = G.T @ (M + np.triu(M, 1).T) @ G
        C = G.T @ pin.computeCoriolisMatrix(model, data, q_all, v_all) @ G
        g = G.T @ pin.computeGeneralizedGravity(model, data, q_all)
        tau = G.T @ pin.rnea(model, data, q_all, v_all, a_all)
        energy = pin.computeKineticEnergy(model, data, q_all, v_all)
        energy += pin.computePotentialEnergy(model, data, q_all)
        assert_allclose(dynamics.M(q), M, atol=1e-12)
        assert_allclose(dynamics.C(q, v), C, atol=1e-12)
        assert_allclose(dynamics.coriolis(q, v), C @ v, atol=1e-12)
        assert_allclose(dynamics.g(q), g, atol=1e-12)
        assert_allclose(dynamics.inverse(q, v, a), tau, atol=1e-12)
        assert_allclose(dynamics.forward(q, v, tau), a, atol=1e-10)
        assert_allclose(dynamics.energy(q, v), energy, rtol=1e-12)
        # and M_dot without any of Pinocchio's Coriolis terms
        h = 1e-6
        slope = (dynamics.M(q + h * v) - dynamics.M(q - h * v)) / (2 * h)
        assert_allclose(dynamics.M_dot(q, v), slope, atol=1e-8)


def test_inertia_of_an_arm_that_branches_behind_a_mimic_joint(rng):
    robot = aj.load_robot(
        chain(
            J1,
            joint("j2", "a", "b", "0 1 1", mimic=mimic("j1", 1.0, 0.0)),
            joint("j3", "b", "c", "1 0 0"),
            joint("j4", "b", "d", "0 0 1"),
        )
    )
    dynamics, rest = Dynamics(robot), np.zeros(3)
    for _ in range(5):
        q, tau = robot.random_configuration(rng), rng.normal(size=3)
        g = dynamics.g(q)
        columns = [dynamics.inverse(q, rest, unit) - g for unit in np.eye(3)]
        assert_allclose(dynamics.M(q), np.transpose(columns), atol=1e-12)
        assert (dynamics.M(q) == dynamics.M(q).T).all()
        assert_allclose(dynamics.M_inv(q) @ dynamics.M(q), np.eye(3), atol=1e-12)
        a = dynamics.forward(q, rest, tau)
        assert_allclose(dynamics.inverse(q, rest, a), tau, atol=1e-10)


def test_jacobians_are_those_of_all_joints_moving_together(coupled, rng):
    robot, model, G, b = coupled
    data, task = model.createData(), aj.PositionTask(robot, frame="d")
    frame = model.getFrameId("d")
    for _ in range(5):
        q, v, h = robot.random_configuration(rng), rng.normal(size=3), 1e-6
        pin.framesForwardKinematics(model, data, G @ q + b)
        assert_allclose(task.value(q), data.oMf[frame].translation, atol=1e-14)
        slope = (task.value(q + h * v) - task.value(q - h * v)) / (2 * h)
        assert_allclose(task.jacobian(q) @ v, slope, atol=1e-8)
        slope = (task.jacobian(q + h * v) - task.jacobian(q - h * v)) / (2 * h)
        assert_allclose(task.jacobian_dot(q, v), slope, atol=1e-8)


def test_gravity_regressor_with_mimic_joints(coupled, rng):
    robot = coupled[0]
    regressor, dynamics = GravityRegressor(robot), Dynamics(robot)
    q = robot.random_configuration(rng)
    assert_allclose(regressor.Z(q) @ regressor.theta, dynamics.g(q), atol=1e-10)
    heavier = robot.with_object(0.2, 0.5, parent="d")
    theta, residual = regressor.fit(heavier)
    assert residual < 1e-10
    assert_allclose(regressor.Z(q) @ theta, Dynamics(heavier).g(q), atol=1e-8)
    sideways = robot.with_gravity((3.0, 1.0, -2.0))
    regressor = GravityRegressor(sideways)
    assert_allclose(
        regressor.Z(q) @ regressor.theta, Dynamics(sideways).g(q), atol=1e-10
    )  # gravity reaches both models


def test_two_fingers_in_closed_form():
    finger = """<link name="f{i}"><inertial><mass value="{m}"/><inertia ixx="1e-3" ixy="0" ixz="0"
      iyy="1e-3" iyz="0" izz="1e-3"/></inertial></link><joint name="jf{i}" type="prismatic">
      <parent link="palm"/><child link="f{i}"/><axis xyz="0 0 1"/>
      <limit lower="0" upper="1" effort="1" velocity="1"/>{mimic}</joint>"""
    text = (
        '<robot name="hand"><link name="palm"/>'
        + finger.format(i=1, m=0.3, mimic="")
        + finger.format(i=2, m=0.2, mimic=mimic("jf1", -2, 0.1))
        + "</robot>"
    )
    dynamics = Dynamics(aj.load_robot(text))
    q, v = np.array([0.3]), np.array([0.7])
    mass, weight = 0.3 + 4 * 0.2, 9.81 * (0.3 - 2 * 0.2)
    assert_allclose(dynamics.M(q), [[mass]])
    assert_allclose(dynamics.g(q), [weight])
    assert_allclose(dynamics.forward(q, v, np.array([0.5])), [(0.5 - weight) / mass])
    height = 0.3 * q[0] + 0.2 * (-2 * q[0] + 0.1)
    assert_allclose(dynamics.energy(q, v), 0.5 * mass * v[0] ** 2 + 9.81 * height)


def test_followers_of_followers():
    robot = aj.load_robot(
        chain(
            J1,
            joint("j2", "a", "b", "0 0 1", mimic=mimic("j1", 2, 0.3)),
            third(follows=mimic("j2", 0.5, 0.1)),
            J4,
        )
    )
    assert robot.joint_names == ("j1", "j4")
    q_all = robot.mimic_joints.q(np.array([0.2, -0.4]))
    assert_allclose(q_all, [0.2, 2 * 0.2 + 0.3, 0.5 * 0.7 + 0.1, -0.4])
    assert_allclose(robot.mimic_joints.v(np.array([1.0, 3.0])), [1.0, 2.0, 1.0, 3.0])


def test_a_follower_can_be_locked_and_its_leader_left_free():
    robot = aj.load_robot(chain(J1, J2, third(), J4))
    assert robot.with_locked_joints({"j1": 0.2}).joint_names == ("j2", "j4")
    alone = robot.with_locked_joints({"j3": 0.2})
    assert alone.joint_names == ("j1", "j2", "j4")
    assert alone.mimic_joints.G is None


def test_both_fingers_of_the_panda_move_as_one(rng):
    panda = aj.load_robot("panda", free=["panda_finger_joint1"])
    assert (panda.nq, panda.nv) == (8, 8)
    assert panda.joint_names[-1] == "panda_finger_joint1"
    assert panda.joint_units[-1] == "m"
    assert panda == aj.load_robot("panda", free="panda_finger_joint2")  # the two are one
    closed, opened = panda.neutral(), panda.neutral()
    opened[7] = 0.03
    for finger in ("panda_leftfinger", "panda_rightfinger"):
        task = aj.PositionTask(panda, frame=finger)
        assert np.linalg.norm(task.value(opened) - task.value(closed)) == pytest.approx(0.03)
    # the hand has one motor, which both fingers pull on; other joints as if they were locked
    locked = aj.load_robot("panda")
    q = np.append(locked.random_configuration(rng), 0.0)
    M = Dynamics(panda).M(q)
    fingers = [panda.model.inertias[i].mass for i in (8, 9)]
    assert M[7, 7] == pytest.approx(sum(fingers))
    assert_allclose(M[:7, :7], Dynamics(locked).M(q[:7]), atol=1e-12)


def test_a_run_with_a_free_finger():
    panda = aj.load_robot("panda", free="panda_finger_joint1", gravity=(0.0, 0.0, 0.0))
    task = aj.PositionTask(panda, frame="panda_hand_tcp")
    controller = aj.SetpointController(task, aj.Gains(kp=100, kv=20, damping=2.0))
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8, 0.02])
    target = task.value(q0) + [0.02, 0.0, 0.0]
    run = aj.simulate(
        aj.Plant(panda, task), controller, target=target, q0=q0, duration=1.0, dt=None
    )
    assert run.q.shape[1] == 8
    assert np.linalg.norm(run.error[-1]) < np.linalg.norm(run.error[0])


@pytest.mark.parametrize(
    ("joints", "text"),
    [
        ((J1, J2, third(follows=mimic("jx")), J4), "mimics 'jx', which must be a joint that mov"),
        ((J1.replace("revolute", "fixed"), J2, third(), J4), "mimics 'j1', which must be a joint"),
        ((J1, J2, third(follows=mimic("j3")), J4), "mimics 'j3', which must be a joint t"),
        (
            (J1.replace("revolute", "continuous"), J2, third(), J4),
            "neither may be continuous; make",
        ),
        ((J1, J2, third("continuous"), J4), "neither may be continuous; make it fixed, or take"),
        ((J1, J2, third(follows=mimic("j4")), J4), "and comes before it in Pinocchio's order"),
        (
            (J1, J2, third(follows="<mimic/>"), J4),
            "<mimic joint=...> of joint 'j3' must be a name",
        ),
        (
            (J1, J2, third(follows=mimic("j1", "two")), J4),
            "<mimic multiplier=...> of joint 'j3' must be a finite number, got 'two'",
        ),
    ],
)
def test_mimic_joints_that_cannot_be_coupled_are_refused(joints, text):
    with pytest.raises(UrdfError) as caught:
        aj.load_robot(chain(*joints))
    assert text in str(caught.value)
    assert "is not a valid URDF: URDF text" not in str(caught.value)


def test_pinocchio_alone_would_be_wrong():
    """Why J̇ and C go by all joints: with mimic joints Pinocchio answers them without a word."""
    text = chain(J1, J2, third(), J4)
    model, robot = pin.buildModelFromXML(text, True), aj.load_robot(text)
    q, v = np.array([0.3, -0.2, 0.5]), np.array([1.0, 2.0, -1.0])
    C = pin.computeCoriolisMatrix(model, model.createData(), q, v)
    assert np.abs(C - Dynamics(robot).C(q, v)).max() > 1e-3


def test_the_gradient_of_gravity_is_coupled(coupled, rng):
    robot, _, _, _ = coupled
    dynamics, q, h = Dynamics(robot), robot.random_configuration(rng), 1e-5
    slopes = [(dynamics.g(q + h * u) - dynamics.g(q - h * u)) / (2 * h) for u in np.eye(robot.nv)]
    assert_allclose(dynamics.g_gradient(q), np.array(slopes).T, atol=1e-6)
