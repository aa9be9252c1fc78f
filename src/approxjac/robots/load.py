"""`load_robot`: an arm by name, from a file or from text."""

import os
import re
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from approxjac.errors import (
    ImplausibleRobotWarning,
    InvalidInputError,
    MissingPackageError,
    UnknownNameError,
    UrdfError,
    require_known,
)
from approxjac.robots.meshes import share_dir
from approxjac.robots.robot import STANDARD_GRAVITY, Robot
from approxjac.robots.urdf import MOST_TEXT, Urdf, leader_of, likely_tips, with_locked_joints
from approxjac.validation import Array, require


class NamedRobot(NamedTuple):
    """URDF file, tip and base of a robot that `load_robot` knows by name."""

    path: str  # of its URDF, in our `urdf/` folder or in example-robot-data's `robots/`
    tip: str  # suggested end-effector frame
    base: str | None = None  # link that the arm starts from if it is part of a larger robot


NAMED: Mapping[str, NamedRobot] = {
    "two_link": NamedRobot("two_link.urdf", "tool0"),
    "panda": NamedRobot("panda_description/urdf/panda.urdf", "panda_hand_tcp"),
    "ur3": NamedRobot("ur_description/urdf/ur3_robot.urdf", "tool0"),
    "ur5": NamedRobot("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "ur10": NamedRobot("ur_description/urdf/ur10_robot.urdf", "tool0"),
    "kinova": NamedRobot("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "xarm7": NamedRobot("xarm_description/urdf/xarm7.urdf", "link_eef"),
    "z1": NamedRobot("z1_description/urdf/z1.urdf", "gripperStator"),
    "so100": NamedRobot("so_arm_description/urdf/so100.urdf", "gripper"),
    "so101": NamedRobot("so_arm_description/urdf/so101.urdf", "gripper_frame_link"),
    "talos_arm": NamedRobot(
        "talos_data/robots/talos_reduced.urdf", "wrist_left_ft_tool_link", "torso_2_link"
    ),
    "tiago_arm": NamedRobot("tiago_description/robots/tiago_no_hand.urdf", "wrist_ft_tool_link"),
    "baxter_left_arm": NamedRobot("baxter_description/urdf/baxter.urdf", "left_gripper"),
    "pr2_left_arm": NamedRobot(
        "pr2_description/urdf/pr2.urdf", "l_gripper_tool_frame", "torso_lift_link"
    ),
    "double_pendulum": NamedRobot(
        "double_pendulum_description/urdf/double_pendulum_simple.urdf", "link3"
    ),
}


def load_robot(
    source: str | Path,
    *,
    gravity: Sequence[float] | Array = STANDARD_GRAVITY,
    tip: str | None = None,
    base: str | None = None,
    free: str | Sequence[str] = (),
) -> Robot:
    """Load an arm by name, from a path to a .urdf file, or from URDF text.

    If the tip is known, the arm is the chain from `base` to it: other joints, such as those of
    fingers or wheels, are locked at zero or at the limit nearest to zero.

    Args:
        source: A name ("panda", "two_link", …), a path, or text that starts with "<".
        gravity: Acceleration of gravity in the world frame, shape (3,) [m/s²].
        tip: End-effector frame; by default the named robot's own, or the last link of an arm
            that does not branch.
        base: Link that the chain starts from; by default the named robot's own, or the root.
        free: Joints off the chain that are not locked: one name, several, or "all".

    Raises:
        UnknownNameError: Neither a known name nor a file; no such frame, or moving joint to free.
        UrdfError: The file is missing, or its URDF is not usable.
        InvalidInputError: A tip that no joint moves, or that is not on a chain from `base`.
        MissingPackageError: A named robot without its package; install the extra `robots`.

    Warns:
        ImplausibleRobotWarning: Masses or effort limits of a file look like placeholders.
    """
    text, path, entry = _find(source)
    if entry is not None:
        tip, base = entry.tip if tip is None else tip, entry.base if base is None else base
    label, folder = ("URDF text", None) if path is None else (str(path), path.resolve().parent)
    urdf = _lock_off_chain(Urdf.parse(text, label), base, tip, free)
    name = None if entry is None else str(source)
    robot = Robot(urdf, gravity=gravity, tip=tip, urdf_dir=folder, name=name)
    if entry is None and (doubts := implausible(robot)):
        warnings.warn(
            f"{label}: {'; '.join(doubts)}. These look like placeholders, which make gravity "
            "and torque limits wrong; put in the manufacturer's numbers",
            ImplausibleRobotWarning,
            stacklevel=2,
        )
    return robot


def robot_names() -> tuple[str, ...]:
    """Return the names that `load_robot` knows."""
    return tuple(NAMED)


def locked_joints(source: str | Path, robot: Robot) -> tuple[str, ...]:
    """Return the moving joints of a source that were locked when `robot` was loaded from it."""
    before, now = Urdf.parse(_find(source)[0], "URDF text").joints, robot.tree.joints
    return tuple(
        joint for joint in before if before[joint].type != "fixed" and now[joint].type == "fixed"
    )


def _find(source: str | Path) -> tuple[str, Path | None, NamedRobot | None]:
    if not isinstance(source, str | Path):
        message = f"source must be a name, a path or URDF text, got {source!r}"
        raise InvalidInputError(message, given=source)
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
            "pip install 'approxjac[robots]'",
            given="example-robot-data",
        )
    if path.suffix or "/" in text or isinstance(source, Path):
        raise UrdfError(f"URDF file {text} does not exist", given=source)
    raise UnknownNameError("robot", text, "the robots known by name", NAMED)


def urdf_path(entry: NamedRobot) -> Path:
    """Return the URDF file of a named robot; it need not exist."""
    share = share_dir()
    if "/" in entry.path and share is not None:
        return share / "example-robot-data" / "robots" / entry.path
    packaged = Path(__file__).parents[1] / "urdf"  # of the wheel; a source checkout has ours
    return (packaged if packaged.is_dir() else Path(__file__).parents[3] / "urdf") / entry.path


def _read(path: Path) -> str:
    try:
        if (size := path.stat().st_size) > MOST_TEXT:
            message = f"URDF file {path} must have at most {MOST_TEXT} bytes, got {size}"
            raise UrdfError(message, given=path)
        data = path.read_bytes()
        declared = re.match(rb"<\?xml[^>]*encoding=[\"']([\w.-]+)", data)
        return data.decode(declared.group(1).decode() if declared else "utf-8-sig")
    except (OSError, UnicodeDecodeError, LookupError) as error:
        raise UrdfError(f"URDF file {path} cannot be read: {error}", given=path) from error


# -- joints that the tip does not need --------------------------------------------------


def _lock_off_chain(
    urdf: Urdf, base: str | None, tip: str | None, free: str | Sequence[str]
) -> Urdf:
    """Return a URDF with the joints fixed that `load_robot` locks; itself if there are none."""
    moving = [joint.name for joint in urdf.joints.values() if joint.type != "fixed"]
    free = _names(free, moving, urdf)
    if tip is None:
        if base is not None:
            raise InvalidInputError(
                f"base is where the chain to the tip starts, so tip must be given too, "
                f"got base {base!r} alone",
                given=base,
            )
        return urdf
    chain = _chain(urdf, base, tip)
    # a mimic joint and the joint that it follows are one: both stay free if either is needed
    direct = {j: follows for j, follows in urdf.followers.items() if follows[0] in moving}
    leaders = {joint: leader_of(joint, direct)[0] for joint in moving}
    needed = {leaders[joint] for joint in moving if joint in chain or joint in free}
    locked = [joint for joint in moving if leaders[joint] not in needed]
    if not locked:
        return urdf
    if not needed:
        raise InvalidInputError(
            f"tip must be a frame that a joint moves, got {tip!r}: there is no moving joint "
            f"between {'the root' if base is None else repr(base)} and it in {urdf.name}",
            given=tip,
        )
    rest = {}
    for joint in (urdf.joints[name] for name in locked if leaders[name] == name):
        lower, upper = joint.limits
        limited = joint.type in ("revolute", "prismatic") and lower < upper
        rest[joint.name] = min(max(0.0, lower), upper) if limited else 0.0
    return with_locked_joints(urdf, rest)


def _names(free: str | Sequence[str], moving: list[str], urdf: Urdf) -> list[str]:
    require("free", free, Sequence, "names of joints, or 'all'")
    names = [free] if isinstance(free, str) else list(free)
    if names == ["all"]:
        return moving
    for name in names:
        require_known("moving joint", name, urdf.name, moving)
    return names


def _chain(urdf: Urdf, base: str | None, tip: str) -> set[str]:
    parent_joints = {joint.child: joint for joint in urdf.joints.values()}
    link, start = _link(urdf, tip), None if base is None else _link(urdf, base)
    joints = set()
    while link in parent_joints and link != start:
        joints.add(parent_joints[link].name)
        link = parent_joints[link].parent
    if start is not None and link != start:
        message = f"base must carry the tip {tip!r} of {urdf.name}, got {base!r}, which does not"
        raise InvalidInputError(message, given=base)
    return joints


def _link(urdf: Urdf, frame: str) -> str:
    """Return the link that a frame is part of: itself, or what the joint of that name moves."""
    if not isinstance(frame, str) or frame not in {*urdf.links, *urdf.joints}:
        raise UnknownNameError("frame", frame, urdf.name, urdf.links, likely_tips(urdf))
    return urdf.link_of(frame)


# The arms known by name weigh 3 to 41 kg for a cube of their reach, and the strongest motor of each
# delivers 0.2 to 14 times the torque of its weight at its reach.
_HEAVY = 2000.0  # [kg/m³]
_STRONG = 30.0
_ALIKE = 4  # parts with the same mass and inertia: exporters write one where none is known


def implausible(robot: Robot) -> list[str]:
    """Return a clause for each mass or effort limit that is not plausible."""
    names, inertias = list(robot.model.names)[1:], list(robot.model.inertias)[1:]
    masses = [(each.mass, *each.inertia.ravel().tolist()) for each in inertias]
    findings, ((shared, count),) = [], Counter(masses).most_common(1)
    if count >= _ALIKE and 2 * count > len(masses):
        findings.append(
            f"what moves with {count} of {len(masses)} joints, {names[masses.index(shared)]} "
            f"first, has the same mass of {shared[0]:g} kg and the same inertia"
        )
    reach = np.inf if robot.tip is None else robot.reach_bound(robot.tip)[1]
    if not 0.0 < reach < np.inf:
        return findings
    for name, (mass, *_) in zip(names, masses, strict=True):
        if mass > _HEAVY * reach**3:
            findings.append(
                f"what moves with joint {name} has {mass:g} kg, of an arm of {reach:.3g} m reach"
            )
    efforts = zip(robot.joint_names, robot.effort_limits, robot.force_units, strict=True)
    for name, effort, force in efforts:
        weight = robot.mass * -STANDARD_GRAVITY[2] * (reach if force == "N m" else 1.0)
        if np.isfinite(effort) and effort > _STRONG * weight:
            findings.append(
                f"joint {name} has an effort limit of {effort:g} {force}, where at most "
                f"{weight:.2g} {force} hold the arm's {robot.mass:.3g} kg"
            )
    return findings
