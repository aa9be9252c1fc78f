"""`TorqueLimited`: limits, the proof, statuses, fallback, learning."""

import copy
import math
import pickle
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import qpsolvers
from hypothesis import given
from hypothesis import strategies as st
from lyapunov_decrease import lyapunov
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac import law as equations
from approxjac.controllers import DifferentiatedVelocity, Posture, RegressorGravity
from approxjac.controllers.limits.limits import sure_deceleration
from approxjac.controllers.limits.quadratic_program import Solver
from approxjac.errors import MeasurementError
from approxjac.robots import Dynamics, GravityRegressor
from approxjac.tasks.analysis import seen_configurations

DT = 1e-3


def law_of(robot, gravity=None, gains=None, task=None, **options):
    """A law that asks for as much as its error: s(e) = e."""
    task = aj.PositionTask(robot) if task is None else task
    gains = aj.default_gains(task) if gains is None else gains
    return aj.SetpointController(task, gains, gravity=gravity, **options)


def learning(robot):
    return law_of(robot, aj.AdaptiveGravity(GravityRegressor(robot), L=0.1, alpha=1.0))


def some_measurement(robot, rng, speed=1.0, error=0.3):
    q = robot.random_configuration(rng)
    x = aj.PositionTask(robot).value(q)
    return aj.Measurement(0.0, q, speed * rng.normal(size=robot.nv), x), x + error * rng.normal(
        size=3
    )


def answered(controller, state, measurement, target):
    return controller.step(state, measurement, target, DT)[1]


def first_answer(controller, measurement, target):
    return answered(controller, controller.initial_state(measurement), measurement, target)


def effort_only(robot, scale):
    return aj.Limits(effort=scale * robot.effort_limits)


# -- limits -------------------------------------------------------------------------------------

ROBOTS = {name: aj.load_robot(name) for name in ("panda", "kinova", "tiago_arm")}
SIZES = st.sampled_from([0.0, 1e-3, 1.0, 30.0, 1e6, 1e12])


@given(
    st.sampled_from(list(ROBOTS)),
    st.integers(0, 2**32 - 1),
    SIZES,
    SIZES,
    st.booleans(),
)
def test_whatever_comes_in_the_torque_is_within_the_limits(name, seed, speed, error, lost):
    robot, rng = ROBOTS[name], np.random.default_rng(seed)
    limits = replace(aj.Limits.of(robot, scale=0.4), rate=2000.0)
    limited = aj.TorqueLimited(learning(robot), limits).guarded(None)  # which refuses most of it
    measurement, target = some_measurement(robot, rng, speed, error)
    state = limited.initial_state(measurement)
    if lost:
        measurement = measurement._replace(x=np.full(3, np.nan))
    after, answer = limited.step(state, measurement, target, DT)
    effort = 0.4 * robot.effort_limits
    assert (np.abs(answer.torque) <= effort).all()
    hold = np.clip(limited.controller.gravity_torque(state, measurement.q), -effort, effort)
    assert (np.abs(answer.torque - hold) <= 2000.0 * DT * (1 + 1e-9)).all()
    assert np.isfinite(after).all()
    assert_array_equal(after[limited.size - robot.nv : limited.size], answer.torque)
    assert answer.limit_status is not aj.LimitStatus.UNLIMITED
    claimed = answer.limit_status in (aj.LimitStatus.FREE, aj.LimitStatus.PROOF_KEPT)
    assert answer.slack == 0.0 if claimed else not answer.slack < 0.0
    again = answered(limited, state, measurement, target)
    assert_array_equal(again.torque, answer.torque)


def test_a_free_torque_is_that_of_the_law_to_the_bit(panda, rng):
    law = learning(panda)
    limited = aj.TorqueLimited(law)
    free = 0
    for _ in range(50):
        measurement, target = some_measurement(panda, rng, speed=0.02, error=0.01)
        (after, answer), (plain_after, plain) = (
            c.step(c.initial_state(measurement), measurement, target, DT) for c in (limited, law)
        )
        if answer.limit_status is aj.LimitStatus.FREE:
            free += 1
            assert_array_equal(answer.torque, plain.torque)
            assert_array_equal(after[: law.size], plain_after[: law.size])
            assert answer.slack == 0.0
    assert free > 25


def test_without_limits_nothing_is_limited(two_link, rng):
    task = aj.PositionTask(two_link, axes="xz")
    limited = aj.TorqueLimited(aj.SetpointController(task), aj.Limits())
    assert limited.dt is None
    q, v = np.array([0.3, 0.8]), np.array([30.0, -50.0])
    answer = answered(
        limited, np.zeros(0), aj.Measurement(0.0, q, v, np.array([50.0, 0.0])), np.zeros(2)
    )
    assert answer.limit_status is aj.LimitStatus.FREE


# -- the proof ----------------------------------------------------------------------------------


def V_dot(plant, controller, q, v, tau, target, alpha, h=1e-6, **state):
    """dV/dt along the true dynamics under a torque, by central differences."""
    a = plant.acceleration(q, v, tau)

    def V(t):
        q_t = pin.integrate(plant.robot.model, q, t * v + 0.5 * t * t * a)
        return lyapunov(plant, controller, q_t, v + t * a, target, alpha, **state).V

    return (V(h) - V(-h)) / (2.0 * h)


