"""The folder that commands write to."""

from __future__ import annotations

from pathlib import Path

from approxjac.errors import InvalidInputError


def make_folder(out: Path) -> None:
    """Make the folder that a command writes to.

    Raises:
        InvalidInputError: It cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"--out must be a folder that can be made, got {out}: {error}", given=out
        ) from error
