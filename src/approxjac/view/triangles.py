"""Triangle meshes to look at: from files, of boxes, cylinders and the like; and made lighter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from approxjac.validation import Array
from approxjac.view.packages import view_package

if TYPE_CHECKING:
    import trimesh

FEW = 200
"""Triangles up to which a mesh is left as it is."""

# Meshes are simplified at this size, for the steps that fast-simplification takes towards larger
# gaps are absolute. The largest is 3 % of the size; with its usual 7 instead of 5 there is no end
# to them, and a mesh in which it gets stuck is torn to pieces.
_SIZE = 100.0
_AGGRESSIVE = 5.0
# It gets stuck in the slivers that CAD writes, unless vertices that are close are welded: those in
# the same cell of a grid. Wider cells are for what narrower ones do not get small enough, the
# widest for what has many small parts.
_CELLS = (0.2, 0.6, 1.8, 5.4)
_THIN = 1.0  # of narrower cells the two sides of a thin wall stay apart

_SHARP = np.deg2rad(35.0)  # edges sharper than this stay edges when shaded smoothly
_AROUND = 32  # sides of what is round; a multiple of 4, so that it reaches its radius along x, y


@dataclass(frozen=True, eq=False)
class Shape:
    """A triangle mesh fixed to a link.

    Attributes:
        vertices: In the frame of the link, shape (n, 3) [m].
        faces: Indices of the vertices of each triangle, shape (f, 3). Counterclockwise seen from
            outside where the mesh file has it so, but not all files have, and simplified thin
            walls may lose it: both sides are to be drawn.
    """

    vertices: Array
    faces: NDArray[np.int32]

    def __post_init__(self) -> None:
        for array in (self.vertices, self.faces):
            array.flags.writeable = False

    @property
    def size(self) -> float:
        """Diagonal of its bounding box [m]."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    def scaled(self, scale: Array) -> Shape:
        """Return it scaled along its axes; of a mirror image, still counterclockwise."""
        faces = self.faces[:, ::-1].copy() if np.prod(scale) < 0.0 else self.faces
        return Shape(self.vertices * scale, faces)

    def moved(self, origin: Array) -> Shape:
        """Return it moved by a homogeneous matrix, shape (4, 4)."""
        return Shape(self.vertices @ origin[:3, :3].T + origin[:3, 3], self.faces)


def load_mesh(path: Path) -> Shape:
    """Return the triangles of a mesh file as they are written there, equal vertices merged.

    As in Pinocchio and in RViz, the unit and the up axis that a COLLADA file declares are ignored:
    coordinates are metres in the URDF's frame.

    Raises:
        ValueError: It cannot be read, or holds no triangles.
    """
    import trimesh

    try:
        with np.errstate(all="ignore"):  # of what is not finite
            loaded = trimesh.load(path, force="mesh", process=False)
            # built anew: normals and textures would keep equal vertices apart
            mesh = trimesh.Trimesh(loaded.vertices, loaded.faces)
            mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces())
    except Exception as error:  # each of trimesh's readers raises its own
        raise ValueError(f"cannot be read: {type(error).__name__}: {error}") from error
    if not len(mesh.faces):
        raise ValueError("holds no triangles")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError("holds coordinates that are not finite")
    return _shape(mesh)


def box(extents: Array) -> Shape:
    """Return a box of `extents` around the origin, shape (3,) [m]."""
    import trimesh

    return smooth(_shape(trimesh.creation.box(extents)))


def cylinder(radius: float, length: float) -> Shape:
    """Return a cylinder along z around the origin [m]."""
    import trimesh

    return smooth(_shape(trimesh.creation.cylinder(radius, length, sections=_AROUND)))


def sphere(radius: float) -> Shape:
    """Return a sphere around the origin [m]."""
    import trimesh

    return _shape(trimesh.creation.icosphere(subdivisions=2, radius=radius))


def capsule(start: Array, end: Array, radius: float) -> Shape:
    """Return a cylinder from `start` to `end` with a half ball at each, shape (3,) each [m]."""
    import trimesh

    along = end - start
    length = float(np.linalg.norm(along))
    mesh = trimesh.creation.capsule(length, radius, count=[12, 20])
    placed = np.eye(4)
    placed[:3, :3] = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along).matrix()
    placed[:3, 3] = 0.5 * (start + end)
    # centred here: where trimesh puts it differs between its versions
    centred = np.asarray(mesh.vertices) - 0.5 * (mesh.bounds[0] + mesh.bounds[1])
    return Shape(centred, np.array(mesh.faces, dtype=np.int32)).moved(placed)


