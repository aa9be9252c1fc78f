"""Reading and checking URDF text.

yourdfpy reads and validates the elements; the XML tree itself is kept as it was given, so that
nothing that yourdfpy would drop is lost (mimic joints, transmissions, Gazebo and MuJoCo tags,
comments).
"""

from __future__ import annotations

import copy
import io
import math
import re
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from approxjac.errors import UrdfError

if TYPE_CHECKING:
    import yourdfpy


def parse(text: str, source: str) -> Any:
    """Return the XML root of a URDF.

    Args:
        text: The URDF.
        source: What to call it in errors: a path or "URDF text".

    Raises:
        UrdfError: Not well-formed XML, the root is not <robot>, or xacro is not expanded.
    """
    from lxml import etree

    # The text is decoded already; an encoding it declares would be applied a second time.
    text = re.sub(r"^\s*<\?xml[^>]*\?>", "", text)
    try:
        root = etree.fromstring(text.encode(), etree.XMLParser(remove_blank_text=True))
    except etree.XMLSyntaxError as error:
        raise UrdfError(f"{source} is not well-formed XML: {error}", given=text) from error
    if root.tag != "robot":
        raise UrdfError(
            f"{source} must have <robot> as its root element, got <{root.tag}>", given=text
        )
    for element in root.iter(etree.Element):
        if "xacro" in element.tag:
            raise UrdfError(
                f"{source} holds <{etree.QName(element).localname}> of xacro: expand it first "
                "with the command xacro",
                given=text,
            )
    return root


def read(root: Any, source: str) -> yourdfpy.URDF:
    """Return the links and joints of a URDF, checked, without touching any mesh.

    Raises:
        UrdfError: An element or attribute that URDF requires is missing or wrong.
    """
    import yourdfpy

    for fault in _attribute_faults(root):
        raise UrdfError(f"{source} is not a valid URDF: {fault}", given=source)
    try:
        urdf = yourdfpy.URDF.load(
            io.BytesIO(bare_text(root).encode()), build_scene_graph=False, load_meshes=False
        )
        urdf.validate()
    except (ValueError, KeyError, AttributeError, IndexError, TypeError) as error:
        raise UrdfError(
            f"{source} is not a valid URDF: {type(error).__name__}: {error}", given=source
        ) from error
    for fault in _faults(urdf):
        raise UrdfError(f"{source} is not a valid URDF: {fault}", given=source)
    return urdf


def bare_text(root: Any) -> str:
    """Return the URDF as computing needs it: without geometry, comments and instructions.

    Not every parser takes every geometry, nor instructions.
    """
    from lxml import etree

    bare = copy.deepcopy(root)
    etree.strip_tags(bare, etree.Comment, etree.ProcessingInstruction)
    etree.strip_elements(bare, "visual", "collision")
    return str(etree.tostring(bare, encoding="unicode"))


def to_text(root: Any) -> str:
    """Return the URDF as indented text with an XML declaration."""
    from lxml import etree

    tree = root.getroottree()  # with the comments that stand before the root
    return str(
        etree.tostring(tree, pretty_print=True, xml_declaration=True, encoding="utf-8").decode()
    )


def _attribute_faults(root: Any) -> list[str]:
    """Attributes that URDF requires and that are missing or no numbers, with their owner."""
    faults = [] if root.get("name") else ["<robot> has no name"]
    for owner in root.iterfind("link"):
        if not owner.get("name"):
            faults.append("a <link> has no name")
    for owner in root.iterfind("joint"):
        if not owner.get("name"):
            faults.append("a <joint> has no name")
        for tag in ("parent", "child"):
            if owner.find(tag) is None or not owner.find(tag).get("link"):
                faults.append(f"joint {owner.get('name')!r} has no <{tag} link=...>")
        if owner.find("mimic") is not None and not owner.find("mimic").get("joint"):
            faults.append(f"joint {owner.get('name')!r} has a <mimic> without joint=...")
    for owner in root.iterfind("link"):
        inertial = owner.find("inertial")
        if inertial is not None and None in (inertial.find("mass"), inertial.find("inertia")):
            faults.append(f"<inertial> of link {owner.get('name')!r} needs <mass> and <inertia>")
    for owner in [*root.iterfind("link"), *root.iterfind("joint")]:
        for path, attribute, count in _NUMBERS:
            for element in owner.iterfind(path):
                given = element.get(attribute)
                if given is None and attribute in _OPTIONAL and element.tag != "axis":
                    continue
                if len(_floats(given)) != count:
                    wanted = "a finite number" if count == 1 else f"{count} finite numbers"
                    faults.append(
                        f"<{element.tag} {attribute}=...> of {owner.tag} {owner.get('name')!r} "
                        f"must be {wanted}, got {given!r}"
                    )
    return faults


