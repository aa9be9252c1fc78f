"""The study beside Marinho and Adorno's control: their model is the arm, and they learn it."""

import json

import compare_adaptive as study
import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj

pytestmark = pytest.mark.study
THEIRS = "marinholab.papers.tro2022.adaptive_control"
MISSING = "marinholab-papers-tro2022-adaptivecontrol is not installed"


def test_their_model_is_the_drawing():
    pytest.importorskip(THEIRS, reason=MISSING)
    panda, rng = aj.load_robot("panda"), np.random.default_rng(0)
    model = study.their_model(panda)
    for q in rng.uniform(-2.0, 2.0, (20, 7)):
        true = study.placed(panda, q)
        there = study.their_pose(true.rotation, true.translation)
        # of two that are one placement
        way = np.sign(np.dot(model.fkm(q).q[:4], there.q[:4]))
        assert_allclose(way * model.fkm(q).q, there.q, atol=1e-9)


def test_they_learn_what_is_near(tmp_path):
    """With exact poses, and only a tool of 1 cm and a tracker turned by 10° unknown."""
    pytest.importorskip(THEIRS, reason=MISSING)
    words = ["--settings", "pose", "--laws", study.FREE, "--seeds", "1"]
    assert study.main([*words, "--out", str(tmp_path)]) == 0
    text = (tmp_path / "compare_adaptive.md").read_text(encoding="utf-8")
    assert text.count("| pose | theirs, tuned and free |") == 1
    ((_, _, (run,)),) = json.loads((tmp_path / "summary.json").read_text())["cells"]
    assert run["early"] < 5.0  # mm, of 40 to 60 at first
    assert run["40"] < 100.0


def test_the_setup_is_one_that_both_can_follow():
    arm = study.Panda("near", 20)
    for t in (0.0, 7.0, 31.0):
        q = arm.planned(t)
        off = np.linalg.norm(arm.tracker.value(q) - arm.path.at(t).x)
        assert off < 0.1  # by the tracker, the tool and the errors of the arm
    low, high = arm.belief.position_limits
    planned = np.array([arm.planned(t) for t in np.linspace(0.0, 40.0, 200)])
    assert (planned > low).all()
    assert (planned < high).all()
    assert np.abs(np.diff(planned, axis=0)).max() < 0.5
