"""Defaults: the ten-line example needs no numbers but lengths, on every arm that loads by name."""

import numpy as np
import pytest
from arms import ARMS, SEVERAL
from common import carried_object
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.robots import GravityRegressor
from approxjac.robots.load import NAMED, urdf_path
from approxjac.tasks import best_axes
from approxjac.tasks.analysis import sees

OFFSET = 0.05  # of the target from the start along each axis [m], with signs that alternate


def ten_lines(name):
    length, mass = carried_object(name)  # 20 cm and 0.5 kg, less for the light arms
    arm = aj.load_robot(name)
    truth = arm.with_object(length=length, mass=mass)
    belief = arm.with_object(length=0.0)
    plant = aj.Plant(truth)
    controller = aj.SetpointController(aj.PositionTask(belief), gravity=aj.AdaptiveGravity(belief))
    start = plant.sensor.value(plant.ready_configuration())
    target = start + OFFSET * np.array([1.0, -1.0, 1.0])[: len(start)]
    return aj.simulate(plant, controller, target)


def test_the_ten_lines_on_a_panda():
    run = ten_lines("panda")
    assert run.error_norm[0] == pytest.approx(OFFSET * 3**0.5)
    assert run.error_norm[run.t >= 9.0].max() < 1e-3
    assert run.t[-1] == 10.0
    assert_allclose(np.diff(run.t), 1e-3, rtol=1e-6)


@pytest.mark.study
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            arm.id,
            marks=arm.marks if arm.id == "so100" else (*arm.marks, pytest.mark.long),
            id=arm.id,
        )
        for arm in SEVERAL
        if arm.id != "panda"
    ],
)
def test_the_ten_lines_on_every_other_arm(name):
    assert ten_lines(name).error_norm[-1] < 1e-3


@pytest.mark.parametrize("name", ARMS)
def test_the_ready_configuration_is_regular_held_and_within_the_limits(name):
    length, mass = carried_object(name)
    plant = aj.Plant(aj.load_robot(name).with_object(length, mass))
    q = plant.ready_configuration()
    assert_array_equal(q, plant.ready_configuration())
    assert (np.abs(plant.dynamics.g(q)) <= 0.7 * plant.robot.effort_limits).all()
    values = np.linalg.svd(plant.sensor.jacobian(q), compute_uv=False)
    assert values[-1] > 0.1 * values[0]
    assert plant.sensor.value(q).shape == (min(3, plant.robot.nv),)


def test_the_ready_configuration_is_one_that_the_motors_hold(panda):
    q = aj.Plant(panda).ready_configuration()
    weak = aj.Plant(panda, torque_limits=20.0)
    assert (np.abs(weak.dynamics.g(q)) > 14.0).any()
    assert (np.abs(weak.dynamics.g(weak.ready_configuration())) <= 14.0).all()
    with pytest.raises(aj.InvalidInputError, match="q0 must be given for panda: no configuration"):
        aj.Plant(panda, torque_limits=1e-3).ready_configuration()


def test_the_ready_configuration_is_one_that_the_camera_sees(panda):
    looks = aj.PinholeCamera(
        800.0, (640, 480), (1.5, 0.0, 0.5), [[0, 0, -1], [1, 0, 0], [0, -1, 0]]
    )
    plant = aj.Plant(panda, aj.ImageTask(panda, looks))
    assert sees(plant.sensor, plant.ready_configuration())


def test_the_sensor_is_by_default_the_position_of_the_tip(panda):
    held = panda.with_object(0.2)
    assert repr(aj.Plant(held).sensor) == repr(aj.PositionTask(held, "object_tip", "xyz"))
    branched = aj.load_robot(urdf_path(NAMED["panda"]))
    with pytest.raises(aj.InvalidInputError, match="frame must be named: panda has more than one"):
        aj.Plant(branched)


def test_an_arm_of_few_joints_has_the_axes_that_it_commands(two_link):
    assert aj.PositionTask(two_link).labels == ("x", "z")
    assert best_axes(two_link, "tool0") == "xz"
    assert best_axes(aj.load_robot("ur5")) == "xyz"
    slider = two_link.with_locked_joints({"joint2": 0.0})
    assert aj.PositionTask(slider).m == 1


def test_a_planar_arm_of_four_joints_has_two_axes(panda):
    turned = ("panda_joint1", "panda_joint3", "panda_joint5")  # about axes within its plane
    planar = panda.with_locked_joints(dict.fromkeys(turned, 0.0))
    assert planar.nv == 4
    assert aj.PositionTask(planar).labels == ("x", "z")
    aj.default_gains(aj.PositionTask(planar))
    rounded = planar.with_kinematic_error(rotations={"panda_joint4": (4e-6, 0.0, 0.0)})
    assert aj.PositionTask(rounded).labels == ("x", "z")  # as of an rpy of 1.5708
    with pytest.raises(aj.InvalidInputError, match=r"does not command, such as y by axes=\"xz\""):
        aj.default_gains(aj.PositionTask(planar, axes="xyz"))


def test_learnt_gravity_needs_the_believed_robot_only(panda):
    short, long = aj.AdaptiveGravity(panda), aj.AdaptiveGravity(GravityRegressor(panda))
    assert short.regressor.names == long.regressor.names
    assert_array_equal(short.theta0, long.theta0)
    with pytest.raises(
        aj.InvalidInputError, match="model must be the believed Robot, or a GravityRegressor of it"
    ):
        aj.AdaptiveGravity(aj.PositionTask(panda))
