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
from approxjac.errors import ApproxJacError, ControlError, InvalidInputError
from approxjac.realtime import Fault, Scheduling, SimulatedDriver, Tolerances, control
from approxjac.realtime.driver import read, two_clocks
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
    found = run(driver_of(plant, kind), controller, 0.1)
    assert_array_equal(found.q, run(driver_of(plant), controller, 0.1).q)
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


def odd(**parts):
    return lambda m: m._replace(**parts)


ODD = {  # what a driver may answer, and what the error says of it
    "nothing": (lambda m: None, "must be a Measurement"),
    "a tuple": (tuple, "must be a Measurement"),
    "too few": (lambda m: tuple(m)[:3], "must be a Measurement"),
    "its class": (lambda m: aj.Measurement, "must be a Measurement"),
    "t None": (odd(t=None), "t of a measurement must be a finite number"),
    "t text": (odd(t="0.1"), "t of a measurement must be a finite number"),
    "t bool": (odd(t=True), "t of a measurement must be a finite number"),
    "t NaN": (odd(t=math.nan), "t of a measurement must be a finite number"),
    "t complex": (odd(t=1j), "t of a measurement must be a finite number"),
    "t array": (odd(t=np.zeros(2)), "t of a measurement must be a finite number"),
    "t_x NaN": (odd(t_x=math.nan), "t_x of a measurement must be a finite number"),
    "t_x infinite": (odd(t_x=math.inf), "t_x of a measurement must be a finite number"),
    "t_x text": (odd(t_x="now"), "t_x of a measurement must be a finite number"),
    "q None": (odd(q=None), "q of a measurement must be an array of real numbers"),
    "q complex": (lambda m: m._replace(q=m.q + 0j), "q of a .* real numbers, .* got .*0.j"),
    "q text": (odd(q=["a"] * 7), "q of a measurement must be an array of real numbers"),
    "v bool": (lambda m: m._replace(v=m.v > 9.0), "v of a measurement must be .* real numbers"),
    "v a dict": (odd(v={"a": 1.0}), "v of a measurement must be an array of real numbers"),
    "v ragged": (odd(v=[[0.0], [0.0, 1.0]]), "v of a measurement must be .* real numbers"),
    "x None": (odd(x=None), "x of a measurement must be .* real numbers, NaN where unknown"),
    "x objects": (odd(x=np.array([None] * 3)), "x of a measurement must be .* real numbers"),
    "x a number": (odd(x=0.5), r"got shapes \(7,\), \(7,\), \(\)"),
    "x a column": (lambda m: m._replace(x=m.x[:, None]), r"got shapes .* \(3, 1\)"),
    "q too long": (lambda m: m._replace(q=np.zeros(8)), r"got shapes \(8,\)"),
}


@pytest.mark.parametrize("what", ODD)
def test_what_is_no_measurement_is_refused_by_name(plant, controller, what):
    """Before the run begins nothing is sent; in its midst the arm is braked."""
    spoil, message = ODD[what]

    class Odd(Wrapped):
        after = 0

        def read(self):
            m = super().read()
            return spoil(m) if len(self.sent) >= self.after else m

    driver = driver_of(plant, Odd)
    with pytest.raises(InvalidInputError, match=message):
        run(driver, controller, 0.1)
    assert (len(driver.sent), driver.brakes) == (0, 1)
    driver = driver_of(plant, Odd)
    driver.after = 20
    with pytest.raises(ControlError, match=message) as caught:
        run(driver, controller, 0.1)
    assert caught.value.given.fault is Fault.FAILED
    assert (len(driver.sent), driver.brakes) == (20, 1)


@pytest.mark.parametrize("odd", [None, "text", (1.0,), [[0.0], [0.0, 1.0]], 1j, np.zeros((2, 2))])
def test_an_odd_measurement_prints_itself(odd):
    assert repr(aj.Measurement(odd, odd, odd, odd, odd)).startswith("Measurement(t=")


@pytest.mark.parametrize(
    "kind", [list, tuple, np.float32, np.longdouble, np.ma.array], ids=lambda kind: kind.__name__
)
def test_numbers_of_any_kind_are_read_as_copies_that_nobody_changes(panda, kind):
    task = aj.PositionTask(panda)
    given = np.arange(7.0), np.zeros(7), np.arange(3.0)
    cast = kind if kind in (list, tuple, np.ma.array) else lambda a: a.astype(kind)

    class Own:
        def read(self):
            return aj.Measurement(np.float32(1.0), *map(cast, given), np.int64(1))

    seen = read(Own(), task)
    for name, own in zip("qvx", given, strict=True):
        copied = getattr(seen, name)
        assert_array_equal(copied, own)
        assert copied.dtype == np.float64
        assert not copied.flags.writeable
        assert not np.shares_memory(copied, own)
    assert (seen.t, seen.t_x) == (1.0, 1)


