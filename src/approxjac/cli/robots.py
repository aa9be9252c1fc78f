"""`approxjac robots`: the arms that load by name, and one robot joint by joint."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import tyro

from approxjac.errors import InvalidInputError
from approxjac.robots import Robot, load_robot, robot_names
from approxjac.robots.load import locked_joints

_WIDTH = 100


def robots(
    robot: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="NAME|FILE")] = None,
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
    """All arms that load by name: joints, n_v, n_q, effort limits, tip and moving mass."""
    rows = [("name", "nv", "nq", "joints", "effort limits", "suggested tip", "kg")]
    for name in robot_names():
        robot = load_robot(name)
        rows.append(
            (
                name,
                str(robot.nv),
                str(robot.nq),
                _kinds(robot),
                _efforts(robot),
                str(robot.tip),
                f"{robot.mass:.3g}",
            )
        )
    return f"{_aligned(rows)}\n\nEffort limits are in N m, those of prismatic joints in N."


def _details(source: str, tip: str | None, base: str | None, free: Sequence[str]) -> str:
    """One robot: its joints with their kinds and limits, and what was locked."""
    robot = load_robot(source, tip=tip, base=base, free=free)
    lower, upper = robot.position_limits
    rows = [("joint", "kind", "limits", "effort")]
    for i, (name, kind) in enumerate(_kind_of_each(robot).items()):
        unit = robot.joint_units[i]
        limits = "none known"
        if math.isfinite(lower[i]):
            limits = f"{lower[i]:.4g} to {upper[i]:.4g} {unit}"
        elif kind == "continuous":
            limits = "none"
        effort = f"{robot.effort_limits[i]:g} {'N' if unit == 'm' else 'N m'}"
        rows.append((name, kind, limits, effort if "inf" not in effort else "none known"))
    leads = robot.tip or "not clear, as it has more than one end: name one as tip"
    lines = [
        f"{source}: {_kinds(robot)}; nv {robot.nv}, nq {robot.nq}; {robot.mass:.4g} kg",
        f"tip: {leads}",
        "",
        _aligned(rows),
    ]
    together = [
        name for name in robot.mimic_joints.model.names[1:] if name not in robot.joint_names
    ]
    for title, joints in (
        ("locked", locked_joints(source, robot)),
        ("moving with another joint", together),
    ):
        if joints:
            lines += ["", *textwrap.wrap(f"{title}: {', '.join(joints)}", _WIDTH)]
    return "\n".join(lines)


def _kind_of_each(robot: Robot) -> dict[str, str]:
    """Joint name → revolute, continuous or prismatic, in the order of v."""
    kinds = {}
    for name, unit in zip(robot.joint_names, robot.joint_units, strict=True):
        turns = robot.model.joints[robot.model.getJointId(name)].nq == 2
        kinds[name] = "prismatic" if unit == "m" else "continuous" if turns else "revolute"
    return kinds


def _kinds(robot: Robot) -> str:
    """Such as "1 prismatic, 7 revolute"."""
    kinds = list(_kind_of_each(robot).values())
    return ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))


def _efforts(robot: Robot) -> str:
    """Range of the effort limits, apart for torques and forces."""
    units = np.array(robot.joint_units)
    ranges = []
    for unit in dict.fromkeys(robot.joint_units):
        limits = robot.effort_limits[units == unit]
        known = limits[np.isfinite(limits)]
        if not known.size:
            ranges.append("none known")
            continue
        low, high = f"{known.min():g}", f"{known.max():g}"
        ranges.append(low if known.min() == known.max() else f"{low}-{high}")
        if known.size < limits.size:
            ranges[-1] += " or none"
    return ", ".join(ranges)


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of words in columns, the first row underlined."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    rows = [rows[0], ["-" * width for width in widths], *rows[1:]]
    return "\n".join(
        "  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )
