"""How the true robot may differ from the believed one."""

import copy
import functools
import itertools
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.codegen.arm.arm_numbers import ArmNumbers, arm_numbers
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.stability.certificates.matrix_form import MatrixForm, best_weights
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.tasks import FrameKinematics

CAMERA = PlanarCamera(0.05, 3.0, 0.1)
PLANE = functools.partial(aj.PositionTask, axes="xz")


@pytest.fixture(scope="module")
def arm():
    return aj.load_robot("two_link")


@pytest.fixture(scope="module")
def everything(arm):
    """Every kind of coordinate, on an arm that is cheap to build."""
    return aj.Uncertainty(
        arm,
        object_length=(0.0, 0.3),
        object_mass=(0.1, 1.0),
        believed_length=0.1,
        believed_mass=0.5,
        object_axis="x",
        joint_shifts={"joint2": (0.02, 0.0, 0.01)},
        joint_rotations={"joint1": (0.0, 0.05, 0.0), "joint2": np.array([0.0, 0.1, 0.0])},
        camera=CAMERA,
        focal_length=(0.04, 0.06),
        distance=(2.0, 4.0),
        roll=(-0.2, 0.4),
        friction=(0.1, 0.2),
    )


def test_a_derived_class_may_make_other_robots():
    class Greasy(aj.Uncertainty):
        def plant(self, values):
            return aj.Plant(super().plant(values).robot, friction=0.3)

    assert Greasy(aj.load_robot("two_link"), PLANE, object_length=(0.0, 0.2)).d == 1


def test_names_units_and_ranges(everything):
    table = {
        "object_length": ("m", 0.1, 0.0, 0.3),
        "object_mass": ("kg", 0.5, 0.1, 1.0),
        "joint2 shift x": ("m", 0.0, -0.02, 0.02),
        "joint2 shift z": ("m", 0.0, -0.01, 0.01),
        "joint2 rotation y": ("rad", 0.0, -0.1, 0.1),
        "joint1 rotation y": ("rad", 0.0, -0.05, 0.05),
        "camera focal_length": ("m", 0.05, 0.04, 0.06),
        "camera distance": ("m", 3.0, 2.0, 4.0),
        "camera roll": ("rad", 0.1, -0.2, 0.4),
    }
    units, *numbers = zip(*table.values(), strict=True)
    assert everything.names == tuple(table)
    assert everything.units == units
    assert everything.d == 9
    given_numbers = (everything.believed, everything.low, everything.high)
    assert_array_equal(given_numbers, numbers)


def test_the_truth_has_the_values(everything):
    values = np.array([0.25, 0.7, 0.01, -0.01, 0.1, 0.05, 0.06, 4.0, -0.2])
    plant = everything.plant(values)
    by_hand = (
        everything.arm.with_object(0.25, 0.7, axis="x")
        .with_kinematic_error({"joint2": (0.01, 0.0, -0.01)})
        .with_kinematic_error(rotations={"joint1": (0.0, 0.05, 0.0), "joint2": (0.0, 0.1, 0.0)})
    )
    q = np.array([0.4, -1.1])
    assert plant.robot.tip == "object_tip"
    assert_allclose(plant.robot.mass, by_hand.mass, rtol=1e-14)
    true, expected = (FrameKinematics(r, "object_tip").pose(q) for r in (plant.robot, by_hand))
    assert_allclose(true, expected, atol=1e-12)
    assert plant.sensor.camera == PlanarCamera(0.06, 4.0, -0.2)
    assert_array_equal(plant.friction, (0.1, 0.2))


@pytest.mark.parametrize("length", [0.0, 0.123456789, 0.3])
def test_an_uncertain_length_is_the_true_one(panda, length):
    uncertainty = aj.Uncertainty(panda, object_length=(0.0, 0.3), believed_length=0.1)
    robot = uncertainty.plant([length]).robot
    q = np.array([0.1, 0.2, -0.3, -1.5, 0.4, 1.5, 0.2])
    hand = aj.PositionTask(robot, "panda_hand_tcp").value(q)
    assert_allclose(np.linalg.norm(aj.PositionTask(robot).value(q) - hand), length, atol=1e-12)
    believed = uncertainty.belief()
    tip = aj.PositionTask(believed).value(q)
    assert_allclose(np.linalg.norm(tip - hand), 0.1, atol=1e-12)


