"""Calibrations as OpenCV and ROS write them."""

import time
from itertools import pairwise

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj

K = np.array([[611.5, 0.0, 325.25], [0.0, 590.0, 236.0], [0.0, 0.0, 1.0]])
FIVE = np.array([-0.28, 0.1, 2e-3, -1e-3, -0.02])
ROS = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [611.5, 0, 325.25, 0, 590., 236, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: {data}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix: {{rows: 3, cols: 4, data: [600, 0, 320, 0, 0, 600, 240, 0, 0, 0, 1, 0]}}
"""


def ros(model="plumb_bob", data=(-0.28, "1e-1", 2e-3, -1e-3, -0.02)):
    return ROS.format(model=model, count=len(data), data=f"[{', '.join(map(str, data))}]")


def opencv(path, old=True, **more):
    """What OpenCV's sample program for calibrations writes."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    content = {
        "calibration_time": "Mon", "image_width": 640, "image_height": 480, "flags": 0,
        "camera_matrix": K, "distortion_coefficients": FIVE[:, None],
        "image_points": np.ones((20, 54, 2), dtype=np.float32), **more,
    }  # fmt: skip
    for name, value in content.items():
        if value is not None:
            file.write(name, value)
    file.release()
    text = path.read_text(encoding="utf-8")
    if old:  # as OpenCV did up to version 4
        text = text.replace("%YAML 1.2", "%YAML:1.0")
        assert text.startswith("%YAML:1.0")
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def file(tmp_path):
    def written(text):
        path = tmp_path / "camera.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return written


def test_a_file_of_opencv(tmp_path):
    path = opencv(tmp_path / "camera.yml")
    assert "!!opencv-matrix" in path.read_text(encoding="utf-8")
    cam = aj.PinholeCamera.from_file(path)
    assert cam == aj.PinholeCamera.from_opencv(K, FIVE, (640, 480))
    assert cam.distortion == tuple(FIVE)
    assert cam.focal_length == (611.5, 590.0)
    assert not cam.fisheye
    assert aj.PinholeCamera.from_file(opencv(tmp_path / "new.yml", old=False)) == cam
    # OpenCV's matrices have no size of an image by themselves
    bare = opencv(tmp_path / "bare.yml", image_width=None, image_height=None, image_points=None)
    with pytest.raises(
        aj.InvalidInputError,
        match=r"must have image_width or width, or the size be given, size=\(width",
    ):
        aj.PinholeCamera.from_file(bare)
    assert aj.PinholeCamera.from_file(bare, size=(640, 480)) == cam
    four = np.array([0.05, -0.01, 0.003, -0.001])
    fisheye = opencv(tmp_path / "f.yml", fisheye_model=1, distortion_coefficients=four)
    cam = aj.PinholeCamera.from_file(fisheye)
    assert cam == aj.PinholeCamera.from_opencv(K, four, (640, 480), fisheye=True)
    r = np.array([0.5, 0.2, 1.0])
    expected = cv2.fisheye.projectPoints(r[None, None], np.zeros(3), np.zeros(3), K, four)[0]
    assert_allclose(cam.project(r), expected[0, 0])
    with pytest.raises(aj.InvalidInputError, match=r"fisheye must be True or left out, as .* says"):
        aj.PinholeCamera.from_file(fisheye, fisheye=False)


@pytest.mark.parametrize(
    ("model", "data", "fisheye"),
    [
        ("plumb_bob", FIVE.tolist(), False),
        ("rational_polynomial", (0.3, -0.1, 1e-3, 5e-4, 0.02, 0.6, 0.05, 0.01), False),
        ("equidistant", (0.05, -0.01, 0.003, "-1e-03"), True),
    ],
)
def test_a_file_of_ros(file, model, data, fisheye):
    cam = aj.PinholeCamera.from_file(file(ros(model, data)), mount="tool0", near=0.1)
    numbers = [float(each) for each in data]
    assert cam == aj.PinholeCamera.from_opencv(
        K, numbers, (640, 480), fisheye=fisheye, mount="tool0", near=0.1
    )


