"""Limits of effort on symbols: what `TorqueLimited` does where it needs no solver."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.codegen.trace.symbols import Condition, Scalar, Symbols, any_of, symbols
from approxjac.controllers.limits.torque_limited import TorqueLimited
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status

_LARGEST = np.finfo(float).max


class TracedTorque(NamedTuple):
    """A torque within its limits.

    Attributes:
        torque: Shape (n_v,).
        status: The number of a `LimitStatus`.
        slack: σ [W]; 0 where it is not known, infinite where it overflows.
        rests: Whether what is learnt rests.
    """

    torque: Symbols
    status: Any
    slack: Any
    rests: Condition


def require_covered(controller: TorqueLimited) -> None:
    """Refuse a limiter of which no code can be made.

    Raises:
        InvalidInputError: Other limits than those of effort, a weight that is no diagonal, or a
            cross_weight.
    """
    if type(controller) is not TorqueLimited:
        raise InvalidInputError(
            "controller must be a TorqueLimited itself to make code of it, got "
            f"{type(controller).__name__}: {controller!r}",
            given=controller,
        )
    limits = controller.limits
    for name in ("rate", "velocity", "position", "acceleration"):
        if np.isfinite(np.asarray(getattr(limits, name))).any():
            raise InvalidInputError(
                f"limits must be those of effort alone to make code of them, Limits(effort=...), "
                f"got one of {name}: {limits!r}",
                given=limits,
            )
    if controller.motion_limits:
        raise InvalidInputError(
            "limits must be those of effort alone to make code of them, got "
            f"{controller.motion_limits!r}",
            given=controller.motion_limits,
        )
    if controller.cross_weight is not None:
        raise InvalidInputError(
            f"cross_weight must be None to make code of a limiter, got {controller.cross_weight!r}",
            given=controller.cross_weight,
        )
    if controller._diagonal is None:
        raise InvalidInputError(
            'weight must be "joint inertia", "identity" or a diagonal to make code of it, got '
            f"{controller.weight!r}",
            given=controller.weight,
        )


class TracedLimiter:
    """A `TorqueLimited` with limits of effort alone, whose `step` takes symbols.

    Joints that are not at a limit go on learning where the proof is given up, but not where the law
    asks for more than the motors have: so nothing does, with these limits.
    """

    def __init__(self, limiter: TorqueLimited) -> None:
        require_covered(limiter)
        self._limiter, self.task = limiter, limiter.task

    def step(
        self, state: Symbols, measurement: Measurement, target: Any, dt: Any
    ) -> tuple[Symbols, Evaluation]:
        """Return what `TorqueLimited.step` does."""
        own = self._limiter._law
        after, answer = own.step(state, measurement, target, dt)
        torque, status, slack, rests = limited(self._limiter, answer, measurement.v)
        p = own.resting
        after = np.concatenate([law.select(rests, state[:p], after[:p]), after[p:]])
        return after, answer._replace(torque=torque, limit_status=status, slack=slack)


def limited(limiter: TorqueLimited, answer: Evaluation, v: Symbols) -> TracedTorque:
    """Return the torque of an answer within limits of effort alone."""
    upper = np.asarray(limiter.limits.effort)
    lower, torque = -upper, answer.torque
    clipped = np.minimum(np.maximum(torque, lower), upper)
    beyond = any_of(~(clipped == torque))
    if not isinstance(beyond, Scalar):
        return TracedTorque(torque, LimitStatus.FREE, 0.0, False)
    status: Any = LimitStatus.LIMITED
    found: Any = clipped
    slack: Any = 0.0
    if limiter.proof:
        y = limiter._law.passive_output(answer, v, limiter.alpha)
        if answer.reference is not None:
            y = y - answer.reference
        diagonal, rho = limiter._diagonal, limiter._rho
        found, slack = law.limited_torque(torque, y, lower, upper, diagonal, rho)  # type: ignore[arg-type]
        is_proven = answer.status == Status.OK
        kept = law.select(slack == 0.0, LimitStatus.PROOF_KEPT, LimitStatus.PROOF_GIVEN_UP)
        status = law.select(is_proven, kept, status)
        slack = law.select(is_proven, slack, 0.0)
    found = np.where(np.abs(torque) <= _LARGEST, found, torque)  # what overflows is told as such
    values = [*symbols(found).tolist(), status, slack]
    others = [*torque.tolist(), LimitStatus.FREE, 0.0]
    *found, status, slack = beyond.graph.rare(beyond, values, others)
    rests = beyond
    if limiter.proof:
        rests = beyond & ~(status == LimitStatus.PROOF_KEPT)
    return TracedTorque(symbols(found), status, slack, rests)
