"""Friction and load in a calibration's report, from torques beside the recordings of the tip."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.calibration.test_accuracy import tracked
from tests.controllers.test_learnt_axes import Arm
from tests.robots.test_dynamics_fit import DT, recorded, share_of_effort

import approxjac as aj
from approxjac.calibration import Recording, calibrate
from approxjac.cli.main import main
from approxjac.robots import fit_dynamics

PAYLOAD = 1.5  # [kg]


@pytest.fixture(scope="module")
def seen():
    return tracked(Arm("z1", 420, 1.0), np.random.default_rng(3))


@pytest.fixture(scope="module")
def motion():
    """A motion with torques, the third joint of which has no dry friction."""
    friction = share_of_effort("z1", 0.05)
    coulomb = np.array(friction.coulomb)
    coulomb[2] = 0.0
    _, q, tau, _ = recorded("z1", PAYLOAD, dataclasses.replace(friction, coulomb=coulomb))
    return Recording(q, t=DT * np.arange(len(q)), tau=tau, place="free")


@pytest.fixture(scope="module")
def found(seen, motion):
    return calibrate(aj.load_robot("z1"), [seen, motion])


def test_the_report_has_friction_and_load_with_their_deviations(seen, motion, found):
    fit = found.dynamics
    expected = fit_dynamics(found.robot, motion.q, motion.tau, DT)
    assert fit.payload == pytest.approx(expected.payload, rel=1e-3)
    assert_allclose(fit.friction.viscous, expected.friction.viscous, rtol=1e-2, atol=1e-3)
    assert abs(fit.payload - PAYLOAD) < max(0.1 * PAYLOAD, fit.payload_sd)
    assert str(fit) in str(found)
    assert "may be off by 20 %; not distinguished from zero: " in str(found)
    assert "Coulomb friction of joint3" in found.torques
    assert "Coulomb friction of joint2" not in found.torques
    assert "payload" not in found.torques
    summary = found.summary()
    assert summary["payload"] == fit.payload
    assert_allclose(summary["friction"][1], fit.friction.coulomb)
    assert_allclose(summary["friction_sd"], fit.friction_sd)
    # and of the tip a free motion shows nothing
    assert_allclose(found.learnt, calibrate(aj.load_robot("z1"), seen).learnt, atol=1e-12)


def test_times_need_not_be_equal(seen, motion):
    kept = np.sort(np.random.default_rng(4).permutation(len(motion.q))[: int(0.9 * len(motion.q))])
    some = Recording(motion.q[kept], t=motion.t[kept], tau=motion.tau[kept])
    fit = calibrate(aj.load_robot("z1"), [seen, some]).dynamics
    assert abs(fit.payload - PAYLOAD) < max(0.1 * PAYLOAD, fit.payload_sd)


def test_what_torques_cannot_show_is_said(seen, motion):
    arm = aj.load_robot("z1")
    still = Recording(np.tile(motion.q[:1], (300, 1)), t=motion.t[:300], tau=motion.tau[:300])
    unknown = np.array(motion.tau)
    unknown[:, 1] = np.nan
    for recording, words in (
        (still, "joint joint1 must move to and fro"),
        (dataclasses.replace(motion, t=None), "need torques of all joints, at times t"),
        (dataclasses.replace(motion, t=motion.t % 5.0), "at times t that increase"),
        (dataclasses.replace(motion, tau=unknown), "need torques of all joints"),
    ):
        found = calibrate(arm, [seen, recording])
        assert found.dynamics is None
        assert words in str(found)
        assert "payload" not in found.summary()
    with pytest.raises(aj.InvalidInputError, match="10 different postures, got 0 beside"):
        calibrate(arm, motion)
    with pytest.raises(aj.InvalidInputError, match=r"tau of a recording must have shape \(3, 2\)"):
        Recording(np.zeros((3, 2)), tau=np.zeros((3, 1)))


@pytest.mark.study
def test_learn_writes_the_scenario_with_them(seen, motion, found, tmp_path):
    names = aj.load_robot("z1").joint_names
    paths = [tmp_path / "tip.csv", tmp_path / "free.csv"]
    heads = [*names, "x", "y", "z"], ["t", *names, *(f"{name}.tau" for name in names), "a.v"]
    velocity = np.zeros(len(motion.q))
    columns = [*seen.q.T, *seen.x.T], [motion.t, *motion.q.T, *motion.tau.T, velocity]
    for path, head, values in zip(paths, heads, columns, strict=True):
        np.savetxt(path, np.array(values).T, delimiter=",", header=",".join(head), comments="")
    out = tmp_path / "out"
    assert main(["learn", "z1", *map(str, paths), "--out", str(out)]) == 0
    truth = aj.Scenario.load(out / "scenario.toml").true
    fit = found.dynamics
    assert truth.object.mass == pytest.approx(fit.payload, rel=1e-3)
    assert truth.friction == pytest.approx(np.mean(fit.friction.viscous), rel=1e-3)
    assert truth.coulomb == pytest.approx(np.mean(fit.friction.coulomb), rel=1e-3)
    assert "Coulomb friction of joint3" in (out / "report.txt").read_text()
    read = Recording.load(paths[1])
    assert (read.kind, read.joints[: len(names)]) == ("motion", names)
