"""`Samples` that the conditions are evaluated on: true robots, configurations and targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.simulation import Plant
from approxjac.tasks.analysis import jacobian_gradient, require_jacobian_of_q
from approxjac.validation import Array

Indices = NDArray[np.intp]
_SINGULAR = 1e-9  # σ_min as a share of σ_max at which Ĵ⁺ cannot be computed


@dataclass(frozen=True, eq=False, repr=False)
class Samples:
    """All that the conditions need of N combinations of true robot, configuration and target.

    Attributes:
        truth: Index of the true robot, shape (N,).
        q: Configuration, shape (N, nq).
        x_d: Target, shape (N, n_x).
        M: Inertia matrix of the true robot, shape (N, n_v, n_v).
        dM: ∂M/∂q_k, shape (N, n_v, n_v, n_v), k first.
        J: True task Jacobian, shape (N, m, n_v).
        J_e: True ∂e/∂q, which is J where e = x − x_d, shape (N, m, n_v).
        J_hat: Ĵ, shape (N, m, n_v).
        dJ_hat: ∂Ĵ/∂q_k, shape (N, n_v, m, n_v), k first.
        s: s(e), shape (N, m).
        slope: s'(e), shape (N, m).
    """

    truth: Indices
    q: Array
    x_d: Array
    M: Array
    dM: Array
    J: Array
    J_e: Array
    J_hat: Array
    dJ_hat: Array
    s: Array
    slope: Array

    def __repr__(self) -> str:
        return f"Samples({len(self)} of {len(set(self.truth.tolist()))} true robots)"

    def __len__(self) -> int:
        return len(self.q)

    def take(self, which: Indices) -> Samples:
        """Return the samples of some indices."""
        return Samples(*(getattr(self, f.name)[which] for f in fields(self)))

    def join(self, *others: Samples) -> Samples:
        """Return these samples and others after them."""
        each = (self, *others)
        return Samples(*(np.concatenate([getattr(s, f.name) for s in each]) for f in fields(self)))


def evaluate(
    controller: SetpointController,
    plants: Sequence[Plant],
    truths: Indices,
    configurations: Array,
    x_d: Array,
) -> Samples:
    """Evaluate models at N true robots `truths`, configurations (N, nq) and targets x_d (N, n_x).

    Raises:
        InvalidInputError: A task whose Jacobian uses the measured x, or a configuration where Ĵ
            loses rank.
    """
    task, saturation = controller.task, controller.saturation
    require_jacobian_of_q(task, "the conditions over a region")
    N, n, m = len(configurations), task.robot.nv, task.m
    M, dM = np.empty((N, n, n)), np.empty((N, n, n, n))
    J, J_e, J_hat = np.empty((N, m, n)), np.empty((N, m, n)), np.empty((N, m, n))
    dJ_hat, e = np.empty((N, n, m, n)), np.empty((N, m))
    for i, (t, q) in enumerate(zip(truths, configurations, strict=True)):
        dynamics, sensor = plants[t].dynamics, plants[t].sensor
        M[i], dM[i] = dynamics.M(q), dynamics.M_gradient(q)
        e[i] = sensor.error(sensor.value(q), x_d[i])
        J[i] = sensor._sensor_jacobian(q)
        J_e[i] = sensor._error_jacobian(e[i], J[i])
        J_hat[i], dJ_hat[i] = task.jacobian(q), jacobian_gradient(task, q)
    values = np.linalg.svd(J_hat, compute_uv=False)
    singular = values[:, -1] <= _SINGULAR * values[:, 0]
    if singular.any():
        raise InvalidInputError(
            "the region must hold no configuration where the estimated Jacobian loses rank, got "
            f"q = {configurations[singular.argmax()].tolist()}; RegularPart(region, task, "
            "sigma_min) leaves them out",
            given=configurations,
        )
    s, slope = saturation.s(e), saturation.ds(e)
    return Samples(truths, configurations, x_d, M, dM, J, J_e, J_hat, dJ_hat, s, slope)
