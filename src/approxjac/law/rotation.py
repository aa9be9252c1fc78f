"""Rotations in space and in the plane, and the rotation that explains data."""

import math
from typing import Any

import numpy as np

from approxjac.law.branches import array, choose, complement, repeat, select, surely, take
from approxjac.law.products import angle, length, root, sine_and_cosine
from approxjac.validation import Array

# generators of SO(3) and SO(2): rotations are exp(Σ φᵢ Gᵢ)
_SPACE = np.array([
    [[0, 0, 0], [0, 0, -1], [0, 1, 0]],
    [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
    [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
], dtype=float)  # fmt: skip
_PLANE = np.array([[[0, -1], [1, 0]]], dtype=float)
# all of their products, ½(GᵢGⱼ + GⱼGᵢ), a row each
_PRODUCTS = {
    len(G[0]): (0.5 * (G @ G[:, np.newaxis] + G[:, np.newaxis] @ G)).reshape(len(G) ** 2, -1)
    for G in (_SPACE, _PLANE)
}
NO_ROTATION = 1e-6
"""A quaternion shorter than this stands for no orientation."""
_NO_SINE, _NO_TURN = 1e-150, 1e-8  # below them the angle over its sine is 1
_FAR = 1e100
_QUARTIC_STEPS = 30  # of Newton's method, to the last bit
_NEWTON_STEPS = 5  # it goes on with the next frame
_LARGEST_STEP = 0.7  # of Newton's method [rad]
_CONVERGED = 1e-4  # after a step as small the next would be its square [rad]


def generators(d: int) -> Array:
    """Return G with rotations exp(Σ φᵢ Gᵢ) of d = 2 or 3 dimensions, shape (1 or 3, d, d)."""
    return _SPACE if d == 3 else _PLANE


def cross_matrix(phi: Array) -> Array:
    """Return [φ]ₓ = Σ φᵢ Gᵢ of φ (3,), or of an angle (1,) in the plane."""
    if len(phi) == 1:
        return np.asanyarray(phi * _PLANE[0])
    x, y, z = phi.tolist()
    return np.asanyarray(array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]))


def rotation_exp(phi: Array) -> Array:
    """Return exp([φ]ₓ) of a rotation vector (3,), or of the angle (1,) in the plane [rad].

    1 + s[φ]ₓ + c[φ]ₓ² in plain numbers, which at this size are quicker than arrays.
    """
    size = length(phi)
    sine, cosine = sine_and_cosine(size)
    turns = size > 1e-4
    s, c = _share(sine, size, turns, 1.0), _share(1.0 - cosine, size * size, turns, 0.5)
    if len(phi) == 1:
        (x,) = phi.tolist()
        along = 1.0 - c * x * x
        return np.asanyarray(array([[along, -s * x], [s * x, along]]))
    x, y, z = phi.tolist()
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, c * x * y, c * x * z, c * y * z
    x, y, z = s * x, s * y, s * z
    return np.asanyarray(array([
        [1.0 - c * (yy + zz), xy - z, xz + y],
        [xy + z, 1.0 - c * (xx + zz), yz - x],
        [xz - y, yz + x, 1.0 - c * (xx + yy)],
    ]))  # fmt: skip


def rotation_log(R: Array) -> Array:
    """Return the rotation vector (3,) of a rotation matrix, or the angle (1,) of one in the plane.

    Its length is at most π; at π it is either of the two vectors.
    """
    if len(R) == 2:
        return np.asanyarray(array([angle(*_plane_turn(R))]))
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    twice = array([zy - yz, xz - zx, yx - xy])
    sine, cosine = 0.5 * length(twice), 0.5 * (xx + yy + zz - 1.0)
    turn = angle(sine, cosine)

    def half_a_turn() -> tuple[Array]:
        symmetric = 0.5 * (R + R.T) - cosine * np.eye(3)  # (1 − cos) a aᵀ
        x, y, z = symmetric
        axis = select((y[1] > x[0]) & (y[1] >= z[2]), y, x)
        axis = select((z[2] > x[0]) & (z[2] > y[1]), z, axis)
        axis = axis / length(axis)
        return (axis * select(axis.dot(twice) >= 0.0, turn, -turn),)

    def usual() -> tuple[Array]:
        return (twice * (0.5 * _share(turn, sine, sine >= 1e-6, 1.0)),)

    return choose(cosine <= -0.99, half_a_turn, usual)[0]


def _plane_turn(R: Array) -> tuple[Any, Any]:
    """Return sine and cosine, times a number, of the turn nearest to a matrix (2, 2)."""
    (a, b), (c, d) = R.tolist()
    return c - b, a + d


