"""Regions of joint space: what they hold, what they draw, and when they are empty."""

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.8, 0.0])


def regions(panda):
    task = aj.PositionTask(panda)
    box = aj.JointBox.around(panda, Q, 0.3)
    return {
        "limits": aj.JointBox(panda),
        "box": box,
        "regular": aj.stability.RegularPart(aj.JointBox(panda), task, 0.2),
    }


@pytest.mark.parametrize("name", ["limits", "box", "regular"])
def test_what_is_drawn_is_contained(panda, name):
    region = regions(panda)[name]
    drawn = region.sample(60, np.random.default_rng(1))
    assert drawn.shape == (60, 7)
    assert all(region.contains(q) for q in drawn)
    assert_array_equal(region.sample(60, np.random.default_rng(1)), drawn)


def test_box_holds_its_bounds_and_no_more(panda):
    box = aj.JointBox.around(panda, Q, 0.3)
    assert box.contains(Q)
    assert box.contains(Q + 0.3)
    assert not box.contains(Q + 0.31)
    drawn = box.sample(2000, np.random.default_rng(0)) - Q
    assert_allclose(drawn.min(axis=0), -0.3, atol=0.01)
    assert_allclose(drawn.max(axis=0), 0.3, atol=0.01)
    assert_allclose(drawn.mean(axis=0), 0.0, atol=0.02)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("name", ["two_link", "kinova"])
def test_a_box_ends_at_each_bound_of_each_joint(name, side):
    """Lower and upper bounds that differ, and joints that turn without end."""
    arm = aj.load_robot(name)
    lower, upper = -0.1 - 0.02 * np.arange(arm.nv), 0.3 + 0.01 * np.arange(arm.nv)
    center = np.linspace(0.2, 1.4, arm.nv)
    box = aj.JointBox(arm, lower, upper, center)
    q = arm.configuration(center)
    for joint, bounds in enumerate(zip(lower, upper, strict=True)):
        way = bounds[int(side > 0.0)] * np.eye(arm.nv)[joint]
        assert box.contains(np.array(pin.integrate(arm.model, q, 0.999 * way)))
        assert not box.contains(np.array(pin.integrate(arm.model, q, 1.001 * way)))


def test_a_box_may_be_one_posture(panda):
    box = aj.JointBox.around(panda, Q, 0.0)
    assert_array_equal(box.sample(3, np.random.default_rng(0)), [Q, Q, Q])


def test_continuous_joints_are_counted_from_the_centre():
    kinova = aj.load_robot("kinova")
    q = kinova.random_configuration(np.random.default_rng(0))
    box = aj.JointBox.around(kinova, q, 0.2)
    drawn = box.sample(50, np.random.default_rng(0))
    assert drawn.shape == (50, 9)
    motions = np.array([pin.difference(kinova.model, q, each) for each in drawn])
    assert 0.15 < np.abs(motions).max() <= 0.2 + 1e-9
    assert all(box.contains(each) for each in drawn)


def test_empty_regions_are_refused(panda):
    task = aj.PositionTask(panda)
    with pytest.raises(
        aj.InvalidInputError, match="lower must be at most upper in every joint, or"
    ):
        aj.JointBox(panda, 0.5, 0.4)
    with pytest.raises(
        aj.InvalidInputError, match=r"the region is empty: 0 of .* drawn of all .* have it, got 9"
    ):
        aj.stability.RegularPart(aj.JointBox(panda), task, 9.0).sample(5, np.random.default_rng(0))


def test_bounds_come_together(panda):
    for options in ({"lower": 0.0}, {"upper": 1.0}, {"center": Q}):
        with pytest.raises(aj.InvalidInputError, match="lower and upper must both be given, or"):
            aj.JointBox(panda, **options)
    with pytest.raises(aj.InvalidInputError, match=r"lower must have shape \(7,\)"):
        aj.JointBox(panda, (0.0, 0.0), (1.0, 1.0))


def test_boxes_of_continuous_joints_hold_what_they_draw():
    """Differences of continuous joints go half a turn either way: a box has to count from its
    middle."""
    kinova = aj.load_robot("kinova")
    lower, upper = np.full(6, -0.2), np.full(6, 0.2)
    lower[0], upper[0] = 2.5, 4.5
    box = aj.JointBox(kinova, lower, upper)
    drawn = box.sample(100, np.random.default_rng(0))
    assert all(box.contains(q) for q in drawn)


def test_regular_part_does_not_give_up_at_once(panda):
    task = aj.PositionTask(panda)
    region = aj.stability.RegularPart(aj.JointBox(panda), task, 0.3)
    assert all(len(region.sample(1, np.random.default_rng(seed))) == 1 for seed in range(100))


def test_a_box_around_a_posture_in_degrees_or_with_words_is_refused():
    panda = aj.load_robot("panda")
    with pytest.raises(aj.InvalidInputError, match="q must be in radians: it is 106"):
        aj.JointBox.around(panda, [0, -30, 0, -110, 0, 90, 40], 0.1)
    with pytest.raises(aj.InvalidInputError, match="radius must be numbers"):
        aj.JointBox.around(panda, Q, "wide")
