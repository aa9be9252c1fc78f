"""The usual ways to keep limits of torques, to compare `TorqueLimited` with."""

import math

import numpy as np

import approxjac as aj


def clipped(law, limits):
    """Return a law whose torques are clipped joint by joint; the direction of its force turns."""
    return aj.TorqueLimited(law, aj.Limits(limits.effort), proof=False)


class TaskTorqueScaled(aj.TorqueLimited):
    """A law whose torque beyond gravity is scaled down until no joint is beyond its limit.

    τ = g + c(τ* − g) with the largest c ≤ 1 within the limits, so that the direction of the force
    stays. Where gravity alone is beyond a limit, it is clipped and c = 0. It keeps limits of
    effort and rate; those of joint positions and velocities it cannot. Gravity is learnt only
    while nothing is scaled.
    """

    def limited(self, answer, gravity, measurement, asked, memory):
        """Return the scaled torque, its status, no slack, and what is kept."""
        lower, upper = asked.lower, asked.upper
        hold = np.minimum(np.maximum(gravity, lower), upper)
        change = answer.torque - hold
        room = np.where(change > 0.0, upper - hold, lower - hold)
        moves = change != 0.0
        share = np.min(room[moves] / change[moves], initial=1.0)
        torque = np.minimum(np.maximum(hold + share * change, lower), upper)
        return torque, aj.LimitStatus.LIMITED, math.nan, memory
