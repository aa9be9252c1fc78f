"""What limits did in every step of a run, of which a record has only some."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from approxjac.controllers import ControllerWrapper
from approxjac.interface import Controller, Evaluation, LimitStatus, Measurement, Target
from approxjac.validation import Array


@dataclass
class Tally:
    """What limits did in the steps of one run.

    Attributes:
        counts: Steps with each status.
        known_slack: Largest σ that was reported in a step that was limited [W]; NaN if none was.
        torque_violation: How far a torque was beyond its limit at most [N m or N]; 0 if none was.
    """

    counts: dict[LimitStatus, int] = field(default_factory=dict)
    known_slack: float = math.nan
    torque_violation: float = 0.0

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


class Watched(ControllerWrapper):
    """A controller, and a count of what limits did to its answers; for one run.

    Args:
        controller: The controller.
        effort: What its torques must not exceed, shape (n_v,) [N m or N].

    Attributes:
        controller: The controller.
        tally: The count.
    """

    def __init__(self, controller: Controller, effort: Array) -> None:
        self._remember(locals())
        self.tally = Tally()
        self.controller = controller
        self._effort = effort
        self._last, self._memory = -math.inf, 0

    def initial_state(self, measurement: Measurement) -> Array:
        """That of the controller."""
        return self.controller.initial_state(measurement)

    def step(
        self, state: Array, measurement: Measurement, target: Target | Array, dt: float
    ) -> tuple[Array, Evaluation]:
        """What the controller answers."""
        after, answer = self.controller.step(state, measurement, target, dt)
        if measurement.t > self._last:  # `simulate` asks for the first answer twice
            self._last = measurement.t
            self._count(answer)
        return after, answer

    def _count(self, answer: Evaluation) -> None:
        tally, status = self.tally, answer.limit_status
        tally.counts[status] = tally.counts.get(status, 0) + 1
        if status is not LimitStatus.FREE:  # which says 0 of any limiter
            tally.known_slack = float(np.fmax(tally.known_slack, answer.slack))
        beyond = float((np.abs(answer.torque) - self._effort).max())
        tally.torque_violation = max(tally.torque_violation, beyond)
