"""`PoseTask`: the error is log(R R_dᵀ), its rate and its Jacobian; the potential of Eq. (12)."""

import functools

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.controllers import DifferentiatedVelocity
from approxjac.errors import UnknownNameError
from approxjac.robots import Dynamics
from approxjac.tasks import NonsingularTask, PoseTrackerTask, TrackerTask
from approxjac.tasks.analysis import place_of


@functools.cache
def panda_pose():
    return aj.PoseTask(aj.load_robot("panda"))


def value_of(position, R, length=1.0):
    """A value with the rotation matrix R and a quaternion of some length."""
    return np.concatenate([position, length * pin.Quaternion(R).coeffs()])


def direction(rng):
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


numbers = st.floats(-2.0, 2.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
# rotation vectors up to 180°, less a little: there both ways round are as long
rotations = st.tuples(vectors, st.floats(0.0, np.pi - 1e-6)).map(
    lambda pair: (
        pair[0] * (pair[1] / max(np.linalg.norm(pair[0]), 1e-3))
        if np.linalg.norm(pair[0]) > 1e-3
        else np.zeros(3)
    )
)
displacements = st.tuples(vectors, rotations).map(np.concatenate)
lengths = st.floats(1e-2, 1e2)
poses = st.tuples(vectors, rotations, lengths, st.sampled_from([-1.0, 1.0])).map(
    lambda parts: value_of(parts[0], pin.exp3(parts[1]), parts[2] * parts[3])
)


def test_the_value_is_pinocchios_pose(arm, rng):
    if arm.nv < 6:
        with pytest.raises(aj.InvalidInputError, match=rf"m <= n_v\), got m = 6 for {arm.name} "):
            aj.PoseTask(arm)
        return
    task = aj.PoseTask(arm)
    q = arm.random_configuration(rng)
    data = arm.model.createData()
    pin.framesForwardKinematics(arm.model, data, q)
    expected = pin.SE3ToXYZQUAT(data.oMf[arm.frame_id(arm.tip)])
    assert_allclose(task.value(q), expected, atol=1e-15)
    assert (task.m, task.n_x) == (6, 7)
    assert task.frame == arm.tip
    assert task.labels == ("x", "y", "z", "rx", "ry", "rz")
    assert task.units == ("m", "m", "m", "rad", "rad", "rad")
    assert task.units == ("m",) * 3 + ("rad",) * 3


def test_the_error_is_pinocchios_logarithm(panda, rng):
    task = aj.PoseTask(panda)
    for _ in range(200):
        x, x_d = (task.value(panda.random_configuration(rng)) for _ in range(2))
        R, R_d = (pin.XYZQUATToSE3(value).rotation for value in (x, x_d))
        error = task.error(x, x_d)
        assert_allclose(error[:3], x[:3] - x_d[:3], atol=1e-15)
        assert_allclose(error[3:], pin.log3(R @ R_d.T), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 3.0, np.pi - 1e-9, np.pi, np.pi + 1e-3])
def test_the_error_at_special_angles(angle, rng):
    """Against the angle and axis themselves to 1e-14, and against log3 as far as it goes."""
    task = panda_pose()
    for _ in range(20):
        axis, R_d = direction(rng), pin.exp3(rng.normal(size=3))
        # the value from quaternions: a rotation matrix near 180° has lost the sign
        half = 0.5 * angle
        turn = pin.Quaternion(np.array([*(np.sin(half) * axis), np.cos(half)]))
        target = pin.Quaternion(R_d)
        x_d = np.array([0.1, 0.2, 0.3, *target.coeffs()])
        x = np.array([0.4, 0.0, 0.3, *(turn * target).coeffs()])
        error = task.error(x, x_d)
        assert_allclose(error[:3], [0.3, -0.2, 0.0], atol=1e-15)
        expected = axis * (angle if angle <= np.pi else angle - 2 * np.pi)
        if angle == np.pi:  # both ways round are as long
            expected = np.copysign(1.0, expected @ error[3:]) * expected
        assert_allclose(error[3:], expected, atol=2e-15 if angle < 1e-2 else 1e-14)
        logarithm = pin.log3(turn.toRotationMatrix())
        if abs(angle - np.pi) < 1e-6:
            logarithm = np.copysign(1.0, logarithm @ error[3:]) * logarithm
        assert_allclose(error[3:], logarithm, atol=1e-7)


@given(poses, poses, lengths)
def test_sign_and_length_of_the_quaternions_do_not_matter(x, x_d, length):
    task = panda_pose()
    error = task.error(x, x_d)
    for a, b in ((-length, 1.0), (1.0, -length), (length, length)):
        scaled = task.error(
            np.concatenate([x[:3], a * x[3:]]), np.concatenate([x_d[:3], b * x_d[3:]])
        )
        if np.linalg.norm(error[3:]) > np.pi - 1e-12 and scaled[3:] @ error[3:] < 0.0:
            scaled[3:] = -scaled[3:]  # at 180° the sign of the quaternion decides
        assert_allclose(scaled, error, atol=1e-12)


