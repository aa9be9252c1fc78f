"""`PointKinematics`: points as a camera sees them, and their motion."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from approxjac.robots import Robot
from approxjac.tasks.frame_kinematics import FrameKinematics
from approxjac.validation import Array, as_vector

# a @ _CROSS is [a]ₓ, row by row
_CROSS = np.array([
    [0, 0, 0, 0, 0, -1, 0, 1, 0],
    [0, 0, 1, 0, 0, 0, -1, 0, 0],
    [0, -1, 0, 1, 0, 0, 0, 0, 0],
], dtype=float)  # fmt: skip


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
        self._at_origin = len(points) == 1 and not points.any()

    def positions(self, q: Array) -> Array:
        """Return the positions of the points, shape (k, 3) [m]."""
        p = self.points
        if self._frame is not None:
            R, o = self._frame.placement(q)
            p = p @ R.T + o
        if self._mount is not None:
            R, o = self._mount.placement(q)
            p = (p - o) @ R
        return p

    def jacobians(self, q: Array, at: Array | None = None) -> tuple[Array, Array]:
        """Return r (k, 3) and ∂r/∂q (k, 3, n_v).

        Args:
            q: Configuration, shape (nq,).
            at: Where to take the points as seen from the mount, shape (k, 3) [m]; rows that are
                NaN, and all by default, where the frame has them.
        """
        p, moved = self._in_world(q)
        if self._mount is None:
            return _chosen(p, at), moved
        J, R, o = self._mount.motion(q)
        r = _chosen((p - o) @ R, at)
        return r, R.T @ (moved - J[:3]) + _skews(r) @ (R.T @ J[3:])

    def _in_world(self, q: Array) -> tuple[Array, Array]:
        """Return positions (k, 3) of the points in the world, and their Jacobians (k, 3, n_v)."""
        if self._frame is None:
            return self.points, np.zeros((len(self.points), 3, self.robot.nv))
        J, R, o = self._frame.motion(q)
        if self._at_origin:
            return o[np.newaxis].copy(), J[np.newaxis, :3]
        arms = self.points @ R.T
        return arms + o, J[:3] - _skews(arms) @ J[3:]

    def motion(self, q: Array, v: Array) -> tuple[Array, Array, Array, Array]:
        """Return the motion of the points along q̇, as seen from the mount.

        Returns:
            r (k, 3) [m], ṙ (k, 3) [m/s], J = ∂r/∂q (k, 3, n_v) and J̇ (k, 3, n_v).

        Raises:
            InvalidInputError: A q or v of the wrong length or not finite.
        """
        q, v = self.robot.configuration(q), as_vector("v", v, self.robot.nv)
        r, A = self.jacobians(q)
        r_dot: Array = A @ v
        moved, moved_dot = self._in_world(q)[1], np.zeros_like(A)
        if self._frame is not None:
            J, R, _ = self._frame.motion(q)
            arms = self.points @ R.T
            arms_dot = np.cross(J[3:] @ v, arms)
            J_dot = self._frame.jacobian_dot(q, v)
            moved_dot = J_dot[:3] - _skews(arms_dot) @ J[3:] - _skews(arms) @ J_dot[3:]
        if self._mount is None:
            return r, r_dot, A, moved_dot
        J, R, _ = self._mount.motion(q)
        R_t, J_dot = R.T.copy(), self._mount.jacobian_dot(q, v)
        own = R_t @ J[3:]
        turn = pin.skew(own @ v)  # of the mount, in its own axes
        own_dot = R_t @ J_dot[3:] - turn @ own
        A_dot = (
            R_t @ (moved_dot - J_dot[:3])
            - turn @ (R_t @ (moved - J[:3]))
            + _skews(r_dot) @ own
            + _skews(r) @ own_dot
        )
        return r, r_dot, A, A_dot


def _chosen(r: Array, at: Array | None) -> Array:
    return r if at is None else np.where(np.isfinite(at), at, r)


def _skews(vectors: Array) -> Array:
    """Return the matrices [a]ₓ with [a]ₓ b = a × b for each row a, shape (k, 3, 3)."""
    return np.asarray(vectors @ _CROSS).reshape(-1, 3, 3)
