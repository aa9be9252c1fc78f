"""`BoundedController`: its formula, its bound, its potential and its linearisation."""

import copy
import functools
import json
import pickle

import numpy as np
import pinocchio as pin
import pytest
import test_fuzz as fuzz
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac import law

START = fuzz.START


def planar():
    return aj.load_robot("two_link").with_object(0.5, 0.5, radius=0.0, axis="x")


@functools.cache
def controllers():
    panda, kinova, xarm = (aj.load_robot(name) for name in ("panda", "kinova", "xarm7"))
    two_link, slider = planar(), fuzz.prismatic_arm()
    task, regressor = aj.PositionTask(panda), aj.GravityRegressor(panda)
    around = (np.maximum(START - 0.4, panda.usual_range()[0]), START + 0.4)
    weak = 0.5 * panda.effort_limits
    camera = aj.PlanarCamera(0.05, 3.0, 0.3)
    two = aj.StackedTask(
        aj.PositionTask(panda, axes="xz"), aj.PositionTask(panda, "panda_link4", axes="y")
    )
    # a point beside its frame: no bound of its Jacobian over a range is known, so it is drawn
    point = aj.StackedTask(
        aj.ImageTask(panda, camera, points=[(0.0, 0.0, 0.1)]), aj.PositionTask(panda, axes="y")
    )
    return {
        "panda": aj.BoundedController(task),
        "panda, weak": aj.BoundedController(task, weak, joint_range=around),
        "panda, no gravity": aj.BoundedController(task, 20.0, gravity=aj.NoGravity(panda)),
        "panda, theta": aj.BoundedController(
            task, gravity=aj.RegressorGravity(regressor, 1.1 * regressor.theta)
        ),
        "panda, pose": aj.BoundedController(aj.PoseTask(panda), joint_range=around),
        "panda, stacked": aj.BoundedController(two, joint_range=around),
        "panda, point": aj.BoundedController(point, joint_range=around),
        "panda, nonsingular": aj.BoundedController(
            aj.NonsingularTask(task, {"panda_joint4": 0.3}), joint_range=around
        ),
        "xarm7": aj.BoundedController(aj.PositionTask(xarm)),
        "kinova": aj.BoundedController(aj.PositionTask(kinova)),
        "two_link": aj.BoundedController(aj.PositionTask(two_link, axes="xz"), (90.0, 45.0)),
        "two_link, camera": aj.BoundedController(aj.ImageTask(two_link, camera), (90.0, np.inf)),
        "slider": aj.BoundedController(aj.PositionTask(slider, axes="xy"), (90.0, 60.0, 30.0)),
    }


NAMES = (
    "panda", "panda, weak", "panda, no gravity", "panda, theta", "panda, pose", "panda, stacked",
    "panda, point", "panda, nonsingular", "xarm7", "kinova", "two_link", "two_link, camera",
    "slider",
)  # fmt: skip


@pytest.fixture(params=NAMES)
def controller(request):
    return controllers()[request.param]


def posture_in(controller, rng):
    robot = controller.task.robot
    return pin.integrate(robot.model, robot.neutral(), rng.uniform(*controller.joint_range))


def test_every_controller_is_tested():
    assert tuple(controllers()) == NAMES


def test_the_torque_is_the_formula(controller, rng):
    task, (kp, gamma, kd, v0) = controller.task, controller.diagonals
    q, v = posture_in(controller, rng), rng.normal(size=task.robot.nv)
    x, target = (task.displaced(task.origin, rng.normal(size=task.m)) for _ in range(2))
    measurement = aj.Measurement(0.0, q, v, x)
    answer = controller.evaluate(np.zeros(0), measurement, target)
    e = task.error(x, target)
    g = np.array(controller.gravity.torque(q))
    J = task.jacobian(q)
    expected = -J.T @ np.diag(kp) @ (gamma * np.tanh(e / gamma)) - kd * np.tanh(v / v0) + g
    assert_allclose(answer.torque, expected)
    assert_allclose(law.bounded_torque(J, kp, controller.saturation.s(e), v, kd, v0, g), expected)
    assert_allclose(answer.e, e)
    assert_array_equal(answer.J_hat, J)
    assert answer.state_rate.shape == controller.initial_state(measurement).shape == (0,)
    assert controller.n_state == 0
    bound = law.bounded_torque_bound(J, kp, gamma, kd, g)
    assert_allclose(controller.torque_bound(q), bound)
    assert (np.abs(expected) <= bound).all()


