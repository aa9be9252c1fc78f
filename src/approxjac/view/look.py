"""`robot_look`: the shapes of the links of a robot."""

from copy import deepcopy
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yourdfpy
from lxml import etree
from lxml.builder import E
from trimesh import Trimesh, creation

from approxjac.errors import package_of
from approxjac.robots import Robot
from approxjac.robots.meshes import find_mesh, read_mesh
from approxjac.view.tree import robot_joints

_TRIANGLES = 2500  # of a mesh file
_THICK = 0.03  # radius of a capsule, of the way from the base to the farthest link
_NEAR = 0.1  # of the radius: joints nearer to their link's origin get no capsule

# Meshes are simplified at this size: fast-simplification's steps towards larger gaps are absolute.
# The largest is 3 % of it; with its usual 7 instead of 5 there is no end to them, and a mesh in
# which it gets stuck is torn to pieces.
_SIZE = 100.0
_AGGRESSIVE = 5.0
# It gets stuck in the slivers that CAD writes, unless vertices that are close are welded: those in
# the same cell of a grid. Wider cells are for what narrower ones do not get small enough, the
# widest for what has many small parts.
_CELLS = (0.2, 0.6, 1.8, 5.4)

_SHARP = np.deg2rad(35.0)  # edges sharper than this stay edges when shaded smoothly


def robot_look(robot: Robot) -> tuple[dict[str, tuple[Trimesh, ...]], list[str]]:
    """Return shapes of links by name, in their frames [m], and texts on those not shown.

    Draw both sides of triangles: not all files have them counterclockwise.

    A link has the <visual>s of the URDF whose files are found. Meshes are simplified to at most
    2500 triangles a file, unless that would tear small parts apart, and prepared for smooth
    shading.

    A link without any is drawn as capsules from its origin to the joints that it carries, except
    those to mere frames; if there are none and its <visual>s were not found, as a ball.
    """
    shapes: dict[str, tuple[Trimesh, ...]] = {}
    missing: dict[str, None] = {}  # in order, each once
    wanted = set()
    for element in robot.tree.root.iterfind("link/visual"):
        name, shape = element.getparent().get("name"), element.find("geometry/*")
        wanted.add(name)
        try:
            shapes[name] = (*shapes.get(name, ()), _visual(element, robot.urdf_dir))
        except ValueError as error:
            kind = "visual" if shape is None else shape.tag
            file = None if shape is None else shape.get("filename")
            missing[f"{file or f'<{kind}> of link {name!r}'}: {error}"] = None
    return _in_place(robot, wanted, set(shapes)) | shapes, list(missing)


def _visual(element: Any, folder: Path | None) -> Trimesh:
    """Return the mesh of a <visual>, or raise a ValueError that says why it cannot be shown."""
    if element.find("geometry/*") is None:
        raise ValueError("there is no <geometry>")
    # by itself: one that is wrong leaves the others
    parts = map(deepcopy, element.iterchildren("origin", "geometry"))
    alone = E.robot(E.link(E.visual(*parts), name="link"), name="alone")
    try:
        file = BytesIO(etree.tostring(alone))
        read = yourdfpy.URDF.load(file, load_meshes=False, build_scene_graph=False)
        (parsed,) = read.robot.links[0].visuals
    except Exception as error:  # of many kinds, as for words in place of numbers
        raise ValueError(f"cannot be read: {error}") from error
    shape = parsed.geometry
    scale = np.ones(3) if shape.mesh is None or shape.mesh.scale is None else shape.mesh.scale
    placement = np.eye(4) if parsed.origin is None else parsed.origin
    placement = placement @ np.diag([*(scale * np.ones(3)), 1.0])
    primitive = shape.box or shape.cylinder or shape.sphere
    sizes = np.abs(scale) if primitive is None else np.hstack([*vars(primitive).values()])
    if not (np.isfinite(placement).all() and np.isfinite(sizes).all() and (sizes > 0.0).all()):
        raise ValueError("its numbers must be finite, and its size > 0")
    if shape.box is not None:
        mesh = smooth(creation.box(shape.box.size))
    elif shape.sphere is not None:
        mesh = creation.icosphere(2, shape.sphere.radius)
    elif shape.cylinder is not None:
        mesh = smooth(creation.cylinder(*sizes))
    else:
        path = find_mesh(shape.mesh.filename or "", folder)
        if path is None:
            raise ValueError("no such file")
        mesh = _light_mesh(path, path.stat().st_mtime_ns).copy()
    return mesh.apply_transform(placement)  # which turns mirror images right side out


@lru_cache(maxsize=128)
def _light_mesh(path: Path, _changed: int) -> Trimesh:
    return smooth(simplify(load_mesh(path), _TRIANGLES))


def _in_place(robot: Robot, wanted: set[str], seen: set[str]) -> dict[str, tuple[Trimesh, ...]]:
    """Return capsules and balls for links without a visible shape."""
    joints = robot_joints(robot)
    way, carriers = {joints[0].parent: 0.0}, {robot.tip, *wanted}
    for joint in joints:
        way[joint.child] = way[joint.parent] + float(np.linalg.norm(joint.origin[:3, 3]))
    for joint in reversed(joints):
        if joint.kind != "fixed" or joint.child in carriers:
            carriers |= {joint.child, joint.parent}
    radius = _THICK * (max(way.values()) or 1.0)  # where all links are at one place, any will do
    shapes: dict[str, tuple[Trimesh, ...]] = {}
    for joint in joints:
        link, end = joint.parent, joint.origin[:3, 3]
        if link not in seen and joint.child in carriers and np.linalg.norm(end) > _NEAR * radius:
            mesh = creation.capsule(float(np.linalg.norm(end)), radius, count=[12, 20])
            mesh.apply_translation(-mesh.bounds.mean(axis=0))  # its place differs between versions
            mesh.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], end))
            shapes[link] = (*shapes.get(link, ()), mesh.apply_translation(0.5 * end))
    balls = wanted - seen - set(shapes)
    return shapes | {link: (creation.icosphere(2, radius),) for link in sorted(balls)}


def load_mesh(path: Path) -> Trimesh:
    """Return the triangles of a mesh file, with equal vertices merged.

    As in Pinocchio and in RViz, the unit and the up axis that a COLLADA file declares are ignored:
    coordinates are metres in the URDF's frame. A file without triangles is a ValueError.
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


def simplify(mesh: Trimesh, count: int) -> Trimesh:
    """Return a mesh with about `count` triangles in place of more."""
    reduced = package_of("view", "fast_simplification").simplify
    if len(mesh.faces) <= count:
        return mesh
    unit = mesh.scale / _SIZE
    for cell in _CELLS:
        welded = Trimesh(mesh.vertices / (unit * cell), mesh.faces, process=False)
        welded.merge_vertices(digits_vertex=0)
        _without_flat(welded)
        vertices, faces = cell * welded.vertices, np.array(welded.faces, dtype=np.int32)
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


def _without_flat(mesh: Trimesh) -> Trimesh:
    mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces())
    return mesh
