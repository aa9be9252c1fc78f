"""Kinematics and dynamics at a symbolic configuration.

`codegen` traces a law by running it on arrays of symbols. Pinocchio takes numbers only, so a
symbolic q supplies the robot's terms itself: it has the methods `arm_of(robot)`, `moved` and
`motion_between`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from approxjac.validation import Array

if TYPE_CHECKING:
    from approxjac.robots.robot import Robot


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
    return np.asanyarray(_symbolic(q, motion).moved(robot, q, motion))


def motion_between(robot: Robot, a: Array, b: Array) -> Array:
    """Return the motion (n_v,) from a to b, both (nq,)."""
    if type(a) is np.ndarray and type(b) is np.ndarray:
        return np.asarray(pin.difference(robot.model, a, b))
    return np.asanyarray(_symbolic(a, b).motion_between(robot, a, b))


def positions_at(robot: Robot, q: Array) -> Array:
    """Return the joint positions (n_v,) [rad or m] at q (nq,)."""
    return q if robot.nq == robot.nv else motion_between(robot, robot.neutral(), q)


def _symbolic(a: Any, b: Any) -> Any:
    return a if hasattr(a, "arm_of") else b
