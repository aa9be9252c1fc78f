"""`approxjac stability`: what it prints, draws and writes, and what it refuses."""

import dataclasses
import json
import re
import shlex
from functools import partialmethod
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import approxjac as aj
from approxjac.cli import main
from approxjac.scenario import Scenario, judge

ROOT = Path(__file__).parents[2]
AROUND = ("0", "-0.5", "0", "-2", "0", "1.8", "0")
QUICK = ["--configurations", "20", "--runs", "1", "--map-points", "2", "--map-runs", "1"]


@pytest.fixture(scope="module", autouse=True)
def rough():
    """Tolerances from few points: their numbers are tested in tests/stability.

    And of the linearisation alone, as functions take seconds; one test has them.
    """
    with pytest.MonkeyPatch.context() as patch:
        few = {"precision": 0.3, "draws": 20}
        rough = partialmethod(aj.Study.tolerance, **few, tests=("stable",))
        patch.setattr(aj.Study, "tolerance", rough)
        yield partialmethod(rough, tests=("certified", "stable"))


def stability(tmp_path, *options, moves="0"):
    return main(["stability", *options, "--moves", moves, "--out", str(tmp_path)])


@pytest.fixture(scope="module")
def certified(tmp_path_factory, rough):
    """A small tool on a Panda; the code, and the folder that was written."""
    out = tmp_path_factory.mktemp("stability")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(aj.Study, "tolerance", rough)
        code = stability(
            out, "panda", "--object-length", "0", "0.1", "--around", *AROUND, "--radius", "0.1",
            *QUICK,
        )  # fmt: skip
    return code, out


@pytest.mark.study
def test_a_certified_set(certified):
    code, out = certified
    assert code == 0
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert (summary["certified"], summary["refuted"]) == (True, False)
    assert summary["about"]["timing"]["period"] == 1e-3
    assert summary["limits"]["certified"]["level"] > 0.0
    assert set(summary["tolerance"]) == {"certified", "stable"}
    scales = [summary["tolerance"][test]["scale"] for test in ("certified", "stable")]
    assert scales == sorted(scales)
    assert 1.0 <= scales[0] < scales[1]
    assert summary["rollouts"]["converged"]["runs"] == 1
    assert np.array(summary["map"]["share"]).shape == (2, 2)
    assert summary["scenario"]["stability"]["object_length"] == [0.0, 0.1]
    assert summary["tests"]["Theorem 1"]["verdict"] == "does not hold"
    assert summary["about"]["errors"]["errors"] == "object length 0 to 0.1 m"


@pytest.mark.study
def test_pictures_are_drawn(certified):
    from matplotlib.image import imread

    _, out = certified
    for name in ("map",):
        assert (out / f"{name}.svg").stat().st_size > 5000
        picture = imread(out / f"{name}.png")[..., :3]
        assert picture.std() > 0.05  # something is on it


