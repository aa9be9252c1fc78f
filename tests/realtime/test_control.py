"""The loop on a robot: where it begins, how it ends, and that the arm is always braked."""

import copy
import dataclasses
import math
import os
import re
import signal
import threading
import time
import types

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rehearsal import START, Around, Wrapped, driver_of, goal, run, tolerating

import approxjac as aj
from approxjac.errors import ControlError, InvalidInputError
from approxjac.interface import LimitStatus
from approxjac.realtime import Fault, RobotRun, SimulatedDriver, control
from approxjac.realtime.control import ObserverThread, require_near
from approxjac.realtime.robot_loop import RobotLoop
from approxjac.view import plot_run, plot_torque
from approxjac.view.browser.frames import RunFrames
from approxjac.view.browser.page import _legend, _plots, page


def test_it_brings_the_tip_there_and_brakes(plant, controller):
    driver = driver_of(plant)
    found = run(driver, controller, 3.0)
    assert found.error_norm[-1] < 1e-4
    assert np.linalg.norm(plant.sensor.value(driver.driver.q) - goal(plant)) < 1e-4
    assert found.fault is None
    assert found.ended == "its time was over: brought to rest"
    assert driver.brakes == 1
    assert driver.driver.braked
    # the target starts at the tip and is led there: no jump
    assert_array_equal(found.x_d[0], plant.sensor.value(START))
    assert np.abs(np.diff(found.x_d, axis=0)).max() < 1.001e-3 * 0.2
    assert len(found.gap) == len(found.work) == len(driver.sent) - 1


@pytest.mark.study
def test_a_run_is_saved_whole(plant, controller, tmp_path):
    found = run(driver_of(plant), controller, 0.2)
    again = RobotRun.load(found.save(tmp_path / "run.npz"))
    for field in dataclasses.fields(RobotRun):
        if field.name not in ("scene", "derived"):
            assert_array_equal(getattr(again, field.name), getattr(found, field.name))
    assert "its time was over" in str(again)
    plain = aj.Trajectory.load(tmp_path / "run.npz")
    assert_array_equal(plain.q, found.q)
    assert (plain.ended, plain.fault_name) == (found.ended, "")
    assert "its time was over" in str(plain)


def test_a_page_says_why_a_robots_run_ended(plant, controller):
    found = run(driver_of(plant), controller, 0.05)
    # drawn as capsules: meshes would have to be simplified
    belief = found.scene.belief
    bare = aj.Robot(belief.urdf.replace("/visual/", "/gone/"), tip=belief.tip)
    scene = dataclasses.replace(found.scene, truth=bare, belief=bare)
    found = dataclasses.replace(found, scene=scene)
    text = page(found)
    assert '<p id="alarm" role="alert"></p>' in text
    assert "ended: its time was over: brought to rest" in text.split("<title>")[0]
    why = "SENSOR_FROZEN: the joints move, but x does not; braked at once"
    text = page(dataclasses.replace(found, fault_name="SENSOR_FROZEN", ended=why), "Monday")
    assert f'<p id="alarm" role="alert">{why}</p>' in text
    assert "<title>SENSOR_FROZEN: Monday</title>" in text


@pytest.mark.study
def test_long_runs_keep_their_last_second(plant, controller, monkeypatch):
    monkeypatch.setattr("approxjac.realtime.robot_loop._ROWS", 20)
    found = run(driver_of(plant), controller, 2.0)
    steps = np.diff(found.t)
    assert_allclose(steps[-999:], 1e-3, atol=1e-9)
    assert_allclose(steps[:-1000], 0.1, atol=1e-9)
    assert len(steps) > 1005


def test_a_controlled_stop_stays_within_its_bound(plant, controller):
    asked = threading.Event()

    class Stopping(Wrapped):
        def read(self):
            if len(self.sent) == 300:  # in mid-motion
                asked.set()
            return super().read()

    driver = driver_of(plant, Stopping)
    found = run(driver, controller, stop=asked)
    assert found.ended == "asked to stop: brought to rest"
    assert 0.3 < found.t[-1] < 1.2
    assert np.abs(driver.driver.v).max() < 0.06
    assert 1e-3 < found.stop_distance < found.stop_bound < 0.1


@pytest.mark.parametrize(
    "name",
    [
        "SIGINT",
        *(pytest.param(k, marks=pytest.mark.study) for k in ("SIGTERM", "SIGHUP", "SIGQUIT")),
    ],
)
def test_a_signal_brings_it_to_rest(plant, controller, name):
    class Signalled(Wrapped):
        def read(self):
            if len(self.sent) == 200:
                os.kill(os.getpid(), getattr(signal, name))
            return super().read()

    before = signal.getsignal(getattr(signal, name))
    driver = driver_of(plant, Signalled)
    found = run(driver, controller)
    assert found.ended == f"{name}: brought to rest"
    assert np.abs(driver.driver.v).max() < 0.06
    assert driver.brakes == 1
    assert signal.getsignal(getattr(signal, name)) == before


