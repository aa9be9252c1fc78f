"""The defaults that the library had before they followed from inertia, motors and latency."""

import numpy as np

import approxjac as aj
from approxjac.controllers.gains.sample_configurations import sample_configurations
from approxjac.controllers.gains.tuning import slow_rate

SPEED, FASTEST = 3.0, 10.0  # of learning, in rates of the task's slow pole


def controller_before(built):
    """Return the law of before for a reach: gains for 1 s, no saturation, a diagonal L."""
    scenario, task = built.scenario, built.law.task
    lag = scenario.loop.dt + (scenario.sensor.velocity_filter or 0.0)
    lag += scenario.loop.actuator_delay
    gains = aj.default_gains(task, 1.0, 1.0 / lag)
    L, alpha = adaptation_before(task, gains)
    gravity = aj.AdaptiveGravity(task.robot, L, alpha)
    law = aj.SetpointController(task, gains, gravity=gravity)
    return law if built.limits is None else aj.TorqueLimited(law, built.limits, dt=scenario.loop.dt)


def adaptation_before(task, gains):
    """Return the diagonal of L, and α, the rate of the task's slow pole.

    L = k/mean(‖Zᵢ‖²), where what gravity compensation lacks dies out three times as fast as the
    error, the median over configurations; and less where learning and a joint would swing faster
    than ten times that rate.
    """
    diagonals = gains.diagonals(task.m, task.robot.nv)
    slow, regressor = slow_rate(task, diagonals), aj.robots.GravityRegressor(task.robot)
    configurations, J, M, *_ = sample_configurations(task)
    Z = np.array([*map(regressor.Z, configurations)])
    D = 1.0 / np.mean((Z * Z).sum(axis=1), axis=0)
    A = np.linalg.solve(J @ np.swapaxes(J, 1, 2), J) @ Z
    rates = np.linalg.eigvals(slow * np.swapaxes(A * D, 1, 2) @ (A / diagonals.kp[:, None]))
    L = SPEED * slow / float(np.median(rates.real.max(axis=1))) * D
    swings = (Z * np.linalg.solve(M, Z)).sum(axis=1).max(axis=0)
    return np.minimum(L, (FASTEST * slow) ** 2 / swings), slow
