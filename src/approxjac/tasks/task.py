"""`Task`: X = h(q) and its Jacobian, for one robot, true or believed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from approxjac import law
from approxjac.cameras.camera import Camera
from approxjac.errors import InvalidInputError
from approxjac.formatting import joined, spaced
from approxjac.robots import Robot
from approxjac.robots.traced import arm_of, moved
from approxjac.validation import Array, Immutable, Saved, as_array, as_vector, require

_STILL = 1e-250  # a speed at which nothing moves [rad/s or m/s]
_DIFFERENCE = 1e-5  # of q, either way, from which a rate is taken [rad or m]


class Feature(NamedTuple):
    """A frame's origin, or points seen by a camera, that an elementary task follows."""

    entries: slice  # where its values are in x
    frame: str | None  # that is followed, or that the points are fixed to; None is the world
    axes: str = ""  # world axes of the position that x gives, such as "xyz"; none of an image
    camera: Camera | None = None  # what sees it, if anything does
    points: Array = np.zeros((1, 3))  # of the frame, shape (k, 3) [m]
    placed: tuple[Array, Array] | None = None  # R, b of a position x = R p + b in other axes

    def place(self, x: Array) -> Array:
        """Return the coordinates along `axes` of the position that values (..., n_x) give [m]."""
        own: Array = x[..., self.entries][..., : len(self.axes)]
        return own if self.placed is None else (own - self.placed[1]) @ self.placed[0]

    def images(self, x: Array) -> Array:
        """Return the images of the points in values (..., n_x), without depths, (..., k, 2)."""
        own, k = x[..., self.entries], len(self.points)
        images: Array = own.reshape(*own.shape[:-1], k, own.shape[-1] // k)
        return images[..., :2]


class Task(Immutable, Saved, ABC):
    """A task X = h(q) of one robot.

    A controller uses only the Jacobian Ĵ of a task of the *believed* robot: the value X comes from
    a measurement. A sensor is the same kind of object on the *true* robot. The error e of a value
    to a target has m coordinates; usually it is X − X_d, and X has m entries, too.

    For a task of your own, implement `value`, `jacobian` and `on`, and for another error also
    `error` and `displaced`; see examples/19_own_task.py.

    Immutable, but it owns scratch memory: one instance per thread.

    Args:
        robot: The robot whose kinematics the task uses.
        labels: Names of the error's coordinates, length m.
        units: Their units, length m.
        n_x: Length of a value; m by default.

    Attributes:
        m: Number of task coordinates: of the error, and rows of the Jacobian.
        n_x: Length of a value X, and of a target.
        uses_x: True if the Jacobian depends on the measured x besides q.
        features: Frames and points that the task follows, to draw them.
        subtracts: True if the error is x − x_d.
        origin: A valid value, to which the errors of others are finite, shape (n_x,).
        overdetermined: True if there may be more coordinates than joints, to be combined.
        ignored: Entries of x that no error depends on.
        parts: Parts of x that are measured or lost at once, such as a point of an image: entries of
            x, and of the error.

    Raises:
        InvalidInputError: Labels and units of different lengths, or more of them than joints.
    """

    uses_x = False
    features: tuple[Feature, ...] = ()
    subtracts: bool
    origin: Array
    overdetermined = False
    ignored: list[int]
    parts: tuple[tuple[slice, slice], ...]

    def __init__(
        self, robot: Robot, labels: Sequence[str], units: Sequence[str], n_x: int | None = None
    ) -> None:
        require("robot", robot, Robot, "a Robot")
        m = len(labels)
        if len(units) != m:
            raise InvalidInputError(
                f"units must be one for each of the labels {tuple(labels)}, got {tuple(units)}",
                given=units,
            )
        if m > robot.nv and not self.overdetermined:  # Ĵ⁺ would not exist
            raise InvalidInputError(
                f"a task must have at most as many coordinates as the robot has joints "
                f"(m <= n_v), got m = {m} for {robot.name} with n_v = {robot.nv}",
                given=m,
            )
        self.robot = robot
        self.labels, self.units = tuple(labels), tuple(units)
        self.m, self.n_x = m, m if n_x is None else n_x
        vars(self).update(
            subtracts=type(self).error is Task.error,
            origin=np.zeros(self.n_x),
            ignored=[],
            parts=((slice(0, self.n_x), slice(0, m)),),
        )

    @abstractmethod
    def value(self, q: Array) -> Array:
        """Return X = h(q), shape (n_x,), with NaN for parts that a sensor would not see."""

    @abstractmethod
    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        """Return J of ė = J q̇ near e = 0 (∂h/∂q where e = X − X_d), shape (m, n_v).

        Args:
            q: Configuration, shape (nq,).
            x: Measured value, shape (n_x,), for a task that uses it, such as an image whose depth
                is measured. Lost parts (NaN), or all for None, are replaced by `value(q)`.
        """

    @abstractmethod
    def on(self, robot: Robot) -> Task:
        """Return the same task for another robot, such as the true one."""

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        """Return d/dt of `jacobian` along q̇, shape (m, n_v).

        By default a central difference, with a relative error of about 1e-9.
        """
        is_known = type(q) is np.ndarray or arm_of(self.robot, q) is None
        if is_known:
            q, v = self.robot.configuration(q), as_vector("v", v, self.robot.nv)
        speed = np.linalg.norm(v) if is_known else law.length(v)
        step = _DIFFERENCE / np.maximum(speed, _STILL)
        after, before = (self.jacobian(moved(self.robot, q, h * v)) for h in (step, -step))
        return np.asanyarray((after - before) / (2.0 * step))

    def error(self, x: Array, x_d: Array) -> Array:
        """Return the error e (m,) of a value to a target, both (n_x,); NaN if x is lost."""
        return x - x_d

    def displaced(self, x: Array, e: Array) -> Array:
        """Return the value whose error to x (n_x,) is e (m,); shape (n_x,)."""
        return x + e

    def target(self, x_d: object) -> Array:
        """Return a target as a read-only array (n_x,), or raise an InvalidInputError."""
        target = as_array("target", x_d, (self.n_x,), joined(self.units))
        if not (np.abs(self.error(target, target)) < 1e-6).all():
            message = f"target must be a value of {self!r}, got {target.tolist()}"
            raise InvalidInputError(message, given=x_d)
        return target

    def describe(self) -> str:
        """Return the task in words, such as "position task (x, y, z)"."""
        return f"{spaced(type(self).__name__)} ({', '.join(self.labels)})"

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.robot.name!r})"

    __reduce__ = object.__reduce__  # type: ignore[assignment]  # what a task is made of copies itself: `FrameKinematics`

    @property
    def measured(self) -> Task:
        """The task that the plant's sensor measures; this one, unless combined."""
        return self

    def visible(self, x: Array) -> Array:
        """Return a value x (n_x,) as a sensor delivers it: NaN in parts that it cannot see."""
        return x

    def is_mirrored(self, x: Array, other: Array) -> bool:
        """Return True if points run round the other way in one value (n_x,) than in another."""
        return False

    def sensor_jacobian(self, q: Array) -> Array:
        """Return `jacobian` at the true depths, whatever a controller assumes; shape (m, n_v)."""
        return self.jacobian(q)

    def error_jacobian(self, e: Array, J: Array) -> Array:
        """Return ∂e/∂q where the error is e (m,) and the Jacobian is J; shape (m, n_v)."""
        return J