def test_a_second_signal_brakes_at_once(plant, controller):
    class Signalled(Wrapped):
        def read(self):
            if len(self.sent) in (200, 210):
                os.kill(os.getpid(), signal.SIGINT)
            return super().read()

    driver = driver_of(plant, Signalled)
    found = run(driver, controller)
    assert found.ended == "SIGINT, twice: braked at once"
    assert len(driver.sent) < 215
    assert driver.brakes == 1


@pytest.mark.parametrize("where", ["read", "send"])
def test_an_error_brakes_and_keeps_the_run(plant, controller, where):
    class Failing(Wrapped):
        def read(self):
            if where == "read" and len(self.sent) == 100:
                raise OSError("the cable")
            return super().read()

        def send(self, command):
            if where == "send" and len(self.sent) == 100:
                raise OSError("the cable")
            super().send(command)

    driver = driver_of(plant, Failing)
    with pytest.raises(
        ControlError, match=r"OSError at 0\.[01]+ s: the cable; the arm was braked"
    ) as e:
        run(driver, controller)
    assert driver.brakes == 1
    assert e.value.given.fault is Fault.FAILED
    assert len(e.value.given.t) >= 99
    assert isinstance(e.value.__cause__, OSError)


def test_a_brake_that_fails_is_told(plant, controller):
    class Stuck(Wrapped):
        def brake(self):
            raise OSError("no pressure")

    with pytest.raises(ControlError, match="NOT braked, as the driver's brake"):
        run(driver_of(plant, Stuck), controller, 0.1)


def test_a_driver_that_hangs_is_braked_by_the_watchdog(plant, controller):
    braked = []

    class Hanging(Wrapped):
        def read(self):
            if len(self.sent) == 100:
                self.since = time.perf_counter()
                time.sleep(30.0)
            return super().read()

        def brake(self):
            braked.append(time.perf_counter() - getattr(self, "since", math.nan))
            super().brake()

    found = run(driver_of(plant, Hanging), controller, tolerances=tolerating(max_period=0.1))
    assert found.fault is Fault.READ_HUNG
    told = r"twice `max_period`: no state came"
    assert re.search(told, found.ended)
    assert len(braked) == 1
    assert 0.15 < braked[0] < 2.0  # twice `max_period`, on a machine that may be busy


@pytest.mark.parametrize(
    ("what", "in_thread"), [("read", True), ("law", False), ("law", True), ("send", False)]
)
def test_a_loop_that_hangs_says_whether_the_state_had_come(plant, controller, what, in_thread):
    class Hanging(Wrapped):
        def read(self):
            if what == "read" and len(self.sent) == 20:
                time.sleep(0.3)
            return super().read()

        def send(self, command):
            if what == "send" and len(self.sent) == 20:
                time.sleep(0.3)
            super().send(command)

    driver = driver_of(plant, Hanging)
    hanging, found = copy.copy(controller.ordinary), []
    if what == "law":
        step = hanging.step

        def slow(*given):
            if len(driver.sent) == 20:
                time.sleep(0.3)
            return step(*given)

        hanging.step = slow
    go = threading.Thread(
        target=lambda: found.append(run(driver, hanging, tolerances=tolerating(max_period=0.1)))
    )
    if in_thread:
        go.start()
        go.join()
    else:
        go.run()
    assert found[0].fault is Fault.READ_HUNG
    state = "no state came"
    if what != "read":
        state = r"the state was read after [\d.]+ ms; the command, or sending it, did not come back"
    assert re.search(rf"no command for 200 ms, twice `max_period`: {state}", found[0].ended)


def test_a_run_is_printed_in_one_block(plant, controller):
    found = dataclasses.replace(run(driver_of(plant), controller, 0.05), stop_distance=0.01)
    lines = str(found).splitlines()[1:]
    names = [line[2:18].strip() for line in lines if line[2] != " "]
    assert names[:2] == ["run", "torque"]
    assert names[-3:] == ["ended", "stop", "work"]
    assert all(line[16:18] == "  " and line[18] != " " for line in lines), lines


def test_a_few_periods_without_q_are_bridged(plant, controller):
    class Blinking(Wrapped):
        def read(self):
            measured = super().read()
            if 100 <= len(self.sent) < 103:
                return measured._replace(q=np.full(7, np.nan))
            return measured

    driver = driver_of(plant, Blinking)
    found = run(driver, controller, 0.2)
    assert found.fault is None
    assert_array_equal(driver.sent[100], driver.sent[99])
    assert_array_equal(driver.sent[102], driver.sent[99])
    assert np.isfinite(driver.sent).all()


