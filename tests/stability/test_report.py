"""The report, tolerance and suggested gains, put together from the tests."""

import json
import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.stability.periods import largest, radii

import approxjac as aj
from approxjac.controllers import DifferentiatedVelocity, Latency
from approxjac.errors import UnknownNameError
from approxjac.law import Sine
from approxjac.paper import experiments as paper
from approxjac.robots import GravityRegressor
from approxjac.stability.certificates.certificate import (
    RESERVE,
    continuous_test,
    sampled_test,
    theorem1,
)
from approxjac.stability.certificates.matrix_form import MatrixForm
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.configurations import inverse_kinematics
from approxjac.stability.loop.linearization import linear_loop, sampled_matrix
from approxjac.stability.report.report import of_gravity, usual_errors
from approxjac.stability.search import suggested_gains as search
from approxjac.stability.search import tolerance
from approxjac.stability.search.worst import searched_test

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.8, 0.0])
Q2 = np.array([0.3, 1.2])  # of the two-link arm, far from singular


@pytest.fixture(scope="module")
def weightless():
    return aj.load_robot("panda").with_gravity((0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def tools(weightless):
    return aj.Uncertainty(weightless, object_length=(0.0, 0.2), object_mass=(0.0, 0.5))


@pytest.fixture(scope="module")
def box(weightless):
    return aj.JointBox.around(weightless, Q, 0.3)


def controller_of(uncertainty, gains=None, **options):
    return aj.SetpointController(
        uncertainty.believed_task(), aj.Gains(400.0, 80.0, 10.0) if gains is None else gains,
        **options,
    )  # fmt: skip


def by_name(report):
    """The rows of a report."""
    return {(row.part, row.name): row for row in report.rows}


@pytest.fixture(scope="module")
def seen():
    """What the report's progress was told."""
    return []


@pytest.fixture(scope="module")
def report(tools, box, seen):
    return aj.Study(controller_of(tools), tools, box, latency=Latency(period=0.0005)).report(
        200, progress=lambda what, share: seen.append((what, share))
    )


def test_report_says_what_each_test_says(report):
    assert not report.theorem1.holds
    assert report.passed
    assert not report.refuted
    test = report.test
    assert test.certified
    in_time = MatrixForm(test.form.samples, report.loop.setting)
    assert (test.margins <= in_time.margins(test.weights) + 1e-12).all()
    assert test.margin >= RESERVE
    assert not report.growth.grows
    assert -5.0 < report.growth.rate < -0.5
    assert test.family == "free"  # none wider was needed
    text = str(report)
    assert text.splitlines()[0] == report.verdict() == report.rows[0].text
    assert max(map(len, text.splitlines())) <= 100
    rows = by_name(report)
    first = rows["tests", "Theorem 1"]
    assert first.verdict == "does not hold"
    assert first.figures["p"] == pytest.approx(0.346, abs=5e-4)
    assert first.figures["p"] > first.figures["allowed_p"] > 0.0
    function = rows["tests", "one function"]
    assert function.verdict == "holds"
    assert function.figures["margin"] == test.margin
    assert (function.figures["violations"], function.figures["checked"]) == (0, 100)
    assert function.figures["violating_at_most"] == pytest.approx(0.0295, abs=5e-4)
    near = rows["tests", "near targets"]
    assert near.verdict == "stable"
    assert near.figures["decay"] == -near.figures["rate"] == -report.growth.rate
    assert near.figures["looks"] == report.growth.looks > 1000
    assert_array_equal(report.rows[1].figures["certified_error"], test.certified_error)


@pytest.mark.study
def test_periods_are_certified_up_to_a_share_of_what_is_stable(report):
    sampled, latency = report.test, report.latency
    own = radii(report.loop, report.samples, latency)
    worst = report.samples.take(np.argsort(-own)[:60])

    def stable(period):
        held = replace(latency, period=period)
        return bool((radii(report.loop, worst, held) < 1.0).all())

    def certified(period):  # in the worst cases that a search found, too
        held = replace(latency, period=period)
        return sampled_test(report.loop, sampled.form.samples, held).margin > 0.0

    exact = largest(stable, latency.period)
    assert certified(0.5 * exact)
    assert not certified((math.pi / 4.0 + 0.02) * exact)


def test_gravity_that_is_left_out_is_said_to_be_known(tools):
    law = controller_of(tools, gravity=aj.NoGravity(tools.arm))
    assert "gravity known exactly: the arm is taken without it" in " ".join(str(law).split())


@pytest.mark.study
def test_report_says_at_once_for_which_starts_it_holds(report):
    """The share of the usual ones that V covers, of which staying is assumed."""
    usual = np.linalg.norm(usual_errors(report), axis=1)
    covers = report.rows[1]
    assert (covers.part, covers.name, covers.verdict) == ("verdict", "covers", "certified")
    expected = {"share": 1.0, "usual": np.median(usual), "unit": "m"}
    assert {name: covers.figures[name] for name in expected} == expected
    assert report.verdict().endswith("as long as the arm stays in the region")
    for level, share in ((0.1, None), (0.0, 0.0)):
        slower = report.test.below(level * report.test.level)
        found = replace(report, test=slower).rows[1].figures["share"]
        assert found == share or (share is None and 0.0 < found < 1.0)


@pytest.mark.parametrize("radius", [0.0, 0.1])
def test_a_certificate_of_no_start_but_the_target_itself_covers_nothing(radius):
    """Of a region of one configuration: by it the exit code is not 0."""
    arm = aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0))
    in_plane = partial(aj.PositionTask, axes="xz")
    tools = aj.Uncertainty(arm, in_plane, object_length=(0.0, 0.06), object_axis="x")
    law = aj.SetpointController(tools.believed_task())
    found = aj.Study(law, tools, aj.JointBox.around(arm, Q2, radius)).report(20)
    assert found.passed
    assert found.covers == (found.test.level > 0.0) == (radius > 0.0)
    assert ("No start away from its target is certified" in str(found)) == (radius == 0.0)


