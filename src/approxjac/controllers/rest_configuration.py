"""`RestConfiguration`: the self-motion n₀ that draws a redundant arm to a configuration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from approxjac import law
from approxjac.errors import InvalidInputError
from approxjac.robots.joint_limits import require_radians
from approxjac.tasks import Task
from approxjac.validation import Array, as_array

_FASTEST = 0.5  # [rad/s or m/s]
_WHOLE = 0.999  # of a turn


class RestConfiguration:
    """n₀ = −k_n s(q ⊖ q_rest), no faster than 0.5 rad/s, and its derivative.

    Of continuous joints the sine of the angle takes the place of the angle, so that n₀ has no jump
    half a turn away.

    Args:
        task: The task of the believed robot.
        q: q_rest, shape (nq,). By default the middle of the ranges of joints that turn less than
            once, or slide less than 2 m. The others are drawn nowhere: the middle of ±2π says
            nothing of an elbow.
        rate: k_n [1/s].

    Raises:
        InvalidInputError: A q_rest for an arm without self-motion, of the wrong shape or in
            degrees.
    """

    def __init__(self, task: Task, q: Sequence[float] | Array | None, rate: float) -> None:
        robot = task.robot
        if q is not None and robot.nv <= task.m:
            raise InvalidInputError(
                f"posture is for arms with more joints than task coordinates, got one for "
                f"{robot.name} with {robot.nv} joints and {task.m} coordinates",
                given=q,
            )
        # as arrays, which NumPy multiplies with in a third of the time of numbers
        self._pull, self._share = np.full(robot.nv, -rate), np.array(rate / _FASTEST)
        self._is_vector = robot.nq == robot.nv
        joints = robot._joints.values()
        self._continuous = np.array([joint.nq > joint.nv for joint in joints])
        self._first = np.array([joint.idx_q for joint in joints])  # the cosine of (cos, sin)
        self._second = self._first + self._continuous
        self._none = np.zeros(robot.nv) if robot.nv <= task.m or rate == 0.0 else None
        self._names = None if q is not None else robot.joint_names
        if q is None:
            lower, upper = robot.usual_range()
            whole = np.where(np.array(robot.joint_units) == "m", 2.0, 2.0 * np.pi)
            self._pull[upper - lower > _WHOLE * whole] = 0.0
            middle = 0.5 * (lower + upper)
            self.q = np.array(pin.integrate(robot.model, robot.neutral(), middle))
            return
        self.q = as_array("posture", robot.configuration(q, "posture"), (robot.nq,))
        require_radians("posture", robot, self.q)

    def words(self) -> str:
        """Return where it draws the self-motion to; "" where there is none or it is left alone."""
        if self._none is not None:
            return ""
        if self._names is None:
            return "self-motion: drawn to the posture that is given"
        drawn = [name for name, k in zip(self._names, self._pull, strict=True) if k]
        if not drawn:
            return "self-motion: drawn nowhere, as all joints turn a whole turn"
        if len(drawn) == len(self._names):
            return "self-motion: drawn to the middle of the ranges of all joints"
        middle = f"drawn to the middle of the ranges of {', '.join(drawn)}"
        return f"self-motion: {middle}; joints that turn a whole turn are free"

    def velocity(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return n₀ and its derivative at q (nq,) and q̇ (n_v,)."""
        if self._none is not None:
            return self._none, self._none
        if self._is_vector:
            away, rate = q - self.q, v
        else:
            a, b = q.take(self._first), q.take(self._second)
            c, s = self.q.take(self._first), self.q.take(self._second)
            away = np.where(self._continuous, b * c - a * s, a - c)
            rate = np.where(self._continuous, a * c + b * s, 1.0) * v
        s, s_dot = law.saturated(away, rate, self._share)
        return self._pull * s, self._pull * s_dot
