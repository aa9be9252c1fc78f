"""The guard of a step: which samples a motion explains, and what takes the place of the others.

Not of the paper, whose measurements are all good. Numbers are floats, or symbols of `codegen`: for
vectors as short as these, loops over floats take a fifth of the time of NumPy.
"""

from __future__ import annotations

import math
from functools import reduce
from itertools import chain, pairwise
from operator import and_
from typing import Any, NamedTuple

import numpy as np

from approxjac.law.branches import all_finite, array, complement, select
from approxjac.law.products import length, root
from approxjac.validation import Array

UNSEEN = -1e20  # [s], the time before a first sample
_FAR = 1e15  # a motion of x before it was first seen
_TURNED = 1e6  # rad or m, the largest sum of the first q
_SOON, _MISSED = 0.2, 2.5  # of a period at least and at most pass from sample to sample
_GAPS, _GAP = 20.0, 0.05  # periods or seconds that may be missing, if the clock then runs on
_STILL = 1e-3  # rad/s or m/s, below which a joint may have the same q and q̇ again
_IMPACT = 0.004  # s, in which an arm that hits something may lose its speed
_WILD = 5.0  # times the largest change of q̇ that makes sense, by which none rises
_FINER = 0.92  # at each change of q: what is left of its noise, as it comes to be known
_STEP, _FINEST = 0.3, 1.0 / 512.0  # of a step of q, and of the largest noise: the least
_LEFT, _TURNS = 0.04, 0.1  # q̇ that changed its sign: what is left of ‖q̇‖², at such a speed
_STRAIGHT = (_TURNS * (2.0 - math.sqrt(_LEFT))) ** 2  # ‖Δq̇‖² up to which it has not
_MEMORY = 0.05  # s, over which q is compared with the integral of q̇
_SHARE = 0.2  # of the way, by which that may be off
_ADDS = 0.25  # of what it may be off, by which one sample counts at most
_FADES = 0.02  # s, in which a torque that was sent acts at last
_SETTLES, _USUAL, _RARE = 0.05, 3.0, 1.0 / 128.0  # s, in which it shows what |q̈| is usual
_KEPT, _TIMES = 0.75, 2.0  # of the motion of x at each new one; by which times it x may move
_BLIND = 0.25  # s, after which an x that is refused again and again ends in a stop
_AHEAD = 0.01  # s, and a period: by which x may be stamped later than the state it comes with
_OLDEST = 1e15  # s

GOOD, UNKNOWN, POSITION, VELOCITY, DISAGREES, REPEATED, CLOCK, SENSOR = range(8)
"""What may be wrong with a sample, in the order of the statuses that tell of it."""


class GuardBounds(NamedTuple):
    """By how much samples may differ from what is expected; lists have an entry for each joint."""

    q: list[float]  # error of a change of q [rad or m]
    lag: float  # of q̇ [s]
    fastest: list[float]  # largest change of q̇ that makes sense at all [rad/s or m/s]
    push: Array  # |q̈| that loads, pushes and what is not modelled may cause at most, (n_v,)
    x: list[float]  # error of a change of each coordinate of x [unit of the task]
    parts: tuple[tuple[slice, slice], ...]  # entries of x, and coordinates, measured together
    periods: float  # that are bridged
    bridged: float  # s, too


class GuardMemory(NamedTuple):
    """What a guard remembers: the last good sample, what was sent, and what was refused."""

    t: Any  # of the last good sample [s]
    bad: Any  # periods in a row that were refused
    kind: Any  # why it stops: one of the numbers above
    blind: Any  # s, for which x was refused; −1 until a second sample agrees with the first
    q: list[Any]  # of that sample
    v: list[Any]
    drift: list[Any]  # q − ∫q̇ of the last moments; in a stop, how far it has moved since
    path: list[Any]  # ∫abs(q̇) of these
    push: list[Any]  # |q̈| that the latest changes of the torque explain, with what is usual
    usual: list[Any]  # |q̈| a few times as large as it was seen lately
    noise: list[Any]  # of a change of q, as far as it is known
    step: list[Any]  # least change of q that was ever seen, such as the step of its encoder
    command: list[Any]  # the last one
    x: list[Any]  # last good
    moved: list[Any]  # motion of x since, at most, of each part

    @staticmethod
    def ends(nq: int, nv: int, n_x: int, parts: int) -> list[int]:
        """Return where its lists end in an array that begins with the four numbers."""
        sizes = (4, nq, *[nv] * 8, n_x, parts)
        return [sum(sizes[: i + 1]) for i in range(len(sizes))]

    @classmethod
    def of(cls, values: list[Any], ends: list[int]) -> GuardMemory:
        """Return the memory of an array's numbers, which `ends` splits."""
        return cls(*values[:4], *(values[a:b] for a, b in pairwise(ends)))

    def joined(self) -> Array:
        """Return it as an array."""
        joined: Array = array([*self[:4], *chain.from_iterable(self[4:])])
        return joined


