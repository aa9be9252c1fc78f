"""`approxjac robots`: the arms that load by name, and one robot joint by joint."""

import math
from collections import Counter
from collections.abc import Sequence

from approxjac.errors import InvalidInputError, MissingPackageError
from approxjac.formatting import aligned, wrapped
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
    lines = [("name", "nv", "nq", "joints", "suggested tip", "kg")]
    missing = []
    for name in robot_names():
        try:
            robot = load_robot(name)
        except MissingPackageError:
            missing.append(name)
            continue
        size, mass = (str(robot.nv), str(robot.nq)), f"{robot.mass:.3g}"
        lines.append((robot.name, *size, _kinds(robot), str(robot.tip), mass))
    text = [aligned(lines)]
    if missing:
        names = ", ".join(missing)
        text += ["", *wrapped(f"pip install 'approxjac[robots]' brings {names}")]
    return "\n".join(text)


def _details(source: str, tip: str | None, base: str | None, free: Sequence[str]) -> str:
    robot = load_robot(source, tip=tip, base=base, free=free)
    joints = [("joint", "kind", "limits", "effort")]
    (lower, upper), efforts = robot.position_limits, robot.effort_limits
    units = zip(robot.joint_names, robot.joint_units, robot.force_units, strict=True)
    for i, (name, unit, force) in enumerate(units):
        kind = robot.tree.joints[name].type
        known = f"{lower[i]:.4g} to {upper[i]:.4g} {unit}"
        known = known if math.isfinite(lower[i]) else "none known"
        most = f"{efforts[i]:g} {force}" if math.isfinite(efforts[i]) else "none known"
        joints.append((name, kind, "none" if kind == "continuous" else known, most))
    unclear = "not clear, as it has more than one end: name one as tip (--tip)"
    leads = robot.tip or f"{unclear}; {likely_tips(robot.tree)}"
    lines = [
        f"{source}: {_kinds(robot)}; nv {robot.nv}, nq {robot.nq}; {robot.mass:.4g} kg",
        *wrapped(f"tip: {leads}", indent=2),
        "",
        aligned(joints),
    ]
    mimics = [n for n in robot.mimic_joints.model.names[1:] if n not in robot.joint_names]
    others = {"locked": locked_joints(source, robot), "moving with another joint": mimics}
    for title, names in others.items():
        if names:
            lines += ["", *wrapped(f"{title}: {', '.join(names)}")]
    return "\n".join(lines)


def _kinds(robot: Robot) -> str:
    kinds = Counter(robot.tree.joints[name].type for name in robot.joint_names)
    return ", ".join(f"{count} {kind}" for kind, count in kinds.items())
