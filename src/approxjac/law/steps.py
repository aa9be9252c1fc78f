"""The set-point laws, eqs. (5), (6) and (28), their step, and that of a held measurement.

A controller checks its arguments, collects the terms of the believed robot and calls these.
`codegen` traces them by calling the controller with symbols.

Shapes: Ĵ is (m, n_v), K_p, K_v, s and Ẋ are (m,) with the gains' diagonals, q̇, g, τ and the
diagonal of the added damping B_c are (n_v,).
"""

import math
from collections.abc import Sequence
from functools import reduce
from operator import and_, or_
from typing import Any, NamedTuple

import numpy as np

from approxjac.law.branches import all_finite, array, choose, complement, select, selected
from approxjac.law.pseudoinverse import (
    SINGULAR_RATIO,
    damped_gram_solve,
    gram_damping,
    is_near_singular,
)
from approxjac.validation import Array

_LEAST = 1e-300


def measured_velocity_torque(
    J_hat: Array, kp: Array, kv: Array, s: Array, x_dot: Array, v: Array, damping: Array, g: Array
) -> Array:
    """Return τ = −Ĵᵀ(K_p s(e) + K_v Ẋ) − B_c q̇ + g(q), with Ẋ measured.

    Implements Eq. (5), the earlier law, kept as a baseline. Departure: the added joint damping
    −B_c q̇ is written out (the paper leaves it to "friction added intentionally").

    The arguments are those of `estimated_velocity_torque`, and Ẋ (m,).
    """
    return g - damping * v - (kp * s + kv * x_dot).dot(J_hat)


def estimated_velocity_torque(
    J_hat: Array, kp: Array, kv: Array, s: Array, v: Array, damping: Array, g: Array
) -> Array:
    """Return τ = −Ĵᵀ(K_p s(e) + K_v Ĵ q̇) − B_c q̇ + g(q).

    Implements Eq. (6), the paper's law: Ĵ q̇ takes the place of the measured task velocity.
    Implements Eq. (28), too, with the g that has been learnt so far, `gravity`. Departure: the
    added joint damping −B_c q̇ is written out; where n_v > m it is required.

    Args:
        J_hat: Estimated task Jacobian Ĵ, shape (m, n_v).
        kp: Diagonal of K_p, shape (m,).
        kv: Diagonal of K_v, shape (m,).
        s: Saturated error s(e), shape (m,).
        v: Joint velocity q̇, shape (n_v,).
        damping: Diagonal of B_c, shape (n_v,).
        g: Gravity torque, shape (n_v,).

    Returns:
        Joint torque τ, shape (n_v,).
    """
    return g - damping * v - (kp * s + kv * J_hat.dot(v)).dot(J_hat)


def gravity(Z: Array, theta: Array) -> Array:
    """Return g = Z(q) θ of a regressor (n_v, p) and parameters (p,). Implements Eq. (27)."""
    return Z.dot(theta)