def first_memory(q: list[float], x: list[float], bounds: GuardBounds) -> Array:
    """Return the memory before a first sample, with any q (nq,) and x (n_x,), as an array."""
    none, far = [0.0] * len(bounds.q), [_FAR] * len(bounds.parts)
    noise, step = [0.25 * each for each in bounds.q], [0.5 * each for each in bounds.q]
    usual = (_RARE * bounds.push).tolist()  # but loads begin to act at the first step
    joints = none, none, none, bounds.push.tolist(), usual, noise, step, none
    return GuardMemory(UNSEEN, 0.0, 0.0, 0.0, q, *joints, x, far).joined()


class Sample(NamedTuple):
    """A measurement in lists of numbers, and how it differs from the last good one."""

    t: Any
    q: list[Any]
    v: list[Any]
    x: list[Any]
    t_x: Any  # NaN where it is not known
    way: list[Any]  # motion from the last good q, n_v numbers
    x_way: list[Any]  # error coordinates of x to the last good one, m numbers


class Judged(NamedTuple):
    """A sample as the guard lets it pass, and its judgement."""

    q: list[Any]
    v: list[Any]
    x: list[Any]
    kind: Any  # what is wrong with q, q̇ or t
    stops: Any  # why it stops now, or 0
    refuses_x: Any
    drift: list[Any]  # as it is remembered
    path: list[Any]
    usual: list[Any]
    noise: list[Any]
    step: list[Any]
    way: list[Any]  # q since the last sample, if both are good
    anew: Any  # whether to compare the next sample with this bad one, as no two agreed so far
    last: list[Any]  # x, the last good one
    moved: list[Any]  # of each part of x, before it moves on


