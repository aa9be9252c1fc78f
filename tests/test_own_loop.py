"""The loop that the examples offer to copy: what it does with faults, and how it ends."""

import dataclasses
import gc
import runpy
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import approxjac as aj
from approxjac.controllers import Posture
from approxjac.robots import GravityRegressor

EXAMPLES = Path(__file__).parents[1] / "examples"
ARM = aj.load_robot("two_link")
TRUTH, BELIEF = ARM.with_object(0.3, 0.1), ARM.with_object(0.0)
HEAVY = ARM.with_object(0.3, 0.5)
SENSOR = aj.PositionTask(TRUTH, axes="xz")
LAW = aj.SetpointController(  # of 1 s, so that braking from 0.3 m/s takes little beside gravity
    aj.PositionTask(BELIEF, axes="xz"),
    gravity=aj.AdaptiveGravity(GravityRegressor(BELIEF)),
    settling_time=1.0,
)
LIMITED = aj.TorqueLimited(LAW, aj.Limits(effort=(200.0, 100.0)))
Q0 = np.array([0.6, 1.2])
GOAL = SENSOR.value(Q0) + [0.1, -0.2]


class Clock:
    """A clock that goes on when it is told to, so that no test depends on how busy a machine is."""

    now = 7.0

    def perf_counter(self):
        return self.now

    def wait_until(self, due):
        self.now = max(self.now, due)


CLOCK = Clock()


