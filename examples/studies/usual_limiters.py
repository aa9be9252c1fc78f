"""The usual ways to keep limits of torques, to compare `TorqueLimited` with."""

import math

import numpy as np

import approxjac as aj
from approxjac.controllers import Limiter
from approxjac.controllers.limits.limiter import Limited


def clipped(law, limits):
    """Return a law whose torques are clipped joint by joint; the direction of its force turns."""
    return aj.TorqueLimited(law, aj.Limits(limits.effort), proof=False)


class TaskTorqueScaled(Limiter):
    """A law whose torque beyond gravity is scaled down until no joint is beyond its limit.

    τ = g + c(τ* − g) with the largest c ≤ 1 within the limits, so that the direction of the force
    stays. Where gravity alone is beyond a limit, it is clipped and c = 0. It keeps limits of
    effort and rate; those of joint positions and velocities it cannot. Gravity is learnt only
    while nothing is scaled.

    Args:
        controller: The law whose torque to limit.
        limits: Limits to keep; those of the believed robot's URDF by default.
    """

    def _limit(self, asked):
        answer, g, _, lower, upper, *_ = asked
        hold = np.minimum(np.maximum(g, lower), upper)
        change = answer.torque - hold
        room = np.where(change > 0.0, upper - hold, lower - hold)
        moves = change != 0.0
        share = np.min(room[moves] / change[moves], initial=1.0)
        torque = np.minimum(np.maximum(hold + share * change, lower), upper)
        return Limited(torque, aj.LimitStatus.LIMITED, math.nan, asked.memory)