@pytest.mark.study
def test_where_x_is_seen_again_the_target_begins_there(plant, controller):
    """And goes on from there to where it was led to, as slowly as ever."""
    lost = (100, 110), (300, 330), (332, 340)

    class Blind(Wrapped):
        def read(self):
            measured = super().read()
            if any(begin <= len(self.sent) < end for begin, end in lost):
                return measured._replace(x=np.full(3, np.nan))
            return measured

    found = run(
        driver_of(plant, Blind),
        controller,
        2.2,
        tolerances=tolerating(max_blind_motion=0.05, timeout=0.035),  # each time
    )
    assert found.fault is None
    is_lost = np.isnan(found.x_measured).any(axis=1)
    assert is_lost.sum() == sum(end - begin for begin, end in lost)
    again = np.flatnonzero(is_lost[:-1] & ~is_lost[1:]) + 1
    for (begin, end), k in zip(lost, again, strict=True):  # meanwhile the last one stands there
        last = np.broadcast_to(found.x[k - 1 - (end - begin)], (end - begin, 3))
        assert_array_equal(found.x[k - (end - begin) : k], last)
    assert_allclose(found.x_d[again], found.x[again], atol=1e-12)
    steps = np.abs(np.diff(found.x_d, axis=0)).max(axis=1)
    assert np.delete(steps, again - 1).max() < 1.001e-3 * 0.2
    assert_allclose(found.x_d[-1], goal(plant))
    assert_allclose(found.x[-1], goal(plant), atol=1e-4)


def losing(begin, end=math.inf):
    """A driver that loses x between two commands."""

    class Losing(Wrapped):
        def read(self):
            m = super().read()
            is_lost = begin <= len(self.sent) < end
            return m._replace(x=np.full(3, np.nan)) if is_lost else m

    return Losing


@pytest.mark.study
def test_blind_says_what_ran_out(plant, controller):
    """The way that x has moved, or the time."""
    found = run(driver_of(plant, losing(200)), controller)
    assert found.fault is Fault.BLIND
    way = float(re.search(r"it moved by ([0-9.]+) m, at most 0.01 m", found.ended)[1])
    assert 0.01 <= way < 0.0105
    found = run(driver_of(plant, losing(1500)), controller, 3.0, tolerances=tolerating(timeout=0.3))
    assert found.fault is Fault.BLIND
    assert "(for 0.301 s, at most 0.3 s)" in found.ended


def test_what_holds_x_may_go_on_for_as_far_as_it_was_told(plant, controller):
    """And by default the loop lets it; a bound that is given holds."""
    held = aj.HeldMeasurement(controller, unseen=0.03)
    for options, bound in (({}, 0.03 * math.sqrt(3.0)), ({"max_blind_motion": 0.02}, 0.02)):
        driver = driver_of(plant, losing(200))
        found = run(driver, held, 2.0, tolerances=tolerating(timeout=0.5, **options))
        assert found.fault is Fault.BLIND
        task = controller.task
        ways = [np.linalg.norm(task.value(q) - task.value(found.q[199])) for q in found.q[199:]]
        assert 0.95 * bound < max(ways) < bound
        assert f"at most {bound:.3g} m" in found.ended


@pytest.mark.parametrize(("unknown", "bridges"), [("tool", True), ("camera", False)])
def test_a_law_that_predicts_x_goes_on_as_far_as_what_it_learnt_reaches(
    by_velocities, unknown, bridges
):
    """Along a circle, with a tool of 20 cm that a frame shows, or a tracker turned by anything."""
    plant, law = by_velocities
    if not bridges:
        kinematics = aj.AdaptiveKinematics(law.task, unknown=("tool", unknown), dt=8e-3)
        law = aj.TrackingController(law.task, kinematics=kinematics, dt=8e-3, command="velocity")
    begin = 50
    tip = plant.sensor.value(START)
    circle = aj.Circle(tip + [-0.08, 0.0, 0.05], radius=0.08, period=4.0)
    driver = driver_of(plant, losing(begin, begin + 75), dt=8e-3)  # 0.6 s
    found = control(driver, law, circle, 2.0, tolerances=tolerating())
    lost = np.isnan(found.x_measured).any(axis=1)
    tips = np.array([plant.sensor.value(q) for q in found.q])
    way = np.linalg.norm(np.diff(tips[lost], axis=0), axis=1).sum()
    errors = np.linalg.norm(tips - found.x_d, axis=1)
    if bridges:
        assert found.fault is None
        assert lost.sum() == 75
        assert way > 0.05
        assert errors[lost].max() < 2e-3
    else:
        assert found.fault is Fault.BLIND
        assert lost.sum() < 75
        assert re.search(
            r"may differ from what is predicted by 0\.01\d* m, at most 0\.01 m", found.ended
        )
        assert errors[lost].max() < 0.01 + errors[begin]


