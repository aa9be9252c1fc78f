"""Files that are written whole or not at all, and of which no more is read than they may hold."""

from __future__ import annotations

import math
import shutil
import uuid
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

_MOST_ARRAYS = 4_000_000_000  # bytes, of all arrays of a file: two hours of a run at 1 kHz
_DENSEST = 1100.0  # what deflate makes of a byte at most
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


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


@contextmanager
def together(folder: Path) -> Iterator[Path]:
    """Yield an empty folder inside another one, whose files take their places there at the end.

    Where the block raises an error, no file of the other folder is changed.
    """
    unfinished = folder / f".{uuid.uuid4().hex[:16]}"
    try:
        unfinished.mkdir()
    except OSError as error:  # which names the folder that the user knows
        raise OSError(error.errno, error.strerror, str(folder)) from error
    try:
        yield unfinished
        for path in sorted(unfinished.iterdir()):
            path.replace(folder / path.name)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def reason(error: Exception) -> str:
    """Return the reason of an error of files, without numbers and names of temporary files."""
    return (isinstance(error, OSError) and error.strerror) or str(error)


def read_text(path: Path, most: int) -> str:
    """Return a text file in UTF-8; an OSError says if it has more than `most` bytes."""
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(f"it has more than {most} bytes")
    return data.decode()


def write_text(path: Path, text: str) -> None:
    """Write a text file as UTF-8."""
    with replaced(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


def read_arrays(stream: IO[bytes], names: Iterable[str] | None = None) -> dict[str, Any]:
    """Return arrays of a .npz file by their names, all of them if none are given.

    No array is made before it is known that the file holds as much as its header claims, at most
    4 GB in all. A damaged file raises what zipfile, zlib and NumPy raise, or a ValueError.
    """
    with zipfile.ZipFile(stream) as archive:
        if names is None:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
        members = {name: archive.getinfo(f"{name}.npy") for name in names}
        size = sum(member.file_size for member in members.values())
        if size > _MOST_ARRAYS:
            raise ValueError(f"its arrays have {size} bytes, more than {_MOST_ARRAYS}")
        return {name: _array(archive, name, member) for name, member in members.items()}


def _array(archive: zipfile.ZipFile, name: str, member: zipfile.ZipInfo) -> Any:
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is compressed in a way that NumPy does not")
    if member.file_size > _DENSEST * (member.compress_size + 1):
        raise ValueError(f"{name} cannot have the {member.file_size} bytes that it claims")
    with archive.open(member) as file:
        version = npy.read_magic(file)
        if version not in _HEADERS:
            raise ValueError(f"{name} has a header of version {version}")
        shape, is_fortran, dtype = _HEADERS[version](file)
        claimed = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or min(shape, default=0) < 0:
            raise ValueError(f"{name} holds no numbers or texts")
        if claimed != member.file_size - file.tell():
            raise ValueError(f"{name} claims {claimed} bytes and has {member.file_size}")
        array = np.frombuffer(bytearray(file.read()), dtype)
        return array.reshape(shape, order="F" if is_fortran else "C")
