"""Runs with `TorqueLimited`: rates, speeds and joint limits are kept from step to step."""

from dataclasses import replace

import numpy as np
import pytest
from arms import among, light_wristed

import approxjac as aj
from approxjac.controllers import RegressorGravity
from approxjac.robots import Dynamics, GravityRegressor
from approxjac.scenario import build_scenario, recommended, run_scenario
from approxjac.scenario.starts import regular_configuration

DT = 1e-3


def law_of(robot, gravity=None):
    task = aj.PositionTask(robot)
    return aj.SetpointController(task, aj.default_gains(task), gravity=gravity)


def test_the_rate_is_kept_over_a_run(panda):
    truth = panda.with_object(0.2, 0.5, axis="x")
    limits = aj.Limits(effort=0.6 * panda.effort_limits, rate=500.0)
    limited = aj.TorqueLimited(law_of(panda.with_object(0.0)), limits)
    plant = aj.Plant(truth, sensor=aj.PositionTask(truth))
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    x_d = plant.sensor.value(q0) + [0.1, -0.2, 0.2]
    run = aj.simulate(
        plant,
        limited,
        x_d,
        q0,
        1.0,
        dt=DT,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    assert np.abs(np.diff(run.tau, axis=0)).max() <= 500.0 * DT + 1e-9
    assert np.abs(np.diff(run.tau, axis=0)).max() > 0.99 * 500.0 * DT
    hold = Dynamics(panda).g(q0)
    assert (np.abs(run.tau[0] - hold) <= 500.0 * DT + 1e-9).all()
    assert run.error_norm[-1] < 0.5 * run.error_norm[0]


@pytest.mark.parametrize("targets", [1, pytest.param(3, marks=pytest.mark.study)])
def test_speeds_stay_within_their_limits_where_the_model_is_exact(panda, targets):
    """With enough torque and the true dynamics, the next step is what the rows predict."""
    limits = aj.Limits(velocity=0.5, position=panda.position_limits)
    limited = aj.TorqueLimited(law_of(panda), limits)
    plant = aj.Plant(panda, sensor=aj.PositionTask(panda))
    rng = np.random.default_rng(3)
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    for _ in range(targets):
        x_d = plant.sensor.value(q0) + rng.uniform(-0.4, 0.4, 3)
        run = aj.simulate(
            plant,
            limited,
            x_d,
            q0,
            1.5,
            dt=DT,
            computation=aj.simulation.Computation("semi_implicit_euler"),
        )
        assert np.abs(run.v).max() < 0.5 * (1.0 + 1e-6)
        assert np.abs(run.v).max() > 0.45
        low, high = panda.position_limits
        assert ((low - 1e-9 <= run.q) & (run.q <= high + 1e-9)).all()


# -- joint limits -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "tool",
    [pytest.param(0.0, id="exact", marks=pytest.mark.study), pytest.param(0.2, id="unknown")],
)
def test_a_joint_driven_into_its_limit_stops_at_it_without_chatter(panda, tool):
    truth = panda.with_object(tool, 2.5 * tool, axis="x")
    belief = panda.with_object(0.0)
    regressor = GravityRegressor(belief)
    theta = regressor.fit(truth)[0]
    plant = aj.Plant(truth, sensor=aj.PositionTask(truth))
    limited = aj.TorqueLimited(law_of(belief, RegressorGravity(regressor, theta)))
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    run = aj.simulate(
        plant,
        limited,
        [0.0, -0.1, -0.5],
        q0,
        4.0,
        dt=DT,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    low, high = panda.position_limits
    room = np.minimum(run.q - low, high - run.q)
    pressing = room[-1] < 1e-3
    assert pressing.any()
    assert room.min() > -1e-3  # it never went through its limit
    last = slice(-1000, None)
    assert np.abs(run.v[last][:, pressing]).max() < 1e-3  # it stands there
    steps = np.abs(np.diff(run.tau[last][:, pressing], axis=0)).max()
    assert steps < 1e-2  # and its torque does not chatter [N m a step]
    assert np.abs(run.tau[last][:, pressing]).max() > 0.1


def test_a_joint_beyond_its_limit_comes_back(panda):
    _, high = panda.position_limits
    limited = aj.TorqueLimited(law_of(panda))
    plant = aj.Plant(panda, sensor=aj.PositionTask(panda))
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    q0[3] = high[3] + 0.2
    x_d = plant.sensor.value(q0)  # the law itself would stay
    run = aj.simulate(
        plant,
        limited,
        x_d,
        q0,
        1.0,
        dt=DT,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    assert run.q[-1, 3] <= high[3] + 1e-3


@pytest.mark.study
@pytest.mark.parametrize(("joint", "beyond"), [(1, 0.5), (5, 1.5)])
def test_a_joint_far_beyond_its_limit_comes_back_no_faster_than_it_may(panda, joint, beyond):
    _, high = panda.position_limits
    limited = aj.TorqueLimited(law_of(panda))
    plant = aj.Plant(panda, sensor=aj.PositionTask(panda), joint_limits=False)
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    q0[joint] = high[joint] + beyond
    x_d = plant.sensor.value(q0)
    run = aj.simulate(
        plant,
        limited,
        x_d,
        q0,
        1.5,
        dt=DT,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    assert run.q[-1, joint] <= high[joint] + 1e-3
    assert (np.abs(run.v) / panda.velocity_limits).max() <= 1.0 + 1e-6


@pytest.mark.parametrize(
    ("rate", "offset"),
    [
        (100.0, (-0.3, 0.5, -0.2)),
        pytest.param(300.0, (-0.55, -0.1, -1.0), marks=pytest.mark.study),
    ],
)
def test_rates_and_joint_limits_go_together(panda, rate, offset):
    """With torques that change slowly, joints are braked in time: no way of no return."""
    limited = aj.TorqueLimited(law_of(panda), replace(aj.Limits.of(panda), rate=rate))
    plant = aj.Plant(panda, sensor=aj.PositionTask(panda))
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    x_d = plant.sensor.value(q0) + offset
    run = aj.simulate(
        plant,
        limited,
        x_d,
        q0,
        3.0,
        dt=DT,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    assert np.abs(np.diff(run.tau, axis=0)).max() <= rate * DT + 1e-9
    assert (np.abs(run.v) / panda.velocity_limits).max() < 1.5
    low, high = panda.position_limits
    assert ((low - 1e-6 <= run.q) & (run.q <= high + 1e-6)).all()
    assert np.abs(run.v[-1]).max() < 0.3
    assert run.limit_status_counts().get(aj.LimitStatus.INFEASIBLE, 0) < 300


def alternating(tau, effort):
    """In how many steps a torque turns back, by more than 1 % of its limit."""
    steps = np.diff(tau, axis=0)
    back = (steps[1:] * steps[:-1] < 0.0) & (np.abs(steps[1:]) > 0.01 * effort)
    return int(back.any(axis=1).sum())


@pytest.mark.parametrize(
    "name",
    among("panda", "z1", "talos_arm"),
)
@pytest.mark.study
@pytest.mark.parametrize("tool", [0.0, 0.1], ids=["exact", "unknown"])
def test_a_target_far_out_of_reach_makes_no_torque_chatter(name, tool):
    robot = aj.load_robot(name)
    truth, belief = robot.with_object(tool, 2.0 * tool, axis="x"), robot.with_object(0.0)
    plant = aj.Plant(truth, sensor=aj.PositionTask(truth))
    limited = aj.TorqueLimited(law_of(belief))
    q0 = robot.random_configuration(np.random.default_rng(3))
    x_d = 2.5 * plant.sensor.value(q0)
    run = aj.simulate(
        plant,
        limited,
        x_d,
        q0,
        1.2,
        dt=DT,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    given_up = run.limit_status == aj.LimitStatus.PROOF_GIVEN_UP
    assert given_up.any()
    assert alternating(run.tau[-500:], robot.effort_limits) == 0
    assert np.linalg.norm(run.v[-1]) < 2.5


def test_a_run_needs_the_limiters_own_dt(panda):
    limited = aj.TorqueLimited(law_of(panda))
    plant = aj.Plant(panda, sensor=aj.PositionTask(panda))
    q0 = panda.neutral() + [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]
    for dt in (None, 2e-3):
        with pytest.raises(
            aj.InvalidInputError, match=r"dt must be that of the controller, 0\.001"
        ):
            aj.simulate(plant, limited, plant.sensor.value(q0), q0, 0.1, dt=dt)


@pytest.fixture(scope="module")
def light_wrist(tmp_path_factory):
    """A UR5 with the wrist's inertia of a real one."""
    path = light_wristed(tmp_path_factory.mktemp("arms"))
    return aj.load_robot(path, tip="tool0")


LAWS = {
    "setpoint": lambda task: aj.SetpointController(task, gravity=aj.AdaptiveGravity(task.robot)),
    "tracking": aj.TrackingController,
}


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    ("seed", "mass", "axis"),
    [
        (2, 2.5, "x"),
        *(
            pytest.param(seed, mass, axis, marks=pytest.mark.study)
            for seed in range(30, 36)
            for mass in (0.0, 0.5, 2.5)
            for axis in "xz"
        ),
    ],
)
def test_speeds_stay_within_their_limits_with_a_payload_that_nobody_told_of(
    light_wrist, law, seed, mass, axis
):
    truth, belief = light_wrist.with_object(0.2, mass, axis=axis), light_wrist.with_object(0.0)
    sensor, rng = aj.PositionTask(truth), np.random.default_rng(seed)
    controller = aj.TorqueLimited(LAWS[law](aj.PositionTask(belief)))
    q0, goal = (regular_configuration(sensor, controller.task, rng) for _ in range(2))
    plant = aj.Plant(truth, sensor, torque_limits=truth.effort_limits)
    run = aj.simulate(
        plant, controller, sensor.value(goal), q0, 0.35, dt=DT, record_every=DT,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )  # fmt: skip
    speed = (np.abs(run.v) / truth.velocity_limits).max(axis=1)
    assert speed[run.t > 0.02].max() <= 1.05
    assert speed.max() <= 1.4  # before a torque has shown the payload


def test_speeds_stay_within_their_limits_where_gears_give_way():
    """Its gears once swung against the limiter to 1.19 times the limit."""
    given = aj.Scenario(
        "kinova",
        controller={"limits": "urdf"},
        true={"object": {"length": 0.2, "mass": 0.5}, "drives": "usual"},
        run={"start": "random", "duration": 0.6, "seed": 902},
    )
    built = build_scenario(recommended(given))
    speed = np.abs(run_scenario(built).run.v) / built.plant.robot.velocity_limits
    assert 0.9 < speed.max() <= 1.05


def test_speeds_stay_within_their_limits_where_there_are_no_gears():
    """With a lag told, rotors are taken for granted that these light joints have not."""
    belief, truth = (aj.load_robot("xarm7").with_object(*tool) for tool in ((0.0,), (0.2, 0.5)))
    sensing = aj.Sensing(x_noise=5e-4, x_rate=60.0, x_delay=0.03, velocity_filter=4e-3)
    late = aj.Latency(image_period=1 / 60, image_age=0.03, velocity_filter=4e-3)
    slow = replace(aj.Limits.of(belief), velocity=0.4 * belief.velocity_limits)
    law = aj.TrackingController(aj.PositionTask(belief), latency=late)
    plant = aj.Plant(truth, sensing=sensing, torque_limits=belief.effort_limits)
    q0 = plant.ready_configuration()
    goal = q0 + np.random.default_rng(5).uniform(-0.8, 0.8, truth.nv)
    run = aj.simulate(plant, aj.TorqueLimited(law, slow), plant.sensor.value(goal), q0, 1.0)
    assert 0.5 < (np.abs(run.v) / slow.velocity).max() <= 1.05
