"""The minimum of a small quadratic program without a branch on a value, so that it can be traced.

Mehrotra's predictor and corrector, a fixed number of times: S. Mehrotra, "On the implementation of
a primal-dual interior point method", SIAM J. Optimization 2(4), 1992.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from approxjac.law.branches import repeat, select
from approxjac.law.factors import Factors
from approxjac.validation import Array

PASSES = 20  # of 1 300 problems of limited steps 99 % take 13 at most
_NONE = 1e-300
_INACTIVE = 1e6  # times the largest violation: a bound that is further away counts as that far
_BACK = 0.995  # share of the way to where a slack or a multiplier vanishes
_DONE = 1e-12  # gap of a minimum
_EXACT, _STATIONARY = 1e-8, 1e-6  # that bounds and gradient have to be at the end


class QuadraticProgram(NamedTuple):
    """min ½ zᵀHz + fᵀz subject to lower ≤ z ≤ upper and row_lower ≤ A z ≤ row_upper.

    Its arrays are of float64 and contiguous.

    Attributes:
        H: Symmetric positive definite, shape (n, n).
        f: Shape (n,).
        lower: Lower bounds, shape (n,), −inf where there is none.
        upper: Upper bounds, shape (n,), inf where there is none.
        A: Rows, shape (k, n); k may be 0.
        row_lower: Lower bounds of the rows, shape (k,), −inf where there is none.
        row_upper: Upper bounds of the rows, shape (k,), inf where there is none.
    """

    H: Array
    f: Array
    lower: Array
    upper: Array
    A: Array
    row_lower: Array
    row_upper: Array


Minimum = Callable[[QuadraticProgram, Any, Any], tuple[Array, Any]]
"""Solver of a `QuadraticProgram`.

It takes the problem; what it costs to exceed the upper bound of the last row, per unit, or None
where that is a bound as the others; and whether it is likely that this price is paid. It returns z,
and 0 where z is the minimum, 1 where nothing keeps the bounds, 2 where it failed.
"""


def interior_minimum(problem: QuadraticProgram, price: Any = None) -> tuple[Array, Any]:
    """Return z, which satisfies its bounds, and 0, or 1 if there is none. See `Minimum`.

    Bounds that are infinite when traced cost nothing.
    """
    H, f, lower, upper, A, low, high = problem
    n = len(f)
    scale = 1.0 / np.sqrt(np.diag(H))
    rows = A * scale
    size = np.sqrt((rows * rows).sum(axis=1) + _NONE)
    G = np.concatenate([np.eye(n), rows / size[:, np.newaxis]])
    least = np.concatenate([lower / scale, low / size])
    most = np.concatenate([upper / scale, high / size])
    H = H * scale[:, np.newaxis] * scale
    free = -Factors(H).solve(f * scale)  # the minimum without bounds
    f = np.zeros(n)
    if price is not None:  # what exceeds the last bound is a variable
        H = np.concatenate([np.concatenate([H, np.zeros((n, 1))], axis=1), np.zeros((1, n + 1))])
        G = np.concatenate([G, np.zeros((1, n))])
        G = np.concatenate([G, np.zeros((len(G), 1))], axis=1)
        G[-2, -1], G[-1, -1] = -1.0, 1.0
        least, most = np.concatenate([least, [0.0]]), np.concatenate([most, [np.inf]])
    at = np.concatenate([free, f[:1]]) if price is not None else free
    above = [i for i, bound in enumerate(most.tolist()) if not _is_infinite(bound)]
    below = [i for i, bound in enumerate(least.tolist()) if not _is_infinite(bound)]
    if not above and not below:
        return free * scale, 0.0
    sides = np.zeros((len(above) + len(below), len(G)))  # those that are bounded, and the side
    sides[np.arange(len(above)), above] = 1.0
    sides[np.arange(len(above), len(sides)), below] = -1.0
    room = np.concatenate([most[above], -least[below]]) - sides.dot(G.dot(at))
    unit = np.maximum((-room).max(), _NONE)  # the largest violation
    room = np.minimum(room / unit, _INACTIVE)
    if price is not None:
        f = np.concatenate([f, np.ones(1) * (price * size[-1] / unit)])
    weights = np.abs(sides).T

    def residuals(x: Array, s: Array, z: Array) -> tuple[Array, Array, Any]:
        stationary = H.dot(x) + f + G.T.dot(sides.T.dot(z))
        return stationary, sides.dot(G.dot(x)) + s - room, (s * z).sum() / len(sides)

    def one(_: Any, before: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, s, z = before
        stationary, apart, gap = residuals(x, s, z)
        done = (gap < _DONE) & (apart.dot(apart) < _EXACT**2)
        K = Factors(H + (G.T * weights.dot(z / s)).dot(G))

        def direction(c: Array) -> tuple[Array, Array, Array]:
            dx = K.solve(-stationary - G.T.dot(sides.T.dot((c + z * apart) / s)))
            ds = -apart - sides.dot(G.dot(dx))
            return dx, ds, (c - z * ds) / s

        _, ds, dz = direction(-s * z)
        far = np.minimum(_length(s, ds), _length(z, dz))
        share = ((s + far * ds) * (z + far * dz)).sum() / len(sides) / gap
        # of what the first direction leaves out, no more than was gone of it
        dx, ds, dz = direction(share * share * share * gap - s * z - far * far * ds * dz)
        far = _BACK * np.minimum(_length(s, ds), _length(z, dz))
        return (
            np.where(done, x, x + far * dx),
            np.where(done, s, s + far * ds),
            np.where(done, z, z + far * dz),
        )

    s = np.maximum(room, 1.0)
    x, s, z = repeat(PASSES, one, (np.zeros(len(at)), s, 1.0 / s))
    stationary, apart, gap = residuals(x, s, z)
    is_minimum = (apart.dot(apart) < _EXACT**2) & (gap < _EXACT)
    is_minimum = is_minimum & (stationary.dot(stationary) < _STATIONARY**2)
    best = (free + unit * x[:n]) * scale
    return np.minimum(np.maximum(best, lower), upper), select(is_minimum, 0.0, 1.0)


def _length(values: Array, change: Array) -> Any:
    """Return the share of a change until a value vanishes, at most 1."""
    shrinks = change < 0.0
    return np.where(shrinks, values / np.where(shrinks, -change, 1.0), 1.0).min()


def _is_infinite(bound: Any) -> bool:
    return isinstance(bound, float) and math.isinf(bound)