def test_a_message_of_ros_as_it_is_printed(file):
    text = "header: {frame_id: camera}\nheight: 480\nwidth: 640\ndistortion_model: plumb_bob\nd:\n"
    text += "".join(f"- {value}\n" for value in FIVE) + f"k: {K.ravel().tolist()}\n"
    cam = aj.PinholeCamera.from_file(file(text))
    assert cam == aj.PinholeCamera.from_opencv(K, FIVE, (640, 480))


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
    ("content", "text"),
    [
        ("", "must be YAML of .*, got no camera_matrix and distortion_coefficients"),
        ("- 1\n- 2\n", "got no camera_matrix"),
        ("a: [1, 2", "must be YAML of OpenCV's FileStorage or of ROS, got expected"),
        (b"\xff\xfe\x00", "must be YAML of OpenCV's FileStorage or of ROS, got UnicodeDecodeError"),
        ("a: \x00", "must be YAML of OpenCV's FileStorage or of ROS, got"),
        ("<?xml version='1.0'?><opencv_storage/>", "must be YAML"),
        ("image_width: 640\n", "must have camera_matrix or k, as .*, got image_width"),
        ("k: [1, 0, 2, 0, 1, 2, 0, 0, 1]\n", "must have distortion_coefficients or"),
        (ros().replace("611.5", "wide"), "camera_matrix of .* must be finite numbers, 9 of"),
        (ros().replace("611.5", ".nan"), "camera_matrix of .* must be finite numbers, 9 of"),
        (ros().replace("611.5, ", ""), "must be finite numbers, 9 of them"),
        (
            ros().replace("image_width: 640", "image_width: wide"),
            "image_width of .* must be finite numbers, 1 of",
        ),
        (
            ros().replace("width: 640", "width: 1e400"),
            "image_width of .* must be finite numbers, 1 of",
        ),
        (
            ros().replace("width: 640", "width: -640"),
            "size must be the width and height of the image",
        ),
        (ros("omnidirectional"), "distortion_model of .* must be one of plumb_bob, .*'omnidir"),
        (ros(data=(0.1,) * 6), "or OpenCV's 4, 5, 8, 12 or 14 coefficients, got 6"),
        ("k: {rows: x, cols: 3, data: 1}\nd: []", "k of .* must be finite numbers, 9 of them"),
        ("? [1, 2]\n: 3\n", "must be YAML of OpenCV's FileStorage or of ROS, got found unhash"),
    ],
)
def test_bad_files_are_refused(file, content, text):
    with pytest.raises(aj.InvalidInputError, match=text):
        aj.PinholeCamera.from_file(file(content))


@pytest.mark.parametrize(
    "content",
    [
        "k: " + "[" * 2_000,
        "k: " + "[" * 2_000 + "]" * 2_000,
        "k: " + "{a: " * 2_000,
        "&a k: [*a]\n",
        "k: " + "9" * 100_000 + "\nd: [" + "1:" * 100_000 + "1]\n",
        "a: &a [1, 1]\n"
        + "".join(f"{c}: &{c} [{', '.join([f'*{b}'] * 9)}]\n" for b, c in pairwise("abcdefghij"))
        + "k: *j\nd: *j\n",
        "a: &a {x: 1}\n"
        + "".join(f"{c}: &{c} {{<<: [*{b}, *{b}]}}\n" for b, c in pairwise("abcdefghij")),
        "k: !!python/object/apply:os.system ['true']\nd: []\n",
        "x" * 500_001,
    ],
    ids=["open", "deep", "maps", "itself", "digits", "billion laughs", "merges", "code", "long"],
)
def test_hostile_files_are_refused_soon(file, content):
    path, start = file(content), time.process_time()
    with pytest.raises(aj.InvalidInputError):
        aj.PinholeCamera.from_file(path)
    assert time.process_time() - start < 5.0


def test_damaged_files_are_refused_or_read(tmp_path, rng):
    whole = bytearray(opencv(tmp_path / "a.yml", image_points=None).read_bytes())
    for _ in range(100):
        damaged = whole.copy()
        damaged[rng.integers(len(whole))] = rng.integers(256)
        path = tmp_path / "b.yml"
        path.write_bytes(damaged)
        try:
            cam = aj.PinholeCamera.from_file(path)
        except aj.InvalidInputError:
            continue
        assert np.isfinite(cam.focal_length).all()


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(aj.InvalidInputError, match="must be a calibration file that can be read"):
        aj.PinholeCamera.from_file(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    "options",
    [{"distortion": (-0.28, 0.1, 2e-3, -1e-3, -0.02)}, {"fisheye": True, "focal_length": 220.0}],
    ids=["tangential", "fisheye"],
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
