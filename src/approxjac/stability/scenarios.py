"""Scenarios: a true robot, a posture and an error, and all that the conditions need of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from approxjac.checks import Array
from approxjac.controllers import SetpointController
from approxjac.simulation import Plant
from approxjac.stability.region import Region

Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Scenarios:
    """What the conditions need at N combinations of true robot, posture and target.

    Attributes:
        truth: Which of the true robots, shape (N,).
        q: Posture, shape (N, nq).
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

    def __len__(self) -> int:
        return len(self.q)

    def take(self, which: Indices) -> Scenarios:
        """Those of some indices."""
        return Scenarios(*(getattr(self, f.name)[which] for f in fields(self)))

    def join(self, other: Scenarios) -> Scenarios:
        """These and others."""
        return Scenarios(
            *(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self))
        )


class Sampler:
    """Draws scenarios of a controller on one of several true robots.

    Args:
        controller: The controller.
        plants: The true robots.
        region: Where postures are drawn from.
        target: x_d, or None for the values of other postures of the region.
    """

    def __init__(
        self,
        controller: SetpointController,
        plants: Sequence[Plant],
        region: Region,
        target: Array | None,
    ) -> None:
        self.controller, self.plants, self.region, self.target = controller, plants, region, target

    def draw(
        self, n: int, rng: np.random.Generator, progress: Callable[[int], None] | None = None
    ) -> Scenarios:
        """Draw n scenarios, the true robots in turn."""
        truths = np.arange(n) % len(self.plants)
        postures = self.region.sample(n, rng)
        if self.target is not None:
            x_d = np.repeat(self.target[None], n, axis=0)
        else:
            sensors = [plant.sensor for plant in self.plants]
            others = self.region.sample(n, rng)
            x_d = np.array([sensors[t].value(q) for t, q in zip(truths, others, strict=True)])
        return self._evaluate(truths, postures, x_d, progress)

    def near(
        self, known: Scenarios, k: int, n: int, size: float, rng: np.random.Generator
    ) -> Scenarios:
        """N scenarios of the same true robot as the k-th known one, at postures near its own."""
        truth = int(known.truth[k])
        sizes = size * 10.0 ** rng.uniform(-1.0, 0.5, n)
        postures = np.array([self.region.near(known.q[k], each, rng) for each in sizes])
        x_d = np.repeat(known.x_d[k : k + 1], n, axis=0)
        return self._evaluate(np.full(n, truth), postures, x_d, None)

    def at(self, truths: Indices, postures: Array) -> Scenarios:
        """Scenarios of chosen true robots and postures, where there is one target."""
        if self.target is None:
            raise ValueError("no target")
        x_d = np.repeat(self.target[None], len(postures), axis=0)
        return self._evaluate(truths, postures, x_d, None)

    def _evaluate(
        self,
        truths: Indices,
        postures: Array,
        x_d: Array,
        progress: Callable[[int], None] | None,
    ) -> Scenarios:
        task, saturation = self.controller.task, self.controller.saturation
        N, n, m = len(postures), task.robot.nv, task.m
        M, dM = np.empty((N, n, n)), np.empty((N, n, n, n))
        J, J_e, J_hat = np.empty((N, m, n)), np.empty((N, m, n)), np.empty((N, m, n))
        dJ_hat, e = np.empty((N, n, m, n)), np.empty((N, m))
        for i, (t, q) in enumerate(zip(truths, postures, strict=True)):
            plant = self.plants[t]
            dynamics, sensor = plant.dynamics, plant.sensor
            M[i] = dynamics.M(q)
            e[i] = sensor.error(sensor.value(q), x_d[i])
            J[i] = J_e[i] = sensor.jacobian(q)
            if not sensor.subtracts:
                J_e[i] = np.array([sensor.error_rate(e[i], column) for column in J[i].T]).T
            J_hat[i] = task.jacobian(q)
            dM[i] = dynamics.M_gradient(q)
            dJ_hat[i] = task.jacobian_gradient(q)
            if progress is not None and i % 100 == 99:
                progress(i + 1)
        return Scenarios(
            truths, postures, x_d, M, dM, J, J_e, J_hat, dJ_hat, saturation.s(e), saturation.ds(e)
        )
