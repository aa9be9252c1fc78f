"""Certificates, limits and certified starts of arms that gravity pulls at, known and learnt."""

import dataclasses
import functools

import numpy as np
import pinocchio as pin
import pytest
from heavy_arms import NAMES, HeavyArm
from numpy.testing import assert_allclose
from tests.stability.periods import radii

import approxjac as aj
from approxjac.controllers import Latency, ModelGravity
from approxjac.law import sampled_form
from approxjac.robots import Dynamics, GravityRegressor
from approxjac.stability import local_stability
from approxjac.stability.certificates.certificate import RESERVE, effort_room
from approxjac.stability.certificates.matrix_form import Hold, MatrixForm


@functools.cache
def heavy(name):
    return HeavyArm(name)


# more joints take longer, and seven of them are certified in other files, too
ARMS = [pytest.param(name, marks=[] if name == "two_link" else pytest.mark.study) for name in NAMES]


@pytest.fixture(params=ARMS)
def arm(request):
    return heavy(request.param)


# -- certificates ---------------------------------------------------------------------------------


@pytest.mark.parametrize("gravity", ["known", "learnt"])
def test_V_falls_by_the_margin_at_least_along_the_true_dynamics(arm, gravity):
    """V̇ ≤ −μ(q̇ᵀDq̇ + eᵀsym(K_pĴG)e) of the certified V, by finite differences of V.

    Where gravity is learnt, V has ½ΔθᵀL⁻¹Δθ, and θ̂ is anywhere.
    """
    learns = gravity == "learnt"
    controller = arm.learning if learns else arm.known
    report = arm.learnt_report if learns else arm.report
    assert report.passed
    assert report.is_sampled != learns
    weights, samples = report.test.weights, report.test.form.samples
    in_time = MatrixForm(samples, report.loop.setting).margins(weights)
    assert (in_time >= report.test.margins - 1e-12).all()
    rng, tightest = np.random.default_rng(0), np.inf
    theta = arm.theta if learns else np.zeros(0)
    for k in range(0, len(samples), 2):
        q, x_d = samples.q[k], samples.x_d[k]
        v = rng.normal(size=len(q)) * 10.0 ** rng.uniform(-3.0, 0.0)
        state = theta + rng.normal(size=len(theta))
        measurement = aj.Measurement(0.0, q, v, arm.sensor.value(q))
        answer = controller.evaluate(state, measurement, x_d)
        assert answer.status is aj.Status.OK
        acceleration = arm.plant.acceleration(q, v, answer.torque)
        rate = answer.state_rate

        def V(t, q=q, v=v, a=acceleration, x_d=x_d, state=state, rate=rate):
            there = pin.integrate(arm.truth.model, q, t * v + 0.5 * t * t * a)
            apart = state + t * rate - theta if learns else np.zeros(1)
            return arm.V(weights, there, v + t * a, x_d) + 0.5 * apart @ apart / 0.05

        h = 1e-6
        V_dot = (V(h) - V(-h)) / (2.0 * h)
        J_hat, e = arm.task.jacobian(q), measurement.x - x_d
        D = J_hat.T * arm.kv @ J_hat + arm.damping * np.eye(len(v))
        size = v @ D @ v + arm.kp * e @ (J_hat @ arm.cross_weight(weights, q) @ e)
        assert V_dot <= -in_time[k] * size + 1e-6 * (1.0 + V(0.0)) + 1e-4 * size
        if size > 1e-3:
            tightest = min(tightest, -V_dot / size)
    assert tightest < 1.2  # the designed dissipation, or there were nothing to see


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("period", [pytest.param(0.5e-3, marks=pytest.mark.study), 2e-3])
def test_motions_from_the_level_are_as_slow_as_assumed_and_end_at_the_target(name, period):
    """Of the loop that runs: from any state with V = c, √(q̇ᵀMq̇) stays below v̄, and V below c.

    V may rise for a period, and at the samples of the whole motion it never passes what it was.
    """
    arm, rng = heavy(name), np.random.default_rng(3)
    report = arm.report_of(arm.known, configurations=20, latency=Latency(period))
    test = report.test
    assert report.passed
    assert test.latency.period == period
    assert 0.0 < test.level <= 0.5 * test.speed**2
    q, x_d = arm.q, arm.sensor.value(arm.q)
    v0, e0 = rng.normal(size=len(q)), 0.01 * rng.normal(size=len(x_d))
    # V is nearly quadratic: so large that both begin far below the level, and the arm stays near
    size = np.sqrt(1e-3 * test.level / arm.V(test.weights, q, v0, x_d - e0))
    x_d, v0 = x_d - size * e0, size * v0
    V0 = arm.V(test.weights, q, v0, x_d)
    run = aj.simulate(
        arm.plant,
        arm.known,
        x_d,
        aj.simulation.InitialState(q, v0=v0),
        0.8,
        dt=period,
        record_every=5 * period,
    )
    V = np.array([arm.V(test.weights, *at, x_d) for at in zip(run.q, run.v, strict=True)])
    M = np.array([arm.plant.dynamics.M(at) for at in run.q])
    speeds = np.sqrt(np.einsum("ni,nij,nj->n", run.v, M, run.v))
    # c is (1 − σ²)/2 v̄², so of this V(0) the bound is in proportion
    assert speeds.max() <= test.speed * np.sqrt(V0 / test.level)
    assert V.max() <= V0 * (1.0 + 1e-9)
    assert V[-1] < 0.3 * V0


