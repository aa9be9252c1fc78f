"""The scenario of a robot that refutes: that robot and target, from within the joint limits."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from approxjac.scenario import Scenario, build_scenario, judge
from approxjac.stability.search.worst import Growth

ERRORS = {
    "object_length": (0.0, 0.2),
    "joint_shifts": {"panda_joint3": (0.01, 0.0, 0.02)},
    "joint_rotations": {"panda_joint5": (0.0, 0.1, 0.0)},
}


def refuted(at_end, rate=0.5):
    scenario = Scenario("panda").with_values(
        {"controller": {"gravity": "exact"}, "stability": ERRORS, "true": {"object": {"mass": 0.0}}}
    )
    study = judge.prepare(scenario)
    errors = study.errors
    low, high = errors.arm.position_limits
    q = high if at_end else 0.5 * (low + high)
    growth = Growth(rate, errors.high, q, 1)
    report = SimpleNamespace(growth=growth)
    return errors, growth, judge.refutation(judge.StabilityResult(scenario, study, report))


@pytest.mark.parametrize("at_end", [False, True])
def test_it_has_that_robot_and_target_and_starts_within_limits(at_end):
    errors, growth, scenario = refuted(at_end)
    built, truth = build_scenario(scenario), errors.plant(growth.values)
    q, start = growth.q, np.array(scenario.run.start)
    assert_allclose(built.plant.sensor.value(q), truth.sensor.value(q), atol=1e-9)
    assert_allclose(built.law.task.value(q), errors.believed_task().value(q), atol=1e-9)
    assert (truth.robot.beyond_limits(start[np.newaxis]) <= 1e-9).all()
    assert 0.0 < np.abs(start - q).max() < 0.02
    assert scenario.run.target.configuration == pytest.approx(tuple(q))


def test_there_is_none_where_errors_decay():
    assert refuted(False, rate=-0.1)[2] is None
