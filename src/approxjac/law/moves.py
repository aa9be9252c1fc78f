"""Law (6) along a line x_d = x₀ + σ d of speed σ̇ = v: what its V and its own path are made of.

With r = Ĵ⁺d and ν = q̇ − vr in place of q̇, z = (ν, s(e)), the V of `law.matrix_form` obeys

    V̇ = −zᵀ(Q − vZ)z + yᵀ(w + f) + vδᵀ(Ws + s'GᵀMν),   y = ν + Gs,

with δ = (JĴ⁺ − I)d and f = −v²f₂ − v̇Mr − vB_n r; B_n is the joints' own viscous friction, B_c the
added one and B their sum. The torque's rate gains ψ and terms linear in ν. And with

    H = B⁻¹Ĵᵀ(JB⁻¹Ĵᵀ)⁻¹,  T = (I − HJ)B⁻¹,  h = r + H(d − Jr) − TB_n r

χ = q − He + TMq̇ obeys χ̇ = v h − Ḣe + (ṪM + TCᵀ)q̇ + Tw, as T takes no task force: slow robots run
along χ' = h(χ), geometry alone.

All functions take stacks (…), of the shapes of `law.matrix_form`; a derivative along each q_k has
an axis for k before the last two.
"""

from typing import NamedTuple

import numpy as np

from approxjac.validation import Array


def christoffel(dM: Array) -> Array:
    """Return c, (…, a, i, j), symmetric in i and j: (C(x)z)_a = Σ c_aij x_i z_j."""
    first = np.swapaxes(dM, -3, -2)
    return np.asarray(0.5 * (first + first.mT - dM))


class MovingTarget(NamedTuple):
    """Terms of a moving target, each for v = 1."""

    r: Array  # Ĵ⁺d, shape (…, n_v)
    C: Array  # C(r), shape (…, n_v, n_v)
    A: Array  # M ∂Ĵ⁺[·]d + C(r), shape (…, n_v, n_v)
    delta: Array  # δ, shape (…, m)
    f: tuple[Array, Array, Array]  # of −f, with v², v̇ and v, each (…, n_v)
    psi: tuple[Array, Array, Array]  # of what drives u̇, with v², v̇ and v, each (…, n_v)
    turning: Array  # what u̇ gains that is linear in ν, shape (…, n_v, n_v)


def motion(
    inertia: tuple[Array, Array],  # M and ∂M
    D_c: Array,
    J: Array,
    estimated: tuple[Array, Array],  # Ĵ and ∂Ĵ
    pinv: tuple[Array, Array],  # Ĵ⁺ and ∂Ĵ⁺
    d: Array,  # direction, shape (m,)
    saturated: tuple[Array, Array],  # s(e) and s'(e)
    dg: Array,
    gains: tuple[Array, Array],  # diagonals of K_p and K_v
    friction: Array,  # diagonal of B_n, shape (n_v,)
) -> MovingTarget:
    """Return the terms of a target that moves along d."""
    (M, dM), (J_hat, dJ_hat), (s, slope), (kp, kv) = inertia, estimated, saturated, gains
    r, turned = pinv[0] @ d, (pinv[1] @ d).mT  # (∂Ĵ⁺/∂q_k)d are the columns
    C = np.einsum("...aij,...i->...aj", christoffel(dM), r)
    A = M @ turned + C
    squared = (A @ r[..., None])[..., 0]
    delta = (J @ r[..., None])[..., 0] - d
    pull = np.ascontiguousarray(np.linalg.solve(M, D_c).mT)  # D_c M⁻¹
    dJ_r = np.einsum("...kij,...k->...ij", dJ_hat, r)
    half = dJ_r.mT @ (kv[:, None] * J_hat)
    driven = (pull @ (friction * r)[..., None])[..., 0] + (dg @ r[..., None])[..., 0]
    driven = driven - (J_hat.mT @ (kp * slope * delta)[..., None])[..., 0]
    driven = driven - (dJ_r.mT @ (kp * s)[..., None])[..., 0]
    psi = (pull @ squared[..., None])[..., 0], (D_c @ r[..., None])[..., 0], driven
    f = squared, (M @ r[..., None])[..., 0], friction * r
    return MovingTarget(r, C, A, delta, f, psi, pull @ (A + C) - half - half.mT)


def moving_part(at: MovingTarget, M: Array, G: Array, dG: Array) -> Array:
    """Return Z, (…, n_v + m, n_v + m), by which the motion reduces Q at v = 1; affine in G."""
    n, m = G.shape[-2:]
    Z = np.zeros((*G.shape[:-2], n + m, n + m))
    Z[..., :n, :n] = -0.5 * (at.A + at.A.mT)
    cross = at.C @ G + M @ np.einsum("...kij,...k->...ij", dG, at.r) - at.A.mT @ G
    Z[..., :n, n:] = 0.5 * cross
    Z[..., n:, :n] = 0.5 * cross.mT
    return Z


def path_rate(J: Array, J_hat: Array, d: Array, B: Array, friction: Array) -> tuple[Array, Array]:
    """Return dχ/dσ (…, n_v) of the path of a slow robot, and H (…, n_v, m)."""
    tall = J_hat.mT / B[:, None]
    H, r = tall @ np.linalg.inv(J @ tall), np.linalg.pinv(J_hat) @ d
    rubbed = friction / B * r
    return r - rubbed + (H @ (d - (J @ (r - rubbed)[..., None])[..., 0])[..., None])[..., 0], H


class OwnPath(NamedTuple):
    """The path of a slow robot, and the tensors that tell how far a fast one leaves it."""

    H: Array  # shape (…, n_v, m)
    dH: Array  # shape (…, n_v, n_v, m), k first
    T: Array  # shape (…, n_v, n_v)
    dT: Array  # shape (…, n_v, n_v, n_v), k first
    h: Array  # dχ/dσ, shape (…, n_v)
    dh: Array  # its derivatives, shape (…, n_v, n_v), k last


def own_path(
    J: Array,
    dJ: Array,
    J_hat: Array,
    dJ_hat: Array,
    pinv: tuple[Array, Array],
    d: Array,
    B: Array,  # diagonal, shape (n_v,); positive, any for as many joints as coordinates
    friction: Array,
) -> OwnPath:
    """Return H, T and h along d, with their derivatives."""
    tall, dtall = J_hat.mT / B[:, None], dJ_hat.mT / B[:, None]
    inverse = np.linalg.inv(J @ tall)
    H = tall @ inverse
    many, J_k = H[..., None, :, :], J[..., None, :, :]
    dH = (dtall - many @ (dJ @ tall[..., None, :, :] + J_k @ dtall)) @ inverse[..., None, :, :]
    T = (np.eye(len(B)) - H @ J) / B
    dT = -(dH @ J_k + many @ dJ) / B
    r, dr = pinv[0] @ d, pinv[1] @ d  # of dr k is the first axis
    left = d - (J @ r[..., None])[..., 0]
    h = r + (H @ left[..., None])[..., 0] - (T @ (friction * r)[..., None])[..., 0]
    dleft = (dJ @ r[..., None, :, None])[..., 0] + dr @ J.mT
    dh = dr + (dH @ left[..., None, :, None])[..., 0] - dleft @ H.mT
    dh = dh - (dT @ (friction * r)[..., None, :, None])[..., 0] - (friction * dr) @ T.mT
    return OwnPath(H, dH, T, dT, h, dh.mT)
