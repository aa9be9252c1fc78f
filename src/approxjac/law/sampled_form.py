"""The matrix form of the sampled loop: torque held and late, x in frames that are late.

The torque that acts is the law's own and an error, τ = u + w, M q̈ = −C q̇ − D q̇ − ĴᵀK_p s + w, and
the V of `law.matrix_form` obeys V̇ = −zᵀQz + yᵀw with y = q̇ + G s. A torque that was computed
earlier has missed what u did since, so that w is small where u̇ is, in the mean over any time:

    √(∫ wᵀD⁻¹w dt) ≤ Γ √(∫ u̇ᵀD⁻¹u̇ dt),   Γ = γ of `hold_gain` times `growth`.

u̇ = T₀z + Uw and a rest that is quadratic in q̇, which is at most κ |q̇|_M |q̇|_D. With |q̇|_M ≤ v̄ and
b = Γκv̄, V is bounded by its start wherever the form `held_form` is positive for some λ ≥ 0.
Where x comes in frames, s in the torque is s + w_x with

    ∫ w_xᵀX w_x dt ≤ γ_x² ∫ |s' J_e q̇|²_X dt,   X constant and diagonal.

Shapes are those of `law.matrix_form`; D_c is D without the arm's own friction.
"""

import math
from typing import NamedTuple

import numpy as np

from approxjac.law.matrix_form import stiffness_block
from approxjac.validation import Array

_MOST = 100.0  # e to more of it certifies nothing
_FEW = 100  # of a stack, that tell which bound is the best


def hold_gain(period: float, late: float) -> float:
    """Return γ = late + 2/π · period [s] of a signal that is held between samples and delayed.

    The error of a held signal starts each period at 0: Wirtinger's inequality with one free end has
    2/π of the longest period. A delay adds itself, as ∫|u(t) − u(t − d)|² ≤ d²∫|u̇|².
    """
    return late + 2.0 * period / math.pi


def growth(rate: float, span: float, lag: float = 0.0) -> float:
    """Return the factor on γ if signals count e^(rate · t) in time; infinite if unbounded.

    For rates of V, and for weights that change by at most e^(2 · rate · t) in a time t.

    `span` is the longest time that what acts is out of date, `lag` the mean age of what a filter
    with a falling response makes of it [s]. Such an age σ is less spread than one with exponential
    distribution, so E σe^(rate σ) ≤ lag/(1 − rate lag)².
    """
    exponent, left = rate * span, 1.0 - rate * lag
    return math.exp(exponent) / left**2 if exponent < _MOST and left > 0.0 else math.inf


class TorqueRate(NamedTuple):
    """u̇ = T z + U w + T_x w_x, without the terms quadratic in q̇."""

    T: Array  # shape (…, n_v, n_v + m)
    U: Array  # shape (…, n_v, n_v)
    T_x: Array | None  # shape (…, n_v, m); None where x is read with the rest of the state


def torque_rate(
    M: Array,
    D: Array,
    D_c: Array,
    J_hat: Array,
    dJ_hat: Array,
    J_e: Array,
    s: Array,
    slope: Array,
    kp: Array,
    dg: Array | None = None,
) -> TorqueRate:
    """Return the rate of u = −ĴᵀK_p s − D_c q̇ + g along the loop.

    `dg` is ∂g/∂q of the gravity torque that is held with it, (…, n_v, n_v).
    """
    E = (dJ_hat.mT @ (kp * s)[..., np.newaxis, :, np.newaxis])[..., 0].mT
    rate = damping_rate_of_torque(M, D, D_c, J_hat, kp, dg)
    n = M.shape[-1]
    T = rate.T.copy()
    T[..., :n] -= E + J_hat.mT @ ((kp * slope)[..., np.newaxis] * J_e)
    return TorqueRate(T, rate.U, None)


