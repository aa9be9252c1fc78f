"""The command `approxjac`: a file a command."""

from approxjac.cli.main import main

__all__ = ["main"]
