"""The closed loops of eqs. (9) and (28), (29) to first order: continuous, and sampled and late."""

import math
from typing import NamedTuple

import numpy as np

from approxjac.validation import Array

_SHORT, _ORDER = 0.5, 16  # in time constants of friction and gravity; terms of the series for it


def closed_loop_matrix(
    M: Array,
    J: Array,
    J_hat: Array,
    kp: Array,
    kv: Array,
    B: Array,
    learning: tuple[Array, Array, Array] | None = None,
) -> Array:
    """Return A of the closed loop to first order about q̇ = 0, e = 0, where s'(0) = 1.

    A₉ = [[0, I], [−M⁻¹ĴᵀK_p J, −M⁻¹(ĴᵀK_v Ĵ + B)]] in (δq, q̇). Implements Eq. (9). Where gravity is
    learnt, A = [[A₉, [0; M⁻¹Z]], [[−αLZᵀĴ⁺J, −LZᵀ], 0]] in (δq, q̇, δθ̂) about θ̂ = θ. Implements
    Eq. (30), with (29). Departure: the paper prints Ṁ for ½Ṁ, of no effect to first order.

    Of Z(q)θ̂ − g(q) only Z δθ̂ is left: Z(q)θ is g(q) for every q, so the gradients of the two
    cancel. Ĵ and Z in (29) are taken at the target: what multiplies their changes is zero there.

    Args:
        M: Inertia matrix at the target, shape (…, n_v, n_v).
        J: True task Jacobian there, shape (…, m, n_v).
        J_hat: Estimated task Jacobian there, shape (…, m, n_v).
        kp: Diagonal of K_p, shape (m,).
        kv: Diagonal of K_v, shape (m,).
        B: Diagonal of all viscous damping, natural and added, shape (n_v,).
        learning: Z at the target, shape (…, n_v, p); L, a diagonal (p,) or a matrix (p, p); and αĴ⁺
            as the law has it, shape (…, n_v, m).

    Returns:
        A, shape (…, 2 n_v + p, 2 n_v + p).
    """
    n, p = M.shape[-1], 0 if learning is None else learning[0].shape[-1]
    A = np.zeros((*M.shape[:-2], 2 * n + p, 2 * n + p))
    A[..., :n, n : 2 * n] = np.eye(n)
    A[..., n : 2 * n, :n] = -np.linalg.solve(M, J_hat.mT * kp @ J)
    A[..., n : 2 * n, n : 2 * n] = -np.linalg.solve(M, J_hat.mT * kv @ J_hat + np.diag(B))
    if learning is not None and p:
        Z, L, pull = learning
        LZ = learning_gain(L, Z)
        A[..., n : 2 * n, 2 * n :] = np.linalg.solve(M, Z)
        A[..., 2 * n :, :n] = -LZ @ pull @ J
        A[..., 2 * n :, n : 2 * n] = -LZ
    return A


def learning_gain(L: Array, Z: Array) -> Array:
    """Return L Zᵀ of (29), shape (…, p, n_v), with L a diagonal (p,) or a matrix (p, p)."""
    return L[:, np.newaxis] * Z.mT if L.ndim == 1 else np.asarray(L @ Z.mT)


class LinearLaw(NamedTuple):
    """The linearised loop at rest at its target, a batch of k of them."""

    M_inv: Array  # inverse of the true inertia matrix, shape (k, n_v, n_v)
    J: Array  # true task Jacobian, shape (k, m, n_v)
    stiffness: Array  # ĴᵀK_p, shape (k, n_v, m)
    damping: Array  # ĴᵀK_vĴ + B_c, shape (k, n_v, n_v)
    learning: Array  # Y L Yᵀ, which turns y into the rate of the learnt torque, (k, n_v, n_v)
    pull: Array  # αĴ⁺, shape (k, n_v, m)


