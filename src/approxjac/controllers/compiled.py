"""`CompiledSetpointController`: usual steps of the laws (6) and (28), (29) as machine code."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from approxjac import law
from approxjac.controllers.arguments import FLOAT64, HUGE
from approxjac.controllers.differentiator import DifferentiatedVelocity
from approxjac.controllers.gains import Gains
from approxjac.controllers.gravity import Gravity, RegressorGravity
from approxjac.controllers.latency import Latency
from approxjac.controllers.machine_code import compiled
from approxjac.controllers.posture import AwayFromStops, Posture, within_null_space
from approxjac.controllers.setpoint import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status, Target
from approxjac.law import Linear, Saturation, Sine, Tanh
from approxjac.law.products import dot
from approxjac.law.saturation import sine, tanh
from approxjac.tasks import PositionTask, Task
from approxjac.validation import Array

_SATURATIONS = (Linear, Sine, Tanh)


class CompiledSetpointController(SetpointController):
    """A `SetpointController` whose usual steps are machine code, in half of the time.

    A usual step is one whose status is OK. Whatever is not (x is lost, Ĵ near a singular pose,
    torques beyond the limits where gravity is learnt, wrong arguments) is left to
    `SetpointController.evaluate`, from the beginning. What is computed is the same to rounding.

    It needs Numba (`pip install 'approxjac[fast]'`) and time when it is built: some ten seconds for
    the first one of each law on a machine, about a second for the first one of a process. So it is
    for loops in which microseconds count.

    No class can be derived from it: what that changed would not be in the machine code.

    Args:
        task: The task of the believed robot; its error must be x − x_d, and its Jacobian an array
            of float64 (or no step is a usual one).
        gains: As for `SetpointController`.
        gravity: As for `SetpointController`.
        saturation: `Linear`, `Sine` or `Tanh`.
        velocity: None: law (5) is not compiled.
        posture: As for `SetpointController`; its torque is computed in NumPy.

    Raises:
        InvalidInputError: As `SetpointController`, and for what is not compiled.
        MissingPackageError: Numba is not installed.
    """

    def __init_subclass__(cls) -> None:
        raise TypeError(
            f"{cls.__name__} cannot be derived from CompiledSetpointController, whose machine code "
            "would not have its changes; derive it from SetpointController"
        )

    def __init__(
        self,
        task: Task,
        gains: Gains | None = None,
        *,
        gravity: Gravity | None = None,
        saturation: Saturation | None = None,
        velocity: DifferentiatedVelocity | None = None,
        posture: Posture | AwayFromStops | None = None,
        latency: Latency | None = None,
        settling_time: float | None = None,
    ) -> None:
        super().__init__(
            task,
            gains,
            gravity=gravity,
            saturation=saturation,
            velocity=velocity,
            posture=posture,
            latency=latency,
            settling_time=settling_time,
        )
        for name, given, fits, wanted in (
            ("velocity", velocity, velocity is None, "None: law (5) is not compiled"),
            (
                "saturation",
                saturation,
                type(self.saturation) in _SATURATIONS,
                "Linear, Sine or Tanh: others are not compiled",
            ),
            ("task", task, task._subtracts, "one whose error is x - x_d: others are not compiled"),
        ):
            if not fits:
                raise InvalidInputError(
                    f"{name} of a CompiledSetpointController must be {wanted}, got {given!r}; "
                    "SetpointController takes it",
                    given=given,
                )
        # It hides the method: one that called it would take a tenth of the step.
        vars(self)["evaluate"] = self._compiled_evaluate()

    def _compiled_evaluate(self) -> Callable[[Array, Measurement, Target | Array], Evaluation]:
        """Return `SetpointController.evaluate`, with its usual steps in machine code.

        What it needs are variables of this function: to look up attributes would take longer than
        the law itself.
        """
        ordinary = super().evaluate
        task, learning, pull = self.task, self.adaptation, self._pull
        robot, jacobian, n, m, p = task.robot, task.jacobian, task.robot.nv, task.m, self._p
        q_shape, state_shape, continuous = (robot.nq,), (self._n_state,), self._continuous
        # Pinocchio takes any number; where NumPy computes, huge ones would make warnings
        guarded = (
            type(task) is not PositionTask
            or robot.mimic_joints.G is not None
            or isinstance(self.gravity, RegressorGravity)
            or pull is not None
        )
        kind = _SATURATIONS.index(type(self.saturation))
        gamma = np.broadcast_to(getattr(self.saturation, "gamma", 1.0), m)
        constants = np.concatenate([*self.diagonals, gamma, [self._scale, kind]])
        is_far = self._reach.is_exceeded
        scale, no_rate = self._scale, self._no_rate
        parts = (fits, is_small, saturated, taken_apart)
        if learning is None:
            step = compiled(known_gravity, (2, 1, 1, 1, 1, 1), 2, parts)
            gravity = self.gravity.torque  # type: ignore[union-attr]  # the others have one
        else:
            inputs = (2, 1, 1, 1, 1, 1, 2, 1, learning.L.ndim, 0, 1, 1)
            step = compiled(learnt_gravity, inputs, 3, parts)
            # copies, as Numba takes longer with arrays that are read-only
            L, limits = learning.L.copy(), learning.torque_limits.copy()
            alpha, nothing = learning.alpha, np.zeros(n)
            root = np.ones(n) if self.pinv.root is None else self.pinv.root.copy()
            Y_of = learning.Y
        float64, huge, empty, ndarray, hypot = FLOAT64, HUGE, np.empty, np.ndarray, math.hypot
        made, ok, unlimited = tuple.__new__, Status.OK, LimitStatus.UNLIMITED

        def evaluate(state: Array, measurement: Measurement, target: Target | Array) -> Evaluation:
            try:
                _, q, v, x, _ = measurement
                usual = (
                    q.__class__ is v.__class__ is x.__class__ is ndarray
                    and target.__class__ is state.__class__ is ndarray
                    and q.shape == q_shape
                    and state.shape == state_shape
                    and q.dtype is v.dtype is x.dtype is float64
                    and target.dtype is state.dtype is float64  # Numba mistakes the order of bytes
                    and (not guarded or hypot(*q.tolist(), *x.tolist()) < huge)
                )
                if continuous and usual:
                    robot.configuration(q)
                if usual:
                    J_hat = jacobian(q, x)  # which refuses a q that is not finite
            except (AttributeError, TypeError, ValueError):
                usual = False
            if usual:
                g = gravity(q).copy() if learning is None else nothing
                bias = g
                if pull is not None:
                    bias = g + within_null_space(pull(q), J_hat, J_hat.dot(J_hat.T), scale)
                torque, e, rate = empty(n), empty(m), no_rate
                try:
                    if guarded and not (J_hat.__class__ is ndarray and J_hat.dtype is float64):
                        usual = False  # of a task of the user's own
                    elif learning is None:
                        usual = step(J_hat, v, x, target, bias, constants, torque, e)
                    else:
                        Y, rate = Y_of(q, J_hat), empty(p)
                        usual = step(
                            J_hat, v, x, target, bias, constants, Y, state,
                            L, alpha, limits, root, torque, e, rate,
                        )  # fmt: skip
                except (TypeError, ValueError):  # not of float64, or beyond what has eigenvalues
                    usual = False
                if usual and not (learning is not None and is_far(q, e)):
                    if learning is not None:
                        g = Y.dot(state)
                        rate = learning.bounded(rate, state, Y, g)
                    # made as Evaluation(...) makes it, in a third of the time
                    return made(Evaluation, (torque, rate, ok, e, J_hat, g, unlimited, 0.0, None))
            return ordinary(state, measurement, target)

        return evaluate


def known_gravity(
    J_hat: Array,
    v: Array,
    x: Array,
    x_d: Array,
    g: Array,
    constants: Array,
    torque: Array,
    e: Array,
) -> bool:
    """Write eq. (6) into `torque` and x − x_d into `e`; return whether it was a usual step.

    `constants` are the diagonals of K_p, K_v and B_c, γ, the scale of `law.is_near_singular`, and
    which of `_SATURATIONS`.
    """
    if not fits(J_hat, v, x, x_d, g, torque, e):
        return False
    kp, kv, damping, gamma, scale, kind = taken_apart(constants, len(e))
    e[:] = x - x_d
    s = saturated(e, gamma, kind)
    torque[:] = law.estimated_velocity_torque(J_hat, kp, kv, s, v, damping, g)
    return is_small(torque, e) and not law.is_near_singular(dot(J_hat, J_hat.T), scale=scale)


def learnt_gravity(
    J_hat: Array,
    v: Array,
    x: Array,
    x_d: Array,
    g: Array,
    constants: Array,
    Z: Array,
    theta_hat: Array,
    L: Array,
    alpha: float,
    limits: Array,
    root: Array,
    torque: Array,
    e: Array,
    rate: Array,
) -> bool:
    """Write eq. (28) into `torque`, (29) into `rate`, x − x_d into `e`; return if it was usual.

    Here g is what is added to the learnt gravity, and `limits` are the torques beyond which θ̂
    stands still, `root` that of the weight of Ĵ⁺; the others are those of `known_gravity` and of
    `law.theta_hat_rate`.
    """
    if not fits(J_hat, v, x, x_d, g, torque, e):
        return False
    kp, kv, damping, gamma, scale, kind = taken_apart(constants, len(e))
    e[:] = x - x_d
    s = saturated(e, gamma, kind)
    torque[:] = g + law.learnt_gravity_torque(J_hat, kp, kv, s, v, damping, Z, theta_hat)
    if not is_small(torque, e) or np.abs(torque / limits).max() > 1.0:
        return False
    weighted = J_hat / root
    w, damped = law.damped_gram_solve(dot(weighted, weighted.T), s, scale=scale)
    rate[:] = law.theta_hat_rate(L, Z, law.passive_output(v, dot(w, weighted) / root, alpha))
    return damped == 0.0 and is_small(rate, e)


def fits(J_hat: Array, v: Array, x: Array, x_d: Array, g: Array, torque: Array, e: Array) -> bool:
    """Return whether all sizes agree: machine code looks at no bounds."""
    return (
        J_hat.shape == (len(e), len(torque))
        and len(v) == len(g) == len(torque)
        and len(x) == len(x_d) == len(e)
    )


def taken_apart(constants: Array, m: int) -> tuple[Array, Array, Array, Array, float, float]:
    """Return K_p, K_v, B_c, γ, scale and kind: one array takes less time to hand over than each."""
    return (
        constants[:m],
        constants[m : 2 * m],
        constants[2 * m : -m - 2],
        constants[-m - 2 : -2],
        constants[-2],
        constants[-1],
    )


def saturated(e: Array, gamma: Array, kind: float) -> Array:
    """Return s(e) of one of `_SATURATIONS`."""
    if kind == 1:
        return sine(e / gamma, gamma)
    if kind == 2:
        return tanh(e / gamma, gamma)
    return e


def is_small(torque: Array, e: Array) -> bool:
    """Return whether torque and error are finite, and far from where numbers overflow."""
    size = 0.0
    for each in torque:
        size += abs(each)
    for each in e:
        size += abs(each)
    return size < HUGE
