"""Targets that are eased in: no jump of position or velocity, and then the path itself."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.realtime.robot_loop import BlendedTarget, Halt

PANDA = aj.load_robot("panda")
TASK = aj.PositionTask(PANDA)
CIRCLE = aj.Circle((0.5, 0.0, 0.5), 0.1, 4.0)
SPEED = np.full(3, 0.2)
numbers = st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3)


@given(offset=numbers, velocity=numbers, begin=st.floats(0.0, 3.0), r=st.floats(0.01, 0.99))
def test_rates_are_those_of_the_target(offset, velocity, begin, r):
    x = CIRCLE.at(begin).x + offset
    eased = BlendedTarget(TASK, CIRCLE, begin, x, np.array(velocity), SPEED)
    first = eased.at(begin)
    assert_allclose(first.x, x, atol=1e-12)
    assert_allclose(first.v, velocity, atol=1e-12)
    t, h = begin + r * eased.duration, 1e-5
    before, now, after = (eased.at(t + k * h) for k in (-1, 0, 1))
    assert_allclose((after.x - before.x) / (2.0 * h), now.v, atol=1e-6)
    assert_allclose((after.v - before.v) / (2.0 * h), now.a, atol=1e-4)
    end = begin + eased.duration
    for there, path in ((eased.at(end), CIRCLE.at(end)), (eased.at(end + 1.0), CIRCLE.at(end + 1))):
        for own, other in zip(there, path, strict=True):
            assert_allclose(own, other, atol=1e-9)


@given(offset=numbers)
def test_it_is_no_faster_than_it_may_be(offset):
    x = np.array([0.5, 0.0, 0.5])
    eased = BlendedTarget(TASK, x, 0.0, x + offset, np.zeros(3), SPEED)
    targets = [eased.at(t) for t in np.linspace(0.0, 0.999 * eased.duration, 50)]
    speeds = [0.0 if each.v is None else np.abs(each.v).max() for each in targets]
    assert max(speeds) <= 0.2 + 1e-12


@pytest.mark.parametrize("times", [0.1, 0.5, 2.0, 5.0])
def test_it_slows_down_as_gently_from_any_velocity(times):
    """By five times its speed in a second at most, and by nearly as much from a fast one."""
    x = np.array([0.5, 0.0, 0.5])
    eased = BlendedTarget(TASK, x, 0.0, x, times * SPEED * [1.0, -1.0, 0.5], SPEED)
    each = [eased.at(t).a for t in np.linspace(0.0, 0.999 * eased.duration, 200)]
    most = np.max(np.abs(each)) / 0.2
    assert most < 5.0
    assert most > (4.8 if times > 0.25 else 0.0)


def test_poses_turn_on_the_shortest_way():
    task = aj.PoseTask(PANDA)
    q = PANDA.neutral() + [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]
    x, goal = task.value(q), task.value(q + 0.3)
    eased = BlendedTarget(task, goal, 0.0, x, np.zeros(6), np.array([0.2] * 3 + [0.5] * 3))
    errors = [task.error(eased.at(t).x, goal) for t in np.linspace(0.0, eased.duration, 20)]
    assert_allclose(eased.at(0.0).x, x, atol=1e-9)
    assert_array_equal(eased.at(eased.duration).x, goal)
    assert (np.diff([np.linalg.norm(e) for e in errors]) <= 1e-12).all()
    for e in errors[:-1]:
        assert_allclose(np.cross(e[3:], errors[0][3:]), 0.0, atol=1e-9)


@pytest.mark.parametrize("velocity", [np.zeros(3), np.array([0.2, 0.0, -0.1])])
def test_a_halt_comes_to_rest_where_it_says(velocity):
    x = np.array([0.5, 0.0, 0.5])
    halt = Halt(TASK, 2.0, x, velocity, 0.3)
    assert_array_equal(halt.at(2.0).v, velocity)
    for t in (2.3, 9.0):
        assert_allclose(halt.at(t).x, x + halt.distance, atol=1e-12)
        assert_allclose(halt.at(t).v, 0.0, atol=1e-12)
    h = 1e-6
    slope = (halt.at(2.1 + h).x - halt.at(2.1 - h).x) / (2.0 * h)
    assert_allclose(slope, halt.at(2.1).v, atol=1e-8)
