"""The options of a scenario, its keys with dots and short ones for the common few; and --out."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, field, fields, is_dataclass, make_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from approxjac.cli.argument_types import Option, own_options, scenario_options
from approxjac.errors import InvalidInputError
from approxjac.files import reason
from approxjac.scenario import Scenario
from approxjac.scenario.records import Goal
from approxjac.scenario.study_records import Analysis
from approxjac.scenario.tables import hints

# A report is about errors that are given as ranges, and takes gravity as compensated exactly.
_USUAL = {
    "simulate": Scenario(""),
    "export": Scenario(""),
    "stability": Scenario("").with_values(
        {"true": {"object": {"length": 0.0, "mass": 0.0}}, "controller": {"gravity": "exact"}}
    ),
}


def _axis(words: list[str]) -> str | tuple[float, ...] | None:
    """Return what the one word of an axis says: its name, a vector such as 0,1,1, or None."""
    (word,) = words
    if "," not in word:
        return None if word == "None" else word
    return tuple(map(float, word.split(",")))


_AXIS = Annotated[
    Any,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="AXIS",
        instance_from_str=_axis,
        is_instance=lambda value: value is None or isinstance(value, str | tuple),
        str_from_instance=lambda value: [
            ",".join(map(repr, value)) if isinstance(value, tuple) else str(value)
        ],
    ),
]
_ROBOT = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        metavar="NAME|FILE",
        help="Name of an arm, a .urdf file, or a .toml file with a scenario; options given here "
        "come before it.",
    ),
]
_COMMON = {
    "--object-length": "true.object.length",
    "--object-mass": "true.object.mass",
    "--object-axis": "true.object.axis",
    "--believed-length": "believed.object.length",
    "--believed-mass": "believed.object.mass",
    "--gravity": "controller.gravity",
    "--settling-time": "controller.settling_time",
    "--kp": "controller.kp",
    "--kv": "controller.kv",
    "--damping": "controller.damping",
    "--limits": "controller.limits",
    "--start": "run.start",
    "--target": "run.target.at",
    "--target-offset": "run.target.offset",
    "--duration": "run.duration",
    "--seed": "run.seed",
}
_UNKNOWN = ["--controller.unknown", "tool", "origins", "camera"]
_FLAGS = {
    "--no-limits": ["--limits", "none"],
    "--learn-kinematics": ["--controller.law", "tracking", *_UNKNOWN],
}
_PATHS = {
    "circle": "run.target.circle.radius",
    "line": "run.target.line.offset",
    "waypoints": "run.target.waypoints.points",
}
_STABILITY = {
    f"--{each.name.replace('_', '-')}": f"stability.{each.name}" for each in fields(Analysis)
}
SHORT: Mapping[str, Mapping[str, str]] = {
    "simulate": _COMMON, "stability": _COMMON | _STABILITY, "export": _COMMON,
}  # fmt: skip
"""Command → short option → the key that it stands for; a report's errors are ranges."""


COMMON: Mapping[str, Sequence[str]] = {
    "simulate": (
        "--object-length", "--object-mass", "--object-axis", "--believed-length", "--believed-mass",
        "--gravity", "--settling-time", "--limits", "--start", "--target", "--target-offset",
        "--path circle|line|waypoints", "--learn-kinematics", "--duration", "--seed", "--task.kind",
        "--view", "--out",
    ),
    "stability": (
        "--object-length", "--object-mass", "--joint-shifts", "--joint-rotations",
        "--believed-length", "--believed-mass", "--around", "--radius", "--target", "--gravity",
        "--settling-time", "--kp", "--kv", "--damping", "--loop.dt", "--runs", "--map-points",
        "--suggest-gains", "--jobs", "--out",
    ),
    "export": (
        "--object-length", "--believed-length", "--believed-mass", "--gravity", "--settling-time",
        "--kp", "--kv", "--damping", "--limits", "--effort-only", "--folder",
    ),
}  # fmt: skip
"""Command → the options that its help shows."""


_ROBOT_NEEDED = (
    "one robot (a name that approxjac robots lists, a .urdf file, or a .toml file with a scenario)"
)
MEANT = {
    **dict.fromkeys(SHORT, _ROBOT_NEEDED),
    "robots": "[one robot by its name or its .urdf file]",
    "view": "one run (a run.npz that simulate, paper or Trajectory.save wrote, or its folder)",
}
"""Command → for what the word is that has no option."""


