"""The guard of a step: which samples a motion explains, and what takes the place of the others.

Not of the paper, whose measurements are all good. Numbers are floats, or symbols of `codegen`: for
vectors as short as these, loops over floats take a fifth of the time of NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import reduce
from itertools import chain, pairwise
from operator import or_
from typing import Any, NamedTuple

from approxjac.law.branches import (
    all_finite,
    array,
    choose,
    complement,
    fold,
    select,
    selected,
    surely,
)
from approxjac.law.products import root
from approxjac.validation import Array, read_only

UNSEEN = -1e20  # [s], the time before a first sample
_FAR = 1e15  # a motion of x before it was first seen
_TURNED = 1e6  # rad or m, the largest sum of the first q
_SOON, _MISSED = 0.2, 2.5  # of a period at least and at most pass from sample to sample
_GAPS, _GAP = 20.0, 0.05  # periods or seconds that may be missing, if the clock then runs on
_STILL = 1e-3  # rad/s or m/s, below which a joint may have the same q and q̇ again
_IMPACT = 0.004  # s, in which an arm that hits something may lose its speed
_WILD = 5.0  # times the largest change of q̇ that makes sense, by which none rises
_WITHIN = 0.5  # of it is what joints may do all along
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
"""Faults of a sample, in the order of their statuses."""


class GuardBounds(NamedTuple):
    """Largest differences of samples from what is expected; lists have an entry for each joint."""

    q: list[float]  # error of a change of q [rad or m]
    lag: float  # of q̇ [s]
    fastest: list[float]  # largest change of q̇ that makes sense at all [rad/s or m/s]
    push: Array  # |q̈| that loads, pushes and what is not modelled may cause at most, (n_v,)
    x: list[float]  # error of a change of each coordinate of x [unit of the task]
    parts: tuple[tuple[slice, slice], ...]  # entries of x, and coordinates, measured together
    periods: float  # that are bridged
    bridged: float  # s, too


class GuardMemory(NamedTuple):
    """Memory of a guard: the last good sample, the last command and the samples refused since."""

    t: Any  # of the last good sample [s]
    bad: Any  # periods in a row that were refused
    kind: Any  # why it stops: one of the numbers above
    # s, for which x was refused, in a stop for which q did not go on; −1 until two samples agree
    blind: Any
    q: list[Any]  # of that sample
    v: list[Any]
    drift: list[Any]  # q − ∫q̇ of the last moments; in a stop, how far it has moved since
    path: list[Any]  # ∫abs(q̇) of these; in a stop, how far q is from the last good one
    push: list[Any]  # |q̈| that the latest changes of the torque explain, with what is usual
    usual: list[Any]  # |q̈| a few times as large as it was seen lately
    noise: list[Any]  # of a change of q, as far as it is known
    step: list[Any]  # least change of q that was ever seen, such as the step of its encoder
    command: list[Any]  # the last one
    x: list[Any]  # last good
    moved: list[Any]  # motion of x since, at most, of each part

    @staticmethod
    def ends(nq: int, nv: int, n_x: int, parts: int) -> list[int]:
        """Return the ends of its lists in an array that begins with the four numbers."""
        sizes = (4, nq, *[nv] * 8, n_x, parts)
        return [sum(sizes[: i + 1]) for i in range(len(sizes))]

    @classmethod
    def of(cls, values: list[Any], ends: list[int]) -> GuardMemory:
        """Return the memory of an array's numbers, which `ends` splits."""
        return cls(*values[:4], *(values[a:b] for a, b in pairwise(ends)))

    def joined(self) -> Array:
        """Return it as an array."""
        return array([*self[:4], *chain.from_iterable(self[4:])])