@pytest.mark.study
def test_report_says_what_no_test_knows_of():
    """Joints beyond their limits, and times that are no whole periods."""
    arm = aj.load_robot("ur5").with_gravity((0.0, 0.0, 0.0))
    tools = aj.Uncertainty(arm, object_length=(0.0, 0.1))
    q = [0.0, -1.2, 1.4, -1.0, -1.5, 0.0]
    late = Latency(period=1e-3, torque_delay=2.4e-3, image_age=5e-3)

    def rows(region, latency):
        found = aj.Study(controller_of(tools), tools, region, latency=latency).report(20)
        return {row.name: row.figures for row in found.rows if row.part == "beware"}

    inside = rows(aj.JointBox.around(arm, q, 0.1), Latency())
    assert inside == {}
    wide = aj.JointBox.around(arm, q, [0.1, 0.1, 3.0, 0.1, 0.1, 0.1])
    beyond = rows(wide, late)
    assert beyond["joint limits"] == {"joints": ["elbow_joint"]}
    assert beyond["timing"] == {"period": 1e-3, "torque_delay": 2e-3, "image_age": 5e-3}
    part = aj.stability.RegularPart(wide, tools.believed_task(), 0.01)
    assert rows(part, Latency())["joint limits"] == {"joints": ["elbow_joint"]}
    longer = rows(aj.JointBox.around(arm, q, 0.1), Latency(torque_delay=1e-2))
    assert longer["timing"] == {"period": 2.5e-3, "torque_delay": 1e-2, "image_age": 0.0}


def test_what_was_chosen_is_checked_elsewhere(report):
    test = report.test
    assert (test.checked, test.violations) == (100, 0)
    assert_allclose(test.violating_at_most, 1.0 - 0.05 ** (1.0 / 100.0))
    two = replace(test, violations=2)  # the share of which 2 or fewer of 100 are seen in 5 %
    share = two.violating_at_most
    seen = sum(math.comb(100, k) * share**k * (1.0 - share) ** (100 - k) for k in range(3))
    assert seen == pytest.approx(0.05)
    (row,) = [row for row in report.rows if "violating_at_most" in row.figures]
    assert row.figures["violating_at_most"] == test.violating_at_most
    assert "confidence" in row.text


@pytest.mark.study
def test_report_repeats_bit_by_bit():
    arm = aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0))
    tools, box = aj.Uncertainty(arm, object_length=(0.0, 0.3)), aj.JointBox.around(arm, Q2, 0.3)
    first, again, other = (
        aj.Study(controller_of(tools), tools, box, seed=seed).report(20) for seed in (0, 0, 1)
    )
    assert again.summary() == first.summary()
    assert str(again) == str(first)
    assert other.summary() != first.summary()


def test_summary_is_json_and_complete(report):
    summary = json.loads(json.dumps(report.summary()))
    assert (summary["certified"], summary["refuted"], summary["reason"]) == (True, False, "")
    assert summary["about"]["timing"]["period"] == 5e-4
    assert summary["tests"]["Theorem 1"]["verdict"] == "does not hold"
    assert len(summary["worst"]["one function"]["q"]) == 7
    assert len(summary["worst"]["near targets"]["values"]) == 2
    assert summary["tests"]["near targets"]["verdict"] == "stable"
    assert sum(len(summary[part]) for part in {row.part for row in report.rows}) == len(report.rows)


def test_a_certified_controller_reaches_its_target(tools, box, report):
    outcome = aj.Study(report.loop.controller, tools, box, duration=4.0, seed=3).rollouts(2)
    assert outcome.n_converged == 2


