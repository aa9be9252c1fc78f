"""Scenarios: a true robot, a posture and an error, and all that the conditions need of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.simulation import Plant
from approxjac.stability.inverse_kinematics import attain
from approxjac.stability.region import Region
from approxjac.stability.visibility import SeenPart, UnattainedError, between
from approxjac.tasks.analysis import jacobian_gradient, require_jacobian_of_q
from approxjac.validation import Array

Indices = NDArray[np.intp]
_STARTS = 20  # of the search for postures that attain a target
_DECADES = 6.0  # of the sizes of small errors
_SINGULAR = 1e-9  # σ_min as a share of σ_max at which Ĵ⁺ cannot be computed


@dataclass(frozen=True, eq=False, repr=False)
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

    def __repr__(self) -> str:
        return f"Scenarios({len(self)} of {len(set(self.truth.tolist()))} true robots)"

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


@dataclass(frozen=True, eq=False)
class Targets:
    """Postures that are taken as targets.

    Attributes:
        truth: Which of the true robots, shape (N,).
        q: Posture, shape (N, nq).
    """

    truth: Indices
    q: Array

    def __len__(self) -> int:
        return len(self.q)

    def take(self, which: Indices) -> Targets:
        """Those of some indices."""
        return Targets(self.truth[which], self.q[which])


class Sampler:
    """Draws scenarios of a controller on one of several true robots.

    Postures and targets are those that the true robot's sensor sees.

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
        self.parts = [SeenPart(region, plant.sensor, k) for k, plant in enumerate(plants)]
        self._attained: list[list[Array]] | None = None

    def draw(
        self, n: int, rng: np.random.Generator, progress: Callable[[int], None] | None = None
    ) -> Scenarios:
        """Draw n scenarios, or more to have every true robot as often.

        A third of them have e = 0, where every motion is to end, a third small errors of all
        sizes, and a third those between two postures of the region. Without the first two a
        saturated s(e) would be looked at where it is flat only.
        """
        truths, postures = self._drawn(n, rng)
        away = self._away(len(truths), rng)
        model = self.region.robot.model
        if self.target is None:
            others = self._seen(truths, self.region.sample(len(truths), rng), rng)
            sensors = [self.plants[t].sensor for t in truths]
            ends = [
                between(sensor, q, other, share)
                for sensor, q, other, share in zip(sensors, postures, others, away, strict=True)
            ]
            x_d = np.array([sensor.value(q) for sensor, q in zip(sensors, ends, strict=True)])
            return self._evaluate(truths, postures, x_d, progress)
        known = self.attained(rng)
        for i, (t, share) in enumerate(zip(truths, away, strict=True)):
            end = known[t][rng.integers(len(known[t]))]
            nearer = np.array(pin.interpolate(model, end, postures[i], share))
            if self.parts[t].contains(nearer):
                postures[i] = nearer
        return self._evaluate(truths, postures, self._targets(len(truths)), progress)

    def attained(self, rng: np.random.Generator) -> list[list[Array]]:
        """Postures of the region that attain the target, for each true robot at least one.

        Raises:
            UnattainedError: There is none for one of them.
        """
        if self._attained is None:
            self._attained = [self._attaining(index, rng) for index in range(len(self.plants))]
        return self._attained

    def targets(self, n: int, rng: np.random.Generator) -> Targets:
        """What may be targets: postures that attain the one target, or n drawn ones."""
        if self.target is None:
            return Targets(*self._drawn(n, rng))
        known = self.attained(rng)
        truths = np.repeat(np.arange(len(known)), [len(postures) for postures in known])
        return Targets(truths, np.concatenate(known))

    def near(
        self, known: Scenarios, k: int, n: int, size: float, rng: np.random.Generator
    ) -> Scenarios:
        """N scenarios of the same true robot as the k-th known one, at postures near its own."""
        truth = int(known.truth[k])
        sizes = size * 10.0 ** rng.uniform(-1.0, 0.5, n)
        part = self.parts[truth]
        postures = np.array([part.near(known.q[k], each, rng) for each in sizes])
        x_d = np.repeat(known.x_d[k : k + 1], n, axis=0)
        return self._evaluate(np.full(n, truth), postures, x_d, None)

    def at(self, truths: Indices, postures: Array) -> Scenarios:
        """Scenarios of chosen true robots and postures, with the one target."""
        return self._evaluate(truths, postures, self._targets(len(postures)), None)

    def _drawn(self, n: int, rng: np.random.Generator) -> tuple[Indices, Array]:
        """At least n true robots in turn, and postures that they see."""
        truths = np.arange(-(-n // len(self.plants)) * len(self.plants)) % len(self.plants)
        return truths, self._seen(truths, self.region.sample(len(truths), rng), rng)

    def _seen(self, truths: Indices, postures: Array, rng: np.random.Generator) -> Array:
        """Postures of the region, with others for those that their true robot does not see."""
        for t, part in enumerate(self.parts):
            postures[truths == t] = part.instead(postures[truths == t], rng)
        return postures

    def _targets(self, n: int) -> Array:
        """The target n times; of a sampler that has one."""
        return np.repeat(np.asarray(self.target)[None], n, axis=0)

    @staticmethod
    def _away(n: int, rng: np.random.Generator) -> Array:
        """How far from the target, as a share of the way to another posture, shape (n,)."""
        kinds = rng.integers(3, size=n)
        sizes = 10.0 ** rng.uniform(-_DECADES, 0.0, n)
        return np.choose(kinds, [np.zeros(n), sizes, np.ones(n)])

    def _attaining(self, index: int, rng: np.random.Generator) -> list[Array]:
        sensor, target = self.plants[index].sensor, self._targets(1)[0]
        starts = self.parts[index].sample(_STARTS, rng)
        attained = [q for q in (attain(sensor, target, start) for start in starts) if q is not None]
        if not attained:
            raise UnattainedError(
                f"target must be within reach of every true robot, got {target.tolist()}, which "
                f"no posture of {sensor.robot!r} was found to attain",
                given=target,
                truth=index,
            )
        within = [q for q in attained if self.region.contains(q)]
        if not within:
            raise UnattainedError(
                f"target must be attained by a posture of the region for every true robot, got "
                f"{target.tolist()}, which {sensor.robot.name} attains outside {self.region!r} "
                "only",
                given=target,
                truth=index,
            )
        return within

    def _evaluate(
        self,
        truths: Indices,
        postures: Array,
        x_d: Array,
        progress: Callable[[int], None] | None,
    ) -> Scenarios:
        task, saturation = self.controller.task, self.controller.saturation
        require_jacobian_of_q(task, "the conditions over a region")
        N, n, m = len(postures), task.robot.nv, task.m
        M, dM = np.empty((N, n, n)), np.empty((N, n, n, n))
        J, J_e, J_hat = np.empty((N, m, n)), np.empty((N, m, n)), np.empty((N, m, n))
        dJ_hat, e = np.empty((N, n, m, n)), np.empty((N, m))
        for i, (t, q) in enumerate(zip(truths, postures, strict=True)):
            plant = self.plants[t]
            dynamics, sensor = plant.dynamics, plant.sensor
            M[i] = dynamics.M(q)
            e[i] = sensor.error(sensor.value(q), x_d[i])
            J[i] = sensor._sensor_jacobian(q)
            J_e[i] = sensor._error_jacobian(e[i], J[i])
            J_hat[i] = task.jacobian(q)
            dM[i] = dynamics.M_gradient(q)
            dJ_hat[i] = jacobian_gradient(task, q)
            if progress is not None and i % 100 == 99:
                progress(i + 1)
        _require_regular(J_hat, postures)
        return Scenarios(
            truths, postures, x_d, M, dM, J, J_e, J_hat, dJ_hat, saturation.s(e), saturation.ds(e)
        )


def _require_regular(J_hat: Array, postures: Array) -> None:
    """Refuse postures where Ĵ⁺ does not exist."""
    values = np.linalg.svd(J_hat, compute_uv=False)
    singular = values[:, -1] <= _SINGULAR * values[:, 0]
    if singular.any():
        raise InvalidInputError(
            "the region must hold no posture where the estimated Jacobian loses rank, got q = "
            f"{postures[singular.argmax()].tolist()}; RegularPart(region, task, sigma_min) leaves "
            "them out",
            given=postures,
        )