class Pseudoinverse(NamedTuple):
    """Ĵ⁺, damped near singular configurations by `damped_gram_solve`.

    With a weight (from `tuned`), Ĵ⁺s minimizes q̇ᵀB_cq̇ over all q̇ with Ĵq̇ = s, as the arm's own
    motion towards its target does. So y of (10) is small along that motion, which disturbs learning
    less. Without one it is the Moore–Penrose inverse, as in the paper.
    """

    ratio: float = SINGULAR_RATIO  # of σ_min/σ_max, below which Ĵ is near singular
    scale: float = 0.0  # a σ_max below which it counts as this large [unit of the task/rad]
    inverse_root: Array | None = None  # 1/√weight, (n_v,)
    weight: Array | None = None  # as for `cross_weight_pinv`, shape (n_v,); None is I

    @property
    def singularity(self) -> tuple[float, float, Array | None]:
        """The numbers that it is made of but for the weight."""
        return self[:3]

    def solved(self, J_hat: Array, s: Array) -> tuple[Array, Any]:
        """Return Ĵ⁺s (n_v,), and its damping λ: 0 away from singular poses."""
        J_hat = self._weighted(J_hat)
        w, damped = damped_gram_solve(J_hat.dot(J_hat.T), s, self.ratio, self.scale)
        return self._weighted(w.dot(J_hat)), damped

    def times(self, J_hat: Array, s: Array, whole: Array | None = None) -> Array:
        """Return Ĵ⁺s (n_v,); if Ĵ lacks columns, damping is judged by the `whole` Ĵ's size."""
        if whole is None:
            return self.solved(J_hat, s)[0]
        scale = float(np.linalg.norm(self._weighted(whole), 2))
        return self._replace(scale=scale).solved(J_hat, s)[0]

    def is_damped(self, J_hat: Array) -> Any:
        """Return True where Ĵ⁺ is damped, for Ĵ (…, m, n_v); shape (…)."""
        squares: Any = np.linalg.svd(self._weighted(J_hat), compute_uv=False) ** 2
        return gram_damping(squares[..., -1], squares[..., 0], self.ratio, self.scale) > 0.0

    def matrix(self, J_hat: Array) -> Array:
        """Return Ĵ⁺ (n_v, m) for a Ĵ (m, n_v)."""
        return np.array([self.times(J_hat, unit) for unit in np.eye(len(J_hat))]).T

    def _weighted(self, rows: Array) -> Array:
        return rows if self.inverse_root is None else rows * self.inverse_root


class SetpointTerms(NamedTuple):
    """Terms of the believed robot at a measured q, and of the error."""

    J_hat: Array  # shape (m, n_v)
    s: Array  # s(e), shape (m,); zeros where x is lost
    g: Array | None = None  # gravity torque, shape (n_v,); None where it is learnt
    Y: Array | None = None  # regressor of what is learnt, shape (n_v, P); None of nothing
    pull: Array | None = None  # τ₀ of a posture, shape (n_v,)
    x_dot: Array | None = None  # measured Ẋ, shape (m,); None is Ĵq̇
    v_d: Array | None = None  # ẋ_d of a target that moves, shape (m,); None is at rest


def setpoint_step(
    kp: Array,
    kv: Array,
    damping: Array,
    terms: SetpointTerms,
    v: Array,
    theta_hat: Array,
    pinv: Pseudoinverse,
) -> tuple[Array, Array, Any, Array, Array | None, Array | None]:
    """Evaluate the laws (5), (6) and (28), with a posture and on a path.

    The gains are diagonals, K_p and K_v (m,) and the damping (n_v,); q̇ is (n_v,) and θ̂ (P,).

    Returns:
        τ; the gravity torque in it; whether Ĵ is near singular; q̇ − Ĵ⁺ẋ_d, or q̇ if the target is at
        rest; Ĵ⁺s(e) if something is learnt; Ĵ⁺ẋ_d. All but the third of shape (n_v,).
    """
    J_hat, s, g, Y, pull, x_dot, v_d = terms
    ratio, scale = pinv[:2]
    G, pinv_s, reference = J_hat.dot(J_hat.T), None, None
    if Y is None:
        assert g is not None
        is_singular = is_near_singular(G, ratio, scale)
    else:
        pinv_s, damped = pinv.solved(J_hat, s)
        is_singular = damped > 0.0
        g = gravity(Y, theta_hat)  # with it, (6) is (28)
    bias = g if pull is None else g + within_null_space(pull, J_hat, G, ratio, scale)
    relative = x_dot
    if v_d is not None:  # the law of the motion relative to ẋ_d, and to Ĵ⁺ẋ_d of the joints
        relative = (J_hat.dot(v) if x_dot is None else x_dot) - v_d
        reference = damped_gram_solve(G, v_d, ratio, scale)[0].dot(J_hat)
        v = v - reference
    if relative is None:
        torque = estimated_velocity_torque(J_hat, kp, kv, s, v, damping, bias)
    else:
        torque = measured_velocity_torque(J_hat, kp, kv, s, relative, v, damping, bias)
    return torque, g, is_singular, v, pinv_s, reference


