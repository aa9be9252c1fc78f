"""Visual servoing with a wrong camera: laws and gains, how runs are counted, the map of roll."""

import math

import numpy as np
import pytest
import roll_map
import visual_servoing as study
from velocity_servo import VelocityServo
from visual_servoing import LAWS, ONE_POINT, Case, Outcome

import approxjac as aj
from approxjac.controllers.gains.tuning import position_gains

pytestmark = pytest.mark.study
CASE = Case(ONE_POINT, "law 6", 0.5, "exact", 0)
DONE = Outcome(CASE, 200.0, 0.1, 2.0, 0.5, 0.02, converged=True)
LOST = DONE._replace(
    final_error=90.0, settling_time=math.nan, converged=False, in_view=False, left_at=1.25,
    reason="a point left the camera's view",
)  # fmt: skip


def test_every_law_has_the_same_start_and_the_gains_that_its_name_says():
    built = {law: study.built(CASE._replace(law=law)) for law in LAWS}
    for other in built.values():
        assert np.array_equal(other.q0, built["law 6"].q0)
        assert np.array_equal(other.target, built["law 6"].target)
    gains = {law: b.law.diagonals for law, b in built.items() if law != "IBVS"}

    def same(a, b, *names):
        return all(np.array_equal(getattr(gains[a], n), getattr(gains[b], n)) for n in names)

    assert same("law 5, 0.1 s, gains of law 6", "law 6", "kp", "kv", "damping")
    assert same("law 6, gains of law 5, 0.1 s", "law 5, 0.1 s", "kp", "kv", "damping")
    mixed = "law 5, 0.1 s, B_c of law 6"
    assert same(mixed, "law 6", "damping")
    assert same(mixed, "law 5, 0.1 s", "kv")
    task = built["law 6"].law.task
    expected = position_gains(task, gains[mixed].kv, gains[mixed].damping, 1.5)
    assert gains[mixed].kp == pytest.approx(expected)
    assert built["law 6, gains of law 5, 0.1 s"].law.velocity is None
    assert built["law 5, 0.03 s"].law.velocity.time_constant == 0.03
    assert isinstance(built["IBVS"].law, VelocityServo)


def test_the_velocity_servo_settles_as_its_rate_says_and_stops_without_a_measurement():
    panda = aj.load_robot("panda")
    servo = VelocityServo(aj.PositionTask(panda), 4.0, aj.controllers.ModelGravity(panda))
    plant, q0 = aj.Plant(panda), np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    x_d = plant.sensor.value(q0) + [0.1, 0.1, 0.0]
    run = aj.simulate(plant, servo, x_d, q0, 2.0, dt=1e-3)
    assert run.error_norm[1000] < 0.03 * run.error_norm[0]
    assert run.error_norm[2000] < 1e-3 * run.error_norm[0]
    v = np.full(7, 0.1)
    blind = servo.evaluate(np.zeros(0), aj.Measurement(0.0, q0, v, np.full(3, np.nan)), x_d)
    assert blind.status == aj.Status.MEASUREMENT_LOST
    np.testing.assert_allclose(plant.acceleration(q0, v, blind.torque), -50.0 * v, rtol=1e-9)


def test_seeds_go_on_until_enough_paths_stay_in_view_but_not_for_ever(monkeypatch):
    tried = []

    def fake(run_case, cases, jobs):
        tried.append([case.seed for case in cases])
        return [(LOST if c.seed in (0, 3, 4) else DONE)._replace(case=c) for c in cases]

    monkeypatch.setattr(study, "run_all", fake)
    outcomes = study.from_many_starts(4, ONE_POINT)
    assert tried == [[0, 1, 2, 3], [4, 5], [6]]
    assert [outcome.case.gravity for outcome in outcomes[:3]] == ["exact", "learnt", "exact"]
    monkeypatch.setattr(study, "run_all", lambda _, cases, *rest: [LOST for _ in cases])
    assert len(study.from_many_starts(2, ONE_POINT)) == 6


def test_the_tables_count_and_name_what_failed():
    table = study.shown_table([DONE, LOST])
    assert "**1 of 1** starts whose path stays in view converged" in table
    assert "- seed 0, gravity exact: 200 -> 90 px; a point left the camera's view, out of" in table
    table = study.compared_table([DONE, DONE, LOST])
    assert "| 0.5 px | law 6 | 2 of 3 | 2.0 s | 0.1 px | 0.02 N m | 0.50 | 0 | 1 |" in table
    table = study.failed_table([DONE, DONE, LOST])
    assert "- law 6, 1 × a point left the camera's view (0.5 px: seeds 0)" in table


def cell(roll, rate, verdict, loop="ideal"):
    return roll_map.Cell(loop, roll, 1.0, 0, rate, False, verdict, 3.0, 0.05, 0.3, 0.7)


def test_the_tolerated_roll_is_where_the_rate_and_the_runs_change():
    cells = [
        cell(0.0, 0.5, "converges"),
        cell(10.0, 0.1, "converges"),
        cell(20.0, -0.1, "diverges"),
    ]
    assert roll_map.tolerated(cells) == ("15", "10")
    assert roll_map.tolerated(cells[:2]) == ("all", "10")
    assert roll_map.tolerated(cells[2:]) == ("none", "none")
    late = [cell(0.0, -0.5, "converges", "late")]
    table = roll_map.table([*cells, *late])
    assert "| continuous, ideal camera | 3 | 3 (100.0 %) | 0 | 0 | 0 | 0 |" in table
    assert "goal 0: the test says diverges (-0.5 1/s), simulation converges (from 20 px" in table


def test_a_run_is_ended_once_its_fate_is_decided():
    sensor = aj.PositionTask(aj.load_robot("panda"))
    watch = roll_map.Watch(sensor, np.zeros(3), 0.1, 30.0)
    assert [watch.see(error) for error in [10.0] * 99 + [0.05] * 99] == [False] * 198
    assert watch.see(0.05)
    assert watch.judged() == "converges"
    watch = roll_map.Watch(sensor, np.zeros(3), 0.1, 30.0)
    assert watch.see(math.nan)  # behind the camera
    assert watch.judged() == "diverges"


def test_a_case_of_the_map_is_tested_and_simulated(monkeypatch):
    monkeypatch.setattr(roll_map, "RATIOS", (4.0,))
    ideal, late = roll_map.run_case(roll_map.Case(0.0, 0))
    assert (ideal.loop, late.loop) == ("ideal", "late")
    for found in (ideal, late):
        assert found.predicted == found.verdict == "converges"
        assert found.decay_rate > 0.5
