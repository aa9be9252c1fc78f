"""The same arms and the same controllers in MuJoCo, an engine that no one here wrote."""

import copy
import pickle
import sys

import mujoco
import numpy as np
import pytest
from arms import FEW
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.controllers import RegressorGravity
from approxjac.errors import MissingPackageError, UrdfError
from approxjac.robots import Drives, Dynamics, GravityRegressor
from approxjac.simulation.plant import semi_implicit_euler

Q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
ARM = aj.load_robot("panda")
TRUTH = ARM.with_object(length=0.20, mass=0.5)
BELIEF = ARM.with_object(length=0.0, mass=0.0)
SENSOR = aj.PositionTask(TRUTH)
X0 = SENSOR.value(Q0)
TASK = aj.PositionTask(BELIEF)
GAINS = aj.Gains(kp=400.0, kv=80.0, damping=1.0)
REGRESSOR = GravityRegressor(TASK.robot)
THETA, _ = REGRESSOR.fit(TRUTH)
LAWS = {
    "law (6)": aj.SetpointController(TASK, GAINS, gravity=RegressorGravity(REGRESSOR, THETA)),
    "adaptive": aj.SetpointController(
        TASK, GAINS, gravity=aj.AdaptiveGravity(GravityRegressor(BELIEF), L=0.5, alpha=2.0)
    ),
}


@pytest.fixture(autouse=True)
def _log_elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log


@pytest.fixture(
    params=[
        pytest.param(k, marks=pytest.mark.study if k == "law (6)" else []) for k in sorted(LAWS)
    ]
)
def controller(request):
    return LAWS[request.param]


@pytest.fixture(scope="module")
def above_floor():
    return aj.MujocoPlant(TRUTH, SENSOR, floor=0.0)


class ThereAndBack:
    """A target that from some time on is another one."""

    def __init__(self, first, then, t):
        self.first, self.then, self.t = np.array(first), np.array(then), t

    def at(self, t):
        return aj.Target(self.first if t < self.t else self.then)


def plants(robot, friction=0.0):
    task = aj.PositionTask(robot, axes="xz" if robot.nv == 2 else "xyz")
    return aj.Plant(robot, task, friction), aj.MujocoPlant(robot, task, friction)


def random_state(robot, rng):
    q = robot.random_configuration(rng)
    return q, rng.normal(size=robot.nv), rng.normal(scale=20.0, size=robot.nv)


def assert_same_accelerations(robot, rng, friction=0.3):
    ours, theirs = plants(robot, friction)
    for _ in range(50):
        q, v, tau = random_state(robot, rng)
        wanted = ours.acceleration(q, v, tau)
        difference = np.abs(theirs.acceleration(q, v, tau) - wanted).max()
        assert difference <= 1e-9 * np.abs(wanted).max()


def test_springs_that_a_run_left_bent_are_in_nobodys_way():
    """Where an arm is free of contact does not depend on what was simulated before."""
    arm = aj.load_robot("ur3")
    plant = aj.MujocoPlant(arm, floor=0.0, drives=Drives(0.02, 300.0))
    ready, still = plant.ready_configuration(), np.zeros(arm.nv)
    motors = plant.motors_at(ready)
    bent = motors._replace(twist=np.array([0.0, 2.0, 1.5, 1.0, 0.0, 0.0]))
    plant.advance(ready, still, still, 1e-3, semi_implicit_euler, bent)
    assert_array_equal(plant.ready_configuration(), ready)


# -- accelerations ----------------------------------------------------------------------


@pytest.mark.parametrize("arm", FEW, indirect=True)
def test_accelerations_are_pinocchios_for_every_named_arm(arm, rng):
    """MuJoCo opens all of them."""
    assert_same_accelerations(arm, rng)


@pytest.mark.parametrize("arm", FEW, indirect=True)
@pytest.mark.parametrize("mass", [pytest.param(0.0, marks=pytest.mark.study), 0.5])
def test_accelerations_with_an_object(arm, mass, rng):
    assert_same_accelerations(arm.with_object(0.2, mass, axis=(1.0, -2.0, 0.5)), rng)


