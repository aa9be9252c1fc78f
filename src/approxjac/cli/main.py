"""The command `approxjac`: arguments → a command.

Exit codes: 0 all is well, 1 a verdict fell short, 2 bad input.
"""

from __future__ import annotations

import io
import os
import sys
import warnings

import tyro

import approxjac
from approxjac.cli import options
from approxjac.cli.export import export
from approxjac.cli.paper import paper
from approxjac.cli.robots import robots
from approxjac.cli.simulate import simulate
from approxjac.cli.stability import stability
from approxjac.cli.view import view
from approxjac.errors import ApproxJacError, UnknownNameError

_COMMANDS = {each.__name__: each for each in (paper, robots, simulate, stability, export, view)}
_DESCRIPTION = (
    "Torque control of any URDF arm whose kinematics are not exactly known. "
    "COMMAND --help says more of each command, with examples; --version prints the version; "
    "exit codes are 0, 1 where a verdict fell short, and 2 for bad input."
)


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
        if arguments and not arguments[0].startswith("-") and arguments[0] not in _COMMANDS:
            raise UnknownNameError("command", arguments[0], "approxjac", _COMMANDS)
        return _flushed(_run(arguments))
    except KeyboardInterrupt:
        print("\napproxjac: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:  # nobody reads on, and what was not done yet is not done
        return _flushed(128 + 13)  # as what SIGPIPE ends
    except (ApproxJacError, OSError) as error:  # a full disk, a file that is a folder, …
        print(f"approxjac: {error}", file=sys.stderr)
        return 2


def _run(arguments: list[str]) -> int:
    """Read the arguments, with all text of the chosen command and a line of each other one."""
    chosen = arguments[0] if arguments else ""
    app = tyro.extras.SubcommandApp()
    scenario = None
    if chosen in options.SHORT:
        scenario, arguments = options.from_file(arguments)
    for name, command in _COMMANDS.items():
        line = str(command.__doc__).split("\n")[0]
        taking = options.with_options(command, scenario) if name in options.SHORT else command
        app.command(name=name, help=None if name == chosen else line)(taking)
    return int(app.cli(args=arguments, prog="approxjac", description=_DESCRIPTION))


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
