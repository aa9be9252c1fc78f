import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac import view
from approxjac.cameras import PlanarCamera

POINTS = [(0.0, 0.0, 0.0), (0.0, 0.1, 0.0)]
HOME = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


@pytest.fixture(scope="module")
def sensor():
    camera = aj.PinholeCamera.looking_at(
        (0.5, 0.0, 0.4), (1.5, -0.8, 0.9), 600.0, (640, 480), distortion=(-0.1,)
    )
    return aj.ImageTask(aj.load_robot("panda").with_object(0.1), camera, points=POINTS)


@pytest.fixture(scope="module")
def run(sensor):
    controller = aj.SetpointController(sensor, aj.default_gains(sensor))
    plant = aj.Plant(sensor.robot, sensor, sensing=aj.Sensing(x_noise=2.0))
    target = sensor.value(HOME + 0.1)
    return aj.simulate(plant, controller, target, HOME, 0.2, dt=2e-3)


def drawn(ax):
    return {line.get_label(): np.array(line.get_data()).T for line in ax.get_lines()}


def test_the_paths_go_through_the_image_from_start_to_target(run, sensor):
    ax = view.plot_image(run, sensor.camera)
    lines = drawn(ax)
    assert_allclose(lines["path 1"], run.x[:, :2])
    assert_allclose(lines["path 2"], run.x[:, 2:])
    assert_allclose(lines["start"], run.x[0].reshape(2, 2))
    assert_allclose(lines["end"], run.x[-1].reshape(2, 2))
    assert_allclose(lines["target"], run.target.reshape(2, 2))
    measured = [line for line in lines.values() if np.array_equal(line, run.x_measured[:, :2])]
    assert len(measured) == 1
    assert ax.get_xlabel() == "u [px]"
    assert ax.get_ylabel() == "v [px]"


def test_the_border_is_the_field_of_view_and_v_points_down(run, sensor):
    ax = view.plot_image(run, sensor.camera)
    border = next(line for line in drawn(ax).values() if len(line) == 5)
    assert border.min(axis=0).tolist() == [-0.5, -0.5]
    assert border.max(axis=0).tolist() == [639.5, 479.5]
    assert ax.get_ylim()[0] > 480.0 > 0.0 > ax.get_ylim()[1]
    assert ax.get_xlim()[0] < 0.0 < 640.0 < ax.get_xlim()[1]
    assert ax.get_aspect() == 1.0


def test_depths_that_are_measured_are_no_image(run, sensor):
    x = np.insert(run.x, (2, 4), 1.0, axis=1)
    x_d = np.insert(run.x_d, (2, 4), 1.0, axis=1)
    deep = dataclasses.replace(run, x=x, x_measured=x, x_d=x_d)
    assert_allclose(drawn(view.plot_image(deep, sensor.camera))["path 2"], run.x[:, 2:])


def test_a_planar_camera_has_an_image_without_a_border():
    arm = aj.load_robot("two_link")
    task = aj.ImageTask(arm, PlanarCamera(0.05, 3.0))
    controller = aj.SetpointController(task, aj.Gains(100.0, 100.0))
    run = aj.simulate(
        aj.Plant(arm, task), controller, task.value([1.5, 1.5]), (1.0, 1.5), 0.1, dt=None
    )
    ax = view.plot_image(run, task.camera)
    assert_allclose(drawn(ax)["path"], run.x)
    assert not any(len(line) == 5 for line in drawn(ax).values())


def test_a_run_of_another_task_is_refused(sensor):
    arm = aj.load_robot("two_link")
    task = aj.PositionTask(arm, axes="xz")
    controller = aj.SetpointController(task, aj.Gains(60.0, 20.0))
    run = aj.simulate(aj.Plant(arm, task), controller, (0.5, 1.2), (0.3, 0.8), 0.1, dt=None)
    with pytest.raises(aj.InvalidInputError, match="run must be that of an image task, with coord"):
        view.plot_image(run, sensor.camera)
    with pytest.raises(aj.InvalidInputError, match="camera must be a camera"):
        view.plot_image(run, "camera")
