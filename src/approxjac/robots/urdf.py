"""`Urdf`: a URDF as a tree, checked and edited; unknown tags and comments are kept."""

from __future__ import annotations

import copy
import functools
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Set
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from lxml import etree
from lxml.builder import E

from approxjac.errors import InvalidInputError, UnknownNameError, UrdfError
from approxjac.validation import Array, as_array, as_number

MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
MOST_TEXT = 16_000_000  # characters
_MOST_LINKS = 2000  # in a chain of 5000 Pinocchio's parser runs out of stack
_MOST_ATTRIBUTES = 100
_UNDECLARED = re.compile(r"Namespace prefix (\S+) .*is not defined")
_LONGEST_NUMBERS = 1000  # characters, of three numbers
OBJECT_RADIUS = 0.01  # radius of an object that nothing is said about [m]
_LONGEST = 10.0  # object [m]; what is longer was meant in mm or cm
_HEAVIEST = 1e4  # object [kg], likewise
Follows = tuple[str, float, float]
"""The joint that a mimic joint follows, the multiplier and the offset [rad or m]."""


class UrdfJoint(NamedTuple):
    """A <joint>."""

    element: Any
    name: str
    type: str
    parent: str
    child: str
    axis: Array  # in the child's frame, shape (3,), of any length
    limits: tuple[float, float]  # [rad or m]; 0 where none is given

    @property
    def origin(self) -> pin.SE3:
        """Placement of the child in the parent at zero."""
        origin = self.element.find("origin")
        given = {} if origin is None else origin.attrib
        xyz, rpy = (np.array(_floats(given.get(key, "0 0 0"))) for key in ("xyz", "rpy"))
        return pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)


class Urdf:
    """A URDF: its XML tree, its links and its joints. Read-only; an edit is made on a `copy`."""

    def __init__(self, root: Any, source: str, text: str | None = None) -> None:
        self.root, self.source = root, source  # what to call it in errors
        self._text = text  # that it was read from, if it was

    @classmethod
    @functools.lru_cache(maxsize=8)  # arms are often loaded again
    def parse(cls, text: str, source: str) -> Urdf:
        """Parse a URDF text; raise a UrdfError if it is no XML or no valid URDF."""
        if len(text) > MOST_TEXT:
            message = f"{source} must have at most {MOST_TEXT} characters, got {len(text)}"
            raise UrdfError(message, given=source)
        try:
            root = _tree(text)
        except (ValueError, etree.XMLSyntaxError) as error:  # a ValueError of lone surrogates
            raise UrdfError(f"{source} is not well-formed XML: {error}", given=text) from error
        if root.tag != "robot":
            message = f"{source} must have <robot> as its root element, got <{root.tag}>"
            raise UrdfError(message, given=text)
        for element in root.iter(etree.Element):
            if "xacro" in element.tag:
                raise UrdfError(
                    f"{source} holds <{etree.QName(element).localname}> of xacro: expand it first "
                    "with the command xacro",
                    given=text,
                )
            if len(element.attrib) > _MOST_ATTRIBUTES:  # for which parsers take quadratic time
                raise UrdfError(
                    f"{source}: an element <{element.tag}> must have at most {_MOST_ATTRIBUTES} "
                    f"attributes, got {len(element.attrib)}",
                    given=source,
                )
        for fault in _faults(root):
            raise UrdfError(f"{source} is not a valid URDF: {fault}", given=source)
        return cls(root, source, text)

    def __reduce__(self) -> tuple[Any, ...]:
        return Urdf.parse, (self.text, self.source)

    @property
    def name(self) -> str:
        """Name of the robot."""
        return str(self.root.get("name"))

    @functools.cached_property
    def links(self) -> tuple[str, ...]:
        """Names of the links."""
        return tuple(link.get("name") for link in self.root.iterfind("link"))

    @functools.cached_property
    def joints(self) -> Mapping[str, UrdfJoint]:
        """Joint name → joint, fixed ones included."""
        return {joint.get("name"): _joint(joint) for joint in self.root.iterfind("joint")}

    def link_of(self, frame: str) -> str:
        """Return the link that a frame is part of: itself, or what the joint of that name moves."""
        return frame if frame in self.links else self.joints[frame].child

    @functools.cached_property
    def moved_links(self) -> Set[str]:
        """Names of the links that a joint moves."""
        carriers = {joint.child: joint for joint in self.joints.values()}
        moved: dict[str, bool] = {}
        for link in self.links:
            way = []  # towards the root, to what is known or moves
            while link not in moved and link in carriers and carriers[link].type == "fixed":
                way.append(link)
                link = carriers[link].parent
            moved.update(dict.fromkeys([*way, link], moved.get(link, link in carriers)))
        return {link for link, moves in moved.items() if moves}

    @functools.cached_property
    def followers(self) -> Mapping[str, Follows]:
        """Mimic joint → what it follows."""
        mimics: dict[str, Follows] = {}
        for mimic in self.root.iterfind("joint/mimic"):
            numbers = float(mimic.get("multiplier", 1.0)), float(mimic.get("offset", 0.0))
            mimics.setdefault(mimic.getparent().get("name"), (mimic.get("joint"), *numbers))
        return mimics

    @functools.cached_property
    def text(self) -> str:
        """The text it was read from; after edits, indented text with an XML declaration."""
        if self._text is not None:
            return self._text
        tree = self.root.getroottree()  # with the comments that stand before the root
        text = etree.tostring(tree, pretty_print=True, xml_declaration=True, encoding="utf-8")
        return str(text.decode())

    def copy(self) -> Urdf:
        """Return a copy whose root may be changed before any property is read."""
        return Urdf(copy.deepcopy(self.root.getroottree()).getroot(), self.source)


