"""Weights of a torque limiter, and the speed at which damping acts."""

from __future__ import annotations

import math

import numpy as np

from approxjac import law
from approxjac.controllers.limiter import Asked
from approxjac.validation import Array

_KEPT = 100.0  # how much dearer it is to turn the task force than to reduce it


def light_inertias(inertias: Array) -> Array:
    """Return the least inertia of each joint, 1 / max (M⁻¹)ᵢᵢ, as the others give way; (n_v,).

    Damping of D times it acts no faster than n_v D: tr(M⁻¹D) bounds its largest eigenvalue.
    """
    mobilities = np.linalg.inv(inertias)
    light: Array = 1.0 / np.diagonal(mobilities, axis1=1, axis2=2).max(axis=0)
    return light


def quickest(inertias: Array, damping: Array) -> float:
    """Return the largest eigenvalue of M⁻¹D over configurations, D diagonal of shape (n_v,)."""
    root = np.sqrt(damping)
    scaled = root[:, np.newaxis] * np.linalg.inv(inertias) * root
    return float(np.linalg.eigvalsh(scaled)[:, -1].max())


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
