"""`NonsingularTask`: a designed Ĵ (section 6 of the paper), and arms in singular postures.

Law (6) in and through singular postures: Eq. (6), Eq. (7), Eq. (28).
"""

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.errors import UnknownNameError
from approxjac.robots import Dynamics, GravityRegressor
from approxjac.tasks import NonsingularTask

# postures with the arm stretched out, where a position task loses a direction
XARM7 = (0.0, 0.7, 0.0, 2.741763303, 0.0, 0.442071942, 0.0)
PANDA = (0.0, 0.4, 0.0, -0.4670024182, 0.0, 2.9570791787, 0.0)


def stretched(name):
    """A robot, its position task, the designed one, and a singular posture."""
    if name == "two_link":
        robot = aj.load_robot("two_link").with_object(0.5, 0.5, radius=0.0, axis="x")
        task = aj.PositionTask(robot, axes="xz")
        return task, NonsingularTask(task, {"joint2": 0.3}), np.array([0.6, 0.0])
    task = aj.PositionTask(aj.load_robot(name))
    if name == "xarm7":
        return task, NonsingularTask(task, {"joint4": 0.3}), np.array(XARM7)
    return task, NonsingularTask(task, {"panda_joint4": -0.3}), np.array(PANDA)


ARMS = ["two_link", "xarm7", "panda"]
LONGER = [ARMS[0], *(pytest.param(name, marks=pytest.mark.study) for name in ARMS[1:])]


def smallest(J):
    return np.linalg.svd(J, compute_uv=False)[-1]


@pytest.mark.parametrize("name", ARMS)
def test_away_from_singular_postures_it_is_the_plain_jacobian(name, rng):
    task, designed, _ = stretched(name)
    robot, regular = task.robot, 0
    for _ in range(50):
        q, v = robot.random_configuration(rng), rng.uniform(-1, 1, robot.nv)
        values = np.linalg.svd(task.jacobian(q), compute_uv=False)
        if values[-1] > 0.101 * values[0]:
            regular += 1
            assert np.array_equal(designed.jacobian(q), task.jacobian(q))
            assert np.array_equal(designed.jacobian_dot(q, v), task.jacobian_dot(q, v))
            assert designed.design_error(q) == 0.0
        elif values[-1] < 0.099 * values[0]:
            assert designed.design_error(q) > 0.0
    assert regular > 10


@pytest.mark.parametrize(("name", "kept"), [("two_link", 0.14), ("xarm7", 0.04), ("panda", 0.05)])
def test_it_keeps_its_rank_in_a_singular_posture(name, kept):
    task, designed, q = stretched(name)
    assert smallest(task.jacobian(q)) < 1e-6
    assert smallest(designed.jacobian(q)) > kept
    # only the direction that is lost is changed
    U = np.linalg.svd(task.jacobian(q))[0]
    change = U.T @ (designed.jacobian(q) - task.jacobian(q))
    assert_allclose(change[:-1], 0.0, atol=1e-8)
    # in which it has the row of the bent posture
    bent = pin.integrate(task.robot.model, q, designed._bend)
    assert_allclose(U.T[-1] @ designed.jacobian(q), U.T[-1] @ task.jacobian(bent), atol=1e-8)


@pytest.mark.parametrize("name", ARMS)
def test_the_design_error_is_the_largest_singular_value_of_the_change(name):
    task, designed, q = stretched(name)
    for offset in (0.0, 0.05, -0.1):
        posture = pin.integrate(task.robot.model, q, np.full(task.robot.nv, offset))
        change = designed.jacobian(posture) - task.jacobian(posture)
        expected = np.linalg.svd(change, compute_uv=False)[0]
        assert_allclose(designed.design_error(posture), expected, rtol=1e-12)
    # Eq. (7): what it adds to p is at most what bending the arm changes
    bent = pin.integrate(task.robot.model, q, designed._bend)
    most = np.linalg.norm(task.jacobian(bent) - task.jacobian(q), 2)
    assert 0.0 < designed.design_error(q) <= most * (1 + 1e-12)


