"""A way out of dead ends: a search for another configuration, and a motion of the joints to it.

Shapes: motions of joints and their speeds are (n_v,), errors and targets (m,).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from approxjac.law.branches import array, choose, complement, is_finite, select
from approxjac.law.pseudoinverse import is_near_singular
from approxjac.law.tracking import saturated
from approxjac.validation import Array

_STANDS, _TRIES, _PASSES = 0.2, 8.0, 15.0  # time before a search [s]; its starts, steps of each
_HELD = 0.1  # share of the wanted rate of errors, below which an arm stands
_FAR, _NEAR, _SAME = 0.02, 0.01, 0.02  # errors that count, are none; change of target [s]
_REACH = 1.0  # time at full speed within which a search begins [s]
_DAMPING, _LEAST = 1e-4, 1e-12  # λ² over tr ĴĴᵀ, and at least
_LONGEST = 0.7  # step of a search [rad or m]
_RAMP = 0.3  # of h [s]
_NONE = 1e9  # time of a motion that was not found [s]
_ENDLESS = 1e6  # range of a continuous joint [rad]


class Detour(NamedTuple):
    """A motion of the joints to where the target is reached, taken where an arm stands before it.

    At a dead end, by stops (of an arm with self-motion) or a singular Ĵ, it stands although another
    configuration reaches its target. After 0.2 s of that, Gauss–Newton steps, one a period, from
    evenly spread starts look for configurations within the joints' ranges in which the predicted
    error vanishes and Ĵ is regular. To the one that is soonest reached, of eight starts or more,
    leads

        q̇_r = h w/T + (1 − h) q̇_t,

    with the way w, its time T, the q̇_t of the task, and an h that rises from 0 to 1 in 0.3 s and
    falls as long from T on, so that its integral is T. What proves σ → 0 holds for any q̇_r. Not
    proven is that there are few detours. What is in the way is not known.

    Its memory are seven numbers, the target, where the search is, its start, and w.
    """

    low: Array  # range of the joints
    high: Array
    turns: Array  # 1 where a joint is continuous, else 0
    spread: Array  # steps from start to start, in ranges
    fastest: Array  # [rad/s or m/s]
    per_speed: Array  # 1/vᵢ of errors, (m,)
    ratio: float  # of σ_max, below which Ĵ is singular
    dt: float

    @property
    def size(self) -> int:
        """Length of the memory."""
        return 7 + len(self.per_speed) + 3 * len(self.low)

    def stands(self, z: Array, J: Array, v: Array, alpha: Any) -> Any:
        """Return True if q̇ reduces an error z at less than a tenth of the rate s(αz)."""
        far, (wanted, _) = self.per_speed * z, saturated(alpha * z, 0.0 * z, self.per_speed)
        return (-z.dot(J.dot(v)) < _HELD * z.dot(wanted)) & (far.dot(far) > _FAR**2)

    def step(
        self,
        memory: Array,
        stands: Any,
        motion: Array,
        target: Array,
        look: Callable[[Array], tuple[Array, Array]],
    ) -> tuple[Array, Any, Any, Array]:
        """Return the memory a period later; and h, ḣ and w/T now.

        `look` returns the predicted error and Ĵ at a motion of the joints.
        """
        m, n, dt = len(target), len(motion), self.dt
        stood, tries, passes, best, left, time, c = memory[:7].tolist()
        aim, (ghost, seed, way) = memory[7 : 7 + m], memory[7 + m :].reshape(3, n)
        none, moved = 0.0 * stood, self.per_speed * (target - aim)
        same, is_free = moved.dot(moved) < _SAME**2, (left <= 0.0) & (c <= 0.0)
        # less if it moves on, as it may rattle at a stop
        stood = select(stands & same & is_free, stood + dt, stood - dt)
        stood = np.minimum(np.maximum(stood, none), none + 2.0 * _STANDS)
        stood = select(same, stood, none)  # what was found is of the target before

        def search() -> tuple[Any, ...]:
            z, J = look(ghost)
            is_known = is_finite(np.concatenate([z, J.ravel()]))  # as where a camera sees nothing
            z, J = np.where(is_known, z, 0.0), np.where(is_known, J, 0.0)
            far, there = self.per_speed * z, self._shortest(ghost - motion)
            lasts, G = (np.abs(there) / self.fastest).max() + _RAMP, J.dot(J.T)
            is_near = is_known & (far.dot(far) < _NEAR**2)
            better = is_near & (lasts < best) & complement(is_near_singular(G, self.ratio))
            ends = is_near | complement(is_known) | (passes >= _PASSES)
            after = seed + self.spread
            after = np.where(after >= 1.0, after - 1.0, after)
            away = self._shortest(self.low + (self.high - self.low) * after - motion)
            nearby = _REACH * self.fastest
            begins = motion + np.minimum(np.maximum(away, -nearby), nearby)
            return (
                select(ends, tries + 1.0, tries),
                select(ends, none, passes + 1.0),
                select(better, lasts, best),
                select(ends, begins, self._nearer(ghost, z, J)),
                select(ends, after, seed),
                select(better, there, way),
            )

        tries, passes, best, ghost, seed, way = choose(
            stood > _STANDS, search, lambda: (none, none, none + _NONE, motion, seed, way)
        )
        found = (tries >= _TRIES) & (best < _NONE)
        # a detour goes on for the time left, unless the target changes
        left = select(found, best, select(same & (left > dt), left - dt, none))
        time = select(found, best, time)
        is_left = left > 0.0
        c_dot = select(is_left, 1.0 - c, -c)
        c_dot = np.minimum(np.maximum(c_dot / dt, none - 1.0 / _RAMP), none + 1.0 / _RAMP)
        numbers = [select(found, none, stood), tries, passes, best, left, time, c + dt * c_dot]
        after = [array(numbers), select(is_left, aim, target), ghost, seed, way]
        h, h_dot = c * c * (3.0 - 2.0 * c), 6.0 * c * (1.0 - c) * c_dot
        per = 1.0 / select(time > 0.0, time, none + 1.0)
        return np.concatenate(after), h, h_dot, per * way

    def _shortest(self, way: Array) -> Array:
        """Return a way that is at most half a turn for each continuous joint."""
        return way - self.turns * (2.0 * np.pi * np.rint(way / (2.0 * np.pi)))

    def _nearer(self, motion: Array, z: Array, J: Array) -> Array:
        """Return a motion a step nearer to z = 0, within the ranges; fast joints do more of it."""
        J = J * (share := self.fastest / self.fastest.max())
        damping = (_DAMPING * J.dot(J.T).trace() + _LEAST) * np.eye(len(z))

        def step(J: Array) -> Array:
            return -share * np.linalg.solve(J.dot(J.T) + damping, z).dot(J)

        way, endless = step(J), _ENDLESS * self.turns
        low, high = self.low - endless, self.high + endless
        barred = ((motion <= low) & (way < 0.0)) | ((motion >= high) & (way > 0.0))
        way = step(np.where(barred, 0.0, J))
        longest = np.abs(way).max()
        way = way * (_LONGEST / select(longest > _LONGEST, longest, 0.0 * longest + _LONGEST))
        return np.minimum(np.maximum(motion + way, low), high)
