import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.errors import UnknownNameError
from approxjac.tasks import PoseTrackerTask, TrackerTask

CAMERA = PlanarCamera(0.05, 3.0, roll=0.7, offset=(0.01, -0.02), plane="xy")


def tasks(robot):
    n = min(3, robot.nv)
    found = [
        aj.PositionTask(robot, axes="xyz"[-n:]),
        aj.PositionTask(robot, axes="zx"),
        aj.ImageTask(robot, CAMERA),
        aj.StackedTask(aj.PositionTask(robot, axes="z"), aj.PositionTask(robot, axes="x")),
    ]
    if robot.nv >= 3:
        found.append(TrackerTask(robot, (0.3, -0.7, 1.1), (0.1, -0.05, 0.05)))
    if robot.nv >= 5:
        found.append(aj.StackedTask(aj.PositionTask(robot), aj.ImageTask(robot, CAMERA)))
    if robot.nv >= 6:
        found.append(aj.PoseTask(robot))
        found.append(PoseTrackerTask(robot, (0.3, -0.7, 1.1), (0.1, -0.05, 0.05)))
    if robot.nv >= 7:
        found.append(aj.StackedTask(aj.PoseTask(robot), aj.PositionTask(robot, axes="y")))
    return found


def test_jacobians_by_finite_differences_on_every_arm(arm, rng):
    h = 1e-6
    for task in tasks(arm.with_object(0.2, 0.5)):
        q = arm.random_configuration(rng)
        J = task.jacobian(q)
        assert J.shape == (task.m, arm.nv)
        columns = [
            task.error(
                task.value(pin.integrate(arm.model, q, h * unit)),
                task.value(pin.integrate(arm.model, q, -h * unit)),
            )
            / (2 * h)
            for unit in np.eye(arm.nv)
        ]
        assert_allclose(J, np.array(columns).T, atol=1e-9)


def test_jacobian_rates_by_finite_differences_on_every_arm(arm, rng):
    h = 1e-5
    for task in tasks(arm.with_object(0.2, 0.5)):
        q, v = arm.random_configuration(rng), rng.uniform(-1, 1, arm.nv)
        ahead, behind = (task.jacobian(pin.integrate(arm.model, q, step * v)) for step in (h, -h))
        assert_allclose(task.jacobian_dot(q, v), (ahead - behind) / (2 * h), atol=1e-8)


def test_axes_choose_rows_in_the_order_given(panda, rng):
    q = panda.random_configuration(rng)
    xyz = aj.PositionTask(panda)
    zx = aj.PositionTask(panda, axes="zx")
    assert_allclose(zx.value(q), xyz.value(q)[[2, 0]])
    assert_allclose(zx.jacobian(q), xyz.jacobian(q)[[2, 0]])
    assert zx.labels == ("z", "x")
    assert zx.units == ("m", "m")


def test_the_planar_camera_is_the_papers_formula():
    f, z, delta, d = 0.05, 3.0, 0.7, np.array([0.01, -0.02])
    camera = PlanarCamera(f, z, delta, tuple(d), plane="xz")
    x, y = 0.3, -1.2
    rotation = np.array([[np.cos(delta), np.sin(delta)], [-np.sin(delta), np.cos(delta)]])
    expected = f / (z - f) * rotation @ [x, y] + d
    assert_allclose(camera.project(np.array([x, 99.0, y])), expected, atol=1e-15)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((0.0, 3.0), r"focal_length must be a finite number > 0 \[m\], got 0.0"),
        ((0.05, 0.05), r"distance must be a finite number > 0.05 \[m\], got 0.05"),
        ((0.05, 3.0, np.nan), r"roll must be a finite number \[rad\], got nan"),
        ((0.05, 3.0, 0.0, (1.0,)), r"offset must have shape \(2,\) \[m\], got shape \(1,\)"),
        ((0.05, 3.0, 0.0, (0.0, 0.0), "xyz"), "plane must name two world axes, such as 'xz'"),
    ],
)
def test_bad_cameras_are_refused(arguments, text):
    with pytest.raises(aj.InvalidInputError, match=text):
        PlanarCamera(*arguments)


def test_bad_tasks_are_refused(two_link, panda):
    with pytest.raises(UnknownNameError, match="axis 'w' not in axes; valid are x, y, z"):
        aj.PositionTask(panda, axes="xw")
    with pytest.raises(aj.InvalidInputError, match="axes must name each axis once"):
        aj.PositionTask(panda, axes="xx")
    with pytest.raises(
        UnknownNameError, match="frame 'tcp' not in panda; did you mean 'panda_hand_tcp'"
    ):
        aj.PositionTask(panda, frame="tcp")
    with pytest.raises(aj.InvalidInputError, match=r"got m = 3 for two_link with n_v = 2"):
        aj.PositionTask(two_link, axes="xyz")