@pytest.mark.study
def test_a_single_robot_and_a_plant_say_the_same():
    arm = aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0))
    truth, belief = arm.with_object(0.2, 0.5), arm.with_object(0.0)
    controller = aj.SetpointController(aj.PositionTask(belief), aj.Gains(400.0, 80.0, 10.0))
    region = aj.JointBox.around(arm, Q2, 0.2)
    reports = [
        aj.Study(controller, uncertainty=each, region=region).report(20)
        for each in (truth, aj.Plant(truth, aj.PositionTask(truth)))
    ]
    assert reports[0].summary() == reports[1].summary()
    assert by_name(reports[0])["worst", "one function"].figures["truth"] == "the true robot"


def test_default_region_leaves_singular_configurations_out(weightless):
    truth, belief = weightless.with_object(0.05), weightless.with_object(0.0)
    loop = ClosedLoop(aj.SetpointController(aj.PositionTask(belief)), truth)
    drawn = loop.draw(40, np.random.default_rng(0))
    values = np.linalg.svd(drawn.J_hat, compute_uv=False)[:, -1]
    assert values.min() >= loop.region.sigma_min > 0.0


def test_a_target_is_looked_at_where_it_is_attained(tools, box):
    controller = controller_of(tools)
    target = tools.plant([0.1, 0.2]).sensor.value(Q)
    found = aj.Study(controller, tools, box, target=target).report(24)
    loop, growth = found.loop, found.growth
    assert_array_equal(loop.target, target)
    # the worst of them is told, with the robot that it is of
    assert_allclose(tools.plant(growth.values).sensor.value(growth.q), target, atol=1e-8)
    worst = by_name(found)["worst", "near targets"].figures
    assert worst["truth"] == tools.describe(growth.values)
    assert_array_equal(worst["q"], growth.q)
    truths, ends = loop.targets(1, np.random.default_rng(0))
    assert set(truths) == set(range(len(loop.values)))
    for t, q in zip(truths, ends, strict=True):
        assert_allclose(tools.plant(loop.values[t]).sensor.value(q), target, atol=1e-8)
    rates = loop.growth(loop.samples_at(truths, ends), found.latency.in_samples())
    assert rates.max() <= growth.rate + 1e-3


@pytest.mark.parametrize(
    ("latency", "frame", "late"),
    [
        (Latency(2e-3), 2e-3, False),
        (Latency(1e-3, image_period=0.02), 0.02, True),
        (Latency(5e-3, torque_delay=0.01, image_period=0.015), 0.015, True),
    ],
)
def test_what_dies_out_between_frames_does_so_in_the_time_of_a_frame(report, latency, frame, late):
    """The rate of growth is that of the map from frame to frame, per second."""
    few = report.samples.take(slice(5))
    rates = report.loop.growth(few, latency.in_samples())
    parts = [
        linear_loop(report.loop.plants[t], report.loop.controller, q)
        for t, q in zip(few.truth, few.q, strict=True)
    ]
    maps = [sampled_matrix(each, latency.in_samples())[0] for each in parts]
    multipliers = np.linalg.eigvals(maps)
    left = np.abs(multipliers - 1.0) > 1e-9  # all but the self-motion
    assert_allclose(np.exp(frame * rates), np.abs(multipliers).max(axis=1, where=left, initial=0.0))
    told = replace(report, latency=latency, growth=report.growth._replace(rate=-2.0))
    figures = by_name(told)["tests", "near targets"].figures
    assert (figures["decay"], figures["rate"]) == (2.0, -2.0)
    assert told.rows[0].figures["late"] == late


@pytest.mark.study
def test_gravity_that_is_not_exact_certifies_nothing():
    arm = aj.load_robot("panda")
    tools = aj.Uncertainty(arm, object_length=(0.0, 0.1), object_mass=(0.0, 0.5))
    region = aj.JointBox.around(arm, Q, 0.1)
    known = aj.Study(controller_of(tools), tools, region).report(20)
    assert not known.gravity_is_exact
    assert not known.passed
    assert known.reason == "gravity"
    assert known.rows[0].figures["error"] == known.gravity_error > 1.0
    why = by_name(known)["beware", "gravity"]
    assert dict(why.figures) == {"error": known.gravity_error, "learns": False, "by": []}
    assert "unless gravity is learnt (AdaptiveGravity)" in why.text
    regressor = GravityRegressor(tools.belief())
    learnt = aj.Study(
        controller_of(tools, gravity=aj.AdaptiveGravity(regressor, L=0.2, alpha=1.0)), tools, region
    ).report(20)
    assert learnt.gravity_is_exact
    assert not learnt.is_sampled
    assert learnt.passed
    assert learnt.reason == ""
    assert learnt.rows[0].verdict == "in continuous time only"
    assert learnt.rows[1].verdict == "continuous"
    assert learnt.test.family == "free"
    assert not learnt.growth.grows
    for each, learns in ((learnt, True), (known, False)):
        assert each.is_sampled != learns
        assert by_name(each)["tests", "near targets"].figures["learns"] == learns


