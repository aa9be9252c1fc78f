"""`Posture`: N τ₀ added to Eq. (6) draws the self-motion, and leaves the task alone."""

import numpy as np
import pinocchio as pin
import pytest
from arms import among
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.controllers import AwayFromStops, Posture, RegressorGravity
from approxjac.controllers.gains.tuning import slow_rate
from approxjac.robots import GravityRegressor

START = {
    "panda": np.array([0.0, -0.4, 0.3, -1.9, 0.2, 1.6, 0.4]),
    "xarm7": np.array([0.0, 0.2, 0.3, 1.2, 0.2, 1.0, 0.1]),
}
POSTURE = {
    "panda": np.array([0.4, -0.2, -0.3, -1.6, 0.5, 1.9, -0.5]),
    "xarm7": np.array([0.4, 0.5, -0.2, 1.4, 0.7, 1.4, -0.4]),
}


@pytest.mark.parametrize("name", among("panda", "xarm7", "pr2_left_arm"))
@pytest.mark.parametrize("stiffness", [7.0, np.linspace(1.0, 9.0, 7)])
def test_the_torque_is_that_of_the_law_and_n_tau_0(name, stiffness, rng):
    """With N = I − Ĵ⁺Ĵ from NumPy's pinv, to 1e-9 N m; of pr2_left_arm some joints go round."""
    robot = aj.load_robot(name)
    task, gains = aj.PositionTask(robot), aj.Gains(400.0, 80.0, damping=1.0)
    wanted = robot.random_configuration(rng)
    plain = aj.SetpointController(task, gains)
    drawn = aj.SetpointController(task, gains, posture=Posture(wanted, stiffness))
    checked = 0
    while checked < 10:
        q, v = robot.random_configuration(rng), rng.uniform(-1, 1, robot.nv)
        J_hat = task.jacobian(q)
        values = np.linalg.svd(J_hat, compute_uv=False)
        if values[-1] < 0.05 * values[0]:
            continue
        measurement = aj.Measurement(0.0, q, v, rng.uniform(-1, 1, 3))
        torques = [
            c.evaluate(np.zeros(0), measurement, np.array([0.4, 0.1, 0.5])).torque
            for c in (plain, drawn)
        ]
        pull = stiffness * pin.difference(robot.model, q, wanted)
        N = np.eye(robot.nv) - np.linalg.pinv(J_hat) @ J_hat
        assert_allclose(torques[1] - torques[0], N @ pull, atol=1e-9)
        assert_allclose(J_hat @ (torques[1] - torques[0]), np.zeros(3), atol=1e-9)
        assert np.abs(N @ pull).max() > 0.1
        checked += 1


def test_a_lost_measurement_leaves_the_posture(panda, rng):
    """Nothing but the task's own force goes with the measurement."""
    task, gains = aj.PositionTask(panda), aj.Gains(400.0, 80.0, damping=1.0)
    lost = aj.Measurement(0.0, START["panda"], rng.uniform(-1, 1, 7), np.full(3, np.nan))
    torques = []
    for posture in (None, Posture(POSTURE["panda"], 5.0)):
        controller = aj.SetpointController(task, gains, posture=posture)
        answer = controller.evaluate(np.zeros(0), lost, np.zeros(3))
        assert answer.status is aj.Status.MEASUREMENT_LOST
        torques.append(answer.torque)
    J = task.jacobian(lost.q)
    N = np.eye(7) - np.linalg.pinv(J) @ J
    assert_allclose(torques[1] - torques[0], N @ (5.0 * (POSTURE["panda"] - lost.q)), atol=1e-9)