def test_the_truth_at_what_is_believed_is_the_belief(panda, everything, rng):
    shifted = aj.Uncertainty(
        panda, object_length=(0.0, 0.3), joint_shifts={"panda_joint4": (0.0, 0.01, 0.0)}
    )
    for uncertainty in (shifted, everything):
        plant, task = uncertainty.plant(uncertainty.believed), uncertainty.believed_task()
        assert plant.robot == uncertainty.belief() == task.robot
        plant.require_task(task)
        for _ in range(3):
            q = plant.robot.random_configuration(rng)
            assert_array_equal(plant.sensor.jacobian(q), task.jacobian(q))
            assert_array_equal(plant.sensor.value(q), task.value(q))


@pytest.mark.parametrize(
    "name", ["two_link", "ur5", pytest.param("pr2_left_arm", marks=pytest.mark.study)]
)
def test_many_robots_at_once_have_the_numbers_of_each(name, rng):
    arm = aj.load_robot(name)
    errors = aj.Uncertainty(
        arm,
        object_length=(0.0, 0.3),
        object_mass=(0.0, 1.0),
        joint_shifts={arm.joint_names[-1]: (0.02, 0.0, 0.01)},
        joint_rotations={arm.joint_names[0]: (0.0, 0.05, 0.0)},
    )
    drawn = [errors.low, *(errors.sample(rng) for _ in range(3)), errors.believed, errors.high]
    robots = []
    for values in [*drawn, *reversed(drawn)]:
        own = errors.plant(values).robot
        robots.append(arm_numbers(own, (own.tip,)))
    belief, values = errors.belief(), np.array([*drawn, *reversed(drawn)])
    tip = belief.mimic_joints.model.getFrameId(belief.tip)
    changes = errors.changes(values)
    together = arm_numbers(belief, (belief.tip,)).changed(changes, [tip], len(values))
    for one, other in zip(ArmNumbers.stacked(robots), together, strict=True):
        assert_allclose(one, other, rtol=0, atol=1e-12)
    assert errors.plant(errors.high).robot is not errors.plant(errors.high).robot


def test_nothing_uncertain(arm):
    uncertainty = aj.Uncertainty(arm, PLANE)
    assert uncertainty.d == 0
    assert uncertainty.names == uncertainty.units == ()
    assert uncertainty.belief() is arm  # no object where nothing is said about one
    assert uncertainty.corners().shape == (1, 0)
    assert uncertainty.sample(np.random.default_rng(0)).shape == (0,)
    assert uncertainty.plant(uncertainty.corners()[0]).robot == arm
    assert uncertainty.describe([]) == "no error"
    assert repr(uncertainty) == "Uncertainty('two_link': no error)"


def test_a_certain_object_is_held_by_both(arm):
    uncertainty = aj.Uncertainty(arm, PLANE, believed_length=0.2, object_axis="x")
    assert uncertainty.d == 0
    assert uncertainty.belief() == arm.with_object(0.2, axis="x")
    heavy = aj.Uncertainty(arm, PLANE, object_mass=(0.0, 1.0))
    assert heavy.names == ("object_mass",)
    assert_allclose(heavy.plant([1.0]).robot.mass, arm.mass + 1.0)
    assert heavy.belief() == arm.with_object(0.0)


# -- cameras with perspective -----------------------------------------------------------

POINTS = ((0.0, 0.0, 0.0), (0.1, 0.05, 0.0))


@pytest.fixture(scope="module")
def watched(panda):
    """A Panda with a tool of unknown length before a camera of unknown calibration."""
    camera = aj.PinholeCamera.looking_at(
        (0.5, 0, 0.4), (1.6, -0.9, 1.0), (600.0, 580.0), (640, 480)
    )
    return aj.Uncertainty(
        panda,
        functools.partial(aj.ImageTask, points=POINTS, depth="measured"),
        object_length=(0.0, 0.2),
        camera=camera,
        roll=(-0.3, 0.3),
        distance=(-0.1, 0.4),
        focal_length=(500.0, 660.0),
    )


