"""Robots that load by name: our own URDFs, and those of example-robot-data."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple


class NamedRobot(NamedTuple):
    """A robot that loads by name."""

    path: str  # of its URDF, in our `urdf/` folder or in example-robot-data's `robots/`
    tip: str  # suggested end-effector frame
    base: str | None = None  # link that the arm starts from if it is part of a larger robot


NAMED: Mapping[str, NamedRobot] = {
    "two_link": NamedRobot("two_link.urdf", "tool0"),
    "two_link_point_mass": NamedRobot("two_link_point_mass.urdf", "tool0"),
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


def share_dir() -> Path | None:
    """Return the folder that `package://example-robot-data/...` is relative to, if installed."""
    import importlib.metadata  # 15 ms, a tenth of what `import approxjac` costs

    try:
        distribution = importlib.metadata.distribution("example-robot-data")
    except importlib.metadata.PackageNotFoundError:
        return None
    share = Path(str(distribution.locate_file("cmeel.prefix/share")))
    return share if (share / "example-robot-data" / "robots").is_dir() else None


def urdf_path(entry: NamedRobot) -> Path:
    """Return the URDF file of a named robot; it need not exist."""
    share = share_dir()
    if "/" in entry.path and share is not None:
        return share / "example-robot-data" / "robots" / entry.path
    packaged = Path(__file__).parents[1] / "urdf"  # of the wheel; a source checkout has ours
    return (packaged if packaged.is_dir() else Path(__file__).parents[3] / "urdf") / entry.path
