"""From where the page looks at a scene, so that nobody needs to turn it first."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.robots import Robot
from approxjac.robots.model import own_joints
from approxjac.validation import Array

_INSTANTS = 40  # of a run, whose postures must all be in view
_SIDE = np.deg2rad(28.0)  # past cameras, which would be looked at from behind otherwise
_ABOVE = np.deg2rad(18.0)
_PARALLEL = 1e-6


def link_points(robot: Robot, q: Array, boxes: Mapping[str, Array] | None = None) -> Array:
    """Where all links are at some of the configurations.

    Args:
        robot: The robot.
        q: Configurations, shape (N, nq).
        boxes: Link → points of it, in its own frame, each (k, 3) [m]; origins by default.

    Returns:
        Points of the world, shape (n, 3) [m].
    """
    if boxes is None:
        boxes = dict.fromkeys(robot.frame_names, np.zeros((1, 3)))
    data, points = robot.model.createData(), []
    every = max(1, len(q) // _INSTANTS)
    for row in [*q[::every], *q[-1:]]:
        pin.framesForwardKinematics(robot.model, data, row)
        for link, own in boxes.items():
            placed = data.oMf[robot.frame_id(link)]
            points.append(own @ placed.rotation.T + placed.translation)
    return np.concatenate(points)


def reach_points(robot: Robot) -> Array:
    """Origins of all links in seeded random postures, shape (n, 3) [m]."""
    rng = np.random.default_rng(0)
    return link_points(robot, np.array([robot.random_configuration(rng) for _ in range(_INSTANTS)]))


def plane_normal(robot: Robot) -> Array | None:
    """Normal of the plane that an arm moves in, shape (3,); None of those that move in space."""
    model = robot.model
    data = model.createData()
    q = robot.neutral()
    pin.computeJointJacobians(model, data, q)
    turns: list[Array] = []
    moves: list[Array] = []
    for joint in own_joints(model).values():
        J = pin.getJointJacobian(model, data, joint.id, pin.ReferenceFrame.WORLD)
        column = np.reshape(J, (6, -1))[:, joint.idx_v]
        (turns if np.linalg.norm(column[3:]) > 0.5 else moves).append(column)
    if not turns:
        return None
    normal: Array = turns[0][3:]
    for column in turns:
        if np.linalg.norm(np.cross(column[3:], normal)) > _PARALLEL:
            return None
    for column in moves:
        if abs(column[:3] @ normal) > _PARALLEL:
            return None
    # from where x points right, and z up; else from above
    side = 1.0 if normal @ np.array([0.1, -1.0, 0.3]) > 0.0 else -1.0
    return np.asarray(side * normal)


def viewpoint(
    robot: Robot, moving: Array, points: Array, cameras: list[dict[str, Any]]
) -> dict[str, Any]:
    """Where to look from, and at what.

    Args:
        robot: The true robot.
        moving: What the eye shall follow, such as the tip, the target; shape (n, 3) [m].
        points: What must be in view, shape (N, 3) [m].
        cameras: Those of `camera_view` that stand in the world.

    Returns:
        "direction", a unit vector towards the eye; "points", corners of what must be in view.
    """
    stands = [camera["apex"] for camera in cameras if camera["mount"] is None]
    corners = [
        camera["corner"] + a * camera["right"] + b * camera["down"]
        for camera in cameras
        if camera["mount"] is None
        for a in (0.0, 1.0)
        for b in (0.0, 1.0)
    ]
    points = np.array([*points, *stands, *corners])
    normal = plane_normal(robot)
    if normal is not None:
        direction = normal
        if stands:  # from beside them
            turn = pin.exp3(np.array([0.0, 0.0, _SIDE]))
            direction = turn @ (np.cos(_ABOVE) * normal + np.array([0.0, 0.0, np.sin(_ABOVE)]))
        elif abs(normal[2]) > 0.9:  # a floor plan is looked at from its near side
            direction = normal + np.array([0.0, -0.8, 0.0])
    else:
        views = [
            camera["corner"] + 0.5 * (camera["right"] + camera["down"]) - camera["apex"]
            for camera in cameras
            if camera["mount"] is None
        ]
        direction = _widest(moving, points, stands, views)
    return {
        "direction": direction / np.linalg.norm(direction),
        "points": _outermost(points),
        "normal": normal if normal is not None else np.array([0.0, 0.0, 1.0]),
    }


def _widest(moving: Array, points: Array, stands: list[Array], views: list[Array]) -> Array:
    """The direction from which the motion, the arm and the cameras lie widest apart.

    Of cameras one sees most from half beside them: neither their image from its edge nor all that
    they look at behind it. The arm shall not stand before what moves.

    Args:
        moving: What the eye shall follow, shape (n, 3) [m].
        points: What must be in view, shape (N, 3) [m].
        stands: Where cameras are, each (3,) [m].
        views: Where they look, each (3,).
    """
    moving = moving[np.isfinite(moving).all(axis=1)]
    parts = [(moving, 1.0), (points, 0.15), (np.array([points.mean(axis=0), *stands]), 0.15)]
    best, found = -np.inf, np.array([1.0, -1.0, 0.0])
    for degrees in range(-165, 195, 15):
        azimuth = np.deg2rad(degrees)
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        width = sum(weight * float(np.std(p @ right)) for p, weight in parts if len(p) > 1)
        for view in views:
            along = abs(float(view[:2] @ right[:2])) / float(np.linalg.norm(view))
            width -= 0.3 * float(np.std(points)) * abs(along - 0.75)
        width -= float(np.std(points)) * _hidden(moving, points, azimuth)
        # of two that show the same, the one in front of the arm
        width += 1e-3 * np.cos(azimuth + np.pi / 4)
        if width > best:
            best = width
            found = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(_ABOVE)])
    return found


def _hidden(moving: Array, points: Array, azimuth: float) -> float:
    """Share of what moves that is behind the arm, looked at from an azimuth [rad]; about."""
    towards = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(_ABOVE)])
    towards = towards / np.linalg.norm(towards)
    some = moving[:: max(1, len(moving) // 20)]
    ways = points[:: max(1, len(points) // 2000), np.newaxis] - some
    depth = ways @ towards
    aside = np.linalg.norm(ways - depth[..., np.newaxis] * towards, axis=2)
    near = 0.2 * float(np.std(points))
    return float(((depth > 2.0 * near) & (aside < near)).any(axis=0).mean())


def _outermost(points: Array) -> Array:
    """Those points that are the farthest in some of many directions, shape (n, 3)."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(300, 3))
    chosen = np.unique(np.argmax(points @ directions.T, axis=0))
    return np.asarray(points[chosen])
