"""Cameras against OpenCV, against finite differences and against the textbook."""

import cv2
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.cameras.lenses import Lens
from approxjac.errors import UnknownNameError

LENSES = {
    "no distortion": (),
    "barrel": (-0.25, 0.06, -0.004),
    "pincushion": (0.12, 0.02),
    "one coefficient": (-0.1,),
    "tangential": (-0.2, 0.05, 1e-3, -2e-3),
    "five": (-0.28, 0.1, 2e-3, -1e-3, -0.02),
    "rational": (0.3, -0.1, 1e-3, 5e-4, 0.02, 0.6, 0.05, 0.01),
    "thin prism": (-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, 0.01, 1e-3, 2e-3, -1e-3, -3e-3, 1e-3),
    "tilted": (
        -0.2,
        0.05,
        1e-3,
        -2e-3,
        0.01,
        0.02,
        0.01,
        1e-3,
        2e-3,
        -1e-3,
        -3e-3,
        1e-3,
        0.05,
        -0.1,
    ),
}
FISHEYES = {
    "equidistant": (),
    "fisheye": (0.05, -0.01, 0.003, -0.001),
    "fisheye that folds": (-0.1, -0.02, 0.0, 0.0),
}


def camera(distortion=(), **options):
    return aj.PinholeCamera.looking_at(
        (0.5, 0.1, 0.3), (1.6, -0.9, 1.1), (610.0, 590.0), (640, 480),
        center=(325.0, 236.0), distortion=distortion, **options,
    )  # fmt: skip


def fisheye(distortion=()):
    return aj.PinholeCamera(
        (200.0, 205.0), (640, 480), center=(325.0, 236.0), distortion=distortion, fisheye=True
    ).standing_at((1.6, -0.9, 1.1), looking_at=(0.5, 0.1, 0.3))


def opencv(cam):
    """The camera in OpenCV's words: rvec, tvec, K and the coefficients."""
    R, p = cam.placement()
    (fx, fy), (cx, cy) = cam.focal_length, cam.center
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    k = cam.distortion
    if len(k) < 4 and not cam.fisheye:
        k1, k2, k3 = (*k, 0.0, 0.0, 0.0)[:3]
        k = (k1, k2, 0.0, 0.0, k3)
    return cv2.Rodrigues(R.T)[0], -R.T @ p, K, np.array(k or (0.0,) * 4)


def points_in_view(cam, rng, count=50):
    """Points at the rays of random pixels and at random depths."""
    pixels = rng.uniform((0, 0), np.array(cam.size) - 1.0, (count, 2))
    pixels = pixels[[bool(np.isfinite(cam.seen(x)).all()) for x in pixels]]
    return np.array([cam.locate(x, rng.uniform(0.3, 4.0)) for x in pixels]), pixels


