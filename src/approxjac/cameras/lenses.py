"""Lenses: distortion of rays by OpenCV's pinhole and fisheye models."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pinocchio as pin
from numpy.polynomial import Polynomial

from approxjac import law
from approxjac.errors import InvalidInputError
from approxjac.law.products import angle, length, polynomial, root, sine_and_cosine
from approxjac.validation import Array

_FARTHEST = 100.0  # no ray ‖(X/Z, Y/Z)‖ that is bent is longer: it is 89.4° away from the axis
_HALVINGS = 60  # of an interval that a radius is in
_NEWTON_STEPS = 8  # from the ray of a lens that is round; of real lenses three will do
_LEAST = 1e-9  # largest distance of a ray from where it was asked for, in focal lengths
_SURELY = 1.0 - 1e-6  # of a disc, within which the derivative is regular
_LARGEST = 1e9  # coefficient
_TINY = 1e-300
_BEFORE = 1e-9  # least distance of a point of the image before a tilted lens, in focal lengths
_COUNTS = (0, 1, 2, 3, 4, 5, 8, 12, 14)  # of coefficients that a lens may be given by


class Lens:
    """OpenCV's distortion of a pinhole camera, with up to 14 coefficients.

    With ρ = ‖p‖², the image of a ray p = (x, y) = (X/Z, Y/Z), in focal lengths from the center, is

        p (1 + k₁ρ + k₂ρ² + k₃ρ³)/(1 + k₄ρ + k₅ρ² + k₆ρ³)
          + (2p₁xy + p₂(ρ + 2x²), p₁(ρ + 2y²) + 2p₂xy) + (s₁ρ + s₂ρ², s₃ρ + s₄ρ²),

    on a sensor that is tilted by (τ_x, τ_y); the coefficients are those of `PinholeCamera`.

    The map is one to one on a disc of rays on which its derivative has a positive definite
    symmetric part; `largest_radius` is the radius of such a disc, by bounds on the derivative
    (exact for radial distortion). Rays beyond it have no image, so that no two share one.
    """

    shown_radius = math.inf  # of the image of rays within it, if round, in focal lengths

    def __init__(self, coefficients: Sequence[float]) -> None:
        given = list(coefficients)
        if len(given) not in _COUNTS:
            raise InvalidInputError(
                f"distortion must be (k1, k2, k3) or fewer of them, or OpenCV's 4, 5, 8, 12 or 14 "
                f"coefficients, got {len(given)}: {given}",
                given=coefficients,
            )
        if max(map(abs, given), default=0.0) > _LARGEST:
            message = f"distortion must have coefficients of at most {_LARGEST:g}, got {given}"
            raise InvalidInputError(message, given=coefficients)
        if len(given) <= 3:  # only radial
            k1, k2, k3 = (*given, 0.0, 0.0, 0.0)[:3]
            given = [k1, k2, 0.0, 0.0, k3]
        k1, k2, p1, p2, k3, k4, k5, k6, *rest = given + [0.0] * (14 - len(given))
        self._above, self._below = (1.0, k1, k2, k3), (1.0, k4, k5, k6)
        self._p, self._s = (p1, p2), tuple(rest[:4])
        tilt = rest[4:]
        self._T: Array | None = _tilt(*tilt) if any(tilt) else None
        self._T_inverse = None if self._T is None else np.asarray(np.linalg.inv(self._T), float)
        self._is_round = not any(self._p) and not any(self._s)
        self.is_straight = not any(given)  # without distortion
        self.largest_radius = self._largest_radius()

    def distorted(self, p: Array) -> Array:
        """Return the image of a ray p (2,), shape (2,)."""
        if self.is_straight:
            return p
        u, v = self._flat(*p.tolist())
        return np.asanyarray(law.array((u, v) if self._T is None else _moved(self._T, u, v)[:2]))

    def slopes(self, x: float, y: float) -> tuple[float, float, float, float]:
        """Return ∂(distorted)/∂p at p = (x, y), row by row."""
        if self.is_straight:
            return 1.0, 0.0, 0.0, 1.0
        a, b, c, d = self._flat_slopes(x, y)
        if self._T is None:
            return a, b, c, d
        (h00, h01, _), (h10, h11, _), (h20, h21, _) = self._T.tolist()
        u, v, depth = _moved(self._T, *self._flat(x, y))
        t00, t01 = (h00 - u * h20) / depth, (h01 - u * h21) / depth
        t10, t11 = (h10 - v * h20) / depth, (h11 - v * h21) / depth
        return t00 * a + t01 * c, t00 * b + t01 * d, t10 * a + t11 * c, t10 * b + t11 * d

    def undistorted(self, shown: Array) -> Array:
        """Return the ray (2,) with image `shown` (2,), or another valid ray if there is none."""
        if self.is_straight:
            return shown
        u, v = shown.tolist()
        if self._T_inverse is not None:
            u, v, _ = _moved(self._T_inverse, u, v, _BEFORE)
        wanted = root(u * u + v * v)
        if isinstance(wanted, float) and wanted == 0.0:
            return np.zeros(2)
        scale = law.select(wanted > 0.0, self._length(wanted) / wanted, 0.0)

        def nearer(_: int, ray: tuple[float, float]) -> tuple[float, float]:  # Newton's step
            x, y = ray
            a, b, c, d = self._flat_slopes(x, y)
            at_u, at_v = self._flat(x, y)
            du, dv, determinant = at_u - u, at_v - v, a * d - b * c  # > 0 within the disc
            x, y = x - (d * du - b * dv) / determinant, y - (a * dv - c * du) / determinant
            return shortened(self.largest_radius, x, y)

        x, y = scale * u, scale * v
        if not self._is_round:
            x, y = law.repeat(_NEWTON_STEPS, nearer, (x, y))
        return np.asanyarray(law.array([x, y]))

    def ray(self, shown: Array) -> Array:
        """Return the ray (2,) with image `shown` (2,); NaN if there is none."""
        if self.is_straight:
            return shown
        p = self.undistorted(shown)
        is_shown = length(self.distorted(p) - shown) <= _LEAST * (1.0 + length(shown))
        return np.asanyarray(law.select(is_shown, p, np.full(2, np.nan)))

    def _factors(self, rho: float) -> tuple[float, float]:
        """Return the radial factor and twice its derivative by ρ."""
        k1, k2, k3 = self._above[1:]
        factor, slope = polynomial(self._above, rho), polynomial((k1, 2.0 * k2, 3.0 * k3), rho)
        if any(self._below[1:]):
            k4, k5, k6 = self._below[1:]
            below = polynomial(self._below, rho)
            factor = factor / below
            slope = (slope - factor * polynomial((k4, 2.0 * k5, 3.0 * k6), rho)) / below
        return factor, 2.0 * slope

    def _length(self, wanted: float) -> float:
        """Return the length of the ray that a round lens shows at a distance from the middle."""
        # which grows up to the fold
        return inverse(lambda r: r * self._factors(r * r)[0], wanted, self.largest_radius)

    def _flat(self, x: float, y: float) -> tuple[float, float]:
        """Return the image of a ray on a sensor that is not tilted."""
        rho = x * x + y * y
        factor = self._factors(rho)[0]
        u, v = x * factor, y * factor
        if not self._is_round:
            (p1, p2), (s1, s2, s3, s4) = self._p, self._s
            xy = 2.0 * x * y
            u = u + (p1 * xy + p2 * (rho + 2.0 * x * x) + rho * (s1 + rho * s2))
            v = v + (p1 * (rho + 2.0 * y * y) + p2 * xy + rho * (s3 + rho * s4))
        return u, v

    def _flat_slopes(self, x: float, y: float) -> tuple[float, float, float, float]:
        rho = x * x + y * y
        factor, twice = self._factors(rho)
        a, b, d = factor + twice * x * x, twice * x * y, factor + twice * y * y
        if self._is_round:
            return a, b, b, d
        (p1, p2), (s1, s2, s3, s4) = self._p, self._s
        of_u, of_v = 2.0 * (s1 + 2.0 * rho * s2), 2.0 * (s3 + 2.0 * rho * s4)
        crossed = 2.0 * (p1 * x + p2 * y)
        return (
            a + 2.0 * p1 * y + 6.0 * p2 * x + of_u * x,
            b + crossed + of_u * y,
            b + crossed + of_v * x,
            d + 6.0 * p1 * y + 2.0 * p2 * x + of_v * y,
        )

    def _largest_radius(self) -> float:
        """Return the radius of the disc of rays on which the map is one to one.

        Of the derivative's symmetric part the radial distortion has the eigenvalues f and d(rf)/dr,
        with f its factor. At a radius r, p₁ and p₂ take at most 6‖p‖r from them, and s at most
        2r(‖(s₁, s₃)‖ + 2ρ‖(s₂, s₄)‖). As polynomials in r, times denominators.
        """
        if self.is_straight:
            return math.inf
        r = Polynomial([0.0, 1.0])
        above, below = (Polynomial(each)(r * r) for each in (self._above, self._below))
        s1, s2, s3, s4 = self._s
        p, first, second = math.hypot(*self._p), math.hypot(s1, s3), math.hypot(s2, s4)
        taken = r * (6.0 * p + 2.0 * first) + r**3 * (4.0 * second)
        growth = (above + r * above.deriv()) * below - r * above * below.deriv()
        conditions = [below, growth - taken * below * below, above * below - taken * below * below]
        if self._T is not None:  # what is shown must be before the sensor
            h20, h21, h22 = self._T[2].tolist()
            beside = r * r * (3.0 * p + first) + r**4 * second
            conditions.append(h22 * below - math.hypot(h20, h21) * (r * above + beside * below))
        scales = _FARTHEST ** np.arange(20.0)
        given = [np.asarray(each.coef, dtype=np.float64) for each in conditions]
        scaled = (each * scales[: len(each)] for each in given)
        largest = _FARTHEST * min(1.0, *map(_first_root, scaled))
        return largest if self._is_round else _SURELY * largest


_WIDEST = math.radians(85.0)  # [rad]; at 90° from the optical axis X/Z is infinite


class Fisheye(Lens):
    """OpenCV's fisheye lens, also called equidistant, or of Kannala and Brandt.

    A ray at the angle θ = atan ‖p‖ from the optical axis has its image in the ray's direction at
    the distance θ_d = θ (1 + k₁θ² + k₂θ⁴ + k₃θ⁶ + k₄θ⁸) from the center. Rays have images up to the
    angle `widest` [rad] at which θ_d stops growing, at most 85°.
    """

    def __init__(self, coefficients: Sequence[float]) -> None:
        if len(coefficients) not in (0, 4):
            raise InvalidInputError(
                "distortion of a fisheye lens must be OpenCV's (k1, k2, k3, k4), or none, got "
                f"{len(coefficients)}: {list(coefficients)}",
                given=coefficients,
            )
        self.is_straight, self._is_round = False, True
        self._T = self._T_inverse = None
        self._k = [1.0, *(coefficients or (0.0,) * 4)]
        self._growth = [(2.0 * i + 1.0) * k for i, k in enumerate(self._k)]  # of dθ_d/dθ, in θ²
        turn = min(1.0, _first_root(np.array(self._growth) * _WIDEST ** (2.0 * np.arange(5))))
        self.widest = _WIDEST * math.sqrt(turn)
        self.largest_radius, self.shown_radius = math.tan(self.widest), self._bent(self.widest)

    def _bent(self, theta: float) -> float:
        return theta * polynomial(self._k, theta * theta)

    def _factors(self, rho: float) -> tuple[float, float]:
        if isinstance(rho, float) and rho == 0.0:
            return 1.0, 0.0
        size = root(rho)
        theta = angle(size, 1.0)
        factor = self._bent(theta) / size
        twice = (polynomial(self._growth, theta * theta) / (1.0 + rho) - factor) / rho
        is_beside = rho > 0.0
        return law.select(is_beside, factor, 1.0), law.select(is_beside, twice, 0.0)

    def _length(self, wanted: float) -> float:
        sine, cosine = sine_and_cosine(inverse(self._bent, wanted, self.widest))
        return sine / cosine


def inverse(growing: Callable[[float], float], wanted: float, largest: float) -> float:
    """Invert a function that grows from 0 to `largest`, by bisection."""

    def halved(_: int, ends: tuple[float, float, float]) -> tuple[float, float, float]:
        low, high, wanted = ends
        middle = 0.5 * (low + high)
        is_short = growing(middle) < wanted
        return law.select(is_short, middle, low), law.select(is_short, high, middle), wanted

    low, high, _ = law.repeat(_HALVINGS, halved, (0.0, largest, wanted))
    return 0.5 * (low + high)


def shortened(radius: float, x: float, y: float) -> tuple[float, float]:
    """Return a ray (x, y), shortened to a length if it is longer."""
    size = root(x * x + y * y)
    size = law.select(size > _TINY, size, _TINY)
    back = law.select(size > radius, radius / size, 1.0)
    return back * x, back * y


def _first_root(coefficients: Array) -> float:
    """Return the first r from 0 to 1 at which a polynomial is 0; else infinity."""
    coefficients = np.where(np.abs(coefficients) > 1e-15, coefficients, 0.0)  # or it never counts
    roots = np.polynomial.polynomial.polyroots(np.trim_zeros(coefficients, "b"))
    real = roots[np.abs(roots.imag) < 1e-9 * np.abs(roots.real)].real
    return float(min(real[(real > 0.0) & (real <= 1.0)], default=math.inf))


def _tilt(tau_x: float, tau_y: float) -> Array:
    """Return OpenCV's homography (3, 3) onto a sensor that is tilted by two angles [rad]."""
    if not (abs(tau_x) < 0.5 * math.pi and abs(tau_y) < 0.5 * math.pi):
        raise InvalidInputError(
            f"distortion must have tau_x and tau_y between -pi/2 and pi/2 [rad], got {tau_x:g} and "
            f"{tau_y:g}",
            given=(tau_x, tau_y),
        )
    R = pin.rpy.rpyToMatrix(-tau_x, -tau_y, 0.0)
    along = np.array([[R[2, 2], 0.0, -R[0, 2]], [0.0, R[2, 2], -R[1, 2]], [0.0, 0.0, 1.0]])
    return np.asarray(along @ R)


def _moved(H: Array, u: float, v: float, least: float | None = None) -> tuple[float, float, float]:
    """Return a point that a homography moves, and its depth, the least one if it is smaller."""
    (h00, h01, h02), (h10, h11, h12), (h20, h21, h22) = H.tolist()
    depth = h20 * u + h21 * v + h22
    depth = depth if least is None else law.select(depth > least, depth, least)
    return (h00 * u + h01 * v + h02) / depth, (h10 * u + h11 * v + h12) / depth, depth
