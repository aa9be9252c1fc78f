"""Torque limits and limiters of one reach."""

import dataclasses
import json
import math

import numpy as np
import pytest

import approxjac as aj
from approxjac.studies import reach, reach_report
from approxjac.studies.limiting import limited
from approxjac.studies.reach import Settings
from approxjac.studies.watch import Watched

HOME = (0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7)
FAR = {"start": HOME, "target_offset": (0.3, -0.4, 0.3), "settling_time": 0.4, "rate": 500.0}


@pytest.fixture(scope="module")
def done():
    settings = Settings(**FAR, torque_limits="0.7", limiter="qp", gravity="exact", duration=1.0)
    return reach.run(reach.prepare("panda", settings))


def test_without_limits_the_controller_knows_none():
    ready = reach.prepare("panda", Settings(start=HOME, target_offset=(0.1, 0, 0), duration=0.1))
    assert ready.limiter is None
    result = reach.run(ready)
    assert result.tally is None
    assert result.summary()["limits"] is None
    assert "limiter" not in reach_report.text(result)
    assert len(reach_report.draw(result).axes) == 6


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        (None, aj.TorqueLimited),
        ("qp", aj.TorqueLimited),
        ("clip", aj.TorqueClipped),
        ("scale", aj.TaskTorqueScaled),
    ],
)
def test_the_controller_is_wrapped_and_the_motors_saturate_at_the_same_limits(name, kind):
    ready = reach.prepare("panda", Settings(**FAR, torque_limits="0.5", limiter=name))
    panda = aj.load_robot("panda")
    assert type(ready.limiter) is kind
    assert ready.limiter.controller is ready.controller
    assert np.array_equal(ready.limits.effort, 0.5 * panda.effort_limits)
    assert np.array_equal(ready.plant.torque_limits, 0.5 * panda.effort_limits)
    assert np.array_equal(ready.limits.velocity, panda.velocity_limits)
    assert ready.controller.gains.kp is not None
    whole = reach.prepare("panda", Settings(**FAR, torque_limits="urdf", limiter=name))
    assert np.array_equal(whole.plant.torque_limits, panda.effort_limits)


