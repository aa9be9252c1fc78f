"""Position and Jacobian of one frame of a robot, in the world's axes."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from approxjac.checks import Array, as_vector
from approxjac.robots import Robot

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
        self._data = self._model.createData()

    def position(self, q: Array) -> Array:
        """Position of the frame's origin in the world, shape (3,) [m]."""
        pin.forwardKinematics(self._model, self._data, self.robot.configuration(q))
        return np.array(pin.updateFramePlacement(self._model, self._data, self._id).translation)

    def jacobian(self, q: Array) -> Array:
        """Jacobian of (velocity, angular velocity), LOCAL_WORLD_ALIGNED, shape (6, n_v)."""
        q = self.robot.configuration(q)
        J: Array = pin.computeFrameJacobian(self._model, self._data, q, self._id, _LWA)
        return J

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        """Time derivative of `jacobian` along q̇, shape (6, n_v)."""
        q, v = self.robot.configuration(q), as_vector("v", v, self.robot.nv)
        pin.computeJointJacobiansTimeVariation(self._model, self._data, q, v)
        pin.updateFramePlacement(self._model, self._data, self._id)
        J_dot: Array = pin.getFrameJacobianTimeVariation(self._model, self._data, self._id, _LWA)
        return J_dot
