"""V̇ of a recorded run against −W, by finite differences along the true dynamics."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.controllers import SetpointController
from approxjac.interface import Status
from approxjac.simulation import Plant, Trajectory
from approxjac.stability import LyapunovValue, lyapunov
from approxjac.validation import Array

_TURN = 1e-4  # how far q and q̇ go at most in a difference, as a share of 1 rad and of q̇'s scale
_LONGEST = 1e-4  # [s]
_ZERO = 1e-9  # below it a power counts as none; limiters tell them apart to about 1e-10 [W]
_REFINEMENTS = 3
_ACCURACY = 1e-6  # wanted, as a share of V̇ and W
_MARGIN = 2.0  # on the measured error of the differences
_ROUND_OFF = 64.0 * float(np.finfo(float).eps)


class Decrease(NamedTuple):
    """V̇ of a run at some of its recorded instants.

    Attributes:
        instants: How many were looked at; those near a singular Ĵ are not, where Ĵ⁺ is damped
            and V another one.
        singular: How many of those there were.
        risen: At how many of the instants V̇ > −W by more than the error of the differences and
            1e-9 W.
        largest_excess: Largest V̇ + W [W].
        error: Largest error of the differences [W].
        usual_error: Its median [W].
        breaches: At how many V̇ > −W + σ with the slack σ that was reported, by more than that.
        largest_breach: Largest V̇ + W − σ [W], negative where there is room.
    """

    instants: int
    singular: int
    risen: int
    largest_excess: float
    error: float
    usual_error: float
    breaches: int
    largest_breach: float


def decrease(
    plant: Plant,
    controller: SetpointController,
    alpha: float,
    run: Trajectory,
    effort: Array,
    instants: int = 100,
) -> Decrease:
    """Compare V̇ along the true dynamics with −W, and with what was reported.

    The torque of the run, as the motors deliver it, gives the true q̈, and V(q, q̇) is
    differentiated along (q̇, q̈). Nothing of the limiter is used but the slack it reported.

    Args:
        plant: The true robot, with no torque limits.
        controller: The law; its gravity must be exact.
        alpha: α of V and W [1/s].
        run: A record of the law with a limiter.
        effort: What the motors deliver, shape (n_v,) [N m or N].
        instants: How many to look at. They are nearer to each other at the start, where limits
            are at work: the i-th of n is at the share (i/n)² of the run.
    """
    chosen = np.unique(
        (np.linspace(0.0, 1.0, instants) ** 2 * (len(run.t) - 1)).round().astype(int)
    )
    regular = [k for k in chosen.tolist() if run.status[k] != Status.NEAR_SINGULAR]
    excesses, errors, slacks = (np.zeros(len(regular)) for _ in range(3))
    for i, k in enumerate(regular):
        tau = np.clip(run.tau[k], -effort, effort)
        excesses[i], errors[i] = excess(
            plant, controller, alpha, run.q[k], run.v[k], tau, run.target
        )
        slacks[i] = run.slack[k]
    beyond = excesses - slacks  # NaN, which compares as False, where no slack is known
    known = beyond[np.isfinite(beyond)]
    return Decrease(
        instants=len(regular),
        singular=len(chosen) - len(regular),
        risen=int((excesses > errors + _ZERO).sum()),
        largest_excess=float(excesses.max(initial=-np.inf)),
        error=float(errors.max(initial=0.0)),
        usual_error=float(np.median(errors)) if regular else 0.0,
        breaches=int((beyond > errors + _ZERO).sum()),
        largest_breach=float(known.max(initial=-np.inf)),
    )


def excess(
    plant: Plant,
    controller: SetpointController,
    alpha: float,
    q: Array,
    v: Array,
    tau: Array,
    target: Array,
) -> tuple[float, float]:
    """V̇ + W under a torque, and the error of its finite differences [W].

    Central differences with a step and with half of it: their extrapolation is of fourth order,
    and how far they are apart is a measured bound of its error. Round-off is added. Where the error
    is large, near a singular Ĵ, smaller steps are tried.
    """
    acceleration = plant.acceleration(q, v, tau)

    def V(t: float) -> float:
        there = pin.integrate(plant.robot.model, q, t * v)
        return lyapunov(plant, controller, there, v + t * acceleration, target, alpha).V

    here = lyapunov(plant, controller, q, v, target, alpha)
    pace = max(float(np.abs(v).max()), float(np.abs(acceleration).max()) / _scale(v))
    step, best = min(_LONGEST, _TURN / max(pace, 1e-300)), (math.nan, math.inf)
    for _ in range(_REFINEMENTS):
        wide, narrow = ((V(h) - V(-h)) / (2.0 * h) for h in (step, 0.5 * step))
        rate = (4.0 * narrow - wide) / 3.0
        error = _MARGIN * abs(narrow - wide) + _round_off(controller, alpha, here, step)
        best = min(best, (rate + here.W, error), key=lambda found: found[1])
        if error <= _ACCURACY * (abs(rate) + abs(here.W)):
            break
        step /= 8.0
    return best


def _round_off(
    controller: SetpointController, alpha: float, here: LyapunovValue, step: float
) -> float:
    """What round-off makes of a difference of V [W].

    That of V itself; and, near the target, that of x, of which V is ½k e² there.
    """
    kp, kv, _ = controller.diagonals
    stiffness = float((kp + alpha * kv).max())
    size = abs(here.V) + math.sqrt(2.0 * abs(here.V) * stiffness) + _ROUND_OFF * stiffness
    return _ROUND_OFF * (size / step + abs(here.W))


def _scale(v: Array) -> float:
    return max(1.0, float(np.abs(v).max()))
