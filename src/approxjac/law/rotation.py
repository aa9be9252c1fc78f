"""Rotations in space and in the plane: rotation vectors, and the rotation that explains data."""

from __future__ import annotations

import math

import numpy as np

from approxjac.law.branches import array, select
from approxjac.law.products import angle, root, sine_and_cosine
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
_NEWTON_STEPS = 5  # it goes on with the next frame
_LARGEST_STEP = 0.7  # of Newton's method [rad]
_CONVERGED = 1e-4  # after a step as small the next would be its square [rad]


def generators(d: int) -> Array:
    """Return G with rotations exp(Σ φᵢ Gᵢ) of d = 2 or 3 dimensions, shape (1 or 3, d, d)."""
    return _SPACE if d == 3 else _PLANE


def cross_matrix(phi: Array) -> Array:
    """Return [φ]ₓ = Σ φᵢ Gᵢ of φ (3,), or of an angle (1,) in the plane."""
    if len(phi) == 1:
        return np.asarray(phi * _PLANE[0])
    x, y, z = phi.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_exp(phi: Array) -> Array:
    """Return exp([φ]ₓ) of a rotation vector (3,), or of the angle (1,) in the plane [rad]."""
    angle = math.hypot(*phi.tolist())
    s, c = 1.0, 0.5
    if angle > 1e-4:
        s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
    return np.array(rodrigues(phi.tolist(), s, c))


def rodrigues(phi: list[float], s: float, c: float) -> list[list[float]]:
    """Return 1 + s[φ]ₓ + c[φ]ₓ² in plain numbers, which at this size are quicker than arrays."""
    if len(phi) == 1:
        (x,) = phi
        along = 1.0 - c * x * x
        return [[along, -s * x], [s * x, along]]
    x, y, z = phi
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, c * x * y, c * x * z, c * y * z
    x, y, z = s * x, s * y, s * z
    return [
        [1.0 - c * (yy + zz), xy - z, xz + y],
        [xy + z, 1.0 - c * (xx + zz), yz - x],
        [xz - y, yz + x, 1.0 - c * (xx + yy)],
    ]


def rotation_log(R: Array) -> Array:
    """Return the rotation vector (3,) of a rotation matrix, or the angle (1,) of one in the plane.

    Its length is at most π; at π either of the two vectors.
    """
    if len(R) == 2:
        return np.array([math.atan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])])
    twice = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = 0.5 * math.hypot(*twice.tolist()), 0.5 * (float(R.trace()) - 1.0)
    angle = math.atan2(sine, cosine)
    if cosine > -0.99:
        return np.asarray((0.5 if sine < 1e-6 else 0.5 * angle / sine) * twice)
    symmetric = 0.5 * (R + R.T) - cosine * np.eye(3)  # (1 − cos) a aᵀ
    axis = symmetric[:, int(np.argmax(symmetric.diagonal()))]
    axis = axis / np.linalg.norm(axis)
    return np.asarray((angle if axis.dot(twice) >= 0.0 else -angle) * axis)


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


def quaternion_between(a: list[float], b: list[float]) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of R_a R_bᵀ from those of R_a and R_b."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    x = ax * bw - aw * bx + az * by - ay * bz
    y = ay * bw - aw * by + ax * bz - az * bx
    z = az * bw - aw * bz + ay * bx - ax * by
    return x, y, z, aw * bw + ax * bx + ay * by + az * bz


def rotation_between(a: list[float], b: list[float]) -> tuple[float, float, float]:
    """Return log(R_a R_bᵀ) [rad] from quaternions (x, y, z, w); NaN where one is none."""
    length_a, length_b = _length(a), _length(b)
    are_some = (length_a > NO_ROTATION) & (length_b > NO_ROTATION)
    are_some = are_some & (length_a < math.inf) & (length_b < math.inf)
    if are_some is False:
        return math.nan, math.nan, math.nan
    unit_a, unit_b = [entry / length_a for entry in a], [entry / length_b for entry in b]
    x, y, z, w = quaternion_between(unit_a, unit_b)
    sine = root(x * x + y * y + z * z)  # of half the angle
    # of the two quaternions of this rotation, the one that turns by at most 180°
    factor = _share(2.0 * angle(sine, abs(w)), sine, sine > _NO_SINE, 2.0)
    factor = select(are_some, select(w < 0.0, -factor, factor), math.nan)
    return factor * x, factor * y, factor * z


