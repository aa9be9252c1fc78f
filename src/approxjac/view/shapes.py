"""`robot_look`: what each link of a robot looks like."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from approxjac.robots import Robot
from approxjac.robots import urdf as urdf_xml
from approxjac.robots.meshes import find_mesh
from approxjac.validation import Array, as_number, require
from approxjac.view import triangles as mesh
from approxjac.view.triangles import Shape

if TYPE_CHECKING:
    import yourdfpy

_THICK = 0.05  # radius of a capsule, of the way from the first moving joint to the last
_NEAR = 0.1  # of the radius: joints nearer to their link's origin get no capsule


@dataclass(frozen=True, eq=False)
class Look:
    """What a robot looks like.

    Attributes:
        shapes: Link → its shapes. Links that nothing is to be seen of are left out.
        missing: What the URDF wants shown and cannot be, each as a text that starts with its
            name and says why: meshes that are not found or cannot be read, unknown geometry.
        found: Links that look as the URDF says, at least in part.
    """

    shapes: Mapping[str, tuple[Shape, ...]]
    missing: tuple[str, ...]
    found: frozenset[str]


def robot_look(
    robot: Robot, *, triangles: int = 25_000, like: tuple[Robot, Look] | None = None
) -> Look:
    """Return what each link of a robot looks like, and what of it is missing.

    A link looks like the <visual>s of the URDF that are found. Meshes are simplified until the
    whole robot keeps to `triangles`, shared by size, and are ready for smooth shading: sharp edges
    have vertices of their own on either side.

    A link of which nothing is found is drawn as capsules from its origin to the origins of the
    joints that it carries and that are away from it (by a tenth of the radius), but for those to
    mere frames; without such joints it is a ball. One that has no <visual> is drawn so as well, in
    a robot where others have towards moving joints and the tip only, and never as a ball. The
    radius is 5 % of the length of the arm, along its links from the first moving joint to the last
    (of an arm with one moving joint: to its farthest link).

    Args:
        robot: The robot.
        triangles: Of the whole robot. Exceeded where what is never simplified has more (boxes,
            cylinders, spheres, capsules, meshes of up to 200 triangles) and where fewer would
            tear a mesh of many small parts apart: of the arms of `robot_names()`, only talos_arm
            has more than it should, 32 000.
        like: Another robot and its look, such as the arm as it is: of links that are the same in
            both, the very same shapes are taken, which takes no time.

    Raises:
        InvalidInputError: `triangles` is not a number > 0. Never because of a mesh.
        MissingPackageError: fast-simplification is not installed.
    """
    require("robot", robot, Robot, "a Robot")
    budget = as_number("triangles", triangles, above=0.0)
    root = urdf_xml.parse(robot.urdf, robot.name)
    files = _Files(robot.urdf_dir)
    taken = {} if like is None else _taken(root, *like)
    seen: dict[str, list[_Visual]] = {}
    missing: dict[str, None] = {}  # in order, each once
    for link in root.iterfind("link"):
        for element in [] if link.get("name") in taken else link.iterfind("visual"):
            try:
                visual = _visual(element, files)
                seen.setdefault(link.get("name"), []).append(visual)
            except ValueError as error:
                missing[f"{_called(element, link)}: {error}"] = None
    shapes = taken | _in_place(robot, root, seen.keys() | taken.keys())
    budget -= sum(len(shape.faces) for drawn in shapes.values() for shape in drawn)
    files.lighten([visual for visuals in seen.values() for visual in visuals], budget)
    for name, visuals in seen.items():
        shapes[name] = tuple(visual.shape(files) for visual in visuals)
    return Look(shapes, tuple(missing), frozenset(seen.keys() | taken.keys()))


def _taken(root: Any, other: Robot, look: Look) -> dict[str, tuple[Shape, ...]]:
    """Shapes of the links of another robot that are the same in this one."""
    theirs = {
        link.get("name"): link for link in urdf_xml.parse(other.urdf, other.name).iterfind("link")
    }
    named = {link.get("name"): link for link in root.iterfind("link")}
    return {
        name: look.shapes[name]
        for name in look.found & named.keys()
        if _text(named[name]) == _text(theirs[name])
    }


def _text(element: Any) -> bytes:
    from lxml import etree

    return bytes(etree.tostring(element, method="c14n", strip_text=True))


@dataclass(frozen=True)
class _Visual:
    """A <visual>: a shape of its own, or a mesh file with its scale; at an origin."""

    origin: Array
    own: Shape | None = None
    file: Path | None = None
    scale: tuple[float, ...] = (1.0, 1.0, 1.0)

    @property
    def key(self) -> tuple[Path | None, tuple[float, ...]]:
        return self.file, self.scale

    def shape(self, files: _Files) -> Shape:
        return (self.own or files.light[self.key]).moved(self.origin)


class _Files:
    """Mesh files, each read once and simplified once a scale."""

    def __init__(self, urdf_dir: Path | None) -> None:
        self.light: dict[tuple[Path | None, tuple[float, ...]], Shape] = {}
        self._urdf_dir = urdf_dir
        self._read: dict[Path, Shape | ValueError] = {}

    def find(self, name: str) -> Path:
        """Return the file of a mesh that can be read, or raise ValueError."""
        path = find_mesh(name, self._urdf_dir)
        if path is None:
            raise ValueError("no such file")
        if path not in self._read:
            try:
                self._read[path] = mesh.load_mesh(path)
            except ValueError as error:
                self._read[path] = error
        found = self._read[path]
        if isinstance(found, ValueError):
            raise found
        return path

    def lighten(self, visuals: list[_Visual], budget: float) -> None:
        """Simplify the meshes of all visuals to a number of triangles."""
        full, used = {}, []
        for visual in visuals:
            if visual.own is not None:
                budget -= len(visual.own.faces)
            elif visual.file is not None:
                used.append(visual.key)
                if visual.key not in full:
                    read = self._read[visual.file]
                    assert isinstance(read, Shape)  # the others have raised
                    full[visual.key] = read.scaled(np.array(visual.scale))
        counts = [len(full[key].faces) for key in used]
        sizes = [full[key].size for key in used]
        for key, count in dict(zip(used, mesh.shares(counts, sizes, budget), strict=True)).items():
            self.light[key] = mesh.smooth(mesh.simplify(full[key], count))


def _visual(element: Any, files: _Files) -> _Visual:
    """Read a <visual>, or raise a ValueError that says why it cannot be shown."""
    origin, placed = element.find("origin"), np.eye(4)
    if origin is not None:
        placed[:3, :3] = pin.rpy.rpyToMatrix(_numbers(origin, "rpy", 3, "0 0 0"))
        placed[:3, 3] = _numbers(origin, "xyz", 3, "0 0 0")
    shape = _geometry(element)
    if shape is None:
        raise ValueError("there is no <geometry>")
    if shape.tag == "mesh":
        scale = tuple(_numbers(shape, "scale", 3, "1 1 1").tolist())
        if 0.0 in scale:
            raise ValueError("its scale is 0")
        return _Visual(placed, file=files.find(shape.get("filename", "")), scale=scale)
    if shape.tag == "box":
        return _Visual(placed, own=mesh.box(_numbers(shape, "size", 3, above=0.0)))
    if shape.tag == "sphere":
        return _Visual(placed, own=mesh.sphere(_numbers(shape, "radius", 1, above=0.0)[0]))
    if shape.tag == "cylinder":
        radius, length = (_numbers(shape, name, 1, above=0.0)[0] for name in ("radius", "length"))
        return _Visual(placed, own=mesh.cylinder(radius, length))
    raise ValueError("this geometry is not known")


def _geometry(element: Any) -> Any:
    return next(element.iterfind("geometry/*"), None)


def _called(element: Any, link: Any) -> str:
    """What to call a <visual>: its mesh file, or its kind and its link."""
    shape = _geometry(element)
    name = shape.get("filename") if shape is not None else None
    kind = shape.tag if shape is not None else "visual"
    return name or f"<{kind}> of link {link.get('name')!r}"


def _numbers(
    element: Any, name: str, count: int, default: str = "", above: float = -np.inf
) -> Array:
    text = element.get(name, default)
    try:
        numbers = np.array(text.split(), dtype=np.float64)
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != count or not (np.isfinite(numbers) & (numbers > above)).all():
        wanted = f"{count} numbers" if count > 1 else "a number"
        raise ValueError(f"{name} must be {wanted}{' > 0' if above == 0.0 else ''}, got {text!r}")
    return numbers


def _in_place(robot: Robot, root: Any, seen: Set[str]) -> dict[str, tuple[Shape, ...]]:
    """Capsules and balls for the links that nothing is seen of."""
    joints = urdf_xml.read(root, robot.name).robot.joints
    radius = _THICK * _arm_length(joints)
    links = {link.get("name"): link for link in root.iterfind("link")}
    wanted = {name for name, link in links.items() if link.find("visual") is not None}
    solid = {name for name, link in links.items() if link.find("inertial") is not None}
    moved = {joint.child for joint in joints if joint.type != "fixed"}
    arm = _carriers(joints, {robot.tip, *moved})
    bodies = _carriers(joints, {robot.tip, *moved, *wanted, *solid})
    shapes: dict[str, tuple[Shape, ...]] = {}
    for joint in joints:
        link, end = joint.parent, _shift(joint)
        # where other links are to be seen, one that is not may be a frame: of a camera, of a floor
        beyond = bodies if link in wanted or not wanted else arm
        far = np.linalg.norm(end) > _NEAR * radius
        if link not in seen and joint.child in beyond and far:
            shapes[link] = (*shapes.get(link, ()), mesh.capsule(np.zeros(3), end, radius))
    for link in sorted(wanted - seen - set(shapes)):
        shapes[link] = (mesh.sphere(radius),)
    return shapes


def _carriers(joints: list[yourdfpy.Joint], links: set[str | None]) -> set[str | None]:
    """Links, and those that carry them."""
    parents = {joint.child: joint.parent for joint in joints}
    found = set(links)
    for link in links:
        while link in parents:
            link = parents[link]
            found.add(link)
    return found


def _arm_length(joints: list[yourdfpy.Joint]) -> float:
    """Way along the links from the first moving joint to the last, or to the farthest link [m]."""
    above = {joint.child: joint for joint in joints}

    def way(joint: yourdfpy.Joint | None) -> float:
        length = 0.0
        while joint is not None:
            length += float(np.linalg.norm(_shift(joint)))
            joint = above.get(joint.parent)
        return length

    moving = [way(joint) for joint in joints if joint.type != "fixed"]
    farthest = max(way(joint) for joint in joints)
    # 1 m where all joints are at one place: any size is as good as another
    return (max(moving) - min(moving)) or (farthest - min(moving)) or 1.0


def _shift(joint: yourdfpy.Joint) -> Array:
    return np.zeros(3) if joint.origin is None else np.array(joint.origin[:3, 3], dtype=np.float64)