def test_ranges_of_a_pinhole_camera(watched):
    assert watched.names == (
        "object_length", "camera focal_length", "camera distance", "camera roll"
    )  # fmt: skip
    assert watched.units == ("m", "px", "m", "rad")
    assert_array_equal(watched.believed, (0.0, 600.0, 0.0, 0.0))
    assert_array_equal(watched.low, (0.0, 500.0, -0.1, -0.3))
    assert_array_equal(watched.high, (0.2, 660.0, 0.4, 0.3))
    assert watched.describe(watched.high) == (
        "object length 0.2 m, camera focal length 660 px, camera distance 0.4 m, "
        "camera roll 0.3 rad (17.2 deg)"
    )
    plant = watched.plant((0.1, 660.0, 0.4, 0.3))
    true, believed = plant.sensor.camera, watched.believed_task().camera
    assert believed is watched.camera
    assert_allclose(true.focal_length, (660.0, 638.0))
    assert_allclose(
        true.placement()[1], believed.placement()[1] - 0.4 * believed.placement()[0][:, 2]
    )
    turned = believed.placement()[0].T @ true.placement()[0]
    assert_allclose(turned[0], (np.cos(0.3), -np.sin(0.3), 0.0), atol=1e-12)
    assert plant.robot == watched.arm.with_object(0.1)
    for task in (plant.sensor, watched.believed_task()):
        assert_array_equal(task.points, POINTS)
        assert task.depth == "measured"
    at_belief = watched.plant(watched.believed)
    assert at_belief.sensor.camera is watched.camera
    q = watched.arm.neutral()
    assert_array_equal(at_belief.sensor.value(q), watched.believed_task().value(q))
    assert_array_equal(watched.scaled(2.0).high, (0.4, 720.0, 0.8, 0.6))


def rotated(vector):
    """Rotation by a vector, after Rodrigues."""
    angle = np.linalg.norm(vector)
    K = np.cross(np.eye(3), np.asarray(vector) / max(angle, 1e-300))  # rows eᵢ × v
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


def two_link_views(**errors):
    """A camera that looks across the plane of a two-link arm, and a configuration."""
    arm = aj.load_robot("two_link")
    camera = aj.PinholeCamera.looking_at(
        (0.9, 0.0, 0.5), (0.7, -3.0, 0.8), (500.0, 480.0), (640, 480)
    )
    return aj.Uncertainty(arm, camera=camera, **errors), np.array([0.4, -0.9])


def two_link_tip(q):
    return np.array([np.cos(q[0]) + np.cos(q.sum()), 0.0, np.sin(q[0]) + np.sin(q.sum())])