def test_the_level_is_that_of_the_slowest_bound(arm):
    """At every sample: max |q̇|_M over V ≤ c is at most v̄, and v̄ at the worst of them."""
    test, samples = arm.report.test, arm.report.test.form.samples
    G = np.array([arm.cross_weight(test.weights, q) for q in samples.q])
    W = np.diag(test.weights.w) + test.weights.coupling * np.ones((len(test.weights.w),) * 2)
    fastest = []
    for M, each in zip(samples.M, G, strict=True):
        n = len(M)
        P = np.block([[M, M @ each], [each.T @ M, W]])
        # max zᵀKz over ½zᵀPz ≤ c, K the kinetic block
        block = np.linalg.inv(P)[:n, :n]
        fastest.append(2.0 * test.level * np.linalg.eigvals(block @ M).real.max())
    assert_allclose(np.sqrt(max(fastest)), test.speed, rtol=1e-6)


@pytest.mark.parametrize("dt", [0.5e-3, 2e-3, 5e-3])
@pytest.mark.parametrize("name", ["two_link", pytest.param("three_joint", marks=pytest.mark.study)])
@pytest.mark.parametrize("gravity", ["known", "learnt"])
def test_spectral_radii_are_those_of_the_simulated_steps(name, dt, gravity):
    """The multipliers of the map of one step of `simulate`, by differences, near a target."""
    arm = heavy(name)
    learns, q = gravity == "learnt", arm.q
    controller = arm.learning if learns else arm.known
    x_d = arm.sensor.value(q)
    fastest = spectral_radius(arm.plant, controller, x_d, q, dt, arm.theta if learns else None)
    report = arm.report_of(controller, configurations=20)
    loop = report.loop
    at = loop.samples_at(np.zeros(1, dtype=int), q[None], x_d[None])
    found = radii(loop, at, Latency(dt))
    assert len(found) == 1
    assert_allclose(1.0 - found[0], 1.0 - fastest, rtol=0.02)


