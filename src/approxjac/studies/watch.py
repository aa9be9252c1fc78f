"""What limits did in every step of a run, of which a record has only some."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from approxjac.interface import Controller, Evaluation, LimitStatus, Measurement
from approxjac.tasks import Task
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


class Watched:
    """Passes on what a controller answers, and keeps count of what limits did to it.

    Unlike a controller it remembers, so it is for one run.

    Args:
        controller: The controller.
        effort: What its torques must not exceed, shape (n_v,) [N m or N].

    Attributes:
        controller: The controller.
        tally: The count.
    """

    def __init__(self, controller: Controller, effort: Array) -> None:
        self.tally = Tally()
        self.controller = controller
        self._effort = effort
        self._last = -math.inf

    @property
    def task(self) -> Task | None:
        """That of the controller."""
        return getattr(self.controller, "task", None)

    @property
    def dt(self) -> float | None:
        """That of the controller [s]."""
        return getattr(self.controller, "dt", None)

    @property
    def law(self) -> Any:
        """That of the controller."""
        return getattr(self.controller, "law", None)

    @property
    def n_state(self) -> int:
        """That of the controller."""
        return self.controller.n_state

    def initial_state(self, measurement: Measurement) -> Array:
        """That of the controller."""
        return self.controller.initial_state(measurement)

    def evaluate(self, state: Array, measurement: Measurement, target: Array) -> Evaluation:
        """What the controller answers."""
        answer = self.controller.evaluate(state, measurement, target)
        if measurement.t > self._last:  # `simulate` asks for the first answer twice
            self._last = measurement.t
            self._count(answer)
        return answer

    def with_task(self, task: Task) -> Watched:
        """Return this for its controller with another task; what was counted stays."""
        controller: Any = self.controller
        other = Watched(controller.with_task(task), self._effort)
        other.tally, other._last = self.tally, self._last
        return other

    def _count(self, answer: Evaluation) -> None:
        tally, status = self.tally, answer.limit_status
        tally.counts[status] = tally.counts.get(status, 0) + 1
        if status is not LimitStatus.FREE:  # which says 0 of any limiter
            tally.known_slack = float(np.fmax(tally.known_slack, answer.slack))
        beyond = float((np.abs(answer.torque) - self._effort).max())
        tally.torque_violation = max(tally.torque_violation, beyond)