@pytest.mark.parametrize("lens", LENSES)
def test_projections_are_those_of_opencv(lens, rng):
    cam = camera(LENSES[lens])
    points = rng.uniform((0.0, -0.4, 0.0), (1.0, 0.6, 0.6), (200, 3))
    expected, _ = cv2.projectPoints(points, *opencv(cam))
    images = np.array([cam.project(r) for r in points])
    assert_allclose(images, expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("lens", FISHEYES)
def test_fisheye_projections_are_those_of_opencv(lens, rng):
    cam = fisheye(FISHEYES[lens])
    points = rng.uniform((-2.0, -2.0, 0.1), (2.0, 2.0, 2.0), (300, 3)) @ cam.placement()[0].T
    points += cam.placement()[1]
    expected = cv2.fisheye.projectPoints(points[:, None], *opencv(cam))[0][:, 0]
    images = np.array([cam.project(r) for r in points])
    shown = np.isfinite(images).all(axis=1)
    own = np.array([cam.in_camera(r) for r in points])
    angle = np.arctan2(np.hypot(*own[:, :2].T), own[:, 2])
    fold = np.degrees(cam._lens.widest)
    assert fold == pytest.approx(81.03, abs=0.01) if lens == "fisheye that folds" else fold == 85.0
    assert_array_equal(shown, angle < cam._lens.widest)
    assert_allclose(images[shown], expected[shown], atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_rays_are_those_of_opencv(lens, rng):
    cam = camera(LENSES[lens])
    pixels = rng.uniform((0, 0), (639, 479), (100, 2))
    _, _, K, k = opencv(cam)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    expected = cv2.undistortPoints(pixels[:, None], K, k, criteria=criteria)[:, 0]
    assert_allclose([cam.ray(x) for x in pixels], expected, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_the_interaction_matrix_by_opencv_and_by_finite_differences(lens, rng):
    cam, h = camera(LENSES[lens]), 1e-6
    for r in points_in_view(cam, rng, 20)[0]:
        rvec, tvec, K, k = opencv(cam)
        # OpenCV differentiates by tvec, which moves the point along the camera's axes
        by_tvec = cv2.projectPoints(r[None], rvec, tvec, K, k)[1][:, 3:6]
        J = cam.interaction(r)
        assert_allclose(J, by_tvec @ cam.placement()[0].T, rtol=1e-9, atol=1e-7)
        columns = [(cam.project(r + h * e) - cam.project(r - h * e)) / (2 * h) for e in np.eye(3)]
        assert_allclose(J, np.array(columns).T, rtol=1e-6, atol=1e-6 * np.abs(J).max())


@pytest.mark.parametrize("lens", FISHEYES)
def test_fisheye_rays_and_interaction_matrices(lens, rng):
    cam, h = fisheye(FISHEYES[lens]), 1e-6
    places, _ = points_in_view(cam, rng, 60)
    assert len(places) > 30
    for r in places:
        J = cam.interaction(r)
        columns = [(cam.project(r + h * e) - cam.project(r - h * e)) / (2 * h) for e in np.eye(3)]
        assert_allclose(J, np.array(columns).T, rtol=1e-5, atol=1e-5 * np.abs(J).max())
    for x in rng.uniform((0, 0), (639, 479), (300, 2)):
        ray = cam.ray(x)
        assert np.isfinite(ray).all() == np.isfinite(cam.seen(x)).all()
        if np.isfinite(ray).all():
            assert_allclose(cam.shown(ray), x, atol=1e-9)
        assert np.isfinite(cam.interaction(cam.locate(cam.nearest(x), 0.5))).all()


def test_what_a_fisheye_lens_shows_at_no_angle_is_not_seen():
    cam = aj.PinholeCamera(150.0, (640, 480), fisheye=True)
    rim = 150.0 * np.radians(85.0)
    for share, inside in ((0.99, True), (1.01, False)):
        for way in ((1.0, 0.0), (0.6, -0.8)):
            x = cam.center + share * rim * np.array(way)
            assert np.isfinite(cam.seen(x)).all() == inside
            assert np.isfinite(cam.ray(x)).all() == inside
    middle = np.array([*cam.center])
    assert_allclose(cam.ray(middle), 0.0)
    assert_allclose(cam.interaction(np.array([0.0, 0.0, 2.0])), 75.0 * np.eye(3)[:2])
    assert np.isnan(cam.project(np.array([1.0, 0.0, 0.08]))).all()  # beyond 85°


@given(st.lists(st.floats(-0.5, 0.5), min_size=14, max_size=14), st.integers(0, 2**31))
def test_no_distortion_tells_a_wrong_ray(k, seed):
    """Two rays are never shown at one place: what is shown somewhere is what is found there."""
    rng = np.random.default_rng(seed)
    k = np.array(k) * [1, 1, 0.1, 0.1, 1, 1, 1, 1, 0.1, 0.1, 0.1, 0.1, 0.5, 0.5]
    try:
        cam = aj.PinholeCamera(500.0, (640, 480), distortion=k)
    except aj.InvalidInputError as error:
        assert "fold" in str(error)  # noqa: PT017  # most of these lenses are absurd
        return
    for x in rng.uniform(-0.5, (639.5, 479.5), (10, 2)):
        ray = cam.ray(x)
        assert_allclose(cam.shown(ray), x, atol=1e-6)
        assert_allclose(cam.project(np.append(ray, 1.0)), x, atol=1e-6)
    for ray in rng.uniform(-1.0, 1.0, (10, 2)):
        x = cam.project(np.append(ray, 1.0))
        if np.isfinite(x).all():
            assert_allclose(cam._lens.undistorted((x - cam.center) / 500.0), ray, atol=1e-5)


def test_it_is_the_interaction_matrix_of_the_textbook(rng):
    """Chaumette and Hutchinson, Visual servo control, Part I: L for a point (x, y), Z."""
    cam = aj.PinholeCamera(1.0, (2, 2), center=(0.0, 0.0))  # normalised coordinates
    for r in rng.uniform((-0.4, -0.4, 0.5), (0.4, 0.4, 2.0), (20, 3)):
        (x, y), Z = r[:2] / r[2], r[2]
        L = np.array([
            [-1 / Z, 0, x / Z, x * y, -(1 + x * x), y],
            [0, -1 / Z, y / Z, 1 + y * y, -x * y, -x],
        ])  # fmt: skip
        found = cam.interaction(r) @ np.hstack([-np.eye(3), pin.skew(r)])
        assert_allclose(found, L, atol=1e-12)


@given(
    st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    st.tuples(st.floats(0, 639), st.floats(0, 479)),
    st.floats(0.1, 10.0),
)
def test_a_point_is_located_by_its_image_and_its_depth(k, pixel, depth):
    try:
        cam = camera(k)
    except aj.InvalidInputError:  # folds back
        assume(False)
    r = cam.locate(np.array(pixel), depth)
    assert_allclose(cam.in_camera(r)[2], depth)
    assert_allclose(cam.project(r), pixel, atol=1e-6)
    assert_array_equal(cam.seen(cam.project(r)), cam.project(r))


@pytest.mark.parametrize("n", [3, 4])
def test_several_points_at_once_have_no_image(n):
    for cam in (aj.PinholeCamera(600.0, (640, 480)), PlanarCamera(0.05, 3.0)):
        with pytest.raises(
            aj.InvalidInputError, match=rf"r must have shape .*got shape \({n}, 3\)"
        ):
            cam.project(np.ones((n, 3)))


def test_looking_at_puts_the_target_in_the_middle_and_up_upwards():
    cam = camera()
    assert_allclose(cam.project(np.array([0.5, 0.1, 0.3])), (325.0, 236.0), atol=1e-9)
    assert cam.project(np.array([0.5, 0.1, 0.4]))[1] < 236.0  # v points down
    R, p = cam.placement()
    assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert_allclose(p, (1.6, -0.9, 1.1))
    assert R[2, 0] == pytest.approx(0.0)  # the horizon is level


def test_what_is_within_the_image_is_seen():
    cam = aj.PinholeCamera(500.0, (640, 480))
    assert cam.center == (319.5, 239.5)
    for x, inside in (
        ((-0.5, 0.0), True), ((-0.6, 0.0), False), ((639.5, 479.5), True), ((0.0, 479.6), False),
        ((np.nan, 0.0), False), ((np.inf, 0.0), False),
    ):  # fmt: skip
        assert np.isfinite(cam.seen(np.array(x))).all() == inside
    assert PlanarCamera(0.05, 3.0).seen(np.array([1e9, 0.0]))[0] == 1e9  # has no edges


def test_what_is_behind_the_camera_has_no_image_but_a_bounded_jacobian():
    cam = aj.PinholeCamera(500.0, (640, 480), near=0.1)
    for Z in (0.09, 0.0, -1.0, np.nan):
        assert np.isnan(cam.project(np.array([0.1, 0.1, Z]))).all()
    largest = np.abs(cam.interaction(np.array([0.0, 0.0, 0.1]))).max()
    for r in ([0.3, 0.2, -1.0], [9.0, 9.0, 0.2], [0.0, 0.0, 0.0]):
        assert np.abs(cam.interaction(np.array(r))).max() <= largest * 1.01


def test_beyond_the_fold_of_a_lens_there_is_no_image():
    cam = aj.PinholeCamera(500.0, (320, 240), distortion=(-0.3,))
    fold = 1.0 / np.sqrt(0.9)
    assert np.isfinite(cam.project(np.array([0.99 * fold, 0.0, 1.0]))).all()
    assert np.isnan(cam.project(np.array([1.01 * fold, 0.0, 1.0]))).all()


def test_far_beyond_the_fold_of_a_lens_the_jacobian_does_not_turn_over():
    """It is that of a ray that is shown, where the lens maps one to one."""
    bent = (0.4, 0.4, 0.04, -0.03, -0.3)
    cam = aj.PinholeCamera(250.0, (640, 480), distortion=bent)
    for r in ([0.0, 0.0, 1.0], [9.0, 9.0, 1.0], [9.0, -9.0, 1.0], [-9.0, 9.0, 1.0]):
        J = cam.interaction(np.array(r))
        assert np.linalg.det(J[:, :2]) > 0.0


def test_errors_of_a_camera():
    cam = camera(LENSES["barrel"])
    R, p = cam.placement()
    wrong = cam.with_error(shift=(0.0, 0.0, -0.4), rotation=(0.0, 0.0, 0.5), focal_factor=1.3)
    assert_allclose(wrong.placement()[1], p - 0.4 * R[:, 2])
    assert_allclose(wrong.placement()[0], R @ pin.exp3(np.array([0.0, 0.0, 0.5])), atol=1e-12)
    assert wrong.focal_length == pytest.approx((1.3 * 610.0, 1.3 * 590.0))
    assert wrong.distortion == cam.distortion
    assert wrong.size == cam.size
    r = np.array([0.5, 0.2, 0.3])
    assert wrong.in_camera(r)[2] == pytest.approx(cam.in_camera(r)[2] + 0.4)
    # as the paper's roll: the image turns by −δ in (right, down)
    d = 0.5
    turned = cam.with_error(rotation=(0.0, 0.0, d)).in_camera(r)[:2]
    assert_allclose(turned, np.array([[np.cos(d), np.sin(d)], [-np.sin(d), np.cos(d)]])
                    @ cam.in_camera(r)[:2])  # fmt: skip
    calibrated = {name: known for name, (known, _) in cam.calibration.items()}
    assert calibrated.pop("focal_length") == 610.0
    errors = ("distance", "roll", "tilt x", "tilt y", "shift x", "shift y", "shift z")
    assert calibrated == dict.fromkeys(errors, 0.0)
    same = cam.recalibrated({"focal_length": 793.0, "distance": 0.4, "roll": 0.5})
    assert_allclose(same.project(r), wrong.project(r))
    with pytest.raises(aj.InvalidInputError, match=r"focal_length must be .* > 0 \[px\], got -5.0"):
        cam.recalibrated({"focal_length": -5.0})
    planar = PlanarCamera(0.05, 3.0)
    assert planar.recalibrated({"roll": 0.2, "distance": 2.0}) == PlanarCamera(0.05, 2.0, 0.2)


@pytest.mark.parametrize("plane", ["xz", "zx", "xy", "yz"])
def test_the_planar_camera_is_a_pinhole_camera_at_one_depth(plane, rng):
    """Within the arm's plane: same images, and same J_I for motions within it."""
    f, z, roll, d = 0.05, 3.0, 0.7, np.array([0.01, -0.02])
    planar = PlanarCamera(f, z, roll, tuple(d), plane)
    rows = ["xyz".index(axis) for axis in plane]
    right, down = np.eye(3)[rows]
    forward = np.cross(right, down)
    pitch = 1e-5  # metres a pixel
    pinhole = aj.PinholeCamera(
        f / pitch, (640, 480), -(z - f) * forward, np.column_stack([right, down, forward]),
        center=d / pitch,
    ).with_error(rotation=(0.0, 0.0, roll))  # fmt: skip
    for _ in range(10):
        r = rng.uniform(-0.1, 0.1, 2) @ np.eye(3)[rows]
        assert_allclose(pitch * pinhole.project(r), planar.project(r), atol=1e-15)
        within = np.eye(3)[:, rows]
        assert_allclose(pitch * pinhole.interaction(r) @ within, planar.interaction(r) @ within)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"focal_length": 0.0}, r"focal_length must be > 0 \[px\], got 0.0"),
        ({"focal_length": (500.0, -1.0)}, r"focal_length must be > 0 \[px\], got \(500.0, -1.0\)"),
        ({"focal_length": "wide"}, r"focal_length must be numbers of shape \(2,\) \[px\]"),
        ({"size": (640, 0)}, r"size must be the width and height of the image, whole numbers >= 1"),
        ({"size": (640.5, 480)}, "size must be the width and height"),
        ({"position": (0.0, np.nan, 0.0)}, r"position must be finite \[m\]"),
        ({"rotation": 2 * np.eye(3)}, "rotation must have the camera's axes .* as orthonormal"),
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "of a right-handed frame"),
        (
            {"distortion": (0.1,) * 6},
            r"distortion must be \(k1, k2, k3\) or fewer of them, or Open",
        ),
        ({"distortion": 0.1}, r"distortion must have shape \(k,\), got shape \(\)"),
        ({"distortion": (np.nan,)}, "distortion must be finite"),
        ({"distortion": (1e300,)}, r"distortion must have coefficients of at most 1e\+09, got"),
        ({"distortion": (-2.0,)}, "distortion must not fold the image back within its size"),
        ({"distortion": (0, 0, 1.0, 0)}, "distortion must not fold the image back within its size"),
        ({"distortion": (0.0,) * 12 + (2.0, 0.0)}, "distortion must have tau_x and tau_y between"),
        ({"distortion": (0.1,) * 3, "fisheye": True}, r"of a fisheye lens must be .*, got 3"),
        ({"fisheye": 1}, "fisheye must be True or False, got 1"),
        ({"near": 0.0}, r"near must be a finite number > 0 \[m\], got 0.0"),
        ({"mount": 3}, "mount must be the name of a frame, or None for the world, got 3"),
    ],
)
def test_bad_pinhole_cameras_are_refused(arguments, text):
    with pytest.raises(aj.InvalidInputError, match=text):
        aj.PinholeCamera(**{"focal_length": 500.0, "size": (640, 480), **arguments})


