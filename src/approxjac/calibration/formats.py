"""Files of other programs as columns by their names: MCAP, LeRobot's parquet, and own runs."""

import json
from itertools import zip_longest
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from approxjac.errors import InvalidInputError, MissingPackageError, package_of
from approxjac.files import read_arrays, reason

POSITION, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
_TIPS = {"PointStamped": "point", "PoseStamped": "pose"}
_STATE = "observation.state"


def _mcap(path: Path) -> dict[str, Any]:
    """Return a row for each point or pose, or else each JointState; joints are interpolated."""
    make_reader = package_of("ros2", "mcap.reader").make_reader
    own = SimpleNamespace(decoder_for=lambda coded, _: _from_json if coded == "json" else None)
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
            row = [t, *(getattr(getattr(tip, "position", tip), axis) for axis in POSITION)]
            if kind == "PoseStamped":
                row += [getattr(tip.orientation, name[1]) for name in QUATERNION]
            tips.setdefault(channel.topic, []).append(row)
    if not joints or len(tips) > 1:
        topics = ", ".join(tips) or "none"
        raise ValueError(f"it has JointState of {len(joints)} joints, and points or poses {topics}")
    series = [np.array(rows).T for rows in joints.values()]
    seen = np.array(*tips.values()).T if tips else max(series, key=np.size)[:1]
    first, last = max(each[0, 0] for each in series), min(each[0, -1] for each in series)
    seen = seen[:, (seen[0] >= first) & (seen[0] <= last)]
    columns = dict(zip(("t", *POSITION, *QUATERNION), seen, strict=False))
    for name, (t, q, tau) in zip(joints, series, strict=True):
        columns[name] = np.interp(seen[0], t, q)
        columns[f"{name}.tau"] = np.interp(seen[0], t, tau)
    return columns


def _from_json(data: bytes) -> Any:
    return json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))


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
    if tuple(texts["task_labels"][:3]) != POSITION:
        raise ValueError(f"its task is {', '.join(texts['task_labels'])}")
    new = np.isfinite(x).all(axis=1) & np.append(True, np.diff(x, axis=0).any(axis=1))
    torques = (f"{name}.tau" for name in texts["joint_names"])
    names = "t", *torques, *POSITION, *QUATERNION
    columns = [kept["t"][new], *kept["tau"][new].T, *x[new].T]
    return {"": kept["q"][new], **dict(zip(names, columns, strict=False))}


_READERS = {".mcap": _mcap, ".parquet": _parquet, ".npz": _run}


def columns_of(path: Path) -> dict[str, Any] | None:
    """Return columns of a file by its ending, "" of all joints (N, nq); None of another kind.

    Raises:
        InvalidInputError: A file that cannot be read, or lacks what is needed.
        MissingPackageError: The extra "ros2" or "lerobot" is not installed.
    """
    if (read := _READERS.get(path.suffix.lower())) is None:
        return None
    try:
        return read(path)
    except MissingPackageError:
        raise
    except Exception as error:  # each library raises its own
        message = f"recording {path} cannot be read: {reason(error)}"
        raise InvalidInputError(message, given=str(path)) from error