def first_memory(q: list[float], x: list[float], bounds: GuardBounds) -> Array:
    """Return the memory before a first sample, with any q (nq,) and x (n_x,), as an array."""
    none, far = [0.0] * len(bounds.q), [_FAR] * len(bounds.parts)
    noise, step = [0.25 * each for each in bounds.q], [0.5 * each for each in bounds.q]
    usual = (_RARE * bounds.push).tolist()  # but loads begin to act at the first step
    joints = none, none, none, bounds.push.tolist(), usual, noise, step, none
    return read_only(GuardMemory(UNSEEN, 0.0, 0.0, 0.0, q, *joints, x, far).joined())


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
    """A sample as the guard lets it pass, its judgement, and the memory before a command."""

    verdict: list[Any]  # what is wrong with q, q̇ or t; 1 if x is refused; 1 to begin anew with it
    q: list[Any]
    v: list[Any]
    x: list[Any]
    after: GuardMemory

    def parts(self) -> tuple[list[Any], ...]:
        """Return all of its numbers in lists."""
        return *self[:4], [*self.after[:4]], *self.after[4:]

    @classmethod
    def of(cls, parts: Iterable[Any]) -> Judged:
        """Return the judgement that has these parts, lists or arrays."""
        verdict, q, v, x, four, *lists = (
            each if isinstance(each, list) else each.tolist() for each in parts
        )
        return cls(verdict, q, v, x, GuardMemory(*four, *lists))


class _Followed(NamedTuple):
    """Difference of q from the integral of q̇, and updated statistics, for each joint."""

    off: list[Any]
    noise: list[Any]  # of a change of q, four times what it was
    slack: list[Any]  # what the drift may be
    drift: list[Any]
    path: list[Any]
    usual: list[Any]
    finer: list[Any]  # the noise that is remembered
    step: list[Any]


def judged(memory: GuardMemory, sample: Sample, dt: Any, bounds: GuardBounds) -> Judged:
    """Judge a sample against the last good one.

    With A = min(a(h + lag), fastest) + ‖q̇‖ of the last good sample, h the time since and a the
    acceleration that motors, loads and model errors may cause, a motion explains it if
    abs(Δq − h q̇) ≤ δ + hA, abs(Δq̇) ≤ δ/h + A (without the lag), and
    abs(Δq − h(q̇ + q̇')/2) ≤ δ + hA/2, δ the error of a change of q; the sum of the latter over the
    last moments is bounded, too, and so is the rise of abs(q̇), also at the first sample.
    Of loads and model errors a first sample may show a few times what is usual; what is more needs
    a second one, which may show all that is possible.

    A sample that differs by little, as nearly all do, needs no more than half of the comparisons.

    dt is the period [s].
    """
    t, since = sample.t, sample.t - memory.t
    near = (since >= _SOON * dt) & (since <= _MISSED * dt) & (abs(t) < _OLDEST)
    near = near & (memory.bad == 0.0) & (memory.kind == 0.0) & (memory.blind == 0.0)
    near = near & complement(_is_early(sample, dt))
    if surely(complement(near)):
        return closely_judged(memory, sample, dt, bounds)
    track = _followed(memory, sample.way, sample.v, since, bounds)
    near = near & is_near(track, memory, sample, since, bounds)
    usual = Judged([GOOD, 0, 0], sample.q, sample.v, sample.x, GuardMemory(
        t, 0.0, 0.0, 0.0, sample.q, sample.v, track.drift, track.path, memory.push, track.usual,
        track.finer, track.step, memory.command, sample.x,
        [
            select(_differs(sample.x[part], memory.x[part]), _nearer(moved), moved)
            for (part, _), moved in zip(bounds.parts, memory.moved, strict=True)
        ],
    ))  # fmt: skip
    if surely(near):
        return usual
    return Judged.of(choose(
        complement(near), lambda: closely_judged(memory, sample, dt, bounds).parts(), usual.parts
    ))  # fmt: skip


