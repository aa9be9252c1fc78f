"""`AdaptiveGravity`: Eq. (28), Eq. (29) with default gains, bounds, and motors that saturate."""

import itertools

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag

import approxjac as aj
from approxjac.controllers import DifferentiatedVelocity
from approxjac.controllers.setpoint import Reach
from approxjac.robots import Dynamics, GravityRegressor
from approxjac.tasks import PoseTrackerTask

START = np.array([0.0, -0.4, 0.3, -1.9, 0.2, 1.6, 0.4])
GOAL = START + [0.3, 0.2, -0.1, 0.2, 0.1, -0.2, 0.2]


@pytest.fixture(scope="module")
def arms():
    """A panda with a 15 cm, 1 kg tool that is believed absent, and the regressor of the belief."""
    panda = aj.load_robot("panda")
    truth, belief = panda.with_object(0.15, 1.0), panda.with_object(0.0)
    regressor = GravityRegressor(belief)
    theta, residual = regressor.fit(truth)
    assert residual < 1e-10
    return truth, belief, regressor, theta


def closed_loop(arms, duration, gains=None, plant=None, every=0.02, **options):
    """Run a controller that learns gravity from START to GOAL."""
    truth, belief, regressor, _ = arms
    sensor = aj.PositionTask(truth)
    gravity = aj.AdaptiveGravity(regressor, **options)
    controller = aj.SetpointController(aj.PositionTask(belief), gains, gravity=gravity)
    run = aj.simulate(
        aj.Plant(truth, sensor, **(plant or {})), controller, sensor.value(GOAL), START, duration,
        dt=2e-3, record_every=every, computation=aj.simulation.Computation("semi_implicit_euler"),
    )  # fmt: skip
    return controller, run


def rate_at(controller, q, v, x, theta_hat, target):
    return controller.evaluate(theta_hat, aj.Measurement(0.0, q, v, x), target)


# -- defaults -------------------------------------------------------------------------------


def test_defaults_are_filled_in_where_nothing_is_given(arms):
    _, belief, regressor, _ = arms
    task = aj.PositionTask(belief)
    gravity = aj.AdaptiveGravity(regressor)
    assert gravity.L is None
    assert gravity.alpha is None
    controller = aj.SetpointController(task, gravity=gravity)
    filled, chosen = controller.adaptation, controller.tuning.learning
    assert filled.sizes == (12, 3, 7)  # θ_g, d and w
    blocks = [chosen.gravity, np.diag(chosen.task_force), np.diag(chosen.joint_torque)]
    assert_allclose(filled.L, block_diag(*blocks), atol=0)
    assert_allclose(filled.alpha, controller.tuning.rate, rtol=1e-6)  # that of the slow pole
    assert_allclose(filled.theta0, [*regressor.theta, *np.zeros(10)], atol=0)
    assert_allclose(filled.torque_limits, [87.0] * 4 + [12.0] * 3)
    lower, upper = filled.bounds
    assert_allclose(upper - filled.theta0, chosen.largest)
    assert_allclose(filled.theta0 - lower, chosen.largest)
    assert_allclose(chosen.largest[-7:], belief.effort_limits)
    assert aj.SetpointController(task).adaptation is None


def test_by_default_pinv_divides_a_motion_among_the_joints_as_damping_does(arms, rng):
    """Ĵ⁺Ĵ leaves D⁻¹Ĵᵀf, the slow motion under any force, as it is; the paper's does not."""
    _, belief, regressor, _ = arms
    task = aj.PositionTask(belief)
    rule = aj.SetpointController(task, gravity=aj.AdaptiveGravity(regressor))
    paper = aj.SetpointController(task, gravity=aj.AdaptiveGravity(regressor, L=0.1))
    for _ in range(10):
        J_hat, (_, kv, damping) = task.jacobian(belief.random_configuration(rng)), rule.diagonals
        motion = np.linalg.solve(J_hat.T * kv @ J_hat + np.diag(damping), J_hat.T) @ rng.normal(
            size=3
        )
        pinv = rule.pinv.matrix(J_hat)
        assert_allclose(J_hat @ pinv, np.eye(3), atol=1e-9)
        assert_allclose(pinv @ (J_hat @ motion), motion, atol=1e-9 * np.abs(motion).max())
        other = paper.pinv.matrix(J_hat)
        assert_allclose(other, np.linalg.pinv(J_hat), atol=1e-9)
        assert np.abs(other @ (J_hat @ motion) - motion).max() > 0.1 * np.abs(motion).max()


