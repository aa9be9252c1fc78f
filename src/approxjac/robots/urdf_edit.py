"""Edits of a URDF: an object attached, joint origins moved, joints fixed.

Each returns a new tree, which keeps everything else of the old one.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from lxml.builder import E

from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.robots.urdf import Urdf, UrdfJoint
from approxjac.validation import Array, as_array, as_number

OBJECT_RADIUS = 0.01
"""Radius of an object that nothing is said about [m]."""
_LONGEST = 10.0  # object [m]; what is longer was meant in mm or cm
_HEAVIEST = 1e4  # object [kg], likewise


def direction(axis: str | Sequence[float]) -> Array:
    """Return a unit vector from "x", "-z", … or a vector."""
    if isinstance(axis, str):
        letter = axis.removeprefix("-").removeprefix("+")
        if letter not in ("x", "y", "z"):
            raise UnknownNameError("axis", axis, "the axes", ["x", "y", "z", "-x", "-y", "-z"])
        sign = -1.0 if axis.startswith("-") else 1.0
        return np.array([sign * (name == letter) for name in "xyz"])
    vector = as_array("axis", axis, (3,))
    if not vector.any():
        raise InvalidInputError(f"axis must not be zero, got {vector.tolist()}", given=axis)
    vector = vector / np.abs(vector).max()  # or the norm might overflow
    return np.asarray(vector / np.linalg.norm(vector))


def object_size(length: float, mass: float, radius: float) -> tuple[float, float, float]:
    """Return length [m], mass [kg] and radius [m] of an object as numbers."""
    return as_size("length", length), as_mass("mass", mass), as_size("radius", radius)


def as_size(name: str, value: Any) -> float:
    """Return the length or radius of an object as a number [m]."""
    return _at_most(_LONGEST, name, value, "m", "200 mm are 0.2")


def as_mass(name: str, value: Any) -> float:
    """Return the mass of an object as a number [kg]."""
    return _at_most(_HEAVIEST, name, value, "kg", "500 g are 0.5")


def _at_most(most: float, name: str, value: Any, unit: str, such: str) -> float:
    number = as_number(name, value, unit=unit, minimum=0.0)
    if number > most:
        raise InvalidInputError(
            f"{name} must be at most {most:g} [{unit}], got {number:g}; {such}", given=value
        )
    return number


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


def object_moments(length: float, mass: float, radius: float) -> tuple[float, float]:
    """Return moments of inertia of a uniform cylinder, across its axis and along it [kg m²].

    Of a thin rod (radius 0) along it that of the cylinder it is drawn as: MuJoCo refuses 0.
    """
    across = mass * (3.0 * radius**2 + length**2) / 12.0
    return across, 0.5 * mass * _drawn_radius(length, radius) ** 2


def with_object(
    urdf: Urdf, *, name: str, parent: str, axis: Array, length: float, radius: float, mass: float
) -> Urdf:
    """Return a URDF with a uniform cylinder from the origin of `parent` along `axis`, and its tip.

    Both new links keep the orientation of `parent`. A massless object has no <inertial>, one
    without length no geometry, as other tools refuse cylinders of length 0.
    """
    middle = pin.SE3(rotation_onto(axis), 0.5 * length * axis)
    link = E.link(name=name)
    if mass > 0.0:
        across, along = map(str, object_moments(length, mass, radius))
        inertia = E.inertia(ixx=across, ixy="0.0", ixz="0.0", iyy=across, iyz="0.0", izz=along)
        link.append(E.inertial(_origin(middle), E.mass(value=str(mass)), inertia))
    if length > 0.0:
        size = {"radius": str(_drawn_radius(length, radius)), "length": str(length)}
        color = E.material(E.color(rgba="0.9 0.6 0.0 1.0"), name=f"{name}_color")
        for shape in (E.visual(), E.collision()):
            shape.extend([E.geometry(E.cylinder(**size)), _origin(middle)])
            link.append(shape)
        link.find("visual").append(color)
    new = urdf.copy()
    new.root.extend([link, E.link(name=f"{name}_tip")])
    for carrier, carried, place in (
        (parent, name, 0.0 * axis),
        (name, f"{name}_tip", length * axis),
    ):
        links = E.parent(link=carrier), E.child(link=carried)
        origin = _origin(pin.SE3(np.eye(3), place))
        new.root.append(E.joint(*links, origin, name=f"{carried}_joint", type="fixed"))
    return new


def with_moved_origins(urdf: Urdf, errors: Mapping[str, tuple[Array, Array]]) -> Urdf:
    """Return a URDF with joints moved: their shifts (3,) [m] and rotation vectors (3,) [rad]."""
    new = urdf.copy()
    for element in new.root.iterfind("joint"):
        name = element.get("name")
        if name in errors:
            shift, turn = errors[name]
            old = urdf.joints[name].origin
            _set_origin(element, pin.SE3(old.rotation @ pin.exp3(turn), old.translation + shift))
    return new


def with_locked_joints(urdf: Urdf, positions: Mapping[str, float]) -> Urdf:
    """Return a URDF with joints fixed at positions [rad or m], and those that mimic them."""
    locked = dict(positions)
    moving = {joint.name for joint in urdf.joints.values() if joint.type != "fixed"}
    following = {joint: follows for joint, follows in urdf.followers.items() if joint in moving}
    for _ in following:  # a follower may be followed in turn
        for joint, (leader, multiplier, offset) in following.items():
            if leader in locked:
                locked.setdefault(joint, multiplier * locked[leader] + offset)
    new = urdf.copy()
    for element in new.root.iterfind("joint"):
        name = element.get("name")
        if name not in locked:
            continue
        if locked[name] != 0.0:
            old = urdf.joints[name]
            _set_origin(element, old.origin * _motion(old, locked[name]))
        element.set("type", "fixed")
        for tag in ("axis", "limit", "mimic", "safety_controller", "calibration", "dynamics"):
            for part in element.findall(tag):
                element.remove(part)
    return new


def _motion(joint: UrdfJoint, position: float) -> pin.SE3:
    """Return the placement of a joint's child at a position [rad or m] in that at zero."""
    along = position * (joint.axis / np.linalg.norm(joint.axis))
    slides = joint.type == "prismatic"
    return pin.SE3(np.eye(3), along) if slides else pin.SE3(pin.exp3(along), np.zeros(3))


def _drawn_radius(length: float, radius: float) -> float:
    """Return the radius that a cylinder is drawn with; of a thin rod (0), a share of its length."""
    return radius if radius > 0.0 else 0.01 * length


def _set_origin(joint: Any, placement: pin.SE3) -> None:
    for element in joint.findall("origin"):
        joint.remove(element)
    joint.append(_origin(placement))


def _origin(placement: pin.SE3) -> Any:
    """Return the <origin> of a placement."""
    # + 0 makes 0 of -0
    numbers = placement.translation + 0.0, pin.rpy.matrixToRpy(placement.rotation) + 0.0
    xyz, rpy = (" ".join(map(str, each)) for each in numbers)
    return E.origin(xyz=xyz, rpy=rpy)