def turned(quaternion: list[float], phi: list[float]) -> tuple[float, float, float, float]:
    """Return a quaternion (x, y, z, w) after a turn by a rotation vector [rad]."""
    size = _length(phi)
    half = 0.5 * size
    sine, cosine = sine_and_cosine(half)
    factor = _share(sine, size, size > _NO_TURN, 0.5)
    x, y, z, w = quaternion
    return quaternion_between([*(factor * each for each in phi), cosine], [-x, -y, -z, w])


def _share(above: float, below: float, is_some: bool, otherwise: float) -> float:
    """Return a quotient, or what it is where there is nothing below."""
    if is_some is False:
        return otherwise
    share: float = select(is_some, above / below, otherwise)
    return share


def _length(vector: list[float]) -> float:
    length: float = root(sum((each * each for each in vector[1:]), vector[0] * vector[0]))
    return length


def nearest_rotation(A: Array) -> Array:
    """Return the rotation R with the largest tr(RᵀA), by SVD (Kabsch); shape of A, (d, d).

    Raises:
        LinAlgError: Of A beyond 1e100, with which LAPACK may go on for ever.
    """
    if not math.hypot(*A.ravel().tolist()) < _FAR:
        raise np.linalg.LinAlgError("A must be finite and below 1e100")
    U, _, Vt = np.linalg.svd(A)
    R = np.asarray(U.dot(Vt), dtype=np.float64)
    return R - np.outer(2.0 * U[:, -1], Vt[-1]) if _mirrors(R) else R


def _mirrors(R: Array) -> bool:
    """Test det R < 0, in plain numbers: a tenth of the time of LAPACK."""
    if len(R) == 2:
        (a, b), (c, d) = R.tolist()
        return bool(a * d < b * c)
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    return bool(a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0.0)


def rotations_everywhere(d: int) -> Array:
    """Return rotations such that any other one is within 45° of one of them, shape (k, d, d)."""
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


def explained(M: Array, h: Array, A: Array) -> float:
    """Return ½wᵀMw + hᵀw of w = vec A, which `best_rotation` makes large."""
    w = A.ravel()
    return float(w.dot(0.5 * M.dot(w) + h))


def best_rotation(M: Array, h: Array, A: Array) -> Array:
    """Return the rotation (d, d) that makes ½wᵀMw + hᵀw largest, w = vec A, near A.

    Newton's method on the rotations A ← exp([δ]ₓ)A. Where the function is not concave along δ, or
    does not rise, A ← the rotation nearest to Mw + h, which never lowers it as M ≥ 0.

    Args:
        M: Symmetric, positive semidefinite, (d², d²).
        h: Shape (d²,).
        A: Where to start, (d, d).
    """
    d = len(A)
    G = generators(d)
    value = explained(M, h, A)
    for _ in range(_NEWTON_STEPS):
        slope, curvature = _derivatives(M, h, A, G)
        step = _newton_step(slope, curvature)
        if step is not None:
            new = rotation_exp(step).dot(A)
            if math.hypot(*step.tolist()) < _CONVERGED:
                return nearest_rotation(new)
            if (higher := explained(M, h, new)) >= value:
                A, value = new, higher
                continue
        new = nearest_rotation((M.dot(A.ravel()) + h).reshape(d, d))
        A, value = new, explained(M, h, new)
    return nearest_rotation(A)


def rotation_information(M: Array, h: Array, A: Array) -> Array:
    """Return the negative second derivative of `explained` along δ of A ← exp([δ]ₓ)A."""
    return _derivatives(M, h, A, generators(len(A)))[1]


def tangents(A: Array) -> Array:
    """Return ∂vec(exp([δ]ₓ)A)/∂δ at δ = 0, shape (d², 1 or 3)."""
    return np.asarray((generators(len(A)) @ A).reshape(-1, A.size).T)


def _derivatives(M: Array, h: Array, A: Array, G: Array) -> tuple[Array, Array]:
    """Return the gradient and the negative Hessian of `explained` along δ."""
    d = len(A)
    moved = (G @ A).reshape(len(G), -1)  # (g, d²)
    rise = M.dot(A.ravel()) + h
    bent = _PRODUCTS[d].dot(rise.reshape(d, d).dot(A.T).ravel()).reshape(len(G), -1)
    return moved.dot(rise), -(moved.dot(M).dot(moved.T) + bent)


def _newton_step(slope: Array, curvature: Array) -> Array | None:
    """Return δ, at most `_LARGEST_STEP` long; None where the function is not concave."""
    try:
        np.linalg.cholesky(curvature)
    except np.linalg.LinAlgError:
        return None
    step = np.asarray(np.linalg.solve(curvature, slope), dtype=np.float64)
    size = math.hypot(*step.tolist())
    return step if size <= _LARGEST_STEP else step * (_LARGEST_STEP / size)
