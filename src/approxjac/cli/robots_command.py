"""`approxjac robots`: the arms that load by name, and one robot joint by joint."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from approxjac.errors import InvalidInputError, MissingPackageError
from approxjac.formatting import wrapped
from approxjac.robots import Robot, load_robot, robot_names
from approxjac.robots.load import locked_joints
from approxjac.robots.urdf import likely_tips


def robots(
    robot: str | None = None,
    tip: str | None = None,
    base: str | None = None,
    free: tuple[str, ...] = (),
) -> int:
    """List the arms that load by name, or describe one by name or from a .urdf file.

    Example: approxjac robots panda

    Args:
        robot: Name or path of the one to describe.
        tip: Its end-effector frame; joints that do not move it are locked.
        base: Link that the chain to the tip starts from.
        free: Joints that are not locked although the tip does not need them, or "all".
    """
    if robot is not None:
        print(_details(robot, tip, base, free))
    elif tip is None and base is None and not free:
        print(_table())
    else:
        raise InvalidInputError("--tip, --base and --free need a robot, got none", given=None)
    return 0


def _table() -> str:
    """Return all arms that load by name: joints, n_v, n_q, effort limits, tip and moving mass."""
    rows = [("name", "nv", "nq", "joints", "effort limits", "suggested tip", "kg")]
    missing = []
    for name in robot_names():
        try:
            robot = load_robot(name)
        except MissingPackageError:
            missing.append(name)
            continue
        size = str(robot.nv), str(robot.nq)
        kinds, mass = _kinds(robot), f"{robot.mass:.3g}"
        rows.append((robot.name, *size, kinds, _efforts(robot), str(robot.tip), mass))
    lines = [_aligned(rows), "", "Effort limits are in N m, those of prismatic joints in N."]
    if missing:
        names = ", ".join(missing)
        lines += ["", *wrapped(f"pip install 'approxjac[robots]' brings {names}")]
    return "\n".join(lines)


def _details(source: str, tip: str | None, base: str | None, free: Sequence[str]) -> str:
    """Return one robot: its joints with their kinds and limits, and those that are locked."""
    robot = load_robot(source, tip=tip, base=base, free=free)
    rows = [("joint", "kind", "limits", "effort")]
    (lower, upper), efforts = robot.position_limits, robot.effort_limits
    for i, (name, kind) in enumerate(zip(robot.joint_names, _each_kind(robot), strict=True)):
        unit, force = ("m", "N") if kind == "prismatic" else ("rad", "N m")
        known = f"{lower[i]:.4g} to {upper[i]:.4g} {unit}"
        known = known if math.isfinite(lower[i]) else "none known"
        most = f"{efforts[i]:g} {force}" if math.isfinite(efforts[i]) else "none known"
        rows.append((name, kind, "none" if kind == "continuous" else known, most))
    unclear = "not clear, as it has more than one end: name one as tip (--tip)"
    leads = robot.tip or f"{unclear}; {likely_tips(robot.tree)}"
    lines = [
        f"{source}: {_kinds(robot)}; nv {robot.nv}, nq {robot.nq}; {robot.mass:.4g} kg",
        *wrapped(f"tip: {leads}", indent=2),
        "",
        _aligned(rows),
    ]
    others = {
        "locked": locked_joints(source, robot),
        "moving with another joint": [
            name for name in robot.mimic_joints.model.names[1:] if name not in robot.joint_names
        ],
    }
    for title, joints in others.items():
        if joints:
            lines += ["", *wrapped(f"{title}: {', '.join(joints)}")]
    return "\n".join(lines)


def _each_kind(robot: Robot) -> list[str]:
    """Return the kind of each joint: revolute, continuous or prismatic."""
    return [robot.tree.joints[name].type for name in robot.joint_names]


def _kinds(robot: Robot) -> str:
    """Return the joints by kind, such as "1 prismatic, 7 revolute"."""
    kinds = Counter(_each_kind(robot))
    return ", ".join(f"{count} {kind}" for kind, count in kinds.items())


def _efforts(robot: Robot) -> str:
    """Return the range of the effort limits, apart for torques and forces."""
    units = np.array(robot.joint_units)
    ranges = []
    for unit in dict.fromkeys(robot.joint_units):
        limits = robot.effort_limits[units == unit]
        known = [f"{limit:g}" for limit in np.unique(limits[np.isfinite(limits)])]
        text = "-".join(dict.fromkeys([*known[:1], *known[-1:]])) or "none known"
        ranges.append(text + (" or none" if known and not np.isfinite(limits).all() else ""))
    return ", ".join(ranges)


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    """Return rows of words in columns, the first row underlined."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    rows = [rows[0], ["-" * width for width in widths], *rows[1:]]
    return "\n".join(
        "  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )
