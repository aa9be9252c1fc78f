"""The certificate of the loop as it runs: what it refuses, what it reaches, what it rests on."""

import math
from functools import partial

import numpy as np
import pytest
from tests.stability.periods import largest, radii

import approxjac as aj
from approxjac.controllers import Latency
from approxjac.law import Linear
from approxjac.stability.certificates.certificate import (
    RESERVE,
    largest_errors,
    sampled_test,
)
from approxjac.stability.certificates.matrix_form import (
    Hold,
    MatrixForm,
    SampledForm,
    Turning,
    best_weights,
)
from approxjac.stability.certificates.moves import largest_ratio
from approxjac.stability.loop.closed_loop import ClosedLoop

Q0 = (0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7)
LATE_IMAGES = Latency(1e-3, image_period=0.034, image_age=0.060)


@pytest.fixture(scope="module")
def arm():
    return aj.load_robot("panda").with_gravity((0.0, 0.0, 0.0))


def panda(arm, damping, kp=400.0, kv=80.0, half=0.15):
    """The Panda of the acceptance figures: a tool of up to 20 cm and 0.5 kg that is not known."""
    errors = aj.Uncertainty(arm, object_length=(0.0, 0.2), object_mass=(0.0, 0.5), object_axis="x")
    task = errors.believed_task()
    controller = aj.SetpointController(
        task, aj.Gains(kp, kv, damping), gravity=aj.NoGravity(task.robot)
    )
    return controller, errors, aj.JointBox.around(arm, Q0, half)


def certificate(parts, latency, n=200, seed=0):
    """The sampled test of a loop, chosen on n samples and checked on as many."""
    loop, rng = ClosedLoop(*parts), np.random.default_rng(seed)
    first, fresh = (loop.draw(n, rng) for _ in range(2))
    return sampled_test(loop, first, latency).checked_on(fresh)


def test_the_loop_that_diverges_is_not_certified_and_its_report_says_so(arm):
    """Certified in continuous time, unstable at 1 kHz: THEORY.md, section 8."""
    parts = panda(arm, 20.0)
    report = aj.Study(*parts, latency=Latency(0.001)).report(100)
    assert best_weights(MatrixForm(report.samples, report.loop.setting), "free").margins.min() > 0.2
    assert not report.passed
    assert not report.test.certified
    assert (report.rows[0].verdict, report.reason) == ("refuted", "unstable")
    assert report.refuted
    assert report.growth.rate > 1e3 * math.log(1.5)
    faster = certificate(parts, Latency(0.45e-3), n=100)
    assert faster.certified
    assert faster.margin > 0.2


def test_the_panda_at_1_khz(arm):
    test = certificate(panda(arm, 5.0), Latency(1e-3))
    assert test.certified
    assert test.margin > 0.2
    assert test.certified_error.min() > 0.25


@pytest.mark.parametrize(
    ("damping", "length"),
    [
        *(pytest.param(*each, marks=pytest.mark.study) for each in ((2.0, 0.0), (5.0, 0.2))),
        (20.0, 0.2),
    ],
)
def test_the_period_certified_at_a_posture_is_a_quarter_of_pi_of_the_exact_one(
    arm, damping, length
):
    controller, errors, region = panda(arm, damping, half=1e-9)
    plant = errors.plant((length, 0.5 if length else 0.0))
    loop = ClosedLoop(controller, plant, region)
    samples = loop.draw(4, np.random.default_rng(0))

    def stable(period):
        return bool((radii(loop, samples, Latency(period)) < 1.0).all())

    def certified(period):
        return sampled_test(loop, samples, Latency(period)).margin > 0.0

    exact = largest(stable, 8e-3 / damping)
    assert 0.75 < largest(certified, 0.5 * exact) / exact < 0.25 * math.pi + 0.01


@pytest.mark.parametrize(("kp", "kv", "least"), [(400.0, 80.0, 0.0), (50.0, 50.0, 0.28)])
@pytest.mark.study
def test_late_images_are_certified(arm, kp, kv, least):
    test = certificate(panda(arm, 5.0, kp, kv), LATE_IMAGES, n=120)
    assert test.certified
    assert test.margin > least
    own = test.form.take(slice(len(test.margins))).margins(test.weights)  # of errors as they are
    np.testing.assert_allclose(test.margins, own)


# -- what it rests on -----------------------------------------------------------------------------


def times_of_frames(period, age, delay, *, on_samples):
    """Times, and when the x was taken that the torque then is of: frames wait for a sample."""
    fine = 20
    t = (np.arange(16 * fine) + 0.5) / fine
    sample = np.floor(t - delay)
    if on_samples:  # as of `Sensing`
        seen = sample - math.ceil(age - 1e-9)
        taken = np.ceil(np.floor(seen / period + 1e-6) * period - 1e-9)
    else:
        taken = np.floor((sample - age) / period + 1e-9) * period
    return t, taken


def errors_of_frames(t, taken):
    """What makes w_x of ṡ."""
    fine = round(1.0 / (t[1] - t[0]))
    edges = np.arange(len(t)) / fine

    def reached(times):
        return np.clip((times[:, np.newaxis] - edges) * fine, 0.0, 1.0) / fine

    return reached(np.maximum(taken, 0.0)) - reached(t)


