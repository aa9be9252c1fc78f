"""The Lyapunov function of eq. (12) with free weights: V̇ = −zᵀQ(q)z with z = (q̇, s(e)).

With any G(q) in place of αĴ⁺ and any weights W of the potential,

    V = ½ q̇ᵀM q̇ + q̇ᵀM G s(e) + Σ wᵢ Sᵢ(eᵢ) + ½ s(e)ᵀΩ s(e)

obeys V̇ = −zᵀQz along eq. (9), where D = ĴᵀK_vĴ + B and

    Q = [[D − sym N, ½(D G + ĴᵀK_p − Jᵀ(W + s'(e) Ω))], [·, sym(K_p Ĵ G)]],
    N = ½ ∂M[Gs] + M ∂G[·]s + M G s'(e) J,

∂M[z] the derivative of M along z, and ∂G[·]s the matrix whose k-th column is (∂G/∂q_k) s. Nothing
is bounded or left out: Q depends on q and e only. It is affine in (G, W, Ω), so asking for Q ≻ 0 in
many configurations at once is a linear matrix inequality. The paper's V is G = αĴ⁺, W = K_p + αK_v,
Ω = 0. Ω is symmetric with a diagonal of zeros: where s(e) = e, W + Ω is any symmetric matrix.

All functions take stacks of configurations, arrays with any leading axes, of these shapes:

- M, the inertia matrix, and D of `dissipation`: (…, n_v, n_v);
- J, the true task Jacobian, and Ĵ, the estimated one: (…, m, n_v);
- G, the cross weight: (…, n_v, m);
- ∂M, ∂Ĵ and ∂G, derivatives with respect to each q_k: those of M, Ĵ and G with an axis for k
  before the last two, (…, n_v, ·, ·);
- s(e) and s'(e): (…, m);
- the diagonals of K_p, K_v and W: (m,), that of all viscous damping B: (n_v,), and Ω: (m, m).
"""

import numpy as np

from approxjac.validation import Array


def dissipation(J_hat: Array, kv: Array, B: Array) -> Array:
    """Return D = ĴᵀK_vĴ + B, the damping of the closed loop. Implements Eq. (9), its damping."""
    return J_hat.mT @ (kv[:, None] * J_hat) + np.diag(B)


def cross_weight_pinv(
    J_hat: Array, dJ_hat: Array, weight: Array | None = None
) -> tuple[Array, Array]:
    """Return G = Ĵ⁺ and ∂G, of Ĵ with full row rank: the cross weight of eq. (12) with α = 1.

    Ĵ⁺ = R⁻¹Ĵᵀ(ĴR⁻¹Ĵᵀ)⁻¹ with R of the diagonal `weight` (n_v,), I by default: of all q̇ with
    Ĵq̇ = s, Ĵ⁺s has the least q̇ᵀRq̇. Implements Eq. (12), its second term; the paper's R is I.
    """
    weighted, dweighted = (J_hat, dJ_hat) if weight is None else (J_hat / weight, dJ_hat / weight)
    inverse = np.linalg.inv(J_hat @ weighted.mT)
    G: Array = weighted.mT @ inverse
    tail = dweighted.mT @ inverse[..., None, :, :]
    rest, many = np.eye(G.shape[-2]) - G @ J_hat, G[..., None, :, :]
    return G, rest[..., None, :, :] @ tail - many @ (dJ_hat @ many)


def cross_weight_damped(D: Array, J_hat: Array, dJ_hat: Array, kv: Array) -> tuple[Array, Array]:
    """Return G = D⁻¹ĴᵀK_v and ∂G, a damped Ĵ⁺ for nonsingular D.

    It equals Ĵ⁺ for B = 0 and n_v = m. With it D G = ĴᵀK_v, so damping no longer stands in the
    cross block of Q, and it exists at singular Ĵ too. A widening of Eq. (12).
    """
    inverse = np.linalg.inv(D)
    G: Array = inverse @ (J_hat.mT * kv)
    tail = inverse[..., None, :, :] @ (dJ_hat.mT * kv)
    rest, many = np.eye(len(kv)) - J_hat @ G, G[..., None, :, :]
    return G, tail @ rest[..., None, :, :] - many @ (dJ_hat @ many)


def inertial_block(
    M: Array, dM: Array, J: Array, G: Array, dG: Array, s: Array, slope: Array
) -> Array:
    """Return sym N, (…, n_v, n_v): the inertial terms, which reduce the dissipation.

    Implements Eq. (13), its last terms, exactly: s(e)ᵀGᵀ(−½Ṁ + S)q̇ and the two that follow are
    −q̇ᵀN q̇ with N linear in s and s', the `slope`.
    """
    along: Array = np.einsum("...kij,...k->...ij", dM, (G @ s[..., None])[..., 0])
    turning = (dG @ s[..., None, :, None])[..., 0].mT
    N = 0.5 * along + M @ (turning + G @ (slope[..., None] * J))
    return 0.5 * (N + N.mT)


def decrease_matrix(
    D: Array,
    N: Array,
    J: Array,
    J_hat: Array,
    G: Array,
    kp: Array,
    weights: Array,
    coupling: Array | None = None,
    slope: Array | None = None,
) -> Array:
    """Return Q of V̇ = −zᵀQz, (…, n_v + m, n_v + m). Implements Eq. (13) with free weights.

    N is that of `inertial_block`, or zero in the limit of large gains. Where there is a `coupling`,
    Ω, there must be the `slope`, s'(e), with it.
    """
    cross = 0.5 * (D @ G + J_hat.mT * kp - J.mT * weights)
    if coupling is not None:
        assert slope is not None
        cross = cross - 0.5 * (slope[..., None] * J).mT @ coupling
    return _blocks(D - N, cross, stiffness_block(J_hat, G, kp))


def stiffness_block(J_hat: Array, G: Array, kp: Array) -> Array:
    """Return sym(K_p Ĵ G), the block of Q for s(e), (…, m, m); αK_p in eq. (13)."""
    block = kp[:, None] * (J_hat @ G)
    return 0.5 * (block + block.mT)


def potential(S: Array, s: Array, weights: Array, coupling: Array) -> Array:
    """Return V at rest, Σ wᵢSᵢ(eᵢ) + ½ s(e)ᵀΩ s(e), (…), of S(e) and s(e). Implements Eq. (12)."""
    return np.asarray(S @ weights + 0.5 * ((s @ coupling) * s).sum(axis=-1))


def potential_block(weights: Array, coupling: Array, c_bar: float) -> Array:
    """Return U = 2c̄ W + Ω, (m, m): V at rest is ≥ ½ s(e)ᵀU s(e). Implements Eq. (14)."""
    return np.asarray(2.0 * c_bar * np.diag(weights) + coupling)


def potential_matrix(M: Array, G: Array, block: Array) -> Array:
    """Return P = [[M, M G], [·, 2c̄ W + Ω]], of which V ≥ ½ zᵀPz. Implements Eq. (14).

    Its last block is that of `potential_block`.
    """
    return _blocks(M, M @ G, block)


def _blocks(upper: Array, cross: Array, lower: Array) -> Array:
    """[[upper, cross], [crossᵀ, lower]] for each configuration."""
    lower = np.broadcast_to(lower, (*cross.shape[:-2], *lower.shape[-2:]))
    return np.block([[upper, cross], [cross.mT, lower]])
