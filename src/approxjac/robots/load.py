"""`load_robot`: an arm by name, from a file or from text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from approxjac.checks import Array
from approxjac.errors import InvalidInputError, UnknownNameError, UrdfError
from approxjac.robots.named import NAMED, urdf_path
from approxjac.robots.robot import STANDARD_GRAVITY, Robot


def load_robot(
    source: str | Path,
    *,
    gravity: Sequence[float] | Array = STANDARD_GRAVITY,
    tip: str | None = None,
) -> Robot:
    """Load an arm by name, from a path to a .urdf file, or from URDF text.

    Args:
        source: A name ("panda", "two_link", …), a path, or text that starts with "<".
        gravity: Acceleration of gravity in the world frame, shape (3,) [m/s²].
        tip: End-effector frame; by default the named robot's own, or the last link of an arm
            that does not branch.

    Raises:
        UnknownNameError: Neither a known name nor a file.
        UrdfError: The file is missing, or its URDF is not usable.
        InvalidInputError: Not a text or a path.

    Example:
        >>> load_robot("two_link").joint_names
        ('joint1', 'joint2')
    """
    if not isinstance(source, str | Path):
        raise InvalidInputError(
            f"source must be a name, a path or URDF text, got {source!r}", given=source
        )
    text = str(source).removeprefix("\ufeff")
    if isinstance(source, str) and text.lstrip().startswith("<"):
        return Robot(text, gravity=gravity, tip=tip)
    if isinstance(source, str) and text in NAMED:
        entry = NAMED[text]
        path = urdf_path(entry)
        if not path.is_file():
            raise UrdfError(
                f"robot {text!r} needs the package example-robot-data "
                "(pip install example-robot-data)",
                given=source,
            )
        robot = _load_file(path, gravity, entry.tip if tip is None else tip)
        return robot.with_locked_joints(entry.locked) if entry.locked else robot
    path = Path(source)
    if len(text) < 4096 and "\0" not in text and path.is_file():
        return _load_file(path, gravity, tip)
    if path.suffix or "/" in text or isinstance(source, Path):
        raise UrdfError(f"URDF file {text} does not exist", given=source)
    raise UnknownNameError("robot", text, "the robots known by name", NAMED)


def robot_names() -> tuple[str, ...]:
    """Return the names that `load_robot` knows."""
    return tuple(NAMED)


def _load_file(path: Path, gravity: Sequence[float] | Array, tip: str | None) -> Robot:
    try:
        data = path.read_bytes()
        declared = re.match(rb"<\?xml[^>]*encoding=[\"']([\w.-]+)", data)
        text = data.decode(declared.group(1).decode() if declared else "utf-8-sig")
    except (OSError, UnicodeDecodeError, LookupError) as error:
        raise UrdfError(f"URDF file {path} cannot be read: {error}", given=path) from error
    return Robot(text, gravity=gravity, tip=tip, urdf_dir=path.resolve().parent, source=str(path))
