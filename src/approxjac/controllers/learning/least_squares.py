"""Estimators of what a measured position depends on: its camera known, or turned anyhow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.controllers.learning.kinematic_report import TiltedAxes
from approxjac.controllers.learning.unknowns import Unknowns
from approxjac.validation import Array

_ODDS = 2.0  # of another rotation against the one at hand, as a logarithm, before it is taken
_SD_TILT = 0.1  # of an axis that may be tilted [rad]
_SAME = 0.8  # of tr(AᵀA'): about 45°, nearer than which rotations are one to Newton's method


class Estimate(NamedTuple):
    """Estimate of the unknowns in x = R(o + HΘ).

    Attributes:
        Theta: Translations, scale and offset in the base's axes, shape (P,).
        R: Rotation of the base's axes in the sensor's, (d, d).
    """

    Theta: Array
    R: Array


class Tilts(NamedTuple):
    """Tilts of axes, and what they would explain beyond what is learnt.

    Attributes:
        chi_squared: Fall of the sum of squares, in the noise's variance.
        freedom: What it is in the mean, where no axis is tilted.
        tilts: That explain most, shape (t,) [rad].
        sd: Their standard deviations, shape (t,) [rad].
    """

    chi_squared: float
    freedom: float
    tilts: Array
    sd: Array


def tilted_axes(found: Tilts, joints: Sequence[str], scale: float) -> TiltedAxes:
    """Return what tilts of the axes of joints would explain.

    Args:
        found: Two tilts a joint.
        joints: Their names.
        scale: Of the noise's variance, as it was told over what it is.
    """
    if not len(found.tilts):
        return TiltedAxes(1.0, 0.0, "", 0.0)
    tilts = np.array([found.tilts, found.tilts / found.sd]).reshape(2, -1, 2)
    joint = int(np.linalg.norm(tilts[1], axis=1).argmax())
    angle = float(np.linalg.norm(tilts[0, joint]))
    chi = found.chi_squared / max(found.freedom, 1e-9) * scale
    return TiltedAxes(chi, found.freedom, joints[joint], angle)


class _Packed:
    """Symmetric matrices (P, P) as their upper triangles, as a state is copied and recorded."""

    def __init__(self, P: int) -> None:
        rows, columns = np.triu_indices(P)
        self.size = len(rows)
        self._upper = rows * P + columns
        where = np.zeros((P, P), dtype=int)
        where[rows, columns] = where[columns, rows] = np.arange(self.size)
        self._where = where

    def has(self, triangle: Array, prior: Array) -> bool:
        """Return whether this may be an information matrix that began with a diagonal prior."""
        # forgetting goes towards the prior, so nothing is ever known less well
        return bool((self.unpack(triangle).diagonal() > 0.99 * prior.diagonal()).all())

    def pack(self, matrix: Array) -> Array:
        return np.asanyarray(matrix.ravel()[self._upper])

    def unpack(self, triangle: Array) -> Array:
        return np.asanyarray(triangle[self._where])


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
        self.prior = np.diag(
            np.append(unknowns.sd_Theta, np.full(unknowns.n_tilts, _SD_TILT)) ** -2.0
        )
        self._weight = noise**-2.0
        self._packed = _Packed(len(self.prior))
        self.size = self._packed.size + len(self.prior)

    def initial(self) -> Array:
        """Return the numbers before the first frame, shape (size,)."""
        return self._about(self._first)

    def are_numbers(self, numbers: Array) -> bool:
        """Return whether they can be those of such an estimator."""
        return self._packed.has(numbers[: self._packed.size], self.prior)

    def renewed(self, numbers: Array) -> Array:
        """Return numbers that know what was learnt only as a belief, as vague as the first."""
        return self._about(self.estimate(numbers).Theta)

    def learn(self, numbers: Array, H: Array, o: Array, x: Array, share: Any) -> Array:
        """Return the numbers after a frame.

        Args:
            numbers: As before, shape (size,).
            H: Regressor in the base's axes, 0 in rows that are lost, (m, P), and of tilts, which
                are looked for and not learnt, (m, t): shape (m, P + t).
            o: What of them is known, shape (m,).
            x: What is measured, shape (m,).
            share: λT, to be forgotten.
        """
        if self._is_turned:
            x = x.reshape(-1, len(self._R)).dot(self._R).ravel()
        P, n, x = self._P, self._packed.size, x - o
        N = law.forgotten_information(self._packed.unpack(numbers[:n]), self.prior, share)
        N, T, H = law.information(N, H, self._weight), H[:, P:], H[:, :P]
        Theta, pull = numbers[n : n + P], numbers[n + P :]
        Theta = Theta + law.correction(N[:P, :P], H, self._weight, x - H.dot(Theta))
        pull = (1.0 - share) * pull + self._weight * x.dot(T)
        return np.concatenate([self._packed.pack(N), Theta, pull])

    def estimate(self, numbers: Array) -> Estimate:
        """Return what is estimated."""
        n = self._packed.size
        return Estimate(numbers[n : n + self._P].copy(), self._R)

    def information(self, numbers: Array) -> Array:
        """Return Λ, shape (P, P)."""
        return self._packed.unpack(numbers[: self._packed.size])[: self._P, : self._P]

    def covariance(self, numbers: Array) -> Array:
        """Return the covariance of (u, b), shape (P, P)."""
        n = self._n_u
        covariance = np.asarray(np.linalg.inv(self.information(numbers)), dtype=np.float64)
        if self._is_turned and n < self._P:
            covariance[n:] = self._R.dot(covariance[n:])
            covariance[:, n:] = covariance[:, n:].dot(self._R.T)
        return covariance

    def tilts(self, numbers: Array) -> Tilts:
        """Return what tilts of axes would explain."""
        n, P = self._packed.size, self._P
        N = self._packed.unpack(numbers[:n])
        pull = numbers[n + P :] - N[P:, :P].dot(numbers[n : n + P])
        left = np.linalg.inv(N[P:, P:] - N[P:, :P].dot(np.linalg.solve(N[:P, :P], N[:P, P:])))
        return _tilts(float(pull.dot(left).dot(pull)), left.dot(pull), left)

    def _about(self, Theta: Array) -> Array:
        """Return the numbers of the prior alone, about these estimates."""
        nothing = np.zeros(len(self.prior) - self._P)
        return np.concatenate([self._packed.pack(self.prior), Theta, nothing])


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
        self.prior = np.diag(
            np.append(unknowns.sd_Theta, np.full(unknowns.n_tilts, _SD_TILT)) ** -2.0
        )
        self._sd_R, self._weight = unknowns.sd_R, noise**-2.0
        P, Q, dd = self._P, len(self.prior), self._d**2
        self._packed = _Packed(Q)
        sizes = [self._packed.size, Q, Q * dd, dd, P, dd]
        self.size = sum(sizes)
        ends = np.cumsum(sizes).tolist()
        self._parts = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
        self._everywhere = law.rotations_everywhere(self._d).reshape(-1, dd)

    def initial(self) -> Array:
        """Return the numbers before the first frame, shape (size,)."""
        return self._about(self._first, self._R.T)

    def are_numbers(self, numbers: Array) -> bool:
        """Return whether they can be those of such an estimator."""
        return self._packed.has(numbers[: self._packed.size], self.prior)

    def renewed(self, numbers: Array) -> Array:
        """Return numbers that know what was learnt only as a belief, as vague as the first."""
        *_, Theta, A = self._split(numbers)
        return self._about(Theta, A.reshape(self._d, self._d))

    def learn(self, numbers: Array, H: Array, o: Array, x: Array, share: Any) -> Array:
        """Return the numbers after a frame.

        Args:
            numbers: As before, shape (size,).
            H: Regressor in the base's axes, 0 in rows that are lost, (m, P), and of tilts, which
                are looked for and not learnt, (m, t): shape (m, P + t).
            o: What of them is known, shape (m,).
            x: What is measured, shape (m,).
            share: λT, to be forgotten.
        """
        d, P, W = self._d, self._P, self._weight
        *_, Theta, A = self._split(numbers)
        numbers = numbers + share * (self._about(Theta, A.reshape(d, d)) - numbers)
        N, a, B, E, _, A = self._split(numbers)
        HW = W * H.T
        N = self._packed.unpack(N) + HW.dot(H)
        if N.dtype.hasobject:  # symbols are symmetric only where they are the same
            N = self._packed.unpack(self._packed.pack(N))
        a = a - HW.dot(o)
        seen = x.reshape(-1, d)
        each = HW.reshape(len(a), -1, d).transpose(0, 2, 1).dot(seen)  # Σ Hᵀ x
        B = B.reshape(len(a), -1) + each.reshape(len(a), -1)
        E = E + (W * o.reshape(-1, d).T.dot(seen)).ravel()
        solved, M, h = _reduced(N[:P, :P], a[:P], B[:P], E)
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
        *_, Theta, A = self._split(numbers)
        A, G = A.reshape(d, d), law.generators(d)
        joint = self._joint(numbers, A, P)[0]
        # b = Rc with R = Aᵀ ← R exp(−[δ]ₓ), and φ = −Rδ (−δ in the plane)
        c, R = Theta[self._n_u :], A.T
        T = np.eye(P + len(G))
        T[self._n_u : P, self._n_u : P] = R
        T[self._n_u : P, P:] = -R.dot((G @ c).T)
        T[P:, P:] = -R if d == 3 else -1.0
        return np.asarray(T.dot(joint).dot(T.T))

    def tilts(self, numbers: Array) -> Tilts:
        """Return what tilts of axes would explain, with all else and the rotation best for them."""
        P, Q = self._P, len(self.prior)
        A = numbers[self._parts[-1]].reshape(self._d, self._d)
        _, without, _, _ = self._joint(numbers, A, P)
        _, M, h = _reduced(*self._leading(numbers, Q))
        A = law.best_rotation(M, h, A)
        covariance, value, Theta, _ = self._joint(numbers, A, Q)
        return _tilts(2.0 * (value - without), Theta[P:], covariance[P:Q, P:Q])

    def _leading(self, numbers: Array, n: int) -> tuple[Array, Array, Array, Array]:
        """Return N, a, B and E of the first n numbers alone."""
        N, a, B, E, *_ = self._split(numbers)
        return self._packed.unpack(N)[:n, :n], a[:n], B.reshape(len(a), -1)[:n], E

    def _joint(self, numbers: Array, A: Array, n: int) -> tuple[Array, float, Array, Array]:
        """Return the covariance of the first n numbers and δ of A ← exp([δ]ₓ)A, and what is best.

        Returns:
            The covariance (n + 1 or 3) squared; the fall of the sum of squares from where all is 0,
            halved; the numbers, (n,), and their rates along δ, (n, 1 or 3).
        """
        N, a, B, E = self._leading(numbers, n)
        solved, M, h = _reduced(N, a, B, E)
        known, axes = np.linalg.eigh(law.rotation_information(M, h, A))
        # nothing is known less well than before
        of_delta = (axes / np.maximum(known, self._sd_R**-2.0)).dot(axes.T)
        follows = solved[:, 1:].dot(law.tangents(A))
        moved = np.concatenate([follows, np.eye(len(of_delta))])
        covariance = moved.dot(of_delta).dot(moved.T)
        covariance[:n, :n] += np.linalg.inv(N)
        value = law.explained(M, h, A.ravel()) + 0.5 * float(a.dot(solved[:, 0]))
        return covariance, value, solved[:, 0] + solved[:, 1:].dot(A.ravel()), follows

    def _split(self, numbers: Array) -> list[Array]:
        """Return N, a, B, E, the estimates Θ and A, flat."""
        return [numbers[part] for part in self._parts]

    def _rotation(self, M: Array, h: Array, A: Array) -> Array:
        """Return the best rotation near A, or one elsewhere that is better beyond doubt."""
        near = law.best_rotation(M, h, A)
        start = law.most_explained(M, h, self._everywhere)

        def elsewhere() -> tuple[Array]:
            other = law.best_rotation(M, h, start.reshape(A.shape))
            better = law.explained(M, h, other) > law.explained(M, h, near) + _ODDS
            return (law.select(better, other, near),)

        is_other = start.dot(near.ravel()) <= _SAME * self._d
        found: Array = law.choose(is_other, elsewhere, lambda: (near,))[0]
        return found

    def _about(self, Theta: Array, A: Array) -> Array:
        """Return the sums of the prior alone, about these estimates."""
        d, n = self._d, self._n_u
        b, P, Q = A.T.dot(Theta[n:]), self._P, len(self.prior)
        a = [self.prior.diagonal()[:n] * Theta[:n], np.zeros(Q - n)]
        B = np.eye(d)[:, :, np.newaxis] * (b * self.prior[n, n])
        of_B = [np.zeros(n * d * d), B.ravel(), np.zeros((Q - P) * d * d)]
        E = (0.5 / self._sd_R**2) * A.ravel()
        return np.concatenate([self._packed.pack(self.prior), *a, *of_B, E, Theta, A.ravel()])


def _reduced(N: Array, a: Array, B: Array, E: Array) -> tuple[Array, Array, Array]:
    """Return N⁻¹[a B], and M and h of what rotations alone have to maximise."""
    solved = np.linalg.solve(N, np.concatenate([a[:, np.newaxis], B], axis=1))
    M = B.T.dot(solved[:, 1:])
    return solved, 0.5 * (M + M.T), B.T.dot(solved[:, 0]) + E


def _tilts(fall: float, tilts: Array, covariance: Array) -> Tilts:
    """Return what tilts explain, of their covariance once they were looked for."""
    variances = covariance.diagonal()
    freedom = float((1.0 - variances / _SD_TILT**2).sum())
    return Tilts(fall, freedom, tilts, np.sqrt(variances))
