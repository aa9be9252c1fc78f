"""Terms of a law along a run: V, and the torque that acts on the task."""

from __future__ import annotations

import math

import numpy as np

from approxjac import law
from approxjac.controllers.setpoint import SetpointController
from approxjac.validation import Array


def task_torque(
    controller: SetpointController, e: Array, v: Array, J_hat: Array, rate: Array
) -> Array:
    """Return −Ĵᵀ(K_p s(e) + K_v Ĵq̇), the part of a torque that acts on a task at rest.

    Args:
        controller: The law.
        e: Task error, NaN where x was lost, shape (…, m).
        v: Joint velocity q̇, shape (…, n_v).
        J_hat: Estimated Jacobian Ĵ, shape (…, m, n_v).
        rate: Rate of the state, from which law (5) has Ẋ, shape (…, n_state).

    Returns:
        Shape (…, n_v) [N m or N]; without K_p s(e) where x was lost.
    """
    kp, kv, _ = controller.diagonals
    s = np.nan_to_num(controller.saturation.s(e))
    measured = rate[..., rate.shape[-1] - len(kp) :]
    x_dot = measured if controller.velocity else (J_hat @ v[..., None])[..., 0]
    torque: Array = -((kp * s + kv * x_dot)[..., None, :] @ J_hat)[..., 0, :]
    return torque


def lyapunov_value(
    controller: SetpointController,
    e: Array,
    v: Array,
    J_hat: Array,
    M: Array,
    alpha: float,
    theta_error: Array | None = None,
) -> float:
    """Return V of (12), or (31) where gravity is learnt, with Ĵ⁺ as in the law.

    Args:
        controller: The law.
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
    (kp, kv, _), saturation = controller.diagonals, controller.saturation
    s, S = saturation.s(e), saturation.S(e)
    V = law.V(v, s, S, controller.pinv.matrix(J_hat), M, kp, kv, alpha)
    if controller.adaptation is None or theta_error is None:
        return V
    return V + law.parameter_potential(theta_error, controller.adaptation.L)
