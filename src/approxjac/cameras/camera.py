"""`Camera`, and the paper's planar one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.formatting import short_fields
from approxjac.validation import Array, Saved, as_array, as_number, plane_rows, shape_of


class Camera(Saved, ABC):
    """A camera: the image X of a point, and how the image moves with the point.

    Positions are those in the frame that the camera is fixed to.

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
        """Return the image of a point at r (3,), shape (2,); NaN where it has none."""

    @abstractmethod
    def interaction(self, r: Array) -> Array:
        """Return the image Jacobian J_I = ∂X/∂r, shape (2, 3)."""

    def seen(self, x: Array) -> Array:
        """Return image coordinates x (2,) if they are in the field of view, and NaN otherwise."""
        return x

    @property
    def calibration(self) -> Mapping[str, tuple[float, str]]:
        """Numbers of the camera's calibration that may be wrong, by name, and their units."""
        return {}

    def recalibrated(self, values: Mapping[str, float]) -> Camera:
        """Return this camera with other values of its calibration, if it has them."""
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
        return self

    @property
    def numbers(self) -> dict[str, Array]:
        """Numbers that images depend on, by the names of attributes, of cameras of one kind.

        Of a camera of one's own they are all its attributes that are numbers.
        """
        own = {name: np.asarray(value) for name, value in vars(self).items()}
        return {name: value for name, value in own.items() if value.dtype == np.float64}

    def with_numbers(self, numbers: Mapping[str, Any]) -> Self:
        """Return this camera with other `numbers`, such as some that are not known yet."""
        other = object.__new__(type(self))
        vars(other).update(vars(self), **numbers)
        return other


@dataclass(frozen=True, repr=False)
class PlanarCamera(Camera):
    """The paper's camera (section 5.1), parallel to the plane that the arm moves in.

    (x_s, y_s) = f/(z − f) [[cos δ, sin δ], [−sin δ, cos δ]] (x, y) + d, on the sensor [m]: the
    `PinholeCamera` whose depth is z − f for every point, and that sees without end.

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
