"""The Lyapunov function V, its decrease W, and the conditions of Theorem 1.

V and W are eqs. (12), (13) and (31); along the closed loop V̇ = −W holds identically. They need the
true J and M: they analyse a closed loop and never run inside a controller.

Theorem 1, eqs. (7), (14) and (21) to (25), requires that p, a bound of ‖Jᵀ − Ĵᵀ‖, is below both
curves of the paper's Figure 1, with gains large enough for the terms c₀ and c₁ of inertia and
damping.
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


def jacobian_error(J: Array, J_hat: Array) -> float:
    """Return ‖Jᵀ − Ĵᵀ‖, the spectral norm. Implements Eq. (7) at one configuration."""
    return float(np.linalg.norm(J - J_hat, 2))


def lambda_2(J_hat: Array, B_over_kv: Array) -> float:
    """Return λ₂ = λ_min[Ĵᵀ Ĵ + B / k_v] of Ĵ (m, n_v) and the diagonal of B / k_v (n_v,).

    Implements Eq. (23), its eigenvalue.
    """
    smallest = np.linalg.eigvalsh(J_hat.T @ J_hat + np.diag(B_over_kv))[0]
    return max(float(smallest), 0.0)  # it is never negative but for round-off


def largest_alpha(kv: Array, c_bar: float, lambda_m: float) -> float:
    """Return the α below which k_vi c̄ − αλ_m > 0 for all i [1/s], with λ_m = λ_max[Ĵ⁺ᵀ M Ĵ⁺].

    Implements Eq. (14), of the diagonal of K_v (m,) and c̄ of eq. (8).
    """
    return float(kv.min()) * c_bar / lambda_m


def allowed_p(
    alpha: float, kp: Array, kv: Array, lambda1: float, c0: float, c1: float
) -> tuple[float, float]:
    """Return the p below which l₁ λ_max[K_v] > αc₀, and that below which l₂ λ_max[K_v] > αc₁.

    Implements Eq. (22), solved for p. Implements Eq. (21), too, with c₀ = c₁ = 0. Departure: λ₁ is
    λ_min[ĴᵀK_vĴ + B] / λ_max[K_v], not of J. c₀ and c₁ are those of eq. (15), α > 0 is in 1/s, and
    the gains are diagonals (m,).
    """
    k = float(kv.max())
    spread = float(kp.max()) + alpha * k
    return (
        2.0 * (k * lambda1 - alpha * c0) / spread,
        2.0 * alpha * (float(kp.min()) - c1) / spread,
    )


def best_alpha(
    kp: Array, kv: Array, lambda1: float, c0: float, c1: float, alpha_max: float
) -> float:
    """Return the α that allows the largest p: where the two bounds of (22) cross, or `alpha_max`.

    Implements Eq. (24) with c₀, c₁ and gains that differ from axis to axis: the first bound falls
    with α and the second rises.
    """
    slope = float(kp.min()) - c1 + c0
    return min(float(kv.max()) * lambda1 / slope, alpha_max) if slope > 0.0 else alpha_max


def allowed_p_velocity(a: Array, alpha: float, lambda2: float) -> Array:
    """Return 2 λ₂ / (a + α), the falling curve of Figure 1. Implements Eq. (23), first."""
    return 2.0 * lambda2 / (a + alpha)


def allowed_p_position(a: Array, alpha: float) -> Array:
    """Return 2 a α / (a + α), the rising curve of Figure 1. Implements Eq. (23), second."""
    return 2.0 * a * alpha / (a + alpha)


def allowed_p_at_crossing(alpha: float, lambda2: float) -> float:
    """Return 2 α λ₂ / (α² + λ₂), where the curves cross, at a = λ₂ / α.

    Implements Eq. (24). Departure: the paper prints a = λ₁/α for the crossing.
    """
    return 2.0 * alpha * lambda2 / (alpha**2 + lambda2) if lambda2 > 0.0 else 0.0


def largest_allowed_p(lambda2: float) -> float:
    """Return λ₂^½, the largest p that any α allows, reached at α = λ₂^½. Implements Eq. (25).

    Departure: the paper says that the left-hand side of (24) is maximal there; it is the
    right-hand side.
    """
    return float(np.sqrt(lambda2))