@pytest.mark.study
def test_what_was_reported_is_kept_where_the_map_is_interrupted(tmp_path, monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(aj.Study, "map", interrupted)
    options = "--object-length", "0", "0.05", "--around", "30", "60", "--radius", "0.1", *QUICK
    assert stability(tmp_path, "two_link", *options) == 130
    printed = capsys.readouterr().out.rstrip("\n")
    assert printed.startswith("certified, margin ")
    assert (tmp_path / "report.txt").read_text(encoding="utf-8").rstrip("\n") == printed


@pytest.mark.long
def test_it_repeats_bit_by_bit(tmp_path):
    options = "--object-length", "0", "0.05", "--around", "30", "60", "--radius", "0.1", *QUICK
    for folder in ("one", "other"):
        stability(tmp_path / folder, "two_link", *options)
    for name in ("summary.json", "map.svg"):
        one, other = ((tmp_path / folder / name).read_bytes() for folder in ("one", "other"))
        assert one == other


@pytest.mark.study
def test_moves_are_told_and_kept(tmp_path, capsys):
    stability(
        tmp_path, "two_link", "--object-length", "0", "0.1", "--around", "0.5", "1.2", "--kp", "60",
        "--kv", "20", "--damping", "5", "--configurations", "20", "--runs", "0", "--map-points",
        "0", moves="0.1",
    )  # fmt: skip
    printed = capsys.readouterr().out
    shown, first = " ".join(printed.split()), " ".join(" ".join(printed.splitlines()[1:4]).split())
    assert "Moves of 10 cm from rest in the middle of the region: " in first
    contents = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert list(contents["moves"]) == ["+x", "+z", "-x", "-z"]
    for way, move in contents["moves"].items():
        assert (move["speed"] > 0.0) == (move["reason"] == "") == (move["verdict"] == "certified")
        assert f"|e| <= {1e3 * move['error']:.2g} mm" in shown or move["reason"]
        assert contents["verdict"]["moves"]["speeds"][way] == move["speed"]
    most = max(move["error"] for move in contents["moves"].values() if not move["reason"])
    assert f"keeps |e| <= {1e3 * most:.2g} mm" in first


@pytest.mark.long
def test_what_is_not_certified_says_what_to_change(tmp_path, capsys):
    code = stability(
        tmp_path, "panda", "--object-length", "0", "0.3", "--around", *AROUND, "--radius", "0.1",
        "--damping", "0.2", "--kp", "400", "--kv", "80", "--configurations", "20", "--runs", "0",
        "--map-points", "0",
    )  # fmt: skip
    shown = capsys.readouterr().out
    assert code == 1
    assert shown.startswith("not certified, sampled at 1 kHz: ")
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["reason"] == "none"
    assert not (tmp_path / "map.png").exists()


@pytest.mark.long
def test_camera_of_the_two_link_arm():
    scenario = Scenario(
        "two_link",
        true={"camera": {"kind": "planar"}, "object": {"length": 0.0, "mass": 0.0}},
        task={"kind": "image"},
        controller={"gravity": "exact", "kp": 5000.0, "kv": 10000.0, "damping": 1.0},
        stability={
            "roll": (-0.5, 0.5), "distance": (2.5, 3.5), "around": (1.5, 1.5), "radius": 0.1,
            "configurations": 40, "runs": 0, "map": ("error", "damping"), "map_points": 2,
            "map_runs": 1,
        },
    )  # fmt: skip
    own = judge.prepare(scenario)
    result = judge.analyse(scenario, own)
    assert own.controller.task.units == ("m", "m")
    assert result.tolerances["stable"].scale > 1.0
    assert "camera roll" in repr(own.uncertainty)
    assert judge.draw_map(result) is not None


@pytest.mark.study
def test_rollouts_are_of_the_loop_that_runs(tmp_path):
    scenario = Scenario(
        "two_link",
        sensor={"noise": 2e-3, "rate": 50.0, "delay": 0.04, "dropout": 0.1, "velocity_filter": 0.0},
        loop={"dt": 2e-3, "actuator_delay": 4e-3},
        run={"duration": 1.5, "tolerance": 0.02, "seed": 3},
        stability={
            "object_length": (0.0, 0.3), "around": (0.5, 1.2), "configurations": 20, "runs": 4,
            "map": ("error", "a"), "map_points": 2, "map_runs": 3,
        },
    )  # fmt: skip
    own = judge.prepare(scenario)
    result, loop = judge.analyse(scenario, own), own.loop()
    limits = aj.Limits(effort=loop.controller.task.robot.effort_limits)
    law = aj.TorqueLimited(loop.controller, limits)
    sensing = aj.Sensing(
        x_noise=2e-3, x_rate=50.0, x_delay=0.04, x_dropout=0.1, velocity_filter=0.0
    )
    late = aj.Study(
        law, loop.truth, loop.region, duration=1.5, accuracy=0.02, seed=3, sensing=sensing,
        latency=aj.Latency(period=2e-3, torque_delay=4e-3),
    )  # fmt: skip
    expected, found = late.rollouts(4), result.report.rollouts
    assert list(found.columns) == list(expected.columns)
    for name, column in expected.columns.items():
        np.testing.assert_array_equal(found.columns[name], column)
    ideal = dataclasses.replace(late, sensing=None).rollouts(4)
    assert (ideal.columns["final_error"] < expected.columns["final_error"]).all()
    unlimited = dataclasses.replace(late, controller=loop.controller)
    again = unlimited.map(dict(zip(result.map.names, result.map.values, strict=True)), 3)
    np.testing.assert_array_equal(result.map.share, again.share)
    shown = " ".join(judge.consequences(result, Path("out")).split())
    assert "the least and most of 4 points over error and a error 0, a " in shown
    assert shown.count("with 95 % confidence") == 2
    assert shown.endswith(f"The map is {Path('out') / 'map.png'}")
    require_written(result, tmp_path)


def require_written(result, folder):
    """The files have what was found, each as itself; and no map of another run stays."""
    (folder / "map.png").write_bytes(b"of another arm")
    judge.write(dataclasses.replace(result, map=None), folder)
    assert {path.name for path in folder.iterdir()} == {"summary.json", "scenario.toml"}
    assert Scenario.load(folder / "scenario.toml") == result.scenario
    found, written = judge.summary(result), json.loads((folder / "summary.json").read_text("utf-8"))
    assert written["map"] is None
    assert written["tolerance"] == found["tolerance"]
    assert list(found["tolerance"]) == list(result.tolerances)
    for test, tolerance in result.tolerances.items():
        fails = tolerance.fails_at if np.isfinite(tolerance.fails_at) else None
        assert found["tolerance"][test] == {
            "scale": tolerance.scale, "fails_at": fails, "worst": tolerance.worst_text,
            "errors": tolerance.uncertainty.describe_box(),
        }  # fmt: skip
    grid = result.map
    assert found["map"]["share"] == grid.share.tolist()
    assert found["map"]["intervals"] == grid.intervals.tolist()
    assert (found["map"]["x"], found["map"]["y"]) == (grid.x.tolist(), grid.y.tolist())
    law = result.report.loop.controller
    assert found["gains"]["kp"] == law.diagonals.kp.tolist()
    own = np.mean(law.diagonals.kp / law.diagonals.kv)
    axes = judge.draw_map(result).axes[:3]
    for ax, share in zip(
        axes, (grid.intervals[..., 0], grid.share, grid.intervals[..., 1]), strict=True
    ):
        (star,) = (line for line in ax.get_lines() if line.get_label() == "as given")
        assert (*star.get_xdata(), *star.get_ydata()) == pytest.approx((1.0, own))
        shown = ax.collections[0].get_array().reshape(share.shape)
        np.testing.assert_allclose(shown, share)


@pytest.mark.parametrize(("longest", "most"), [(0.3, 3.0), (5.0, 2.0)])
def test_a_map_is_of_errors_that_robots_can_have(longest, most):
    """An object of at most 10 m; and the report's own point is one of the map's."""
    arm = aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0))
    errors = aj.Uncertainty(arm, object_length=(0.0, longest), object_axis="x")
    law = aj.SetpointController(errors.believed_task(), aj.Gains(60.0, 20.0, 1.0))
    loop = aj.Study(law, errors, aj.JointBox.around(arm, (0.5, 1.2), 0.1)).loop()
    scales = judge._values("error", loop, errors, 5)
    assert (scales[0], scales[-1]) == pytest.approx((0.0, most), rel=1e-4)
    assert 1.0 in scales
    for name, own in (("a", 3.0), ("kv", 1.0), ("damping", 1.0)):
        values = judge._values(name, loop, errors, 6)
        assert (values[0], values[-1]) == pytest.approx((0.1 * own, 10.0 * own))
        assert np.isclose(values, own).sum() == 1
        assert (np.diff(values) > 0.0).all()


