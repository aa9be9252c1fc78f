"""What drivers and threads do that a loop must stand: arrays, hangs, slow brakes, two arms."""

import gc
import math
import os
import signal
import sys
import threading
import time

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from rehearsal import START, Around, Wrapped, driver_of, goal, run

import approxjac as aj
from approxjac.errors import ControlError, InvalidInputError
from approxjac.realtime import Fault, Scheduling, SimulatedDriver, Tolerances, control
from approxjac.realtime.driver import two_clocks
from approxjac.realtime.robot_loop import RobotLoop
from approxjac.realtime.scheduling import Pace, real_time


class SameArrays(Wrapped):
    """Writes to the same arrays at every read."""

    kept = None

    def read(self):
        m = super().read()
        self.kept = self.kept or m._replace(q=m.q.copy(), v=m.v.copy(), x=m.x.copy())
        for own, new in zip(self.kept[1:4], m[1:4], strict=True):
            own[:] = new
        return self.kept._replace(t=m.t, t_x=m.t_x)


class Lists(Wrapped):
    def read(self):
        m = super().read()
        return m._replace(q=m.q.tolist(), v=m.v.tolist(), x=m.x.tolist())


@pytest.mark.parametrize("kind", [SameArrays, pytest.param(Lists, marks=pytest.mark.study)])
def test_arrays_of_a_driver_may_be_any(plant, controller, kind):
    found = run(driver_of(plant, kind), controller, 0.3)
    assert_array_equal(found.q, run(driver_of(plant), controller, 0.3).q)
    assert found.fault is None


def test_an_x_that_was_taken_never_is_one_whose_time_is_not_known(plant, controller):
    runs = []
    for t_x in (None, -math.inf):

        class Timeless(Wrapped):
            def read(self, t_x=t_x):
                return super().read()._replace(t_x=t_x)

        runs.append(run(driver_of(plant, Timeless), controller, 0.05))
        assert runs[-1].fault is None
    for name in ("q", "x", "error"):
        assert_array_equal(getattr(runs[1], name), getattr(runs[0], name))


def test_what_a_mask_hides_is_not_measured(plant, controller):
    class Masked(Wrapped):
        def read(self):
            m = super().read()
            return m._replace(q=np.ma.array(m.q, mask=len(self.sent) >= 100))

    driver = driver_of(plant, Masked)
    assert run(driver, controller).fault is Fault.JOINTS_UNKNOWN
    assert len(driver.sent) == 103


def test_arrays_of_another_shape_end_a_run(plant, controller):
    class Short(Wrapped):
        def read(self):
            m = super().read()
            return m._replace(x=m.x[:1]) if len(self.sent) == 100 else m

    with pytest.raises(ControlError, match=r"got shapes \(7,\), \(7,\), \(1,\); the arm was brak"):
        run(driver_of(plant, Short), controller)


def test_a_run_without_any_q_has_its_first_instant(plant, controller):
    class Lost(Wrapped):
        reads = 0

        def read(self):
            m, self.reads = super().read(), self.reads + 1
            return m if self.reads <= 5 else m._replace(q=np.full(7, np.nan))

    found = run(driver_of(plant, Lost), controller)
    assert found.fault is Fault.JOINTS_UNKNOWN
    assert_array_equal(found.q, [START])


@pytest.mark.parametrize("in_thread", [True, False])
def test_nothing_is_sent_once_the_watchdog_brakes(plant, controller, in_thread):
    class Slow(Wrapped):
        after = 0

        def read(self):
            if len(self.sent) == 100:
                time.sleep(0.3)
            return super().read()

        def send(self, command):
            self.after += self.brakes
            super().send(command)

        def brake(self):
            super().brake()
            time.sleep(0.5)  # meanwhile the loop comes round again

    driver, found = driver_of(plant, Slow), []

    def go():
        found.append(run(driver, controller, tolerances=Tolerances(max_period=0.05)))

    if in_thread:
        thread = threading.Thread(target=go)
        thread.start()
        thread.join()
    else:
        go()
    assert found[0].fault is Fault.READ_HUNG
    assert driver.brakes == 1
    assert driver.after == 0


class Spoiling(Around):
    """Its commands become NaN."""

    def step(self, state, measurement, target, dt):
        after, answer = self.controller.step(state, measurement, target, dt)
        worse = answer.torque * np.nan if measurement.t > 0.05 else answer.torque
        return after, answer._replace(torque=worse)


def test_no_command_that_is_not_finite_is_sent(plant, controller):
    driver = driver_of(plant)
    driver.limits = aj.Limits()
    with pytest.raises(
        ControlError, match=r"step of .* failed at t = 0.051 s: .*torque must be finite"
    ):
        run(driver, Spoiling(controller))
    assert np.isfinite(driver.sent).all()
    assert driver.brakes == 1