_NUMBERS = (
    ("origin", "xyz", 3),
    ("origin", "rpy", 3),
    ("axis", "xyz", 3),
    ("inertial/origin", "xyz", 3),
    ("inertial/origin", "rpy", 3),
    ("inertial/mass", "value", 1),
    *(("inertial/inertia", name, 1) for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")),
    *(("limit", name, 1) for name in ("lower", "upper", "effort", "velocity")),
    ("mimic", "multiplier", 1),
    ("mimic", "offset", 1),
)
# looked at elsewhere, or with a default
_OPTIONAL = ("xyz", "rpy", "lower", "upper", "effort", "velocity", "multiplier", "offset")


_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def _floats(text: str | None) -> list[float]:
    """Return the numbers in a text, none if it holds anything else.

    Stricter than Python: of what urdfdom cannot read, it drops the whole element without an error.
    """
    words = (text or "").split()
    if len(words) == 1:
        words = [text or ""]  # blanks around a single number are among what it cannot read
    if not all(_NUMBER.fullmatch(word) for word in words):
        return []
    numbers = [float(word) for word in words]
    return numbers if all(math.isfinite(number) for number in numbers) else []


def _faults(urdf: yourdfpy.URDF) -> list[str]:
    """What is wrong with a URDF, in words; Pinocchio's parser would only say that it is."""
    links, joints = urdf.robot.links, urdf.robot.joints
    faults = [
        f"two {kind}s are called {name!r}"
        for kind, items in (("link", links), ("joint", joints))
        for name, count in Counter(item.name for item in items).items()
        if count > 1
    ]
    names = {link.name for link in links}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in names:
                faults.append(f"joint {joint.name!r} refers to link {link!r}, which does not exist")
        moves = joint.type in ("revolute", "continuous", "prismatic")
        if moves and joint.axis is not None and not np.linalg.norm(joint.axis) > 0.0:
            faults.append(f"the axis of joint {joint.name!r} is zero")
        limit = joint.limit
        if joint.type in ("revolute", "prismatic") and limit is None:
            faults.append(
                f"joint {joint.name!r} is {joint.type} and has no <limit>; with effort, velocity, "
                "lower and upper all 0, no limit is known"
            )
        turns_freely = joint.type == "continuous"
        if moves and limit and not turns_freely and (limit.lower or 0.0) > (limit.upper or 0.0):
            faults.append(f"the limits of joint {joint.name!r} are reversed")
        if moves and limit is not None and (limit.effort is None or limit.velocity is None):
            faults.append(
                f"the <limit> of joint {joint.name!r} needs effort and velocity; 0 means that none "
                "is known"
            )
    faults += _tree_faults(joints, names)
    # yourdfpy counts some limits as missing that URDF allows to be; those were looked at above.
    return faults + [str(error) for error in urdf.errors if "<limit>" not in str(error)]


def _tree_faults(joints: list[yourdfpy.Joint], names: set[str]) -> list[str]:
    """Links with two parents, more than one root, or loops."""
    parents = Counter(joint.child for joint in joints)
    faults = [
        f"link {link!r} is the child of {count} joints"
        for link, count in parents.items()
        if count > 1
    ]
    roots = sorted(names - set(parents))
    if len(roots) != 1:
        faults.append(f"there must be one link without a parent, got {', '.join(roots) or 'none'}")
        return faults
    reached = {roots[0]}
    for _ in joints:
        reached |= {joint.child for joint in joints if joint.parent in reached}
    if reached != names:
        loose = ", ".join(sorted(names - reached))
        faults.append(f"these links are not connected to {roots[0]!r}: {loose}")
    return faults
