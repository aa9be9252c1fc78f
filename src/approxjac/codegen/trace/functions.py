"""sin, cos, tanh and exp of numbers that are not known yet, from arithmetic that rounds alike.

Each machine's own ones differ in their last bits. Sine and cosine are within two units
of the last place, tanh within four.
"""

from __future__ import annotations

from collections.abc import Sequence

from approxjac.codegen.trace.graph import POWER_SHIFT, Number, Scalar, select

# π/2 and ln 2 in parts of 33 bits and less, so that an integer up to 2²⁰ times each is exact
_QUARTERS = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_LN2 = (6.93147180369123816490e-01, 1.90821492927058770002e-10)
# minimax polynomials of FreeBSD's msun (k_sin.c, k_cos.c), from the lowest power
_SIN = (
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04,
    2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
_COS = (
    4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
    -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip
# of atan (s_atan.c), and the angles that it is reduced by, in two parts
_ATAN = (
    3.33333333333329318027e-01, -1.99999999998764832476e-01, 1.42857142725034663711e-01,
    -1.11111104054623557880e-01, 9.09088713343650656196e-02, -7.69187620504482999495e-02,
    6.66107313738753120669e-02, -5.83357013379057348645e-02, 4.97687799461593236017e-02,
    -3.65315727442169155270e-02, 1.62858201153657823623e-02,
)  # fmt: skip
_ANGLES = (  # up to a tangent of, the tangent and the angle
    (7 / 16, 0.0, 0.0, 0.0),
    (11 / 16, 0.5, 4.63647609000806093515e-01, 2.26987774529616870924e-17),
    (19 / 16, 1.0, 7.85398163397448278999e-01, 3.06161699786838301793e-17),
    (39 / 16, 1.5, 9.82793723247329054082e-01, 1.39033110312309984516e-17),
)  # fmt: skip
_RIGHT = (1.57079632679489655800e00, 6.12323399573676603587e-17)
_FACTORIALS = 14  # terms of exp up to ½ ln 2, whose remainder is 4e-18
_FLAT = 20.0  # beyond it, tanh is 1 to the last bit

LARGEST_ANGLE = 1e6
"""Angle up to which `sine_and_cosine` keeps its digits [rad]."""


def nearest_integer(x: Scalar) -> Number:
    """Return the integer next to x, the even one of two."""
    return select(abs(x) < 2.0**51, (x + 1.5 * 2.0**52) - 1.5 * 2.0**52, x)


def sine_and_cosine(x: Scalar) -> tuple[Number, Number]:
    """Return sin x and cos x, for x up to `LARGEST_ANGLE`."""
    quarter = (x * (2.0 / 3.14159265358979323846) + 0.5).floor()
    r: Number = x
    for part in _QUARTERS:
        r = r - quarter * part
    square = r * r
    sine = r + r * square * _polynomial(square, _SIN)
    cosine = (1.0 - 0.5 * square) + square * square * _polynomial(square, _COS)
    half = (quarter * 0.5).floor()
    odd = quarter - 2.0 * half  # whether sine and cosine change places
    behind = half - 2.0 * (half * 0.5).floor()  # whether x is in the third or fourth quarter
    swaps, sign = odd == 1.0, 1.0 - 2.0 * behind
    return (
        sign * select(swaps, cosine, sine),
        sign * (1.0 - 2.0 * odd) * select(swaps, sine, cosine),
    )


def tanh(x: Scalar) -> Number:
    """Return tanh x."""
    size = abs(x)
    size = select(size < _FLAT, size, _FLAT)
    grown = expm1(size + size)
    value = grown / (grown + 2.0)
    return select(x < 0.0, -value, value)


def arctangent(y: Number, x: Number) -> Number:
    """Return the angle of (x, y), from 0 to π/2 [rad]; neither is negative, nor both 0."""
    top, bottom, (high, low) = -x, y, _RIGHT
    for end, tangent, *angle in reversed(_ANGLES):
        within = y < end * x
        # tan(α − β) = (y − x tan β) / (x + y tan β)
        top = select(within, y - x * tangent, top)
        bottom = select(within, x + y * tangent, bottom)
        high, low = (select(within, *each) for each in zip(angle, (high, low), strict=True))
    t = top / bottom
    square = t * t
    return high - ((t * (square * _polynomial(square, _ATAN)) - low) - t)


def expm1(x: Scalar) -> Number:
    """Return exp(x) − 1, for x from −700 to 700."""
    k = (x * (1.0 / 0.693147180559945309417) + 0.5).floor()
    r: Number = x
    for part in _LN2:
        r = r - k * part
    coefficient, coefficients = 1.0, []
    for n in range(1, _FACTORIALS):
        coefficient /= n
        coefficients.append(coefficient)
    power = (k + POWER_SHIFT).graph.apply("power", k + POWER_SHIFT)
    return power * (r * _polynomial(r, coefficients)) + (power - 1.0)


def _polynomial(x: Number, coefficients: Sequence[float]) -> Number:
    value: Number = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value
