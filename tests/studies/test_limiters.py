"""The study of limiters: cases, what is measured of a run, and a verdict that can be bad."""

import json
import math

import numpy as np
import pytest

import approxjac as aj
from approxjac.studies import limiters, limiters_report, reach
from approxjac.studies.decrease import Decrease, decrease, excess
from approxjac.studies.limiters import Case, Outcome

CASE = Case("two_link", 0.35, 0, 1.0)  # motors too weak for what the law asks


@pytest.fixture(scope="module")
def ready():
    return limiters.prepare(CASE)


@pytest.fixture(scope="module")
def outcomes():
    return {outcome.limiter: outcome for outcome in limiters.run_case(CASE)}


class Wrapped:
    """A controller whose answers are changed."""

    def __init__(self, controller, change):
        self.controller, self.change = controller, change
        self.task, self.n_state = controller.task, controller.n_state

    def initial_state(self, measurement):
        return self.controller.initial_state(measurement)

    def evaluate(self, state, measurement, target):
        return self.change(self.controller.evaluate(state, measurement, target))


def outcome_of(ready, change, name="qp"):
    def make(ready):
        return Wrapped(aj.TorqueClipped(ready.controller, ready.limits), change)

    return limiters.run_limiter(CASE, name, ready, make)


def test_the_cases_are_every_arm_at_every_scale():
    cases = limiters.cases((), (), starts=15, duration=10.0)
    assert len(cases) == len(set(cases)) == 15 * 5 * 3 > 200
    assert {case.robot for case in cases} == {"panda", "xarm7", "two_link"}
    assert {case.scale for case in limiters.cases(("panda",), (0.4, 0.4), 1, 1.0)} == {0.4}


def test_a_start_and_target_can_be_held_with_the_scaled_limits(ready):
    robot, limits = ready.plant.robot, ready.limits
    assert np.array_equal(ready.plant.torque_limits, limits.effort)
    assert (np.abs(ready.plant.dynamics.g(ready.q0)) <= 0.7 * limits.effort).all()
    gravity = ready.controller.gravity.torque(ready.q0)
    assert gravity == pytest.approx(ready.plant.dynamics.g(ready.q0), abs=1e-12)
    assert robot == aj.load_robot("two_link").with_object(0.2, 0.5, axis="x")
    assert ready.controller.task.robot == aj.load_robot("two_link").with_object(0, 0, axis="x")
    strong = limiters.prepare(CASE._replace(scale=1.0)).limits
    assert limits.effort == pytest.approx(0.35 * np.asarray(strong.effort))
    assert np.array_equal(limits.velocity, strong.velocity)


def test_limits_that_a_urdf_does_not_know_come_from_the_weight_of_the_arm(ready):
    truth = ready.plant.robot
    limits = limiters.full_limits(truth)
    heaviest = np.abs(ready.plant.dynamics.g(np.zeros(2)))  # stretched out along the horizontal
    assert limits.effort == pytest.approx(2.0 * heaviest, rel=0.01)
    assert limits.velocity.tolist() == [3.0, 3.0]
    panda = aj.load_robot("panda")
    assert np.array_equal(limiters.full_limits(panda).effort, panda.effort_limits)
    assert np.array_equal(limiters.full_limits(panda).velocity, panda.velocity_limits)


def test_every_limiter_runs_the_same_reach(outcomes):
    assert list(outcomes) == ["qp", "qp-torque", "clip", "scale", "tanh"]
    ran = [outcome for outcome in outcomes.values() if outcome.statuses]
    assert len({outcome.start_error for outcome in ran}) == 1
    for outcome in ran:
        assert sum(outcome.statuses.values()) == 1001  # each step once, the first one too
        assert outcome.torque_violation <= 1e-9
        assert outcome.peak_torque == pytest.approx(1.0)
        assert outcome.proof.breaches == 0
        assert outcome.proof.instants + outcome.proof.singular > 90
    assert outcomes["clip"].proof.largest_excess > 100.0
    assert outcomes["clip"].peak_speed > 1.5 > outcomes["qp"].peak_speed


def test_the_qp_reports_what_it_takes_from_the_proof(outcomes):
    qp, clip = outcomes["qp"], outcomes["clip"]
    assert qp.statuses["PROOF_GIVEN_UP"] > 0
    assert qp.largest_slack >= qp.proof.largest_excess * (1.0 - 1e-6) > 0.0
    assert math.isnan(clip.largest_slack)
    assert set(clip.statuses) <= {"FREE", "LIMITED"}