@pytest.mark.parametrize("heavier", ["truth", "belief"])
def test_weight_that_is_wrong_to_either_side_is_no_equilibrium(heavier):
    """Of an arm whose joints gravity pulls at to one side only."""
    arm = heavy("three_joint")
    plant, other = aj.Plant(arm.truth, arm.sensor), arm.belief
    if heavier == "belief":
        plant, other = aj.Plant(arm.belief, arm.task), arm.truth
    law = aj.SetpointController(arm.task, arm.gains, gravity=ModelGravity(other))
    with pytest.raises(aj.InvalidInputError):
        local_stability(plant, law, arm.q)
    exact = aj.SetpointController(arm.task, arm.gains, gravity=ModelGravity(plant.robot))
    assert local_stability(plant, exact, arm.q).stable
    learnt = aj.SetpointController(
        arm.task, arm.gains, gravity=aj.AdaptiveGravity(other, L=0.1, torque_limits=np.inf)
    )
    assert local_stability(plant, learnt, arm.q).stable


@pytest.mark.parametrize("late", [0.0, 0.7, 3.0])
@pytest.mark.parametrize("age", [None, 0.0, 2.0])
def test_what_acts_is_out_of_date_by_the_period_and_all_delays(late, age):
    """Longest ages of the torque that acts, and of the x in it, counted out; in periods."""
    frames = {} if age is None else {"image_period": 3.0, "image_age": age}
    hold = Hold.of(Latency(1.0, torque_delay=late, **frames))
    t = np.linspace(20.0, 40.0, 20001)[:-1]
    sampled = np.floor(t - late)  # when the torque that acts was computed
    assert_allclose((t - sampled).max(), hold.span, atol=2e-3)
    if age is not None:
        taken = 3.0 * np.floor((sampled - age) / 3.0)
        assert (t - taken).max() <= hold.age + 1e-9


# -- weight that is held for a period -------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [*(pytest.param(k, marks=pytest.mark.study) for k in ("panda", "ur5")), "three_joint"],
)
def test_the_rate_of_the_torque_has_that_of_the_weight(name):
    """u̇ of u = −Ĵᵀ K_p e − D_c q̇ + g along the true motion, by differences; slow, so that
    what is quadratic in q̇ is nothing.
    """
    arm, rng = heavy(name), np.random.default_rng(6)
    samples = arm.report.samples.take(np.arange(6))
    dg = samples.dg
    n, kp = arm.bare.nv, np.full(arm.task.m, arm.kp)
    J_hat = samples.J_hat
    D = J_hat.mT @ (arm.kv * J_hat) + arm.damping * np.eye(n)
    rate = sampled_form.torque_rate(
        samples.M, D, D, J_hat, samples.dJ_hat, samples.J_e, samples.s, samples.slope, kp, dg
    )
    for k in range(len(samples)):
        q, x_d, v = samples.q[k], samples.x_d[k], 1e-4 * rng.normal(size=n)
        w = 1e-2 * rng.normal(size=n)

        def torque(q, v, x_d=x_d):
            J = arm.task.jacobian(q)
            force = arm.kp * (arm.sensor.value(q) - x_d) + arm.kv * (J @ v)
            return -J.T @ force - arm.damping * v + weight_of(arm, q)

        a = arm.plant.acceleration(q, v, torque(q, v) + w)
        h = 1e-4
        there, back = ((q + t * v + 0.5 * t * t * a, v + t * a) for t in (h, -h))
        u_dot = (torque(*there) - torque(*back)) / (2.0 * h)
        found = rate.T[k] @ np.concatenate([v, samples.s[k]]) + rate.U[k] @ w
        assert_allclose(found, u_dot, atol=1e-4 * np.abs(u_dot).max() + 1e-6)
        # and the part of the weight can be seen
        assert np.abs(dg[k] @ v).max() > 0.0


def spectral_radius(plant, controller, x_d, q, dt, theta=None):
    """Of the map of one step of `simulate`, by differences, without what does not move."""
    n, h, theta = len(q), 1e-5, np.zeros(0) if theta is None else theta
    rest = np.concatenate([q, np.zeros(n), theta])

    def after(z):
        run = aj.simulate(
            plant,
            controller,
            x_d,
            aj.simulation.InitialState(
                z[:n], v0=z[n : 2 * n], state=z[2 * n :] if len(theta) else None
            ),
            dt,
            dt=dt,
        )
        return np.concatenate([run.q[-1], run.v[-1], run.state[-1][: len(theta)]])

    steps = h * np.eye(len(rest))
    jacobian = np.array([(after(rest + k) - after(rest - k)) / (2.0 * h) for k in steps]).T
    values = np.linalg.eigvals(jacobian)
    return np.abs(values[np.abs(values - 1.0) > 1e-7]).max()


