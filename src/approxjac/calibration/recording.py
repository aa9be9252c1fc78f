"""`Recording`: configurations of an arm, and what was measured of its tip at each."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.formatting import short_fields
from approxjac.robots import Robot
from approxjac.validation import Array, as_array, require

_POSITION = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_NAMED = ("socket", "place")


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """Configurations of an arm, and what was measured of its tip at each of them.

    Without x the tip was held at an unmeasured point, such as a ball in a socket: always
    the same for rows with the same `socket` and `place`. With x a tracker saw it, whose axes and
    origin may be unknown; with quaternions it saw the orientation, too.

    Attributes:
        q: Positions of the joints, shape (N, n) [rad or m]; configurations (N, nq) will do.
        joints: Their names, n of them; by default those of the arm in its order.
        x: Positions of the tip, shape (N, 3) [m]; None if they were not measured.
        quaternion: Orientations (x, y, z, w) of the tip, shape (N, 4); None without.
        socket: Name of the place at which the tip was held, one for all rows or N.
        place: Where the arm stood or reached to: rows of one place are left out together when the
            calibration is checked; one name for all rows or N.

    Raises:
        InvalidInputError: Arrays of other shapes, or not finite; quaternions without x.
    """

    q: Array
    joints: Sequence[str] | None = None
    x: Array | None = None
    quaternion: Array | None = None
    socket: str | Sequence[str] = ""
    place: str | Sequence[str] = ""
    __repr__ = short_fields

    def __post_init__(self) -> None:
        n = "n" if self.joints is None else len(self.joints)
        q = as_array("q of a recording", self.q, ("N", n))
        rows = len(q)
        for name, size, unit in (("x", 3, "m"), ("quaternion", 4, "")):
            if (values := getattr(self, name)) is not None:
                values = as_array(f"{name} of a recording", values, (rows, size), unit)
                object.__setattr__(self, name, values)
        if self.quaternion is not None and self.x is None:
            raise InvalidInputError("quaternion needs x of the same rows, got none", given=self.x)
        if self.quaternion is not None and not np.linalg.norm(self.quaternion, axis=1).all():
            message = "quaternion of a recording must not be zero"
            raise InvalidInputError(message, given=self.quaternion)
        for name in _NAMED:
            names = getattr(self, name)
            each = (names,) * rows if isinstance(names, str) else tuple(map(str, names))
            if len(each) != rows:
                message = f"{name} must be one name or one for each of {rows} rows, got {len(each)}"
                raise InvalidInputError(message, given=names)
            object.__setattr__(self, name, each)
        object.__setattr__(self, "q", q)

    def __len__(self) -> int:
        return len(self.q)

    @property
    def kind(self) -> str:
        """The kind of measurement: "socket", "point" or "pose"."""
        if self.x is None:
            return "socket"
        return "point" if self.quaternion is None else "pose"

    @classmethod
    def load(
        cls, path: str | Path, place: str | None = None, socket: str | None = None
    ) -> Recording:
        """Read a csv file; by the names of its columns.

        Names of joints [rad or m]; `x y z` [m] and `qx qy qz qw` of the tip; `socket` and `place`.
        Other columns are passed over. A file without a header holds the joints only, in the arm's
        order.

        Args:
            path: The file.
            place: Name of the place; by default that of the column, or else of the folder.
            socket: Name of the socket; by default that of the column, or else of the file.

        Raises:
            InvalidInputError: A file that cannot be read, or has a row of another length.
        """
        path = Path(require("path", path, (str, Path), "a file to read"))
        try:
            with path.open(newline="", encoding="utf-8-sig") as file:
                lines = [line for line in file if line.strip() and not line.startswith("#")]
            marks = ";" if lines and ";" in lines[0] else ","
            rows = [[each.strip() for each in row] for row in csv.reader(lines, delimiter=marks)]
        except (OSError, UnicodeDecodeError) as error:
            raise InvalidInputError(f"recording {path} cannot be read: {error}") from error
        head = rows.pop(0) if rows and not _is_number(rows[0][0]) else []
        width = len(head or (rows[0] if rows else ()))
        if not rows or {len(row) for row in rows} != {width}:
            message = f"recording {path} must have rows of equal length, and some, got {len(rows)}"
            raise InvalidInputError(message, given=str(path))
        texts = list(zip(*rows, strict=True))
        columns = dict(zip(head, texts, strict=True)) if head else {}
        own_place, own_socket = columns.pop("place", ()), columns.pop("socket", ())
        at = place or own_place or path.resolve().parent.name
        held = socket or own_socket or path.stem
        numbers: dict[str, Array] = {}
        for name, each in columns.items():
            bad = [i for i, text in enumerate(each) if not _is_number(text)]
            if bad and len(bad) < len(each):
                where = f"column {name} of {path}, row {bad[0] + 1}"
                message = f"{where} must hold a number, got {each[bad[0]]!r}"
                raise InvalidInputError(message, given=str(path))
            if not bad and name != "t":
                known = name.lower() in (*_POSITION, *_QUATERNION)
                numbers[name.lower() if known else name] = np.array(each, dtype=float)
        x, quaternion = (
            np.stack([numbers.pop(name) for name in parts], axis=1)
            if all(name in numbers for name in parts) else None
            for parts in (_POSITION, _QUATERNION)
        )  # fmt: skip
        if head:
            q = np.stack([*numbers.values()], axis=1) if numbers else np.zeros((len(rows), 0))
            return cls(q, tuple(numbers), x, quaternion, held, at)
        if not all(map(_is_number, chain.from_iterable(rows))):
            message = f"recording {path} must hold numbers, or have names in its first row"
            raise InvalidInputError(message, given=str(path))
        return cls(np.array(rows, dtype=float), socket=held, place=at)

    def of(self, arm: Robot) -> Recording:
        """Return this recording with q as the arm's configurations, (N, nq).

        Raises:
            InvalidInputError: A joint of the arm is missing, or q has another width.
        """
        names, q = arm.joint_names, self.q
        if self.joints is not None:
            if missing := [name for name in names if name not in self.joints]:
                message = (
                    f"recording must have all joints of {arm.name}, got no {missing[0]} among "
                    f"{', '.join(self.joints) or 'no numbers'}"
                )
                raise InvalidInputError(message, given=self.joints)
            q = q[:, [list(self.joints).index(name) for name in names]]
        if q.shape[1] not in (arm.nv, arm.nq):
            message = f"q of a recording must have {arm.nv} joints of {arm.name}, got {q.shape[1]}"
            raise InvalidInputError(message, given=q.shape)
        rows = np.array([arm.configuration(each) for each in q])
        return replace(self, q=rows, joints=None)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