def test_explicit_ones_are_kept(arms):
    _, belief, regressor, _ = arms
    task = aj.PositionTask(belief)

    def filled(**options):
        gravity = aj.AdaptiveGravity(regressor, **options)
        return aj.SetpointController(task, gravity=gravity).adaptation

    both = filled(L=0.3, alpha=0.7, theta0=np.ones(12), torque_limits=9.0, bounds=(-1, 2))
    assert_allclose(both.L, np.full(12, 0.3), atol=0)
    assert both.alpha == 0.7
    assert_allclose(both.theta0, np.ones(12), atol=0)
    assert_allclose(both.torque_limits, np.full(7, 9.0), atol=0)
    assert_allclose(both.bounds, [np.full(12, -1.0), np.full(12, 2.0)], atol=0)
    free = filled()
    only_L = filled(L=0.3)  # then nothing else is learnt
    assert only_L.sizes == (12, 0, 0)
    assert_allclose(only_L.L, np.full(12, 0.3), atol=0)
    assert only_L.bounds is None
    assert_allclose(only_L.alpha, free.alpha, rtol=1e-9)
    assert filled(alpha=0.5 * free.alpha).alpha == 0.5 * free.alpha
    some = filled(task_force=2.0, joint_torque=0.0)
    assert some.sizes == (12, 3, 0)
    assert_allclose(np.diag(some.L)[12:], np.full(3, 2.0), atol=0)
    assert_allclose(some.L[:12, :12], free.L[:12, :12], atol=0)
    beside = filled(L=0.3, joint_torque=np.arange(1.0, 8.0), bounds=(-9, 9))
    assert_allclose(beside.L, [*np.full(12, 0.3), *range(1, 8)], atol=0)
    assert_allclose(beside.bounds[1], [*np.full(12, 9.0), *np.full(7, np.inf)], atol=0)
    kept = filled(bounds=(regressor.theta - 0.1, regressor.theta + 0.1))
    assert_allclose(kept.bounds[1] - kept.theta0, [*np.full(12, 0.1), *free.bounds[1][12:]])
    with pytest.raises(aj.InvalidInputError, match=r"task_force must have shape \(3,\)"):
        filled(task_force=(1.0, 2.0))
    with pytest.raises(aj.InvalidInputError, match="joint_torque must be"):
        filled(joint_torque=-1.0)


@pytest.mark.parametrize("from_zero", [pytest.param(False, marks=pytest.mark.study), True])
def test_with_default_gains_an_unknown_payload_is_learnt(arms, from_zero):
    """To < 1 mm in 10 s from the believed θ̂(0), and from none at all; dt = 2 ms.

    With none at all the arm falls first, beyond its limits if nothing stops it.
    """
    theta0, plant = (np.zeros(12), {"joint_limits": False}) if from_zero else (None, None)
    controller, run = closed_loop(arms, 10.0, plant=plant, every=10.0, theta0=theta0)
    assert np.linalg.norm(run.error[0]) > 0.1
    assert np.linalg.norm(run.error[-1]) < 1e-3
    assert np.abs(run.v[-1]).max() < 1e-3
    # what is learnt is gravity where the arm stands
    truth, _, regressor, _ = arms
    g, Z = Dynamics(truth).g(run.q[-1]), regressor.Z(run.q[-1])
    assert_allclose(controller.gravity_torque(run.state[-1], run.q[-1]), g, atol=0.05)
    assert np.abs(Z @ regressor.theta - g).max() > 1.0


