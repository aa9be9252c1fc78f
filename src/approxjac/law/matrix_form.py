"""The Lyapunov function of eq. (12) with free weights: V̇ = −zᵀQ(q)z with z = (q̇, s(e)).

With any G(q) in place of αĴ⁺ and any weights W of the potential,

    V = ½ q̇ᵀM q̇ + q̇ᵀM G s(e) + Σ wᵢ Sᵢ(eᵢ)

obeys V̇ = −zᵀQz along eq. (9), where D = ĴᵀK_vĴ + B and

    Q = [[D − sym N, ½(D G + ĴᵀK_p − JᵀW)], [·, sym(K_p Ĵ G)]],
    N = ½ ∂M[Gs] + M ∂G[·]s + M G s'(e) J,

∂M[z] the derivative of M along z, and ∂G[·]s the matrix whose k-th column is (∂G/∂q_k) s. Nothing
is bounded or left out: Q depends on q and e only. It is affine in (G, W), so asking for Q ≻ 0 in
many configurations at once is a linear matrix inequality. The paper's V is G = αĴ⁺, W = K_p + αK_v.

All functions take stacks of configurations: arrays with any leading axes.
"""

from __future__ import annotations

import numpy as np

from approxjac.validation import Array


def dissipation(J_hat: Array, kv: Array, B: Array) -> Array:
    """D = ĴᵀK_vĴ + B, what damps the closed loop. Implements Eq. (9), its damping.

    Args:
        J_hat: Estimated task Jacobian, shape (…, m, n_v).
        kv: Diagonal of K_v, shape (m,).
        B: Diagonal of all viscous damping, shape (n_v,).

    Returns:
        Shape (…, n_v, n_v).
    """
    return _T(J_hat) @ (kv[:, None] * J_hat) + np.diag(B)


def cross_weight_pinv(J_hat: Array, dJ_hat: Array) -> tuple[Array, Array]:
    """G = Ĵ⁺ and its derivatives: the cross weight of eq. (12) with α = 1.

    Implements Eq. (12), its second term.

    Args:
        J_hat: Estimated task Jacobian of full row rank, shape (…, m, n_v).
        dJ_hat: ∂Ĵ/∂q_k, shape (…, n_v, m, n_v), k first.

    Returns:
        G, shape (…, n_v, m), and ∂G/∂q_k, shape (…, n_v, n_v, m), k first.
    """
    inverse = np.linalg.inv(J_hat @ _T(J_hat))
    G: Array = _T(J_hat) @ inverse
    tail = _T(dJ_hat) @ inverse[..., None, :, :]
    many, J_many = G[..., None, :, :], J_hat[..., None, :, :]
    dG: Array = tail - many @ (J_many @ tail) - many @ (dJ_hat @ many)
    return G, dG


def cross_weight_damped(D: Array, J_hat: Array, dJ_hat: Array, kv: Array) -> tuple[Array, Array]:
    """G = D⁻¹ĴᵀK_v and its derivatives: what Ĵ⁺ becomes where damping shares the motion.

    It equals Ĵ⁺ for B = 0 and n_v = m. With it D G = ĴᵀK_v, so damping no longer stands in the
    cross block of Q, and it exists at singular Ĵ too. A widening of Eq. (12).

    Args:
        D: `dissipation`, shape (…, n_v, n_v), nonsingular.
        J_hat: Estimated task Jacobian, shape (…, m, n_v).
        dJ_hat: ∂Ĵ/∂q_k, shape (…, n_v, m, n_v), k first.
        kv: Diagonal of K_v, shape (m,).

    Returns:
        G, shape (…, n_v, m), and ∂G/∂q_k, shape (…, n_v, n_v, m), k first.
    """
    weighted = kv[:, None] * J_hat
    G: Array = np.asarray(np.linalg.solve(D, _T(weighted)), dtype=np.float64)
    half = _T(dJ_hat) @ weighted[..., None, :, :]
    rhs = _T(kv[:, None] * dJ_hat) - (half + _T(half)) @ G[..., None, :, :]
    return G, np.asarray(np.linalg.solve(D[..., None, :, :], rhs), dtype=np.float64)


