"""The tracking law: motion that follows a target, its derivative, and the torque for it.

Not of the paper: J.-J. E. Slotine and W. Li, "On the adaptive control of robot manipulators", Int.
J. Robotics Research 6(3), 1987, on an error that kinematics predict. Shapes: z, u, ẋ_d are (m,), Ĵ
is (m, n_v), q̇, q̇_r, q̈_r, σ, n₀ are (n_v,).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from approxjac.law.branches import any_of, choose, complement, is_finite, select
from approxjac.law.products import dot, root
from approxjac.law.pseudoinverse import SINGULAR_RATIO, damped_solver, damping_rate, regular_solver
from approxjac.validation import Array


class PredictedError(NamedTuple):
    """The error predicted by estimates at one instant, with the terms of its derivatives.

    It is in the base frame, into which the target is transformed. With Ĉ = R̂ᵀ/ŝ and ĉ = −Ĉb̂ of a
    camera or tracker x = sRp + b (Ĉ = I if it is known), z = p̂(q) − (Ĉx_d + ĉ) and, exactly,
    ż = Ĵq̇ − x_d_dot + drift. It is in the task's unit if the sensor measures in metres.

    Attributes:
        z: Predicted error, shape (m,).
        J: Ĵ, the exact Jacobian of the prediction, shape (m, n_v).
        J_dot: dĴ/dt along q̇ and the motion of the estimates, shape (m, n_v).
        x_d_dot: Ĉẋ_d, shape (m,).
        x_d_ddot: Its rate Ĉẍ_d + Ĉ'ẋ_d, shape (m,).
        drift: Velocity of z due to the estimates, ż − Ĵq̇ + x_d_dot, shape (m,).
    """

    z: Array
    J: Array
    J_dot: Array
    x_d_dot: Array
    x_d_ddot: Array
    drift: Array


_PASSES = 2  # in which shares are found
_CREEPS = 0.2  # of the speed that counts as one towards an end: what is left of it at the end


class StopZones(NamedTuple):
    """Ranges of joints, near whose ends a reference leaves motion to the others; (n_v,) each."""

    low: Array
    high: Array
    zone: Array  # δ, in front of each end
    slow: Array  # v₀, above which a speed towards it counts

    def shares(
        self, near: Array, v: Array, v_r: Array, a_r: Array, sides: Array
    ) -> tuple[Array, Array]:
        """Return the share r of each joint in a motion, and its derivative, (n_v,) each.

        r = 1 − c²(3 − 2c) s²/(1 + s²), with c from 0 to 1 on the way through the zone, and s the
        reference's speed towards the end, over v₀, which falls to a fifth of it at the end.
        """
        c, c_dot = np.minimum(near, 1.0), sides * v / self.zone
        c_dot = np.where(near < 1.0, c_dot, 0.0)
        per = 1.0 / (self.slow * (1.0 - (1.0 - _CREEPS) * c))
        s = np.maximum(sides * v_r * per, 0.0)
        s_dot = (sides * a_r + s * self.slow * (1.0 - _CREEPS) * c_dot) * per
        s_dot = np.where(s > 0.0, s_dot, 0.0)
        depth, speed = c * c * (3.0 - 2.0 * c), s * s / (1.0 + s * s)
        depth_dot, speed_dot = 6.0 * c * (1.0 - c) * c_dot, 2.0 * s * s_dot / (1.0 + s * s) ** 2
        return 1.0 - depth * speed, -(depth_dot * speed + depth * speed_dot)

    def near(self, motion: Array) -> tuple[Array, Array]:
        """Return the depth of joints in their zones, with its sign, at a motion (n_v,)."""
        low, high = (self.low - motion) / self.zone + 1.0, (motion - self.high) / self.zone + 1.0
        return np.maximum(np.maximum(low, high), 0.0), np.where(high > low, 1.0, -1.0)


class ReferenceGains(NamedTuple):
    """Gains of a reference that brings an error to zero."""

    alpha: float | Array  # α and k of `task_velocity`
    k: float | Array
    fastest: Array  # speeds of joints of `within_speeds`
    singular_ratio: float = SINGULAR_RATIO  # and scale, of `damped_gram_solve`
    scale: float = 0.0
    stops: StopZones | None = None
    shares: Array | None = None  # constant shares r > 0 of joints in the motion, (n_v,)


def saturated(z: Array, z_dot: Array, k: float | Array) -> tuple[Array, Array]:
    """Return s(z) = z/√r with r = 1 + Σ(kᵢzᵢ)², and its derivative (ż − z Σkᵢ²zᵢżᵢ/r)/√r.

    s is along z, and with k = α/v no α sᵢ(z) is above vᵢ; with one v for all, ‖α s(z)‖ is not.
    """
    u = k * z
    r = 1.0 + dot(u, u)
    size = root(r)
    return z / size, (z_dot - z * (dot(u, k * z_dot) / r)) / size


def task_velocity(
    z: Array, z_dot: Array, x_d_dot: Array, x_d_ddot: Array, alpha: float | Array, k: float | Array
) -> tuple[Array, Array]:
    """Return u = ẋ_d − αs(z) and its derivative, with ẋ_d and ẍ_d; k is that of `saturated`."""
    s, s_dot = saturated(z, z_dot, k)
    return x_d_dot - alpha * s, x_d_ddot - alpha * s_dot


def reference(
    J_hat: Array,
    J_hat_dot: Array,
    u: Array,
    u_dot: Array,
    null: Array,
    null_dot: Array,
    singular_ratio: float = SINGULAR_RATIO,
    scale: float = 0.0,
) -> tuple[Array, Array, float]:
    """Return q̇_r = Ĵ⁺(u − Ĵn₀) + n₀ and its derivative, with Ĵ⁺ of `damped_gram_solve`.

    With w = (ĴĴᵀ + λ²I)⁻¹(u − Ĵn₀) and h = Ĵ'ᵀw + n₀', differentiating the definition gives

        q̈_r = h + Ĵ⁺(u' − Ĵ'q̇_r − Ĵh − (λ²)'w).

    Each derivative is along the motion. Returned are q̇_r, q̈_r and λ.
    """
    G = dot(J_hat, J_hat.T)
    solve, singular = regular_solver(G, singular_ratio, scale)

    def solved(solve: Callable[[Array], Array], rate: Any) -> tuple[Array, Array]:
        """Return q̇_r and q̈_r with b ↦ (ĴĴᵀ + λ²I)⁻¹b and (λ²)', None of no damping."""
        w = solve(u - dot(J_hat, null))
        velocity = dot(w, J_hat) + null
        h = dot(w, J_hat_dot) + null_dot
        rest = u_dot - dot(J_hat_dot, velocity) - dot(J_hat, h)
        if rate is not None:
            rest = rest - rate * w
        return velocity, h + dot(solve(rest), J_hat)

    def damped() -> tuple[Array, Array, Any]:
        solve, ends, damping = damped_solver(G, singular_ratio, scale)
        rate = damping_rate(J_hat, J_hat_dot, ends, singular_ratio, scale)
        return *solved(solve, select(damping > 0.0, rate, 0.0)), root(damping)

    return choose(singular, damped, lambda: (*solved(solve, None), 0.0))


def reference_step(
    error: PredictedError,
    v: Array,
    null: tuple[Array, Array],
    waits: Any,
    gains: ReferenceGains,
    motion: Array | None = None,
) -> tuple[Array, Array, Any, Any]:
    """Return q̇_r and q̈_r that bring a predicted error to zero, and their status.

    `null` are n₀ and its derivative; the joints rest while it `waits` for a first prediction.

    With the diagonal r of the joints' shares,

        q̇_r = n₀ + r (Ĵr)⁺(u − Ĵn₀),

    so that Ĵq̇_r = u, which is all that proofs need, and q̈_r is its derivative. Joints that this
    would bring to a stop that is near, at the positions `motion` (n_v,), leave the motion to the
    others, by `StopZones.shares`.

    Returns:
        q̇_r; q̈_r; whether Ĵ⁺ is damped; whether all is finite, else the joints rest.
    """
    z, J_hat, J_hat_dot, x_d_dot, x_d_ddot, drift = error
    z_dot = dot(J_hat, v) - x_d_dot + drift
    u, u_dot = task_velocity(z, z_dot, x_d_dot, x_d_ddot, gains.alpha, gains.k)
    is_known = is_finite(np.concatenate([u, u_dot, J_hat.ravel()]))

    ratio, stops = (gains.singular_ratio, gains.scale), gains.stops

    def shared(r: Array, r_dot: Array) -> tuple[Array, Array, Any]:
        n, n_dot = null
        b = u - dot(J_hat, n), u_dot - dot(J_hat_dot, n) - dot(J_hat, n_dot)
        none = 0.0 * v
        J_r, J_r_dot = J_hat * r, J_hat_dot * r + J_hat * r_dot
        p, p_dot, damping = reference(J_r, J_r_dot, *b, none, none, *ratio)
        return n + r * p, n_dot + r_dot * p + r * p_dot, damping

    def moves() -> tuple[Array, Array, Any]:
        shares = gains.shares
        if shares is None:
            v_r, a_r, damping = reference(J_hat, J_hat_dot, u, u_dot, *null, *ratio)
        else:
            v_r, a_r, damping = shared(shares, 0.0 * v)
        if stops is None or motion is None:
            return *within_speeds(v_r, a_r, gains.fastest), damping
        near, sides = stops.near(motion)
        r, r_dot = np.ones(len(v)) if shares is None else shares, 0.0 * v
        found = v_r, a_r, damping, r, r_dot
        for _ in range(_PASSES):  # what some joints leave may bring others to a stop

            def away(found: tuple[Any, ...] = found) -> tuple[Any, ...]:
                v_r, a_r, _, r, r_dot = found
                less, less_dot = stops.shares(near, v, v_r, a_r, sides)
                r, r_dot = r * less, r_dot * less + r * less_dot
                return *shared(r, r_dot), r, r_dot

            towards = any_of((near > 0.0) & (sides * found[0] > 0.0))
            found = choose(towards, away, partial(tuple, found))
        v_r, a_r, damping, *_ = found
        return *within_speeds(v_r, a_r, gains.fastest), damping

    nothing = np.zeros(len(v))
    still = waits | complement(is_known)
    v_r, a_r, damping = choose(still, lambda: (nothing, nothing, 0.0), moves)
    return v_r, a_r, damping > 0.0, is_known


def within_speeds(velocity: Array, acceleration: Array, fastest: Array) -> tuple[Array, Array]:
    """Return c q̇_r and its derivative, with the largest c ≤ 1 and all abs(c q̇_r,i) ≤ fastestᵢ.

    Where c = fastestᵢ/abs(q̇_r,i) of one joint, c' = −c q̈_r,i/q̇_r,i.
    """
    shares = np.abs(velocity) / fastest
    if not shares.dtype.hasobject:
        i = int(shares.argmax())
        share, v_i, a_i = float(shares[i]), velocity[i], acceleration[i]
        if share <= 1.0:
            return velocity, acceleration
    else:
        share, v_i, a_i = shares[0], velocity[0], acceleration[0]
        for each, v_next, a_next in zip(shares[1:], velocity[1:], acceleration[1:], strict=True):
            more = each > share
            share, v_i = select(more, each, share), select(more, v_next, v_i)
            a_i = select(more, a_next, a_i)
    c, rate = 1.0 / share, a_i / select(share > 1.0, v_i, 1.0)
    slow = velocity * c, (acceleration - velocity * rate) * c
    return choose(share > 1.0, lambda: slow, lambda: (velocity, acceleration))


def tracking_torque(feedforward: Array, K_sigma: Array) -> Array:
    """Return τ = Y_d(q, q̇, q̇_r, q̈_r) â − K_σσ, with σ = q̇ − q̇_r and both terms given.

    V̇₂ = −σᵀK_σσ for each K_σ with a positive definite symmetric part, whatever it depends on: it
    is not in V₂.
    """
    return feedforward - K_sigma


def bounded_damping(A: Array, A_sigma: Array, most: Array) -> Array:
    """Return K_σσ with K_σ = (A⁻¹ + B⁻¹)⁻¹ = B(A + B)⁻¹A, which is ≤ A and ≤ B = diag(most).

    Args:
        A: Symmetric and positive definite, (n_v, n_v).
        A_sigma: Aσ, (n_v,).
        most: Largest damping of each joint > 0, (n_v,).
    """
    return most * np.linalg.solve(A + np.diag(most), A_sigma)


def dynamics_rate(gamma: Array, Y_d_sigma: Array) -> Array:
    """Return dâ/dt = −Γ Y_dᵀσ, shape (p,), with the diagonal of Γ and Y_dᵀσ, (p,) each."""
    return -gamma * Y_d_sigma


def servo_lag_rate(gamma: float, acceleration: Array, sigma: Array) -> Any:
    """Return dL̂/dt = −γ wᵀσ, of a servo with L q̈ + q̇ = q̇_cmd that is sent q̇_r + L̂w.

    With q̈_r = w + Dσ, Lσ̇ = −(I + LD)σ + (L̂ − L)w, and V₃ = ½L‖σ‖² + (L̂ − L)²/2γ has
    V̇₃ = −σᵀ(I + LD)σ.
    """
    return -gamma * dot(acceleration, sigma)
