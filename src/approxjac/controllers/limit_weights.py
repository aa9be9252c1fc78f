"""The weight of a torque limiter that keeps the direction of the force on the task."""

from __future__ import annotations

import math

import numpy as np

from approxjac import law
from approxjac.controllers.limiter import Asked
from approxjac.validation import Array

_KEPT = 100.0  # how much dearer it is to turn the task force than to reduce it


def task_force_weight(asked: Asked) -> Array:
    """Return an R that makes it dear to turn the force on the task, shape (n_v, n_v).

    R = I + w N P N with P = Ĵᵀ(ĴĴᵀ)⁻¹Ĵ, onto the joint torques that act on the task, and
    N = I − uuᵀ, u the direction of the law's own τ* − g.
    """
    force = asked.answer.torque - asked.gravity
    size, J_hat = math.hypot(*force.tolist()), asked.answer.J_hat
    if size == 0.0 or J_hat is None:
        return np.eye(len(force))
    u = force / size
    squares, U = np.linalg.eigh(J_hat.dot(J_hat.T))
    regular = squares > law.SINGULAR_RATIO**2 * squares[-1]
    basis = (U[:, regular] / np.sqrt(squares[regular])).T.dot(J_hat)
    across = basis - np.outer(basis.dot(u), u)
    R: Array = np.eye(len(force)) + _KEPT * across.T.dot(across)
    return R
