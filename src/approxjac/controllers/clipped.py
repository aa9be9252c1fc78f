"""Clipped and scaled torques: the usual ways to keep limits, to compare `TorqueLimited` with."""

from __future__ import annotations

import math

import numpy as np

from approxjac.controllers.limiter import Asked, Limiter
from approxjac.interface import LimitStatus
from approxjac.validation import Array


class TorqueClipped(Limiter):
    """A controller whose torque is clipped, joint by joint; the direction of its force turns.

    It keeps limits of effort and rate; those of joint positions and velocities it cannot.
    Gravity is learnt only while nothing is clipped.

    Args:
        controller: The controller whose torque to limit.
        limits: Limits to keep; those of the believed robot's URDF by default.
    """

    def _limit(self, asked: Asked) -> tuple[Array, LimitStatus, float]:
        return asked.clipped, LimitStatus.LIMITED, math.nan


class TaskTorqueScaled(Limiter):
    """A controller whose torque beyond gravity is scaled down until no joint is beyond a limit.

    τ = g + c(τ* − g) with the largest c ≤ 1 within the limits, so that the direction of the force
    stays. Where gravity alone is beyond a limit, it is clipped and c = 0. It keeps limits of
    effort and rate; those of joint positions and velocities it cannot. Gravity is learnt only
    while nothing is scaled.

    Args:
        controller: The controller whose torque to limit.
        limits: Limits to keep; those of the believed robot's URDF by default.
    """

    def _limit(self, asked: Asked) -> tuple[Array, LimitStatus, float]:
        answer, g, _, lower, upper, _, _ = asked
        hold = np.minimum(np.maximum(g, lower), upper)
        change = answer.torque - hold
        room = np.where(change > 0.0, upper - hold, lower - hold)
        moves = change != 0.0
        share = np.min(room[moves] / change[moves], initial=1.0)
        torque = hold + share * change
        return np.minimum(np.maximum(torque, lower), upper), LimitStatus.LIMITED, math.nan