def test_what_limits_did_is_counted_in_every_step(done, tmp_path):
    reach_report.write(done, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    limits = summary["limits"]
    assert limits["steps"] == sum(limits["status_counts"].values()) == 501
    assert limits["status_counts"]["PROOF_GIVEN_UP"] > 0
    assert limits["largest_slack_W"] >= np.nanmax(done.run.slack) > 0.0
    assert limits["largest_torque_violation"] <= 1e-9
    speeds = np.abs(done.run.v) / aj.load_robot("panda").velocity_limits
    assert limits["peak_speed_ratio"] == speeds.max()
    assert summary["peak_torque_ratio"] == pytest.approx(1.0)
    assert summary["settings"]["torque_limits"] == "0.7"
    text = reach_report.text(done)
    assert "\nlimiter     qp, 0.7 of the effort limits: " in text
    assert "slack up to " in text


def test_the_picture_shows_slack_and_speeds(done):
    axes = {ax.get_title(): ax for ax in reach_report.draw(done).axes}
    assert len(axes) == 8
    assert "Slack σ of V̇ ≤ −W + σ, and status" in axes
    torque = axes["Torque of each joint"].get_lines()[0].get_ydata()
    assert torque == pytest.approx(done.run.tau[:, 0] / (0.7 * 87.0))
    speed = axes["Speed of each joint"].get_lines()[0].get_ydata()
    assert speed == pytest.approx(done.run.v[:, 0] / 2.175)


def test_a_slack_that_is_not_known_is_none():
    settings = Settings(**FAR, torque_limits="0.5", limiter="clip", duration=0.1)
    result = reach.run(reach.prepare("panda", settings))
    assert result.summary()["limits"]["largest_slack_W"] is None
    assert set(result.summary()["limits"]["status_counts"]) == {"LIMITED"}
    assert "slack not known" in reach_report.text(result)
    json.dumps(result.summary(), allow_nan=False)


def test_a_torque_that_the_limiter_lets_through_shows(done):
    strong = aj.TorqueClipped(done.reach.controller, aj.Limits(effort=1e3), dt=2e-3)
    result = reach.run(dataclasses.replace(done.reach, limiter=strong))
    assert result.tally.torque_violation > 1.0
    assert result.peak_torque_ratio > 1.0


def test_a_torque_rate_is_kept():
    settings = Settings(**FAR, torque_limits="urdf", torque_rate=500.0, duration=0.2)
    result = reach.run(reach.prepare("panda", settings))
    assert result.run.t[1] == pytest.approx(2e-3)
    assert np.abs(np.diff(result.run.tau, axis=0)).max() <= 500.0 * 2e-3 + 1e-9


def final(done, status, **changes):
    """Why a run does not converge whose end is as given."""
    n = len(done.run.t)
    still = {"v": np.zeros((n, 7)), "tau": np.zeros((n, 7)), "x": np.tile(done.run.x[-1], (n, 1))}
    still |= {"error": np.full((n, 3), 0.1), "q": np.tile(done.run.q[0], (n, 1))}
    still |= {"limit_status": np.full(n, int(status)), "status": np.zeros(n, dtype=int)}
    run = dataclasses.replace(done.run, **{**still, **changes})
    return dataclasses.replace(done, run=run, settling_time=math.nan).reason


def test_reasons_tell_what_limits_did(done):
    n, status = len(done.run.t), aj.LimitStatus
    assert final(done, status.FREE).startswith("came to rest away from its target: out of reach")
    assert final(done, status.PROOF_GIVEN_UP).endswith("held back by its limits")
    q = done.run.q[0].copy()
    q[1] = aj.load_robot("panda").position_limits[1][1]
    for last, text in ((2.8, "panda_joint1 and panda_joint2"), (0.0, "panda_joint2")):
        q[0] = 2.8973 if last else 0.0
        reason = final(done, status.PROOF_GIVEN_UP, q=np.tile(q, (n, 1)))
        assert reason == f"a dead end: came to rest at the position limits of {text}"
    torque = np.zeros((n, 7))
    torque[:, 3] = done.motor_limits[3]
    reason = final(done, status.LIMITED, tau=torque)
    assert reason == "came to rest at the torque limits: those of panda_joint4"
    moving = done.run.x[-1] + np.sin(np.arange(n))[:, None]
    assert final(done, status.LIMITED, x=moving) == "moves on at its limits without settling"
    assert final(done, status.INFEASIBLE) == status.INFEASIBLE.message
    assert final(done, status.SOLVER_FAILED) == status.SOLVER_FAILED.message
    q[1] += 0.2
    reason = final(done, status.INFEASIBLE, q=np.tile(q, (n, 1)))
    assert reason.endswith("stands still with panda_joint2 beyond its limits")


@pytest.mark.parametrize(
    ("robot", "options", "text"),
    [
        ("panda", {"limiter": "qp"}, 'limiter needs torque_limits, "urdf" or a share'),
        ("panda", {"torque_rate": 9.0}, "torque_rate needs torque_limits"),
        ("panda", {"solver": "osqp"}, "solver needs torque_limits"),
        ("panda", {"torque_limits": "full"}, "must be \"urdf\" or a positive share .* got 'full'"),
        ("panda", {"torque_limits": "-1"}, 'must be "urdf" or a positive share'),
        ("panda", {"torque_limits": "nan"}, 'must be "urdf" or a positive share'),
        ("panda", {"torque_limits": "1", "limiter": "cut"}, "limiter 'cut' not in the limiters; v"),
        (
            "panda",
            {"torque_limits": "1", "limiter": "clip", "solver": "osqp"},
            "for the limiter qp",
        ),
        ("panda", {"torque_limits": "1", "torque_rate": -1.0}, "rate must be numbers > 0"),
        ("two_link", {"torque_limits": "urdf"}, "that of two_link has none, got urdf"),
    ],
)
def test_bad_limits_are_refused(robot, options, text):
    with pytest.raises(aj.ApproxJacError, match=text):
        reach.prepare(robot, Settings(**options))


def test_an_unknown_limiter_is_refused(done):
    with pytest.raises(aj.UnknownNameError, match="limiter 'cut' not in the limiters"):
        limited(done.reach.controller, done.reach.limits, "cut")


def test_a_step_of_unknown_slack_does_not_hide_the_slack_of_others():
    class Says:
        n_state = 0

        def __init__(self, *steps):
            self.steps = iter(steps)

        def evaluate(self, state, measurement, target):
            status, slack = next(self.steps)
            zero = np.zeros(1)
            return aj.Evaluation(zero, zero, aj.Status.OK, zero, None, status, slack)

    def largest(*steps):
        watched = Watched(Says(*steps), np.ones(1))
        for k in range(len(steps)):
            watched.evaluate(np.zeros(0), aj.Measurement(float(k), *np.zeros((3, 1))), np.zeros(1))
        return watched.tally.largest_slack

    free, lost = (aj.LimitStatus.FREE, 0.0), (aj.LimitStatus.LIMITED, np.nan)
    assert largest(free, free) == 0.0
    assert largest(free, (aj.LimitStatus.PROOF_GIVEN_UP, 7.0), lost, free) == 7.0
    assert np.isnan(largest(free, lost))