def test_the_bound_is_reached_by_the_worst_error_and_velocity(controller, rng):
    """So it is no larger than it has to be at a posture."""
    q = posture_in(controller, rng)
    task, (kp, gamma, kd, v0) = controller.task, controller.diagonals
    J, g = task.jacobian(q), np.array(controller.gravity.torque(q))
    for i in range(task.robot.nv):
        sign = 1.0 if g[i] >= 0.0 else -1.0
        s, v = -sign * np.sign(J[:, i]) * gamma, np.full(task.robot.nv, -sign * 1e3 * v0[i])
        torque = law.bounded_torque(J, kp, s, v, kd, v0, g)
        assert_allclose(sign * torque[i], controller.torque_bound(q)[i])


def test_the_bound_is_within_the_limits_over_the_range(controller, rng):
    closest = 0.0
    limited = np.isfinite(controller.torque_limits)
    for _ in range(400):
        share = controller.torque_bound(posture_in(controller, rng)) / controller.torque_limits
        assert share.max() <= 1.0
        closest = max(closest, float(share[limited].max()))
    assert closest > 0.75  # what the motors have is used
    drawn = [controllers()[name] for name in ("panda, point", "panda, nonsingular")]
    assert controller.guaranteed == (controller not in drawn)


def test_the_task_cannot_accelerate_a_joint_for_ever(controller, rng):
    """The largest damping torque is above the task's at each joint, by (1 − share) / share."""
    kp, gamma, kd, _ = controller.diagonals
    for _ in range(100):
        J = controller.task.jacobian(posture_in(controller, rng))
        assert ((kp * gamma) @ np.abs(J) <= 0.45 / 0.55 * kd + 1e-9).all()


