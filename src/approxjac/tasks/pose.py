"""Position and orientation of a frame."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from approxjac import law
from approxjac.robots import Robot
from approxjac.tasks.frame_kinematics import FrameKinematics
from approxjac.tasks.task import Feature, Task
from approxjac.validation import Array


class PoseTask(Task):
    """X = position [m] and orientation of a frame in the world; m = 6.

    A value is (x, y, z) and a quaternion (x, y, z, w), shape (7,), as `pin.SE3ToXYZQUAT` has it;
    the quaternion's length and sign do not matter. The error is (p − p_d, φ): φ = log(R R_dᵀ) is
    the rotation vector that leads from the target's orientation to the measured one, in world
    axes [rad], valid up to 180°. At 180° itself the two ways round are equally long; of them
    the one of the quaternion's sign is taken.

    The Jacobian is the geometric one (velocity and angular velocity, world axes). With it
    d/dt ½‖φ‖² = φᵀω holds exactly for every φ below 180°, so the paper's potential and proof carry
    over there, where the three rotational gains are equal and s(φ) = φ. With other gains V̇ = −W
    holds with ∂e/∂q in place of J, which then counts as a part of the Jacobian's error.

    Args:
        robot: The robot, true or believed.
        frame: Frame name; the robot's `tip` by default.

    Raises:
        UnknownNameError: No such frame.
        InvalidInputError: Fewer than six joints.
    """

    _kind = "pose"

    def __init__(self, robot: Robot, frame: str | None = None) -> None:
        super().__init__(robot, ("x", "y", "z", "rx", "ry", "rz"), ("m",) * 3 + ("rad",) * 3, 7)
        self.frame = robot.tip_or(frame)
        self._frame = FrameKinematics(robot, self.frame)
        self._features = (Feature(slice(0, 7), self.frame, "xyz"),)
        self._origin = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])  # no rotation

    def value(self, q: Array) -> Array:
        return self._frame.pose(q)

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        return self._frame.jacobian(q)

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        return self._frame.jacobian_dot(q, v)

    def error(self, x: Array, x_d: Array) -> Array:
        px, py, pz, *quaternion = x.tolist()
        dx, dy, dz, *target = x_d.tolist()
        turn = law.rotation_between(quaternion, target)
        return np.asanyarray(law.array([px - dx, py - dy, pz - dz, *turn]))

    def displaced(self, x: Array, e: Array) -> Array:
        turned = law.turned(x[3:].tolist(), e[3:].tolist())
        return np.concatenate([x[:3] + e[:3], law.array(turned)])

    def on(self, robot: Robot) -> PoseTask:
        return PoseTask(robot, self.frame)

    def _error_jacobian(self, e: Array, J: Array) -> Array:
        rates = pin.Jlog3(pin.exp3(e[3:])).T  # φ̇ = rates ω, as ω is in world axes
        return np.concatenate([J[:3], rates @ J[3:]])

    def __repr__(self) -> str:
        return f"PoseTask({self.robot.name!r}, {self.frame!r})"
