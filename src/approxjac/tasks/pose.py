"""Position and orientation of a frame."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from approxjac.robots import Robot
from approxjac.tasks.frame_kinematics import FrameKinematics
from approxjac.tasks.task import Feature, Task
from approxjac.validation import Array

NO_ROTATION = 1e-6
"""A quaternion shorter than this stands for no orientation."""


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
        return np.array([px - dx, py - dy, pz - dz, *_rotation_between(quaternion, target)])

    def displaced(self, x: Array, e: Array) -> Array:
        turned = pin.Quaternion(pin.exp3(e[3:])) * pin.Quaternion(x[3:])
        return np.concatenate([x[:3] + e[:3], turned.coeffs()])

    def on(self, robot: Robot) -> PoseTask:
        return PoseTask(robot, self.frame)

    def _error_jacobian(self, e: Array, J: Array) -> Array:
        rates = pin.Jlog3(pin.exp3(e[3:])).T  # φ̇ = rates ω, as ω is in world axes
        return np.concatenate([J[:3], rates @ J[3:]])

    def __repr__(self) -> str:
        return f"PoseTask({self.robot.name!r}, {self.frame!r})"


def _rotation_between(a: list[float], b: list[float]) -> tuple[float, float, float]:
    """Return log(R_a R_bᵀ) [rad] from quaternions (x, y, z, w); NaN where one is none."""
    length_a, length_b = math.hypot(*a), math.hypot(*b)
    if not (NO_ROTATION < length_a < math.inf and NO_ROTATION < length_b < math.inf):
        return math.nan, math.nan, math.nan
    unit_a, unit_b = [entry / length_a for entry in a], [entry / length_b for entry in b]
    x, y, z, w = quaternion_between(unit_a, unit_b)
    w = w + 0.0  # no −0.0, which would turn the sign at 180°
    sine = math.hypot(x, y, z)  # of half the angle
    # of the two quaternions of this rotation, the one that turns by at most 180°
    angle = 2.0 * math.atan2(math.copysign(sine, w), abs(w))
    factor = angle / sine if sine > 1e-150 else math.copysign(2.0, w)
    return factor * x, factor * y, factor * z


def quaternion_between(a: list[float], b: list[float]) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of R_a R_bᵀ from those of R_a and R_b."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    x = ax * bw - aw * bx + az * by - ay * bz
    y = ay * bw - aw * by + ax * bz - az * bx
    z = az * bw - aw * bz + ay * bx - ax * by
    return x, y, z, aw * bw + ax * bx + ay * by + az * bz
