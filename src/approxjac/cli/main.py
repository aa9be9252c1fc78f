"""The command `approxjac`: words → its help, or a command with a scenario and arguments.

Exit codes: 0 all is well, 1 a verdict fell short, 2 bad input.
"""

from __future__ import annotations

import inspect
import io
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import approxjac
from approxjac.cli.export_command import export
from approxjac.cli.options import (
    COMMON,
    POSITIONAL,
    SHORT,
    Option,
    Typed,
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
from approxjac.errors import ApproxJacError, UnknownNameError
from approxjac.formatting import width, wrapped
from approxjac.scenario.convert import typed_as, value_of

_COMMANDS = {each.__name__: each for each in (paper, robots, simulate, stability, export, view)}
_INDENT = 26
_NAMES = {float: "N", int: "N", str: "NAME", Path: "PATH"}
_COMPLETION = """_approxjac() {{
  local words='{commands}'
  [ "$COMP_CWORD" -gt 1 ] && case ${{COMP_WORDS[1]}} in
{cases}
  esac
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _approxjac approxjac"""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal that cannot show λ shows "?"
    warnings.showwarning = _warned
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
        where = f": {error.filename}" if error.filename else ""
        return _complain(f"{error.strerror or error}{where}")


def _run(arguments: list[str]) -> int:
    chosen, words = arguments[0], arguments[1:]
    if arguments == ["--version"]:
        print(f"approxjac {approxjac.__version__}")
        return 0
    if chosen in ("-h", "--help"):
        print(_help_of_commands())
        return 0
    if chosen == "--completion":
        print(_completion(words[0] if words else "bash"))
        return 0
    if chosen not in _COMMANDS:
        kind = "option" if chosen.startswith("-") else "command"
        known = [*_COMMANDS, "--help", "--version", "--completion"]
        raise UnknownNameError(kind, chosen, "approxjac", known)
    command = _COMMANDS[chosen]
    options = options_of(command)
    if asked := {"-h", "--help", "--help-all"} & set(words):
        common = () if "--help-all" in asked else COMMON.get(chosen, ())
        print(_help_of(command, options, common))
        return 0
    typed = read(chosen, words, options, *POSITIONAL.get(chosen, ("", "")))
    try:
        return _called(command, typed)
    except ApproxJacError as error:
        return _complain(explained(error, options, typed))


def _called(command: Callable[..., int], typed: Typed) -> int:
    """Call a command with what was typed, and with its scenario where it takes one."""
    kinds = get_type_hints(command)
    values = dict(typed.values)
    own = {
        name: value_of(kinds[name], values.pop(name), name)
        for name in inspect.signature(command).parameters
        if name in values
    }
    if command.__name__ in SHORT:
        return command(scenario_of(command.__name__, typed.alone, values), **own)
    return command(typed.alone, **own) if typed.alone else command(**own)


def _complain(message: object) -> int:
    """Print what is wrong, and return the exit code of bad input."""
    print(f"approxjac: {message}", file=sys.stderr)
    return 2


def _warned(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning without the place in the code that Python puts before it."""
    _complain(message)


def _flushed(code: int) -> int:
    """Return the exit code when all is printed that somebody still reads, as `head` may not."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or it fails at exit again
    return code


# -- help -------------------------------------------------------------------------------


def _help_of_commands() -> str:
    lines = ["usage: approxjac COMMAND [options]", ""]
    lines += [
        *wrapped("Torque control of any URDF arm whose kinematics are not exactly known."),
        "",
    ]
    for name, command in _COMMANDS.items():
        lines += _entry(name, _paragraphs(command)[0], 14)
    text = (
        "COMMAND --help says more of each command, with examples; --version prints the version. "
        "Exit codes are 0, 1 where a verdict fell short, and 2 for bad input."
    )
    return "\n".join([*lines, "", *wrapped(text)])


def _completion(shell: str) -> str:
    """Return a script with which a shell completes commands, and the options of each."""
    if shell not in ("bash", "zsh"):
        raise UnknownNameError("shell", shell, "--completion", ("bash", "zsh"))
    cases = []
    for name, command in _COMMANDS.items():
        words = " ".join(word for option in options_of(command) for word in option.names)
        cases.append(f"    {name}) words='{words}' ;;")
    script = _COMPLETION.format(commands=" ".join(_COMMANDS), cases="\n".join(cases))
    zsh = "autoload -U +X compinit bashcompinit && compinit && bashcompinit\n"
    return zsh + script if shell == "zsh" else script


def _help_of(command: Callable[..., int], options: Sequence[Option], common: Sequence[str]) -> str:
    """Return the help of a command with its common options and a hint at all, or all by group."""
    word, meaning = POSITIONAL.get(command.__name__, ("", ""))
    lines = [" ".join(filter(None, ["usage: approxjac", command.__name__, word, "[options]"]))]
    for paragraph in _paragraphs(command):  # an example stays what can be copied
        lines += ["", *([paragraph] if paragraph.startswith("Example: ") else wrapped(paragraph))]
    if word:
        lines += ["", *_entry(word, f"{meaning[0].upper()}{meaning[1:]}.", _INDENT)]
    groups: dict[str, list[str]] = {}
    for option in options:
        name, group = ", ".join(option.names), option.key.rpartition(".")[0]
        title = f"[{group}]" if group else "Options"
        if common:
            name, title = option.names[0], "Common options"
        if not common or set(option.names) & set(common):
            entry = _entry(f"{name} {_values(option.hint)}".rstrip(), _text(option), _INDENT)
            groups.setdefault(title, []).extend(entry)
    for title, entries in groups.items():
        lines += ["", title, *entries]
    if common:
        text = (
            f"All {len(options)} options: approxjac {command.__name__} --help-all. Each is a key "
            "of a scenario file: --sensor.noise 0.001 is noise = 0.001 below [sensor]."
        )
        lines += ["", *wrapped(text)]
    return "\n".join(lines)


def _paragraphs(command: Callable[..., int]) -> list[str]:
    """Return the paragraphs of a command's docstring before its arguments."""
    text = inspect.cleandoc(command.__doc__ or "").partition("\nArgs:")[0]
    return [part.strip() for part in text.split("\n\n")]


def _text(option: Option) -> str:
    """Return what an option is for, and its default where the text has none."""
    default = option.default
    if default in (None, "", (), False) or default == {} or "default" in option.help:
        return option.help
    return f"{option.help} (default: {typed_as(default)})"


def _entry(name: str, text: str, indent: int) -> list[str]:
    """Return a name with a text beside it, or below where the name is long."""
    indent = min(indent, width() // 2)
    if len(name) + 4 > indent:
        return [f"  {name}", *wrapped(text, " " * indent)]
    return wrapped(text, f"  {name}".ljust(indent))


def _values(hint: Any) -> str:
    """Return the value of an option as its help shows it."""
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