def judged(memory: GuardMemory, sample: Sample, dt: Any, bounds: GuardBounds) -> Judged:
    """Judge a sample against the last good one.

    With A = min(a(h + lag), fastest) + ‖q̇‖ of the last good sample, h the time since and a the
    acceleration that motors, loads and model errors may cause, a motion explains it if
    abs(Δq − h q̇) ≤ δ + hA, abs(Δq̇) ≤ δ/h + A (without the lag), and
    abs(Δq − h(q̇ + q̇')/2) ≤ δ + hA/2, δ the error of a change of q; the sum of the latter over the
    last moments is bounded, too, and so is the rise of abs(q̇), also at the first sample.
    Of loads and model errors a first sample may show a few times what is usual; what is more needs
    a second one, which may show all that is possible.

    dt is the period [s].
    """
    t, q, v, _, _, way, _ = sample
    stopped, seen = memory.kind > 0.0, memory.t > 0.5 * UNSEEN
    since, lag, before = t - memory.t, bounds.lag, memory.v
    missed = (memory.bad > 0.0) & (since <= _larger(_GAPS * dt, _GAP))
    runs = stopped | ((since >= _SOON * dt) & (missed | (since <= _MISSED * dt)))
    h = select(stopped, (memory.bad + 1.0) * dt, select(runs, since, dt))  # in a stop periods count
    half, per, with_lag, share = 0.5 * h, 1.0 / h, h + lag, _SHARE + lag * 4.0 / _MEMORY
    fade = _larger(1.0 - h / _MEMORY, 0.0)
    impact = _smaller(h / _IMPACT, 1.0) * root(sum((each * each for each in before), 0.0))
    jumps = hits = apart = moves = wild = False
    drifts, paths = list[Any](), list[Any]()
    noises, steps, left, size = list[Any](), list[Any](), 0.0, 0.0
    usuals, settles, was_bad = list[Any](), _larger(1.0 - h / _SETTLES, 0.0), memory.bad > 0.0
    for w, v1, v0, a, usual, rare, r, step, coarse, most, drift, path in zip(
        way, v, before, memory.push, memory.usual, bounds.push.tolist(), memory.noise, memory.step,
        bounds.q, bounds.fastest, memory.drift, memory.path, strict=True,
    ):  # fmt: skip
        a = select(was_bad, a + rare, a)
        shown = _smaller(_USUAL * per * abs(v1 - v0), rare)
        usuals.append(_larger(_larger(settles * usual, _RARE * rare), shown))
        noise = _smaller(4.0 * r, coarse)
        unit = 1.0 / (2.0 * noise * per + _TURNS)
        both, one = unit * (v1 + v0), unit * v0
        left, size = left + both * both, size + one * one
        mean = half * (v1 + v0)
        off = w - mean
        A = _smaller(a * with_lag, most) + impact
        path = fade * path + abs(mean)
        slack = 2.0 * noise + share * path
        adds = _ADDS * slack  # a bad sample that passed does not make the next ones bad
        drift = fade * drift + _larger(_smaller(off, adds), -adds)
        slack = slack + lag * (abs(v1) + abs(v0))
        jumps = jumps | (abs(w - h * v0) > noise + h * A)
        hits = hits | (abs(v1 - v0) > noise * per + _smaller(a * h, most) + impact)
        wild = wild | (abs(v1) > noise * per + _WILD * most + abs(v0))
        apart = apart | (abs(off) > noise + half * A)
        apart = apart | ((abs(drift) > slack) & complement(stopped))
        moves = moves | (abs(v1) > _STILL)
        drifts.append(drift)
        paths.append(path)
        # only where q changes it shows how well it is known
        changes, least = w != 0.0, _larger(_STEP * step, _FINEST * coarse)
        steps.append(select(changes & (abs(w) < step), abs(w), step))
        noises.append(_larger(select(changes, _FINER * r, r), _larger(abs(off), least)))
    hits = hits | wild | ((left < _LEFT * size) & (size > 1.0))  # all joints at once
    again = moves & reduce(and_, [a == b for a, b in zip(q + v, memory.q + before, strict=True)])
    known, far = all_finite(q + v) & (abs(t) < _OLDEST), sum(map(abs, way), 0.0) > _TURNED
    kind = select(apart, DISAGREES, GOOD)
    kind = select(hits, VELOCITY, kind)
    kind = select(jumps, POSITION, kind)
    kind = select(again, REPEATED, kind)
    kind = select(runs, kind, CLOCK)
    kind = select(known, select(seen, kind, select(wild | far, VELOCITY, GOOD)), UNKNOWN)
    is_bad = kind > 0
    too_long = (memory.bad >= bounds.periods) | ((memory.bad + 1.0) * dt > bounds.bridged)
    stops = select(is_bad & was_bad & too_long, kind, 0)
    stops = select(stopped, memory.kind, select(memory.blind < _BLIND, stops, SENSOR))
    hidden = is_bad | (stops > 0)
    refuses, used, last, moved = _seen(memory, sample, hidden, dt, bounds)
    alone, makes_sense = memory.blind < 0.0, complement(wild | far)
    none = [0.0] * len(v)
    drifts = _each(seen, drifts, none)
    if seen is not True:  # nothing has confirmed a first q̇ yet
        pairs = zip(v, bounds.fastest, strict=True)
        v = _each(seen, v, [_larger(_smaller(each, most), -most) for each, most in pairs])
    return Judged(
        _each(is_bad, memory.q, q), _each(is_bad, _each(stopped | alone, none, before), v),
        used, kind, stops, refuses,
        _each(is_bad, memory.drift, drifts),
        _each(is_bad, memory.path, _each(seen, paths, none)),
        _each(is_bad | complement(seen), memory.usual, usuals),
        _each(is_bad | complement(seen), memory.noise, noises),
        _each(is_bad | complement(seen), memory.step, steps),
        _each(is_bad | was_bad, none, way), is_bad & known & alone & makes_sense, last, moved,
    )  # fmt: skip


