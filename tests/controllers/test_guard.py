"""Bad samples in a running loop: what they do to the motion, to what is learnt, and their names."""

import copy
import dataclasses
import decimal
import fractions
import functools
import math

import numpy as np
import pinocchio as pin
import pytest

import approxjac as aj
from approxjac.codegen.step import compiled
from approxjac.controllers import (
    AdaptiveKinematics,
    DifferentiatedVelocity,
    Guard,
    HeldMeasurement,
    PredictedMeasurement,
)
from approxjac.controllers.guard import usual_accelerations
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.law import guard as law_of_guards
from approxjac.law.guard import (
    GuardBounds,
    GuardMemory,
    Sample,
    closely_judged,
    first_memory,
    judged,
    remembered,
)
from approxjac.simulation.plant import INTEGRATORS
from approxjac.simulation.simulate import MovingArm

DT = 1e-3
STEP = INTEGRATORS["semi_implicit_euler"]
BELIEF = aj.load_robot("panda").with_object(0.1, 0.3, axis="x")
TRUTH = aj.load_robot("panda").with_object(0.2, 0.5, axis="x")
PLANT = aj.Plant(TRUTH, aj.PositionTask(TRUTH))
START = PLANT.ready_configuration()
GOAL = PLANT.sensor.value(START) + [-0.1, 0.1, -0.1]


class Spring(aj.Controller):
    """A law of one's own, which says nothing of gravity."""

    def evaluate(self, state, measurement, target):
        _, q, v, x, _ = measurement
        e, J = self.task.error(x, target), self.task.jacobian(q, x)
        force = 300.0 * np.nan_to_num(e) + 60.0 * J @ v
        torque = self.gravity_torque(state, q) - J.T @ force - 3.0 * v
        return aj.Evaluation(torque, np.zeros(0), aj.Status.OK, e, J)


def _controllers():
    task = aj.PositionTask(BELIEF)
    law, limits = aj.SetpointController(task), aj.Limits.of(BELIEF)
    learnt = aj.SetpointController(task, gravity=aj.AdaptiveGravity(BELIEF))
    limited, tracking = aj.TorqueLimited(law, limits), aj.TrackingController(task)
    slow = dataclasses.replace(limits, rate=1000.0)
    late = aj.Latency(DT, torque_delay=DT, velocity_filter=5e-3)
    raised = aj.TrackingController(task, latency=late)  # whose damping grows until joints swing
    return {
        "law": law,
        "learnt": learnt,
        "differentiated": aj.SetpointController(task, velocity=DifferentiatedVelocity(0.01)),
        "tracking": tracking,
        "velocity": aj.TrackingController(task, command="velocity"),
        "predicted": PredictedMeasurement(law, AdaptiveKinematics(task, dt=DT)),
        "limited": limited,
        "limited, learnt": aj.TorqueLimited(learnt, limits),
        "limited, tracking": aj.TorqueLimited(tracking, limits),
        "raised": raised,
        "limited, raised": aj.TorqueLimited(raised, limits),
        "limited, rate": aj.TorqueLimited(law, slow),
        "held": HeldMeasurement(law, 0.02),
        "held, limited": HeldMeasurement(limited, 0.02),
        "predicted, limited": PredictedMeasurement(limited, AdaptiveKinematics(task, dt=DT)),
        "own": Spring(task),
        "own, limited": aj.TorqueLimited(Spring(task), limits),
    }


CONTROLLERS = _controllers()
OF_JOINTS = ["wrap", "wrap of q", "spike", "freeze", "NaN", "NaN of q", "sign", "clock", "set back"]
OF_JOINTS += ["clock of 15 ms", "swapped", "unit", "unit of v"]
OF_X = ["spike of x", "NaN of x", "stamp", "old stamp", "unit of x"]


def spoilt(kind, m, last):
    """Return a measurement in which something is wrong; `last` was the last good one."""
    t, q, v, x, t_x = m
    first, q_first = np.eye(1, len(v), 4)[0], np.eye(1, len(q), 4)[0]
    changes = {
        "wrap": {"v": v + 2.0 * math.pi / DT * first},
        "wrap of q": {"q": q + 2.0 * math.pi * q_first},
        "spike": {"v": v - 20.0 * first},
        "freeze": {"q": last.q, "v": last.v},
        "NaN": {"v": np.where(first > 0.0, np.nan, v)},
        "NaN of q": {"q": np.where(q_first > 0.0, np.inf, q)},
        "sign": {"v": -v},
        "clock": {"t": t + 10.0, "t_x": t_x + 10.0},
        "set back": {"t": t - 10.0, "t_x": t_x - 10.0},
        "clock of 15 ms": {"t": t + 0.015, "t_x": t_x + 0.015},
        "swapped": {"q": q[[0, 3, 2, 1, 4, 5, 6]], "v": v[[0, 3, 2, 1, 4, 5, 6]]},
        "unit": {"q": np.degrees(q), "v": np.degrees(v)},
        "unit of v": {"v": np.degrees(v)},
        "spike of x": {"x": x + [0.0, 0.5, 0.0]},
        "NaN of x": {"x": np.full(3, np.nan)},
        "stamp": {"t_x": t_x + 10.0},
        "old stamp": {"t_x": t_x - 10.0},
        "unit of x": {"x": 1e3 * x},
    }
    return m._replace(**changes[kind])