@pytest.mark.parametrize(("name", "joint"), [("two_link", 1), ("xarm7", 5), ("panda", 5)])
def test_it_is_continuous_through_a_singular_posture(name, joint):
    """Lipschitz in q: with D the change of Ĵ by bending, (3 + 2‖D‖/(ratio σ_max)) ‖∂Ĵ/∂q‖."""
    task, designed, q = stretched(name)
    robot = task.robot
    unit = np.eye(robot.nv)[joint]
    grid = np.linspace(-0.6, 0.6, 2402)  # the singular posture lies between two of its points
    path = [np.array(pin.integrate(robot.model, q, x * unit)) for x in grid]
    slope = max(np.linalg.norm(task.jacobian_dot(posture, unit), 2) for posture in path[::20])
    bend = max(
        np.linalg.norm(
            task.jacobian(pin.integrate(robot.model, x, designed._bend)) - task.jacobian(x), 2
        )
        for x in path[::20]
    )
    largest = min(np.linalg.norm(task.jacobian(posture), 2) for posture in path[::20])
    lipschitz = (3.0 + 2.0 * bend / (0.1 * largest)) * slope
    steps = np.diff([designed.jacobian(posture) for posture in path], axis=0)
    sizes = np.linalg.norm(steps, 2, axis=(1, 2))
    assert sizes.max() <= lipschitz * (grid[1] - grid[0])
    assert smallest(task.jacobian(path[1200])) < 1e-3  # it did pass there


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("offset", [0.0, 0.02, -0.05, 0.1, -0.2, 1.0])
def test_its_rate_by_finite_differences(name, offset, rng):
    """In the singular posture, near it, and outside of where it is changed."""
    task, designed, q = stretched(name)
    model, h = task.robot.model, 1e-6
    unit = np.eye(task.robot.nv)[1 if name == "two_link" else 5]
    q = pin.integrate(model, q, offset * unit)
    v = rng.uniform(-1, 1, task.robot.nv)
    if abs(offset) <= 0.1:
        assert designed.design_error(q) > 0.0
    if offset == 1.0:
        assert designed.design_error(q) == 0.0
    ahead, behind = (designed.jacobian(pin.integrate(model, q, s * h * v)) for s in (1, -1))
    assert_allclose(designed.jacobian_dot(q, v), (ahead - behind) / (2 * h), atol=2e-8)


def test_its_rate_where_several_directions_are_changed(panda, rng):
    designed = NonsingularTask(aj.PoseTask(panda), {"panda_joint4": 0.3}, ratio=0.5)
    h = 1e-6
    for _ in range(10):
        q, v = panda.random_configuration(rng), rng.uniform(-1, 1, 7)
        values = np.linalg.svd(designed.task.jacobian(q), compute_uv=False)
        assert (values < 0.5 * values[0]).sum() >= 2
        ahead, behind = (
            designed.jacobian(pin.integrate(panda.model, q, s * h * v)) for s in (1, -1)
        )
        assert_allclose(designed.jacobian_dot(q, v), (ahead - behind) / (2 * h), atol=1e-7)


def test_all_else_is_that_of_the_task(panda, rng):
    pose = aj.PoseTask(panda)
    designed = NonsingularTask(pose, {"panda_joint4": 0.3})
    x, x_d = (pose.value(panda.random_configuration(rng)) for _ in range(2))
    assert designed.task is pose
    assert designed.robot is panda
    assert (designed.m, designed.n_x) == (6, 7)
    assert (designed.labels, designed.units) == (pose.labels, pose.units)
    q = panda.random_configuration(rng)
    assert_allclose(designed.value(q), pose.value(q), atol=0)
    e = pose.error(x, x_d)
    assert_allclose(designed.error(x, x_d), e, atol=0)
    assert_allclose(designed.origin, pose.origin, atol=0)
    assert_allclose(designed.displaced(x, e), pose.displaced(x, e), atol=0)
    assert_allclose(
        designed.error_jacobian(e, pose.jacobian(q)),
        pose.error_jacobian(e, pose.jacobian(q)),
        atol=0,
    )
    assert repr(designed) == f"NonsingularTask({pose!r}, bend={{'panda_joint4': 0.3}})"


@pytest.mark.parametrize(
    ("arguments", "kind", "text"),
    [
        (({},), aj.InvalidInputError, r"bend must displace at least one joint of two_link, got \{"),
        (({"joint2": 0.0},), aj.InvalidInputError, "bend must displace at least one joint"),
        (({"joint2": np.nan},), aj.InvalidInputError, r"bend of joint2 must be a finite number"),
        (
            ({"joint2": "far"},),
            aj.InvalidInputError,
            r"bend of joint2 must be .* \[rad\], got 'far'",
        ),
        (({"joint2": 20.0},), aj.InvalidInputError, r"bend of joint2 must be .* and <= 6.28"),
        (({"elbow": 0.1},), UnknownNameError, "moving joint 'elbow' not in two_link; valid are"),
        (((0.0, 0.1),), aj.InvalidInputError, "bend must be a mapping from joint names to displ"),
        (({"joint2": 0.1}, 0.0), aj.InvalidInputError, "ratio must be a finite number > 0 and <"),
        (({"joint2": 0.1}, 1.1), aj.InvalidInputError, "ratio must be .* <= 1, got 1.1"),
        (({"joint2": 0.1}, np.nan), aj.InvalidInputError, "ratio must be a finite number > 0 an"),
    ],
)
def test_bad_designs_are_refused(two_link, arguments, kind, text):
    with pytest.raises(kind, match=text):
        NonsingularTask(aj.PositionTask(two_link, axes="xz"), *arguments)


def test_only_a_task_can_be_changed(two_link):
    with pytest.raises(aj.InvalidInputError, match="task must be a task of the believed robot, s"):
        NonsingularTask(two_link, {"joint2": 0.1})