def leader_of(joint: str, following: Mapping[str, Follows]) -> Follows:
    """Return the joint that a mimic joint follows in the end, with multiplier and offset."""
    multiplier, offset = 1.0, 0.0
    for _ in following:
        if joint not in following:
            break
        joint, own_multiplier, own_offset = following[joint]
        multiplier, offset = multiplier * own_multiplier, multiplier * own_offset + offset
    return joint, multiplier, offset


def _tree(text: str) -> Any:
    """Return the root of an XML text; undeclared namespaces, such as Drake's, are declared."""
    # The text is decoded already; an encoding it declares would be applied a second time.
    bare = re.sub(r"^\s*<\?xml[^>]*\?>", "", text)
    parser = etree.XMLParser(remove_blank_text=True)
    try:
        return etree.fromstring(bare.encode(), parser)
    except etree.XMLSyntaxError:
        undeclared = [_UNDECLARED.match(each.message) for each in parser.error_log]
        if not all(undeclared):
            raise
    root = etree.fromstring(bare.encode(), etree.XMLParser(recover=True))
    prefixes = sorted({match[1] for match in undeclared if match})[:_MOST_ATTRIBUTES]
    declared = "".join(f' xmlns:{prefix}="urn:{prefix}"' for prefix in prefixes)
    start, whole = f"<{root.tag}", etree.tostring(root, encoding="unicode")
    return etree.fromstring(whole.replace(start, start + declared, 1).encode(), parser)


def _joint(element: Any) -> UrdfJoint:
    axis, limit = element.find("axis"), element.find("limit")
    lower, upper = (0.0 if limit is None else float(limit.get(k, 0.0)) for k in ("lower", "upper"))
    return UrdfJoint(
        element,
        element.get("name"),
        element.get("type"),
        element.find("parent").get("link"),
        element.find("child").get("link"),
        np.array(_floats("1 0 0" if axis is None else axis.get("xyz"))),
        (lower, upper),
    )


# -- what is checked --------------------------------------------------------------------

_ELEMENTS = {"joint": ("parent", "child"), "inertial": ("mass", "inertia")}  # what holds what
_LIMITED = "a finite number, 0 if none is known"
_ATTRIBUTES = (  # of what element, which attributes, what they must be, must they be there
    ("parent", ("link",), "a name", True),
    ("child", ("link",), "a name", True),
    ("origin", ("xyz", "rpy"), "3 finite numbers", False),
    ("axis", ("xyz",), "3 finite numbers", True),
    ("inertial/origin", ("xyz", "rpy"), "3 finite numbers", False),
    ("inertial/mass", ("value",), "a finite number", True),
    ("inertial/inertia", MOMENTS, "a finite number", True),
    ("limit", ("lower", "upper"), "a finite number", False),
    ("limit", ("effort", "velocity"), _LIMITED, True),
    ("mimic", ("joint",), "a name", True),
    ("mimic", ("multiplier", "offset"), "a finite number", False),
)
# "++" goes back to no digit, and so takes no quadratic time
_NUMBER = re.compile(r"[+-]?(\d++\.?\d*+|\.\d++)([eE][+-]?\d++)?", re.ASCII)