def test_what_is_learnt_is_told_in_words(arms):
    _, belief, regressor, theta = arms
    task = aj.PositionTask(belief)
    learns = aj.SetpointController(task, gravity=aj.AdaptiveGravity(regressor)).adaptation
    told = learns.describe(np.array([*theta, 0.0, -3.0, 0.0, *np.zeros(5), 0.25, 0.0]), task)
    assert told.startswith(
        "to compensate, beside the believed arm's weight: a load on the last link of +1 kg"
    )
    assert "-3 N (force along y)" in told
    assert "+0.25 N m (torque of panda_joint6)" in told
    only_gravity = aj.AdaptiveGravity(regressor, L=0.1)
    learns = aj.SetpointController(task, gravity=only_gravity).adaptation
    assert "force" not in learns.describe(theta, task)


# -- bounds ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gains(arms):
    """Gains that settle within 1 s: with given ones, s(e) = e."""
    return aj.default_gains(aj.PositionTask(arms[1]))


@pytest.mark.study
@pytest.mark.parametrize("metric", ["diagonal", "full"])
def test_theta_stays_within_its_bounds_to_one_step(arms, gains, metric):
    """Tight ones: the target is reached, but far more slowly."""
    _, belief, regressor, theta = arms
    lower = np.minimum(theta, regressor.theta) - 0.02
    upper = np.maximum(theta, regressor.theta) + 0.02
    L = aj.controllers.tuned(aj.PositionTask(belief), regressor=regressor).learning.gravity
    options = {"L": np.diag(L).copy() if metric == "diagonal" else L, "every": 2e-3}
    _, bounded = closed_loop(arms, 26.0, gains, bounds=(lower, upper), **options)
    _, free = closed_loop(arms, 6.0, gains, **options)
    outside = np.maximum(np.maximum(lower - bounded.state, bounded.state - upper), 0.0)
    one_step = np.abs(np.diff(bounded.state, axis=0)).max(axis=0)
    assert (outside <= one_step).all()
    assert outside.max() < 0.01
    assert np.maximum(lower - free.state, free.state - upper).max() > 0.05
    assert np.linalg.norm(bounded.error[-1]) < 1e-3


def test_inside_the_bounds_nothing_changes(arms):
    """Bit by bit."""
    _, free = closed_loop(arms, 1.0)
    _, wide = closed_loop(arms, 1.0, bounds=(-100.0, 100.0))
    assert np.array_equal(free.state, wide.state)
    assert np.array_equal(free.tau, wide.tau)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"bounds": 3.0}, r"bounds must be a smallest and a larger theta .*, got 3\.0"),
        (
            {"bounds": (-9.0, 0.0, 9.0)},
            "bounds must be a smallest and a larger theta that hold",
        ),
        ({"bounds": (-9.0,)}, "bounds must be a smallest and a larger theta that hold"),
        ({"bounds": (-9.0, np.inf)}, r"bounds must be finite, got \[inf"),
        ({"bounds": (np.nan, 9.0)}, r"bounds must be finite, got \[nan"),
        ({"bounds": (-9.0, np.ones(3))}, r"bounds must have shape \(2,\), got shape \(3,\)"),
        ({"bounds": ("low", 9.0)}, r"bounds must be numbers of shape \(2,\)"),
        ({"bounds": (9.0, -9.0)}, r"a smallest and a larger theta .*, got \(9\.0, -9"),
        ({"bounds": (0.0, 1e-3)}, r"hold theta0 = \[.*\], got \(0\.0, 0\.001"),
        ({"bounds": (1.0, 1.0), "theta0": (1.0, 1.0)}, r"a smallest and a larger theta"),
        ({"L": 1e300}, r"L must be > 0 in every entry.*, and at most 1e\+60"),
        ({"L": 1e300 * np.eye(2)}, r"L must be > 0 in every entry.*, and at most 1e\+60"),
        ({"alpha": 1e300}, r"alpha must be > 0 in every entry.*, and at most 1e\+60"),
        ({"torque_limits": 0.0}, r"torque_limits must be numbers > 0 \[N m or N\], one or 2"),
        ({"torque_limits": (1.0, -1.0)}, r"torque_limits must be numbers > 0"),
        ({"torque_limits": np.nan}, r"torque_limits must be numbers > 0 .*, got nan"),
        ({"torque_limits": (1.0, 2.0, 3.0)}, r"torque_limits must be numbers > 0 .* one or 2"),
    ],
)
def test_bad_bounds_and_limits_are_refused(two_link, arguments, text):
    with pytest.raises(aj.InvalidInputError, match=text):
        aj.AdaptiveGravity(GravityRegressor(two_link, "x"), **arguments)


