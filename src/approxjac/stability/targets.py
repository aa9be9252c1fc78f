"""Test 3 over a region: the linearisation with each posture as a target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from approxjac.checks import Array
from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.stability.local import linearised
from approxjac.stability.scenarios import Indices, Sampler, Scenarios
from approxjac.tasks import Task

_LOCAL = 1000  # postures at most
_STARTS = 20  # of the search for postures that attain a target
_STEPS = 200  # of a search
_EXACT = 1e-10  # error that counts as none, relative to the size of the Jacobian
_LONGEST = 0.3  # step [rad or m]


@dataclass(frozen=True, eq=False)
class LocalTest:
    """What the exact linearisation says with each posture taken as a target.

    Attributes:
        decay_rates: −max Re λ without the self-motion's zeros, shape (N,) [1/s]; 0 where J or Ĵ is
            singular, which decides nothing.
        damping_ratios: Smallest −Re λ/‖λ‖, shape (N,).
        q: The postures, shape (N, nq).
        truth: Which of the true robots, shape (N,).
    """

    decay_rates: Array
    damping_ratios: Array
    q: Array
    truth: Indices

    @property
    def share(self) -> float:
        """Share of the postures that are stable."""
        return float((self.decay_rates > 0.0).mean())

    @property
    def worst(self) -> int:
        """Index of the posture with the slowest decay."""
        return int(self.decay_rates.argmin())

    @property
    def stable(self) -> bool:
        """Whether all are."""
        return bool((self.decay_rates > 0.0).all())


def local_test(
    sampler: Sampler, scenarios: Scenarios, controller: SetpointController | None = None
) -> LocalTest:
    """Linearise the closed loop with each posture (of the first thousand) as a target.

    Args:
        sampler: Of the scenarios, with their true robots.
        scenarios: The postures.
        controller: Another one than the sampler's, of the same task.
    """
    few = scenarios.take(np.arange(min(len(scenarios), _LOCAL)))
    at = [
        linearised(sampler.plants[t], controller or sampler.controller, q)
        for t, q in zip(few.truth, few.q, strict=True)
    ]
    return LocalTest(
        np.array([0.0 if each.singular else each.decay_rate for each in at]),
        np.array([each.damping_ratio for each in at]),
        few.q,
        few.truth,
    )


def attaining(sampler: Sampler, rng: np.random.Generator) -> Scenarios:
    """Postures that attain the target, for each true robot at least one.

    Raises:
        InvalidInputError: The target is out of reach of a true robot.
    """
    x_d = sampler.target
    if x_d is None:
        raise InvalidInputError("a target must be given", given=None)
    found: list[tuple[int, Array]] = []
    for index, plant in enumerate(sampler.plants):
        starts = sampler.region.sample(_STARTS, rng)
        postures = [attain(plant.sensor, x_d, q) for q in starts]
        attained = [(index, q) for q in postures if q is not None]
        within = [(index, q) for _, q in attained if sampler.region.contains(q)]
        if not attained:
            raise InvalidInputError(
                f"target must be within reach of every true robot, got {x_d.tolist()}, which no "
                f"posture of {plant.robot!r} was found to attain",
                given=x_d,
            )
        if not within:
            raise InvalidInputError(
                f"target must be attained by a posture of the region for every true robot, got "
                f"{x_d.tolist()}, which {plant.robot.name} attains outside {sampler.region!r} only",
                given=x_d,
            )
        found += within
    truths, postures_found = zip(*found, strict=True)
    return sampler.at(np.array(truths), np.array(postures_found))


def attain(sensor: Task, x_d: Array, q0: Array) -> Array | None:
    """A posture whose task value is x_d, from a start (nq,); None if the search finds none.

    Damped Gauss–Newton steps, which also end at rest where the target is out of reach.
    """
    q = np.array(q0)
    for _ in range(_STEPS):
        e, J = sensor.error(sensor.value(q), x_d), sensor.jacobian(q)
        size = float(np.linalg.norm(J, 2))
        error = float(np.linalg.norm(e))
        if error <= _EXACT * max(size, 1e-300):
            return q
        damping = (1e-3 * size) ** 2 * min(1.0, error / size)
        step = -J.T @ np.linalg.solve(J @ J.T + damping * np.eye(len(e)), e)
        longest = float(np.abs(step).max())
        q = np.array(pin.integrate(sensor.robot.model, q, step * min(1.0, _LONGEST / longest)))
    return None