def test_V_decreases_as_promised_along_the_true_dynamics(panda, rng):
    """V̇ ≤ −W where the slack is 0, V̇ ≤ −W + σ elsewhere; J, M, C, g of the true robot."""
    truth = panda.with_object(0.2, 0.5, axis="x")
    belief = panda.with_object(0.0)
    regressor = GravityRegressor(belief)
    law = law_of(belief, RegressorGravity(regressor, regressor.fit(truth)[0]))
    limited = aj.TorqueLimited(law, aj.Limits.of(panda, scale=0.5))
    plant = aj.Plant(truth, sensor=aj.PositionTask(truth))
    seen = set()
    for _ in range(40):
        measurement, target = some_measurement(truth, rng, speed=0.3, error=0.2)
        q, v = measurement.q, measurement.v
        answer = first_answer(limited, measurement, target)
        W = lyapunov(plant, law, q, v, target, limited.alpha).W
        rate = V_dot(plant, law, q, v, answer.torque, target, limited.alpha)
        assert rate <= -W + answer.slack + 1e-5 * (1.0 + abs(W))
        if answer.slack > 1e-3:  # and the slack is not larger than it has to be
            assert rate >= -W + answer.slack - 1e-5 * (1.0 + abs(W))
        seen.add(answer.limit_status)
    assert aj.LimitStatus.PROOF_KEPT in seen


def test_on_a_path_the_proofs_row_has_the_motion_relative_to_it(panda, rng):
    """There q̇ − Ĵ⁺ẋ_d takes the place of q̇ in y, as in the law and in what learns."""
    law, kept = law_of(panda), 0
    limited = aj.TorqueLimited(law, effort_only(panda, 0.4))
    for _ in range(60):
        measurement, x_d = some_measurement(panda, rng, speed=0.5, error=0.2)
        target = aj.Target(x_d, rng.normal(size=3))
        answer = first_answer(limited, measurement, target)
        if answer.limit_status is aj.LimitStatus.PROOF_KEPT:
            kept += 1
            relative = measurement.v - np.linalg.pinv(answer.J_hat) @ target.v
            y = law.passive_output(answer, relative, limited.alpha)
            wanted = law.evaluate(np.zeros(0), measurement, target).torque
            assert y @ (answer.torque - wanted) <= 1e-9
    assert kept > 5


def test_clipping_breaks_what_the_QP_keeps(panda, rng):
    """At the same states, with the same torque asked for."""
    law = law_of(panda)
    limits = effort_only(panda, 0.4)
    limited, clipped = (aj.TorqueLimited(law, limits, proof=proof) for proof in (True, False))
    broken = 0
    for _ in range(100):
        measurement, target = some_measurement(panda, rng, speed=0.5, error=0.2)
        answer = first_answer(limited, measurement, target)
        if answer.limit_status is aj.LimitStatus.PROOF_KEPT:
            y = law.passive_output(answer, measurement.v, limited.alpha)
            wanted = law.evaluate(np.zeros(0), measurement, target).torque
            other = first_answer(clipped, measurement, target).torque
            assert y @ (answer.torque - wanted) <= 1e-9
            broken += y @ (other - wanted) > 1e-3
    assert broken > 5


@pytest.mark.parametrize(
    "v_d",
    [
        pytest.param(None, id="at rest", marks=pytest.mark.study),
        pytest.param(np.array([0.3, -0.2, 0.1]), id="on a path"),
    ],
)
@pytest.mark.parametrize(("scale", "speed"), [(0.4, 0.5), (4.0, 0.05)])
def test_where_the_proof_is_given_up_joints_at_a_limit_do_not_learn(panda, scale, speed, v_d, rng):
    """There learning is that of an arm whose joints at a limit are locked: y = q̇ + α(ĴP)⁺s(e).

    On a path s(e) − ẋ_d/α takes the place of s(e).
    """
    law = learning(panda)
    free = aj.SetpointController(
        law.task,
        law.gains,
        gravity=aj.AdaptiveGravity(
            law.adaptation.regressor, L=0.1, alpha=1.0, torque_limits=np.inf
        ),
    )
    limited = aj.TorqueLimited(law, aj.Limits.of(panda, scale=scale), braking=0.1 / DT)
    assert limited.alpha == 1.0
    seen = {}
    for _ in range(150):
        measurement, target = some_measurement(panda, rng, speed=speed, error=0.2)
        if scale > 1.0:  # two joints at their stops
            q, x = measurement.q.copy(), measurement.x
            q[[1, 3]] = panda.position_limits[1][[1, 3]] - 0.001
            measurement = measurement._replace(q=q, x=law.task.value(q))
            target = target - x + measurement.x
        target = aj.Target(target, v_d)
        state = limited.initial_state(measurement)
        after, answer = limited.step(state, measurement, target, DT)
        before = law.learnt(state)
        learnt, wanted = free.step(before, measurement, target, DT)
        kept = aj.LimitStatus.FREE, aj.LimitStatus.PROOF_KEPT, aj.LimitStatus.EXCEEDED
        if answer.limit_status in kept:
            assert_array_equal(law.learnt(after), learnt)
        elif answer.limit_status is aj.LimitStatus.PROOF_GIVEN_UP:
            q, v, (low, high) = measurement.q, measurement.v, panda.position_limits
            locked = (np.abs(answer.torque) > 0.98 * scale * panda.effort_limits) | (
                np.abs(v) > 0.98 * panda.velocity_limits
            )
            locked |= (q < low + 0.02) | (q > high - 0.02)
            J_free = answer.J_hat * ~locked
            if locked.any() and np.linalg.cond(J_free) > 30.0:
                continue  # Ĵ⁺ is damped there
            s = law.saturation.s(answer.e) - (0.0 if v_d is None else v_d)
            y = v * ~locked + np.linalg.pinv(J_free) @ s
            goes_on = locked.any() and (np.abs(wanted.torque) <= scale * panda.effort_limits).all()
            rate = -0.1 * law.adaptation.regressor.Z(q).T @ y if goes_on else 0.0 * before
            assert_allclose(law.learnt(after), before + DT * rate, atol=1e-12)
            seen["without some joints"] = seen.get("without some joints", 0) + bool(goes_on)
        else:
            assert_array_equal(law.learnt(after), before)
        seen[answer.limit_status] = seen.get(answer.limit_status, 0) + 1
    assert seen[aj.LimitStatus.PROOF_KEPT] > 5
    assert seen[aj.LimitStatus.PROOF_GIVEN_UP] > 5
    assert (seen["without some joints"] > 5) == (scale > 1.0)