@pytest.mark.parametrize(
    ("given", "tolerance"),
    [
        ({}, 1e-3),
        ({"sensor": {"noise": 2e-3}}, 6e-3),
        ({"sensor": {"noise": 2e-3}, "run": {"tolerance": 1e-4}}, 1e-4),
        ({"task": {"kind": "image"}, "sensor": {"noise": 0.01}}, 0.5),
        ({"task": {"kind": "image"}, "sensor": {"noise": 1.0}}, 3.0),
    ],
)
def test_rollouts_converge_to_within_the_noise(given, tolerance):
    scenario = Scenario("two_link").with_values(given)
    assert judge.prepare(scenario).accuracy == pytest.approx(tolerance)


def test_gravity_may_be_learnt_or_not_be_felt():
    def loop(gravity):
        ranges = {"object_length": (0.0, 0.1)}
        scenario = Scenario("panda", controller={"gravity": gravity}, stability=ranges)
        return judge.prepare(scenario).loop()

    assert loop("learnt").controller.adaptation is not None
    assert not loop("exact").truth.arm.gravity.any()


@pytest.mark.parametrize(
    ("gravity", "why"),
    [
        ("believed", "the error does not go to 0 but to where K_p makes up for it"),
        ("learnt", "no learnt gravity parameters explain up to "),
    ],
)
def test_gravity_of_a_tilted_base_is_a_report_and_no_bad_input(gravity, why):
    tilt = {"joint_rotations": {"shoulder_pan_joint": (0.1, 0.0, 0.0)}}
    small = {"configurations": 20, "runs": 0, "map_points": 0}
    scenario = Scenario("ur5", controller={"gravity": gravity}, stability=tilt | small)
    result = judge.analyse(scenario, judge.prepare(scenario))
    assert not result.report.gravity_is_exact
    assert (result.tolerances, result.map) == ({}, None)
    assert why in " ".join(str(result.report).split())
    proof = "No proof was found. The loop may still be stable" in str(result.report)
    assert proof == (gravity == "learnt")  # the learnt task force may take it up
    assert ("a problem found in the loop" in str(result.report)) != proof
    faster = result.report.growth._replace(rate=1.0)
    growing = dataclasses.replace(result.report, growth=faster)
    assert "a problem found in the loop" in str(growing)
    assert "map" not in judge.consequences(result, Path("out"))


