"""`Moves`: how fast a target may move along a line, and how far e and the joints get.

The tube of `certificates.moves` is sought by trial; its constants by a search over true robots,
places along the path, joints within R and errors within ē.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from approxjac import law
from approxjac.controllers.gains.gains import Latency
from approxjac.errors import InvalidInputError
from approxjac.formatting import joined
from approxjac.law import moves
from approxjac.robots import Robot
from approxjac.robots.traced import moved, positions_at
from approxjac.stability.certificates.matrix_form import Hold, Weights, best_weights
from approxjac.stability.certificates.moves import (
    EasedLine,
    MovingForm,
    Tube,
    damping_of,
    largest,
    largest_ratio,
)
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.samples import Indices, Samples
from approxjac.stability.report.move_bounds import Move, Moves
from approxjac.stability.search.worst import climb
from approxjac.validation import Array, as_array, as_number

_NODES = 4  # steps of Runge and Kutta along a path
_NEWTON = 2  # to a given error
_SAMPLES, _SOME, _WORST = 600, 200, 100  # of a tube; of these, that functions are chosen on
_RATES = (0.7, 1.2, 1.7, 2.1, 2.5, 3.0)  # ρ that are tried [1/s]
_MULTIPLES = (0.7, 1.0)  # of the multiplier that is best for the margin
_EVERY = 5  # of samples, that are looked at half way from the path, too
_WIDER = 1.08  # times what the formulas return, that is tried next
_TUBES, _ROUNDS = 12, 6  # until the answer is inside; searches, until one finds nothing
_STARTS, _STEPS = 3, 5  # of a search for each group of constants
_OF_FUNCTION = ("margin", "flat", "sigma", "eta")
_OF_LOOP = ("curvature", "damping", "fastest")
_OF_MOTION = ("r", "turning", "f", "psi", "drift", "dh")
_FIRST = 0.05  # rad s: R of the first tube, for a speed of one length a second
_MOST_R, _MOST_E = 1.0, 0.3  # rad, and share of the length, that are no answer any more
_SHORTEST = 1.5  # s, of a move as fast as any that is tried
_SLOWER, _SPEEDS = 0.85, 16  # from one to the next
_TRIED = 6  # with a search, from the fastest that samples allow
_USUAL, _HALF = 0.2, 0.5  # m; c̄


def certified_moves(
    loop: ClosedLoop,
    latency: Latency,
    seed: int,
    displacements: Sequence[Sequence[float]] | Array | None,
    start: Sequence[float] | Array | None,
    speed: float | None,
) -> Moves:
    """Find what `Study.moves` returns.

    Raises:
        InvalidInputError: The errors of `Study.moves`.
    """
    _require_covered(loop, latency)
    task, robot = loop.controller.task, loop.region.robot
    if displacements is None:
        if set(task.units) != {"m"}:
            raise InvalidInputError(
                f"displacements must be given for a task in {joined(task.units)}, such as "
                f"[{', '.join(['1.0'] + ['0.0'] * (task.m - 1))}]",
                given=displacements,
            )
        displacements = _USUAL * np.concatenate([np.eye(task.m), -np.eye(task.m)])
    ways = as_array("displacements", np.atleast_2d(displacements), ("k", task.m))
    lengths = np.linalg.norm(ways, axis=1)
    if not (lengths > 0.0).all():
        raise InvalidInputError("displacements must not be zero", given=displacements)
    q0 = loop.region.box.center if start is None else robot.configuration(start, "start")
    if speed is not None:
        speed = as_number("speed", speed, above=0.0)
    found: list[Move] = []
    for way, length in zip(ways, lengths.tolist(), strict=True):
        search = MoveSearch(loop, latency.period, q0, np.random.default_rng([seed, len(found)]))
        line = EasedLine(way / length, length, speed or 1.875 * length / _SHORTEST)
        fast, tube = (
            search.fastest(line) if speed is None else (speed, search.certified(line, True))
        )
        most, rate, reason = Tube(np.full(robot.nv, math.inf), math.inf, 0.0), 0.0, search.reason
        if tube is None:
            fast, duration = 0.0, math.inf
        else:
            most, rate, reason = tube.tube, tube.function.rate, ""
            duration = line._replace(peak=fast).duration
        units = task.units, tuple(robot.joint_units)
        found.append(Move(way, fast, duration, most.e, most.R, rate, reason, task.labels, units))
    return Moves(q0, tuple(found))


def _require_covered(loop: ClosedLoop, latency: Latency) -> None:
    """Require what the theorem covers."""
    controller, sensor, setting = loop.controller, loop.plants[0].sensor, loop.setting
    task, B = controller.task, setting.B
    is_vector = sensor.subtracts and task.n_x == task.m and task.measured is task
    of_moves, period = "for certified moves", latency.period
    for is_covered, wanted, given in (
        (
            controller.adaptation is None,
            f"gravity must be known {of_moves}, by ModelGravity(robot), or by NoGravity(robot) "
            "for an arm that compensates it",
            controller,
        ),
        (
            latency == Latency(period),
            f"latency must have no more than a period {of_moves}, such as Latency({period:g})",
            latency,
        ),
        (
            is_vector and not task.uses_x,
            f"task must have errors x - x_d and a Jacobian of q {of_moves}, such as PositionTask",
            task,
        ),
        (
            task.m == task.robot.nv or (B > 0.0).all(),
            f"damping must be > 0 in all joints of a redundant arm {of_moves}, or their friction",
            B.tolist(),
        ),
        (
            setting.saturation.c_bar == _HALF,
            f"saturation must have c_bar = 0.5 {of_moves}, as Linear, Tanh and Sine",
            setting.saturation,
        ),
    ):
        if not is_covered:
            raise InvalidInputError(f"{wanted}, got {given!r}", given=given)
    loop.require_gravity()


class TubeBox:
    """Cases around the paths of all robots: true robot, place, joints within R and e within ē.

    A case is a point of [−1, 1]ᵏ.
    """

    def __init__(self, loop: ClosedLoop, line: EasedLine, q0: Array, tube: Tube) -> None:
        self._loop, self.line, self._q0, self.tube = loop, line, q0, tube
        self.d, self._n, self._m = loop.corners.shape[1], len(tube.R), len(line.d)
        self.size = self.d + 1 + self._n + self._m

    def samples(self, z: Array, part: float = 1.0) -> tuple[Samples, Indices]:
        """Return the samples of points (N, k), and which of them they are: robots may not exist.

        Or those on the straight lines to them from the path, after a part of the way.
        """
        loop, robot, d = self._loop, self._loop.region.robot, self.d
        values = np.zeros((len(z), d))
        if isinstance(loop.truth, Uncertainty) and d:
            values = loop.truth.at(z[:, :d])
        different, first, which = np.unique(values, axis=0, return_index=True, return_inverse=True)
        other, truths = loop.of_values(values)
        first, which = first[truths[first] >= 0], which.reshape(-1)
        path, x0 = slow_path(other, truths[first], self._q0, self.line)
        rows = np.flatnonzero(truths >= 0)
        place = np.full(len(different), -1)
        place[which[first]] = np.arange(len(first))
        share, own = 0.5 * (z[rows, d] + 1.0), place[which[rows]]
        e = self.tube.e * z[rows, d + 1 + self._n :]
        e = e / np.maximum(1.0, np.linalg.norm(z[rows, d + 1 + self._n :], axis=1))[:, None]
        x_d = x0[own] + share[:, None] * self.line.length * self.line.d
        place = between(path[:, own], share)
        motion = place + self.tube.R * z[rows, d + 1 : d + 1 + self._n]
        B, friction = damping_of(loop.setting), loop.plants[0].friction
        for _ in range(_NEWTON):  # to this error, along the way of slow robots
            at = other.terms(truths[rows], _moved(robot, self._q0, motion), x_d)
            H = moves.path_rate(at.J, at.J_hat, self.line.d, B, friction)[1]
            motion = motion - (H @ (at.e - e)[..., None])[..., 0]
        motion = place + part * (motion - place)
        return other.samples_at(truths[rows], _moved(robot, self._q0, motion), x_d), rows

    def starts(self, n: int, rng: np.random.Generator) -> Array:
        """Draw n points: corners of all, corners of the robots alone, and inside, in turn."""
        z = rng.uniform(-1.0, 1.0, (n, self.size))
        z[::3], z[1::3, : self.d] = np.sign(z[::3]), np.sign(z[1::3, : self.d])
        z[:, self.d] = rng.uniform(-1.0, 1.0, n)  # and everywhere along the path
        return z


def slow_path(loop: ClosedLoop, truths: Indices, q0: Array, line: EasedLine) -> tuple[Array, Array]:
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


def between(path: Array, share: Array) -> Array:
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


class Refused(Exception):
    """No tube was found, with the reason."""


class Function(NamedTuple):
    """A Lyapunov function that dies out with a rate ρ [1/s]."""

    weights: Weights
    rate: float


class Found(NamedTuple):
    """A tube that holds all robots, and what it was found with."""

    tube: Tube  # what the formulas return, with `_WIDER` to spare for what a search missed
    function: Function
    hard: Array  # points of its box that a search found, shape (s, k)


class MoveSearch:
    """The search for a tube, and for the largest speed, of moves from one configuration."""

    def __init__(
        self, loop: ClosedLoop, period: float, q0: Array, rng: np.random.Generator
    ) -> None:
        self._loop, self._hold, self._q0, self._rng = loop, Hold.of(Latency(period)), q0, rng
        self._friction = loop.plants[0].friction
        self.reason = ""  # why the last line was refused

    def certified(
        self, line: EasedLine, searched: bool, known: Found | None = None
    ) -> Found | None:
        """Return a tube for a line, or None if there is none.

        Constants are those of samples, and if `searched` of the worst that a search finds.
        `known` is what another speed had, to begin with.
        """
        try:
            return self._tube(line, searched, known)
        except Refused as refused:
            self.reason = str(refused)
            return None

    def _tube(self, line: EasedLine, searched: bool, known: Found | None) -> Found:
        n = self._loop.region.robot.nv
        first = _FIRST * line.peak / line.length
        e = 0.1 * first * line.length
        kp = float(np.max(self._loop.setting.kp))
        tube = Tube(np.full(n, first), e, math.sqrt(kp) * e)
        function, hint = None, None
        hard = np.empty((0, TubeBox(self._loop, line, self._q0, tube).size))
        if known is not None:
            tube, function, hard = known
        searches = 0
        for _ in range(_TUBES):
            box = TubeBox(self._loop, line, self._q0, tube)
            z = np.concatenate([hard, box.starts(_SAMPLES, self._rng)])
            form = self._form(box, z)
            answer = None if function is None else self._answer(form, function, tube)
            if answer is None:
                function, answer = self._function(form, tube, function or hint)
            if answer is None:
                raise Refused("as no function was found that is positive on the way")
            if answer.R.max() > _MOST_R or answer.e > _MOST_E * line.length:
                raise Refused("as the bounds grow without end")
            assert function is not None
            if not tube.holds(answer):
                tube = _wider(answer)
                continue
            if not searched:
                return Found(_spared(answer, tube), function, hard)
            searches += 1
            found = self._worst(box, form, function, tube, z)
            worse = self._form(box, np.concatenate([z, found]))
            answer = self._answer(worse, function, tube)
            hard = np.concatenate([hard, found])
            if answer is not None and tube.holds(answer):
                return Found(_spared(answer, tube), function, hard)
            if searches == _ROUNDS:
                raise Refused("as the search found ever worse cases")
            if answer is None:
                function, hint = None, function
            else:
                tube = _wider(answer)
        raise Refused("as the bounds grow without end")

    def fastest(self, line: EasedLine, known: Found | None = None) -> tuple[float, Found | None]:
        """Return the largest speed that is certified, up to that of `line`, and its tube."""
        speeds = [line.peak * _SLOWER**k for k in range(_SPEEDS)]
        low, high, best = 0, len(speeds), known
        while low < high:  # the fastest that samples allow
            middle = (low + high) // 2
            found = self.certified(line._replace(peak=speeds[middle]), False, best)
            low, high = (low, middle) if found else (middle + 1, high)
            best = found or best
        for speed in speeds[low : low + _TRIED]:
            found = self.certified(line._replace(peak=speed), True, best)
            if found is not None:
                return speed, found
        return 0.0, None

    def _form(self, box: TubeBox, z: Array) -> MovingForm:
        """Return the form at points."""
        try:
            samples, halfway = box.samples(z)[0], box.samples(z[::_EVERY], 0.5)[0]
        except InvalidInputError as error:
            raise Refused("as the estimated Jacobian loses rank on the way") from error
        regular, inside = self._usual(samples.join(halfway))
        if not regular.all():
            raise Refused("as some robot may come near a singular pose")
        if not inside.all():
            raise Refused("as bounds of a joint reach its limit")
        loop, tube = self._loop, box.tube
        form = MovingForm(samples, loop.setting, self._friction, self._hold, box.line, tube.nu)
        # the lines that ∂h is a mean along leave |e| ≤ ē, if little
        between = largest(form.elsewhere(halfway).sizes())
        form.most |= {name: np.maximum(form.most[name], between[name]) for name in ("dh", "along")}
        return form

    def _usual(self, samples: Samples) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return masks: Ĵ and JB⁻¹Ĵᵀ are regular; joints are inside their limits."""
        robot, controller = self._loop.region.robot, self._loop.controller
        low, high = robot.position_limits
        squares: Any = np.linalg.svd(samples.J_hat, compute_uv=False) ** 2
        ratio, scale, _ = controller.pinv.singularity
        damped = law.gram_damping(squares[:, -1], squares[:, 0], ratio, scale) > 0.0
        ways = samples.J @ (samples.J_hat.mT / damping_of(self._loop.setting)[:, None])
        at = np.array([positions_at(robot, q) for q in samples.q])
        inside = ((at >= low) & (at <= high)).all(axis=1)
        return np.asarray(~damped & (np.linalg.det(ways) > 0.0)), np.asarray(inside)

    def _with(self, form: MovingForm, rate: float, tube: Tube) -> MovingForm:
        of = np.full(len(form.setting.kp), tube.e)
        return form.changed(decay=(rate, largest_ratio(form.setting.saturation, of)))

    def _answer(self, form: MovingForm, function: Function, tube: Tube) -> Tube | None:
        form = self._with(form, function.rate, tube)
        if not form.is_possible():
            return None
        return form.bounds(function.weights, tube, largest(form.weighed(function.weights)))

    def _function(
        self, form: MovingForm, tube: Tube, hint: Function | None
    ) -> tuple[Function | None, Tube | None]:
        """Choose the function whose answer is smallest, of about the rate of a hint."""
        best: tuple[float, Function | None] = math.inf, None
        rates: tuple[float, ...] = _RATES
        if hint is not None:
            k = _RATES.index(hint.rate)
            rates = _RATES[max(k - 1, 0) : k + 2]
        some = form.take(slice(0, _SOME))
        for rate in rates:
            faster = self._with(some, rate, tube)
            if not faster.is_possible():
                if rate == _RATES[0]:
                    raise Refused("as the period is too long for the damping of light joints")
                break
            weights = best_weights(faster.take(slice(0, _WORST)), "free").weights
            for multiple in _MULTIPLES if (weights.w > 0.0).all() else ():
                scaled = weights._replace(multiplier=multiple * weights.multiplier)
                function = Function(scaled, rate)
                answer = self._answer(some, function, tube)
                if answer is not None:
                    size = float(answer.R.max()) + answer.e / (_USUAL * form.line.length)
                    best = min(best, (size, function), key=lambda each: each[0])
        function_ = best[1]
        return function_, None if function_ is None else self._answer(form, function_, tube)

    def _worst(
        self, box: TubeBox, form: MovingForm, function: Function, tube: Tube, z: Array
    ) -> Array:
        """Search for the points where groups of constants are largest; return them (s, k)."""
        form, weights = self._with(form, function.rate, tube), function.weights
        weighed = largest(form.weighed(weights))
        on = form.along(weights, tube, form.most | weighed)
        assert on is not None
        line, most, first = form.line, form.most | weighed, self._rng.permutation(len(z))
        scale, usual_a = form.drift(on, most), 3.0 * line.peak / line.duration

        def values(here: MovingForm, name: str) -> Array:
            """Return a group's size in each sample of a form."""
            if name in _OF_LOOP:
                return here.constant(name)
            own = here.weighed(weights) if name in _OF_FUNCTION else here.sizes()
            if name == "eta":
                return np.asarray((own["eta"] / most["eta"]).max(axis=-1))
            if name == "drift":
                return np.asarray((here.drift(on, most | own) / scale).max(axis=-1))
            if name == "dh":
                return np.asarray(((own["dh"] @ tube.R) / (most["dh"] @ tube.R)).max(axis=-1))
            if name not in ("f", "psi"):
                return own[name]
            size = line.peak**2 * own[f"{name}0"] + usual_a * own[f"{name}1"]
            size = size + line.peak * own[f"{name}2"]
            if name == "f":
                size = size + line.peak * np.sqrt((here.motion.delta**2) @ weights.w)
            return np.asarray(size)

        def score(name: str, points: Array) -> Array:
            whole = np.full(len(points), -np.inf)
            samples, rows = box.samples(points)
            if len(rows):
                usual = np.logical_and(*self._usual(samples))
                whole[rows] = np.where(usual, values(form.elsewhere(samples), name), np.inf)
            return whole

        found, some = [], form.take(slice(0, _SOME))
        for name in (*_OF_FUNCTION, *_OF_LOOP, *_OF_MOTION):
            worst = np.argsort(-values(some, name))[: _STARTS - 1]
            starts = np.concatenate([z[worst], z[first[:1]]])
            first = np.roll(first, -1)
            found.append(climb(partial(score, name), starts, _STEPS)[0])
        return np.concatenate(found)


def _wider(tube: Tube) -> Tube:
    return Tube(_WIDER * tube.R, _WIDER * tube.e, _WIDER * tube.nu)


def _spared(answer: Tube, tube: Tube) -> Tube:
    spare = _wider(answer)
    return Tube(np.minimum(spare.R, tube.R), min(spare.e, tube.e), min(spare.nu, tube.nu))