def test_without_a_joint_at_a_limit_the_arm_that_is_left_learns_as_the_law_does(panda, rng):
    """Also of images of three points, whose Ĵ⁺ is damped by a bound of their own."""
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.3), (1.6, 0.2, 0.8), 600.0, (640, 480))
    points = ((0.0, 0.0, 0.0), (0.05, 0.0, 0.0), (0.0, 0.05, 0.0))
    task = aj.ImageTask(panda, camera, points=points)
    gravity = aj.AdaptiveGravity(panda, L=0.1, alpha=1.0, torque_limits=np.inf)
    law, nobody = law_of(panda, gravity, task=task), np.zeros(panda.nv, dtype=bool)
    ratios = []
    for q in seen_configurations(task, 10):
        measurement = aj.Measurement(0.0, q, rng.normal(size=panda.nv), task.value(q))
        target = aj.Target(measurement.x + 5.0, 10.0 * rng.normal(size=task.m))
        state = law.begin(measurement)
        answer = law.evaluate(state, measurement, target)
        if answer.status is aj.Status.OK:  # Ĵ⁺ is not damped
            rate = law.rate_without(nobody, state, measurement, answer)
            assert_allclose(rate, answer.state_rate, rtol=1e-6, atol=1e-9)
            values = np.linalg.svd(answer.J_hat, compute_uv=False)
            ratios.append(values[-1] / values[0])
    assert len(ratios) > 5
    assert np.median(ratios) < equations.SINGULAR_RATIO


def test_V_with_learnt_parameters_decreases_as_promised_too(panda, rng):
    """The parameters' part of V needs learning to go on: then V̇ ≤ −W at slack 0."""
    truth = panda.with_object(0.0, 0.0)
    law = aj.SetpointController(
        aj.PositionTask(truth),
        gravity=aj.AdaptiveGravity(GravityRegressor(truth), L=0.05, alpha=0.5),
    )
    limited = aj.TorqueLimited(law, aj.Limits.of(panda, scale=0.6))
    plant = aj.Plant(truth, sensor=aj.PositionTask(truth))
    theta = law.adaptation.regressor.theta
    kept = 0
    for _ in range(60):
        measurement, target = some_measurement(truth, rng, speed=0.3, error=0.2)
        q, v = measurement.q, measurement.v
        state = theta + 0.05 * rng.normal(size=len(theta))
        whole = limited.initial_state(measurement)
        whole[: len(theta)] = state
        answer = answered(limited, whole, measurement, target)
        if answer.limit_status is not aj.LimitStatus.PROOF_KEPT:
            continue
        kept += 1
        a, h, rate = plant.acceleration(q, v, answer.torque), 1e-6, answer.state_rate

        def V(t, q=q, v=v, a=a, state=state, rate=rate, target=target):
            q_t = pin.integrate(truth.model, q, t * v + 0.5 * t * t * a)
            return lyapunov(
                plant, law, q_t, v + t * a, target, 0.5, state=state + t * rate, theta=theta
            ).V

        W = lyapunov(plant, law, q, v, target, 0.5, state=state, theta=theta).W
        assert (V(h) - V(-h)) / (2.0 * h) <= -W + 1e-5 * (1.0 + abs(W))
    assert kept > 5


def test_where_the_proof_is_given_up_V_has_the_slack_and_what_would_be_learnt(panda, rng):
    """V̇ = −W + σ − yᵀZ(θ − θ̂) for a θ̂ that stands still."""
    law = aj.SetpointController(
        aj.PositionTask(panda),
        gravity=aj.AdaptiveGravity(GravityRegressor(panda), L=0.05, alpha=0.5),
    )
    limited = aj.TorqueLimited(law, effort_only(panda, 0.5))
    plant = aj.Plant(panda, sensor=aj.PositionTask(panda))
    regressor = law.adaptation.regressor
    theta, seen = regressor.theta, 0
    for _ in range(60):
        measurement, target = some_measurement(panda, rng, speed=0.3, error=0.3)
        q, v = measurement.q, measurement.v
        state = theta + 0.05 * rng.normal(size=len(theta))
        _, answer = limited.step(state, measurement, target, DT)
        if answer.limit_status is not aj.LimitStatus.PROOF_GIVEN_UP:
            continue
        seen += 1
        given = {"state": state, "theta": theta}
        W = lyapunov(plant, law, q, v, target, 0.5, **given).W
        y = law.passive_output(answer, v, 0.5)
        unlearnt = y @ regressor.Z(q) @ (theta - state)
        rate = V_dot(plant, law, q, v, answer.torque, target, 0.5, **given)
        assert rate == pytest.approx(-W + answer.slack - unlearnt, abs=1e-5 * (1.0 + abs(W)))
    assert seen > 5