def test_a_view_that_has_no_direction_or_no_up_is_refused():
    for target, position in (((1, 1, 1), (1, 1, 1)), ((1, 1, 0), (1, 1, 2))):
        with pytest.raises(aj.InvalidInputError, match="target must not be at position"):
            aj.PinholeCamera.looking_at(target, position, 500.0, (640, 480))


def test_calibrations_that_do_not_exist_are_refused():
    class Flat(aj.cameras.Camera):
        labels, unit = ("a", "b"), "m"

        def project(self, r):
            return r[:2]

        def interaction(self, r):
            return np.eye(3)[:2]

    assert Flat().calibration == {}
    assert Flat().mount is None
    with pytest.raises(UnknownNameError, match="value 'roll' not in the calibration of Flat"):
        Flat().recalibrated({"roll": 1.0})


@pytest.mark.parametrize("distortion", [(0.3,), (0.5, 0.2), (-0.25, 0.1, -0.01)])
def test_the_interaction_matrix_is_exact_up_to_the_edges(distortion):
    # off-centre, rays reach farthest somewhere along an edge and not at a corner or its middle
    cam = aj.PinholeCamera(500.0, (640, 480), center=(100.0, 60.0), distortion=distortion)
    edges = [(u, v) for u in np.linspace(0, 639, 25) for v in (0, 479)]
    edges += [(u, v) for u in (0, 639) for v in np.linspace(0, 479, 25)]
    h = 1e-6 * np.eye(3)
    for x in np.array(edges, dtype=float):
        r = cam.locate(x, 1.3)
        columns = [(cam.project(r + step) - cam.project(r - step)) / 2e-6 for step in h]
        assert_allclose(cam.interaction(r), np.transpose(columns), atol=1e-4)


