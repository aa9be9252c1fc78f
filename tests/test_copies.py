"""Copies and pickles of what owns scratch memory: the same bits, and nothing shared."""

import copy
import pickle

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.controllers import (
    ControllerWrapper,
    DifferentiatedVelocity,
    Posture,
    RegressorGravity,
)
from approxjac.errors import SimulationError, UnknownNameError
from approxjac.law import Sine
from approxjac.robots import Dynamics, GravityRegressor
from approxjac.tasks import NonsingularTask

COPIES = {"pickle": lambda thing: pickle.loads(pickle.dumps(thing)), "deepcopy": copy.deepcopy}


@pytest.fixture(params=COPIES)
def copied(request):
    return COPIES[request.param]


def tasks(robot):
    position = aj.PositionTask(robot)
    return {
        "position": position,
        "plane": aj.PositionTask(robot, axes="xz"),
        "pose": aj.PoseTask(robot),
        "stacked": aj.StackedTask(position, aj.PositionTask(robot, "panda_link4", "z")),
        "nonsingular": NonsingularTask(position, {"panda_joint4": 0.3}),
        "image": aj.ImageTask(robot, PlanarCamera(0.05, 3.0, 0.3)),
        "pinhole": aj.ImageTask(
            robot,
            aj.PinholeCamera.looking_at(
                (0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480), distortion=(-0.1, 0.02)
            ),
            points=((0.0, 0.0, 0.0), (0.0, 0.05, 0.0)),
        ),
    }


def controllers(robot):
    task, gains = aj.PositionTask(robot), aj.Gains(400.0, 80.0, 1.0)
    regressor = GravityRegressor(robot)
    return {
        "defaults": aj.SetpointController(task),
        "no gravity": aj.SetpointController(task, gains, gravity=aj.NoGravity(robot)),
        "saturated": aj.SetpointController(task, gains, saturation=Sine(0.05)),
        "regressor": aj.SetpointController(
            task, gains, gravity=RegressorGravity(regressor, 0.9 * regressor.theta)
        ),
        "adaptive": aj.SetpointController(
            task, gains, gravity=aj.AdaptiveGravity(regressor, bounds=(-50.0, 50.0))
        ),
        "full L": aj.SetpointController(
            task, gains, gravity=aj.AdaptiveGravity(regressor, np.eye(regressor.p), 0.5)
        ),
        "tracking": aj.TrackingController(task),
        "law (5)": aj.SetpointController(task, gains, velocity=DifferentiatedVelocity()),
        "posture": aj.SetpointController(task, gains, posture=Posture(robot.neutral() + 0.1, 5.0)),
        "pose": aj.SetpointController(aj.PoseTask(robot)),
        "held": aj.HeldMeasurement(aj.TorqueLimited(aj.SetpointController(task, gains)), 0.1),
    }


@pytest.fixture(scope="module")
def holding(panda):
    return panda.with_object(0.2, 0.5)


@pytest.mark.parametrize(
    "kind", ["position", "plane", "pose", "stacked", "nonsingular", "image", "pinhole"]
)
def test_tasks(holding, copied, rng, kind):
    task = tasks(holding)[kind]
    other = copied(task)
    assert repr(other) == repr(task)
    assert other.robot == task.robot
    for _ in range(3):
        q, v = holding.random_configuration(rng), rng.normal(size=7)
        assert_array_equal(other.value(q), task.value(q))
        assert_array_equal(other.jacobian(q), task.jacobian(q))
        assert_array_equal(other.jacobian_dot(q, v), task.jacobian_dot(q, v))


@pytest.fixture(scope="module")
def built(holding):
    return controllers(holding)


KINDS = [
    "defaults", "no gravity", "saturated", "regressor", "adaptive", "full L", "law (5)",
    "posture", "pose", "held",
]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_controllers(holding, built, copied, rng, kind):
    controller = built[kind]
    other = copied(controller)
    assert repr(other) == repr(controller)
    sensor = controller.task
    for _ in range(3):
        q, v = holding.random_configuration(rng), rng.normal(size=7)
        measurement = aj.Measurement(0.0, q, v, sensor.value(q))
        target = sensor.value(holding.random_configuration(rng))
        state = controller.initial_state(measurement)
        assert_array_equal(other.initial_state(measurement), state)
        (after, answer), (later, again) = (
            each.step(state, measurement, target, 1e-3) for each in (controller, other)
        )
        assert_array_equal(later, after)
        assert_array_equal(again.torque, answer.torque)
        assert again.status is answer.status


class Around(ControllerWrapper):
    """A wrapper of one's own, with every kind of argument."""

    def __init__(self, controller, /, first, *marks, late=0.0, **more):
        self.controller = controller
        self.said = first, marks, late, more


def test_a_wrapper_with_any_arguments_is_built_anew(panda, copied):
    wrapper = Around(aj.SetpointController(aj.PositionTask(panda)), 1, "a", "b", late=0.1, more=2)
    other = copied(wrapper.with_task(aj.PositionTask(panda, "panda_link7")))
    assert other.task.frame == "panda_link7"
    assert other.said == wrapper.said == (1, ("a", "b"), 0.1, {"more": 2})


def test_mimic_joints_and_continuous_ones(copied, rng):
    """Where Pinocchio's model is not the one that every joint moves in."""
    for robot in (aj.load_robot("panda", free="all"), aj.load_robot("kinova")):
        task, dynamics = aj.PositionTask(robot), Dynamics(robot)
        other, others = copied(task), copied(dynamics)
        q, v = robot.random_configuration(rng), rng.normal(size=robot.nv)
        assert_array_equal(other.jacobian_dot(q, v), task.jacobian_dot(q, v))
        assert_array_equal(others.C(q, v), dynamics.C(q, v))


def test_plants(holding, copied, rng):
    plant = aj.Plant(
        holding,
        aj.PositionTask(holding),
        aj.robots.Friction(0.3, coulomb=0.1),
        sensing=aj.Sensing(x_noise=1e-3),
        torque_limits=holding.effort_limits,
    )
    other = copied(plant)
    q, v, tau = holding.random_configuration(rng), rng.normal(size=7), rng.normal(size=7)
    assert_array_equal(other.acceleration(q, v, tau), plant.acceleration(q, v, tau))
    assert_array_equal(other.measure(0.0, q, v).x, plant.measure(0.0, q, v).x)


def test_copies_do_not_share_scratch_memory(holding, built, copied, rng):
    """The gravity torque is an alias of scratch memory: an evaluation elsewhere leaves it alone."""
    controller = built["defaults"]
    other = copied(controller)
    a, b = holding.random_configuration(rng), holding.random_configuration(rng)
    torque = controller.gravity.torque(a)
    before = torque.copy()
    other.gravity.torque(b)
    assert_array_equal(torque, before)
    assert other.task is not controller.task


def test_a_pickle_is_not_much_larger_than_its_urdf(holding, built):
    for controller in built.values():
        assert len(pickle.dumps(controller)) < len(holding.urdf) + 20_000


@pytest.mark.parametrize(
    "error",
    [
        UnknownNameError("frame", "tcp", "panda", ["panda_hand_tcp"]),
        aj.InvalidInputError("dt must be > 0", given=-1.0),
        SimulationError("diverged", given=0.5),
    ],
)
def test_errors_come_back_from_other_processes(copied, error):
    other = copied(error)
    assert type(other) is type(error)
    assert str(other) == str(error)
    assert vars(other) == vars(error)