def test_at_180_degrees_the_sign_of_the_quaternion_decides():
    task = panda_pose()
    upright, turned = np.array([0, 0, 0, 0, 0, 0, 1.0]), np.array([0, 0, 0, 0.0, 1, 0, 0.0])
    assert_allclose(task.error(turned, upright)[3:], [0, np.pi, 0])
    assert_allclose(task.error(-turned, upright)[3:], [0, -np.pi, 0])


@pytest.mark.parametrize(
    "quaternion", [(0, 0, 0, 0), (0, np.nan, 0, 1), (np.inf, 0, 0, 1), (0, 0, -np.inf, 0)]
)
def test_what_is_no_orientation_gives_nan_and_counts_as_lost(panda, quaternion, rng):
    task = aj.PoseTask(panda)
    q, v = panda.random_configuration(rng), rng.uniform(-1, 1, 7)
    good = task.value(q)
    bad = np.array([*good[:3], *quaternion], dtype=float)
    assert np.isnan(task.error(bad, good)[3:]).all()
    assert np.isnan(task.error(good, bad)[3:]).all()
    controller = aj.SetpointController(task)
    answer = controller.evaluate(np.zeros(0), aj.Measurement(0.0, q, v, bad), good)
    assert answer.status is aj.Status.MEASUREMENT_LOST
    _, kv, damping = controller.diagonals
    J = task.jacobian(q)
    expected = Dynamics(panda).g(q) - J.T @ (kv * (J @ v)) - damping * v
    assert_allclose(answer.torque, expected, atol=1e-12)


def test_targets_that_are_no_pose_are_refused(panda):
    task = aj.PoseTask(panda)
    for target, text in (
        (np.zeros(6), r"target must have shape \(7,\) \[m or rad\], got shape \(6,\)"),
        (np.zeros(7), r"target must be a value of PoseTask\('panda', 'panda_hand_tcp'\), got \["),
        ((0, 0, 0, 1e-7, 0, 0, 0), "target must be a value of PoseTask"),
        ((0, 0, 0, np.nan, 0, 0, 1), r"target must be finite \[m or rad\], got \["),
        ((0, np.inf, 0, 0, 0, 0, 1), r"target must be finite \[m or rad\], got \["),
        ((0, 0, 0, 1.7e308, 1.7e308, 0, 0), "target must be a value of PoseTask"),
        ("here", r"target must be numbers of shape \(7,\)"),
    ):
        with pytest.raises(aj.InvalidInputError, match=text):
            task.target(target)
    good = task.target((0.1, 0.2, 0.3, 0, 0, 0, -2))
    assert_allclose(good, [0.1, 0.2, 0.3, 0, 0, 0, -2])
    assert not good.flags.writeable
    position = aj.PositionTask(panda)
    with pytest.raises(aj.InvalidInputError, match=r"target must have shape \(3,\) \[m\], got sh"):
        position.target(np.zeros(7))
    with pytest.raises(aj.InvalidInputError, match=r"target must be finite \[m\], got \[nan"):
        position.target((np.nan, 0, 0))


# -- the axioms -----------------------------------------------------------------------------


@given(poses)
def test_a_value_has_no_error_to_itself(x):
    assert_allclose(panda_pose().error(x, x), np.zeros(6), atol=1e-15)


@given(poses, poses)
def test_no_error_is_beyond_180_degrees_and_swapping_turns_its_sign(x, x_d):
    task = panda_pose()
    error = task.error(x, x_d)
    assert np.linalg.norm(error[3:]) <= np.pi * (1 + 1e-15)
    if np.linalg.norm(error[3:]) < np.pi - 1e-9:
        assert_allclose(task.error(x_d, x), -error, atol=1e-12)


@given(poses, displacements)
def test_the_error_to_where_it_was_displaced_from_is_the_displacement(x, displacement):
    task = panda_pose()
    assert_allclose(task.error(task.displaced(x, displacement), x), displacement, atol=1e-12)


@given(displacements)
def test_the_origin_is_no_rotation(displacement):
    task = panda_pose()
    assert_allclose(task.target(task.origin), [0, 0, 0, 0, 0, 0, 1])
    x = task.displaced(task.origin, displacement)
    assert_allclose(x[:3], displacement[:3])
    R = pin.XYZQUATToSE3(x).rotation
    assert_allclose(R, pin.exp3(displacement[3:]), atol=1e-14)


def error_rate(error, velocity):
    """ė where the geometric Jacobian gives a velocity and an angular velocity."""
    return panda_pose().error_jacobian(error, velocity[:, np.newaxis])[:, 0]


