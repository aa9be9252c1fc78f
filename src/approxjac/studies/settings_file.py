"""Settings of a command from a TOML file."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

from approxjac.errors import InvalidInputError, UnknownNameError


def with_file(arguments: list[str], commands: Mapping[str, type]) -> list[str]:
    """Write the settings of `COMMAND FILE.toml` out as the options that they stand for."""
    files = [word for word in arguments if word.endswith(".toml")]
    if not files or arguments[0] not in commands:
        return arguments
    path, given = Path(files[0]), [word for word in arguments[1:] if word != files[0]]
    try:
        settings = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InvalidInputError(f"{path} does not exist", given=path) from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidInputError(f"{path} cannot be read as TOML: {error}", given=path) from error
    robot = settings.pop("robot", None)
    if not isinstance(robot, str):
        raise InvalidInputError(
            f'{path} must name a robot, such as robot = "panda", got {robot!r}', given=path
        )
    valid = {"out", *(field.name for field in fields(commands[arguments[0]]))}
    for name in settings:
        if name not in valid:
            raise UnknownNameError("setting", name, str(path), valid)
    if any(word.split("=")[0] in ("--target", "--target-offset") for word in given):
        settings = {k: v for k, v in settings.items() if k not in ("target", "target_offset")}
    words = []
    for name, value in settings.items():
        option = f"--{name.replace('_', '-')}"
        if isinstance(value, dict | list):
            words += [option, *_words(value)]
        else:
            words.append(f"{option}={value}")  # as one word, so that "-x" is a value
    return [arguments[0], robot, *words, *given]


def _words(value: object) -> list[str]:
    """Return a TOML value as it is written on a command line."""
    if isinstance(value, dict):
        return [word for key, entry in value.items() for word in (str(key), *_words(entry))]
    if isinstance(value, list):
        return [word for entry in value for word in _words(entry)]
    return [str(value)]
