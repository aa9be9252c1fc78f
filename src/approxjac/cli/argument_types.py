"""Arguments of a command: what it takes, and how the words that a user typed are read."""

from __future__ import annotations

import difflib
import inspect
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from approxjac.errors import ApproxJacError, InvalidInputError, UnknownNameError
from approxjac.scenario.tables import hints

_SHAPES = re.compile(r"must have shape \((\d+),\)( \[[^]]*\])?, got shape \((\d+),\)")
_ENTRY = r"(?:-?[\d.]+(?:e[+-]?\d+)?|-?inf|nan|'[^']*')"
_LIST = re.compile(rf"[(\[]({_ENTRY}(?:, {_ENTRY})+,?)[)\]]")
_UNIONS = (Union, types.UnionType)
_KINDS = {
    float: ("a number", "N"), int: ("a whole number", "N"), str: ("a name", "NAME"),
    Path: ("a path", "PATH"), Any: ("an axis such as x, -z or 0,1,1", "AXIS"),
}  # fmt: skip


class Typed(NamedTuple):
    """An option as it was typed, with the words after it."""

    name: str
    words: tuple[str, ...]


@dataclass(frozen=True)
class Option:
    """An option of a command.

    Attributes:
        names: As they may be typed, the usual one first.
        key: In a scenario, with dots; or of the command's own argument.
        hint: Type of its value.
        help: For what it is.
        default: Value without it.
    """

    names: tuple[str, ...]
    key: str
    hint: Any
    help: str
    default: Any

    @property
    def is_flag(self) -> bool:
        """Return whether it takes no value."""
        return self.hint is bool


def described(documented: Any) -> dict[str, str]:
    """Return name → text of the arguments or attributes that a docstring tells of."""
    found: dict[str, list[str]] = {}
    section, name = False, ""
    for line in inspect.cleandoc(documented.__doc__ or "").splitlines():
        if line in ("Args:", "Attributes:"):
            section = True
        elif section and line and not line.startswith(" "):
            section = False
        elif section and line.startswith("        "):
            found[name].append(line.strip())
        elif section and line.strip():
            name, _, text = line.strip().partition(": ")
            found[name] = [text]
    return {name: " ".join(lines) for name, lines in found.items()}


def own_options(command: Callable[..., int]) -> list[Option]:
    """Return the options of a command itself; not its scenario's, and nothing positional."""
    told, kinds = described(command), get_type_hints(command)
    return [
        Option((f"--{name.replace('_', '-')}",), name, kinds[name], told[name], each.default)
        for name, each in inspect.signature(command).parameters.items()
        if name not in ("scenario", "robot", "run")
    ]


def scenario_options(record: Any, short: Mapping[str, str], key: str = "") -> list[Option]:
    """Return the options of a scenario, or of a part of it: its keys, and short ones for some."""
    found: list[Option] = []
    told = described(type(record))
    kind_of: Any = type(record)
    for name, hint in hints(kind_of).items():
        value, dotted = getattr(record, name, None), f"{key}{name}"
        if hint is KW_ONLY or dotted == "robot":
            continue
        if is_dataclass(value):
            found += scenario_options(value, short, f"{dotted}.")
            continue
        names = [option for option, meant in short.items() if meant == dotted]
        names.append(f"--{dotted.replace('_', '-')}")
        hint = Any if name == "axis" else hint
        found.append(Option(tuple(names), dotted, hint, told[name], value))
    return found


def read(
    command: str,
    words: Sequence[str],
    options: Sequence[Option],
    positional: str,
    spelled: Mapping[str, str],
) -> tuple[list[str], dict[str, Typed]]:
    """Return the words in order, what has no option first, and key → option as it was typed.

    Args:
        command: Such as "simulate".
        words: After the command.
        options: Of the command.
        positional: For what the one word without an option is, such as "a robot, …"; "" of a
            command that takes none, "[a robot]" where it may be left out.
        spelled: Option → what was typed in its place, such as --no-limits.

    Raises:
        UnknownNameError: No such option.
        InvalidInputError: Values that an option does not take, or too many words.
    """
    named = {name: option for option in options for name in option.names}
    alone: list[str] = []
    found: list[str] = []
    typed: dict[str, Typed] = {}
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if not _is_option(word):
            alone.append(word)
            continue
        name, equals, value = word.partition("=")
        option = named.get(f"--{name[2:].replace('_', '-')}")
        if option is None:
            usual = [each.names[0] for each in options]  # too many to be told where none is near
            near = usual if difflib.get_close_matches(name, usual, cutoff=0.5) else []
            raise UnknownNameError("option", name, f"{command} --help-all", near)
        name = spelled.get(name, name)
        typed[option.key] = Typed(name, ())
        if option.is_flag and not equals:
            found.append(option.names[0])
            continue
        count = 1 if option.hint is Any else _until_option(rest)
        given = [value] if equals else rest[:count]
        taken = 0 if option.is_flag else _fitting(option.hint, given)
        left = given[taken:]
        if not taken or (left and (equals or alone or len(left) > 1 or not positional)):
            aside = option.help.partition(". ")[0].rstrip(".")
            aside = aside[:1].lower() + aside[1:]
            raise InvalidInputError(
                f"{name} takes {wanted(option)}, got {' '.join(given) or 'nothing'} ({aside})",
                given=given,
            )
        rest = rest if equals else rest[taken:]
        values = given[:taken]
        typed[option.key] = Typed(name, tuple(values))
        # a value that begins with a minus would be taken for an option
        found += [f"{option.names[0]}={values[0]}"] if taken == 1 else [option.names[0], *values]
    if len(alone) > bool(positional):
        told = positional.strip("[]") or "options alone"
        raise InvalidInputError(f"{command} takes {told}, got {' '.join(alone)}", given=alone)
    if positional and not positional.startswith("[") and not alone:
        raise InvalidInputError(f"{command} needs {positional}, got none", given=alone)
    return [*alone, *found], typed