@pytest.mark.parametrize("on_samples", [False, True])
@pytest.mark.parametrize(
    ("period", "age", "delay"),
    [(1.02, 0.0, 0.0), (1.1, 0.0, 0.0), (3.1, 0.0, 0.0), (1.05, 1.0, 0.0), (2.2, 1.1, 0.0),
     (0.7, 0.0, 0.0), (3.0, 2.0, 0.0), (3.0, 1.3, 0.0), (1.0, 2.5, 0.0), (3.0, 0.0, 2.0),
     (1.1, 0.0, 3.0), (2.0, 1.5, 1.0)],
)  # fmt: skip
def test_the_gain_of_frames_holds_for_every_signal(period, age, delay, on_samples):
    """Also where frames fall between samples, which 2/π (period + sample) does not bound."""
    t, taken = times_of_frames(period, age, delay, on_samples=on_samples)
    hold = Hold.of(Latency(1.0, delay, image_period=period, image_age=age))
    assert np.linalg.norm(errors_of_frames(t, taken), 2) <= hold.frames
    assert (t - taken).max() <= hold.age
    assert hold.span >= 1.0 + delay


@pytest.mark.parametrize("lag", [0.01, 1.0, 4.0])
def test_the_gain_of_a_filter_holds_for_every_signal(lag):
    fine, n = 12, 30
    passed = np.tril(np.ones((n * fine, n * fine))) / fine - 0.5 * np.eye(n * fine) / fine
    means = passed.reshape(n, fine, -1).mean(axis=1)
    seen, a = np.zeros((n, n * fine)), 1.0 / (1.0 + lag)
    for k in range(1, n):
        seen[k] = (1.0 - a) * seen[k - 1] + a * means[k - 1]
    errors = np.repeat(seen, fine, axis=0) - passed
    hold = Hold.of(Latency(1.0, velocity_filter=lag))
    assert np.linalg.norm(errors, 2) <= hold.gain
    # the mean age of q̇ when it is seen, and while it is held; what q makes of the torque is of now
    j, a = np.arange(400), 1.0 / (1.0 + lag)
    age = float((a * (1.0 - a) ** j) @ (j + 0.5))
    assert (hold.lag, hold.turned) == pytest.approx((age, age + 0.5))


@pytest.mark.parametrize(
    "latency", [Latency(1e-3), pytest.param(LATE_IMAGES, marks=pytest.mark.study)]
)
def test_states_below_the_level_are_as_slow_and_near_as_assumed(arm, latency):
    test = certificate(panda(arm, 5.0), latency, n=60)
    form, weights, rng = test.form, test.weights, np.random.default_rng(1)
    at = form.samples
    v, s = (rng.normal(size=shape) for shape in (at.M.shape[:2], at.s.shape))
    G = form.cross_weight(weights)
    for share in np.linspace(0.0, 1.0, 9):
        z, e = share * v, (1.0 - share) * s
        kinetic = np.einsum("ni,nij,nj->n", z, at.M, z)
        V = 0.5 * kinetic + np.einsum("ni,nij,njk,nk->n", z, at.M, G, e)
        V += weights.at_rest(e, Linear())
        scale = test.level / V
        assert (np.sqrt(scale * kinetic) <= test.speed * (1.0 + 1e-9)).all()
        size = np.sqrt(scale) * np.linalg.norm(e, axis=1)
        assert (size <= form.largest_s(weights) * (1.0 + 1e-9)).all()
    assert form.largest_s(weights) <= form.most_s * (1.0 + 1e-9)


def test_gravity_counts_where_velocities_are_filtered():
    """g is not filtered with what it is held with, so what q turns it by meanwhile is left over."""
    robot = aj.load_robot("two_link")
    make = partial(aj.SetpointController, aj.PositionTask(robot), aj.Gains(100.0, 20.0, 5.0))
    box = aj.JointBox.around(robot, (0.3, 1.2), 0.1)
    filtered = Latency(1e-3, velocity_filter=4e-3)
    heavy = certificate((make(), aj.Plant(robot), box), filtered, n=16)
    exact = certificate((make(), aj.Plant(robot), box), Latency(1e-3), n=16)
    assert heavy.form.turning.gravity > 0.0
    assert exact.form.turning.gravity == 0.0
    assert heavy.form._b > heavy.form.hold.gain * heavy.form.turning.curvature * heavy.speed


@pytest.fixture(scope="module")
def exact():
    """A loop whose model is exact, around a posture; its certificate."""
    robot = aj.load_robot("two_link")
    law = aj.SetpointController(aj.PositionTask(robot, axes="xz"), aj.Gains(60.0, 20.0, 5.0))
    box = aj.JointBox.around(robot, (0.4, 1.2), 0.2)
    return robot, law, box, certificate((law, aj.Plant(robot, law.task), box), Latency(1e-3), n=16)


