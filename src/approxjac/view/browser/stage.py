"""A scene as MeshCat commands: arms, cameras, markers and what is around them."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin
from matplotlib.ticker import MaxNLocator

from approxjac.cameras import PinholeCamera, PlanarCamera
from approxjac.errors import package_of
from approxjac.robots import Robot
from approxjac.simulation.trajectory import Scene
from approxjac.tasks import Task
from approxjac.tasks.analysis import image_feature
from approxjac.validation import Array, plane_rows
from approxjac.view.style import COLORS
from approxjac.view.tree import Tree, held_objects

_GHOST = 0.38  # opacity of the believed arm
_GRID, _GRID_LINES = "#DDE1E6", 24
_INSTANTS = 40  # of a run, whose configurations must all be in view
_AROUND = 0.1  # of an arm's size: how thick links are
_FRONT, _ASIDE = np.array([0.1, -1.0, 0.3]), np.array([0.3, -0.3, 0.35])
_NEAR = 0.18  # to the image as it is drawn, of the way to what the camera looks at
_IN_HAND = 0.12  # the same of a camera on the arm, of the arm's size
_BEYOND = 1.3  # to the end of lines of sight, of the way to what the camera looks at
# what is seen through the arm, in which tips and joints often are
_THROUGH: Mapping[str, Any] = {
    "side": 0, "transparent": True, "depthTest": False, "depthWrite": False,
}  # fmt: skip


def _camera_view(task: Task | None, size: float) -> dict[str, Any] | None:
    """Return the drawing of a task's camera in the axes of its mount, or None."""
    # image coordinates X are at corner + a right + b down with (a, b) = (X − low)/(high − low),
    # without lens distortion; lines of sight go on to `reach` distances of the image
    feature = image_feature(task)
    camera = None if feature is None else feature.camera
    near, reach = _NEAR, _BEYOND / _NEAR

    def corners(low: Array, high: Array) -> Array:
        return np.array([low, (high[0], low[1]), (low[0], high[1])])

    if isinstance(camera, PinholeCamera):
        R, apex = camera.placement()
        f, c = np.array(camera.focal_length), np.array(camera.center, dtype=float)
        low, high = np.array([-0.5, -0.5]), np.array(camera.size) - 0.5
        near *= max(size, float(np.linalg.norm(apex)))
        if camera.mount is not None:
            near, reach = _IN_HAND * size, 0.5 / _IN_HAND
        rays = np.column_stack([(corners(low, high) - c) / f, np.ones(3)]) @ R.T
    elif isinstance(camera, PlanarCamera):
        # it sees without end: its image is as large as the arm, and it stands over the middle of
        # that, at the depth z − f of the equal pinhole camera
        rows, center = plane_rows(camera.plane), np.array(camera.offset)
        J = camera.interaction(np.zeros(3))[:, rows]
        half = 1.05 * size * camera.magnification * np.array([1.0, -1.0])  # y_s points up
        low, high = center - half, center + half
        apex = (camera.distance - camera.focal_length) * np.cross(*np.eye(3)[rows])
        on_plane = np.linalg.solve(J, (corners(low, high) - center).T)
        rays = on_plane.T @ np.eye(3)[rows] - apex
    else:
        return None
    corner, right, down = apex + near * rays
    return {
        "apex": apex, "corner": corner, "right": right - corner, "down": down - corner,
        "low": low, "high": high, "reach": reach, "mount": camera.mount,
    }  # fmt: skip


