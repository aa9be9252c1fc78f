"""Conversion of tables, Python values and typed words to records, and back to TOML."""

import json
import os
import types
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.scenario.records import Goal
from approxjac.validation import as_number

Table = Mapping[str, Any]
_UNIONS = (Union, types.UnionType)
hints = cache(get_type_hints)  # of a record's fields, by name
_WRONG_TYPE = (TypeError, ValueError, OverflowError)  # a number of 400 digits is no float


class Words(tuple[str, ...]):
    """A value as it was typed: one word, or several of a list."""


def filled(record: Any, values: Table, where: str = "", key: str = "") -> Any:
    """Return a record with the values of a table in place of its own, with `Scenario`'s errors.

    A value may be a record or its table. Errors name the file `where` the table is from, and the
    dotted `key` of the record within its scenario.
    """
    made = checked(type(record), record, values, where, key)
    try:
        return replace(record, **made)
    except InvalidInputError as error:  # of a record of the library, which knows no key
        raise InvalidInputError(f"{key}.{error}{_in(where)}", given=error.given) from None


def checked(kind: type, base: Any, values: Table, where: str = "", key: str = "") -> dict[str, Any]:
    """Return values of a table, converted for a kind of record; inner tables fill `base`."""
    known = {field.name: field for field in fields(kind)}
    made = {}
    for name, value in values.items():
        dotted, inner = f"{key}.{name}" if key else name, getattr(base, name, None)
        if name not in known:
            table = " ".join(filter(None, (where, f"[{key}]" if key else ""))) or "a scenario"
            raise UnknownNameError("key", name, table, known)
        if is_dataclass(inner):
            made[name] = filled(inner, _table_of(inner, value, dotted), where, dotted)
            continue
        made[name] = read = value_of(hints(kind)[name], value, dotted, where)
        for number in read if isinstance(read, tuple) else (read,):
            if isinstance(number, int | float) and not isinstance(number, bool):
                try:
                    as_number(dotted, number, **known[name].metadata)
                except InvalidInputError as error:
                    raise InvalidInputError(f"{error}{_in(where)}", given=number) from None
    return made


def value_of(hint: Any, value: Any, key: str, where: str = "") -> Any:
    """Return a value converted to a field's type, or raise an error that names its key."""
    with suppress(*_WRONG_TYPE):
        return converted(hint, value)
    given = (" ".join(value).strip() or "nothing") if isinstance(value, Words) else repr(value)
    raise InvalidInputError(f"{key} must be {wanted(hint)}, got {given}{_in(where)}", given=value)


def converted(hint: Any, value: Any) -> Any:
    """Return a value converted to a field's type; a `_WRONG_TYPE` if it is of another."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in _UNIONS:
        # typed words are also a text, and so may be none
        for kind in sorted(inner, key=lambda kind: kind is not type(None)):
            with suppress(*_WRONG_TYPE):
                return converted(kind, value)
        raise TypeError
    if isinstance(value, Words):
        value = _meant(hint, value)
    if origin is dict:
        return {converted(str, k): converted(inner[1], v) for k, v in dict(value).items()}
    if origin is tuple:
        variadic = inner[-1] is Ellipsis
        if variadic and inner[0] is float and isinstance(value, int | float):
            value = (value,)
        if isinstance(value, str) or (not variadic and len(value) != len(inner)):
            raise TypeError
        kinds = [inner[0]] * len(value) if variadic else inner
        return tuple(converted(kind, entry) for kind, entry in zip(kinds, value, strict=True))
    if isinstance(value, np.generic):
        value = value.item()
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is float and number:
        return float(value)
    if hint is int and number and float(value).is_integer():
        return int(value)
    if hint in (str, bool, type(None)) and isinstance(value, hint):
        return value
    if hint in (str, Path) and isinstance(value, str | os.PathLike) and (hint is str or value):
        return hint(os.fspath(value))
    if origin is Literal and isinstance(value, str) and value in inner:
        return value
    raise TypeError


def _meant(hint: Any, words: Words) -> Any:
    """Return the value of another type that typed words stand for."""
    origin, inner = get_origin(hint), get_args(hint)
    if not words:
        raise ValueError
    if origin is tuple:
        if len(words) == 1 and inner[0] is not str:
            words = Words(words[0].split(","))  # such as 0,1,1
        return [Words((word,)) for word in words]
    if origin is dict:  # a joint and its vector, and so on
        count = 1 + len(get_args(inner[1]))
        if len(words) % count:
            raise ValueError
        return {words[k]: Words(words[k + 1 : k + count]) for k in range(0, len(words), count)}
    (word,) = words
    if hint in (int, float):
        return float(word)
    if hint in (bool, type(None)):
        return {"true": True, "false": False, "None": None}.get(word, word)
    return word


def typed_as(value: Any) -> str:
    """Return a value as it may be typed."""
    if isinstance(value, tuple):
        return " ".join(map(typed_as, value))
    return f"{value:g}" if isinstance(value, float) else f"{value}"


def wanted(hint: Any) -> str:
    """Describe the valid values of a type."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in _UNIONS:
        return " or ".join(wanted(kind) for kind in inner if kind is not type(None))
    if origin is Literal:
        return " or ".join(filter(None, [", ".join(inner[:-1]), inner[-1]]))
    if origin is dict:
        return "3 numbers for each of some joints"
    if origin is tuple:
        what = "words" if inner[0] is str else "numbers"
        return what if inner[-1] is Ellipsis else f"{len(inner)} {what}"
    names = {float: "a number", int: "a whole number", str: "a word", bool: "true or false"}
    return names.get(hint, "a path")


def differences(record: Any, default: Any) -> dict[str, Any]:
    """Return the values of a record that differ from another's, as tables of plain values."""
    changed: dict[str, Any] = {}
    for field in fields(record):
        mine, usual = getattr(record, field.name), getattr(default, field.name)
        if mine != usual:
            changed[field.name] = differences(mine, usual) if is_dataclass(mine) else mine
            if isinstance(mine, Goal) and set(changed[field.name]) == {"at"}:
                changed[field.name] = changed[field.name]["at"]
    return changed


def to_toml(table: Table) -> str:
    """Return a table of plain values as TOML, with a heading for each table in it."""
    inner = {name: value for name, value in table.items() if isinstance(value, Mapping)}
    lines = [f"{name} = {_toml(value)}" for name, value in table.items() if name not in inner]
    for name, values in inner.items():
        lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in values.items())]
    return "\n".join(lines).strip() + "\n"


def _in(where: str) -> str:
    return f" in {where}" if where else ""


def _table_of(record: Any, value: Any, key: str) -> Table:
    if isinstance(value, type(record)):
        return dict(vars(value))
    if isinstance(record, Goal) and isinstance(value, Sequence | np.ndarray):
        return {"at": value}
    if isinstance(value, Mapping):
        return value
    names = ", ".join(field.name for field in fields(record))
    raise InvalidInputError(f"{key} must be a table of {names}, got {value!r}", given=value)


def _toml(value: Any) -> str:
    """Return a plain value as TOML, in one line: as JSON, but for tables and one character."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_toml(v)}" for k, v in value.items()) + " }"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(name: str) -> str:
    bare = name.isascii() and name.replace("_", "").replace("-", "").isalnum()
    return name if bare else _toml(name)
