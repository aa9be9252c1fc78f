"""`approxjac simulate`: files and options say the same, and what becomes of them."""

import json
from types import SimpleNamespace

import pytest

from approxjac.cli import main
from approxjac.robots import load_robot
from approxjac.scenario import Scenario, recommended

pytestmark = pytest.mark.usefixtures("blank_pictures")
HOME = [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7]
TOML = f"""
robot = "panda"

[true]
object = {{ length = 0.3 }}

[believed]
shifts = {{ panda_joint4 = [0.0, 0.01, 0.0] }}

[controller]
gravity = "exact"

[loop]
dt = 0.002

[run]
start = {HOME}
target = {{ offset = [0.05, -0.05, 0.05] }}
duration = 6.0
"""
OPTIONS = [
    "simulate", "panda", "--object-length", "0.3", "--believed.shifts", "panda_joint4", "0",
    "0.01", "0", "--start", *map(str, HOME), "--target-offset", "0.05", "-0.05", "0.05",
    "--gravity", "exact", "--duration", "6", "--loop.dt", "0.002",
]  # fmt: skip


def outcome(folder):
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


@pytest.fixture
def reach(tmp_path):
    path = tmp_path / "reach.toml"
    path.write_text(TOML, encoding="utf-8")
    return path


@pytest.mark.long
def test_a_file_says_the_same_as_options(reach, tmp_path, capsys):
    assert main(["simulate", str(reach), "--out", str(tmp_path / "a")]) == 0
    assert "converged\nerror " in capsys.readouterr().out
    assert main([*OPTIONS, "--out", str(tmp_path / "b")]) == 0
    assert outcome(tmp_path / "a") == outcome(tmp_path / "b")
    assert Scenario.load(reach) == Scenario.load(tmp_path / "b" / "scenario.toml")
    assert Scenario.load(reach) == Scenario.load(tmp_path / "a" / "scenario.toml")


@pytest.mark.parametrize("target", ["--target", "--run.target.at"])
def test_options_take_the_place_of_what_the_file_says(reach, tmp_path, target):
    words = [target, "0.4", "0.1", "0.5", "--duration=0.1", "--object-axis=-x"]
    assert main(["simulate", str(reach), *words, "--out", str(tmp_path)]) == 1
    found = outcome(tmp_path)
    assert found["target"] == [0.4, 0.1, 0.5]
    assert found["verdict"] == "not converged"
    assert found["scenario"]["run"]["duration"] == 0.1
    assert found["scenario"]["true"]["object"]["length"] == 0.3
    assert found["scenario"]["true"]["object"]["axis"] == "-x"  # a value that begins with a minus


@pytest.mark.parametrize(("word", "axis"), [("-1,0,1", [-1.0, 0.0, 1.0]), ("y", "y")])
def test_an_axis_is_one_word(tmp_path, word, axis):
    words = ["panda", f"--object-axis={word}", "--duration=0.01", "--out", str(tmp_path)]
    assert main(["simulate", *words]) in (0, 1)
    assert outcome(tmp_path)["scenario"]["true"]["object"]["axis"] == axis


@pytest.mark.long
def test_a_path_that_was_followed_is_no_failure(tmp_path, capsys):
    words = ["--start", *map(str, HOME), "--run.target.circle.radius", "0.1", "--duration", "1.5"]
    assert main(["simulate", "panda", *words, "--out", str(tmp_path)]) == 0
    assert "followed\nup to " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robot = 1", 'must name a robot, such as robot = "panda", got 1'),
        ("[true]", "must name a robot"),
        ("robot = ", "cannot be read as TOML"),
        ('robot = "panda"\n[true]\nobject = { lenght = 0.1 }',
         "key 'lenght' not in bad.toml [true.object]; did you mean 'length'"),
        ('robot = "panda"\n[loop]\ndt = "fast"', "loop.dt must be a number or continuous, got"),
        ('robot = "panda"\n[true]\nobject = { mass = "1" }',
         "true.object.mass must be a number, got '1' in bad.toml"),
    ],
)  # fmt: skip
def test_a_bad_file_is_one_clear_line(tmp_path, capsys, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.toml").write_text(text, encoding="utf-8")
    assert main(["simulate", "bad.toml"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "target"),
    [(["--circle", "0.1"], {"circle": {"radius": 0.1}}),
     (["--line", "0", "0.1", "0"], {"line": {"offset": [0.0, 0.1, 0.0]}})],
)  # fmt: skip
def test_a_path_has_a_short_option(tmp_path, words, target):
    saved, run = tmp_path / "scenario.toml", ["--duration", "0.01", "--out", str(tmp_path)]
    assert main(["simulate", "panda", *words, *run]) in (0, 1)
    expected = Scenario("panda", run={"target": target, "duration": 0.01})
    assert Scenario.load(saved) == recommended(expected)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], {"speed": 1.0, "port": None, "believed_length": 0.0}),
        (["--speed", "3", "--port", "7123", "--believed-length", "0.15"],
         {"speed": 3.0, "port": 7123, "believed_length": 0.15}),
    ],
)  # fmt: skip
def test_a_run_is_shown_as_the_options_say(tmp_path, monkeypatch, words, expected):
    class Shown(Exception):
        def __init__(self, believe, **given):
            self.believed, self.given = believe(0.25), given

    def run(built, progress, observer):
        raise observer

    monkeypatch.setattr("approxjac.view.LiveView", Shown)
    monkeypatch.setattr("approxjac.scenario.run_scenario", run)
    law = ("--controller.law", "setpoint")
    with pytest.raises(Shown) as caught:
        main(["simulate", "two_link", "--view", *words, *law, "--out", str(tmp_path)])
    assert caught.value.given == expected
    arm, usual = load_robot("two_link"), Scenario("two_link")
    assert caught.value.believed == arm.with_object(0.25, usual.believed.object.mass)


def test_a_law_that_learns_the_length_is_shown_without_a_slider_for_it(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr("approxjac.view.LiveView", lambda believe, **_: shown.append(believe))
    assert (
        main(["simulate", "two_link", "--view", "--duration", "0.01", "--out", str(tmp_path)]) < 2
    )
    assert shown == [None]


@pytest.mark.parametrize(("words", "dt"), [([], "continuous"), (["--view"], 1e-3)])
def test_what_is_shown_are_steps_and_nothing_else_is_changed(tmp_path, monkeypatch, words, dt):
    class Ran(Exception):
        pass

    def run(built, progress, observer):
        raise Ran(built.scenario.loop.dt)

    monkeypatch.setattr("approxjac.scenario.run_scenario", run)
    continuous = ["--loop.dt", "continuous", "--limits", "none", "--out", str(tmp_path)]
    with pytest.raises(Ran) as caught:
        main(["simulate", "two_link", *continuous, *words])
    assert caught.value.args == (dt,)


@pytest.mark.parametrize(
    ("failed", "converged", "code"), [(True, False, 1), (False, True, 0), (False, False, 0)]
)
def test_the_exit_code_tells_a_failure(tmp_path, monkeypatch, failed, converged, code):
    """Not what is too late to judge, which has neither converged nor failed."""
    result = SimpleNamespace(failed=failed, converged=converged)
    monkeypatch.setattr("approxjac.scenario.run_scenario", lambda *_: result)
    for name in ("write", "text"):
        monkeypatch.setattr(f"approxjac.scenario.outcome.{name}", lambda *_: "")
    assert main(["simulate", "two_link", "--out", str(tmp_path)]) == code
