"""`AdaptiveGravity`: Eq. (28), Eq. (29) with default gains, bounds, and motors that saturate."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.controllers import DifferentiatedVelocity
from approxjac.robots import Dynamics, GravityRegressor

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
        dt=2e-3, record_every=every, integrator="semi_implicit_euler",
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
    filled = controller.adaptation
    L, alpha = aj.controllers.default_adaptation(task, controller.diagonals, regressor)
    assert_allclose(filled.L, L, atol=0)
    assert filled.alpha == alpha
    assert filled.L.shape == (12,)
    assert (filled.L > 0.0).all()
    assert_allclose(filled.alpha, 4.0, rtol=1e-6)  # the slow pole of gains that settle in 1 s
    assert_allclose(filled.theta0, regressor.theta, atol=0)
    assert_allclose(filled.torque_limits, [87.0] * 4 + [12.0] * 3)
    assert filled.bounds is None
    assert aj.SetpointController(task).adaptation is None


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
    only_L = filled(L=0.3)
    assert_allclose(only_L.L, np.full(12, 0.3), atol=0)
    assert only_L.alpha == free.alpha
    only_alpha = filled(alpha=2.0 * free.alpha)
    assert only_alpha.alpha == 2.0 * free.alpha
    # learning is as fast: L α stays
    assert_allclose(only_alpha.L * only_alpha.alpha, free.L * free.alpha, rtol=1e-12)


def test_every_arm_has_defaults(arm):
    axes = "yz" if arm.name == "double_pendulum" else "xz" if arm.nv == 2 else "xyz"
    gravity = aj.AdaptiveGravity(GravityRegressor(arm))
    filled = aj.SetpointController(aj.PositionTask(arm, axes=axes), gravity=gravity).adaptation
    assert np.isfinite(filled.L).all()
    assert (filled.L > 0.0).all()
    assert filled.alpha > 0.0


@pytest.mark.parametrize("from_zero", [False, True])
def test_with_default_gains_an_unknown_payload_is_learnt(arms, from_zero):
    """To < 1 mm in 10 s from the believed θ̂(0), and from none at all; dt = 2 ms.

    With none at all the arm falls first, beyond its limits if nothing stops it.
    """
    theta0, plant = (np.zeros(12), {"joint_limits": False}) if from_zero else (None, None)
    _, run = closed_loop(arms, 10.0, plant=plant, every=10.0, theta0=theta0)
    assert np.linalg.norm(run.error[0]) > 0.1
    assert np.linalg.norm(run.error[-1]) < 1e-3
    assert np.abs(run.v[-1]).max() < 1e-3
    # what is learnt is gravity where the arm stands
    truth, _, regressor, _ = arms
    g, Z = Dynamics(truth).g(run.q[-1]), regressor.Z(run.q[-1])
    assert_allclose(Z @ run.state[-1], g, atol=0.05)
    assert np.abs(Z @ regressor.theta - g).max() > 1.0


# -- bounds ---------------------------------------------------------------------------------


def test_theta_stays_within_its_bounds_to_one_step(arms):
    """Tight ones: the target is reached, but with a time constant of 7 s instead of 1.3 s."""
    *_, regressor, theta = arms
    lower = np.minimum(theta, regressor.theta) - 0.02
    upper = np.maximum(theta, regressor.theta) + 0.02
    _, bounded = closed_loop(arms, 20.0, every=2e-3, bounds=(lower, upper))
    _, free = closed_loop(arms, 6.0, every=2e-3)
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
        ({"bounds": 3.0}, r"bounds must be a smallest and a largest theta, got 3\.0"),
        ({"bounds": (-9.0, 0.0, 9.0)}, "bounds must be a smallest and a largest theta, got"),
        ({"bounds": (-9.0,)}, "bounds must be a smallest and a largest theta, got"),
        ({"bounds": (-9.0, np.inf)}, r"bounds must be finite, got \[inf"),
        ({"bounds": (np.nan, 9.0)}, r"bounds must be finite, got \[nan"),
        ({"bounds": (-9.0, np.ones(3))}, r"bounds must have shape \(2,\), got shape \(3,\)"),
        ({"bounds": ("low", 9.0)}, r"bounds must be numbers of shape \(2,\)"),
        ({"bounds": (9.0, -9.0)}, r"a smallest and a larger theta, got \[9\.0, 9\.0\] to \[-9"),
        ({"bounds": (0.0, 1e-3)}, r"bounds must hold theta0 = \[.*\], got \[0\.0, 0\.0\] to"),
        ({"bounds": (1.0, 1.0), "theta0": (1.0, 1.0)}, r"a smallest and a larger theta"),
        ({"bounds": (-9.0, 9.0), "L": np.eye(2)}, "bounds need L to be a number or a diagonal: wi"),
        ({"L": 1e300}, r"L must be at most 1e\+60"),
        ({"L": 1e300 * np.eye(2)}, r"L must be at most 1e\+60"),
        ({"alpha": 1e300}, r"alpha must be at most 1e\+60"),
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


def test_learning_stands_still_while_the_torque_is_beyond_the_limits(arms, rng):
    _, belief, regressor, _ = arms
    task = aj.PositionTask(belief)

    def controller_with(limits):
        gravity = aj.AdaptiveGravity(regressor, torque_limits=limits)
        return aj.SetpointController(task, gravity=gravity)

    v, x, target = rng.uniform(-1, 1, 7), rng.uniform(-1, 1, 3), np.zeros(3)
    free = rate_at(controller_with(np.inf), START, v, x, regressor.theta, target)
    assert free.status is aj.Status.OK
    assert np.abs(free.state_rate).max() > 0.0
    asked = np.abs(free.torque)
    for joint in range(7):
        for share, beyond in ((1.0 - 1e-9, True), (1.0 + 1e-9, False)):
            limits = np.full(7, np.inf)
            limits[joint] = share * asked[joint]
            answer = rate_at(controller_with(limits), START, v, x, regressor.theta, target)
            assert np.array_equal(answer.torque, free.torque)  # what is asked for stays
            assert (answer.status is aj.Status.TORQUE_SATURATED) is beyond
            rate = np.zeros(12) if beyond else free.state_rate
            assert np.array_equal(answer.state_rate, rate)
    # a lost measurement is told first; many joints below their limits are not one beyond
    lost = np.full(3, np.nan)
    answer = rate_at(controller_with(1e-3), START, v, lost, regressor.theta, target)
    assert answer.status is aj.Status.MEASUREMENT_LOST
    answer = rate_at(controller_with(asked * 1.001), START, v, x, regressor.theta, target)
    assert answer.status is aj.Status.OK


def test_without_limits_nothing_ever_stands_still(arms):
    _, belief, regressor, _ = arms
    gravity = aj.AdaptiveGravity(regressor, torque_limits=np.inf)
    controller = aj.SetpointController(aj.PositionTask(belief), gravity=gravity)
    far = np.full(3, 1e6)
    answer = rate_at(controller, START, np.zeros(7), far, regressor.theta, np.zeros(3))
    assert np.abs(answer.torque).max() > 1e6
    assert answer.status is aj.Status.OK
    assert np.abs(answer.state_rate).max() > 1.0


def test_the_differentiator_goes_on_while_learning_stands_still(arms):
    """Law (5) with learnt gravity: of the state, θ̂ alone is frozen."""
    _, belief, regressor, _ = arms
    controller = aj.SetpointController(
        aj.PositionTask(belief),
        gravity=aj.AdaptiveGravity(regressor, torque_limits=1e-3),
        velocity=DifferentiatedVelocity(0.01),
    )
    measurement = aj.Measurement(0.0, START, np.zeros(7), np.full(3, 0.5))
    state = controller.initial_state(measurement)
    state[12:] -= 0.002
    answer = controller.evaluate(state, measurement, np.zeros(3))
    assert answer.status is aj.Status.TORQUE_SATURATED
    assert np.array_equal(answer.state_rate[:12], np.zeros(12))
    assert_allclose(answer.state_rate[12:], np.full(3, 0.2))


def test_freezing_keeps_theta_from_winding_up_on_weak_motors(arms):
    """Motors of half their torque, θ̂(0) = θ: what θ̂ is driven off by falls by a quarter."""
    _, belief, _, theta = arms
    limits = 0.5 * belief.effort_limits
    gains = aj.default_gains(aj.PositionTask(belief), 0.5)
    peaks = []
    for frozen_at in (limits, np.inf):
        _, run = closed_loop(
            arms, 3.0, gains, {"torque_limits": limits}, every=0.01,
            theta0=theta, torque_limits=frozen_at,
        )  # fmt: skip
        saturated = (run.status == aj.Status.TORQUE_SATURATED).any()
        assert saturated == np.isfinite(frozen_at).all()
        assert np.linalg.norm(run.error[-1]) < 1e-3
        peaks.append(np.linalg.norm(run.state - theta, axis=1).max())
    assert peaks[0] < 0.75 * peaks[1]
