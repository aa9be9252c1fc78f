"""The closed loops of eq. (9) and of eqs. (28), (29), linearised at the target."""

from __future__ import annotations

import numpy as np

from approxjac.validation import Array


def closed_loop_matrix(M: Array, J: Array, J_hat: Array, kp: Array, kv: Array, B: Array) -> Array:
    """A = [[0, I], [−M⁻¹ĴᵀK_p J, −M⁻¹(ĴᵀK_v Ĵ + B)]], the linearisation of eq. (9).

    Implements Eq. (9) to first order in (δq, q̇) about q̇ = 0, e = 0, where s'(0) = 1.

    Args:
        M: Inertia matrix at the target, shape (…, n_v, n_v).
        J: True task Jacobian there, shape (…, m, n_v).
        J_hat: Estimated task Jacobian there, shape (…, m, n_v).
        kp: Diagonal of K_p, shape (m,).
        kv: Diagonal of K_v, shape (m,).
        B: Diagonal of all viscous damping, natural and added, shape (n_v,).

    Returns:
        A, shape (…, 2 n_v, 2 n_v).
    """
    n = M.shape[-1]
    A = np.zeros((*M.shape[:-2], 2 * n, 2 * n))
    A[..., :n, n:] = np.eye(n)
    A[..., n:, :n] = -np.linalg.solve(M, J_hat.mT * kp @ J)
    A[..., n:, n:] = -np.linalg.solve(M, J_hat.mT * kv @ J_hat + np.diag(B))
    return A


def adaptive_closed_loop_matrix(
    M: Array,
    J: Array,
    J_hat: Array,
    J_hat_pinv: Array,
    kp: Array,
    kv: Array,
    B: Array,
    Z: Array,
    L: Array,
    alpha: float,
) -> Array:
    """A = [[A₉, [0; M⁻¹Z]], [[−αLZᵀĴ⁺J, −LZᵀ], 0]] with A₉ of `closed_loop_matrix`.

    Implements Eq. (30), with (29), to first order in (δq, q̇, δθ̂) about q̇ = 0, e = 0, θ̂ = θ,
    where s'(0) = 1. Departure: the paper prints Ṁ for ½Ṁ, of no effect to first order.

    Of Z(q)θ̂ − g(q) only Z δθ̂ is left: Z(q)θ is g(q) for every q, so the gradients of the two
    cancel. Ĵ and Z in (29) are taken at the target: what multiplies their changes is zero there.

    The arguments are those of `closed_loop_matrix`; Ĵ⁺ as the law has it, shape (…, n_v, m); the
    gravity regressor Z at the target, shape (…, n_v, p); the adaptation gain L, a diagonal (p,) or
    a matrix (p, p); and α > 0 [1/s].

    Returns:
        A, shape (…, 2 n_v + p, 2 n_v + p).
    """
    n, p = Z.shape[-2:]
    LZ = learning_gain(L, Z)
    A = np.zeros((*M.shape[:-2], 2 * n + p, 2 * n + p))
    A[..., : 2 * n, : 2 * n] = closed_loop_matrix(M, J, J_hat, kp, kv, B)
    if p:
        A[..., n : 2 * n, 2 * n :] = np.linalg.solve(M, Z)
        A[..., 2 * n :, :n] = -alpha * LZ @ J_hat_pinv @ J
        A[..., 2 * n :, n : 2 * n] = -LZ
    return A


def learning_gain(L: Array, Z: Array) -> Array:
    """L Zᵀ of (29), shape (…, p, n_v), with L a diagonal (p,) or a matrix (p, p)."""
    return L[:, np.newaxis] * Z.mT if L.ndim == 1 else np.asarray(L @ Z.mT)
