"""`Camera`: the paper's planar camera, and a pinhole camera in OpenCV's conventions."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Self

import numpy as np
import pinocchio as pin

from approxjac import law
from approxjac.cameras.lenses import Fisheye, Lens, shortened
from approxjac.errors import InvalidInputError, require_known
from approxjac.formatting import short_fields
from approxjac.law.products import length
from approxjac.validation import (
    Array,
    Saved,
    as_array,
    as_number,
    changed_copy,
    is_scalar,
    plane_rows,
    require,
    shape_of,
)


class Camera(Saved, ABC):
    """A camera: the image X of a point and its Jacobian.

    Positions r [m] are in the frame `mount` that the camera is fixed to.

    Attributes:
        labels: Names of the image coordinates of one point, length 2.
        unit: Unit of the image coordinates.
        mount: Frame of the robot that the camera is fixed to; None is the world.
    """

    labels: tuple[str, ...]
    unit: str
    mount: str | None = None

    @abstractmethod
    def project(self, r: Array) -> Array:
        """Return the image of a point at r (3,), shape (2,); NaN if it has none."""

    @abstractmethod
    def interaction(self, r: Array) -> Array:
        """Return the image Jacobian J_I = ∂X/∂r, shape (2, 3)."""

    def seen(self, x: Array) -> Array:
        """Return image coordinates x (2,), or NaN if they are outside the field of view."""
        return x

    @property
    def calibration(self) -> Mapping[str, tuple[float, str]]:
        """Name → value and unit of calibration parameters that may be wrong."""
        return {}

    def recalibrated(self, values: Mapping[str, float]) -> Camera:
        """Return this camera with other values of its `calibration`, by name."""
        for name in values:
            where = f"the calibration of {type(self).__name__}"
            require_known("value", name, where, self.calibration)
        return self

    @property
    def numbers(self) -> dict[str, Array]:
        """Attribute → number that images depend on; by default all float attributes."""
        own = {name: np.asarray(value) for name, value in vars(self).items()}
        return {name: value for name, value in own.items() if value.dtype == np.float64}

    def with_numbers(self, numbers: Mapping[str, Any]) -> Self:
        """Return this camera with other `numbers`, which may be symbols."""
        return changed_copy(self, **numbers)


@dataclass(frozen=True, repr=False)
class PlanarCamera(Camera):
    """The paper's camera (section 5.1), parallel to the plane that the arm moves in.

    (x_s, y_s) = f/(z − f) [[cos δ, sin δ], [−sin δ, cos δ]] (x, y) + d, on the sensor [m].

    Attributes:
        focal_length: f > 0 [m].
        distance: z > f, from the arm's plane to the image [m].
        roll: δ, rotation of the image about the optical axis [rad].
        offset: d, image of the world's origin, shape (2,) [m].
        plane: World axes of x and y above, such as "xz".

    Raises:
        InvalidInputError: A focal length that is not positive, or a distance not beyond it.
    """

    focal_length: float
    distance: float
    roll: float = 0.0
    offset: Sequence[float] = (0.0, 0.0)
    plane: str = "xz"
    labels = ("x_s", "y_s")
    _kind = "PlanarCamera"
    unit = "m"
    __repr__ = short_fields
    _J: Array = field(init=False, repr=False, compare=False)
    _d: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        f = as_number("focal_length", self.focal_length, unit="m", above=0.0)
        as_number("distance", self.distance, unit="m", above=f)
        as_number("roll", self.roll, unit="rad")
        offset = as_array("offset", self.offset, (2,), "m")
        rows = plane_rows(self.plane)
        c, s = np.cos(self.roll), np.sin(self.roll)
        J = np.zeros((2, 3))
        J[:, rows] = self.magnification * np.array([[c, s], [-s, c]])
        vars(self).update(offset=tuple(offset.tolist()), _J=J, _d=offset)  # frozen once it is built

    @property
    def magnification(self) -> float:
        """Magnification f / (z − f), image size over object size."""
        return self.focal_length / (self.distance - self.focal_length)

    def project(self, r: Array) -> Array:
        if shape_of(r) != (3,):
            as_array("the point r", r, (3,), "m")
        return np.asanyarray(self._J @ r + self._d)

    def interaction(self, r: Array) -> Array:
        return self._J.copy()

    @property
    def calibration(self) -> Mapping[str, tuple[float, str]]:
        units = {"focal_length": "m", "distance": "m", "roll": "rad"}
        return {name: (getattr(self, name), unit) for name, unit in units.items()}

    @property
    def numbers(self) -> dict[str, Array]:
        return {"_J": self._J, "_d": self._d}

    def recalibrated(self, values: Mapping[str, float]) -> PlanarCamera:
        super().recalibrated(values)
        return replace(self, **values)  # type: ignore[arg-type]  # none of them is a text


_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_ON_AN_EDGE = 17  # points of each edge of the image
_NOWHERE = np.full(2, np.nan)
_TILTS, _SHIFTS = ("tilt x", "tilt y"), ("shift x", "shift y", "shift z")
_WITHIN = 0.999  # of a round image, in which a ray is surely shown


@dataclass(frozen=True, repr=False)
class PinholeCamera(Camera):
    """A camera with perspective: u = f_x x″ + c_x, v = f_y y″ + c_y, in pixels.

    (x″, y″) is the ray (X/Z, Y/Z) of a point (X, Y, Z) in the camera's own axes (right, down,
    forward), distorted by the lens, as in OpenCV; (0, 0) is the centre of the upper left pixel.
    `from_opencv` takes OpenCV's calibration directly.

    Rays beyond the angle at which the lens's polynomial folds back, or beyond 85° of a fisheye
    lens, have no image (NaN). The Jacobian of a point outside the view is that at the nearest
    visible ray and a depth of at least `near`: the true camera may see it although this does not.

    Attributes:
        focal_length: f_x = f_y, or (f_x, f_y), > 0 [px].
        size: Width and height of the image [px].
        position: Position of the camera's centre, shape (3,) [m].
        rotation: Its axes (right, down, forward) as columns, shape (3, 3).
        center: Principal point (c_x, c_y); the image's centre by default [px].
        distortion: Up to three of (k₁, k₂, k₃); or OpenCV's 4, 5, 8, 12 or 14 coefficients (k₁,
            k₂, p₁, p₂, k₃, k₄, k₅, k₆, s₁, s₂, s₃, s₄, τ_x, τ_y); 4 or none of a fisheye lens.
        fisheye: True if the lens is OpenCV's fisheye model ("equidistant" in ROS).
        mount: Frame that position and rotation are given in; None is the world.
        near: Smallest depth Z at which points are seen, > 0 [m].

    Raises:
        InvalidInputError: Numbers out of range or of the wrong shape, axes that are not
            orthonormal, or a distortion that folds back within the image.
    """

    focal_length: float | Sequence[float]
    size: Sequence[int]
    position: Sequence[float] | Array = (0.0, 0.0, 0.0)
    rotation: Sequence[Sequence[float]] | Array = _UPRIGHT
    center: Sequence[float] | None = None
    distortion: Sequence[float] = ()
    mount: str | None = None
    near: float = 0.05
    fisheye: bool = False
    labels = ("u", "v")
    unit = "px"
    _kind = "PinholeCamera"
    _f: Array = field(init=False, compare=False)
    _c: Array = field(init=False, compare=False)
    _R: Array = field(init=False, compare=False)
    _p: Array = field(init=False, compare=False)
    _R_t: Array = field(init=False, compare=False)  # in the order that a step needs
    _edges: list[tuple[float, float]] = field(init=False, compare=False)  # of rays
    _sees_all: bool = field(init=False, compare=False)  # each pixel has a ray
    _lens: Lens = field(init=False, compare=False)

    def __post_init__(self) -> None:
        focal = (self.focal_length,) * 2 if is_scalar(self.focal_length) else self.focal_length
        f = as_array("focal_length", focal, (2,), "px")
        if not (f > 0.0).all():
            message = f"focal_length must be > 0 [px], got {self.focal_length!r}"
            raise InvalidInputError(message, given=self.focal_length)
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
        R = as_rotation(self.rotation)
        k: tuple[float, ...] = ()
        if shape_of(self.distortion) != (0,):
            k = tuple(as_array("distortion", self.distortion, ("k",)).tolist())
        require("fisheye", self.fisheye, bool, "True or False")
        lens = _lens(self.fisheye, k)
        as_number("near", self.near, unit="m", above=0.0)
        require("mount", self.mount, str | None, "the name of a frame, or None for the world")
        own = vars(self)  # frozen once it is built
        own.update(focal_length=tuple(f.tolist()), size=(int(size[0]), int(size[1])))
        own.update(position=tuple(p.tolist()), rotation=tuple(map(tuple, R.tolist())))
        own.update(center=tuple(c.tolist()), distortion=k)
        own.update(_f=f, _c=c, _p=p, _R=R, _R_t=R.T.copy(), _lens=lens)
        border, rays = _border(lens, tuple(f.tolist()), tuple(c.tolist()), self.size)
        is_lost = np.isnan(rays).any(axis=1)
        own["_sees_all"] = not is_lost.any()
        if is_lost.any() and not self.fisheye:  # which alone may show a round image
            raise InvalidInputError(
                "distortion must not fold the image back within its size: no ray is shown at "
                f"{border[is_lost][0].tolist()} px, as no ray longer than {lens.largest_radius:.3g}"
                " is. Calibrate with views that reach into the corners, or with fewer "
                f"coefficients; got {self.distortion}",
                given=self.distortion,
            )
        if is_lost.any():
            rays = np.array([self.ray(self.nearest(x)) for x in border])
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
        """Return a camera at `position` whose optical axis goes through `target`, both (3,) [m].

        `up` (3,) points upwards in the image and must not be parallel to the optical axis; other
        arguments are those of `PinholeCamera`.
        """
        return cls(focal_length, size, **options).standing_at(position, looking_at=target, up=up)

    @classmethod
    def from_opencv(
        cls,
        K: Any,
        distortion: Any,
        size: Sequence[int],
        *,
        rvec: Any = None,
        tvec: Any = None,
        camera_pose: Any = None,
        fisheye: bool = False,
        **options: Any,
    ) -> PinholeCamera:
        """Return the camera of a calibration by OpenCV.

        Its pose in the world, or in its `mount`, is given by rvec and tvec or by camera_pose.

        Args:
            K: Camera matrix, shape (3, 3), without skew [px].
            distortion: OpenCV's coefficients in any shape, or None.
            size: Width and height of the image [px].
            rvec: Rotation vector of r_camera = Rodrigues(rvec) r + tvec, 3 numbers [rad]; such as
                from `cv2.solvePnP`, for points r of a board in that frame.
            tvec: Its translation, 3 numbers [m].
            camera_pose: Matrix of r = R r_camera + p, shape (4, 4) [m]; such as R_cam2gripper and
                t_cam2gripper of `cv2.calibrateHandEye`.
            fisheye: True if the coefficients are those of `cv2.fisheye`.
            **options: `mount` and `near`, as for `PinholeCamera`.
        """
        k = as_array("K", K, (3, 3), "px")
        f, c = (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2])
        if (k != [[f[0], 0.0, c[0]], [0.0, f[1], c[1]], [0.0, 0.0, 1.0]]).any():
            message = f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {k.tolist()}"
            raise InvalidInputError(message, given=K)
        coefficients: Any = () if distortion is None else np.ravel(distortion)
        if len(coefficients) == 3:  # of which the last would be taken for k₃
            raise InvalidInputError(
                "distortion must be OpenCV's 4, 5, 8, 12 or 14 coefficients, or none, got 3: "
                f"{list(coefficients)}",
                given=distortion,
            )
        places = {"rvec": rvec, "tvec": tvec, "camera_pose": camera_pose}
        given = [name for name, each in places.items() if each is not None]
        R, p = np.eye(3), np.zeros(3)
        if given == ["rvec", "tvec"]:
            R = pin.exp3(np.array(as_array("rvec", np.ravel(rvec), (3,), "rad"))).T
            p = -R @ as_array("tvec", np.ravel(tvec), (3,), "m")
        elif given == ["camera_pose"]:
            R, p = as_pose("camera_pose", camera_pose)
        elif given:
            raise InvalidInputError(
                f"where a camera stands must be given by rvec and tvec, or by camera_pose, got "
                f"{' and '.join(given)}",
                given=given,
            )
        return cls(f, size, p, R, c, coefficients, fisheye=fisheye, **options)

    def standing_at(
        self,
        position: Sequence[float] | Array,
        looking_at: Sequence[float] | Array,
        *,
        up: Sequence[float] | Array = (0.0, 0.0, 1.0),
    ) -> PinholeCamera:
        """Return this camera at a position, looking at another (3,) [m], with `up` upwards."""
        p = as_array("position", position, (3,), "m")
        view = as_array("target", looking_at, (3,), "m") - p
        right = np.cross(view, as_array("up", up, (3,)))
        if not np.linalg.norm(right) > 1e-9 * max(1.0, float(np.linalg.norm(view))):
            raise InvalidInputError(
                f"target must not be at position, nor along up from it, "
                f"got target {looking_at!r} from {position!r} with up {up!r}",
                given=looking_at,
            )
        x, z = right / np.linalg.norm(right), view / np.linalg.norm(view)
        return replace(self, position=p, rotation=np.column_stack([x, np.cross(z, x), z]))

    def placement(self) -> tuple[Array, Array]:
        """Return rotation (3, 3) and position (3,) [m] in the frame `mount`."""
        return self._R.copy(), self._p.copy()

    def in_camera(self, r: Array) -> Array:
        """Return a point r (3,) [m] in the camera's own axes, (3,) [m]; the last is the depth Z."""
        return np.asanyarray(self._R_t @ (r - self._p))

    def project(self, r: Array) -> Array:
        """Return the image (2,) [px] of a point at r (3,), also beyond the edges of the image.

        NaN for a point behind the camera or nearer than `near`, and where the lens folds back.
        """
        if shape_of(r) != (3,):
            as_array("the point r", r, (3,), "m")
        X, Y, Z = self.in_camera(r).tolist()
        is_seen = (self.near <= Z) & (math.inf > Z)
        if is_seen is False:
            return _NOWHERE.copy()
        x, y = X / Z, Y / Z
        if self._lens.largest_radius < math.inf:
            is_seen = is_seen & (x * x + y * y < self._lens.largest_radius**2)
        return np.asanyarray(law.select(is_seen, self.shown(law.array([x, y])), _NOWHERE.copy()))

    def shown(self, p: Array) -> Array:
        """Return the image (2,) [px] of a ray (X/Z, Y/Z); shape (2,)."""
        return np.asanyarray(self._f * self._lens.distorted(p) + self._c)

    def seen(self, x: Array) -> Array:
        (u, v), (width, height) = x.tolist(), self.size
        inside = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
        if not self._sees_all:
            w = (x - self._c) / self._f
            inside = inside & (length(w) <= self._lens.shown_radius)
        return np.asanyarray(law.select(inside, x, _NOWHERE.copy()))

    def nearest(self, x: Array) -> Array:
        """Return the visible image coordinates (2,) nearest to x (2,) [px]."""
        (u, v), (width, height) = x.tolist(), self.size
        inside = law.array([_between(u, -0.5, width - 0.5), _between(v, -0.5, height - 0.5)])
        if self._sees_all:
            return np.asanyarray(inside)
        w = ((inside - self._c) / self._f).tolist()
        w = shortened(_WITHIN * self._lens.shown_radius, *w)
        return np.asanyarray(self._c + self._f * law.array(w))

    def ray(self, x: Array) -> Array:
        """Return the ray (X/Z, Y/Z) whose image is x (2,) [px], shape (2,); NaN if none has it."""
        return self._lens.ray((x - self._c) / self._f)

    def locate(self, x: Array, depth: float) -> Array:
        """Return the position (3,) of the point at a depth Z [m] whose image is x (2,) [px]."""
        X, Y = self.ray(x).tolist()
        return np.asanyarray(self._R @ law.array([depth * X, depth * Y, depth]) + self._p)

    def interaction(self, r: Array) -> Array:
        """Return the image Jacobian J_I = ∂X/∂r, shape (2, 3) [px/m]."""
        x, y, Z = self._within(self.in_camera(r))
        a, b, c, d = self._lens.slopes(x, y)
        f_u, f_v = (self._f / Z).tolist()
        J = law.array([
            [f_u * a, f_u * b, -f_u * (a * x + b * y)],
            [f_v * c, f_v * d, -f_v * (c * x + d * y)],
        ])  # fmt: skip  # in the camera's own axes
        return np.asanyarray(J @ self._R_t)

    def _within(self, own: Array) -> tuple[float, float, float]:
        """Return ray (x, y) and depth of a point in the camera's axes, moved into its view."""
        X, Y, Z = own.tolist()
        Z = law.select(self.near < Z, Z, self.near)
        along, across = self._edges
        x, y = _between(X / Z, *along), _between(Y / Z, *across)
        if not self._lens.is_straight:
            x, y = shortened(self._lens.largest_radius, x, y)
        return x, y, Z

    def with_error(
        self,
        *,
        shift: Sequence[float] | Array = (0.0, 0.0, 0.0),
        rotation: Sequence[float] | Array = (0.0, 0.0, 0.0),
        focal_factor: float = 1.0,
    ) -> PinholeCamera:
        """Return this camera with errors of its pose and focal length.

        Args:
            shift: Shift along this camera's axes (right, down, forward), shape (3,) [m].
            rotation: Rotation vector in this camera's axes, shape (3,) [rad]; (0, 0, δ) rolls the
                camera clockwise by δ, seen from behind it, and its image the other way.
            focal_factor: Factor of both focal lengths, > 0.
        """
        moved = self._R @ as_array("shift", shift, (3,), "m")
        turned = self._R @ pin.exp3(np.array(as_array("rotation", rotation, (3,), "rad")))
        f = tuple((self._f * as_number("focal_factor", focal_factor, above=0.0)).tolist())
        return replace(self, focal_length=f, position=self._p + moved, rotation=turned)

    @property
    def calibration(self) -> Mapping[str, tuple[float, str]]:
        """f_x [px]; shift back along the optical axis [m]; roll and tilts [rad]; shifts [m].

        It is shifted along its axes right, down and forward, tilted by a rotation vector across its
        optical axis, and then rolled about that.
        """
        turns, shifts = dict.fromkeys(("roll", *_TILTS), "rad"), dict.fromkeys(_SHIFTS, "m")
        errors = {"distance": "m", **turns, **shifts}
        first = {"focal_length": (float(self._f[0]), "px")}
        return first | {name: (0.0, unit) for name, unit in errors.items()}

    @property
    def numbers(self) -> dict[str, Array]:
        return {"_f": self._f, "_c": self._c, "_R": self._R, "_p": self._p}

    def with_numbers(self, numbers: Mapping[str, Any]) -> Self:
        other = super().with_numbers(numbers)
        vars(other).update(_R_t=other._R.T)
        return other

    def recalibrated(self, values: Mapping[str, float]) -> PinholeCamera:
        super().recalibrated(values)
        back, roll, *moved = (values.get(n, 0.0) for n in ("distance", "roll", *_TILTS, *_SHIFTS))
        f = as_number("focal_length", values.get("focal_length", self._f[0]), unit="px", above=0.0)
        turn = np.array([0.0, 0.0, roll])
        if any(tilt := moved[:2]):
            turn = pin.log3(pin.exp3(np.array([*tilt, 0.0])) @ pin.exp3(turn))
        shift = np.array(moved[2:]) - [0.0, 0.0, back]
        return self.with_error(shift=shift, rotation=turn, focal_factor=f / self._f[0])

    def __repr__(self) -> str:
        shown = [f"{self.size[0]} x {self.size[1]} px", f"f = {_short(self.focal_length)} px"]
        shown += [f"position={_short(self.position)}", f"view={_short(self._R[:, 2].tolist())}"]
        if any(self.distortion):
            shown.append(f"distortion={_short(self.distortion)}")
        if self.fisheye:
            shown.append("fisheye")
        if self.mount is not None:
            shown.append(f"mount={self.mount!r}")
        return f"PinholeCamera({', '.join(shown)})"