# -- closed loop ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", LONGER)
def test_pulled_inwards_a_stretched_arm_stalls_with_the_plain_jacobian_and_not_with_it(name):
    """Along the direction that Ĵ has lost, Ĵᵀ makes no torque of the force: Eq. (6) is g(q).

    The stretched arm is then an equilibrium (an unstable one: round-off bends it in the end),
    however far away the target is. The designed Ĵ has a lever there.
    """
    task, designed, q = stretched(name)
    robot = task.robot
    lost = np.linalg.svd(task.jacobian(q))[0][:, -1]
    outwards = lost * np.sign(lost @ (task.value(q) - task.value(pin.integrate(
        robot.model, q, designed._bend))))  # fmt: skip
    distance = 0.75 if name == "two_link" else 0.15
    target = task.value(q) - distance * outwards
    plant = aj.Plant(robot, task)
    gains = aj.default_gains(task, 0.5)
    runs = [
        aj.simulate(
            plant,
            aj.SetpointController(chosen, gains),
            target,
            q,
            duration,
            dt=1e-3,
            record_every=duration,
            computation=aj.simulation.Computation("semi_implicit_euler"),
        )
        for chosen, duration in ((task, 0.5), (designed, 4.0))
    ]
    plain, arrived = runs
    assert_allclose(plain.tau[0], Dynamics(robot).g(q), atol=1e-4)
    assert np.linalg.norm(plain.error[-1]) > (1 - 1e-9) * distance
    assert np.abs(plain.v[-1]).max() < 1e-4
    assert np.abs(arrived.tau[0] - plain.tau[0]).max() > 1.0
    assert np.linalg.norm(arrived.error[-1]) < 1e-3 * distance
    assert np.abs(arrived.v[-1]).max() < 1e-2


@pytest.mark.parametrize("name", LONGER[:2])
@pytest.mark.parametrize("kind", ["plain", "designed", "learnt"])
def test_torques_are_bounded_and_continuous_through_a_singular_posture(name, kind):
    """Swung through the stretched posture: the largest step of τ halves with dt, Eq. (28) too."""
    task, designed, q = stretched(name)
    robot = task.robot
    swing = np.eye(robot.nv)[1 if name == "two_link" else 5]
    start = pin.integrate(robot.model, q, -0.05 * swing)
    gravity = None
    if kind == "learnt":
        moments = "x" if name == "two_link" else "xyz"
        gravity = aj.AdaptiveGravity(GravityRegressor(robot, moments), torque_limits=np.inf)
    controller = aj.SetpointController(
        designed if kind == "designed" else task, aj.default_gains(task), gravity=gravity
    )
    target = task.value(pin.integrate(robot.model, q, 0.4 * swing))
    largest = []
    for dt in (1e-3, 5e-4, 2.5e-4):
        run = aj.simulate(
            aj.Plant(robot, task),
            controller,
            target,
            aj.simulation.InitialState(start, v0=4.0 * swing),
            0.2,
            dt=dt,
            computation=aj.simulation.Computation("semi_implicit_euler"),
        )
        bend = run.q[:, 1 if name == "two_link" else 5]
        middle = q[1 if name == "two_link" else 5]
        assert bend[0] < middle < bend.max()  # through it
        plain = [smallest(task.jacobian(posture)) for posture in run.q]
        assert min(plain) < 0.01 * max(np.linalg.norm(task.jacobian(q), 2), 1.0)
        assert np.abs(run.tau).max() < 150.0
        largest.append(np.abs(np.diff(run.tau, axis=0)).max())
    assert_allclose([largest[0] / largest[1], largest[1] / largest[2]], 2.0, rtol=0.1)


def test_one_coordinate_keeps_its_rank_too(two_link):
    """Where the only singular value vanishes, ε is a share of what it typically is."""
    task = NonsingularTask(aj.PositionTask(two_link, axes="x"), {"joint2": 0.3}, ratio=0.3)
    path = [task.jacobian(np.array([turn, 0.0])) for turn in np.linspace(0.2, 0.0, 2001)]
    assert np.linalg.norm(path[-1]) > 0.1
    steps = np.linalg.norm(np.diff(path, axis=0), axis=(1, 2))
    assert steps.max() < 0.01


def test_of_an_image_with_depths_the_bent_arm_has_what_was_measured_too(panda, rng):
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))
    points = ((0.0, 0.0, 0.0), (0.05, 0.0, 0.02))
    images = aj.ImageTask(panda, camera, points=points, depth="measured")
    designed = NonsingularTask(images, {"panda_joint4": 0.3}, ratio=0.9)
    bent, x = q + 0.3 * np.eye(7)[3], images.value(q) * 1.1
    J, moved = images.jacobian(q, x), images.jacobian(bent, x)
    U, values, _ = np.linalg.svd(J, full_matrices=False)
    weights = np.maximum(0.0, 1.0 - (values / (0.9 * values[0])) ** 2)
    assert weights.max() > 0.5
    expected = J + U @ np.diag(weights) @ U.T @ (moved - J)
    assert_allclose(designed.jacobian(q, x), expected, rtol=1e-6, atol=1e-6 * values[0])
    assert np.abs(moved - images.jacobian(bent)).max() > 0.01 * values[0]
