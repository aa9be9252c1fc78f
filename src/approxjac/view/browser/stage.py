"""A scene as MeshCat commands: arms, cameras, markers and what is around them."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from approxjac.robots import Robot
from approxjac.simulation.scene import Scene
from approxjac.tasks import Task
from approxjac.tasks.analysis import features
from approxjac.validation import Array
from approxjac.view.browser.cameras import camera_view
from approxjac.view.browser.viewpoint import reach_points
from approxjac.view.packages import view_package
from approxjac.view.style import COLORS
from approxjac.view.tree import Tree

if TYPE_CHECKING:
    from approxjac.view.look import Look

_GHOST = 0.38  # opacity of the believed arm
_GRID, _GRID_LINES = "#DDE1E6", 24
# what is seen through the arm, in which tips and joints often are
_THROUGH = {"side": 0, "transparent": True, "depthTest": False, "depthWrite": False}


class Stage:
    """Everything of a scene that is drawn once and then only moved.

    Args:
        scene: Who takes part.
        like: The stage of a scene with the same true robot, whose look is taken over.

    Attributes:
        size: Of the arm: the farthest that a link gets from the base [m].
        middle: Of where the arm reaches, shape (3,) [m].
        cameras: How cameras are drawn, as `camera_view` says, with "role" "true" or "believed"
            and "node", the path of what carries it.
        missing: What could not be drawn, and why.
        boxes: By role, link → points of the box around its shapes, in its frame, each (k, 3)
            [m].

    Raises:
        MissingPackageError: meshcat is not installed.
    """

    def __init__(self, scene: Scene, like: Stage | None = None) -> None:
        from approxjac.view.look import robot_look  # loads trimesh

        self._geometry = view_package("meshcat.geometry")
        self._commands = view_package("meshcat.commands")
        self._pack = view_package("umsgpack").packb
        self.scene = scene
        true = robot_look(scene.truth) if like is None else like._looks["true"]
        self._looks: dict[str, Look] = {"true": true}
        if scene.belief is not None:
            self._looks["believed"] = robot_look(scene.belief, like=(scene.truth, true))
        looks = self._looks.values()
        self.missing = tuple(dict.fromkeys(text for look in looks for text in look.missing))
        self.boxes = {role: _boxes(look) for role, look in self._looks.items()}
        around = reach_points(scene.truth)
        self.middle: Array = 0.5 * (around.min(axis=0) + around.max(axis=0))
        self.size = float(np.linalg.norm(around, axis=1).max())
        self._trees = {"true": Tree(scene.truth, "true")}
        if scene.belief is not None:
            self._trees["believed"] = Tree(scene.belief, "believed")
        self.cameras = [
            camera | {"role": role, "node": self._node(role, camera["mount"])}
            for role, task in (("true", scene.sensor), ("believed", scene.task))
            if role in self._trees
            for camera in [
                camera_view(
                    next((f for f in features(task) if f.camera is not None), None),
                    self.size,
                    self.middle,
                )
            ]
            if camera is not None
        ]

    def data(self, *roles: str) -> dict[str, Any]:
        """What page.js builds the scene from: texts, numbers, lists and dictionaries.

        Args:
            roles: "true" and "believed", which is both by default. `approxjac.redraw` of a page
                that has the true robot takes `data("believed")`, when the belief has changed.
        """
        roles = tuple(role for role in roles or ("true", "believed") if role in self._trees)
        commands: list[bytes] = []
        built: dict[str, Any] = {"roles": roles, "clones": [], "missing": list(self.missing)}
        if "true" in roles:
            built["links"] = self._true_arm(self._looks["true"], commands)
            self._markers(commands)
            self._points("true", self.scene.sensor, commands)
        if "believed" in roles:
            built["clones"] = self._ghost(self._looks, commands)
            self._points("believed", self.scene.task, commands)
        cameras = [camera for camera in self.cameras if camera["role"] in roles]
        for camera in cameras:
            self._camera(camera, commands)
        return built | {
            "commands": [base64.b64encode(c).decode() for c in commands],
            "joints": {role: _joints(self._trees[role]) for role in roles},
            "cameras": [_listed(camera) for camera in cameras],
        }

    # -- parts --------------------------------------------------------------------------

    def _true_arm(self, look: Look, commands: list[bytes]) -> list[dict[str, Any]]:
        """Draw the true arm; returns its shapes, whose colours show the state of their joint."""
        tree, links = self._trees["true"], []
        objects = _objects(self.scene.truth)
        for link, shapes in look.shapes.items():
            colour = COLORS["object"] if link in objects else COLORS["arm"]
            for i, shape in enumerate(shapes):
                path = (*tree.paths[link], f"shape{i}")
                commands.append(self._mesh(path, shape, colour))
                links.append({"path": path, "driver": tree.drivers[link], "colour": colour})
        return links

    def _ghost(self, looks: Mapping[str, Look], commands: list[bytes]) -> list[dict[str, Any]]:
        """Draw the believed arm; shapes that the true arm has too are listed, not sent twice."""
        tree, true = self._trees["believed"], self._trees["true"]
        clones: list[dict[str, Any]] = []
        for link, shapes in looks["believed"].shapes.items():
            twins = looks["true"].shapes.get(link, ())
            for i, shape in enumerate(shapes):
                path = (*tree.paths[link], f"shape{i}")
                if i < len(twins) and twins[i] is shape:
                    clones.append({"from": (*true.paths[link], f"shape{i}"), "to": path})
                else:
                    commands.append(self._mesh(path, shape, COLORS["believed"], _GHOST))
        self._bones(commands)
        return clones

    def _bones(self, commands: list[bytes]) -> None:
        """Draw a rod along each link that the controller believes longer, shorter or bent.

        Wrong joint origins change no mesh: without it one would see gaps in the ghost only.
        """
        g, tree = self._geometry, self._trees["believed"]
        origins = {joint.name: joint.origin for joint in self._trees["true"].joints}
        for joint in tree.joints:
            end = joint.origin[:3, 3]
            length = float(np.linalg.norm(end))
            origin = origins.get(joint.name)
            if length < 1e-6 or (origin is not None and np.allclose(origin, joint.origin)):
                continue
            if joint.parent in _objects(self.scene.belief or self.scene.truth):
                continue  # an object is as long as it is believed to be
            material = g.MeshLambertMaterial(
                color=_number(COLORS["believed"]), opacity=0.8, **_THROUGH
            )
            rod = g.Mesh(g.Cylinder(length, 0.006 * self.size), material)
            path = (*tree.paths[joint.parent], f"bone_{len(commands)}")
            commands.append(self._object(path, rod, _along(end)))

    def _markers(self, commands: list[bytes]) -> None:
        """Draw the target, the tips and the arrow of the force, at the origin and of unit size."""
        g, r = self._geometry, 0.013 * self.size
        for name, radius, colour, opacity in (
            ("target", 2.0 * r, COLORS["target"], 0.65),
            ("believed_tip", r, COLORS["believed"], 1.0),
            ("measured", r, COLORS["measured"], 1.0),
            ("tip", r, COLORS["true"], 1.0),
        ):
            material = g.MeshLambertMaterial(color=_number(colour), opacity=opacity, **_THROUGH)
            commands.append(self._object((name,), g.Mesh(g.Sphere(radius), material)))
        black = g.MeshBasicMaterial(color=_number(COLORS["force"]), **_THROUGH)
        # three.js' cylinders lie along y; page.js turns and stretches them
        shaft = g.Cylinder(1.0, 0.35 * r)
        head = g.Cylinder(3.2 * r, radiusTop=0.0, radiusBottom=1.1 * r)
        commands.append(self._object(("force", "shaft"), g.Mesh(shaft, black)))
        commands.append(self._object(("force", "head"), g.Mesh(head, black)))

    def _points(self, role: str, task: Task | None, commands: list[bytes]) -> None:
        """Draw the points that a camera sees, of the world or of a frame of the arm."""
        g = self._geometry
        feature = next((f for f in features(task) if f.camera is not None), None)
        if feature is None or (feature.frame is not None and not feature.points.any()):
            return  # the tip, which has a marker
        if feature.frame is None and role == "believed":
            return  # points of the world are where they are
        colour = COLORS["true"] if role == "true" else COLORS["believed"]
        for k, point in enumerate(feature.points):
            placed = np.eye(4)
            placed[:3, 3] = point
            ball = g.Mesh(g.Sphere(0.01 * self.size), g.MeshLambertMaterial(color=_number(colour)))
            path = (*self._node(role, feature.frame), f"points_{role}", str(k))
            commands.append(self._object(path, ball, placed))

    def grid(self, normal: Array, points: Array) -> list[str]:
        """Commands of a thin grid through the base, across a direction.

        Args:
            normal: The direction, shape (3,): up, or the normal of the plane of a planar arm.
            points: What it shall reach under, shape (n, 3) [m].
        """
        g = self._geometry
        u = np.cross(normal, [0.0, 0.0, 1.0])
        u = u / np.linalg.norm(u) if np.linalg.norm(u) > 1e-6 else np.array([1.0, 0.0, 0.0])
        v = np.cross(normal, u)
        half = 1.1 * float(max(np.abs(points @ u).max(), np.abs(points @ v).max()))
        steps = np.array([1.0, 2.0, 5.0])
        choices = np.sort(np.outer(10.0 ** np.arange(-3, 4), steps).ravel())
        step = float(choices[np.searchsorted(choices, 2.0 * half / _GRID_LINES)])
        count = int(np.ceil(half / step))
        ticks = step * np.arange(-count, count + 1)
        end = ticks[-1]
        ends = [(a * u + s * end * v, a * v + s * end * u) for a in ticks for s in (-1.0, 1.0)]
        across = [e[0] for e in ends] + [e[1] for e in ends]
        material = g.LineBasicMaterial(color=_number(_GRID))
        lines = g.LineSegments(g.PointsGeometry(np.array(across, dtype=np.float32).T), material)
        command = self._object(("grid",), lines)
        return [base64.b64encode(command).decode()]

    def _camera(self, camera: dict[str, Any], commands: list[bytes]) -> None:
        """Draw a camera's pyramid and its image plane under the node that carries it."""
        g, role = self._geometry, camera["role"]
        colour = _number(COLORS["true"] if role == "true" else COLORS["believed"])
        corner, right, down = camera["corner"], camera["right"], camera["down"]
        corners = [corner, corner + right, corner + right + down, corner + down]
        edges = []
        for i, point in enumerate(corners):
            edges += [camera["apex"], point, point, corners[(i + 1) % 4]]
        lines = g.PointsGeometry(np.array(edges, dtype=np.float32).T)
        path = (*camera["node"], f"camera_{role}")
        material = g.LineBasicMaterial(color=colour)
        commands.append(self._object((*path, "edges"), g.LineSegments(lines, material)))
        plane = g.TriangularMeshGeometry(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]))
        glass = g.MeshBasicMaterial(color=colour, opacity=0.10, depthWrite=False)
        commands.append(self._object((*path, "image"), g.Mesh(plane, glass)))

    def _mesh(self, path: tuple[str, ...], shape: Any, colour: str, opacity: float = 1.0) -> bytes:
        g = self._geometry
        material = g.MeshLambertMaterial(
            color=_number(colour), opacity=opacity, depthWrite=opacity == 1.0
        )
        mesh = g.TriangularMeshGeometry(shape.vertices, shape.faces.astype(np.int32))
        return self._object(path, g.Mesh(mesh, material))

    def _object(self, path: tuple[str, ...], thing: Any, placed: Array | None = None) -> bytes:
        """A command that puts a thing at a node, as it is or placed (4, 4) in the node's axes."""
        # MeshCat's own are random; they need to be unique within a command only
        thing.uuid, thing.geometry.uuid, thing.material.uuid = "object", "geometry", "material"
        command = self._commands.SetObject(thing).lower() | {"path": "/".join(path)}
        if placed is not None:
            command["object"]["object"]["matrix"] = placed.T.ravel().tolist()
        packed: bytes = self._pack(command)
        return packed

    def _node(self, role: str, mount: str | None) -> tuple[str, ...]:
        return () if mount is None else self._trees[role].paths[mount]


