"""Numbers of a URDF that cannot be those of the arm: placeholders, and other units."""

from __future__ import annotations

from collections import Counter

import numpy as np

from approxjac.robots.joint_limits import reach_bound
from approxjac.robots.robot import Robot

# The arms known by name weigh 3 to 41 kg for a cube of their reach, and the strongest motor of each
# delivers 0.2 to 14 times the torque of its weight at its reach.
_HEAVY = 2000.0  # [kg/m³]
_STRONG = 30.0
_ALIKE = 4  # links with the same mass and inertia
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_G = 9.81


def implausible(robot: Robot) -> list[str]:
    """Return what in a robot's masses and effort limits cannot be, a sentence each."""
    return [*_alike(robot), *_heavy_and_strong(robot)]


def _alike(robot: Robot) -> list[str]:
    """Say which links have the same inertia: exporters write one for all where none is known."""
    # of links on joints that move: there are parts that an arm has several of
    moved = {joint.child for joint in robot.tree.joints.values() if joint.type != "fixed"}
    masses = {}
    for link in robot.tree.root.iterfind("link"):
        inertial = link.find("inertial")
        if link.get("name") in moved and inertial is not None:
            moments = tuple(float(inertial.find("inertia").get(name)) for name in _MOMENTS)
            masses[link.get("name")] = float(inertial.find("mass").get("value")), moments
    if not masses:
        return []
    shared, count = Counter(masses.values()).most_common(1)[0]
    if count < _ALIKE or 2 * count <= len(masses):
        return []
    first = next(name for name, found in masses.items() if found == shared)
    return [
        f"{count} of {len(masses)} links, {first} first, have the same mass of {shared[0]:g} kg "
        "and the same inertia"
    ]


def _heavy_and_strong(robot: Robot) -> list[str]:
    """Say which links are too heavy for the arm's size, and which motors too strong for it."""
    if robot.tip is None:
        return []
    reach = reach_bound(robot, robot.tip)[1]
    if not 0.0 < reach < np.inf:
        return []
    found = []
    for link in robot.tree.root.iterfind("link/inertial/mass"):
        name, mass = link.getparent().getparent().get("name"), float(link.get("value"))
        if name in robot.tree.moved_links and mass > _HEAVY * reach**3:
            found.append(f"link {name} has {mass:g} kg, of an arm that reaches {reach:.3g} m")
    if found:
        return found
    for name, effort, unit in zip(
        robot.joint_names, robot.effort_limits, robot.joint_units, strict=True
    ):
        weight = robot.mass * _G * (reach if unit == "rad" else 1.0)
        if np.isfinite(effort) and effort > _STRONG * weight > 0.0:
            force = "N m" if unit == "rad" else "N"
            found.append(
                f"joint {name} has an effort limit of {effort:g} {force}, where at most "
                f"{weight:.2g} {force} hold the arm's {robot.mass:.3g} kg"
            )
    return found
