"""A search for the worst case: robot, configuration and target together.

A case is a point z of the box [−1, 1]ᵏ: the uncertain numbers, the motion from the middle of the
region, and that of the configuration whose x is the target. A step is a batch for all starts:
forward differences along each coordinate, then points on the way to the corner that the slopes
point to, and with the strongest coordinates flipped. It is no proof, but finds what samples miss:
of many errors at once, the worst lie at corners that nobody draws.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from approxjac import law
from approxjac.controllers.gains.gains import Latency, Timing
from approxjac.robots.traced import motion_between
from approxjac.stability.certificates.certificate import (
    RESERVE,
    MatrixTest,
    continuous_test,
    sampled_form,
    sampled_test,
)
from approxjac.stability.certificates.matrix_form import MatrixForm, SampledForm, Weights
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.samples import Indices, Samples
from approxjac.validation import Array

_STEP = 1e-2  # of a difference
_WAY = (1.0, 0.5, 0.25, 0.1, 0.03)  # shares of the way to the corner
_FLIPPED = (1, 2, 4, 8)  # coordinates, the strongest ones
_STEPS = 12
_LEAST = 1e-4  # relative improvement that goes on
_STARTS = (6, 12)  # of the searches that have to find nothing
_OF_CONSTANTS = 3
ROUNDS = 12
_TRIES = 100  # of a start that is a case

Score = Callable[[Array], Array]


class Cases(NamedTuple):
    """N cases: values of the uncertain numbers, configurations, and those that have the target."""

    values: Array  # shape (N, d)
    q: Array  # shape (N, nq)
    ends: Array | None  # shape (N, nq); None where each q is a target


class CaseBox:
    """The box of all cases of a loop, of `pairs` of a configuration and a target, or of targets."""

    def __init__(self, loop: ClosedLoop, pairs: bool) -> None:
        self._loop, self._box = loop, loop.region.box
        self._d = loop.corners.shape[1]
        self._n = self._box.robot.nv
        self._pairs, self._of_targets = pairs and loop.target is None, not pairs
        self.size = self._d + self._n * (1 + self._pairs)

    def cases(self, z: Array) -> Cases:
        """Return the cases of points (N, k)."""
        values, truth, first = np.zeros((len(z), self._d)), self._loop.truth, self._d + self._n
        if isinstance(truth, Uncertainty) and self._d:
            values = truth.at(z[:, : self._d])
        q = self._configurations(z[:, self._d : first])
        if self._pairs:
            return Cases(values, q, self._configurations(z[:, first:]))
        return Cases(values, q, None if self._of_targets else q)

    def starts(self, n: int, rng: np.random.Generator) -> Array:
        """Draw n starts, of cases where they are found; of one in a hundred points most are."""
        z, left = np.empty((n, self.size)), np.arange(n)
        for _ in range(_TRIES):
            z[left] = self._drawn(len(left), rng)
            left = np.delete(left, self._loop.judged(*self.cases(z[left]))[1])
            if not len(left):
                break
        return z

    def _drawn(self, n: int, rng: np.random.Generator) -> Array:
        """Draw n points: corners of all, corners of the robots alone, and inside, in turn."""
        z = rng.uniform(-1.0, 1.0, (n, self.size))
        z[::3], z[1::3, : self._d] = np.sign(z[::3]), np.sign(z[1::3, : self._d])
        if self._of_targets and self._loop.target is not None:  # near those that attain it
            known = [q for each in self._loop.attained(rng) for q in each]
            some = [known[k] for k in rng.integers(len(known), size=n)]
            away = [motion_between(self._box.robot, self._box.center, q) for q in some]
            sizes = np.where(self._box.upper > 0.0, self._box.upper, 1.0)
            z[:, self._d :] = np.clip(away / sizes, -1.0, 1.0)
        return z

    def _configurations(self, motions: Array) -> Array:
        box, model = self._box, self._box.robot.model
        motions = motions * box.upper
        if box.robot.nq == box.robot.nv:
            return np.asarray(box.center + motions)
        return np.array([pin.integrate(model, box.center, motion) for motion in motions])


def climb(score: Score, z: Array, steps: int = _STEPS) -> tuple[Array, Array]:
    """Return the worst points (s, k) that a search from some points finds, and their scores (s,).

    A score is large where a case is bad, and −∞ where it is none.
    """
    k, z, best = z.shape[1], z.copy(), score(z)
    goes_on = np.isfinite(best)

    def improved(rows: Indices, tried: Array) -> NDArray[np.bool_]:
        """Move to the worst of the points tried, (r, c, k), of those that are worse than before."""
        found = score(tried.reshape(-1, k)).reshape(tried.shape[:2])
        values, first = found.max(axis=1), found.argmax(axis=1)
        better = values > best[rows] + _LEAST * np.abs(best[rows])
        z[rows[better]] = tried[better, first[better]]
        best[rows[better]] = values[better]
        return better

    for _ in range(steps):
        rows = np.flatnonzero(goes_on)
        if not len(rows):
            break
        here, h = z[rows], np.where(z[rows] > 0.0, -_STEP, _STEP)
        near = here[:, None] + h[..., None] * np.eye(k)
        slopes = (score(near.reshape(-1, k)).reshape(h.shape) - best[rows, None]) / h
        slopes[~np.isfinite(slopes)] = 0.0
        corner = np.where(slopes == 0.0, here, np.sign(slopes))
        strongest = np.argsort(-np.abs(slopes * (corner - here)), axis=1)
        tried = [here + share * (corner - here) for share in _WAY]
        for count in _FLIPPED:
            flipped, which = here.copy(), strongest[:, :count]
            np.put_along_axis(flipped, which, np.take_along_axis(corner, which, 1), 1)
            tried.append(flipped)
        better = improved(rows, np.stack(tried, axis=1))
        if len(stuck := rows[~better]):  # one coordinate alone, at either end
            ends = np.repeat(z[stuck, None], 2 * k, axis=1)
            ends[:, range(k), range(k)], ends[:, range(k, 2 * k), range(k)] = -1.0, 1.0
            better[~better] = improved(stuck, ends)
        goes_on[rows] = better & np.isfinite(best[rows])  # nothing is worse than ∞
    return z, best


def scored(loop: ClosedLoop, box: CaseBox, score: Callable[[Samples], Array]) -> Score:
    """Return the score of points of a box, by that of their samples."""

    def of(z: Array) -> Array:
        found = np.full(len(z), -np.inf)
        samples, which = loop.judged(*box.cases(z))
        if len(which):
            values = score(samples)
            found[which] = np.where(np.isnan(values), -np.inf, values)
        return found

    return of


class Growth(NamedTuple):
    """The target near which errors grow fastest, or decay slowest, that a search found."""

    rate: float  # largest real part of an eigenvalue [1/s]; errors do not decay where it is ≥ 0
    values: Array  # of the uncertain numbers there, shape (d,)
    q: Array  # configuration, shape (nq,)
    looks: int  # number of cases that were looked at

    @property
    def grows(self) -> bool:
        """True if errors do not decay there."""
        return self.rate >= 0.0


def fastest_growth(
    loop: ClosedLoop, timing: Timing, starts: int, rng: np.random.Generator
) -> Growth:
    """Search for the target near which the sampled loop is least stable.

    It climbs the slowest rate of Jq̇ = −JD⁻¹ĴᵀK_p s, which is fast to evaluate; then, from where
    that is worst and from other starts, the exact map from frame to frame.
    """
    box, looks, learns = CaseBox(loop, pairs=False), 0, loop.controller.adaptation is not None

    def slow(samples: Samples) -> Array:
        nonlocal looks
        looks += len(samples)
        setting = loop.setting
        D = law.dissipation(samples.J_hat, setting.kv, setting.B)
        A = samples.J @ np.linalg.solve(D, samples.J_hat.mT * setting.kp)
        return np.asarray(-np.linalg.eigvals(A).real.min(axis=-1))

    def exact(samples: Samples) -> Array:
        nonlocal looks
        looks += len(samples)
        return loop.growth(samples, timing)

    z, rates = climb(scored(loop, box, slow), box.starts(starts, rng))
    z = np.concatenate([z[np.argsort(-rates)[: max(2, starts // 4)]], box.starts(2, rng)])
    z, rates = climb(scored(loop, box, exact), z, 2 if learns else _STEPS // 4)
    worst = box.cases(z[[rates.argmax()]])
    samples, _ = loop.judged(*worst)
    if not len(samples):  # no start is a case, so cases are drawn by whoever knows the region
        truths, q = loop.targets(starts, rng)
        x = loop.terms(truths, q).x
        rates = exact(samples := loop.samples_at(truths, q, x))
        first = int(rates.argmax())
        return Growth(float(rates[first]), loop.values[truths[first]], q[first], looks)
    return Growth(float(rates.max()), worst.values[0], samples.q[0], looks)


def worst_margins(
    loop: ClosedLoop, form: MatrixForm, weights: Weights, starts: int, rng: np.random.Generator
) -> Samples:
    """Search for the cases in which a function has the least margin; return them as samples."""
    box = CaseBox(loop, pairs=True)
    score = scored(loop, box, lambda samples: -form.elsewhere(samples).margins(weights))
    return _kept(loop, box, climb(score, box.starts(starts, rng))[0])


def worst_constants(
    loop: ClosedLoop, form: SampledForm, starts: int, rng: np.random.Generator
) -> Samples:
    """Search for the cases in which constants of the sampled form are largest, as samples."""
    box, found = CaseBox(loop, pairs=True), []
    for name in [*form.constants, "energy"]:

        def large(samples: Samples, name: str = name) -> Array:
            return form.elsewhere(samples).constant(name)

        score = scored(loop, box, large)
        found.append(climb(score, box.starts(starts, rng), _STEPS // 2)[0])
    return _kept(loop, box, np.concatenate(found))


def _kept(loop: ClosedLoop, box: CaseBox, z: Array) -> Samples:
    """Return the samples of points, whose true robots the loop keeps."""
    cases = box.cases(z)
    samples, which = loop.judged(*cases)
    return replace(samples, truth=loop.keep(cases.values[which]))


def searched_test(
    loop: ClosedLoop,
    latency: Latency | None,
    samples: Samples,
    rng: np.random.Generator,
    tell: Callable[[float], None] = lambda share: None,
    rounds: int = ROUNDS,
) -> MatrixTest:
    """Choose a Lyapunov function in which a search finds no case of small margin.

    What a search finds joins the samples, and the function is chosen anew, until two searches in
    succession find nothing below `RESERVE`, or there is no function for all samples.

    Args:
        loop: The loop.
        latency: Its latency; None for continuous time.
        samples: Samples to begin with.
        rng: Generator of the starts of the search.
        tell: Function called with the share done.
        rounds: Number of functions at most; 0 chooses one on the given samples, without a search.
    """
    if rounds and latency is not None:
        form = sampled_form(loop, samples, latency)
        samples = samples.join(worst_constants(loop, form, _OF_CONSTANTS, rng))
    test: Any = None
    for k in range(max(rounds, 1)):
        tell((k + 1) / (rounds + 1))
        if latency is None:
            test = continuous_test(loop, samples, test)
        else:
            test = sampled_test(loop, samples, latency, test)
        for starts in _STARTS if rounds else ():
            if test.margin < RESERVE:
                break
            test = test.with_samples(worst_margins(loop, test.form, test.weights, starts, rng))
        # another function is tried only for more samples than it was chosen on
        if test.margin >= RESERVE or len(test.margins) == len(samples):
            break
        samples = test.form.samples
    found: MatrixTest = test
    return found