class Stage:
    """Everything of a scene that is drawn once and then only moved.

    Robots are known by their role, "true" and, if there is one, "believed".
    """

    def __init__(self, scene: Scene) -> None:
        _Drawing()  # for its error
        from approxjac.view.look import robot_look  # loads trimesh and yourdfpy

        self.scene = scene
        self.robots = {"true": scene.truth}
        if scene.belief is not None:
            self.robots["believed"] = scene.belief
        looks = {role: robot_look(each) for role, each in self.robots.items()}
        self._shapes = {role: shapes for role, (shapes, _) in looks.items()}
        self._missing = list(dict.fromkeys(text for _, texts in looks.values() for text in texts))
        self._trees = {role: Tree(robot, role) for role, robot in self.robots.items()}
        q = np.array([*scene.truth.configurations(_INSTANTS)])
        # the farthest that a link gets
        self.size = float(np.linalg.norm(frame_points(scene.truth, q), axis=1).max())
        self._tasks = {"true": scene.sensor, "believed": scene.task}
        self.cameras = []  # as they are drawn, with the path of the node that carries each
        for role in self.robots:
            camera = _camera_view(self._tasks[role], self.size)
            if camera is not None:
                node = self._node(role, camera["mount"])
                self.cameras.append(camera | {"role": role, "node": node})

    @property
    def differs(self) -> bool:
        """True if the believed arm or camera differs from the true one."""
        if "believed" not in self.robots:
            return False
        parts = []
        for role, tree in self._trees.items():
            joints = [np.append(joint.origin, joint.axis) for joint in tree.joints]
            views = [camera for camera in self.cameras if camera["role"] == role]
            names = ("apex", "corner", "right", "down", "low", "high")
            joints += [view[name] for view in views for name in names]
            parts.append(np.concatenate(joints))
        one, other = parts
        return one.shape != other.shape or not np.allclose(one, other, atol=1e-9)

    @property
    def floor(self) -> float:
        """Height of the lowest frame that does not move [m]."""
        frames = self.scene.truth.model.frames
        return min(float(f.placement.translation[2]) for f in frames if f.parentJoint == 0)

    @property
    def camera_points(self) -> Array:
        """Positions of cameras in the world and corners of their images, shape (n, 3) [m]."""
        views = [camera for camera in self.cameras if camera["mount"] is None]
        corners = [np.vstack([camera["apex"], _image_corners(camera)]) for camera in views]
        return np.concatenate([np.zeros((0, 3)), *corners])

    def data(self, *roles: str) -> dict[str, Any]:
        """Return the scene as page.js builds it, by default of both roles.

        `approxjac.redraw` of a page takes `data("believed")`, when the belief has changed.
        """
        roles = roles or tuple(self.robots)
        drawing = _Drawing()
        built: dict[str, Any] = {
            "roles": roles, "missing": self._missing, "links": [], "clones": [], "cameras": [],
            "commands": drawing.commands, "differs": self.differs,
            "joints": {role: self._trees[role].listed() for role in roles},
        }  # fmt: skip
        for role in roles:
            self._arm(role, drawing, built)
            if role == "true":
                self._markers(drawing)
            else:
                self._bones(drawing)
            self._points(role, drawing)
        for camera in self.cameras:
            if camera["role"] in roles:
                _draw_camera(camera, drawing)
                listed = {name: np.asarray(value).tolist() for name, value in camera.items()}
                built["cameras"].append(listed)
        return built

    def _arm(self, role: str, drawing: _Drawing, built: dict[str, Any]) -> None:
        """Draw an arm; shapes that the believed one has as well are listed, not sent twice."""
        tree, true = self._trees[role], self._trees["true"]
        objects = held_objects(self.robots[role])
        ghost = {"opacity": _GHOST, "depthWrite": False}
        for link, shapes in self._shapes[role].items():
            twins = self._shapes["true"].get(link, ())
            colour = COLORS["object" if link in objects else "arm"]
            for i, shape in enumerate(shapes):
                path = (*tree.paths[link], f"shape{i}")
                if role == "true":
                    drawing.mesh(path, shape.vertices, shape.faces, colour)
                    driver = tree.drivers[link]
                    built["links"].append({"path": path, "driver": driver, "colour": colour})
                elif i < len(twins) and np.array_equal(twins[i].vertices, shape.vertices):
                    built["clones"].append({"from": (*true.paths[link], f"shape{i}"), "to": path})
                else:
                    drawing.mesh(path, shape.vertices, shape.faces, COLORS["believed"], **ghost)

    def _bones(self, drawing: _Drawing) -> None:
        """Draw a rod along each link believed of another length or bent: no mesh shows it."""
        tree = self._trees["believed"]
        origins = {joint.name: joint.origin for joint in self._trees["true"].joints}
        # an object is as long as it is believed to be
        objects = held_objects(self.robots["believed"])
        for joint in tree.joints:
            end, origin = joint.origin[:3, 3], origins.get(joint.name)
            length = float(np.linalg.norm(end))
            same = origin is not None and np.allclose(origin, joint.origin)
            if length >= 1e-6 and not same and joint.parent not in objects:
                rod = drawing.geometry.Cylinder(length, 0.006 * self.size)
                path = (*tree.paths[joint.parent], f"bone_{len(drawing.commands)}")
                turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 1.0, 0.0]), end)
                placed = pin.SE3(turn.matrix(), 0.5 * end).homogeneous  # three.js' lie along y
                look = {"opacity": 0.8, **_THROUGH}
                drawing.put(path, rod, COLORS["believed"], placed=placed, **look)

    def _markers(self, drawing: _Drawing) -> None:
        """Draw the target, the tips and the arrow of the force, at the origin and of unit size."""
        g, r = drawing.geometry, 0.013 * self.size
        drawing.put(("target",), g.Sphere(2.0 * r), COLORS["target"], opacity=0.65, **_THROUGH)
        for name, role in (("believed_tip", "believed"), ("measured", "measured"), ("tip", "true")):
            drawing.put((name,), g.Sphere(r), COLORS[role], **_THROUGH)
        # page.js turns and stretches them
        shaft, head = g.Cylinder(1.0, 0.35 * r), g.Cylinder(3.2 * r, 1.0, 0.0, 1.1 * r)
        for name, part in (("shaft", shaft), ("head", head)):
            drawing.put(("force", name), part, COLORS["force"], lit=False, **_THROUGH)

    def _points(self, role: str, drawing: _Drawing) -> None:
        """Draw the points that a camera sees, of the world or of a frame of the arm."""
        feature = image_feature(self._tasks[role])
        if feature is None or (feature.frame is not None and not feature.points.any()):
            return  # the tip, which has a marker
        if feature.frame is None and role == "believed":
            return  # points of the world are where they are
        for k, point in enumerate(feature.points):
            placed = np.eye(4)
            placed[:3, 3] = point
            ball = drawing.geometry.Sphere(0.01 * self.size)
            path = (*self._node(role, feature.frame), f"points_{role}", str(k))
            drawing.put(path, ball, COLORS[role], placed=placed)

    def _node(self, role: str, mount: str | None) -> tuple[str, ...]:
        return () if mount is None else self._trees[role].paths[mount]


