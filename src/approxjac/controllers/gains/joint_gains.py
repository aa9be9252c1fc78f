"""Gains of the tracking law that motors behind gears tolerate, given or adapted while it runs."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.controllers.gains.gains import Latency
from approxjac.controllers.gains.motors import (
    crossover,
    integral_rate,
    largest_inertia,
    least_rotors,
    motor_damping,
)
from approxjac.robots import Drives, Robot
from approxjac.robots.drives import usual_effort
from approxjac.validation import Array

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
