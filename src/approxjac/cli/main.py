"""The command `approxjac`: arguments → a command.

Exit codes: 0 all is well, 1 a verdict fell short, 2 bad input.
"""

from __future__ import annotations

import io
import os
import sys
import warnings
from collections.abc import Callable

import tyro

import approxjac
from approxjac.cli import help, options
from approxjac.cli.argument_types import Typed, in_words_of_user, read
from approxjac.cli.export_command import export
from approxjac.cli.paper_command import paper
from approxjac.cli.robots_command import robots
from approxjac.cli.simulate_command import simulate
from approxjac.cli.stability_command import stability
from approxjac.cli.view_command import view
from approxjac.errors import ApproxJacError, UnknownNameError
from approxjac.scenario import Scenario

_COMMANDS = {each.__name__: each for each in (paper, robots, simulate, stability, export, view)}
_SCENARIO = (
    "NAME|FILE",
    "Name of an arm (approxjac robots lists them), a .urdf file, or a .toml file with a scenario; "
    "options come before what it says.",
)
_POSITIONAL = {
    "paper": ("", ""),
    "robots": ("[NAME|FILE]", "Name or .urdf file of the one to describe."),
    "simulate": _SCENARIO,
    "stability": _SCENARIO,
    "export": _SCENARIO,
    "view": ("RUN", "File run.npz that simulate, paper or Trajectory.save wrote, or its folder."),
}


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
    chosen = arguments[0]
    if chosen in ("-h", "--help"):
        print(help.of_commands(_COMMANDS))
        return 0
    if chosen.startswith("--tyro"):  # the shell's completion
        return _called(arguments, None)
    if chosen not in _COMMANDS:
        kind = "option" if chosen.startswith("-") else "command"
        raise UnknownNameError(kind, chosen, "approxjac", [*_COMMANDS, "--help", "--version"])
    command, words = _COMMANDS[chosen], arguments[1:]
    if asked := {"-h", "--help", "--help-all"} & set(words):
        common = () if "--help-all" in asked else options.COMMON.get(chosen, ())
        print(help.of_command(command, options.of(command), _POSITIONAL[chosen], common))
        return 0
    scenario, spelled = None, dict[str, str]()
    if chosen in options.SHORT:
        scenario, words, spelled = options.from_file(words)
    known, typed = options.of(command, scenario), dict[str, Typed]()
    try:
        words, typed = read(chosen, words, known, options.MEANT.get(chosen, ""), spelled)
        return _called([chosen, *words], scenario)
    except ApproxJacError as error:
        told = in_words_of_user(error, known, typed, scenario is not None)
        print(f"approxjac: {told}", file=sys.stderr)
        return 2


def _called(arguments: list[str], scenario: Scenario | None) -> int:
    """Call a command with words that it takes; without one, tell the shell of all of them."""

    def taking(command: Callable[..., int]) -> Callable[..., int]:
        takes_scenario = command.__name__ in options.SHORT
        return options.with_options(command, scenario) if takes_scenario else command

    if arguments[0] in _COMMANDS:
        command = taking(_COMMANDS[arguments[0]])
        return int(tyro.cli(command, args=arguments[1:], prog=f"approxjac {arguments[0]}"))
    app = tyro.extras.SubcommandApp()
    for name, command in _COMMANDS.items():
        app.command(name=name)(taking(command))
    return int(app.cli(args=arguments, prog="approxjac"))


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