@lru_cache(maxsize=64)
def _lens(fisheye: bool, coefficients: tuple[float, ...]) -> Lens:
    return (Fisheye if fisheye else Lens)(coefficients)


@lru_cache(maxsize=64)  # a camera is often built again with another pose
def _border(
    lens: Lens, f: tuple[float, ...], c: tuple[float, ...], size: tuple[int, int]
) -> tuple[Array, Array]:
    """Return points of the edges [px], among them those with the longest rays, and rays; (n, 2)."""
    count = 2 if lens.is_straight else _ON_AN_EDGE
    (left, right), (top, bottom) = ends = [(-0.5, n - 0.5) for n in size]
    along = [
        np.append(np.linspace(*end, count), np.clip(middle, *end))
        for end, middle in zip(ends, c, strict=True)
    ]
    border = np.array(
        [(u, v) for u in along[0] for v in (top, bottom)]
        + [(u, v) for u in (left, right) for v in along[1]]
    )
    return border, np.array([lens.ray(x) for x in (border - c) / f])


def _between(value: float, low: float, high: float) -> float:
    value = law.select(value > low, value, low)
    return law.select(value < high, value, high)


def _short(values: Any) -> str:
    return f"({', '.join(f'{value:.4g}' for value in np.ravel(values))})"


_AXES = "the camera's axes (right, down, forward)"
_ORTHONORMAL = 1e-6  # how far from it a rotation may be, to be made so


