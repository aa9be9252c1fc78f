"""The command `approxjac`: words → its help, or a command with a scenario and arguments.

Exit codes: 0 all is well, 1 a verdict fell short, 2 bad input.
"""

import errno
import inspect
import io
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import approxjac
from approxjac.cli.export_command import export
from approxjac.cli.learn_command import learn
from approxjac.cli.options import (
    FILES,
    POSITIONAL,
    Option,
    explained,
    options_of,
    read,
    scenario_of,
)
from approxjac.cli.paper_command import paper
from approxjac.cli.robots_command import robots
from approxjac.cli.simulate_command import simulate
from approxjac.cli.stability_command import stability
from approxjac.cli.view_command import view
from approxjac.errors import ApproxJacError, InvalidInputError, UnknownNameError
from approxjac.formatting import width, wrapped
from approxjac.scenario.convert import Words, typed_as, value_of

_COMMANDS = {
    each.__name__: each for each in (paper, robots, simulate, stability, export, view, learn)
}
_INDENT = 26
_NAMES = {float: "N", int: "N", str: "NAME", Path: "PATH"}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115 - a shell closed it, by >&-
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal that cannot show λ shows "?"
    warnings.showwarning = lambda message, *_, **__: _complain(message)  # type: ignore[assignment]
    try:
        return _flushed(_run(arguments or ["--help"]))
    except KeyboardInterrupt:
        print("\napproxjac: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # nobody reads on, and what was not done yet is not done
        return _flushed(128 + 13)  # as what SIGPIPE ends
    except ApproxJacError as error:
        return _complain(error)
    except OSError as error:  # a full disk, a file that is a folder, …
        where = error.filename or ("standard output" if error.errno == errno.ENOSPC else "")
        return _complain(f"{error.strerror or error}{where and ': '}{where}")


def _run(arguments: list[str]) -> int:
    chosen, words = arguments[0], arguments[1:]
    if arguments == ["--version"]:
        print(f"approxjac {approxjac.__version__}")
        return 0
    if chosen in ("-h", "--help"):
        print(_help_of_commands())
        return 0
    if chosen not in _COMMANDS:
        kind = "option" if chosen.startswith("-") else "command"
        raise UnknownNameError(kind, chosen, "approxjac", [*_COMMANDS, "--help", "--version"])
    command = _COMMANDS[chosen]
    options = options_of(command)
    if asked := {"-h", "--help", "--help-all"} & set(words):
        print(_help_of(command, options, "--help-all" in asked))
        return 0
    count = next((k for k, word in enumerate(words) if word.startswith("--")), len(words))
    name, meaning = POSITIONAL.get(chosen, ("", ""))
    more = words[1:count] if FILES in name else []  # files beside what comes first
    count -= len(more)
    if count > bool(name):
        taken = meaning or "options alone"
        given = " ".join(words[:count])
        raise InvalidInputError(f"{chosen} takes {taken}; got {given}", given=given)
    source = "".join(words[:count])
    if not source and (count or name[:1] not in ("", "[")):
        raise InvalidInputError(f"{chosen} needs {meaning}; got none before options", given="")
    values, names = read(chosen, words[count + len(more) :], options)
    values |= {"files": Words(more)} if more else {}
    try:
        return _called(command, source, values)
    except ApproxJacError as error:
        return _complain(explained(error, options, source, values, names))


def _called(command: Callable[..., int], source: str, values: dict[str, Any]) -> int:
    kinds, values = get_type_hints(command), dict(values)
    own = {
        name: value_of(kinds[name], values.pop(name), name)
        for name in inspect.signature(command).parameters
        if name in values
    }
    if "scenario" in kinds:
        return command(scenario_of(command.__name__, source, values), **own)
    return command(source, **own) if source else command(**own)


def _complain(message: object) -> int:
    with suppress(OSError):  # of a stderr that nobody reads, or that is full
        print(f"approxjac: {message}", file=sys.stderr, flush=True)
    return 2


def _flushed(code: int) -> int:
    """Return the exit code when all is printed that somebody still reads, as `head` may not."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or it fails at exit again
    return code


def _help_of_commands() -> str:
    about = wrapped("Torque control of any URDF arm whose kinematics are not exactly known.")
    lines = ["usage: approxjac COMMAND [options]", "", *about, ""]
    for name, command in _COMMANDS.items():
        lines += _entry(name, _paragraphs(command)[0], 14)
    text = (
        "COMMAND --help says more of each command, with examples; --version prints the version. "
        "Exit codes are 0, 1 where a verdict fell short, and 2 for bad input."
    )
    return "\n".join([*lines, "", *wrapped(text)])


def _help_of(command: Callable[..., int], options: Sequence[Option], every: bool) -> str:
    """Return the help of a command with its short options and a hint at all, or all by group."""
    word, meaning = POSITIONAL.get(command.__name__, ("", ""))
    lines = [" ".join(filter(None, ["usage: approxjac", command.__name__, word, "[options]"]))]
    for paragraph in _paragraphs(command):  # an example stays what can be copied
        lines += ["", *([paragraph] if paragraph.startswith("Example: ") else wrapped(paragraph))]
    if word:
        lines += ["", *_entry(word, f"{meaning[0].upper()}{meaning[1:]}.", _INDENT)]
    common = [each for each in options if "." not in each.names[0]]
    groups: dict[str, list[str]] = {}
    for option in options if every else common:
        group = option.key.rpartition(".")[0] if every else ""
        name = ", ".join(option.names) if every else option.names[0]
        entry = _entry(f"{name} {_values(option.hint)}".rstrip(), _text(option), _INDENT)
        groups.setdefault(f"[{group}]" if group else "Options", []).extend(entry)
    for title, entries in groups.items():
        lines += ["", title, *entries]
    if len(common) < len(options) and not every:
        text = (
            f"All {len(options)} options: approxjac {command.__name__} --help-all. Each is a key "
            "of a scenario file: --sensor.noise 0.001 is noise = 0.001 below [sensor]."
        )
        lines += ["", *wrapped(text)]
    return "\n".join(lines)


def _paragraphs(command: Callable[..., int]) -> list[str]:
    text = inspect.cleandoc(command.__doc__ or "").partition("\nArgs:")[0]
    return [part.strip() for part in text.split("\n\n")]


def _text(option: Option) -> str:
    default = option.default
    if default in (None, "", (), False) or default == {} or "default" in option.help:
        return option.help
    return f"{option.help} (default: {typed_as(default)})"


def _entry(name: str, text: str, indent: int) -> list[str]:
    indent = min(indent, width() // 2)
    if len(name) + 4 > indent:
        return [f"  {name}", *wrapped(text, " " * indent)]
    return wrapped(text, f"  {name}".ljust(indent))


def _values(hint: Any) -> str:
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return "|".join(_values(kind) for kind in inner if kind is not type(None))
    if origin is Literal:
        return "|".join(inner)
    if origin is dict:
        return "JOINT X Y Z ..."
    if origin is tuple:
        each = _NAMES[inner[0]]
        return f"{each} ..." if inner[-1] is Ellipsis else " ".join([each] * len(inner))
    return "" if hint is bool else _NAMES[hint]
