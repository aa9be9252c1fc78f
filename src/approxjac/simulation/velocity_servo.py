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

    of the true arm, clipped at the limits of its motors. So a good servo has no errors but these;
    what it does not know is whatever the arm runs into. Until the first command takes effect it
    holds the arm at rest.

    A robot that takes positions, told ∫q̇_cmd dt, answers a command in the same way as far as this
    lag is that of its positions: q = ∫q̇_cmd dt/(1 + lag s). Another is what holds it up: a motor at
    its limit or a stop leaves the integral ahead, and it catches up later, which this servo does
    not.

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