class Loop:
    """A loop in which the samples from `at` on are spoilt, `count` of them."""

    def __init__(self, controller, duration, kind=None, count=0, at=0.1, goal=GOAL):
        q, v, most = START, np.zeros(7), TRUTH.effort_limits
        truth = last = PLANT.measure(0.0, q, v)._replace(t_x=0.0)
        state, first = controller.initial_state(truth), round(at / DT)
        self.statuses, self.states, speeds, errors, self.full = [], [], [], [], 0
        for k in range(round(duration / DT)):
            truth = PLANT.measure(k * DT, q, v)._replace(t_x=k * DT)
            is_bad = kind is not None and first <= k < first + count
            told = spoilt(kind, truth, last) if is_bad else truth
            last = last if is_bad else truth
            state, answer = controller.step(state, told, goal, DT)
            assert np.isfinite(answer.torque).all()
            assert np.isfinite(state).all()
            self.states.append(state)
            self.statuses.append(answer.status)
            if controller.command == "velocity":
                v = answer.torque  # a servo that follows at once
                q = q + DT * v
            else:
                torque = np.clip(answer.torque, -most, most)
                self.full += bool((np.abs(answer.torque) >= 0.999 * most).any())
                q, v, _ = PLANT.advance(q, v, torque, DT, STEP)
            speeds.append(np.abs(v).max())
            errors.append(np.linalg.norm(truth.x - goal))
        self.speeds, self.errors = np.array(speeds), np.array(errors)
        self.q, self.v, self.torque = q, v, answer.torque


@functools.cache
def clean(name, duration):
    return Loop(CONTROLLERS[name], duration)


def require_as_clean(name, kind, duration=0.6):
    usual, found = clean(name, duration), Loop(CONTROLLERS[name], duration, kind, 1)
    assert found.speeds.max() <= 1.5 * usual.speeds.max() + 0.1
    assert found.full <= usual.full + 3
    assert found.errors[-1] <= 1.2 * usual.errors[-1] + 1e-4
    return found


@pytest.mark.parametrize("kind", ["wrap", "swapped", "sign", "clock of 15 ms", "stamp", "NaN"])
def test_one_bad_sample_leaves_the_motion_as_it_was(kind):
    require_as_clean("limited, learnt", kind, 0.3)


@pytest.mark.study
@pytest.mark.parametrize("kind", ["wrap of q", "sign", "set back", "unit", "unit of x"])
@pytest.mark.parametrize(
    "name", ["tracking", "limited, raised", "predicted, limited", "own, limited", "velocity"]
)
def test_one_bad_sample_leaves_the_motion_of_other_laws_as_it_was(name, kind):
    require_as_clean(name, kind, 0.3)


@pytest.mark.long
@pytest.mark.parametrize("kind", OF_JOINTS + OF_X)
@pytest.mark.parametrize("name", CONTROLLERS)
def test_one_bad_sample_leaves_the_motion_of_any_law_as_it_was(name, kind):
    require_as_clean(name, kind, 1.1)


NAMES = {
    "wrap": "VELOCITY_JUMPED",
    "wrap of q": "POSITION_JUMPED",
    "freeze": "STATE_REPEATED",
    "NaN": "JOINTS_UNKNOWN",
    "set back": "CLOCK_JUMPED",
    "unit": "POSITION_JUMPED",
}


def require_stopped(name, kind, count):
    found = Loop(CONTROLLERS[name], 0.5, kind, count)
    assert found.statuses[99] is not aj.Status.STOPPED
    if kind in NAMES:
        assert found.statuses[100].name == NAMES[kind]
    assert found.statuses[-1] is aj.Status.STOPPED
    assert found.speeds[-1] < 0.3
    return found


@pytest.mark.parametrize("kind", NAMES)
def test_ten_bad_samples_in_a_row_end_in_a_stop_with_their_name(kind):
    require_stopped("limited", kind, 10)


def test_joints_that_stay_swapped_do_not_drive_an_arm_that_is_stopped():
    """What they say agrees from sample to sample, but it is not where the arm was."""
    found = require_stopped("limited", "swapped", 100)
    assert found.full == clean("limited", 0.5).full
    assert found.speeds.max() < 3.0  # it moves on undamped for 0.2 s, with a weight nobody told of


@pytest.mark.long
@pytest.mark.parametrize("count", [10, 100])
@pytest.mark.parametrize("kind", [each for each in OF_JOINTS if each != "sign"])
@pytest.mark.parametrize("name", CONTROLLERS)
def test_bad_samples_in_a_row_end_in_a_stop_of_any_law(name, kind, count):
    require_stopped(name, kind, count)


@pytest.mark.parametrize("joint", [0, 4, 5])
def test_what_is_not_usual_is_believed_when_a_second_sample_shows_it(joint):
    """As where something is hit: 0.1 rad/s at once, and from then on."""
    found = Loop(CONTROLLERS["limited"], 0.1)
    state, first = found.states[-1], PLANT.measure(0.099, START, np.zeros(7))
    law, way = CONTROLLERS["limited"], np.eye(7)[joint]
    told = []
    for k in range(1, 4):
        t, v = first.t + k * DT, found.v + (0.1 + 0.001 * k) * way
        hit = PLANT.measure(t, found.q + DT * k * v, v)._replace(t_x=t)
        state, answer = law.step(state, hit, GOAL, DT)
        told.append(answer.status)
    assert told[0] in BAD
    assert told[1:] == [aj.Status.OK] * 2


class AtRest:
    """A robot that takes velocities, has a fine encoder, and stood for a tenth of a second."""

    def __init__(self, dt):
        law = aj.TrackingController(aj.PositionTask(BELIEF), command="velocity", dt=dt)
        self.dt, self.law = dt, law.guarded(Guard(q=1e-6))
        self.k, self.q, self.v, self.statuses = 0, START, np.zeros(7), []
        self.state = self.law.initial_state(self.seen())
        for _ in range(round(0.1 / dt)):
            self.step(PLANT.sensor.value(START))
        self.statuses.clear()

    def seen(self):
        t = self.k * self.dt
        return PLANT.measure(t, self.q, self.v)._replace(t_x=t)

    def step(self, goal):
        self.state, answer = self.law.step(self.state, self.seen(), goal, self.dt)
        self.statuses.append(answer.status)
        self.k += 1
        return answer.torque


