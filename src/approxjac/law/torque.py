"""The control laws: eqs. (5), (6) and (28), and a bounded one to compare them with.

Shapes: Ĵ is (m, n_v), K_p, K_v, s and Ẋ are (m,) with the gains' diagonals, q̇, g, τ and the
diagonal of the added damping B_c are (n_v,).
"""

from __future__ import annotations

import numpy as np

from approxjac.law.products import dot
from approxjac.validation import Array


def measured_velocity_torque(
    J_hat: Array, kp: Array, kv: Array, s: Array, x_dot: Array, v: Array, damping: Array, g: Array
) -> Array:
    """τ = −Ĵᵀ(K_p s(e) + K_v Ẋ) − B_c q̇ + g(q), with Ẋ measured.

    Implements Eq. (5), the earlier law, kept as a baseline. Departure: the added joint damping
    −B_c q̇ is written out (the paper leaves it to "friction added intentionally").

    The arguments are those of `estimated_velocity_torque`, and Ẋ (m,).
    """
    return g - damping * v - dot(kp * s + kv * x_dot, J_hat)


def estimated_velocity_torque(
    J_hat: Array, kp: Array, kv: Array, s: Array, v: Array, damping: Array, g: Array
) -> Array:
    """τ = −Ĵᵀ(K_p s(e) + K_v Ĵ q̇) − B_c q̇ + g(q).

    Implements Eq. (6), the paper's law: Ĵ q̇ takes the place of the measured task velocity.
    Departure: the added joint damping −B_c q̇ is written out; where n_v > m it is required.

    Args:
        J_hat: Estimated task Jacobian Ĵ, shape (m, n_v).
        kp: Diagonal of K_p, shape (m,).
        kv: Diagonal of K_v, shape (m,).
        s: Saturated error s(e), shape (m,).
        v: Joint velocity q̇, shape (n_v,).
        damping: Diagonal of B_c, shape (n_v,).
        g: Gravity torque, shape (n_v,).

    Returns:
        Joint torque τ, shape (n_v,).
    """
    return g - damping * v - dot(kp * s + kv * dot(J_hat, v), J_hat)


def learnt_gravity_torque(
    J_hat: Array,
    kp: Array,
    kv: Array,
    s: Array,
    v: Array,
    damping: Array,
    Z: Array,
    theta_hat: Array,
) -> Array:
    """τ = −Ĵᵀ(K_p s(e) + K_v Ĵ q̇) − B_c q̇ + Z(q) θ̂.

    Implements Eq. (28): eq. (6) with the gravity that has been learnt so far. (`SetpointController`
    composes it from (27) and (6), as its gravity may come from elsewhere.) The gravity regressor Z
    is (n_v, p), the estimated parameters θ̂ are (p,).
    """
    return estimated_velocity_torque(J_hat, kp, kv, s, v, damping, gravity(Z, theta_hat))


def bounded_torque(
    J_hat: Array, kp: Array, s: Array, v: Array, kd: Array, v0: Array, g: Array
) -> Array:
    """τ = −Ĵᵀ K_p s(e) − K_d tanh(q̇/v₀) + g(q), with s(e) = γ tanh(e/γ).

    No equation of the paper: the regulator with fixed estimates after W. E. Dixon, "Adaptive
    regulation of amplitude limited robot manipulators with uncertain kinematics and dynamics", IEEE
    Trans. Automatic Control 52(3), 2007. Whatever e and q̇ are, abs(τᵢ) is at most
    `bounded_torque_bound`. Ĵ, K_p, s, q̇ and g are those of `estimated_velocity_torque`; K_d (n_v,)
    is the diagonal of the largest damping torques, v₀ (n_v,) the velocities at which they saturate.
    """
    return g - kd * np.tanh(v / v0) - dot(kp * s, J_hat)


def bounded_torque_bound(J_hat: Array, kp: Array, gamma: Array, kd: Array, g: Array) -> Array:
    """Σⱼ abs(Ĵⱼᵢ) k_pj γⱼ + k_di + abs(gᵢ), which no abs(τᵢ) of `bounded_torque` exceeds.

    The arguments are those of `bounded_torque`, and the saturation values γ of s, shape (m,).
    """
    return np.abs(g) + kd + dot(kp * gamma, np.abs(J_hat))


def gravity(Z: Array, theta: Array) -> Array:
    """g = Z(q) θ, of the regressor Z (n_v, p) and gravity parameters (p,). Implements Eq. (27)."""
    return dot(Z, theta)