def _floats(text: str | None) -> list[float]:
    """Return the numbers in a text; none where urdfdom would drop the element without an error."""
    if len(text or "") > _LONGEST_NUMBERS:
        return []
    words = (text or "").split()
    if len(words) == 1:
        words = [text or ""]  # blanks around a single number are among what it cannot read
    numbers = [float(word) if _NUMBER.fullmatch(word) else math.nan for word in words]
    return numbers if all(map(math.isfinite, numbers)) else []


def _faults(root: Any) -> Iterator[str]:
    """Describe the faults of a URDF; Pinocchio's parser only says that there are some."""
    if not root.get("name"):
        yield "<robot> has no name"
    for tag in ("link", "joint"):
        owners = root.findall(tag)
        if len(owners) > _MOST_LINKS:
            yield f"it has {len(owners)} {tag}s; there may be at most {_MOST_LINKS}"
        for owner in owners:
            yield from _attribute_faults(owner)  # without which the rest cannot be looked at
    joints = [_joint(element) for element in root.iterfind("joint")]
    links = [link.get("name") for link in root.iterfind("link")]
    for what, names in (
        ("links are called", links),
        ("joints are called", [joint.name for joint in joints]),
        ("joints have the child", [joint.child for joint in joints]),
    ):
        for name, count in Counter(names).items():
            if count > 1:
                yield f"two {what} {name!r}"
    known = set(links)
    for joint in joints:
        yield from _joint_faults(joint, known)
    roots = sorted(known - {joint.child for joint in joints})
    if len(roots) != 1:
        yield f"there must be one link without a parent, got {', '.join(roots) or 'none'}"
    carried: dict[str, list[str]] = {}
    for joint in joints:
        carried.setdefault(joint.parent, []).append(joint.child)
    level = roots
    while level:  # every link has one parent at most, so it is visited once
        known.difference_update(level)
        level = [child for link in level for child in carried.get(link, [])]
    if known:
        yield f"these links are not connected to {roots[0]!r}: {', '.join(sorted(known))}"


def _attribute_faults(owner: Any) -> Iterator[str]:
    name = owner.get("name")
    if not name:
        yield f"a <{owner.tag}> has no name"
    for element in (owner, *owner.iterfind("inertial")):
        for tag in _ELEMENTS.get(element.tag, ()):
            if element.find(tag) is None:
                yield f"<{element.tag}> of {owner.tag} {name!r} has no <{tag}>"
    for path, attributes, wanted, required in _ATTRIBUTES:
        count = 3 if wanted == "3 finite numbers" else 1
        for element in owner.iterfind(path):
            for attribute in attributes:
                given = element.get(attribute)
                is_right = given if wanted == "a name" else len(_floats(given)) == count
                if (given is not None or required) and not is_right:
                    yield (
                        f"<{element.tag} {attribute}=...> of {owner.tag} {name!r} "
                        f"must be {wanted}, got {repr(given)[:60]}"
                    )


def _joint_faults(joint: UrdfJoint, links: set[str]) -> Iterator[str]:
    name, kind = joint.name, joint.type
    for link in (joint.parent, joint.child):
        if link not in links:
            yield f"joint {name!r} refers to link {link!r}, which does not exist"
    if kind not in _TYPES:
        yield f"type of joint {name!r} must be one of {', '.join(_TYPES)}, got {kind!r}"
    if kind in ("revolute", "continuous", "prismatic") and not np.linalg.norm(joint.axis) > 0.0:
        yield f"the axis of joint {name!r} is zero"
    if kind in ("revolute", "prismatic"):
        if joint.limits[0] > joint.limits[1]:
            yield f"the limits of joint {name!r} are reversed"
        if joint.element.find("limit") is None:
            yield (
                f"joint {name!r} is {kind} and has no <limit>; with effort, velocity, lower and "
                "upper all 0, no limit is known"
            )


_USUAL = ("tool0", "tcp", "_ee_link", "end_effector", "eef", "tool", "flange", "gripper", "hand")
_MANY = 12  # links that are named


def likely_tips(urdf: Urdf) -> str:
    """Return a clause that suggests tips: links with a tip's usual name, then the end links."""
    carriers = {joint.parent for joint in urdf.joints.values()}
    ranks = {}
    for link in filter(urdf.moved_links.__contains__, urdf.links):
        words = [k for k, word in enumerate(_USUAL) if word in f"_{link.lower()}"]
        if words and "finger" not in link.lower():
            # of two with the same word the shorter name is that of the whole thing
            ranks[link] = words[0], len(link)
        elif link not in carriers:
            ranks[link] = len(_USUAL), 0
    likely = sorted(ranks, key=ranks.__getitem__)
    more = f" and {len(likely) - _MANY} more" if len(likely) > _MANY else ""
    return f"likely tips are {', '.join(likely[:_MANY])}{more}"


