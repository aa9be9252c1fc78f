"""The view of a scene that the page starts with, so that nobody needs to turn it first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.robots import Robot
from approxjac.robots.model import own_joints
from approxjac.validation import Array

_INSTANTS = 40  # of a run, whose configurations must all be in view
_SIDE = np.deg2rad(28.0)  # past cameras, which would be looked at from behind otherwise
_ABOVE = np.deg2rad(18.0)
_PARALLEL = 1e-6


def link_points(robot: Robot, q: Array, boxes: Mapping[str, Array]) -> Array:
    """Return points of links (k, 3), each in its frame, at some of the q (N, nq); (n, 3) [m]."""
    data, points = robot.model.createData(), []
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
