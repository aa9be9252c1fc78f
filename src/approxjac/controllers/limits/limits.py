"""`Limits` of torques and joints; `Limit`, bounds of motion to derive from; and examples of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from approxjac import law
from approxjac.errors import InvalidInputError, failed
from approxjac.formatting import one_line, short_fields
from approxjac.robots import Dynamics, Robot
from approxjac.tasks.frame_tasks import FrameKinematics
from approxjac.validation import Array, as_array, as_limits, as_number, read_only, require, shape_of

_CONFIGURATIONS = 100
_SHARE, _RARE = 0.5, 0.05
_LEAST_LEFT = 0.05  # of the effort, where gravity takes all of it
_UNITS = {
    "effort": "N m or N",
    "rate": "N m/s or N/s",
    "velocity": "rad/s or m/s",
    "acceleration": "rad/s^2 or m/s^2",
}
_NO_INERTIA = 1e-12  # instead of none, which would divide by zero
_FAR = 1e100  # a speed that stands for infinity
_RETURN = 0.05  # speed that comes back from behind a wall [m/s]
_STILL = 1e-9  # speed that has no direction [m/s]
_CLEAR = 1e-3  # that is kept from a wall besides its margin, for what periods are off [m]


@dataclass(frozen=True, eq=False, repr=False)
class Limits:
    """Limits of the motors and joints of an arm. None or infinite is no limit.

    `Limits.of(robot)` returns those of the URDF; `dataclasses.replace` changes one.

    Attributes:
        effort: Largest abs(τ), a number or shape (n_v,) [N m or N].
        rate: Largest change of τ in time, a number or shape (n_v,) [N m/s or N/s].
        position: Smallest and largest joint positions, each shape (n_v,) [rad or m].
        velocity: Largest abs(q̇), a number or shape (n_v,) [rad/s or m/s].
        acceleration: Largest abs(q̈), a number or shape (n_v,) [rad/s² or m/s²].

    Raises:
        InvalidInputError: Limits that are not positive, not numbers, or reversed.
    """

    effort: float | Sequence[float] | Array | None = None
    rate: float | Sequence[float] | Array | None = None
    position: tuple[Sequence[float] | Array, Sequence[float] | Array] | None = None
    velocity: float | Sequence[float] | Array | None = None
    acceleration: float | Sequence[float] | Array | None = None
    __repr__ = short_fields

    def __post_init__(self) -> None:
        for name, unit in _UNITS.items():
            value = getattr(self, name)
            if value is not None:
                size = shape_of(value)
                limits = as_limits(name, value, max(size[0], 1) if size else 1, unit=unit)
                object.__setattr__(self, name, limits if size else float(limits[0]))
        if self.position is not None:
            object.__setattr__(self, "position", _range(self.position))

    @classmethod
    def of(cls, robot: Robot, scale: float = 1.0) -> Limits:
        """Return the limits of effort, position and velocity of a robot's URDF.

        `scale` > 0 is the usable share of the effort limits.
        """
        require("robot", robot, Robot, "a Robot")
        scale = as_number("scale", scale, above=0.0)
        return cls(
            effort=scale * robot.effort_limits,
            position=robot.position_limits,
            velocity=robot.velocity_limits,
        )

    def for_joints(self, nv: int) -> Limits:
        """Return these limits with an entry for each of n_v joints, infinite where there is none.

        Raises:
            InvalidInputError: Limits of another number of joints.
        """
        filled = {}
        for name in _UNITS:
            value = getattr(self, name)
            given = np.inf if value is None else value
            filled[name] = as_limits(name, given, nv, unit="one per joint")
        lower, upper = self.position or (np.full(nv, -np.inf), np.full(nv, np.inf))
        if len(lower) != nv:
            message = f"position must hold a range for each of {nv} joints, got {len(lower)}"
            raise InvalidInputError(message, given=self.position)
        return Limits(position=(lower, upper), **filled)


def sure_deceleration(robot: Robot, effort: Array) -> Array:
    """Return the deceleration that motors guarantee for each joint, (n_v,) [rad/s² or m/s²].

    It needs at most half of the effort left after gravity, of every motor, in 19 of 20
    configurations within the joint limits. The other half is for joints that brake together, for
    the terms in q̇, and for a payload. Infinite if the effort limits (n_v,) [N m or N] are unknown.
    """
    dynamics, drawn = Dynamics(robot), [*robot.configurations(_CONFIGURATIONS)]
    left = np.maximum(effort - np.abs([*map(dynamics.g, drawn)]), _LEAST_LEFT * effort)
    inertias = np.maximum(np.abs([*map(dynamics.M, drawn)]), _NO_INERTIA)
    rates = (left[:, :, np.newaxis] / inertias).min(axis=1)
    return np.asarray(_SHARE * np.quantile(rates, _RARE, axis=0, method="lower"))


def _range(position: object) -> tuple[Array, Array]:
    try:
        lower, upper = (np.array(side, dtype=np.float64) for side in position)  # type: ignore[attr-defined]
        fits = lower.shape == upper.shape and lower.ndim == 1 and bool((lower < upper).all())
    except (TypeError, ValueError):
        fits = False
    if not fits:
        raise InvalidInputError(
            "position must be the smallest and the largest position of each joint [rad or m], "
            f"got {position!r}",
            given=position,
        )
    return read_only(lower), read_only(upper)


@dataclass(eq=False, repr=False)
class LimitTerms:
    """The believed arm at one step, from which a limit makes its rows.

    Attributes:
        robot: The believed robot.
        q: Configuration, shape (nq,).
        v: Joint velocity q̇, shape (n_v,).
        frames: Function from a frame's name to its kinematics.
        approach: κ, largest approach speed per distance to a limit [1/s].
        braking: r, rate at which speeds decay to their bounds [1/s].
        deceleration: Deceleration that motors guarantee for each joint alone, shape (n_v,),
            finite [rad/s² or m/s²].
        jerk: Largest rate of joint accelerations, shape (n_v,) [rad/s³ or m/s³]; None is no limit.
    """

    robot: Robot
    q: Array
    v: Array
    frames: Callable[[str], FrameKinematics]
    approach: float
    braking: float
    deceleration: Array
    jerk: Array | None = None

    def position(self, frame: str | None = None) -> Array:
        """Return the position of a frame in the world, shape (3,) [m]; None is the tip."""
        return self._of(frame).position(self.q)

    def jacobian(self, frame: str | None = None) -> Array:
        """Return the Jacobian of a frame's velocity and angular velocity in the world, (6, n_v)."""
        return self._of(frame).jacobian(self.q)

    def drift(self, frame: str | None = None) -> Array:
        """Return J̇q̇ of a frame, shape (6,): its acceleration is Jq̈ + J̇q̇."""
        return np.asanyarray(self._of(frame).jacobian_dot(self.q, self.v).dot(self.v))

    def stay_above(
        self, value: Any, J: Any, drift: Any, returning: float = np.inf
    ) -> tuple[Array, Array, Array]:
        """Return rows that keep some h(q) at 0 or above.

        h may fall at κh at most, or slower if needed to brake in time; below 0 it has to return, at
        a rate of `returning` at most. h and J̇q̇ are (k,), J = ∂h/∂q is (k, n_v).
        """
        value, J, drift = (law.array(each) for each in (value, J, drift))
        fastest = np.where(value < 0.0, returning, _FAR)
        knee = (np.abs(J) * self.deceleration).max(axis=1) / self.approach
        falls = law.approach_speed(value, fastest, self.approach, knee)
        low = law.acceleration_bounds(J.dot(self.v), -falls, self.braking, self._jerk_of(J))
        return J, low - drift, np.full(len(J), np.inf)

    def stay_below(
        self, rate: Any, most: float | Array, J: Any, drift: Any
    ) -> tuple[Array, Array, Array]:
        """Return rows that keep speeds Jq̇ (k,) at their bounds `most` or below; J̇q̇ is (k,)."""
        rate, J, drift = (law.array(each) for each in (rate, J, drift))
        most = np.broadcast_to(most, (len(J),))
        high = law.acceleration_bounds(rate, most, self.braking, self._jerk_of(J))
        return J, np.full(len(J), -np.inf), high - drift

    def _jerk_of(self, J: Array) -> Array | None:
        return None if self.jerk is None else np.abs(J).dot(self.jerk)

    def _of(self, frame: str | None) -> FrameKinematics:
        return self.frames(self.robot.tip_or(None) if frame is None else frame)


