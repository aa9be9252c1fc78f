"""Estimators of what a measured position depends on: its camera known, or turned anyhow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from approxjac import law
from approxjac.controllers.kinematic_unknowns import Unknowns
from approxjac.validation import Array

_ODDS = 2.0  # of another rotation against the one at hand, as a logarithm, before it is taken
_SAME = 0.8  # of tr(AᵀA'): about 45°, nearer than which rotations are one to Newton's method


class Estimate(NamedTuple):
    """What is estimated of x = R(o + HΘ).

    Attributes:
        Theta: Translations, scale and offset in the base's axes, shape (P,).
        R: Rotation of the base's axes in the sensor's, (d, d).
    """

    Theta: Array
    R: Array


class _Packed:
    """Symmetric matrices (P, P) as their upper triangles, as a state is copied and recorded."""

    def __init__(self, P: int) -> None:
        rows, columns = np.triu_indices(P)
        self.size = len(rows)
        self._upper = rows * P + columns
        where = np.zeros((P, P), dtype=int)
        where[rows, columns] = where[columns, rows] = np.arange(self.size)
        self._where = where

    def pack(self, matrix: Array) -> Array:
        return np.asarray(matrix.ravel()[self._upper])

    def unpack(self, triangle: Array) -> Array:
        return np.asarray(triangle[self._where])


class KnownCamera:
    """Rᵀx = o + HΘ with R known: recursive least squares with forgetting towards the prior.

    Theorem A. Its numbers: Λ, Θ̂.

    Args:
        unknowns: What may be wrong.
        noise: Of x [m].
    """

    def __init__(self, unknowns: Unknowns, noise: float) -> None:
        self._first, self._R = unknowns.Theta, unknowns.R
        self._n_u, self._P = unknowns.n_u, len(unknowns.Theta)
        self._is_turned = not np.array_equal(self._R, np.eye(len(self._R)))
        self.prior = np.diag(unknowns.sd_Theta**-2.0)
        self._weight = noise**-2.0
        self._packed = _Packed(self._P)
        self.size = self._packed.size + self._P

    def initial(self) -> Array:
        """Return the numbers before the first frame, shape (size,)."""
        return np.concatenate([self._packed.pack(self.prior), self._first])

    def renewed(self, numbers: Array) -> Array:
        """Return numbers that know what was learnt only as a belief, as vague as the first."""
        return np.concatenate([self._packed.pack(self.prior), numbers[-self._P :]])

    def learn(self, numbers: Array, H: Array, o: Array, x: Array, share: float) -> Array:
        """Return the numbers after a frame.

        Args:
            numbers: As before, shape (size,).
            H: Regressor of the rows that are seen, (m, P).
            o: What of them is known, shape (m,).
            x: What is measured, shape (m,).
            share: λT, to be forgotten.
        """
        if self._is_turned:
            x = x.reshape(-1, len(self._R)).dot(self._R).ravel()
        Lambda = law.forgotten_information(self.information(numbers), self.prior, share)
        Theta = numbers[-self._P :]
        innovation = x - o - H.dot(Theta)
        Lambda = law.information(Lambda, H, self._weight)
        Theta = Theta + law.correction(Lambda, H, self._weight, innovation)
        return np.concatenate([self._packed.pack(Lambda), Theta])

    def estimate(self, numbers: Array) -> Estimate:
        """Return what is estimated."""
        return Estimate(numbers[-self._P :].copy(), self._R)

    def information(self, numbers: Array) -> Array:
        """Return Λ, shape (P, P)."""
        return self._packed.unpack(numbers[: -self._P])

    def covariance(self, numbers: Array) -> Array:
        """Return the covariance of (u, b), shape (P, P)."""
        P, n = self._P, self._n_u
        covariance = np.asarray(np.linalg.inv(self.information(numbers)), dtype=np.float64)
        if self._is_turned and n < P:
            covariance[n:] = self._R.dot(covariance[n:])
            covariance[:, n:] = covariance[:, n:].dot(self._R.T)
        return covariance


class UnknownCamera:
    """x = R(o + Hu + c), with R any rotation: exact least squares over all frames at once.

    In the base frame Rᵀx = o + Hu + c, and as R changes no lengths, the sums over frames that the
    least squares need do not depend on R. So all frames are remembered, exactly, in sums N, a, B
    and E of fixed size: for a rotation A = Rᵀ, with w = vec A,

        Θ(A) = N⁻¹(a + Bw), and A maximises ½(a + Bw)ᵀN⁻¹(a + Bw) + Eᵀw

    over rotations only, 3 numbers (1 in the plane) instead of all, and looked for everywhere.
    Forgetting is towards the prior about what is estimated now, which leaves the estimate where it
    is.

    As in Theorem A no excitation is needed. Where x is exact, V = J(true) − J(estimate) ≥ 0 of the
    sum of squares J (which is V₁ where the rotation is known) falls with each frame by at least
    ½‖ε‖²/noise², ε what is left of x: J(true) does not grow, and the least J grows by that much.
    So ε is square summable, for any motion. With forgetting this holds where the sum of squares is
    as convex as the prior.

    Args:
        unknowns: What may be wrong.
        noise: Of x [m].
    """

    def __init__(self, unknowns: Unknowns, noise: float) -> None:
        self._n_u, self._P, self._d = unknowns.n_u, len(unknowns.Theta), unknowns.d
        self._first, self._R = unknowns.Theta, unknowns.R
        self.prior = np.diag(unknowns.sd_Theta**-2.0)
        self._sd_R, self._weight = unknowns.sd_R, noise**-2.0
        P, dd = self._P, self._d**2
        self._packed = _Packed(P)
        sizes = [self._packed.size, P, P * dd, dd, P, dd]
        self.size = sum(sizes)
        ends = np.cumsum(sizes).tolist()
        self._parts = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
        self._everywhere = law.rotations_everywhere(self._d).reshape(-1, dd)

    def initial(self) -> Array:
        """Return the numbers before the first frame, shape (size,)."""
        return self._about(self._first, self._R.T)

    def renewed(self, numbers: Array) -> Array:
        """Return numbers that know what was learnt only as a belief, as vague as the first."""
        *_, Theta, A = self._split(numbers)
        return self._about(Theta, A.reshape(self._d, self._d))

    def learn(self, numbers: Array, H: Array, o: Array, x: Array, share: float) -> Array:
        """Return the numbers after a frame.

        Args:
            numbers: As before, shape (size,).
            H: Regressor of the points that are seen, in the base frame, (k d, P).
            o: What of them is known, (k d,).
            x: What is measured, shape (k d,).
            share: λT, to be forgotten.
        """
        d, P, W = self._d, self._P, self._weight
        if share > 0.0:
            *_, Theta, A = self._split(numbers)
            numbers = numbers + share * (self._about(Theta, A.reshape(d, d)) - numbers)
        N, a, B, E, _, A = self._split(numbers)
        HW = W * H.T
        N = self._packed.unpack(N) + HW.dot(H)
        a = a - HW.dot(o)
        seen = x.reshape(-1, d)
        each = HW.reshape(P, -1, d).transpose(0, 2, 1).dot(seen)  # Σ Hᵀ x
        B = B.reshape(P, -1) + each.reshape(P, -1)
        E = E + (W * o.reshape(-1, d).T.dot(seen)).ravel()
        solved, M, h = _reduced(N, a, B, E)
        w = self._rotation(M, h, A.reshape(d, d)).ravel()
        Theta = solved[:, 0] + solved[:, 1:].dot(w)
        return np.concatenate([self._packed.pack(N), a, B.ravel(), E, Theta, w])

    def estimate(self, numbers: Array) -> Estimate:
        """Return what is estimated."""
        *_, Theta, A = self._split(numbers)
        return Estimate(Theta.copy(), A.reshape(self._d, self._d).T)

    def covariance(self, numbers: Array) -> Array:
        """Return the covariance of (u, b, φ), φ the rotation R ← exp([φ]ₓ)R, (P + 1 or 3) squared.

        That of the least squares: rotation first, all else given the rotation.
        """
        d, P = self._d, self._P
        N, a, B, E, Theta, A = self._split(numbers)
        N, A = self._packed.unpack(N), A.reshape(d, d)
        solved, M, h = _reduced(N, a, B.reshape(P, -1), E)
        known, axes = np.linalg.eigh(law.rotation_information(M, h, A))
        # of A ← exp([δ]ₓ)A; nothing is known less well than before
        of_delta = (axes / np.maximum(known, self._sd_R**-2.0)).dot(axes.T)
        G = law.generators(d)
        follows = solved[:, 1:].dot(law.tangents(A))  # ∂(u, c)/∂δ
        joint = np.concatenate([follows, np.eye(len(G))]).dot(of_delta)
        joint = joint.dot(np.concatenate([follows, np.eye(len(G))]).T)
        joint[:P, :P] += np.linalg.inv(N)
        # b = Rc with R = Aᵀ ← R exp(−[δ]ₓ), and φ = −Rδ (−δ in the plane)
        c, R = Theta[self._n_u :], A.T
        T = np.eye(P + len(G))
        T[self._n_u : P, self._n_u : P] = R
        T[self._n_u : P, P:] = -R.dot((G @ c).T)
        T[P:, P:] = -R if d == 3 else -1.0
        return np.asarray(T.dot(joint).dot(T.T))

    def _split(self, numbers: Array) -> list[Array]:
        """Return N, a, B, E, the estimates Θ and A, flat."""
        return [numbers[part] for part in self._parts]

    def _rotation(self, M: Array, h: Array, A: Array) -> Array:
        """Return the best rotation near A, or one elsewhere that is better beyond doubt."""
        near = law.best_rotation(M, h, A)
        found = self._everywhere
        values = found.dot(h) + 0.5 * (found.dot(M) * found).sum(axis=1)
        start = found[int(np.argmax(values))]
        if start.dot(near.ravel()) > _SAME * self._d:
            return near
        other = law.best_rotation(M, h, start.reshape(A.shape))
        better = law.explained(M, h, other) > law.explained(M, h, near) + _ODDS
        return other if better else near

    def _about(self, Theta: Array, A: Array) -> Array:
        """Return the sums of the prior alone, about these estimates."""
        d, n = self._d, self._n_u
        a = np.concatenate([self.prior.diagonal()[:n] * Theta[:n], np.zeros(d)])
        b = A.T.dot(Theta[n:])
        B = np.zeros((self._P, d, d))
        B[n:] = np.eye(d)[:, :, np.newaxis] * (b * self.prior[-1, -1])
        E = (0.5 / self._sd_R**2) * A.ravel()
        return np.concatenate([self._packed.pack(self.prior), a, B.ravel(), E, Theta, A.ravel()])


def _reduced(N: Array, a: Array, B: Array, E: Array) -> tuple[Array, Array, Array]:
    """Return N⁻¹[a B], and M and h of what rotations alone have to maximise."""
    solved = np.linalg.solve(N, np.concatenate([a[:, np.newaxis], B], axis=1))
    M = B.T.dot(solved[:, 1:])
    return solved, 0.5 * (M + M.T), B.T.dot(solved[:, 0]) + E
