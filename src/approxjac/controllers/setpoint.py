"""`SetpointController`: the laws (5), (6) and (28) put together with a believed robot."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import pinocchio as pin

from approxjac import law
from approxjac.controllers.gains import Gains
from approxjac.controllers.gravity import (
    Adaptation,
    AdaptiveGravity,
    Gravity,
    believed_gravity,
    require_gravity,
)
from approxjac.controllers.posture import Posture
from approxjac.controllers.saturation import require_saturation
from approxjac.controllers.task_controller import TaskController, is_beyond
from approxjac.controllers.tuning import default_adaptation, default_gains, slow_rate
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.interface import Evaluation, Measurement, Status
from approxjac.law import Linear, Saturation
from approxjac.robots.joint_limits import require_radians
from approxjac.tasks import Task
from approxjac.tasks.analysis import vanishing
from approxjac.validation import Array, as_diagonal, as_number, require

_OK, _LOST = Status.OK, Status.MEASUREMENT_LOST  # members of an enum are slow to look up
_ALPHA_SHARE = 0.3  # of the rate of the task's slow pole
_SATURATED, _SINGULAR = Status.TORQUE_SATURATED, Status.NEAR_SINGULAR


@dataclass(frozen=True)
class DifferentiatedVelocity:
    """Ẋ of the earlier law (5): the measured x, filtered with a time constant T and differentiated.

    Attributes:
        time_constant: T > 0 [s]. Sampled control needs dt well below it.
    """

    time_constant: float = 0.02

    def __post_init__(self) -> None:
        as_number("time_constant", self.time_constant, unit="s", above=0.0)


class SetpointController(TaskController):
    """Bring a measured task value to a target with an approximate Jacobian.

    τ = −Ĵᵀ(K_p s(e) + K_v (Ĵq̇ − ẋ_d)) − B_c q̇ + gravity, with e = x − x_d, x measured. It knows the
    believed robot only, through the Jacobian of `task` and through `gravity`.

    The theorems are for a target at rest. With ẋ_d as a feed-forward a moving target is followed
    more closely, but nothing is proven then; gravity that is learnt is disturbed by the motion.

    Its state is θ̂ where gravity is learnt, followed by the differentiator's state for law (5).

    Immutable, but it owns scratch memory: one instance a thread.

    Attributes:
        adaptation: What learns gravity, with its defaults filled in; None if it is not learnt.

    Args:
        task: The task of the believed robot.
        gains: K_p, K_v and the added joint damping; `default_gains(task)` by default.
        gravity: Where the gravity torque comes from; the believed robot's own model by default.
            `NoGravity` is for robots that compensate it themselves, `AdaptiveGravity` makes this
            the law (28), (29).
        saturation: s(e), any `law.Saturation`; s(e) = e by default.
        velocity: None for the paper's estimated task velocity Ĵq̇, law (6); or
            `DifferentiatedVelocity`, law (5).
        posture: Where the self-motion of a redundant arm is drawn to; nowhere by default.

    Raises:
        InvalidInputError: Gains of the wrong shape, a saturation that is no `law.Saturation`, no
            added damping on an arm with more joints than task coordinates, a posture for an arm
            without self-motion, or gravity of a robot with other joints.
    """

    def __init__(
        self,
        task: Task,
        gains: Gains | None = None,
        *,
        gravity: Gravity | None = None,
        saturation: Saturation | None = None,
        velocity: DifferentiatedVelocity | None = None,
        posture: Posture | None = None,
    ) -> None:
        self._remember(locals())
        require("task", task, Task, "a task of the believed robot, such as PositionTask(robot)")
        for name, value, kind, wanted in (
            ("gains", gains, Gains, "Gains(kp=..., kv=..., damping=...) or None"),
            ("velocity", velocity, DifferentiatedVelocity, "DifferentiatedVelocity(T) or None"),
            ("posture", posture, Posture, "Posture(q, stiffness) or None"),
        ):
            if value is not None:
                require(name, value, kind, wanted)
        require_gravity(gravity)
        robot = task.robot
        self.gains = default_gains(task) if gains is None else gains
        self.saturation: Saturation = Linear() if saturation is None else saturation
        self.velocity = velocity
        self.posture = posture
        self.diagonals = self.gains.diagonals(task.m, robot.nv)
        require_saturation(self.saturation, task)
        if robot.nv > task.m and not (self.diagonals.damping > 0.0).all():
            raise InvalidInputError(
                f"damping must be > 0 [N m s/rad] for {robot.name}: it has {robot.nv} joints for "
                f"{task.m} task coordinates, and nothing else damps its self-motion; "
                f"got {self.diagonals.damping.tolist()}",
                given=gains,
            )
        if velocity is not None and not task._subtracts:
            raise InvalidInputError(
                f"law (5) differentiates x and needs a task whose error is x - x_d, got {task!r}",
                given=velocity,
            )
        self.gravity = believed_gravity(gravity, robot)
        self.adaptation = self._resolved_adaptation(task)
        self._p = 0 if self.adaptation is None else self.adaptation.regressor.p
        # as arrays, which NumPy takes in two thirds of the time of numbers
        self._alpha = np.array(0.0 if self.adaptation is None else self.adaptation.alpha)
        self._lag = np.array(1.0 if velocity is None else velocity.time_constant)
        self._pull = None if posture is None else _resolved_posture(posture, task)
        self._scale = vanishing(task)
        self._take(task, self._p + (0 if velocity is None else task.m))

    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first evaluation: θ̂(0), and the first measured x for law (5).

        Raises:
            InvalidInputError: A measurement of the wrong shapes.
            MeasurementError: Law (5), and the first x is lost.
        """
        _, _, x = self._require_arrays(self._no_rate, measurement, np.zeros(self.task.n_x))
        if self.velocity is not None and not np.isfinite(x).all():
            raise MeasurementError(
                f"the first x must be finite for law (5), which differentiates it, "
                f"got {x.tolist()}",
                given=measurement,
            )
        theta0 = np.zeros(0) if self.adaptation is None else self.adaptation.theta0
        followed = np.zeros(0) if self.velocity is None else x
        return np.concatenate([theta0, followed])

    def learnt(self, state: Array) -> Array:
        """Return θ̂ of a state (n_state,), or of a series of them (…, n_state); shape (…, p)."""
        return state[..., : self._p]

    def passive_output(self, answer: Evaluation, v: Array, alpha: float | Array) -> Array:
        """Return y = q̇ + αĴ⁺s(e), eq. (10), where this controller gave an answer.

        Args:
            answer: The answer.
            v: The joint velocity that it was given for, shape (n_v,).
            alpha: α [1/s].

        Returns:
            Shape (n_v,) [rad/s or m/s]; q̇ where x was lost.
        """
        s, J_hat = self.saturation.s(answer.e), answer.J_hat
        if J_hat is None or not math.isfinite(s.dot(s)):
            return v
        w, _ = law.damped_gram_solve(J_hat.dot(J_hat.T), s, scale=self._scale)
        return law.passive_output(v, w.dot(J_hat), alpha)

    def task_torque(self, e: Array, v: Array, J_hat: Array, rate: Array) -> Array:
        """Return −Ĵᵀ(K_p s(e) + K_v Ĵq̇), the part of a torque that acts on a task at rest.

        Args:
            e: Task error, NaN where x was lost, shape (…, m).
            v: Joint velocity q̇, shape (…, n_v).
            J_hat: Estimated Jacobian Ĵ, shape (…, m, n_v).
            rate: Rate of the state, from which law (5) has Ẋ, shape (…, n_state).

        Returns:
            Shape (…, n_v) [N m or N]; without K_p s(e) where x was lost.
        """
        kp, kv, _ = self.diagonals
        s = np.nan_to_num(self.saturation.s(e))
        x_dot = rate[..., self._p :] if self.velocity else (J_hat @ v[..., None])[..., 0]
        torque: Array = -((kp * s + kv * x_dot)[..., None, :] @ J_hat)[..., 0, :]
        return torque

    @functools.cached_property
    def alpha(self) -> float:
        """α of the Lyapunov function where none is given [1/s].

        That of the adaptation where gravity is learnt, else 0.3 of the rate of the task's slow
        pole.
        """
        if self.adaptation is not None:
            return self.adaptation.alpha
        return _ALPHA_SHARE * slow_rate(self.task, self.diagonals)

    def lyapunov_value(
        self,
        e: Array,
        v: Array,
        J_hat: Array,
        M: Array,
        alpha: float,
        theta_error: Array | None = None,
    ) -> float:
        """Return V of (12), or (31) where gravity is learnt, with Ĵ⁺ as in the law.

        Args:
            e: True task error, shape (m,).
            v: Joint velocity q̇, shape (n_v,).
            J_hat: Estimated Jacobian Ĵ, shape (m, n_v).
            M: True inertia matrix, shape (n_v, n_v).
            alpha: α [1/s].
            theta_error: θ − θ̂, shape (p,), where gravity is learnt.

        Returns:
            V [J]; NaN where the error is not known.
        """
        if not np.isfinite(e).all():
            return math.nan
        kp, kv, _ = self.diagonals
        G, units = J_hat @ J_hat.T, np.eye(len(e))
        solved = [law.damped_gram_solve(G, unit, scale=self._scale)[0] for unit in units]
        J_hat_pinv = (np.array(solved) @ J_hat).T
        s, potential = self.saturation.s(e), self.saturation.S(e)
        V = law.V(v, s, potential, J_hat_pinv, M, kp, kv, alpha)
        if self.adaptation is None or theta_error is None:
            return V
        return V + law.parameter_potential(theta_error, self.adaptation.L)

    def gravity_torque(self, state: Array, q: Array) -> Array:
        """Return the gravity torque that this law compensates, shape (n_v,) [N m or N]."""
        if self.adaptation is not None:
            return law.gravity(self.adaptation.regressor.Z(q), state[: self._p])
        return self.gravity.torque(q).copy()  # type: ignore[union-attr]  # the others have one

    def with_gravity(self, gravity: Gravity) -> Self:
        """Return this controller with another source of gravity."""
        return self._rebuilt(gravity=gravity)

    def with_task(self, task: Task) -> Self:
        """Return this controller with another task, such as that of another believed robot.

        Gains, gravity, and what is learnt of it, stay as they are.

        Args:
            task: A task with the same coordinates, of a robot with the same joints.
        """
        learning = self.adaptation
        gravity = self.gravity if learning is None else AdaptiveGravity(*learning)
        return self._rebuilt(task=task, gains=self.gains, gravity=gravity)

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
        kp, kv, damping = self.diagonals
        G = J_hat.dot(J_hat.T)
        learning = self.adaptation
        if learning is None:
            singular = law.is_near_singular(G, scale=self._scale)
            g = self.gravity.torque(q).copy()  # type: ignore[union-attr]  # the others have one
        else:
            w, damped = law.damped_gram_solve(G, s, scale=self._scale)
            singular = damped > 0.0
            Z = learning.regressor.Z(q)
            g = law.gravity(Z, state[: self._p])  # with it, (6) below is (28)
        bias = g
        if self._pull is not None:
            bias = bias + self._pull_within_null_space(q, J_hat, G, *self._pull)
        if x_d_dot is not None:
            bias = bias + law.feed_forward_torque(J_hat, kv, x_d_dot)

        rate = self._no_rate
        if self.velocity is None:
            torque = law.estimated_velocity_torque(J_hat, kp, kv, s, v, damping, bias)
        else:
            # The differentiator's state follows x with time constant T: its rate is Ẋ itself.
            # Without x it goes on with Ĵq̇, so that there is no jump when x is back.
            x_dot = J_hat.dot(v) if lost else (x - state[self._p :]) / self._lag
            torque = law.measured_velocity_torque(J_hat, kp, kv, s, x_dot, v, damping, bias)
            rate = x_dot if learning is None else np.append(self._no_rate[: self._p], x_dot)

        status = _OK
        if lost:
            status = _LOST
        elif learning is not None and is_beyond(torque, learning.torque_limits):
            status = _SATURATED
        elif singular:
            status = _SINGULAR
        if learning is not None and not lost and status is not _SATURATED:
            y = law.passive_output(v, w.dot(J_hat), self._alpha)
            theta_rate = law.theta_hat_rate(learning.L, Z, y)
            if learning.bounds is not None:
                theta_hat = state[: self._p]
                theta_rate = law.within_bounds(theta_rate, theta_hat, *learning.bounds)
            rate = theta_rate if self.velocity is None else np.append(theta_rate, x_dot)
        return Evaluation(torque, rate, status, e, J_hat, g)

    def _pull_within_null_space(
        self, q: Array, J_hat: Array, G: Array, posture: Array, stiffness: Array
    ) -> Array:
        """Return N τ₀ of `Posture`, shape (n_v,)."""
        pull: Array = stiffness * pin.difference(self.task.robot.model, q, posture)
        w, damped = law.damped_gram_solve(G, J_hat.dot(pull), scale=self._scale)
        if damped == 0.0:
            disturbing: Array = w.dot(J_hat)
            return pull - disturbing
        # With a damped Ĵ⁺, N would be no projector. An exact one that is faded out is one still,
        # and continuous, as it turns only where its weight is zero.
        _, values, rows = np.linalg.svd(J_hat, full_matrices=False)
        threshold = law.SINGULAR_RATIO * max(values[0], self._scale)
        weight = (values[-1] / threshold) ** 2 if threshold > 0.0 else 0.0
        faded: Array = weight * (pull - rows.T.dot(rows.dot(pull)))
        return faded

    def _resolved_adaptation(self, task: Task) -> Adaptation | None:
        """Return the adaptation with its defaults filled in."""
        gravity = self.gravity
        if not isinstance(gravity, AdaptiveGravity):
            return None
        L, alpha = gravity.L, gravity.alpha
        if L is None or alpha is None:
            default_L, default_alpha = default_adaptation(
                task, self.diagonals, gravity.regressor, alpha
            )
            L = default_L if L is None else L
            alpha = default_alpha
        return Adaptation(
            gravity.regressor, L, alpha, gravity.theta0, gravity.bounds, gravity.torque_limits
        )

    def __repr__(self) -> str:
        law = "(28), (29)" if self._p else "(6)" if self.velocity is None else "(5)"
        parts = [f"law {law}", repr(self.task), repr(self.gains), repr(self.gravity)]
        return f"{type(self).__name__}({', '.join(parts)})"


def require_setpoint(controller: Any) -> None:
    """Refuse anything but a `SetpointController` itself.

    Raises:
        InvalidInputError: Another controller, or one that limits it or holds measurements for it.
    """
    wanted = "a SetpointController (law_of(controller) is the one inside of its wrappers)"
    require("controller", controller, SetpointController, wanted)


def _resolved_posture(posture: Posture, task: Task) -> tuple[Array, Array]:
    robot = task.robot
    if robot.nv <= task.m:
        raise InvalidInputError(
            f"posture is for arms with more joints than task coordinates, got one for "
            f"{robot.name} with {robot.nv} joints and {task.m} coordinates",
            given=posture,
        )
    q = robot.configuration(posture.q, "q of the posture")
    require_radians("q of the posture", robot, q)
    return q, as_diagonal("stiffness", posture.stiffness, robot.nv, unit="N m/rad")
