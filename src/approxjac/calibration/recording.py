"""`Recording`: configurations of an arm, and what was measured of its tip at each."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, zip_longest
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from approxjac.errors import InvalidInputError, MissingPackageError, package_of
from approxjac.files import read_arrays, reason
from approxjac.formatting import short_fields
from approxjac.robots import Robot
from approxjac.validation import Array, as_array, require

_NAMED = ("socket", "place")
_POSITION, _QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
_TIPS = {"PointStamped": "point", "PoseStamped": "pose"}
_STATE = "observation.state"


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
        t: Time of the rows, shape (N,) [s]; None if it is not known.
        tau: Torques of the motors, shape (N, n) [N m or N], NaN where unknown. Without x they make
            a recording a free motion, which shows friction and load only.

    Raises:
        InvalidInputError: Arrays of other shapes, or not finite; quaternions without x.
    """

    q: Array
    joints: Sequence[str] | None = None
    x: Array | None = None
    quaternion: Array | None = None
    socket: str | Sequence[str] = ""
    place: str | Sequence[str] = ""
    t: Array | None = None
    tau: Array | None = None
    __repr__ = short_fields

    def __post_init__(self) -> None:
        n = "n" if self.joints is None else len(self.joints)
        q = as_array("q of a recording", self.q, ("N", n))
        rows = len(q)
        shapes = {"x": (rows, 3), "quaternion": (rows, 4), "t": (rows,)}
        for name, unit in (("x", "m"), ("quaternion", ""), ("t", "s")):
            if (values := getattr(self, name)) is not None:
                values = as_array(f"{name} of a recording", values, shapes[name], unit)
                object.__setattr__(self, name, values)
        if self.quaternion is not None and self.x is None:
            raise InvalidInputError("quaternion needs x of the same rows, got none", given=self.x)
        if self.quaternion is not None and not np.linalg.norm(self.quaternion, axis=1).all():
            message = "quaternion of a recording must not be zero"
            raise InvalidInputError(message, given=self.quaternion)
        if self.tau is not None and np.shape(self.tau) != q.shape:
            message = f"tau of a recording must have shape {q.shape}, got {np.shape(self.tau)}"
            raise InvalidInputError(message, given=self.tau)
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
        """The kind of measurement: "socket", "point" or "pose", or "motion" of torques only."""
        if self.x is None:
            return "socket" if self.tau is None else "motion"
        return "point" if self.quaternion is None else "pose"

    @classmethod
    def load(
        cls, path: str | Path, place: str | None = None, socket: str | None = None
    ) -> Recording:
        """Read a file by its ending: .mcap, LeRobot's .parquet, a run's .npz, or else csv.

        Columns are names of joints [rad or m], and `name.tau` of their torques [N m or N]; `t` [s];
        `x y z` [m] and `qx qy qz qw` of the tip; `socket` and `place`. Others are passed over. A
        csv file without a header holds the joints only, in the arm's order. Of MCAP it reads
        JointState, and PointStamped or PoseStamped of one topic; of LeRobot `observation.state`.

        Args:
            path: The file.
            place: Name of the place; by default that of the column, or else of the folder.
            socket: Name of the socket; by default that of the column, or else of the file.

        Raises:
            InvalidInputError: A file that cannot be read, or has a row of another length.
            MissingPackageError: The extra "ros2" or "lerobot" is not installed.
        """
        path = Path(require("path", path, (str, Path), "a file to read"))
        try:
            columns = _READERS.get(path.suffix.lower(), _csv)(path)
        except MissingPackageError:
            raise
        except Exception as error:  # each library raises its own
            message = f"recording {path} cannot be read: {reason(error)}"
            raise InvalidInputError(message, given=str(path)) from error
        at, held = (columns.pop(name, None) for name in ("place", "socket"))
        t, q = columns.pop("t", None), columns.pop("", None)
        x, quaternion = (
            np.stack([columns.pop(name) for name in parts], axis=1)
            if all(name in columns for name in parts) else None
            for parts in (_POSITION, _QUATERNION)
        )  # fmt: skip
        tau = {name: columns.pop(name) for name in [*columns] if name.endswith(".tau")}
        joints = None if q is not None else tuple(columns)
        if q is None:
            q = np.array([*columns.values()]).T if columns else np.zeros((1, 0))
        unknown = np.full(len(q), np.nan)
        torques = [tau.get(f"{name}.tau", unknown) for name in joints or ()] or [*tau.values()]
        return cls(
            q, joints, x, quaternion, socket or (path.stem if held is None else held),
            place or (path.resolve().parent.name if at is None else at), t,
            np.stack(torques, axis=1) if np.isfinite(torques).any() else None,
        )  # fmt: skip

    def of(self, arm: Robot) -> Recording:
        """Return this recording with q as the arm's configurations, (N, nq).

        Raises:
            InvalidInputError: A joint of the arm is missing, or q has another width.
        """
        names, q, tau = arm.joint_names, self.q, self.tau
        if self.joints is not None:
            if missing := [name for name in names if name not in self.joints]:
                message = (
                    f"recording must have all joints of {arm.name}, got no {missing[0]} among "
                    f"{', '.join(self.joints) or 'no numbers'}"
                )
                raise InvalidInputError(message, given=self.joints)
            order = [list(self.joints).index(name) for name in names]
            q, tau = q[:, order], None if tau is None else np.asarray(tau)[:, order]
        if q.shape[1] not in (arm.nv, arm.nq):
            message = f"q of a recording must have {arm.nv} joints of {arm.name}, got {q.shape[1]}"
            raise InvalidInputError(message, given=q.shape)
        rows = np.array([arm.configuration(each) for each in q])
        return replace(self, q=rows, joints=None, tau=tau)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _csv(path: Path) -> dict[str, Any]:
    """Return columns of numbers, places and sockets; without a header all numbers as ""."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = [line for line in file if line.strip() and not line.startswith("#")]
    marks = ";" if lines and ";" in lines[0] else ","
    rows = [[each.strip() for each in row] for row in csv.reader(lines, delimiter=marks)]
    head = rows.pop(0) if rows and not _is_number(rows[0][0]) else []
    if not rows or {len(row) for row in rows} != {len(head or rows[0])}:
        raise ValueError(f"it must have rows of equal length, and some, got {len(rows)}")
    if not head:
        if not all(map(_is_number, chain.from_iterable(rows))):
            raise ValueError("it must hold numbers, or have names in its first row")
        return {"": np.array(rows, dtype=float)}
    columns = dict[str, Any]()
    for name, each in zip(head, zip(*rows, strict=True), strict=True):
        bad = [] if name in _NAMED else [i for i, text in enumerate(each) if not _is_number(text)]
        if name in _NAMED:
            columns[name] = np.array(each)
        elif not bad:
            known = name.lower() in (*_POSITION, *_QUATERNION)
            columns[name.lower() if known else name] = np.array(each, dtype=float)
        elif len(bad) < len(each):
            where = f"column {name}, row {bad[0] + 1}"
            raise ValueError(f"{where} must hold a number, got {each[bad[0]]!r}")
    return columns


def _mcap(path: Path) -> dict[str, Any]:
    """Return a row for each point or pose, or else each JointState; joints are interpolated."""
    make_reader = package_of("ros2", "mcap.reader").make_reader
    from_json = partial(json.loads, object_hook=lambda fields: SimpleNamespace(**fields))
    own = SimpleNamespace(decoder_for=lambda coded, _: from_json if coded == "json" else None)
    decoders = [package_of("ros2", "mcap_ros2.decoder").DecoderFactory(), own]
    joints, tips = dict[str, list[Any]](), dict[str, list[Any]]()
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=decoders)
        for schema, channel, _, message in reader.iter_decoded_messages():
            kind = schema.name.rpartition("/")[2] if schema else ""
            if kind not in ("JointState", *_TIPS):
                continue
            t = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            if kind == "JointState":
                values = zip_longest(message.position, message.effort, fillvalue=np.nan)
                for name, each in zip(message.name, values, strict=True):
                    joints.setdefault(name, []).append((t, *each))
                continue
            tip = getattr(message, _TIPS[kind])
            row = [t, *(getattr(getattr(tip, "position", tip), axis) for axis in _POSITION)]
            if kind == "PoseStamped":
                row += [getattr(tip.orientation, name[1]) for name in _QUATERNION]
            tips.setdefault(channel.topic, []).append(row)
    if not joints or len(tips) > 1:
        topics = ", ".join(tips) or "none"
        raise ValueError(f"it has JointState of {len(joints)} joints, and points or poses {topics}")
    series = [np.array(rows).T for rows in joints.values()]
    seen = np.array(*tips.values()).T if tips else max(series, key=np.size)[:1]
    first, last = max(each[0, 0] for each in series), min(each[0, -1] for each in series)
    seen = seen[:, (seen[0] >= first) & (seen[0] <= last)]
    columns = dict(zip(("t", *_POSITION, *_QUATERNION), seen, strict=False))
    for name, (t, q, tau) in zip(joints, series, strict=True):
        columns[name] = np.interp(seen[0], t, q)
        columns[f"{name}.tau"] = np.interp(seen[0], t, tau)
    return columns


def _parquet(path: Path) -> dict[str, Any]:
    """Return columns of numbers and texts, and those of the states that meta/info.json names."""
    table = package_of("lerobot", "pyarrow.parquet").read_table(path)
    flat = [n for n in table.column_names if n == _STATE or not table.field(n).type.num_fields]
    each = {name: np.array(table[name].to_pylist()) for name in flat}
    columns = {
        name: values for name, values in each.items()
        if name in ("place", "socket") or (values.ndim == 1 and values.dtype.kind in "biuf")
    }  # fmt: skip
    if _STATE in each:
        infos = (folder / "meta" / "info.json" for folder in path.resolve().parents)
        info = next((file for file in infos if file.is_file()), None)
        if info is None:
            raise ValueError(f"there is no meta/info.json with the names of {_STATE}")
        names = json.loads(info.read_text("utf-8"))["features"][_STATE]["names"]
        names = names if isinstance(names, list) else next(iter(names.values()))
        names = [name.removesuffix(".pos") for name in names]
        columns |= dict(zip(names, each[_STATE].T, strict=True))
    if "timestamp" in columns:
        columns["t"] = columns["timestamp"]
    return columns


def _run(path: Path) -> dict[str, Any]:
    """Return a row for each new x that `Trajectory.save` kept of a position or pose."""
    with path.open("rb") as file:
        kept = read_arrays(file)
    texts, x = json.loads(str(kept["texts"])), kept["x_measured"]
    if tuple(texts["task_labels"][:3]) != _POSITION:
        raise ValueError(f"its task is {', '.join(texts['task_labels'])}")
    new = np.isfinite(x).all(axis=1) & np.append(True, np.diff(x, axis=0).any(axis=1))
    torques = (f"{name}.tau" for name in texts["joint_names"])
    names = "t", *torques, *_POSITION, *_QUATERNION
    columns = [kept["t"][new], *kept["tau"][new].T, *x[new].T]
    return {"": kept["q"][new], **dict(zip(names, columns, strict=False))}


_READERS = {".mcap": _mcap, ".parquet": _parquet, ".npz": _run}
