"""`robot_look`: the shapes of the links of a robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from copy import deepcopy
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
import yourdfpy
from lxml import etree
from lxml.builder import E
from trimesh import Trimesh, creation

from approxjac.errors import package_of
from approxjac.robots import Robot
from approxjac.robots.meshes import find_mesh, read_mesh
from approxjac.validation import Array
from approxjac.view.tree import Joint, robot_joints

_TRIANGLES = 25_000  # of a robot
_THICK = 0.05  # radius of a capsule, of the way from the first moving joint to the last
_NEAR = 0.1  # of the radius: joints nearer to their link's origin get no capsule
_AROUND = 32  # sides of what is round; a multiple of 4, so that it reaches its radius along x, y
_FEW = 200  # triangles up to which a mesh is left as it is

# Meshes are simplified at this size: fast-simplification's steps towards larger gaps are absolute.
# The largest is 3 % of it; with its usual 7 instead of 5 there is no end to them, and a mesh in
# which it gets stuck is torn to pieces.
_SIZE = 100.0
_AGGRESSIVE = 5.0
# It gets stuck in the slivers that CAD writes, unless vertices that are close are welded: those in
# the same cell of a grid. Wider cells are for what narrower ones do not get small enough, the
# widest for what has many small parts.
_CELLS = (0.2, 0.6, 1.8, 5.4)
_THIN = 1.0  # of narrower cells the two sides of a thin wall stay apart

_SHARP = np.deg2rad(35.0)  # edges sharper than this stay edges when shaded smoothly


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
    root, taken = robot.tree.root, {} if like is None else _taken(robot, *like)
    load = cache(load_mesh)
    seen: dict[str, list[_Visual]] = {}
    missing: dict[str, None] = {}  # in order, each once
    for link in root.iterfind("link"):
        name = link.get("name")
        for element in [] if name in taken else link.iterfind("visual"):
            shape = element.find("geometry/*")
            try:
                visual = _visual(element, robot.urdf_dir, load)
            except ValueError as error:
                kind = "visual" if shape is None else shape.tag
                file = None if shape is None else shape.get("filename")
                missing[f"{file or f'<{kind}> of link {name!r}'}: {error}"] = None
            else:
                seen.setdefault(name, []).append(visual)
    found = seen.keys() | taken.keys()
    shapes = taken | _in_place(robot, found)
    # the meshes of all files, each once a scale, become as light as there is room
    visuals = [visual for of_link in seen.values() for visual in of_link]
    files = [visual for visual in visuals if visual.file is not None]
    fixed = [mesh for meshes in shapes.values() for mesh in meshes]
    fixed += [visual.mesh for visual in visuals if visual.file is None]
    has, sizes = [len(visual.mesh.faces) for visual in files], [v.mesh.scale for v in files]
    counts = shares(has, sizes, _TRIANGLES - sum(len(mesh.faces) for mesh in fixed))
    wanted = {v.file: (v.mesh, count) for v, count in zip(files, counts, strict=True)}
    light: dict[Any, Trimesh] = {f: smooth(simplify(*given)) for f, given in wanted.items()}
    for name, of_link in seen.items():
        placed = [light.get(v.file, v.mesh).copy().apply_transform(v.origin) for v in of_link]
        shapes[name] = tuple(placed)
    return Look(shapes, tuple(missing), frozenset(found))


def _taken(robot: Robot, other: Robot, look: Look) -> dict[str, tuple[Trimesh, ...]]:
    """Return the shapes of the links of another robot that are the same in this one."""

    def texts(whole: Robot) -> dict[str, bytes]:
        links = whole.tree.root.iterfind("link")
        return {e.get("name"): etree.tostring(e, method="c14n", strip_text=True) for e in links}

    theirs = set(texts(other).values())
    return {
        name: look.shapes[name]
        for name, text in texts(robot).items()
        if text in theirs and name in look.found
    }


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


def _in_place(robot: Robot, seen: Set[str]) -> dict[str, tuple[Trimesh, ...]]:
    """Return capsules and balls for the links that nothing is seen of."""
    joints = robot_joints(robot)
    radius = _THICK * _arm_length(joints)
    links = {link.get("name"): link for link in robot.tree.root.iterfind("link")}
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
    carriers = set(links)
    for joint in reversed(joints):
        if joint.child in carriers:
            carriers.add(joint.parent)
    return carriers


def _arm_length(joints: Sequence[Joint]) -> float:
    """Return the way along the links from first to last moving joint, or farthest link [m]."""
    way = {joints[0].parent: 0.0}
    for joint in joints:
        way[joint.child] = way[joint.parent] + float(np.linalg.norm(joint.origin[:3, 3]))
    moving = [way[joint.child] for joint in joints if joint.kind != "fixed"]
    # 1 m where all joints are at one place: any size is as good as another
    return (max(moving) - min(moving)) or (max(way.values()) - min(moving)) or 1.0


def load_mesh(path: Path) -> Trimesh:
    """Return the triangles of a mesh file as they are written there, equal vertices merged.

    As in Pinocchio and in RViz, the unit and the up axis that a COLLADA file declares are ignored:
    coordinates are metres in the URDF's frame.

    Raises:
        ValueError: It cannot be read, or holds no triangles.
    """
    try:
        with np.errstate(all="ignore"):  # of what is not finite
            loaded = read_mesh(path)
            # built anew: normals and textures would keep equal vertices apart
            mesh = _without_flat(Trimesh(loaded.vertices, loaded.faces))
    except Exception as error:  # each of trimesh's readers raises its own
        raise ValueError(f"cannot be read: {type(error).__name__}: {error}") from error
    if not len(mesh.faces):
        raise ValueError("holds no triangles")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError("holds coordinates that are not finite")
    return mesh


def capsule(end: Array, radius: float) -> Trimesh:
    """Return a cylinder from the origin to `end` (3,) [m] with a half ball at each."""
    mesh = trimesh.creation.capsule(float(np.linalg.norm(end)), radius, count=[12, 20])
    mesh.apply_translation(-mesh.bounds.mean(axis=0))  # its place differs between versions
    mesh.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], end))
    mesh.apply_translation(0.5 * end)
    return mesh


def shares(counts: Sequence[int], sizes: Sequence[float], budget: float) -> list[int]:
    """Share a number of triangles among meshes, by size.

    On a curved surface n triangles leave a gap in proportion to size²/(radius n): shared by size,
    all are off by about the same. No mesh gets more than it has, or less than 200, even where that
    is too many.
    """
    has, weight = np.array(counts, dtype=float), np.array(sizes)

    def given(rate: float) -> Array:
        return np.asarray(np.minimum(has, np.maximum(_FEW, np.floor(rate * weight))))

    if not len(has) or has.sum() <= budget:
        return list(counts)
    low, high = 0.0, float((has / weight).max())
    for _ in range(60):
        rate = 0.5 * (low + high)
        low, high = (rate, high) if given(rate).sum() <= budget else (low, rate)
    return [int(count) for count in given(low)]


def simplify(mesh: Trimesh, count: int) -> Trimesh:
    """Return a mesh with about `count` triangles in place of more."""
    reduced = package_of("view", "fast_simplification").simplify
    if len(mesh.faces) <= count:
        return mesh
    unit = mesh.scale / _SIZE
    start = mesh.vertices / unit
    for cell in _CELLS:
        vertices, faces = _weld(start, mesh.faces, cell)
        if len(faces) > count:  # without its border a tube that is open would lose its wall
            share = 1.0 - count / len(faces)
            vertices, faces = reduced(
                vertices, faces, target_reduction=share, agg=_AGGRESSIVE, preserve_border=True
            )
        if len(faces) <= count:
            break
    return Trimesh(vertices * unit, faces, process=False)


def smooth(mesh: Trimesh) -> Trimesh:
    """Return a mesh that shows sharp edges as edges, and what is round as round, when shaded."""
    return trimesh.graph.smooth_shade(mesh, angle=_SHARP, facet_minarea=None)


def _weld(vertices: Array, faces: Array, cell: float) -> tuple[Array, Array]:
    """Make one vertex, their mean, of all in the same cell of a grid; drop what becomes flat."""
    facing = np.round(Trimesh(vertices, faces, process=False).vertex_normals) + 1.0
    place = np.round((vertices - vertices.min(axis=0)) / cell)
    keys = place @ [1 << 6, 1 << 26, 1 << 46] + (cell < _THIN) * (facing @ [1, 4, 16])
    _, index = np.unique(keys.astype(np.int64), return_inverse=True)
    number = np.bincount(index)
    means = [np.bincount(index, vertices[:, axis]) / number for axis in range(3)]
    welded = _without_flat(Trimesh(np.column_stack(means), index[faces], process=False))
    return np.array(welded.vertices), np.array(welded.faces, dtype=np.int32)


def _without_flat(mesh: Trimesh) -> Trimesh:
    """Drop triangles that are there twice or have no area."""
    mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces())
    return mesh