def _number(colour: str) -> int:
    return int(colour[1:], 16)


def _joints(tree: Tree) -> list[dict[str, Any]]:
    return [
        {
            "path": tree.paths[joint.child],
            "kind": joint.kind,
            "origin": joint.origin.T.ravel().tolist(),  # columns first, as three.js has them
            "axis": joint.axis.tolist(),
            "column": joint.column,
        }
        for joint in tree.joints
    ]


def _boxes(look: Look) -> dict[str, Array]:
    """The box around each link's shapes: corners, middles of edges and faces, (27, 3)."""
    found = {}
    for link, shapes in look.shapes.items():
        vertices = np.concatenate([shape.vertices for shape in shapes])
        ends = vertices.min(axis=0), np.median(vertices, axis=0), vertices.max(axis=0)
        found[link] = np.array(list(product(*zip(*ends, strict=True))))
    return found


def _along(end: Array) -> Array:
    """Placement (4, 4) of a cylinder of three.js, which lies along y, from the origin to `end`."""
    y = end / np.linalg.norm(end)
    x = np.cross(y, np.eye(3)[np.abs(y).argmin()])
    x = x / np.linalg.norm(x)
    placed = np.eye(4)
    placed[:3] = np.column_stack([x, y, np.cross(x, y), 0.5 * end])
    return placed


def _objects(robot: Robot) -> set[str]:
    """Links that `Robot.with_object` made: they carry a link and a joint named after them."""
    links = set(robot.frame_names)
    return {n for n in links if f"{n}_tip" in links and f"{n}_tip_joint" in links}


def _listed(camera: dict[str, Any]) -> dict[str, Any]:
    return {
        key: value.tolist() if isinstance(value, np.ndarray) else value
        for key, value in camera.items()
    }