class _Drawing:
    """MeshCat commands, each of which puts a thing at a node."""

    def __init__(self) -> None:
        self.geometry = package_of("view", "meshcat.geometry")
        self.commands: list[str] = []
        self._commands = package_of("view", "meshcat.commands")
        self._pack = package_of("view", "umsgpack").packb

    def put(
        self, path: tuple[str, ...], shape: Any, colour: str, *,
        placed: Array | None = None, lit: bool = True, **look: Any,
    ) -> None:  # fmt: skip
        """Put a geometry at a node, as it is or placed (4, 4) in the node's axes."""
        g = self.geometry
        if isinstance(shape, g.PointsGeometry):
            thing = g.LineSegments(shape, g.LineBasicMaterial())
        else:
            thing = g.Mesh(shape, (g.MeshLambertMaterial if lit else g.MeshBasicMaterial)(**look))
        thing.material.color = int(colour[1:], 16)  # as three.js counts it
        # MeshCat's own are random; they need to be unique within a command only
        thing.uuid, thing.geometry.uuid, thing.material.uuid = "object", "geometry", "material"
        command = self._commands.SetObject(thing).lower() | {"path": "/".join(path)}
        if placed is not None:
            command["object"]["object"]["matrix"] = placed.T.ravel().tolist()
        self.commands.append(base64.b64encode(self._pack(command)).decode())

    def mesh(
        self, path: tuple[str, ...], vertices: Array, faces: Any, colour: str, **look: Any
    ) -> None:
        """Put triangles at a node."""
        triangles = self.geometry.TriangularMeshGeometry(vertices, np.array(faces, dtype=np.int32))
        self.put(path, triangles, colour, **look)

    def lines(self, path: tuple[str, ...], ends: Array, colour: str) -> None:
        """Put lines at a node, from each first of two points (n, 3) to the second."""
        self.put(path, self.geometry.PointsGeometry(np.array(ends, dtype=np.float32).T), colour)


