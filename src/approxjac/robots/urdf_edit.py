"""Editing URDF: an object attached, joint origins moved, joints fixed.

yourdfpy writes the new elements; they go into the original XML tree, which keeps everything else.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.validation import Array, as_array

if TYPE_CHECKING:
    import yourdfpy

THIN_ROD = 0.01
"""Radius that a thin rod (radius 0) is drawn with, relative to its length."""


def transform(translation: Array, rotation: Array | None = None) -> Array:
    """Return the 4 × 4 homogeneous matrix of a translation [m] and a rotation matrix."""
    matrix = np.eye(4)
    matrix[:3, 3] = translation
    if rotation is not None:
        matrix[:3, :3] = rotation
    return matrix


def direction(axis: str | Sequence[float]) -> Array:
    """Return a unit vector from "x", "-z", … or a vector.

    Raises:
        UnknownNameError: A text that names no axis.
        InvalidInputError: A vector of the wrong shape, zero or not finite.
    """
    if isinstance(axis, str):
        letter = axis.removeprefix("-").removeprefix("+")
        if letter not in ("x", "y", "z"):
            raise UnknownNameError("axis", axis, "the axes", ["x", "y", "z", "-x", "-y", "-z"])
        sign = -1.0 if axis.startswith("-") else 1.0
        return np.array([sign * (name == letter) for name in "xyz"])
    vector = as_array("axis", axis, (3,))
    largest = float(np.abs(vector).max())
    if largest == 0.0:
        raise InvalidInputError(f"axis must not be zero, got {vector.tolist()}", given=axis)
    vector = vector / largest
    return np.asarray(vector / np.linalg.norm(vector))


def require_new(name: str, taken: Collection[str], robot: str) -> None:
    """Refuse a name of an object that is none, or that a robot's frames have."""
    if not isinstance(name, str) or not name.isprintable() or not name or " " in name:
        raise InvalidInputError(
            f"name must be a text without spaces, such as 'object', got {name!r}", given=name
        )
    for new in (name, f"{name}_tip", f"{name}_joint", f"{name}_tip_joint"):
        if new in taken:
            raise InvalidInputError(
                f"name must be new to the robot, got {name!r}: {robot} already has a frame "
                f"{new!r}, perhaps as it holds an object already; give another name",
                given=name,
            )


def rotation_onto(axis: Array) -> Array:
    """Return the smallest rotation matrix that takes z onto the unit vector `axis`."""
    x, y, z = axis
    if z < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + z))


def append_object(
    root: Any, *, name: str, parent: str, axis: Array, length: float, radius: float, mass: float
) -> None:
    """Append a uniform cylinder from the origin of `parent` along `axis`, and a tip frame.

    Both new links keep the orientation of `parent`, so that a length of 0 puts the tip frame
    exactly onto it. A massless object has no <inertial>, one without length no geometry
    (other tools refuse cylinders of length 0), neither to see nor to touch. A thin rod (radius 0)
    has m l²/12 across it; along it, where MuJoCo refuses 0, it has the inertia of the cylinder it
    is drawn as.
    """
    from yourdfpy import (
        Collision,
        Color,
        Cylinder,
        Geometry,
        Inertial,
        Joint,
        Link,
        Material,
        Visual,
    )

    middle = transform(0.5 * length * axis, rotation_onto(axis))
    link = Link(name=name)
    drawn_radius = radius if radius > 0.0 else THIN_ROD * length
    if mass > 0.0:
        across = mass * (3.0 * radius**2 + length**2) / 12.0
        link.inertial = Inertial(
            origin=middle,
            mass=mass,
            inertia=np.diag([across, across, 0.5 * mass * drawn_radius**2]),
        )
    if length > 0.0:
        geometry = Geometry(cylinder=Cylinder(radius=drawn_radius, length=length))
        link.collisions = [Collision(name=None, origin=middle, geometry=geometry)]
        link.visuals = [
            Visual(
                origin=middle,
                geometry=geometry,
                material=Material(
                    name=f"{name}_color", color=Color(rgba=np.array([0.9, 0.6, 0.0, 1.0]))
                ),
            )
        ]
    tip = Link(name=f"{name}_tip")
    joints = [
        Joint(name=f"{name}_joint", type="fixed", parent=parent, child=name, origin=np.eye(4)),
        Joint(
            name=f"{name}_tip_joint",
            type="fixed",
            parent=name,
            child=tip.name,
            origin=transform(length * axis),
        ),
    ]
    root.extend(_elements([link, tip], joints))


