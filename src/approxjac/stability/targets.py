"""Test 3 over a region: the linearisation with each posture as a target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from approxjac.controllers import SetpointController
from approxjac.stability.local import linearised
from approxjac.stability.samples import Indices, Sampler, Scenarios, Targets
from approxjac.validation import Array

_LOCAL = 1000  # postures at most


@dataclass(frozen=True, eq=False, repr=False)
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

    def __repr__(self) -> str:
        slowest = f"slowest decay {self.decay_rates.min():.3g}/s"
        return f"LocalTest(stable at {100 * self.share:.4g} % of {len(self.q)} postures, {slowest})"

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
    sampler: Sampler,
    targets: Scenarios | Targets,
    controller: SetpointController | None = None,
) -> LocalTest:
    """Linearise the closed loop with each posture (of the first thousand) as a target.

    Args:
        sampler: Of the postures, with their true robots.
        targets: The postures.
        controller: Another one than the sampler's, of the same task.
    """
    truth, postures = targets.truth[:_LOCAL], targets.q[:_LOCAL]
    at = [
        linearised(sampler.plants[t], controller or sampler.controller, q)
        for t, q in zip(truth, postures, strict=True)
    ]
    return LocalTest(
        np.array([0.0 if each.singular else each.decay_rate for each in at]),
        np.array([each.damping_ratio for each in at]),
        postures,
        truth,
    )
