"""The servo study: what is run, how it is counted, the map's verdicts, tables that can be bad."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import approxjac as aj
from approxjac.cli import main
from approxjac.controllers.tuning import position_gains
from approxjac.studies import servo, servo_map, servo_study, servo_study_report, servo_study_view
from approxjac.studies.servo_map import Cell, Decided, Watch
from approxjac.studies.servo_settings import ServoSettings
from approxjac.studies.servo_study import LAWS, ONE_POINT, SCENES, Case, Outcome
from approxjac.studies.servo_study_report import Result

CASE = Case(ONE_POINT, "law 6", 0.5, "exact", 0)
DONE = Outcome(CASE, 200.0, 0.1, 2.0, 0.5, 0.02, converged=True)
LOST = DONE._replace(
    final_error=90.0, settling_time=math.nan, converged=False, in_view=False, left_at=1.25,
    reason="a point left the camera's view: without it there are only brakes",
)  # fmt: skip
SLOW = DONE._replace(
    final_error=0.8, settling_time=math.nan, converged=False, reason="still approaching its target"
)


def cell(loop="ideal", roll=0.0, ratio=1.0, goal=0, rate=0.5, verdict="converges", singular=False):
    return Cell(loop, roll, ratio, goal, rate, singular, verdict, 3.0, 0.05, 0.3, 0.7)


def short(monkeypatch, scene, **changes):
    settings = replace(SCENES[scene].settings, **changes)
    monkeypatch.setitem(SCENES, scene, SCENES[scene]._replace(settings=settings))


# -- what is run ------------------------------------------------------------------------------


def test_the_camera_is_as_wrong_as_is_asked_with_signs_of_the_seed():
    cameras = [servo_study.wrong_camera(ServoSettings(), seed) for seed in range(60)]
    found = {(round(math.degrees(c.roll)), c.focal_factor, c.depth_factor) for c in cameras}
    assert found == {(r, f, d) for r in (-30, 30) for f in (0.7, 1.3) for d in (0.5, 1.5)}
    assert [c.seed for c in cameras] == list(range(60))
    assert cameras == [servo_study.wrong_camera(ServoSettings(), seed) for seed in range(60)]
    first = cameras[0]
    assert (first.object_length, first.believed_length) == (0.15, 0.0)
    assert (first.frame_rate, first.latency, first.noise) == (30.0, 0.03, 0.5)
    assert any(first.distortion)


def test_every_law_runs_from_the_same_starts_with_the_same_camera():
    cases = servo_study.cases(2)
    assert len(cases) == len(set(cases)) == 2 * (3 * len(LAWS) + 2 + 2)
    assert {case.gravity for case in cases} == {"exact"}
    ready = [
        servo.prepare("panda", servo_study.settings_of(CASE._replace(law=law))) for law in LAWS
    ]
    for other in ready[1:]:
        assert np.array_equal(other.q0, ready[0].q0)
        assert np.array_equal(other.q_goal, ready[0].q_goal)
        assert repr(other.controller.task) == repr(ready[0].controller.task)


def test_gains_are_those_that_a_laws_name_says():
    prepared = {
        law: servo.prepare("panda", servo_study.settings_of(CASE._replace(law=law))).controller
        for law in LAWS
    }
    gains = {
        law: controller.gains.diagonals(2, 7)
        for law, controller in prepared.items()
        if law != "IBVS"
    }

    def same(a, b, *names):
        return all(np.array_equal(getattr(gains[a], n), getattr(gains[b], n)) for n in names)

    assert same("law 5, 0.1 s, gains of law 6", "law 6", "kp", "kv", "damping")
    assert same("law 6, gains of law 5, 0.1 s", "law 5, 0.1 s", "kp", "kv", "damping")
    mixed = "law 5, 0.1 s, B_c of law 6"
    assert same(mixed, "law 6", "damping")
    assert same(mixed, "law 5, 0.1 s", "kv")
    expected = position_gains(
        prepared["law 6"].task, gains[mixed].kv, gains[mixed].damping, ServoSettings().settling_time
    )
    assert gains[mixed].kp == pytest.approx(expected)
    assert (gains["law 5, 0.3 s"].kv < gains["law 5, 0.03 s"].kv).all()
    assert prepared["law 6, gains of law 5, 0.1 s"].velocity is None
    assert prepared["law 5, 0.03 s"].velocity.time_constant == 0.03
    assert isinstance(prepared["IBVS"], aj.VelocityServo)


# -- how it is counted ------------------------------------------------------------------------


def test_seeds_go_on_until_enough_paths_stay_in_view(monkeypatch):
    tried = []

    def fake(run_case, cases, jobs, progress):
        tried.append([case.seed for case in cases])
        return [(LOST if c.seed in (0, 3, 4) else DONE)._replace(case=c) for c in cases]

    monkeypatch.setattr(servo_study, "run_in_processes", fake)
    outcomes = servo_study.must_show(4)
    assert tried == [[0, 1, 2, 3], [4, 5], [6]]
    assert len(servo_study_report.in_view(outcomes)) == 4
    assert [outcome.case.gravity for outcome in outcomes[:3]] == ["exact", "learnt", "exact"]


def test_seeds_do_not_go_on_for_ever(monkeypatch):
    monkeypatch.setattr(
        servo_study, "run_in_processes", lambda _, cases, *rest: [LOST for _ in cases]
    )
    outcomes = servo_study.must_show(2)
    assert len(outcomes) == 6
    (text,) = servo_study_report.shortcomings(Result(2, outcomes, [], []))
    assert text == "only 0 of 6 paths stayed in view, 2 wanted"


def test_a_run_that_leaves_the_view_is_told_with_its_time(monkeypatch):
    short(monkeypatch, ONE_POINT, duration=2.5)
    case = CASE._replace(law="law 5, 0.1 s, gains of law 6", noise=2.0)
    outcome = servo_study.run_case(case)
    assert not outcome.in_view
    assert not outcome.converged
    assert 1.0 < outcome.left_at < 2.5
    assert outcome.peak_torque > 1.0


def test_a_run_counts_as_its_result_says(monkeypatch):
    short(monkeypatch, ONE_POINT, duration=0.5)
    outcome = servo_study.run_case(CASE)
    result = servo.run(servo.prepare("panda", servo_study.settings_of(CASE)))
    assert outcome.in_view
    assert math.isnan(outcome.left_at)
    assert outcome.final_error == result.final_error
    assert outcome.roughness == result.torque_roughness
    assert outcome.reason == result.reason == "still approaching its target at the end"


@pytest.mark.parametrize("scene", [name for name in SCENES if "two points" in name])
def test_the_scenes_of_two_points_run(monkeypatch, scene):
    short(monkeypatch, scene, duration=0.2)
    outcome = servo_study.run_case(Case(scene, SCENES[scene].laws[-1], 0.5, "exact", 0))
    assert math.isfinite(outcome.final_error)
    assert outcome.in_view


def test_a_divergence_is_a_failure_and_no_way_out_of_the_count(monkeypatch):
    def explode(*_):
        raise aj.SimulationError("it exploded")

    monkeypatch.setattr(servo, "run", explode)
    outcome = servo_study.run_case(CASE)
    assert (outcome.in_view, outcome.converged, outcome.reason) == (True, False, "it exploded")
    assert outcome.final_error == math.inf


def test_less_than_95_of_100_fall_short():
    enough = [DONE] * 19 + [SLOW]
    assert servo_study_report.shortcomings(Result(20, enough, [], [])) == []
    found = servo_study_report.shortcomings(Result(20, [DONE] * 18 + [SLOW] * 2, [], []))
    assert found == [
        "18 of 20 starts whose path stays in view converged to within the noise, at least 95 % "
        "wanted"
    ]
    # who leaves the view counts neither way
    assert servo_study_report.shortcomings(Result(20, [*enough, LOST], [], [])) == []


# -- the map ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("roll", "verdict"), [(0.0, "converges"), (150.0, "diverges")])
def test_test_and_simulation_agree_far_from_the_boundary(roll, verdict):
    cells = servo_map.run_case(servo_map.Case(roll, 0, (4.0,)))
    assert [c.loop for c in cells] == ["ideal", "late"]
    assert {c.verdict for c in cells} == {c.predicted for c in cells} == {verdict}
    for c in cells:
        assert c.duration < 5.0
        assert math.isfinite(c.end_rate) == (verdict == "converges")


def test_an_error_grows_and_shrinks_as_fast_as_the_local_test_says():
    for roll, ratio in ((60.0, 1.0), (90.0, 2.0)):
        ready, q_goal = servo_map.prepared(roll, 0)
        controller = servo_map.with_ratio(ready, ratio)
        rate = servo_map.local_test("ideal", ready, controller, q_goal).decay_rate
        watch = servo_map.simulated("ideal", ready, controller, q_goal, 0)
        half = len(watch.errors) // 2
        seen = math.log(watch.errors[half] / watch.errors[-1]) / (0.5 * watch.duration)
        assert seen == pytest.approx(rate, rel=0.35)


def test_only_the_gain_ratio_and_the_roll_change():
    ready, q_goal = servo_map.prepared(30.0, 1)
    straight, same_goal = servo_map.prepared(0.0, 1)
    assert np.array_equal(q_goal, same_goal)
    assert ready.settings == replace(straight.settings, roll=math.radians(30.0))
    before, after = ready.controller.gains, servo_map.with_ratio(ready, 3.0).gains
    assert after.kp == pytest.approx(3.0 * np.asarray(before.kv))
    assert np.array_equal(after.kv, before.kv)
    assert np.array_equal(after.damping, before.damping)


def test_the_late_camera_is_a_delay_to_the_local_test():
    ready, q_goal = servo_map.prepared(0.0, 0)
    controller = servo_map.with_ratio(ready, 2.0)
    report = servo_map.local_test("late", ready, controller, q_goal)
    assert report.dt == 1e-3
    assert report.dead_time == pytest.approx(0.03 + 0.5 / 30.0, abs=2e-3)
    assert servo_map.local_test("ideal", ready, controller, q_goal).dt is None


def test_a_start_is_as_near_as_is_asked():
    ready, q_goal = servo_map.prepared(0.0, 0)
    target = ready.sensor.value(q_goal)
    for distance in (5.0, 20.0):
        q0 = servo_map.near_start(ready.sensor, q_goal, distance, 0)
        assert np.linalg.norm(ready.sensor.value(q0) - target) == pytest.approx(distance, rel=0.1)


@pytest.fixture(scope="module")
def scene():
    return servo_map.prepared(0.0, 0)[0]


def watched(scene, errors):
    """What a watch says of errors that it sees every 10 ms."""
    watch = Watch(scene.controller, scene.sensor, scene.target, small=1.0, large=60.0)
    try:
        for error in errors:
            watch.see(float(error))
    except Decided:
        assert watch.verdict is not None
    return watch


def test_a_run_is_decided_when_its_error_is_small_for_a_second_or_large(scene):
    t = 0.01 * np.arange(1001)
    fast = watched(scene, 20.0 * np.exp(-2.0 * t))
    assert fast.judged() == "converges"
    assert math.log(20.0) / 2.0 < fast.duration < math.log(20.0) / 2.0 + 1.0
    growing = watched(scene, 20.0 * np.exp(0.5 * t))
    assert growing.judged() == "diverges"
    assert growing.duration == pytest.approx(2.0 * math.log(3.0), abs=0.02)
    assert watched(scene, [20.0, math.nan]).judged() == "diverges"


def test_an_error_that_passes_through_zero_is_not_small(scene):
    t = 0.01 * np.arange(1001)
    swinging = watched(scene, np.abs(20.0 * np.cos(2.0 * t)))
    assert swinging.judged() == "undecided"
    assert len(swinging.errors) == len(t)


def test_what_is_slow_is_judged_by_its_trend(scene):
    t = 0.01 * np.arange(1001)
    for rate, verdict in ((-0.05, "converges"), (0.05, "diverges"), (-0.01, "undecided")):
        assert watched(scene, 20.0 * np.exp(rate * t)).judged() == verdict


def test_agreement_counts_what_both_decide():
    cells = [
        cell(),
        cell(rate=-0.5, verdict="diverges"),
        cell(rate=0.5, verdict="diverges"),
        cell(rate=-0.5, verdict="converges"),
        cell(verdict="undecided"),
        cell(singular=True),
        cell(loop="late"),
    ]
    found = servo_map.agreement(cells, "ideal")
    assert found == ("ideal", 6, 4, 2, 1, 1, 1, 1)
    assert found.share == pytest.approx(2 / 6)
    assert servo_map.agreement(cells, "late").share == 1.0
    assert math.isnan(servo_map.agreement([], "late").share)
    assert len(servo_study_report.differences(cells)) == 4
    assert servo_study_report.differences(cells[:2]) == ["- nowhere"]
    (text,) = servo_study_report.differences(cells[3:4])
    assert "the test says diverges (-0.5 1/s), simulation converges (from 5 px to 0.05" in text
    assert "at a posture 0.3 rad from the goal's, where the test says 0.7 1/s" in text


def test_the_tolerated_roll_is_where_a_rate_passes_through_zero():
    assert servo_study_report.boundary([0.0, 10.0, 20.0], [1.0, 0.5, -0.5]) == 15.0
    assert servo_study_report.boundary([0.0, 10.0], [1.0, 0.5]) == math.inf
    assert math.isnan(servo_study_report.boundary([0.0, 10.0], [-1.0, 0.5]))
    cells = [
        cell(roll=0.0, rate=1.0),
        cell(roll=10.0, rate=-1.0, verdict="undecided"),
        cell(roll=20.0, rate=-1.0, verdict="converges"),  # beyond the first that does not
        cell(roll=0.0, goal=1, rate=1.0),
        cell(roll=10.0, goal=1, rate=1.0),
        cell(roll=20.0, goal=1, rate=1.0),
    ]
    assert servo_study_report.tolerated(cells) == ("5 to all", "0 to 20")
    assert servo_study_report.tolerated(cells[:3]) == ("5", "0")


# -- tables, pictures, the command ------------------------------------------------------------


@pytest.fixture(scope="module")
def result():
    compared = [
        (DONE if law != "law 5, 0.3 s" else SLOW)._replace(
            case=CASE._replace(law=law, noise=noise), roughness=0.01 * k
        )
        for noise in (0.5, 2.0)
        for k, law in enumerate(LAWS)
    ]
    compared.append(LOST._replace(case=CASE._replace(law="IBVS", seed=1), roughness=0.0))
    cells = [
        cell(loop, roll, ratio, goal, 0.5 - roll / 60.0, "converges" if roll < 30.0 else "diverges")
        for loop in servo_map.LOOPS
        for roll in (0.0, 20.0, 40.0)
        for ratio in (1.0, 4.0)
        for goal in (0, 1)
    ]
    return Result(2, [DONE, SLOW._replace(case=CASE._replace(seed=1)), LOST], compared, cells)


def test_the_table_names_every_failure(result):
    table = servo_study_report.table(result)
    assert "**1 of 2** starts whose path stays in view converged" in table
    assert "1 more left the view" in table
    assert "- seed 1, gravity exact: 200 -> 0.8 px; still approaching its target\n" in table
    assert "without it there are only brakes, out of view from 1.25 s" in table
    assert "- law 5, 0.3 s, 2 × still approaching its target (0.5 px: seeds 0; 2 px: seeds 0)" in (
        table
    )
    assert "| 0.5 px | IBVS | 1 of 2 | – | 45 px | 0.07 N m | 0.50 | 0 | 1 |" in table
    assert "| continuous, ideal camera | 12 | 12 (100.0 %) | 0 | 0 | 0 | 0 |" in table
    assert "| 4 1/s | 30 | 20 | 30 | 20 |" in table
    assert table.count("- nowhere") == 1
    alone = servo_study_report.table(Result(1, [DONE], [], []))
    assert "Comparison" not in alone
    assert alone.count("- none") == 2


def test_the_summary_is_json_without_nan(result):
    summary = json.loads(json.dumps(servo_study_report.summary(result), allow_nan=False))
    assert summary["verdict"] == "fell short"
    assert (summary["starts_in_view"], summary["converged"]) == (2, 1)
    assert summary["starts_out_of_view"] == 1
    assert [entry["loop"] for entry in summary["agreement"]] == ["ideal", "late"]
    assert len(summary["cells"]) == 24
    assert summary["compared"][-1]["left_at"] == 1.25


def test_the_pictures_show_what_the_tables_say(result):
    noise = servo_study_view.draw_noise(result.compared)
    lines = {line.get_label(): line for line in noise.axes[0].get_lines()}
    assert set(lines) == set(LAWS)
    assert lines["law 6"].get_ydata().tolist() == [100.0, 100.0]
    assert lines["law 5, 0.3 s"].get_ydata().tolist() == [0.0, 0.0]
    figure = servo_study_view.draw_map(result.cells)
    share = figure.axes[0].collections[0].get_array()
    assert np.asarray(share).tolist() == [[1.0, 1.0, 0.0]] * 2
    single = servo_study_view.draw_map([c for c in result.cells if c.ratio == 1.0 and c.roll == 0])
    assert len(single.axes) == 3


def faked(monkeypatch, result, **changes):
    result = result._replace(**changes)
    monkeypatch.setattr(servo_study, "must_show", lambda *_: result.shown)
    monkeypatch.setattr(servo_study, "compare", lambda *_: result.compared)
    monkeypatch.setattr(servo_map, "run", lambda *_: result.cells)


def test_the_command_writes_tables_pictures_and_a_summary(tmp_path, capsys, monkeypatch, result):
    faked(monkeypatch, result, shown=[DONE, DONE])
    assert main(["servo-study", "--starts", "2", "--out", str(tmp_path)]) == 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    out = capsys.readouterr().out
    assert table in out
    assert "all shown" in out
    assert {path.name for path in tmp_path.iterdir()} == {
        "map.png", "map.svg", "noise.png", "noise.svg", "summary.json", "table.md",
    }  # fmt: skip
    assert json.loads((tmp_path / "summary.json").read_text())["verdict"] == "ok"


def test_falling_short_gives_exit_code_1(tmp_path, capsys, monkeypatch, result):
    faked(monkeypatch, result, compared=[], cells=[])
    words = ["--starts", "2", "--comparisons", "0", "--map-goals", "0"]
    assert main(["servo-study", *words, "--out", str(tmp_path)]) == 1
    assert "fell short: 1 of 2 starts whose path stays in view" in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"summary.json", "table.md"}


def test_one_start_through_the_whole_command(tmp_path, monkeypatch, capsys):
    words = ["--starts", "1", "--comparisons", "0", "--map-goals", "0", "--jobs", "1"]
    assert main(["servo-study", *words, "--out", str(tmp_path)]) == 0
    assert "**1 of 1** starts" in capsys.readouterr().out
    (run,) = json.loads((tmp_path / "summary.json").read_text())["shown"]
    assert (run["seed"], run["converged"], run["in_view"]) == (0, True, True)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--starts", "0"], "starts must be at least 1, got 0"),
        (["--comparisons=-1"], "comparisons must be at least 0, got -1"),
        (["--map-goals=-1"], "map_goals must be at least 0, got -1"),
        (["--starts", "1", "--jobs", "0"], "jobs must be at least 1, got 0"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(tmp_path, capsys, words, message):
    assert main(["servo-study", *words, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_starts_that_keep_the_limits_are_a_scene_of_their_own():
    case = servo_study.Case(servo_study.WITHIN_LIMITS, "law 6", 0.5, "exact", 0)
    assert servo_study.settings_of(case).torque_limits == "urdf"
    assert all(case.scene != servo_study.WITHIN_LIMITS for case in servo_study.cases(1))
