"""`AccelerationObserver`: predict q̈ with the believed arm, corrected by the last period.

A torque limiter keeps limits of speeds by it, and has to keep them while gravity is learnt. So it
does not take what is learnt for true: it predicts with the believed arm's own weight, and what
that is wrong by shows in how far the measured q̇ is from the predicted one.
"""

from __future__ import annotations

import numpy as np

from approxjac import law
from approxjac.controllers.arguments import HUGE
from approxjac.controllers.controller import Controller
from approxjac.interface import Measurement
from approxjac.validation import Array

_NEVER = 1e20  # [s], a time that is never measured


class AccelerationObserver:
    """q̈ = f(q, q̇, τ) + r, with f the believed dynamics and r the residual that periods have shown.

    After each period q̇ is f dt + r₁ dt from where it was, and r follows r₁ with a rate of its own:
    one at which damping may act, so that delays and filters which allow that damping allow r, and
    noise of q̇ becomes no more torque than with that damping.

    f has the believed arm's weight where gravity is learnt, so it does not depend on what is
    learnt; elsewhere it has what the controller compensates, which may be that of a robot that
    compensates itself.

    Its memory is flat: when the next q̇ is expected [s], that q̇ by f alone, and r; 1 + 2 n_v. A q̇
    that comes at another time than expected, by more than half a period, shows nothing.

    Owns scratch memory: one instance a thread.

    Args:
        controller: The law whose torques are predicted.
        dt: Period [s].
        rate: Of r [1/s], at most 1/dt.
    """

    def __init__(self, controller: Controller, dt: float, rate: float) -> None:
        robot = controller.task.robot
        self.dynamics, self.has_weight = controller.believed_dynamics()
        self.size = 1 + 2 * robot.nv
        self._n = robot.nv
        self._dt, self._rate, self._share = dt, np.array(rate), np.array(1.0 - rate * dt)
        self._half = 0.5 * dt
        self._period = np.array(dt)
        self._nothing = np.concatenate([[_NEVER], np.zeros(2 * robot.nv)])

    def nothing(self) -> Array:
        """Return the memory before the first period."""
        return self._nothing.copy()

    def timed(self, memory: Array, measurement: Measurement) -> Measurement:
        """Return a measurement that comes when it is expected where nothing tells the time."""
        if not hasattr(measurement.t, "is_unknown"):
            return measurement
        return measurement._replace(t=law.select(memory[0] < _NEVER, memory[0], 0.0))

    def residual(self, memory: Array, measurement: Measurement) -> Array:
        """Return r by now, shape (n_v,) [rad/s² or m/s²]."""
        n = self._n
        r, is_due = memory[n + 1 :], abs(measurement.t - memory[0]) <= self._half
        apart = measurement.v - memory[1 : n + 1]
        residual: Array = law.select(is_due, self._share * r + self._rate * apart, r)
        return residual

    def forward(self, measurement: Measurement, gravity: Array, torque: Array) -> Array:
        """Return f of a torque, shape (n_v,) [rad/s² or m/s²]; gravity is what is compensated."""
        _, q, v, _, _ = measurement
        return self.dynamics.forward(q, v, torque if self.has_weight else torque - gravity)

    def expecting(self, measurement: Measurement, f: Array, residual: Array) -> Array:
        """Return the memory after a step that sends a torque with this f."""
        expected = measurement.v + self._period * f
        memory = np.concatenate([[measurement.t + self._dt], expected, residual])
        # what is absurd must not make the next period's prediction overflow
        kept: Array = law.select(np.abs(memory).max() < HUGE, memory, self._nothing)
        return kept