@pytest.mark.parametrize("name", among("panda", "xarm7"))
def test_the_task_is_reached_exactly_and_the_self_motion_comes_to_rest(name):
    """Unknown 15 cm, 0.5 kg tool: e < 1e-6 m all the same, and N (q ⊖ q_posture) → 0."""
    robot = aj.load_robot(name)
    truth, belief = robot.with_object(0.15, 0.5), robot.with_object(0.0)
    regressor = GravityRegressor(belief)
    theta, _ = regressor.fit(truth)
    sensor, task = aj.PositionTask(truth), aj.PositionTask(belief)
    target = sensor.value(START[name] + [0.3, 0.2, -0.1, 0.2, 0.1, -0.2, 0.2])
    left = {}
    for stiffness in (None, 8.0):
        controller = aj.SetpointController(
            task,
            aj.default_gains(task, 0.6),
            gravity=RegressorGravity(regressor, theta),
            posture=None if stiffness is None else Posture(POSTURE[name], stiffness),
        )
        run = aj.simulate(
            aj.Plant(truth, sensor),
            controller,
            target,
            START[name],
            14.0,
            dt=2e-3,
            record_every=14.0,
            computation=aj.simulation.Computation("semi_implicit_euler"),
        )
        assert np.linalg.norm(run.error[0]) > 0.1
        assert np.linalg.norm(run.error[-1]) < 1e-6
        assert np.abs(run.v[-1]).max() < 1e-4
        J_hat = task.jacobian(run.q[-1])
        N = np.eye(7) - np.linalg.pinv(J_hat) @ J_hat
        left[stiffness] = np.linalg.norm(N @ (run.q[-1] - POSTURE[name]))
    assert left[None] > 0.5
    assert left[8.0] < 1e-3 * left[None]


def test_it_is_for_arms_with_self_motion(panda, two_link):
    with pytest.raises(
        aj.InvalidInputError,
        match=r"posture is for arms with more joints than task coordinates, got one for two_link "
        r"with 2 joints and 2 coordinates",
    ):
        aj.SetpointController(
            aj.PositionTask(two_link, axes="xz"),
            aj.Gains(50.0, 20.0, 1.0),
            posture=Posture((0.0, 1.0), 1.0),
        )
    ur5 = aj.load_robot("ur5")
    with pytest.raises(aj.InvalidInputError, match="got one for ur5 with 6 joints and 6 coordinat"):
        aj.SetpointController(aj.PoseTask(ur5), posture=Posture(ur5.neutral(), 1.0))
    aj.SetpointController(aj.PositionTask(ur5), posture=Posture(ur5.neutral(), 1.0))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            (np.zeros(6), 1.0),
            r"q of the posture must have shape \(7,\) \[rad or m\], got shape \(6,\)",
        ),
        ((0.0, 1.0), r"q of the posture must have shape \(7,\) \[rad or m\], got shape \(\)"),
        ((np.full(7, np.nan), 1.0), r"q of the posture must be finite \[rad\], got \[nan"),
        ((np.full(7, 90.0), 1.0), "q of the posture must be in radians: it is 90.07 rad beyond"),
        (("up", 1.0), "q of the posture must be numbers of shape"),
        (([[1.0], [1.0, 2.0]], 1.0), "q of the posture must be numbers of shape"),
        ((np.zeros(7), 0.0), r"stiffness must be > 0 in every entry \[N m/rad\], .*got \[0.0\]"),
        ((np.zeros(7), -1.0), r"stiffness must be > 0 in every entry"),
        ((np.zeros(7), np.inf), r"stiffness must be finite \[N m/rad\], got \[inf\]"),
        ((np.zeros(7), (1.0, 2.0)), r"stiffness must have shape \(7,\) \[N m/rad\], got shape \(2"),
        ((np.zeros(7), np.eye(7)), r"stiffness must have shape \(49,\) \[N m/rad\], got sha"),
        ((np.zeros(7), [[1.0], [1.0, 2.0]]), r"stiffness must be numbers of shape \(1,\)"),
        ((np.zeros(7), None), r"stiffness must be numbers of shape \(1,\)"),
    ],
)
def test_bad_postures_are_refused(panda, arguments, text):
    with pytest.raises(aj.InvalidInputError, match=text):
        aj.SetpointController(aj.PositionTask(panda), posture=Posture(*arguments))


def test_what_is_no_posture_is_refused(panda):
    with pytest.raises(
        aj.InvalidInputError, match=r"posture must be Posture\(q, stiffness\) or No"
    ):
        aj.SetpointController(aj.PositionTask(panda), posture=START["panda"])
    pr2 = aj.load_robot("pr2_left_arm")
    with pytest.raises(aj.InvalidInputError, match=r"cos\^2 \+ sin\^2 = 1"):
        aj.SetpointController(aj.PositionTask(pr2), posture=Posture(2 * pr2.neutral(), 1.0))