def quaternion(R: Array) -> Array:
    """Return the unit quaternion (x, y, z, w) of a rotation (3, 3), with the sign of Eigen's."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    # of four times the squares of w, x, y and z the first is taken if it is large, or the largest
    of_w, of_x, of_y, of_z = 1.0 + xx + yy + zz, 1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx
    of_z = of_z - yy + zz
    wx, wy, wz = zy - yz, xz - zx, yx - xy
    xy, xz, yz = xy + yx, xz + zx, yz + zy
    row = array([of_x, xy, xz, wx, of_x])
    row = select(yy > xx, array([xy, of_y, yz, wy, of_y]), row)
    row = select((zz > xx) & (zz > yy), array([xz, yz, of_z, wz, of_z]), row)
    row = select(xx + yy + zz > 0.0, array([wx, wy, wz, of_w, of_w]), row)
    return np.asanyarray(row[:4] / (2.0 * root(row[4])))


def rotation_of(quaternion: Array) -> tuple[Any, Any]:
    """Return R (3, 3) of a quaternion (x, y, z, w) of any length, and whether that is valid."""
    size = length(quaternion)
    is_some = (size > NO_ROTATION) & (size < math.inf)
    x, y, z, w = (quaternion / select(is_some, size, 1.0)).tolist()
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return array([
        [1.0 - 2.0 * (yy + zz), 2.0 * (xy - z * w), 2.0 * (xz + y * w)],
        [2.0 * (xy + z * w), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - x * w)],
        [2.0 * (xz - y * w), 2.0 * (yz + x * w), 1.0 - 2.0 * (xx + yy)],
    ]), is_some  # fmt: skip


def log_rate(E: Array, omega: Array) -> Any:
    """Return φ' of φ = log E where E' = [ω]ₓE, shape (3,): ω less ½φ × ω and a rest of φ²."""
    phi = rotation_log(E)
    size = length(phi)
    sine, cosine = sine_and_cosine(size)
    square = size * size
    # (1 − ½ a sin a/(1 − cos a))/a², and its series, as at small angles digits cancel
    series = 1.0 / 12.0 + square * (1.0 / 720.0 + square * (1.0 / 30240.0 + square / 1209600.0))
    above, below = 2.0 * (1.0 - cosine) - size * sine, 2.0 * square * (1.0 - cosine)
    rest = _share(above, below, size > 0.2, series)
    C = cross_matrix(phi)
    once = C.dot(omega)
    return omega - 0.5 * once + rest * C.dot(once)


def quaternion_between(a: list[float], b: list[float]) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of R_a R_bᵀ from those of R_a and R_b."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    x = ax * bw - aw * bx + az * by - ay * bz
    y = ay * bw - aw * by + ax * bz - az * bx
    z = az * bw - aw * bz + ay * bx - ax * by
    return x, y, z, aw * bw + ax * bx + ay * by + az * bz


def rotation_between(a: list[float], b: list[float]) -> tuple[float, float, float]:
    """Return log(R_a R_bᵀ) [rad] from quaternions (x, y, z, w); NaN if one is invalid."""
    (ax, ay, az, aw), (bx, by, bz, bw) = a, b
    length_a = root(ax * ax + ay * ay + az * az + aw * aw)
    length_b = root(bx * bx + by * by + bz * bz + bw * bw)
    are_some = (length_a > NO_ROTATION) & (length_b > NO_ROTATION)
    are_some = are_some & (length_a < math.inf) & (length_b < math.inf)
    if are_some is False:
        return math.nan, math.nan, math.nan
    unit_a = [ax / length_a, ay / length_a, az / length_a, aw / length_a]
    unit_b = [bx / length_b, by / length_b, bz / length_b, bw / length_b]
    x, y, z, w = quaternion_between(unit_a, unit_b)
    sine = root(x * x + y * y + z * z)  # of half the angle
    # of the two quaternions of this rotation, the one that turns by at most 180°
    factor = _share(2.0 * angle(sine, abs(w)), sine, sine > _NO_SINE, 2.0)
    factor = select(are_some, select(w < 0.0, -factor, factor), math.nan)
    return factor * x, factor * y, factor * z


def turned(quaternion: list[float], phi: list[float]) -> tuple[float, float, float, float]:
    """Return a quaternion (x, y, z, w) after a turn by a rotation vector [rad]."""
    size = root(sum((each * each for each in phi[1:]), phi[0] * phi[0]))
    sine, cosine = sine_and_cosine(0.5 * size)
    factor = _share(sine, size, size > _NO_TURN, 0.5)
    x, y, z, w = quaternion
    return quaternion_between([*(factor * each for each in phi), cosine], [-x, -y, -z, w])


def _share(above: float, below: float, is_some: bool, otherwise: float) -> float:
    """Return a quotient, or a given value where the denominator is 0."""
    if is_some is False:
        return otherwise
    return select(is_some, above / below, otherwise)


def nearest_rotation(A: Array) -> Array:
    """Return the rotation R with the largest tr(RᵀA) (Kabsch); shape of A, (d, d).

    Raises:
        LinAlgError: A is beyond 1e100, for which LAPACK may not terminate.
    """
    if not A.dtype.hasobject and not math.hypot(*A.ravel().tolist()) < _FAR:
        raise np.linalg.LinAlgError("A must be finite and below 1e100")
    if len(A) == 2:
        sine, cosine = _plane_turn(A)
        size = root(sine * sine + cosine * cosine)
        s, c = _share(sine, size, size > 0.0, 0.0), _share(cosine, size, size > 0.0, 1.0)
        return np.asanyarray(array([[c, -s], [s, c]]))
    if A.dtype.hasobject:
        return _by_quaternion(A)
    U, _, Vt = np.linalg.svd(A)
    R = np.asarray(U.dot(Vt), dtype=np.float64)
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()  # a tenth of the time of LAPACK's determinant
    mirrors = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0.0
    return R - np.outer(2.0 * U[:, -1], Vt[-1]) if mirrors else R


def _by_quaternion(A: Array) -> Array:
    """Return the nearest rotation of symbols, by the quaternion that maximizes pᵀKp (Davenport).

    K's largest eigenvalue is at most √3‖A‖, from where Newton's method goes down to it.
    """
    A = A / select((size := root((A * A).sum())) > 0.0, size, 1.0)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = A.tolist()
    determinant = xx * (yy * zz - yz * zy) - xy * (yx * zz - yz * zx) + xz * (yx * zy - yy * zx)
    K = array([
        [xx - yy - zz, xy + yx, xz + zx, zy - yz],
        [xy + yx, yy - xx - zz, yz + zy, xz - zx],
        [xz + zx, yz + zy, zz - xx - yy, yx - xy],
        [zy - yz, xz - zx, yx - xy, xx + yy + zz],
    ])  # fmt: skip
    minors = _minors(K)
    constant = sum(((-1.0) ** j * K[0, j] * minors[0][j] for j in range(4)), 0.0)
    eight = 8.0 * determinant

    def newton(_: Any, values: tuple[Any]) -> tuple[Any]:
        (x,) = values  # of x⁴ − 2x² − 8 det A x + det K
        slope = 4.0 * x * (x * x - 1.0) - eight
        down = (x * x * (x * x - 2.0) - eight * x + constant) / select(slope > 0.0, slope, 1.0)
        return (x - select((down > 0.0) & (slope > 0.0), down, 0.0),)

    # a number of the graph, that a loop goes on with
    (largest,) = repeat(_QUARTIC_STEPS, newton, (select(xx > 2.0, xx, math.sqrt(3.0)),))
    adjugate = _minors(K - largest * np.eye(4))
    best, most = adjugate[0], abs(adjugate[0][0])
    best = array([best[j] * (-1.0) ** j for j in range(4)])
    for i in range(1, 4):  # columns of the adjugate are in proportion: the largest is exact
        row = array([adjugate[i][j] * (-1.0) ** (i + j) for j in range(4)])
        own = abs(adjugate[i][i])
        best, most = select(own > most, row, best), select(own > most, own, most)
    return np.asanyarray(rotation_of(best / select(most > 0.0, most, 1.0))[0])


def _minors(K: Array) -> list[list[Any]]:
    """Return the determinants of K (4, 4) without a row and a column."""

    def minor(i: int, j: int) -> Any:
        rows, columns = [r for r in range(4) if r != i], [c for c in range(4) if c != j]
        (a, b, c), (d, e, f), (g, h, k) = ([K[r, c] for c in columns] for r in rows)
        return a * (e * k - f * h) - b * (d * k - f * g) + c * (d * h - e * g)

    return [[minor(i, j) for j in range(4)] for i in range(4)]


def rotations_everywhere(d: int) -> Array:
    """Return rotations that are within 45° of every rotation, shape (k, d, d)."""
    if d == 2:
        return np.array([rotation_exp(np.array([a])) for a in np.arange(12) * math.pi / 6.0])
    # the icosahedral group's 60 rotations: products of two of its turns
    golden = 0.5 * (1.0 + math.sqrt(5.0))
    fifth = rotation_exp(0.4 * math.pi * np.array([0.0, 1.0, golden]) / math.hypot(1.0, golden))
    third = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    group = [np.eye(3)]
    for R in group:  # grows while it is gone through
        for turn in (fifth, third):
            new = turn @ R
            if not any(np.abs(new - other).max() < 1e-6 for other in group):
                group.append(new)
    return np.array(group)


def explained(M: Array, h: Array, A: Array) -> Any:
    """Return ½wᵀMw + hᵀw of w = vec A, which `best_rotation` maximizes."""
    w = A.ravel()
    return w.dot(0.5 * M.dot(w) + h)


def most_explained(M: Array, h: Array, rotations: Array) -> Array:
    """Return the rotation among some (k, d²), flat, that maximizes `explained`."""
    if not M.dtype.hasobject:
        values = rotations.dot(h) + 0.5 * (rotations.dot(M) * rotations).sum(axis=1)
        return np.asarray(rotations[int(np.argmax(values))])

    def better(i: Any, values: tuple[Any, Array]) -> tuple[Any, Array]:
        w = take(rotations, i)
        value = explained(M, h, w)
        return select(value > values[0], value, values[0]), select(value > values[0], w, values[1])

    first = rotations[0]
    start = explained(M, h, first), first.astype(object)
    return np.asanyarray(repeat(len(rotations), better, start)[1])


def best_rotation(M: Array, h: Array, A: Array) -> Array:
    """Return the rotation (d, d) near A that maximizes ½wᵀMw + hᵀw, w = vec A.

    Newton's method on the rotations A ← exp([δ]ₓ)A. Where the function is not concave along δ, or
    does not rise, A ← the rotation nearest to Mw + h, which never lowers it as M ≥ 0.

    M (d², d²) is symmetric, positive semidefinite; A (d, d) is where to start.
    """
    d = len(A)

    def step(_: Any, values: tuple[Array, Any, Any]) -> tuple[Array, Any, Any]:
        A, value, is_done = values
        if surely(is_done):
            return values
        slope, curvature = derivatives(M, h, A)
        turn, is_concave = _newton_step(slope, curvature)
        new = rotation_exp(turn).dot(A)
        is_small = is_concave & (length(turn) < _CONVERGED)
        higher = explained(M, h, new)

        def elsewhere() -> tuple[Array, Any]:
            other = nearest_rotation((M.dot(A.ravel()) + h).reshape(d, d))
            return other, explained(M, h, other)

        is_step = is_small | (is_concave & (higher >= value))
        other, rise = choose(complement(is_step), elsewhere, lambda: (new, higher))
        return select(is_done, A, other), select(is_done, value, rise), is_done | is_small

    value = explained(M, h, A)
    start = (A, value, complement(value == value))  # NaN is left as it is
    return nearest_rotation(repeat(_NEWTON_STEPS, step, start)[0])


def tangents(A: Array) -> Array:
    """Return ∂vec(exp([δ]ₓ)A)/∂δ at δ = 0, shape (d², 1 or 3)."""
    return np.asanyarray((generators(len(A)) @ A).reshape(-1, A.size).T)


def derivatives(M: Array, h: Array, A: Array) -> tuple[Array, Array]:
    """Return the gradient and the negative Hessian of `explained` along δ of A ← exp([δ]ₓ)A."""
    moved, rise = tangents(A).T, M.dot(A.ravel()) + h
    bent = _PRODUCTS[len(A)].dot(rise.reshape(A.shape).dot(A.T).ravel())
    bent = bent.reshape(len(moved), -1)
    return moved.dot(rise), -(moved.dot(M).dot(moved.T) + bent)


def _newton_step(slope: Array, curvature: Array) -> tuple[Array, Any]:
    """Return δ, at most `_LARGEST_STEP` long, and whether the function is concave; 0 where not."""
    rows = curvature.tolist()
    is_concave = rows[0][0] > 0.0
    if len(rows) == 3:
        (a, b, c), (_, e, f), (_, _, k) = rows
        minor = a * e - b * b
        determinant = k * minor - a * f * f + 2.0 * b * c * f - e * c * c
        is_concave = is_concave & (minor > 0.0) & (determinant > 0.0)
    if is_concave is False:
        return np.zeros(len(slope)), False
    step: Any = np.linalg.solve(curvature, slope)
    size = length(step)
    factor = _share(_LARGEST_STEP, size, size > _LARGEST_STEP, 1.0)
    return np.asanyarray(select(is_concave, step * factor, 0.0 * slope)), is_concave