def grid(points: Array, floor: float) -> list[str]:
    """Return commands of a thin grid at the height of the floor, as wide as points (n, 3) [m]."""
    half = 1.1 * float(np.abs(points[:, :2]).max())
    ticks = np.array(MaxNLocator(_GRID_LINES).tick_values(-half, half))
    along = np.stack(np.meshgrid(ticks, ticks[[0, -1]], indexing="ij"), axis=-1)
    ends = np.concatenate([along, along[..., ::-1]]).reshape(-1, 2)
    drawing = _Drawing()
    drawing.lines(("grid",), np.column_stack([ends, np.full(len(ends), floor)]), _GRID)
    return drawing.commands


def _image_corners(camera: dict[str, Any]) -> Array:
    corner, right, down = camera["corner"], camera["right"], camera["down"]
    return np.array([corner, corner + right, corner + right + down, corner + down])


def _draw_camera(camera: dict[str, Any], drawing: _Drawing) -> None:
    """Draw a camera's pyramid and its image plane under the node that carries it."""
    colour, path = COLORS[camera["role"]], (*camera["node"], f"camera_{camera['role']}")
    corners = _image_corners(camera)
    apexes, following = np.tile(camera["apex"], (4, 1)), np.roll(corners, -1, axis=0)
    edges = np.stack([apexes, corners, corners, following], axis=1).reshape(16, 3)
    drawing.lines((*path, "edges"), edges, colour)
    glass: dict[str, Any] = {"lit": False, "opacity": 0.10, "depthWrite": False}
    drawing.mesh((*path, "image"), corners, [[0, 1, 2], [0, 2, 3]], colour, **glass)


def frame_points(robot: Robot, q: Array) -> Array:
    """Return the origins of all frames at some of the q (N, nq), shape (n, 3) [m]."""
    data, points = robot.model.createData(), []
    every = max(1, len(q) // _INSTANTS)
    for row in [*q[::every], *q[-1:]]:
        pin.framesForwardKinematics(robot.model, data, row)
        points += [placed.translation.copy() for placed in data.oMf]
    return np.array(points)


def viewpoint(moving: Array, points: Array, size: float) -> dict[str, Any]:
    """Return a viewpoint for moving points (n, 3), with other points (N, 3) in view [m].

    It looks, a little turned, along the direction in which the moving points, and with less weight
    the others, spread least; and it holds the outermost points, with a margin for an arm's `size`.
    """
    direction = np.linalg.eigh(np.cov(moving.T) + 0.15 * np.cov(points.T))[1][:, 0]
    # what moves is not to be behind the arm; and rather from the front than from behind
    towards = moving.mean(axis=0) - points.mean(axis=0) + 0.1 * np.std(points) * _FRONT
    direction = direction * np.copysign(1.0, direction @ towards) + _ASIDE
    direction[2] = max(direction[2], _ASIDE[2])
    ways = np.random.default_rng(0).normal(size=(300, 3))
    far = points[np.unique(np.argmax(points @ ways.T, axis=0))]
    out = far - points.mean(axis=0)
    far = far + _AROUND * size * out / np.linalg.norm(out, axis=1, keepdims=True)
    return {"direction": np.round(direction, 4).tolist(), "points": np.round(far, 4).tolist()}