def shares(counts: Sequence[int], sizes: Sequence[float], budget: float) -> list[int]:
    """Share a number of triangles among meshes, by size.

    On a curved surface n triangles leave a gap in proportion to size²/(radius n): shared by size,
    all are off by about the same. No mesh gets more than it has, or less than `FEW`.

    Args:
        counts: Triangles of each.
        sizes: Of each [m].
        budget: Triangles of all, exceeded only where `FEW` for each is too many.
    """
    has, weight = np.array(counts, dtype=float), np.array(sizes)

    def given(rate: float) -> Array:
        return np.asarray(np.minimum(has, np.maximum(FEW, np.floor(rate * weight))))

    if not len(has) or has.sum() <= budget:
        return list(counts)
    low, high = 0.0, float((has / weight).max())
    for _ in range(60):
        rate = 0.5 * (low + high)
        low, high = (rate, high) if given(rate).sum() <= budget else (low, rate)
    return [int(count) for count in given(low)]


def simplify(shape: Shape, count: int) -> Shape:
    """Return a mesh with about `count` triangles in place of more.

    Raises:
        MissingPackageError: fast-simplification is not installed.
    """
    fast_simplification = view_package("fast_simplification")
    if len(shape.faces) <= count:
        return shape
    unit = shape.size / _SIZE
    start = np.array(shape.vertices) / unit
    for cell in _CELLS:
        vertices, faces = _weld(start, np.array(shape.faces), cell)
        if len(faces) > count:  # without its border a tube that is open would lose its wall
            vertices, faces = fast_simplification.simplify(
                vertices,
                faces,
                target_reduction=1.0 - count / len(faces),
                agg=_AGGRESSIVE,
                preserve_border=True,
            )
        if len(faces) <= count:
            break
    return Shape(vertices * unit, faces.astype(np.int32))


def _weld(
    vertices: Array, faces: NDArray[np.int32], cell: float
) -> tuple[Array, NDArray[np.int32]]:
    """Make one vertex, their mean, of all in the same cell of a grid; drop what becomes flat."""
    import trimesh

    facing = np.round(trimesh.Trimesh(vertices, faces, process=False).vertex_normals) + 1.0
    place = np.round((vertices - vertices.min(axis=0)) / cell)
    keys = place @ [1 << 6, 1 << 26, 1 << 46] + (cell < _THIN) * (facing @ [1, 4, 16])
    _, index = np.unique(keys.astype(np.int64), return_inverse=True)
    number = np.bincount(index)
    means = [np.bincount(index, vertices[:, axis]) / number for axis in range(3)]
    welded = trimesh.Trimesh(np.column_stack(means), index[faces], process=False)
    welded.update_faces(welded.unique_faces() & welded.nondegenerate_faces())
    return np.array(welded.vertices), np.array(welded.faces, dtype=np.int32)


def smooth(shape: Shape) -> Shape:
    """Return a mesh whose vertices are shared by two triangles only if the edge is not sharp.

    So a viewer that takes the mean of normals at each vertex shows round things round and keeps
    edges.
    """
    import trimesh
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    flat = mesh.face_adjacency_angles < _SHARP
    pairs, edges = mesh.face_adjacency[flat], mesh.face_adjacency_edges[flat]
    # the corners of all triangles; two that meet along a flat edge become one vertex
    joined = [
        [3 * face + (shape.faces[face] == end[:, None]).argmax(axis=1) for face in pairs.T]
        for end in edges.T
    ]
    first, second = np.concatenate(joined, axis=1)
    corners = shape.faces.size
    link = coo_array((np.ones(len(first)), (first, second)), shape=(corners, corners))
    count, vertex = connected_components(link, directed=False)
    vertices = np.empty((count, 3))
    vertices[vertex] = shape.vertices[shape.faces.ravel()]
    return Shape(vertices, vertex.reshape(-1, 3).astype(np.int32))


def _shape(mesh: trimesh.Trimesh) -> Shape:
    # copies: trimesh watches its own arrays, and they may be written to
    return Shape(np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int32))