@pytest.mark.parametrize(
    ("options", "terms"),
    [
        ({}, ["task force", "joint torques"]),
        ({"task_force": 1.0}, ["task force"]),
        ({"task_force": 0.0}, []),
    ],
)
def test_gravity_that_no_parameters_explain_is_not_said_to_want_learning(options, terms):
    arm = aj.load_robot("panda")
    tilted = aj.Uncertainty(arm, joint_rotations={"panda_joint1": (0.2, 0.0, 0.0)})
    options = options and {"L": 0.2, "alpha": 1.0} | options
    law = controller_of(tilted, gravity=aj.AdaptiveGravity(arm, **options))
    loop = ClosedLoop(law, tilted, aj.JointBox.around(arm, Q, 0.1))
    error = loop.gravity_error(Q[np.newaxis])
    assert error > 1.0
    row = of_gravity(loop, error)
    assert dict(row.figures) == {"error": error, "learns": True, "by": terms}
    assert row.text.startswith("no learnt gravity parameters explain up to")
    with pytest.raises(aj.InvalidInputError, match="but for wrong joint axes or a tilted base"):
        loop.require_gravity()


@pytest.mark.study
def test_a_gravity_of_ones_own_is_judged_by_what_it_returns():
    scratch = np.empty(7)

    class Own(aj.controllers.ModelGravity):
        share = 1.0

        def torque(self, q):
            np.multiply(self.share, super().torque(q), out=scratch)
            return scratch  # the same memory at each call

    class Weak(Own):
        share = 0.9

    arm = aj.load_robot("panda")
    region = aj.JointBox.around(arm, Q, 0.3)
    drawn = region.sample(5, np.random.default_rng(0))
    most = max(np.abs(aj.Plant(arm).dynamics.g(q)).max() for q in drawn)
    for gravity, off in ((Own(arm), 0.0), (Weak(arm), 0.1)):
        law = aj.SetpointController(
            aj.PositionTask(arm), aj.Gains(400.0, 80.0, 5.0), gravity=gravity
        )
        found = ClosedLoop(law, arm, region).gravity_error(drawn)
        assert_allclose(found, off * most, atol=1e-9)
    report = aj.Study(law, arm, region).report(20)
    assert not report.gravity_is_exact
    assert not report.passed
    assert "gravity by Weak" in by_name(report)["about", "law"].figures["law"]


@pytest.mark.parametrize("mass", [0.0, 1.5])
def test_gravity_is_off_by_the_most_of_all_robots_where_each_stands(mass):
    """A tool of any length that weighs nothing is compensated by the arm alone, everywhere."""
    arm = aj.load_robot("two_link")
    tools = aj.Uncertainty(
        arm, object_length=(0.0, 0.4), object_axis="x",
        object_mass=(0.0, mass) if mass else None, believed_mass=0.0,
    )  # fmt: skip
    law = aj.SetpointController(tools.believed_task(), aj.Gains(60.0, 20.0, 1.0))
    loop = ClosedLoop(law, tools, aj.JointBox.around(arm, Q2, 1.0))
    drawn = loop.region.sample(6, np.random.default_rng(0))
    off = [
        np.abs(tools.plant(values).dynamics.g(q) - law.gravity.torque(q)).max()
        for values in tools.corners()
        for q in drawn
    ]
    assert_allclose(loop.gravity_error(drawn), max(off), atol=1e-9)
    assert (max(off) > 1.0) == (mass > 0.0)


def test_progress_tells_what_is_being_done(report, seen):
    assert {"configurations", "near targets", "one function"} <= {what for what, _ in seen}
    assert all(0.0 <= share <= 1.0 for _, share in seen)


