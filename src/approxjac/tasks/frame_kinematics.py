"""Kinematics of a frame of a robot, and of points as they are seen from another one."""

from __future__ import annotations

from functools import cached_property, partial
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.law import quaternion
from approxjac.robots import Robot
from approxjac.robots.traced import arm_of
from approxjac.validation import Array, as_vector

_LWA = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
# a @ _CROSS is [a]ₓ, row by row
_CROSS = np.array([
    [0, 0, 0, 0, 0, -1, 0, 1, 0],
    [0, 0, 1, 0, 0, 0, -1, 0, 0],
    [0, -1, 0, 1, 0, 0, 0, 0, 0],
], dtype=float)  # fmt: skip


class FrameKinematics:
    """Forward kinematics of one frame.

    Owns scratch memory: one instance a thread. What it returns is yours to keep. A q or v of the
    wrong length or not finite is an InvalidInputError.

    Args:
        robot: The robot, true or believed.
        frame: Frame name; an UnknownNameError if there is none.
    """

    def __init__(self, robot: Robot, frame: str) -> None:
        self.robot = robot
        self.frame = frame
        self._id = robot.frame_id(frame)
        self._model = robot.model
        self._many = robot.nv > 1  # of one joint Pinocchio's Jacobian has lost an axis
        # Pinocchio's J̇ is wrong with mimic joints: it is computed with all joints on their own
        self._all = robot.mimic_joints.model

    # Scratch memory is made when it is first needed: of truths that are drawn, many never need it.
    # Of what Pinocchio holds these are live views, as to read it costs as much as to compute it.

    @cached_property
    def _data(self) -> pin.Data:
        return self._model.createData()

    @cached_property
    def _jacobian_of(self) -> partial[Array]:
        return partial(pin.computeFrameJacobian, self._model, self._data)

    @cached_property
    def _placed(self) -> tuple[Array, Array]:
        placement = self._data.oMf[self._id]
        return placement.rotation, placement.translation

    @cached_property
    def _all_data(self) -> pin.Data:
        return self._data if self._all is self._model else self._all.createData()

    @cached_property
    def _id_in_all(self) -> int:
        return int(self._all.getFrameId(self.frame, self._model.frames[self._id].type))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.robot, self.frame)  # a copy has scratch memory of its own

    def position(self, q: Array) -> Array:
        """Return the position of the frame's origin in the world, shape (3,) [m]."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.frame(self.frame)[1])
        return np.array(self._placement(q).translation)

    def placement(self, q: Array) -> tuple[Array, Array]:
        """Return the rotation (3, 3) of the frame's axes in the world's, and `position`."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            R, p = arm.frame(self.frame)
            return R, p
        M = self._placement(q)
        return np.array(M.rotation), np.array(M.translation)

    def pose(self, q: Array) -> Array:
        """Return position [m] and unit quaternion (x, y, z, w) in the world, shape (7,)."""
        if type(q) is not np.ndarray and arm_of(self.robot, q) is not None:
            R, p = self.placement(q)
            return np.concatenate([p, quaternion(R)])
        return np.array(pin.SE3ToXYZQUAT(self._placement(q)))

    def jacobian(self, q: Array) -> Array:
        """Return the Jacobian of (velocity, angular velocity), LOCAL_WORLD_ALIGNED, (6, n_v)."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.jacobian(self.frame))
        J: Array = self._jacobian_of(self.robot.configuration(q), self._id, _LWA)
        return J if self._many else J.reshape(6, 1)

    def motion(self, q: Array) -> tuple[Array, Array, Array]:
        """Return `jacobian`, and the frame's rotation (3, 3) and position (3,) at the same q.

        Rotation and position are scratch memory: use them before the next call, do not keep them.
        """
        if type(q) is not np.ndarray and arm_of(self.robot, q) is not None:
            return self.jacobian(q), *self.placement(q)
        J = self.jacobian(q)  # places the frame, too
        return J, *self._placed

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        """Return the time derivative of `jacobian` along q̇, shape (6, n_v)."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.jacobian_dot(self.frame, v))
        q, v = self.robot.configuration(q), as_vector("v", v, self.robot.nv)
        mimic_joints, frame = self.robot.mimic_joints, self._id_in_all
        pin.computeJointJacobiansTimeVariation(
            self._all, self._all_data, mimic_joints.q(q), mimic_joints.v(v)
        )
        pin.updateFramePlacement(self._all, self._all_data, frame)
        J_dot: Array = pin.getFrameJacobianTimeVariation(self._all, self._all_data, frame, _LWA)
        return mimic_joints.columns(J_dot.reshape(6, -1))

    def drift(self, q: Array, v: Array) -> Array:
        """Return J̇q̇, shape (6,): what accelerates the frame, and turns it, where q̈ is 0."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.drift(self.frame, v))
        return np.asarray(self.jacobian_dot(q, v).dot(v))

    def _placement(self, q: Array) -> pin.SE3:
        pin.forwardKinematics(self._model, self._data, self.robot.configuration(q))
        return pin.updateFramePlacement(self._model, self._data, self._id)


class PointKinematics:
    """Points (k, 3) [m] of one frame as seen from another one, the mount; None is the world.

    Owns scratch memory: one instance a thread.
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
        """Return r (k, 3), or `at` where that is finite, and ∂r/∂q there (k, 3, n_v)."""
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


def _chosen(r: Array, at: Array | None) -> Array:
    return r if at is None else np.where(np.isfinite(at), at, r)


def _skews(vectors: Array) -> Array:
    """Return the matrices [a]ₓ with [a]ₓ b = a × b for each row a, shape (k, 3, 3)."""
    return np.asanyarray((vectors @ _CROSS).reshape(-1, 3, 3))
