"""Kinematics and dynamics at a symbolic configuration.

`codegen` traces a law by running it on arrays of symbols. Pinocchio takes numbers only, so a
symbolic q supplies the robot's terms itself: it has the method `arm_of(robot)`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.robots.robot import Robot, own_joints
from approxjac.validation import Array


def arm_of(robot: Any, q: Any) -> Any:
    """Return the terms of a robot at a symbolic q; None if q is numeric.

    They are a `codegen.arm.rigid_body.Configured`.
    """
    own = getattr(q, "arm_of", None)
    return None if own is None else own(robot)


def moved(robot: Robot, q: Array, motion: Array) -> Array:
    """Return the configuration (nq,) after a motion (n_v,) from q."""
    if type(q) is np.ndarray and type(motion) is np.ndarray:
        return np.array(pin.integrate(robot.model, q, motion))
    after, kind = list[Any](), _kind(q, motion)
    q, steps = q.tolist(), motion.tolist()
    for joint, step in zip(own_joints(robot.model).values(), steps, strict=True):
        at = joint.idx_q
        if joint.nq == 1:
            after.append(q[at] + step)
            continue
        c, s = np.cos(step), np.sin(step)
        x, y = c * q[at] - s * q[at + 1], s * q[at] + c * q[at + 1]
        # the first step of Newton's method to the unit circle
        scale = 0.5 * (3.0 - (x * x + y * y))
        after += [x * scale, y * scale]
    return np.array(after, dtype=object).view(kind)


def motion_between(robot: Robot, a: Array, b: Array) -> Array:
    """Return the motion (n_v,) from a to b, both (nq,)."""
    if type(a) is np.ndarray and type(b) is np.ndarray:
        return np.asarray(pin.difference(robot.model, a, b))
    motion, kind = list[Any](), _kind(a, b)
    a, b = a.tolist(), b.tolist()
    for joint in own_joints(robot.model).values():
        at = joint.idx_q
        if joint.nq == 1:
            motion.append(b[at] - a[at])
            continue
        cosine = a[at] * b[at] + a[at + 1] * b[at + 1]
        sine = a[at] * b[at + 1] - a[at + 1] * b[at]
        motion.append(np.arctan2(sine, cosine))
    return np.array(motion, dtype=object).view(kind)


def positions_at(robot: Robot, q: Array) -> Array:
    """Return the joint positions (n_v,) [rad or m] at q (nq,)."""
    return q if robot.nq == robot.nv else motion_between(robot, robot.neutral(), q)


def _kind(a: Any, b: Any) -> Any:
    return type(a if hasattr(a, "arm_of") else b)
