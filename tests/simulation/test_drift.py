"""A slipped tool and a moved tracker are told in time, with their size; nothing else is."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac import law
from approxjac.cameras import PlanarCamera
from approxjac.controllers import AdaptiveKinematics, PredictedMeasurement
from approxjac.interface import Condition, Measurement
from approxjac.realtime import SimulatedDriver
from approxjac.robots import KinematicRegressor
from approxjac.simulation.drift import DriftWatch
from approxjac.simulation.simulate import MovingArm
from approxjac.tasks import PoseTask, PoseTrackerTask, TrackerTask

DT, RATE, NOISE, AT = 0.01, 60.0, 1e-3, 8.0
SLIP = np.array([4e-3, 2e-3, -2e-3])
TURN, SHIFT = np.array([0.01, -0.012, 0.008]), np.array([6e-3, -8e-3, 4e-3])
KINDS = ("tool", "origins"), ("tool", "origins", "camera"), ("tool", "axes", "offset")


def slipped(robot, by):
    return robot.with_kinematic_error({"object_tip_joint": list(by)})


def followed(task, unknown, after, seconds, seed=0, restarts=True):
    """Follow a motion that a sensor sees, through which something happens at AT.

    Returns what a watch says, the last state, the law, and by how much x moved.
    """
    robot, rng = task.robot, np.random.default_rng(seed)
    truth = robot.with_object(0.15, axis="y")
    kind = TrackerTask if task.m == 3 else PoseTrackerTask
    none = np.zeros(3)
    before = kind(truth, rotation=none, offset=none)
    slip, turn, shift = after
    late = kind(slipped(truth, slip), rotation=turn, offset=shift)
    controller = aj.SetpointController(task)
    if unknown is not None:
        kinematics = AdaptiveKinematics(task, unknown, noise=NOISE, dt=DT, restarts=restarts)
        controller = PredictedMeasurement(controller, kinematics)
    watch, said, q0 = DriftWatch(controller), [], aj.Plant(truth).ready_configuration()
    omega, phase = rng.uniform(0.4, 1.2, (2, robot.nv))
    state, shown, x, moved = None, -1.0, None, 0.0
    for t in DT * np.arange(round(seconds / DT)):
        angle = omega * t + 5.0 * phase
        q, v = q0 + 0.3 * (np.sin(angle) - np.sin(5.0 * phase)), 0.3 * omega * np.cos(angle)
        if t - shown >= 1.0 / RATE - 1e-9:
            shown = t
            x = (before if t < AT else late).value(q)
            x[:3] += NOISE * rng.normal(size=3)
            if t < AT + 1e-9:
                moved = np.linalg.norm((late.value(q) - before.value(q))[:3])
        seen = Measurement(t, q, v, x, shown)
        state = controller.initial_state(seen) if state is None else state
        if change := watch.look(seen, state):
            said.append(change)
        if unknown is not None:  # only the kinematics take part
            kept, (_, known) = state.copy(), controller.kinematics_of(state)
            n = controller.controller.size
            kept[n : n + len(known)] = kinematics.step(known, seen, DT)
            state = kept
    return said, state, controller, moved


def test_where_time_starts_anew_nothing_is_compared_with_what_was_before(panda):
    task = aj.PositionTask(panda)
    watch, q0 = DriftWatch(aj.SetpointController(task)), aj.Plant(panda).ready_configuration()
    for begun, seconds in ((100.0, 4.0), (0.0, 0.1)):
        for t in np.arange(0.0, seconds, 0.05):
            q, v = q0 + 0.2 * np.sin(t), np.full(7, 0.2 * np.cos(t))
            watch.look(Measurement(begun + t, q, v, task.value(q), begun + t), np.zeros(0))
        assert all(window.begun <= begun + t for window in watch._windows)
        assert bool(watch._windows) == (seconds > 2.0)


@pytest.mark.parametrize("unknown", [*KINDS, None])
def test_nothing_is_said_where_nothing_happens(panda, unknown):
    nothing = np.zeros((3, 3))
    assert followed(aj.PositionTask(panda), unknown, nothing, 14.0)[0] == []


@pytest.mark.parametrize("unknown", [*KINDS, None])
@pytest.mark.parametrize("size", [1.0, 2.0])
def test_a_slipped_tool_is_told(panda, unknown, size):
    after = size * SLIP, np.zeros(3), np.zeros(3)
    (change, *_), _, _, moved = followed(aj.PositionTask(panda), unknown, after, AT + 2.5)
    assert change.condition is not Condition.SENSOR_MOVED
    assert AT < change.named <= AT + 2.0
    assert abs(change.begin - AT) < 0.3
    assert_allclose(moved, size * np.linalg.norm(SLIP), rtol=1e-9)
    assert abs(change.size - moved) < 4.0 * change.sd < 4e-3


@pytest.mark.parametrize("unknown", [*KINDS, None])
def test_a_moved_tracker_is_told(panda, unknown):
    after = np.zeros(3), TURN, SHIFT
    (change, *_), _, _, moved = followed(aj.PositionTask(panda), unknown, after, AT + 2.5)
    assert change.condition is Condition.SENSOR_MOVED
    assert AT < change.named <= AT + 2.0
    assert abs(change.size - moved) < 4.0 * change.sd < 0.5 * moved
    if np.isfinite(change.turn):
        assert abs(change.turn - np.linalg.norm(TURN)) < 4.0 * change.turn_sd


@pytest.mark.parametrize(
    ("after", "condition"),
    [
        ((SLIP, np.zeros(3), np.zeros(3)), Condition.TOOL_SLIPPED),
        ((np.zeros(3), TURN, SHIFT), Condition.SENSOR_MOVED),
    ],
)
def test_poses_are_watched_too(panda, after, condition):
    said, *_, moved = followed(PoseTask(panda), ("tool", "origins"), after, AT + 2.5)
    assert said[0].condition in {condition, Condition.TOOL_OR_SENSOR_MOVED}
    assert abs(said[0].size - moved) < 4.0 * said[0].sd + 1e-4


@pytest.mark.parametrize("unknown", KINDS)
@pytest.mark.parametrize("kind", [TrackerTask, PoseTrackerTask])
def test_what_is_expected_of_a_frame_changes_as_the_arm_does(panda, kind, unknown):
    """By independent arms: one whose tool moved, a tracker that moved, one with other origins."""
    h, turn, offset = 1e-5, np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.4, -0.2])
    task = kind(panda, rotation=turn, offset=offset)
    kinematics = AdaptiveKinematics(task, unknown, noise=NOISE)
    q = aj.Plant(panda).ready_configuration() + 0.1
    first = Measurement(0.0, q, np.zeros(7), task.value(q), 0.0)
    looks = (sight := kinematics.expectation(kinematics.initial_state(first)).sight)(first)
    assert_allclose(looks.left, 0.0, atol=1e-12)
    regressor, R = KinematicRegressor(panda), law.rotation_exp(turn)

    def by(moved):
        after, before = (sight(first._replace(x=moved(s * h).value(q))).left for s in (1, -1))
        return (after - before) / (2.0 * h)

    def arm(i):
        def moved(step):
            theta = regressor.theta + step * np.eye(regressor.p)[i]
            return kind(regressor.robot_with(theta), rotation=turn, offset=offset)

        return moved

    def spun(way):
        robot = regressor.robot_with(regressor.theta, way)
        return kind(robot, rotation=turn, offset=offset)

    def turned(way):
        S = law.rotation_exp(way)
        return kind(panda, rotation=law.rotation_log(S @ R), offset=S @ offset)

    near = {"atol": 1e-8}
    for i, unit in enumerate(np.eye(3)):
        shift = by(lambda s, unit=unit: kind(panda, rotation=turn, offset=offset + s * unit))
        assert_allclose(shift, looks.shift[:, i], **near)
        assert_allclose(by(lambda s, unit=unit: turned(s * unit)), looks.turn[:, i], **near)
        assert_allclose(by(arm(regressor.n_lengths - 3 + i))[:3], looks.tool[:3, i], **near)
        if (name := f"panda_joint4.{'xyz'[i]}") in kinematics.names:
            column = looks.H[:, kinematics.names.index(name)]
            assert_allclose(by(arm(regressor.names.index(name))), column, **near)
        if kind is PoseTrackerTask:
            turns = by(lambda s, unit=unit: spun(s * unit))[3:]
            assert_allclose(turns, looks.tool_turn[3:, i], **near)


def test_learning_restarts_by_choice(panda):
    after, task = (4.0 * SLIP, np.zeros(3), np.zeros(3)), aj.PositionTask(panda)
    restarted = {}
    for restarts in (True, False):
        _, state, controller, _ = followed(task, KINDS[0], after, AT + 1.5, restarts=restarts)
        restarted[restarts] = controller.kinematics_learnt(state).restarts
    assert restarted[True] >= 1
    assert restarted[False] == 0
    known, anew = (
        controller.kinematics_learnt(each) for each in (state, controller.relearnt(state))
    )
    assert anew.restarts == 1
    assert_allclose([row.value for row in anew.rows], [row.value for row in known.rows])
    (tool,) = (row for row in anew.rows if row.name == "tool.x")
    assert_allclose(tool.share, 0.0, atol=1e-9)
    assert next(row for row in known.rows if row.name == "tool.x").share > 0.9


def test_a_loop_learns_anew_when_it_is_told_to(panda):
    plant = aj.Plant(panda.with_object(0.1, axis="y"))
    task = aj.PositionTask(panda)
    law_ = aj.TrackingController(task, kinematics=AdaptiveKinematics(task, KINDS[0], noise=NOISE))

    def tell(loop):
        if loop.step == 150:
            loop.relearn()

    run = aj.simulate(
        plant, law_, plant.sensor.value(plant.ready_configuration()), duration=0.3, observer=tell
    )
    assert law_.kinematics_learnt(run.state[149]).restarts == 0
    assert law_.kinematics_learnt(run.state[-1]).restarts == 1
    assert law_.kinematics_learnt(run.state[-1]).seconds < 0.2


class Slips(SimulatedDriver):
    """A robot whose tool slips."""

    after = None

    def read(self):
        if self.samples == 1250:
            self.plant = self.after
        return super().read()


@pytest.mark.study
@pytest.mark.parametrize("learns", [True, False])
def test_a_loop_on_a_robot_tells_it_and_learns_anew_on_request(panda, learns, tmp_path):
    """By a law that learns and one on the measured x."""
    truth, task = panda.with_object(0.15, 0.3, axis="x"), aj.PositionTask(panda.with_object(0.0))
    sensing = aj.Sensing(x_noise=NOISE, x_rate=RATE, x_delay=0.02)
    plant, other = (
        aj.Plant(each, aj.PositionTask(each), sensing=sensing)
        for each in (truth, slipped(truth, 2.0 * SLIP))
    )
    gravity, late = aj.AdaptiveGravity(task.robot), aj.Latency(period=4e-3)
    controller = aj.SetpointController(task, gravity=gravity, latency=late)
    if learns:
        kinematics = AdaptiveKinematics(
            task, KINDS[0], noise=NOISE, delay=0.02, dt=4e-3, restarts=False
        )
        controller = aj.TrackingController(task, kinematics=kinematics, dt=4e-3)
    controller = aj.TorqueLimited(controller, aj.Limits(effort=panda.effort_limits))
    driver = Slips(plant, dt=4e-3, pace=np.inf)
    driver.after = other
    x0, seen = plant.sensor.value(plant.ready_configuration()), []

    kinds = {Condition.TOOL_SLIPPED, Condition.TOOL_OR_SENSOR_MOVED}

    def look(loop):
        told = [each for each in loop.events if each.condition in kinds]
        if told and learns and not seen:
            seen.append(told[0])
            loop.relearn()

    slow = aj.realtime.Tolerances(max_period=2.0)  # a busy machine is no fault here
    path = aj.Circle(x0 + [0.0, 0.05, 0.0], 0.06, 4.0)
    run = aj.control(driver, controller, path, 7.5, tolerances=slow, observer=look)
    assert run.fault is None
    (event,) = (each for each in run.events if each.condition in kinds)
    assert 5.0 < event.named <= 7.0
    assert event.begin == pytest.approx(5.0, abs=0.3)
    told = float(event.figure.split()[0])
    assert told == pytest.approx(2e3 * np.linalg.norm(SLIP), abs=2.0)
    assert Condition.SENSOR_MOVED not in {each.condition for each in run.events}
    page = aj.view.save_page(run, tmp_path / "run.html").read_text(encoding="utf-8")
    assert event.condition.label in page
    if learns:
        assert seen[0] == event
        assert controller.kinematics_learnt(run.state[-1]).restarts == 1


@pytest.mark.study
def test_a_tool_that_slips_before_a_planar_camera_is_told():
    """Its roll is wrong, and the law on the measured image does not learn it."""
    arm = aj.load_robot("two_link")
    truth, camera = arm.with_object(0.3, 0.5, axis="x"), PlanarCamera(0.05, 3.0, 0.3)
    sensing = aj.Sensing(x_noise=1e-5, x_rate=RATE, x_delay=0.02)
    plant, other = (
        aj.Plant(each, aj.ImageTask(each, camera), sensing=sensing)
        for each in (truth, truth.with_kinematic_error({"object_tip_joint": [0.012, 0.0, -0.009]}))
    )
    task = aj.ImageTask(arm.with_object(0.0), PlanarCamera(0.05, 3.0, 0.1))
    late, gravity = aj.Latency(period=2e-3, image_period=1 / RATE), aj.AdaptiveGravity(task.robot)
    controller = aj.SetpointController(task, gravity=gravity, latency=late)
    moving = MovingArm(plant, np.array([0.5, 1.2]), np.zeros(2), 2e-3, "semi_implicit_euler", 0)
    seen, watch, said = moving.sense()[1], DriftWatch(controller), []
    path, state = aj.Circle(seen.x + [0.0, 2e-3], 3e-3, 4.0), controller.initial_state(seen)
    for k in range(round((AT + 2.0) / 2e-3)):
        if k == round(AT / 2e-3):
            moving.plant = other
        if change := watch.look(seen, state):
            said.append(change)
        state, answer = controller.step(state, seen, path.at(k * 2e-3), 2e-3)
        moving.move(moving.take(answer.torque))
        seen = moving.sense()[1]
    (change,) = said
    assert change.condition is not Condition.SENSOR_MOVED
    assert change.size == pytest.approx(0.015, abs=2e-3)
