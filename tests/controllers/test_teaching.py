"""Self-motion of the tracking law that teaches learnt kinematics."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.controllers.test_learnt_axes import Arm

import approxjac as aj
from approxjac import law
from approxjac.codegen import compiled
from approxjac.controllers import AdaptiveKinematics, KnownKinematics, TrackingGains
from approxjac.scenario import Scenario, build_scenario, recommended
from approxjac.simulation import Sensing

TEACH, DT = TrackingGains(self_motion="teach"), 2e-3


def motion(ratio=0.05, size=0.15):
    """A self-motion of three joints within ± 2 rad."""
    ones = np.ones(3)
    stops = law.StopZones.of(-2.0 * ones, 2.0 * ones, 0.5 * ones, 0.1 * ones)
    omega, phase = np.array([0.3, 0.5, 0.9]), np.array([0.0, 2.0, 4.0])
    return law.TeachingMotion(size, omega, phase, stops, ones, ratio, 1e-3)


def moved(teaching, seconds, memory=None, **given):
    """The self-motion after a time, and how it changed from step to step."""
    usual = {"J": np.eye(3)[:2], "motion": np.zeros(3), "v": np.zeros(3), "rests": False}
    memory, rows, rates = np.zeros(4) if memory is None else memory, [], []
    for _ in range(round(seconds / teaching.dt)):
        memory, rate = teaching.step(memory, *(usual | given).values())
        rows.append(memory[1:])
        rates.append(rate)
    return memory, np.array(rows), np.array(rates)


def test_its_rate_is_that_of_its_speed_and_it_goes_to_and_fro():
    memory, n, rate = moved(motion(), 60.0)
    assert_allclose(np.diff(n, axis=0) / 1e-3, rate[1:], atol=1e-12)
    assert (n.max(axis=0) > 0.1).all()
    assert (n.min(axis=0) < -0.1).all()
    assert np.abs(n).max() <= 0.15
    assert memory[0] == pytest.approx(60.0)


@pytest.mark.parametrize(
    "given",
    [
        {"rests": True},
        {"v": np.array([0.0, -0.9, 0.0])},
        {"J": np.array([[1.0, 0.0, 0.0], [1.0, 0.05, 0.0]])},
    ],
)
def test_it_ends_at_rest_at_full_speed_and_where_the_arm_is_singular(given):
    before, *_ = moved(motion(), 5.0)
    after, n, _ = moved(motion(), 3.0, before, **given)
    assert np.abs(before[1:]).max() > 0.05
    assert np.abs(after[1:]).max() < 1e-4
    assert (np.abs(n) <= np.abs(before[1:]) + 1e-12).all()


def test_a_joint_before_its_stop_goes_back_only():
    near = {"motion": np.array([1.8, -1.8, 0.0])}
    _, n, _ = moved(motion(), 40.0, **near)
    assert n[:, 0].max() < 1e-9
    assert n[:, 1].min() > -1e-9
    assert n[:, 0].min() < -0.1
    assert n[:, 1].max() > 0.1
    assert n[:, 2].min() < -0.1 < 0.1 < n[:, 2].max()


def test_what_it_is_not_for_is_refused():
    task = aj.PositionTask(aj.load_robot("panda"))
    with pytest.raises(aj.errors.InvalidInputError, match="self_motion"):
        aj.TrackingController(task, kinematics=KnownKinematics(task), gains=TEACH)
    pose = aj.PoseTask(aj.load_robot("ur5"))
    learns = AdaptiveKinematics(pose, ("tool",))
    with pytest.raises(aj.errors.InvalidInputError, match="more joints than task"):
        aj.TrackingController(pose, kinematics=learns, gains=TEACH)
    with pytest.raises(aj.errors.InvalidInputError, match="self_motion"):
        TrackingGains(self_motion="teaches")


@pytest.mark.parametrize("command", ["torque", pytest.param("velocity", marks=pytest.mark.study)])
def test_compiled_it_is_the_same_and_it_moves_no_tip(command):
    arm = aj.load_robot("panda")
    task = aj.PositionTask(arm)
    circle = aj.Circle(task.value(aj.Plant(arm).ready_configuration()), 0.05, 4.0)
    runs = []
    for gains, of in ((TEACH, compiled), (TEACH, lambda each: each), (None, lambda each: each)):
        kinematics = AdaptiveKinematics(task, ("tool",), noise=1e-4, dt=DT)
        law_ = aj.TrackingController(
            task, kinematics=kinematics, gains=gains, command=command, dt=DT
        )
        servo = aj.simulation.VelocityServo(0.01) if command == "velocity" else None
        plant = aj.Plant(arm, sensing=Sensing(x_rate=50.0), servo=servo)
        runs.append(aj.simulate(plant, of(law_), circle, duration=2.0, dt=DT))
    assert_allclose(runs[0].q, runs[1].q, atol=1e-7)
    assert np.abs(runs[1].q - runs[2].q).max() > 0.03
    late = runs[1].t > 1.0
    assert runs[1].error_norm[late].max() < 1.5 * runs[2].error_norm[late].max() + 1e-3


def test_a_servo_is_sent_ahead_by_how_the_taught_motion_changes(panda):
    """Of joints that follow it exactly: L̂ times the rate of q̇_r, by differences."""
    task, dt, lag = aj.PositionTask(panda), 1e-4, 1e-4
    kinematics = AdaptiveKinematics(task, ("tool",), noise=1e-4, dt=dt)
    law_ = aj.TrackingController(
        task, kinematics=kinematics, gains=TEACH, command="velocity", dt=dt
    ).guarded(None)
    circle = aj.Circle(task.value(q := np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])), 0.05, 4.0)
    v, state, references, ahead = np.zeros(7), None, [], []
    for k in range(40):
        now = aj.Measurement(k * dt, q, v, task.value(q), k * dt)
        state = law_.initial_state(now) if state is None else state
        state[0], state[law_._end : law_._end + 7] = lag, v  # it may go on from here
        state, answer = law_.step(state, now, circle.at(k * dt), dt)
        v = answer.reference
        q = q + dt * v
        references.append(v)
        ahead.append((answer.torque - v) / lag)
    rate, found = np.diff(references[10:], axis=0) / dt, np.array(ahead[10:-1])
    assert np.abs(rate).max() > 0.1
    assert_allclose(found, rate, atol=0.02 * np.abs(rate).max())


def test_the_last_encoder_is_no_news_beside_a_tool():
    """It only turns the tool: of that no motion tells, and the covariance says so."""
    arm = Arm("panda", 91)
    kinematics = AdaptiveKinematics(arm.believed, ("tool", "origins", "axes"), noise=1e-3, dt=4e-3)
    state = arm.followed(kinematics, 15.0)
    report = kinematics.report(state)
    at = [kinematics.names.index(f"tool.{axis}") for axis in "xyz"]
    last = kinematics.names.index(f"{arm.believed.joint_names[6]}.encoder")
    assert abs(report.rows[last].share) < 1e-9
    axis, tool = np.array([0.0, 0.0, 1.0]), kinematics.learnt(state)[at]
    turned = np.cross(axis, tool)
    way = turned / np.linalg.norm(turned)
    sd = np.sqrt(way @ report.covariance[np.ix_(at, at)] @ way)
    assert sd >= 0.015 * np.linalg.norm(turned)


def test_a_scenario_has_it():
    scenario = recommended(Scenario("panda", controller={"self_motion": "teach"}))
    n, plain = (
        build_scenario(each).law.n_state for each in (scenario, recommended(Scenario("panda")))
    )
    assert n == plain + 8
    with pytest.raises(aj.errors.InvalidInputError, match="self_motion"):
        build_scenario(Scenario("panda", controller={"law": "setpoint", "self_motion": "teach"}))
