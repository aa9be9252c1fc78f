"""The options of a command, made from a scenario's records, and their parser.

A word that begins with -- is an option, and all words up to the next are its value.
"""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

from approxjac.errors import ApproxJacError, InvalidInputError, UnknownNameError
from approxjac.files import refusing
from approxjac.scenario import Scenario
from approxjac.scenario.convert import Words, hints, value_of
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


# A report is about errors that are given as ranges, and takes gravity as compensated exactly.
_USUAL = {
    "simulate": Scenario(""),
    "export": Scenario(""),
    "stability": Scenario("").with_values(
        {"true": {"object": {"length": 0.0, "mass": 0.0}}, "controller": {"gravity": "exact"}}
    ),
}
_OF_LAW = {
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
}
_OF_RUN = {
    "--start": "run.start",
    "--target": "run.target.at",
    "--target-offset": "run.target.offset",
    "--circle": "run.target.circle.radius",
    "--line": "run.target.line.offset",
    "--waypoints": "run.target.waypoints.points",
    "--duration": "run.duration",
    "--seed": "run.seed",
    "--drives": "true.drives",
}
_OF_STUDY = {f"--{name.replace('_', '-')}": f"stability.{name}" for name in hints(Analysis)}
SHORT: Mapping[str, Mapping[str, str]] = {
    "simulate": _OF_LAW | _OF_RUN,
    "stability": _OF_LAW | {"--duration": "run.duration", "--seed": "run.seed"} | _OF_STUDY,
    "export": _OF_LAW,
}
"""Command → short option → the key that it stands for; a report's errors are ranges."""
_ROBOT = (
    "NAME|FILE",
    "the name of an arm (approxjac robots lists them), a .urdf file, or a .toml file with a "
    "scenario, which options override",
)
FILES = "FILES…"
POSITIONAL: Mapping[str, tuple[str, str]] = {
    **dict.fromkeys(SHORT, _ROBOT),
    "robots": ("[NAME|FILE]", "the name or the .urdf file of one robot"),
    "learn": (f"NAME|FILE {FILES}", "the arm as it is drawn, and csv files with recordings of it"),
    "view": ("RUN", "the run.npz that simulate, paper or Trajectory.save wrote, or its folder"),
}
"""Command → the word before its options, in brackets where it may be left out, and what it is."""


def options_of(command: Callable[..., int]) -> list[Option]:
    """Return all options of a command, with those of its scenario."""
    name = command.__name__
    if name not in SHORT:
        return own_options(command)
    return [*record_options(_USUAL[name], SHORT[name]), *own_options(command)]


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
        if is_dataclass(value):
            options += record_options(value, short, f"{dotted}.")
        elif hint is not KW_ONLY and dotted != "robot":
            names = [option for option, meant in short.items() if meant == dotted]
            names.append(f"--{dotted.replace('_', '-')}")
            options.append(Option(tuple(names), dotted, hint, texts[name], value))
    return options


def read(
    command: str, words: Sequence[str], options: Sequence[Option]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return key → words, or True for an option without; and key → option as typed."""
    named = {name: option for option in options for name in option.names}
    rest, values, names = list(words), dict[str, Any](), dict[str, str]()
    while rest:
        name, equals, value = rest.pop(0).partition("=")
        given = Words([value] if equals else [])
        while rest and not equals and not rest[0].startswith("--"):
            given = Words((*given, rest.pop(0)))
        option = named.get(f"--{name[2:].replace('_', '-')}")
        if option is None:
            short_or_dotted = -1 if "." in name else 0
            usual = [each.names[short_or_dotted] for each in options]  # too many to list all
            near = usual if difflib.get_close_matches(name, usual, cutoff=0.5) else []
            raise UnknownNameError("option", name, f"{command} --help-all", near)
        if option.hint is bool:
            if given:
                message = f"{name} takes no value, got {' '.join(given)}"
                raise InvalidInputError(message, given=given)
            values[option.key], names[option.key] = True, name
            continue
        try:
            value_of(option.hint, given, name)
        except InvalidInputError as error:
            aside = option.help.partition(". ")[0].partition("; ")[0].rstrip(".")
            message = f"{error} ({aside[:1].lower()}{aside[1:]})"
            raise InvalidInputError(message, given=given) from None
        values[option.key], names[option.key] = given, name
    return values, names


def explained(
    error: ApproxJacError,
    options: Sequence[Option],
    source: str,
    values: Mapping[str, Any],
    names: dict[str, str],
) -> str:
    """Return an error's message with the user's own options in place of keys.

    Keys that were not typed stay as they are in a file, if there is one.
    """
    usual = {} if source.endswith(".toml") else {each.key: each.names[0] for each in options}
    shown, message = usual | names, str(error)
    for key in sorted(shown, key=len, reverse=True):
        if "." in key or "_" in key:
            message = re.sub(rf"(?<![\w.-]){re.escape(key)}(?![\w.])", shown[key], message)
    key, _, rest = message.partition(" ")
    own = [
        name
        for dotted, name in names.items()
        if key == dotted.rpartition(".")[2] or name == f"--{key}"
    ]
    if len(own) == 1:
        return f"{own[0]} {rest}"
    if isinstance(error, UnknownNameError):
        typed = {key: words for key, words in values.items() if isinstance(words, Words)}
        own = [names[key] for key, words in typed.items() if error.given in words]
    return f"{own[0]}: {message}" if len(own) == 1 else message


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


def make_folder(out: Path) -> None:
    """Make the folder that a command writes to."""
    with refusing("--out must be a folder that can be made", out):
        out.mkdir(parents=True, exist_ok=True)


def time_bar(total: float, what: str, disable: bool | None = None) -> tqdm[Any]:
    """Return a bar of a simulated time [s]; by default none where the output is no terminal."""
    from tqdm import tqdm

    times = "{percentage:.0f} %|{bar}| {elapsed} so far, {remaining} to go"
    shown = "{desc}{n:.1f} of {total:g} s, " + times
    return tqdm(total=total, desc=f"{what}: ", disable=disable, bar_format=shown)
