"""Limits of effort on symbols: what `TorqueLimited` does where it needs no solver."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.codegen import traced_setpoint as setpoint
from approxjac.codegen.arm.rigid_body import Configured
from approxjac.codegen.trace.symbols import Condition, Scalar, Symbols, any_of, symbols
from approxjac.controllers.controller import Controller
from approxjac.controllers.gains.gains import Diagonals
from approxjac.controllers.limits.torque_limited import TorqueLimited
from approxjac.controllers.setpoint import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.interface import LimitStatus, Status
from approxjac.law.limits import power_zero

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


def law_of(controller: Controller) -> SetpointController:
    """Return the law of a controller that `require_covered` takes, as it is inside of limits."""
    law = controller._law if isinstance(controller, TorqueLimited) else controller
    assert isinstance(law, SetpointController)
    return law


def require_covered(controller: Controller) -> None:
    """Refuse a controller of which no code can be made.

    Raises:
        InvalidInputError: Another law than `setpoint.require_covered` takes, other limits than
            those of effort, a weight that is no diagonal, or a cross_weight.
    """
    controller = getattr(controller, "ordinary", controller)  # of one that is compiled
    if isinstance(controller, TorqueLimited) and type(controller) is not TorqueLimited:
        raise InvalidInputError(
            "controller must be a TorqueLimited itself to make code of it, got "
            f"{type(controller).__name__}: {controller!r}",
            given=controller,
        )
    if not isinstance(controller, TorqueLimited):
        setpoint.require_covered(controller)
        return
    setpoint.require_covered(controller.controller)
    limits = controller.limits
    for name in ("rate", "velocity", "position"):
        if np.isfinite(np.asarray(getattr(limits, name))).any():
            raise InvalidInputError(
                f"limits must be those of effort alone to make code of them, Limits(effort=...), "
                f"got one of {name}: {limits!r}",
                given=limits,
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


def answer(
    controller: Controller,
    arm: Configured,
    q: Symbols,
    v: Symbols,
    x: Symbols,
    x_d: Symbols,
    state: Symbols,
    *,
    may_lose: bool,
    v_d: Symbols | None = None,
    gains: Diagonals | None = None,
) -> tuple[setpoint.Answer, TracedTorque]:
    """Return what `setpoint.answer` does, with the rate of what does not rest; and its limits."""
    law = law_of(controller)
    found = setpoint.answer(law, arm, q, v, x, x_d, state, may_lose=may_lose, v_d=v_d, gains=gains)
    within = limited(controller, found, v)
    rate = symbols(found.rate)
    rate[: law.resting] = np.where(within.rests, 0.0, rate[: law.resting])
    return found._replace(rate=rate), within


def limited(controller: Controller, answer: setpoint.Answer, v: Symbols) -> TracedTorque:
    """Return what `TorqueLimited.step` does with an answer, with limits of effort alone.

    Joints that are not at a limit go on learning where the proof is given up, but not where the law
    asks for more than the motors have: so nothing does, with these limits.

    Args:
        controller: The limiter; any other controller leaves the answer as it is.
        answer: Answer of the law inside of it.
        v: Joint velocity, shape (n_v,).
    """
    if not isinstance(controller, TorqueLimited):
        return TracedTorque(answer.torque, float(LimitStatus.UNLIMITED), 0.0, False)
    limiter = controller
    upper = np.asarray(limiter.limits.effort)
    lower, torque = -upper, answer.torque
    clipped = np.minimum(np.maximum(torque, lower), upper)
    beyond = any_of(~(clipped == torque))
    if not isinstance(beyond, Scalar):
        return TracedTorque(torque, float(LimitStatus.FREE), 0.0, False)
    status: Any = float(LimitStatus.LIMITED)
    found: Any = clipped
    slack: Any = 0.0
    rests: Any = beyond
    if limiter.proof:
        y = law.passive_output(v - answer.reference, answer.pinv_s, limiter.alpha)
        found, slack = _nearest(limiter, torque, y, lower, upper, clipped)
        is_proven = answer.status == float(setpoint.STATUSES.index(Status.OK))
        kept, given_up = float(LimitStatus.PROOF_KEPT), float(LimitStatus.PROOF_GIVEN_UP)
        status = np.where(is_proven, np.where(slack == 0.0, kept, given_up), status)
        slack = np.where(is_proven, slack, 0.0)
    found = np.where(np.abs(torque) <= _LARGEST, found, torque)  # what overflows is told as such
    values = [*symbols(found).tolist(), *(symbols(each)[()] for each in (status, slack))]
    others = [*torque.tolist(), float(LimitStatus.FREE), 0.0]
    *found, status, slack = beyond.graph.rare(beyond, values, others)
    if limiter.proof:
        rests = beyond & ~(status == float(LimitStatus.PROOF_KEPT))
    return TracedTorque(symbols(found), status, slack, rests)


def _nearest(
    limiter: TorqueLimited,
    torque: Symbols,
    y: Any,
    lower: Any,
    upper: Any,
    clipped: Symbols,
) -> tuple[Any, Any]:
    """Return what `law.limited_torque` does, without its first guess."""
    rho, step = limiter._rho, y / limiter._diagonal
    power: Any = y @ (clipped - torque)
    root: Any = power_zero(power, torque, y, lower, upper, step)
    least = np.minimum(np.maximum(torque - np.multiply(np.minimum(root, rho), step), lower), upper)
    left = np.where(root <= rho, 0.0, y @ (least - torque))
    is_positive, is_finite = power > 0.0, power < np.inf
    found = np.where(is_positive & is_finite, least, clipped)
    return found, np.where(is_finite, np.where(is_positive, left, 0.0), np.inf)
