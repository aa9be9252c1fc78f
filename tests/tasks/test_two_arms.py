"""Two arms on one torso: both tips as one stacked task, and one controller for both."""

import numpy as np
import pytest

import approxjac as aj
from approxjac.robots import GravityRegressor

INERTIA = '<inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/>'


def arm(side, y):
    """Four joints, the first about the vertical, and a tip."""
    names = [f"{side}_{name}" for name in ("shoulder", "upper", "lower", "hand")]
    parts, parent = [], "torso"
    for k, (name, axis) in enumerate(zip(names, ("0 0 1", "0 1 0", "0 1 0", "0 1 0"), strict=True)):
        place = f"0 {y} 0.4" if k == 0 else "0.05 0 0" if k == 1 else "0.35 0 0"
        parts.append(
            f'<link name="{name}"><inertial><origin xyz="0.15 0 0"/><mass value="{3 - 0.6 * k}"/>'
            f'{INERTIA}</inertial></link><joint name="{name}_joint" type="revolute">'
            f'<parent link="{parent}"/><child link="{name}"/><origin xyz="{place}"/>'
            f'<axis xyz="{axis}"/><limit lower="-2.5" upper="2.5" effort="80" velocity="3"/>'
            "</joint>"
        )
        parent = name
    parts.append(
        f'<link name="{side}_tip"/><joint name="{side}_tip_joint" type="fixed"><parent '
        f'link="{parent}"/><child link="{side}_tip"/><origin xyz="0.1 0 0"/></joint>'
    )
    return "".join(parts)


ARMS = arm("left", 0.25) + arm("right", -0.25)
URDF = f'<robot name="two_arms"><link name="torso"/>{ARMS}</robot>'
SHIFTS = {"left_hand_joint": [0.03, 0.0, 0.02], "right_lower_joint": [0.0, 0.02, -0.03]}
START = np.array([0.1, 0.5, 0.8, 0.4, -0.1, 0.4, 0.9, 0.5])


def tips(robot):
    return aj.StackedTask(aj.PositionTask(robot, "left_tip"), aj.PositionTask(robot, "right_tip"))


@pytest.mark.study
def test_two_wrong_arms_reach_two_targets_at_once():
    believed = aj.load_robot(URDF)
    truth = believed.with_kinematic_error(SHIFTS)
    plant, task = aj.Plant(truth, tips(truth), 0.2), tips(believed)
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(GravityRegressor(believed)))
    wrong = task.value(START) - plant.sensor.value(START)
    assert np.abs(wrong).max() > 0.02  # of what is believed of the tips
    target = plant.sensor.value(START) + [0.05, -0.05, 0.1, -0.05, 0.05, 0.1]
    run = aj.simulate(plant, law, target, START, 6.0, dt=1e-3)
    assert run.error_norm[0] > 0.17
    assert run.error_norm[-1] < 1e-3
    assert set(run.status_counts()) <= {aj.Status.OK, aj.Status.OUT_OF_REACH}
    assert run.task_labels == task.labels
    assert len(run.task_labels) == 6


@pytest.mark.study
def test_one_arm_does_not_wait_for_the_other():
    """What only the left tip has to do leaves the right arm where it is."""
    robot = aj.load_robot(URDF)
    plant, law = aj.Plant(robot, tips(robot), 0.2), aj.SetpointController(tips(robot))
    target = plant.sensor.value(START) + [0.05, -0.05, 0.1, 0.0, 0.0, 0.0]
    run = aj.simulate(plant, law, target, START, 3.0, dt=1e-3)
    assert np.abs(run.error[-1]).max() < 1e-3
    assert np.abs(run.x[:, 3:] - run.x[0, 3:]).max() < 1e-3
    J = law.task.jacobian(START)
    assert J[:3, 4:] == pytest.approx(0.0)
    assert J[3:, :4] == pytest.approx(0.0)


def test_two_ends_have_to_be_named():
    told = "likely tips are left_hand, right_hand, left_tip, right_tip"
    with pytest.raises(aj.InvalidInputError, match=told):
        aj.PositionTask(aj.load_robot(URDF))