def test_a_function_is_checked_where_it_was_not_chosen(exact):
    """It fails there, and what it was chosen on does not make up for that."""
    robot, law, box, test = exact
    assert (test.certified, test.violations) == (True, 0)
    turned = robot.with_kinematic_error(rotations={"joint1": (0.0, 1.8, 0.0)})
    loop, other = (
        ClosedLoop(law, aj.Plant(each, law.task.on(each)), box) for each in (robot, turned)
    )
    first, fresh = (each.draw(n, np.random.default_rng(0)) for each, n in ((loop, 16), (other, 9)))
    found = sampled_test(loop, first, Latency(1e-3))
    found = found.checked_on(first.take(slice(4)).join(fresh))
    assert found.margin >= RESERVE
    assert found.checked == 13
    assert found.violations == (found.form.elsewhere(fresh).margins(found.weights) <= 0.0).sum()
    assert 0 < found.violations <= 9
    assert not found.certified
    with_these = found.with_samples(fresh)  # chosen on as many, it has not passed either
    assert len(with_these.margins) == 25
    assert with_these.margin <= 0.0


@pytest.mark.parametrize("gamma", [None, 0.05])
def test_decay_is_that_of_V_itself(gamma):
    """F without and with a rate ρ differ by ρP, zᵀPz ≥ 2V for errors of motions below v̄."""
    robot = aj.load_robot("two_link")
    saturation = None if gamma is None else aj.law.Tanh(gamma)
    law = aj.SetpointController(
        aj.PositionTask(robot, axes="xz"), aj.Gains(60.0, 20.0, 5.0), saturation=saturation
    )
    box = aj.JointBox.around(robot, (0.4, 1.2), 0.1)
    loop = ClosedLoop(law, aj.Plant(robot, law.task), box)
    form = MatrixForm(loop.draw(30, np.random.default_rng(0)), loop.setting)
    weights = best_weights(form, "free").weights._replace(
        multiplier=0.0
    )  # of holds nothing is left
    sampled = SampledForm(form, np.zeros(2), Hold.of(Latency(1e-3)), 1.0, 1.0)
    ratio = largest_ratio(
        saturation or Linear(), bounds := largest_errors(law.saturation, weights.w, 0.5)
    )
    assert (ratio > 0.6) == (gamma is not None)
    slow = sampled.changed(decay=(0.7, ratio)).decrease(weights)
    P = (sampled.decrease(weights) - slow)[:, :4, :4] / 0.7
    at, G = form.samples, form.cross_weight(weights)
    for k, share in enumerate(np.random.default_rng(1).uniform(-1.0, 1.0, (len(at), 4))):
        v, e = share[:2], share[2:] * bounds
        s, S = law.saturation.s(e), law.saturation.S(e)
        V = 0.5 * v @ at.M[k] @ v + v @ at.M[k] @ G[k] @ s + weights.w @ S
        z = np.append(v, s)
        assert z @ P[k] @ z >= 2.0 * V - 1e-9
        if gamma is None:
            assert z @ P[k] @ z == pytest.approx(2.0 * V)


def test_old_torques_have_missed_what_turned_for_as_long_as_they_are_old():
    """By ē s̄ for a period and the delay, where x comes in frames."""
    robot = aj.load_robot("two_link")
    law = aj.SetpointController(aj.PositionTask(robot, axes="xz"), aj.Gains(60.0, 20.0, 5.0))
    loop = ClosedLoop(law, aj.Plant(robot, law.task), aj.JointBox.around(robot, (0.4, 1.2), 0.1))
    late = Latency(1e-3, torque_delay=3e-3, image_period=0.01)
    form = MatrixForm(loop.draw(20, np.random.default_rng(0)), loop.setting)
    sampled = SampledForm(form, np.zeros(2), Hold.of(late), 1.0, 0.2, Turning(0.0, stiffness=5.0))
    assert sampled._b == pytest.approx((1e-3 + 3e-3) * 5.0 * 0.2)


def test_whatever_turns_faster_leaves_less_of_the_margin():
    """Each rate at which samples turn counts where torques are late, x is old and q̇ filtered.

    That at which the torque's error answers itself ends all: some multiplier exists below it only.
    """
    robot = aj.load_robot("two_link")
    law = aj.SetpointController(aj.PositionTask(robot), aj.Gains(60.0, 20.0, 5.0))
    box = aj.JointBox.around(robot, (0.3, 1.2), 0.1)
    late = Latency(1e-3, 1e-3, velocity_filter=2e-3, image_period=4e-3, image_age=2e-3)
    test = certificate((law, aj.Plant(robot), box), late, n=16)
    form, weights = test.form, test.weights
    assert test.margin > 0.0
    for name, size in form.turning._asdict().items():
        assert size > 0.0, name
        slow, fast = (
            form.changed(turning=form.turning._replace(**{name: share * size}))
            for share in (0.0, 3.0)
        )
        assert slow.is_possible()
        if name == "fastest":
            sooner = 1.0 / math.sqrt(form._gain * (1.0 + form._b))
            for share, possible in ((0.99, True), (1.01, False)):
                turning = form.turning._replace(fastest=share * sooner)
                assert form.changed(turning=turning).is_possible() == possible
            continue
        for one, other in ((slow, form), (form, fast)):
            assert (one.margins(weights) > other.margins(weights)).all(), name
