"""What each link of a robot looks like: a stand-in, until the real one with meshes is merged."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.robots import Robot
from approxjac.robots import urdf as urdf_xml


class Shape(NamedTuple):
    """A triangle mesh in a link's frame: vertices (n, 3) [m] and faces (f, 3)."""

    vertices: Any
    faces: Any


class Look(NamedTuple):
    """Shapes of each link, and what could not be drawn, each with its reason."""

    shapes: Mapping[str, tuple[Shape, ...]]
    missing: tuple[str, ...]


def robot_look(robot: Robot) -> Look:
    """Boxes, cylinders and spheres of the URDF; capsules for what has meshes."""
    import trimesh

    root = urdf_xml.parse(robot.urdf, robot.name)
    found: dict[str, list[Shape]] = {}
    for link in root.iterfind("link"):
        for visual in link.iterfind("visual"):
            origin, shape = visual.find("origin"), visual.find("geometry")[0]
            placed = np.eye(4)
            if origin is not None:
                rpy = [float(x) for x in origin.get("rpy", "0 0 0").split()]
                placed[:3, :3] = pin.rpy.rpyToMatrix(*rpy)
                placed[:3, 3] = [float(x) for x in origin.get("xyz", "0 0 0").split()]
            if shape.tag == "box":
                mesh = trimesh.creation.box([float(x) for x in shape.get("size").split()])
            elif shape.tag == "cylinder":
                radius, length = float(shape.get("radius")), float(shape.get("length"))
                if not (radius and length):
                    continue
                mesh = trimesh.creation.cylinder(radius, length)
            elif shape.tag == "sphere":
                mesh = trimesh.creation.icosphere(radius=float(shape.get("radius")))
            else:
                continue
            mesh.apply_transform(placed)
            found.setdefault(link.get("name"), []).append(Shape(mesh.vertices, mesh.faces))
    joints = urdf_xml.read(root, robot.name).robot.joints
    for joint in joints:
        end = np.eye(4) if joint.origin is None else joint.origin
        length = float(np.linalg.norm(end[:3, 3]))
        if joint.parent in found and len(root.findall("link/visual/geometry/mesh")) == 0:
            continue
        if length > 0.02:
            mesh = trimesh.creation.cylinder(0.03, segment=[np.zeros(3), end[:3, 3]])
            found.setdefault(joint.parent, []).append(Shape(mesh.vertices, mesh.faces))
    shapes = {link: tuple(parts) for link, parts in found.items()}
    return Look(shapes, ())
