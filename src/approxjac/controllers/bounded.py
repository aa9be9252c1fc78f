"""`BoundedController`: a law whose torque has a bound that is known beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from approxjac import law
from approxjac.checks import Array, require
from approxjac.controllers.bounded_gains import (
    BoundedGains,
    Extremes,
    JointRangeLike,
    limits_of,
    shared_out,
)
from approxjac.controllers.checked import CheckedController, is_beyond
from approxjac.controllers.gravity import Gravity
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, Status
from approxjac.law import Tanh
from approxjac.tasks import Task
from approxjac.tasks.task import vanishing

_OK, _LOST = Status.OK, Status.MEASUREMENT_LOST  # members of an enum are slow to look up
_SATURATED, _SINGULAR = Status.TORQUE_SATURATED, Status.NEAR_SINGULAR


class BoundedController(CheckedController):
    """Brings a measured task value to a fixed target with torques that never pass their limits.

    τ = −Ĵᵀ K_p s(e) − K_d tanh(q̇/v₀) + g(q) with s(e) = γ tanh(e/γ): whatever e and q̇ are,
    abs(τᵢ) ≤ Σⱼ abs(Ĵⱼᵢ(q)) k_pj γⱼ + k_di + abs(gᵢ(q)), which is `torque_bound`. When it is
    built, that bound is held below the limits over a whole range of the joints.

    The regulator with fixed estimates after W. E. Dixon, "Adaptive regulation of amplitude limited
    robot manipulators with uncertain kinematics and dynamics" (IEEE TAC 52(3), 2007), for
    comparison. His paper adapts kinematic and dynamic parameters besides, by projection.

    Should a torque be beyond its limit all the same (a posture outside the range, or a task whose
    bound is drawn: see `guaranteed`), it is clipped as a last resort, and the status says
    `TORQUE_SATURATED`. The potential below is lost then.

    With Ĵ = J, exact gravity and natural friction B, V = ½q̇ᵀMq̇ + Σ k_pi γᵢ² log cosh(eᵢ/γᵢ) has
    V̇ = −q̇ᵀ K_d tanh(q̇/v₀) − q̇ᵀBq̇ ≤ 0. Else V̇ gains q̇ᵀ(J − Ĵ)ᵀ K_p s(e). Near the target it is
    law (6) with K_v = 0 and B_c = K_d/v₀.

    Its state is empty. Immutable, but it owns scratch memory: one instance a thread.

    Attributes:
        diagonals: The gains as vectors.
        torque_limits: Shape (n_v,) [N m or N].
        saturation: s(e), `Tanh(gamma)`.
        gravity: Where the gravity torque comes from.
        joint_range: Lowest and highest joint positions for which the bound was checked, as motions
            from zero, each of shape (n_v,) [rad or m].
        guaranteed: Whether the torques are proved to be within the limits over that range without
            any clipping; if not, postures were drawn.

    Args:
        task: The task of the believed robot.
        torque_limits: A number or shape (n_v,) [N m or N]; the believed robot's effort limits by
            default, infinite where there is none.
        gains: `bounded_gains(task, torque_limits, ...)` by default.
        gravity: `ModelGravity` (default, of the believed robot), `RegressorGravity` or `NoGravity`.
        joint_range: Lowest and highest position of the joints, each a number or shape (n_v,), as
            motions from zero [rad or m]; `Robot.usual_range` by default.

    Raises:
        InvalidInputError: Limits that leave nothing above gravity, gains that may ask for more
            than the limits, gravity that is learnt, or arguments of the wrong shape or kind.
    """

    def __init__(
        self,
        task: Task,
        torque_limits: float | Sequence[float] | Array | None = None,
        gains: BoundedGains | None = None,
        *,
        gravity: Gravity | None = None,
        joint_range: JointRangeLike | None = None,
    ) -> None:
        require("task", task, Task, "a task of the believed robot, such as PositionTask(robot)")
        if task.jacobian_uses_x:
            raise InvalidInputError(
                f"task must have a Jacobian that depends on q only, for torques to be bounded "
                f"beforehand, got {task!r}",
                given=task,
            )
        if gains is not None:
            require("gains", gains, BoundedGains, "BoundedGains(kp, gamma, kd, v0) or None")
        limits = limits_of(task.robot, torque_limits)
        extremes = Extremes(task, gravity, joint_range)
        if gains is None:
            gains = shared_out(extremes, limits)
        else:
            extremes.require_within(gains.diagonals(task.m, task.robot.nv), limits)
        where = (extremes.lower, extremes.upper)
        self._settle(task, limits, gains, extremes.gravity, where, extremes.guaranteed)

    def _settle(
        self,
        task: Task,
        torque_limits: Array,
        gains: BoundedGains,
        gravity: Gravity,
        joint_range: tuple[Array, Array],
        guaranteed: bool,
    ) -> None:
        """Take over what has been checked."""
        self._take(task, 0)
        self.torque_limits = torque_limits
        self.gains = gains
        self.diagonals = gains.diagonals(task.m, task.robot.nv)
        self.gravity = gravity
        self.joint_range = joint_range
        self.guaranteed = guaranteed
        self.saturation = Tanh(self.diagonals.gamma)
        self._scale = vanishing(task)

    def torque_bound(self, q: Array) -> Array:
        """What no abs(τᵢ) of the law exceeds at q, whatever e and q̇ are; shape (n_v,) [N m or N].

        Raises:
            InvalidInputError: A q of the wrong length or not finite.
        """
        q = self.task.robot.configuration(q)
        kp, gamma, kd, _ = self.diagonals
        g = self.gravity.torque(q)  # type: ignore[union-attr]  # learnt gravity is refused
        return law.bounded_torque_bound(self.task.compute_jacobian(q), kp, gamma, kd, g)

    def _answer(
        self, q: Array, v: Array, x: Array, e: Array, state: Array, lost: bool
    ) -> Evaluation:
        """Evaluate the law at inputs that have been checked."""
        J_hat = self.task.compute_jacobian(q, x)
        s = np.zeros_like(e) if lost else self.saturation.s(e)
        kp, _, kd, v0 = self.diagonals
        g = self.gravity.torque(q)  # type: ignore[union-attr]
        torque = law.bounded_torque(J_hat, kp, s, v, kd, v0, g)
        status = _OK
        if law.is_near_singular(J_hat.dot(J_hat.T), scale=self._scale):
            status = _SINGULAR
        if is_beyond(torque, self.torque_limits):
            torque = np.minimum(np.maximum(torque, -self.torque_limits), self.torque_limits)
            status = _SATURATED
        if lost:
            status = _LOST
        return Evaluation(torque, self._no_rate, status, e, J_hat)

    def with_task(self, task: Task) -> BoundedController:
        """Return this controller with another task; gains are shared out anew for its bounds."""
        where = self.joint_range
        return type(self)(task, self.torque_limits, gravity=self.gravity, joint_range=where)

    def __reduce__(self) -> tuple[Any, ...]:
        # a copy has scratch memory of its own, down to that of its task and its gravity
        names = ("task", "torque_limits", "gains", "gravity", "joint_range", "guaranteed")
        return _copied, (type(self), *(getattr(self, name) for name in names))

    def __repr__(self) -> str:
        return f"BoundedController({self.task!r}, {self.gains!r})"


def _copied(kind: type[BoundedController], *checked: Any) -> BoundedController:
    controller = kind.__new__(kind)
    controller._settle(*checked)
    return controller
