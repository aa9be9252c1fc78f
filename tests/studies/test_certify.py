"""Stability tests held against simulations: cases, soundness, tables, exit codes."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import approxjac as aj
from approxjac import cli
from approxjac.simulation import Trajectory
from approxjac.stability.closed_loop import setting_of
from approxjac.stability.matrix_form import MatrixForm, Weights
from approxjac.stability.samples import Sampler
from approxjac.studies import (
    certify,
    certify_cases,
    certify_report,
    certify_shares,
    certify_two_link,
)

CASES = certify_cases.cases(7, seed=1)


@pytest.fixture(scope="module")
def outcomes():
    return certify.run(CASES, jobs=2)


@pytest.fixture(scope="module")
def shares():
    return [certify_shares.shares(0.2, 0.03, postures=300)]


@pytest.fixture(scope="module")
def two_link():
    return certify_two_link.run()


# -- the cases ----------------------------------------------------------------------------


def test_cases_take_the_kinds_in_turn_and_follow_from_their_seed():
    cases = certify_cases.cases(15, seed=3)
    assert [case.kind for case in cases[:7]] == list(certify_cases.KINDS)
    assert cases[7].kind == certify_cases.KINDS[0]
    one, again, other = (certify_cases.build(case) for case in (cases[2], cases[2], cases[9]))
    assert np.array_equal(one.q0, again.q0)
    assert np.array_equal(one.target, again.target)
    assert one.plant.robot == again.plant.robot
    assert not np.array_equal(one.q0, other.q0)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.kind)
def test_start_and_target_are_in_the_region_and_nothing_weighs(case):
    loop = certify_cases.build(case)
    assert loop.region.contains(loop.q0)
    assert loop.region.contains(loop.q_target)
    assert not loop.plant.dynamics.g(loop.q0).any()
    for part in (loop.plant.sensor, loop.controller.task):
        assert np.linalg.matrix_rank(part.jacobian(loop.q_target)) == part.m


def test_damping_is_scaled_and_nothing_else():
    loop = certify_cases.build(CASES[3])
    damped = loop.with_damping(4.0, 16.0)
    before, after = loop.controller.diagonals, damped.controller.diagonals
    np.testing.assert_allclose(after.kp, before.kp)
    np.testing.assert_allclose(after.kv, 4.0 * before.kv)
    np.testing.assert_allclose(after.damping, 16.0 * before.damping)
    assert damped.controller.saturation is loop.controller.saturation


# -- what is measured ---------------------------------------------------------------------


def simulated(loop: certify_cases.Loop, duration: float = 0.5) -> Trajectory:
    return aj.simulate(
        loop.plant,
        loop.controller,
        loop.target,
        loop.q0,
        duration,
        record_every=duration / 2000.0,
        dt=None,
    )


@pytest.mark.parametrize("case", [CASES[1], CASES[3], CASES[5]], ids=lambda case: case.kind)
def test_the_lyapunov_function_that_is_watched_falls_as_its_matrix_says(case):
    loop = certify_cases.build(case)
    run = simulated(loop)
    setting = setting_of(loop.controller, loop.plant)
    kept = np.arange(len(run.t))
    sampler = Sampler(loop.controller, [loop.plant], loop.region, loop.target)
    seen = sampler.at(np.zeros(len(kept), dtype=int), run.q)
    m = len(setting.kp)
    rng = np.random.default_rng(0)
    weights = Weights(
        np.eye(m) + 0.3 * rng.standard_normal((m, m)),
        0.5 * rng.standard_normal((m, m)),
        setting.kp * rng.uniform(0.5, 2.0, m),
    )
    V = certify.lyapunov_values(loop, seen, setting, weights, run, kept)
    Q = MatrixForm(seen, setting).pencils(weights)[0][0]
    z = np.concatenate([run.v, seen.s], axis=1)
    rate = -np.einsum("ki,kij,kj->k", z, Q, z)
    step = run.t[1]
    measured = (V[2:] - V[:-2]) / (2.0 * step)
    smooth = slice(200, None)  # finite differences of the first transient are poor
    np.testing.assert_allclose(
        measured[smooth], rate[1:-1][smooth], atol=1e-3 * np.abs(rate[smooth]).max()
    )


def test_a_function_that_does_not_certify_is_seen_to_rise():
    loop = certify_cases.build(CASES[0])
    report = certify.assess(loop)
    weights = report.matrix["free"].weights
    wrong = {"free": replace(weights, w=weights.w * np.array([0.02, 1.0]))}
    motion = certify.move(loop, 1.0)
    assert certify.watch(loop, report, motion, {"free": weights})[0]["free"] <= 1e-7
    rises, unseen = certify.watch(loop, report, motion, wrong)
    assert rises["free"] > 1e-3
    assert unseen["free"] < 0.0


def test_no_case_contradicts_a_test(outcomes):
    assert [outcome.case for outcome in outcomes] == CASES
    assert certify_report.counterexamples(outcomes) == []
    assert any(outcome.certified["wide"] for outcome in outcomes)
    for outcome in outcomes:
        if outcome.stable and not math.isnan(outcome.near_rate):
            assert outcome.near_rate == pytest.approx(outcome.rate, rel=0.6)


def test_a_case_gives_the_same_outcome_wherever_it_runs(outcomes):
    assert certify.run_case(CASES[6]) == outcomes[6]


# -- what is told -------------------------------------------------------------------------


def test_the_table_counts_what_the_tests_certify(outcomes):
    table = certify_report.table(outcomes)
    assert "Counterexamples: 0." in table
    assert "| **all** | 7 | " in table
    for case in CASES:
        assert f"| {case.kind} | 1 | " in table


def test_every_counterexample_is_named(outcomes, two_link, shares):
    good = next(outcome for outcome in outcomes if outcome.certified["wide"] and outcome.stayed)
    bad = [
        good._replace(converged=False, damping=None),
        good._replace(rises={**good.rises, "wide": 1e-3}),
        good._replace(near_rate=-0.2),
    ]
    found = certify_report.counterexamples([good, *bad])
    assert any("wide certifies, the motion stays in the region and does not" in t for t in found)
    assert any("wide certifies, V rises by 0.001 of it within the region" in t for t in found)
    assert any("a small error dies out at -0.2/s" in text for text in found)
    assert all(text in certify_report.table(bad) for text in certify_report.counterexamples(bad))
    summary = certify_report.summary(bad, two_link, shares)
    assert summary["verdict"] == "counterexample found"
    json.dumps(summary, allow_nan=False)


def test_a_motion_that_leaves_the_region_contradicts_nothing(outcomes):
    certified = next(outcome for outcome in outcomes if outcome.certified["wide"])
    left = certified._replace(stayed=False, converged=False, damping=None)
    assert left.counterexamples == []


def test_the_command_writes_its_tables_and_tells_by_its_exit_code(
    tmp_path, monkeypatch, outcomes, two_link, shares
):
    monkeypatch.setattr(certify, "run", lambda cases, jobs, progress: outcomes)
    monkeypatch.setattr(certify_two_link, "run", lambda: two_link)
    monkeypatch.setattr(certify_shares, "run", lambda: shares)
    assert cli.main(["certify", "--cases", "7", "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "table.md", "two_link.md", "panda.md", "summary.json",
    }  # fmt: skip
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["cases"] == 7
    assert summary["counterexamples"] == []
    bad = [outcomes[0]._replace(near_rate=-outcomes[0].rate)]
    monkeypatch.setattr(certify, "run", lambda cases, jobs, progress: bad)
    assert cli.main(["certify", "--out", str(tmp_path)]) == 1


def test_bad_arguments_are_refused(capsys, tmp_path):
    with pytest.raises(aj.InvalidInputError, match="cases must be an integer >= 1, got 0"):
        certify_cases.cases(0)
    with pytest.raises(aj.InvalidInputError, match="seed must be an integer >= 0, got -1"):
        certify_cases.cases(1, seed=-1)
    with pytest.raises(aj.UnknownNameError, match="kind 'ur6' not in"):
        certify_cases.cases(1, kinds=["ur6"])
    with pytest.raises(aj.InvalidInputError, match="jobs must be at least 1, got 0"):
        certify.run([], jobs=0)
    assert cli.main(["certify", "--cases", "0", "--out", str(tmp_path)]) == 2
    assert "cases must be an integer >= 1" in capsys.readouterr().err


# -- the paper's arm ----------------------------------------------------------------------


def test_the_local_test_gives_the_eigenvalues_of_the_theory_notes(two_link):
    rates = {row["figure"]: -row["rate"] for row in two_link["figures"]}
    expected = {3: 0.0588, 4: -0.0920, 5: -0.0130, 6: -0.1276, 7: -0.0680}
    for figure, rate in expected.items():
        assert rates[figure] == pytest.approx(rate, abs=5e-5)


def test_theorem_1_certifies_no_figure_and_says_so(two_link):
    for row in two_link["figures"]:
        assert row["p"] > 10.0 * row["allowed_p"]
        assert not any("theorem1" in passed for passed in row["certified"].values())
    assert "| 4 | -0.0920/s | 0.0381 | 0.0005 |" in certify_report.two_link_table(two_link)


def test_test_2_certifies_figures_4_6_and_7_at_the_target(two_link):
    passed = {row["figure"]: row["certified"][0.0] for row in two_link["figures"]}
    assert passed[3] == ()
    assert passed[4] == ("free", "wide")
    assert passed[5] == ("wide",)
    assert passed[6] == passed[7] == ("paper", "free", "wide")


def test_the_camera_roll_that_each_test_allows(two_link):
    rolls = two_link["largest_roll"]
    assert rolls["paper"]["large_gains"] == pytest.approx(60.0, abs=0.1)
    for test in ("free", "wide", "local"):
        assert rolls[test]["large_gains"] == pytest.approx(90.0, abs=0.15)
    at_figure_4 = [rolls[test]["figure_4"] for test in certify_two_link.TESTS]
    assert at_figure_4 == pytest.approx([0.75, 49.3, 63.7, 73.0, 73.0], abs=0.1)
    # with matrices in place of alpha, nothing is lost at a single posture
    assert rolls["wide"]["figure_4"] == pytest.approx(rolls["local"]["figure_4"], abs=0.1)


# -- the Panda ----------------------------------------------------------------------------


def test_shares_of_a_pandas_postures(shares):
    row = shares[0]
    assert row.paper == pytest.approx(0.25, abs=0.08)
    assert row.half == pytest.approx(0.86, abs=0.06)
    assert row.free == pytest.approx(0.98, abs=0.03)
    assert row.paper < row.half <= row.free <= row.wide + 0.01 <= row.falling + 0.01
    assert row.local == 1.0
    assert "| 20 cm | 0.03 | " in certify_shares.table(shares)
