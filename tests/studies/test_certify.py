"""Stability tests held against simulations: cases, soundness, tables, exit codes."""

import json

import certify
import certify_panda
import certify_two_link
import numpy as np
import pytest
import random_loops

import approxjac as aj
from approxjac.stability.certificates.matrix_form import MatrixForm, Weights
from approxjac.stability.loop.closed_loop import ClosedLoop

pytestmark = pytest.mark.study
CASES = random_loops.cases(7, seed=1)


@pytest.fixture(scope="module")
def outcome():
    return certify.run_case(CASES[0])


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.kind)
def test_a_loop_follows_from_its_case_and_nothing_weighs(case):
    loop, again = random_loops.build(case), random_loops.build(case)
    assert np.array_equal(loop.q0, again.q0)
    assert np.array_equal(loop.target, again.target)
    assert loop.plant.robot == again.plant.robot
    assert loop.region.contains(loop.q0)
    assert loop.region.contains(loop.q_target)
    assert not loop.plant.dynamics.g(loop.q0).any()
    for part in (loop.plant.sensor, loop.controller.task):
        assert np.linalg.matrix_rank(part.jacobian(loop.q_target)) == part.m


@pytest.mark.parametrize("case", [CASES[1], CASES[3]], ids=lambda case: case.kind)
def test_the_lyapunov_function_that_is_watched_falls_as_its_matrix_says(case):
    loop = random_loops.build(case)
    run = aj.simulate(
        loop.plant, loop.controller, loop.target, loop.q0, 0.5, record_every=0.5 / 2000.0, dt=None
    )
    closed = ClosedLoop(loop.controller, loop.plant, loop.region, loop.target)
    setting = closed.setting
    kept = np.arange(len(run.t))
    seen = closed.samples_at(np.zeros(len(kept), dtype=int), run.q)
    m = len(setting.kp)
    rng = np.random.default_rng(0)
    weights = Weights(
        np.eye(m) + 0.3 * rng.standard_normal((m, m)),
        0.5 * rng.standard_normal((m, m)),
        setting.kp * rng.uniform(0.5, 2.0, m),
    )
    V = certify.lyapunov(loop, seen, setting, weights, run, kept)
    Q = MatrixForm(seen, setting).pencils(weights)[0][0]
    z = np.concatenate([run.v, seen.s], axis=1)
    rate = -np.einsum("ki,kij,kj->k", z, Q, z)
    measured = (V[2:] - V[:-2]) / (2.0 * run.t[1])
    smooth = slice(200, None)  # finite differences of the first transient are poor
    np.testing.assert_allclose(
        measured[smooth], rate[1:-1][smooth], atol=1e-3 * np.abs(rate[smooth]).max()
    )


def test_nothing_contradicts_a_test_and_the_table_says_so(outcome):
    assert outcome.certified["full"]
    assert outcome.counterexamples() == []
    assert outcome.near_rate == pytest.approx(outcome.rate, rel=0.6)
    assert "Counterexamples: 0." in certify.table([outcome])


def test_every_counterexample_is_named_and_sets_the_exit_code(outcome, monkeypatch, tmp_path):
    bad = [
        outcome._replace(stayed=True, converged=False, damping=None),
        outcome._replace(rises={**outcome.rises, "full": 1e-3}),
        outcome._replace(near_rate=-0.2),
    ]
    found = [text for each in bad for text in each.counterexamples()]
    assert any("full certifies, the motion stays in the region and does not" in t for t in found)
    assert any("full certifies, V rises by 0.001 of it within the region" in t for t in found)
    assert any("a small error dies out at -0.2/s" in text for text in found)
    assert outcome._replace(stayed=False, converged=False).counterexamples() == []
    monkeypatch.setattr(certify, "run_all", lambda *_: bad)
    assert certify.main(["--out", str(tmp_path)]) == 1
    assert json.loads((tmp_path / "summary.json").read_text())["counterexamples"] == found


@pytest.mark.long
def test_the_papers_figures_4_6_and_7_are_certified_at_the_target(monkeypatch):
    monkeypatch.setattr(certify_two_link, "RADII", (0.0, 0.05))
    found = {figure: certify_two_link.verdict(figure) for figure in (3, 4)}
    assert -found[3]["rate"] == pytest.approx(0.0588, abs=5e-5)
    assert -found[4]["rate"] == pytest.approx(-0.0920, abs=5e-5)
    assert found[3]["certified"][0] == []
    assert found[4]["certified"][0] == ["free", "full"]
    for verdict in found.values():
        assert verdict["p"] > 10.0 * verdict["allowed_p"]
    assert "| 4 | -0.0920/s | 0.0381 | 0.0005 |" in certify_two_link.table(found.values(), [])


@pytest.mark.long
def test_the_camera_roll_that_each_test_allows():
    rolls = {test: certify_two_link.largest_roll(test, True) for test in ("free", "local")}
    assert rolls["free"] == pytest.approx(90.0, abs=0.15)
    assert rolls["local"] == pytest.approx(90.0, abs=0.15)
    # with matrices in place of alpha, nothing is lost here
    full, local = (certify_two_link.largest_roll(test) for test in ("full", "local"))
    assert full == pytest.approx(73.0, abs=0.1)
    assert full == pytest.approx(local, abs=0.1)


def test_shares_of_a_pandas_configurations():
    row = certify_panda.shares(0.2, 0.03, 300)
    assert row.paper == pytest.approx(0.25, abs=0.08)
    assert row.half == pytest.approx(0.86, abs=0.06)
    assert row.free == pytest.approx(0.98, abs=0.03)
    assert row.paper < row.half <= row.free <= row.wide + 0.01 <= row.falling + 0.01
    assert row.local == 1.0
