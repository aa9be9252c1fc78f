"""Triangle meshes to look at: from files, and made lighter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from trimesh import Trimesh

from approxjac.extras import package_of
from approxjac.robots.meshes import read_mesh
from approxjac.validation import Array

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
