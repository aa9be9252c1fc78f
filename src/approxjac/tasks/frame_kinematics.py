"""Position, orientation and Jacobian of one frame of a robot, in the world's axes."""

from __future__ import annotations

from functools import cached_property, partial
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.robots import Robot
from approxjac.validation import Array, as_vector

_LWA = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class FrameKinematics:
    """Forward kinematics of one frame.

    Owns scratch memory: one instance a thread. What it returns is yours to keep.

    Args:
        robot: The robot, true or believed.
        frame: Frame name.

    Raises:
        UnknownNameError: No such frame.
        InvalidInputError: From every method, for a q or v of the wrong length or not finite.
    """

    def __init__(self, robot: Robot, frame: str) -> None:
        self.robot = robot
        self.frame = frame
        self._id = robot.frame_id(frame)
        self._model = robot.model
        self._nq, self._is_vector = robot.nq, robot.nq == robot.nv  # or it has (cos, sin) pairs
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

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.robot, self.frame)  # a copy has scratch memory of its own

    def position(self, q: Array) -> Array:
        """Return the position of the frame's origin in the world, shape (3,) [m]."""
        return np.array(self._placement(q).translation)

    def placement(self, q: Array) -> tuple[Array, Array]:
        """Return the rotation (3, 3) of the frame's axes in the world's, and `position`."""
        M = self._placement(q)
        return np.array(M.rotation), np.array(M.translation)

    def pose(self, q: Array) -> Array:
        """Return position [m] and unit quaternion (x, y, z, w) in the world, shape (7,)."""
        return np.array(pin.SE3ToXYZQUAT(self._placement(q)))

    def jacobian(self, q: Array) -> Array:
        """Return the Jacobian of (velocity, angular velocity), LOCAL_WORLD_ALIGNED, (6, n_v)."""
        q = as_vector("q", q, self._nq) if self._is_vector else self.robot.configuration(q)
        J: Array = self._jacobian_of(q, self._id, _LWA)
        return J if self._many else J.reshape(6, 1)

    def motion(self, q: Array) -> tuple[Array, Array, Array]:
        """Return `jacobian`, and the frame's rotation (3, 3) and position (3,) at the same q.

        Rotation and position are scratch memory: use them before the next call, do not keep them.
        """
        J = self.jacobian(q)  # places the frame, too
        return J, *self._placed

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        """Return the time derivative of `jacobian` along q̇, shape (6, n_v)."""
        q, v = self.robot.configuration(q), as_vector("v", v, self.robot.nv)
        mimic_joints = self.robot.mimic_joints
        frame = self._all.getFrameId(self.frame, self._model.frames[self._id].type)
        pin.computeJointJacobiansTimeVariation(
            self._all, self._all_data, mimic_joints.q(q), mimic_joints.v(v)
        )
        pin.updateFramePlacement(self._all, self._all_data, frame)
        J_dot: Array = pin.getFrameJacobianTimeVariation(self._all, self._all_data, frame, _LWA)
        return mimic_joints.columns(J_dot.reshape(6, -1))

    def _placement(self, q: Array) -> pin.SE3:
        pin.forwardKinematics(self._model, self._data, self.robot.configuration(q))
        return pin.updateFramePlacement(self._model, self._data, self._id)
