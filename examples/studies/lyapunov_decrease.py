"""V̇ of a recorded run against −W, by finite differences along the true dynamics."""

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin

import approxjac as aj
from approxjac import law

TURN = 1e-4  # how far q and q̇ go at most in a difference, as a share of 1 rad and of q̇'s scale
LONGEST = 1e-4  # [s]
ZERO = 1e-9  # below it a power counts as none; limiters tell them apart to about 1e-10 [W]
REFINEMENTS = 3
ACCURACY = 1e-6  # wanted, as a share of V̇ and W
MARGIN = 2.0  # on the measured error of the differences
ROUND_OFF = 64.0 * float(np.finfo(float).eps)


class Lyapunov(NamedTuple):
    """V [J] and W = −dV/dt [W]."""

    V: float
    W: float


class Decrease(NamedTuple):
    """V̇ of a run at some of its recorded instants."""

    instants: int  # without those near a singular Ĵ, where Ĵ⁺ is damped and V another one
    singular: int  # how many those were
    risen: int  # V̇ > −W by more than the error of the differences and 1e-9 W
    largest_excess: float  # largest V̇ + W [W]
    error: float  # largest error of the differences [W]
    usual_error: float  # its median [W]
    breaches: int  # V̇ > −W + σ with the slack σ that was reported, by more than that
    largest_breach: float  # largest V̇ + W − σ [W], negative where there is room


def lyapunov(plant, controller, q, v, target, alpha=None, *, state=None, theta=None):
    """Return V and W of law (6), or (28), eqs. (12), (13) and (31), with the true J and M.

    Along the closed loop dV/dt = −W holds exactly, provided that the controller's gravity is
    exact, or learnt with the same α and in the span of its regressor (with Ĵ⁺ not damped, no bounds
    at work, and torques within the limits of `AdaptiveGravity`). A `Posture` adds its power
    q̇ᵀN τ₀ to dV/dt, which W leaves out. A run has V alone, `run.V`.

    Args:
        plant: The true robot, sensor and viscous friction.
        controller: The law; Ĵ must be of full rank at q.
        q: Configuration, shape (nq,).
        v: Velocity, shape (n_v,).
        target: x_d, shape (n_x,).
        alpha: α of (10) [1/s]; the controller's by default.
        state: Controller state where gravity is learnt.
        theta: True θ of the controller's regressor where gravity is learnt, shape (p,), or followed
            by the constant task force and joint torques, which are 0 if not given.
    """
    alpha = controller.alpha if alpha is None else alpha
    task, sensor, dynamics = controller.task, plant.sensor, plant.dynamics
    kp, kv, damping = controller.diagonals
    e = sensor.error(sensor.value(q), target)
    s = controller.saturation.s(e)
    J_e, J_hat = sensor.error_jacobian(e, sensor.sensor_jacobian(q)), task.jacobian(q)
    J_hat_dot = task.jacobian_dot(q, v)
    pinv, (pinv_dot,) = law.cross_weight_pinv(J_hat, J_hat_dot[None], controller.pinv.weight)
    M = dynamics.M(q)
    V = law.V(v, s, controller.saturation.S(e), pinv, M, kp, kv, alpha)
    if (learning := controller.adaptation) is not None:
        whole = theta if len(theta) == len(learning.theta0) else learning.whole(np.array(theta))
        V += law.parameter_potential(whole - controller.learnt(state), learning.L)
    s_dot = controller.saturation.ds(e) * (J_e @ v)
    inertia = M, dynamics.M_dot(q, v), dynamics.coriolis(q, v)
    B = plant.friction + damping
    W = law.W(v, (s, s_dot), J_e, J_hat, (pinv, pinv_dot), inertia, B, kp, kv, alpha)
    return Lyapunov(V, W)


def decrease(plant, controller, alpha, run, effort, instants=100):
    """Compare V̇ along the true dynamics with −W, and with the reported slack.

    The torque of the run, as the motors deliver it, gives the true q̈, and V(q, q̇) is
    differentiated along (q̇, q̈). Nothing of the limiter is used but the slack it reported.

    Args:
        plant: The true robot, with no torque limits.
        controller: The law; its gravity must be exact.
        alpha: α of V and W [1/s].
        run: A record of the law with a limiter.
        effort: Torque that the motors deliver, shape (n_v,) [N m or N].
        instants: How many to look at. They are nearer to each other at the start, where limits
            are at work: the i-th of n is at the share (i/n)² of the run.
    """
    places = np.linspace(0.0, 1.0, instants) ** 2 * (len(run.t) - 1)
    chosen = np.unique(places.round().astype(int)).tolist()
    regular = [k for k in chosen if run.status[k] != aj.Status.NEAR_SINGULAR]
    found = np.zeros((len(regular), 2))
    for i, k in enumerate(regular):
        tau = np.clip(run.tau[k], -effort, effort)
        found[i] = excess(plant, controller, alpha, run.q[k], run.v[k], tau, run.target)
    excesses, errors = found.T
    beyond = excesses - run.slack[regular]  # NaN, which compares as False, where none is known
    return Decrease(
        instants=len(regular),
        singular=len(chosen) - len(regular),
        risen=int((excesses > errors + ZERO).sum()),
        largest_excess=float(excesses.max(initial=-np.inf)),
        error=float(errors.max(initial=0.0)),
        usual_error=float(np.median(errors)) if regular else 0.0,
        breaches=int((beyond > errors + ZERO).sum()),
        largest_breach=float(beyond[np.isfinite(beyond)].max(initial=-np.inf)),
    )


def excess(plant, controller, alpha, q, v, tau, target):
    """Return V̇ + W under a torque, and the error of its finite differences [W].

    Central differences with a step and with half of it: their extrapolation is of fourth order,
    and how far they are apart is a measured bound of its error. Round-off is added. Where the error
    is large, near a singular Ĵ, smaller steps are tried.
    """
    acceleration = plant.acceleration(q, v, tau)

    def V(t):
        there = pin.integrate(plant.robot.model, q, t * v)
        return lyapunov(plant, controller, there, v + t * acceleration, target, alpha).V

    here = lyapunov(plant, controller, q, v, target, alpha)
    scale = max(1.0, float(np.abs(v).max()))
    pace = max(float(np.abs(v).max()), float(np.abs(acceleration).max()) / scale)
    step, best = min(LONGEST, TURN / max(pace, 1e-300)), (math.nan, math.inf)
    for _ in range(REFINEMENTS):
        wide, narrow = ((V(h) - V(-h)) / (2.0 * h) for h in (step, 0.5 * step))
        rate = (4.0 * narrow - wide) / 3.0
        error = MARGIN * abs(narrow - wide) + round_off(controller, alpha, here, step)
        best = min(best, (rate + here.W, error), key=lambda found: found[1])
        if error <= ACCURACY * (abs(rate) + abs(here.W)):
            break
        step /= 8.0
    return best


def round_off(controller, alpha, here, step):
    """Return the round-off in a difference of V [W].

    That of V itself; and, near the target, that of x, of which V is ½k e² there.
    """
    kp, kv, _ = controller.diagonals
    stiffness = float((kp + alpha * kv).max())
    size = abs(here.V) + math.sqrt(2.0 * abs(here.V) * stiffness) + ROUND_OFF * stiffness
    return ROUND_OFF * (size / step + abs(here.W))