def upright(kp, kv, damping, gravity=None):
    """A two-link arm that stands upright, softly held: its weight turns with q."""
    robot = aj.load_robot("two_link")
    task, q = aj.PositionTask(robot, axes="xz"), np.array([1.4, 0.3])
    law = aj.SetpointController(task, aj.Gains(kp, kv, damping), gravity=gravity)
    return aj.Plant(robot, task), law, q


@pytest.mark.parametrize(
    ("period", "gains", "holds"),
    [
        (2e-3, (2.0, 0.1, 0.02), True),
        pytest.param(8e-3, (1.0, 0.1, 0.02), False, marks=pytest.mark.study),
    ],
)
def test_weight_that_is_held_for_a_period_takes_damping(period, gains, holds):
    """At 8 ms this drives the arm away from its target, which no certificate may miss."""
    plant, law, q = upright(*gains)
    x_d, box = plant.sensor.value(q), aj.JointBox.around(plant.robot, q, 0.0)
    report = aj.Study(law, plant, box, target=x_d, latency=Latency(period)).report(20)
    assert (spectral_radius(plant, law, x_d, q, period) < 1.0) == holds
    assert report.passed == holds
    assert report.refuted != holds
    # the certificate by itself, whatever the exact linearisation tells beside it
    assert report.test.certified == holds


def test_weight_that_is_learnt_and_held_takes_damping():
    robot = aj.load_robot("two_link")
    gravity = aj.AdaptiveGravity(robot, L=1e-2, alpha=0.1)
    plant, law, q = upright(5.0, 0.2, 0.05, gravity)
    x_d, theta = plant.sensor.value(q), GravityRegressor(robot).theta
    assert spectral_radius(plant, law, x_d, q, 0.01, theta) > 1.0 + 1e-4
    box = aj.JointBox.around(robot, q, 0.02)
    report = aj.Study(law, plant, box, target=x_d, latency=Latency(0.01)).report(40)
    assert not report.passed


def test_a_certificate_needs_all_samples(arm):
    """Those that the function was chosen on, and those that it was checked in."""
    for test in (arm.report.test, arm.learnt_report.test):
        assert test.certified
        assert not dataclasses.replace(test, violations=1).certified
        worse = test.margins.copy()
        worse[-1] = 0.99 * RESERVE
        assert not dataclasses.replace(test, margins=worse).certified


# -- loops that hardly grow -----------------------------------------------------------------------


@pytest.mark.parametrize("excess", [2e-5, 5e-4])
@pytest.mark.parametrize("gravity", ["known", "learnt"])
def test_errors_that_grow_slowly_are_unstable(excess, gravity):
    """A real multiplier of 1 + 5e-4 or less: at 1 kHz that is a doubling within two seconds.

    The true arm's y goes the other way than the believed one, so that its error grows; how fast
    from sample to sample the period says.
    """
    arm = heavy("three_joint")
    controller = arm.learning if gravity == "learnt" else arm.known
    report = arm.report_of(controller, configurations=20)
    at = report.samples.take(np.arange(4))
    # J with one row turned round: ĴᵀK_pJ has a negative eigenvalue, which drives errors away
    turned = at.J * np.array([1.0, -1.0, 1.0])[:, None]
    wrong = dataclasses.replace(at, J=turned)
    period = 1e-3
    for _ in range(60):
        fastest = radii(report.loop, wrong, Latency(period)).max()
        if abs(fastest - 1.0 - excess) < 0.1 * excess:
            break
        period *= excess / (fastest - 1.0)
    found = radii(report.loop, wrong, Latency(period))
    assert 1.0 < found.max() < 1.0 + 2.0 * excess
    rate = float(report.loop.growth(wrong, Latency(period).in_samples()).max())
    assert rate == pytest.approx(np.log(found.max()) / period, rel=1e-6)

    def growing(rate):
        return dataclasses.replace(report, growth=report.growth._replace(rate=rate))

    assert growing(rate).contradiction == "unstable"
    assert not growing(rate).passed
    assert growing(0.0).contradiction
    assert not growing(-1e-9).contradiction


