"""Gains that motors behind elastic gears tolerate: above them the loop's lag makes them swing.

Measured at the motor, a joint of any link and spring answers torque as a positive real P(s), which
no damping k > 0 makes unstable without lag. Above its resonance P is 1/(Js), and there a lag of a
few milliseconds turns k > cJ into a divergence.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.controllers.gains.gains import Latency
from approxjac.controllers.gains.sample_configurations import usual_inertias
from approxjac.robots import Drives, Robot
from approxjac.robots.drives import usual_effort
from approxjac.validation import Array

_MARGIN = 0.75  # share of the largest damping
_SHARE = 0.015  # of the arm's largest inertia, which any rotor has
_PER_EFFORT = 1e-3  # rotor inertia over effort that any drive has [s²]
_LEAST, _ENOUGH = 0.05, 0.075  # least rotors that are believed of light and of heavy arms [kg m²]
_DAMPED = 0.02  # least damping ratio of a gear: without any no lag would be allowed
_POINTS = 4000
_LEARNT, _SLOWLY = 0.4, 0.7  # spring of what is learnt, and of all that is slow: of k over the lag
_KAPPA = 60.0  # κ [1/s]
_STEADY = 0.25  # κ dt at most
_WITHOUT_MOTORS = 0.3  # of the integral that is within what motors may damp
_QUICK = 2.0  # times κ, how fast a parameter may learn
_LATE = 0.25  # over the lag, if that is felt at the links: so fast
_STRONG = 2.0  # times usual rotors, up to which damping is raised
_NO_SWING = 3e-3  # speed below which no swing counts [rad/s or m/s]
_QUIET = 0.02  # of a motor's effort, that noise of q̇ may cause
_NO_MORE = 1e-3  # of a damping, which is not worth raising it
_SLOW, _HARDLY = 5.0, 3.0  # ω₀ of slow feedback, and the rate of damping without it [1/s]
_TO_LEARN, _TO_DAMP, _TO_LEAD = 0.4, 0.4, 0.2  # of the spring of what is slow: Γ, κ₀, α₀
_OF_JOINTS = 4  # learnt parameters: inertia of the rotor, two of friction, a constant torque


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


class JointGains(NamedTuple):
    """Gains that the motors of the joints tolerate."""

    alpha: Array  # the largest α by each joint, (n_v,) [1/s]
    kappa: float
    most: Array  # the largest K_σ of each joint, (n_v,) [N m s/rad or N s/m]
    fastest: float  # learning of a parameter [1/s]
    integral: float  # i of `AdaptiveDynamics`, at most κ [1/s]
    rotors: Array  # inertias that are taken for granted, (n_v,)

    @classmethod
    def of(
        cls,
        robot: Robot,
        alpha: float | None,
        kappa: float | None,
        usual_alpha: float,
        dt: float,
        latency: Latency | None = None,
        drives: Drives | None = None,
        slowly: bool = False,
    ) -> JointGains:
        """Return the gains for a lag and drives; α and κ as given, else by the motors.

        `slowly` is for gains beside a `law.SlowFeedback`.
        """
        most_kappa, lag = min(_KAPPA, _STEADY / dt), latency or Latency(dt)
        alphas = np.full(robot.nv, alpha or usual_alpha)
        damping, integral = np.full(robot.nv, np.inf), min(integral_rate(lag), most_kappa)
        rotors = np.zeros(robot.nv)
        if latency is not None or drives is not None:
            # a motor feels K_σ and, by q̈_r, αM̂
            all_slow = integral_rate(lag, slowly)
            integral = min(all_slow * (_TO_LEARN if slowly else 1.0), most_kappa)
            most = motor_damping(robot, lag, drives, all_slow if slowly else integral)
            rotors = least_rotors(robot) if drives is None else np.asarray(drives.rotor_inertia)
            inertia = largest_inertia(robot) + rotors
            if alpha is None:
                alphas = np.minimum(alphas, 0.5 * most / inertia)
            damping = np.maximum(most - alphas.min() * inertia, 0.25 * most)
            if not np.isfinite(damping).all():  # the lag is felt at the links
                most_kappa = min(most_kappa, 0.5 / lag.of_velocity)
        kappa = most_kappa if kappa is None else kappa
        fastest = _QUICK * kappa
        if not np.isfinite(damping).all():
            integral = min(_WITHOUT_MOTORS * integral_rate(lag), most_kappa)
            fastest = min(fastest, _LATE / lag.of_velocity)
        return cls(alphas, kappa, damping, fastest, min(integral, kappa), rotors)


def is_hardly_damped(robot: Robot, gains: JointGains) -> bool:
    """Return True if what motors may damp leaves some joint to itself for a third of a second."""
    return float((gains.most / (largest_inertia(robot) + gains.rotors)).min()) < _HARDLY


def slow_feedback(robot: Robot, latency: Latency, dt: float, first: JointGains) -> law.SlowFeedback:
    """Return the gains κ₀ and α₀ of the slow feedback, as the heaviest joint allows."""
    inertia = largest_inertia(robot) + first.rotors
    spring = float((first.most / inertia).min()) * integral_rate(latency, True)
    kappa = min(_TO_DAMP * spring / _SLOW, _SLOW)
    alpha = min(_TO_LEAD * spring / _SLOW, 0.25 * _SLOW)
    return law.SlowFeedback(_SLOW, kappa / first.kappa, alpha, dt)


def strong_drives(robot: Robot) -> Drives:
    """Return drives with rotors twice as heavy as usual, up to whose damping it is raised."""
    return Drives(_STRONG * np.asarray(Drives.usual(robot).rotor_inertia)).of(robot)


class UsedGains(NamedTuple):
    """Gains of one step, or those that each joint allows."""

    alpha: Any  # of a step a number, else (n_v,)
    most: Array
    added: Array  # F beside M̂ in κ(M̂ + F), (n_v,)
    gamma: Array | None = None  # Γ of the dynamics if it is not their own, (p,)
    alpha_dot: Any = None  # None of a constant α


class RaisedGains:
    """Gains from those that the lightest rotors stand to those of heavy ones.

    `law.RaisedDamping` finds how far each joint's may go. α is what all joints stand; links are
    learnt as fast as the joint allows whose gains are the least raised.
    """

    def __init__(self, robot: Robot, latency: Latency, dt: float, low: UsedGains, high: UsedGains):
        self.low = low
        self.alpha, self.most, self.added = (
            np.maximum(to - of, 0.0) for of, to in zip(low[:3], high[:3], strict=True)
        )
        damping = low.most, np.maximum(self.most, _NO_MORE * low.most)
        least, quiet = np.full(robot.nv, _NO_SWING), _QUIET * usual_effort(robot)
        self.watch = law.RaisedDamping.of(
            crossover(latency), least, damping, quiet, dt, latency.velocity_filter
        )
        self.n_state = len(self.watch.start(np.zeros(robot.nv)))
        self.gamma = None
        if low.gamma is not None and high.gamma is not None:
            self.gamma = np.maximum(high.gamma - low.gamma, 0.0)

    def step(self, memory: Array, v: Array) -> tuple[Array, UsedGains]:
        """Return the memory a period later, and the gains now."""
        after, rates = self.watch.step(memory, v)
        return after, self.used(memory, rates)

    def used(self, memory: Array, rates: Array | None = None) -> UsedGains:
        """Return the gains of a memory; `rates` (n_v,) are those of the shares."""
        low, n, gamma = self.low, len(self.most), self.low.gamma
        share = memory[:n]
        rates = 0.0 * share if rates is None else rates
        alpha, alpha_dot = law.smallest(low.alpha + share * self.alpha, rates * self.alpha)
        if self.gamma is not None:
            least, _ = law.smallest(share, rates)
            of_joints = np.concatenate([share] * _OF_JOINTS)
            links = np.zeros_like(share, shape=len(self.gamma) - len(of_joints)) + least
            gamma = gamma + np.concatenate([links, of_joints]) * self.gamma
        most, added = low.most + share * self.most, low.added + share * self.added
        return UsedGains(alpha, most, added, gamma, alpha_dot)
