"""Targets that are eased in from a motion that is much faster than they may be."""

import functools
import time

import numpy as np
import pytest
from heavy_arms import HeavyArm
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.realtime import Tolerances
from approxjac.realtime.brake import Brake, HungError, Watchdog
from approxjac.realtime.robot_loop import BlendedTarget, Halt

SPEED = np.array([0.2, 0.2, 0.1])
FAST = [np.array([0.0, 0.0, 0.0]), np.array([1.5, 0.0, 0.0]), np.array([-0.3, 0.8, 0.9])]


@functools.cache
def task():
    return HeavyArm("three_joint").task


def rates(path, times, h=1e-5):
    """Velocities and accelerations by differences."""
    x = [np.array([path.at(t + k * h).x for t in times]) for k in (-1, 0, 1)]
    return (x[2] - x[0]) / (2.0 * h), (x[2] - 2.0 * x[1] + x[0]) / h**2


@pytest.mark.parametrize("velocity", FAST)
@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_a_fast_start_is_slowed_down_gently(velocity, offset):
    """Neither faster than it begins and than it may be, together, nor braked harder than is usual.

    What is too fast is brought to rest with at most the deceleration that takes `speed` away in
    the shortest time, 0.2 s.
    """
    goal = np.array([0.5, 0.1, 0.4])
    begin = goal + offset * np.array([1.0, -0.6, 0.3])
    eased = BlendedTarget(task(), goal, 0.0, begin, velocity, SPEED)
    times = np.linspace(1e-4, eased.duration - 1e-4, 400)
    speeds, accelerations = rates(eased, times)
    assert_allclose(speeds[0], velocity, atol=2e-2)  # it begins as fast as the tip moves
    assert (np.abs(speeds) <= np.abs(velocity) + SPEED + 1e-6).all()
    if not offset and velocity.any():
        share = np.abs(accelerations) / (SPEED / 0.2)
        assert 0.9 < share.max() <= 1.0
        # all coordinates in the same time: the one that is too fast by most has all of it
        assert share[:, (np.abs(velocity) / SPEED).argmax()].max() == share.max()
    assert_allclose(eased.at(eased.duration).x, goal, atol=1e-12)


@pytest.mark.parametrize("velocity", FAST)
def test_a_fast_path_is_joined_from_its_own_speed(velocity):
    """What counts is the velocity relative to the path: one that is the path's needs no time."""
    path = aj.Line((0.3, 0.0, 0.4), (0.9, 0.3, 0.4), 0.5)
    begin = 0.05
    own = path.at(begin).v
    eased = BlendedTarget(task(), path, begin, path.at(begin).x, own, SPEED)
    for t in np.linspace(begin, begin + 0.3, 20):
        assert_allclose(eased.at(t).x, path.at(t).x, atol=1e-9)
    relative = BlendedTarget(task(), path, begin, path.at(begin).x, own + velocity, SPEED)
    alone = BlendedTarget(task(), path.at(begin).x, begin, path.at(begin).x, velocity, SPEED)
    assert_allclose(relative.duration, alone.duration, rtol=1e-9)
    assert relative.duration >= 0.2


@pytest.mark.parametrize("dt", [0.5e-3, 2e-3, 5e-3])
def test_from_period_to_period_the_target_moves_by_what_it_may(dt):
    """At rest at first: no step of it is longer than `speed` dt, and the longest is nearly that."""
    goal = np.array([0.5, 0.1, 0.4])
    begin = goal + np.array([0.2, -0.1, 0.02])
    eased = BlendedTarget(task(), goal, 1.0, begin, np.zeros(3), SPEED)
    times = np.arange(1.0, 1.0 + eased.duration + 2 * dt, dt)
    steps = np.abs(np.diff([eased.at(t).x for t in times], axis=0)).max(axis=0)
    assert (steps <= SPEED * dt * (1.0 + 1e-9)).all()
    assert (steps / SPEED).max() > 0.99 * dt
    assert np.abs(eased.at(1.0 + dt).x - begin).max() < 0.02 * 0.2 * dt  # from rest, with no jump


