"""`ClosedLoop`: a controller on one or several true robots, and the samples it is tested on."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from approxjac.controllers import Controller, Gains
from approxjac.controllers.gains.gains import Timing
from approxjac.errors import InvalidInputError
from approxjac.formatting import joined
from approxjac.robots import Dynamics, Robot
from approxjac.robots.traced import moved
from approxjac.simulation import Plant
from approxjac.stability.certificates.matrix_form import Setting
from approxjac.stability.errors.region import JointBox, Region, RegularPart, require_law
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.configurations import (
    UnattainedError,
    VisiblePart,
    inverse_kinematics,
    least_regular,
)
from approxjac.stability.loop.linearization import (
    LocalStability,
    gravity_error,
    linear_loops,
    stabilities,
)
from approxjac.stability.loop.samples import (
    Indices,
    Samples,
    Terms,
    TracedTerms,
    terms_alone,
    traced_terms,
)
from approxjac.tasks import Task
from approxjac.tasks.analysis import (
    features,
    image_feature,
    require_jacobian_of_q,
    sees,
    vanishing,
)
from approxjac.validation import Array, require

EXACT_GRAVITY = 1e-5  # gravity torque that counts as none [N m or N]
SHARED = 8  # samples that functions are chosen on, of each true robot from inside of the errors
_REGULAR = 0.5  # times a tenth of the typical σ_max: configurations below it are left out
_STARTS = 20  # of the search for configurations that attain a target
_WEIGHED = 8  # true robots from inside whose gravity is looked at, besides the corners
_DECADES = 6.0  # of the sizes of small errors
_VANISHING = 1e-4  # σ_min that is found there, of a tenth of the typical σ_max
_PROJECTED, _ATTAINED = 12, 1e-9  # steps to a target, and what counts as there [rad or m]
_LONGEST = 0.3  # step [rad or m]
_SINGULAR = 1e-9  # σ_min as a share of σ_max at which Ĵ⁺ cannot be computed


class ClosedLoop:
    """A controller on one or several true robots, with the region and target to analyse.

    It draws configurations and targets that the true robot's sensor sees, and true robots at
    the corners and inside of the error box. The arguments are those of `Study`.

    Attributes:
        corners: Values of the uncertain coordinates at the corners, shape (k, d).
        values: Errors of each true robot: corners of the set, and others drawn from inside.
        plants: The true robots.
        diagonals: The gains.
        parts: The region as each true robot's sensor sees it.

    Raises:
        InvalidInputError: Law (5) or a posture torque, another task than the sensor's, a plant
            that is not ideal, or arguments of the wrong kind or shape.
    """

    def __init__(
        self,
        controller: Controller,
        truth: Plant | Robot | Uncertainty,
        region: Region | None = None,
        target: Sequence[float] | Array | None = None,
    ) -> None:
        controller = require_law(controller)
        if isinstance(truth, Robot):
            truth = Plant(truth, controller.task.on(truth))
        require("truth", truth, (Plant, Uncertainty), "a Plant, a Robot or an Uncertainty")
        self.controller, self.truth, self.diagonals = controller, truth, controller.diagonals
        self.corners = truth.corners() if isinstance(truth, Uncertainty) else np.zeros((1, 0))
        self.values = self.corners
        self.plants = [truth] if isinstance(truth, Plant) else [*map(truth.plant, self.corners)]
        for plant in self.plants:
            plant.require_task(controller.task)
            plant.require_ideal("a stability report")
        region = usual_region(controller.task) if region is None else region
        require("region", region, Region, "a Region, such as JointBox(robot)")
        self.region = region
        self.target = None if target is None else self.plants[0].sensor.target(target)
        self.parts = [VisiblePart(region, plant.sensor, k) for k, plant in enumerate(self.plants)]
        self._numbers: Array = np.empty(0)  # of the true robots, as `terms` has them
        self._attained: list[list[Array]] = []

    def scaled(self, factor: float) -> ClosedLoop:
        """Return the loop with scaled errors of its `Uncertainty`."""
        assert isinstance(self.truth, Uncertainty)
        scaled = ClosedLoop(self.controller, self.truth.scaled(factor), self.region, self.target)
        vars(scaled)["_traced"] = self._traced
        return scaled

    def with_gains(self, gains: Gains) -> ClosedLoop:
        """Return the loop with other gains than its controller's."""
        task, other = self.controller.task, copy.copy(self)
        other.diagonals = gains.diagonals(task.m, task.robot.nv)
        return other

    @property
    def setting(self) -> Setting:
        """Gains and damping, as the conditions need them."""
        (kp, kv, damping), learning = self.diagonals, self.controller.adaptation
        alpha = None if learning is None else learning.alpha
        B, saturation = damping + self.plants[0].friction, self.controller.saturation
        return Setting(kp, kv, B, saturation, alpha, self.controller.pinv.weight)

    def gravity_error(self, configurations: Array) -> float:
        """Return the largest gravity torque that is neither compensated nor learnt [N m or N]."""
        plants = self.plants[: len(self.corners) + _WEIGHED]
        k, N = len(plants), len(configurations)
        g = self.terms(np.repeat(np.arange(k), N), np.tile(configurations, (k, 1))).g
        return gravity_error(self.controller, plants, configurations, g.reshape(k, N, -1))

    @property
    def force_unit(self) -> str:
        """Unit of joint torques, "N m", "N", or both."""
        return joined(self.plants[0].robot.force_units)

    @property
    def integral_terms(self) -> list[str]:
        """Names of learnt parts that can absorb gravity that no parameters explain."""
        learning, parts = self.controller.adaptation, ("task force", "joint torques")
        sizes = (0, 0) if learning is None else learning.sizes[1:]
        return [part for part, size in zip(parts, sizes, strict=True) if size]

    def require_gravity(self) -> None:
        """Raise an InvalidInputError if gravity is neither exact nor learnable."""
        error = self.gravity_error(self.region.sample(5, np.random.default_rng(0)))
        if error > EXACT_GRAVITY:
            raise InvalidInputError(
                f"gravity must be compensated exactly or be learnt, got an error of {error:.3g} "
                f"{self.force_unit}; AdaptiveGravity learns it, but for wrong joint axes or a "
                "tilted base, and robots with_gravity((0, 0, 0)) take it as compensated",
                given=self.controller,
            )

    def singular_configuration(self, samples: Samples) -> Array | None:
        """Return a configuration (nq,) of the region where Ĵ loses rank, or None if none is found.

        Samples miss it, and no test holds there: Ĵᵀ K_p s = 0 for some s ≠ 0, so the arm may
        rest away from its target. Margins do not show it: they are relative to sym(K_pĴG).
        """
        task = self.controller.task
        q = least_regular(task, self.parts, samples)
        size = np.linalg.svd(task.jacobian(q), compute_uv=False)[-1]
        return q if size <= _VANISHING * vanishing(task) else None

    def damped_configuration(self, samples: Samples) -> Array | None:
        """Return a configuration (nq,) where the Ĵ⁺ of learning is damped, or None.

        V of learnt gravity has the law's own G = αĴ⁺, and the conditions assume an exact one.
        """
        if self.controller.adaptation is None:
            return None
        q = least_regular(self.controller.task, self.parts, samples)
        return q if self.controller.pinv.is_damped(self.controller.task.jacobian(q)) else None

    def draw(
        self, n: int, rng: np.random.Generator, inside: int = 0, uniform: bool = False
    ) -> Samples:
        """Draw n samples, or more so that every corner has as many.

        With `inside` ≥ 1, about half of them are of new true robots from inside the error box, each
        with this number of samples. Samples of one robot are not independent: use 1 to bound a
        share.

        A third of them have e = 0, a third small errors of all sizes, and a third errors between
        two configurations, at which a saturated s(e) is flat. If `uniform`, all are of the last
        kind, each with a robot of its own from inside: robot, configuration and target are drawn
        uniformly and independently.
        """
        truths, drawn = self._drawn(n, rng, 1 if uniform else inside, uniform)
        n = len(truths)
        kinds, sizes = (
            rng.integers(2 if uniform else 0, 3, size=n),
            10.0 ** rng.uniform(-_DECADES, 0.0, n),
        )
        away = np.choose(kinds, [np.zeros(n), sizes, np.ones(n)])  # as a share of the way
        if self.target is None:
            others = self.seen(truths, self.region.sample(n, rng), rng)
            ends = [
                self.parts[t].between(q, other, share)
                for t, q, other, share in zip(truths, drawn, others, away, strict=True)
            ]
            return self.samples_at(truths, drawn, self.terms(truths, np.array(ends)).x)
        known, model = self.attained(rng), self.region.robot.model
        for i, (t, share) in enumerate(zip(truths, away, strict=True)):
            end = known[t][rng.integers(len(known[t]))]
            nearer = np.array(pin.interpolate(model, end, drawn[i], share))
            if self.parts[t].contains(nearer):
                drawn[i] = nearer
        return self.samples_at(truths, drawn)

    def targets(self, n: int, rng: np.random.Generator) -> tuple[Indices, Array]:
        """Return true robots (N,) and configurations (N, nq) that attain the target, or n drawn."""
        if self.target is None:
            return self._drawn(n, rng)
        known = self.attained(rng)
        truths = np.repeat(np.arange(len(known)), [len(each) for each in known])
        return truths, np.concatenate(known)

    def terms(self, truths: Indices, configurations: Array, x_d: Array | None = None) -> Terms:
        """Return the terms of true robots (N,) at configurations (N, nq), of targets (N, n_x).

        By default they have the one target, or else the task's origin, whose errors mean nothing.
        """
        task = self.controller.task
        if x_d is None:
            target = task.origin if self.target is None else self.target
            x_d = np.tile(target, (len(truths), 1))
        if self._traced is not None:
            try:
                if new := self.plants[len(self._numbers) :]:
                    self._numbers = np.array([*self._numbers, *self._traced.numbers(new)])
                return self._traced.at(self._numbers[truths], configurations, x_d)
            except ValueError:  # of a robot from inside that differs in more than others
                self._traced = None
        rows = []
        for t, q, target in zip(truths.tolist(), configurations, x_d, strict=True):
            plant = self.plants[t]  # dynamics are large: kept at corners only
            dynamics = plant.dynamics if t < len(self.corners) else Dynamics(plant.robot)
            rows.append(vars(terms_alone(plant, dynamics, task, q, target)))
        return Terms(**{name: np.array([row[name] for row in rows]) for name in rows[0]})

    @cached_property
    def _traced(self) -> TracedTerms | None:
        return traced_terms(self.truth, self.controller.task)

    def samples_at(
        self, truths: Indices, configurations: Array, x_d: Array | None = None
    ) -> Samples:
        """Evaluate N true robots, configurations (N, nq) and targets (N, n_x), or the one target.

        Raises:
            InvalidInputError: A task whose Jacobian uses the measured x, or a configuration where
                Ĵ loses rank.
        """
        require_jacobian_of_q(self.controller.task, "the conditions over a region")
        if x_d is None:
            x_d = np.repeat(np.asarray(self.target)[None], len(configurations), axis=0)
        at = self.terms(truths, configurations, x_d)
        singular = _is_singular(at.J_hat)
        if singular.any():
            raise InvalidInputError(
                "the region must hold no configuration where the estimated Jacobian loses rank, "
                f"got q = {configurations[singular.argmax()].tolist()}; RegularPart(region, task, "
                "sigma_min) leaves them out",
                given=configurations,
            )
        return self._samples(at, truths, configurations, x_d)

    def _samples(self, at: Terms, truths: Indices, configurations: Array, x_d: Array) -> Samples:
        J_e, sensor, saturation = at.J, self.plants[0].sensor, self.controller.saturation
        if not sensor.subtracts:
            J_e = np.array([sensor.error_jacobian(*each) for each in zip(at.e, at.J, strict=True)])
        s, slope = saturation.s(at.e), saturation.ds(at.e)
        return Samples(
            **vars(at), truth=truths, q=configurations, x_d=x_d, J_e=J_e, s=s, slope=slope
        )

    # -- cases of a search, see `search.worst` ----------------------------------------------------

    def judged(self, values: Array, q: Array, ends: Array | None) -> tuple[Samples, Indices]:
        """Return samples of N cases, and which of them these are.

        Their true robots have values (N, d) of the uncertain numbers; the targets are those of
        configurations (N, nq), or the one target. Without `ends` each q is a target, which for the
        one target it is moved to. Left out are robots that cannot exist, configurations that are
        not in the region or not seen, and those where Ĵ loses rank.
        """
        other, which = self.of_values(values)
        kept = np.array([k >= 0 for k in which])
        moved = q
        if self.target is not None and ends is None:
            moved, there = other._attaining_by_steps(which, q)
            kept &= there
        kept &= np.array([self.region.contains(each) for each in moved])
        if self._has_camera:
            parts = [VisiblePart(self.region, plant.sensor) for plant in other.plants]
            for k in np.flatnonzero(kept):
                seen = (moved[k],) if ends is None or self.target is not None else (q[k], ends[k])
                kept[k] = all(sees(parts[which[k]].sensor, each) for each in seen)
        rows = np.flatnonzero(kept)
        if not len(rows):
            return self._empty, rows
        truths, moved = which[rows], moved[rows]
        x_d = None
        if self.target is None:
            x_d = other.terms(truths, moved if ends is None else ends[rows]).x
        at = other.terms(truths, moved, x_d)
        good = ~_is_singular(at.J_hat) & np.isfinite(at.e).all(axis=1)
        if x_d is None:
            x_d = np.repeat(np.asarray(self.target)[None], len(rows), axis=0)
        at = at.take(good)
        return other._samples(at, truths[good], moved[good], x_d[good]), rows[good]

    def keep(self, values: Array) -> Indices:
        """Keep true robots with values (N, d), and return their indices."""
        if not isinstance(self.truth, Uncertainty):
            return np.zeros(len(values), dtype=int)
        first, plants = len(self.plants), [*map(self.truth.plant, values)]
        parts = [VisiblePart(self.region, p.sensor, first + k) for k, p in enumerate(plants)]
        self.values = np.concatenate([self.values, values])
        self.plants, self.parts = [*self.plants, *plants], [*self.parts, *parts]
        return np.arange(first, len(self.plants))

    def growth(self, at: Samples, timing: Timing | None) -> Array:
        """Return the largest real part of an eigenvalue near each sample as a target [1/s]."""
        found = self.stabilities(at.q, at, timing)
        return np.array([each.max_real_eigenvalue for each in found])

    @cached_property
    def _empty(self) -> Samples:
        at = self.terms(np.zeros(1, dtype=int), self.region.robot.neutral()[None])
        return self._samples(at, np.zeros(1, dtype=int), at.x, at.x).take(slice(0))

    @cached_property
    def _has_camera(self) -> bool:
        sensor = self.plants[0].sensor
        is_own = not features(sensor) and type(sensor).visible is not Task.visible
        return is_own or image_feature(sensor) is not None

    def of_values(self, values: Array) -> tuple[ClosedLoop, Indices]:
        """Return this loop with the true robots of some values; and which is whose, −1 if none."""
        different, which = np.unique(values, axis=0, return_inverse=True)
        other, which = copy.copy(self), which.reshape(-1)
        other.corners, truth = different[:0], self.truth
        if not isinstance(truth, Uncertainty):
            return other, which
        if self._traced is not None and not self._has_camera:
            other.plants = self.plants[:1]
            try:
                other._numbers = self._traced.numbers_at(truth, different)
            except ValueError:  # of a robot that differs in more than others
                self._traced = None
            else:
                return other, which
        index, other.plants, other._numbers = np.full(len(different), -1), [], np.empty(0)
        for k, each in enumerate(different):
            try:
                other.plants = [*other.plants, truth.plant(each)]
            except InvalidInputError:  # a camera that cannot exist
                continue
            index[k] = len(other.plants) - 1
        return other, index[which]

    def _attaining_by_steps(self, truths: Indices, q: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return configurations (N, nq) near q at which x is the target, and which of them are."""
        robot, rows = self.region.robot, truths >= 0
        q = q.copy()
        for _ in range(_PROJECTED):
            at = self.terms(truths[rows], q[rows])
            with np.errstate(invalid="ignore"):
                step = np.full((len(q), robot.nv), np.nan)
                usable = np.isfinite(at.e).all(axis=1)
                step[np.flatnonzero(rows)[usable]] = -(
                    np.linalg.pinv(at.J[usable]) @ at.e[usable, :, None]
                )[..., 0]
            rows = rows & np.isfinite(step).all(axis=1)
            size = np.maximum(1.0, np.abs(step[rows]).max(axis=1, initial=0.0) / _LONGEST)
            q[rows] = [
                moved(robot, one, way)
                for one, way in zip(q[rows], step[rows] / size[:, None], strict=True)
            ]
        left = np.full(len(q), np.inf)
        at = self.terms(truths[rows], q[rows])
        left[rows] = np.linalg.norm(at.e, axis=1) / np.linalg.norm(at.J, axis=(1, 2))
        return q, left <= _ATTAINED

    def stabilities(
        self, configurations: Array, at: Terms, timing: Timing | None
    ) -> list[LocalStability]:
        """Linearise at N configurations, taken as targets, with their terms."""
        plant, law = self.plants[0], self.controller
        parts = linear_loops(law, plant.friction, configurations, at.M, at.dg, at.J, at.J_hat)
        parts = parts._replace(**self.diagonals._asdict())
        return stabilities(parts, float(np.linalg.norm(plant.robot.gravity)), timing)

    def attained(self, rng: np.random.Generator) -> list[list[Array]]:
        """Return configurations of the region that attain the target, for each true robot.

        Raises:
            UnattainedError: There is none for one of them.
        """
        for part in self.parts[len(self._attained) :]:
            self._attained = [*self._attained, self._attaining(part, rng)]
        return self._attained

    def _attaining(self, part: VisiblePart, rng: np.random.Generator) -> list[Array]:
        sensor, target = part.sensor, np.asarray(self.target)
        if part.truth >= len(self.corners):  # from near by: one is enough of many such robots
            known = self._attained[rng.integers(len(self.corners))]
            for k in rng.permutation(len(known)):
                q = known[k]
                end = inverse_kinematics(sensor, target, q) if sees(sensor, q) else None
                if end is not None and self.region.contains(end):
                    return [end]
        ends = [inverse_kinematics(sensor, target, q) for q in part.sample(_STARTS, rng)]
        attained = [q for q in ends if q is not None]
        within = [q for q in attained if self.region.contains(q)]
        if not within:
            wanted = "within reach of"
            why = f"no configuration of {sensor.robot.name} was found to attain"
            if attained:
                wanted = "attained by a configuration of the region for"
                why = f"{sensor.robot.name} attains outside {self.region!r} only"
            raise UnattainedError(
                f"target must be {wanted} every true robot, got {target.tolist()}, which {why}",
                given=target,
                truth=part.truth,
            )
        return within

    def _drawn(
        self, n: int, rng: np.random.Generator, inside: int = 0, uniform: bool = False
    ) -> tuple[Indices, Array]:
        """At least n true robots, the corners in turn, and configurations that they see."""
        k, first = len(self.corners), len(self.plants)
        at_corners = n // 2 * (not uniform) if inside and self.corners.shape[1] else n
        truths = np.arange(-(-at_corners // k) * k) % k
        if at_corners < n:
            others = np.arange(max(n - len(truths), n // 4, 1)) // inside
            assert isinstance(self.truth, Uncertainty)
            self.keep(np.array([self.truth.sample(rng) for _ in range(int(others[-1]) + 1)]))
            # no part of the samples, such as every second one, is to be of corners only
            truths = rng.permutation(np.append(truths, first + others))
        return truths, self.seen(truths, self.region.sample(len(truths), rng), rng)

    def seen(self, truths: Indices, drawn: Array, rng: np.random.Generator) -> Array:
        """Return the configurations, with those replaced that their robot's sensor does not see."""
        pairs = zip(truths.tolist(), drawn, strict=True)
        for t in dict.fromkeys(t for t, q in pairs if not sees(self.parts[t].sensor, q)):
            drawn[truths == t] = self.parts[t].replace_unseen(drawn[truths == t], rng)
        return drawn


def _is_singular(J_hat: Array) -> NDArray[np.bool_]:
    values = np.linalg.svd(J_hat, compute_uv=False)
    return np.asarray(values[:, -1] <= _SINGULAR * values[:, 0])


def usual_region(task: Task) -> RegularPart:
    """Return the default region: the joint limits without near-singular configurations."""
    return RegularPart(JointBox(task.robot), task, _REGULAR * vanishing(task))