def is_near(
    track: _Followed, memory: GuardMemory, sample: Sample, h: Any, bounds: GuardBounds
) -> Any:
    """Return True if a sample differs so little that each comparison of `judged` holds."""
    half = 0.5 * h

    def next_joint(values: Any, off: Any, noise: Any, slack: Any, drift: Any, *motion: Any) -> Any:
        near, sudden, speed = values
        v1, v0, push, fastest = motion
        # |Δq − h q̇| is at most the sum of both
        most, change = 0.5 * noise + half * _smaller(h * push, fastest), v1 - v0
        near = near & (abs(off) <= most) & (half * abs(change) <= most) & (abs(drift) <= slack)
        return (near, sudden + change * change, speed + v1 * v1), ()

    (near, sudden, speed), _ = fold(
        next_joint, (True, 0.0, 0.0),
        *track[:4], sample.v, memory.v, memory.push, bounds.fastest,
    )  # fmt: skip
    far = sum((each * each for each in sample.x_way), 0.0)
    near = near & (far <= min(_FAR, *bounds.x) ** 2) & (sudden <= _STRAIGHT)
    return near & ((sudden > 0.0) | (speed <= _STILL * _STILL))


def _followed(
    memory: GuardMemory, way: list[Any], v: list[Any], h: Any, bounds: GuardBounds
) -> _Followed:
    """Compare q with the integral of q̇, joint by joint, a time h after the last good sample."""
    half, per, share = 0.5 * h, _USUAL / h, _SHARE + bounds.lag * 4.0 / _MEMORY
    fade, settles = _larger(1.0 - h / _MEMORY, 0.0), _larger(1.0 - h / _SETTLES, 0.0)

    def next_joint(values: Any, w: Any, v1: Any, v0: Any, drift: Any, *known: Any) -> Any:
        path, usual, r, step, coarse, rare = known
        noise, mean, size = _smaller(4.0 * r, coarse), half * (v1 + v0), abs(w)
        off, path = w - mean, fade * path + abs(mean)
        slack = 2.0 * noise + share * path
        adds = _ADDS * slack  # a bad sample that passed does not make the next ones bad
        drift = fade * drift + _larger(_smaller(off, adds), -adds)
        usual = _larger(settles * usual, _RARE * rare)
        usual = _larger(usual, _smaller(per * abs(v1 - v0), rare))
        # only where q changes it shows how well it is known
        changes, least = size > 0.0, _larger(_STEP * step, _FINEST * coarse)
        finer = _larger(select(changes, _FINER * r, r), _larger(abs(off), least))
        step = select(changes & (size < step), size, step)
        return values, (off, noise, slack, drift, path, usual, finer, step)

    return _Followed(*fold(
        next_joint, (), way, v, memory.v, memory.drift, memory.path, memory.usual, memory.noise,
        memory.step, bounds.q, bounds.push.tolist(),
    )[1])  # fmt: skip