# -- saturated motors -----------------------------------------------------------------------


@pytest.mark.parametrize("L", [0.1, None], ids=["gravity", "all of it"])
def test_learning_stands_still_while_the_torque_is_beyond_the_limits(arms, rng, L):
    _, belief, regressor, _ = arms
    task = aj.PositionTask(belief)

    def controller_with(limits):
        gravity = aj.AdaptiveGravity(regressor, L, torque_limits=limits)
        return aj.SetpointController(task, gravity=gravity)

    v, x, target = rng.uniform(-1, 1, 7), rng.uniform(-1, 1, 3), np.zeros(3)
    theta0 = controller_with(np.inf).adaptation.theta0
    free = rate_at(controller_with(np.inf), START, v, x, theta0, target)
    assert free.status is aj.Status.OK
    assert np.abs(free.state_rate).max() > 0.0
    asked = np.abs(free.torque)
    for joint in range(7):
        for share, beyond in ((1.0 - 1e-9, True), (1.0 + 1e-9, False)):
            limits = np.full(7, np.inf)
            limits[joint] = share * asked[joint]
            answer = rate_at(controller_with(limits), START, v, x, theta0, target)
            assert np.array_equal(answer.torque, free.torque)  # what is asked for stays
            assert (answer.status is aj.Status.TORQUE_SATURATED) is beyond
            rate = np.zeros(len(theta0)) if beyond else free.state_rate
            assert np.array_equal(answer.state_rate, rate)
    # a lost measurement is told first; many joints below their limits are not one beyond
    lost = np.full(3, np.nan)
    answer = rate_at(controller_with(1e-3), START, v, lost, theta0, target)
    assert answer.status is aj.Status.MEASUREMENT_LOST
    answer = rate_at(controller_with(asked * 1.001), START, v, x, theta0, target)
    assert answer.status is aj.Status.OK


def test_without_limits_nothing_ever_stands_still(arms):
    _, belief, regressor, _ = arms
    task, gravity = (
        aj.PositionTask(belief),
        aj.AdaptiveGravity(regressor, 0.1, torque_limits=np.inf),
    )
    controller = aj.SetpointController(task, aj.Gains(1e8, 1.0, damping=1.0), gravity=gravity)
    x = task.value(START)
    answer = rate_at(controller, START, np.zeros(7), x, regressor.theta, x - 0.1)
    assert np.abs(answer.torque).max() > 1e6
    assert answer.status is aj.Status.OK
    assert np.abs(answer.state_rate).max() > 1e-3


@pytest.mark.parametrize("axes", ["xyz", "zx"])
def test_learning_stands_still_where_the_target_is_out_of_reach(arms, axes):
    """Farther from the first joint than the stretched arm with a tool: nobody can learn there."""
    _, belief, regressor, _ = arms
    task = aj.PositionTask(belief, axes=axes)
    gravity = aj.AdaptiveGravity(regressor, torque_limits=np.inf)
    controller = aj.SetpointController(task, gravity=gravity)
    theta, x = controller.adaptation.theta0, task.value(START)
    for away, far in ((1.0, False), (1.8, True)):
        for shift in (0.0, 7.0):  # whoever measures x may stand anywhere
            target = np.full(task.m, away / np.sqrt(task.m)) + shift
            answer = rate_at(controller, START, np.zeros(7), x + shift, theta, target)
            assert (answer.status is aj.Status.OUT_OF_REACH) is far
            assert (answer.state_rate == 0.0).all() == far


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (3.0, -2.0, 1.0)])
def test_the_reach_is_in_the_world_wherever_a_tracker_stands(panda, offset):
    task = PoseTrackerTask(panda, rotation=(0.3, -1.0, 2.0), offset=offset)
    origin, most = panda.reach_bound(task.frame)
    for away, is_far in ((0.8, False), (1.3, True)):
        target = task.offset + pin.exp3(task.rotation) @ (origin + away * most * np.eye(3)[1])
        error = task.error(task.value(START), np.append(target, [0.0, 0.0, 0.0, 1.0]))
        assert Reach(task).is_exceeded(START, error) == is_far


