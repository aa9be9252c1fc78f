"""Estimators of what a measured position depends on: its camera known, or turned anyhow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from approxjac import law
from approxjac.validation import Array

_ODDS = 8.0  # of another rotation against the one at hand, as a logarithm, before it is taken
_SAME = 0.8  # of tr(AᵀA'): about 45°, nearer than which rotations are one to Newton's method


class Estimate(NamedTuple):
    """What is estimated of x = R p(u) + b.

    Attributes:
        u: Translations, and the scale if that is unknown, shape (n_u,) [m].
        R: Rotation of the base's axes in the sensor's, (d, d).
        b: Offset, shape (d,) [m].
    """

    u: Array
    R: Array
    b: Array


class KnownCamera:
    """x = o + HΘ, Θ = (u, b): recursive least squares with forgetting towards the prior.

    Theorem A. Its numbers: Λ, Θ̂.

    Args:
        u_0: Believed u, shape (n_u,).
        sd_u: Their standard deviations, shape (n_u,).
        d: Number of offsets b, 0 where that is known.
        sd_b: Of each offset [m].
        noise: Of x [m].
    """

    def __init__(self, u_0: Array, sd_u: Array, d: int, sd_b: float, noise: float) -> None:
        self.n_u, self.P = len(u_0), len(u_0) + d
        self.prior = np.diag(np.concatenate([sd_u, np.full(d, sd_b)]) ** -2.0)
        self._first = np.concatenate([u_0, np.zeros(d)])
        self._weight = noise**-2.0
        self.size = self.P * self.P + self.P
        self._d = d

    def initial(self) -> Array:
        """Return the numbers before the first frame, shape (size,)."""
        return np.concatenate([self.prior.ravel(), self._first])

    def renewed(self, numbers: Array) -> Array:
        """Return numbers that know what was learnt only as a belief, as vague as the first."""
        return np.concatenate([self.prior.ravel(), numbers[-self.P :]])

    def learn(
        self, numbers: Array, H: Array, o: Array, x: Array, share: float, is_due: bool
    ) -> Array:
        """Return the numbers after a frame.

        Args:
            numbers: As before, shape (size,).
            H: Regressor of the rows that are seen, (m, P).
            o: What of them is known, shape (m,).
            x: What is measured, shape (m,).
            share: λT, to be forgotten.
            is_due: Not used: every frame is learnt from at once.
        """
        P = self.P
        Lambda = numbers[: P * P].reshape(P, P)
        Lambda = law.forgotten_information(Lambda, self.prior, share)
        Theta = numbers[P * P :]
        innovation = x - o - H.dot(Theta)
        Lambda = law.information(Lambda, H, self._weight)
        Theta = Theta + law.correction(Lambda, H, self._weight, innovation)
        return np.concatenate([Lambda.ravel(), Theta])

    def estimate(self, numbers: Array) -> Estimate:
        """Return what is estimated."""
        Theta = numbers[-self.P :]
        return Estimate(Theta[: self.n_u].copy(), np.eye(self._d), Theta[self.n_u :])

    def covariance(self, numbers: Array) -> Array:
        """Return the covariance of (u, b), shape (P, P)."""
        P = self.P
        return np.asarray(np.linalg.inv(numbers[: P * P].reshape(P, P)), dtype=np.float64)


class UnknownCamera:
    """x = R(o + Hu + c), with R any rotation: exact least squares over all frames at once.

    In the base frame Rᵀx = o + Hu + c, and as R changes no lengths, the sums over frames that the
    least squares need do not depend on R. So all frames are remembered, exactly, in sums N, a, B
    and E of fixed size: for a rotation A = Rᵀ, with w = vec A,

        Θ(A) = N⁻¹(a + Bw), and A maximises ½(a + Bw)ᵀN⁻¹(a + Bw) + Eᵀw

    over rotations only, 3 numbers (1 in the plane) instead of all. Forgetting is towards the prior
    about what is estimated now, which leaves the estimate where it is, as in Theorem A.

    Args:
        u_0: Believed u, shape (n_u,).
        sd_u: Their standard deviations, shape (n_u,).
        d: Dimensions, 2 or 3.
        sd_b: Standard deviation of the offset b = R c, along each axis [m].
        sd_R: Of the rotation [rad].
        noise: Of x [m].
    """

    def __init__(
        self, u_0: Array, sd_u: Array, d: int, sd_b: float, sd_R: float, noise: float
    ) -> None:
        self.n_u, self.P, self.d = len(u_0), len(u_0) + d, d
        self._u_0 = u_0
        self.prior = np.diag(np.concatenate([sd_u, np.full(d, sd_b)]) ** -2.0)
        self._sd_R, self._weight = sd_R, noise**-2.0
        P, dd = self.P, d * d
        sizes = [P * P, P, P * dd, dd, P, dd]
        self._ends = np.cumsum(sizes)[:-1]
        self.size = sum(sizes)
        self._everywhere = law.rotations_everywhere(d).reshape(-1, dd)

    def initial(self) -> Array:
        """Return the numbers before the first frame, shape (size,)."""
        Theta = np.concatenate([self._u_0, np.zeros(self.d)])
        return self._about(Theta, np.eye(self.d))

    def renewed(self, numbers: Array) -> Array:
        """Return numbers that know what was learnt only as a belief, as vague as the first."""
        *_, Theta, A = np.split(numbers, self._ends)
        return self._about(Theta, A.reshape(self.d, self.d))

    def learn(
        self, numbers: Array, H: Array, o: Array, x: Array, share: float, is_due: bool
    ) -> Array:
        """Return the numbers after a frame.

        Args:
            numbers: As before, shape (size,).
            H: Regressor of the points that are seen, in the base frame, (k d, P).
            o: What of them is known, (k d,).
            x: What is measured, shape (k d,).
            share: λT, to be forgotten.
            is_due: Whether to say what follows for the estimates, or to remember the frame only.
        """
        d, P, W = self.d, self.P, self._weight
        if share > 0.0:
            *_, Theta, A = np.split(numbers, self._ends)
            numbers = numbers + share * (self._about(Theta, A.reshape(d, d)) - numbers)
        N, a, B, E, Theta, w = np.split(numbers, self._ends)
        HW = W * H.T
        N = N.reshape(P, P) + HW.dot(H)
        a = a - HW.dot(o)
        seen = x.reshape(-1, d)
        each = HW.reshape(P, -1, d).transpose(0, 2, 1).dot(seen)  # Σ Hᵀ x
        B = B.reshape(P, -1) + each.reshape(P, -1)
        E = E + (W * o.reshape(-1, d).T.dot(seen)).ravel()
        if is_due:
            solved, M, h = _reduced(N, a, B, E)
            w = self._rotation(M, h, w.reshape(d, d)).ravel()
            Theta = solved[:, 0] + solved[:, 1:].dot(w)
        return np.concatenate([N.ravel(), a, B.ravel(), E, Theta, w])

    def estimate(self, numbers: Array) -> Estimate:
        """Return what is estimated."""
        d = self.d
        Theta, A = numbers[-self.P - d * d : -d * d], numbers[-d * d :].reshape(d, d)
        return Estimate(Theta[: self.n_u].copy(), A.T, A.T.dot(Theta[self.n_u :]))

    def covariance(self, numbers: Array) -> Array:
        """Return the covariance of (u, b, φ), φ the rotation R ← exp([φ]ₓ)R, (P + 1 or 3) squared.

        That of the least squares: rotation first, all else given the rotation.
        """
        d, P = self.d, self.P
        N, a, B, E, Theta, A = np.split(numbers, self._ends)
        A = A.reshape(d, d)
        solved, M, h = _reduced(N.reshape(P, P), a, B.reshape(P, -1), E)
        known, axes = np.linalg.eigh(law.rotation_information(M, h, A))
        # of A ← exp([δ]ₓ)A; nothing is known less well than before
        of_delta = (axes / np.maximum(known, self._sd_R**-2.0)).dot(axes.T)
        G = law.generators(d)
        follows = solved[:, 1:].dot(law.tangents(A))  # ∂(u, c)/∂δ
        joint = np.concatenate([follows, np.eye(len(G))]).dot(of_delta)
        joint = joint.dot(np.concatenate([follows, np.eye(len(G))]).T)
        joint[:P, :P] += np.linalg.inv(N.reshape(P, P))
        # b = Rc with R = Aᵀ ← R exp(−[δ]ₓ), and φ = −Rδ (−δ in the plane)
        c, R = Theta[self.n_u :], A.T
        T = np.eye(P + len(G))
        T[self.n_u : P, self.n_u : P] = R
        T[self.n_u : P, P:] = -R.dot((G @ c).T)
        T[P:, P:] = -R if d == 3 else -1.0
        return np.asarray(T.dot(joint).dot(T.T))

    def _rotation(self, M: Array, h: Array, A: Array) -> Array:
        """Return the best rotation near A, or one elsewhere that is better beyond doubt."""
        near = law.best_rotation(M, h, A)
        found = self._everywhere
        values = found.dot(h) + 0.5 * (found.dot(M) * found).sum(axis=1)
        start = found[int(np.argmax(values))]
        if start.dot(near.ravel()) > _SAME * self.d:
            return near
        other = law.best_rotation(M, h, start.reshape(A.shape))
        better = law.explained(M, h, other) > law.explained(M, h, near) + _ODDS
        return other if better else near

    def _about(self, Theta: Array, A: Array) -> Array:
        """Return the sums of the prior alone, about these estimates."""
        d, n = self.d, self.n_u
        a = np.concatenate([self.prior.diagonal()[:n] * Theta[:n], np.zeros(d)])
        b = A.T.dot(Theta[n:])
        B = np.zeros((self.P, d, d))
        B[n:] = np.eye(d)[:, :, np.newaxis] * (b * self.prior[-1, -1])
        E = (0.5 / self._sd_R**2) * A.ravel()
        return np.concatenate([self.prior.ravel(), a, B.ravel(), E, Theta, A.ravel()])


def _reduced(N: Array, a: Array, B: Array, E: Array) -> tuple[Array, Array, Array]:
    """Return N⁻¹[a B], and M and h of what rotations alone have to maximise."""
    solved = np.linalg.solve(N, np.concatenate([a[:, np.newaxis], B], axis=1))
    M = B.T.dot(solved[:, 1:])
    return solved, 0.5 * (M + M.T), B.T.dot(solved[:, 0]) + E
