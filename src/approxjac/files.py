"""Files written atomically, and read whole or not at all."""

import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from approxjac.errors import InvalidInputError


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yield a temporary path whose file replaces `path` when the block ends.

    If the block raises an error, `path` stays as it was and the temporary file is removed.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder")
    # of one name's length, and of its ending, which tells some writers the format
    unfinished = path.with_name(f".{uuid.uuid4().hex[:16]}{path.suffix}")
    try:
        with _naming(path, unfinished):
            yield unfinished
            unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


@contextmanager
def _naming(path: Path, unfinished: Path) -> Iterator[None]:
    """Make errors name the user's file or folder, also those that name none."""
    try:
        yield
    except Exception as error:
        old, new = str(unfinished), str(path)
        if isinstance(error, OSError) and error.errno is not None:
            error.filename = str(error.filename or old).replace(old, new)
        else:
            error.args = tuple(
                each.replace(old, new) if isinstance(each, str) else each for each in error.args
            )
        raise


@contextmanager
def together(folder: Path) -> Iterator[Path]:
    """Yield an empty folder inside `folder`; its files are moved there when the block ends.

    If the block raises an error, no file of `folder` is changed.
    """
    unfinished = folder / f".{uuid.uuid4().hex[:16]}"
    try:
        with _naming(folder, unfinished):
            unfinished.mkdir()
            yield unfinished
            for path in sorted(unfinished.iterdir()):
                path.replace(folder / path.name)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


@contextmanager
def refusing(
    wanted: str, given: object, kinds: tuple[type[Exception], ...] = (OSError,)
) -> Iterator[None]:
    """Raise an InvalidInputError with what was wanted and given in place of some kinds of errors.

    A ValueError is one of a name that no file can have.
    """
    try:
        yield
    except kinds as error:
        file = str(getattr(error, "filename", None) or given)  # of several in a folder
        named = given if file == str(given) else f"{given}: {file}"
        raise InvalidInputError(f"{wanted}, got {named}: {reason(error)}", given=given) from error


def reason(error: Exception) -> str:
    """Return the reason of a file error, without its number and names of temporary files."""
    return (isinstance(error, OSError) and error.strerror) or str(error)


def read_text(path: Path, most: int) -> str:
    """Read a text file in UTF-8; raise an OSError if it has more than `most` bytes."""
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(f"it has more than {most} bytes")
    return data.decode()


def write_text(path: Path, text: str) -> None:
    """Write a text file as UTF-8."""
    with replaced(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


def read_arrays(stream: IO[bytes]) -> dict[str, Any]:
    """Return the arrays of a .npz file by name.

    A damaged file raises an error of zipfile, zlib or NumPy, or a ValueError.
    """
    with np.load(stream, allow_pickle=False) as archive:
        if damaged := archive.zip.testzip():
            raise ValueError(f"{damaged} is damaged")
        return dict(archive)
