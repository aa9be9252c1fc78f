"""Damping that a motor behind an elastic gear allows: above it the loop's lag makes it swing.

Measured at the motor, a joint of any link and spring answers torque as a positive real P(s), which
no damping k > 0 makes unstable without lag. Above its resonance P is 1/(Js), and there a lag of a
few milliseconds turns k > cJ into a divergence.
"""

import math

import numpy as np

from approxjac.controllers.gains.gains import Latency
from approxjac.controllers.gains.sample_configurations import usual_inertias
from approxjac.robots import Drives, Robot
from approxjac.validation import Array

_MARGIN = 0.75  # share of the largest damping
_SHARE = 0.015  # of the arm's largest inertia, which any rotor has
_PER_EFFORT = 1e-3  # rotor inertia over effort that any drive has [s²]
_LEAST, _ENOUGH = 0.05, 0.075  # least rotors that are believed of light and of heavy arms [kg m²]
_DAMPED = 0.02  # least damping ratio of a gear: without any no lag would be allowed
_POINTS = 4000
_LEARNT, _SLOWLY = 0.4, 0.7  # spring of what is learnt, and of all that is slow: of k over the lag


def _lags(latency: Latency) -> tuple[float, float]:
    """Return the delay from q̇ to torque, and the time constant of the filter of q̇ [s]."""
    delay, filtered = latency.torque_delay + 0.5 * latency.period, latency.velocity_filter
    if filtered > 0.0:  # of differences, which are the rate of half a period ago
        delay += 0.5 * latency.period
    return delay, filtered


def integral_rate(latency: Latency, slowly: bool = False) -> float:
    """Return P/k [1/s] of a damping k and a learnt joint torque's spring P, 0.4 over the lag.

    Where more than that acts `slowly`, all of it is a spring of 0.7 over the lag.
    """
    return (_SLOWLY if slowly else _LEARNT) / sum(_lags(latency))


def largest_rate(latency: Latency, damping_ratio: float = 0.05, integral: float = 0.0) -> float:
    """Return c [1/s]: a joint whose rotor is J is stable with each damping k ≤ cJ at its motor.

    The loop k(1 + i/s) P(s) exp(−sT_d)/(1 + sT_f), i the `integral` [1/s], T_d the torques' delay
    and half a period (a whole one where q̇ is of differences), T_f the filter of q̇, lags by
    φ(ω) = ωT_d + atan ωT_f + atan i/ω. Where φ < π/2 no P(iω) leads to −1, which is at all low
    frequencies if i < 1/(T_d + T_f); beyond, a resonance of damping ratio ζ is a circle of diameter
    1/(2ζJω), the rotor's tail 1/(Jω):

        c = min(s(ω₉₀), min over φ > π/2 of 2ζ s(ω)/|cos φ|),  s(ω) = ω√(1 + ω²T_f²)/√(1 + i²/ω²).
    """
    delay, filtered = _lags(latency)
    # φ from π/2 to 3π/2, beyond which both terms only grow
    phase = np.linspace(0.5 * math.pi, 1.5 * math.pi, _POINTS)[:-1]
    low, high = np.zeros(len(phase)), np.full(len(phase), 1.5 * math.pi / delay)
    for _ in range(60):  # ω of each φ, which from π/2 on grows with it
        omega = 0.5 * (low + high)
        lag = omega * delay + np.arctan(omega * filtered) + np.arctan(integral / omega)
        low, high = np.where(lag > phase, low, omega), np.where(lag > phase, omega, high)
    size = omega * np.sqrt((1.0 + (omega * filtered) ** 2) / (1.0 + (integral / omega) ** 2))
    return float(min(size[0], (2.0 * damping_ratio * size[1:] / np.abs(np.cos(phase[1:]))).min()))


def crossover(latency: Latency) -> float:
    """Return ω₉₀ [rad/s], at which the lag from q̇ to torque is 90°."""
    delay, filtered = _lags(latency)
    low, high = 0.0, 0.5 * math.pi / delay
    for _ in range(60):
        omega = 0.5 * (low + high)
        late = omega * delay + math.atan(omega * filtered) > 0.5 * math.pi
        low, high = (low, omega) if late else (omega, high)
    return low


def least_rotors(robot: Robot) -> Array:
    """Return rotor inertias that a geared arm's joints have at least, (n_v,) [kg m² or kg]."""
    usual = _SHARE * float(largest_inertia(robot).max())
    usual = min(max(usual, _LEAST), _ENOUGH)
    return np.minimum(_PER_EFFORT * robot.effort_limits, usual)


def largest_inertia(robot: Robot) -> Array:
    """Return the largest M̂_ii of usual configurations, shape (n_v,) [kg m² or kg]."""
    return np.asarray(usual_inertias(robot).diagonal(axis1=1, axis2=2).max(axis=0))


def motor_damping(
    robot: Robot, latency: Latency, drives: Drives | None, integral: float = 0.0
) -> Array:
    """Return the damping that each motor may have, ¾ cJ, shape (n_v,) [N m s/rad or N s/m].

    Rotors are those of `drives`, else `least_rotors`; infinite of rigid joints without a rotor.
    """
    if drives is None:
        return _MARGIN * largest_rate(latency, integral=integral) * least_rotors(robot)
    known = drives.of(robot)
    J = np.asarray(known.rotor_inertia)
    c = largest_rate(latency, max(known.damping_ratio, _DAMPED), integral)
    return np.where(J > 0.0, _MARGIN * c * J, np.inf)
