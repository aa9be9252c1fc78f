"""The command `approxjac`: a file a command."""

from approxjac.cli.main import main as main
