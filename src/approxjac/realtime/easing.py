"""`Eased`: a target that starts where the tip is and joins the one that is asked for."""

from __future__ import annotations

import numpy as np

from approxjac.interface import Target
from approxjac.simulation.loop import Wanted, target_at
from approxjac.tasks import Task
from approxjac.validation import Array

_PEAK = 1.875  # of a least-jerk motion: its fastest speed by its mean speed
_SHORTEST = 0.2  # s


class Eased:
    """A target's path, with an offset that goes to zero with least jerk.

    At first it is at x, with the velocity given; within its duration it joins the path, at rest
    relative to it. So the target of a loop jumps neither in position nor in velocity.

    Args:
        task: The controller's task.
        path: A target that is at rest, moves, or a path.
        begin: Time at which it begins [s].
        x: Where it begins, shape (n_x,).
        velocity: Of it there, in the error coordinates of the task, shape (m,) [unit/s].
        speed: How fast the offset may change at most, shape (m,) [unit/s].

    Attributes:
        duration: Until it has joined the path [s].
    """

    def __init__(
        self, task: Task, path: Wanted, begin: float, x: Array, velocity: Array, speed: Array
    ) -> None:
        self._task, self._path, self._begin = task, path, begin
        goal, goal_v, _ = _complete(task, target_at(path, begin))
        self._offset = task.error(x, goal)
        self._rate = velocity - goal_v
        self.duration = max(
            _SHORTEST,
            _PEAK * float(np.max(np.abs(self._offset) / speed)),
            4.0 * float(np.max(np.abs(self._rate) / speed)) * _SHORTEST,
        )

    def at(self, t: float) -> Target:
        """Return the target at t [s], in the time of the path."""
        goal = target_at(self._path, t)
        r = (t - self._begin) / self.duration
        if r >= 1.0 or not (self._offset.any() or self._rate.any()):
            return goal if isinstance(goal, Target) else Target(goal)
        x, v, a = _complete(self._task, goal)
        # quintics that are 1 and 0 in value and slope at r = 0, and vanish with both at r = 1
        e, w, T = self._offset, self.duration * self._rate, self.duration
        place = 1.0 - r**3 * (10.0 - 15.0 * r + 6.0 * r * r)
        place_rate = -30.0 * r * r * (1.0 - r) ** 2
        place_rate2 = -60.0 * r * (1.0 - r) * (1.0 - 2.0 * r)
        slope = r - r**3 * (6.0 - 8.0 * r + 3.0 * r * r)
        slope_rate = 1.0 - r * r * (18.0 - 32.0 * r + 15.0 * r * r)
        slope_rate2 = -r * (36.0 - 96.0 * r + 60.0 * r * r)
        return Target(
            self._task.displaced(x, place * e + slope * w),
            v + (place_rate * e + slope_rate * w) / T,
            a + (place_rate2 * e + slope_rate2 * w) / T**2,
        )


class Halt:
    """A target that comes to rest from where it is, with steady deceleration.

    Args:
        task: The controller's task.
        begin: Time at which it begins [s].
        x: Where it begins, shape (n_x,).
        velocity: Of it there, shape (m,) [unit/s].
        duration: Until it is at rest [s].

    Attributes:
        distance: How far it goes, shape (m,) [unit].
    """

    def __init__(
        self, task: Task, begin: float, x: Array, velocity: Array, duration: float
    ) -> None:
        self._task, self._begin, self._x, self._v = task, begin, x, velocity
        self._duration = duration
        self.distance = 0.5 * duration * velocity

    def at(self, t: float) -> Target:
        """Return the target at t [s]."""
        r = min(max((t - self._begin) / self._duration, 0.0), 1.0)
        way = self._duration * (r - 0.5 * r * r) * self._v
        a = -self._v / self._duration if r < 1.0 else np.zeros_like(self._v)
        return Target(self._task.displaced(self._x, way), (1.0 - r) * self._v, a)


def _complete(task: Task, target: Target | Array) -> tuple[Array, Array, Array]:
    """Return x, v and a of a target, 0 where it has no rates."""
    if not isinstance(target, Target):
        target = Target(target)
    still = np.zeros(task.m)
    v, a = (still if rate is None else rate for rate in (target.v, target.a))
    return target.x, v, a
