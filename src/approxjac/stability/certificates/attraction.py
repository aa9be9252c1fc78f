"""`Attraction`: starts from which the arm provably never leaves the region."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from approxjac.stability.certificates.certificate import SampledTest, largest_errors
from approxjac.stability.certificates.matrix_form import MatrixForm, Weights, best_weights
from approxjac.stability.certificates.sampled_form import SampledForm
from approxjac.stability.errors.region import JointBox
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.samples import Indices
from approxjac.validation import Array

_RATES = (0.3, 0.6, 1.2, 2.0)  # ρ that are tried [1/s]
_WORST = 120  # samples that the function is chosen on
_MULTIPLES = (0.6, 0.8, 1.0, 1.3, 1.8)  # of the multipliers
_PAIRS = 300  # of a start and a target, for the largest V at the start
_EDGES = 1500  # configurations on the boundary
_CLOSER, _AROUND = 4, 300  # closer looks at the lowest place of the boundary, and of how many
_HALVINGS = 12
_SLOWER = 0.125  # times v̄ of all starts: those that stay are slower
_LOOKS, _NEAR, _CLOSE = 8, 40, 0.15  # around those that travel farthest; share of the spread
_TRIED = 4  # functions, until samples nearby have a bound, too
_UNSEEN = 1.1  # times the most that samples travel


@dataclass(frozen=True, eq=False, repr=False)
class Attraction:
    """Starts at rest from which a certified motion stays in a box of configurations.

    |qᵢ(t) − qᵢ(0)| ≤ `travel`ᵢ √V(0) at all times, from a rate at which a V of its own dies out.
    With as many joints as task coordinates also: V ≤ `level`, of the report's function, is left by
    no motion, as on the boundary of the box V is larger whatever the speed.

    Attributes:
        travel: Shape (n_v,) [rad/√J or m/√J]; infinite without a rate.
        rate: ρ of that rate [1/s]; 0 where there is none.
        weights: Of the V that has it.
        level: Smallest V on the boundary, and at most `SampledTest.level` [J]; 0 with joints to
            spare. Of the loop without torque limits.
        radius: Starts at rest, and targets of configurations, within so much of the middle of the
            box in every joint never leave it [rad or m]; 0 where there are none.
        error: Largest ‖e‖ of such starts [units of the task].
    """

    travel: Array
    rate: float
    weights: Weights
    level: float
    radius: float
    error: float

    def __repr__(self) -> str:
        return f"Attraction(radius={self.radius:.3g}, error={self.error:.3g})"


def attraction(loop: ClosedLoop, test: SampledTest, rng: np.random.Generator) -> Attraction | None:
    """Return starts that stay; None of what is not certified, or of a region that is no box."""
    box, saturation, form = loop.region, loop.controller.saturation, slower(test.form)
    if not test.certified or not isinstance(box, JointBox) or not test.level:
        return None
    travel, rate, weights = np.full(box.robot.nv, np.inf), 0.0, test.weights
    for _, its_rate, its_weights in _rates(form, test)[:_TRIED]:
        farthest = _UNSEEN * _farthest(loop, form, its_weights, its_rate, rng)
        if np.isfinite(farthest).all():
            travel, rate, weights = farthest, its_rate, its_weights
            break
    most = form.level(weights)
    starts = _Starts(loop, box, test.weights, rng)
    spare = box.robot.nv - loop.controller.task.m

    def stays(radius: float) -> bool:
        e = starts.errors(radius)
        energy = float(test.weights.at_rest(e, saturation).max())
        if energy > test.level:
            return False
        its_own = float(weights.at_rest(e, saturation).max())
        if its_own <= most and (radius + travel * np.sqrt(its_own) <= box.upper).all():
            return True
        return not spare and energy < starts.lowest(radius)

    low, high, level = 0.0, float(box.upper.min()), 0.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stays(middle) else (low, middle)
    if not spare:
        level = min(test.level, starts.lowest(low))
    error = float(np.linalg.norm(starts.errors(low), axis=1).max()) if low else 0.0
    return Attraction(travel, rate, weights, level, low, error)


def slower(form: SampledForm) -> SampledForm:
    """Return a form of the slower motions that are asked whether they stay."""
    return form.with_speed(_SLOWER * form.speed)


def _rates(form: SampledForm, test: SampledTest) -> list[tuple[float, float, Weights]]:
    """Functions that die out with a rate: size of their travel, rate, weights; the least first."""
    largest = _largest_ratio(form, test.weights)
    worst, functions = form.take(np.argsort(test.margins)[:_WORST]), []
    for rate in _RATES:
        if not form.changed(decay=(rate, largest)).is_possible():
            break
        best = best_weights(worst.changed(decay=(rate, largest)), "free").weights
        for multiple in _MULTIPLES if (best.w > 0.0).all() else ():
            scaled = best._replace(multiplier=multiple * best.multiplier)
            if np.isinf(travels(worst, scaled, rate)).any():
                continue
            size = float(travels(form, scaled, rate).max() * np.sqrt(best.w.max()))
            if np.isfinite(size):
                functions.append((size, rate, scaled))
    return sorted(functions, key=lambda each: each[0])


def _farthest(
    loop: ClosedLoop, form: SampledForm, weights: Weights, rate: float, rng: np.random.Generator
) -> Array:
    """The most that samples travel by a function, with a closer look around those that do."""
    near, most = form, np.zeros(form.samples.M.shape[-1])
    for look in range(_LOOKS + 1):
        bounds = travels(near, weights, rate)
        if (bounds <= most).all():
            break
        most = np.maximum(most, bounds.max(axis=0))
        if look == _LOOKS or np.isinf(most).any():
            break
        k = int((bounds / most).max(axis=1).argmax())
        near = form.elsewhere(loop.near(near.samples, k, _NEAR, _CLOSE, rng))
    return most


def travels(form: SampledForm, weights: Weights, rate: float) -> Array:
    """Return `Attraction.travel` by each sample, shape (N, n_v); infinite where F − ρP ⊁ 0.

    Errors are as large as the function lets them be.
    """
    decay = rate, _largest_ratio(form, weights)
    faster = form.changed(most_s=form.largest_s(weights), decay=decay)
    F = faster.decrease(weights)
    positive = np.linalg.eigvalsh(F)[:, 0] > 0.0
    n = form.samples.M.shape[-1]
    bounds = np.full((len(F), n), np.inf)
    inverse = np.diagonal(np.linalg.inv(F[positive]), axis1=1, axis2=2)[:, :n]
    bounds[positive] = np.sqrt(inverse / (2.0 * rate))
    return bounds


def _largest_ratio(form: SampledForm, weights: Weights) -> float:
    """Largest S(e)/s(e)² of motions that stay below v̄: ½ where s(e) = e."""
    saturation = form.setting.saturation
    largest = largest_errors(saturation, weights.w, 0.5 * form.speed**2)
    errors = np.linspace(0.0, 1.0, 200)[1:, np.newaxis] * largest
    s = saturation.s(errors)
    positive = s > 0.0
    return float((saturation.S(errors)[positive] / s[positive] ** 2).max(initial=0.5))


def _robots(loop: ClosedLoop, n: int, rng: np.random.Generator) -> Indices:
    """Return true robots in any order, half of them corners where there are others; shape (n,)."""
    corners, others = len(loop.corners), len(loop.plants) - len(loop.corners)
    robots = np.arange(n) % corners
    if others:
        robots[: n // 2] = corners + np.arange(n // 2) % others
    return rng.permutation(robots)


class _Starts:
    """Starts and targets near the middle of a box, and its boundary, the same at each asking."""

    def __init__(
        self, loop: ClosedLoop, box: JointBox, weights: Weights, rng: np.random.Generator
    ) -> None:
        self._loop, self._box, self._weights, self._rng = loop, box, weights, rng
        n = box.robot.nv
        self._pairs = rng.uniform(-1.0, 1.0, (2, _PAIRS, n))
        self._pairs[:, ::2] = np.sign(self._pairs[:, ::2])  # corners are where errors are largest
        self._pairs[1, ::4] = -self._pairs[0, ::4]
        self._truths = _robots(loop, _PAIRS, rng)
        self._edges = rng.uniform(-1.0, 1.0, (_EDGES, n))
        sides = np.where(rng.random(_EDGES) < 0.5, -1.0, 1.0)
        self._edges[np.arange(_EDGES), np.arange(_EDGES) % n] = sides
        self._edge_truths = _robots(loop, _EDGES, rng)

    def errors(self, radius: float) -> Array:
        """Return errors of starts within a radius, shape (N, m)."""
        starts, ends = (self._at(radius * motions) for motions in self._pairs)
        return self._loop.terms(self._truths, starts, self._targets(self._truths, ends)).e

    def lowest(self, radius: float) -> float:
        """Return the smallest V on the boundary, with any speed, of targets within a radius [J]."""
        truths, motions, least = self._edge_truths, self._edges, np.inf
        ends = np.resize(self._pairs[1], motions.shape)
        for look in range(1 + _CLOSER):
            values = self._least(truths, self._box.upper * motions, radius * ends)
            k = int(values.argmin())
            least = min(least, float(values[k]))
            if look == _CLOSER:
                break
            size = 0.2 * 0.4**look
            near = motions[k] + size * self._rng.normal(size=(_AROUND, motions.shape[1]))
            on = np.abs(motions[k]) >= 1.0
            near = np.where(on, motions[k], np.clip(near, -1.0, 1.0))
            ends = np.clip(ends[k] + size * self._rng.normal(size=near.shape), -1.0, 1.0)
            truths, motions = np.full(_AROUND, truths[k]), near
        return least

    def _least(self, truths: Indices, motions: Array, ends: Array) -> Array:
        """min over q̇ of V, V at rest less ½|Gs|²_M, shape (N,)."""
        q = self._at(motions)
        at = self._loop.samples_at(truths, q, self._targets(truths, self._at(ends)))
        G = MatrixForm(at, self._loop.setting).cross_weight(self._weights)
        turned = (G @ at.s[..., np.newaxis])[..., 0]
        kinetic = 0.5 * np.einsum("ni,nij,nj->n", turned, at.M, turned)
        at_rest = self._weights.at_rest(at.e, self._loop.controller.saturation)
        return np.asarray(at_rest - kinetic)

    def _targets(self, truths: Indices, ends: Array) -> Array:
        if self._loop.target is not None:
            return np.repeat(np.asarray(self._loop.target)[np.newaxis], len(truths), axis=0)
        return self._loop.terms(truths, ends).x

    def _at(self, motions: Array) -> Array:
        model, center = self._box.robot.model, self._box.center
        return np.array([pin.integrate(model, center, motion) for motion in motions])