def inertial_block(
    M: Array, dM: Array, J: Array, G: Array, dG: Array, s: Array, slope: Array
) -> Array:
    """sym N: what inertia takes from the dissipation, the bracket of eq. (13) as a matrix.

    Implements Eq. (13), its last terms, exactly: s(e)ᵀGᵀ(−½Ṁ + S)q̇ and the two that follow are
    −q̇ᵀN q̇ with N linear in s and s'.

    Args:
        M: Inertia matrix, shape (…, n_v, n_v).
        dM: ∂M/∂q_k, shape (…, n_v, n_v, n_v), k first.
        J: True task Jacobian, shape (…, m, n_v).
        G: Cross weight, shape (…, n_v, m).
        dG: ∂G/∂q_k, shape (…, n_v, n_v, m), k first.
        s: s(e), shape (…, m).
        slope: s'(e), shape (…, m).

    Returns:
        Shape (…, n_v, n_v).
    """
    along: Array = np.einsum("...kij,...k->...ij", dM, (G @ s[..., None])[..., 0])
    turning = _T((dG @ s[..., None, :, None])[..., 0])
    N = 0.5 * along + M @ (turning + G @ (slope[..., None] * J))
    symmetric: Array = 0.5 * (N + _T(N))
    return symmetric


def decrease_matrix(
    D: Array, N: Array, J: Array, J_hat: Array, G: Array, kp: Array, weights: Array
) -> Array:
    """Q of V̇ = −zᵀQz. Implements Eq. (13) with free weights.

    Args:
        D: `dissipation`, shape (…, n_v, n_v).
        N: `inertial_block`, shape (…, n_v, n_v); zero in the limit of large gains.
        J: True task Jacobian, shape (…, m, n_v).
        J_hat: Estimated task Jacobian, shape (…, m, n_v).
        G: Cross weight, shape (…, n_v, m).
        kp: Diagonal of K_p, shape (m,).
        weights: w, the diagonal of W, shape (m,).

    Returns:
        Shape (…, n_v + m, n_v + m), symmetric.
    """
    cross = 0.5 * (D @ G + _T(J_hat) * kp - _T(J) * weights)
    return _blocks(D - N, cross, stiffness_block(J_hat, G, kp))


def stiffness_block(J_hat: Array, G: Array, kp: Array) -> Array:
    """sym(K_p Ĵ G), the block of Q that belongs to s(e); αK_p in eq. (13). Shape (…, m, m)."""
    block = kp[:, None] * (J_hat @ G)
    return 0.5 * (block + _T(block))


def potential_matrix(M: Array, G: Array, weights: Array, c_bar: float) -> Array:
    """P of V ≥ ½ zᵀPz: [[M, M G], [·, 2c̄ W]]. Implements Eq. (14) as a matrix.

    Args:
        M: Inertia matrix, shape (…, n_v, n_v).
        G: Cross weight, shape (…, n_v, m).
        weights: w, the diagonal of W, shape (m,).
        c_bar: c̄ of eq. (8).

    Returns:
        Shape (…, n_v + m, n_v + m), symmetric.
    """
    return _blocks(M, M @ G, 2.0 * c_bar * np.diag(weights))


def _blocks(upper: Array, cross: Array, lower: Array) -> Array:
    """[[upper, cross], [crossᵀ, lower]] for each configuration."""
    n, m = cross.shape[-2:]
    joined = np.empty((*cross.shape[:-2], n + m, n + m))
    joined[..., :n, :n] = upper
    joined[..., :n, n:] = cross
    joined[..., n:, :n] = _T(cross)
    joined[..., n:, n:] = lower
    return joined


def _T(A: Array) -> Array:
    return np.swapaxes(A, -1, -2)
