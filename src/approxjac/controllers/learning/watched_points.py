"""Points that a camera watches, in the axes of its mount, linear in translations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from approxjac.robots import KinematicRegressor
from approxjac.tasks import ImageTask
from approxjac.validation import Array


class PointsMotion(NamedTuple):
    """Points and their derivatives, with translations that are learnt.

    Attributes:
        r: Points in the axes of the mount, shape (k, 3) [m].
        J: ∂r/∂q, shape (k, 3, n_v).
        J_dot: Its rate along q̇ and u', shape (k, 3, n_v).
        drift: What u' moves r by, shape (k, 3) [m/s].
    """

    r: Array
    J: Array
    J_dot: Array
    drift: Array


class WatchedPoints:
    """r(q) = o(q) + H(q)u in the axes of the camera's mount, with u translations.

    Of a camera in the world the points are the robot's: u moves the tool. Of one on the robot they
    are the world's: u moves all of them, in the axes of the world.

    Owns scratch memory: one instance a thread.

    Args:
        task: Image of the points, of the believed robot.
        moves: Whether where the points are is in u.
        origins: Whether the origins of the joints are.

    Attributes:
        names: Names of u, such as "tool.x", "points.x" or "panda_joint4.x".
        u: What is believed of it, shape (n_u,) [m].
        is_points: Which of u are of the points, shape (n_u,).
        k: Number of points.
    """

    def __init__(self, task: ImageTask, moves: bool, origins: bool) -> None:
        mount, self.k = task.camera.mount, len(task.points)
        self._is_carried = mount is not None
        if mount is None:
            self.regressor = KinematicRegressor(task.robot, task.frame, task.points)
        else:  # its origin, and the ends of its axes
            self.regressor = KinematicRegressor(task.robot, mount, np.eye(4, 3, -1))
        self._world = task.points if self._is_carried else np.zeros((self.k, 3))
        regressor = self.regressor
        p, theta = regressor.p, regressor.theta.copy()
        is_tool = np.arange(p) >= p - 3
        learnt = np.where(is_tool, moves and not self._is_carried, origins)
        self.of_theta = np.flatnonzero(learnt)
        self.names = [regressor.names[i] for i in self.of_theta]
        u, own = theta[self.of_theta].tolist(), is_tool[self.of_theta].tolist()
        theta[self.of_theta] = 0.0
        self._theta, self._S = theta, np.eye(p)[:, self.of_theta]
        self._n_theta = len(u)
        self._moves_world = moves and self._is_carried
        if self._moves_world:
            self.names += [f"points.{axis}" for axis in "xyz"]
            u, own = [*u, 0.0, 0.0, 0.0], [*own, True, True, True]
        self.u, self.is_points = np.array(u), np.array(own, dtype=bool)

    def at(self, q: Array) -> tuple[Array, Array]:
        """Return H(q), shape (k, 3, n_u), and o(q), shape (k, 3)."""
        Y = self.regressor.Y(q)
        known = Y.dot(self._theta)
        if self.regressor.has_offset:
            known = known + self.regressor.offset(q)
        if not self._is_carried:
            return Y.dot(self._S).reshape(self.k, 3, -1), known.reshape(-1, 3)
        known = known.reshape(4, 3)
        A = known[1:] - known[0]  # rows are the mount's axes
        H = -A.dot(Y[:3].dot(self._S))
        if self._moves_world:
            H = np.concatenate([H, A], axis=1)
        return np.broadcast_to(H, (self.k, *H.shape)), (self._world - known[0]).dot(A.T)

    def theta(self, u: Array) -> Array:
        """Return all translations of `regressor`, those that are known as well; shape (p,) [m]."""
        return np.asarray(self._theta + self._S.dot(u[: self._n_theta]))

    def motion(self, q: Array, v: Array, u: Array, u_dot: Array) -> PointsMotion:
        """Return points and derivatives at q (nq,) and q̇ (n_v,), with u and u' (n_u,)."""
        n = self._n_theta
        theta, theta_dot = self.theta(u), self._S.dot(u_dot[:n])
        p, J, J_dot, drift = self.regressor.motion(q, v, theta, theta_dot)
        J, J_dot = (each.reshape(-1, 3, J.shape[1]) for each in (J, J_dot))
        p, drift = p.reshape(-1, 3), drift.reshape(-1, 3)
        if not self._is_carried:
            return PointsMotion(p, J, J_dot, drift)
        # r = A(P − o) with rows a of A: each entry is a product a·w
        A, a_J, a_J_dot = p[1:] - p[0], J[1:] - J[0], J_dot[1:] - J_dot[0]
        a_dot = a_J.dot(v)
        w, w_dot = self._world - p[0], -J[0].dot(v) - drift[0]
        moved = -drift[0]
        if self._moves_world:
            w, w_dot, moved = w + u[n:], w_dot + u_dot[n:], moved + u_dot[n:]
        each = np.einsum("kj,ajn->kan", w, a_J)
        each_dot = np.einsum("kj,ajn->kan", w, a_J_dot) + np.einsum("j,ajn->an", w_dot, a_J)
        return PointsMotion(
            w.dot(A.T),
            each - A.dot(J[0]),
            each_dot - a_dot.dot(J[0]) - A.dot(J_dot[0]),
            np.tile(A.dot(moved), (self.k, 1)),
        )