def test_whole_numbers_are_numbers(panda):
    task = aj.PositionTask(panda)

    class Whole:
        def read(self):
            return aj.Measurement(0, np.arange(7), np.zeros(7, np.uint8), [1, 2, 3])

    assert_array_equal(read(Whole(), task).q, np.arange(7.0))


@pytest.mark.parametrize("huge", [1e30, 1e200, 1e308])
@pytest.mark.parametrize("name", ["t", "q", "v", "x", "t_x"])
def test_numbers_beyond_all_bounds_end_a_run_by_name(plant, controller, name, huge):
    class Huge(Wrapped):
        def read(self):
            m = super().read()
            if len(self.sent) < 20:
                return m
            return m._replace(**{name: huge + 0.0 * np.asarray(getattr(m, name))[()]})

    driver = driver_of(plant, Huge)
    found = run(driver, controller, 0.1)
    assert found.fault is not None
    assert found.fault is not Fault.FAILED
    assert driver.brakes == 1
    assert np.isfinite(driver.sent).all()


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"dt": None}, "dt of the driver must be a finite number > 0"),
        ({"dt": 0.0}, "dt of the driver must be a finite number > 0"),
        ({"limits": None}, "limits of the driver must be"),
        ({"command": "position"}, "command of the controller must be 'position'"),
    ],
)
def test_what_a_driver_says_of_itself_is_checked(plant, controller, parts, message):
    driver = driver_of(plant)
    vars(driver).update(parts)
    with pytest.raises(InvalidInputError, match=message):
        run(driver, controller, 0.1)
    assert not driver.sent


@pytest.mark.parametrize("huge", [1e30, 1e308, math.nan, None, "state"])
def test_a_state_that_is_none_is_refused(plant, controller, huge):
    first = np.asarray(controller.initial_state(plant.measure(0.0, START, np.zeros(7))))
    state = huge if huge in (None, "state") else np.full_like(first, huge)
    if huge is None:
        state = [None] * len(first)
    driver = driver_of(plant)
    with pytest.raises(ApproxJacError) as caught:
        run(driver, controller, 0.1, state=state)
    assert not isinstance(caught.value, ControlError)
    assert not driver.sent


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

    def advance(self, state, measurement, target, dt):
        after, answer = self.controller.advance(state, measurement, target, dt)
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


@pytest.mark.study
def test_an_observer_cannot_exchange_the_limits_away(plant, controller):
    refused = []

    def observe(loop):
        if not refused:
            try:
                loop.exchange(loop.controller.controller)
            except InvalidInputError as error:
                refused.append(str(error))

    run(driver_of(plant), controller, 0.05, observer=observe)
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


def test_motors_behind_gears_stand_with_an_arm_that_is_braked(plant):
    drives = aj.robots.Drives.usual(plant.robot)
    driver = SimulatedDriver(aj.Plant(plant.robot, drives=drives), START, pace=math.inf)
    for _ in range(30):
        driver.read()
        driver.send(0.3 * plant.robot.effort_limits)
    assert np.abs(driver.read().v).max() > 0.05  # at the motors, where the encoders are
    driver.brake()
    driver.read()
    assert not driver.read().v.any()


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


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has such scheduling")
def test_a_loop_has_its_processor_and_gives_it_back():
    before = os.sched_getaffinity(0), os.sched_getscheduler(0)
    cpu = max(before[0])
    with real_time(Scheduling(cpu)):
        assert os.sched_getaffinity(0) == {cpu}
    assert (os.sched_getaffinity(0), os.sched_getscheduler(0)) == before
    for wrong in (Scheduling(cpu=4096), Scheduling(cpu, priority=100), Scheduling(priority=-1)):
        with pytest.raises(InvalidInputError) as refused, real_time(wrong):
            pass
        assert refused.value.given is wrong
        assert (os.sched_getaffinity(0), os.sched_getscheduler(0)) == before
    try:
        with real_time(Scheduling(priority=3)):
            assert os.sched_getscheduler(0) == os.SCHED_FIFO
            assert os.sched_getparam(0).sched_priority == 3
    except InvalidInputError:
        pass  # a user without the permission
    assert (os.sched_getaffinity(0), os.sched_getscheduler(0)) == before