# -- edits, each a new tree that keeps everything else of the old one ---------------------


def direction(axis: str | Sequence[float]) -> Array:
    """Return a unit vector from "x", "-z", … or a vector."""
    if isinstance(axis, str):
        letter = axis.removeprefix("-").removeprefix("+")
        if letter not in ("x", "y", "z"):
            raise UnknownNameError("axis", axis, "the axes", ["x", "y", "z", "-x", "-y", "-z"])
        sign = -1.0 if axis.startswith("-") else 1.0
        return np.asarray(sign * np.eye(3)["xyz".index(letter)])
    vector = as_array("axis", axis, (3,))
    if not vector.any():
        raise InvalidInputError(f"axis must not be zero, got {vector.tolist()}", given=axis)
    vector = vector / np.abs(vector).max()  # or the norm might overflow
    return np.asarray(vector / np.linalg.norm(vector))


def as_size(name: str, value: Any, unit: str = "m") -> float:
    """Return a length or radius [m], or a mass [kg], as a valid number."""
    number = as_number(name, value, unit=unit, minimum=0.0)
    most, small = (_LONGEST, "mm") if unit == "m" else (_HEAVIEST, "g")
    if number > most:
        such = f"{number:g} {small} are {1e-3 * number:g}"
        message = f"{name} must be at most {most:g} [{unit}], got {number:g}; {such}"
        raise InvalidInputError(message, given=value)
    return number


def rotation_onto(axis: Array) -> Array:
    """Return the matrix (3, 3) of the smallest rotation from z onto the unit vector `axis`."""
    return np.array(pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis).matrix())


def with_object(
    urdf: Urdf, *, name: str, parent: str, axis: Array, length: float, radius: float, mass: float
) -> Urdf:
    """Return a URDF with a uniform cylinder from the origin of `parent` along `axis`, and its tip.

    With length 0 it has no geometry, because other tools refuse such cylinders.
    """
    middle, drawn = pin.SE3(rotation_onto(axis), 0.5 * length * axis), radius or 0.01 * length
    link = E.link(name=name)
    if mass > 0.0:
        # of a thin rod (radius 0) along it that of the cylinder it is drawn as: MuJoCo refuses 0
        across = str(mass * (3.0 * radius**2 + length**2) / 12.0)
        along = str(0.5 * mass * drawn**2)
        inertia = E.inertia(ixx=across, ixy="0.0", ixz="0.0", iyy=across, iyz="0.0", izz=along)
        link.append(E.inertial(_origin(middle), E.mass(value=str(mass)), inertia))
    if length > 0.0:
        size = {"radius": str(drawn), "length": str(length)}
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
    """Return a URDF with joint origins moved by shifts (3,) [m] and rotation vectors (3,) [rad]."""
    new = urdf.copy()
    for element in new.root.iterfind("joint"):
        name = element.get("name")
        if name in errors:
            shift, turn = errors[name]
            old = urdf.joints[name].origin
            _set_origin(element, pin.SE3(old.rotation @ pin.exp3(turn), old.translation + shift))
    return new


def with_locked_joints(urdf: Urdf, positions: Mapping[str, float]) -> Urdf:
    """Return a URDF with joints, and those that mimic them, fixed at positions [rad or m]."""
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
            old, motion = urdf.joints[name], pin.SE3.Identity()
            along = locked[name] * (old.axis / np.linalg.norm(old.axis))
            if old.type == "prismatic":
                motion.translation = along
            else:
                motion.rotation = pin.exp3(along)
            _set_origin(element, old.origin * motion)
        element.set("type", "fixed")
        for tag in ("axis", "limit", "mimic", "safety_controller", "calibration", "dynamics"):
            for part in element.findall(tag):
                element.remove(part)
    return new


def _set_origin(joint: Any, placement: pin.SE3) -> None:
    for element in joint.findall("origin"):
        joint.remove(element)
    joint.append(_origin(placement))


def _origin(placement: pin.SE3) -> Any:
    # + 0 makes 0 of -0
    numbers = placement.translation + 0.0, pin.rpy.matrixToRpy(placement.rotation) + 0.0
    xyz, rpy = (" ".join(map(str, each)) for each in numbers)
    return E.origin(xyz=xyz, rpy=rpy)
