"""The pinhole camera, fixed in the world or on the arm, in OpenCV's conventions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import NoneType
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.tasks.camera import Calibrated, Camera
from approxjac.tasks.distortion import RadialDistortion
from approxjac.validation import Array, as_array, as_number, is_scalar, require

_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_ON_AN_EDGE = 17  # points of each edge of the image
_ORTHONORMAL = 1e-6  # how far from it a rotation may be, to be made so


@dataclass(frozen=True, repr=False)
class PinholeCamera(Camera):
    """A camera with perspective: u = f_x x″ + c_x, v = f_y y″ + c_y, in pixels.

    (x″, y″) is the ray (X/Z, Y/Z) through a point (X, Y, Z) in the camera's own axes, bent by
    radial distortion (1 + k₁ρ + k₂ρ² + k₃ρ³). All as in OpenCV: the camera's x axis points right
    in the image, y down, z along the view; (0, 0) is the middle of the upper left pixel. Where
    OpenCV gives (rvec, tvec) from the world to the camera, R = Rodrigues(rvec), this camera has
    `rotation` Rᵀ and `position` −Rᵀ tvec.

    For a Jacobian a point is taken at the nearest ray within the image and at a depth of at least
    `near`, where it is outside: a believed camera may have the point there, or even behind it,
    while the true one sees it.

    Attributes:
        focal_length: f_x = f_y, or (f_x, f_y), > 0 [px].
        size: Width and height of the image [px].
        position: Of the camera's centre, shape (3,) [m].
        rotation: Its axes (right, down, forward) as columns, shape (3, 3).
        center: (c_x, c_y), where the optical axis meets the image; its middle by default [px].
        distortion: (k₁, k₂, k₃), or fewer of them.
        mount: Frame of the robot that position and rotation are given in and that the camera
            moves with; None is the world.
        near: Smallest depth Z at which anything is seen, > 0 [m].

    Raises:
        InvalidInputError: Numbers out of range or of the wrong shape, a rotation that is none, or
            a distortion with which the image folds back within its size.
    """

    focal_length: float | Sequence[float]
    size: Sequence[int]
    position: Sequence[float] | Array = (0.0, 0.0, 0.0)
    rotation: Sequence[Sequence[float]] | Array = _UPRIGHT
    center: Sequence[float] | None = None
    distortion: Sequence[float] = ()
    mount: str | None = None
    near: float = 0.05
    labels = ("u", "v")
    unit = "px"
    _kind = "PinholeCamera"
    _f: Array = field(init=False, repr=False, compare=False)
    _c: Array = field(init=False, repr=False, compare=False)
    _R: Array = field(init=False, repr=False, compare=False)
    _p: Array = field(init=False, repr=False, compare=False)
    _R_t: Array = field(init=False, repr=False, compare=False)  # in the order that a step needs
    _edges: list[tuple[float, float]] = field(init=False, repr=False, compare=False)  # of rays
    _lens: RadialDistortion = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        focal = (self.focal_length,) * 2 if is_scalar(self.focal_length) else self.focal_length
        f = as_array("focal_length", focal, (2,), "px")
        if not (f > 0.0).all():
            raise InvalidInputError(
                f"focal_length must be > 0 [px], got {self.focal_length!r}", given=self.focal_length
            )
        size = as_array("size", self.size, (2,), "px")
        if not (size >= 1.0).all() or (size != np.round(size)).any():
            raise InvalidInputError(
                f"size must be the width and height of the image, whole numbers >= 1 [px], "
                f"got {self.size!r}",
                given=self.size,
            )
        middle = 0.5 * (size - 1.0)
        c = middle if self.center is None else as_array("center", self.center, (2,), "px")
        p = as_array("position", self.position, (3,), "m")
        R = _rotation(self.rotation)
        if not (np.ndim(self.distortion) == 1 and len(self.distortion) <= 3):
            raise InvalidInputError(
                f"distortion must be (k1, k2, k3) or fewer of them, OpenCV's without its "
                f"tangential p1 and p2, got {self.distortion!r}",
                given=self.distortion,
            )
        k = tuple(as_number("distortion", value) for value in self.distortion)
        as_number("near", self.near, unit="m", above=0.0)
        require("mount", self.mount, (str, NoneType), "the name of a frame, or None for the world")
        own = vars(self)  # frozen once it is built
        own.update(focal_length=tuple(f.tolist()), size=(int(size[0]), int(size[1])))
        own.update(position=tuple(p.tolist()), rotation=tuple(map(tuple, R.tolist())))
        own.update(center=tuple(c.tolist()), distortion=k)
        own.update(_f=f, _c=c, _p=p, _R=R, _R_t=R.T.copy(), _lens=RadialDistortion(k))
        self._require_unfolded()
        rays = np.array([self.ray(x) for x in self._border()])
        own["_edges"] = list(zip(rays.min(axis=0).tolist(), rays.max(axis=0).tolist(), strict=True))

    @classmethod
    def looking_at(
        cls,
        target: Sequence[float] | Array,
        position: Sequence[float] | Array,
        focal_length: float | Sequence[float],
        size: Sequence[int],
        *,
        up: Sequence[float] | Array = (0.0, 0.0, 1.0),
        **options: Any,
    ) -> PinholeCamera:
        """Return a camera whose optical axis goes through a point.

        Args:
            target: The point, shape (3,) [m].
            position: Of the camera, shape (3,) [m].
            focal_length: f_x = f_y, or (f_x, f_y) [px].
            size: Width and height of the image [px].
            up: Direction that is up in the image, shape (3,).
            **options: Center, distortion, mount and near, as for `PinholeCamera`.

        Raises:
            InvalidInputError: A target at the camera's own position, or straight up or down.
        """
        p = as_array("position", position, (3,), "m")
        view = as_array("target", target, (3,), "m") - p
        right = np.cross(view, as_array("up", up, (3,)))
        if not np.linalg.norm(right) > 1e-9 * max(1.0, float(np.linalg.norm(view))):
            raise InvalidInputError(
                f"target must be away from position, and not along up, which has no place in the "
                f"image then, got target {target!r} from {position!r} with up {up!r}",
                given=target,
            )
        z: Array = view / np.linalg.norm(view)
        x: Array = right / np.linalg.norm(right)
        return cls(focal_length, size, p, np.column_stack([x, np.cross(z, x), z]), **options)

    @classmethod
    def from_opencv(
        cls,
        K: Any,
        distortion: Sequence[float] | Array,
        rvec: Any,
        tvec: Any,
        size: Sequence[int],
    ) -> PinholeCamera:
        """Return the camera that OpenCV's calibration tells.

        Args:
            K: Camera matrix, shape (3, 3), without skew [px].
            distortion: OpenCV's (k₁, k₂, p₁, p₂, k₃), or the first four or two; p₁ = p₂ = 0.
            rvec: Rotation vector from the world to the camera, 3 numbers [rad].
            tvec: Translation, 3 numbers [m].
            size: Width and height of the image [px].

        Raises:
            InvalidInputError: Wrong shapes, skew, tangential or other distortion.
        """
        k = as_array("K", K, (3, 3), "px")
        if np.abs(k - [[k[0, 0], 0.0, k[0, 2]], [0.0, k[1, 1], k[1, 2]], [0.0, 0.0, 1.0]]).any():
            raise InvalidInputError(
                f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {k.tolist()}", given=K
            )
        five = np.zeros(5)
        given = np.ravel(np.asarray(distortion, dtype=float))
        five[: min(5, len(given))] = given[:5]
        if len(given) not in (0, 2, 4, 5) or five[2:4].any():
            raise InvalidInputError(
                f"distortion must be (k1, k2, p1, p2, k3), or the first four or two, with the "
                f"tangential p1 = p2 = 0, which this camera does not have, got {given.tolist()}",
                given=distortion,
            )
        R = pin.exp3(np.array(as_array("rvec", np.ravel(rvec), (3,), "rad")))
        t = as_array("tvec", np.ravel(tvec), (3,), "m")
        radial = tuple(five[[0, 1, 4]].tolist())
        return cls((k[0, 0], k[1, 1]), size, -R.T @ t, R.T, (k[0, 2], k[1, 2]), radial)

    def placement(self) -> tuple[Array, Array]:
        """Return rotation (3, 3) and position (3,) [m] in the frame that it is fixed to."""
        return self._R.copy(), self._p.copy()

    def in_camera(self, r: Array) -> Array:
        """Return a point r (3,) in the camera's own axes, (3,); its third entry is the depth Z."""
        return np.asarray(self._R_t @ (r - self._p))

    def project(self, r: Array) -> Array:
        """Return the image (2,) [px] of a point at r (3,), also beyond the edges of the image.

        NaN for a point behind the camera or nearer than `near`, and where the lens folds back.
        """
        X, Y, Z = self.in_camera(r).tolist()
        if self.near <= Z < math.inf:
            p = np.array([X / Z, Y / Z])
            if math.hypot(*p) < self._lens.largest_radius:
                return self.shown(p)
        return np.full(2, np.nan)

    def shown(self, p: Array) -> Array:
        """Return the image (2,) [px] of a ray (X/Z, Y/Z); shape (2,)."""
        return np.asarray(self._f * self._lens.distorted(p) + self._c)

    def seen(self, x: Array) -> Array:
        (u, v), (width, height) = x.tolist(), self.size
        inside = -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5
        return x if inside else np.full(2, np.nan)

    def nearest(self, x: Array) -> Array:
        """Return the image coordinates within the image that are nearest to x (2,); (2,)."""
        (u, v), (width, height) = x.tolist(), self.size
        return np.array([min(max(u, -0.5), width - 0.5), min(max(v, -0.5), height - 0.5)])

    def ray(self, x: Array) -> Array:
        """Return the ray (X/Z, Y/Z) whose image is x (2,) [px]; shape (2,)."""
        return self._lens.undistorted((x - self._c) / self._f)

    def locate(self, x: Array, depth: float) -> Array:
        """Return the position (3,) of the point at a depth Z [m] whose image is x (2,) [px]."""
        X, Y = self.ray(x).tolist()
        return np.asarray(self._R @ np.array([depth * X, depth * Y, depth]) + self._p)

    def interaction(self, r: Array) -> Array:
        """Return the image Jacobian J_I = ∂X/∂r, shape (2, 3) [px/m].

        With [−I, [r_c]ₓ] behind it, r_c the point and both in the camera's axes, it is the
        interaction matrix (2, 6) of the camera's own velocity in the literature.
        """
        x, y, Z = self._within(self.in_camera(r))
        a, b, d = self._lens.slopes(x, y)
        f_u, f_v = (self._f / Z).tolist()
        J = np.array([
            [f_u * a, f_u * b, -f_u * (a * x + b * y)],
            [f_v * b, f_v * d, -f_v * (b * x + d * y)],
        ])  # fmt: skip  # in the camera's own axes
        return np.asarray(J @ self._R_t)

    def _within(self, own: Array) -> tuple[float, float, float]:
        """Return ray (x, y) and depth of a point in the camera's axes, moved into its view."""
        X, Y, Z = own.tolist()
        Z = max(Z, self.near)
        (left, right), (top, bottom) = self._edges
        return min(max(X / Z, left), right), min(max(Y / Z, top), bottom), Z

    def with_error(
        self,
        *,
        shift: Sequence[float] | Array = (0.0, 0.0, 0.0),
        rotation: Sequence[float] | Array = (0.0, 0.0, 0.0),
        focal_factor: float = 1.0,
    ) -> PinholeCamera:
        """Return a camera that stands elsewhere and has another focal length.

        Args:
            shift: Of its centre along its own axes (right, down, forward), shape (3,) [m]. A
                shift of (0, 0, −d) makes all depths larger by d.
            rotation: Rotation vector in its own axes, shape (3,) [rad]; (0, 0, δ) is a roll by δ.
            focal_factor: Of both focal lengths, > 0.

        Raises:
            InvalidInputError: Wrong shapes, not finite, or a factor that is not positive.
        """
        moved = self._R @ as_array("shift", shift, (3,), "m")
        turned = self._R @ pin.exp3(np.array(as_array("rotation", rotation, (3,), "rad")))
        factor = as_number("focal_factor", focal_factor, above=0.0)
        f = tuple((self._f * factor).tolist())
        return replace(self, focal_length=f, position=self._p + moved, rotation=turned)

    @property
    def calibration(self) -> Mapping[str, Calibrated]:
        """f_x [px], distance [m] and roll [rad]: how far the camera stands back and is turned."""
        return {
            "focal_length": Calibrated(float(self._f[0]), "px"),
            "distance": Calibrated(0.0, "m"),
            "roll": Calibrated(0.0, "rad"),
        }

    def _recalibrated(self, values: Mapping[str, float]) -> PinholeCamera:
        back, roll = values.get("distance", 0.0), values.get("roll", 0.0)
        f = as_number("focal_length", values.get("focal_length", self._f[0]), unit="px", above=0.0)
        return self.with_error(
            shift=(0.0, 0.0, -back), rotation=(0.0, 0.0, roll), focal_factor=f / self._f[0]
        )

    def __repr__(self) -> str:
        shown = [f"{self.size[0]} x {self.size[1]} px", f"f = {_short(self.focal_length)} px"]
        shown += [f"position={_short(self.position)}", f"view={_short(self._R[:, 2].tolist())}"]
        if any(self.distortion):
            shown.append(f"distortion={_short(self.distortion)}")
        if self.mount is not None:
            shown.append(f"mount={self.mount!r}")
        return f"PinholeCamera({', '.join(shown)})"

    def _border(self) -> list[Array]:
        """Return points of the edges [px], among them those whose rays reach farthest."""
        count = _ON_AN_EDGE if any(self.distortion) else 2
        (left, right), (top, bottom) = ends = [(-0.5, n - 0.5) for n in self.size]
        along = [
            np.append(np.linspace(*end, count), np.clip(c, *end))
            for end, c in zip(ends, self._c, strict=True)
        ]
        return [np.array([u, v]) for u in along[0] for v in (top, bottom)] + [
            np.array([u, v]) for u in (left, right) for v in along[1]
        ]

    def _require_unfolded(self) -> None:
        """Refuse a lens whose image folds back before it reaches the corners."""
        radius = self._lens.largest_radius
        if math.isinf(radius):
            return
        reached = float(np.hypot(*self._lens.distorted(np.array([radius, 0.0]))))
        farthest = max(float(np.hypot(*((x - self._c) / self._f))) for x in self._border())
        if reached < farthest:
            raise InvalidInputError(
                f"distortion must not fold the image back within its size: rays of a radius of "
                f"{reached:.3g} are the farthest that it shows, and the corners need "
                f"{farthest:.3g}; got {self.distortion}",
                given=self.distortion,
            )


def _rotation(value: object) -> Array:
    R = as_array("rotation", value, (3, 3))
    if np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(R) < 0.0:
        raise InvalidInputError(
            f"rotation must have the camera's axes (right, down, forward) as orthonormal columns "
            f"of a right-handed frame, got {R.tolist()}",
            given=value,
        )
    U, _, V = np.linalg.svd(R)  # the nearest one, so that products of many stay rotations
    return np.asarray(U @ V)


def _short(values: Any) -> str:
    """Return numbers to four digits, in brackets."""
    return f"({', '.join(f'{value:.4g}' for value in np.ravel(values))})"