def frame_map(
    loop: LinearLaw,
    dt: float,
    samples: int,
    age: int,
    torque_late: int = 0,
    velocity_filter: float | None = None,
    friction: Array | None = None,
    gravity: Array | None = None,
) -> Array:
    """Return the map of the state from one frame of x to the next, exact to first order.

    Between samples the torque is held. With κ what is left of the learnt torque to learn, near the
    target,

        M q̈ = −ĴᵀK_p x − (ĴᵀK_vĴ + B_c) q̇ + κ + ∂g q − B_n q̇ − ∂g q,   κ̇ = −Y L Yᵀ (q̇ + αĴ⁺x),

    the friction B_n and gravity of the arm alone not held, so that gravity and its compensation do
    not cancel. Y L Yᵀ is all that counts of what learns: it has the n_v rates of the learnt torque
    and none of those combinations of parameters that no joint feels. A frame is taken at the first
    of each `samples` samples and read from `age` samples later until the next one has aged as much.

    Args:
        loop: The loop.
        dt: Time of a sample [s].
        samples: Samples from one frame to the next, ≥ 1.
        age: Samples from a frame to the first torque that uses it.
        torque_late: Samples from a torque to its effect.
        velocity_filter: Time constant of the filter of q̇ from differences of q [s]; None is an
            exact q̇.
        friction: Diagonal of B_n, the arm's own, shape (n_v,); none by default.
        gravity: ∂g/∂q, which acts and is compensated, shape (k, n_v, n_v); none by default.

    Returns:
        Square, shape (k, N, N), of (q, q̇, κ, what filters q̇, late torques, x of frames that are
        waited for, the newest first); the late torques the oldest first.
    """
    k, n, m = loop.stiffness.shape
    filtered = velocity_filter is not None
    sizes = (n, n, n, n if filtered else 0, torque_late * n, m)
    size = sum(sizes)
    q, v, learnt, w, late, x = np.split(np.eye(size), np.cumsum(sizes)[:-1])
    v_seen, w_after = v, w
    if velocity_filter is not None:  # as `simulate` filters differences of q
        a = dt / (velocity_filter + dt)
        v_seen = a / dt * q + w
        w_after = (1.0 - a) * v_seen - a / dt * q
    torque = learnt - loop.stiffness @ x - loop.damping @ v_seen
    if gravity is not None:
        torque = torque + gravity @ q
    acting = np.concatenate([np.broadcast_to(late, (k, *late.shape)), torque], axis=1)
    moving = np.broadcast_to(np.concatenate([q, v]), (k, 2 * n, size))
    flow = _flow(loop.M_inv, friction, gravity, dt)
    sample = np.concatenate(
        [
            flow @ np.concatenate([moving, acting[:, :n]], axis=1),
            learnt - dt * loop.learning @ (v_seen + loop.pull @ x),
            np.broadcast_to(w_after, (k, *w_after.shape)),
            acting[:, n:],
            np.broadcast_to(x, (k, m, size)),
        ],
        axis=1,
    )
    # The state between frames: that of a sample without x, and then the frames that are waited
    # for, the newest first. Until `switch` samples after a frame, the oldest of them is read.
    frames, switch = divmod(age, samples)
    waiting = frames + (switch > 0)
    plain = size - m
    rows = np.split(np.eye(plain + waiting * m), [plain, *(plain + m * np.arange(1, waiting))])
    seen = [loop.J @ rows[0][:n], *rows[1:]] if waiting else [loop.J @ rows[0][:n]]
    state: Array = np.broadcast_to(rows[0], (k, *rows[0].shape))
    for count, read in ((switch, frames + 1), (samples - switch, frames)):
        if count:
            x_read = np.broadcast_to(seen[read], (k, m, plain + waiting * m))
            over = np.linalg.matrix_power(sample, count)[:, :plain]
            state = over @ np.concatenate([state, x_read], axis=1)
    kept = [np.broadcast_to(each, (k, m, plain + waiting * m)) for each in seen[:waiting]]
    return np.concatenate([state, *kept], axis=1)


def _flow(M_inv: Array, friction: Array | None, gravity: Array | None, dt: float) -> Array:
    """Map (q, q̇) and a torque that is held over dt to (q, q̇) after it, (k, 2 n_v, 3 n_v).

    The power series of M q̈ = τ − B_n q̇ − ∂g q over a time that is short enough for it, which is
    doubled as often as needed.
    """
    k, n, _ = M_inv.shape
    none = np.zeros((k, n, n))
    F = none if friction is None else M_inv * friction
    K = none if gravity is None else M_inv @ gravity
    damped, swung = (float(np.abs(each).sum(axis=1).max(initial=0.0)) for each in (F, K))
    size = dt * max(damped, math.sqrt(swung))
    doublings = max(0, math.ceil(math.log2(size / _SHORT))) if size > 0.0 else 0
    h = dt / 2.0**doublings
    # the coefficients of q: of those that q, q̇ and the torque begin with, a block each
    last, this = (np.broadcast_to(np.eye(n, 3 * n, j * n), (k, n, 3 * n)) for j in (0, 1))
    after = np.concatenate([last + h * this, this], axis=1)
    factor = h
    for order in range(2, _ORDER if size > 0.0 else 3):
        last, this = this, -(F @ this) - K @ last
        if order == 2:
            this[..., 2 * n :] = M_inv
        after[:, n:] += factor * this
        factor *= h / order
        after[:, :n] += factor * this
    for _ in range(doublings):
        still, held = after[..., : 2 * n], after[..., 2 * n :]
        after = np.concatenate([still @ still, still @ held + held], axis=2)
    return after
