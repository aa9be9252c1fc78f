"""Mesh files of a URDF: where they are; and writing what other tools can read."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from lxml.builder import E

from approxjac.errors import UrdfError
from approxjac.robots.catalog import share_dir
from approxjac.robots.urdf import Urdf

_MUJOCO_READS = (".stl", ".obj", ".msh")
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def find_mesh(filename: str, urdf_dir: Path | None) -> Path | None:
    """Return the file that a URDF means by a mesh name, as ROS finds packages, or None."""
    if filename.startswith("package://"):
        relative = filename.removeprefix("package://")
        roots = [urdf_dir, *urdf_dir.parents] if urdf_dir is not None else []
        roots += [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p]
        roots += filter(None, [share_dir()])
    else:
        relative = filename.removeprefix("file://")
        roots = [Path("/") if urdf_dir is None else urdf_dir]
    candidates = (root / relative for root in roots)
    return next((file.resolve() for file in candidates if file.is_file()), None)


def for_other_tools(urdf: Urdf, urdf_dir: Path | None, path: Path) -> None:
    """Make a URDF open alike in Pinocchio, MuJoCo, MeshCat and yourdfpy, to be written to `path`.

    Mesh files that are found are named by their full path; collision meshes that MuJoCo cannot
    read are converted to STL, into the folder `{name}_meshes` beside the file. Unless the URDF
    already speaks to MuJoCo, it is asked to keep links on fixed joints as bodies (it merges them
    otherwise, and the tip frame is lost) and not to invent a mass for shapes of links without one.
    """
    root, folder = urdf.root, path.with_name(f"{path.stem}_meshes")
    converted: dict[Path, Path] = {}
    for mesh in root.iter("mesh"):
        found = find_mesh(mesh.get("filename", ""), urdf_dir)
        if found is None:
            continue
        collides = mesh.getparent().getparent().tag == "collision"
        if collides and found.suffix.lower() not in _MUJOCO_READS:
            if found not in converted:
                name = f"{len(converted)}_{found.stem}.stl"  # two meshes may share a name
                converted[found] = _to_stl(found, (folder / name).resolve())
            found = converted[found]
        mesh.set("filename", str(found))
    moves = urdf.moved_links
    # MuJoCo refuses inertias that no body can have also where they act on nothing
    for inertia in root.iterfind("link/inertial/inertia"):
        if not _possible(inertia) and inertia.getparent().getparent().get("name") not in moves:
            inertia.attrib.update(dict.fromkeys(_MOMENTS, "0"))
    if root.find("mujoco") is None:
        compiler = E.compiler(fusestatic="false", strippath="false", inertiafromgeom="false")
        root.insert(0, E.mujoco(compiler))


def impossible_inertias(urdf: Urdf) -> dict[str, list[float]]:
    """Return the links that move with inertias that no body has → principal moments [kg m²]."""
    found = {}
    for inertia in urdf.root.iterfind("link/inertial/inertia"):
        link = inertia.getparent().getparent().get("name")
        if link in urdf.moved_links and not _possible(inertia):
            found[link] = _principal(inertia)
    return found


def _possible(inertia: Any) -> bool:
    """Return whether no principal moment is negative or larger than the other two together."""
    small, middle, large = _principal(inertia)
    slack = 1e-9 * abs(large)
    return bool(small >= -slack and small + middle >= large - slack)


def _principal(inertia: Any) -> list[float]:
    """Return the principal moments of an <inertia> [kg m²], the smallest first."""
    xx, xy, xz, yy, yz, zz = (float(inertia.get(name)) for name in _MOMENTS)
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return [float(moment) for moment in moments]


def _to_stl(mesh: Path, stl: Path) -> Path:
    """Convert a mesh file to STL and return the new file."""
    import trimesh

    try:
        stl.parent.mkdir(parents=True, exist_ok=True)
        trimesh.load(mesh, force="mesh").export(stl)
    except Exception as error:  # each of trimesh's readers raises its own
        raise UrdfError(
            f"collision mesh {mesh} cannot be converted to {stl}: {error}", given=mesh
        ) from error
    return stl
