"""`VelocityCommand`: joint velocities for a robot's own servo, within limits, ahead of its lag."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from approxjac import law
from approxjac.controllers.limits.limits import Limits, sure_deceleration
from approxjac.robots import Robot
from approxjac.robots.traced import motion_between
from approxjac.validation import Array, as_limits

_APPROACH = 5.0  # κ of `law.speed_bounds` [1/s]
_GAIN = 1.0  # of what learns the lag
_LONGEST = 0.1  # lag [s]
_SOONEST = 0.1  # that a joint gets to its full speed in, where nothing is told [s]


class VelocityCommand:
    """The velocity nearest to q̇_r + L̂w that joints may be commanded, with a lag L̂ that is learnt.

    w = ∂q̇_r/∂t + Dq̇_r with D = ∂q̇_r/∂q is q̈_r = w + Dσ of joints that move as they should: it has
    no noise of q̇, which would be in q̈_r and in σ alike and make L̂ grow. A servo with
    L q̈ + q̇ = q̇_cmd and σ = q̇ − q̇_r has Lσ̇ = −(I + LD)σ + (L̂ − L)w, so with L̂' = −γ wᵀσ the
    function V₃ = ½L‖σ‖² + (L̂ − L)²/2γ has V̇₃ = −σᵀ(I + LD)σ. With D near −αĴ⁺Ĵ that is negative
    for a lag below 1/α. A delay counts as lag, for which nothing is proven.

    Speed is brought within its limits along q̇_r as a whole (`law.within_speeds`, before); joints
    near their position limits are slowed down each on its own, and each command differs from the
    one before by the acceleration that there may be. Where a command is limited, L̂ rests.

    Args:
        robot: The believed robot.
        limits: With an entry for each joint.
        acceleration: A number or shape (n_v,) [rad/s² or m/s²]; by default `sure_deceleration`, but
            no more than leads to full speed in 0.1 s.
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
        usual = np.minimum(sure, np.asarray(limits.velocity) / _SOONEST)
        given = usual if acceleration is None else acceleration
        self.acceleration = as_limits("acceleration", given, robot.nv, unit="rad/s^2 or m/s^2")
        slowing = np.minimum(self.acceleration, sure)
        self._joints = law.JointRange.of(limits.position, limits.velocity, _APPROACH, slowing)
        self._robot = robot
        self._neutral = None if robot.nq == robot.nv else robot.neutral()
        self._dt, self._change = dt, dt * self.acceleration

    def step(
        self, state: Array, q: Array, v: Array, v_r: Array, w: Array, before: Array
    ) -> tuple[Array, Array]:
        """Return L̂ a period later, shape (1,), and the command, shape (n_v,).

        Args:
            state: L̂ [s], shape (1,).
            q: Configuration, shape (nq,).
            v: q̇, shape (n_v,).
            v_r: q̇_r, shape (n_v,).
            w: q̈_r at q̇ = q̇_r, shape (n_v,).
            before: The command before, shape (n_v,).
        """
        wanted = v_r + state[0] * w
        sent = self._within(q, wanted, before)
        lag = state + self._dt * law.servo_lag_rate(_GAIN, w, v - v_r)
        lag = np.minimum(np.maximum(lag, 0.0), _LONGEST)
        return law.select(law.all_of(sent == wanted), lag, state), sent

    def _within(self, q: Array, velocity: Array, before: Array) -> Array:
        """Return the velocity within limits, given the command before."""
        motion = q if self._neutral is None else motion_between(self._robot, self._neutral, q)
        low, high = law.speed_bounds(motion, self._joints)
        wanted = np.minimum(np.maximum(velocity, low), high)
        within = np.minimum(np.maximum(wanted, before - self._change), before + self._change)
        return np.asanyarray(within)