def closely_judged(memory: GuardMemory, sample: Sample, dt: Any, bounds: GuardBounds) -> Judged:
    """Judge any sample, as `judged` does."""
    t, q, v, _, _, way, _ = sample
    stopped, seen = memory.kind > 0.0, memory.t > 0.5 * UNSEEN
    since, lag, before = t - memory.t, bounds.lag, memory.v
    missed = (memory.bad > 0.0) & (since <= _larger(_GAPS * dt, _GAP))
    runs = stopped | ((since >= _SOON * dt) & (missed | (since <= _MISSED * dt)))
    h = select(stopped, (memory.bad + 1.0) * dt, select(runs, since, dt))  # in a stop periods count
    half, per, with_lag, was_bad = 0.5 * h, 1.0 / h, h + lag, memory.bad > 0.0
    impact = _smaller(h / _IMPACT, 1.0) * root(sum((each * each for each in before), 0.0))
    track = _followed(memory, way, v, h, bounds)
    # in a stop: how long ago a sample was near the one before
    apart_for = select(stopped, memory.blind, h - dt)
    per_gap = 1.0 / (apart_for + dt)

    def next_joint(values: Any, w: Any, off: Any, noise: Any, slack: Any, *motion: Any) -> Any:
        jumps, hits, apart, moves, wild, left, size, near = values
        drift, v1, v0, a, rare, most, seen_at = motion
        a = select(was_bad, a + rare, a)
        unit = 1.0 / (2.0 * noise * per + _TURNS)
        both, one = unit * (v1 + v0), unit * v0
        left, size = left + both * both, size + one * one
        A = _smaller(a * with_lag, most) + impact
        slack = slack + lag * (abs(v1) + abs(v0))
        jumps = jumps | (abs(w - h * v0) > noise + h * A)
        hits = hits | (abs(v1 - v0) > noise * per + _smaller(a * h, most) + impact)
        wild = wild | (abs(v1) > noise * per + _WILD * most + abs(v0))
        apart = apart | (abs(off) > noise + half * A)
        apart = apart | ((abs(drift) > slack) & complement(stopped))
        moves = moves | (abs(v1) > _STILL)
        # as fast as both q and q̇ say that it goes on, from where it was last near
        on = w - select(stopped, seen_at, 0.0)
        reach = noise + (_WILD * dt + _WITHIN * apart_for) * most
        near, goes = near & (abs(on) <= reach), on * per_gap
        least = _smaller(_smaller(abs(goes), abs(v1)), most)
        sure = select(goes * v1 > 0.0, select(v1 > 0.0, least, -least), 0.0)
        values = jumps, hits, apart, moves, wild, left, size, near
        return values, (_larger(_smaller(v1, most), -most), sure)

    (jumps, hits, apart, moves, wild, left, size, near), (likely, sure) = fold(
        next_joint, (False, False, False, False, False, 0.0, 0.0, True),
        way, *track[:4], v, before, memory.push, bounds.push.tolist(), bounds.fastest, memory.path,
    )  # fmt: skip
    hits = hits | wild | ((left < _LEFT * size) & (size > 1.0))  # all joints at once
    again = moves & complement(_differs(q + v, memory.q + before))
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
    alone = memory.blind < 0.0
    refuses, x, last, moved = _seen(memory, sample, is_bad | (stops > 0), dt, bounds)
    anew = is_bad & known & alone & complement(wild | far)
    blind = select(is_bad, memory.blind, select(seen, 0.0, -1.0))
    blind, none = select(refuses, memory.blind + dt, blind), [0.0] * len(v)
    drift = selected(is_bad, memory.drift, selected(seen, track.drift, none))
    path, brakes = selected(is_bad, memory.path, selected(seen, track.path, none)), none
    before_gap = selected(stopped, memory.path, none)
    if not surely(stops == GOOD):
        path = selected(stops > 0, selected(known & near, way, before_gap), path)
        gap = select(known & near, 0.0, apart_for + dt)
        blind = select((stops > 0) & complement(alone), gap, blind)
        brakes = selected(known & near & stopped, sure, none)
        way = selected(is_bad | was_bad, none, way)
        since_then = [a + b for a, b in zip(memory.drift, way, strict=True)]
        drift = selected(stops > 0, selected(stopped, since_then, none), drift)
    keeps, skips = is_bad | complement(seen), is_bad & complement(anew)
    used_v = selected(seen, v, likely)  # nothing has confirmed a first q̇ yet
    used_q = selected(is_bad, memory.q, q)
    return Judged(
        [kind, select(refuses, 1, 0), select(anew, 1, 0)],
        used_q, selected(is_bad, selected(stopped | alone, brakes, before), used_v), x,
        GuardMemory(
            select(skips, memory.t, t), select(is_bad, memory.bad + 1.0, 0.0), stops, blind,
            selected(anew, q, used_q), selected(skips, before, v), drift,
            path, memory.push,
            selected(keeps, memory.usual, track.usual), selected(keeps, memory.noise, track.finer),
            selected(keeps, memory.step, track.step), memory.command, last, moved,
        ),
    )  # fmt: skip