@pytest.mark.parametrize("axes", ["xyz", "zx"])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_reach_is_around_the_first_joint(panda, axes, side):
    """By a tool more than the stretched arm: of a Panda 0.333 m above the floor."""
    task = aj.PositionTask(panda, axes=axes)
    origin, most = panda.reach_bound(task.frame)
    assert origin == pytest.approx([0.0, 0.0, 0.333])
    up = np.where(np.array(list(axes)) == "z", side, 0.0)
    for distance, is_far in ((1.17 * most, False), (1.19 * most, True)):
        target = origin[["xyz".index(axis) for axis in axes]] + distance * up
        assert Reach(task).is_exceeded(START, task.value(START) - target) == is_far


def test_the_differentiator_goes_on_while_learning_stands_still(arms):
    """Law (5) with learnt gravity: of the state, θ̂ alone is frozen."""
    _, belief, regressor, _ = arms
    controller = aj.SetpointController(
        aj.PositionTask(belief),
        gravity=aj.AdaptiveGravity(regressor, torque_limits=1e-3),
        velocity=DifferentiatedVelocity(0.01),
    )
    measurement = aj.Measurement(0.0, START, np.zeros(7), np.full(3, 0.5))
    state = controller.begin(measurement)
    p = len(state) - 3
    state[p:] -= 0.002
    answer = controller.evaluate(state, measurement, np.zeros(3))
    assert answer.status is aj.Status.TORQUE_SATURATED
    assert np.array_equal(answer.state_rate[:p], np.zeros(p))
    assert_allclose(answer.state_rate[p:], np.full(3, 0.2))


def test_freezing_keeps_theta_from_winding_up_on_weak_motors(arms):
    """Motors of half their torque, θ̂(0) = θ: what θ̂ is driven off by falls by a quarter.

    In the metric L⁻¹, in which force and torques that are learnt compare with parameters.
    """
    _, belief, _, theta = arms
    limits = 0.5 * belief.effort_limits
    gains = aj.default_gains(aj.PositionTask(belief), 0.5)
    peaks = []
    for frozen_at in (limits, np.inf):
        controller, run = closed_loop(
            arms, 3.0, gains, {"torque_limits": limits}, every=0.01,
            theta0=theta, torque_limits=frozen_at,
        )  # fmt: skip
        saturated = (run.status == aj.Status.TORQUE_SATURATED).any()
        assert saturated == np.isfinite(frozen_at).all()
        assert np.linalg.norm(run.error[-1]) < 1e-3
        off = run.state - [*theta, *np.zeros(10)]
        root = np.linalg.cholesky(controller.adaptation.L)
        peaks.append(np.linalg.norm(np.linalg.solve(root, off.T), axis=0).max())
    assert peaks[0] < 0.75 * peaks[1]


