"""Errors of an arm by the covariance of its calibration, in every test of a study."""

import dataclasses
import pickle

import numpy as np
import pytest
from beliefs import belief_of
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2
from tests.calibration.test_calibrate import elsewhere, sockets
from tests.controllers.test_learnt_axes import Arm

import approxjac as aj
from approxjac.calibration import calibrate
from approxjac.controllers import PredictedMeasurement
from approxjac.robots import KinematicRegressor
from approxjac.stability import Execution

FAR = np.sqrt(chi2.ppf(0.95, 39))  # of the numbers of an arm with six joints


@pytest.fixture(scope="module")
def known():
    return belief_of(aj.load_robot("ur5"), off=3.0)


@pytest.fixture(scope="module")
def errors(known):
    belief, robot = known
    return aj.Uncertainty(robot, covariance=belief)


@pytest.fixture(scope="module")
def numbers(known):
    """Return the robot's regressor, and the covariance of its numbers."""
    belief, robot = known
    regressor = KinematicRegressor(robot, axes=True)
    return regressor, belief.about(regressor, belief.names)[1]


def test_draws_are_normal_with_the_covariance(errors, numbers):
    _, P = numbers
    rng = np.random.default_rng(0)
    drawn = np.array([errors.sample(rng) for _ in range(4000)])
    assert drawn.shape == (4000, errors.d) == (4000, len(P))
    white = np.linalg.solve(np.linalg.cholesky(P), drawn.T)
    assert np.abs(white.mean(axis=1)).max() < 5.0 / np.sqrt(4000)
    assert np.abs(np.cov(white) - np.eye(len(P))).max() < 7.0 / np.sqrt(4000)
    inside = np.linalg.norm(white, axis=0) <= errors._radius
    assert inside.mean() == pytest.approx(0.95, abs=0.012)
    again = np.array([errors.scaled(2.0).sample(np.random.default_rng(0)) for _ in range(1)])
    assert_allclose(again[0], 2.0 * drawn[0])


@pytest.mark.parametrize(("confidence", "most"), [(0.5, 0.01), (0.95, 1e-3), (0.997, 3e-3)])
def test_the_radius_is_that_of_chi_squared(known, confidence, most):
    belief, robot = known
    errors = aj.Uncertainty(robot, covariance=belief, confidence=confidence)
    expected = np.sqrt(chi2.ppf(confidence, errors.d))
    assert errors._radius == pytest.approx(expected, rel=most)
    sd = np.sqrt(errors._learnt.P.diagonal())
    assert_allclose(errors.high, expected * sd, rtol=most)
    assert_allclose(errors.low, -errors.high)