def test_no_command_follows_a_fault_that_the_answer_tells(plant, controller):
    class Lost(Wrapped):
        def read(self):
            m = super().read()
            return m if len(self.sent) < 100 else m._replace(x=np.full(3, np.nan))

    driver = driver_of(plant, Lost)
    assert (
        run(
            driver,
            controller,
            tolerances=Tolerances(max_blind_motion=9.0, timeout=0.1, max_period=2.0),
        ).fault
        is Fault.BLIND
    )
    assert len(driver.sent) == 200


def test_an_observer_cannot_exchange_the_limits_away(plant, controller):
    refused = []

    def observe(loop):
        if not refused:
            try:
                loop.exchange(loop.controller.controller)
            except InvalidInputError as error:
                refused.append(str(error))

    run(driver_of(plant), controller, 0.3, observer=observe)
    assert "must keep the robot's limits of effort" in refused[0]


def test_two_arms_leave_the_interpreter_as_it_was():
    before = sys.getswitchinterval(), gc.isenabled(), gc.get_freeze_count()
    first, second = real_time(Scheduling()), real_time(Scheduling())
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert not gc.isenabled()  # the other one still runs
    second.__exit__(None, None, None)
    assert (sys.getswitchinterval(), gc.isenabled(), gc.get_freeze_count()) == before


def test_a_second_signal_interrupts_a_start_that_hangs(plant, controller):
    class Hanging(Wrapped):
        def read(self):
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5.0)
            return super().read()

    driver, before = driver_of(plant, Hanging), signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run(driver, controller)
    assert driver.brakes == 1
    assert signal.getsignal(signal.SIGINT) == before


def test_a_bridge_of_long_periods_is_not_late(by_velocities, monkeypatch):
    plant, law = by_velocities
    # a busy machine may well stand still for 40 ms, and this is about the robot's clock
    monkeypatch.setattr(sys.modules["approxjac.realtime.control"], "_HANGS", 100.0)

    class Blinking(Wrapped):
        def read(self):
            m = super().read()
            return m._replace(q=np.full(7, np.nan)) if 50 <= len(self.sent) < 53 else m

    assert control(driver_of(plant, Blinking, dt=8e-3), law, goal(plant), 1.0).fault is None


def test_late_is_more_than_a_period(plant, controller):
    with pytest.raises(InvalidInputError, match=r"max_period .* > 0\.001"):
        control(
            SimulatedDriver(plant, START),
            controller,
            goal(plant),
            tolerances=Tolerances(max_period=1e-3),
        )


@pytest.mark.study
def test_targets_may_turn_round_in_mid_motion(plant, controller, monkeypatch):
    """Joints that share a motion go on swinging for a while: that is not too fast."""
    first = goal(plant)
    wishes = {300: lambda loop: aj.Circle(loop.target - [0.05, 0, 0], 0.05, 4.0)}
    wishes[700] = lambda loop: first

    advance = RobotLoop.advance

    def turning(loop):
        if loop.step in wishes:
            loop.aim_at(wishes[loop.step](loop))
        return advance(loop)

    monkeypatch.setattr(RobotLoop, "advance", turning)
    assert run(driver_of(plant), controller, 1.5).fault is None


def test_gravity_is_added_once(plant):
    arm = plant.robot
    adds = aj.Plant(arm, adds_gravity=arm)
    assert SimulatedDriver(adds).adds_gravity
    with pytest.raises(InvalidInputError, match="adds_gravity must be of a robot with the joints"):
        aj.Plant(arm, adds_gravity=aj.load_robot("xarm7"))


def test_periods_that_were_missed_are_left_out():
    """Of all periods that are counted, the last has begun, and none comes twice."""
    dt, count = 0.01, 0
    pace, begun = Pace(dt), time.perf_counter()
    for pause in (0.0, 0.035, 0.0, 0.0, 0.021, 0.0):
        time.sleep(pause)
        periods = pace.wait()
        count += periods
        passed = time.perf_counter() - begun
        assert periods >= max(1, math.floor(pause / dt))
        assert count * dt <= passed + 1e-3


@pytest.mark.parametrize("dt", [1e-3, 8e-3])
def test_x_may_be_stamped_later_than_its_state_by_little(dt):
    for ahead, clocks in ((-5.0, 1), (0.0, 1), (0.009 + dt, 1), (0.011 + dt, 2), (1.0, 2)):
        measured = aj.Measurement(100.0, START, START, START[:3], 100.0 + ahead)
        assert bool(two_clocks(measured, dt)) is (clocks == 2)
    assert not two_clocks(measured._replace(t_x=None), dt)
