"""Records to and from tables of names and values, as TOML and options have them."""

from __future__ import annotations

import json
import os
import types
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import Field, fields, is_dataclass, replace
from functools import cache
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.scenario.records import Goal
from approxjac.validation import as_number

Table = Mapping[str, Any]
_UNIONS = (Union, types.UnionType)


@cache
def hints(kind: type) -> Mapping[str, Any]:
    """Return the types of a record's fields by name."""
    return get_type_hints(kind)


def filled(record: Any, values: Table, where: str = "", key: str = "") -> Any:
    """Return a record with the values of a table in place of its own, as `Scenario` refuses them.

    A value may be a record or its table. Errors name the file `where` the table is from, and the
    dotted `key` of the record within its scenario.
    """
    return replace(record, **checked(type(record), record, values, where, key))


def checked(kind: type, base: Any, values: Table, where: str = "", key: str = "") -> dict[str, Any]:
    """Return values of a table as a kind of record has them; those of inner tables fill `base`."""
    known: dict[str, Field[Any]] = {field.name: field for field in fields(kind)}
    table = " ".join(word for word in (where, f"[{key}]" if key else "") if word) or "a scenario"
    found = {}
    for name, value in values.items():
        if name not in known:
            raise UnknownNameError("key", name, table, known)
        dotted, inner = f"{key}.{name}" if key else name, getattr(base, name, None)
        if is_dataclass(inner):
            found[name] = filled(inner, _table_of(inner, value, dotted), where, dotted)
            continue
        found[name] = made = _value(hints(kind)[name], value, dotted, where, table)
        for number in made if isinstance(made, tuple) else (made,):
            if isinstance(number, int | float):
                _in_range(dotted, number, where, known[name])
    return found


def _in_range(key: str, number: float, where: str, field: Field[Any]) -> None:
    """Refuse a number that is out of its range, and say in which file."""
    try:
        as_number(key, number, **field.metadata)
    except InvalidInputError as error:
        told = f" in {where}" if where else ""
        raise InvalidInputError(f"{error}{told}", given=number) from None


def differences(record: Any, default: Any) -> dict[str, Any]:
    """Return what a record has otherwise than another, as tables of plain values."""
    found: dict[str, Any] = {}
    for field in fields(record):
        mine, usual = getattr(record, field.name), getattr(default, field.name)
        if mine == usual:
            continue
        found[field.name] = differences(mine, usual) if is_dataclass(mine) else mine
        if isinstance(mine, Goal) and set(found[field.name]) == {"at"}:
            found[field.name] = found[field.name]["at"]
    return found


def to_toml(table: Table) -> str:
    """Return a table of plain values as TOML, with a heading for each table in it."""
    inner = {name: value for name, value in table.items() if isinstance(value, Mapping)}
    lines = [f"{name} = {toml(value)}" for name, value in table.items() if name not in inner]
    for name, values in inner.items():
        lines += ["", f"[{name}]", *(f"{key} = {toml(value)}" for key, value in values.items())]
    return "\n".join(lines).strip() + "\n"


def _table_of(record: Any, value: Any, key: str) -> Table:
    """Return the table that a value is for a field that is a record."""
    if isinstance(value, type(record)):
        return dict(vars(value))
    if isinstance(record, Goal) and isinstance(value, Sequence | np.ndarray):
        return {"at": value}
    if isinstance(value, Mapping):
        return value
    names = ", ".join(field.name for field in fields(record))
    raise InvalidInputError(f"{key} must be a table of {names}, got {value!r}", given=value)


def _value(hint: Any, value: Any, key: str, where: str, table: str) -> Any:
    """Return a value as a field of that type has it."""
    kinds = get_args(hint) if get_origin(hint) in _UNIONS else (hint,)
    for kind in kinds:
        # a number has no length, and one of 400 digits is no float
        with suppress(TypeError, ValueError, OverflowError):
            return _converted(kind, value)
    kinds = tuple(kind for kind in kinds if kind is not type(None))
    words = [get_args(kind) for kind in kinds if get_origin(kind) is Literal]
    if isinstance(value, str) and len(words) == len(kinds):
        raise UnknownNameError(key, value, table, sum(words, ()))
    told = f"{key} must be {' or '.join(map(_wanted, kinds))}, got {value!r}"
    raise InvalidInputError(told + (f" in {where}" if where else ""), given=value)


def _converted(hint: Any, value: Any) -> Any:
    """Return a value as a field of that type has it; a TypeError where it is of another."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Literal and isinstance(value, str) and value in inner:
        return value
    if origin is dict:
        return {_converted(str, k): _converted(inner[1], v) for k, v in dict(value).items()}
    if origin is tuple:
        variadic = inner[-1] is Ellipsis
        if variadic and inner[0] is float and isinstance(value, int | float):
            value = (value,)
        if isinstance(value, str) or (not variadic and len(value) != len(inner)):
            raise TypeError
        kinds = [inner[0]] * len(value) if variadic else inner
        return tuple(_converted(kind, entry) for kind, entry in zip(kinds, value, strict=True))
    if isinstance(value, np.generic):
        value = value.item()
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is float and number:
        return float(value)
    if hint is int and number and float(value).is_integer():
        return int(value)
    if hint in (str, type(None)) and isinstance(value, hint):
        return value
    if hint is str and isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError


def _wanted(hint: Any) -> str:
    """Return what a value of a type is, in words."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Literal:
        return " or ".join(json.dumps(word) for word in inner)
    if origin is dict:
        return f"a table of names, each with {_wanted(inner[1])}"
    if origin is tuple:
        count = "" if inner[-1] is Ellipsis else f"{len(inner)} "
        return f"a list of {count}{'words' if inner[0] is str else 'numbers'}"
    return {float: "a number", int: "a whole number", str: "a word"}[hint]


def toml(value: Any) -> str:
    """Return a plain value as TOML, in one line."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return _quoted(value) if isinstance(value, str) else repr(value)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")  # as JSON but for this


def _key(name: str) -> str:
    bare = name.isascii() and name.replace("_", "").replace("-", "").isalnum()
    return name if bare else _quoted(name)
