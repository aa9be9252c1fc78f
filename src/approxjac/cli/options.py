"""The options of a command, made from a scenario's records, and what was typed of them.

argparse takes -1e-3 and -x for options, and lets a list swallow the robot after it; so words are
read here: an option takes the longest run of words that its type makes a value of.
"""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, get_type_hints

from approxjac.errors import ApproxJacError, InvalidInputError, UnknownNameError
from approxjac.files import reason
from approxjac.scenario import Scenario
from approxjac.scenario.convert import WRONG_TYPE, Words, converted, hints, value_of
from approxjac.scenario.records import Analysis, Goal

if TYPE_CHECKING:
    from tqdm import tqdm


@dataclass(frozen=True)
class Option:
    """An option of a command."""

    names: tuple[str, ...]  # as they may be typed, the usual one first
    key: str  # in a scenario, with dots; or of the command's own argument
    hint: Any  # type of its value
    help: str
    default: Any = None
    means: Mapping[str, Words] = field(default_factory=dict)  # of one that stands for others


# A report is about errors that are given as ranges, and takes gravity as compensated exactly.
_USUAL = {
    "simulate": Scenario(""),
    "export": Scenario(""),
    "stability": Scenario("").with_values(
        {"true": {"object": {"length": 0.0, "mass": 0.0}}, "controller": {"gravity": "exact"}}
    ),
}
_SHORT = {
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
    "--circle": "run.target.circle.radius",
    "--line": "run.target.line.offset",
    "--waypoints": "run.target.waypoints.points",
    "--duration": "run.duration",
    "--seed": "run.seed",
}
_OF_STUDY = {
    f"--{each.name.replace('_', '-')}": f"stability.{each.name}" for each in fields(Analysis)
}
SHORT: Mapping[str, Mapping[str, str]] = {
    "simulate": _SHORT, "stability": _SHORT | _OF_STUDY, "export": _SHORT,
}  # fmt: skip
"""Command → short option → the key that it stands for; a report's errors are ranges."""
COMMON: Mapping[str, Sequence[str]] = {
    "simulate": (
        "--object-length", "--object-mass", "--object-axis", "--believed-length", "--believed-mass",
        "--gravity", "--settling-time", "--limits", "--start", "--target", "--target-offset",
        "--circle", "--learn-kinematics", "--duration", "--seed", "--task.kind", "--view", "--out",
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
_ROBOT = (
    "NAME|FILE",
    "the name of an arm (approxjac robots lists them), a .urdf file, or a .toml file with a "
    "scenario, which options override",
)
POSITIONAL: Mapping[str, tuple[str, str]] = {
    **dict.fromkeys(SHORT, _ROBOT),
    "robots": ("[NAME|FILE]", "the name or the .urdf file of one robot"),
    "view": ("RUN", "the run.npz that simulate, paper or Trajectory.save wrote, or its folder"),
}
"""Command → the word that has no option, in brackets where it may be left out, and what it is."""
_RENAMED = {"--path": "--circle RADIUS, --line OFFSET or --waypoints POINTS"}
_STANDING_FOR_OTHERS = [
    Option(
        ("--no-limits",), "no_limits", bool, "Keep no limits, as --limits none.",
        means={"controller.limits": Words(["none"])},
    ),
    Option(
        ("--learn-kinematics",), "learn_kinematics", bool,
        "Learn tool, joint origins and camera with the tracking law, as --controller.law tracking "
        "--controller.unknown tool origins camera.",
        means={
            "controller.law": Words(["tracking"]),
            "controller.unknown": Words(["tool", "origins", "camera"]),
        },
    ),
]  # fmt: skip


def options_of(command: Callable[..., int]) -> list[Option]:
    """Return all options of a command, with those of its scenario."""
    name = command.__name__
    if name not in SHORT:
        return own_options(command)
    of_scenario = record_options(_USUAL[name], SHORT[name])
    return [*of_scenario, *own_options(command), *_STANDING_FOR_OTHERS]


def documented(record: Any) -> dict[str, str]:
    """Return name → text of the arguments or attributes in a docstring."""
    doc = inspect.cleandoc(record.__doc__ or "").replace("`", "")
    section = re.search(r"^(?:Args|Attributes):\n((?: .*\n?)*)", doc, re.M)
    entries = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section[1] if section else "", re.M)
    return {name: " ".join(text.split()) for name, text in entries}


def own_options(command: Callable[..., int]) -> list[Option]:
    """Return the options of a command itself: its arguments but the first, which has no option."""
    texts, kinds = documented(command), get_type_hints(command)
    return [
        Option((f"--{name.replace('_', '-')}",), name, kinds[name], texts[name], each.default)
        for name, each in inspect.signature(command).parameters.items()
        if name not in ("scenario", "robot", "run")
    ]


def record_options(record: Any, short: Mapping[str, str], key: str = "") -> list[Option]:
    """Return the options of a scenario, or of a part of it: its keys, and short ones for some."""
    options: list[Option] = []
    kind: Any = type(record)
    texts = documented(kind)
    for name, hint in hints(kind).items():
        value, dotted = getattr(record, name, None), f"{key}{name}"
        if hint is KW_ONLY or dotted == "robot":
            continue
        if is_dataclass(value):
            options += record_options(value, short, f"{dotted}.")
            continue
        names = [option for option, meant in short.items() if meant == dotted]
        names.append(f"--{dotted.replace('_', '-')}")
        options.append(Option(tuple(names), dotted, hint, texts[name], value))
    return options


# -- what was typed -----------------------------------------------------------------------


class Typed(NamedTuple):
    """The words after a command."""

    alone: str  # without an option: the robot, or the run
    values: dict[str, Any]  # key → words; True of a mere option
    names: dict[str, str]  # key → option as it was typed


def read(
    command: str, words: Sequence[str], options: Sequence[Option], positional: str, meaning: str
) -> Typed:
    """Read the words after a command.

    `positional` is the one word without an option, "" of a command that takes none, in brackets
    where it may be left out; `meaning` is what it is.
    """
    named = {name: option for option in options for name in option.names}
    rest, alone = list(words), list[str]()
    values, names = dict[str, Any](), dict[str, str]()
    while rest:
        word = rest.pop(0)
        if not _is_option(word):
            alone.append(word)
            continue
        name, equals, value = word.partition("=")
        option = named.get(f"--{name[2:].replace('_', '-')}")
        if name in _RENAMED:
            raise InvalidInputError(f"{name} is now {_RENAMED[name]}", given=name)
        if option is None:
            usual = [each.names[0] for each in options]  # too many to list where none is near
            near = usual if difflib.get_close_matches(name, usual, cutoff=0.5) else []
            raise UnknownNameError("option", name, f"{command} --help-all", near)
        names |= dict.fromkeys(option.means or [option.key], name)
        if option.hint is bool:
            if equals:
                raise InvalidInputError(f"{name} takes no value, got {value}", given=value)
            values |= option.means or dict[str, Any]({option.key: True})
            continue
        before_next = next((k for k, each in enumerate(rest) if _is_option(each)), len(rest))
        given = [value] if equals else rest[:before_next]
        count = _fitting(option.hint, given)
        left = len(given) - count
        if not count or (left and (equals or alone or left > 1 or not positional)):
            aside = option.help.partition(". ")[0].partition("; ")[0].rstrip(".")
            try:
                value_of(option.hint, Words(given), option.key)
            except InvalidInputError as error:
                text = str(error).replace(option.key, name, 1)
                text = f"{text} ({aside[:1].lower()}{aside[1:]})"
                raise InvalidInputError(text, given=given) from None
        values[option.key] = Words(given[:count])
        del rest[: 0 if equals else count]
    if len(alone) > bool(positional):
        taken = meaning or "options alone"
        raise InvalidInputError(f"{command} takes {taken}; got {' '.join(alone)}", given=alone)
    if positional[:1] not in ("", "[") and not alone:
        raise InvalidInputError(f"{command} needs {meaning}; got none", given=alone)
    return Typed("".join(alone), values, names)


def with_options(options: Sequence[Option], text: str) -> str:
    """Return a text with options in place of the keys that it names."""
    for option in sorted(options, key=lambda option: -len(option.key)):
        if "." in option.key or "_" in option.key:
            text = re.sub(rf"(?<![\w.-]){re.escape(option.key)}(?![\w.])", option.names[0], text)
    return text


def explained(error: ApproxJacError, options: Sequence[Option], typed: Typed) -> str:
    """Return an error's message with the user's own option in place of the key it begins with.

    A key that was not typed stays as it is in a file, if there is one.
    """
    message, from_file = str(error), typed.alone.endswith(".toml")
    key, _, rest = message.partition(" ")
    known = [
        each
        for each in options
        if key in (each.key, each.key.rpartition(".")[2]) or f"--{key}" in each.names
    ]
    typed_ones = [each for each in known if each.key in typed.names]
    known = typed_ones or [each for each in known if each.key == key]
    if len(known) == 1:
        (option,) = known
        usual = option.key if from_file and "." in option.key else option.names[0]
        rest = rest if from_file else with_options(options, rest)
        return f"{typed.names.get(option.key, usual)} {rest}"
    if isinstance(error, UnknownNameError) and not message.startswith("-"):
        words = {key: value for key, value in typed.values.items() if isinstance(value, Words)}
        given = [typed.names[key] for key, value in words.items() if error.given in value]
        return f"{given[0]}: {message}" if len(given) == 1 else message
    return message


def _is_option(word: str) -> bool:
    return word.startswith("--") and len(word) > 2


def _fitting(hint: Any, words: Sequence[str]) -> int:
    """Return how many of the first words make a value; 0 where none do."""
    for count in range(len(words), 0, -1):
        with suppress(*WRONG_TYPE):
            converted(hint, Words(words[:count]))
            return count
    return 0


def scenario_of(command: str, source: str, values: Mapping[str, Words]) -> Scenario:
    """Return the scenario of a file, or the usual one of a command, with what was typed by key."""
    if source.endswith(".toml"):
        scenario = Scenario.load(source)
    else:
        scenario = _USUAL[command].with_values({"robot": source})
    if any(key.startswith("run.target.") for key in values):  # in place of the file's
        scenario = scenario.with_values({"run": {"target": Goal()}})
    table: dict[str, Any] = {}
    for key, words in values.items():
        *parts, name = key.split(".")
        inner = table
        for part in parts:
            inner = inner.setdefault(part, {})
        inner[name] = words
    return scenario.with_values(table)


def require_folder_of(option: str, file: Path | None) -> None:
    """Refuse a file, if one is given, that there is no folder for."""
    if file is not None and not file.parent.is_dir():
        raise InvalidInputError(
            f"{option} must be a file in a folder that there is, got {file}", given=file
        )


def make_folder(out: Path) -> None:
    """Make the folder that a command writes to."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"--out must be a folder that can be made, got {out}: {reason(error)}", given=out
        ) from error


def time_bar(total: float, what: str, disable: bool | None = None) -> tqdm[Any]:
    """Return a bar of a simulated time [s]; by default none where the output is no terminal."""
    from tqdm import tqdm

    times = "{percentage:.0f} %|{bar}| {elapsed} so far, {remaining} to go"
    shown = "{desc}{n:.1f} of {total:g} s, " + times
    return tqdm(total=total, desc=f"{what}: ", disable=disable, bar_format=shown)