@pytest.mark.parametrize("proof", [True, False])
def test_nothing_is_said_of_the_proof_without_x(panda, proof):
    limited = aj.TorqueLimited(law_of(panda), aj.Limits(effort=20.0), proof=proof)
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    lost = aj.Measurement(0.0, q, np.full(7, 0.1), np.full(3, np.nan))
    answer = answered(limited, np.zeros(0), lost, np.ones(3))
    assert answer.status is aj.Status.MEASUREMENT_LOST
    assert answer.limit_status is aj.LimitStatus.LIMITED
    assert math.isnan(answer.slack)


def test_nothing_is_said_of_the_proof_near_a_singular_pose(two_link):
    task = aj.PositionTask(two_link, axes="xz")
    limited = aj.TorqueLimited(aj.SetpointController(task), aj.Limits(effort=20.0))
    q = np.array([0.3, 0.0])  # stretched
    x = task.value(q)
    answer = answered(limited, np.zeros(0), aj.Measurement(0.0, q, np.zeros(2), x), x + 1.0)
    assert answer.status is aj.Status.NEAR_SINGULAR
    assert answer.limit_status is aj.LimitStatus.LIMITED
    assert math.isnan(answer.slack)


def test_with_a_posture_V_changes_by_the_power_of_the_change(panda, rng):
    """What the posture costs, it costs without limits too: V̇ is no more than with τ*."""
    q_rest = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    law = law_of(panda, posture=Posture(q_rest, 20.0))
    limited = aj.TorqueLimited(law, aj.Limits.of(panda, scale=0.5))
    plant = aj.Plant(panda, sensor=aj.PositionTask(panda))
    kept = 0
    for _ in range(30):
        measurement, target = some_measurement(panda, rng, speed=0.3, error=0.2)
        q, v = measurement.q, measurement.v
        answer = first_answer(limited, measurement, target)
        wanted = law.evaluate(np.zeros(0), measurement, target)
        if answer.limit_status is aj.LimitStatus.PROOF_KEPT:
            kept += 1
            rates = [
                V_dot(plant, law, q, v, torque, target, limited.alpha)
                for torque in (answer.torque, wanted.torque)
            ]
            assert rates[0] <= rates[1] + 1e-5 * (1.0 + abs(rates[1]))
    assert kept > 3


def test_the_differentiator_of_law_5_goes_on_while_learning_stands_still(panda, rng):
    law = aj.SetpointController(
        aj.PositionTask(panda),
        gravity=aj.AdaptiveGravity(GravityRegressor(panda), L=0.1, alpha=1.0),
        velocity=DifferentiatedVelocity(0.02),
    )
    limited = aj.TorqueLimited(law, effort_only(panda, 0.1), proof=False)
    measurement, target = some_measurement(panda, rng, error=1.0)
    state = limited.initial_state(measurement)
    behind, p = state.copy(), limited.size - 3
    behind[p : p + 3] -= 0.01
    after, answer = limited.step(behind, measurement, target, DT)
    assert answer.limit_status is aj.LimitStatus.LIMITED
    assert_array_equal(after[:p], behind[:p])
    assert_allclose((after - behind)[p : p + 3] / DT, 0.5)


# -- the QP -------------------------------------------------------------------------------------


def test_the_torque_is_the_minimum_of_the_QP_with_its_slack(panda, rng):
    """The slack is eliminated on the way; here the problem stands as it is written down."""
    daqp, seen = Solver(), []

    def recording(problem):
        seen.append(problem)
        return daqp.solve(problem)[0]

    law = law_of(panda)
    limits = aj.Limits.of(panda, scale=0.5)
    limited = aj.TorqueLimited(law, limits, solver=recording)
    statuses = set()
    for _ in range(60):
        seen.clear()
        measurement, target = some_measurement(panda, rng, speed=1.0, error=0.2)
        answer = first_answer(limited, measurement, target)
        if not seen or answer.limit_status is aj.LimitStatus.INFEASIBLE:
            continue
        R, _, lower, upper, A, low, high = seen[0]
        y = law.passive_output(answer, measurement.v, limited.alpha)
        wanted = law.evaluate(np.zeros(0), measurement, target).torque
        rho = (seen[0].f + R @ wanted) @ y / (y @ y)
        H = np.zeros((8, 8))
        H[:7, :7], H[7, 7] = R, 1e-8  # definite, and too little to count
        z = qpsolvers.solve_qp(
            H,
            np.append(-R @ wanted, rho),
            np.vstack([np.c_[A, np.zeros(len(A))], np.c_[-A, np.zeros(len(A))], [*y, -1.0]]),
            np.concatenate([high, -low, [y @ wanted]]),
            lb=np.append(lower, 0.0),
            ub=np.append(upper, np.inf),
            solver="daqp",
            primal_tol=1e-10,
        )
        assert_allclose(answer.torque, z[:7], atol=2e-4)
        assert answer.slack == pytest.approx(z[7], abs=1e-3)
        statuses.add(answer.limit_status)
    assert {aj.LimitStatus.PROOF_KEPT, aj.LimitStatus.PROOF_GIVEN_UP} <= statuses