@pytest.mark.parametrize("dt", [0.5e-3, 2e-3, 5e-3])
def test_a_halt_is_as_long_as_it_says_at_any_period(dt):
    """Steady deceleration: half of what the velocity would go in that time, and no jump."""
    x, v = np.array([0.5, 0.1, 0.4]), np.array([0.4, -0.2, 0.0])
    halt = Halt(task(), 2.0, x, v, 0.3)
    assert_allclose(halt.distance, 0.15 * v)
    times = np.arange(2.0, 2.5, dt)
    places = np.array([halt.at(t).x for t in times])
    assert_allclose(places[0], x)
    assert_allclose(places[-1], x + halt.distance, atol=1e-12)
    speeds = np.diff(places, axis=0) / dt
    assert (np.abs(speeds) <= np.abs(v) * (1.0 + 1e-9)).all()
    changes = np.diff(speeds, axis=0) / dt
    assert (np.abs(changes) <= np.abs(v) / 0.3 * (1.0 + 1e-6) + 1e-9).all()
    assert_allclose(halt.at(2.1).v, (1.0 - 0.1 / 0.3) * v)
    assert_allclose(halt.at(2.1).a, -v / 0.3)
    assert_allclose(halt.at(1.9).x, x)


@pytest.mark.parametrize(
    "dt", [*(pytest.param(k, marks=pytest.mark.study) for k in (0.5e-3, 2e-3)), 5e-3]
)
def test_a_rehearsed_arm_is_brought_to_rest_and_braked_at_any_period(dt):
    """The eased target leads it there; at the end the target halts, and then the brake closes."""
    arm = HeavyArm("three_joint")
    law = aj.SetpointController(
        arm.task, gravity=aj.controllers.ModelGravity(arm.truth), latency=aj.Latency(dt)
    )
    law = aj.TorqueLimited(law, aj.Limits.of(arm.belief), dt=dt)
    driver = aj.realtime.SimulatedDriver(arm.plant, arm.q, dt=dt, pace=np.inf)
    seen = []

    class Watched:
        def __init__(self):
            self.dt, self.command, self.limits = driver.dt, driver.command, driver.limits
            self.adds_gravity, self.read, self.send = False, driver.read, driver.send

        def brake(self):
            seen.append(driver.v.copy())
            driver.brake()

    x_d = arm.sensor.value(arm.q) + np.array([0.0, 0.05, -0.03])
    found = aj.control(Watched(), law, x_d, 0.7, tolerances=Tolerances(max_period=5.0))
    assert found.fault is None
    assert len(seen) == 1
    assert np.abs(seen[0]).max() < 0.06
    assert driver.braked
    q = driver.q.copy()
    driver.advance(10 * dt)
    assert (driver.q == q).all()
    assert not driver.v.any()
    assert np.abs(np.diff(found.x_d, axis=0)).max() <= 0.2 * dt * (1.0 + 1e-6)
    assert 0.0 < found.stop_distance <= found.stop_bound
    assert found.error_norm[-1] < 2e-3


class Robot:
    """A robot that remembers what it was told."""

    def __init__(self, error=None):
        self.error, self.brakes, self.sent = error, 0, []

    def brake(self):
        self.brakes += 1
        if self.error is not None:
            raise self.error

    def send(self, command):
        self.sent.append(command)


@pytest.mark.parametrize("error", [None, OSError("the cable"), KeyboardInterrupt()])
def test_a_brake_closes_once_and_then_nothing_is_sent(error):
    robot = Robot(error)
    brake = Brake(robot)
    brake.send(np.ones(3))
    assert brake.closed_at is None
    for _ in range(3):
        brake.close()
    assert robot.brakes == 1
    assert brake.error is error
    with pytest.raises(HungError):
        brake.send(np.ones(3))
    assert len(robot.sent) == 1


def test_a_watchdog_leaves_a_loop_alone_that_comes_round():
    """And bites one that does not, no sooner than it may and not much later."""
    robot = Robot()
    brake = Brake(robot)
    with Watchdog(brake, 0.6) as watchdog:  # a busy machine has some time to come round
        for _ in range(3):
            time.sleep(0.2)
            watchdog.beat()
        assert not watchdog.bit
        assert robot.brakes == 0
        begin = time.perf_counter()
        with pytest.raises(HungError):
            time.sleep(3.0)
    assert watchdog.bit
    assert robot.brakes == 1
    assert brake.closed_at - begin > 0.55
    assert time.perf_counter() - begin < 2.9
