"""`Tally`: what limits did in every step of a run, of which a record has only some."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from approxjac.interface import LimitStatus
from approxjac.simulation import SampledLoop
from approxjac.validation import Array


class Tally:
    """An observer of `simulate` that counts, for one run, what limits did in each step.

    Args:
        effort: What torques must not exceed, shape (n_v,) [N m or N].
        observer: Another observer, which is called after it.

    Attributes:
        counts: Steps with each status.
        known_slack: Largest σ that was reported in a step that was limited [W]; NaN if none was.
        torque_violation: How far a torque was beyond its limit at most [N m or N]; 0 if none was.
    """

    def __init__(
        self, effort: Array, observer: Callable[[SampledLoop], None] | None = None
    ) -> None:
        self.counts: dict[LimitStatus, int] = {}
        self.known_slack = math.nan
        self.torque_violation = 0.0
        self._effort, self._observer = effort, observer

    def __call__(self, loop: SampledLoop) -> None:
        """Count a step."""
        answer, status = loop.answer, loop.answer.limit_status
        self.counts[status] = self.counts.get(status, 0) + 1
        if status is not LimitStatus.FREE:  # which says 0 of any limiter
            self.known_slack = float(np.fmax(self.known_slack, answer.slack))
        beyond = float((np.abs(answer.torque) - self._effort).max())
        self.torque_violation = max(self.torque_violation, beyond)
        if self._observer is not None:
            self._observer(loop)

    def __enter__(self) -> Tally:
        if isinstance(self._observer, AbstractContextManager):
            self._observer.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        if isinstance(self._observer, AbstractContextManager):
            self._observer.__exit__(*error)

    @property
    def steps(self) -> int:
        """How many there were."""
        return sum(self.counts.values())

    @property
    def largest_slack(self) -> float:
        """Largest σ where it is known [W], 0 if nothing was limited; NaN if it is known nowhere."""
        return 0.0 if set(self.counts) <= {LimitStatus.FREE} else self.known_slack

    def shares(self) -> dict[LimitStatus, float]:
        """Share of the steps with each status, in the order of the statuses."""
        return {status: n / self.steps for status, n in sorted(self.counts.items())}