def test_bad_input_is_named(tools, box, weightless):
    controller = controller_of(tools)
    far = np.array([5.0, 0.0, 0.0])
    with pytest.raises(aj.InvalidInputError, match="target must be within reach of every true rob"):
        aj.Study(controller, tools, box, target=far).report(40)
    elsewhere = tools.plant([0.1, 0.2]).sensor.value(-Q)
    with pytest.raises(
        aj.InvalidInputError, match="target must be attained by a configuration of t"
    ):
        aj.Study(controller, tools, box, target=elsewhere).report(40)
    with pytest.raises(aj.InvalidInputError, match="configurations must be an integer >= 20, g"):
        aj.Study(controller, tools, box).report(3)
    with pytest.raises(aj.InvalidInputError, match="seed must be an integer >= 0, got -1"):
        aj.Study(controller, tools, box, seed=-1).report()
    with pytest.raises(aj.InvalidInputError, match="uncertainty must be an Uncertainty"):
        aj.Study(controller, weightless.with_object(0.1), box).report(40, runs=5)
    with pytest.raises(aj.InvalidInputError, match="region must be a Region, such as JointBox"):
        aj.Study(controller, tools, region=3).report()
    with pytest.raises(aj.InvalidInputError, match="truth must be a Plant, a Robot or an Uncert"):
        aj.Study(controller, uncertainty="panda").report()
    with pytest.raises(aj.InvalidInputError, match="kp must be > 0"):
        aj.Study(controller_of(tools, aj.Gains(0.0, 1.0, 1.0)), tools, box).report()
    with pytest.raises(aj.InvalidInputError, match=r"object_mass must be .*>= 0"):
        aj.Uncertainty(weightless, object_mass=(-1.0, 1.0))


def unwrapped(report):
    return " ".join(str(report).split())


def test_laws_without_certificates_have_a_report_that_says_so(tools, box):
    law_5 = controller_of(tools, velocity=DifferentiatedVelocity())
    report = aj.Study(law_5, tools, box).report(20)
    assert "the laws (6) and (28) without a posture" in unwrapped(report)
    tracking = aj.Study(aj.TrackingController(law_5.task), tools, box).report(20)
    assert "a SetpointController, which learns no Jacobian" in unwrapped(tracking)
    assert any("not applicable" in row.verdict for row in tracking.rows)
    assert not tracking.passed


# -- tolerance ------------------------------------------------------------------------------


@pytest.mark.long  # in short: test_a_certified_set of cli/test_stability.py
def test_tolerance_of_a_tool_is_larger_for_sharper_tests(tools, box):
    law = controller_of(tools, aj.Gains(400.0, 80.0, 5.0))
    found = aj.Study(law, tools, box).tolerance(draws=20)
    scales = [found[test].scale for test in ("certified", "stable")]
    assert 1.0 < scales[0] < scales[1] < 10.0
    for each in found.values():
        assert each.scale < each.fails_at
        assert each.fails_at - each.scale <= 0.1 * each.fails_at  # the precision
        assert "times the errors" in " ".join(str(each).split())
        assert "fails" in str(each)
        assert each.worst_text in str(each)
    assert "object length" in found["certified"].worst_text


@pytest.mark.study
def test_tolerated_camera_roll_is_where_the_eigenvalues_say():
    """Two-link with Figure 4's gains: beyond the told angle the exact linearisation is unstable."""
    arm = paper.build_arm().with_gravity((0.0, 0.0, 0.0))
    errors = aj.Uncertainty(arm, camera=paper.CAMERA, roll=(-math.pi / 3, math.pi / 3))
    controller = aj.SetpointController(errors.believed_task(), aj.Gains(5000.0, 10000.0))
    target = errors.believed_task().value(np.radians([90.0, 90.0]))
    found = aj.Study(controller, errors, aj.JointBox(arm), target=target).tolerance(
        ("stable",), draws=4, precision=0.002, largest=2.9
    )["stable"]
    angle = found.scale * math.pi / 3

    def all_stable(roll):
        verdicts = []
        for sign in (-1.0, 1.0):
            plant = errors.plant([sign * roll])
            starts = aj.JointBox(arm).sample(6, np.random.default_rng(5))
            postures = [inverse_kinematics(plant.sensor, target, q) for q in starts]
            verdicts += [
                aj.local_stability(plant, controller, q).stable for q in postures if q is not None
            ]
        assert len(verdicts) > 8
        return all(verdicts)

    assert all_stable(0.98 * angle)
    assert not all_stable(1.02 * angle)
    assert math.degrees(abs(found.worst[0])) == pytest.approx(math.degrees(angle), rel=0.01)


def test_tolerance_stops_where_robots_cannot_exist(weightless, box):
    errors = aj.Uncertainty(weightless, object_length=(0.0, 0.2), believed_length=0.1)
    found = aj.Study(controller_of(errors), errors, box).tolerance("stable", draws=20)
    assert_allclose(found["stable"].scale, 1.0, rtol=1e-4)  # a length below 0 is none
    assert found["stable"].fails_at == math.inf
    assert "not up to the most that was tried" in str(found["stable"])
    assert str(found["stable"]).startswith("tolerated by the linearisation (near targets only): ")
    assert repr(found["stable"]) == "Tolerance('stable': scale 1, fails at inf)"
    assert "object length 0 to 0.2 m" in str(found["stable"])  # and not 1.2e-07