def recorded(law, limits, measurement, target, **options):
    """The first problem that a step solves, and the limiter."""
    seen = []

    def solver(problem):
        seen.append(problem)
        return Solver().solve(problem)[0]

    limited = aj.TorqueLimited(law, limits, solver=solver, **options)
    answer = answered(limited, limited.initial_state(measurement), measurement, target)
    return seen[0], limited, answer


def test_joints_are_weighed_by_their_inertia(panda):
    """R is diagonal, and no configuration's (M⁻¹)ᵢᵢ is far above it."""
    measurement, target = infeasible_state(panda)
    R = recorded(law_of(panda), None, measurement, target)[0].H
    assert_array_equal(R, np.diag(np.diag(R)))
    rng = np.random.default_rng(5)
    drawn = [np.diag(Dynamics(panda).M_inv(panda.random_configuration(rng))) for _ in range(500)]
    share = np.max(drawn, axis=0) / np.diag(R)
    assert (share > 0.7).all()
    assert (share < 1.3).all()


@pytest.mark.parametrize("rate", [None, 2000.0])
def test_the_rows_bound_the_acceleration_that_the_believed_arm_predicts(panda, rate):
    """M̂⁻¹τ within [low, high] is q̈ within `acceleration_bounds`, here by Pinocchio's ABA."""
    measurement, target = infeasible_state(panda)
    measurement = measurement._replace(v=np.linspace(2.0, -2.0, 7))
    q, v = measurement.q, measurement.v
    limits = replace(aj.Limits.of(panda), rate=rate)
    problem, limited, _ = recorded(law_of(panda), limits, measurement, target)
    without = pin.aba(panda.model, panda.model.createData(), q, v, np.zeros(7))
    a = sure_deceleration(panda, panda.effort_limits)
    joints = equations.JointRange.of(
        panda.position_limits, panda.velocity_limits, limited.approach, a
    )
    speeds = joints.speed_bounds(q)
    assert (np.abs(speeds) <= panda.velocity_limits).all()
    wanted = equations.acceleration_bounds(v, speeds, limited.braking)
    low, high = problem.row_lower[:7] + without, problem.row_upper[:7] + without
    if rate is None:
        assert_allclose(np.array([low, high]), wanted, rtol=1e-6, atol=1e-6)
    else:  # torque needs time to fall, so it is nearer to none, never on the other side
        assert (np.abs([low, high]) <= np.abs(wanted) + 1e-6).all()
        assert (np.abs([low, high]) < 0.5 * np.abs(wanted)).any()
        assert (np.sign([low, high]) == np.sign(wanted)).all()


def test_the_proof_pulls_no_joint_faster_than_it_may_move(panda, rng):
    """ρ is less where −αĴ⁺s(e) is beyond a limit of speed."""
    highest, slowed = [], []
    for _ in range(20):
        measurement, target = some_measurement(panda, rng, speed=1.0, error=0.9)
        try:
            problem, limited, answer = recorded(
                law_of(panda), aj.Limits.of(panda, scale=0.5), measurement, target
            )
        except IndexError:  # free
            continue
        y = limited.controller.passive_output(answer, measurement.v, limited.alpha)
        wanted = limited.controller.evaluate(np.zeros(0), measurement, target).torque
        rho = (problem.f + problem.H @ wanted) @ y / (y @ y)
        share = np.abs((y - measurement.v) / panda.velocity_limits).max()
        highest.append(rho * max(1.0, share))
        slowed.append(share > 1.0)
    assert_allclose(highest, highest[0], rtol=1e-6)
    assert any(slowed)
    assert not all(slowed)


def fastest_mode(robot, damping):
    """The largest eigenvalue of M⁻¹D over configurations that are none of the library's own."""
    dynamics, rng = Dynamics(robot), np.random.default_rng(7)
    drawn = [robot.random_configuration(rng) for _ in range(300)]
    return max(np.linalg.eigvals(dynamics.M_inv(q) * damping).real.max() for q in drawn)


def test_damping_that_the_proof_adds_is_no_faster_than_braking(panda):
    """It is λR⁻¹ along y with λ ≤ ρ."""
    measurement, target = infeasible_state(panda)
    limits = replace(aj.Limits.of(panda), velocity=None)  # nothing reduces ρ
    problem, limited, answer = recorded(law_of(panda), limits, measurement, target, braking=80.0)
    wanted = limited.controller.evaluate(np.zeros(0), measurement, target).torque
    y = limited.controller.passive_output(answer, measurement.v, limited.alpha)
    rho = (problem.f + problem.H @ wanted) @ y / (y @ y)
    mode = fastest_mode(panda, rho / np.diag(problem.H))
    assert 0.7 * 80.0 < mode < 1.3 * 80.0


def infeasible_state(robot):
    """A joint that is much too fast for the torque that is left, close to its limit."""
    q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    v = np.zeros(7)
    q[0], v[0] = robot.position_limits[1][0] - 0.01, 2.0
    x = aj.PositionTask(robot).value(q)
    return aj.Measurement(0.0, q, v, x), x


