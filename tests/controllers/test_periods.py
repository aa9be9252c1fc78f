"""Limits, holds and the tracking law at other periods than a millisecond."""

import functools
import math

import numpy as np
import pytest
from heavy_arms import HeavyArm
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import linprog

import approxjac as aj
from approxjac import Status
from approxjac.controllers import (
    AdaptiveDynamics,
    KnownKinematics,
    Latency,
    ModelGravity,
    NoGravity,
    PredictedMeasurement,
    TrackingGains,
)
from approxjac.robots import Dynamics

PERIODS = (0.5e-3, 2e-3, 5e-3)
LOST = np.full(3, np.nan)


@functools.cache
def heavy(name):
    return HeavyArm(name)


@pytest.fixture(params=PERIODS, ids=lambda dt: f"{1e3 * dt:g}ms")
def dt(request):
    return request.param


# for runs of many steps: a longer period is soon done, and shows what depends on it
OF_RUNS = pytest.mark.parametrize(
    "dt",
    [pytest.param(dt, marks=[] if dt == 5e-3 else pytest.mark.study) for dt in PERIODS],
    indirect=True,
    ids=lambda dt: f"{1e3 * dt:g}ms",
)


@pytest.fixture(params=["panda", "three_joint"])
def arm(request):
    return heavy(request.param)


def law_for(arm, dt, gravity=None, **options):
    """A law that is as fast as the period allows, with the true arm's weight."""
    gravity = ModelGravity(arm.truth) if gravity is None else gravity
    return aj.SetpointController(arm.task, latency=Latency(dt), gravity=gravity, **options)


def measured(arm, q, v=None, t=0.0):
    v = np.zeros(arm.bare.nv) if v is None else v
    return aj.Measurement(t, q, v, arm.sensor.value(q))


# -- the rate of torques --------------------------------------------------------------------------


@pytest.mark.parametrize("looks_ahead", [False, True])
def test_torques_change_by_the_rate_times_the_period(arm, dt, looks_ahead):
    """By no more in any step, and by all of it where the law asks for more."""
    rate, effort = 300.0, 5.0 * np.abs(Dynamics(arm.truth).g(arm.q)) + 30.0
    velocity = 2.0 if looks_ahead else None
    limited = aj.TorqueLimited(
        law_for(arm, dt), aj.Limits(effort=effort, rate=rate, velocity=velocity), dt=dt
    )
    x_d = arm.sensor.value(arm.q) + 0.1
    run = aj.simulate(arm.plant, limited, x_d[: arm.task.m], arm.q, 40 * dt, dt=dt)
    hold = ModelGravity(arm.truth).torque(arm.q)
    torques = np.concatenate([[hold], run.tau])  # the first step starts from what holds the arm
    steps = np.abs(np.diff(torques, axis=0))[:-1]
    assert steps.max() <= rate * dt * (1.0 + 1e-9)
    assert steps.max() >= 0.999 * rate * dt
    assert (np.abs(run.tau) <= effort).all()


def test_the_torque_before_counts_within_the_efforts(arm, dt):
    """A state may come from a run with other motors: it is brought into these first."""
    effort, rate = np.abs(Dynamics(arm.truth).g(arm.q)) + 2.0, 100.0
    limits = aj.Limits(effort=effort, rate=rate)
    limited = aj.TorqueLimited(law_for(arm, dt), limits, dt=dt, proof=False)
    now = measured(arm, arm.q)
    state = limited.initial_state(now)
    state[limited.size - arm.bare.nv : limited.size] = 10.0 * effort
    x_d = now.x - 5.0
    _, answer = limited.step(state, now, x_d, dt)
    wanted = limited.controller.evaluate(np.zeros(0), now, x_d).torque
    assert (wanted < effort - rate * dt).any()
    assert_allclose(answer.torque, np.clip(wanted, effort - rate * dt, effort))


# -- speeds and positions -------------------------------------------------------------------------