def test_tolerance_of_a_controller_that_never_passes(tools, box):
    weak = controller_of(tools, aj.Gains(1.0, 80.0, 100.0))  # damping that 1 ms does not stand
    shares = []
    found = aj.Study(weak, tools, box).tolerance(
        ("stable",), draws=40, progress=lambda what, share: shares.append(share)
    )["stable"]
    assert found.scale == 0.0
    assert found.fails_at == 0.0
    assert shares == sorted(shares)
    assert all(0.0 <= share <= 1.0 for share in shares)


def test_tolerance_refuses(tools, box, weightless):
    controller = controller_of(tools)
    with pytest.raises(UnknownNameError, match="test 'theorem' not in the tests"):
        aj.Study(controller, tools, box).tolerance(("theorem",))
    with pytest.raises(aj.InvalidInputError, match="largest must be a finite number > 0"):
        aj.Study(controller, tools, box).tolerance(largest=0.0)
    certain = aj.Uncertainty(weightless)
    with pytest.raises(aj.InvalidInputError, match="uncertainty must have a range to scale"):
        aj.Study(controller_of(certain), certain, box).tolerance()


# -- suggested gains ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small_box(weightless):
    return aj.JointBox.around(weightless, Q, 0.05)


@pytest.mark.study
def test_suggested_gains_meet_what_was_asked(tools, small_box, monkeypatch):
    monkeypatch.setattr(search, "_TARGETS", 8)
    found = aj.Study(controller_of(tools), tools, small_box).gains(2.0, configurations=20)
    assert found.found is not None
    best = found.found
    assert best.margin > 0.0
    assert best.torque_ratio <= 1.0
    assert best.settling_time <= 2.0
    again = aj.Study(controller_of(tools, best.gains), tools, small_box).report(40)
    assert again.passed
    outcome = aj.Study(
        controller_of(tools, best.gains), tools, small_box, duration=5.0, accuracy=0.002
    ).rollouts(2)
    assert outcome.n_converged == 2
    assert max(run.settling_time for run in outcome.runs) < 4.0


def test_where_no_gains_do_it_says_how_many_meet_each_demand(tools, small_box, monkeypatch):
    monkeypatch.setattr(search, "_TARGETS", 8)
    shares = []
    found = aj.Study(controller_of(tools), tools, small_box).gains(
        0.8, configurations=20, torque_limits=8.0, test="stable",
        progress=lambda what, share: shares.append(share),
    )  # fmt: skip
    assert found.found is None
    assert shares == sorted(shares)
    assert shares[-1] == 1.0  # every candidate was tried
    met = np.array([each.met(0.8) for each in found.tried])
    assert f"{met[:, 1].sum()} start within the torque limits" in unwrapped(found)
    assert str(found).startswith("gains: none found that meet all demands")


def test_suggest_refuses(tools, small_box):
    study = aj.Study(controller_of(tools), tools, small_box)
    with pytest.raises(UnknownNameError, match="test 'lyapunov' not in the tests"):
        study.gains(test="lyapunov")
    with pytest.raises(aj.InvalidInputError, match="settling_time must be a finite number > 0"):
        study.gains(0.0)
    with pytest.raises(aj.InvalidInputError, match="torque_limits must be numbers > 0"):
        study.gains(torque_limits=-1.0)


# -- what a saturated error hides -----------------------------------------------------------


@pytest.mark.long
def test_a_saturated_error_is_looked_at_where_it_is_not():
    """With a small γ, drawn errors are all beyond it, where s is flat; motions end where it is not.

    The camera is rolled so far that the loop is unstable at many targets.
    """
    arm = paper.build_arm().with_gravity((0.0, 0.0, 0.0))
    errors = aj.Uncertainty(arm, camera=paper.CAMERA, roll=(-math.pi / 3, 0.0))
    controller = aj.SetpointController(
        errors.believed_task(), aj.Gains(5000.0, 5000.0), saturation=Sine(1e-5)
    )
    region = aj.JointBox.around(arm, (1.57, 1.57), 0.3)
    found = aj.Study(controller, errors, region).report(40)
    slopes = found.test.form.samples.slope  # that functions are chosen on
    assert (slopes > 0.5).all(axis=1).mean() > 0.25
    assert (slopes == 0.0).all(axis=1).mean() > 0.25
    assert found.refuted
    assert not found.test.certified
    scales = aj.Study(controller, errors, region).tolerance(draws=40, precision=0.05)
    assert scales["certified"].scale < scales["stable"].scale < 1.0


def test_pose_gains_that_differ_count_in_theorem_1(weightless):
    """With an exact model, p is what ∂e/∂q differs from J by; without it Theorem 1 would hold."""
    task = aj.PoseTask(weightless)
    kp = (4e4, 4e4, 4e4, 4e4, 4e3, 4e2)
    controller = aj.SetpointController(task, aj.Gains(kp, 8000.0, 20.0))
    region = aj.JointBox.around(weightless, Q, 0.3)
    loop = ClosedLoop(controller, weightless, region)
    samples = loop.draw(20, np.random.default_rng(0))
    found = theorem1(samples, loop.setting)
    assert found.p > 0.01
    assert not found.holds
    assert loop.growth(samples, None).max() < 0.0


