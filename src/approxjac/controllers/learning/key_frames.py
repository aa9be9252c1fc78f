"""Estimator of what an image depends on: translations of the points, the camera's pose and f."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from approxjac import law
from approxjac.errors import InvalidInputError
from approxjac.validation import Array

_KEYS = 40  # key frames
_MOST = 200.0  # frames that one of them counts for at most
_NEW = (0.03, 0.15)  # of o [m] and H, from a key frame on
_NEAREST = 0.05  # that a point is before the camera [m]
_PLACED = 0.5  # depth of points that are believed behind the camera [m]
_DAMPING = (0.0, 1.0, 1e2, 1e4, 1e6)  # of Levenberg and Marquardt, in prior informations
_TURN = 0.7  # of one step [rad]
_DOUBT = 4.0  # χ² a degree of freedom, above which another roll is looked for
_LARGEST_CHI = 1e9  # that is told
_ODDS = 8.0  # of it against the one at hand, as a logarithm, before it is taken
_BETTER = 0.7  # and its cost, as a share
_VIEWS = 6  # of the best ones that are tried
_PATIENCE = 10.0  # frames for it to become better


class ImageEstimate(NamedTuple):
    """ImageEstimate of the unknowns in y = e^λ π(R(o + Hu − p)).

    Attributes:
        u: Translations, shape (n_u,) [m].
        R: Rotation of the mount's axes in the camera's, (3, 3).
        p: Position of the camera in the axes of its mount, shape (3,) [m].
        stretch: λ, the logarithm of the focal length over the believed one.
    """

    u: Array
    R: Array
    p: Array
    stretch: float


class Deviations(NamedTuple):
    """Plausible errors of an `ImageEstimate`; 0 of what is known.

    Attributes:
        u: Of the translations, shape (n_u,) [m].
        position: Of the camera's position [m].
        rotation: Of its rotation [rad].
        stretch: Of λ.
    """

    u: Array
    position: float
    rotation: float
    stretch: float


class ImageEstimator:
    """Least squares over key frames, linearised anew with each frame.

    A key frame is the mean of y and of r = o + Hu over a short way, which is as linear in u as one
    frame is. As rays are no linear function, what is remembered are 40 of them. Each new frame
    brings a step of Levenberg and Marquardt from the estimate, with the prior as it was at first.

    Where the estimate does not explain what is seen, the camera may be rolled, or elsewhere about
    the points: the turn of the image that explains it best from there, in closed form, is tried
    beside the estimate for some frames, and taken if it is better beyond doubt.

    Its numbers: key frames (for each point its count, y, o and H), the estimate, the one that is
    tried beside it, how long that has been tried (0: it is not), how many were tried before, χ²,
    and which key frame is last.

    Args:
        believed: The estimate before the first frame.
        sd: Plausible errors of it.
        noise: Of y, shape (2,).
        k: Number of points.
    """

    def __init__(self, believed: ImageEstimate, sd: Deviations, noise: Array, k: int) -> None:
        self._believed, self._k, self._n = believed, k, len(believed.u)
        n = self._n
        self.sd = np.concatenate([sd.u, [sd.position] * 3, [sd.rotation] * 3, [sd.stretch]])
        self._free = np.flatnonzero(self.sd > 0.0)
        self._prior = np.where(self.sd > 0.0, self.sd, np.inf) ** -2.0
        self._weight = noise**-2.0
        self._shape = _KEYS, k, 6 + 3 * n
        self._m, self._e = _KEYS * k * (6 + 3 * n), n + 13
        self.size = self._m + 2 * self._e + 4
        everywhere = law.rotations_everywhere(3)  # of which those with the same view are one
        _, first = np.unique(np.round(everywhere[:, 2], 6), axis=0, return_index=True)
        self._views = everywhere[first]

    # -- numbers -------------------------------------------------------------------------

    def initial(self) -> Array:
        """Return the numbers before the first frame, shape (size,)."""
        return self._about(self._believed)

    def renewed(self, numbers: Array) -> Array:
        """Return numbers that have forgotten all frames, but not the estimate."""
        return self._about(self.estimate(numbers))

    def estimate(self, numbers: Array) -> ImageEstimate:
        """Return what is estimated."""
        return self._unpacked(numbers[self._m : self._m + self._e])

    def has_begun(self, numbers: Array) -> bool:
        """Return whether there was a frame: χ² is above 0 from the first one on."""
        return bool(numbers[-2] > 0.0)

    def chi_squared(self, numbers: Array) -> float:
        """Return χ² of all key frames a degree of freedom."""
        return float(numbers[-2])

    def learn(self, numbers: Array, H: Array, o: Array, y: Array) -> Array:
        """Return the numbers after a frame.

        Args:
            numbers: As before, shape (size,).
            H: Of the points, shape (k, 3, n_u).
            o: Shape (k, 3).
            y: What is measured, shape (k, 2), NaN of points that are lost.
        """
        numbers = numbers.copy()
        self._remember(numbers, H, o, y)
        terms = self._terms(numbers)
        m, e = self._m, self._e
        first = not self.has_begun(numbers)
        best = self.estimate(numbers)
        if first or not math.isfinite(self._misfit(best, terms)):
            best = self._placed(best, terms)
        best, cost = self._improved(best, terms, 8 if first else 1)
        chi = self._chi_squared(best, terms)
        tried = numbers[m + 2 * e]
        if chi > _DOUBT and not first and self._prior[-2] > 0.0:
            if tried:
                other = self._unpacked(numbers[m + e : m + 2 * e])
            else:
                other = self._another(terms, int(numbers[-3]))
            other, cost_other = self._improved(other, terms, 2)
            if cost_other < min(_BETTER * cost, cost - _ODDS):
                best, tried, numbers[-3] = other, 0.0, 0.0
                chi = self._chi_squared(best, terms)
            else:
                tried += 1.0
                if tried > _PATIENCE:
                    tried, numbers[-3] = 0.0, numbers[-3] + 1.0
                numbers[m + e : m + 2 * e] = self._packed(other)
        else:
            tried = 0.0
        numbers[m : m + e] = self._packed(best)
        numbers[m + 2 * e], numbers[-2] = tried, min(max(chi, 1e-12), _LARGEST_CHI)
        return numbers

    def covariance(self, numbers: Array) -> Array:
        """Return the covariance of (u, p, φ, λ), φ of R ← exp([φ]ₓ)R; 0 of what is known."""
        found, free = np.zeros((len(self.sd), len(self.sd))), self._free
        A, _ = self._normal(self.estimate(numbers), self._terms(numbers))
        found[np.ix_(free, free)] = np.linalg.inv(A[np.ix_(free, free)])
        return found

    def _about(self, estimate: ImageEstimate) -> Array:
        numbers = np.zeros(self.size)
        numbers[self._m : self._m + self._e] = self._packed(estimate)
        return numbers

    def _packed(self, estimate: ImageEstimate) -> Array:
        u, R, p, stretch = estimate
        return np.concatenate([u, R.ravel(), p, [stretch]])

    def _unpacked(self, numbers: Array) -> ImageEstimate:
        n = self._n
        R, p = numbers[n : n + 9].reshape(3, 3), numbers[n + 9 : n + 12]
        return ImageEstimate(numbers[:n].copy(), R.copy(), p.copy(), float(numbers[n + 12]))

    # -- key frames ----------------------------------------------------------------------

    def _remember(self, numbers: Array, H: Array, o: Array, y: Array) -> None:
        """Add a frame to the last key frame, or begin another one, in place."""
        keys = numbers[: self._m].reshape(self._shape)
        if not 0.0 <= numbers[-1] < _KEYS:
            told = f"state must be one of this controller's, got key frame {numbers[-1]:g}"
            raise InvalidInputError(told, given=numbers)
        last = int(numbers[-1])
        key = keys[last]
        has = key[:, 0] > 0.0
        if has.any():
            away = np.abs(key[has, 3:6] - o[has]).max() / _NEW[0]
            away += np.linalg.norm(key[has, 6:] - H.reshape(self._k, -1)[has]) / _NEW[1]
            if away > 1.0:
                last = (last + 1) % _KEYS
                numbers[-1] = last
                key = keys[last]
                key[:] = 0.0
        seen = np.isfinite(y).all(axis=1)
        count = np.minimum(key[:, 0] + seen, _MOST)
        share = np.where(seen, 1.0 / np.maximum(count, 1.0), 0.0)[:, np.newaxis]
        now = np.concatenate([np.nan_to_num(y), o, H.reshape(self._k, -1)], axis=1)
        key[:, 1:] += share * (now - key[:, 1:])
        key[:, 0] = count

    def _terms(self, numbers: Array) -> tuple[Array, Array, Array, Array]:
        """Return weights (N, 2), y (N, 2), o (N, 3) and H (N, 3, n_u) of what is remembered."""
        rows = numbers[: self._m].reshape(-1, self._shape[2])
        rows = rows[rows[:, 0] > 0.0]
        weights = rows[:, :1] * self._weight
        return weights, rows[:, 1:3], rows[:, 3:6], rows[:, 6:].reshape(len(rows), 3, self._n)

    def _chi_squared(
        self, estimate: ImageEstimate, terms: tuple[Array, Array, Array, Array]
    ) -> float:
        rows = 2.0 * len(terms[0])
        return 2.0 * self._misfit(estimate, terms) / max(rows - len(self._free), 0.5 * rows)

    # -- least squares -------------------------------------------------------------------

    def _places(self, estimate: ImageEstimate, terms: tuple[Array, Array, Array, Array]) -> Array:
        """Return the points in the camera's axes, shape (N, 3)."""
        u, R, p, _ = estimate
        return np.asarray((terms[2] + terms[3].dot(u) - p).dot(R.T))

    def _misfit(self, estimate: ImageEstimate, terms: tuple[Array, Array, Array, Array]) -> float:
        """Return half the weighted sum of squares of what is left of y; inf behind the camera."""
        c = self._places(estimate, terms)
        if not (c[:, 2] > _NEAREST).all():
            return math.inf
        left = terms[1] - law.rays(c, math.exp(estimate.stretch))
        return 0.5 * float((terms[0] * left * left).sum())

    def _cost(self, estimate: ImageEstimate, terms: tuple[Array, Array, Array, Array]) -> float:
        """Return the misfit, and what it costs to be away from what is believed."""
        away = self._away(estimate)
        turned = estimate.R - self._believed.R
        prior = away.dot(self._prior * away) + 0.5 * self._prior[-2] * float(
            np.vdot(turned, turned)
        )
        return self._misfit(estimate, terms) + 0.5 * float(prior)

    def _away(self, estimate: ImageEstimate) -> Array:
        """Return how far an estimate is from what is believed, but for the rotation."""
        u, _, p, stretch = self._believed
        return np.concatenate(
            [estimate.u - u, estimate.p - p, np.zeros(3), [estimate.stretch - stretch]]
        )

    def _normal(
        self, estimate: ImageEstimate, terms: tuple[Array, Array, Array, Array]
    ) -> tuple[Array, Array]:
        """Return the normal matrix (P, P) and the descent (P,) of the cost."""
        weights, y, _, H = terms
        R, stretch = estimate.R, math.exp(estimate.stretch)
        c = self._places(estimate, terms)
        shown = law.rays(c, stretch)
        A = law.ray_jacobian(c, stretch)
        AR = A @ R
        n = self._n
        rows = np.empty((*A.shape[:2], len(self.sd)))
        rows[:, :, :n], rows[:, :, n : n + 3] = AR @ H, -AR
        for i, G in enumerate(law.generators(3)):  # c moves by φ × c
            rows[:, :, n + 3 + i] = (A @ c.dot(G.T)[:, :, np.newaxis])[..., 0]
        rows[:, :, -1] = shown
        rows = rows.reshape(-1, len(self.sd))
        weighted = rows * weights.reshape(-1, 1)
        normal = weighted.T.dot(rows) + np.diag(self._prior)
        descent = (y - shown).ravel().dot(weighted) - self._prior * self._away(estimate)
        tangents = (law.generators(3) @ R).reshape(3, -1)
        turned = (R - self._believed.R).ravel()
        descent[n + 3 : n + 6] -= 0.5 * self._prior[-2] * tangents.dot(turned)
        return normal, descent

    def _improved(
        self, estimate: ImageEstimate, terms: tuple[Array, Array, Array, Array], steps: int
    ) -> tuple[ImageEstimate, float]:
        """Return an estimate after some steps of Levenberg and Marquardt, and its cost."""
        cost, free = self._cost(estimate, terms), self._free
        for _ in range(steps if math.isfinite(cost) else 0):  # nothing leads out from behind it
            normal, descent = self._normal(estimate, terms)
            normal, descent = normal[np.ix_(free, free)], descent[free]
            for damping in _DAMPING:
                step = np.zeros(len(self.sd))
                damped = normal + np.diag(damping * self._prior[free])
                step[free] = np.linalg.solve(damped, descent)
                new = self._moved(estimate, step)
                lower = self._cost(new, terms)
                if lower < cost:
                    estimate, cost = new, lower
                    break
            else:
                break
        return estimate, cost

    def _moved(self, estimate: ImageEstimate, step: Array) -> ImageEstimate:
        u, R, p, stretch = estimate
        n = self._n
        turn = step[n + 3 : n + 6]
        largest = max(1.0, math.hypot(*turn.tolist()) / _TURN)
        step = step / largest
        R = law.rotation_exp(step[n + 3 : n + 6]).dot(R)
        return ImageEstimate(u + step[:n], R, p + step[n : n + 3], stretch + float(step[-1]))

    # -- where to start ------------------------------------------------------------------

    def _placed(
        self, estimate: ImageEstimate, terms: tuple[Array, Array, Array, Array]
    ) -> ImageEstimate:
        """Return an estimate whose camera is moved such that it sees the points, about as it does.

        Where they are believed behind it, it is moved back; then sideways.
        """
        if self._prior[self._n] == 0.0:  # where it is is known
            return estimate
        u, R, p, stretch = estimate
        weights = terms[0][:, 0] / terms[0][:, 0].sum()
        c = self._places(estimate, terms)
        back = 0.0 if c[:, 2].min() > _NEAREST else _PLACED - float(c[:, 2].min())
        c[:, 2] += back
        beside = weights.dot(c[:, 2:] * terms[1] * math.exp(-stretch) - c[:, :2])
        return ImageEstimate(u, R, p - np.append(beside, back).dot(R), stretch)

    def _another(self, terms: tuple[Array, Array, Array, Array], rank: int) -> ImageEstimate:
        """Return another estimate to begin with: a camera elsewhere about the points, and rolled.

        At the depth that is believed. Where it is believed is the first, and from there the best
        roll, in closed form; of other views, the one whose images are alike but for turn and size.

        Args:
            terms: What is remembered.
            rank: How many were tried before.
        """
        weights, y, o, H = terms
        w = weights[:, 0] / weights[:, 0].sum()
        u, _, p, stretch = believed = self._placed(self._believed, terms)
        r = o + H.dot(u)
        depth = max(float(w.dot((r - p).dot(believed.R[2]))), _PLACED)
        views = np.eye(3)[np.newaxis] if rank % 2 == 0 else self._views
        R = believed.R @ views
        center = depth * np.append(math.exp(-stretch) * w.dot(y), 1.0)
        c = (r - w.dot(r)) @ R.transpose(0, 2, 1) + center
        c[..., 2] = np.maximum(c[..., 2], _NEAREST)
        turns, left = law.image_turn(c[..., :2] / c[..., 2:], y, weights[:, 0])
        best = np.argsort(left)[(rank // 2) % min(_VIEWS, len(left))]
        rolled = law.rotation_exp(np.array([0.0, 0.0, turns[best]])).dot(R[best])
        if self._prior[self._n] > 0.0:
            p = w.dot(r) - center.dot(rolled)
        return believed._replace(R=rolled, p=p)