class Limit(ABC):
    """Bounds of motion, as rows: low ≤ A q̈ ≤ high.

    Pass it to `TorqueLimited` with `Limits`. It has no memory, and several limiters may share it.
    Rows that use `np.where` instead of `if` can be compiled, too. Pages draw the plane of a limit
    with the attributes `point` and `normal`, as `Wall` has them.
    """

    @abstractmethod
    def rows(self, terms: LimitTerms, v: Array, dt: float) -> tuple[Array, Array, Array]:
        """Return A (k, n_v), low (k,) and high (k,), infinite where there is no bound.

        k is the same in every step. `LimitTerms.stay_above` makes rows of a function of q, and
        `LimitTerms.stay_below` of a speed.

        Args:
            terms: The believed arm at this step.
            v: Joint velocity q̇, shape (n_v,).
            dt: Sampling time [s].
        """


class Wall(Limit):
    """A plane that frames of the arm stay in front of.

    The believed arm stays 1 mm further away: with a margin as large as the error of the believed
    frame positions, so does the true one. A frame behind the plane returns at 5 cm/s.

    Args:
        point: A point on the plane in the world, shape (3,) [m].
        normal: Normal towards the allowed side, shape (3,), of any length.
        margin: Distance to keep from the plane, ≥ 0 [m].
        frames: Names of frames; the tip by default.
    """

    def __init__(
        self,
        point: Sequence[float] | Array,
        normal: Sequence[float] | Array,
        margin: float = 0.0,
        frames: Sequence[str] = (),
    ) -> None:
        self.point, normal = as_array("point", point, (3,)), as_array("normal", normal, (3,))
        length = float(np.linalg.norm(normal))
        if not length > 0.0:
            message = f"normal must have a direction, got {normal.tolist()}"
            raise InvalidInputError(message, given=normal)
        self.normal = normal / length
        self.margin = as_number("margin", margin, unit="m", minimum=0.0)
        self.frames = tuple(frames)

    def rows(self, terms: LimitTerms, v: Array, dt: float) -> tuple[Array, Array, Array]:
        """Return the rows, one for each frame."""
        n, frames = self.normal, self.frames or (None,)
        edge = n.dot(self.point) + self.margin + _CLEAR
        height = [n.dot(terms.position(each)) - edge for each in frames]
        J = [n.dot(terms.jacobian(each)[:3]) for each in frames]
        drift = [n.dot(terms.drift(each)[:3]) for each in frames]
        return terms.stay_above(height, J, drift, _RETURN)

    def __repr__(self) -> str:
        frames = f", frames={list(self.frames)}" if self.frames else ""
        point, normal = self.point.tolist(), self.normal.round(6).tolist()
        return f"Wall(point={point}, normal={normal}, margin={self.margin:g}{frames})"