def as_rotation(value: object, name: str = "rotation", axes: str = _AXES) -> Array:
    """Return axes as the columns of a matrix (3, 3), if they are orthonormal."""
    R = as_array(name, value, (3, 3))
    if np.abs(R @ R.T - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(R) < 0.0:
        raise InvalidInputError(
            f"{name} must have {axes} as orthonormal columns of a right-handed frame, got "
            f"{R.tolist()}",
            given=value,
        )
    U, _, V = np.linalg.svd(R)  # the nearest one, so that products of many stay rotations
    return np.asarray(U @ V)


def as_pose(name: str, value: object) -> tuple[Array, Array]:
    """Return rotation (3, 3) and position (3,) of a homogeneous matrix (4, 4) [m]."""
    pose = as_array(name, value, (4, 4), "m")
    if np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0]).max() > _ORTHONORMAL:
        message = f"{name} must have the last row (0, 0, 0, 1), got {pose[3].tolist()}"
        raise InvalidInputError(message, given=value)
    return as_rotation(pose[:3, :3], name, "axes"), np.array(pose[:3, 3])


def tag_corners(size: float, tag_pose: object = None) -> Array:
    """Return the corners of a square tag, as points of an `ImageTask`, shape (4, 3) [m].

    The order is that of `cv2.aruco`: upper left, upper right, lower right, lower left of the
    upright tag. (For pupil-apriltags, which starts at the lower left and goes the other way round,
    use `corners[::-1]`.) `CombinedTask.balanced` reduces the eight coordinates to six.

    Args:
        size: Side length of its black square, > 0 [m].
        tag_pose: Pose of the tag in the frame that it is fixed to, shape (4, 4) [m]; its x axis
            points right, y up, and z out of the tag. By default the identity.

    Raises:
        InvalidInputError: A size that is not positive, or a matrix that is no pose.
    """
    half = 0.5 * as_number("size", size, unit="m", above=0.0)
    corners = half * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    if tag_pose is None:
        return corners
    R, p = as_pose("tag_pose", tag_pose)
    return np.asarray(corners @ R.T + p)
