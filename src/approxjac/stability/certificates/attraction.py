"""`Attraction`: starts from which the arm provably never leaves the region."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from approxjac.stability.certificates.certificate import SampledTest, largest_errors
from approxjac.stability.certificates.matrix_form import SampledForm, Weights, best_weights
from approxjac.stability.errors.region import JointBox
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.validation import Array

_RATES = (0.3, 0.6, 1.2, 2.0)  # ρ that are tried [1/s]
_WORST = 120  # samples that the function is chosen on
_MULTIPLES = (0.6, 0.8, 1.0, 1.3, 1.8)  # of the multipliers
_PAIRS = 300  # of a start and a target, for the largest V at the start
_HALVINGS = 12
_SLOWER = 0.125  # times v̄ of all starts: those that stay are slower
_LOOKS, _NEAR, _CLOSE = 8, 40, 0.15  # around those that travel farthest; share of the spread
_TRIED = 4  # functions, until samples nearby have a bound, too
_UNSEEN = 1.1  # times the most that samples travel


@dataclass(frozen=True, eq=False, repr=False)
class Attraction:
    """Starts at rest from which a certified motion stays in a box of configurations.

    |qᵢ(t) − qᵢ(0)| ≤ `travel`ᵢ √V(0) at all times, because V of its own decays at a known rate.
    """

    travel: Array  # bound above, shape (n_v,) [rad/√J or m/√J]
    rate: float  # ρ, with V ≤ V(0) exp(−2ρt) [1/s]
    weights: Weights  # weights of that V
    # if start (at rest) and target configuration are within this distance of the middle of the box
    # in every joint, the motion never leaves the box [rad or m]
    radius: float
    error: float  # largest ‖e‖ of such starts [units of the task]

    def __repr__(self) -> str:
        return f"Attraction(radius={self.radius:.3g}, error={self.error:.3g})"


def attraction(loop: ClosedLoop, test: SampledTest, rng: np.random.Generator) -> Attraction | None:
    """Return starts that stay; None if there are none, or the region is no box."""
    box, saturation, form = loop.region, loop.controller.saturation, slower(test.form)
    if not test.certified or not isinstance(box, JointBox) or not test.level:
        return None
    for _, rate, weights in _rates(form, test)[:_TRIED]:
        travel = _UNSEEN * _farthest(loop, form, weights, rate, rng)
        if np.isfinite(travel).all():
            break
    else:
        return None
    n, most, model = box.robot.nv, form.level(weights), box.robot.model
    pairs = rng.uniform(-1.0, 1.0, (2, _PAIRS, n))  # of a start and a target
    pairs[:, ::2] = np.sign(pairs[:, ::2])  # corners are where errors are largest
    pairs[1, ::4] = -pairs[0, ::4]
    corners = len(loop.corners)
    robots = np.arange(_PAIRS) % corners  # half of them corners, where there are others
    if others := len(loop.plants) - corners:
        robots[: _PAIRS // 2] = corners + np.arange(_PAIRS // 2) % others
    robots = rng.permutation(robots)

    def errors(radius: float) -> Array:
        starts, ends = (
            np.array([pin.integrate(model, box.center, radius * motion) for motion in motions])
            for motions in pairs
        )
        x_d = None if loop.target is not None else loop.terms(robots, ends).x
        return loop.terms(robots, starts, x_d).e

    def stays(radius: float) -> bool:
        e = errors(radius)
        energy = float(weights.at_rest(e, saturation).max())
        is_certified = float(test.weights.at_rest(e, saturation).max()) <= test.level
        farthest = radius + travel * np.sqrt(energy)
        return is_certified and energy <= most and bool((farthest <= box.upper).all())

    low, high = 0.0, float(box.upper.min())
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stays(middle) else (low, middle)
    if not low:
        return None
    return Attraction(travel, rate, weights, low, float(np.linalg.norm(errors(low), axis=1).max()))


def slower(form: SampledForm) -> SampledForm:
    """Return the form of the slower motions that are tested for staying."""
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
    bounds = travels(form, weights, rate)
    near, most = form, bounds.max(axis=0)
    for _ in range(_LOOKS if np.isfinite(most).all() else 0):
        k = int((bounds / most).max(axis=1).argmax())
        near = form.elsewhere(loop.near(near.samples, k, _NEAR, _CLOSE, rng))
        bounds = travels(near, weights, rate)
        if (bounds <= most).all() or np.isinf(bounds).any():
            return np.asarray(np.maximum(most, bounds.max(axis=0)))
        most = np.maximum(most, bounds.max(axis=0))
    return np.asarray(most)


def travels(form: SampledForm, weights: Weights, rate: float) -> Array:
    """Return `Attraction.travel` by each sample, shape (N, n_v); infinite where F − ρP ⊁ 0.

    Errors are the largest that V allows.
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