class CartesianSpeed(Limit):
    """The largest speed of a frame's origin.

    Args:
        most: The speed [m/s].
        frame: Name of the frame; the tip by default.
    """

    def __init__(self, most: float, frame: str | None = None) -> None:
        self.most, self.frame = as_number("most", most, unit="m/s", above=0.0), frame

    def rows(self, terms: LimitTerms, v: Array, dt: float) -> tuple[Array, Array, Array]:
        """Return one row, along the velocity."""
        J = terms.jacobian(self.frame)[:3]
        velocity = J.dot(v)
        speed = law.root(velocity.dot(velocity))
        along = velocity / np.maximum(speed, _STILL)
        drift = along.dot(terms.drift(self.frame)[:3])
        return terms.stay_below([speed], self.most, along.dot(J)[np.newaxis], [drift])

    def __repr__(self) -> str:
        frame = "" if self.frame is None else f", frame={self.frame!r}"
        return f"CartesianSpeed({self.most:g}{frame})"


def require_rows(limit: Any, terms: LimitTerms, dt: float) -> None:
    """Raise an InvalidInputError if it is no limit, or its rows have wrong shapes or bounds."""
    require("limits", limit, Limit, "Limits(...), a Limit such as Wall(...), or a list of them")
    _as_rows(limit, limit.rows(terms, terms.v, dt), terms, is_first=True)


def rows_at(limit: Limit, terms: LimitTerms, dt: float, t: float) -> tuple[Array, Array, Array]:
    """Return the rows in the step at t [s]; a ControllerError if they fail or have wrong shapes."""
    if hasattr(terms.q, "arm_of"):  # symbols
        A, low, high = map(law.array, limit.rows(terms, terms.v, dt))
        return A, low, high
    try:
        return _as_rows(limit, limit.rows(terms, terms.v, dt), terms)
    except Exception as error:
        raise failed(f"limit {limit!r}", t, error) from error


def _as_rows(
    limit: Limit, rows: Any, terms: LimitTerms, is_first: bool = False
) -> tuple[Array, Array, Array]:
    nv = terms.robot.nv
    try:
        A, low, high = (np.asarray(each, dtype=float) for each in rows)
        fits = A.shape == (low.size, nv) and low.shape == high.shape == (low.size,)
        if is_first:
            fits = fits and bool(np.isfinite(A).all() and (low <= high).all())
    except (TypeError, ValueError):
        fits = False
    if not fits:
        raise InvalidInputError(
            f"rows of {limit!r} must return A of shape (k, {nv}), low and high of shape (k,), with "
            f"low <= high, got {one_line(rows)}",
            given=limit,
        )
    return A, low, high