def in_words_of_user(
    error: ApproxJacError, options: Sequence[Option], typed: Mapping[str, Typed], from_file: bool
) -> str:
    """Return an error's message with options as they were typed, in place of keys and arguments.

    Keys that were not typed stay as they are in a file, if there is one. Arrays and their shapes
    become numbers as one types them.
    """

    def shown(option: Option) -> str:
        usual = option.key if from_file and "." in option.key else option.names[0]
        return typed[option.key].name if option.key in typed else usual

    message = str(error)
    for option in options:
        if "." in option.key:
            pattern = rf"(?<![\w.\-]){re.escape(option.key)}(?![\w\-]|\.\w)"
            message = re.sub(pattern, shown(option), message)
    for option in options:  # an argument that is to be given, such as believed_length
        word = option.names[0][2:].replace("-", "_")
        if "." in option.key and "_" in word and not message.startswith(word):
            message = re.sub(rf"(?<![\w.\-/']){re.escape(word)}(?= \d)", shown(option), message)
    first = re.match(r"(\w+)(?= (must|needs|is)\b)", message)
    if first:  # an argument of a function that the value was handed to
        own = f"--{first[1].replace('_', '-')}"
        known = [o for o in options if own in o.names] or [
            o for o in options if o.key.rpartition(".")[2] == first[1]
        ]
        known = [option for option in known if option.key in typed] or known
        if len(known) == 1:
            message = shown(known[0]) + message[first.end() :]
    if not message.startswith("-") and isinstance(error, UnknownNameError):
        given = [each.name for each in typed.values() if error.given in each.words]
        message = f"{given[0]}: {message}" if len(given) == 1 else message
    return _LIST.sub(
        lambda found: re.sub(r"[',]", "", found[1]),
        _SHAPES.sub(r"must be \1 numbers\2, got \3", message),
    )


def wanted(option: Option) -> str:
    """Return in words which values an option takes."""
    if option.is_flag:
        return "no value"
    return " or ".join(_words(kind) for kind in _kinds(option.hint))


def metavar(option: Option) -> str:
    """Return the value of an option as its help shows it."""
    return "" if option.is_flag else "|".join(_short(kind) for kind in _kinds(option.hint))


def _is_option(word: str) -> bool:
    return word.startswith("--") and len(word) > 2


def _until_option(words: Sequence[str]) -> int:
    """Return how many words there are before the next option."""
    return next((k for k, word in enumerate(words) if _is_option(word)), len(words))


def _kinds(hint: Any) -> list[Any]:
    """Return the types that a value may have, but for None."""
    if get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    kinds = get_args(hint) if get_origin(hint) in _UNIONS else (hint,)
    return [kind for kind in kinds if kind is not type(None)]


def _fitting(hint: Any, words: Sequence[str]) -> int:
    """Return how many of the first words make a value; 0 where none do."""
    if list(words[:1]) == ["None"]:
        return 1
    kinds = _kinds(hint)
    return next((k for k in range(len(words), 0, -1) if _fits(kinds, words[:k])), 0)


def _fits(kinds: Sequence[Any], words: Sequence[str]) -> bool:
    return any(_is(kind, words) for kind in kinds)


def _is(kind: Any, words: Sequence[str]) -> bool:
    """Return whether words are a value of one type."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return len(words) == 1 and words[0] in inner
    if origin is dict:  # a joint and a vector, and so on
        vectors = [words[k : k + 4] for k in range(0, len(words), 4)]
        return all(len(each) == 4 and _is(inner[1], each[1:]) for each in vectors)
    if origin is tuple:
        kinds = [inner[0]] * len(words) if inner[-1] is Ellipsis else inner
        return len(kinds) == len(words) and all(
            _is(each, [word]) for each, word in zip(kinds, words, strict=True)
        )
    if kind in (float, int):
        try:
            kind(words[0])
        except ValueError:
            return False
    return len(words) == 1


def _words(kind: Any) -> str:
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return " or ".join(filter(None, [", ".join(inner[:-1]), inner[-1]]))
    if origin is dict:
        return "a joint and 3 numbers, for one joint or several"
    if origin is tuple:
        many = "numbers" if inner[0] is float else "whole numbers" if inner[0] is int else "names"
        return many if inner[-1] is Ellipsis else f"{len(inner)} {many}"
    return _KINDS[kind][0]


def _short(kind: Any) -> str:
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return "|".join(inner)
    if origin is dict:
        return "JOINT X Y Z ..."
    if origin is tuple:
        each = _KINDS[inner[0]][1]
        return f"{each} ..." if inner[-1] is Ellipsis else " ".join([each] * len(inner))
    return _KINDS[kind][1]
