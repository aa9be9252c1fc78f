"""Regions of joint space: what they hold, what they draw, and when they are empty."""

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.8, 0.0])


def regions(panda):
    task = aj.PositionTask(panda)
    plant = aj.Plant(panda.with_object(0.2), aj.PositionTask(panda.with_object(0.2)))
    controller = aj.SetpointController(aj.PositionTask(panda.with_object(0.0)))
    box = aj.JointBox.around(panda, Q, 0.3)
    target = plant.sensor.value(Q) + [0.05, 0.0, 0.05]
    return {
        "limits": aj.JointBox(panda),
        "box": box,
        "tube": aj.stability.Tube(panda, np.linspace(Q, Q + 0.5, 20), 0.1),
        "regular": aj.stability.RegularPart(aj.JointBox(panda), task, 0.2),
        "sublevel": aj.stability.SublevelSet(plant, controller, target, Q),
    }


@pytest.mark.parametrize("name", ["limits", "box", "tube", "regular", "sublevel"])
def test_what_is_drawn_is_contained_and_so_is_what_is_near(panda, name):
    region = regions(panda)[name]
    drawn = region.sample(60, np.random.default_rng(1))
    assert drawn.shape == (60, 7)
    assert all(region.contains(q) for q in drawn)
    rng = np.random.default_rng(2)
    near = np.array([region.near(q, 0.05, rng) for q in drawn])
    assert all(region.contains(q) for q in near)
    assert 0 < np.abs(near - drawn).max() < 0.5 * region.spread.max()
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


def test_a_box_may_be_one_posture(panda):
    box = aj.JointBox.around(panda, Q, 0.0)
    assert_array_equal(box.sample(3, np.random.default_rng(0)), [Q, Q, Q])
    assert_array_equal(box.near(Q, 0.1, np.random.default_rng(0)), Q)


def test_continuous_joints_are_counted_from_the_centre():
    kinova = aj.load_robot("kinova")
    q = kinova.random_configuration(np.random.default_rng(0))
    box = aj.JointBox.around(kinova, q, 0.2)
    drawn = box.sample(50, np.random.default_rng(0))
    assert drawn.shape == (50, 9)
    motions = np.array([pin.difference(kinova.model, q, each) for each in drawn])
    assert 0.15 < np.abs(motions).max() <= 0.2 + 1e-9
    assert all(box.contains(each) for each in drawn)


def test_sublevel_set_is_where_v_lets_the_arm_go(two_link):
    """All its postures have V ≤ V(start), and motions that start there stay in it."""
    plant = aj.Plant(two_link, aj.PositionTask(two_link, axes="xz"))
    controller = aj.SetpointController(
        aj.PositionTask(two_link, axes="xz"),
        aj.Gains(100.0, 60.0),
        gravity=aj.controllers.ModelGravity(two_link),
    )
    start, target_posture = np.array([0.65, 1.15]), np.array([0.8, 1.0])
    target = plant.sensor.value(target_posture)
    region = aj.stability.SublevelSet(plant, controller, target, start)
    assert region.contains(start)
    assert region.contains(target_posture)
    level = 100.0 * 0.5 * np.sum((plant.sensor.value(start) - target) ** 2)
    assert_allclose(region.level, level)
    drawn = region.sample(100, np.random.default_rng(0))
    values = [50.0 * np.sum((plant.sensor.value(q) - target) ** 2) for q in drawn]
    assert max(values) <= level
    assert max(values) > 0.8 * level  # it is filled up to its rim
    # the other elbow posture of the target belongs to another part, which is not connected
    assert np.sin(drawn[:, 1]).min() > 0.0
    run = aj.simulate(plant, controller, target, start, 5.0, dt=4e-3, record_every=0.04)
    assert all(region.contains(q) for q in run.q)


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
    with pytest.raises(aj.InvalidInputError, match="radius must be > 0 in every joint, or the reg"):
        aj.stability.Tube(panda, np.array([Q]), 0.0)
    with pytest.raises(
        aj.InvalidInputError, match=r"configurations must be of shape \(N, 7\) with N > 0"
    ):
        aj.stability.Tube(panda, np.zeros((0, 7)))
    plant = aj.Plant(panda, task)
    controller = aj.SetpointController(task)
    with pytest.raises(
        aj.InvalidInputError, match=r"q0 must be in JointBox.*or the region is empty"
    ):
        aj.stability.SublevelSet(plant, controller, task.value(Q), Q + 3.0)


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
