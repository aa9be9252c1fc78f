"""The command `approxjac`: words → a command with a scenario and arguments.

Exit codes: 0 all is well, 1 a verdict fell short, 2 bad input.
"""

from __future__ import annotations

import inspect
import io
import os
import sys
import warnings
from collections.abc import Callable
from typing import get_type_hints

import approxjac
from approxjac.cli import help
from approxjac.cli.export_command import export
from approxjac.cli.options import COMMON, POSITIONAL, SHORT, options_of, scenario_of
from approxjac.cli.paper_command import paper
from approxjac.cli.parser import Typed, explained, read
from approxjac.cli.robots_command import robots
from approxjac.cli.simulate_command import simulate
from approxjac.cli.stability_command import stability
from approxjac.cli.view_command import view
from approxjac.errors import ApproxJacError, UnknownNameError
from approxjac.scenario.convert import value_of

_COMMANDS = {each.__name__: each for each in (paper, robots, simulate, stability, export, view)}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"approxjac {approxjac.__version__}")
        return 0
    arguments = arguments or ["--help"]
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal that cannot show λ shows "?"
    warnings.showwarning = _warned
    try:
        return _flushed(_run(arguments))
    except KeyboardInterrupt:
        print("\napproxjac: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # nobody reads on, and what was not done yet is not done
        return _flushed(128 + 13)  # as what SIGPIPE ends
    except ApproxJacError as error:
        print(f"approxjac: {error}", file=sys.stderr)
        return 2
    except OSError as error:  # a full disk, a file that is a folder, …
        where = f": {error.filename}" if error.filename else ""
        print(f"approxjac: {error.strerror or error}{where}", file=sys.stderr)
        return 2


def _run(arguments: list[str]) -> int:
    """Run a command, or show its help."""
    chosen, words = arguments[0], arguments[1:]
    if chosen in ("-h", "--help"):
        print(help.of_commands(_COMMANDS))
        return 0
    if chosen == "--completion":
        options = {name: options_of(each) for name, each in _COMMANDS.items()}
        print(help.completion(words[0] if words else "bash", options))
        return 0
    if chosen not in _COMMANDS:
        kind = "option" if chosen.startswith("-") else "command"
        known = [*_COMMANDS, "--help", "--version", "--completion"]
        raise UnknownNameError(kind, chosen, "approxjac", known)
    command = _COMMANDS[chosen]
    known_options, typed = options_of(command), Typed()
    if asked := {"-h", "--help", "--help-all"} & set(words):
        common = () if "--help-all" in asked else COMMON.get(chosen, ())
        print(help.of_command(command, known_options, common))
        return 0
    try:
        read(typed, chosen, words, known_options, *POSITIONAL.get(chosen, ("", "")))
        return _called(command, typed)
    except ApproxJacError as error:
        message = explained(error, known_options, typed, typed.alone.endswith(".toml"))
        print(f"approxjac: {message}", file=sys.stderr)
        return 2


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


def _warned(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning without the place in the code that Python puts before it."""
    print(f"approxjac: {message}", file=sys.stderr)


def _flushed(code: int) -> int:
    """Return the exit code when all is printed that somebody still reads, as `head` may not."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or it fails at exit again
    return code