def _seen(
    memory: GuardMemory, sample: Sample, hidden: Any, dt: Any, bounds: GuardBounds
) -> tuple[Any, list[Any], list[Any], list[Any]]:
    """Judge x, part by part; one that differs from the last is new.

    Returns whether any is refused; x with NaN where it is, or all if `hidden`; the last good x; and
    the motion of each part since.
    """
    refuses, used, last, moves = False, list[Any](), list[Any](), list[Any]()
    alone = memory.blind < 0.0
    early = (sample.t_x == sample.t_x) & (sample.t_x - sample.t > dt + _AHEAD)
    for (entries, rows), moved in zip(bounds.parts, memory.moved, strict=True):
        here, before, far = sample.x[entries], memory.x[entries], early
        for apart, noise in zip(sample.x_way[rows], bounds.x[rows], strict=True):
            far = far | (abs(apart) > noise + _TIMES * moved)
        there = all_finite(here)
        far = far & there
        same = reduce(and_, [a == b for a, b in zip(here, before, strict=True)])
        new = complement(same | far | hidden) & there
        refuses = refuses | far
        used += _each(far | hidden, [math.nan] * len(here), here)
        last += _each(new | (far & alone & complement(hidden)), here, before)
        nearer = select(moved < 0.5 * _FAR, _KEPT * moved, 0.0)
        moves.append(select(new, nearer, moved))
    return refuses & complement(hidden), used, last, moves


def remembered(
    memory: GuardMemory,
    judged: Judged,
    sample: Sample,
    dt: Any,
    command: list[Any],
    push: list[Any],
    sizes: list[Any] | None,
) -> GuardMemory:
    """Return the memory after a command is sent.

    Args:
        memory: The memory before.
        judged: The judgement of the sample.
        sample: The sample.
        dt: The period [s].
        command: The torque or velocity that is sent, n_v numbers.
        push: |q̈| that it may cause, n_v numbers.
        sizes: ‖Ĵ‖ of each part of x; None if there is no Ĵ: then x may move as it likes.
    """
    is_bad, stops, was = judged.kind > 0, judged.stops > 0, memory.kind > 0.0
    held = judged.drift
    if stops is not False:
        since = [a + b for a, b in zip(memory.drift, judged.way, strict=True)]
        held = _each(stops, _each(was, since, [0.0] * len(since)), judged.drift)
    fade = _larger(1.0 - dt / _FADES, 0.0)
    push = [
        _larger(new + usual, fade * old)
        for new, usual, old in zip(push, judged.usual, memory.push, strict=True)
    ]
    last, moves = judged.last, [_FAR] * len(judged.moved)
    if sizes is not None:
        speed = dt * root(sum((each * each for each in judged.v), 0.0))
        pairs = zip(judged.moved, sizes, strict=True)
        moves = [_smaller(moved + speed * size, _FAR) for moved, size in pairs]
    anew, seen = judged.anew, memory.t > 0.5 * UNSEEN
    blind = select(is_bad, memory.blind, select(seen, 0.0, -1.0))
    blind = select(judged.refuses_x, memory.blind + dt, blind)
    return GuardMemory(
        select(is_bad & complement(anew), memory.t, sample.t),
        select(is_bad, memory.bad + 1.0, 0.0), judged.stops, blind,
        _each(anew, sample.q, judged.q), _each(is_bad & complement(anew), memory.v, sample.v),
        held, judged.path, push, judged.usual, judged.noise, judged.step, command, last, moves,
    )  # fmt: skip


def stop_torque(
    judged: Judged, memory: GuardMemory, gravity: Array, damping: Array, stiffness: Array
) -> Array:
    """Return the torque that holds an arm where it stopped: g − D q̇ − K(way since), (n_v,)."""
    since = [a + b for a, b in zip(memory.drift, judged.way, strict=True)]
    way = array(_each(memory.kind > 0.0, since, [0.0] * len(since)))
    torque: Array = gravity - damping * array(judged.v) - stiffness * way
    return torque


def _larger(a: Any, b: Any) -> Any:
    return select(a > b, a, b)


def _smaller(a: Any, b: Any) -> Any:
    return select(a < b, a, b)


def _each(condition: Any, a: list[Any], b: list[Any]) -> list[Any]:
    if condition is True or condition is False:
        return a if condition else b
    return [select(condition, *pair) for pair in zip(a, b, strict=True)]


