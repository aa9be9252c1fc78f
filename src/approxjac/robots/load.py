"""`load_robot`: an arm by name, from a file or from text."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

from approxjac.errors import InvalidInputError, MissingPackageError, UnknownNameError, UrdfError
from approxjac.robots.catalog import NAMED, NamedRobot, urdf_path
from approxjac.robots.locked_joints import lock_off_chain
from approxjac.robots.robot import STANDARD_GRAVITY, Robot
from approxjac.robots.urdf import Urdf
from approxjac.validation import Array


def load_robot(
    source: str | Path,
    *,
    gravity: Sequence[float] | Array = STANDARD_GRAVITY,
    tip: str | None = None,
    base: str | None = None,
    free: str | Sequence[str] = (),
) -> Robot:
    """Load an arm by name, from a path to a .urdf file, or from URDF text.

    Where the tip is known, the arm is the chain from `base` to it: the robot's other joints, such
    as those of fingers, wheels or the other arm, are locked, each at zero or at its limit nearest
    to zero. Mimic joints are locked with the joint that they follow. A robot that is loaded by name
    has that name.

    Args:
        source: A name ("panda", "two_link", …), a path, or text that starts with "<".
        gravity: Acceleration of gravity in the world frame, shape (3,) [m/s²].
        tip: End-effector frame; by default the named robot's own, or the last link of an arm
            that does not branch. Of a branched file without it, no joint is locked.
        base: Link that the chain starts from; by default the named robot's own, or the root. The
            robot stands in the world on its root all the same.
        free: Joints that are not locked although the tip does not need them: one name, several,
            or "all".

    Raises:
        UnknownNameError: Neither a known name nor a file; no such frame, or moving joint to free.
        UrdfError: The file is missing, or its URDF is not usable.
        InvalidInputError: Not a text or a path; a tip that nothing moves, or that `base` does not
            carry.
        MissingPackageError: A named robot, and example-robot-data was taken away.

    Example:
        >>> load_robot("two_link").joint_names
        ('joint1', 'joint2')
    """
    text, path, entry = _find(source)
    if entry is not None:
        tip, base = entry.tip if tip is None else tip, entry.base if base is None else base
    label, folder = ("URDF text", None) if path is None else (str(path), path.resolve().parent)
    urdf = lock_off_chain(Urdf.parse(text, label), base, tip, free)
    name = None if entry is None else str(source)
    return Robot(urdf, gravity=gravity, tip=tip, urdf_dir=folder, name=name)


def robot_names() -> tuple[str, ...]:
    """Return the names that `load_robot` knows."""
    return tuple(NAMED)


def locked_joints(source: str | Path, robot: Robot) -> tuple[str, ...]:
    """Return the joints that move in a source, and were locked when `robot` was loaded from it."""
    before, now = Urdf.parse(_find(source)[0], "URDF text").joints, robot.tree.joints
    return tuple(
        joint for joint in before if before[joint].type != "fixed" and now[joint].type == "fixed"
    )


def _find(source: str | Path) -> tuple[str, Path | None, NamedRobot | None]:
    """Return the URDF text that a source means, its file, and what is known of it by name."""
    if not isinstance(source, str | Path):
        raise InvalidInputError(
            f"source must be a name, a path or URDF text, got {source!r}", given=source
        )
    text = str(source).removeprefix("\ufeff")
    if isinstance(source, str) and text.lstrip().startswith("<"):
        return text, None, None
    entry = NAMED.get(text) if isinstance(source, str) else None
    path = Path(source) if entry is None else urdf_path(entry)
    if os.path.isfile(path):  # unlike Path.is_file, of any name
        return _read(path), path, entry
    if entry is not None:
        raise MissingPackageError(
            f"robot {text!r} needs example-robot-data, which is not installed: "
            "pip install example-robot-data",
            given="example-robot-data",
        )
    if path.suffix or "/" in text or isinstance(source, Path):
        raise UrdfError(f"URDF file {text} does not exist", given=source)
    raise UnknownNameError("robot", text, "the robots known by name", NAMED)


def _read(path: Path) -> str:
    """Return the text of a file, in the encoding that it declares."""
    try:
        data = path.read_bytes()
        declared = re.match(rb"<\?xml[^>]*encoding=[\"']([\w.-]+)", data)
        return data.decode(declared.group(1).decode() if declared else "utf-8-sig")
    except (OSError, UnicodeDecodeError, LookupError) as error:
        raise UrdfError(f"URDF file {path} cannot be read: {error}", given=path) from error
