"""Joint stops: stiff, damped contacts at the position limits of a robot."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
import pinocchio as pin

from approxjac.robots import Dynamics, Robot
from approxjac.validation import Array

_RATE = 200.0  # natural frequency of a joint on its stop, critically damped [rad/s]
_GIVES_WAY = 0.01  # at most under the whole torque of its motor [rad or m]
_DRAWN = 50  # configurations, for the usual inertia of a joint


class JointStops:
    """Stops at `Robot.position_limits`: p = max(0, kδ + dδ̇) where a joint is δ > 0 beyond one.

    A stop pushes back and never pulls. As kδ is part of p while δ grows, and p at most kδ while it
    shrinks, T + ½kδ² never grows through a stop.

    k is that of 200 rad/s with the usual inertia of the joint, 1/mean (M⁻¹)_ii, or stiffer where
    its motor could press the joint further than 0.01 rad or m beyond the limit; d = 2k / 200 rad/s.
    So a joint that runs into its stop at v sinks in by about v/(e·200 rad/s), 2 mrad at 1 rad/s.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot, self._limits = robot, robot.position_limits
        # of each coordinate of q, infinite of continuous joints
        self.ends = [(-math.inf, math.inf)] * robot.nq
        for name, low, high in zip(robot.joint_names, *self._limits, strict=True):
            joint = robot.model.joints[robot.model.getJointId(name)]
            self.ends[joint.idx_q] = float(low), float(high)

    @cached_property
    def stiffness(self) -> Array:
        """k, shape (n_v,) [N m/rad or N/m]."""
        robot, dynamics, rng = self._robot, Dynamics(self._robot), np.random.default_rng(0)
        drawn = (robot.random_configuration(rng) for _ in range(_DRAWN))
        usual = 1.0 / np.mean([np.diag(dynamics.M_inv(q)) for q in drawn], axis=0)
        effort = np.where(np.isfinite(robot.effort_limits), robot.effort_limits, 0.0)
        return np.asarray(np.maximum(usual * _RATE**2, effort / _GIVES_WAY))

    @cached_property
    def damping(self) -> Array:
        """d, shape (n_v,) [N m s/rad or N s/m]."""
        return 2.0 / _RATE * self.stiffness

    def touched(self, q: Array) -> bool:
        """Return True where a joint is beyond its limits; quick, as every step asks."""
        for value, (low, high) in zip(q.tolist(), self.ends):  # noqa: B905, SIM110 (it is quick)
            if value < low or value > high:  # one that is NaN is not
                return True
        return False

    def depth(self, q: Array) -> tuple[Array, Array]:
        """Return δ, −∞ without limits, and the side of the nearer limit, +1 or −1: (n_v,) each."""
        motion = pin.difference(self._robot.model, self._robot.neutral(), q)
        low, high = self._limits
        above, below = motion - high, low - motion
        return np.maximum(above, below), np.where(above > below, 1.0, -1.0)

    def torque(self, q: Array, v: Array) -> Array:
        """Return −p on the upper side and p on the lower one, shape (n_v,) [N m or N]."""
        depth, side = self.depth(q)
        push = self.stiffness * np.maximum(depth, 0.0) + self.damping * side * v
        return np.where(depth > 0.0, -side * np.maximum(push, 0.0), 0.0)

    def held_torque(self, q: Array, v: Array, M_inv: Array, dt: float) -> Array:
        """Return the torque (n_v,) that stops hold over a step dt [s] of semi-implicit Euler.

        Of p with δ and δ̇ at the end of the step (implicit Euler), so that what is said of the
        energy holds for a step of any length, with any stiffness. v is that at the end of the step
        if there were no stops.
        """
        depth, side = self.depth(q)
        v = side * v  # outwards
        slowed = dt * side[:, np.newaxis] * M_inv * side  # v by a unit of each push
        per_speed = self.stiffness * dt + self.damping
        push = np.zeros(len(v))
        touching = np.zeros(len(v), dtype=bool)
        while True:
            # what pushes one joint back may push another one beyond its limit
            reached = depth + dt * (v - slowed @ push) > 0.0
            if not (reached & ~touching).any():
                return -side * push
            touching |= reached
            there = np.flatnonzero(touching)
            push[there] = _complementary(
                np.diag(1.0 / per_speed[there]) + slowed[np.ix_(there, there)],
                (self.stiffness * depth)[there] / per_speed[there] + v[there],
            )


def _complementary(A: Array, b: Array) -> Array:
    """Return p ≥ 0 with Ap ≥ b, one of them an equality in each entry, by Murty's pivoting."""
    held = np.zeros(len(b), dtype=bool)
    rounding = 1e-12 * np.abs(b).max()
    while True:
        p = np.zeros(len(b))
        p[held] = np.linalg.solve(A[np.ix_(held, held)], b[held])
        wrong = np.where(held, p < 0.0, A @ p < b - rounding)
        if not wrong.any():
            return p
        held[wrong.argmax()] ^= True
