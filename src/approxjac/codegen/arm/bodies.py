"""Bodies that move, on symbols: Newton's and Euler's equations of one link."""

from __future__ import annotations

from typing import NamedTuple

from approxjac.codegen.trace.symbols import Number, Symbols, symbols


class Motion(NamedTuple):
    """Motion of a link, in its own axes.

    Attributes:
        omega: Its angular velocity, shape (3,) [rad/s].
        omega_dot: Its angular acceleration, shape (3,) [rad/s²].
        a: Acceleration of the joint's origin, shape (3,) [m/s²].
        gradient: U (3, 3), so that what is at r in the link's axes has acceleration a + U r; None
            of a base that does not turn.
    """

    omega: Symbols
    omega_dot: Symbols
    a: Symbols
    gradient: Symbols


class Body(NamedTuple):
    """Mass [kg], first moments (3,) [kg m] and second moments (3, 3) [kg m²] about an origin."""

    m: Number
    h: Symbols
    S: Symbols


Wrench = tuple[Symbols, Symbols]
"""A force and its moment about the joint's origin, in the link's axes."""


def force(body: Body, a: Symbols, U: Symbols) -> Wrench:
    """Return what a link alone needs to accelerate as a + U r."""
    m, h, S = body
    # ∫ r × U r dm
    turning = symbols([
        S[0, 1] * U[2, 0] - S[0, 2] * U[1, 0] + S[1, 1] * U[2, 1] - S[2, 2] * U[1, 2]
        + S[1, 2] * (U[2, 2] - U[1, 1]),
        S[1, 2] * U[0, 1] - S[0, 1] * U[2, 1] + S[2, 2] * U[0, 2] - S[0, 0] * U[2, 0]
        + S[0, 2] * (U[0, 0] - U[2, 2]),
        S[0, 2] * U[1, 2] - S[1, 2] * U[0, 2] + S[0, 0] * U[1, 0] - S[1, 1] * U[0, 1]
        + S[0, 1] * (U[1, 1] - U[0, 0]),
    ])  # fmt: skip
    return a * m + U @ h, turning + cross(h, a)


def gradient(omega: Symbols, omega_dot: Symbols) -> Symbols:
    """Return U of a `Motion`, from angular velocity and acceleration (3,)."""
    (x, y, z), (dx, dy, dz) = omega, omega_dot
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return symbols([
        [-(yy + zz), xy - dz, xz + dy],
        [xy + dz, -(xx + zz), yz - dx],
        [xz - dy, yz + dx, -(xx + yy)],
    ])  # fmt: skip


def cross(a: Symbols, b: Symbols) -> Symbols:
    """Return a × b, shape (3,)."""
    return symbols([
        a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    ])  # fmt: skip