def test_a_servo_may_follow_any_command_within_two_milliseconds():
    """Which no torque explains, from rest on."""
    robot = AtRest(4e-3)
    for _ in range(20):
        command = robot.step(GOAL)
        robot.v = robot.v + (1.0 - np.exp(-robot.dt / 2e-3)) * (command - robot.v)
        robot.q = robot.q + robot.dt * robot.v
    assert np.abs(robot.v).max() > 0.1
    assert set(robot.statuses) == {aj.Status.OK}


@pytest.mark.parametrize("joint", [0, 3, 6])
def test_what_a_servo_does_by_itself_is_believed_when_a_second_sample_shows_it(joint):
    robot = AtRest(1e-3)
    robot.v = 0.3 * np.eye(7)[joint]
    for _ in range(3):
        robot.q = robot.q + robot.dt * robot.v
        robot.step(PLANT.sensor.value(START))
    assert robot.statuses[0] in BAD
    assert robot.statuses[1:] == [aj.Status.OK] * 2


def test_a_torque_is_eased_while_samples_stay_bad():
    """From the second on, half of what is more than holds and damps the arm goes each time."""
    usual = Loop(CONTROLLERS["limited"], 0.1)
    now = PLANT.measure(0.1, usual.q, usual.v)._replace(t_x=0.1)
    state, torques = usual.states[-1], []
    for k in range(5):
        bad = now._replace(t=0.1 + k * DT, v=np.full(7, np.nan))
        state, answer = CONTROLLERS["limited"].step(state, bad, GOAL, DT)
        torques.append(answer.torque)
    np.testing.assert_array_equal(torques[0], usual.torque)
    changes = np.diff(torques[0:], axis=0)
    np.testing.assert_allclose(changes[1:], 0.5 * changes[:-1], atol=1e-9)


@pytest.mark.parametrize("count", [1, 3, 5])
def test_a_rate_of_torque_is_kept_through_bad_samples_and_after_them(count):
    law, q, v, before = CONTROLLERS["limited, rate"], START, np.zeros(7), None
    state = law.initial_state(PLANT.measure(0.0, q, v)._replace(t_x=0.0))
    for k in range(80):
        now = PLANT.measure(k * DT, q, v)._replace(t_x=k * DT)
        is_bad = 20 <= k < 20 + count
        told = now._replace(v=np.full(7, np.nan)) if is_bad else now
        state, answer = law.step(state, told, GOAL, DT)
        if before is not None:
            assert np.abs(answer.torque - before).max() <= 1000.0 * DT * (1.0 + 1e-9)
        before = answer.torque
        q, v, _ = PLANT.advance(q, v, before, DT, STEP)


@pytest.mark.parametrize("dt", [2.5e-4, 2e-3])
def test_a_stop_changes_the_torque_at_its_rate_whatever_the_period(dt):
    """From a torque far off to that which holds the arm, as fast as it may and no faster."""
    arm, rate = aj.load_robot("ur3"), 40.0
    limits = aj.Limits(effort=arm.effort_limits, rate=rate)
    law = aj.SetpointController(aj.PositionTask(arm), latency=aj.Latency(dt))
    law, plant = aj.TorqueLimited(law, limits, dt=dt), aj.Plant(arm)
    q, v = plant.ready_configuration(), np.zeros(6)
    state, torques = law.initial_state(plant.measure(0.0, q, v)), []
    goal, status = plant.sensor.value(q) + [0.2, 0.2, 0.2], []
    for k in range(round(0.12 / dt) + 60):
        now = plant.measure(k * dt, q, v)._replace(t_x=k * dt)
        told = now._replace(v=np.full(6, np.nan)) if k > 0.06 / dt else now
        state, answer = law.step(state, told, goal, dt)
        torques.append(answer.torque)
        status.append(answer.status)
    stopped = np.flatnonzero(np.array(status) == aj.Status.STOPPED)
    changes = np.abs(np.diff(torques, axis=0))[stopped[1:] - 1]
    assert changes.max() == pytest.approx(rate * dt, rel=1e-6)


@pytest.mark.parametrize("name", ["limited, learnt", "limited, tracking", "raised", "predicted"])
def test_no_memory_moves_while_samples_are_bad(name):
    controller = CONTROLLERS[name]
    found = Loop(controller, 0.11, "wrap", 5)
    size = controller.size
    for state in found.states[100:105]:
        np.testing.assert_array_equal(state[:size], found.states[99][:size])
    assert not np.array_equal(found.states[105][:size], found.states[99][:size])


@pytest.mark.parametrize("kind", ["wrap", "spike of x"])
def test_compiled_steps_judge_as_those_of_python(kind):
    require_the_same("limited", kind)


@pytest.mark.study
@pytest.mark.parametrize("name", ["tracking", "held, limited"])
@pytest.mark.parametrize("kind", ["NaN of q", "clock", "swapped"])
def test_compiled_steps_of_any_law_judge_as_those_of_python(name, kind):
    require_the_same(name, kind)


def require_the_same(name, kind):
    """Machine code leaves what is rare to Python, and has the same memory."""
    controller = CONTROLLERS[name]
    in_python, quick = (Loop(each, 0.12, kind, 7) for each in (controller, compiled(controller)))
    assert in_python.statuses == quick.statuses
    for a, b in zip(in_python.states[::10], quick.states[::10], strict=True):
        memory, same = a[controller.size :], b[controller.size :]
        np.testing.assert_allclose(memory, same, rtol=1e-6, atol=1e-9)


def test_a_stopped_arm_stays_until_the_controller_begins_anew():
    controller = CONTROLLERS["limited"]
    found = Loop(controller, 0.6, "wrap", 8)
    assert set(found.statuses[110:]) == {aj.Status.STOPPED}
    again = Loop(controller, 0.1)
    assert set(again.statuses) == {aj.Status.OK}


def test_a_first_sample_that_is_none_is_an_error():
    law = CONTROLLERS["law"]
    measured = PLANT.measure(0.0, START, np.zeros(7))
    state = law.initial_state(measured)
    with pytest.raises(MeasurementError, match="q must be finite"):
        law.step(state, measured._replace(q=np.nan * START), GOAL, DT)


