"""Calibrations as OpenCV has them."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj

K = np.array([[611.5, 0.0, 325.25], [0.0, 590.0, 236.0], [0.0, 0.0, 1.0]])
FIVE = np.array([-0.28, 0.1, 2e-3, -1e-3, -0.02])


def test_where_it_stands_is_told_as_opencv_tells_it():
    rvec, tvec = np.array([0.3, -0.8, 1.1]), np.array([0.1, 0.2, 1.5])
    cam = aj.PinholeCamera.from_opencv(K, FIVE, (640, 480), rvec=rvec, tvec=tvec)
    r = np.array([0.05, 0.1, 0.2])
    expected, _ = cv2.projectPoints(r[None], rvec, tvec, K, FIVE)
    assert_allclose(cam.project(r), expected[0, 0])
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rvec)[0].T
    pose[:3, 3] = -pose[:3, :3] @ tvec
    same = aj.PinholeCamera.from_opencv(K, FIVE, (640, 480), camera_pose=pose)
    assert_allclose(same.project(r), expected[0, 0])
    there = aj.PinholeCamera.from_opencv(K, FIVE, (640, 480)).standing_at((1.0, 0.0, 0.5), r)
    assert_allclose(there.project(r), there.center)
    assert there.distortion == cam.distortion


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(
            {"distortion": (-0.28, 0.1, 2e-3, -1e-3, -0.02)},
            id="tangential",
            marks=pytest.mark.long,
        ),
        pytest.param(
            {"fisheye": True, "focal_length": 220.0}, id="fisheye", marks=pytest.mark.study
        ),
    ],
)
def test_a_camera_is_learnt_through_its_lens(panda, options):
    """Its rays are those of the lens: learnt is where it stands, and the error goes to zero."""
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    made = aj.PinholeCamera(**{"focal_length": 600.0, "size": (640, 480), **options})
    camera = made.standing_at((1.2, -0.6, 0.8), looking_at=(0.5, 0.0, 0.5))
    sensor = aj.ImageTask(panda, camera)
    task = aj.ImageTask(panda, camera.with_error(rotation=(0.0, 0.0, 0.3), shift=(0.0, 0.1, -0.1)))
    learns = aj.controllers.AdaptiveCamera(task, unknown=("camera",))
    controller = aj.TrackingController(task, kinematics=learns, dt=2e-3)
    plant = aj.Plant(panda, sensor)
    x_d = sensor.value(q0) + [40.0, -30.0]
    run = aj.simulate(
        plant,
        controller,
        x_d,
        q0,
        4.0,
        dt=2e-3,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    assert run.error_norm[0] == pytest.approx(50.0)
    assert run.error_norm[-1] < 0.5
    # a target that moves out of what the lens shows leaves no torque undefined
    far = aj.Target(np.array([5000.0, -4000.0]), np.array([50.0, 0.0]), np.zeros(2))
    measured = aj.Measurement(0.0, q0, np.zeros(7), sensor.value(q0))
    state = controller.initial_state(measured)
    for x in (sensor.value(q0), np.array([639.0, 479.0]), np.array([-0.4, -0.4])):
        state, answer = controller.step(state, measured._replace(x=x), far, 2e-3)
        assert np.isfinite(answer.torque).all()