def test_tolerance_takes_no_gravity_for_granted():
    arm = aj.load_robot("panda")
    tools = aj.Uncertainty(arm, object_length=(0.0, 0.1), object_mass=(0.0, 1.0))
    region = aj.JointBox.around(arm, Q, 0.1)
    with pytest.raises(aj.InvalidInputError, match="gravity must be compensated exactly or be lea"):
        aj.Study(controller_of(tools), tools, region).tolerance(draws=20)


def test_what_fails_is_the_camera_that_differs_most():
    """It may be rolled a little one way or far the other way, and the farthest roll fails."""
    arm = paper.build_arm().with_gravity((0.0, 0.0, 0.0))
    errors = aj.Uncertainty(arm, camera=paper.CAMERA, roll=(-0.01, 1.2))
    law = aj.SetpointController(errors.believed_task(), aj.Gains(5000.0, 10000.0, 1.0))
    study = aj.Study(law, errors, aj.JointBox.around(arm, (1.5, 1.5), 0.1))
    found = study.tolerance("stable", draws=20, precision=0.5, largest=2.0)["stable"]
    assert found.scale < found.fails_at <= 2.0
    assert_allclose(found.worst, errors.scaled(found.fails_at).high, rtol=1e-12)


def test_certificates_are_sought_among_as_many_draws_as_are_asked_for(monkeypatch):
    counts = []

    def counted(loop, held, samples, rng):
        counts.append(len(samples))
        return searched_test(loop, held, samples, rng)

    monkeypatch.setattr(tolerance, "searched_test", counted)
    arm = aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0))
    tools = aj.Uncertainty(arm, object_length=(0.0, 0.1))
    study = aj.Study(controller_of(tools), tools, aj.JointBox.around(arm, Q2, 0.2))
    for draws in (8, 80):
        counts.clear()
        study.tolerance("certified", draws=draws, largest=1.0)
        assert len(counts) == 2  # without errors, and with all of them
        assert all(draws <= count < 5 * draws for count in counts)


@pytest.mark.study
def test_what_is_not_certified_is_the_object_that_differs_most():
    """Objects may be a little shorter or much longer than believed, and the longest one fails."""
    arm = aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0))
    tools = aj.Uncertainty(
        arm, object_length=(0.099, 2.3), believed_length=0.1, object_axis=(1.0, 0.0, 1.0)
    )
    law = controller_of(tools, aj.Gains(60.0, 20.0, 2.0))
    study = aj.Study(law, tools, aj.JointBox.around(arm, Q2, 0.3))
    found = study.tolerance("certified", draws=20, precision=0.5, largest=2.0)["certified"]
    assert found.scale < found.fails_at <= 2.0
    assert_allclose(found.worst, tools.scaled(found.fails_at).high, rtol=1e-12)


@pytest.mark.study
def test_a_target_that_grown_errors_put_out_of_reach_is_where_tolerance_ends(weightless):
    tools = aj.Uncertainty(weightless, object_length=(0.0, 0.05))
    region = aj.JointBox.around(weightless, Q, 0.3)
    target = tools.plant([0.02]).sensor.value(Q)
    found = aj.Study(controller_of(tools), tools, region, target=target).tolerance(
        ("stable",), draws=4, largest=60.0
    )["stable"]
    assert 1.0 < found.scale < found.fails_at < 60.0


def test_every_corner_is_drawn_as_often(weightless):
    shifts = dict.fromkeys(weightless.joint_names[:4], (0.01, 0.0, 0.0))
    many = aj.Uncertainty(weightless, joint_shifts=shifts)
    loop = ClosedLoop(controller_of(many), many, aj.JointBox.around(weightless, Q, 0.1))
    drawn = loop.draw(20, np.random.default_rng(0))
    assert (np.bincount(drawn.truth) == [2] * 16).all()


def test_a_law_of_ones_own_is_not_certified_as_the_one_it_is_derived_from():
    class Pushed(aj.SetpointController):
        def evaluate(self, state, measurement, target):
            answer = super().evaluate(state, measurement, target)
            return answer._replace(torque=answer.torque + [3.0, 0.0])

    arm = aj.load_robot("two_link")
    errors = aj.Uncertainty(arm, lambda robot: aj.PositionTask(robot, axes="xz"))
    law = Pushed(errors.believed_task(), aj.Gains(60.0, 20.0, 1.0), gravity=aj.NoGravity(arm))
    region = aj.JointBox.around(arm, [0.3, 0.8], 0.1)
    report = aj.Study(law, errors, region).report(20)
    assert "Pushed has another evaluate; rollouts" in unwrapped(report)
    assert not report.passed
    with pytest.raises(aj.InvalidInputError, match="Pushed has another evaluate; rollouts"):
        aj.Study(law, errors, region).tolerance()