LIMITED = ("panda", "xarm7", "two_link", "kinova", "panda, weak", "panda, nonsingular", "slider")
FUZZ = settings(
    max_examples=100,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@pytest.mark.parametrize("name", LIMITED)
@FUZZ
@given(data=st.data())
def test_no_numbers_make_the_torque_exceed_the_limits(name, data):
    controller = controllers()[name]
    state, measurement, target = data.draw(fuzz.arguments(controller))
    kept = [np.copy(a) for a in (*measurement[1:], target)]
    answer = fuzz.checked(controller, state, measurement, target)
    for before, after in zip(kept, (*measurement[1:], target), strict=True):
        assert_array_equal(before, after)
    if answer is None:
        return
    assert np.isfinite(np.concatenate([measurement.q, measurement.v, target])).all()
    assert (np.abs(answer.torque) <= controller.torque_limits + 1e-9).all()
    if not np.isfinite(measurement.x).all():
        assert answer.status is aj.Status.MEASUREMENT_LOST


@pytest.mark.parametrize("name", LIMITED)
@FUZZ
@given(data=st.data())
def test_within_the_range_nothing_is_clipped(name, data):
    """Whatever the error and the velocity are."""
    controller = controllers()[name]
    task = controller.task
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    sizes = [10.0 ** data.draw(st.floats(-3.0, 20.0)) for _ in range(2)]
    v, x = sizes[0] * rng.normal(size=task.robot.nv), sizes[1] * rng.normal(size=task.m)
    q = posture_in(controller, rng)
    answer = controller.evaluate(np.zeros(0), aj.Measurement(0.0, q, v, x), np.zeros(task.m))
    assert answer.status in {aj.Status.OK, aj.Status.NEAR_SINGULAR}
    assert (np.abs(answer.torque) <= controller.torque_bound(q) + 1e-9).all()
    assert (np.abs(answer.torque) <= controller.torque_limits + 1e-9).all()


@FUZZ
@given(data=st.data())
def test_wrong_types_and_shapes_are_named_errors(data):
    controller = controllers()["panda"]
    q = controller.task.robot.neutral()
    x = controller.task.value(q)
    good = {"state": np.zeros(0), "q": q, "v": np.zeros(7), "x": x, "target": x}
    name = data.draw(st.sampled_from(["q", "v", "x", "target"]))
    good[name] = data.draw(fuzz.junk(good[name].size))
    measurement = aj.Measurement(0.0, good["q"], good["v"], good["x"])
    with pytest.raises(aj.ApproxJacError, match="must be"):
        controller.evaluate(good["state"], measurement, good["target"])


def test_outside_the_range_the_torque_is_clipped_and_the_status_says_so():
    controller = controllers()["panda, weak"]
    q = np.array([0.0, 1.5, 0.0, -0.1, 0.0, 1.6, 0.0])  # stretched out: gravity alone is too much
    measurement = aj.Measurement(0.0, q, np.zeros(7), np.zeros(3))
    answer = controller.evaluate(np.zeros(0), measurement, np.zeros(3))
    assert answer.status is aj.Status.TORQUE_SATURATED
    assert abs(answer.torque[1]) == controller.torque_limits[1]
    assert controller.torque_bound(q)[1] > controller.torque_limits[1]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_lost_measurement_leaves_damping_and_gravity(controller, value, rng):
    task = controller.task
    q, v = posture_in(controller, rng), rng.normal(size=task.robot.nv)
    x = np.full(task.n_x, value)
    answer = controller.evaluate(np.zeros(0), aj.Measurement(0.0, q, v, x), task.origin)
    assert answer.status is aj.Status.MEASUREMENT_LOST
    _, _, kd, v0 = controller.diagonals
    assert_allclose(answer.torque, controller.gravity.torque(q) - kd * np.tanh(v / v0))
    assert (np.abs(answer.torque) <= controller.torque_limits).all()


# -- the proof ------------------------------------------------------------------------------


def potential(controller, dynamics, q, v, target):
    """V = ½q̇ᵀMq̇ + Σ k_p γ² log cosh(e/γ)."""
    kp = controller.diagonals.kp
    e = controller.task.value(q) - target
    return 0.5 * v @ dynamics.M(q) @ v + kp @ controller.saturation.S(e)


@pytest.mark.parametrize("name", ["panda", "two_link", "xarm7", "kinova"])
def test_the_potential_falls_by_what_damping_takes(name, rng):
    """V̇ = −q̇ᵀ K_d tanh(q̇/v₀) along the true dynamics where the Jacobian is right."""
    controller = controllers()[name]
    task = controller.task
    robot, dynamics = task.robot, aj.Dynamics(task.robot)
    plant = aj.Plant(robot, task)
    _, _, kd, v0 = controller.diagonals
    for _ in range(5):
        q, v = posture_in(controller, rng), rng.normal(size=robot.nv)
        target = task.value(posture_in(controller, rng))
        torque = controller.evaluate(np.zeros(0), plant.measure(0.0, q, v), target).torque
        a = plant.acceleration(q, v, torque)
        values = []
        for h in (1e-5, -1e-5):
            near = pin.integrate(robot.model, q, h * v + 0.5 * h * h * a)
            values.append(potential(controller, dynamics, near, v + h * a, target))
        rate = (values[0] - values[1]) / 2e-5
        assert_allclose(rate, -v @ (kd * np.tanh(v / v0)), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ["panda", "two_link"])
def test_near_the_target_it_is_law_6_with_damping_only(name, rng):
    """Finite differences of the closed loop against `closed_loop_matrix` with K_v = 0."""
    belief = {"panda": aj.load_robot("panda"), "two_link": aj.load_robot("two_link")}[name]
    truth = belief.with_object(0.2)
    belief = belief.with_object(0.0)
    axes = "xz" if name == "two_link" else "xyz"
    controller = aj.BoundedController(
        aj.PositionTask(belief, axes=axes), (90.0, 45.0) if name == "two_link" else None
    )
    plant = aj.Plant(truth, aj.PositionTask(truth, axes=axes))
    n, q0 = truth.nv, START[: truth.nv] + rng.uniform(-0.3, 0.3, truth.nv)
    target = plant.sensor.value(q0)

    def acceleration(z):
        measured = plant.measure(0.0, q0 + z[:n], z[n:])
        torque = controller.evaluate(np.zeros(0), measured, target).torque
        return plant.acceleration(measured.q, measured.v, torque)

    steps = 1e-6 * np.eye(2 * n)
    found = np.array([(acceleration(z) - acceleration(-z)) / 2e-6 for z in steps]).T
    kp, _, kd, v0 = controller.diagonals
    J, J_hat = plant.sensor.jacobian(q0), controller.task.jacobian(q0)
    M = aj.Dynamics(truth).M(q0)
    A = law.closed_loop_matrix(M, J, J_hat, kp, np.zeros(len(kp)), kd / v0)
    assert_allclose(found, A[n:], rtol=1e-4, atol=1e-5 * np.abs(A).max())


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", ["panda", "two_link"])
def test_it_reaches_the_target_with_a_wrong_tool(name, seed):
    rng = np.random.default_rng(seed)
    axes, goal = ("xz", np.array([0.6, 1.2])) if name == "two_link" else ("xyz", START)
    robot = aj.load_robot(name)
    truth, belief = robot.with_object(0.15, axis="xz"[name == "panda"]), robot.with_object(0.0)
    limits = np.array([100.0, 50.0]) if name == "two_link" else 0.9 * robot.effort_limits
    controller = aj.BoundedController(aj.PositionTask(belief, axes=axes), limits)
    plant = aj.Plant(truth, aj.PositionTask(truth, axes=axes), torque_limits=limits)
    q0 = goal + rng.uniform(-0.3, 0.3, truth.nv)
    target = plant.sensor.value(goal)
    options = {"dt": 1e-3, "integrator": "semi_implicit_euler"}
    run = aj.simulate(plant, controller, target, q0, 4.0, **options)
    assert run.error_norm[0] > 0.02
    assert run.error_norm[-1] < 0.02 * run.error_norm[0]
    assert (np.abs(run.tau) <= limits).all()
    assert aj.Status.TORQUE_SATURATED not in set(run.status.tolist())


# -- building -------------------------------------------------------------------------------


def test_limits_that_gravity_takes_are_refused(panda):
    task = aj.PositionTask(panda)
    with pytest.raises(
        aj.InvalidInputError,
        match=r"torque_limits must leave something above gravity .* panda: panda_joint2 has 34.8 "
        r"N m and holding takes up to \d\d\.\d+; limits above \[.*\] are valid, or a joint_range",
    ):
        aj.BoundedController(task, 0.4 * panda.effort_limits)
    with pytest.raises(aj.InvalidInputError, match="panda_joint2 has"):
        aj.BoundedController(task, 0.4 * panda.effort_limits, aj.BoundedGains(1.0, 0.1, 1.0, 1.0))


def test_limits_above_those_that_an_error_names_are_valid(panda):
    task = aj.PositionTask(panda)
    with pytest.raises(aj.InvalidInputError, match="limits above") as caught:
        aj.bounded_gains(task, 0.1)
    least = str(caught.value).split("limits above [")[1].split("]")[0]
    assert aj.BoundedController(task, 1.01 * np.array(json.loads(f"[{least}]")) + 0.1).guaranteed


def test_gains_of_ones_own_are_held_against_the_bound(panda):
    task = aj.PositionTask(panda)
    fine = aj.BoundedGains(100.0, (0.05, 0.05, 0.1), (9, 9, 9, 9, 4, 4, 4), 2.0)
    controller = aj.BoundedController(task, gains=fine)
    assert controller.gains is fine
    assert_allclose(controller.diagonals.gamma, [0.05, 0.05, 0.1])
    too_much = aj.BoundedGains(100.0, 0.3, 9.0, 2.0)
    with pytest.raises(
        aj.InvalidInputError,
        match=r"kp gamma and kd must keep the torque of panda .*: panda_joint2 has 87 N m and may "
        r"be asked for \d+\.?\d*, of them .* for gravity, .* for the task, 9 for damping.*; "
        r"bounded_gains\(task, torque_limits\) does",
    ):
        aj.BoundedController(task, gains=too_much)


def test_joints_without_limits(panda):
    task = aj.PositionTask(planar(), axes="xz")
    with pytest.raises(
        aj.InvalidInputError, match=r"torque_limits must be finite for a joint of .* that moves"
    ):
        aj.BoundedController(task)
    free = aj.BoundedController(task, gains=aj.BoundedGains(100.0, 0.2, 20.0, 1.0))
    assert np.isinf(free.torque_limits).all()
    one = aj.BoundedController(task, (90.0, np.inf)).diagonals
    assert_allclose(one.v0[1], one.v0[0])


def test_more_of_the_share_is_more_force(panda):
    task = aj.PositionTask(panda)
    forces = []
    for share in (0.2, 0.5, 0.8):
        gains = aj.bounded_gains(task, task_share=share)
        forces.append(gains.kp * gains.gamma)
        slope = np.array(gains.kd) / gains.v0
        assert_allclose(slope[0], 12.33, rtol=0.01)  # whatever the limits are
    assert_allclose(forces[2], 4.0 * forces[0])


def test_bad_arguments_are_refused(panda, two_link):
    task = aj.PositionTask(panda)
    cases = [
        (lambda: aj.BoundedController(panda), "task must be a task of the believed robot"),
        (lambda: aj.bounded_gains(panda), "task must be a task of the believed robot"),
        (
            lambda: aj.BoundedController(
                task, gravity=aj.AdaptiveGravity(aj.GravityRegressor(panda))
            ),
            r"gravity must not be learnt for a bounded law: .* RegressorGravity or NoGravity",
        ),
        (
            lambda: aj.BoundedController(task, gravity=aj.ModelGravity(two_link)),
            "gravity must be that of a robot with the joints",
        ),
        (lambda: aj.BoundedController(task, gravity=1), "gravity must be one of ModelGravity"),
        (lambda: aj.BoundedController(task, -1.0), "torque_limits must be numbers > 0"),
        (lambda: aj.BoundedController(task, np.ones(3)), "torque_limits must be numbers > 0"),
        (
            lambda: aj.BoundedController(task, gains=aj.Gains(1, 1, 1)),
            r"gains must be BoundedGains\(kp, gamma, kd, v0\) or None",
        ),
        (
            lambda: aj.BoundedController(task, gains=aj.BoundedGains((1, 2), 1, 1, 1)),
            r"kp must have shape \(3,\), got shape \(2,\)",
        ),
        (lambda: aj.BoundedGains(1, 1, 0, 1), r"kd must be > 0 in every entry, got \[0.0\]"),
        (lambda: aj.BoundedGains(1, 1, 1, 1e-300), r"v0 must be at least 1e-60, got \[1e-300\]"),
        (lambda: aj.BoundedGains(1, "a", 1, 1), "gamma must be numbers"),
        (lambda: aj.bounded_gains(task, task_share=1.0), "task_share must be < 1, got 1.0"),
        (lambda: aj.bounded_gains(task, task_share=0.0), "task_share must be a finite number > 0"),
        (
            lambda: aj.BoundedController(task, joint_range=(1.0, -1.0)),
            "joint_range must not have a highest position below the lowest",
        ),
        (
            lambda: aj.BoundedController(task, joint_range=3.0),
            "joint_range must be a lowest and a highest position, got 3.0",
        ),
        (
            lambda: aj.BoundedController(task, joint_range=(np.zeros(3), 1.0)),
            r"joint_range must have shape \(7,\)",
        ),
    ]
    for make, text in cases:
        with pytest.raises(aj.InvalidInputError, match=text):
            make()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))])
def test_copies_have_the_same_bits_and_scratch_of_their_own(controller, copied, rng):
    other = copied(controller)
    assert repr(other) == repr(controller)
    assert other.guaranteed == controller.guaranteed
    task = controller.task
    assert other.task is not task
    for _ in range(3):
        q, v = posture_in(controller, rng), rng.normal(size=task.robot.nv)
        measurement = aj.Measurement(0.0, q, v, task.value(q))
        target = task.value(posture_in(controller, rng))
        answer, again = (c.evaluate(np.zeros(0), measurement, target) for c in (controller, other))
        assert_array_equal(again.torque, answer.torque)
        assert again.status is answer.status
        assert_array_equal(other.torque_bound(q), controller.torque_bound(q))
    torque = controller.gravity.torque(q)
    before = torque.copy()
    other.gravity.torque(posture_in(controller, rng))
    assert_array_equal(torque, before)


def test_what_it_is_called(panda):
    text = repr(controllers()["panda"])
    assert text.startswith("BoundedController(PositionTask('panda', 'panda_hand_tcp', 'xyz'), Bou")
    assert "gamma=0.06" in text
