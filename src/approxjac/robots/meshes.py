"""Mesh files of a URDF: finding and reading them, and URDFs that other tools can open."""

import os
from pathlib import Path
from typing import IO, Any

import numpy as np
from lxml import etree
from lxml.builder import E

from approxjac.errors import UrdfError, package_of
from approxjac.files import replaced
from approxjac.robots.urdf import MOMENTS, Urdf

_MUJOCO_READS = (".stl", ".obj", ".msh")
_MOST = 200_000_000  # bytes of a mesh file
_READ = ("stl", "obj", "dae", "ply", "off")  # no archives, whose size is unknown
_MOST_COPIES = 100_000  # of nodes in a COLLADA file


def share_dir() -> Path | None:
    """Return the folder that `package://example-robot-data/...` is relative to, if installed."""
    import importlib.metadata  # 15 ms, a tenth of what `import approxjac` costs

    try:
        distribution = importlib.metadata.distribution("example-robot-data")
    except importlib.metadata.PackageNotFoundError:
        return None
    share = Path(str(distribution.locate_file("cmeel.prefix/share")))
    return share if (share / "example-robot-data" / "robots").is_dir() else None


def find_mesh(filename: str, urdf_dir: Path | None) -> Path | None:
    """Return the file of a URDF's mesh name, searched as ROS finds packages, or None."""
    if filename.startswith("package://"):
        relative = filename.removeprefix("package://")
        roots = [urdf_dir, *urdf_dir.parents] if urdf_dir is not None else []
        roots += [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p]
        roots += filter(None, [share_dir()])
    else:
        relative = filename.removeprefix("file://")
        roots = [Path("/") if urdf_dir is None else urdf_dir]
    candidates = (root / relative for root in roots)
    # unlike Path.is_file, of any name
    return next((file.resolve() for file in candidates if os.path.isfile(file)), None)


def read_mesh(path: Path) -> Any:
    """Read the triangles of a mesh file with trimesh, without textures.

    Raises a ValueError for another kind of file, or one over 200 MB, and trimesh's own errors.
    """
    trimesh = package_of("view", "trimesh")
    kind, size = path.suffix.lower().removeprefix("."), path.stat().st_size
    if kind not in _READ:
        raise ValueError(f"its type must be one of {', '.join(_READ)}, not {path.suffix[:20]!r}")
    if size > _MOST:
        raise ValueError(f"it has {size} bytes, more than {_MOST}")
    with path.open("rb") as file:
        if file.read(2) == b"PK":
            raise ValueError("it is an archive")
        file.seek(0)
        if kind == "dae":
            _require_few_copies(file)
            file.seek(0)
        # from a stream, with which readers find no other files
        return trimesh.load(file, file_type=kind, force="mesh", process=False)


def _require_few_copies(file: IO[bytes]) -> None:
    """Refuse a COLLADA file whose nodes hold nodes twice, and these, …: it would be without end."""
    nodes = list(etree.parse(file).iter("{*}node"))
    holding = {f"#{node.get('id')}": node for node in nodes}
    known: dict[str | None, int] = {}

    def copies(name: str | None) -> int:
        if name not in known:
            known[name] = _MOST_COPIES  # should it hold itself
            inside = [] if name not in holding else holding[name].iter("{*}instance_node")
            known[name] = 1 + sum(copies(each.get("url")) for each in inside)
        return known[name]

    total = sum(copies(each.get("url")) for node in nodes for each in node.iter("{*}instance_node"))
    if total >= _MOST_COPIES:
        raise ValueError(f"its nodes are copied {total} times, more than {_MOST_COPIES}")


def for_other_tools(urdf: Urdf, urdf_dir: Path | None, path: Path) -> None:
    """Change a URDF to open alike in Pinocchio, MuJoCo, MeshCat and yourdfpy, saved at `path`.

    Unless it already has options for MuJoCo, it gets some: links on fixed joints stay bodies, so
    that the tip frame is not lost, and shapes add no mass.
    """
    root, folder = urdf.root, path.with_name(f"{path.stem}_meshes")
    converted: dict[Path, Path] = {}
    for mesh in root.iter("mesh"):
        file = find_mesh(mesh.get("filename", ""), urdf_dir)
        if file is None:
            continue
        collides = mesh.getparent().getparent().tag == "collision"
        if collides and file.suffix.lower() not in _MUJOCO_READS:
            if file not in converted:
                name = f"{len(converted)}_{file.stem}.stl"  # two meshes may share a name
                converted[file] = _to_stl(file, (folder / name).resolve())
            file = converted[file]
        mesh.set("filename", str(file))
    moves = urdf.moved_links
    # MuJoCo refuses inertias that no body can have also where they act on nothing
    for inertia in root.iterfind("link/inertial/inertia"):
        if not _possible(inertia) and inertia.getparent().getparent().get("name") not in moves:
            inertia.attrib.update(dict.fromkeys(MOMENTS, "0"))
    if root.find("mujoco") is None:
        compiler = E.compiler(fusestatic="false", strippath="false", inertiafromgeom="false")
        root.insert(0, E.mujoco(compiler))


def _possible(inertia: Any) -> bool:
    """Return True if principal moments are possible: none negative or above the others' sum."""
    xx, xy, xz, yy, yz, zz = (float(inertia.get(name)) for name in MOMENTS)
    small, middle, large = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    slack = 1e-9 * abs(large)
    return bool(small >= -slack and small + middle >= large - slack)


def _to_stl(mesh: Path, stl: Path) -> Path:
    """Convert a mesh file to STL and return the new file."""
    try:
        stl.parent.mkdir(parents=True, exist_ok=True)
        read = read_mesh(mesh)
        with replaced(stl) as unfinished:
            read.export(unfinished)
    except Exception as error:  # each of trimesh's readers raises its own
        message = f"collision mesh {mesh} cannot be converted to {stl}: {error}"
        raise UrdfError(message, given=mesh) from error
    return stl
