"""Limits of speeds and positions while gravity is learnt: a slice of the study, and its verdict."""

import limits_while_learning as study
import numpy as np
import pytest
from limits_while_learning import Case, Outcome

import approxjac as aj

KIND = Case("xarm7", "exact", 0.5, "limited", 0, 6, 0.05)


def harsh(robot, monkeypatch):
    """Laws that ask for far more than the arm may do: s(e) = e, settling in half a second."""
    belief = aj.load_robot(robot).with_object(0.0)
    task = aj.PositionTask(belief)
    law = aj.SetpointController(
        task, aj.default_gains(task, 0.5), gravity=aj.AdaptiveGravity(belief, L=0.1, alpha=8.0)
    )
    monkeypatch.setattr(study, "law_of", lambda *_: law)
    study.arm.cache_clear()


@pytest.mark.study
@pytest.mark.parametrize("robot", ["xarm7", "ur5"])
def test_speeds_and_positions_are_kept_while_what_is_learnt_is_wrong(robot, monkeypatch):
    harsh(robot, monkeypatch)
    kind = KIND._replace(robot=robot)
    outcomes = study.run_case(kind)
    far = study.run_case(kind._replace(states=0, seed=3, duration=0.4))
    assert study.shortcomings([*outcomes, *far]) == []
    assert max(o.speed for o in (*outcomes, *far)) < 1.02
    assert max(o.beyond for o in (*outcomes, *far)) < 1e-3
    clipped = study.run_case(kind._replace(limiter="clipped"))
    assert max(o.speed for o in clipped) > 1.5
    study.arm.cache_clear()


@pytest.mark.long
@pytest.mark.parametrize("robot", study.ROBOTS)
@pytest.mark.parametrize("settling_time", study.SETTLING_TIMES)
def test_every_arm_keeps_them(robot, settling_time):
    kind = KIND._replace(robot=robot, settling_time=settling_time, states=25)
    outcomes = study.run_case(kind) + study.run_case(kind._replace(states=0, duration=2.5, seed=1))
    assert study.shortcomings(outcomes) == []
    assert np.isfinite([o.speed for o in outcomes]).all()


def test_a_broken_limit_and_a_lie_about_it_are_shortcomings():
    good = Outcome(KIND, False, True, 1.0, 0.0, "FREE", "", 0.0)
    broken = good._replace(speed=1.2, broken="EXCEEDED")
    late = good._replace(counts=False, first="INFEASIBLE", speed=1.2, broken="INFEASIBLE")
    lie = late._replace(broken="FREE")
    other = broken._replace(case=KIND._replace(plant="tool"))
    assert study.shortcomings([good, late, other]) == []
    assert len(study.shortcomings([broken, lie])) == 2
    assert "| exact | limited | 2 | 2 | 1 | 0 |" in study.table([good, broken])
