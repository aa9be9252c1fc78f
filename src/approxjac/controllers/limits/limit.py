"""`Limit`: bounds of motion to derive from, and two examples: `Wall` and `CartesianSpeed`."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from approxjac import law
from approxjac.errors import InvalidInputError, failed
from approxjac.formatting import one_line
from approxjac.robots import Robot
from approxjac.tasks.frame_tasks import FrameKinematics
from approxjac.validation import Array, as_array, as_number, require

_FAR = 1e100  # a speed that stands for infinity
_RETURN = 0.05  # speed that comes back from behind a wall [m/s]
_STILL = 1e-9  # speed that has no direction [m/s]
_CLEAR = 1e-3  # that is kept from a wall besides its margin, for what periods are off [m]


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