def test_where_nothing_keeps_all_limits_the_arm_is_held_and_braked(panda):
    measurement, target = infeasible_state(panda)
    hold = Dynamics(panda).g(measurement.q)
    limits = replace(aj.Limits.of(panda), effort=np.abs(hold) + 2.0)
    limited = aj.TorqueLimited(law_of(panda), limits)
    answer = first_answer(limited, measurement, target)
    assert answer.limit_status is aj.LimitStatus.INFEASIBLE
    assert answer.torque[0] == pytest.approx(-2.0)
    dynamics, q, v = Dynamics(panda), measurement.q, measurement.v
    alone = np.append(-2.0, hold[1:])  # the joint's own motor, while the others are held
    q_dd = dynamics.forward(q, v, answer.torque)
    assert q_dd[0] < dynamics.forward(q, v, alone)[0]  # they give way, within their own limits
    assert (np.abs(v + DT * q_dd)[1:] < panda.velocity_limits[1:]).all()


def test_what_cannot_be_kept_takes_no_other_joint_with_it(panda):
    """The joint that brakes too late has all that the others can give within their own speeds."""
    measurement, target = infeasible_state(panda)
    limits = aj.Limits.of(panda, scale=0.5)
    limited = aj.TorqueLimited(law_of(panda), limits, braking=0.3 / DT)
    dynamics, q = Dynamics(panda), measurement.q
    v = np.array([2.1, 2.0, 1.2, 0.6, -0.8, -1.1, -2.3])
    alone = limits.effort[0] / dynamics.M(q)[0, 0]  # with the others held
    state, statuses, fastest, hardest = limited.initial_state(measurement), set(), 0.0, 0.0
    for k in range(100):
        now = aj.Measurement(k * DT, q, v, limited.task.value(q))
        state, answer = limited.step(state, now, target, DT)
        q_dd = dynamics.forward(q, v, answer.torque)
        v = v + DT * q_dd
        q, fastest = q + DT * v, max(fastest, (np.abs(v) / panda.velocity_limits).max())
        hardest = max(hardest, -q_dd[0])
        statuses.add(answer.limit_status)
        assert q[0] < panda.position_limits[1][0]
    assert aj.LimitStatus.INFEASIBLE in statuses
    assert fastest < 1.001
    assert hardest > 3.0 * alone
    assert abs(v[0]) < 0.1


@pytest.mark.parametrize(("joint", "speed", "beyond"), [(0, 1.01, -1.0), (4, 0.0, 0.002)])
def test_a_joint_beyond_its_limit_is_never_called_free(panda, joint, speed, beyond):
    """Also where the law's own torque leads back within all other limits, to the bit."""
    measurement, _ = infeasible_state(panda)
    q, v = measurement.q, np.zeros(7)
    q[0] = 0.0
    q[joint] = panda.position_limits[1][joint] + beyond
    v[joint] = speed * panda.velocity_limits[joint]
    law = law_of(panda, gains=aj.Gains(kp=30.0, kv=0.1, damping=5.0))
    x = law.task.value(q)
    target = x - law.task.jacobian(q)[:, joint]  # the way that it has to come back
    measurement = aj.Measurement(0.0, q, v, x)
    limited = aj.TorqueLimited(law)
    answer = first_answer(limited, measurement, target)
    assert_array_equal(answer.torque, law.evaluate(np.zeros(0), measurement, target).torque)
    assert answer.limit_status is aj.LimitStatus.EXCEEDED
    assert answer.slack == 0.0
    q[joint], v[joint] = 0.0, 0.0
    assert first_answer(limited, measurement, target).limit_status is aj.LimitStatus.FREE


class Faulty:
    """A solver that fails as told."""

    def __init__(self, fault):
        self.fault = fault

    def __call__(self, problem):
        n = len(problem.f)
        if self.fault == "raises":
            raise RuntimeError("no")
        answers = {
            "none": None,
            "nan": np.full(n, np.nan),
            "beyond": problem.upper + 5.0,
            "text": "torque",
            "short": np.zeros(n - 1),
            "rows": np.where(np.isfinite(problem.lower), problem.lower, 0.0),
        }
        return answers.get(self.fault)


@pytest.mark.parametrize("fault", ["raises", "none", "nan", "beyond", "text", "short", "rows"])
def test_a_solver_that_fails_leaves_a_torque_that_holds_and_brakes(panda, fault):
    options = {"braking": 0.1 / DT}
    limited = aj.TorqueLimited(law_of(panda), solver=Faulty(fault), **options)
    measurement, target = infeasible_state(panda)
    measurement = measurement._replace(v=0.5 * measurement.v)
    good = first_answer(aj.TorqueLimited(law_of(panda), **options), measurement, target)
    assert good.limit_status in (aj.LimitStatus.PROOF_KEPT, aj.LimitStatus.PROOF_GIVEN_UP)
    answer = first_answer(limited, measurement, target)
    assert answer.limit_status is aj.LimitStatus.SOLVER_FAILED
    assert np.isfinite(answer.torque).all()
    assert (np.abs(answer.torque) <= panda.effort_limits).all()
    q_dd = Dynamics(panda).forward(measurement.q, measurement.v, answer.torque)
    assert_allclose(q_dd[1:], 0.0, atol=1e-6)
    assert q_dd[0] < -1.0  # it brakes
    assert math.isfinite(answer.slack)


