"""A scene as MeshCat commands: arms, cameras, markers and what is around them."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from approxjac.cameras import PinholeCamera, PlanarCamera
from approxjac.errors import package_of
from approxjac.robots import Robot
from approxjac.robots.model import own_joints
from approxjac.simulation.trajectory import Scene
from approxjac.tasks import Task
from approxjac.tasks.analysis import image_feature
from approxjac.validation import Array, plane_rows
from approxjac.view.style import COLORS
from approxjac.view.tree import Tree, held_objects

if TYPE_CHECKING:
    from approxjac.view.look import Look

_GHOST = 0.38  # opacity of the believed arm
_GRID, _GRID_LINES = "#DDE1E6", 24
_NEAR = 0.18  # to the image as it is drawn, of the way to what the camera looks at
_IN_HAND = 0.12  # the same of a camera on the arm, of the arm's size
_BEYOND = 1.3  # to the end of lines of sight, of the way to what the camera looks at
# what is seen through the arm, in which tips and joints often are
_THROUGH: Mapping[str, Any] = {
    "side": 0, "transparent": True, "depthTest": False, "depthWrite": False,
}  # fmt: skip


def _camera_view(task: Task | None, size: float, middle: Array) -> dict[str, Any] | None:
    """Return the drawing of a task's camera in the axes of its mount, or None.

    The image coordinates X are at `corner` + a `right` + b `down` with (a, b) = (X − low)/(high −
    low), without lens distortion. `reach` is how far lines of sight go, in distances of the image.
    The arm has a size, and its middle (3,) in the world [m].
    """
    feature = image_feature(task)
    camera = None if feature is None else feature.camera
    near, reach = _NEAR, _BEYOND / _NEAR

    def corners(low: Array, high: Array) -> Array:
        return np.array([low, (high[0], low[1]), (low[0], high[1])])

    if isinstance(camera, PinholeCamera):
        R, apex = camera.placement()
        f, c = np.array(camera.focal_length), np.array(camera.center, dtype=float)
        low, high = np.array([-0.5, -0.5]), np.array(camera.size) - 0.5
        near *= float(np.linalg.norm(middle - apex))
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
        normal = np.cross(*np.eye(3)[rows])
        apex = (camera.distance - camera.focal_length) * normal
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

    With the stage of a scene with the same true robot as `like`, its look is taken over. Robots are
    known by their role, "true" and, if there is one, "believed".
    """

    def __init__(self, scene: Scene, like: Stage | None = None) -> None:
        _Drawing()  # for its error
        from approxjac.view.look import robot_look  # loads trimesh and yourdfpy

        self.scene = scene
        self.robots = {"true": scene.truth}
        true = robot_look(scene.truth) if like is None else like._looks["true"]
        self._looks: dict[str, Look] = {"true": true}
        if scene.belief is not None:
            self.robots["believed"] = scene.belief
            self._looks["believed"] = robot_look(scene.belief, like=(scene.truth, true))
        self._trees = {role: Tree(robot, role) for role, robot in self.robots.items()}
        self.boxes = {role: _boxes(look) for role, look in self._looks.items()}  # around links
        around = reach_points(scene.truth)
        middle = 0.5 * (around.min(axis=0) + around.max(axis=0))
        self.size = float(np.linalg.norm(around, axis=1).max())  # the farthest that a link gets
        self._tasks = {"true": scene.sensor, "believed": scene.task}
        self.cameras = []  # as they are drawn, with the path of the node that carries each
        for role in self.robots:
            camera = _camera_view(self._tasks[role], self.size, middle)
            if camera is not None:
                node = self._node(role, camera["mount"])
                self.cameras.append(camera | {"role": role, "node": node})

    @property
    def differs(self) -> bool:
        """Return True where the believed arm or camera differs from the true one."""
        if "believed" not in self.robots:
            return False
        true, believed = (
            {joint.name: np.append(joint.origin, joint.axis) for joint in self._trees[role].joints}
            for role in ("true", "believed")
        )
        if true.keys() != believed.keys():
            return True
        pairs = [(true[name], believed[name]) for name in true]
        views = {camera["role"]: camera for camera in self.cameras}
        if len(views) == 2:
            names = ("apex", "corner", "right", "down", "low", "high")
            pairs += [(views["true"][name], views["believed"][name]) for name in names]
        return any(not np.allclose(one, other, atol=1e-9) for one, other in pairs)

    @property
    def ground(self) -> Array:
        """Return the base's origin and corners of what of the true robot is fixed, (n, 3) [m]."""
        drivers, robot = self._trees["true"].drivers, self.robots["true"]
        boxes = {link: box for link, box in self.boxes["true"].items() if drivers[link] < 0}
        fixed = link_points(robot, robot.neutral()[np.newaxis], boxes)
        return np.concatenate([np.zeros((1, 3)), fixed])

    def data(self, *roles: str) -> dict[str, Any]:
        """Return the scene as page.js builds it, by default of both roles.

        `approxjac.redraw` of a page takes `data("believed")`, when the belief has changed.
        """
        roles = roles or tuple(self.robots)
        missing = dict.fromkeys(text for look in self._looks.values() for text in look.missing)
        drawing = _Drawing()
        built: dict[str, Any] = {
            "roles": roles, "missing": list(missing), "links": [], "clones": [], "cameras": [],
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
        for link, shapes in self._looks[role].shapes.items():
            twins = self._looks["true"].shapes.get(link, ())
            colour = COLORS["object" if link in objects else "arm"]
            for i, shape in enumerate(shapes):
                path = (*tree.paths[link], f"shape{i}")
                if role == "true":
                    drawing.mesh(path, shape.vertices, shape.faces, colour)
                    driver = tree.drivers[link]
                    built["links"].append({"path": path, "driver": driver, "colour": colour})
                elif i < len(twins) and twins[i] is shape:
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
        material = g.MeshLambertMaterial if lit else g.MeshBasicMaterial
        self._put(path, g.Mesh(shape, material(**look)), colour, placed)

    def mesh(
        self, path: tuple[str, ...], vertices: Array, faces: Any, colour: str, **look: Any
    ) -> None:
        """Put triangles at a node."""
        triangles = self.geometry.TriangularMeshGeometry(vertices, np.array(faces, dtype=np.int32))
        self.put(path, triangles, colour, **look)

    def lines(self, path: tuple[str, ...], ends: Array, colour: str) -> None:
        """Put lines at a node, from each first of two points (n, 3) to the second."""
        g = self.geometry
        points = g.PointsGeometry(np.array(ends, dtype=np.float32).T)
        self._put(path, g.LineSegments(points, g.LineBasicMaterial()), colour)

    def _put(
        self, path: tuple[str, ...], thing: Any, colour: str, placed: Array | None = None
    ) -> None:
        thing.material.color = int(colour[1:], 16)  # as three.js counts it
        # MeshCat's own are random; they need to be unique within a command only
        thing.uuid, thing.geometry.uuid, thing.material.uuid = "object", "geometry", "material"
        command = self._commands.SetObject(thing).lower() | {"path": "/".join(path)}
        if placed is not None:
            command["object"]["object"]["matrix"] = placed.T.ravel().tolist()
        self.commands.append(base64.b64encode(self._pack(command)).decode())


def grid(normal: Array, points: Array, ground: Array) -> list[str]:
    """Return commands of a thin grid across normal (3,), as wide as points (n, 3) [m].

    It goes through the base, or under what of the robot is fixed, at the lowest of ground (k, 3).
    """
    u = np.cross(normal, [0.0, 0.0, 1.0])
    u = u / np.linalg.norm(u) if np.linalg.norm(u) > 1e-6 else np.array([1.0, 0.0, 0.0])
    v = np.cross(normal, u)
    half = 1.1 * float(max(np.abs(points @ u).max(), np.abs(points @ v).max()))
    choices = np.sort(np.outer(10.0 ** np.arange(-3, 4), [1.0, 2.0, 5.0]).ravel())
    step = float(choices[np.searchsorted(choices, 2.0 * half / _GRID_LINES)])
    count = int(np.ceil(half / step))
    ticks = step * np.arange(-count, count + 1)
    ends = [(a, s * ticks[-1]) for a in ticks for s in (-1.0, 1.0)]
    across = [a * u + b * v for a, b in ends] + [a * v + b * u for a, b in ends]
    drawing = _Drawing()
    level = min(0.0, float((ground @ normal).min())) if abs(normal[2]) > 0.9 else 0.0
    drawing.lines(("grid",), np.array(across) + level * normal, _GRID)
    return drawing.commands


def _draw_camera(camera: dict[str, Any], drawing: _Drawing) -> None:
    """Draw a camera's pyramid and its image plane under the node that carries it."""
    colour, path = COLORS[camera["role"]], (*camera["node"], f"camera_{camera['role']}")
    corner, right, down = camera["corner"], camera["right"], camera["down"]
    corners = np.array([corner, corner + right, corner + right + down, corner + down])
    apexes, following = np.tile(camera["apex"], (4, 1)), np.roll(corners, -1, axis=0)
    edges = np.stack([apexes, corners, corners, following], axis=1).reshape(16, 3)
    drawing.lines((*path, "edges"), edges, colour)
    glass: dict[str, Any] = {"lit": False, "opacity": 0.10, "depthWrite": False}
    drawing.mesh((*path, "image"), corners, [[0, 1, 2], [0, 2, 3]], colour, **glass)


def _boxes(look: Look) -> dict[str, Array]:
    """Return the box around each link's shapes: corners, middles of edges and faces, (27, 3)."""
    boxes = {}
    for link, shapes in look.shapes.items():
        vertices = np.concatenate([shape.vertices for shape in shapes])
        ends = vertices.min(axis=0), np.median(vertices, axis=0), vertices.max(axis=0)
        boxes[link] = np.array(list(product(*zip(*ends, strict=True))))
    return boxes


_INSTANTS = 40  # of a run, whose configurations must all be in view
_SIDE = np.deg2rad(28.0)  # past cameras, which would be looked at from behind otherwise
_ABOVE = np.deg2rad(18.0)
_PARALLEL = 1e-6


def link_points(robot: Robot, q: Array, boxes: Mapping[str, Array]) -> Array:
    """Return points of links (k, 3), each in its frame, at some of the q (N, nq); (n, 3) [m]."""
    data = robot.model.createData()
    points: list[Array] = [np.zeros((0, 3))]
    every = max(1, len(q) // _INSTANTS)
    for row in [*q[::every], *q[-1:]]:
        pin.framesForwardKinematics(robot.model, data, row)
        for link, own in boxes.items():
            placed = data.oMf[robot.frame_id(link)]
            points.append(own @ placed.rotation.T + placed.translation)
    return np.concatenate(points)


def reach_points(robot: Robot) -> Array:
    """Return origins of all links in seeded random configurations, shape (n, 3) [m]."""
    rng, origins = np.random.default_rng(0), dict.fromkeys(robot.frame_names, np.zeros((1, 3)))
    drawn = [robot.random_configuration(rng) for _ in range(_INSTANTS)]
    return link_points(robot, np.array(drawn), origins)


def viewpoint(
    robot: Robot,
    moving: Array,
    points: Array,
    cameras: Sequence[Mapping[str, Any]],
    marker: float,
) -> dict[str, Any]:
    """Return from where to look at moving points (n, 3), with others (N, 3) in view [m].

    What moves is drawn with a marker of that radius [m].
    Cameras in the world, as the `Stage` has them, are to be in view, too. "direction" is a unit
    vector towards the eye, "normal" that of the plane that the arm moves in, or else up.
    """
    cameras = [camera for camera in cameras if camera["mount"] is None]
    stands = [camera["apex"] for camera in cameras]
    ends = product(cameras, (0.0, 1.0), (0.0, 1.0))
    corners = [c["corner"] + a * c["right"] + b * c["down"] for c, a, b in ends]
    points = np.array([*points, *stands, *corners])
    normal = _plane_normal(robot)
    if normal is None:
        middles = [c["corner"] + 0.5 * (c["right"] + c["down"]) - c["apex"] for c in cameras]
        direction = _widest(moving, points, stands, middles)
    elif stands:  # from beside them
        turn = pin.exp3(np.array([0.0, 0.0, _SIDE]))
        direction = turn @ (np.cos(_ABOVE) * normal + np.array([0.0, 0.0, np.sin(_ABOVE)]))
    else:  # a floor plan is looked at from its near side
        direction = normal + np.array([0.0, -0.8 if abs(normal[2]) > 0.9 else 0.0, 0.0])
    there = moving[np.isfinite(moving).all(axis=1)]
    steps = marker * np.concatenate([np.eye(3), -np.eye(3)])
    points = np.concatenate([points, (there[:, np.newaxis] + steps).reshape(-1, 3)])
    # those that are the farthest in some of many directions
    ways = np.random.default_rng(0).normal(size=(300, 3))
    return {
        "direction": direction / np.linalg.norm(direction),
        "points": points[np.unique(np.argmax(points @ ways.T, axis=0))],
        "normal": normal if normal is not None else np.array([0.0, 0.0, 1.0]),
    }


def _plane_normal(robot: Robot) -> Array | None:
    """Return the normal of the plane that an arm moves in, (3,); None of those in space."""
    model, data = robot.model, robot.model.createData()
    J = pin.computeJointJacobians(model, data, robot.neutral()).T
    J = J[[joint.idx_v for joint in own_joints(model).values()]]
    turning = np.linalg.norm(J[:, 3:], axis=1) > 0.5
    if not turning.any():
        return None
    normal = np.asarray(J[turning, 3:][0])
    if (np.linalg.norm(np.cross(J[turning, 3:], normal), axis=1) > _PARALLEL).any():
        return None
    if (np.abs(J[~turning, :3] @ normal) > _PARALLEL).any():
        return None
    # from where x points right, and z up; else from above
    return normal if normal @ np.array([0.1, -1.0, 0.3]) > 0.0 else -normal


def _widest(moving: Array, points: Array, stands: Sequence[Array], views: Sequence[Array]) -> Array:
    """Return the direction from which motion, arm and cameras lie widest apart, shape (3,).

    Of cameras, which stand somewhere and view a direction, each (3,), one sees most from half
    beside them: neither their image from its edge nor all that they look at behind it. The arm
    shall not stand before what moves.
    """
    moving = moving[np.isfinite(moving).all(axis=1)]
    around, spread = np.array([points.mean(axis=0), *stands]), float(np.std(points))
    azimuths = np.deg2rad(range(-165, 195, 15))
    c, s = np.cos(azimuths), np.sin(azimuths)
    towards, rights = np.array([c, s, np.tan(_ABOVE) + 0.0 * c]).T, np.array([-s, c, 0.0 * c])
    width = 1e-3 * np.cos(azimuths + np.pi / 4)  # of two that are equal, that in front of the arm
    for each, weight in ((moving, 1.0), (points, 0.15), (around, 0.15)):
        if len(each) > 1:
            width += weight * np.std(each @ rights, axis=0)
    for view in views:
        along = np.abs(view[:2] @ rights[:2]) / np.linalg.norm(view)
        width -= 0.3 * spread * np.abs(along - 0.75)
    width -= [spread * _hidden(moving, points, each) for each in towards]
    return np.asarray(towards[width.argmax()])


def _hidden(moving: Array, points: Array, towards: Array) -> float:
    """Return about which share of what moves is behind the arm, for an eye towards (3,)."""
    towards = towards / np.linalg.norm(towards)
    some = moving[:: max(1, len(moving) // 20)]
    ways = points[:: max(1, len(points) // 2000), np.newaxis] - some
    depth = ways @ towards
    aside = np.linalg.norm(ways - depth[..., np.newaxis] * towards, axis=2)
    near = 0.2 * float(np.std(points))
    return float(((depth > 2.0 * near) & (aside < near)).any(axis=0).mean())