def damping_rate_of_torque(
    M: Array, D: Array, D_c: Array, J_hat: Array, kp: Array, dg: Array | None = None
) -> TorqueRate:
    """Return the rate of u = −D_c q̇ + g along the loop, if s comes in frames, as s + w_x."""
    pull = _pull(M, D_c)
    stiffness = pull @ (J_hat.mT * kp)
    along = pull @ D
    if dg is not None:
        along = along + dg
    T: Array = np.concatenate([along, stiffness], axis=-1)
    return TorqueRate(T, -np.asarray(pull, dtype=np.float64), stiffness)


def torque_curvature(
    M: Array, dM: Array, D: Array, D_c: Array, J_hat: Array, dJ_hat: Array, kv: Array
) -> Array:
    """Return κ, (…): the part of u̇ quadratic in q̇ is at most κ |q̇|_M |q̇|_D in the norm of D⁻¹.

    D_cM⁻¹C(q, q̇)q̇ − ∂D_c[q̇]q̇, whose tensor is bounded by `tensor_bound`.
    """
    coriolis = np.swapaxes(dM, -3, -2) - 0.5 * dM  # [a, i, j] of (C q̇)_a
    pull = _pull(M, D_c)
    shape = coriolis.shape
    tensor = (pull @ coriolis.reshape(*shape[:-2], -1)).reshape(shape)
    tensor = tensor - np.swapaxes(_damping_gradient(J_hat, dJ_hat, kv), -3, -2)
    tensor = 0.5 * (tensor + tensor.mT)
    root, root_M = _inverse_root(D), _inverse_root(M)
    return tensor_bound(_turned(tensor, root, root_M, root))


def damping_turn(
    M: Array, D: Array, J_hat: Array, dJ_hat: Array, kv: Array, along: bool = False
) -> Array:
    """Return k_R, (…): D changes by at most the factor e^(k_R v̄ t) in a time t with |q̇|_M ≤ v̄.

    `along` gives k_f instead: |∂D[q̇]p| is at most k_f |q̇|_D |p|_M in the norm of D⁻¹.
    """
    root, root_M = _inverse_root(D), _inverse_root(M)
    sides = (root, root, root_M) if along else (root_M, root, root)
    return tensor_bound(_turned(_damping_gradient(J_hat, dJ_hat, kv), *sides))


def stiffness_turn(D: Array, dJ_hat: Array, kp: Array) -> Array:
    """Return ē, (…): |∂Ĵᵀ[q̇]K_p s| is at most ē |q̇|_D |s| in the norm of D⁻¹."""
    root, gradient = _inverse_root(D), dJ_hat.mT * kp  # [k, a, j]
    return tensor_bound(_turned(gradient, root, root, np.eye(len(kp))))


def tensor_bound(tensor: Array) -> Array:
    """Return a bound of |T(x, y, z)| for unit vectors, (…), for T (…, a, b, c).

    The spectral norm of one of the three matrices that it unfolds to: of all tensors of a stack the
    same one, which is the best for the first of them.
    """
    unfolded = [np.moveaxis(tensor, axis, -3) for axis in (-3, -2, -1)]
    few = [np.max(_norms(each.reshape(-1, *each.shape[-3:])[:_FEW])) for each in unfolded]
    return _norms(unfolded[int(np.argmin(few))])


def _norms(tensor: Array) -> Array:
    """Spectral norms of the tensors unfolded along the third axis from the end."""
    rows = tensor.reshape(*tensor.shape[:-2], -1)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(rows @ rows.mT)[..., -1], 0.0)))