def test_several_points_are_combined_in_the_controller_and_in_the_truth():
    for ranges in ({}, {"roll": (-0.1, 0.1)}):
        scenario = Scenario(
            "panda", task={"kind": "image", "points": 2}, controller={"gravity": "exact"},
            stability=ranges,
        )  # fmt: skip
        own = judge.prepare(scenario)
        for plant in own.loop().plants:
            plant.require_task(own.controller.task)
        assert (judge.uncertainty_of(own) is not None) == bool(ranges)


def test_without_ranges_it_looks_at_the_true_robot():
    scenario = Scenario("panda", sensor={"noise": 1e-3}, controller={"limits": 0.5})
    own = judge.prepare(scenario)
    (plant,) = own.loop().plants
    assert plant.robot == aj.load_robot("panda").with_object(0.2, 0.5)
    assert plant.sensing is None
    assert judge.uncertainty_of(own) is None


def test_regions():
    arm = aj.load_robot("panda")
    joints = tuple(float(q) for q in AROUND)

    def region(**analysis):
        return judge.prepare(Scenario("panda", stability=analysis)).region

    assert region(around=joints, radius=0.1).contains(arm.configuration(joints) + 0.1)
    assert isinstance(region(), aj.stability.RegularPart)
    regular = region(around=joints, sigma_min=0.1)
    assert isinstance(regular, aj.stability.RegularPart)
    assert isinstance(regular.region, aj.JointBox)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--kp", "0"], "--kp must be a finite number > 0"),
        (["--object-length", "0.3", "0.1"], "--object-length must be (smallest, largest)"),
        (["--object-mass", "-1", "1"], "--object-mass must be a finite number >= 0"),
        (["--sigma-min", "50"], "the region is empty"),
        (["--target", "9", "9", "9"], "target must be within reach of every true robot"),
        (["--around", "0", "0"], "--around must be 7 numbers"),
        (["--map", "error", "b"], "parameter 'b' not in the map"),
        (["--map-points", "1"], "--map-points must be 0 or >= 2, got 1"),
        (
            ["--configurations", "3"],
            "configurations must be a finite number >= 20, got 3",
        ),
        (["--jobs", "0"], "jobs must be >= 1, got 0"),
        (["--radius", "0"], "--radius must be a finite number > 0"),
        (["--stability.roll", "-0.1", "0.1"], "--stability.roll needs --task.kind image"),
    ],
)
def test_bad_input_is_one_clear_line(tmp_path, capsys, options, text):
    given = options if "--object-length" in options else ["--object-length", "0", "0.1", *options]
    quick = [word for word in ("--runs", "0") if "--runs" not in options]
    if "--configurations" not in options:
        quick += ["--configurations", "20"]
    assert stability(tmp_path, "panda", *given, *quick) == 2
    error = capsys.readouterr().err
    assert error.startswith("approxjac: ")
    assert error.count("\n") == 1
    assert text in error