_SHORTHANDS = [
    Option(("--no-limits",), "no_limits", bool, "Keep no limits, as --limits none.", False),
    Option(
        ("--learn-kinematics",), "learn_kinematics", bool,
        "Learn tool, joint origins and camera by law T, as --controller.law tracking "
        "--controller.unknown tool origins camera.", False,
    ),
    Option(
        ("--path circle|line|waypoints",), "path", tuple[float, ...],
        "Path to follow: the radius of a circle, the offset of a line, or points, in m.", None,
    ),
]  # fmt: skip


def of(command: Callable[..., int], scenario: Scenario | None = None) -> list[Option]:
    """Return all options of a command, with those of its scenario."""
    options = own_options(command)
    name = command.__name__
    if name in SHORT:
        default = _USUAL[name] if scenario is None else scenario
        options = [*scenario_options(default, SHORT[name]), *options, *_SHORTHANDS]
    return options


def from_file(words: list[str]) -> tuple[Scenario | None, list[str], dict[str, str]]:
    """Return the scenario of the file among a command's words, and the words with its robot.

    In these --no-limits, --learn-kinematics and --path are what they stand for; the last that is
    returned says for what.
    """
    spelled: dict[str, str] = {}
    for short, meant in _FLAGS.items():
        if short in words:
            spelled |= {word: short for word in meant if word.startswith("--")}
    words = [part for word in words for part in _FLAGS.get(word, [word])]
    words = _with_path(words, spelled)
    for i, word in enumerate(words):
        if word.endswith(".toml") and word[0] != "-" and words[i - 1] != "--save":
            scenario = Scenario.load(word)
            if any(other.startswith(("--target", "--run.target")) for other in words):  # not both
                scenario = scenario.with_values({"run": {"target": Goal()}})
            return scenario, [*words[:i], scenario.robot, *words[i + 1 :]], spelled
    return None, words, spelled


def _with_path(words: list[str], spelled: dict[str, str]) -> list[str]:
    """Return words with the key of a path's shape in place of `--path SHAPE`."""
    if "--path" not in words:
        return words
    i = words.index("--path")
    shape = "".join(words[i + 1 : i + 2])
    if shape not in _PATHS:
        raise InvalidInputError(
            "--path takes circle, line or waypoints, and then the circle's radius, the line's "
            f"offset or the points, in m; got {shape or 'nothing'}",
            given=shape,
        )
    option = f"--{_PATHS[shape]}"
    spelled[option] = f"--path {shape}"
    return [*words[:i], option, *words[i + 2 :]]


def with_options(
    command: Callable[..., int], default: Scenario | None = None
) -> Callable[..., int]:
    """Return a command that takes the keys of a scenario as options, instead of a scenario.

    What options do not say is as in `default`, or as usual.
    """
    default = _USUAL[command.__name__] if default is None else default
    short: dict[str, list[str]] = {}
    for option, key in SHORT[command.__name__].items():
        short.setdefault(key, []).append(option)

    def taking_options(scenario: Any, **others: Any) -> int:
        return command(default.with_values(asdict(scenario)), **others)

    options: Any = Annotated[_options(default, short), tyro.conf.arg(name="")]
    # tyro reads all of these
    taking_options.__doc__ = command.__doc__
    taking_options.__annotations__ = get_type_hints(command, include_extras=True)
    taking_options.__annotations__["scenario"] = options
    taking_options.__signature__ = inspect.signature(command)  # type: ignore[attr-defined]
    return taking_options


def _options(record: Any, short: Mapping[str, list[str]], key: str = "") -> type:
    """Return a type with the fields of a record, which tyro makes options of."""
    made: list[tuple[str, Any, Any]] = []
    kind_of: Any = type(record)
    for name, hint in hints(kind_of).items():
        value, dotted = getattr(record, name, None), f"{key}{name}"
        if hint is KW_ONLY:
            continue
        if dotted == "robot":
            made.append((name, _ROBOT, field()))
        elif is_dataclass(value):
            kind = _options(value, short, f"{dotted}.")
            made.append((name, kind, field(default_factory=kind)))
        else:
            hint = Annotated[hint, tyro.conf.arg(aliases=short.get(dotted))]
            if name == "axis":  # as three words it would take the robot after it for a part of it
                hint = Annotated[_AXIS, tyro.conf.arg(aliases=short.get(dotted))]
            default = partial(getattr, record, name)  # which may be a table
            made.append((name, hint, field(default_factory=default)))
    doc = {"__doc__": record.__doc__}  # the help of its options
    return make_dataclass(type(record).__name__, made, namespace=doc)


def make_folder(out: Path) -> None:
    """Make the folder that a command writes to.

    Raises:
        InvalidInputError: It cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"--out must be a folder that can be made, got {out}: {reason(error)}", given=out
        ) from error
