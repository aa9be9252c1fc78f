"""Reading and editing URDF text.

yourdfpy reads, validates and writes the elements; the original XML tree keeps everything else
as it was (mimic joints, transmissions, Gazebo and MuJoCo tags, comments), which yourdfpy on its
own would drop when it writes a file.
"""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from approxjac.checks import Array
from approxjac.errors import UrdfError

if TYPE_CHECKING:
    import yourdfpy

THIN_ROD = 0.01
"""Radius that a thin rod (radius 0) is drawn with, relative to its length."""


def parse(text: str, source: str) -> Any:
    """Return the XML root of a URDF.

    Args:
        text: The URDF.
        source: What to call it in errors: a path or "URDF text".

    Raises:
        UrdfError: Not well-formed XML, or the root is not <robot>.
    """
    from lxml import etree

    try:
        root = etree.fromstring(text.encode(), etree.XMLParser(remove_blank_text=True))
    except etree.XMLSyntaxError as error:
        raise UrdfError(f"{source} is not well-formed XML: {error}", given=text) from error
    if root.tag != "robot":
        raise UrdfError(
            f"{source} must have <robot> as its root element, got <{root.tag}>", given=text
        )
    return root


def read(root: Any, source: str) -> yourdfpy.URDF:
    """Return the links and joints of a URDF, validated, without touching any mesh.

    Raises:
        UrdfError: An element or attribute that URDF requires is missing or wrong.
    """
    import yourdfpy
    from lxml import etree

    try:
        urdf = yourdfpy.URDF.load(
            io.BytesIO(etree.tostring(root)), build_scene_graph=False, load_meshes=False
        )
        urdf.validate()
    except (ValueError, KeyError, AttributeError, IndexError, TypeError) as error:
        raise UrdfError(
            f"{source} is not a valid URDF: {type(error).__name__}: {error}", given=source
        ) from error
    names = [link.name for link in urdf.robot.links]
    for joint in urdf.robot.joints:
        for link in (joint.parent, joint.child):
            if link not in names:
                raise UrdfError(
                    f"{source} is not a valid URDF: joint {joint.name!r} refers to link "
                    f"{link!r}, which does not exist",
                    given=source,
                )
    # Missing limits are legal for us (no limit known); missing names, types and links are not.
    fatal = [str(error) for error in urdf.errors if "<limit>" not in str(error)]
    if fatal:
        raise UrdfError(f"{source} is not a valid URDF: {fatal[0]}", given=source)
    return urdf


def to_text(root: Any) -> str:
    """Return the URDF as indented text with an XML declaration."""
    from lxml import etree

    return str(
        etree.tostring(root, pretty_print=True, xml_declaration=True, encoding="utf-8").decode()
    )


def transform(translation: Array, rotation: Array | None = None) -> Array:
    """Return the 4 × 4 homogeneous matrix of a translation [m] and a rotation matrix."""
    matrix = np.eye(4)
    matrix[:3, 3] = translation
    if rotation is not None:
        matrix[:3, :3] = rotation
    return matrix


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
    old = urdf.joint_map[name].origin
    old = np.eye(4) if old is None else old
    _set_origin(root, name, transform(translation) @ old @ transform(np.zeros(3), rotation))


def fix_joint(root: Any, urdf: yourdfpy.URDF, name: str, motion: Array) -> None:
    """Make a joint fixed at `motion`, its 4 × 4 displacement from the zero position."""
    old = urdf.joint_map[name].origin
    old = np.eye(4) if old is None else old
    _set_origin(root, name, old @ motion)
    joint = _joint_element(root, name)
    joint.set("type", "fixed")
    for tag in ("axis", "limit", "mimic", "safety_controller", "calibration", "dynamics"):
        for element in joint.findall(tag):
            joint.remove(element)


def for_other_tools(root: Any, urdf_dir: Path | None) -> None:
    """Make a URDF open alike in Pinocchio, MuJoCo, MeshCat and yourdfpy.

    Mesh files that are found are named by their full path. MuJoCo is asked to keep links on
    fixed joints as bodies (it merges them otherwise, and the tip frame is lost), unless the
    URDF already speaks to MuJoCo.
    """
    from lxml import etree

    for mesh in root.iter("mesh"):
        found = find_mesh(mesh.get("filename", ""), urdf_dir)
        if found is not None:
            mesh.set("filename", str(found))
    if root.find("mujoco") is None:
        mujoco = etree.Element("mujoco")
        etree.SubElement(mujoco, "compiler", fusestatic="false", strippath="false")
        root.insert(0, mujoco)


def find_mesh(filename: str, urdf_dir: Path | None) -> Path | None:
    """Return the file that a URDF means by a mesh name, or None where there is none.

    `package://` is looked up in the folders above the URDF, in ROS_PACKAGE_PATH and in the
    share folder of example-robot-data; other names are relative to the URDF.
    """
    from approxjac.robots.named import share_dir

    if filename.startswith("package://"):
        relative = filename.removeprefix("package://")
        roots = [urdf_dir, *urdf_dir.parents] if urdf_dir is not None else []
        roots += [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p]
        share = share_dir()
        if share is not None:
            roots.append(share)
    else:
        relative = filename.removeprefix("file://")
        roots = [urdf_dir] if urdf_dir is not None else [Path("/")]
    for root in roots:
        candidate = root / relative
        if candidate.is_file():
            return candidate.resolve()
    return None


def _elements(links: Sequence[yourdfpy.Link], joints: Sequence[yourdfpy.Joint]) -> list[Any]:
    """Return links and joints as XML elements, written by yourdfpy."""
    import yourdfpy

    robot = yourdfpy.Robot(name="elements", links=list(links), joints=list(joints))
    writer = yourdfpy.URDF(robot=robot, build_scene_graph=False, load_meshes=False)
    return list(writer.write_xml().getroot())


def _joint_element(root: Any, name: str) -> Any:
    return next(joint for joint in root.iterfind("joint") if joint.get("name") == name)


def _set_origin(root: Any, name: str, origin: Array) -> None:
    from yourdfpy import Joint

    written = _elements([], [Joint(name=name, type="fixed", parent="", child="", origin=origin)])
    joint = _joint_element(root, name)
    for element in joint.findall("origin"):
        joint.remove(element)
    joint.append(written[0].find("origin"))