@pytest.mark.parametrize("distortion", [(-1e-16,), (-1e-13,), (0.0, -1e-20), (1e-300,), (0.2,)])
@pytest.mark.parametrize("far", [1e5, 1e12, 1e29, 1e300])
def test_absurd_pixels_have_no_ray_or_the_right_one(distortion, far):
    cam, x = aj.PinholeCamera(600.0, (640, 480), distortion=distortion), np.array([far, -3.0])
    ray = cam.ray(x)
    assert np.isnan(ray).all() or cam.shown(ray) == pytest.approx(x, rel=1e-8)
    assert np.isfinite(cam.ray(cam.nearest(x))).all()


@pytest.mark.parametrize("cam", [PlanarCamera(0.05, 3.0), camera()])
def test_names_that_are_not_in_the_calibration_are_refused(cam):
    with pytest.raises(UnknownNameError, match="value 'focal' not in the calibration of P"):
        cam.recalibrated({"focal": 1.0})


@pytest.mark.parametrize("lens", LENSES)
def test_a_camera_that_opencv_calibrated(lens, rng):
    known = camera(LENSES[lens])
    rvec, tvec, K, five = opencv(known)
    cam = aj.PinholeCamera.from_opencv(K, five[None], known.size, rvec=rvec, tvec=tvec[:, None])
    assert_allclose(cam.placement()[0], known.placement()[0], atol=1e-12)
    for r in points_in_view(known, rng, 10)[0]:
        assert_allclose(cam.project(r), known.project(r), atol=1e-8)
    assert repr(known).startswith("PinholeCamera(640 x 480 px, f = (610, 590) px, position=(1.6,")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"distortion": (0.1, 0.0, 0.0)},
            "must be OpenCV's 4, 5, 8, 12 or 14 coefficients, or none",
        ),
        ({"distortion": (0.1,) * 7}, "or OpenCV's 4, 5, 8, 12 or 14 coefficients, got 7"),
        ({"rvec": None}, "must be given by rvec and tvec, or by camera_pose, got tvec"),
        ({"camera_pose": np.eye(4)}, "by camera_pose, got rvec and tvec and camera_pose"),
        ({"rvec": None, "tvec": None, "camera_pose": np.ones((4, 4))}, "must have the last row"),
        (
            {"K": np.diag([1.0, 2.0, 3.0])},
            r"K must be \[\[fx, 0, cx\], \[0, fy",
        ),
        ({"K": np.eye(2)}, r"K must have shape \(3, 3\) \[px\], got shape \(2, 2\)"),
        ({"tvec": (1.0, 2.0)}, r"tvec must have shape \(3,\) \[m\], got shape \(2,\)"),
    ],
)
def test_bad_calibrations_are_refused(changes, text):
    K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    given = {"K": K, "distortion": (), "rvec": (0.0, 0.0, 0.0), "tvec": (0.0, 0.0, 0.0)}
    with pytest.raises(aj.InvalidInputError, match=text):
        aj.PinholeCamera.from_opencv(**{**given, **changes, "size": (640, 480)})