def test_accelerations_under_a_slanted_gravity(rng):
    assert_same_accelerations(aj.load_robot("panda").with_gravity((1.0, -2.0, 3.0)), rng)


def test_mimic_joints_that_move_are_refused():
    robot = aj.load_robot("panda", free="panda_finger_joint1")
    with pytest.raises(aj.InvalidInputError, match="must have no mimic joints that move"):
        aj.MujocoPlant(robot, aj.PositionTask(robot))


INERTIAL = """<inertial><origin xyz="0.1 0.2 0.3"/><mass value="1"/>
  <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>"""
AWKWARD = f"""
<robot name="awkward">
  <mujoco>
    <compiler fusestatic="true" boundmass="5" boundinertia="5" settotalmass="9"/>
    <option density="1000" viscosity="1" gravity="0 0 3"/>
  </mujoco>
  <link name="base"/>
  <link name="a">{INERTIAL}</link>
  <link name="b">{INERTIAL}</link>
  <link name="shape"><collision><geometry><box size="1 1 1"/></geometry></collision></link>
  <joint name="z" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 3 0"/>
    <dynamics damping="3" friction="3"/></joint>
  <joint name="y" type="prismatic"><parent link="base"/><child link="b"/><axis xyz="1 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="fixed" type="fixed"><parent link="b"/><child link="shape"/></joint>
</robot>"""


def test_what_a_urdf_tells_mujoco_only_does_not_make_it_another_arm(rng):
    """Damping, invented masses, a fluid, another order of joints."""
    robot = aj.load_robot(AWKWARD, tip="shape", free="all")
    _, plant = plants(robot)
    model = plant.mujoco_model
    assert [model.joint(i).name for i in range(2)] == ["z", "y"]
    assert robot.joint_names == ("y", "z")
    assert_same_accelerations(robot, rng)


def test_the_same_inputs_give_the_same_bits_whatever_came_before(above_floor, rng):
    states = [random_state(TRUTH, rng) for _ in range(20)]
    states[0] = (Q0 + [0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0], np.ones(7), np.zeros(7))
    first = [above_floor.acceleration(*state) for state in states]
    assert (touching(above_floor, [state[0] for state in states]) < 0.0).any()
    again = [above_floor.acceleration(*state) for state in reversed(states)]
    assert_array_equal(first, again[::-1])
    fresh = aj.MujocoPlant(TRUTH, SENSOR, floor=0.0)
    assert_array_equal(fresh.acceleration(*states[0]), first[0])


# -- closed loop ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "integrator", [pytest.param("rk4", marks=pytest.mark.study), "semi_implicit_euler"]
)
def test_closed_loops_agree_to_1e_12(controller, integrator):
    arguments = (X0 + [0.10, -0.15, 0.16], Q0, 2.0)
    ours, theirs = (
        aj.simulate(
            plant(TRUTH, SENSOR, 0.1),
            controller,
            *arguments,
            dt=1e-3,
            computation=aj.simulation.Computation(integrator),
        )
        for plant in (aj.Plant, aj.MujocoPlant)
    )
    for name in ("q", "v", "x", "state"):
        difference = np.abs(getattr(ours, name) - getattr(theirs, name))
        assert difference.max(initial=0.0) < 1e-12
    assert np.abs(ours.tau - theirs.tau).max() < 1e-10


def test_the_continuous_closed_loop_agrees_to_1e_7():
    arguments = (LAWS["law (6)"], X0 + [0.10, -0.15, 0.16], Q0, 2.0)
    ours = aj.simulate(aj.Plant(TRUTH, SENSOR), *arguments, dt=None)
    theirs = aj.simulate(aj.MujocoPlant(TRUTH, SENSOR), *arguments, dt=None)
    assert np.abs(ours.q - theirs.q).max() < 1e-7