def test_a_limiter_that_cannot_be_made_is_an_outcome(outcomes):
    tanh = outcomes["tanh"]  # whose bound leaves nothing above gravity with such motors
    assert tanh.statuses == {}
    assert tanh.proof is None
    assert not tanh.converged
    assert "must leave something above gravity" in tanh.reason
    assert "refused" in limiters_report.table(list(outcomes.values()))


def test_the_bounded_law_runs_where_motors_are_strong():
    case = Case("two_link", 1.0, 0, 0.2)
    ready = limiters.prepare(case)
    outcome = limiters.run_limiter(case, "tanh", ready, limiters.makers()["tanh"])
    assert outcome.statuses == {"UNLIMITED": 201}
    assert outcome.torque_violation == 0.0
    assert outcome.proof is None


def test_finite_differences_of_V_agree_with_the_identity(ready):
    rng = np.random.default_rng(0)
    plant = aj.Plant(ready.plant.robot, ready.plant.sensor)
    controller, alpha = ready.controller, 0.7
    for _ in range(20):
        q, v = rng.uniform(0.4, 2.0, 2), rng.normal(size=2)
        tau = rng.normal(size=2) * 50.0
        value, error = excess(plant, controller, alpha, q, v, tau, ready.target)
        measurement = aj.Measurement(0.0, q, v, plant.sensor.value(q))
        answer = controller.evaluate(np.zeros(0), measurement, ready.target)
        y = controller.passive_output(answer, v, alpha)
        assert value == pytest.approx(y @ (tau - answer.torque), abs=error)
        assert error < 1e-6 * max(1.0, abs(value))


def test_a_limiter_that_lies_about_its_slack_is_caught(ready, outcomes):
    def lie(answer):
        return answer._replace(limit_status=aj.LimitStatus.PROOF_KEPT, slack=0.0)

    liar = outcome_of(ready, lie)
    assert liar.proof.breaches > 10
    assert liar.proof.largest_breach > 100.0
    (short,) = limiters_report.shortcomings([liar, outcomes["clip"]])
    assert "V̇ was above −W by more than the slack that was reported" in short
    assert limiters_report.shortcomings([outcomes["qp"], outcomes["clip"]]) == []


def test_a_limiter_that_breaks_a_limit_is_caught(ready, outcomes):
    strong = outcome_of(ready, lambda answer: answer._replace(torque=1.001 * answer.torque))
    assert strong.torque_violation > 1e-3
    assert strong.peak_torque == pytest.approx(1.001)
    shortcomings = limiters_report.shortcomings([strong, outcomes["clip"]])
    assert any("went beyond a torque limit by" in text for text in shortcomings)


def test_a_slack_that_covers_the_excess_is_no_breach(ready):
    run = reach.run(ready.__class__(**{**vars(ready), "limiter": limiters.makers()["clip"](ready)}))
    plant = aj.Plant(ready.plant.robot, ready.plant.sensor)
    effort = np.asarray(ready.limits.effort)
    found = decrease(plant, ready.controller, 1.0, run.run, effort, instants=20)
    assert found.instants + found.singular == 20
    assert found.risen > 5
    assert found.breaches == 0  # LIMITED claims nothing
    assert found.largest_excess > 100.0 > 0.1 > found.error


def made_up(limiter, scale, within, **changes):
    proof = Decrease(100, 0, 5, 20.0, 1e-6, 1e-9, 0, -1.0)
    outcome = Outcome(
        Case("panda", scale, 3, 10.0), limiter, 0.5, 1e-5, 2.0, within, within,
        "" if within else "a dead end: came to rest at the position limits of joint2",
        1.0, 0.0, 1.2, 0.0, {"FREE": 90, "PROOF_KEPT": 10}, 0.0, proof,
    )  # fmt: skip
    return outcome._replace(**changes)


def test_fewer_runs_within_joint_limits_than_with_clip_is_a_shortcoming():
    outcomes = [made_up("qp", 1.0, True), made_up("clip", 1.0, True)]
    assert limiters_report.shortcomings(outcomes) == []
    outcomes += [made_up("qp", 0.3, False), made_up("clip", 0.3, True)]
    (short,) = limiters_report.shortcomings(outcomes)
    assert short.startswith("at 0.3 of the limits fewer runs converged within the joints' limits")
    assert limiters_report.summary(outcomes)["verdict"] == "fell short"


