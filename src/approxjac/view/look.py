"""`robot_look`: the shapes of the links of a robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from copy import deepcopy
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yourdfpy
from lxml import etree
from lxml.builder import E
from trimesh import Trimesh, creation

from approxjac.robots import Robot
from approxjac.robots.meshes import find_mesh
from approxjac.validation import Array
from approxjac.view.mesh_drawing import capsule, load_mesh, shares, simplify, smooth
from approxjac.view.tree import Joint, robot_joints

_TRIANGLES = 25_000  # of a robot
_THICK = 0.05  # radius of a capsule, of the way from the first moving joint to the last
_NEAR = 0.1  # of the radius: joints nearer to their link's origin get no capsule
_AROUND = 32  # sides of what is round; a multiple of 4, so that it reaches its radius along x, y


class Look(NamedTuple):
    """Shapes of the links of a robot.

    Both sides of triangles are to be drawn: not all files have them counterclockwise.
    """

    shapes: Mapping[str, tuple[Trimesh, ...]]  # by link, in its frame [m], not to be changed
    missing: tuple[str, ...]  # what of the URDF cannot be shown, by name, and why
    found: frozenset[str]  # links that look as the URDF says, at least in part


class _Visual(NamedTuple):
    """A <visual>: a mesh at an origin; `file` and its scale if it is one of a file."""

    origin: Array
    mesh: Trimesh
    file: tuple[Path, tuple[float, ...]] | None


def robot_look(robot: Robot, like: tuple[Robot, Look] | None = None) -> Look:
    """Return the look of each link of a robot, and what of it is missing.

    A link looks like the <visual>s of the URDF that are found. Meshes are simplified until the
    whole robot keeps to 25 000 triangles, shared by size, and are ready for smooth shading. There
    are more where what is never simplified has more (boxes, cylinders, spheres, capsules, meshes of
    up to 200 triangles) and where fewer would tear a mesh of many small parts apart.

    A link of which nothing is found is drawn as capsules from its origin to the joints that it
    carries, but for those to mere frames; without any away from it, it is a ball. One that has no
    <visual> is drawn so as well, in a robot where others have towards moving joints and the tip
    only, and never as a ball.

    With another robot and its look as `like`, links that are the same in both take the very same
    shapes, without delay.
    """
    root = robot.tree.root
    taken = {} if like is None else _taken(root, *like)
    seen, missing = _visuals(root, robot.urdf_dir, taken.keys())
    shapes = taken | _in_place(robot, root, seen.keys() | taken.keys())
    budget = _TRIANGLES - sum(len(mesh.faces) for drawn in shapes.values() for mesh in drawn)
    light = _lightened([visual for found in seen.values() for visual in found], budget)
    for name, visuals in seen.items():
        placed = [light.get(v.file, v.mesh).copy().apply_transform(v.origin) for v in visuals]
        shapes[name] = tuple(placed)
    return Look(shapes, missing, frozenset(seen.keys() | taken.keys()))


def _taken(root: Any, other: Robot, look: Look) -> dict[str, tuple[Trimesh, ...]]:
    """Return the shapes of the links of another robot that are the same in this one."""

    def text(link: Any) -> bytes:
        return bytes(etree.tostring(link, method="c14n", strip_text=True))

    theirs = {text(link) for link in other.tree.root.iterfind("link")}
    same = [link.get("name") for link in root.iterfind("link") if text(link) in theirs]
    return {name: look.shapes[name] for name in same if name in look.found}


def _visuals(
    root: Any, folder: Path | None, known: Set[str]
) -> tuple[dict[str, list[_Visual]], tuple[str, ...]]:
    """Read the <visual>s of all links that are not known yet, and say which cannot be shown."""
    load = cache(load_mesh)
    seen: dict[str, list[_Visual]] = {}
    missing: dict[str, None] = {}  # in order, each once
    for link in root.iterfind("link"):
        name = link.get("name")
        for element in [] if name in known else link.iterfind("visual"):
            shape = element.find("geometry/*")
            try:
                seen.setdefault(name, []).append(_visual(element, folder, load))
            except ValueError as error:
                kind = "visual" if shape is None else shape.tag
                file = None if shape is None else shape.get("filename")
                missing[f"{file or f'<{kind}> of link {name!r}'}: {error}"] = None
    return {name: found for name, found in seen.items() if found}, tuple(missing)


def _visual(element: Any, folder: Path | None, load: Callable[[Path], Trimesh]) -> _Visual:
    """Read a <visual>, or raise a ValueError that says why it cannot be shown."""
    origin, shape = _parsed(element)
    if shape.box is not None:
        return _Visual(origin, smooth(creation.box(shape.box.size)), None)
    if shape.sphere is not None:
        return _Visual(origin, creation.icosphere(2, shape.sphere.radius), None)
    if shape.cylinder is not None:
        radius, length = shape.cylinder.radius, shape.cylinder.length
        return _Visual(origin, smooth(creation.cylinder(radius, length, sections=_AROUND)), None)
    scale = np.ones(3) if shape.mesh.scale is None else shape.mesh.scale * np.ones(3)
    path = find_mesh(shape.mesh.filename or "", folder)
    if path is None:
        raise ValueError("no such file")
    mesh = load(path).copy()
    mesh.apply_transform(np.diag([*scale, 1.0]))  # turns mirror images right side out
    return _Visual(origin, mesh, (path, tuple(scale.tolist())))


def _parsed(element: Any) -> tuple[Array, Any]:
    """Return the origin of a <visual>, shape (4, 4), and its shape, as yourdfpy reads them.

    Each by itself: one that is wrong leaves the others.
    """
    if element.find("geometry/*") is None:
        raise ValueError("there is no <geometry>")
    parts = [deepcopy(element.find(tag)) for tag in ("origin", "geometry")]
    visual = E.visual(*filter(lambda part: part is not None, parts))
    alone = E.robot(E.link(visual, name="link"), name="alone")
    try:
        file = BytesIO(etree.tostring(alone))
        read = yourdfpy.URDF.load(file, load_meshes=False, build_scene_graph=False)
        (parsed,) = read.robot.links[0].visuals
    except Exception as error:  # of many kinds, as for words in place of numbers
        raise ValueError(f"cannot be read: {error}") from error
    shape = parsed.geometry
    sizes = [
        np.ravel(size)
        for kind in filter(None, (shape.box, shape.sphere, shape.cylinder))
        for size in vars(kind).values()
    ]
    if shape.mesh is not None and shape.mesh.scale is not None:
        sizes.append(np.ravel(np.abs(shape.mesh.scale)))  # which mirrors where it is negative
    origin = np.eye(4) if parsed.origin is None else parsed.origin
    numbers = np.concatenate([origin.ravel(), *sizes])
    if not np.isfinite(numbers).all() or any((size <= 0.0).any() for size in sizes):
        raise ValueError("its numbers must be finite, and its size > 0")
    return origin, shape


def _lightened(visuals: Sequence[_Visual], budget: float) -> dict[Any, Trimesh]:
    """Simplify the meshes of all files, each once a scale, to a number of triangles in all."""
    files = [visual for visual in visuals if visual.file is not None]
    budget -= sum(len(visual.mesh.faces) for visual in visuals if visual.file is None)
    counts = [len(visual.mesh.faces) for visual in files]
    given = shares(counts, [visual.mesh.scale for visual in files], budget)
    wanted = {v.file: (v.mesh, count) for v, count in zip(files, given, strict=True)}
    return {file: smooth(simplify(mesh, count)) for file, (mesh, count) in wanted.items()}


def _in_place(robot: Robot, root: Any, seen: Set[str]) -> dict[str, tuple[Trimesh, ...]]:
    """Return capsules and balls for the links that nothing is seen of."""
    joints = robot_joints(robot)
    radius = _THICK * _arm_length(joints)
    links = {link.get("name"): link for link in root.iterfind("link")}
    wanted = {name for name, link in links.items() if link.find("visual") is not None}
    solid = {name for name, link in links.items() if link.find("inertial") is not None}
    moved = {joint.child for joint in joints if joint.kind != "fixed"}
    arm = _carriers(joints, {robot.tip, *moved})
    bodies = _carriers(joints, {robot.tip, *moved, *wanted, *solid})
    shapes: dict[str, tuple[Trimesh, ...]] = {}
    for joint in joints:
        link, end = joint.parent, joint.origin[:3, 3]
        # where other links are to be seen, one that is not may be a frame: of a camera, of a floor
        beyond = bodies if link in wanted or not wanted else arm
        far = np.linalg.norm(end) > _NEAR * radius
        if link not in seen and joint.child in beyond and far:
            shapes[link] = (*shapes.get(link, ()), capsule(end, radius))
    for link in sorted(wanted - seen - set(shapes)):
        shapes[link] = (creation.icosphere(2, radius),)
    return shapes


def _carriers(joints: Sequence[Joint], links: Set[str | None]) -> set[str | None]:
    """Return links, and those that carry them."""
    found = set(links)
    for joint in reversed(joints):
        if joint.child in found:
            found.add(joint.parent)
    return found


def _arm_length(joints: Sequence[Joint]) -> float:
    """Return the way along the links from first to last moving joint, or farthest link [m]."""
    way = {joints[0].parent: 0.0}
    for joint in joints:
        way[joint.child] = way[joint.parent] + float(np.linalg.norm(joint.origin[:3, 3]))
    moving = [way[joint.child] for joint in joints if joint.kind != "fixed"]
    # 1 m where all joints are at one place: any size is as good as another
    return (max(moving) - min(moving)) or (max(way.values()) - min(moving)) or 1.0