def test_the_same_measurement_gives_the_same_torque(controller, rng):
    """Nothing but the measurement reaches a controller, whatever plant it comes from."""
    ours, theirs = aj.Plant(TRUTH, SENSOR), aj.MujocoPlant(TRUTH, SENSOR)
    q, v, _ = random_state(TRUTH, rng)
    state = controller.begin(ours.measure(0.0, q, v))
    answers = [controller.evaluate(state, p.measure(0.0, q, v), X0) for p in (ours, theirs)]
    assert_array_equal(answers[0].torque, answers[1].torque)
    assert_array_equal(answers[0].state_rate, answers[1].state_rate)


@pytest.mark.study
@pytest.mark.parametrize("height", [0.3, -0.05], ids=["free", "contact"])
def test_a_run_is_mujocos_own_stepping(above_floor, height):
    """`mj_step` with its Euler integrator and its warm start, under the same torques."""
    dt = 1e-3
    target = [X0[0], X0[1], height]
    run = aj.simulate(
        above_floor,
        LAWS["law (6)"],
        target,
        Q0,
        2.0,
        dt=dt,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    assert (touching(above_floor, run.q).min() < 0.0) == (height < 0.0)
    model = copy.copy(above_floor.mujoco_model)
    model.opt.timestep = dt
    model.opt.disableflags = 0
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    data = mujoco.MjData(model)
    data.qpos[:] = Q0
    q = [Q0]
    for tau in run.tau[:-1]:
        data.qfrc_applied[:] = tau
        mujoco.mj_step(model, data)
        q.append(data.qpos.copy())
    assert np.abs(run.q - q).max() < 1e-10


# -- joint limits -----------------------------------------------------------------------


def beyond_limits(run):
    """How far each joint is beyond its limit, shape (N, n_v) [rad]."""
    lower, upper = TRUTH.position_limits
    return np.maximum(run.q - upper, lower - run.q)


def pressed(plant, controller, target, duration=10.0, back=X0, dt=2e-3):
    """Four seconds towards a target, then back."""
    path = ThereAndBack(target, back, 4.0)
    return aj.simulate(
        plant,
        controller,
        path,
        Q0,
        duration,
        dt=dt,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )


@pytest.mark.study
@pytest.mark.parametrize("target", [(-0.6, 0.0, 0.4)])
def test_joint_limits_hold_and_the_controller_recovers(target):
    without = aj.Plant(TRUTH, SENSOR, 0.1, joint_limits=False)
    free = pressed(without, LAWS["law (6)"], target)
    assert beyond_limits(free).max() > 1.0
    run = pressed(aj.MujocoPlant(TRUTH, SENSOR, 0.1), LAWS["law (6)"], target)
    beyond = beyond_limits(run)
    assert beyond.max() > 0.0
    # a joint that hits its limit goes on for less than 10 ms of its speed
    assert (beyond.max(axis=0) < 0.01 * np.abs(run.v).max(axis=0)).all()
    assert np.abs(run.tau).max() < 250.0
    assert np.linalg.norm(run.x[-1] - X0) < 1e-3
    unlimited = aj.MujocoPlant(TRUTH, SENSOR, 0.1, joint_limits=False)
    assert (
        np.abs(pressed(unlimited, LAWS["law (6)"], target, 5.0).q[:500] - free.q[:500]).max() < 1e-6
    )


@pytest.mark.parametrize("kind", [aj.Plant, aj.MujocoPlant])
@pytest.mark.parametrize("end", [0, 1])
def test_limits_are_those_of_links_and_motors_turn_on(kind, end):
    """By the twist of the gear, τ/K, while a motor pushes its link against the limit."""
    push = (2 * end - 1) * 30.0 * np.eye(7)[0]
    plant = kind(ARM, friction=2.0, drives=Drives(0.2, 200.0, 0.3))
    limit, q = ARM.position_limits[end][0], Q0.copy()
    q[0] = limit - 0.01 * np.sign(push[0])
    v, motors = np.zeros(7), plant.motors_at(q)
    for _ in range(500):
        command = plant.dynamics.g(q) + push
        q, v, motors = plant.advance(q, v, command, 2e-3, semi_implicit_euler, motors)
    assert_allclose(q[0], limit, atol=0.02)
    assert_allclose(motors.twist[0], push[0] / 200.0, atol=0.005)
    assert_allclose(v[0], 0.0, atol=1e-3)


@pytest.mark.long
def test_it_comes_back_from_the_limits_it_is_driven_against_by_random_targets():
    plant = aj.MujocoPlant(TRUTH, SENSOR, 0.1)
    rng = np.random.default_rng(5)
    hits = 0
    for _ in range(8):
        way = rng.normal(size=3) * [1.0, 1.0, 0.0] + [0.0, 0.0, abs(rng.normal())]
        target = [0.0, 0.0, 0.333] + rng.uniform(0.3, 1.4) * way / np.linalg.norm(way)
        run = pressed(plant, LAWS["law (6)"], target, 20.0, dt=4e-3)
        hits += beyond_limits(run).max() > 0.0
        assert beyond_limits(run).max() < 0.12
        assert np.linalg.norm(run.x[2500] - X0) < 0.05  # 6 s after
        assert np.linalg.norm(run.x[-1] - X0) < 1e-6  # 16 s after
    assert hits >= 3


@pytest.mark.study
def test_a_limit_may_hold_the_arm_up_for_long():
    """The law knows of no limits: it slides along this one, and is late."""
    target, back = (1.3, 0.1, 0.5), X0 + 0.05
    without = aj.Plant(TRUTH, SENSOR, 0.1, joint_limits=False)
    free = pressed(without, LAWS["law (6)"], target, back=back)
    assert np.linalg.norm(free.x[-1] - back) < 1e-6
    run = pressed(aj.MujocoPlant(TRUTH, SENSOR, 0.1), LAWS["law (6)"], target, 20.0, back)
    assert np.linalg.norm(run.x[5000] - back) > 0.1  # at 10 s
    assert 0.0 < beyond_limits(run)[run.t > 9.0].max() < 0.02
    assert np.linalg.norm(run.x[-1] - back) < 1e-5


# -- floor ------------------------------------------------------------------------------


def touching(plant, configurations):
    """Distance of the deepest contact at each configuration, negative inside, 0 without [m]."""
    data = mujoco.MjData(plant.mujoco_model)
    deepest = []
    for q in configurations:
        data.qpos[:] = q
        mujoco.mj_forward(plant.mujoco_model, data)
        deepest.append(min((contact.dist for contact in data.contact), default=0.0))
    return np.array(deepest)


@pytest.mark.study
def test_a_target_under_the_floor(above_floor, controller):
    depth = 0.05
    low = np.array([X0[0], X0[1], -depth])
    run = pressed(above_floor, controller, low, 14.0)
    down = (run.t > 3.0) & (run.t < 4.0)
    deepest = touching(above_floor, run.q[run.t < 4.5])  # it has left by then
    assert deepest[-1] == 0.0
    assert (deepest[down[: len(deepest)]] < 0.0).all()  # it presses on the floor ...
    assert deepest[down[: len(deepest)]].min() > -2e-3  # ... and sinks in by less than 2 mm,
    assert deepest.min() > -5e-3  # less than 5 mm when it hits it
    assert run.x[:, 2].min() > -2e-3
    free = aj.simulate(aj.Plant(TRUTH, SENSOR), controller, low, Q0, 4.0, dt=2e-3)
    assert free.x[-1, 2] < -0.9 * depth
    assert np.abs(run.tau).max() < 150.0
    assert np.linalg.norm(run.x[-1] - X0) < 1e-5


def test_the_torque_on_the_floor_is_that_of_the_error(above_floor):
    """At rest on the floor nothing but Ĵᵀ kp e is added to gravity: no more than kp a metre."""
    controller = LAWS["law (6)"]
    run = pressed(above_floor, controller, [X0[0], X0[1], -0.05], 4.0)
    q, v = run.q[-2], run.v[-2]
    pressing = run.tau[-2] - Dynamics(TRUTH).g(q)
    sigma = np.linalg.svd(TASK.jacobian(q), compute_uv=False)[0]
    assert np.linalg.norm(v) < 0.2
    assert np.linalg.norm(pressing) < sigma * (400.0 * run.error_norm[-2] + 80.0 * 0.2) + 0.2


def test_an_arm_without_a_floor_touches_nothing(rng):
    plant = aj.MujocoPlant(TRUTH, SENSOR)
    configurations = [TRUTH.random_configuration(rng) for _ in range(100)]
    assert_array_equal(touching(plant, configurations), 0.0)


# -- what it says -----------------------------------------------------------------------


def test_repr(above_floor):
    text = repr(above_floor)
    assert text.startswith("MujocoPlant('panda', PositionTask('panda'")
    assert text.endswith(", floor=0)")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"floor": np.nan}, r"floor must be a finite number \[m\], got nan"),
        ({"floor": "low"}, r"floor must be a finite number \[m\], got 'low'"),
        ({"joint_limits": 1}, "joint_limits must be True or False, got 1"),
    ],
)
def test_bad_options_are_refused(options, text):
    with pytest.raises(aj.InvalidInputError, match=text):
        aj.MujocoPlant(TRUTH, SENSOR, **options)


