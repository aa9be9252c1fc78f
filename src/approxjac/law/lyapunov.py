"""The Lyapunov function V and its decrease W, eqs. (12), (13) and (31).

Along the closed loop V̇ = −W holds identically. These functions need the true J and M: they
analyse a closed loop and never run inside a controller.
"""

import numpy as np

from approxjac.validation import Array


def V(
    v: Array,
    s: Array,
    potential: Array,
    J_hat_pinv: Array,
    M: Array,
    kp: Array,
    kv: Array,
    alpha: float,
) -> float:
    """Return V = ½ q̇ᵀM q̇ + α q̇ᵀM Ĵ⁺ s(e) + Σ (k_pi + α k_vi) S_i(e_i).

    Implements Eq. (12).

    q̇ is (n_v,); s(e), the potentials S_i(e_i) and the gains' diagonals are (m,), Ĵ⁺ is (n_v, m), M
    (n_v, n_v), α [1/s] and V [J].
    """
    Mv = M @ v
    return float(0.5 * v @ Mv + alpha * (Mv @ (J_hat_pinv @ s)) + (kp + alpha * kv) @ potential)


def W(
    v: Array,
    saturated: tuple[Array, Array],
    J: Array,
    J_hat: Array,
    pinv: tuple[Array, Array],
    inertia: tuple[Array, Array, Array],
    B: Array,
    kp: Array,
    kv: Array,
    alpha: float,
) -> float:
    """Return W = −V̇ along the closed loop.

    Implements Eq. (13). Departures: the last term is −s(e)ᵀ(d/dt Ĵ⁺)ᵀM q̇ (the paper's dot is
    missing), and (B − ½Ṁ + S)q̇ is evaluated as B q̇ + C(q, q̇)q̇ − Ṁ q̇.

    The arguments are those of `V` and: s(e) with ds/dt = s'(e) J q̇, shape (m,); the true ∂e/∂q for
    J, which is the task Jacobian where e = x − x_d, and Ĵ, shape (m, n_v); Ĵ⁺ with d/dt Ĵ⁺, shape
    (n_v, m); M with dM/dt, shape (n_v, n_v), and C(q, q̇)q̇, shape (n_v,); and B, the diagonal of
    all viscous damping, natural and added, shape (n_v,).

    Returns:
        W [W].
    """
    (s, s_dot), (J_hat_pinv, J_hat_pinv_dot), (M, M_dot, coriolis) = saturated, pinv, inertia
    Jhv = J_hat @ v
    delta_v = J @ v - Jhv
    Mv = M @ v
    damping = v @ (B * v) + Jhv @ (kv * Jhv)
    stiffness = alpha * s @ (kp * s)
    mismatch = delta_v @ ((kp + alpha * kv) * s)
    inertial = (
        (J_hat_pinv @ s) @ (B * v + coriolis - M_dot @ v)
        - (J_hat_pinv @ s_dot) @ Mv
        - (J_hat_pinv_dot @ s) @ Mv
    )
    return float(damping + stiffness - mismatch + alpha * inertial)


def parameter_potential(theta_error: Array, L: Array) -> float:
    """Return ½ Δθᵀ L⁻¹ Δθ [J], added to V where gravity is learnt, with Δθ = θ − θ̂ (p,).

    The adaptation gain L is a diagonal (p,), with 0 for what is known and not learnt, or a matrix
    (p, p). Implements Eq. (31). Departure: the paper prints L for L⁻¹.
    """
    if L.ndim == 1:
        scaled = np.divide(theta_error, L, out=np.zeros_like(theta_error), where=L > 0.0)
    else:
        scaled = np.linalg.solve(L, theta_error)
    return float(0.5 * theta_error @ scaled)
