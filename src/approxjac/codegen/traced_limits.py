"""Limits on symbols: a step of `TorqueLimited`, which solves with an interior minimum."""

from __future__ import annotations

from typing import Any

import numpy as np

from approxjac import law
from approxjac.codegen.trace.symbols import Condition, Scalar, Symbols, any_of, symbols
from approxjac.controllers.limits.limiter import Asked
from approxjac.controllers.limits.torque_limited import TorqueLimited
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status, Target
from approxjac.validation import Array

_LARGEST = np.finfo(float).max
_UNSET = 1e20  # of the torque before the first one
_SET = 1e19  # what is above it is not set


def require_covered(controller: TorqueLimited) -> None:
    """Refuse a limiter of which no code can be made.

    Raises:
        InvalidInputError: A class derived from `TorqueLimited`, a cross_weight, or another solver
            than DAQP where one is needed.
    """
    if type(controller) is not TorqueLimited:
        raise InvalidInputError(
            "controller must be a TorqueLimited itself to make code of it, got "
            f"{type(controller).__name__}: {controller!r}",
            given=controller,
        )
    if controller.cross_weight is not None:
        raise InvalidInputError(
            f"cross_weight must be None to make code of a limiter, got {controller.cross_weight!r}",
            given=controller.cross_weight,
        )
    solver = controller._solver.name
    if solver != "daqp" and (controller._looks_ahead or controller._diagonal is None):
        raise InvalidInputError(
            f"solver must be 'daqp' to make code of a limiter that needs one, got {solver!r}",
            given=solver,
        )


def solves(controller: Any) -> bool:
    """Return whether a controller, or one inside of it, is a limiter that needs a solver."""
    while controller is not None:
        if isinstance(controller, TorqueLimited):
            return controller._looks_ahead or controller._diagonal is None
        controller = getattr(controller, "controller", None)
    return False


class TracedLimiter:
    """A `TorqueLimited` whose `step` takes symbols."""

    def __init__(self, limiter: TorqueLimited) -> None:
        require_covered(limiter)
        self._limiter, self.task = limiter, limiter.task

    def initial_state(self, measurement: Measurement) -> Symbols:
        """Return a first state; the torque before, of a limit of the rate, comes with its step."""
        limiter = self._limiter
        before = np.full(limiter._memory - len(limiter._kept), _UNSET)
        inner = limiter._law.initial_state(measurement)
        return symbols(np.concatenate([inner, limiter._kept, before]))

    def step(
        self, state: Symbols, measurement: Measurement, target: Target | Array, dt: Any
    ) -> tuple[Symbols, Evaluation]:
        """Return what `TorqueLimited.step` does."""
        limiter = self._limiter
        own, upper = limiter._law, np.asarray(limiter.limits.effort)
        lower, n = -upper, len(state) - limiter._memory
        state, memory = state[:n], state[n:]
        after, answer = own.step(state, measurement, target, dt)
        wanted, gravity = answer.torque, answer.gravity
        if gravity is None:
            gravity = own.gravity_torque(state, measurement.q)
        if limiter._has_rate:
            memory, before = memory[: -len(upper)], memory[-len(upper) :]
            before = np.where(before > _SET, gravity, before)
            before = np.minimum(np.maximum(before, lower), upper)
            lower, upper = law.rate_bounds(before, limiter._rate, dt, lower, upper)
        if len(memory) and not isinstance(measurement.t, float | Scalar):
            due = law.select(memory[0] > _SET, 0.0, memory[0])  # nothing tells: it is on time
            measurement = measurement._replace(t=due)
        clipped = np.minimum(np.maximum(wanted, lower), upper)
        free = law.complement(any_of(~(clipped == wanted)))
        asked = Asked(answer, gravity, measurement, lower, upper, clipped, free, memory)
        found, memory, status, slack = _limited(limiter, asked)
        rests = law.complement(any_of([status == each for each in _LEARNS]))
        p = own.resting
        if p:
            given_up = rests & (status == LimitStatus.PROOF_GIVEN_UP)
            self._leave(given_up, answer)
            after = np.concatenate([law.select(rests, state[:p], after[:p]), after[p:]])
        # what overflows is told as such
        torque = np.where(np.abs(wanted) <= _LARGEST, found, wanted)
        after = np.concatenate([after, memory, torque] if limiter._has_rate else [after, memory])
        return after, answer._replace(torque=torque, limit_status=status, slack=slack)

    def _leave(self, given_up: Condition, answer: Evaluation) -> None:
        """Leave to Python what joints that are at no limit learn, as `Limiter.step` has it."""
        if self._limiter._looks_ahead:
            effort = np.asarray(self._limiter.limits.effort)
            law.leave(given_up & law.complement(any_of(np.abs(answer.torque) > effort)))


_LEARNS = LimitStatus.FREE, LimitStatus.PROOF_KEPT, LimitStatus.EXCEEDED


def _limited(limiter: TorqueLimited, asked: Asked) -> tuple[Symbols, Symbols, Any, Any]:
    """Return the torque, what is kept, the status and the slack of one step."""
    answer, _, measurement, *_, memory = asked
    v = measurement.v

    def output() -> tuple[Symbols, Any]:
        y = limiter._law.passive_output(answer, v, limiter.alpha)
        y = y if answer.reference is None else y - answer.reference
        return y, limiter.price(y, v)

    residual = rows = None
    if limiter._looks_ahead:
        residual = limiter._prediction.residual(memory, measurement)
        rows = limiter.rows(measurement)
    solve = law.interior_minimum
    step = limiter.limited(asked, residual, rows, output, solve, solve)
    free: Any = LimitStatus.FREE
    if rows is not None and residual is not None:
        free = law.select(limiter.is_exceeded(measurement), LimitStatus.EXCEEDED, free)
        memory = limiter._prediction.expecting(measurement, step.f, residual)
    status: Any = LimitStatus.LIMITED
    slack: Any = 0.0
    if limiter.proof:
        is_proven = answer.status == Status.OK
        kept = law.select(step.slack == 0.0, LimitStatus.PROOF_KEPT, LimitStatus.PROOF_GIVEN_UP)
        status = law.select(is_proven, kept, status)
        slack = law.select(is_proven, step.slack, 0.0)
    status = law.select(step.verdict > 0, LimitStatus.INFEASIBLE, status)
    is_free = step.free > 0.0
    return step.torque, memory, law.select(is_free, free, status), law.select(is_free, 0.0, slack)