@pytest.mark.parametrize("rate", [0.0, pytest.param(3.0, marks=pytest.mark.study)])
def test_a_loop_that_grows_at_one_target_is_unstable(rate):
    """However stable it is at all others; also where it does not decay."""
    robot = aj.load_robot("two_link")
    task, q = aj.PositionTask(robot, axes="xz"), np.array([0.4, 0.9])
    law = aj.SetpointController(task, aj.Gains(50.0, 20.0, 1.0))
    plant, box = aj.Plant(robot, task), aj.JointBox.around(robot, q, 0.05)
    report = aj.Study(law, plant, box).report(20)
    assert report.contradiction == ""
    some = replace(report, growth=report.growth._replace(rate=rate))
    assert some.growth.grows
    assert some.contradiction == some.reason == "unstable"
    assert some.refuted
    assert not some.passed
    assert some.rows[0].verdict == "refuted"
    assert (some.rows[0].figures["rate"], some.rows[1].verdict) == (rate, "problem")


@pytest.mark.parametrize(("left", "diverged"), [(0, 0), (3, 0), (5, 2)])
def test_rollouts_that_diverge_contradict_a_certificate(report, left, diverged):
    runs = SimpleNamespace(n=8, n_left=left, n_diverged=diverged, rows=[])
    found = replace(report, rollouts=runs)
    headline, covers = found.rows[:2]
    assert (covers.figures["left"], covers.figures["runs"]) == (left, 8)
    if diverged:
        assert (headline.verdict, covers.verdict) == ("refuted", "problem")
        assert found.refuted
        assert (headline.figures["diverged"], headline.figures["runs"]) == (2, 8)
        assert found.reason == "rollouts diverged"
    else:
        assert (headline.verdict, covers.verdict) == ("yes", "certified")
        assert headline.figures["margin"] == report.test.margin


def test_a_test_in_continuous_time_certifies_in_continuous_time_only(report):
    in_time = continuous_test(report.loop, report.test.form.samples)
    found = replace(report, test=in_time)
    headline, covers = found.rows[:2]
    assert (headline.verdict, covers.verdict) == ("in continuous time only", "continuous")
    assert headline.figures["margin"] == in_time.margin > report.test.margin
    assert found.passed


@pytest.mark.parametrize(
    ("latency", "taken"),
    [
        (Latency(4e-3, torque_delay=9e-3, image_age=8e-3), (4e-3, 8e-3, 8e-3)),
        (Latency(2e-3, torque_delay=4e-3, image_age=5.5e-3), (2e-3, 4e-3, 6e-3)),
        (Latency(5e-3, torque_delay=1e-2, image_age=2e-2), None),
    ],
)
def test_delays_that_are_no_whole_periods_are_rounded_and_said_to_be(report, latency, taken):
    found = replace(report, latency=latency)
    row = by_name(found).get(("beware", "timing"))
    if taken is None:
        assert row is None
    else:
        names = ("period", "torque_delay", "image_age")
        assert [row.figures[name] for name in names] == pytest.approx(taken)


def test_joints_beyond_their_limits_are_named(report):
    q = report.samples.q.copy()
    q[7, 2], q[9, 5] = 3.1, -0.4
    for samples, beyond in (
        (replace(report.samples, q=q), {"joints": ["panda_joint3", "panda_joint6"]}),
        (report.samples, None),
    ):
        found = replace(report, samples=samples)
        row = by_name(found).get(("beware", "joint limits"))
        assert (row and row.figures) == beyond


@pytest.mark.parametrize(
    ("margin", "violations", "reason"),
    [(0.5, 0, ""), (RESERVE, 0, ""), (0.5, 1, "violated"), (0.9 * RESERVE, 0, "none"),
     (0.9 * RESERVE, 1, "violated"), (-1.0, 0, "none"), (-1.0, 1, "none"), (-np.inf, 0, "none")],
)  # fmt: skip
def test_why_it_is_not_certified(report, margin, violations, reason):
    """Of the least margin of what was drawn and found, and what was found elsewhere."""
    margins = np.array([margin, 2.0])
    found = replace(report, test=replace(report.test, margins=margins, violations=violations))
    assert not found.theorem1.holds
    assert found.reason == reason
    assert found.rows[0].verdict == ("not certified" if reason else "yes")
    assert not found.refuted
    assert found.passed == found.test.certified == (reason == "")
    assert by_name(found)["tests", "one function"].verdict == ("none" if reason else "holds")