@given(displacements, vectors, vectors)
def test_the_potential_falls_as_the_angular_velocity_pulls(error, velocity, omega):
    """d/dt ½‖φ‖² = φᵀω, however large φ is: why Eq. (12) holds with equal rotational gains."""
    rate = error_rate(error, np.concatenate([velocity, omega]))
    assert_allclose(rate[:3], velocity)
    assert_allclose(error[3:] @ rate[3:], error[3:] @ omega, atol=1e-12)


# -- derivatives ----------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [1e-6, 0.99e-4, 1.01e-4, 0.1, 2.0, 3.0, 3.13])
def test_error_rates_by_finite_differences_at_large_errors(angle, rng):
    task, h = panda_pose(), 1e-5
    for _ in range(10):
        x_d = value_of(rng.normal(size=3), pin.exp3(rng.normal(size=3)))
        error = np.concatenate([rng.normal(size=3), angle * direction(rng)])
        velocity = rng.uniform(-1, 1, 6)
        x = task.displaced(x_d, error)
        ahead, behind = (task.error(task.displaced(x, s * h * velocity), x_d) for s in (1, -1))
        # the second derivative grows like 1/(π − angle)²
        assert_allclose(
            error_rate(error, velocity),
            (ahead - behind) / (2 * h),
            atol=1e-8 / (np.pi - angle) ** 2 + 1e-9,
        )


def test_the_error_rate_is_continuous_where_its_series_begins(rng):
    axis, omega = direction(rng), rng.normal(size=6)
    rates = [
        error_rate(np.concatenate([np.zeros(3), angle * axis]), omega)
        for angle in (1e-4 * (1 - 1e-12), 1e-4 * (1 + 1e-12))
    ]
    assert_allclose(rates[0], rates[1], atol=1e-15)
    # at no error, the rate is what the Jacobian gives
    assert_allclose(error_rate(np.zeros(6), omega), omega, atol=0)


def test_the_error_of_a_moving_arm_changes_at_its_rate(panda, rng):
    """The whole chain: q̇, Jacobian, error and its rate at a large error."""
    task, h = aj.PoseTask(panda), 1e-6
    for _ in range(10):
        q, v = panda.random_configuration(rng), rng.uniform(-1, 1, 7)
        x_d = task.value(panda.random_configuration(rng))
        error = task.error(task.value(q), x_d)
        if np.linalg.norm(error[3:]) > 3.0:
            continue
        ahead, behind = (
            task.error(task.value(pin.integrate(panda.model, q, s * h * v)), x_d) for s in (1, -1)
        )
        rate = error_rate(error, task.jacobian(q) @ v)
        assert_allclose(rate, (ahead - behind) / (2 * h), atol=1e-7)


def test_law_5_is_refused(panda):
    with pytest.raises(aj.InvalidInputError, match=r"law \(5\) .* whose error is x - x_d, got Pos"):
        aj.SetpointController(
            aj.PoseTask(panda), aj.Gains(100.0, 20.0, 1.0), velocity=DifferentiatedVelocity()
        )


def test_law_5_is_for_what_subtracts(panda):
    """A stack or a design of tasks whose error is x − x_d has such an error too."""
    position, pose = aj.PositionTask(panda), aj.PoseTask(panda)
    gains, differentiated = aj.Gains(100.0, 20.0, 1.0), DifferentiatedVelocity()
    bend = {"panda_joint4": 0.3}
    for task in (
        position,
        NonsingularTask(position, bend),
        aj.StackedTask(position, aj.PositionTask(panda, "panda_link4", "z")),
    ):
        assert task.subtracts
        aj.SetpointController(task, gains, velocity=differentiated)
    for task in (pose, NonsingularTask(pose, bend), aj.StackedTask(pose)):
        assert not task.subtracts
        with pytest.raises(aj.InvalidInputError, match=r"law \(5\) .* whose error is x - x_d"):
            aj.SetpointController(task, gains, velocity=differentiated)


def test_repr_names_robot_and_frame(panda):
    assert repr(aj.PoseTask(panda, "panda_link5")) == "PoseTask('panda', 'panda_link5')"
    with pytest.raises(UnknownNameError, match="frame 'tcp' not in panda"):
        aj.PoseTask(panda, "tcp")


@pytest.mark.parametrize("kind", [TrackerTask, PoseTrackerTask])
def test_a_value_in_the_axes_of_a_tracker_has_its_place_in_the_world(panda, rng, kind):
    task, q = kind(panda, (0.4, -0.7, 1.1), (2.0, -1.0, 0.5)), panda.random_configuration(rng)
    assert_allclose(place_of(task, task.value(q)), aj.PositionTask(panda).value(q))