def test_a_camera_is_tilted_and_shifted_as_a_pinhole_is():
    """Its image of the tip, both in closed form: of a planar arm, and of a pinhole."""
    given = {"focal_length": (400.0, 600.0), "distance": (-0.3, 0.3), "roll": (-2.0, 2.0)}
    errors, q = two_link_views(tilt=(0.2, 0.1), shift=(0.1, 0.2, 0.3), **given)
    assert errors.names[3:] == (
        "camera tilt x", "camera tilt y", "camera shift x", "camera shift y", "camera shift z"
    )  # fmt: skip
    assert errors.units[3:] == ("rad", "rad", "m", "m", "m")
    assert_array_equal(errors.high[3:], (0.2, 0.1, 0.1, 0.2, 0.3))
    assert_array_equal(errors.low[3:], -errors.high[3:])
    R, p = errors.camera.placement()
    rng = np.random.default_rng(3)
    for values in (errors.believed, *(errors.sample(rng) for _ in range(20)), *errors.corners(12)):
        (f, back, roll), tilt, shift = values[:3], values[3:5], values[5:]
        c, s = np.cos(roll), np.sin(roll)
        turned = R @ rotated([*tilt, 0.0]) @ [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
        x, y, z = turned.T @ (two_link_tip(q) - p - R @ (shift - [0.0, 0.0, back]))
        image = [319.5 + f * x / z, 239.5 + 0.96 * f * y / z]
        shown = errors.plant(values).sensor.camera.seen(np.array(image))
        assert_allclose(errors.plant(values).sensor.value(q), shown, rtol=1e-9)


def test_images_move_with_a_camera_as_the_interaction_matrix_says():
    """[u, v]' = L [velocity, rotation] of the camera, for small errors (Chaumette, Hutchinson)."""
    errors, q = two_link_views(roll=(-0.1, 0.1), tilt=(0.1, 0.1), shift=(0.1, 0.1, 0.1))
    R, p = errors.camera.placement()
    X, Y, Z = R.T @ (two_link_tip(q) - p)
    x, y, f = X / Z, Y / Z, np.array([500.0, 480.0])
    L = np.array(
        [
            [-1.0 / Z, 0.0, x / Z, x * y, -(1.0 + x * x), y],
            [0.0, -1.0 / Z, y / Z, 1.0 + y * y, -x * y, -x],
        ]
    )
    order, h = [5, 3, 4, 0, 1, 2], 1e-6  # roll, tilts and shifts, of velocity and rotation
    for i, column in enumerate(order):
        ends = (errors.plant(s * h * np.eye(6)[i]).sensor.value(q) for s in (1.0, -1.0))
        moved = np.subtract(*ends) / (2.0 * h)
        assert_allclose(moved, f * L[:, column], rtol=1e-6, atol=1e-5)


def test_a_tilt_that_is_certain_is_no_coordinate():
    errors, _ = two_link_views(tilt=(0.0, 0.1), shift=(0.0, 0.0, 0.0))
    assert errors.names == ("camera tilt y",)
    assert errors.describe([0.1]) == "camera tilt y 0.1 rad (5.7 deg)"
    assert errors.describe_box() == "camera tilt y -0.1 rad (-5.7 deg) to 0.1 rad (5.7 deg)"
    assert_allclose(errors.scaled(3.0).high, [0.3])
    assert_allclose(errors.largest_scale(100.0), np.pi / 0.1, rtol=1e-3)
    with pytest.raises(InvalidInputError, match="tilt must be >= 0"):
        two_link_views(tilt=(-0.1, 0.1))
    with pytest.raises(UnknownNameError, match="'shift x' not in the calibration of PlanarCamera"):
        aj.Uncertainty(ARM, camera=CAMERA, shift=(0.1, 0.0, 0.0))


class Fixed(aj.cameras.Camera):
    """A camera in whose calibration only the roll may be wrong, or nothing."""

    labels, unit = ("a", "b"), "m"

    def __init__(self, calibrated=()):
        self.calibrated = calibrated

    @property
    def calibration(self):
        return {name: CAMERA.calibration[name] for name in self.calibrated}

    def recalibrated(self, values):
        return self

    def project(self, r):
        return r[::2]

    def interaction(self, r):
        return np.eye(3)[::2]


def test_what_a_calibration_does_not_have_is_refused(arm, watched):
    assert aj.Uncertainty(arm, camera=Fixed(["roll"]), roll=(0.0, 0.1)).names == ("camera roll",)
    with pytest.raises(
        UnknownNameError,
        match="range 'distance' not in the calibration of Fixed; valid are roll",
    ):
        aj.Uncertainty(arm, camera=Fixed(["roll"]), roll=(0.0, 0.1), distance=(2.0, 4.0))
    with pytest.raises(UnknownNameError, match=r"range 'roll' not in the calibration of Fixed$"):
        aj.Uncertainty(arm, camera=Fixed(), roll=(0.0, 0.1))
    with pytest.raises(
        aj.InvalidInputError,
        match=r"roll must contain what is believed, 0 \[rad\], got \(0.1, 0.2\)",
    ):
        aj.Uncertainty(arm, camera=watched.camera, roll=(0.1, 0.2))
    with pytest.raises(
        aj.InvalidInputError,
        match=r"a camera must exist .* camera focal length -300 px, camera distance -0.9 m, "
        r"camera roll -2.7 rad \(-154.7 deg\) with the factor 9: focal_length must be a finite "
        r"number > 0 \[px\], got -300",
    ):
        watched.scaled(9.0)


# -- corners, samples, scale ------------------------------------------------------------


def box(arm, d):
    """A set of d joint shifts and rotations; those of the arm's three joints are 18."""
    bounds = iter([1e-3] * d + [0.0] * 18)
    joints = ("joint1", "joint2", "tool0_joint")
    shifts, rotations = (
        {joint: tuple(itertools.islice(bounds, 3)) for joint in joints} for _ in range(2)
    )
    return aj.Uncertainty(arm, PLANE, joint_shifts=shifts, joint_rotations=rotations)


def test_few_corners_are_all_of_them(arm):
    uncertainty = box(arm, 4)
    corners = uncertainty.corners(16)
    assert corners.shape == (16, 4)
    assert {tuple(np.sign(corner)) for corner in corners} == set(
        itertools.product((-1, 1), repeat=4)
    )


@settings(max_examples=25)
@given(d=st.integers(0, 18), limit=st.integers(1, 200))
def test_corners(d, limit):
    uncertainty = box(ARM, d)
    corners = uncertainty.corners(limit)
    assert corners.shape[1] == d
    assert_array_equal(corners, uncertainty.corners(limit))
    assert len(np.unique(corners, axis=0)) == len(corners)
    at_ends = (corners == uncertainty.low) | (corners == uncertainty.high)
    if 2**d <= limit:
        assert len(corners) == 2**d
        assert at_ends.all()
        return
    assert len(corners) == max(limit, 2 * d)
    alone = corners[(corners == 0.0).any(axis=1)] if d > 1 else corners
    assert len(alone) == 2 * d
    assert (np.count_nonzero(alone, axis=1) == 1).all()
    assert at_ends.all(axis=1).sum() == len(corners) - (2 * d if d > 1 else 0)


ARM = aj.load_robot("two_link")
WEIGHTLESS = ARM.with_gravity((0.0, 0.0, 0.0))
NEAR = aj.JointBox.around(WEIGHTLESS, [0.8, 1.2], 0.2)


@pytest.mark.parametrize(("width", "count"), [(0.7, 2), (0.8, 3), (3.0, 5), (2.0 * np.pi, 9)])
def test_an_angle_is_cut_into_what_two_ends_stand_for(width, count):
    rolls = aj.Uncertainty(ARM, camera=PlanarCamera(0.05, 3.0), roll=(0.0, width))
    assert_allclose(rolls.corners()[:, 0], np.linspace(0.0, width, count))
    lengths = aj.Uncertainty(ARM, object_length=(0.0, width))
    assert_array_equal(lengths.corners()[:, 0], (0.0, width))


@given(
    low=st.floats(-3.0, 0.0), high=st.floats(0.0, 3.0), share=st.floats(0.0, 1.0)
)  # fmt: skip
@settings(max_examples=50)
def test_between_its_ends_a_rotation_is_one_of_theirs_but_for_a_cosine(low, high, share):
    rolls = aj.Uncertainty(ARM, camera=PlanarCamera(0.05, 3.0), roll=(low, high))
    points = rolls.corners()[:, 0]
    angle = low + share * (high - low)
    k = min(np.searchsorted(points, angle), len(points) - 1)
    before, after = points[max(k - 1, 0)], points[k]
    if after - before < 1e-6:
        return
    of_ends = np.array([[np.cos(t), np.sin(t)] for t in (before, after)]).T
    parts = np.linalg.solve(of_ends, [np.cos(angle), np.sin(angle)])
    assert (parts >= -1e-9).all()
    assert 1.0 - 1e-9 <= parts.sum() <= 1.0 / np.cos(np.pi / 8.0) + 1e-9


def test_an_angle_beyond_a_full_turn_is_refused():
    camera = PlanarCamera(0.05, 3.0)
    with pytest.raises(InvalidInputError, match=r"camera roll must .* full turn.* got 0 to 7"):
        aj.Uncertainty(ARM, camera=camera, roll=(0.0, 7.0))
    with pytest.raises(InvalidInputError, match=r"rotation x must .* full turn.* got -4 to 4"):
        aj.Uncertainty(ARM, joint_rotations={"joint2": (4.0, 0.0, 0.0)})
    rolls = aj.Uncertainty(ARM, camera=camera, roll=(-1.0, 1.0))
    assert_allclose(rolls.largest_scale(10.0), np.pi, rtol=1e-3)
    lenses = aj.Uncertainty(ARM, camera=camera, focal_length=(0.04, 0.05))
    assert_allclose(lenses.scaled(lenses.largest_scale(10.0)).low, 0.005)  # 0 is of no lens


@pytest.mark.study
def test_a_camera_that_may_be_rolled_any_way_is_not_certified():
    # the ends of (0, 2 pi) are the same robot, which is the believed one
    rolls = aj.Uncertainty(WEIGHTLESS, camera=PlanarCamera(0.05, 3.0), roll=(0.0, 2.0 * np.pi))
    controller = aj.SetpointController(rolls.believed_task(), aj.Gains(2e5, 5e4, 3.0))
    report = aj.Study(controller, rolls, NEAR).report(60)
    assert not report.passed
    assert report.reason == "unstable"
    (near,) = (row for row in report.rows if row[:2] == ("tests", "near targets"))
    assert near.verdict == "unstable"
    assert near.figures["rate"] == report.growth.rate > 0.0
    assert 0.5 * np.pi < report.growth.values[0] < 1.5 * np.pi
    assert report.rows[1].verdict == "problem"


@pytest.mark.study
def test_true_robots_inside_that_are_worse_than_both_ends_are_found():
    # tilted either way, the base takes as much of x from the plane that the task sees
    tilts = aj.Uncertainty(WEIGHTLESS, PLANE, joint_rotations={"joint1": (0.0, 0.0, np.pi / 8.0)})
    controller = aj.SetpointController(tilts.believed_task(), aj.Gains(100.0, 10.0, 1.0))
    loop, rng = ClosedLoop(controller, tilts, NEAR), np.random.default_rng(0)
    ends, inside = loop.draw(60, rng), loop.draw(60, rng, inside=1)
    form = MatrixForm(ends, loop.setting)
    full = form.unknowns("full")  # the last of which is the coupling: without it one end decides
    of_ends = best_weights(
        form, full._replace(basis=full.basis[:-1], start=full.start[:-1], least=full.least[:-1])
    )
    assert of_ends.margins.min() > 0.9
    assert MatrixForm(inside, loop.setting).margins(of_ends.weights).min() < 0.0

    report = aj.Study(controller, tilts, NEAR).report(120)
    assert report.passed  # by another function
    margins = MatrixForm(report.samples, loop.setting).margins(of_ends.weights)
    worst = int(report.samples.truth[margins.argmin()])
    assert worst >= 2
    assert abs(report.loop.values[worst][0]) < np.pi / 16.0
    told = tilts.describe(report.loop.values[worst])
    assert report.describe_truth(worst) == told
    test = report.test
    of_worst = report.describe_truth(int(test.form.samples.truth[test.worst]))
    assert report.summary()["worst"]["one function"]["truth"] == of_worst


def test_what_a_share_is_bounded_with_has_a_true_robot_of_its_own():
    tools = aj.Uncertainty(WEIGHTLESS, PLANE, object_length=(0.0, 0.3), object_mass=(0.0, 1.0))
    controller = aj.SetpointController(tools.believed_task(), aj.Gains(100.0, 20.0, 1.0))
    loop, rng = ClosedLoop(controller, tools, NEAR), np.random.default_rng(0)
    few, own = loop.draw(100, rng, inside=4), loop.draw(100, rng, inside=1)
    for samples, each in ((few, 4), (own, 1)):
        assert len(samples) == 100
        truths, counts = np.unique(samples.truth, return_counts=True)
        assert_array_equal(truths[:4], range(4))
        assert counts[4:].max() == each
        assert (samples.truth >= 4).sum() == 48
    values = loop.values[4:]
    assert len(np.unique(values, axis=0)) == len(values) == 60
    assert ((values > tools.low) & (values < tools.high)).all()
    for t, q, J in zip(own.truth[:20], own.q, own.J, strict=False):
        assert_allclose(J, tools.plant(loop.values[t]).sensor.jacobian(q), atol=1e-12)
    again = ClosedLoop(controller, tools, NEAR)
    again.draw(100, np.random.default_rng(0), inside=4)
    assert_array_equal(again.values, loop.values[: len(again.values)])


@given(
    seed=st.integers(0, 2**32), factor=st.floats(0.0, 3.0), low=st.floats(-0.9, 0.1),
    high=st.floats(0.1, 1.1),
)  # fmt: skip
@settings(max_examples=25)
def test_scaled(seed, factor, low, high):
    uncertainty = aj.Uncertainty(
        ARM, camera=CAMERA, roll=(low, high), joint_rotations={"joint2": (0.0, 0.1, 0.0)}
    )
    scaled = uncertainty.scaled(factor)
    assert scaled.names == uncertainty.names
    assert_array_equal(scaled.believed, uncertainty.believed)
    assert (scaled.low <= scaled.believed).all()
    assert (scaled.believed <= scaled.high).all()
    for end, other in ((scaled.low, uncertainty.low), (scaled.high, uncertainty.high)):
        expected = scaled.believed + factor * (other - scaled.believed)
        assert_allclose(end, expected, atol=1e-14)
    sample = scaled.sample(np.random.default_rng(seed))
    assert ((scaled.low <= sample) & (sample <= scaled.high)).all()
    assert_array_equal(sample, scaled.sample(np.random.default_rng(seed)))
    assert_array_equal(uncertainty.scaled(1.0).high, uncertainty.high)
    twice = scaled.scaled(0.5)
    assert_allclose(twice.high, uncertainty.scaled(0.5 * factor).high, atol=1e-15)


def test_scaled_by_zero_is_no_error(everything):
    none = everything.scaled(0.0)
    assert none.names == everything.names
    assert_array_equal(none.corners(), [everything.believed])
    assert_array_equal(none.low, none.high)
    assert none.plant(none.corners()[0]).robot == everything.belief()


# -- texts ------------------------------------------------------------------------------


def test_words(everything, arm):
    uncertainty = aj.Uncertainty(
        arm, object_length=(0.0, 0.3), camera=CAMERA, roll=(0.0, 0.5), object_axis="x"
    )
    assert uncertainty.describe([0.3, 0.349]) == (
        "object length 0.3 m, camera roll 0.349 rad (20.0 deg)"
    )
    assert uncertainty.describe([-0.0, 0.0]).startswith("object length 0 m")
    assert repr(uncertainty.scaled(0.5)) == (
        "Uncertainty('two_link': object length 0 to 0.15 m, "
        "camera roll 0.05 rad (2.9 deg) to 0.3 rad (17.2 deg))"
    )


def test_copies(everything):
    values = everything.high
    q = np.array([0.4, -1.1])
    for other in (pickle.loads(pickle.dumps(everything)), copy.deepcopy(everything)):
        assert repr(other) == repr(everything)
        assert_array_equal(other.low, everything.low)
        ours, theirs = everything.plant(values), other.plant(values)
        assert_array_equal(theirs.sensor.jacobian(q), ours.sensor.jacobian(q))


def test_what_was_given_cannot_be_changed_later(arm):
    bounds = np.array([0.1, 0.0, 0.0])
    shifts = {"joint2": bounds}
    uncertainty = aj.Uncertainty(arm, PLANE, joint_shifts=shifts)
    bounds[0] = 5.0
    shifts.clear()
    assert uncertainty.scaled(2.0).high == 0.2
    uncertainty.high[0] = 9.0
    assert uncertainty.high == 0.1


# -- what is refused --------------------------------------------------------------------

REFUSED = [
    (
        {"object_length": (0.3, 0.0)},
        r"object_length must be \(smallest, largest\) \[m\], got \(0.3, 0.0\); \(0.0, 0.3\) is",
    ),
    ({"object_length": (0.0, np.nan)}, r"object_length must be finite \[m\], got \[0.0, nan\]"),
    (
        {"object_length": 0.3},
        r"object_length must be \(smallest, largest\) \[m\], such as \(0.0, 0.3\), got 0.3",
    ),
    (
        {"object_length": (0.1, 0.3)},
        r"_length must contain what is believed, 0 \[m\], got \(0.1, 0.3\); \(0.0, 0.3\) does, or "
        "believe another value in it",
    ),
    ({"object_mass": (0.0, 1.0), "believed_mass": 2.0}, "object_mass must contain what is"),
    ({"object_length": (0.0, 20.0)}, r"object_length must be at most 10 \[m\], got 20"),
    ({"believed_length": 12.0}, r"believed_length must be at most 10 \[m\], got 12"),
    ({"object_length": (-0.1, 0.3)}, r"object_length must be a finite number >= 0 \[m\]"),
    ({"object_mass": (-0.1, 0.3)}, r"object_mass must be a finite number >= 0 \[kg\], got -0.1"),
    ({"believed_length": -1.0}, r"believed_length must be a finite number >= 0 \[m\], got -1"),
    ({"believed_mass": "1"}, r"believed_mass must be a finite number >= 0 \[kg\], got '1'"),
    ({"object_length": (0.0, 1.0), "object_axis": (0, 0, 0)}, "axis must not be zero"),
    ({"joint_shifts": [0.1]}, "joint_shifts must be a mapping from joint names to bounds"),
    ({"joint_shifts": {"joint2": (0.1, 0.1)}}, r"joint_shifts of joint2 must have shape"),
    (
        {"joint_rotations": {"joint2": (-0.1, 0.1, 0.0)}},
        r"joint_rotations of joint2 must be >= 0 .*got \[-0.1",
    ),
    ({"roll": (-0.1, 0.1)}, r"roll is that of a camera, got \(-0.1, 0.1\) without one: give"),
    ({"camera": 5}, r"camera must be a camera, such as PlanarCamera\(f, z\), or None, got 5"),
    (
        {"camera": CAMERA, "focal_length": (0.0, 0.1)},
        r"a camera must exist everywhere in the set, got camera focal length 0 m: focal_length "
        r"must be a finite number > 0 \[m\], got 0.0",
    ),
    (
        {"camera": CAMERA, "focal_length": (0.05, 2.5), "distance": (2.4, 3.5)},
        r"a camera must exist everywhere in the set, got camera focal length 2.5 m, camera "
        r"distance 2.4 m: distance must be a finite number > 2.5 \[m\], got 2.4",
    ),
    ({"camera": CAMERA, "focal_length": (0.05, 3.0)}, r"distance must be a finite number > 3 \[m"),
    ({"camera": CAMERA, "distance": (0.05, 3.0)}, r"distance must be .* > 0.05 \[m\], got 0"),
    ({"camera": CAMERA, "roll": (0.2, 0.3)}, r"roll must contain what is believed, 0.1 \[rad\]"),
    ({"factor": -1.0}, "factor must be a finite number >= 0, got -1.0"),
    ({"friction": (0.1, 0.2, 0.3)}, r"friction must have shape \(2,\)"),
    ({"friction": -1.0}, "friction must be >= 0"),
    ({"object_axis": (0, 0, 0)}, "axis must not be zero"),  # without a length, too
]  # fmt: skip


@pytest.mark.parametrize(("options", "text"), REFUSED)
def test_refused(arm, options, text):
    task = None if "camera" in options else PLANE
    with pytest.raises(aj.InvalidInputError, match=text):
        aj.Uncertainty(arm, task, **options)


def test_refused_arms_tasks_and_joints(arm):
    with pytest.raises(
        aj.InvalidInputError, match=r"arm must be the believed Robot, .* got 'panda'"
    ):
        aj.Uncertainty("panda")
    with pytest.raises(aj.InvalidInputError, match="task must be a function of a robot, got"):
        aj.Uncertainty(arm, PLANE(arm))
    with pytest.raises(aj.InvalidInputError, match="what task makes of a robot must be a task"):
        aj.Uncertainty(arm, lambda robot: robot)
    with pytest.raises(
        aj.InvalidInputError, match="sensor must be a task of the plant's own robot"
    ):
        aj.Uncertainty(arm, lambda robot: PLANE(arm), believed_length=0.1)
    for task in (lambda robot: PLANE(robot), 5):
        with pytest.raises(
            aj.InvalidInputError, match="task must be a function of a robot and a camera, such as"
        ):
            aj.Uncertainty(arm, task, camera=CAMERA)
    for field in ("joint_shifts", "joint_rotations"):
        with pytest.raises(UnknownNameError, match="joint 'joint' not in two_link; did you mean"):
            aj.Uncertainty(arm, PLANE, **{field: {"joint": (0.1, 0.0, 0.0)}})


def test_a_set_that_grows_too_large(arm):
    uncertainty = aj.Uncertainty(arm, PLANE, object_length=(0.05, 0.2), believed_length=0.1)
    assert uncertainty.scaled(2.0).low == 0.0
    with pytest.raises(
        aj.InvalidInputError,
        match=r"object_length must be a finite number >= 0 \[m\], got -0.0[45]",
    ):
        uncertainty.scaled(3.0)
    camera = aj.Uncertainty(arm, camera=CAMERA, distance=(2.0, 3.0))
    with pytest.raises(aj.InvalidInputError, match=r"distance 0 m with the factor 3: dist"):
        camera.scaled(3.0)
    with pytest.raises(aj.InvalidInputError, match="factor must be a finite number >= 0, got nan"):
        camera.scaled(float("nan"))


def test_refused_values_and_limits(arm):
    uncertainty = aj.Uncertainty(arm, PLANE, object_length=(0.0, 0.3))
    for ask in (uncertainty.plant, uncertainty.describe):
        with pytest.raises(aj.InvalidInputError, match=r"values must have shape \(1,\) \[m\]"):
            ask([0.1, 0.2])
    with pytest.raises(aj.InvalidInputError, match=r"length must be a finite number >= 0 \[m\]"):
        uncertainty.plant([-0.1])
    for limit in (0, 1.5, True):
        with pytest.raises(aj.InvalidInputError, match="limit must be an integer >= 1, got"):
            uncertainty.corners(limit)


def test_a_box_without_a_range_is_no_error():
    assert aj.Uncertainty(aj.load_robot("panda")).describe_box() == "no error"


def test_an_arm_that_holds_an_object_already_is_refused():
    held = aj.load_robot("panda").with_object(0.1)
    for ranges in ({"object_length": np.array([0.0, 0.3])}, {"believed_length": 0.2}):
        with pytest.raises(aj.InvalidInputError, match="arm must be without an object"):
            aj.Uncertainty(held, **ranges)
    aj.Uncertainty(held, joint_shifts={"panda_joint4": (0.01, 0.0, 0.0)})


def test_the_axes_are_those_of_the_belief():
    arm = aj.load_robot("panda")
    planar = arm.with_locked_joints(
        dict.fromkeys(("panda_joint1", "panda_joint3", "panda_joint5"), 0.0)
    )
    errors = aj.Uncertainty(planar, joint_rotations={"panda_joint4": (0.05, 0.0, 0.0)})
    assert errors.believed_task().labels == errors.plant([0.05]).sensor.labels == ("x", "z")
