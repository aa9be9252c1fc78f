"""The joints that are locked when an arm is loaded: those that its tip does not need."""

from __future__ import annotations

from collections.abc import Sequence

from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.robots.urdf import Urdf, leader_of
from approxjac.robots.urdf_edit import with_locked_joints


def lock_off_chain(
    urdf: Urdf, base: str | None, tip: str | None, free: str | Sequence[str]
) -> Urdf:
    """Return a URDF with the joints fixed that `load_robot` locks; itself if there are none.

    A mimic joint and the joint that it follows are one: both stay free if either is needed.
    """
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
    """Return the joints that `free` names."""
    try:
        names = [free] if isinstance(free, str) else list(free)
    except TypeError as error:
        raise InvalidInputError(
            f"free must be names of joints, or 'all', got {free!r}", given=free
        ) from error
    if len(names) == 1 and isinstance(names[0], str) and names[0] == "all":
        return moving
    for name in names:
        if not isinstance(name, str) or name not in moving:
            raise UnknownNameError("moving joint", name, urdf.name, moving)
    return names


def _chain(urdf: Urdf, base: str | None, tip: str) -> set[str]:
    """Return all joints between two links."""
    parent_joints = {joint.child: joint for joint in urdf.joints.values()}
    link, start = _link(urdf, tip), None if base is None else _link(urdf, base)
    joints = set()
    while link in parent_joints and link != start:
        joints.add(parent_joints[link].name)
        link = parent_joints[link].parent
    if start is not None and link != start:
        raise InvalidInputError(
            f"base must carry the tip {tip!r} of {urdf.name}, got {base!r}, which does not",
            given=base,
        )
    return joints


def _link(urdf: Urdf, frame: str) -> str:
    """Return the link that a frame is part of: itself, or what the joint of that name moves."""
    if isinstance(frame, str) and frame in urdf.links:
        return frame
    if isinstance(frame, str) and frame in urdf.joints:
        return urdf.joints[frame].child
    raise UnknownNameError("frame", frame, urdf.name, urdf.links)