def test_a_target_that_comes_to_rest_stays_there(plant, controller, monkeypatch):
    """Whether somebody moves it meanwhile, or x is lost and seen again."""

    class Blind(Wrapped):
        def read(self):
            measured = super().read()
            if 210 <= len(self.sent) < 230:
                return measured._replace(x=np.full(3, np.nan))
            return measured

    advance = RobotLoop.advance

    def halting(loop):
        if loop.step == 200:
            loop.halt()
        elif loop.step in (205, 240):
            loop.aim_at(goal(plant, (0.2, 0.2, 0.2)))
            loop.halt()
        return advance(loop)

    monkeypatch.setattr(RobotLoop, "advance", halting)
    found = run(driver_of(plant, Blind), controller)
    assert found.fault is None
    assert 0.5 < found.t[-1] < 1.19
    assert_array_equal(found.x_d[501:], np.broadcast_to(found.x_d[501], found.x_d[501:].shape))
    way = found.x_d[200:] - found.x_d[199]
    v = (found.x_d[199] - found.x_d[198]) / 1e-3
    assert_allclose(way[-1], 0.15 * v, atol=1e-3)
    task = controller.task
    faster = task.jacobian(found.q[199]) @ found.v[199] - v
    ways = found.error[199], 0.15 * v, 0.3 * faster, np.full(3, 6.0 * 2e-3)
    assert found.stop_bound == pytest.approx(sum(map(np.linalg.norm, ways)), rel=0.02)
    gone = np.linalg.norm(found.x_measured[199:] - found.x[199], axis=1)
    assert found.stop_distance == pytest.approx(np.nanmax(gone), rel=1e-6)


def test_a_braking_fault_in_a_controlled_stop_brakes_at_once(plant, controller):
    class Jumping(Wrapped):
        def read(self):
            measured = super().read()
            jump = 0.02 * (len(self.sent) >= 80)
            return measured._replace(q=measured.q + jump)

    limiting = Limiting(controller, 500 * [LimitStatus.PROOF_GIVEN_UP])
    driver = driver_of(plant, Jumping)
    found = run(driver, limiting, tolerances=tolerating(timeout=0.02))
    assert found.fault is Fault.POSITION_JUMPED
    assert "; braked at once (LIMITS: " in found.ended
    assert len(driver.sent) == 80


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_each_coordinate_may_be_astray_in_either_direction(plant, controller, axis, side):
    here = np.arange(3) == axis

    class Moved(Wrapped):
        def read(self):
            measured = super().read()
            away = 0.1 * side * here * (len(self.sent) >= 20)
            return measured._replace(x=measured.x + away)

    unsure = aj.realtime.Accuracy(x=1.0)
    tolerances = tolerating(max_error=np.where(here, 0.05, 1.0), accuracy=unsure)
    found = run(driver_of(plant, Moved), controller, 0.1, tolerances=tolerances)
    assert found.fault is Fault.ASTRAY
    assert found.t[-1] == pytest.approx(0.02)
    assert re.search(rf"\({'xyz'[axis]}.*: 0\.\d* m, at most 0\.05\)", found.ended)


def test_a_joint_is_no_faster_than_the_robot_allows(plant, controller):
    driver = driver_of(plant)
    driver.limits = dataclasses.replace(driver.limits, velocity=0.1)
    found = run(driver, controller)
    assert found.fault is Fault.TOO_FAST
    assert 0.1 < np.abs(found.v[-1]).max() < 0.2


@pytest.fixture
def knowing(plant):
    """A controller that knows the tool."""
    gravity = aj.AdaptiveGravity(plant.robot)
    law = aj.SetpointController(aj.PositionTask(plant.robot), gravity=gravity)
    return aj.TorqueLimited(law, aj.Limits.of(plant.robot))


@pytest.mark.study
def test_x_is_held_against_what_the_present_controller_believes(
    plant, controller, knowing, monkeypatch
):
    """The one that it begins with knows the tool, the one that goes on does not."""
    advance, begun = RobotLoop.advance, []

    def exchanging(loop):
        if loop.step == begun[-1]:
            loop.exchange(controller)
        return advance(loop)

    monkeypatch.setattr(RobotLoop, "advance", exchanging)
    exact = aj.realtime.Accuracy(x=2e-4, tool=0.0, jacobian=0.0)
    faults = []
    for step in (1000, 50):
        begun.append(step)
        found = run(driver_of(plant), knowing, 0.2, tolerances=tolerating(accuracy=exact))
        faults.append(found.fault)
    assert faults == [None, Fault.SENSOR_DISAGREES]
    assert found.t[-1] > 0.05


class LearnsSensor(Around):
    """A controller that learns a sensor's pose, too."""

    @property
    def kinematics(self):
        return aj.AdaptiveKinematics(self.task, ("camera",))