@OF_RUNS
@pytest.mark.parametrize("gravity", ["known", "learnt"])
def test_speeds_stay_within_their_limits(arm, dt, gravity):
    """With enough torque; learnt weight is wrong by a tool, which periods show."""
    learns = gravity == "learnt"
    source = aj.AdaptiveGravity(arm.belief) if learns else ModelGravity(arm.belief)
    fastest, plant = 0.4, arm.plant if learns else aj.Plant(arm.belief, arm.task)
    law = aj.SetpointController(
        arm.task, latency=Latency(dt), gravity=source, saturation=aj.law.Linear()
    )
    limited = aj.TorqueLimited(law, aj.Limits(velocity=fastest), dt=dt)
    assert limited.dt == dt
    x_d = plant.sensor.value(arm.q) + np.array([0.15, -0.25, -0.15])
    run = aj.simulate(
        plant,
        limited,
        x_d,
        arm.q,
        0.4,
        dt=dt,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    late = run.t > 0.3  # what the belief lacks shows late
    assert np.abs(run.v[late]).max() <= fastest * (1.05 if learns else 1.0 + 1e-3)
    assert np.abs(run.v).max() <= fastest * (1.4 if learns else 1.0 + 1e-3)
    assert np.abs(run.v).max() > 0.9 * fastest
    assert run.error_norm[-1] < run.error_norm[0]


@pytest.mark.parametrize("excess", [0.5, -0.5])
def test_the_way_to_a_limit_of_speed_is_gone_by_the_share_that_braking_allows(arm, dt, excess):
    """Over one step, by Pinocchio: of what is left at most braking·dt, from beyond at least."""
    fastest, v = 0.5, np.zeros(arm.bare.nv)
    v[1] = fastest * (1.0 + 0.2 * np.sign(excess))
    law = law_for(arm, dt, saturation=aj.law.Linear())
    limited = aj.TorqueLimited(law, aj.Limits(velocity=fastest), dt=dt)
    now = measured(arm, arm.q, v)
    # a force that accelerates this joint, so large that the law asks for more than it may
    x_d = now.x + 100.0 * arm.task.jacobian(arm.q) @ Dynamics(arm.belief).M_inv(arm.q)[:, 1]
    answer = limited.step(limited.initial_state(now), now, x_d, dt)[1]
    wanted = law.evaluate(np.zeros(0), now, x_d).torque
    weightless = Dynamics(arm.belief.with_gravity((0.0, 0.0, 0.0)))
    held = ModelGravity(arm.truth).torque(arm.q)
    asked, given = (weightless.forward(arm.q, v, tau - held) for tau in (wanted, answer.torque))
    ahead, share = v + dt * given, limited.braking * dt
    assert 0.0 < share <= 0.31
    low, high = (v + share * (side - v) for side in (-fastest, fastest))
    assert v[1] + dt * asked[1] > high[1]  # the law would go further
    assert (ahead <= high + 1e-6).all()
    assert (ahead >= low - 1e-6).all()
    assert ((ahead > high - 1e-6) | (ahead < low + 1e-6)).any()  # and it brakes no more


@OF_RUNS
def test_a_joint_comes_to_its_limit_no_faster_than_it_may(arm, dt):
    """At a distance d with κd, and never through it, while the law pulls on.

    Speeds go to their bound at the rate `braking`, r, and so are behind one that falls as
    exp(−κt): by r/(r − κ).
    """
    joint, law = 1, law_for(arm, dt, gravity=ModelGravity(arm.belief))
    low, high = arm.q - 2.5, arm.q + 2.5
    high[joint] = arm.q[joint] + 0.06
    limited = aj.TorqueLimited(law, aj.Limits(position=(low, high)), dt=dt)
    plant = aj.Plant(arm.belief, arm.task, joint_limits=False)
    x_d = arm.task.value(arm.q) + 0.3 * arm.task.jacobian(arm.q)[:, joint]
    run = aj.simulate(
        plant,
        limited,
        x_d,
        arm.q,
        0.6,
        dt=dt,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    left = high[joint] - run.q[:, joint]
    assert left.min() > -1e-9
    assert left.min() < 0.02
    towards = run.v[1:, joint]  # of the step that began with what was left before
    assert limited.approach == 0.1 * limited.braking
    behind = limited.braking / (limited.braking - limited.approach)
    assert (towards <= behind * limited.approach * left[:-1] * (1.0 + 1e-3) + 1e-9).all()
    assert (towards > 0.9 * limited.approach * left[:-1]).any()


def test_what_is_beyond_a_limit_has_its_status(arm, dt):
    """Of speed by more than 0.1 %, of position by more than 1 mrad; the torque is the law's."""
    n = arm.bare.nv
    law = law_for(arm, dt, gains=aj.Gains(20.0, 5.0, 2.0))
    for beyond, expected in ((0.9, aj.LimitStatus.FREE), (1.1, aj.LimitStatus.EXCEEDED)):
        for kind in ("velocity", "position"):
            q, v, back = arm.q.copy(), np.zeros(n), np.zeros(n)
            back[0] = 1.0
            if kind == "velocity":
                limits = aj.Limits(velocity=0.3)
                v[0] = 0.3 * (1.0 + 1e-3 * beyond)
            else:
                limits = aj.Limits(position=(q - 3.0, q + np.where(back > 0.0, 0.0, 3.0)))
                q = q + 1e-3 * beyond * back
                v[0] = -0.05
            limited = aj.TorqueLimited(law, limits, dt=dt, braking=20.0)
            now = measured(arm, q, v)
            answer = limited.step(limited.initial_state(now), now, now.x, dt)[1]
            assert_array_equal(answer.torque, law.evaluate(np.zeros(0), now, now.x).torque)
            assert answer.limit_status is expected, kind


def test_braking_is_of_the_period(dt):
    """0.3 over dt and the delays that the law knows; 0.1/dt where torques change slowly."""
    arm = heavy("three_joint")
    law = law_for(arm, dt)
    limits = aj.Limits(effort=50.0)
    assert_allclose(aj.TorqueLimited(law, limits, dt=dt).braking, 0.3 / dt)
    late = aj.SetpointController(arm.task, latency=Latency(dt, 3e-3, 4e-3))
    assert_allclose(aj.TorqueLimited(late, limits, dt=dt).braking, 0.3 / (dt + 7e-3))
    slow = aj.SetpointController(arm.task, aj.Gains(1.0, 1.0, 1e-3))
    for changes in (limits, aj.Limits(effort=50.0, rate=100.0)):
        assert_allclose(aj.TorqueLimited(slow, changes, dt=dt).braking, 0.1 / dt)
    fast = aj.SetpointController(arm.task, aj.Gains(100.0, 100.0, 1e3))
    assert_allclose(aj.TorqueLimited(fast, limits, dt=dt).braking, 0.3 / dt)


# -- where nothing keeps all limits ---------------------------------------------------------------


def too_fast(seed, dt, hurried):
    """A Panda whose motors are too weak for how fast some of its joints are, without weight."""
    arm, rng = aj.load_robot("panda").with_gravity((0.0, 0.0, 0.0)), np.random.default_rng(seed)
    q = arm.random_configuration(rng)
    v = rng.uniform(-0.5, 0.5, 7)
    v[hurried] = rng.choice([-1.0, 1.0], len(hurried)) * rng.uniform(2.0, 4.0, len(hurried))
    task = aj.PositionTask(arm)
    law = aj.SetpointController(task, aj.Gains(100.0, 20.0, 1.0), gravity=NoGravity(arm))
    effort = 0.1 * arm.effort_limits
    limited = aj.TorqueLimited(law, aj.Limits(effort=effort, velocity=1.0), dt=dt)
    now = aj.Measurement(0.0, q, v, task.value(q))
    answer = limited.step(limited.initial_state(now), now, now.x, dt)[1]
    M_inv = np.linalg.inv(Dynamics(arm).M(q))
    without = Dynamics(arm).forward(q, v, np.zeros(7))
    bounds = limited.braking * (-1.0 - v), limited.braking * (1.0 - v)
    return answer, M_inv, without, bounds, effort


@OF_RUNS
@pytest.mark.parametrize("hurried", [[0], [1, 3], [5, 0]])
def test_joints_that_need_it_most_are_braked_first_and_the_others_kept(dt, hurried):
    """Independently, by linear programs: which joints can be kept, and how near the first comes.

    The joint that lacks most counts as one that cannot be kept, then the two that do, until there
    is a torque; all others keep their bounds.
    """
    infeasible, alone = 0, 0
    for seed in range(5):
        answer, M_inv, without, (low, high), effort = too_fast(seed, dt, hurried)
        if answer.limit_status is not aj.LimitStatus.INFEASIBLE:
            continue
        infeasible += 1
        wanted = np.clip(0.0, low, high)
        order = np.argsort(-np.abs(wanted) / (np.abs(M_inv) @ effort))
        sides = np.column_stack([-effort, effort])

        def possible(released, M_inv=M_inv, without=without, low=low, high=high, sides=sides):
            kept = np.setdiff1d(np.arange(7), released)
            A = np.concatenate([M_inv[kept], -M_inv[kept]])
            b = np.concatenate([(high - without)[kept], -(low - without)[kept]])
            return A, b, linprog(np.zeros(7), A_ub=A, b_ub=b, bounds=sides).status == 0

        count = next(k for k in range(1, 8) if possible(order[:k])[2])
        released = order[:count]
        q_dd = without + M_inv @ answer.torque
        kept = np.setdiff1d(np.arange(7), released)
        off = 1e-4 * np.abs(q_dd).max()
        assert (q_dd[kept] >= low[kept] - off).all()
        assert (q_dd[kept] <= high[kept] + off).all()
        assert (np.abs(answer.torque) <= effort).all()
        if count > 1:
            continue
        alone += 1
        # of the braking that this joint could have beyond none, with the others kept
        first, A, b = order[0], *possible(released)[:2]
        sign = np.sign(wanted[first])
        best = linprog(-sign * M_inv[first], A_ub=A, b_ub=b, bounds=sides)
        most = sign * (without[first] + M_inv[first] @ best.x)
        nearest = min(most, abs(wanted[first]))
        assert sign * q_dd[first] > nearest - 0.2 * abs(nearest)
    assert infeasible > 2
    assert alone > 1 or len(hurried) > 1


# -- holds ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("inside", ["law", "limited", "learning"])
def test_an_x_is_too_old_once_the_image_must_have_moved(arm, dt, inside):
    """At a constant Ĵq̇, after unseen/(|Ĵq̇| dt) steps, of whatever length; at equality not yet."""
    n = arm.bare.nv
    controller = arm.learning if inside == "learning" else law_for(arm, dt)
    if inside == "limited":
        controller = aj.TorqueLimited(controller, aj.Limits(effort=80.0), dt=dt)
    v = 0.2 * np.cos(np.arange(n))
    speeds = np.abs(arm.task.jacobian(arm.q) @ v)
    fastest = int(speeds.argmax())
    p, steps = 0.0, 7
    rate = float((arm.task.jacobian(arm.q) @ v)[fastest])
    for _ in range(steps):
        p += dt * rate
    for unseen, bridged in ((abs(p), steps), (abs(p) * (1.0 - 1e-9), steps - 1)):
        held = aj.HeldMeasurement(controller, unseen).guarded(None)  # it moves, and q stays
        seen = measured(arm, arm.q, v)
        state, lost = held.initial_state(seen), 0
        answers = []
        for k in range(steps + 3):
            x = seen.x if k == 0 else np.full(arm.task.m, np.nan)
            state, answer = held.step(state, seen._replace(t=k * dt, x=x), seen.x + 0.05, dt)
            answers.append(answer)
        # the step that sees x counts its own motion, so that as many follow
        statuses = [answer.status for answer in answers]
        assert statuses[0] is not Status.MEASUREMENT_HELD
        assert statuses[1 : 1 + bridged] == [Status.MEASUREMENT_HELD] * bridged
        assert set(statuses[1 + bridged :]) == {Status.MEASUREMENT_LOST}
        lost = np.isnan(answers[-1].e)
        assert lost.all()
        assert_allclose(answers[bridged].e, -0.05, atol=1e-12)
        if inside != "learning":  # which goes on
            assert_array_equal(answers[bridged].torque, answers[1].torque)


@OF_RUNS
def test_a_held_law_stops_on_time_in_a_run(dt):
    """A camera that hangs: the believed motion since the last frame is `unseen`, and a step."""
    arm = heavy("three_joint")
    held = aj.HeldMeasurement(law_for(arm, dt), unseen=0.02)
    sensing = aj.Sensing(x_rate=1.0 / (4 * dt), x_frozen=[(20 * dt, 10.0)])
    plant = aj.Plant(arm.truth, arm.sensor, sensing=sensing)
    x_d = arm.sensor.value(arm.q) + np.array([0.0, 0.25, -0.15])
    run = aj.simulate(
        plant,
        held,
        x_d,
        arm.q,
        0.6,
        dt=dt,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    lost = np.flatnonzero(run.status == Status.MEASUREMENT_LOST)
    assert len(lost) > 10
    first = lost[0]
    assert (run.status[first:] == Status.MEASUREMENT_LOST).all()
    fresh = np.flatnonzero(np.abs(np.diff(run.x_measured, axis=0)).max(axis=1) > 0.0)[-1] + 1
    rates = np.array([arm.task.jacobian(q) @ v for q, v in zip(run.q, run.v, strict=True)])
    moved = dt * np.abs(np.cumsum(rates[fresh:], axis=0)).max(axis=1)
    assert moved[first - fresh - 1] > 0.02
    assert moved[first - fresh - 2] <= 0.02
    assert np.linalg.norm(run.v[-1]) < 0.3 * np.linalg.norm(run.v[first])


# -- learning -------------------------------------------------------------------------------------


def test_what_is_learnt_in_a_step_is_the_rate_times_the_period(arm, dt):
    """Free and where the proof is kept; of a limiter that gives it up, of joints at no limit."""
    theta = arm.theta
    rng, free, kept = np.random.default_rng(3), 0, 0
    g = np.abs(Dynamics(arm.truth).g(arm.q))
    limited = aj.TorqueLimited(arm.learning, aj.Limits(effort=1.2 * g + 3.0), dt=dt)
    for _ in range(30):
        q, v = arm.q + 0.1 * rng.normal(size=len(g)), 0.3 * rng.normal(size=len(g))
        now, x_d = measured(arm, q, v), arm.sensor.value(q) + 0.02 * rng.normal(size=arm.task.m)
        after, answer = limited.step(theta.copy(), now, x_d, dt)
        J_hat = arm.task.jacobian(q)
        y = v + 0.5 * np.linalg.pinv(J_hat) @ (now.x - x_d)
        rate = -0.05 * arm.learning.adaptation.regressor.Z(q).T @ y
        if answer.limit_status in (aj.LimitStatus.FREE, aj.LimitStatus.PROOF_KEPT):
            assert_allclose(after - theta, dt * rate, rtol=1e-6, atol=1e-12)
            free += answer.limit_status is aj.LimitStatus.FREE
            kept += answer.limit_status is aj.LimitStatus.PROOF_KEPT
    assert free
    assert kept


# -- the tracking law -----------------------------------------------------------------------------


def tracking(arm, dt, **options):
    return aj.TrackingController(arm.task, kinematics=KnownKinematics(arm.task), dt=dt, **options)


def test_the_tracking_gain_is_as_large_as_the_period_allows(arm, dt):
    assert tracking(arm, dt).kappa == min(60.0, 0.25 / dt)
    assert tracking(arm, dt).dt == dt


def test_the_reference_is_no_faster_than_joints_may_move(arm, dt):
    """Nine tenths of the URDF's speeds, of all joints by the same factor."""
    law = tracking(arm, dt, gains=TrackingGains(self_motion=0.0, speed=100.0))
    now = measured(arm, arm.q)
    seen = []
    for far in (0.01, 1.0, 5.0):
        state = law.initial_state(now)
        x_d = arm.task.value(arm.q) + far * np.ones(3)
        reference = law.step(state, now, x_d, dt)[1].reference
        share = np.abs(reference) / arm.bare.velocity_limits
        assert share.max() <= 0.9 * (1.0 + 1e-9)
        seen.append((share.max(), reference / np.linalg.norm(reference)))
    assert_allclose(seen[-1][0], 0.9)
    assert_allclose(seen[0][1], seen[-1][1], atol=0.05)


@OF_RUNS
def test_a_circle_is_followed_at_any_period(dt):
    """With the tool's weight unknown: learnt while it moves."""
    arm = heavy("three_joint")
    truth = arm.bare.with_object(0.0, 0.3)
    plant = aj.Plant(truth, arm.task.on(truth))
    controller = tracking(arm, dt)
    path = aj.Circle(arm.task.value(arm.q) + [0.0, 0.0, 0.02], 0.04, 1.6, normal=(0.0, 1.0, 0.5))
    run = aj.simulate(plant, controller, path, arm.q, 1.6, dt=dt)
    assert run.error_norm[run.t > 1.2].max() < 4e-3
    assert run.error_norm.max() <= run.error_norm[0] + 2e-3
    assert set(run.status) == {Status.OK}


def test_dynamics_learn_by_the_period(arm, dt):
    """â' = −ΓY_dᵀσ over dt: twice as much in twice the time."""
    gains, dynamics = TrackingGains(kappa=20.0), AdaptiveDynamics(arm.belief)
    controllers = [tracking(arm, k * dt, gains=gains, dynamics=dynamics) for k in (1, 2)]
    v = 0.1 * np.sin(np.arange(arm.bare.nv))
    now = measured(arm, arm.q, v)
    moved = []
    for k, controller in enumerate(controllers):
        state = controller.initial_state(now)
        after, answer = controller.step(state, now, now.x + 0.02, (k + 1) * dt)
        moved.append((after - state)[: controller.resting])
        assert answer.status is Status.OK
    size = np.abs(moved[0]).max()
    inside = np.abs(moved[1]) > 1e-9 * size  # friction stays at its bound of zero
    assert inside.any()
    assert_allclose(moved[1][inside], 2.0 * moved[0][inside], rtol=1e-6, atol=1e-9 * size)


@pytest.mark.parametrize("share", [0.5, 0.6])
def test_a_gain_that_leaves_no_room_for_rotors_adds_none(arm, dt, share):
    """κ dt beyond what M̂ alone allows: the gain is κM̂, and nothing is divided by zero."""
    controller = tracking(arm, dt, gains=TrackingGains(kappa=share / dt))
    assert not controller.dynamics.gain_inertia(1.0).any()
    now = measured(arm, arm.q, np.zeros(arm.bare.nv))
    _, answer = controller.step(controller.initial_state(now), now, now.x, dt)
    assert answer.status is Status.OK


class Unseeing(KnownKinematics):
    """Kinematics that predict nothing."""

    def predict(self, state, q, v, target):
        return super().predict(state, q, v, target)._replace(z=np.full(self.task.m, np.nan))


def test_without_a_prediction_the_dynamics_rest_and_the_joints_are_braked(arm, dt):
    controller = aj.TrackingController(arm.task, kinematics=Unseeing(arm.task), dt=dt)
    v = 0.3 * np.cos(np.arange(arm.bare.nv))
    now = measured(arm, arm.q, v)
    state = controller.initial_state(now)
    after, answer = controller.step(state, now, now.x + 0.1, dt)
    assert answer.status is Status.NOT_PREDICTED
    assert_array_equal(answer.reference, 0.0)
    assert_array_equal(after[: controller.resting], state[: controller.resting])
    # σ = q̇: power is taken from the motion, by the gain and by what holds the arm alone
    braking = answer.torque - Dynamics(arm.belief).g(arm.q)
    assert v @ braking < -0.5 * controller.kappa * v @ Dynamics(arm.belief).M(arm.q) @ v


def test_where_x_is_lost_the_dynamics_go_on_as_with_it(arm, dt):
    """Known kinematics predict without x: the same torque, and the same is learnt."""
    controller = tracking(arm, dt)
    now = measured(arm, arm.q, 0.1 * np.ones(arm.bare.nv))
    state = controller.initial_state(now)
    after, seen = controller.step(state, now, now.x + 0.05, dt)
    blind, lost = controller.step(state, now._replace(x=np.nan * now.x), now.x + 0.05, dt)
    assert (seen.status, lost.status) == (Status.OK, Status.PREDICTED)
    assert_array_equal(seen.torque, lost.torque)
    n = controller.size
    assert_array_equal(after[:n], blind[:n])
    assert (after[:n] != state[:n]).any()


def test_before_x_was_seen_the_joints_are_held_still_and_their_weight_is_learnt(arm, dt):
    """Kinematics that learn have nothing to go by: q̇_r = 0, and â' = −ΓY_dᵀq̇ goes on."""
    controller = aj.TrackingController(arm.task, dt=dt)
    v = 0.05 * np.cos(np.arange(arm.bare.nv))
    now = measured(arm, arm.q, v)._replace(x=LOST)
    state = controller.initial_state(now)
    after, answer = controller.step(state, now, arm.sensor.value(arm.q), dt)
    assert answer.status is Status.MEASUREMENT_LOST
    assert_array_equal(answer.reference, 0.0)
    p = controller.resting
    assert (after[:p] != state[:p]).any()


# -- what is predicted ----------------------------------------------------------------------------


def test_the_next_run_begins_with_the_weight_that_was_learnt(dt):
    """By the law inside, beside what the kinematics know."""
    arm = heavy("three_joint")
    kinematics = aj.AdaptiveKinematics(arm.task, unknown=("tool",), dt=dt)
    law = aj.SetpointController(arm.task, gravity=aj.AdaptiveGravity(arm.belief))
    controller = PredictedMeasurement(law, kinematics)
    now = measured(arm, arm.q, 0.1 * np.ones(3))._replace(t_x=0.0)
    first = controller.initial_state(now)
    state = first
    for k in range(20):
        later = now._replace(t=k * dt, t_x=k * dt)
        state, _ = controller.step(state, later, now.x + 0.02, dt)
    p = len(law.adaptation.theta0)
    learnt = controller.learnt(state)[:p]
    assert np.abs(learnt - controller.learnt(first)[:p]).max() > 1e-4
    assert_array_equal(controller.learnt(controller.resumed(state, now))[:p], learnt)


@OF_RUNS
def test_a_predicted_measurement_is_learnt_from_period_by_period(dt):
    """The same law on x̂ at any period: a tool of 10 cm that nobody told of is found."""
    arm = heavy("three_joint")
    kinematics = aj.AdaptiveKinematics(arm.task, unknown=("tool",), dt=dt, noise=1e-4)
    controller = PredictedMeasurement(law_for(arm, dt), kinematics)
    x_d = arm.sensor.value(arm.q) + np.array([0.05, 0.1, -0.05])
    run = aj.simulate(arm.plant, controller, x_d, arm.q, 1.2, dt=dt, record_every=5 * dt)
    assert run.error_norm[-1] < 5e-3
    report = controller.kinematics_learnt(run.state[-1])
    assert report is not None
    assert math.isfinite(float(run.tau.max()))
    lost = measured(arm, arm.q)._replace(x=LOST)
    first = controller.initial_state(lost)
    assert controller.step(first, lost, x_d, dt)[1].status is Status.MEASUREMENT_LOST
    state = run.state[-1]
    later = lost._replace(t=run.t[-1] + dt)
    assert controller.step(state, later, x_d, dt)[1].status is Status.PREDICTED