@pytest.fixture
def own_loop(monkeypatch):
    """The module of the loop, with that clock: as fast as it can."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.delitem(sys.modules, "own_loop", raising=False)
    import own_loop

    monkeypatch.setattr(own_loop, "time", CLOCK)
    monkeypatch.setattr(own_loop, "wait_until", CLOCK.wait_until)
    yield own_loop
    assert gc.isenabled()
    del sys.modules["own_loop"]


class Arm:
    """A driver whose faults begin at some cycle."""

    def __init__(self, fault="", since=300, truth=TRUTH):
        self.plant = aj.Plant(truth, aj.PositionTask(truth, axes="xz"))
        self.q, self.v = Q0.copy(), np.zeros(2)
        self.fault, self.since, self.torques, self.brakes = fault, since, [], 0

    def read(self):
        x = self.plant.sensor.value(self.q)
        fault = self.fault if len(self.torques) >= self.since else ""
        if fault == "fails":
            raise ConnectionError("no cable")
        q = self.q * (np.nan if fault == "joints" else 1.0)
        if fault == "slow" and len(self.torques) == self.since:
            CLOCK.now += 0.05
        return q, self.v, x * (np.nan if fault == "blind" else 1.0)

    def send(self, torque):
        self.torques.append(np.array(torque))
        self.v = self.v + 1e-3 * self.plant.acceleration(self.q, self.v, torque)
        self.q = self.q + 1e-3 * self.v

    def brake(self):
        self.brakes += 1


def lead(own_loop, arm, seconds=20.0, **changes):
    arguments = {"unseen": 0.02, "speed": 0.3, "astray": 0.5, "longest": 10.0, "patience": 0.5}
    arguments |= changes
    arm.ended = own_loop.control(arm, LIMITED, lambda t: GOAL, lambda t: t >= seconds, **arguments)
    return arm.ended[:2]


def test_it_starts_without_a_jump_arrives_and_ends_at_standstill(own_loop):
    arm = Arm()
    why, log = lead(own_loop, arm, 8.0)
    assert why == "asked to"
    believed = LAW.gravity_torque(LAW.adaptation.theta0, Q0)
    np.testing.assert_allclose(arm.torques[0], believed, atol=1e-9)
    before = log[log["t"] < 8.0]
    assert np.linalg.norm(before["x"][-1] - GOAL) < 1e-3
    assert np.abs(arm.v).max() < 0.02
    assert arm.brakes == 1
    g = arm.plant.dynamics.g(arm.q)
    again = LAW.gravity_torque(arm.ended[2], arm.q)  # what was learnt is handed back
    assert np.abs(again - g).max() < 0.1 * np.abs(believed - g).max()
    assert len(log) == len(arm.torques)
    np.testing.assert_array_equal(log["torque"], arm.torques)
    np.testing.assert_array_equal(log["t"], 1e-3 * np.arange(len(log)))


@pytest.mark.parametrize("truth", [TRUTH, HEAVY])
def test_a_stop_in_mid_motion_is_soft_and_ends_at_standstill(own_loop, truth):
    arm = Arm(truth=truth)
    why, log = lead(own_loop, arm, 0.6)
    assert why == "asked to"
    assert np.abs(log["v"][599]).max() > 0.2
    assert np.abs(arm.v).max() < 0.02
    assert log["t"][-1] < 2.59  # before it gives up
    assert is_soft(arm, log[600:])


def test_a_stop_while_an_image_is_lost_does_not_push_to_the_goal(own_loop):
    """What is held is compared with a target that waits, never with the goal itself."""

    class Blinking(Arm):
        def read(self):
            self.fault = "blind" if 590 <= len(self.torques) < 650 else ""
            return super().read()

    arm = Blinking()
    why, log = lead(own_loop, arm, 0.6, unseen=0.1)
    assert why == "asked to"
    assert log["status"][599] == aj.Status.MEASUREMENT_HELD
    assert np.abs(log["v"][599]).max() > 0.2
    assert np.abs(log["v"][600:]).max() < 1.1 * np.abs(log["v"][599]).max()  # it only brakes
    assert np.abs(arm.v).max() < 0.02
    assert is_soft(arm, log[600:])


def test_parts_that_come_back_one_by_one_do_not_push_to_the_goal(own_loop):
    """The first part is seen again while the second is lost, and held."""
    both = [
        aj.StackedTask(aj.PositionTask(robot, axes="x"), aj.PositionTask(robot, axes="z"))
        for robot in (TRUTH, BELIEF)
    ]
    law = aj.SetpointController(both[1], gravity=aj.AdaptiveGravity(BELIEF))

    class InParts(Arm):
        def read(self):
            q, v, x = super().read()
            k = len(self.torques)
            return q, v, np.where([200 <= k < 700, 690 <= k < 760], np.nan, x)

    arm = InParts()
    _, log, _ = own_loop.control(
        arm, law, lambda t: GOAL, lambda t: t >= 0.9, unseen=0.02, speed=0.3, astray=0.5,
        longest=10.0,
    )  # fmt: skip
    assert (log["status"][400:700] == aj.Status.MEASUREMENT_LOST).any()
    assert np.abs(np.diff(log["torque"][695:765], axis=0)).max() < 5.0


def is_soft(arm, log):
    """Whether torques stay near those that hold the arm: it is not switched off."""
    g = np.array([arm.plant.dynamics.g(q) for q in log["q"]])
    return np.abs(log["torque"] - g).max() < 0.5 * np.abs(g).max()


@pytest.mark.parametrize(
    ("fault", "changes", "reason"),
    [
        ("blind", {}, "blind, or at its limits, for too long"),
        ("slow", {"longest": 0.04}, "a torque came too late"),
    ],
)
def test_a_fault_that_lasts_stops_it(own_loop, fault, changes, reason):
    arm = Arm(fault)
    why, log = lead(own_loop, arm, **changes)
    assert why == reason
    assert log["t"][-1] < 4.0
    assert arm.brakes == 1
    moving = np.abs(log["v"]).max(axis=1)
    assert moving[-1] < 0.7 * moving[300]  # what it has not learnt of its weight lets it sink
    assert is_soft(arm, log[300:])
    assert log["status"][-1] == aj.Status.MEASUREMENT_LOST


def test_it_does_not_begin_where_the_limits_do_not_hold_the_arm(own_loop):
    arm = Arm()
    weak = aj.TorqueLimited(LAW, aj.Limits(effort=(2.0, 1.0)))
    with pytest.raises(ValueError, match="limits do not hold the arm as it stands"):
        own_loop.control(
            arm, weak, lambda t: GOAL, lambda t: False, unseen=0.02, speed=0.3, astray=0.5,
            longest=10.0,
        )  # fmt: skip
    assert arm.torques == []
    assert arm.brakes == 1


class Turned(Arm):
    """A driver whose x has its axes turned by 180° against those of the robot."""

    def read(self):
        q, v, x = super().read()
        return q, v, -x


@pytest.mark.parametrize(
    ("options", "reason"),
    [({"astray": 0.3}, "far from its target"), ({"fastest": (1.0, 1.5)}, "too fast")],
)
def test_a_measurement_in_other_axes_stops_it(own_loop, options, reason):
    arm = Turned()
    options = {"unseen": 0.02, "speed": 0.3, "astray": 9.0, "longest": 10.0} | options
    why, log, _ = own_loop.control(arm, LIMITED, lambda t: -GOAL, lambda t: t > 20.0, **options)
    assert why == reason
    assert arm.brakes == 1
    beyond = np.abs(log["v"]) > options.get("fastest", np.inf)
    assert not beyond[:-1].any()  # the cycle after which the brakes close is the last
    assert beyond[-1].any() == (why == "too fast")


def test_limits_that_void_the_proof_for_long_stop_it(own_loop):
    arm = Arm()
    enough = 1.3 * np.abs(LAW.gravity_torque(LAW.adaptation.theta0, Q0))
    weak = aj.TorqueLimited(LAW, aj.Limits(effort=enough))
    far = SENSOR.value(np.array([-0.3, 0.4]))
    options = {"unseen": 0.02, "speed": 0.3, "astray": 9.0, "longest": 10.0, "patience": 0.5}
    why, log, _ = own_loop.control(arm, weak, lambda t: far, lambda t: t > 20.0, **options)
    assert why == "blind, or at its limits, for too long"
    assert (log["limit"][-1000:] >= aj.LimitStatus.PROOF_GIVEN_UP).any()
    assert (np.abs(log["torque"]) <= enough + 1e-9).all()


def test_an_arm_that_sinks_under_a_fault_is_braked_when_it_gains_speed(own_loop):
    """The weight that it has not learnt draws it down once x is lost."""
    arm = Arm("blind", since=50, truth=ARM.with_object(0.3, 5.0))
    why, log = lead(own_loop, arm)
    assert why == "blind, or at its limits, for too long"
    stopping = np.abs(log["v"][log["t"] > 0.55]).max(axis=1)
    assert log["t"][-1] < 2.0
    assert stopping[-1] > 0.02
    assert stopping[-1] < stopping.min() + 0.15


def test_a_stop_while_nothing_is_seen_does_not_let_it_fall(own_loop):
    arm = Arm("blind", since=50, truth=ARM.with_object(0.3, 3.0))
    why, log = lead(own_loop, arm, 0.1, patience=2.0)
    assert why == "asked to"
    assert log["t"][-1] < 1.0  # not the two seconds of a stop that holds the tip
    pace = np.abs(log["v"][log["t"] > 0.1]).max(axis=1)
    assert pace[-1] < pace.min() + 0.15


def test_one_measurement_far_off_sends_no_torque_for_it(own_loop):
    class Glitch(Arm):
        def read(self):
            q, v, x = super().read()
            return q, v, x + (5.0 if len(self.torques) == 500 else 0.0)

    arm = Glitch()
    why, _ = lead(own_loop, arm)
    assert why == "far from its target"
    assert np.abs(np.diff(arm.torques[495:520], axis=0)).max() < 10.0  # the force is gone, no more
    assert len(arm.torques) > 500


def test_a_driver_that_fails_at_once_is_braked(own_loop):
    arm = Arm("fails", since=0)
    with pytest.raises(ConnectionError):
        lead(own_loop, arm)
    assert arm.brakes == 1


def test_a_posture_and_a_joint_at_its_limit_do_not_keep_it_from_beginning(own_loop):
    panda = aj.load_robot("panda")
    q = np.array([0.0, 1.763, 0.0, -2.0, 0.0, 1.6, 0.7])  # a hair beyond the limit of joint 2
    task = aj.PositionTask(panda)
    law = aj.SetpointController(task, posture=Posture(q - 0.3, 5.0))
    limited = aj.TorqueLimited(law, dataclasses.replace(aj.Limits.of(panda), rate=1000.0))

    class Still(Arm):
        def __init__(self):
            self.q, self.v, self.torques, self.brakes = q, np.zeros(7), [], 0

        def read(self):
            return self.q, self.v, task.value(self.q)

        def send(self, torque):
            self.torques.append(np.array(torque))

    arm = Still()
    x = task.value(q)
    why, _, _ = own_loop.control(
        arm, limited, lambda t: x, lambda t: t > 0.05, unseen=0.02, speed=0.1, astray=0.1,
        longest=10.0,
    )  # fmt: skip
    assert why == "asked to"
    assert len(arm.torques) > 50


def test_the_log_tells_what_the_limits_did_and_what_was_learnt(own_loop):
    arm = Arm()
    _, log = lead(own_loop, arm, 2.0)
    assert (log["limit"] == aj.LimitStatus.FREE).mean() > 0.5
    assert log["slack"][1900] == 0.0
    np.testing.assert_allclose(log["target"][1900], GOAL)
    np.testing.assert_array_equal(log["theta_hat"][-1], arm.ended[2])


def test_one_late_torque_is_no_reason_to_stop(own_loop):
    why, log = lead(own_loop, Arm("slow"), 1.0, longest=1.0)
    assert why == "asked to"
    assert (log["gap"] > 0.05).sum() >= 1


def test_without_joints_it_sends_the_last_torque_for_some_cycles_and_brakes(own_loop):
    arm = Arm("joints")
    why, log = lead(own_loop, arm)
    assert why == "joints unknown"
    assert arm.brakes == 1
    unknown = log[log["status"] == own_loop.UNKNOWN]
    assert len(unknown) == 12
    assert len(log) == 312
    np.testing.assert_array_equal(unknown["torque"], log["torque"][299:300].repeat(12, axis=0))
    g = arm.plant.dynamics.g(log["q"][299])  # it moves slowly, so that is what holds it up
    assert np.abs(unknown["torque"][0] - g).max() < 0.3 * np.abs(g).max()


def test_a_blind_arm_waits_and_goes_on_from_where_it_is_seen(own_loop):
    class Blinking(Arm):
        def read(self):
            self.fault = "blind" if len(self.torques) < 700 else ""
            return super().read()

    arm = Blinking()
    why, log = lead(own_loop, arm, 8.0)
    assert why == "asked to"
    assert (log["status"][400:700] == aj.Status.MEASUREMENT_LOST).any()
    jumps = np.abs(np.diff(log["torque"][699:710], axis=0)).max()
    assert jumps < 5.0
    assert np.linalg.norm(log["x"][7999] - GOAL) < 2e-3


def test_whatever_happens_the_brakes_close(own_loop):
    arm = Arm("fails")
    with pytest.raises(ConnectionError):
        lead(own_loop, arm)
    assert arm.brakes == 1


def test_the_log_keeps_the_last_cycles(own_loop):
    _, log = lead(own_loop, Arm(), 0.5, rows=100)
    assert len(log) == 100
    np.testing.assert_allclose(np.diff(log["t"]), 1e-3)


def test_the_target_moves_at_its_speed_in_every_kind_of_task(own_loop):
    task = aj.PoseTask(aj.load_robot("panda"))
    aim = task.value(np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]))
    goal = task.displaced(aim, np.array([0.0, 0.0, 0.1, 0.3, 0.0, 0.0]))
    step = own_loop.moved(task, aim, goal, 0.01)
    assert np.linalg.norm(task.error(step, aim)) == pytest.approx(0.01)
    np.testing.assert_allclose(own_loop.moved(task, aim, goal, 1.0), goal, atol=1e-12)
    np.testing.assert_allclose(own_loop.moved(task, goal, goal, 0.01), goal, atol=1e-12)


def test_after_a_late_torque_it_goes_on_at_the_next_whole_period(own_loop):
    class Timed(Arm):
        def send(self, torque):
            super().send(torque)
            CLOCK.now += 3.7e-3 if len(self.torques) == 10 else 0.2e-3

    _, log = lead(own_loop, Timed(), 0.02)
    begins = np.cumsum(log["gap"]) - log["work"]
    periods = np.concatenate([np.arange(10), np.arange(13, 21)])  # three are left out
    np.testing.assert_allclose(begins[:18], 1e-3 * periods, atol=1e-9)
    assert log["work"][9] == pytest.approx(3.7e-3)


def test_waiting_ends_when_it_is_due(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    from own_loop import wait_until

    due = time.perf_counter() + 5e-3
    wait_until(due)
    assert time.perf_counter() >= due
    wait_until(due - 1.0)  # what is over is not waited for


@pytest.mark.study
def test_the_example_arrives_although_it_was_blind_and_stands_still(
    own_loop, tmp_path, monkeypatch
):
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    monkeypatch.setattr(sys, "argv", ["11_your_own_loop.py", "--out", str(tmp_path)])
    ran = runpy.run_path(str(EXAMPLES / "11_your_own_loop.py"), run_name="__main__")
    assert ran["why"] == "asked to"
    at_start, _, seen_again, arrived = ran["error"][list(ran["at"].values())]
    assert at_start > 200.0
    assert seen_again > 5.0  # what it had learnt to hold went on pushing it there
    assert arrived < 1.0
    assert ran["speed"][-1] <= 0.02
    assert 1.0 < ran["jump"] < 4.0
    assert (ran["log"]["status"] == own_loop.UNKNOWN).sum() == 3
