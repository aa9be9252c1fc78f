"""Every arm with an object that its controller believes absent: outcomes, table, exit code."""

import math
import re

import every_arm
import pytest
from common import carried_object

import approxjac as aj

pytestmark = pytest.mark.study


def test_the_object_is_scaled_to_arms_that_cannot_carry_it():
    assert carried_object("panda") == (0.20, 0.5)
    length, mass = carried_object("so100")
    assert mass == pytest.approx(0.15 * aj.load_robot("so100").mass, abs=1e-3)
    assert length == pytest.approx(0.2 * (mass / 0.5) ** (1 / 3), abs=2e-3)


@pytest.mark.long
def test_the_study_of_one_arm_in_two_processes(tmp_path):
    words = ["--robots", "ur5", "--starts", "1", "--duration", "8", "--jobs", "2"]
    assert every_arm.main([*words, "--out", str(tmp_path)]) == 0
    table = (tmp_path / "every_arm.md").read_text(encoding="utf-8")
    assert re.search(r"\| ur5 \| 20 cm, 0.5 kg \| 1 of 1 \| .* s \(.* s\) \| 1 of 1 \|", table)
    assert (tmp_path / "summary.json").exists()


def test_every_failure_is_named():
    case = every_arm.Case("panda", "exact", 3, 30.0)
    bad = every_arm.Outcome(case, 0.5, 0.02, math.nan, 1.5, False, "stands still")
    good = every_arm.Outcome(case._replace(seed=4), 0.5, 1e-5, 3.0, 0.5, True, "")
    table = every_arm.table([bad, good])
    assert "| 1 of 2 | 3.0 s (3.0 s) |" in table
    assert "- panda, gravity known, seed 3: 500 mm -> 20 mm; stands still" in table


def test_a_run_that_cannot_be_is_an_outcome(tmp_path, monkeypatch):
    def explode(*_, **__):
        raise aj.errors.SimulationError("it exploded")

    monkeypatch.setattr(every_arm, "Scenario", explode)
    monkeypatch.setattr(
        every_arm, "run_all", lambda run, cases, jobs: [run(case) for case in cases]
    )
    assert every_arm.main(["--robots", "ur5", "--starts", "1", "--out", str(tmp_path)]) == 1
    text = (tmp_path / "every_arm.md").read_text(encoding="utf-8")
    assert "- ur5, gravity known, seed 0: it exploded" in text