@pytest.mark.parametrize("exchanged", [False, True])
def test_a_turned_sensor_is_taken_while_the_present_controller_learns_it(
    plant, knowing, monkeypatch, exchanged
):
    class Turned(Wrapped):
        """A sensor that is turned by 0.4 rad about where the tip begins."""

        def read(self):
            m = super().read()
            x0, (c, s) = plant.sensor.value(START), (np.cos(0.4), np.sin(0.4))
            return m._replace(x=x0 + [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]] @ (m.x - x0))

    advance, loops = RobotLoop.advance, []

    def exchanging(loop):
        loops.append(loop)
        if loop.step == 20 and exchanged:
            loop.exchange(knowing)
        return advance(loop)

    monkeypatch.setattr(RobotLoop, "advance", exchanging)
    exact = aj.realtime.Accuracy(x=2e-4, tool=0.0, jacobian=0.0)
    learning, tolerances = LearnsSensor(knowing), tolerating(accuracy=exact)
    found = run(driver_of(plant, Turned), learning, 0.2, tolerances=tolerances)
    assert loops[-1].learns_sensor is not exchanged
    assert found.fault is (Fault.SENSOR_DISAGREES if exchanged else None)


class Limiting(Around):
    """Says of its limits what a schedule has, with the torque that it was asked for."""

    def __init__(self, controller, schedule):
        super().__init__(controller)
        self.schedule = schedule

    def advance(self, state, measurement, target, dt):
        after, answer = self.controller.advance(state, measurement, target, dt)
        k = round((measurement.t - 0.05) / dt)
        said = self.schedule[k] if 0 <= k < len(self.schedule) else LimitStatus.FREE
        return after, answer._replace(limit_status=said)


VOID = LimitStatus.PROOF_GIVEN_UP, LimitStatus.INFEASIBLE, LimitStatus.SOLVER_FAILED


@pytest.mark.parametrize("status", VOID)
def test_limits_that_void_the_proof_for_too_long_end_a_run(plant, controller, status):
    """For more than `timeout` at a stretch; a stop may take as long again."""
    schedule = 20 * [status] + [LimitStatus.FREE] + 500 * [status]
    driver, tolerances = driver_of(plant), tolerating(timeout=0.02)
    found = run(driver, Limiting(controller, schedule), tolerances=tolerances)
    assert found.fault is Fault.LIMITS
    assert found.ended.endswith("; brought to rest")
    assert found.t[-1] == pytest.approx(0.05 + 0.021 + 0.021 + 0.02, abs=2.5e-3)
    assert np.isfinite(found.stop_distance)


def test_limits_may_void_the_proof_for_as_long_at_any_period(by_velocities):
    plant, law = by_velocities
    schedule = 5 * VOID[:1] + (LimitStatus.FREE,) + 200 * VOID[:1]
    driver, tolerances = driver_of(plant, dt=8e-3), tolerating(timeout=0.04)
    found = run(driver, Limiting(law, schedule), tolerances=tolerances)
    assert found.fault is Fault.LIMITS
    voids = found.limit_status[: round(0.15 / 8e-3)] == VOID[0]
    assert found.t[-1] == pytest.approx(found.t[voids.argmax()] + 12 * 8e-3 + 0.04, abs=0.02)


def test_limits_that_keep_the_proof_or_void_it_for_a_while_are_no_fault(plant, controller):
    schedule = [each for each in LimitStatus if each not in VOID for _ in range(30)]
    for status in VOID:
        schedule += 20 * [status] + [LimitStatus.EXCEEDED]
    tolerances = tolerating(timeout=0.02)
    found = run(driver_of(plant), Limiting(controller, schedule), 0.3, tolerances=tolerances)
    assert found.fault is None
    assert set(LimitStatus) <= set(found.limit_status.tolist())


@pytest.mark.study
def test_an_observer_sees_it_and_moves_the_target(plant, controller):
    second = goal(plant, (0.0, 0.1, 0.0))
    seen, moved = [], []

    class Watched(Wrapped):
        def read(self):
            time.sleep(2e-4)
            return super().read()

    def observe(loop):
        seen.append((loop.t, loop.step, threading.current_thread().name))
        if loop.step > 200 and not moved:
            loop.aim_at(second)
            moved.append(loop.step)

    found = run(driver_of(plant, Watched), controller, 2.5, observer=observe)
    assert len(seen) > 3
    assert {name for _, _, name in seen} == {"approxjac observer"}
    assert_allclose(found.x_d[-1], second)
    assert found.error_norm[-1] < 1e-3
    assert np.abs(np.diff(found.x_d, axis=0)).max() < 1e-3  # it goes there without a jump