def within_null_space(torque: Array, J_hat: Array, G: Array, ratio: float, scale: float) -> Array:
    """Return N τ with N = I − Ĵ⁺Ĵ, faded out near a singular Ĵ; shape (n_v,).

    G is ĴĴᵀ; `ratio` and `scale` are those of `damped_gram_solve`.
    """
    b = J_hat.dot(torque)
    w, damped = damped_gram_solve(G, b, ratio, scale)

    def faded() -> tuple[Array]:
        # With a damped Ĵ⁺, N would be no projector. An exact one that is faded out is one still,
        # and continuous, as it turns only where its weight is zero.
        squares, U = np.linalg.eigh(G)
        squares = np.maximum(squares, 0.0)
        threshold = ratio**2 * np.maximum(squares.max(), max(scale**2, _LEAST))
        inverse = np.where(squares > 0.0, 1.0 / np.where(squares > 0.0, squares, 1.0), 0.0)
        projected = U.dot(b.dot(U) * inverse).dot(J_hat)
        return (squares.min() / threshold * (torque - projected),)

    return choose(damped > 0.0, faded, lambda: (torque - w.dot(J_hat),))[0]


class HoldStep(NamedTuple):
    """A held measurement at one step."""

    x: Array  # that the controller is given, NaN where it is too old
    last: list[Any]  # x that was seen, and when it was taken
    moved: list[Any]  # p, how far each error has moved since
    known: list[Any]  # of each part, 1 if it was ever seen
    stands: list[tuple[slice, Any]]  # of each part, the rows of p and whether they stand still
    is_new: Any  # whether any part is


def hold_step(
    memory: Array,
    x: Array,
    errors: Array,
    t_x: Any,
    knows_time: Any,
    parts: Sequence[tuple[slice, slice]],
    most: Sequence[float],
) -> HoldStep:
    """Return the last measured x, part by part, until the arm has moved too far.

    The memory (x, t_x, p, seen) of earlier steps is (n_x + 1 + m + parts,). The new x (n_x,) was
    taken at t_x [s]; unless `knows_time`, an x that differs is new. `errors` of x to any value (m,)
    are not finite where it is no measurement. `parts` are the entries of x, and of the error, that
    are measured together, in order; `most` is the largest motion of each error without a new x.
    """
    kept, n = memory.tolist(), len(x)
    last, t_last, p, seen = kept[:n], kept[n], kept[n + 1 : -len(parts)], kept[-len(parts) :]
    measured, apart, was_seen = x.tolist(), errors.tolist(), [each > 0.0 for each in seen]
    later = knows_time & ((t_x > t_last) | complement(reduce(or_, was_seen)))
    used, moved, known, stands = list[Any](), list[Any](), list[Any](), list[tuple[slice, Any]]()
    remembered, any_new, all_new = list[Any](), False, True
    for (entries, rows), ever in zip(parts, was_seen, strict=True):
        here, before, own = measured[entries], last[entries], p[rows]
        new = later
        if knows_time is not True:
            differs = complement(reduce(and_, [a == b for a, b in zip(here, before, strict=True)]))
            new = select(knows_time, later, differs)
        never = complement(ever)
        is_new = all_finite(here + apart[rows]) & (never | new)
        is_far = reduce(or_, [abs(far) > end for far, end in zip(own, most[rows], strict=True)])
        is_old = complement(is_new) & (never | is_far)
        now = selected(is_new, here, before)
        remembered += now
        used += selected(is_old, [math.nan] * len(here), now)
        moved += selected(is_new, [0.0] * len(own), own)
        known.append(select(is_new | ever, 1.0, 0.0))
        stands.append((rows, is_old))
        any_new = any_new | is_new
        all_new = all_new and is_new is True
    remembered.append(select(any_new & later, t_x, t_last))
    return HoldStep(x if all_new else array(used), remembered, moved, known, stands, any_new)


def hold_moved(held: HoldStep, motion: Array) -> Array:
    """Return the memory after a step in which errors move by `motion` (m,)."""
    by, moved = motion.tolist(), list[Any]()
    for rows, is_old in held.stands:
        # a part that is too old stands still: an arm that sags back is not seen by that
        own = held.moved[rows]
        moved += selected(is_old, own, [a + b for a, b in zip(own, by[rows], strict=True)])
    return array(held.last + moved + held.known)