def test_every_kind_of_failure_is_named():
    outcomes = [
        made_up("qp", 0.5, False),
        made_up("qp", 0.5, True),
        made_up("clip", 0.5, False, converged=True, reason="", position_excess=2.0),
        made_up("clip", 0.3, False, reason="within the tolerance since 9.7 s only, too late"),
    ]
    text = "\n".join(limiters_report.failures(outcomes))
    assert "- qp, 1 × a dead end (1 at 0.5); such as panda, seed 3: 500 -> 0.01 mm" in text
    assert (
        "- clip, 1 × done, but with a joint more than 0.01 rad beyond its position limits" in text
    )
    assert "- clip, 1 × within the tolerance too late to judge (1 at 0.3)" in text
    assert limiters_report.failures(outcomes[1:2]) == ["- none"]


def test_the_table_and_the_summary_hold_all_numbers(outcomes):
    mine = [made_up("qp", 0.5, True), made_up("clip", 0.5, False), *outcomes.values()]
    table = limiters_report.table(mine)
    assert "| panda | × 0.5 | 1 | 1 (1) | 0 (0) | – |" in table
    assert "| **all** | × 0.35 | 1 |" in table
    assert (
        "| × 0.5 | qp | 2.0 s | 5 % | 20 W | 1.00 | 0 | 1.20 (1.2) | 0.000 rad | 90 / 0 / 10"
        in table
    )
    summary = json.loads(json.dumps(limiters_report.summary(mine), allow_nan=False))
    assert summary["verdict"] == "ok"
    assert summary["starts"] == 2
    assert len(summary["runs"]) == len(mine)
    first = summary["runs"][0]
    assert (first["robot"], first["seed"], first["limiter"]) == ("panda", 3, "qp")
    assert first["proof"]["breaches"] == 0
    assert {row["limiter"] for row in summary["rows"]} == set(outcomes)


def test_the_picture_has_a_column_for_each_arm(outcomes):
    mine = [made_up("qp", scale, scale > 0.4) for scale in (1.0, 0.5, 0.3)]
    figure = limiters_report.draw([*mine, *outcomes.values()])
    assert len(figure.axes) == 6
    lines = {line.get_label(): line for line in figure.axes[0].get_lines()}
    assert lines["qp"].get_xdata().tolist() == [1.0, 0.5, 0.3]
    assert lines["qp"].get_ydata().tolist() == [100.0, 100.0, 0.0]


def test_outcomes_in_two_processes_are_those_of_one():
    cases = limiters.cases(("two_link",), (0.5, 1.0), starts=1, duration=0.2)
    told = []
    outcomes = limiters.run(cases, jobs=2, progress=lambda: told.append(1))
    assert len(told) == 2
    assert [o.case for o in outcomes] == [case for case in cases for _ in range(5)]
    alone = limiters.run_case(cases[1])
    assert repr(outcomes[5:]) == repr(alone)  # NaN is not equal to itself


def test_a_divergence_is_an_outcome(monkeypatch, ready):
    def explode(*_, **__):
        raise aj.SimulationError("it exploded")

    monkeypatch.setattr(limiters.reach, "run", explode)
    outcome = limiters.run_limiter(CASE, "clip", ready, limiters.makers()["clip"])
    assert outcome.reason == "it exploded"
    assert not outcome.within


def test_bad_arguments_are_refused(monkeypatch):
    with pytest.raises(aj.UnknownNameError, match="robot 'pandas' not in"):
        limiters.cases(("pandas",), (), 1, 1.0)
    with pytest.raises(aj.InvalidInputError, match="starts must be at least 1, got 0"):
        limiters.cases((), (), 0, 1.0)
    with pytest.raises(aj.InvalidInputError, match="scales must be a finite number > 0"):
        limiters.cases((), (0.5, 0.0), 1, 1.0)
    with pytest.raises(aj.InvalidInputError, match=r"duration must be a finite number >= 0\.1"):
        limiters.cases((), (), 1, 0.0)
    monkeypatch.setattr(limiters, "_TRIES", 100)
    with pytest.raises(aj.InvalidInputError, match="that its motors can hold"):
        limiters.prepare(Case("panda", 0.01, 0, 1.0))
