"""Reaches of the studies: what is measured of a run, the loop to compare with, and exit codes."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import reach
import reach_mujoco
import reaches
from joint_impedance import JointImpedance
from operational_space import OperationalSpace
from reaches import Case, Outcome

import approxjac as aj
from approxjac.scenario import build_scenario, run_scenario

pytestmark = pytest.mark.study


def test_the_time_is_that_from_which_on_the_error_stays():
    norms = np.array([0.5, 0.0005, 0.5, 0.0005, 0.0004])
    record = SimpleNamespace(t=np.arange(5.0), error_norm=norms)
    assert reaches.time_within(record, 1e-3) == 3.0
    assert reaches.time_within(record, 1.0) == 0.0
    assert math.isnan(reaches.time_within(record, 1e-6))


def test_a_reach_is_that_of_approxjac_simulate_and_what_the_law_asks_for_is_seen_behind_limits():
    case = Case("panda", 1, "limits", duration=0.2)
    stiff = {"limits": 0.4, "gravity": "exact", "kp": 3000.0, "kv": 100.0, "damping": 5.0}
    built = build_scenario(reaches.scenario(case, controller=stiff))
    outcome, result = reaches.run(case, built), run_scenario(built)
    assert outcome.final_error == result.run.error_norm[-1]
    assert result.peak_torque_ratio <= 1.0 + 1e-9 < outcome.asked
    assert outcome.limited > 0.0


def test_overshoot_is_the_distance_beyond_the_target():
    case = Case("two_link", 0, "free", duration=1.5)
    built = build_scenario(reaches.scenario(case, run={"start": (0.3, 0.5)}))
    wild = OperationalSpace(
        built.law.task, 12.0, 0.1, 10.0, built.q0, np.full(2, np.inf)
    )  # an integral as fast as this one swings
    outcome = reaches.run(case, replace(built, controller=wild))
    result = run_scenario(replace(built, controller=wild)).run
    way = result.error @ result.error[0]
    assert outcome.overshoot == pytest.approx(-way.min() / result.error_norm[0])
    assert outcome.overshoot > 0.05


def test_the_operational_space_loop_has_the_poles_that_it_promises():
    """With a right model and no integral e ~ (1 + ωt) exp(−ωt)."""
    arm = aj.load_robot("panda")
    plant, w = aj.Plant(arm), 8.0
    q0 = plant.ready_configuration()
    law = OperationalSpace(aj.PositionTask(arm), w, 1e9, 1e9, q0, np.full(7, np.inf))
    target = plant.sensor.value(q0) + [0.0, 0.02, -0.02]
    run = aj.simulate(plant, law, target, q0, 1.0, dt=1e-3)
    wanted = run.error_norm[0] * (1.0 + w * run.t) * np.exp(-w * run.t)
    assert run.error_norm == pytest.approx(wanted, abs=2e-4)


def test_joint_impedance_is_at_its_goal_with_the_true_model_and_beside_it_with_the_believed_one():
    built = build_scenario(reaches.scenario(Case("panda", 3, "free")))
    errors = []
    for robot in (built.plant.robot, built.law.task.robot):
        run = run_scenario(replace(built, controller=JointImpedance(built, robot))).run
        errors.append(run.error_norm[-1])
    assert errors[0] < 1e-4
    assert errors[1] > 0.05  # the tool of 20 cm is not in its inverse kinematics


def test_what_falls_short_is_named():
    done = Outcome(Case("panda", 0, "free"), 0.5, 1e-5, time=2.0, overshoot=0.0, asked=0.5)
    late = done._replace(case=Case("panda", 1, "free"), time=math.nan, reason="stuck", asked=2.0)
    assert reach.shortcomings([done] * 40) == []
    short = reach.shortcomings([done, late])
    assert "free: 50 % within 4 s, 75 % wanted" in short
    assert any(text.startswith("free: asked of the motors") for text in short)
    assert "- free, panda, seed 1: 500 -> 0.01 mm; stuck" in reaches.failures([done, late])


def test_a_run_that_diverges_falls_short():
    good = Outcome(Case("panda", 0, "sensors"), 0.5, 1e-3, rms=1e-3, asked=0.5)
    assert reach_mujoco.shortcomings([good]) == []
    assert "sensors, panda diverged" in reach_mujoco.shortcomings([good, Outcome(good.case)])


@pytest.mark.long
def test_joints_of_mujoco_have_friction_where_they_are_told_to():
    case = Case("ur5", 0, "friction", duration=3.0)
    stuck = reach_mujoco.run_case(case)
    mujoco = reaches.scenario(case, true={"engine": "mujoco"}, controller={"gravity": "exact"})
    free = reaches.run(case, build_scenario(mujoco))
    assert stuck.final_error != free.final_error