def test_a_camera_with_the_numbers_of_another_one_shows_what_that_does(rng):
    """As one whose calibration is not known until a run begins."""
    one = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))
    other = aj.PinholeCamera.looking_at((0.3, 0.2, 0.1), (-2.0, 1.0, 2.0), 500.0, (640, 480))
    same = one.with_numbers(other.numbers)
    for r in rng.uniform(-0.3, 0.3, (5, 3)):
        assert_allclose(same.in_camera(r), other.in_camera(r))
        assert_allclose(same.project(r), other.project(r))
        assert_allclose(same.interaction(r), other.interaction(r))
        assert_allclose(same.locate(same.project(r), same.in_camera(r)[2]), r, atol=1e-9)


@pytest.mark.parametrize(("p", "tilt"), [(0.05, 0.8), (0.02, 1.1), (0.0, 0.6)])
def test_a_tilted_sensor_shows_rays_up_to_those_along_it(p, tilt):
    """On the x axis the image is r + 3p₂r², and ∞ where that is cot τ: what is left out is less."""
    lens = Lens((0.0, 0.0, 0.0, p, *(0.0,) * 8, 0.0, tilt))
    reach = 1.0 / np.tan(tilt)
    along = 2.0 * reach / (1.0 + np.sqrt(1.0 + 12.0 * p * reach))
    assert lens.largest_radius == pytest.approx(along, rel=1e-5)


@pytest.mark.parametrize("lens", [(0.03, 0.2, 0.05), (0.0, 0.1, 0.3), (0.1, 0.0, 0.02)])
def test_rays_are_shown_up_to_where_their_images_stop_moving_apart(lens):
    """Along −x the image is −r + 3p₂r² + s₁r² + s₂r⁴, whose slope is 0 at the first fold."""
    p, s1, s2 = lens
    roots = np.roots([4.0 * s2, 0.0, 6.0 * p + 2.0 * s1, -1.0])
    (fold,) = roots[(abs(roots.imag) < 1e-12) & (roots.real > 0.0)].real
    found = Lens((0.0, 0.0, 0.0, p, 0.0, 0.0, 0.0, 0.0, s1, s2, 0.0, 0.0)).largest_radius
    assert found == pytest.approx(fold, rel=1e-5)