def test_a_posture_is_a_copy():
    q = np.zeros(7)
    posture = Posture(q, np.ones(7))
    q[:] = 1.0
    assert_allclose(posture.q, np.zeros(7), atol=0)
    with pytest.raises(ValueError, match="read-only"):
        posture.q[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        posture.stiffness[0] = 2.0


def test_near_a_singular_posture_it_fades_out_and_still_leaves_the_task_alone():
    """Ĵ N τ₀ = 0 on the way through a singular posture, and the torque is continuous."""
    robot = aj.load_robot("xarm7")
    task = aj.PositionTask(robot)
    singular = np.array([0.0, 0.0, 0.0, 2.742, 0.0, 0.442, 0.0])
    direction = np.array([0.0, 0.3, 0.2, 1.0, 0.1, -0.4, 0.0])
    gains, still = aj.Gains(100.0, 20.0, 1.0), np.zeros(7)
    plain = aj.SetpointController(task, gains)
    kept = aj.SetpointController(task, gains, posture=Posture(np.zeros(7), 10.0))
    pulls, faded = [], 0
    for step in np.linspace(-0.2, 0.2, 2001):
        q = singular + step * direction
        measurement = aj.Measurement(0.0, q, still, task.value(q))
        answers = [c.evaluate(np.zeros(0), measurement, task.value(q)) for c in (kept, plain)]
        pulls.append(answers[0].torque - answers[1].torque)
        assert np.abs(answers[0].J_hat @ pulls[-1]).max() < 1e-12
        faded += answers[0].status is aj.Status.NEAR_SINGULAR
    assert faded > 50
    sizes = np.linalg.norm(pulls, axis=1)
    assert sizes.min() < 0.05 * sizes.max()
    assert np.linalg.norm(np.diff(pulls, axis=0), axis=1).max() < 0.02 * sizes.max()


# -- away from stops ------------------------------------------------------------------------


@pytest.mark.parametrize("name", among("panda", "xarm7", "pr2_left_arm"))
def test_joints_near_their_stops_are_pushed_inwards_within_the_null_space(name, rng):
    """As fast as the task's slow pole is, each by its own damping."""
    robot = aj.load_robot(name)
    damping = np.linspace(0.5, 2.0, robot.nv)
    task, gains = aj.PositionTask(robot), aj.Gains(400.0, 80.0, damping)
    plain = aj.SetpointController(task, gains)
    pushed = aj.SetpointController(task, gains, posture=AwayFromStops(0.2))
    lower, upper = robot.position_limits
    width = np.minimum(0.2 * (upper - lower), 0.6)
    near_ones, rate = 0, slow_rate(task, plain.diagonals)
    for _ in range(60):
        q, v = robot.random_configuration(rng), rng.uniform(-1, 1, robot.nv)
        J_hat = task.jacobian(q)
        values = np.linalg.svd(J_hat, compute_uv=False)
        if values[-1] < 0.05 * values[0]:
            continue
        measurement = aj.Measurement(0.0, q, v, rng.uniform(-1, 1, 3))
        target = np.array([0.4, 0.1, 0.5])
        before, after = (c.evaluate(np.zeros(0), measurement, target) for c in (plain, pushed))
        push = after.torque - before.torque
        motion = pin.difference(robot.model, robot.neutral(), q)
        deep = np.maximum(lower + width - motion, 0.0) - np.maximum(motion - upper + width, 0.0)
        assert_allclose(J_hat @ push, np.zeros(3), atol=1e-9)
        N = np.eye(robot.nv) - np.linalg.pinv(J_hat) @ J_hat
        assert_allclose(push, N @ (rate * damping * deep), atol=1e-9)
        assert np.any(push) == (np.abs(deep).max() > 0.0)
        near_ones += np.any(deep)
    assert near_ones > 5


def test_an_arm_that_stands_at_a_stop_leaves_it_and_keeps_its_target(panda):
    q0 = START["panda"].copy()
    q0[5] = panda.position_limits[1][5] - 0.02
    task = aj.PositionTask(panda)
    plant = aj.Plant(panda)
    distances = {}
    for posture in (None, AwayFromStops()):
        controller = aj.SetpointController(task, posture=posture)
        run = aj.simulate(plant, controller, task.value(q0), q0, 4.0, dt=2e-3)
        assert run.error_norm[-1] < 1e-3
        distances[posture] = panda.position_limits[1][5] - run.q[-1][5]
    assert distances[None] < 0.05 < 0.2 < distances[AwayFromStops()]


@pytest.mark.parametrize("share", [0.0, -0.1, 0.6, np.nan])
def test_a_zone_that_is_none_is_refused(share):
    with pytest.raises(aj.InvalidInputError, match="share must be"):
        AwayFromStops(share)