def test_a_first_velocity_that_no_joint_has_is_an_error():
    law = CONTROLLERS["law"]
    measured = PLANT.measure(0.0, START, np.array([6283.0, *np.zeros(6)]))
    with pytest.raises(MeasurementError, match="first sample"):
        law.step(law.initial_state(measured), measured, GOAL, DT)


@pytest.mark.parametrize("kind", ["wrap of q", "swapped", "clock", "spike of x"])
@pytest.mark.parametrize("at", [0.0, DT])
def test_a_bad_sample_among_the_first_two_is_outvoted(kind, at):
    usual = clean("limited", 0.3)
    found = Loop(CONTROLLERS["limited"], 0.3, kind, 1, at)
    assert set(found.statuses[4:]) == {aj.Status.OK}
    assert found.speeds.max() <= 1.5 * usual.speeds.max() + 0.1
    assert found.full <= usual.full + 3
    assert found.errors[-1] <= 1.2 * usual.errors[-1] + 1e-4


def test_an_x_that_is_refused_for_long_ends_in_a_stop():
    found = Loop(CONTROLLERS["held"], 0.5, "spike of x", 400)
    assert found.statuses[100] is aj.Status.SENSOR_JUMPED
    assert found.statuses[-1] is aj.Status.STOPPED
    brief = Loop(CONTROLLERS["held"], 0.5, "spike of x", 200)
    assert brief.statuses[-1] is aj.Status.OK


def answers(law, samples, dt):
    """Return the answers to samples (q, q̇, by how much the clock and x are off)."""
    told, state = [], None
    for k, (q, v, clock, off) in enumerate(samples):
        now = PLANT.measure(k * dt, q, np.zeros(7))
        now = now._replace(t=now.t + clock, v=v, x=now.x + off, t_x=None)
        state = law.initial_state(now) if state is None else state
        state, answer = law.step(state, now, GOAL, dt)
        told.append(answer)
    return told


STILL, LOST = (START, np.zeros(7), 0.0, 0.0), (START, np.full(7, np.nan), 0.0, 0.0)


@pytest.mark.parametrize(("speed", "seen"), [(0.5, 5), (3.0, 5), (4.0, 5), (0.5, 1), (3.0, 1)])
def test_a_stop_brakes_an_arm_that_got_fast_while_it_was_not_seen(speed, seen):
    """Though no motion leads there from the last good sample, where q and q̇ agree how it moves."""
    v = speed * np.array([1.0, 0.0, 0.0, -1.0, 0.0, 0.0, 1.0])
    moving = [(START + (10 + k) * DT * v, v, 0.0, 0.0) for k in range(50)]
    told = answers(CONTROLLERS["law"], [STILL] * seen + [LOST] * 10 + moving, DT)
    assert {each.status for each in told[-50:]} == {aj.Status.STOPPED}
    for answer in told[seen + 11 :]:
        brakes = answer.torque - aj.robots.Dynamics(BELIEF).g(START)
        assert (brakes * v <= -0.99 * usual_accelerations(BELIEF)[2] * v * v).all()


@pytest.mark.parametrize("kind", ["swapped", "sign", "unit"])
def test_a_stop_is_not_driven_by_samples_that_are_wrong_in_the_same_way(kind):
    """They agree with each other, but the arm stands: only its weight is held."""
    still = PLANT.measure(0.0, START, np.zeros(7))._replace(t_x=0.0)
    wrong = spoilt(kind, still, still)
    stream = [(wrong.q + 1e-4 * np.sin(k), wrong.v, 0.0, 0.0) for k in range(60)]
    told = answers(CONTROLLERS["law"], [STILL] * 5 + [LOST] * 10 + stream, DT)
    g = aj.robots.Dynamics(BELIEF).g(START)
    assert {each.status for each in told[-50:]} == {aj.Status.STOPPED}
    assert max(np.abs(each.torque - g).max() for each in told[16:]) < 0.1