@pytest.mark.parametrize("side", [0, 1])
def test_a_solver_that_fails_beyond_a_joint_limit_leaves_a_torque_that_leads_back(panda, side):
    limited = aj.TorqueLimited(law_of(panda), solver=Faulty("raises"))
    measurement, target = infeasible_state(panda)
    outward = (-1.0, 1.0)[side]
    measurement.q[0] = panda.position_limits[side][0] + 0.1 * outward
    measurement = measurement._replace(v=np.zeros(7))
    answer = first_answer(limited, measurement, target)
    assert answer.limit_status is aj.LimitStatus.SOLVER_FAILED
    assert outward * (answer.torque[0] - Dynamics(panda).g(measurement.q)[0]) < -0.1


@pytest.mark.parametrize("size", [1e100, 1e155, 1e200])
@pytest.mark.parametrize("joints", [True, False])
def test_numbers_that_overflow_keep_no_proof(panda, rng, size, joints):
    """Without a warning: those are errors in these tests."""
    limits = aj.Limits.of(panda) if joints else aj.Limits(effort=20.0)
    limited = aj.TorqueLimited(law_of(panda), limits).guarded(None)
    measurement, target = infeasible_state(panda)
    measurement = measurement._replace(v=size * rng.normal(size=7))
    answer = first_answer(limited, measurement, target)
    assert answer.limit_status in (
        aj.LimitStatus.PROOF_GIVEN_UP,
        aj.LimitStatus.SOLVER_FAILED,
        aj.LimitStatus.INFEASIBLE,
    )
    assert answer.slack > 0.0
    assert (np.abs(answer.torque) <= limited.limits.effort).all()


class FailsTheSecondTime:
    """Solves the first problem of a step, and fails on the one with the proof's row."""

    def __init__(self):
        self.daqp, self.calls = Solver(), 0

    def __call__(self, problem):
        self.calls += 1
        if np.isfinite(problem.row_upper[-1]):
            raise RuntimeError("no")
        return self.daqp.solve(problem)[0]


def test_a_solver_that_fails_on_the_second_problem_of_a_step_loses_nothing(panda, rng):
    solver = FailsTheSecondTime()
    limits = aj.Limits.of(panda, scale=0.5)
    limited = aj.TorqueLimited(law_of(panda), limits, solver=solver)
    twice = 0
    for _ in range(200):
        before = solver.calls
        measurement, target = some_measurement(panda, rng, speed=0.5, error=0.2)
        answer = first_answer(limited, measurement, target)
        assert answer.limit_status is not aj.LimitStatus.SOLVER_FAILED
        if solver.calls == before + 2:
            twice += 1
            assert answer.limit_status is aj.LimitStatus.PROOF_KEPT
    assert twice > 5


# -- around it ----------------------------------------------------------------------------------


def test_copies_have_scratch_memory_of_their_own(panda, rng):
    limited = aj.TorqueLimited(learning(panda), aj.Limits(effort=30.0, rate=5000.0))
    measurement, target = some_measurement(panda, rng, error=1.0)
    state = limited.initial_state(measurement)
    torque = answered(limited, state, measurement, target).torque
    for other in (copy.deepcopy(limited), pickle.loads(pickle.dumps(limited))):
        assert other.controller is not limited.controller
        assert_array_equal(answered(other, state, measurement, target).torque, torque)


def test_a_first_state_has_the_torque_that_holds_the_arm(panda, rng):
    limited = aj.TorqueLimited(learning(panda), aj.Limits(rate=100.0))
    measurement, _ = some_measurement(panda, rng)
    state = limited.initial_state(measurement)
    assert_allclose(
        state[limited.size - 7 : limited.size], Dynamics(panda).g(measurement.q), atol=1e-9
    )


def test_the_first_torque_needs_q(panda):
    limited = aj.TorqueLimited(law_of(panda), aj.Limits(rate=100.0))
    measurement = aj.Measurement(0.0, np.full(7, np.nan), np.zeros(7), np.zeros(3))
    with pytest.raises(MeasurementError, match="must be finite"):
        answered(limited, limited.initial_state(measurement), measurement, np.zeros(3))


def test_options_survive_a_copy(panda):
    limited = aj.TorqueLimited(law_of(panda), proof=False, braking=20.0, solver=Faulty("none"))
    other = copy.deepcopy(limited)
    assert (other.proof, other.braking, other.approach) == (False, 20, 2)
    assert other.solver.fault == "none"


def test_rates_of_braking_may_be_what_sampling_allows(panda):
    assert aj.TorqueLimited(law_of(panda), dt=DT, braking=1.0 / DT).braking == 1.0 / DT
    assert aj.TorqueLimited(law_of(panda), braking=0.5).braking == 0.5
    with pytest.raises(aj.InvalidInputError, match=r"and <= 100") as error:
        aj.TorqueLimited(law_of(panda), dt=DT, braking=1001.0)
    assert error.value.given == 1001.0


@pytest.mark.parametrize(("share", "braking"), [(1e-3, 0.1 / DT), (0.5, None), (100.0, 0.3 / DT)])
def test_without_a_latency_braking_is_as_fast_as_the_laws_own_damping(panda, share, braking):
    """A loop that stands the one stands the other; from 0.1 to 0.3 over dt."""
    gains = aj.default_gains(aj.PositionTask(panda))
    law = law_of(panda, gains=replace(gains, damping=share * np.asarray(gains.damping)))
    if braking is None:
        braking = fastest_mode(panda, law.diagonals.damping)
        assert 0.12 / DT < braking < 0.25 / DT
    assert aj.TorqueLimited(law, dt=DT).braking == pytest.approx(braking, rel=0.2)