def move_joint_origin(
    root: Any, urdf: yourdfpy.URDF, name: str, translation: Array, rotation: Array
) -> None:
    """Shift the origin of a joint in its parent link's frame, and turn it about itself.

    Args:
        root: XML root to change.
        urdf: The same, as `read` returned it.
        name: Joint.
        translation: Shift in the parent link's frame, shape (3,) [m].
        rotation: Rotation matrix applied in the joint's own frame, shape (3, 3).
    """
    old = _origin(urdf, name)
    _set_origin(root, name, transform(translation) @ old @ transform(np.zeros(3), rotation))


def lock_joints(root: Any, urdf: yourdfpy.URDF, positions: Mapping[str, float]) -> None:
    """Make joints fixed at their positions [rad or m], and with them the joints that mimic them.

    Args:
        root: XML root to change.
        urdf: The same, as `read` returned it.
        positions: Moving joint → position. A mimic joint that is named is fixed where this says.
    """
    locked = dict(positions)
    moving = {joint.name for joint in urdf.robot.joints if joint.type != "fixed"}
    following = {joint: f for joint, f in followers(root).items() if joint in moving}
    for _ in following:  # a follower may be followed in turn
        for joint, (leader, multiplier, offset) in following.items():
            if leader in locked:
                locked.setdefault(joint, multiplier * locked[leader] + offset)
    for name, position in locked.items():
        _fix_joint(root, urdf, name, position)


def followers(root: Any) -> dict[str, tuple[str, float, float]]:
    """Return mimic joint → (joint that it follows, multiplier, offset)."""
    found = {}
    for joint in root.iterfind("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            multiplier = float(mimic.get("multiplier", 1.0))
            offset = float(mimic.get("offset", 0.0))
            found[joint.get("name")] = (mimic.get("joint"), multiplier, offset)
    return found


def leader_of(
    joint: str, following: Mapping[str, tuple[str, float, float]]
) -> tuple[str, float, float]:
    """Return the joint at the end of a chain of followers, and the multiplier and offset to it.

    Args:
        joint: Where to start; itself, 1 and 0 are returned if it follows no other.
        following: As `followers` returns it. Of joints that follow each other, one is returned.
    """
    multiplier, offset = 1.0, 0.0
    for _ in following:
        if joint not in following:
            break
        joint, own_multiplier, own_offset = following[joint]
        multiplier, offset = multiplier * own_multiplier, multiplier * own_offset + offset
    return joint, multiplier, offset


def _fix_joint(root: Any, urdf: yourdfpy.URDF, name: str, position: float) -> None:
    """Make a joint fixed at a position [rad or m]."""
    if position != 0.0:
        axis = urdf.joint_map[name].axis / np.linalg.norm(urdf.joint_map[name].axis)
        if urdf.joint_map[name].type == "prismatic":
            motion = transform(position * axis)
        else:
            motion = transform(np.zeros(3), pin.exp3(position * axis))
        _set_origin(root, name, _origin(urdf, name) @ motion)
    joint = _joint_element(root, name)
    joint.set("type", "fixed")
    for tag in ("axis", "limit", "mimic", "safety_controller", "calibration", "dynamics"):
        for element in joint.findall(tag):
            joint.remove(element)


def _elements(links: Sequence[yourdfpy.Link], joints: Sequence[yourdfpy.Joint]) -> list[Any]:
    """Return links and joints as XML elements, written by yourdfpy."""
    import yourdfpy

    robot = yourdfpy.Robot(name="elements", links=list(links), joints=list(joints))
    writer = yourdfpy.URDF(robot=robot, build_scene_graph=False, load_meshes=False)
    return list(writer.write_xml().getroot())


def _joint_element(root: Any, name: str) -> Any:
    return next(joint for joint in root.iterfind("joint") if joint.get("name") == name)


def _origin(urdf: yourdfpy.URDF, name: str) -> Array:
    """Origin of a joint in its parent link, 4 × 4; URDF leaves out the identity."""
    origin: Array | None = urdf.joint_map[name].origin
    return np.eye(4) if origin is None else origin


def _set_origin(root: Any, name: str, origin: Array) -> None:
    from yourdfpy import Joint

    written = _elements([], [Joint(name=name, type="fixed", parent="", child="", origin=origin)])
    joint = _joint_element(root, name)
    for element in joint.findall("origin"):
        joint.remove(element)
    joint.append(written[0].find("origin"))
