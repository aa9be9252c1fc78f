"""`VelocityServo`: the inner loop of a robot that takes velocities of its joints."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.formatting import short_fields
from approxjac.simulation.sensing import Sensing
from approxjac.validation import as_number

_SHORTEST = 1e-3  # lag; a run goes on in steps of at most that [s]


@dataclass(frozen=True, repr=False)
class VelocityServo:
    """The robot's own loop around its joints, where a controller commands q̇ in place of torques.

    It takes a command every `period`, acts on it `delay` later, and makes q̇ follow it with a
    first-order lag, lag · q̈ = q̇_cmd − q̇, by the torque

        τ = M(q)(q̇_cmd − q̇)/lag + C(q, q̇)q̇ + g(q) + friction

    of the true arm, clipped at the limits of its motors (`Plant.motor_limits`). It is a good servo:
    it has no errors but these. What it does not know is whatever the arm runs into; a joint that
    is held up, or whose motor is at its limit, disturbs the others. Until the first command takes
    effect it holds the arm at rest. Limits of speed are the controller's to keep.

    It stands for a robot that takes positions, too, if that is sent ∫q̇_cmd dt and follows it with
    this lag: from the same start both then move alike. Not where it is held up: there the integral
    goes on ahead, and is caught up with later.

    Attributes:
        lag: Time constant, ≥ 1 ms [s].
        delay: Time from a command that is taken to its effect [s].
        period: Time between commands that are taken [s]; others are not seen.
        quantum: Steps in which positions are measured, as `Sensing.q_quantum` [rad or m].

    Raises:
        InvalidInputError: A number that is negative, not finite or too small.
    """

    lag: float = 0.03
    delay: float = 0.008
    period: float = 0.008
    quantum: float = 0.0
    __repr__ = short_fields

    def __post_init__(self) -> None:
        as_number("lag", self.lag, unit="s", minimum=_SHORTEST)
        as_number("delay", self.delay, unit="s", minimum=0.0)
        as_number("period", self.period, unit="s", above=0.0)
        as_number("quantum", self.quantum, unit="rad or m", minimum=0.0)

    def sensed(self, sensing: Sensing | None) -> Sensing | None:
        """Return sensing with the servo's quanta of positions.

        Raises:
            InvalidInputError: It has quanta of its own.
        """
        if self.quantum == 0.0:
            return sensing
        sensing = Sensing() if sensing is None else sensing
        if np.any(sensing.q_quantum):
            raise InvalidInputError(
                f"quantum of the servo must be 0 where the sensing has a q_quantum of its own, "
                f"got {self.quantum:g} beside {sensing!r}",
                given=self,
            )
        return replace(sensing, q_quantum=self.quantum)
