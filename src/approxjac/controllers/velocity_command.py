"""`VelocityCommand`: a reference velocity within limits of speed, position and acceleration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from approxjac.controllers.limits import Limits, speed_bounds, sure_deceleration
from approxjac.robots import Robot
from approxjac.validation import Array, as_limits

_APPROACH = 5.0  # κ of `speed_bounds` [1/s]


class VelocityCommand:
    """The velocity nearest to q̇_r that joints may be commanded.

    Speed is brought within its limits along q̇_r as a whole (`law.within_speeds`, before); joints
    near their position limits are slowed down each on its own, and each command differs from the
    one before by the acceleration that there may be.

    Args:
        robot: The believed robot.
        limits: With an entry for each joint.
        acceleration: A number or shape (n_v,) [rad/s² or m/s²]; by default `sure_deceleration`.
        dt: Time from command to command [s].
    """

    def __init__(
        self,
        robot: Robot,
        limits: Limits,
        acceleration: float | Sequence[float] | Array | None,
        dt: float,
    ) -> None:
        sure = sure_deceleration(robot, np.asarray(limits.effort))
        given = sure if acceleration is None else acceleration
        self.acceleration = as_limits("acceleration", given, robot.nv, unit="rad/s^2 or m/s^2")
        (low, high), fastest = np.array(limits.position), np.asarray(limits.velocity)
        slowing = np.minimum(self.acceleration, sure)
        self._joints = np.array([low, high, fastest, slowing]).T.tolist()
        self._model = robot.model
        self._neutral = None if robot.nq == robot.nv else robot.neutral()
        self._change = dt * self.acceleration

    def within(self, q: Array, velocity: Array, before: Array) -> Array:
        """Return the command at q (nq,), given the wanted one and the one before, (n_v,) each."""
        motion = q if self._neutral is None else pin.difference(self._model, self._neutral, q)
        low, high = np.array(speed_bounds(motion, self._joints, _APPROACH))
        wanted = np.minimum(np.maximum(velocity, low), high)
        within = np.minimum(np.maximum(wanted, before - self._change), before + self._change)
        return np.asarray(within)
