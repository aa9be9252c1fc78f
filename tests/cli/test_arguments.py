"""What is typed wrong: exit code 2, one line with the user's option, the value, what is valid."""

import types
from operator import attrgetter
from typing import Literal, Union, get_args, get_origin

import pytest

from approxjac.cli import main, options
from approxjac.cli.simulate_command import simulate
from approxjac.scenario import Scenario
from approxjac.scenario.convert import Words, converted

# Words → the option (or word) that is named, the value that was given, and what would be valid.
CASES = """
simulat panda | command 'simulat' | simulate
--bogus | option '--bogus' | export, learn, paper, robots, simulate, stability, view
simulate | simulate needs the name of an arm | got none | .urdf
simulate panda ur5 | the name of an arm | got panda ur5
simulate pando | robot 'pando' | did you mean 'panda'
simulate panda --settling-tim | '--settling-tim' | did you mean '--settling-time'
simulate ur5 --controller.gravty none | '--controller.gravty' | mean '--controller.gravity'
simulate panda --objct-length 1 | '--objct-length' | '--object-length'
simulate panda --object-length | --object-length must be a number | got nothing | , m
simulate panda --object-length long | --object-length must be a number | got long
simulate panda --object-length nan | --object-length must be a finite number >= 0 | got nan
simulate panda --object-length 15 | --object-length | got 15 | at most 10 [m]
simulate panda --believed.object.radius 15 | --believed.object.radius | got 15 | at most 10 [m]
stability panda --object-length 0 20 | --object-length | got 20 | at most 10 [m]
stability panda --object-mass 0 1e300 | --object-mass | got 1e+300 | at most 10000 [kg]
stability panda --object-length 0 1 --believed-length 15 | --believed-length | got 15 | 10 [m]
stability panda --object-length 0.12 0.18 | --object-length | 0.12 | 0.18 | 0 [m]
stability panda --object-mass 1 2 | --object-mass | 1.0 | 2.0 | 0 [kg]
simulate panda --believed-length -0.1 | --believed-length | got -0.1 | >= 0
simulate panda --believed.object.length -0.1 | --believed.object.length | got -0.1 | >= 0
simulate panda --believed-length=-0.1 | --believed-length | got -0.1 | >= 0
simulate panda --kp 0 | --kp | got 0.0 | > 0
simulate panda --kp 1 2 | --kp | 2 | 3
simulate ur5 --kv=20 30 40 | option '30' | simulate --help-all
simulate panda --kv 400 a | --kv must be numbers | got 400 a | one per task coordinate
simulate panda --kp --seed 1 | --kp must be numbers | got nothing
simulate panda --controller.unknown | --controller.unknown must be words | got nothing
simulate panda --out | --out must be a path | got nothing
simulate panda --damping -1 | --damping | got -1.0 | >= 0
simulate panda --gravity lernt | --gravity | got lernt | learnt, exact, believed, none
simulate panda --gravity rest | --gravity | got rest | learn_residual
simulate panda --controller.integral learnt | '--controller.integral' | integral-action
simulate --seed 1 panda | simulate needs the name of an arm | got none before options
simulate panda --controller.integral-action yes | integral-action | got yes | true or false
simulate panda --start 0 0 | --start | 2 | 7 | [rad or m]
simulate panda --start 0 -30 0 -120 0 90 45 | --start must be in radians | panda_joint4
simulate panda --start 0 -0.5 0 -9 0 1.6 0.7 | --start | got -9 for panda_joint4 | -3.072 to -0.0698
simulate panda --target 0.4 0.1 | --target | 2 | 3 | [m]
simulate panda --target 0.4 0 0.4 --target-offset 0.1 0 0 | --target | --target-offset | not both
simulate panda --circle 0.1 --target 0 0 1 | --target | run.target.circle | not both
simulate panda --duration 1e-9 | --duration | got 1e-09 | >= --loop.dt = 0.001 [s]
simulate panda --seed 1.5 | --seed must be a whole number | got 1.5
simulate panda --limits -1 | --limits | got -1.0 | > 0
simulate panda --object-axis q | --object-axis | 'q' | -x, -y, -z, x, y, z
simulate panda --object-axis 1,2 | --object-axis | '1,2' | x, y, z
simulate panda --circle | --circle must be a number | got nothing | radius of the circle, m
simulate panda --circle -1 | --circle | got -1.0 | > 0
simulate panda --believed.shifts panda_joint9 0 0 1 | --believed.shifts | 'panda_joint9' | joint7
simulate panda --believed.shifts panda_joint4 0 0 | --believed.shifts | joint4 0 0 | 3 numbers
simulate panda --speed 2 | --speed | got 2 | --view
simulate panda --view=yes | --view | got yes | no value
simulate panda --true.floor 0 | --true.floor | got 0.0 | true.engine mujoco
simulate panda --task.kind image --task.points 9 | --task.points | got 9 | 1, 2 or 3
simulate panda --sensor.rate 1e6 | --sensor.rate | got 1e+06 | at most that of control, 1000 [Hz]
simulate panda --controller.law tracking --gravity exact | --gravity | got exact | learnt or
simulate panda --out file | --out | got file | a folder that can be made
simulate zero.toml | controller.kp | got 0.0 in zero.toml | > 0
simulate late.toml | sensor.delay | got 100 | shorter than the run, 20 [s]
simulate late.toml --sensor.delay 30 | --sensor.delay | got 30 | shorter than the run, 20 [s]
stability panda --object-length 0.3 | --object-length must be 2 numbers | got 0.3
stability panda --object-length 0.3 0.1 | --object-length | 0.3 | 0.1 | (smallest, largest) [m]
stability panda --object-length 0 0.1 --around 0 0 | --around | 2 | 7 | [rad or m]
stability panda --object-length 0 0.1 --map error qq | 'qq' | a, damping, error, kv
stability panda --controller.unknown tool | --controller.unknown | left out of a report | tool
stability panda --roll 0 1 | --roll | got 0 1 with position | task.kind image
stability panda --jobs 0 | --jobs | got 0 | >= 1
paper --figures 2 | --figures | got 2 | 1, 3, 4, 5, 6, 7, 8
paper --duration -1 | --duration | got -1.0 | > 0 [s]
robots panda --tip panda_hnad | --tip | 'panda_hnad' | panda_hand
robots --tip tool0 | --tip, --base and --free need a robot | got none
view | view needs the run.npz | got none
simulate two_link --out "" | --out must be a path | got nothing
stability two_link --out "" | --out must be a path | got nothing
paper --out "" | --out must be a path | got nothing
export two_link --folder "" | --folder must be a path | got nothing
view file --out "" | --out must be a path | got nothing
view "" | view needs the run.npz | got none
robots "" | robots needs the name | got none
simulate "" | simulate needs the name of an arm | got none
view x.npz | x.npz | Trajectory.save
view file --out nowhere/page.html | --out | got nowhere/page.html | an existing folder
export panda --gravity none --effort-only --folder file | --folder | got file | can be made
"""
CASES = [[part.strip() for part in line.split(" | ")] for line in CASES.strip().splitlines()]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case[0])
def test_the_error_is_one_line_with_option_value_and_what_is_valid(
    case, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    files = {
        "file": "hi", "x.npz": "hi", "zero.toml": 'robot = "panda"\n[controller]\nkp = 0\n',
        "late.toml": 'robot = "panda"\n[sensor]\ndelay = 100\n',
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    words, *parts = case
    assert main([word.strip('"') for word in words.split()]) == 2
    message = capsys.readouterr().err
    assert message.startswith("approxjac: ")
    assert message.count("\n") == 1
    assert [part for part in parts if part not in message] == [], message


@pytest.mark.parametrize(
    ("words", "start"),
    [
        ("simulate pando --seed 1", "robot 'pando'"),  # which the seed has no part in
        ("simulate panda --sensor.lost 30 31 --seed 1", "--sensor.lost must be"),
        ("simulate panda --seed 2 --believed.shifts joint9 0 0 1", "--believed.shifts: joint "),
    ],
)
def test_the_error_begins_with_the_option_at_fault_and_no_other(words, start, capsys):
    assert main(words.split()) == 2
    assert capsys.readouterr().err.startswith(f"approxjac: {start}")


def sample(hint):
    """Words of a value of a type."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return sample(inner[0])
    if origin is Literal:
        return inner[-1:]
    if origin is dict:
        return ("joint", "0.1", "-2e-3", "3")
    if origin is tuple:
        count = 4 if inner[-1] is Ellipsis else len(inner)
        return sample(inner[0]) * count
    return {float: ("2.5e1",), int: ("30",), str: ("word",), bool: ("true",)}[hint]


@pytest.mark.parametrize(
    "option", options.record_options(Scenario("panda"), {}), ids=lambda option: option.key
)
def test_every_key_is_an_option_and_a_line_of_a_file(option, tmp_path):
    words = sample(option.hint)
    typed, _ = options.read("stability", [*option.names[:1], *words], [option])
    scenario = options.scenario_of("simulate", "panda", typed)
    assert scenario != Scenario("panda")
    assert attrgetter(option.key)(scenario) == converted(option.hint, Words(words))
    assert Scenario.load(scenario.save(tmp_path / "s.toml")) == scenario


@pytest.mark.parametrize(
    ("words", "key", "value"),
    [
        ("--object-length 2e-1", "true.object.length", 0.2),
        ("--true.object.length=.2", "true.object.length", 0.2),
        ("--start -1e-1 .5", "run.start", (-0.1, 0.5)),
        ("--start=-0.1,0.5", "run.start", (-0.1, 0.5)),
        ("--object-axis -x", "true.object.axis", "-x"),
        ("--object-axis 0,-1,1", "true.object.axis", (0.0, -1.0, 1.0)),
        ("--object-axis 0 -1 1", "true.object.axis", (0.0, -1.0, 1.0)),
        ("--seed 7", "run.seed", 7),
        ("--settling_time 3", "controller.settling_time", 3.0),
        ("--settling-time None", "controller.settling_time", None),
        ("--controller.integral-action false", "controller.integral_action", False),
        ("--limits none", "controller.limits", "none"),
        ("--limits 0.5", "controller.limits", 0.5),
        ("--controller.unknown tool origins", "controller.unknown", ("tool", "origins")),
        ("--task.frames a b --seed 1", "task.frames", ("a", "b")),
        ("--true.shifts j 0 1e-2 -1 k 0 0 1", "true.shifts",
         {"j": (0.0, 0.01, -1.0), "k": (0.0, 0.0, 1.0)}),
    ],
)  # fmt: skip
def test_words_are_values_of_a_key(words, key, value):
    known = options.options_of(simulate)
    typed, _ = options.read("simulate", words.split(), known)
    scenario = options.scenario_of("simulate", "two_link", typed)
    assert attrgetter(key)(scenario) == value
