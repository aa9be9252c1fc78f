"""Every arm with a tool that its controller believes absent: cases, outcomes, table."""

import json
import math

import pytest

import approxjac as aj
from approxjac.studies import arms


def test_the_cases_are_every_arm_with_gravity_known_and_learnt():
    cases = arms.cases((), starts=20, duration=30.0)
    assert len(cases) == 2 * 20 * len(aj.robot_names())
    assert len(set(cases)) == len(cases)
    assert {case.robot for case in cases} == set(aj.robot_names())


def test_the_object_is_scaled_to_arms_that_cannot_carry_it():
    assert arms.carried_object("panda") == (0.20, 0.5)
    length, mass = arms.carried_object("so100")
    assert mass == pytest.approx(0.15 * aj.load_robot("so100").mass, abs=1e-3)
    assert length == pytest.approx(0.2 * (mass / 0.5) ** (1 / 3), abs=2e-3)


def test_outcomes_in_two_processes_are_those_of_one(tmp_path):
    cases = arms.cases(("two_link", "ur5"), starts=1, duration=8.0)
    outcomes = arms.run(cases, jobs=2)
    assert [outcome.case for outcome in outcomes] == cases
    assert outcomes[2] == arms.run_case(cases[2])
    assert outcomes[2].converged
    assert outcomes[2].final_error < 1e-3
    table, summary = arms.table(outcomes), arms.summary(outcomes)
    assert "| ur5 | 20 cm, 0.5 kg | 1 of 1 |" in table
    assert summary["verdict"] == "ok"
    json.dumps(summary, allow_nan=False)


def test_every_failure_is_named():
    case = arms.Case("panda", "exact", 3, 30.0)
    bad = arms.Outcome(case, 0.5, 0.02, math.nan, 1.5, False, "stands still")
    good = arms.Outcome(case._replace(seed=4), 0.5, 1e-5, 3.0, 0.5, True, "")
    table = arms.table([bad, good])
    assert "| 1 of 2 | 3.0 s (3.0 s) |" in table
    assert "- panda, gravity known, seed 3: 500 mm -> 20 mm; stands still" in table
    learnt = good._replace(case=case._replace(gravity="learnt"))
    summary = arms.summary([bad, good, learnt])
    assert summary["converged_gravity_known"] == 0.5
    assert summary["verdict"] == "fell short"


def test_a_divergence_is_an_outcome(monkeypatch):
    def explode(*_, **__):
        raise aj.SimulationError("it exploded")

    monkeypatch.setattr(arms.reach, "run", explode)
    outcome = arms.run_case(arms.Case("ur5", "exact", 0, 1.0))
    assert not outcome.converged
    assert outcome.reason == "it exploded"
    assert "ur5, gravity known, seed 0" in arms.table([outcome])


def test_bad_arguments_are_refused():
    with pytest.raises(aj.UnknownNameError, match="robot 'pandas' not in"):
        arms.cases(("pandas",), 1, 1.0)
    with pytest.raises(aj.InvalidInputError, match="starts must be at least 1, got 0"):
        arms.cases(("panda",), 0, 1.0)
    with pytest.raises(aj.InvalidInputError, match="duration must be a finite number > 0"):
        arms.cases(("panda",), 1, 0.0)
    with pytest.raises(aj.InvalidInputError, match="jobs must be at least 1, got 0"):
        arms.run([], jobs=0)