def test_braking_is_as_fast_as_the_latency_that_a_law_was_tuned_for_allows(panda):
    task = aj.PositionTask(panda)
    late = aj.Latency(torque_delay=2e-3, velocity_filter=5e-3)
    for latency, lag in ((aj.Latency(), 1e-3), (late, 8e-3)):
        law = aj.SetpointController(task, latency=latency)
        assert aj.TorqueLimited(law, dt=DT).braking == pytest.approx(0.3 / lag)
    assert aj.TorqueLimited(law, dt=2.0 * DT).braking == pytest.approx(0.3 / 9e-3)


def test_only_limits_of_speeds_and_positions_need_their_own_dt(panda, rng):
    measurement, target = some_measurement(panda, rng, speed=0.02, error=0.01)
    looking_ahead = aj.TorqueLimited(law_of(panda), dt=DT)
    state = looking_ahead.initial_state(measurement)
    looking_ahead.step(state, measurement, target, DT * (1.0 + 1e-12))
    with pytest.raises(aj.InvalidInputError, match=r"dt must be that of the controller") as error:
        looking_ahead.step(state, measurement, target, 2.0 * DT)
    assert error.value.given == 2.0 * DT
    aj.TorqueLimited(law_of(panda), effort_only(panda, 1.0), dt=DT).step(
        np.zeros(0), measurement, target, 2.0 * DT
    )


@pytest.mark.parametrize("state", [np.zeros(3), np.full(7, np.nan), "old"])
def test_bad_states_are_refused(panda, rng, state):
    limited = aj.TorqueLimited(law_of(panda), aj.Limits(rate=100.0))
    measurement, target = some_measurement(panda, rng)
    with pytest.raises(aj.InvalidInputError, match="state must"):
        answered(limited, state, measurement, target)


# -- baselines ----------------------------------------------------------------------------------


def test_clipping_clips(panda, rng):
    law = law_of(panda)
    clipped = aj.TorqueLimited(law, effort_only(panda, 0.3), proof=False)
    measurement, target = some_measurement(panda, rng, error=1.0)
    wanted = law.evaluate(np.zeros(0), measurement, target).torque
    answer = first_answer(clipped, measurement, target)
    effort = 0.3 * panda.effort_limits
    assert_array_equal(answer.torque, np.clip(wanted, -effort, effort))
    assert answer.limit_status is aj.LimitStatus.LIMITED
    assert math.isnan(answer.slack)


@pytest.mark.parametrize("proof", [True, False])
def test_absurd_errors_and_postures_do_not_warn(panda, proof):
    """With gains per pixel a torque may be usual where the error or the posture is not."""
    task, q = aj.PositionTask(panda), np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    law = aj.SetpointController(task, aj.Gains(kp=1e-60, kv=1.0, damping=1.0))
    limited = aj.TorqueLimited(law, aj.Limits.of(panda), proof=proof).guarded(None)
    far = q.copy()
    far[6] = -1e308
    for posture, size in ((q, 1e200), (q, 1e60), (far, 1.0)):
        measurement = aj.Measurement(0.0, posture, np.full(7, 0.5), np.array([size, -size, 0.5]))
        answer = answered(limited, limited.initial_state(measurement), measurement, np.zeros(3))
        assert np.isfinite(answer.torque).all()
        assert (np.abs(answer.torque) <= panda.effort_limits).all()


def test_what_others_learn_at_limits_stays_within_bounds(panda, rng):
    """θ̂ at a bound goes no further where joints at a limit do not learn."""
    task, regressor = aj.PositionTask(panda), GravityRegressor(panda)
    bounds = regressor.theta - 0.01, regressor.theta + 0.01
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(regressor, bounds=bounds))
    limited, seen = aj.TorqueLimited(law, aj.Limits.of(panda)), 0
    lower, upper = law.adaptation.bounds
    for _ in range(400):
        measurement, _ = some_measurement(panda, rng, speed=0.1, error=0.2)
        q = measurement.q.copy()
        q[3] = panda.position_limits[1][3] - 0.001
        measurement = measurement._replace(q=q, x=task.value(q))
        target = measurement.x + rng.uniform(-0.05, 0.05, 3)
        state = limited.initial_state(measurement)
        state[:12] = np.where(rng.random(12) < 0.5, lower[:12], upper[:12])
        after, answer = limited.step(state, measurement, target, DT)
        theta_hat, moved = state[:22], after[:22] - state[:22]
        if answer.limit_status is not aj.LimitStatus.PROOF_GIVEN_UP or not moved.any():
            continue
        seen += 1
        size = np.abs(moved).max()
        assert (moved[theta_hat <= lower] >= -1e-9 * size).all()
        assert (moved[theta_hat >= upper] <= 1e-9 * size).all()
    assert seen > 2


def test_solvers_print_nothing(rng, capfd):
    """Nor does the C inside of them, whatever becomes of the problem."""
    robot = ROBOTS["panda"]
    limits = replace(aj.Limits.of(robot, scale=0.2), rate=500.0)
    limited = aj.TorqueLimited(learning(robot), limits).guarded(None)
    statuses = set()
    for size in (0.0, 1.0, 1e3, 1e9):
        for _ in range(5):
            measurement, target = some_measurement(robot, rng, speed=size, error=size)
            statuses.add(first_answer(limited, measurement, target).limit_status)
    assert len(statuses) > 1
    assert capfd.readouterr() == ("", "")
