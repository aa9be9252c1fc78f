"""`Moves`: how fast a target may move along a line, and how far e and the joints get.

The tube of `certificates.moves` is sought by trial; its constants by a search over true robots,
places along the path, joints within R and errors within ē.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from approxjac import law
from approxjac.law import moves
from approxjac.robots import Robot
from approxjac.robots.traced import moved
from approxjac.stability.certificates.matrix_form import Hold, Weights, best_weights
from approxjac.stability.certificates.moves import (
    RATES,
    Line,
    MovingForm,
    Tube,
    damping_of,
    largest,
)
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.samples import Indices, Samples
from approxjac.stability.search.worst import climb
from approxjac.validation import Array

_NODES = 4  # steps of Runge and Kutta along a path
_NEWTON = 2
_SAMPLES, _WORST = 600, 150


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