@pytest.mark.study
def test_an_arm_does_not_wait_while_another_controller_is_copied(plant, controller):
    """Such as one that is compiled, of which a copy takes tenths of a second."""
    waits = []

    class Other:
        def __deepcopy__(self, memo):
            waits.append(loop.between_steps.locked())
            return self

    loop = types.SimpleNamespace(
        plant=plant, controller=controller, path=goal(plant), dt=1e-3, steps=1,
        between_steps=threading.Lock(), exchange=lambda given: waits.append(given is other),
    )  # fmt: skip
    other = Other()
    ObserverThread(loop, print).exchange(other)
    assert waits == [False, True]


def test_an_observer_that_fails_stops_no_arm(plant, controller):
    def observe(loop):
        raise ZeroDivisionError

    assert run(driver_of(plant), controller, 0.05, observer=observe).fault is None


@pytest.mark.study
def test_a_path_is_followed(plant, controller):
    driver = driver_of(plant)
    center = goal(plant, (-0.05, 0.0, 0.0))
    path = aj.Circle(center, 0.05, 4.0)
    found = control(driver, controller, path, 2.4, tolerances=tolerating())
    assert_allclose(found.x_d[2300], path.at(2.3).x)
    assert found.error_norm[2000:].max() < 0.02


BROKEN = {
    "clock of x": (
        lambda m, old: m._replace(t_x=m.t + 1.7e9),
        "CLOCK_JUMPED: the clock of the robot, or that of x, jumped (x was taken 1.7e+09 s after",
    ),
    "clock": (
        lambda m, old: m._replace(t=m.t - 0.1), "jumped (-99 ms from state to state); braked",
    ),
    "jump": (
        lambda m, old: m._replace(q=m.q + 0.02 * (np.arange(7) == 2)),
        "(panda_joint3: by 0.01",
    ),
    "sign": (lambda m, old: m._replace(v=m.v + 2.0 * (np.arange(7) == 1)), "(panda_joint2: "),
    "frozen": (
        lambda m, old: m._replace(
            q=np.where(np.arange(7) == 3, old.q, m.q), v=np.where(np.arange(7) == 3, 0.0, m.v)
        ),
        "(panda_joint4: ",
    ),
    "astray": (lambda m, old: m, " m, at most 1e-06); braked"),
}  # fmt: skip


@pytest.mark.parametrize("what", BROKEN)
def test_a_run_that_a_fault_ended_says_where_and_by_how_much(plant, controller, what):
    change, told = BROKEN[what]
    kept = []

    class Changed(Wrapped):
        def read(self):
            m = super().read()
            if len(self.sent) < 200:
                kept[:] = [m]
                return m
            return change(m, kept[0])

    bounds = {"max_error": (1e-6, 1.0, 1.0)} if what == "astray" else {}
    found = run(driver_of(plant, Changed), controller, tolerances=tolerating(**bounds))
    assert told in found.ended
    assert found.fault.message in found.ended


@pytest.mark.study
def test_the_usual_noise_of_x_is_in_the_unit_of_the_task(panda):
    """0.5 px of noise are usual, and 2 mm of it would be 2000 px."""
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))
    task = aj.ImageTask(panda.with_object(0.0), camera)
    plant = aj.Plant(task.robot, task, sensing=aj.Sensing(x_noise=0.5, x_rate=60.0))
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(task.robot))
    limited = aj.TorqueLimited(law, aj.Limits.of(task.robot))
    found = control(
        driver_of(plant),
        limited,
        plant.sensor.value(START) + 5.0,
        0.3,
        tolerances=tolerating(),
    )
    assert found.fault is None
    usual = aj.realtime.Accuracy().for_units(("m", "rad", "px")).x
    assert_array_equal(usual, [2e-3, 2e-3, 1.0])
    assert aj.realtime.Accuracy(x=0.3).for_units(("px",)).x == 0.3
    assert "Accuracy(x=..., x_period=...)" in Fault.SENSOR_JUMPED.message


@pytest.mark.study
def test_the_error_is_that_to_the_target_when_x_was_taken(plant, controller):
    late = aj.Plant(plant.robot, plant.sensor, sensing=aj.Sensing(x_delay=0.03))
    path = aj.Circle(goal(plant, (-0.05, 0.0, 0.0)), 0.05, 2.0)

    class Between(Wrapped):
        def read(self):
            measured = super().read()
            return measured._replace(t_x=measured.t_x - 3e-4)

    found = control(driver_of(late, Between), controller, path, 0.5, tolerances=tolerating())
    then = 0.7 * found.x_d[70:-30] + 0.3 * found.x_d[69:-31]
    true = np.array([plant.sensor.value(q) for q in found.q[70:-30]])
    assert_allclose(found.error[100:], true - then, atol=1e-8)
    moved = found.x_d[30:] - found.x_d[:-30]
    assert np.linalg.norm(moved, axis=1).max() > 4e-3  # by which it would be off otherwise


