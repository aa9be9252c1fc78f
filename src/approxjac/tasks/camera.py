"""What a camera is, and the paper's planar one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np

from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.formatting import short_fields
from approxjac.validation import Array, as_array, as_number, axis_rows


class Calibrated(NamedTuple):
    """One number of a camera's calibration: its value and its unit."""

    value: float
    unit: str


class Camera(ABC):
    """A camera: the image X of a point, and how the image moves with the point.

    Positions are those in the frame that the camera is fixed to: the world, or the frame of the
    robot that `mount` names.
    """

    @property
    @abstractmethod
    def labels(self) -> tuple[str, ...]:
        """Names of the image coordinates of one point, length 2."""

    @property
    @abstractmethod
    def unit(self) -> str:
        """Unit of the image coordinates."""

    @property
    def mount(self) -> str | None:
        """Frame of the robot that the camera is fixed to; None is the world."""
        return None

    @abstractmethod
    def project(self, r: Array) -> Array:
        """Return the image of a point at r (3,), shape (2,); NaN where it has none."""

    @abstractmethod
    def interaction(self, r: Array) -> Array:
        """Return the image Jacobian J_I = ∂X/∂r, shape (2, 3)."""

    @abstractmethod
    def interaction_dot(self, r: Array, r_dot: Array) -> Array:
        """Return d/dt of `interaction` for a point that moves with ṙ, shape (2, 3)."""

    def seen(self, x: Array) -> Array:
        """Return image coordinates x (2,) if they are in the field of view, and NaN otherwise."""
        return x

    def _saved(self) -> dict[str, Any] | None:
        """Return what a file keeps of the camera; None of a class that `restored` does not know."""
        return None

    @property
    def calibration(self) -> Mapping[str, Calibrated]:
        """What may be wrong with the camera's calibration, by name."""
        return {}

    def recalibrated(self, values: Mapping[str, float]) -> Camera:
        """Return this camera with other values of its calibration.

        Raises:
            InvalidInputError: A camera without calibration, or numbers that no camera has.
            UnknownNameError: A name that is not in its calibration.
        """
        kind = type(self).__name__
        if not self.calibration:
            raise InvalidInputError(
                f"{kind} has no calibration to change, got {dict(values)}", given=values
            )
        for name in values:
            if name not in self.calibration:
                raise UnknownNameError(
                    "value", name, f"the calibration of {kind}", self.calibration
                )
        return self._recalibrated(values)

    def _recalibrated(self, values: Mapping[str, float]) -> Camera:
        """Return this camera with values that its calibration has."""
        return self


def fields_of(camera: Any, kind: type[Camera]) -> dict[str, Any] | None:
    """Return a dataclass' fields for a file; None of a camera of a class made from `kind`."""
    if type(camera) is not kind:
        return None
    given = {f.name: getattr(camera, f.name) for f in fields(camera) if f.init}  # type: ignore[arg-type]
    return {"kind": kind.__name__, **given}


@dataclass(frozen=True, repr=False)
class PlanarCamera(Camera):
    """The paper's camera (section 5.1), parallel to the plane that the arm moves in.

    (x_s, y_s) = f/(z − f) [[cos δ, sin δ], [−sin δ, cos δ]] (x, y) + d, on the sensor, in
    metres. It is the `PinholeCamera` whose depth is z − f for every point, looks along the normal
    of the plane and sees without end.

    Attributes:
        focal_length: f > 0 [m].
        distance: z > f, from the arm's plane to the image [m].
        roll: δ, turn of the image about the optical axis [rad].
        offset: d, where the world's origin appears, shape (2,) [m].
        plane: The world axes that are the paper's x and y.

    Raises:
        InvalidInputError: A focal length that is not positive, or a distance not beyond it.
    """

    focal_length: float
    distance: float
    roll: float = 0.0
    offset: Sequence[float] = (0.0, 0.0)
    plane: str = "xz"
    _J: Array = field(init=False, repr=False, compare=False)
    _d: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        f = as_number("focal_length", self.focal_length, unit="m", above=0.0)
        as_number("distance", self.distance, unit="m", above=f)
        as_number("roll", self.roll, unit="rad")
        offset = as_array("offset", self.offset, (2,), "m")
        object.__setattr__(self, "offset", tuple(offset.tolist()))
        rows = axis_rows("plane", self.plane)
        if len(rows) != 2:
            raise InvalidInputError(
                f"plane must name two world axes, such as 'xz', got {self.plane!r}",
                given=self.plane,
            )
        c, s = np.cos(self.roll), np.sin(self.roll)
        J = np.zeros((2, 3))
        J[:, rows] = self.magnification * np.array([[c, s], [-s, c]])
        object.__setattr__(self, "_J", J)
        object.__setattr__(self, "_d", np.array(self.offset, dtype=float))

    def __repr__(self) -> str:
        return short_fields(self)

    def _saved(self) -> dict[str, Any] | None:
        return fields_of(self, PlanarCamera)

    @property
    def magnification(self) -> float:
        """Magnification f / (z − f), image size over object size."""
        return self.focal_length / (self.distance - self.focal_length)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the image coordinates."""
        return ("x_s", "y_s")

    @property
    def unit(self) -> str:
        """Metres on the sensor."""
        return "m"

    def project(self, r: Array) -> Array:
        """Return the image of a point at world position r (3,), shape (2,) [m]."""
        return self._J @ r + self._d

    def interaction(self, r: Array) -> Array:
        """Return the image Jacobian, the same for every r, shape (2, 3) [m/m]."""
        return self._J.copy()

    def interaction_dot(self, r: Array, r_dot: Array) -> Array:
        """Return zero: the image Jacobian does not depend on r, shape (2, 3)."""
        return np.zeros((2, 3))

    @property
    def calibration(self) -> Mapping[str, Calibrated]:
        """Focal length [m], distance [m] and roll [rad]."""
        return {
            "focal_length": Calibrated(self.focal_length, "m"),
            "distance": Calibrated(self.distance, "m"),
            "roll": Calibrated(self.roll, "rad"),
        }

    def _recalibrated(self, values: Mapping[str, float]) -> PlanarCamera:
        changed: dict[str, Any] = {**values}
        return replace(self, **changed)
