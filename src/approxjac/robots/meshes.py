"""Mesh files of a URDF: where they are; and writing what other tools can read."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from approxjac.errors import UrdfError
from approxjac.robots.catalog import share_dir

_MUJOCO_READS = (".stl", ".obj", ".msh")
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def find_mesh(filename: str, urdf_dir: Path | None) -> Path | None:
    """Return the file that a URDF means by a mesh name, or None where there is none.

    `package://` is looked up in the folders above the URDF, in ROS_PACKAGE_PATH and in the
    share folder of example-robot-data; other names are relative to the URDF.
    """
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


def for_other_tools(root: Any, urdf_dir: Path | None, path: Path) -> None:
    """Make a URDF open alike in Pinocchio, MuJoCo, MeshCat and yourdfpy.

    Mesh files that are found are named by their full path. Collision meshes that MuJoCo cannot
    read are converted to STL, into the folder `{name}_meshes` beside the file. MuJoCo is asked to
    keep links on fixed joints as bodies (it merges them otherwise, and the tip frame is lost) and
    not to invent a mass for shapes of links that have none, unless the URDF already speaks to
    MuJoCo. Of links that do not move, inertias that no body can have, which MuJoCo refuses, are
    written as zero; they act on nothing.

    Args:
        root: XML root to change.
        urdf_dir: Folder that mesh names are relative to.
        path: File that will be written.
    """
    from lxml import etree

    converted: dict[Path, Path] = {}
    folder = path.with_name(f"{path.stem}_meshes")
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
    for link in _links_at_rest(root):
        inertia = link.find("inertial/inertia")
        if inertia is not None and not _possible(inertia):
            for name in _MOMENTS:
                inertia.set(name, "0")
    if root.find("mujoco") is None:
        mujoco = etree.Element("mujoco")
        etree.SubElement(
            mujoco, "compiler", fusestatic="false", strippath="false", inertiafromgeom="false"
        )
        root.insert(0, mujoco)


def _links_at_rest(root: Any) -> list[Any]:
    """The <link> elements that no joint moves."""
    parents = {
        joint.find("child").get("link"): (joint.get("type"), joint.find("parent").get("link"))
        for joint in root.iterfind("joint")
    }

    def at_rest(name: str) -> bool:
        while name in parents:
            kind, name = parents[name]
            if kind != "fixed":
                return False
        return True

    return [link for link in root.iterfind("link") if at_rest(link.get("name"))]


def _possible(inertia: Any) -> bool:
    """Whether no principal moment is negative or larger than the other two together."""
    xx, xy, xz, yy, yz, zz = (float(inertia.get(name)) for name in _MOMENTS)
    small, middle, large = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    slack = 1e-9 * abs(large)
    return bool(small >= -slack and small + middle >= large - slack)


def _to_stl(mesh: Path, stl: Path) -> Path:
    """Convert a mesh file to STL; returns the new file."""
    import trimesh

    try:
        stl.parent.mkdir(parents=True, exist_ok=True)
        trimesh.load(mesh, force="mesh").export(stl)
    except Exception as error:  # each of trimesh's readers raises its own
        raise UrdfError(
            f"collision mesh {mesh} cannot be converted to {stl}: {error}", given=mesh
        ) from error
    return stl