# -- limits of effort -----------------------------------------------------------------------------


def limited(arm, effort, **options):
    return aj.TorqueLimited(arm.known, aj.Limits(effort=effort), **options)


def largest_torques(arm, report, level):
    """At each sample, the largest |τᵢ| over all states with ½zᵀPz ≤ level: exactly, by duality."""
    test, samples = report.test, report.samples
    W = np.diag(test.weights.w) + test.weights.coupling * np.ones((len(test.weights.w),) * 2)
    found = []
    for q, M in zip(samples.q, samples.M, strict=True):
        J_hat, G = arm.task.jacobian(q), arm.cross_weight(test.weights, q)
        P = np.block([[M, M @ G], [G.T @ M, W]])
        D_c = J_hat.T * arm.kv @ J_hat + arm.damping * np.eye(len(M))
        rows = np.concatenate([D_c, arm.kp * J_hat.T], axis=1)
        moving = np.sqrt(2.0 * level * np.einsum("ij,jk,ik->i", rows, np.linalg.inv(P), rows))
        found.append(np.abs(weight_of(arm, q)) + moving)
    return np.array(found)


def weight_of(arm, q):
    model = arm.truth.model
    return pin.computeGeneralizedGravity(model, model.createData(), q)


def test_motors_hold_the_arm_only_where_they_have_more_than_its_weight(arm):
    g = np.abs([weight_of(arm, q) for q in arm.report.samples.q]).max(axis=0)
    for share, holds in ((1.001, True), (0.999, False)):
        effort = np.maximum(share * g, 1e-3)
        room = effort_room(arm.report.loop, effort, arm.report.samples, arm.report.test)
        assert room.holds == holds
        assert (room.level > 0.0) == holds


def test_below_the_level_no_torque_is_beyond_the_efforts(arm):
    """Against the exact largest torque over V ≤ c, gravity and motion together, at every sample."""
    effort = 1.2 * np.abs([weight_of(arm, q) for q in arm.report.samples.q]).max(axis=0) + 3.0
    limiter = limited(arm, effort)
    report = arm.report_of(limiter)
    level = report.limits.level
    assert 0.0 < level == report.test.level < arm.report.test.level
    assert (largest_torques(arm, report, level) <= effort * (1.0 + 1e-9)).all()
    # and it is no smaller than it has to be: the bound adds two parts that are seldom at once large
    assert (largest_torques(arm, report, 6.0 * level) > effort).any()


def test_limits_never_certify_more_than_there_was(arm):
    """Whatever the motors have, V ≤ c is what it was without them, and so are its starts."""
    before, report = arm.report.test, arm.report_of(limited(arm, 1e6))
    after = report.test
    assert after.level == report.limits.level == before.level
    assert_allclose(after.certified_error, before.certified_error)


def test_a_level_never_grows(arm):
    test, samples = arm.report.test, arm.report.samples
    for share in (0.0, 0.3, 1.0, 2.0):
        found = test.below(share * test.level)
        assert_allclose(found.level, min(share, 1.0) * test.level)
        # errors of one coordinate, with wᵢeᵢ²/2 = c
        largest = np.sqrt(2.0 * found.level / test.weights.w)
        assert_allclose(found.certified_error, largest, rtol=1e-6)
        away = samples.e.any(axis=1)
        e = samples.e[away]
        W = np.diag(test.weights.w) + test.weights.coupling * np.ones((e.shape[1],) * 2)
        V = 0.5 * np.einsum("ni,ij,nj->n", e, W, e)
        saturation = arm.report.loop.controller.saturation
        assert_allclose(test.weights.at_rest(e, saturation), V, atol=1e-12)


