"""How points move as a camera sees them: the kinematics behind an image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from approxjac.checks import Array, as_vector
from approxjac.robots import Robot
from approxjac.tasks.frame import FrameKinematics


class PointMotion(NamedTuple):
    """Positions of k points, and how they change with q; seen from where the camera is fixed.

    Attributes:
        r: Positions, shape (k, 3) [m].
        J: ∂r/∂q, shape (k, 3, n_v) [m/rad].
        r_dot: ṙ along q̇, shape (k, 3) [m/s].
        J_dot: d/dt of J along q̇, shape (k, 3, n_v).
    """

    r: Array
    J: Array
    r_dot: Array
    J_dot: Array


class PointKinematics:
    """Points of one frame as seen from another one; None is the world.

    Owns scratch memory: one instance a thread.

    Args:
        robot: The robot, true or believed.
        points: Positions in the frame that they are fixed to, shape (k, 3) [m].
        frame: That frame.
        mount: The frame that they are seen from.

    Raises:
        UnknownNameError: No such frame.
    """

    def __init__(self, robot: Robot, points: Array, frame: str | None, mount: str | None) -> None:
        self.robot, self.points = robot, points
        self.frame, self.mount = frame, mount
        self._frame = None if frame is None else FrameKinematics(robot, frame)
        self._mount = None if mount is None else FrameKinematics(robot, mount)

    def positions(self, q: Array) -> Array:
        """Positions of the points, shape (k, 3) [m]."""
        p = self.points
        if self._frame is not None:
            R, o = self._frame.placement(q)
            p = p @ R.T + o
        if self._mount is not None:
            R, o = self._mount.placement(q)
            p = (p - o) @ R
        return p

    def jacobians(self, q: Array, at: Array | None = None) -> tuple[Array, Array]:
        """r (k, 3) and ∂r/∂q (k, 3, n_v), at a q that has been checked already.

        Args:
            q: Configuration, shape (nq,).
            at: Where to take the points as seen from the mount, shape (k, 3) [m]; rows that are
                NaN, and all by default, where the frame has them.
        """
        p, arms, J = self.points, self.points, np.zeros((6, self.robot.nv))
        if self._frame is not None:
            J = self._frame.compute_jacobian(q)
            R, o = self._frame.placement(q)
            arms = p @ R.T
            p = arms + o
        moved = np.array([J[:3] - _crossed(arm, J[3:]) for arm in arms])
        if self._mount is None:
            return _chosen(p, at), moved
        J = self._mount.compute_jacobian(q)
        R, o = self._mount.placement(q)
        r = _chosen((p - o) @ R, at)
        own = R.T @ J[3:]
        return r, np.array(
            [R.T @ (A - J[:3]) + _crossed(x, own) for x, A in zip(r, moved, strict=True)]
        )

    def motion(self, q: Array, v: Array) -> PointMotion:
        """All of it, with time derivatives along q̇.

        Raises:
            InvalidInputError: A q or v of the wrong length or not finite.
        """
        q, v = self.robot.configuration(q), as_vector("v", v, self.robot.nv)
        r, A = self.jacobians(q)
        r_dot: Array = A @ v
        arms, J, J_dot = self.points, *np.zeros((2, 6, self.robot.nv))
        if self._frame is not None:
            J, J_dot = self._frame.compute_jacobian(q).copy(), self._frame.jacobian_dot(q, v)
            arms = arms @ self._frame.placement(q)[0].T
        swing = J[3:] @ v
        moved = np.array([J[:3] - _crossed(arm, J[3:]) for arm in arms])
        moved_dot = np.array(
            [
                J_dot[:3] - _crossed(np.cross(swing, arm), J[3:]) - _crossed(arm, J_dot[3:])
                for arm in arms
            ]
        )
        if self._mount is None:
            return PointMotion(r, A, r_dot, moved_dot)
        J, J_dot = self._mount.compute_jacobian(q).copy(), self._mount.jacobian_dot(q, v)
        R = self._mount.placement(q)[0]
        own = R.T @ J[3:]
        turn = own @ v  # the mount's angular velocity in its own axes
        own_dot = R.T @ J_dot[3:] - _crossed(turn, own)
        A_dot = [
            R.T @ (B_dot - J_dot[:3])
            - _crossed(turn, R.T @ (B - J[:3]))
            + _crossed(x_dot, own)
            + _crossed(x, own_dot)
            for x, x_dot, B, B_dot in zip(r, r_dot, moved, moved_dot, strict=True)
        ]
        return PointMotion(r, A, r_dot, np.array(A_dot))


def _chosen(r: Array, at: Array | None) -> Array:
    return r if at is None else np.where(np.isfinite(at), at, r)


def _crossed(a: Array, B: Array) -> Array:
    """[a]ₓ B for a (3,) and columns B (3, n)."""
    x, y, z = a.tolist()
    return np.array([y * B[2] - z * B[1], z * B[0] - x * B[2], x * B[1] - y * B[0]])
