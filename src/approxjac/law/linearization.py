"""The closed loop of eq. (9), linearised at the target."""

from __future__ import annotations

import numpy as np

from approxjac.checks import Array


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
    forces = np.swapaxes(J_hat, -1, -2)
    A[..., n:, :n] = -np.linalg.solve(M, forces * kp @ J)
    A[..., n:, n:] = -np.linalg.solve(M, forces * kv @ J_hat + np.diag(B))
    return A