def test_a_collision_mesh_that_is_missing():
    mesh = '<collision><geometry><mesh filename="package://none/a.stl"/></geometry></collision>'
    urdf = aj.load_robot("two_link").urdf.replace(
        '<link name="link1">', f'<link name="link1">{mesh}'
    )
    with pytest.raises(
        UrdfError,
        match=r"^MuJoCo cannot open the URDF of two_link: .*a\.stl.*; it needs every collision",
    ) as caught:
        plants(aj.load_robot(urdf))
    assert "\n" not in str(caught.value)


def test_without_mujoco(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(
        MissingPackageError,
        match=r"MujocoPlant needs mujoco, .*: pip install 'approxjac\[mujoco\]'$",
    ):
        aj.MujocoPlant(TRUTH, SENSOR)


def test_the_ready_configuration_is_above_the_floor():
    """UR5's, without a floor, has its tip 10 cm below 0."""
    truth = aj.load_robot("ur5").with_object(0.2, 0.5, axis="x")
    anywhere, above = aj.MujocoPlant(truth), aj.MujocoPlant(truth, floor=0.0)
    assert not above._is_free(anywhere.ready_configuration())
    q = above.ready_configuration()
    assert above._is_free(q)
    rest = np.zeros(6)
    free = anywhere.acceleration(q, rest, rest)
    np.testing.assert_allclose(above.acceleration(q, rest, rest), free, rtol=1e-9)


# -- inertias that no body has --------------------------------------------------------------


def with_inertia(iz):
    """A pendulum whose moments about x and y are 0.1 kg m²."""
    return aj.load_robot(
        f"""<robot name="pendulum"><link name="base"/><link name="bob"><inertial>
        <origin xyz="0.5 0 0"/><mass value="2"/><inertia ixx="0.1" iyy="0.1" izz="{iz}" ixy="0"
        ixz="0" iyz="0"/></inertial></link><joint name="turn" type="continuous">
        <parent link="base"/><child link="bob"/><axis xyz="0 1 0"/></joint></robot>"""
    )


def test_inertias_that_no_body_has_are_refused_by_name():
    with pytest.raises(UrdfError, match=r"cannot open the URDF of pendulum: .*bob.* that a body"):
        aj.MujocoPlant(with_inertia(0.5))
    assert aj.MujocoPlant(with_inertia(0.15)).mujoco_model.body("bob").inertia[0] == 0.15


# -- copies -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "copied", [copy.copy, copy.deepcopy, lambda plant: pickle.loads(pickle.dumps(plant))]
)
def test_copies_move_alike_and_share_no_scratch_memory(copied):
    plant = aj.MujocoPlant(TRUTH, SENSOR, 0.3, floor=0.1)
    v, tau = np.ones(7), np.arange(7.0)
    expected = plant.acceleration(Q0, v, tau)
    other = copied(plant)
    assert repr(other) == repr(plant)
    other.acceleration(Q0 + 0.1, 5.0 * v, tau)
    assert_array_equal(plant.acceleration(Q0, v, tau), expected)
    assert_array_equal(other.acceleration(Q0, v, tau), expected)
    assert other._mujoco_data is not plant._mujoco_data