def test_learnt_gravity_has_room_where_the_true_weight_leaves_it(arm):
    """What is to be learnt is the true arm's weight, not the believed one's."""
    report, samples = arm.learnt_report, arm.learnt_report.samples
    true = np.abs([weight_of(arm, q) for q in samples.q]).max(axis=0)
    believed = np.abs([Dynamics(arm.belief).g(q) for q in samples.q]).max(axis=0)
    between = np.where(true < 1.0, 1e3, 0.5 * (true + believed))
    assert (true[true >= 1.0] > believed[true >= 1.0] + 1e-3).any()
    weak = aj.TorqueLimited(arm.learning, aj.Limits(effort=between))
    assert arm.report_of(weak).reason == "motors"
    effort = 1.02 * true + np.where(true < 1.0, 1e3, 0.0)
    found = arm.report_of(aj.TorqueLimited(arm.learning, aj.Limits(effort=effort)))
    assert not found.is_sampled
    assert not report.is_sampled
    assert found.limits == (True, 0.0)
    assert found.passed
    assert_allclose(found.test.weights.A1, 0.5 * np.eye(arm.task.m))
    assert not found.test.weights.A2.any()


@pytest.mark.parametrize("gravity", ["known", "learnt"])
def test_limited_steps_keep_V_falling_as_they_say(arm, gravity):
    """yᵀ(τ − τ*) ≤ 0 with y of (10) where the proof is kept, else it is the slack."""
    learns, rng = gravity == "learnt", np.random.default_rng(5)
    law = arm.learning if learns else arm.known
    report = arm.learnt_report if learns else arm.report
    g = np.abs([weight_of(arm, q) for q in report.samples.q]).max(axis=0)
    limiter = aj.TorqueLimited(law, aj.Limits(effort=1.1 * g + 1.0))
    theta, kept = arm.theta if learns else np.zeros(0), 0
    for k in range(len(report.samples)):
        q, x_d = report.samples.q[k], report.samples.x_d[k]
        if k % 2:  # a third of the samples are at their targets
            x_d = x_d + 0.1 * rng.normal(size=len(x_d))
        v = 0.2 * rng.normal(size=len(q))
        measurement = aj.Measurement(0.0, q, v, arm.sensor.value(q))
        after, answer = limiter.step(theta.copy(), measurement, x_d, 1e-3)
        wanted = law.evaluate(theta.copy(), measurement, x_d)
        e = measurement.x - x_d
        y = v + limiter.alpha * np.linalg.pinv(arm.task.jacobian(q)) @ e
        power = y @ (answer.torque - wanted.torque)
        assert (np.abs(answer.torque) <= 1.1 * g + 1.0 + 1e-12).all()
        if answer.limit_status is aj.LimitStatus.PROOF_KEPT:
            kept += 1
            assert power <= 1e-9
        if answer.limit_status is aj.LimitStatus.PROOF_GIVEN_UP:
            assert_allclose(power, answer.slack, rtol=1e-6)
        if answer.limit_status is aj.LimitStatus.PROOF_KEPT and learns:
            assert_allclose(after, theta + 1e-3 * wanted.state_rate, atol=1e-12)
    assert kept > 2


def test_gravity_that_is_wrong_certifies_nothing(arm):
    """The believed arm's own weight, without the tool; what learns it may begin with that."""
    wrong = aj.SetpointController(arm.task, arm.gains, gravity=ModelGravity(arm.belief))
    report = arm.report_of(wrong, configurations=20)
    error = np.abs([Dynamics(arm.belief).g(q) - weight_of(arm, q) for q in report.samples.q]).max()
    assert 0.5 * error <= report.gravity_error <= error * (1.0 + 1e-9)
    assert not report.passed
    assert report.reason == "gravity"
    assert arm.learnt_report.gravity_error < 1e-6
    assert arm.learnt_report.passed