def test_a_stop_does_not_brake_a_speed_that_only_q_dot_has():
    still, wrong = (START, np.zeros(7)), (START, np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    before = [STILL] * 5 + [LOST] * 10
    told, usual = (
        answers(CONTROLLERS["law"], before + [(*each, 0.0, 0.0)] * 200, DT)
        for each in (wrong, still)
    )
    off = [a.torque - b.torque for a, b in zip(told[16:], usual[16:], strict=True)]
    assert not np.any(off)


def test_no_more_than_20_ms_are_bridged_however_long_a_period_is():
    told = answers(CONTROLLERS["law"], [STILL] * 5 + [LOST] * 3, 8e-3)
    assert [each.status for each in told[5:]] == [aj.Status.JOINTS_UNKNOWN] * 2 + [
        aj.Status.STOPPED
    ]


def test_one_sample_is_bridged_however_long_a_period_is():
    told = answers(CONTROLLERS["law"], [STILL] * 5 + [LOST] + [STILL] * 3, 25e-3)
    assert [each.status for each in told[5:]] == [aj.Status.JOINTS_UNKNOWN] + [aj.Status.OK] * 3


@pytest.mark.parametrize(("dt", "gap"), [(1e-3, 0.03), (4e-3, 0.06), (1e-3, 0.2)])
def test_a_clock_may_run_on_after_20_periods_or_50_ms_but_no_more(dt, gap):
    """The larger of both: what is missed once is believed by the second sample after it."""
    late = (*STILL[:2], gap, 0.0)
    told = [each.status for each in answers(CONTROLLERS["law"], [STILL] * 5 + [late] * 8, dt)[5:]]
    jumped, ok, stopped = aj.Status.CLOCK_JUMPED, aj.Status.OK, aj.Status.STOPPED
    assert told == ([jumped] * 5 + [stopped] * 3 if gap == 0.2 else [jumped] + [ok] * 7)


@pytest.mark.parametrize(("dt", "speed"), [(1e-3, 0.8), (4e-3, 0.4), (8e-3, 0.4)])
def test_velocities_that_all_change_their_sign_at_once_are_refused(dt, speed):
    """Though each alone may change as much: its noise is not known yet."""
    v = np.full(7, speed)
    samples = [(START + k * dt * v, -v if k == 20 else v, 0.0, 0.0) for k in range(22)]
    told = [each.status for each in answers(CONTROLLERS["law"], samples, dt)]
    assert told[19:] == [aj.Status.OK, aj.Status.VELOCITY_JUMPED, aj.Status.OK]


@pytest.mark.parametrize(("ahead", "is_good"), [(0.017, True), (0.019, False), (10.0, False)])
def test_an_x_may_be_stamped_a_period_and_10_ms_after_its_state(ahead, is_good):
    law, dt, told = CONTROLLERS["held"], 8e-3, []
    still = PLANT.measure(0.0, START, np.zeros(7))
    state = law.initial_state(still._replace(t_x=0.0))
    for k in range(6):
        now = still._replace(t=k * dt, t_x=k * dt + (ahead if k == 4 else 0.0))
        state, answer = law.step(state, now, GOAL, dt)
        told.append(answer.status)
    assert told[4] is (aj.Status.OK if is_good else aj.Status.SENSOR_JUMPED)
    assert told[:4] == [aj.Status.OK] * 4


def test_a_first_q_of_millions_of_turns_is_an_error():
    far = START + 1e7 * np.eye(7)[0]
    with pytest.raises(MeasurementError, match="a first sample must have a q"):
        answers(CONTROLLERS["law"], [(far, np.zeros(7), 0.0, 0.0)], DT)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_first_velocity_counts_as_twice_the_fastest_at_most(side):
    """Nothing has confirmed it yet."""
    law, fastest = CONTROLLERS["law"], BELIEF.velocity_limits[5]
    torques = [
        answers(law, [(START, side * share * fastest * np.eye(7)[5], 0.0, 0.0)], DT)[0].torque
        for share in (1.0, 2.0, 2.5, 8.0)
    ]
    assert np.abs(torques[1] - torques[0]).max() > 0.1
    np.testing.assert_allclose(torques[2:], [torques[1]] * 2, rtol=1e-12)


@pytest.mark.parametrize("dt", [5e-4, DT, 4e-3])
def test_a_change_of_torque_explains_less_and_less_for_20_ms(dt):
    """As it may act late; what |q̈| is usual comes on top at first and remains at last."""
    bounds = GuardBounds([1e-3], 0.0, [1.0], np.array([10.0]), [0.1], (), 5.0, 0.02)
    memory = GuardMemory.of(first_memory([0.0], [], bounds).tolist(), GuardMemory.ends(1, 1, 0, 0))
    still = Sample(0.0, [0.0], [0.0], [], math.nan, [0.0], [])
    usual = 10.0 / 128.0
    found, pushes = [], [100.0] + 60 * [0.0]
    for k, push in enumerate(pushes):
        judgement = closely_judged(memory, still._replace(t=k * dt), dt, bounds)
        memory = remembered(judgement, dt, [0.0], [push], None)
        found.append(memory.push[0])
    faded = (100.0 + usual) * (1.0 - dt / 0.02) ** np.arange(61)
    np.testing.assert_allclose(found, np.maximum(faded, usual), rtol=1e-9)


@pytest.mark.parametrize("dt", [7e-4, 3e-3])
@pytest.mark.parametrize("drifted", [1.6, -1.6, 2.4, -2.4])
def test_joints_that_stand_may_drift_by_twice_the_noise_of_a_change_of_q(dt, drifted):
    """In all that is remembered of 50 ms: more tells that q̇ is not that of q."""
    bounds = GuardBounds([1e-3], 0.0, [1.0], np.array([10.0]), [0.1], (), 5.0, 0.02)
    memory = GuardMemory.of(first_memory([0.0], [], bounds).tolist(), GuardMemory.ends(1, 1, 0, 0))
    way = 2e-4
    memory = memory._replace(t=0.0, drift=[(drifted * 1e-3 - way) / (1.0 - dt / 0.05)])
    sample = Sample(dt, [way], [0.0], [], math.nan, [way], [])
    kind = law_of_guards.GOOD if abs(drifted) < 2.0 else law_of_guards.DISAGREES
    assert judged(memory, sample, dt, bounds).verdict[0] == kind


@pytest.mark.parametrize("dt", [1e-3, 4e-3])
def test_how_long_an_x_is_refused_is_counted_in_seconds(dt):
    off = *STILL[:3], 0.5
    told = answers(CONTROLLERS["law"], [STILL] * 5 + [off] * round(0.3 / dt), dt)
    refused = [each.status for each in told].count(aj.Status.SENSOR_JUMPED)
    assert 0.25 <= (refused + 1) * dt <= 0.25 + 3.0 * dt


def test_a_stop_holds_the_arm_where_it_began_whatever_joints_had_drifted_by():
    """While q creeps and q̇ is zero, the last moments of both differ; in a stop that is over."""
    law, creep = CONTROLLERS["law"], [START + 1e-4 * k for k in range(10)]
    held = creep[-1]
    samples = [(q, np.zeros(7), 0.0, 0.0) for q in creep]
    samples += [(held, np.full(7, np.nan), 0.0, 0.0)] * 6 + [(held, np.zeros(7), 0.0, 0.0)] * 3
    told = answers(law, samples, DT)
    assert [each.status for each in told[:10]] == [aj.Status.OK] * 10
    assert {each.status for each in told[-4:]} == {aj.Status.STOPPED}
    for each in told[-4:]:
        np.testing.assert_allclose(each.torque, each.gravity, atol=1e-9)


@pytest.mark.parametrize("clock", [-10.0, 10.0])
def test_a_stop_damps_the_arm_though_its_clock_stays_wrong(clock):
    law, v = CONTROLLERS["law"], np.full(7, 0.05)
    samples = [(START + k * DT * v, v, clock * (k >= 10), 0.0) for k in range(40)]
    if clock > 0.0:  # what stops is that q̇ is lost; then the clock jumps
        samples[10:20] = [(q, np.nan * v, 0.0, 0.0) for q, *_ in samples[10:20]]
        samples[20] = (samples[20][0] + 0.5, *samples[20][1:])  # to a q that no motion explains
    told = answers(law, samples, DT)
    assert {each.status for each in told[20:]} == {aj.Status.STOPPED}
    braked = np.array([each.torque - each.gravity for each in told[25:]])
    assert (braked @ v < 0.0).all()


def test_without_a_guard_a_bad_sample_reaches_the_law():
    law = CONTROLLERS["limited"].guarded(None)
    found = Loop(law, 0.3, "wrap", 1)
    assert set(found.statuses) == {aj.Status.OK}
    assert found.states[0].size == law.size
    with pytest.raises(InvalidInputError, match="guard must be"):
        law.guarded(3)


def test_a_guard_stays_with_copies_of_its_controller():
    law = CONTROLLERS["limited"].guarded(Guard(q=1e-5))
    for other in (copy.deepcopy(law), law.with_task(law.task), compiled(law)):
        assert other.guard.q == 1e-5
    assert compiled(law).guarded(None).guard is None


def test_a_law_of_ones_own_must_name_its_methods_so_that_they_are_guarded():
    with pytest.raises(InvalidInputError, match="must be called advance"):

        class Old(aj.Controller):
            def step(self, state, measurement, target, dt):
                return state, None


def noisy(controller, bits, dt, v_filter, duration, seed=0):
    """Return the statuses of a run with real sensors on a path."""
    sensing = aj.Sensing(
        q_quantum=2.0 * math.pi / 2**bits, velocity_filter=v_filter, x_noise=2e-3, x_delay=0.02,
        x_rate=60.0,
    )  # fmt: skip
    plant = aj.Plant(TRUTH, aj.PositionTask(TRUTH), sensing=sensing)
    path = aj.Circle(PLANT.sensor.value(START) + [0.0, 0.05, 0.0], 0.05, 2.0, (1.0, 0.0, 0.0))
    run = aj.simulate(plant, controller, path, START, duration, dt=dt, seed=seed)
    return set(run.status.tolist())


@pytest.mark.parametrize("bits", [12, 20])
def test_no_good_sample_of_a_coarse_encoder_is_refused(bits):
    task = aj.PositionTask(BELIEF)
    law = aj.SetpointController(task, latency=aj.controllers.Latency(velocity_filter=5e-3))
    assert not {*map(int, BAD)} & noisy(law, bits, DT, 5e-3, 0.5)


BAD = [each for each in aj.Status if each >= aj.Status.JOINTS_UNKNOWN]


def test_a_stopped_arm_resumes_with_what_was_learnt():
    controller = CONTROLLERS["limited, learnt"]
    found = Loop(controller, 0.2, "wrap", 8)
    now = PLANT.measure(0.0, START, np.zeros(7))
    state = controller.resumed(found.states[-1], now)
    np.testing.assert_array_equal(controller.learnt(state), controller.learnt(found.states[-1]))
    assert controller.step(state, now, GOAL, DT)[1].status is aj.Status.OK


@pytest.mark.parametrize("entry", [0, 3, 5, 12])
def test_a_memory_of_the_guard_that_is_not_finite_is_refused(entry):
    law = CONTROLLERS["law"]
    state = law.initial_state(PLANT.measure(0.0, START, np.zeros(7)))
    state[entry] = np.nan
    with pytest.raises(InvalidInputError, match="state must be finite"):
        law.step(state, PLANT.measure(0.0, START, np.zeros(7)), GOAL, DT)


class Adversary:
    """A loop of an arm that no bound was tuned on, and the samples that its guard just accepts."""

    def __init__(self, name, law, dt, bits):
        belief = aj.load_robot(name)
        truth = belief.with_object(0.05, 0.3, axis="x")
        task, most = aj.PositionTask(belief), truth.effort_limits
        sensing = aj.Sensing(q_quantum=2.0 * math.pi / 2**bits, velocity_filter=5e-3, x_noise=5e-4)
        plant = aj.Plant(truth, sensing=sensing, torque_limits=most)
        q0, latency = plant.ready_configuration(), aj.controllers.Latency(dt, velocity_filter=5e-3)
        setpoint = aj.SetpointController(task, gravity=aj.AdaptiveGravity(belief), latency=latency)
        limited = aj.TorqueLimited(setpoint, aj.Limits.of(belief), dt=dt)
        tracking = aj.TrackingController(task, latency=latency, drives=aj.robots.Drives())
        self.law = compiled({
            "limited": limited,
            "predicted": PredictedMeasurement(limited, AdaptiveKinematics(task, dt=dt)),
            "tracking": aj.TorqueLimited(tracking, aj.Limits.of(belief), dt=dt),
            "velocity": aj.TrackingController(task, dt=dt, command="velocity"),
        }[law])  # fmt: skip
        if law == "velocity":
            servo = aj.simulation.VelocityServo(lag=0.02, delay=0.0, period=dt)
            plant = aj.Plant(truth, sensing=sensing, servo=servo)
        self.plant, self.most, self.dt = plant, most, dt
        rest = np.zeros(truth.nv)
        self.arm = MovingArm(plant, q0, rest, dt, "semi_implicit_euler", 0)
        self.told = self.arm.sense()[1]
        way = 0.2 * np.random.default_rng(0).standard_normal(truth.nv)
        self.goal = plant.sensor.value(pin.integrate(truth.model, q0, way))
        self.state, self.statuses = self.law.initial_state(self.told), []
        self.peak = self.full = 0

    def passes(self, told):
        answer = self.law.step(self.state, told, self.goal, self.dt)[1]
        return answer.status < aj.Status.JOINTS_UNKNOWN

    def worst(self, way, per_v):
        """Return the sample farthest off in q̇, with q that fits or not, that still passes."""
        low, high = 0.0, 1e3
        for _ in range(40):
            off = 0.5 * (low + high)
            low, high = (off, high) if self.passes(self.bad(off * way, per_v)) else (low, off)
        return self.bad(low * way, per_v)

    def bad(self, off, per_v):
        told = self.told
        q = pin.integrate(self.plant.robot.model, told.q, per_v * off)
        return told._replace(q=q, v=told.v + off)

    def advance(self, told=None):
        step = self.law.step(self.state, told or self.told, self.goal, self.dt)
        command, self.state = step[1].torque.copy(), step[0].copy()
        self.statuses.append(step[1].status)
        self.full += bool((np.abs(command) >= 0.999 * self.most).any())
        self.arm.move(self.arm.take(command))
        self.told = self.arm.sense()[1]
        self.peak = max(self.peak, np.abs(self.arm.v).max())

    def twin(self):
        return copy.deepcopy(self, {id(each): each for each in (self.law, self.plant)})

    def run(self, duration):
        for _ in range(round(duration / self.dt)):
            self.advance()
        return self


def require_no_harm(name, law, dt, bits, waits):
    begun = Adversary(name, law, dt, bits)
    usual = begun.twin().run(0.8)
    assert max(usual.statuses) < aj.Status.JOINTS_UNKNOWN
    for wait in waits:
        begun.run(wait)
        n = len(begun.told.v)
        for way in (*np.eye(n), -np.ones(n), np.sign(np.sin(np.arange(1.0, n + 1)))):
            for per_v in (0.0, 0.5 * dt):
                found = begun.twin()
                found.advance(found.worst(way, per_v))
                found.run(0.3)
                assert aj.Status.STOPPED not in found.statuses
                assert found.peak <= 1.5 * usual.peak + 0.1
                assert found.full <= usual.full + 3


@pytest.mark.study
@pytest.mark.parametrize("law", ["limited", pytest.param("tracking", marks=pytest.mark.long)])
def test_the_worst_sample_that_passes_harms_no_light_wrist(law):
    require_no_harm("z1", law, 1e-3, 14, [0.1])


@pytest.mark.long
@pytest.mark.parametrize(("dt", "bits"), [(5e-4, 17), (1e-3, 14), (2e-3, 16)])
@pytest.mark.parametrize("law", ["limited", "predicted", "tracking", "velocity"])
@pytest.mark.parametrize("name", ["z1", "xarm7", "ur10", "ur3", "talos_arm", "baxter_left_arm"])
def test_the_worst_sample_that_passes_harms_none_of_these_arms(name, law, dt, bits):
    require_no_harm(name, law, dt, bits, [0.15, 0.15, 0.3])


class Twins:
    """A guard with random bounds, whose samples of a moving arm are judged twice."""

    def __init__(self, seed):
        self.rng = rng = np.random.default_rng(seed)
        self.n, self.parts = n, parts = int(rng.choice([1, 2, 3, 7])), int(rng.integers(1, 4))
        self.m, self.dt = 3 * parts, 10.0 ** rng.uniform(-3.5, -1.5)
        each = tuple((slice(i, i + 3), slice(i, i + 3)) for i in range(0, self.m, 3))
        x_noise = [float(rng.choice([0.03, math.inf], p=[0.8, 0.2]))] * self.m
        self.step, lag = 10.0 ** rng.uniform(-5.0, -2.0, n), float(rng.choice([0.0, 1e-3, 0.02]))
        most, push = rng.uniform(1.0, 40.0, n).tolist(), rng.uniform(1.0, 1e3, n)
        self.bounds = GuardBounds(
            (rng.choice([2.0, 60.0]) * self.step).tolist(),
            lag,
            most,
            push,
            x_noise,
            each,
            5.0,
            0.02,
        )
        self.ends = GuardMemory.ends(n, n, self.m, parts)
        self.memory = first_memory([0.0] * n, [0.0] * self.m, self.bounds)
        self.x, self.last, self.t = np.zeros(self.m), None, rng.choice([0.0, 1e6, -1e3])
        self.motion = (
            10.0 ** rng.uniform(-5.0, 0.0, n),
            rng.uniform(0.1, 5.0, n),
            rng.uniform(0, 6.0, n),
        )
        if seed[1] == 0:  # at rest, until the guard takes no later time
            self.t, self.dt, self.motion[0][:] = 1e15 - 9.0, 0.5, 0.0
        self.noise = 10.0 ** rng.uniform(-3.0, 0.0)

    def sample(self):
        """Return the next t, q, v, x and t_x: one in three is slightly wrong."""
        rng, n, dt = self.rng, self.n, self.dt
        self.t += dt * (1.0 + 0.1 * rng.standard_normal())
        size, rate, phase = self.motion
        angle, noise = rate * self.t + phase, self.noise * rng.standard_normal((2, n))
        q = np.round(size * np.sin(angle) / self.step + 0.1 * noise[0]) * self.step
        v = size * rate * np.cos(angle) + 0.1 * noise[1] * self.step / dt
        if rng.random() < 0.3:
            self.x = 0.02 * np.sin(self.t + np.arange(self.m))
        x, t_x = self.x.copy(), rng.choice([None, self.t - 0.02])
        wrong, off = rng.choice(30), 10.0 ** rng.uniform(-1.0, 2.0) * self.step[0]
        q[0], v[0] = q[0] + off * (wrong == 0), v[0] + off / dt * (wrong == 1)
        v[0], v = (1.0 - 2.0 * (wrong == 2)) * v[0], (1.0 - 2.0 * (wrong == 3)) * v
        if wrong == 4 and self.last is not None:
            q, v = self.last
        self.t += dt * rng.uniform(-1.0, 3.0) * (wrong == 5)
        x[0] = {6: np.nan, 7: np.inf, 8: x[0] + 0.1}.get(wrong, x[0])
        t_x = {9: self.t + rng.choice([dt + 0.009, dt + 0.011]), 8: math.nan}.get(wrong, t_x)
        self.last = q, v
        return self.t, q, v, x, t_x

    def advance(self):
        """Compare both judgements; return the one of the closer look."""
        (t, q, v, x, t_x), dt = self.sample(), self.dt
        seen, n, rng = self.memory[self.ends[9] : self.ends[10]], self.n, self.rng
        with np.errstate(invalid="ignore"):
            way, x_way = q - self.memory[4 : 4 + n], x - seen
        kept = GuardMemory.of(self.memory.tolist(), self.ends)
        rows = [each.tolist() for each in (q, v, x)]
        taken = math.nan if t_x is None else t_x
        sample = Sample(t, *rows, taken, way.tolist(), x_way.tolist())
        found = closely_judged(kept, sample, dt, self.bounds)
        parts = zip(found.parts(), judged(kept, sample, dt, self.bounds).parts(), strict=True)
        for one, other in parts:
            np.testing.assert_array_equal(one, other)
        command, push = rng.standard_normal(n), self.bounds.push * rng.uniform(1.0, 9.0, n)
        sizes = None if rng.random() < 0.1 else rng.uniform(0.1, 3.0, self.parts).tolist()
        self.memory = remembered(found, dt, command.tolist(), push.tolist(), sizes).joined()
        if found.after.kind:
            self.memory = first_memory([0.0] * n, [0.0] * self.m, self.bounds)
        return found


@pytest.mark.parametrize(
    "seed", [*range(4), *(pytest.param(seed, marks=pytest.mark.long) for seed in range(4, 12))]
)
def test_what_differs_by_little_is_judged_as_a_closer_look_does(seed, monkeypatch):
    looks, closely = [], law_of_guards.closely_judged
    monkeypatch.setattr(
        law_of_guards, "closely_judged", lambda *given: looks.append(1) or closely(*given)
    )
    twins = [Twins([seed, i]) for i in range(5)]
    found = [each.advance() for each in twins for _ in range(150)]
    assert 20 < sum(each.verdict == [0, 0, 0] for each in found) < 730
    assert len(looks) < 730


def test_runs_in_which_each_sample_is_looked_at_closely_are_the_same_to_the_bit(monkeypatch):
    loops = [Loop(CONTROLLERS["limited, learnt"], 0.12, "sign", 1)]
    monkeypatch.setattr(law_of_guards, "is_near", lambda *given: False)
    loops.append(Loop(CONTROLLERS["limited, learnt"], 0.12, "sign", 1))
    np.testing.assert_array_equal(loops[0].states, loops[1].states)
    assert loops[0].statuses == loops[1].statuses


class Nameless:
    """An object that cannot even be printed."""

    def __repr__(self):
        raise RuntimeError("no repr")


@pytest.mark.parametrize("name", ["law", "tracking", "predicted", "limited", "held"])
def test_what_is_no_measurement_is_a_named_error_of_every_law(name):
    good = PLANT.measure(0.0, START, np.zeros(7))._replace(t_x=0.0)
    odd = [good._replace(t=t) for t in (None, "0", [0.0], 10**400, Nameless())]
    odd += [tuple(good), list(good), Nameless(), good._replace(x=Nameless())]
    for law in (CONTROLLERS[name], CONTROLLERS[name].guarded(None)):
        state = law.initial_state(good)
        for each in odd:
            with pytest.raises(InvalidInputError):
                law.step(state, each, GOAL, DT)
        for t_x in ("0", [0.0], Nameless()):
            with pytest.raises(InvalidInputError, match="t_x"):
                law.initial_state(good._replace(t_x=t_x))
        for dt in (None, "0.001", Nameless()):
            with pytest.raises(InvalidInputError, match="dt must be"):
                law.step(state, good, GOAL, dt)
        for target in (1e308 * GOAL, Nameless()):
            with pytest.raises(InvalidInputError, match="target must be"):
                law.step(state, good, target, DT)
        with pytest.raises(InvalidInputError, match="state must be"):
            law.step(Nameless(), good, GOAL, DT)


@pytest.mark.parametrize("kind", [decimal.Decimal, fractions.Fraction, np.float32, int])
def test_times_may_be_of_any_kind_of_numbers(kind):
    law = CONTROLLERS["held"]
    good = PLANT.measure(2.0, START, np.zeros(7))._replace(t_x=2.0)
    state, usual = law.step(law.initial_state(good), good, GOAL, 1.0)
    same = good._replace(t=kind(2), t_x=kind(2))
    after, answer = law.step(law.initial_state(same), same, GOAL, kind(1))
    np.testing.assert_array_equal(after, state)
    np.testing.assert_array_equal(answer.torque, usual.torque)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e200])
def test_no_number_in_the_memory_of_a_guard_makes_a_compiled_torque_wrong(bad):
    """Whatever is not a named error is finite and within limits, also at a bad sample after it."""
    law, effort = compiled(CONTROLLERS["limited"]), aj.Limits.of(BELIEF).for_joints(7).effort
    good = PLANT.measure(0.0, START, np.zeros(7))
    steps = [good._replace(t=k * DT, v=np.full(7, v)) for k, v in ((1, 0.0), (2, math.nan))]
    start, _ = law.step(law.initial_state(good), good, GOAL, DT)
    answered = 0
    for i in range(law.size, len(start)):
        state = start.copy()
        state[i] = bad
        try:
            for each in steps:
                state, answer = law.step(state, each, GOAL, DT)
                answered += 1
                assert (np.abs(answer.torque) <= np.asarray(effort) * (1.0 + 1e-9)).all()
        except (InvalidInputError, MeasurementError):
            pass
    assert answered > 0
