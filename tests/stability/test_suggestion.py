"""Suggestions are of loops that pass as they run, and damping may have the arm's shape."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.stability.periods import largest, radii

import approxjac as aj
from approxjac.controllers import tuned
from approxjac.controllers.gains.sample_configurations import sample_configurations
from approxjac.controllers.gains.tuning import default_gains, position_gains
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.search import suggested_gains

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
KHZ = aj.Latency(period=1e-3)


@pytest.fixture(scope="module")
def arm():
    return aj.load_robot("panda").with_gravity((0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def tools(arm):
    return aj.Uncertainty(arm, object_length=(0.0, 0.2), object_mass=(0.0, 0.5), object_axis="x")


@pytest.fixture(scope="module")
def box(arm):
    return aj.JointBox.around(arm, Q, 0.15)


def law_of(tools, gains):
    return aj.SetpointController(tools.believed_task(), gains, gravity=aj.NoGravity(tools.arm))


def longest_period(tools, box, gains):
    """The longest period that is stable near 60 targets [s]."""
    loop = ClosedLoop(law_of(tools, gains), tools, box)
    samples = loop.draw(60, np.random.default_rng(0))

    def stable(period):
        return bool((radii(loop, samples, replace(KHZ, period=period)) < 1.0).all())

    return largest(stable, KHZ.period)


def test_tuned_damping_has_the_shape_of_the_inertia_by_itself(tools, box):
    """r Mᵢᵢ and a floor: so it stands periods four times as long as equal damping does."""
    task = tools.believed_task()
    own = np.median(np.diagonal(sample_configurations(task).M, axis1=1, axis2=2), axis=0)
    damping = tuned(task).gains.diagonals(task.m, 7).damping
    floor = damping - tuned(task).rate * own
    np.testing.assert_allclose(floor, floor[0], rtol=1e-9)
    equal = aj.Gains(400.0, 80.0, 5.0)
    assert longest_period(tools, box, tuned(task).gains) > 4.0 * longest_period(tools, box, equal)


@pytest.mark.study
def test_suggested_gains_follow_the_latency(tools, box):
    """Where torques are late the damping is less, and the late loop is stable."""
    late = aj.Latency(period=5e-3, torque_delay=1e-2)
    law = law_of(tools, aj.Gains(400.0, 80.0, 5.0))
    early, found = (
        aj.Study(law, tools, box, latency=each).gains(2.0, test="stable", configurations=40)
        for each in (KHZ, late)
    )
    assert np.sum(found.found.gains.damping) < np.sum(early.found.gains.damping)
    loop = ClosedLoop(law_of(tools, found.found.gains), tools, box)
    assert radii(loop, loop.draw(60, np.random.default_rng(7)), late).max() < 1.0
    assert str(found).startswith("gains: found, passing with slowest decay [1/s] ")


@pytest.fixture
def one_candidate(monkeypatch):
    for name in ("_RATES", "_STIFFNESS", "_DAMPING"):
        monkeypatch.setattr(suggested_gains, name, (1.0,))


@pytest.mark.usefixtures("one_candidate")
def test_a_candidate_is_judged_by_the_slowest_and_heaviest_robot_as_it_is_sampled():
    """At a posture, where what is drawn does not matter: of all corners, late, to both sides."""
    arm, plane = aj.load_robot("two_link"), functools.partial(aj.PositionTask, axes="xz")
    tool = {"object_length": (0.0, 0.6), "object_mass": (0.0, 2.0), "object_axis": "x"}
    errors = aj.Uncertainty(arm, plane, **tool)
    weightless = aj.Uncertainty(arm.with_gravity((0.0, 0.0, 0.0)), plane, **tool)
    late, limits = aj.Latency(period=0.04, torque_delay=0.04), np.array([70.0, 20.0])
    law = aj.SetpointController(errors.believed_task(), aj.Gains(60.0, 20.0, 1.0))
    for q in (np.array([0.4, 1.2]), np.array([2.7, -1.2])):
        study = aj.Study(law, errors, aj.JointBox.around(arm, q, 1e-7), latency=late)
        first = study.gains(3.0, test="stable", configurations=20, torque_limits=limits).tried[0]
        own = law_of(weightless, first.gains)
        rates, shares = [], []
        for values in errors.corners():
            plant = weightless.plant(values)
            plant = aj.Plant(plant.robot, plant.sensor, actuator_delay=0.04)
            rates.append(aj.local_stability(plant, own, q, 0.04).decay_rate)
            shares.append(np.abs(errors.plant(values).dynamics.g(q) / limits).max())
        assert first.settling_time == pytest.approx(4.0 / min(rates), rel=1e-3)
        assert max(rates) > 1.05 * min(rates)
        assert first.torque_ratio == pytest.approx(max(shares), rel=1e-3)


@pytest.mark.usefixtures("one_candidate")
def test_torques_at_the_start_are_those_of_the_law_that_carries_the_weight(monkeypatch):
    """Towards the target, and against gravity: whichever of both is in whose way."""
    draw, drawn = ClosedLoop.draw, []

    def drawing(loop, *args, **options):
        drawn.append((loop, draw(loop, *args, **options)))
        return drawn[-1][1]

    monkeypatch.setattr(ClosedLoop, "draw", drawing)
    arm, plane = aj.load_robot("two_link"), functools.partial(aj.PositionTask, axes="xz")
    errors = aj.Uncertainty(arm, plane, object_mass=(0.0, 2.0), object_axis="x")
    law = aj.SetpointController(errors.believed_task(), aj.Gains(60.0, 20.0, 1.0))
    limits = np.array([50.0, 30.0])
    study = aj.Study(law, errors, aj.JointBox.around(arm, (0.4, 1.2), 0.6))
    first = study.gains(1.0, test="stable", configurations=20, torque_limits=limits).tried[0]
    own = aj.SetpointController(law.task, first.gains, gravity=aj.NoGravity(law.task.robot))
    ((loop, samples),), shares = drawn, []
    for t, q, x, x_d in zip(samples.truth, samples.q, samples.x, samples.x_d, strict=True):
        torque = own.evaluate(np.zeros(0), aj.Measurement(0.0, q, np.zeros(2), x), x_d).torque
        weight = errors.plant(loop.values[t]).dynamics.g(q)
        shares.append(np.abs(torque + weight) / limits)
    assert first.torque_ratio == pytest.approx(np.max(shares), rel=1e-9)


def test_candidates_are_tried_from_the_default_gains_on_to_those_far_from_them(monkeypatch):
    """As far as all factors together say; of two that are as far, the slower one is first."""
    monkeypatch.setattr(suggested_gains, "_TARGETS", 2)
    for name in ("_RATES", "_STIFFNESS", "_DAMPING"):
        factors = (1.0, 0.5, 2.0) if name == "_STIFFNESS" else (1.0, 2.0, 4.0)
        monkeypatch.setattr(suggested_gains, name, factors)
    arm, plane = aj.load_robot("two_link"), functools.partial(aj.PositionTask, axes="xz")
    errors = aj.Uncertainty(arm, plane, object_length=(0.0, 0.1), object_axis="x")
    law = law_of(errors, aj.Gains(60.0, 20.0, 1.0))
    study = aj.Study(law, errors, aj.JointBox.around(arm, (0.4, 1.2), 0.1))
    found = study.gains(1.0, test="stable", configurations=1, torque_limits=1e-6)  # none will do
    task, factors = law.task, []
    usual = default_gains(task, 1.0, 1.0 / study.timing.of_velocity)
    for gains in (each.gains for each in found.tried):
        kv, damping = (
            np.max(getattr(gains, name) / getattr(usual, name)) for name in ("kv", "damping")
        )
        rate = np.max(gains.kp / position_gains(task, gains.kv, gains.damping, 1.0))
        factors.append((rate, max(kv, 1.0 / kv) * np.sqrt(damping)))
    far = np.round([(rate * others, rate) for rate, others in factors], 9).tolist()
    assert len(far) == 27
    assert far[0] == [1.0, 1.0]
    assert far == sorted(far)


@pytest.mark.usefixtures("one_candidate")
@pytest.mark.parametrize("test", ["certified", "stable"])
def test_gains_that_grow_as_they_are_sampled_fail(monkeypatch, test):
    """By as much as the spectral radius of the loop is above 1."""
    monkeypatch.setattr(suggested_gains, "_DAMPING", (20.0,))
    arm, plane = aj.load_robot("two_link"), functools.partial(aj.PositionTask, axes="xz")
    arm, late = arm.with_gravity((0.0, 0.0, 0.0)), aj.Latency(period=0.03, torque_delay=0.03)
    errors, q = aj.Uncertainty(arm, plane, object_length=(0.0, 0.3)), np.array([-0.7, 1.9])
    law, box = law_of(errors, aj.Gains(60.0, 20.0, 1.0)), aj.JointBox.around(arm, q, 1e-7)
    study = aj.Study(law, errors, box, latency=late)
    found = study.gains(3.0, test=test, configurations=20, torque_limits=1e4)
    (only,), grows = found.tried, []
    for values in errors.corners():
        plant = errors.plant(values)
        plant = aj.Plant(plant.robot, plant.sensor, actuator_delay=0.03)
        own = law_of(errors, only.gains)
        grows.append(-aj.local_stability(plant, own, q, 0.03).decay_rate)
    assert max(grows) > 1.0
    assert only.margin == pytest.approx(-max(grows), rel=1e-3)
    assert found.found is None


@pytest.mark.parametrize("count", [0, -1, 2.5])
def test_counts_out_of_range_are_refused(tools, box, count):
    study = aj.Study(law_of(tools, aj.Gains(400.0, 80.0, 5.0)), tools, box)
    for use in (lambda: study.gains(configurations=count), lambda: study.tolerance(draws=count)):
        with pytest.raises(aj.InvalidInputError, match=f"must be an integer >= .*got {count}"):
            use()


def test_the_smallest_counts_are_taken(tools, box):
    study = aj.Study(law_of(tools, aj.Gains(400.0, 80.0, 5.0)), tools, box)
    with pytest.raises(aj.InvalidInputError, match=r"configurations must be .*20, got 19"):
        study.gains(configurations=19)
    assert study.tolerance(["stable"], draws=1, precision=0.5)["stable"].scale > 0.0


def test_gains_that_a_report_refuses_are_not_suggested(tools, box, monkeypatch):
    """The first that meet the demands in the samples drawn are passed over."""
    refused = []

    def report(study, configurations):
        refused.append(study.controller.gains)
        return SimpleNamespace(passed=len(refused) > 1, test=SimpleNamespace(margin=0.2))

    monkeypatch.setattr(aj.Study, "report", report)
    passes = SimpleNamespace(margin=0.3)
    monkeypatch.setattr(suggested_gains, "sampled_test", lambda loop, samples, latency: passes)
    law = law_of(tools, aj.Gains(400.0, 80.0, 5.0))
    found = aj.Study(law, tools, box).gains(2.0, configurations=20)
    assert len(refused) == 2
    assert found.found.gains is refused[1]
    assert found.found.margin == 0.2
    passed_over = next(each for each in found.tried if each.gains is refused[0])
    assert passed_over.margin == 0.0
    assert str(found).startswith("gains: found, passing with margin 0.2\n  K_p ")