def test_it_learns_no_weight_that_the_motors_cannot_hold(panda, rng):
    """Where |Yθ̂| is beyond the motors, it becomes no larger, as long as the arm stays there."""
    task = aj.PositionTask(panda)
    law, effort = (
        aj.SetpointController(task, gravity=aj.AdaptiveGravity(panda)),
        panda.effort_limits,
    )
    controller = law.with_limiter(effort)  # which never rests, so that it is bounds that are seen
    learning = controller.adaptation
    measurement = aj.Plant(panda).measure(0.0, panda.random_configuration(rng), np.zeros(7))
    theta0 = controller.begin(measurement)
    Y = learning.Y(measurement.q, task.jacobian(measurement.q))
    beyond = 0
    for _ in range(50):
        heavy = rng.choice([-1.2, 0.0, 1.2], 7) * effort  # N m, by joint torques alone
        theta_hat = theta0 + np.concatenate([np.zeros(15), heavy])
        # at a bound of one parameter on which rows of torque depend, too
        theta_hat[12] = learning.bounds[rng.integers(2)][12]
        target = measurement.x + rng.uniform(-0.2, 0.2, 3)
        answer = controller.evaluate(theta_hat, measurement, target)
        g, g_dot = answer.gravity, Y @ answer.state_rate
        too_much = np.abs(g) > effort
        beyond += too_much.sum()
        assert (g_dot * np.sign(g))[too_much].max(initial=0.0) <= 1e-9 * np.abs(g_dot).max()
    assert beyond > 50


def test_motors_that_are_stronger_than_the_urdf_says_may_be_asked_for_more(panda):
    """With `torque_limits` of one's own, within limits of one's own, and with none at all."""
    truth, strong = panda.with_object(0.2, 6.0), 3.0 * panda.effort_limits
    task, belief = aj.PositionTask(panda), aj.AdaptiveGravity
    q = np.array([0.0, 1.0, 0.0, -1.0, 0.0, 1.6, 0.7])
    theta = GravityRegressor(panda).fit(truth)[0]
    told = {"bounds": (-100.0, 100.0), "theta0": theta}
    for gravity, limits in (
        (belief(panda, torque_limits=strong, **told), None),
        (belief(panda, torque_limits=np.inf, **told), None),
        (belief(panda, **told), aj.Limits(effort=strong)),
    ):
        law = aj.SetpointController(task, gravity=gravity)
        controller = law if limits is None else aj.TorqueLimited(law, limits)
        x = aj.PositionTask(panda).value(q)
        measurement = aj.Measurement(0.0, q, np.zeros(7), x - [0.0, 0.0, 0.01])
        state = controller.initial_state(measurement)
        after, answer = controller.step(state, measurement, x, 1e-3)
        assert (np.abs(answer.gravity) > panda.effort_limits).any()
        free = law.with_limiter(np.full(7, np.inf)).evaluate(law.begin(measurement), measurement, x)
        assert_allclose(controller.learnt(after) - controller.learnt(state), 1e-3 * free.state_rate)


@pytest.mark.study
def test_axes_that_are_10_degrees_off_are_made_up_for_and_30_are_not():
    """Directions, tools and targets drawn; what is left after 6 s."""
    arm, left = aj.load_robot("panda"), {10: [], 30: []}
    q0 = aj.Plant(arm).ready_configuration()
    for (degrees, errors), mass, seed in itertools.product(left.items(), (0.1, 1.3), range(8)):
        rng = np.random.default_rng(seed)
        axes = rng.normal(size=(arm.nv, 3))
        axes *= np.radians(degrees) / np.linalg.norm(axes, axis=1, keepdims=True)
        turns = dict(zip(arm.joint_names, axes, strict=True))
        belief = arm.with_object(0.0).with_kinematic_error(rotations=turns)
        plant, way = aj.Plant(arm.with_object(0.2, mass, axis="x")), rng.normal(size=3)
        law = aj.SetpointController(aj.PositionTask(belief), gravity=aj.AdaptiveGravity(belief))
        x_d = plant.sensor.value(q0) + 0.2 * way / np.linalg.norm(way)
        try:
            run = aj.simulate(plant, law, x_d, q0, 6.0, dt=2e-3)
            errors.append(run.error_norm[run.t > 5.4].max())
        except aj.errors.SimulationError:
            errors.append(np.inf)
    assert max(left[10]) < 2e-4
    assert 4 <= sum(each > 5e-3 for each in left[30]) <= 12