def _is_early(sample: Sample, dt: Any) -> Any:
    """Return True if x is stamped later than it can be."""
    t_x = sample.t_x
    return (t_x == t_x) & (t_x - sample.t > dt + _AHEAD)


def _nearer(moved: Any) -> Any:
    """Return the motion of x that is still to be expected once a new x has come."""
    return select(moved < 0.5 * _FAR, _KEPT * moved, 0.0)


def _seen(
    memory: GuardMemory, sample: Sample, hidden: Any, dt: Any, bounds: GuardBounds
) -> tuple[Any, list[Any], list[Any], list[Any]]:
    """Judge x, part by part; one that differs from the last is new.

    Returns True if any is refused; x with NaN where it is, or all if `hidden`; the last good x; and
    the motion of each part since.
    """
    refuses, used, last, moves = False, list[Any](), list[Any](), list[Any]()
    alone, early = memory.blind < 0.0, _is_early(sample, dt)
    for (entries, rows), moved in zip(bounds.parts, memory.moved, strict=True):
        here, before, far = sample.x[entries], memory.x[entries], early
        for apart, noise in zip(sample.x_way[rows], bounds.x[rows], strict=True):
            far = far | (abs(apart) > noise + _TIMES * moved)
        there = all_finite(here)
        far = far & there
        new = _differs(here, before) & complement(far | hidden) & there
        refuses = refuses | far
        used += selected(far | hidden, [math.nan] * len(here), here)
        last += selected(new | (far & alone & complement(hidden)), here, before)
        moves.append(select(new, _nearer(moved), moved))
    return refuses & complement(hidden), used, last, moves


def remembered(
    judgement: Judged, dt: Any, command: list[Any], push: list[Any], sizes: list[Any] | None
) -> GuardMemory:
    """Return the memory after a command is sent.

    Args:
        judgement: The judgement of the sample.
        dt: The period [s].
        command: The torque or velocity that is sent, n_v numbers.
        push: |q̈| that it may cause, n_v numbers.
        sizes: ‖Ĵ‖ of each part of x; None if there is no Ĵ: then x may move as it likes.
    """
    after, fade = judgement.after, _larger(1.0 - dt / _FADES, 0.0)
    push = [
        _larger(new + usual, fade * old)
        for new, usual, old in zip(push, after.usual, after.push, strict=True)
    ]
    moved = [_FAR] * len(after.moved)
    if sizes is not None:
        speed = dt * root(sum((each * each for each in judgement.v), 0.0))
        pairs = zip(after.moved, sizes, strict=True)
        moved = [_smaller(before + speed * size, _FAR) for before, size in pairs]
    return after._replace(push=push, command=command, moved=moved)


def stop_command(judgement: Judged, gravity: list[Any], *bounds: Any) -> Array:
    """Return the command that holds an arm where it stopped: g − D q̇ − K(way since), (n_v,).

    The bounds are lists of n_v numbers: D, K, the largest command, the last, and their difference.
    """

    def next_joint(values: Any, g: Any, v: Any, way: Any, D: Any, K: Any, *limits: Any) -> Any:
        effort, last, change = limits
        halt = _smaller(_larger(g - D * v - K * way, -effort), effort)
        return values, (_smaller(_larger(halt, last - change), last + change),)

    _, (command,) = fold(next_joint, (), gravity, judgement.v, judgement.after.drift, *bounds)
    return array(command)


def _differs(a: list[Any], b: list[Any]) -> Any:
    return reduce(or_, [one != other for one, other in zip(a, b, strict=True)])


def _larger(a: Any, b: Any) -> Any:
    above = a > b  # without `select` of a float, as this runs often
    return a if above is True else b if above is False else select(above, a, b)


def _smaller(a: Any, b: Any) -> Any:
    below = a < b
    return a if below is True else b if below is False else select(below, a, b)
