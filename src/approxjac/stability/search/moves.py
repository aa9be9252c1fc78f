"""`Moves`: how fast a target may move along a line, and how far e and the joints get.

The tube of `certificates.moves` is sought by trial; its constants by a search over true robots,
places along the path, joints within R and errors within ē.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from approxjac import law
from approxjac.controllers.gains.gains import Latency
from approxjac.errors import InvalidInputError
from approxjac.law import moves
from approxjac.robots import Robot
from approxjac.robots.traced import moved, positions_at
from approxjac.stability.certificates.matrix_form import Hold, Weights, best_weights
from approxjac.stability.certificates.moves import Line, MovingForm, Tube, damping_of, largest
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.samples import Indices, Samples
from approxjac.stability.search.worst import climb
from approxjac.validation import Array, as_array, as_number

if TYPE_CHECKING:
    from approxjac.stability.studied_loop import StudiedLoop

_NODES = 4  # steps of Runge and Kutta along a path
_NEWTON = 2  # to a given error
_SAMPLES, _WORST = 600, 150  # of a tube; of these, that functions are chosen on
_RATES = (0.5, 0.8, 1.2, 1.7, 2.4, 3.3, 4.5)  # ρ that are tried [1/s]
_MULTIPLES = (0.6, 1.0, 1.6)  # of the multiplier that is best for the margin
_WIDER = 1.08  # times what the formulas return, that is tried next
_TUBES, _ROUNDS = 12, 6  # until the answer is inside; searches, until one finds nothing
_STARTS, _STEPS = 3, 5  # of a search for each group of constants
_FIRST = 0.05  # rad, and share of the length, of the first tube
_MOST_R, _MOST_E = 1.0, 0.3  # rad, and share of the length, that are no answer any more
_SHORTEST = 1.5  # s, of a move as fast as any that is tried
_SLOWER, _SPEEDS = 0.85, 16  # from one to the next
_USUAL = 0.2  # m


class TubeBox:
    """Cases around the paths of all robots: true robot, place, joints within R and e within ē.

    A case is a point of [−1, 1]ᵏ.
    """

    def __init__(self, loop: ClosedLoop, line: Line, q0: Array, tube: Tube) -> None:
        self._loop, self.line, self._q0, self.tube = loop, line, q0, tube
        self.d, self._n, self._m = loop.corners.shape[1], len(tube.R), len(line.d)
        self.size = self.d + 1 + self._n + self._m

    def samples(self, z: Array) -> tuple[Samples, Indices]:
        """Return the samples of points (N, k), and which of them they are: robots may not exist."""
        loop, robot, d = self._loop, self._loop.region.robot, self.d
        values = np.zeros((len(z), d))
        if isinstance(loop.truth, Uncertainty) and d:
            values = loop.truth.at(z[:, :d])
        different, first, which = np.unique(values, axis=0, return_index=True, return_inverse=True)
        other, truths = loop.of_values(values)
        first, which = first[truths[first] >= 0], which.reshape(-1)
        path, x0 = _path(other, truths[first], self._q0, self.line)
        rows = np.flatnonzero(truths >= 0)
        place = np.full(len(different), -1)
        place[which[first]] = np.arange(len(first))
        share, own = 0.5 * (z[rows, d] + 1.0), place[which[rows]]
        e = self.tube.e * z[rows, d + 1 + self._n :]
        e = e / np.maximum(1.0, np.linalg.norm(z[rows, d + 1 + self._n :], axis=1))[:, None]
        x_d = x0[own] + share[:, None] * self.line.length * self.line.d
        motion = _between(path[:, own], share) + self.tube.R * z[rows, d + 1 : d + 1 + self._n]
        B, friction = damping_of(loop.setting), loop.plants[0].friction
        for _ in range(_NEWTON):  # to this error, along the way of slow robots
            at = other.terms(truths[rows], _moved(robot, self._q0, motion), x_d)
            H = moves.path_rate(at.J, at.J_hat, self.line.d, B, friction)[1]
            motion = motion - (H @ (at.e - e)[..., None])[..., 0]
        return other.samples_at(truths[rows], _moved(robot, self._q0, motion), x_d), rows

    def starts(self, n: int, rng: np.random.Generator) -> Array:
        """Draw n points: corners of all, corners of the robots alone, and inside, in turn."""
        z = rng.uniform(-1.0, 1.0, (n, self.size))
        z[::3], z[1::3, : self.d] = np.sign(z[::3]), np.sign(z[1::3, : self.d])
        z[:, self.d] = rng.uniform(-1.0, 1.0, n)  # and everywhere along the path
        return z


def _path(
    loop: ClosedLoop, truths: Indices, q0: Array, line: Line
) -> tuple[Array, Array]:
    """Return motions and their rates along the paths of slow robots, (nodes, k, 2 n_v), and x₀."""
    B, friction, robot = damping_of(loop.setting), loop.plants[0].friction, loop.region.robot
    step = line.length / _NODES

    def rate(motion: Array) -> tuple[Array, Array]:
        at = loop.terms(truths, _moved(robot, q0, motion))
        return moves.path_rate(at.J, at.J_hat, line.d, B, friction)[0], at.x

    here = np.zeros((len(truths), robot.nv))
    nodes, x0 = [], None
    for k in range(_NODES + 1):
        first, x = rate(here)
        x0 = x if x0 is None else x0
        nodes.append(np.concatenate([here, line.length * first], axis=1))
        if k < _NODES:
            second, _ = rate(here + 0.5 * step * first)
            third, _ = rate(here + 0.5 * step * second)
            fourth, _ = rate(here + step * third)
            here = here + step / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
    assert x0 is not None
    return np.array(nodes), x0


def _between(path: Array, share: Array) -> Array:
    """Return motions (N, n_v) at shares (N,) of paths (nodes, N, 2 n_v), by cubics."""
    n, k = path.shape[-1] // 2, np.minimum((share * _NODES).astype(int), _NODES - 1)
    t, all_ = (share * _NODES - k)[:, None], np.arange(len(share))
    (a, va), (b, vb) = (np.split(path[i, all_], [n], axis=1) for i in (k, k + 1))
    va, vb = va / _NODES, vb / _NODES
    return np.asarray(
        a + t * (va + t * (3.0 * (b - a) - 2.0 * va - vb + t * (2.0 * (a - b) + va + vb)))
    )


def _moved(robot: Robot, q0: Array, motions: Array) -> Array:
    if robot.nq == robot.nv:
        return np.asarray(q0 + motions)
    return np.array([moved(robot, q0, each) for each in motions])


class Function(NamedTuple):
    """A Lyapunov function that dies out with a rate ρ [1/s]."""

    weights: Weights
    rate: float


class Found(NamedTuple):
    """A tube that holds all robots, and what it was found with."""

    tube: Tube  # what the formulas return
    function: Function
    hard: Array  # points of its box that a search found, shape (s, k)


class MoveSearch:
    """The search for a tube, and for the largest speed, of moves from one configuration."""

    def __init__(self, loop: ClosedLoop, period: float, q0: Array, rng: np.random.Generator) -> None:
        self._loop, self._hold, self._q0, self._rng = loop, Hold.of(Latency(period)), q0, rng
        self._friction = loop.plants[0].friction

    def certified(self, line: Line, searched: bool, known: Found | None = None) -> Found | None:
        """Return a tube for a line, or None if there is none.

        Constants are those of samples, and if `searched` of the worst that a search finds.
        `known` is what another speed had, to begin with.
        """
        n = self._loop.region.robot.nv
        e = 0.1 * _FIRST * line.length
        kp = float(np.max(self._loop.setting.kp))
        tube = Tube(np.full(n, _FIRST), e, math.sqrt(kp) * e)
        function, hard = None, np.empty((0, TubeBox(self._loop, line, self._q0, tube).size))
        if known is not None:
            tube, function, hard = _wider(known.tube), known.function, known.hard
        searches = 0
        for _ in range(_TUBES):
            box = TubeBox(self._loop, line, self._q0, tube)
            z = np.concatenate([hard, box.starts(_SAMPLES, self._rng)])
            form = self._form(box, z)
            if form is None:
                return None
            answer = None if function is None else self._answer(form, function, tube)
            if answer is None:
                function, answer = self._function(form, tube)
            if answer is None or answer.R.max() > _MOST_R or answer.e > _MOST_E * line.length:
                return None
            assert function is not None
            if not tube.holds(answer):
                tube = _wider(answer)
                continue
            if not searched:
                return Found(answer, function, hard)
            searches += 1
            found = self._worst(box, form, function, tube, z)
            worse = self._form(box, np.concatenate([z, found]))
            if worse is None:
                return None
            answer = self._answer(worse, function, tube)
            hard = np.concatenate([hard, found])
            if answer is not None and tube.holds(answer):
                return Found(answer, function, hard)
            if searches == _ROUNDS:
                return None
            if answer is None:
                function = None
            else:
                tube = _wider(answer)
        return None

    def fastest(self, line: Line, known: Found | None) -> tuple[float, Found | None]:
        """Return the largest speed that is certified, up to that of `line`, and its tube."""
        speeds = [line.peak * _SLOWER**k for k in range(_SPEEDS)]
        low, high, best = 0, len(speeds), known
        while low < high:  # the fastest that samples allow
            middle = (low + high) // 2
            found = self.certified(line._replace(peak=speeds[middle]), False, best)
            if found is None and best is not None:
                found = self.certified(line._replace(peak=speeds[middle]), False)
            low, high = (low, middle) if found else (middle + 1, high)
            best = found or best
        for speed in speeds[low:]:
            found = self.certified(line._replace(peak=speed), True, best)
            if found is not None:
                return speed, found
        return 0.0, None

    def _form(self, box: TubeBox, z: Array) -> MovingForm | None:
        """Return the form at points; None where Ĵ is damped, or a joint may reach its limit."""
        try:
            samples, _ = box.samples(z)
        except InvalidInputError:  # Ĵ loses rank
            return None
        if not self._is_usual(samples).all():
            return None
        loop, tube = self._loop, box.tube
        return MovingForm(samples, loop.setting, self._friction, self._hold, box.line, tube.nu)

    def _is_usual(self, samples: Samples) -> NDArray[np.bool_]:
        robot, controller = self._loop.region.robot, self._loop.controller
        low, high = robot.position_limits
        squares = np.linalg.svd(samples.J_hat, compute_uv=False) ** 2
        ratio, scale, _ = controller.pinv.singularity
        damped = law.gram_damping(squares[:, -1], squares[:, 0], ratio, scale) > 0.0
        ways = samples.J @ (samples.J_hat.mT / damping_of(self._loop.setting)[:, None])
        at = np.array([positions_at(robot, q) for q in samples.q])
        inside = ((at >= low) & (at <= high)).all(axis=1)
        return np.asarray(~damped & (np.linalg.det(ways) > 0.0) & inside)

    def _with(self, form: MovingForm, rate: float, tube: Tube) -> MovingForm:
        errors = np.linspace(0.0, tube.e, 50)[1:, None] * np.ones(len(form.setting.kp))
        saturation = form.setting.saturation
        ratio = float((saturation.S(errors) / saturation.s(errors) ** 2).max())
        return form.changed(decay=(rate, ratio))

    def _answer(self, form: MovingForm, function: Function, tube: Tube) -> Tube | None:
        form = self._with(form, function.rate, tube)
        if not form.is_possible():
            return None
        return form.bounds(function.weights, tube, largest(form.weighed(function.weights)))

    def _function(self, form: MovingForm, tube: Tube) -> tuple[Function | None, Tube | None]:
        """Choose the function whose answer is smallest."""
        best: tuple[float, Function | None, Tube | None] = math.inf, None, None
        for rate in _RATES:
            faster = self._with(form, rate, tube)
            if not faster.is_possible():
                break
            weights = best_weights(faster.take(slice(0, _WORST)), "free").weights
            for multiple in _MULTIPLES if (weights.w > 0.0).all() else ():
                scaled = weights._replace(multiplier=multiple * weights.multiplier)
                function = Function(scaled, rate)
                answer = self._answer(form, function, tube)
                if answer is not None:
                    size = float(answer.R.max()) + answer.e / (_FIRST * form.line.length)
                    best = min(best, (size, function, answer), key=lambda each: each[0])
        return best[1:]

    def _worst(
        self, box: TubeBox, form: MovingForm, function: Function, tube: Tube, z: Array
    ) -> Array:
        """Search for the points where groups of constants are largest; return them (s, k)."""
        form, weights = self._with(form, function.rate, tube), function.weights
        weighed = largest(form.weighed(weights))
        on = form.along(weights, tube, form.most | weighed)
        assert on is not None
        most, peak, first = form.most | weighed, form.line.peak, self._rng.permutation(len(z))
        scale = form.drift(on, most)

        def scores(points: Array) -> dict[str, Array]:
            samples, rows = box.samples(points)
            scored: dict[str, Array] = {}
            if not len(rows):
                return scored
            here = form.elsewhere(samples)
            own = here.sizes() | here.weighed(weights)
            scored = {name: own[name] for name in ("margin", "flat", "sigma", "r", "turning")}
            scored |= {name: here.constant(name) for name in ("curvature", "damping", "fastest")}
            for k in ("f", "psi"):
                scored[k] = peak**2 * own[f"{k}0"] + peak * own[f"{k}2"]
            scored["f"] = scored["f"] + peak * own["delta"]
            scored["eta"] = (own["eta"] / most["eta"]).max(axis=-1)
            scored["drift"] = (here.drift(on, own) / scale).max(axis=-1)
            scored["dh"] = ((own["dh"] @ tube.R) / (most["dh"] @ tube.R)).max(axis=-1)
            usual = self._is_usual(samples)
            whole = {}
            for name, values in scored.items():
                whole[name] = np.full(len(points), -np.inf)
                whole[name][rows] = np.where(usual, values, np.inf)
            return whole

        known, found = scores(z), []
        for name, values in known.items():
            starts = [z[np.argsort(-values)[: _STARTS - 1]], z[first[:1]]]
            first = np.roll(first, -1)
            score = partial(_only, scores, name)
            found.append(climb(score, np.concatenate(starts), _STEPS)[0])
        return np.concatenate(found)


def _only(scores: Callable[[Array], dict[str, Array]], name: str, z: Array) -> Array:
    return scores(z)[name]


def _wider(tube: Tube) -> Tube:
    return Tube(_WIDER * tube.R, _WIDER * tube.e, _WIDER * tube.nu)