class QuickGuard:
    """The usual step of a guard on arrays: a good sample, which differs by noise only.

    It does what `judged` and `remembered` do, in a third of the time. `ends` are those of
    `GuardMemory`.
    """

    def __init__(self, bounds: GuardBounds, ends: list[int], nq: int, nv: int) -> None:
        self._q, self._joints = slice(4, 4 + nq), slice(ends[1], ends[9])
        self._x, self._moved = slice(ends[9], ends[10]), slice(ends[10], ends[11])
        self._shape, self._parts, self._x_noise = (8, nv), bounds.parts, min(_FAR, *bounds.x) ** 2
        self._coarse, self._most = np.array(bounds.q), np.array(bounds.fastest)
        self._push, self._rare = bounds.push, _RARE * bounds.push
        self._finest, self._share = _FINEST * self._coarse, _SHARE + bounds.lag * 4.0 / _MEMORY

    def judged(
        self,
        memory: Array,
        sample: tuple[Any, ...],
        way: Array,
        x_way: Array,
        dt: float,
    ) -> Array | None:
        """Return the memory but for the command, or None where the sample needs a closer look.

        The arguments are a measurement's t, q, v, x and t_x, and the motion of q and x since the
        last good one.
        """
        t, q, v, x, t_x = sample
        last, bad, kind, blind = memory[:4].tolist()
        since = t - last
        if bad or kind or blind or not _SOON * dt <= since <= _MISSED * dt or t >= _OLDEST:
            return None
        if t_x is not None and t_x - t > dt + _AHEAD:
            return None
        known = memory[self._joints].reshape(self._shape)
        before, half, r = known[0], 0.5 * since, known[5]
        sudden, both, noise = v - before, v + before, np.minimum(4.0 * r, self._coarse)
        mean, fade = half * both, max(1.0 - since / _MEMORY, 0.0)
        off = way - mean
        path = fade * known[2] + np.abs(mean)
        slack = 2.0 * noise + self._share * path
        drift = fade * known[1] + np.maximum(np.minimum(off, _ADDS * slack), -_ADDS * slack)
        # less than what `judged` asks for, so that |Δq − h q̇| is within its bound
        most = 0.5 * noise + half * np.minimum(since * known[3], self._most)
        size, far = np.abs(off), np.abs(way)
        if not (
            (size <= most).all() and (half * np.abs(sudden) <= most).all()
            and (np.abs(drift) <= slack).all()
            and x_way.dot(x_way) <= self._x_noise
            and (sudden.any() or v.dot(v) <= _STILL * _STILL)
        ):  # fmt: skip
            return None
        if sudden.dot(sudden) > _STRAIGHT:
            unit = 1.0 / (2.0 * noise / since + _TURNS)
            left, one = unit * both, unit * before
            if left.dot(left) < _LEFT * one.dot(one) > _LEFT:
                return None
        after = memory.copy()
        after[0], after[self._q] = t, q
        now = after[self._joints].reshape(self._shape)
        now[0], now[1], now[2] = v, drift, path
        changes = far > 0.0
        usual = np.maximum(max(1.0 - since / _SETTLES, 0.0) * known[4], self._rare)
        now[4] = np.maximum(usual, np.minimum(_USUAL * (1.0 / since) * np.abs(sudden), self._push))
        least = np.maximum(_STEP * known[6], self._finest)
        now[5] = np.maximum(np.where(changes, _FINER * r, r), np.maximum(size, least))
        now[6] = np.where(changes & (far < known[6]), far, known[6])
        moved, seen = after[self._moved], after[self._x]
        for i, (entries, _) in enumerate(self._parts):
            if (here := x[entries].tolist()) != seen[entries].tolist():
                seen[entries] = here
                moved[i] = _KEPT * moved[i] if moved[i] < 0.5 * _FAR else 0.0
        return after

    def answered(
        self, after: Array, v: Array, dt: float, command: Array, push: Array, J_hat: Array | None
    ) -> Array:
        """Return the memory of `judged` after a command, as in `remembered`."""
        known = after[self._joints].reshape(self._shape)
        known[3] = np.maximum(push + known[4], max(1.0 - dt / _FADES, 0.0) * known[3])
        known[7] = command
        moved = after[self._moved]
        if J_hat is None:
            moved[:] = _FAR
            return after
        speed = dt * root(sum([each * each for each in v.tolist()], 0.0))
        for i, (_, rows) in enumerate(self._parts):
            moved[i] = min(moved[i] + speed * length(J_hat[rows].ravel()), _FAR)
        return after
