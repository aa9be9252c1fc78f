"""The control laws: eqs. (5), (6) and (28).

Shapes: Ĵ is (m, n_v), K_p, K_v, s and Ẋ are (m,) with the gains' diagonals, q̇, g, τ and the
diagonal of the added damping B_c are (n_v,).
"""

from approxjac.validation import Array


def measured_velocity_torque(
    J_hat: Array, kp: Array, kv: Array, s: Array, x_dot: Array, v: Array, damping: Array, g: Array
) -> Array:
    """Return τ = −Ĵᵀ(K_p s(e) + K_v Ẋ) − B_c q̇ + g(q), with Ẋ measured.

    Implements Eq. (5), the earlier law, kept as a baseline. Departure: the added joint damping
    −B_c q̇ is written out (the paper leaves it to "friction added intentionally").

    The arguments are those of `estimated_velocity_torque`, and Ẋ (m,).
    """
    return g - damping * v - (kp * s + kv * x_dot).dot(J_hat)


def estimated_velocity_torque(
    J_hat: Array, kp: Array, kv: Array, s: Array, v: Array, damping: Array, g: Array
) -> Array:
    """Return τ = −Ĵᵀ(K_p s(e) + K_v Ĵ q̇) − B_c q̇ + g(q).

    Implements Eq. (6), the paper's law: Ĵ q̇ takes the place of the measured task velocity.
    Implements Eq. (28), too, with the g that has been learnt so far, `gravity`. Departure: the
    added joint damping −B_c q̇ is written out; where n_v > m it is required.

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
    return g - damping * v - (kp * s + kv * J_hat.dot(v)).dot(J_hat)


def gravity(Z: Array, theta: Array) -> Array:
    """Return g = Z(q) θ of a regressor (n_v, p) and parameters (p,). Implements Eq. (27)."""
    return Z.dot(theta)
