"""The public names: each stands in the reference, and type checkers know it."""

import importlib
import inspect
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import approxjac as aj

REFERENCE = Path(__file__).parents[1] / "docs" / "api"
MODULES = (
    "robots",
    "cameras",
    "tasks",
    "controllers",
    "simulation",
    "realtime",
    "stability",
    "law",
    "view",
)
DIRECTIVE = re.compile(r"^\.\. auto(\w+):: (\S+)\n((?:   :.*\n)*)", re.MULTILINE)


def found(name):
    """The object that a dotted name means: the longest part that is a module, then attributes."""
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def names_of(module):
    """The public names of a module: those that it lists, or all that it has."""
    own = (name for name, each in vars(module).items() if not inspect.ismodule(each))
    return getattr(module, "__all__", [name for name in own if not name.startswith("_")])


def described():
    """Every object that the reference describes."""
    pages = sorted(REFERENCE.glob("*.md"))
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    for kind, name, options in DIRECTIVE.findall(text):
        if kind != "module":
            yield name, found(name)
            continue
        module = importlib.import_module(name)
        members = re.search(r":members:(.*)", options)
        excluded = re.search(r":exclude-members:(.*)", options)
        left_out = {word.strip() for word in excluded[1].split(",")} if excluded else set()
        named = [word.strip() for word in members[1].split(",") if word.strip()]
        own = [
            key
            for key, value in vars(module).items()
            if not key.startswith("_") and getattr(value, "__module__", "") == name
        ]
        for key in named or own:
            if key not in left_out:
                yield f"{name}.{key}", getattr(module, key)


def test_every_public_name_is_in_the_reference():
    inside = {id(thing) for _, thing in described()}
    for module in (aj, *(getattr(aj, name) for name in MODULES)):
        missing = {
            name
            for name in names_of(module)
            if callable(thing := getattr(module, name)) and id(thing) not in inside
        }
        assert missing == set(), module.__name__


def test_the_reference_describes_each_thing_once_and_nothing_private():
    names = [name for name, _ in described()]
    things = [thing for _, thing in described()]
    assert len(names) > 150
    assert not [name for name in names if "._" in name]
    assert sorted(n for n, t in zip(names, things, strict=True) if things.count(t) > 1) == []


@pytest.mark.parametrize("module", [aj, *(getattr(aj, name) for name in MODULES)])
def test_every_name_has_a_docstring(module):
    for name in names_of(module):
        thing = getattr(module, name)
        if inspect.isclass(thing) or inspect.isfunction(thing):
            assert inspect.getdoc(thing), name


def test_nothing_public_is_printed_as_an_address():
    for name in aj.__all__:
        kind = getattr(aj, name)
        if inspect.isclass(kind) and not issubclass(kind, Exception | aj.Task):
            own = kind.__repr__ is not object.__repr__
            assert own or getattr(kind, "_is_protocol", False), name


def test_tab_completion_shows_what_helps(panda):
    controller = aj.SetpointController(aj.PositionTask(panda))
    for thing in (panda, controller, aj.Plant(panda), controller.task):
        shown = {name for name in dir(thing) if not name.startswith("_")}
        assert not shown & {"np", "pin", "math", "data"}
        assert all(hasattr(thing, name) for name in shown)


PROGRAM = """
    import approxjac as aj

    arm = aj.load_robot("panda")
    belief = arm.with_object(length=0.0)
    controller = aj.SetpointController(
        aj.PositionTask(belief), gravity=aj.AdaptiveGravity(belief)
    )
    run = aj.simulate(aj.Plant(arm.with_object(length=0.2)), controller, target=[0.5, 0.0, 0.5])
    report = aj.Study(controller, arm).report()
    reveal_type(run)
    reveal_type(report)
    reveal_type(aj.JointBox(arm))
    reveal_type(aj.view.plot_run)
    reveal_type(aj.Study.rollouts)
    aj.Gains(kp="400", kv=80.0)
    aj.stabilty_report
"""


@pytest.mark.study
def test_type_checkers_know_the_names(tmp_path):
    pytest.importorskip("mypy")
    path = tmp_path / "program.py"
    path.write_text(textwrap.dedent(PROGRAM), encoding="utf-8")
    config = Path(__file__).parents[1] / "pyproject.toml"
    process = subprocess.run(
        [sys.executable, "-m", "mypy", f"--config-file={config}", str(path)],  # which is strict
        capture_output=True,
        text=True,
        check=False,
        cwd=config.parent,
        env={**os.environ, "MYPYPATH": str(Path(aj.__file__).parents[1])},
    )
    types = re.findall(r'Revealed type is "([^"]*)"', process.stdout)
    assert types[0] == "approxjac.simulation.trajectory.Trajectory"
    assert types[1].startswith("approxjac.stability.report.report.StabilityReport")
    assert types[2] == "approxjac.stability.errors.region.JointBox"
    assert types[3].startswith("def (run: approxjac.simulation.trajectory.Trajectory)")
    assert types[4].startswith("def (self: approxjac.stability.studied_loop.StudiedLoop, n:")
    errors = re.findall(r"error: (.*)", process.stdout)
    assert len(errors) == 2
    assert 'Argument "kp" to "Gains" has incompatible type "str"' in errors[0]
    assert 'has no attribute "stabilty_report"' in errors[1]


def test_a_misspelled_name_is_told_what_was_meant():
    code = "import approxjac as aj; aj.simulat"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "module 'approxjac' has no attribute 'simulat'" in process.stderr
    assert "Did you mean: 'simulate'?" in process.stderr


def test_few_names_stand_at_the_top():
    """What one builds and calls; the rest is in its module."""
    assert len(aj.__all__) <= 47


def test_without_matplotlib_all_but_plots_is_there():
    """What looks at the package, such as `help`, may ask for all of its names."""
    lines = (
        "import sys; sys.modules['matplotlib'] = None",
        "from approxjac import *; import approxjac, inspect",
        "inspect.getmembers(approxjac); inspect.getmembers(approxjac.view)",
        "print('all others'); approxjac.view.plot_run",
    )
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (1, "all others\n")
    assert "pip install 'approxjac[study]'" in done.stderr.splitlines()[-1]
