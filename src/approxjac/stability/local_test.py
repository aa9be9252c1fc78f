"""Test 3 over a region: the linearisation with each configuration as a target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from approxjac.controllers import SetpointController
from approxjac.stability.closed_loop import ClosedLoop
from approxjac.stability.local import linearised
from approxjac.stability.samples import Indices
from approxjac.validation import Array

_LOCAL = 1000  # configurations at most


@dataclass(frozen=True, eq=False, repr=False)
class LocalTest:
    """What the exact linearisation says with each configuration taken as a target.

    Attributes:
        decay_rates: −max Re λ without the self-motion's zeros, shape (N,) [1/s]; 0 where J or Ĵ is
            singular, which decides nothing.
        damping_ratios: Smallest −Re λ/‖λ‖, shape (N,).
        q: The configurations, shape (N, nq).
        truth: Index of the true robot, shape (N,).
    """

    decay_rates: Array
    damping_ratios: Array
    q: Array
    truth: Indices

    def __repr__(self) -> str:
        share, slowest = f"{100 * self.share:.4g} %", f"{self.decay_rates.min():.3g}/s"
        return (
            f"LocalTest(stable at {share} of {len(self.q)} configurations, slowest decay {slowest})"
        )

    @property
    def share(self) -> float:
        """Share of the configurations that are stable."""
        return float((self.decay_rates > 0.0).mean())

    @property
    def worst(self) -> int:
        """Index of the configuration with the slowest decay."""
        return int(self.decay_rates.argmin())

    @property
    def stable(self) -> bool:
        """Whether all are."""
        return bool((self.decay_rates > 0.0).all())


def local_test(
    loop: ClosedLoop,
    truths: Indices,
    configurations: Array,
    controller: SetpointController | None = None,
) -> LocalTest:
    """Linearise a closed loop with each configuration (of the first thousand) as a target.

    Args:
        loop: The closed loop.
        truths: Indices of the true robots, shape (N,).
        configurations: Shape (N, nq).
        controller: Another one than the loop's, of the same task.
    """
    truths, configurations = truths[:_LOCAL], configurations[:_LOCAL]
    at = [
        linearised(loop.plants[t], controller or loop.controller, q)
        for t, q in zip(truths, configurations, strict=True)
    ]
    return LocalTest(
        np.array([0.0 if each.singular else each.decay_rate for each in at]),
        np.array([each.damping_ratio for each in at]),
        configurations,
        truths,
    )