@pytest.mark.long
def test_without_errors_there_is_nothing_to_scale(tmp_path, capsys):
    quick = ["--around", *AROUND, "--configurations", "20", "--runs", "0"]
    assert stability(tmp_path, "panda", *quick) == 0
    assert "Theorem 1     holds   Jacobian error p = 0 <" in capsys.readouterr().out
    assert not (tmp_path / "map.png").exists()


@pytest.mark.long
def test_a_region_without_full_rank_is_never_said_to_be_certified(tmp_path, capsys):
    code = stability(
        tmp_path, "two_link", "--object-length", "0", "0.1", "--around", "0.3", "0.1", "--radius",
        "0.3", "--configurations", "20", "--runs", "0", "--map-points", "0",
    )  # fmt: skip
    shown = capsys.readouterr().out
    assert code == 1
    assert shown.startswith("not certified, ")
    assert "the estimated Jacobian loses rank in the region" in shown
    assert "certifies it" not in shown


@pytest.mark.long
def test_no_map_of_another_run_stays(tmp_path):
    (tmp_path / "map.png").write_bytes(b"of another arm")
    stability(
        tmp_path, "two_link", "--object-length", "0", "0.1", "--around", "0.3", "1.0", "--radius",
        "0.1", "--configurations", "20", "--runs", "0", "--map-points", "0",
    )  # fmt: skip
    assert not (tmp_path / "map.png").exists()


def _shell_commands():
    """Commands of pages that only shells run: those of console blocks are run as tests."""
    for page in [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md"]:
        for block in re.findall(r"^```sh\n(.*?)^```", page.read_text("utf-8"), re.M | re.S):
            for line in block.splitlines():
                if line.startswith(("approxjac stability ", "approxjac simulate ")):
                    yield pytest.param(shlex.split(line)[1:], id=f"{page.name}: {line[:60]}")


@pytest.mark.parametrize("words", list(_shell_commands()))
def test_commands_of_the_pages_get_as_far_as_the_work(words, tmp_path, monkeypatch):
    class Works(Exception):
        pass

    def work(*_, **__):
        raise Works

    monkeypatch.setattr(judge, "analyse", work)
    monkeypatch.setattr("approxjac.scenario.run_scenario", work)
    monkeypatch.chdir(tmp_path)
    words = [str(ROOT / word) if (ROOT / word).is_file() else word for word in words]
    with pytest.raises(Works):
        main([word for word in words if word != "--view"])


def test_joint_errors_are_of_the_arm_whose_tip_the_law_commands():
    given = {"joint_shifts": {"joint1": (0.0, 0.0, 0.02)}}
    scenario = Scenario("two_link").with_values({"stability": given})
    loop = judge.prepare(scenario).loop()
    assert loop.truth.names == ("joint1 shift z",)  # and no object that nobody asked for
    task, sensor = loop.controller.task, loop.truth.plant([0.02]).sensor
    assert sensor.frame == task.frame
    assert sensor.value([0.0, 0.0]) - task.value([0.0, 0.0]) == pytest.approx([0.0, 0.02])


def test_a_map_is_drawn_with_both_ends_of_its_interval():
    x, y, rng = np.array([0.5, 1.0, 2.0]), np.array([0.3, 3.0]), np.random.default_rng(6)
    low, share, high = np.sort(rng.random((3, 2, 3)), axis=0)
    grid = SimpleNamespace(
        names=("a", "damping"), x=x, y=y, share=share, intervals=np.stack([low, high], axis=-1)
    )
    controller = aj.SetpointController(aj.PositionTask(aj.load_robot("two_link"), axes="xz"))
    result = SimpleNamespace(
        map=grid,
        report=SimpleNamespace(loop=SimpleNamespace(controller=controller)),
        scenario=SimpleNamespace(stability=SimpleNamespace(map_runs=7)),
        study=SimpleNamespace(errors=SimpleNamespace(describe_box=lambda: "none")),
    )
    figure = judge.draw_map(result)
    for ax, expected in zip(figure.axes, (low, share, high), strict=False):
        np.testing.assert_allclose(ax.collections[0].get_array().reshape(2, 3), expected)
    assert judge.draw_map(SimpleNamespace(map=None)) is None