def test_corners_are_on_the_ellipsoid_along_conjugate_axes(errors, numbers):
    _, P = numbers
    corners = errors.corners()
    white = np.linalg.solve(np.linalg.cholesky(P), corners.T).T / errors._radius
    assert_allclose(np.linalg.norm(white, axis=1), 1.0, rtol=1e-6)
    assert_allclose(white[1::2], -white[::2], atol=1e-9)
    assert_allclose(white[::2] @ white[::2].T, np.eye(len(white) // 2), atol=1e-6)
    assert_array_equal(errors.corners(10), corners[:10])
    assert_allclose(errors.scaled(0.5).corners(), 0.5 * corners, rtol=1e-9, atol=1e-15)


def test_the_first_corners_change_the_jacobian_most(errors, numbers):
    """More than any draw pulled onto the surface does, in the mean over configurations."""
    task, some = errors.believed_task(), [*errors.arm.configurations(16)]
    J = np.array([task.jacobian(q) for q in some])

    def change(values):
        sensor = errors.plant(values).sensor
        return np.sqrt(np.sum((np.array([sensor.jacobian(q) for q in some]) - J) ** 2))

    corners, (_, P) = errors.corners(), numbers
    changes = np.array([change(each) for each in corners[::2]])
    assert (np.diff(changes) < 0.1 * changes[:-1]).all()  # of what is linear they fall
    rng, L = np.random.default_rng(1), np.linalg.cholesky(P)
    for _ in range(60):
        z = rng.normal(size=len(L))
        assert change(errors._radius * L @ z / np.linalg.norm(z)) < changes[0]
    # axes that are left out change nothing
    assert len(corners) == 64 or change(corners[-1]) < 1e-3 * changes[0]


def test_true_robots_are_those_of_the_numbers(errors, numbers, rng):
    regressor, _ = numbers
    for _ in range(4):
        values, q = errors.sample(rng), rng.uniform(-2.0, 2.0, 6)
        theta = regressor.theta + values
        slow = regressor.robot_with(theta)
        plant = errors.plant(values)
        assert_allclose(plant.sensor.value(q), regressor.position(q, theta), atol=1e-12)
        assert_allclose(plant.dynamics.g(q), aj.Plant(slow).dynamics.g(q), atol=1e-9)
    assert errors.plant(np.zeros(errors.d)).robot is errors.belief()


def test_tips_move_by_the_covariance(errors, numbers):
    """Monte Carlo against HPHᵀ, with H by finite differences."""
    regressor, P = numbers
    rng, q = np.random.default_rng(4), np.array([0.4, -1.2, 1.0, -0.5, 0.6, 0.2])
    steps = 1e-6 * np.eye(len(P))
    of = [regressor.position(q, regressor.theta + s * e) for e in steps for s in (1.0, -1.0)]
    H = (np.array(of[::2]) - np.array(of[1::2])).T / 2e-6
    here = errors.believed_task().value(q)
    off = np.array([errors.plant(errors.sample(rng)).sensor.value(q) - here for _ in range(1500)])
    C = H @ P @ H.T
    assert_allclose(np.cov(off.T), C, atol=0.12 * np.trace(C))
    corners = np.array([errors.plant(each).sensor.value(q) - here for each in errors.corners()])
    most = errors._radius * np.sqrt(np.linalg.eigvalsh(C)[-1])
    assert np.linalg.norm(corners, axis=1).max() < 1.05 * most


def test_draws_of_sockets_are_far_nearer_than_those_of_boxes():
    """Of how the arm moves, wherever its base is, which a socket does not show."""
    arm = Arm("panda", 71)
    recordings, apart = sockets(arm, 1)
    found = calibrate(arm.believed, recordings, apart=apart)
    errors = aj.Uncertainty(found.robot, covariance=found)
    rng, sd, away = np.random.default_rng(0), np.sqrt(errors._learnt.P.diagonal()), []
    for _ in range(40):
        for values in (errors.sample(rng), sd * rng.uniform(-3.0, 3.0, errors.d)):
            away.append(elsewhere(arm, errors.plant(values).robot, 40))
    by_covariance, alone = np.median(away[::2]), np.median(away[1::2])
    assert by_covariance < 0.5e-3
    assert alone > 5.0 * by_covariance


def test_a_tool_in_hand_and_errors_of_the_arm(known):
    belief, robot = known
    both = aj.Uncertainty(robot, object_length=(0.0, 0.3), covariance=belief)
    alone = aj.Uncertainty(robot, covariance=belief)
    assert both.names == ("object_length", *alone.names)
    corners = both.corners()
    assert_array_equal(corners[:, 1:], alone.corners())
    assert set(corners[:, 0]) == {0.0, 0.3}
    values, q = corners[3], robot.neutral()
    tip = alone.plant(values[1:]).robot
    expected = aj.PositionTask(tip.with_object(values[0])).value(q)
    assert_allclose(both.plant(values).sensor.value(q), expected, atol=1e-12)
    assert both.describe(values).startswith("object length 0.3 m, learnt numbers ")
    assert both.describe_box().endswith(f", {alone.d} learnt numbers up to {FAR:.3g} sd off")


def test_it_says_how_far_it_is_off(errors):
    assert repr(errors) == f"Uncertainty('ur5': {errors.d} learnt numbers up to {FAR:.3g} sd off)"
    values = np.zeros(errors.d)
    assert errors.describe(values) == "no error"
    i = errors.names.index("elbow_joint.encoder")
    values[i] = 0.02
    sd = np.linalg.norm(np.linalg.solve(np.linalg.cholesky(errors._learnt.P), values))
    assert errors.describe(values) == (
        f"learnt numbers {sd:.3g} sd off, most elbow_joint.encoder 0.02 rad (1.1 deg)"
    )
    again = pickle.loads(pickle.dumps(errors))
    assert_array_equal(again.plant(values).robot.model.jointPlacements[3].rotation,
                       errors.plant(values).robot.model.jointPlacements[3].rotation)  # fmt: skip


def test_what_does_not_fit_is_refused(known):
    belief, robot = known
    with pytest.raises(aj.InvalidInputError, match="arm must be the robot of the calibration"):
        aj.Uncertainty(aj.load_robot("ur5"), covariance=belief)
    with pytest.raises(aj.InvalidInputError, match="calibration must be of panda"):
        aj.Uncertainty(aj.load_robot("panda"), covariance=belief)
    with pytest.raises(aj.InvalidInputError, match="without joint_shifts and joint_rotations"):
        aj.Uncertainty(robot, covariance=belief, joint_shifts={"elbow_joint": (0.01, 0.0, 0.0)})
    with pytest.raises(aj.InvalidInputError, match="covariance must be a Calibration, or None"):
        aj.Uncertainty(robot, covariance=belief.covariance)
    for confidence in (0.0, 1.0, "much"):
        with pytest.raises(aj.InvalidInputError, match="confidence must be"):
            aj.Uncertainty(robot, covariance=belief, confidence=confidence)


# -- in a study -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def study(known):
    belief, robot = known
    weightless = robot.with_gravity((0.0, 0.0, 0.0))
    errors = aj.Uncertainty(weightless, covariance=belief)
    law = aj.SetpointController(errors.believed_task())
    q = [0.3, -1.2, 1.3, -0.6, 1.1, 0.2]
    return aj.Study(law, errors, aj.JointBox.around(weightless, q, 0.2), duration=1.5)


@pytest.mark.study
def test_a_report_draws_from_it(study):
    report = study.report(100)
    (near,) = (row for row in report.rows if row[:2] == ("tests", "near targets"))
    assert report.passed
    assert near.verdict == "stable"
    assert f"{study.uncertainty.d} learnt numbers up to {FAR:.3g} sd off" in str(report)
    k = len(study.uncertainty.corners())
    assert_array_equal(report.loop.values[:k], study.uncertainty.corners())
    assert len(report.loop.values) > k


@pytest.mark.parametrize("learns", [False, pytest.param(True, marks=pytest.mark.study)])
def test_rollouts_in_lanes_are_those_of_python(study, known, learns):
    """Of a law that learns from the prior that the arms are drawn from, too."""
    pytest.importorskip("llvmlite")
    if learns:
        law, (belief, _) = study.controller, known
        kinematics = aj.AdaptiveKinematics(law.task, ("tool",), prior=belief)
        sensing = aj.Sensing(x_rate=50.0, x_delay=0.02)
        controller = PredictedMeasurement(law, kinematics)
        study = dataclasses.replace(study, controller=controller, sensing=sensing)
    runs = [study.rollouts(6, execution=Execution(engine=each)) for each in ("lanes", "python")]
    lanes, python = runs
    assert lanes.setting.engine == "lanes"
    for one, other in zip(lanes.runs, python.runs, strict=True):
        assert_array_equal(one.values, other.values)
        assert one.final_error == pytest.approx(other.final_error, rel=1e-6, abs=1e-12)
        assert np.abs(one.values).max() > 0.0


def test_tolerance_and_map_scale_the_ellipsoid(study):
    (tolerance,) = study.tolerance(tests=["stable"], largest=0.5, draws=40).values()
    assert tolerance.scale == 0.5
    assert tolerance.uncertainty.factor == 0.5
    grid = study.map({"error": [0.0, 1.0], "a": [10.0, 20.0]}, 4)
    assert grid.share.shape == (2, 2)
    for (scale, _), runs in grid.points.items():
        assert any(np.any(run.values) for run in runs.runs) == (scale > 0.0)
