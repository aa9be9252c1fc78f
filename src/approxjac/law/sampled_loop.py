"""The closed loop of eqs. (28), (29) to first order as it runs: sampled, late, x in frames."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from approxjac.validation import Array

_SMALL = 1e-5  # friction times the time of a sample over inertia, below which series serve


class LinearLaw(NamedTuple):
    """The linearised loop at rest at its target, a batch of k of them.

    Attributes:
        M_inv: Inverse of the true inertia matrix, shape (k, n_v, n_v).
        J: True task Jacobian, shape (k, m, n_v).
        stiffness: ĴᵀK_p, shape (k, n_v, m).
        damping: ĴᵀK_vĴ + B_c, shape (k, n_v, n_v).
        learning: Y L Yᵀ, which turns y into the rate of the learnt torque, shape (k, n_v, n_v).
        pull: αĴ⁺, shape (k, n_v, m).
    """

    M_inv: Array
    J: Array
    stiffness: Array
    damping: Array
    learning: Array
    pull: Array


def frame_map(
    loop: LinearLaw,
    dt: float,
    samples: int,
    age: int,
    torque_late: int = 0,
    velocity_filter: float = 0.0,
    friction: Array | None = None,
) -> Array:
    """Map of the state from one frame of x to the next, exact but for gravity's gradient.

    Between samples the torque is held. With κ what is left of the learnt torque to learn, near the
    target,

        M q̈ = −ĴᵀK_p x − (ĴᵀK_vĴ + B_c) q̇ + κ − B_n q̇,   κ̇ = −Y L Yᵀ (q̇ + αĴ⁺x),

    the friction B_n alone not held, where Y L Yᵀ is all that counts of what learns: it has the n_v
    rates of the learnt torque and none of those combinations of parameters that no joint feels. A
    frame is taken at the first of each `samples` samples and read from `age` samples later until
    the next one has aged as much.

    Args:
        loop: The loop.
        dt: Time of a sample [s].
        samples: Samples from one frame to the next, ≥ 1.
        age: Samples from a frame to the first torque that uses it.
        torque_late: Samples from a torque to its effect.
        velocity_filter: Time constant of the filter of q̇ [s]; 0 is an exact q̇.
        friction: Diagonal of B_n, the arm's own, shape (n_v,); none by default.

    Returns:
        Square, shape (k, N, N), N = 3 n_v and what is delayed or filtered.
    """
    k, n, m = loop.stiffness.shape
    filtered = velocity_filter > 0.0
    sizes = (n, n, n, n if filtered else 0, torque_late * n, m)
    size = sum(sizes)
    q, v, learnt, w, late, x = np.split(np.eye(size), np.cumsum(sizes)[:-1])
    v_seen, w_after = v, w
    if filtered:  # as `simulate` filters differences of q
        a = dt / (velocity_filter + dt)
        v_seen = a / dt * q + w
        w_after = (1.0 - a) * v_seen - a / dt * q
    torque = learnt - loop.stiffness @ x - loop.damping @ v_seen
    acting = np.concatenate([np.broadcast_to(late, (k, *late.shape)), torque], axis=1)
    accelerated = loop.M_inv @ acting[:, :n]
    left, once, twice = _coasting(loop.M_inv, np.zeros(n) if friction is None else friction, dt)
    sample = np.concatenate(
        [
            q + once @ v + twice @ accelerated,
            left @ v + once @ accelerated,
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


def _coasting(M_inv: Array, friction: Array, dt: float) -> tuple[Array, Array, Array]:
    """Return e^(−Ft) of F = M⁻¹B_n after dt, its integral and that of this, (k, n_v, n_v)."""
    root = np.linalg.cholesky(M_inv)
    rates, modes = np.linalg.eigh(root.mT @ (friction[:, np.newaxis] * root))
    x = np.maximum(rates, 0.0) * dt
    safe = np.where(x > _SMALL, x, 1.0)
    once = np.where(x > _SMALL, -np.expm1(-safe) / safe, 1.0 - 0.5 * x)
    twice = np.where(x > _SMALL, (1.0 - once) / safe, 0.5 - x / 6.0)
    there = root @ modes
    back = np.linalg.inv(there)
    parts = (np.exp(-x), dt * once, dt**2 * twice)
    left, first, second = (there @ (part[..., np.newaxis] * back) for part in parts)
    return left, first, second