def held_form(
    Q: Array,  # of `decrease_matrix`
    G: Array,  # cross weight
    D: Array,  # of `dissipation`
    J_hat: Array,  # Ĵ
    kp: Array,  # diagonal of K_p
    rate: TorqueRate,  # of `torque_rate`; of `damping_rate_of_torque` where x comes in frames
    multiplier: float,  # λ ≥ 0
    gain: float,  # Γ² [s²]
    # what w has beside Γ times T z + U w is at most b |q̇|_D: Γκv̄ of what is quadratic in q̇,
    # and with frames (h + d) ē s̄ more; constant
    b: float,
    # the diagonal of X (m,), s'(e) J_e (…, m, n_v), and γ_x² [s²], where x comes in frames: N is
    # 2 n_v + 2 m then, 2 n_v + m without
    frames: tuple[Array, Array, float] | None = None,
) -> Array:
    """Return F, (…, N, N): ∫zᵀQz − yᵀw of the sampled loop is at least ∫(z, w)ᵀF(z, w).

    Affine in (Q, G), in the multiplier λ and in X.
    """
    n, m = G.shape[-2:]
    sizes = (n, m, n) if frames is None else (n, m, n, m)
    at = np.cumsum((0, *sizes))
    v, s, w = (slice(*at[k : k + 2]) for k in range(3))
    z = slice(0, n + m)
    F = np.zeros((*Q.shape[:-2], at[-1], at[-1]))
    F[..., z, z] = Q
    F[..., v, w] = -0.5 * np.eye(n)
    F[..., s, w] = -0.5 * G.mT
    R = np.linalg.inv(D)
    F[..., w, w] = multiplier * R
    parts = [rate.T, rate.U]
    if frames is not None:
        X, seen, gain_x = frames
        x = slice(at[3], at[4])
        assert rate.T_x is not None
        parts.append(rate.T_x)
        pull = 0.5 * J_hat.mT * kp
        F[..., v, x] = pull
        F[..., s, x] = G.mT @ pull
        F[..., x, x] = np.diag(X)
        F[..., v, v] -= gain_x * (seen.mT @ (X[:, np.newaxis] * seen))
    whole = np.concatenate(parts, axis=-1)
    scale = multiplier * gain
    F -= scale * (1.0 + b) * (whole.mT @ R @ whole)
    F[..., v, v] -= multiplier * (b + b * b) * D
    upper = np.triu(F, 1)
    return upper + upper.mT + F * np.eye(at[-1])


def held_margin(F: Array, D: Array, J_hat: Array, G: Array, kp: Array) -> Array:
    """Return the largest μ of F ⪰ μ diag(D, sym K_pĴG, 0), (…); −∞ if its last blocks are ≤ 0."""
    n, m = G.shape[-2:]
    k = n + m
    lower = F[..., k:, k:]
    margins = np.full(F.shape[:-2], -np.inf)
    stiffness = stiffness_block(J_hat, G, kp)
    good = (np.linalg.eigvalsh(lower)[..., 0] > 0.0) & (np.linalg.eigvalsh(stiffness)[..., 0] > 0.0)
    part, cross = F[good], F[good][..., :k, k:]
    left = part[..., :k, :k] - cross @ np.linalg.solve(part[..., k:, k:], cross.mT)
    whole = np.zeros_like(left)
    whole[..., :n, :n], whole[..., n:, n:] = D[good], stiffness[good]
    root = _inverse_root(whole)
    margins[good] = np.linalg.eigvalsh(root @ left @ root.mT)[..., 0]
    return margins


def _damping_gradient(J_hat: Array, dJ_hat: Array, kv: Array) -> Array:
    """∂D/∂q_k, (…, k, n_v, n_v)."""
    half = dJ_hat.mT @ (kv[:, np.newaxis] * J_hat)[..., np.newaxis, :, :]
    return half + half.mT


def _turned(tensor: Array, A: Array, B: Array, C: Array) -> Array:
    """A_xa B_yi C_zj T_aij of stacks."""
    last = tensor @ C.mT[..., np.newaxis, :, :]
    middle = B[..., np.newaxis, :, :] @ last
    shape = middle.shape
    flat = middle.reshape(*shape[:-2], -1)
    return np.asarray((A @ flat).reshape(shape))


def _pull(M: Array, D_c: Array) -> Array:
    """D_c M⁻¹, both symmetric; in its own memory, or products with it take ten times as long."""
    return np.ascontiguousarray(np.linalg.solve(M, D_c).mT)


def _inverse_root(A: Array) -> Array:
    """L⁻¹ of A = L Lᵀ."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(A)))
