"""`VelocityServo`: the classical baseline, visual servoing of a velocity-controlled arm."""

from __future__ import annotations

import numpy as np

from approxjac import law
from approxjac.controllers.gravity import (
    AdaptiveGravity,
    Gravity,
    believed_gravity,
    require_gravity,
)
from approxjac.controllers.saturation import require_saturation
from approxjac.controllers.task_controller import TaskController
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, Status
from approxjac.law import Linear, Saturation
from approxjac.robots import Dynamics
from approxjac.tasks import Task
from approxjac.tasks.analysis import vanishing
from approxjac.validation import Array, as_diagonal, as_number, require

_OK, _LOST = Status.OK, Status.MEASUREMENT_LOST  # members of an enum are slow to look up
_SINGULAR = Status.NEAR_SINGULAR


class VelocityServo(TaskController):
    """Image-based visual servoing at velocity level, with an inner velocity loop.

    q̇_ref = −λ Ĵ⁺s(e),   τ = M̂(q) ω (q̇_ref − q̇) + Ĉ(q, q̇)q̇ + gravity

    The law of F. Chaumette and S. Hutchinson, "Visual servo control, Part I: Basic approaches"
    (IEEE Robotics & Automation Magazine 13(4), 2006), for any task, to compare the paper's laws
    with. e = x − x_d, x measured. q̇_ref is scaled down as a whole until no joint's is beyond its
    velocity limit (those of the believed robot); Ĵ⁺ is damped near singular poses.

    The inner loop is the best that a believed robot can have, so that what a comparison shows is
    the outer law: where M̂, Ĉ and gravity are right, q̈ = ω (q̇_ref − q̇) for each joint by itself,
    the velocity-controlled robot that the law is derived for. Drives with a gain for each joint,
    ω M̂ᵢᵢ, would not be fairer: the eigenvalues of M⁻¹ diag(Mᵢᵢ) spread their bandwidth (on a Panda
    from 0.4 ω to 13 ω, the medians over postures), for which the law would be blamed. Unlike many
    drives it has no integral: gravity that it does not know leaves an error, and lets the
    self-motion of a redundant arm drift, as with `SetpointController`.

    With a right Ĵ small errors have ë = ω (−λe − ė): slow poles near −λ as long as λ is small
    beside ω/4, oscillation beyond. Sampled control needs ω dt well below 2.

    While x is lost, q̇_ref = 0 and the arm stops. Its state is empty. Immutable, but it owns scratch
    memory: one instance a thread.

    Attributes:
        velocity_limits: What q̇_ref is kept below, shape (n_v,) [rad/s or m/s].

    Args:
        task: The task of the believed robot.
        rate: λ > 0 [1/s]. 4/T settles to 2 % in about T, as `default_gains(task, T)` does; 4 by
            default.
        inner_bandwidth: ω > 0 [1/s].
        gravity: `ModelGravity` (default, of the believed robot), `RegressorGravity` or `NoGravity`.
        saturation: s(e), any `law.Saturation`; s(e) = e by default.

    Raises:
        InvalidInputError: Numbers that are not positive, gravity that is learnt or of a robot with
            other joints, or a saturation that is no `law.Saturation`.
    """

    def __init__(
        self,
        task: Task,
        rate: float = 4.0,
        *,
        inner_bandwidth: float = 50.0,
        gravity: Gravity | None = None,
        saturation: Saturation | None = None,
    ) -> None:
        self._remember(locals())
        require("task", task, Task, "a task of the believed robot, such as PositionTask(robot)")
        self.rate = _as_rate("rate", rate)
        self.inner_bandwidth = _as_rate("inner_bandwidth", inner_bandwidth)
        require_gravity(gravity)
        if isinstance(gravity, AdaptiveGravity):
            raise InvalidInputError(
                "gravity must not be learnt by a velocity servo: eq. (29) goes with the laws of "
                "SetpointController; give ModelGravity, RegressorGravity or NoGravity",
                given=gravity,
            )
        robot = task.robot
        self.gravity = believed_gravity(gravity, robot)
        self.saturation: Saturation = Linear() if saturation is None else saturation
        require_saturation(self.saturation, task)
        self.velocity_limits = robot.velocity_limits
        self.velocity_limits.flags.writeable = False
        # gravity is what the controller takes it for, which may be none
        self._dynamics = Dynamics(robot.with_gravity((0.0, 0.0, 0.0)))
        self._scale = vanishing(task)
        self._take(task, 0)

    def velocity_reference(self, answer: Evaluation) -> Array:
        """q̇_ref where this controller gave an answer, shape (n_v,) [rad/s or m/s].

        Zero where x was lost.
        """
        if answer.status is _LOST or answer.J_hat is None:
            return np.zeros(self.task.robot.nv)
        with np.errstate(over="ignore"):  # e may be absurd and its saturation usual
            reference, _ = self._reference(answer.J_hat, self.saturation.s(answer.e))
        return reference

    def _reference(self, J_hat: Array, s: Array) -> tuple[Array, float]:
        """q̇_ref, shape (n_v,), and the damping of Ĵ⁺."""
        reference, damping = law.velocity_reference(J_hat, s, self.rate, self._scale)
        return law.within_speeds(reference, self.velocity_limits), damping

    def _answer(
        self,
        q: Array,
        v: Array,
        x: Array,
        e: Array,
        state: Array,
        x_d_dot: Array | None,
        lost: bool,
    ) -> Evaluation:
        """Evaluate the law at inputs that have been checked."""
        J_hat = self.task.jacobian(q, x)
        s = np.zeros_like(e) if lost else self.saturation.s(e)
        reference, damping = self._reference(J_hat, s)
        moving = self._dynamics.inverse(q, v, self.inner_bandwidth * (reference - v))
        g = self.gravity_torque(state, q)
        status = _LOST if lost else _SINGULAR if damping > 0.0 else _OK
        return Evaluation(moving + g, self._no_rate, status, e, J_hat, g)

    def gravity_torque(self, state: Array, q: Array) -> Array:
        """Return the gravity torque that this law compensates, shape (n_v,) [N m or N]."""
        return self.gravity.torque(q).copy()  # type: ignore[union-attr]

    def __repr__(self) -> str:
        return (
            f"VelocityServo({self.task!r}, rate={self.rate:.4g}, "
            f"inner_bandwidth={self.inner_bandwidth:.4g})"
        )


def _as_rate(name: str, value: float) -> float:
    number = as_number(name, value, unit="1/s", above=0.0)
    as_diagonal(name, number, 1, unit="1/s")  # not beyond what gains may be
    return number