@pytest.mark.study
def test_a_page_of_a_robot_speaks_of_beliefs_not_of_truth(plant, controller, tmp_path):
    found = run(driver_of(plant), controller, 0.1)
    again = aj.Trajectory.load(found.save(tmp_path / "run.npz"))
    for one in (found, again):
        words = [entry[-1] for entry in _legend(one.scene, "believed tip", image=False)]
        assert "believed arm" in words
        assert "tip by the belief and its path" in words
        assert not {"true arm", "true tip and its path"} & set(words)
    known = dataclasses.replace(found.scene, knows_truth=True)
    legend = _legend(known, "believed tip", image=False)
    assert "true tip and its path" in [entry[-1] for entry in legend]


REFUSED = {
    "limits": "controller must keep the robot's limits of effort",
    "one motor": "controller must keep the robot's limits of effort",
    "falls": "the controller must compensate gravity, such as by AdaptiveGravity",
    "adds": "the controller must leave gravity to the robot, which adds its own",
    "adds to T": "or a driver that takes it off, as FrankaDriver(gravity=robot)",
    "beyond": "limits, got panda_joint4 at 0.1 rad, limits -3.072 and -0.0698",
    "degrees": "q must be in radians: it is 111.",
    "moving": "the arm must be at rest",
    "moving back": "the arm must be at rest",
    "blind": "x must be known before the arm moves",
    "clock": "the clock of the driver must go on",
    "two clocks": "t_x must be by the clock of t, got Measurement(",
    "millimetres": "m from the base of an arm that reaches 1.09 m; 1 mm is 0.001",
    "period": "must be",
    "tuning": "(gains or learning) is for a period of 0.001 s, and the driver's dt is 0.002 s",
    "sizes": "driver must read q, q̇ and x with 7, 7 and 3 numbers, got shapes (6,), (7,), (3,)",
    "duration": "duration must be a finite number > 0 [s], got 0.0",
    "driver": "driver must be a Driver",
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_may_not_begin_is_refused_and_sends_nothing(plant, controller, panda, what):
    belief = controller.task.robot
    changed = {
        "moving": lambda m: m._replace(v=np.full(7, 0.1)),
        "moving back": lambda m: m._replace(v=-0.1 * (np.arange(7) == 6)),
        "blind": lambda m: m._replace(x=np.full(3, np.nan)),
        "clock": lambda m: m._replace(t=1.0),
        "beyond": lambda m: m._replace(q=np.append(START[:3], [0.1, *START[4:]])),
        "degrees": lambda m: m._replace(q=np.degrees(m.q)),
        "millimetres": lambda m: m._replace(x=1e3 * m.x),
        "two clocks": lambda m: m._replace(t_x=m.t + 1.7e9),
        "sizes": lambda m: m._replace(q=m.q[:6]),
    }

    class Changed(Wrapped):
        def read(self):
            return changed.get(what, lambda m: m)(super().read())

    adds = panda if "adds" in what else None
    driver = driver_of(aj.Plant(plant.robot, plant.sensor, adds_gravity=adds), Changed)
    if what == "limits":
        controller = controller.controller
    elif what == "one motor":
        efforts = belief.effort_limits * np.where(np.arange(7) == 6, 0.99, 1.0)
        driver.limits = aj.Limits(effort=efforts)
    elif what == "falls":
        law = aj.SetpointController(controller.task, gravity=aj.NoGravity(belief))
        controller = aj.TorqueLimited(law, aj.Limits.of(belief))
    elif what == "adds to T":
        law = aj.TrackingController(controller.task, dt=1e-3)
        controller = aj.TorqueLimited(law, aj.Limits.of(belief))
    elif what == "period":
        driver.dt = 2e-3
    elif what == "tuning":
        driver.dt = 2e-3
        controller = aj.TorqueLimited(controller.controller, driver.limits, dt=2e-3)
    given = object() if what == "driver" else driver
    with pytest.raises(InvalidInputError) as refused:
        control(given, controller, goal(plant), 0.0 if what == "duration" else 1.0)
    assert REFUSED[what] in str(refused.value)
    assert driver.sent == []


def test_the_remedy_for_another_period_keeps_the_rest_of_the_latency(plant, controller):
    law, limits = controller.controller, aj.Limits.of(controller.task.robot)
    latency = aj.Latency(image_period=0.03, image_age=0.06)
    law = aj.SetpointController(law.task, gravity=law.gravity, latency=latency)
    remedy = r"the loop, Latency\(period=0.002, image_period=0.03, image_age=0.06\): what"
    with pytest.raises(InvalidInputError, match=remedy):
        run(driver_of(plant, dt=2e-3), aj.TorqueLimited(law, limits, dt=2e-3), 0.02)


def test_a_law_tuned_for_the_period_may_begin(plant, controller):
    law, limits = controller.controller, aj.Limits.of(controller.task.robot)
    slow = aj.SetpointController(law.task, gravity=law.gravity, latency=aj.Latency(period=2e-3))
    found = run(driver_of(plant, dt=2e-3), aj.TorqueLimited(slow, limits, dt=2e-3), 0.02)
    assert "its time was over" in found.ended


def test_a_tracker_may_stand_elsewhere_in_a_hall(panda):
    x = np.array([30.0, -20.0, 3.0])
    require_near(aj.PositionTask(panda), x)
    placed = aj.tasks.TrackerTask(panda, offset=1e3 * x)
    require_near(placed, 1e3 * x + 0.5)
    with pytest.raises(InvalidInputError, match=r"x must be in m, got \["):
        require_near(placed, 1e3 * x + 100.0)


@pytest.mark.parametrize("frames", [300, 1100])
def test_a_first_frame_is_waited_for(plant, controller, frames):
    class Starting(Wrapped):
        count = 0

        def read(self):
            self.count += 1
            m = super().read()
            return m._replace(x=np.full(3, np.nan)) if self.count < frames else m

    driver = driver_of(plant, Starting)
    if frames < 1000:  # of `timeout`
        assert run(driver, controller, 0.2).fault is None
        return
    with pytest.raises(InvalidInputError, match="x must be known before the arm moves"):
        run(driver, controller)
    assert driver.sent == []


@pytest.mark.parametrize(
    ("duration", "error"), [(0.2, 0.02), pytest.param(2.5, 1e-3, marks=pytest.mark.long)]
)
def test_a_robot_that_adds_gravity_is_led_by_what_is_left(plant, panda, duration, error):
    belief = panda.with_object(0.0)
    gravity = aj.AdaptiveGravity(belief, theta0=0.0)
    law = aj.SetpointController(aj.PositionTask(belief), gravity=gravity)
    limited = aj.TorqueLimited(law, aj.Limits.of(belief))
    driver = driver_of(aj.Plant(plant.robot, plant.sensor, adds_gravity=panda))
    found = run(driver, limited, duration)
    assert found.error_norm[-1] < error
    e = found.error[0]  # as it is believed, nothing is left to learn
    assert found.V[0] == pytest.approx(law.diagonals[0] @ law.saturation.S(e), rel=1e-3)


def test_the_record_of_commanded_velocities_has_no_torques(by_velocities, tmp_path):
    plant, law = by_velocities
    driver = driver_of(plant, dt=8e-3)
    found = run(driver, law, 0.4)
    assert_array_equal(found.command, driver.sent[: len(found.t)])
    assert np.abs(found.command).max() > 0.01
    assert np.isnan(found.tau).all()
    for each in (found, RobotRun.load(found.save(tmp_path / "run.npz"))):
        assert (each.command_kind, each.units["command"], each.has_torque) == (
            "velocity", "rad/s", False,
        )  # fmt: skip
        assert re.search(r"velocity +at most [0-9.]+ rad/s \(panda_joint\d\)", str(each))
        assert "N m" not in str(each)
        assert "torque" not in str(each)
    _, axes = plot_run(found)
    assert_array_equal(axes[1].get_lines()[0].get_ydata(), found.command[:, 0])
    assert "rad/s" in axes[1].get_ylabel()
    with pytest.raises(InvalidInputError, match="plot_command"):
        plot_torque(found)
    plots = {plot["column"]: plot["unit"] for plot in _plots(found.scene, found)}
    assert plots["command"] == "q̇ [rad/s]"
    assert "torque" not in plots
    assert_array_equal(RunFrames(found.scene).columns(found)["command"], found.command)


def test_a_stop_takes_as_long_at_any_period(by_velocities):
    """0.3 s, in which the target comes to rest, whatever a period is."""
    plant, law = by_velocities
    found = run(driver_of(plant, dt=8e-3), law, 0.4)
    assert found.ended == "its time was over: brought to rest"
    assert 0.7 < found.t[-1] < 0.75


def test_an_x_is_lost_for_too_long_by_the_time_that_it_is(by_velocities):
    plant, law = by_velocities
    tolerances = tolerating(timeout=0.3, max_blind_motion=0.5)
    found = run(driver_of(plant, losing(60), dt=8e-3), law, 2.0, tolerances=tolerances)
    assert found.fault is Fault.BLIND
    assert "(for 0.304 s, at most 0.3 s)" in found.ended


@pytest.mark.study
def test_velocities_are_commanded(by_velocities):
    plant, law = by_velocities
    found = run(driver_of(plant, dt=8e-3), law, 4.0)
    assert found.fault is None
    assert found.error_norm[-1] < 1e-3


def test_in_real_time_the_arm_does_not_wait(plant, controller):
    driver = Wrapped(SimulatedDriver(plant, START))
    begun = time.perf_counter()
    found = run(driver, controller, 0.5)
    passed = time.perf_counter() - begun
    assert found.t[-1] <= passed
    assert_allclose(driver.driver.t, passed, rtol=0.5)  # building the loop takes some of it
