"""The linearisation of Eq. (9)."""

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

import approxjac as aj


def linearized_by_differences(plant, controller, q_target):
    """The closed loop's flow in tangent coordinates, differentiated numerically."""
    n, model = plant.robot.nv, plant.robot.model
    target = plant.sensor.value(q_target)

    def flow(z):
        q, v = pin.integrate(model, q_target, z[:n]), z[n:]
        answer = controller.evaluate(np.zeros(0), plant.measure(0.0, q, v), target)
        return np.concatenate([v, plant.acceleration(q, v, answer.torque)])

    h = 1e-5
    return np.array([(flow(h * u) - flow(-h * u)) / (2 * h) for u in np.eye(2 * n)]).T


@pytest.mark.parametrize("name", ["two_link", "ur5", "panda", "kinova"])
def test_eigenvalues_are_those_of_the_flow(name, rng):
    arm = aj.load_robot(name)
    truth, belief = arm.with_object(0.2), arm.with_object(0.05, axis="x")  # massless: g is exact
    axes = "xz" if arm.nv == 2 else "xyz"
    plant = aj.Plant(truth, aj.PositionTask(truth, axes=axes), friction=0.3)
    controller = aj.SetpointController(
        aj.PositionTask(belief, axes=axes), aj.Gains(60.0, 30.0, damping=1.0),
        saturation=aj.Sine(0.1),
    )  # fmt: skip
    q = truth.random_configuration(rng)
    local = aj.local_stability(plant, controller, q)
    redundancy = arm.nv - len(axes)
    assert local.eigenvalues.shape == (2 * arm.nv - redundancy,)
    expected = np.linalg.eigvals(linearized_by_differences(plant, controller, q))
    expected = expected[np.argsort(np.abs(expected))][redundancy:]
    scale = np.abs(expected).max()
    for eigenvalue in local.eigenvalues:
        assert np.abs(expected - eigenvalue).min() < 1e-4 * scale
    assert_allclose(local.max_real_eigenvalue, expected.real.max(), atol=1e-4 * scale)
    assert local.stable == (local.max_real_eigenvalue < 0)


def test_an_exact_model_is_stable_and_a_reversed_camera_is_not(two_link):
    camera = aj.PlanarCamera(0.05, 3.0)
    plant = aj.Plant(two_link, aj.ImageTask(two_link, camera))
    for roll, stable in ((0.0, True), (np.pi, False)):
        believed = aj.PlanarCamera(0.05, 3.0, roll=roll)
        controller = aj.SetpointController(
            aj.ImageTask(two_link, believed), aj.Gains(5000.0, 5000.0)
        )
        assert aj.local_stability(plant, controller, np.array([1.5, 1.5])).stable is stable


@pytest.mark.parametrize("q", [(0.3, 0.0), (0.3, np.pi), (-1.0, 0.0), (0.0, 0.0)])
def test_a_singular_target_is_never_stable(two_link, q):
    task = aj.PositionTask(two_link, axes="xz")
    local = aj.local_stability(
        aj.Plant(two_link, task), aj.SetpointController(task, aj.Gains(50.0, 20.0)), q
    )
    assert local.singular
    assert not local.stable


def controllers_without_a_linearization(robot):
    task, gains = aj.PositionTask(robot, axes="xz"), aj.Gains(50.0, 20.0)
    heavier = robot.with_object(0.1, 0.5, name="more")
    image = aj.ImageTask(robot, aj.PlanarCamera(0.05, 3.0))
    return {
        r"local_stability is for law \(6\), .*got SetpointController\(law \(5\)": (
            aj.SetpointController(task, gains, velocity=aj.DifferentiatedVelocity())
        ),
        r"gravity must be exact near the target .* with NoGravity": (
            aj.SetpointController(task, gains, gravity=aj.NoGravity(robot))
        ),
        r"gravity must be exact near the target .* with ModelGravity": (
            aj.SetpointController(task, gains, gravity=aj.ModelGravity(heavier))
        ),
        r"local_stability is for controllers without a posture, .*got Posture\(": (
            aj.SetpointController(
                aj.PositionTask(robot, axes="x"),
                aj.Gains(50.0, 20.0, 1.0),
                posture=aj.Posture((0.5, 1.0), 1.0),
            )
        ),
        r"the controller's task must have the coordinates of the plant's sensor": (
            aj.SetpointController(image, gains)
        ),
    }


def test_what_has_another_linearization_is_refused(two_link):
    plant = aj.Plant(two_link, aj.PositionTask(two_link, axes="xz"))
    height = aj.Plant(two_link, aj.PositionTask(two_link, axes="x"))
    for text, controller in controllers_without_a_linearization(two_link).items():
        chosen = plant if controller.posture is None else height
        with pytest.raises(aj.InvalidInputError, match=text):
            aj.local_stability(chosen, controller, np.array([0.5, 1.0]))
    good = aj.SetpointController(aj.PositionTask(two_link, axes="xz"), aj.Gains(50.0, 20.0))
    with pytest.raises(aj.InvalidInputError, match=r"q_target must have shape \(2,\)"):
        aj.local_stability(plant, good, np.zeros(3))


@pytest.mark.parametrize(
    "options",
    [
        {"coulomb": 1.0},
        {"torque_limits": 20.0},
        {"actuator_delay": 0.01},
        {"sensing": aj.Sensing(x_noise=1e-3)},
    ],
)
def test_what_eq_1_does_not_have_is_refused(two_link, options):
    """By the local test and by V and W, which know viscous friction only."""
    task = aj.PositionTask(two_link, axes="xz")
    plant, controller = aj.Plant(two_link, task, **options), aj.SetpointController(task)
    q = np.array([0.3, 0.8])
    with pytest.raises(aj.InvalidInputError, match="the local test is for a plant without Coulomb"):
        aj.local_stability(plant, controller, q)
    with pytest.raises(aj.InvalidInputError, match="the Lyapunov function is for a plant without"):
        aj.lyapunov(plant, controller, q, np.zeros(2), task.value(q), 1.0)
