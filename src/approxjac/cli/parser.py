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
from dataclasses import KW_ONLY, dataclass, field, is_dataclass
from typing import Any, get_type_hints

from approxjac.errors import ApproxJacError, InvalidInputError, UnknownNameError
from approxjac.scenario.convert import WRONG_TYPE, Words, converted, hints, value_of

_RENAMED = {"--path": "--circle RADIUS, --line OFFSET or --waypoints POINTS"}


@dataclass(frozen=True)
class Option:
    """An option of a command."""

    names: tuple[str, ...]  # as they may be typed, the usual one first
    key: str  # in a scenario, with dots; or of the command's own argument
    hint: Any  # type of its value
    help: str
    default: Any = None
    means: Mapping[str, Words] = field(default_factory=dict)  # of one that stands for others


@dataclass
class Typed:
    """What was typed after a command."""

    alone: str = ""  # the word without an option: the robot, or the run
    values: dict[str, Any] = field(default_factory=dict)  # key → words; True of a mere option
    names: dict[str, str] = field(default_factory=dict)  # key → option as it was typed


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


def read(
    typed: Typed,
    command: str,
    words: Sequence[str],
    options: Sequence[Option],
    positional: str,
    meaning: str,
) -> None:
    """Read the words after a command, and keep in `typed` also what comes before an error.

    `positional` is the one word without an option, "" of a command that takes none, in brackets
    where it may be left out; `meaning` is what it is.
    """
    named = {name: option for option in options for name in option.names}
    rest, alone = list(words), list[str]()
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
        typed.names |= dict.fromkeys(option.means or [option.key], name)
        if option.hint is bool:
            if equals:
                raise InvalidInputError(f"{name} takes no value, got {value}", given=value)
            typed.values |= option.means or dict[str, Any]({option.key: True})
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
                text = f"{error} ({aside[:1].lower()}{aside[1:]})"
                raise InvalidInputError(text, given=given) from None
        typed.values[option.key] = Words(given[:count])
        del rest[: 0 if equals else count]
    if len(alone) > bool(positional):
        taken = meaning or "options alone"
        raise InvalidInputError(f"{command} takes {taken}; got {' '.join(alone)}", given=alone)
    if positional[:1] not in ("", "[") and not alone:
        raise InvalidInputError(f"{command} needs {meaning}; got none", given=alone)
    typed.alone = "".join(alone)


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
