"""Files that are written whole or not at all."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield a new path beside another one, whose place the file there takes at the end.

    Where the block raises an error, what was at the place stays as it was, and nothing is left.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder")
    # of one name's length, and of its ending, which tells some writers the format
    unfinished = path.with_name(f".{uuid.uuid4().hex[:16]}{path.suffix}")
    try:
        yield unfinished
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def reason(error: Exception) -> str:
    """Return why a file cannot be read or written, without numbers and names of temporary files."""
    return (isinstance(error, OSError) and error.strerror) or str(error)


def write_text(path: Path, text: str) -> None:
    """Write a text file as UTF-8."""
    with replaced(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
