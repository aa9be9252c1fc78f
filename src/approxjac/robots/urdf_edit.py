"""Editing URDF: an object attached, joint origins moved, joints fixed.

yourdfpy writes the new elements; they go into the original XML tree, which keeps everything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from approxjac.checks import Array, as_array
from approxjac.errors import InvalidInputError, UnknownNameError

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
    (other tools refuse cylinders of length 0). A thin rod (radius 0) has m l²/12 across it;
    along it, where MuJoCo refuses 0, it has the inertia of the cylinder it is drawn as.
    """
    from yourdfpy import Color, Cylinder, Geometry, Inertial, Joint, Link, Material, Visual

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
        link.visuals = [
            Visual(
                origin=middle,
                geometry=Geometry(cylinder=Cylinder(radius=drawn_radius, length=length)),
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


def fix_joint(root: Any, urdf: yourdfpy.URDF, name: str, motion: Array) -> None:
    """Make a joint fixed at `motion`, its 4 × 4 displacement from the zero position."""
    _set_origin(root, name, _origin(urdf, name) @ motion)
    joint = _joint_element(root, name)
    joint.set("type", "fixed")
    for tag in ("axis", "limit", "mimic", "safety_controller", "calibration", "dynamics"):
        for element in joint.findall(tag):
            joint.remove(element)


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
