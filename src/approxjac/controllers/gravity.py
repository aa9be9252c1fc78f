"""Sources of the gravity torque of a law."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, get_args

import numpy as np
import pinocchio as pin

from approxjac.controllers.gains import Diagonals
from approxjac.controllers.tuning import default_adaptation
from approxjac.errors import InvalidInputError
from approxjac.formatting import listed, short
from approxjac.robots import GravityRegressor, Robot
from approxjac.tasks import Task
from approxjac.validation import (
    Array,
    Immutable,
    as_array,
    as_diagonal,
    as_entries,
    as_limits,
    as_number,
    is_scalar,
    require,
)


class _RobotGravity(Immutable):
    def __init__(self, robot: Robot) -> None:
        self._remember(locals())
        require("robot", robot, Robot, "the believed Robot")
        self.robot = robot

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.robot.name!r})"


class ModelGravity(_RobotGravity):
    """g(q) of a robot's model, by RNEA: exact as far as its masses and lengths are.

    Args:
        robot: The believed robot.
    """

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        model = robot.model
        self._torque_at = partial(pin.computeGeneralizedGravity, model, model.createData())

    def torque(self, q: Array) -> Array:
        """Return g(q), shape (n_v,) [N m or N]; an alias of scratch memory."""
        g: Array = self._torque_at(q)
        return g


class NoGravity(_RobotGravity):
    """No gravity torque: the robot compensates it by itself, or there is none.

    Args:
        robot: The believed robot.
    """

    def torque(self, q: Array) -> Array:
        """Return zeros, shape (n_v,)."""
        return np.zeros(self.robot.nv)


class RegressorGravity(Immutable):
    """g(q) = Z(q) θ, eq. (27), with θ known from elsewhere (identification, a data sheet).

    It is exact even where the regressor's robot has wrong lengths: see `GravityRegressor`.

    Args:
        regressor: Z(q) of the believed robot.
        theta: Its parameters, shape (p,).

    Raises:
        InvalidInputError: Wrong shape or not finite.
    """

    def __init__(self, regressor: GravityRegressor, theta: Sequence[float] | Array) -> None:
        self._remember(locals())
        wanted = "a GravityRegressor of the believed robot"
        require("regressor", regressor, GravityRegressor, wanted)
        self.regressor, self.robot = regressor, regressor.robot
        self.theta = as_array("theta", theta, (regressor.p,))

    def __repr__(self) -> str:
        return f"RegressorGravity({self.robot.name!r}, theta={listed(self.theta)})"

    def torque(self, q: Array) -> Array:
        """Return Z(q) θ, shape (n_v,) [N m or N]."""
        g: Array = self.regressor.Z(q).dot(self.theta)
        return g


class AdaptiveGravity(Immutable):
    """Z(q) θ̂ with θ̂ learnt by eq. (29).

    θ̂ stands still while x is lost, and while the torque of the law is beyond `torque_limits`:
    what a saturated motor fails to do is no evidence about gravity.

    Args:
        model: The believed robot, or a `GravityRegressor` of it. What it holds
            changes θ̂(0) only.
        L: Adaptation gain > 0: a number, a diagonal (p,), or a symmetric positive definite
            matrix (p, p). None takes that of `default_adaptation`.
        alpha: α > 0 of eq. (10) [1/s]. None takes that of `default_adaptation`.
        theta0: θ̂(0), a number or shape (p,); that of the believed robot by default.
        bounds: Smallest and largest θ, each a number or shape (p,), that θ̂ is kept in by
            projection (to within one step of dt where control is sampled). Needs a diagonal L.
        torque_limits: Torques beyond which θ̂ stands still, a number or shape (n_v,) [N m or N];
            the believed robot's effort limits by default, `numpy.inf` for never.

    Attributes:
        regressor: Z(q) of the believed robot.
        L: As a diagonal (p,) or a matrix (p, p), or None.
        bounds: As two arrays (p,), or None.

    Raises:
        InvalidInputError: Wrong shapes, not finite, L or alpha not positive, bounds that are
            reversed or do not hold theta0, or bounds with a full matrix L.
    """

    def __init__(
        self,
        model: Robot | GravityRegressor,
        L: float | Sequence[float] | Array | None = None,
        alpha: float | None = None,
        theta0: float | Sequence[float] | Array | None = None,
        bounds: tuple[float | Sequence[float] | Array, float | Sequence[float] | Array]
        | None = None,
        torque_limits: float | Sequence[float] | Array | None = None,
    ) -> None:
        self._remember(locals())
        wanted = "the believed Robot, or a GravityRegressor of it"
        require("model", model, (Robot, GravityRegressor), wanted)
        regressor = GravityRegressor(model) if isinstance(model, Robot) else model
        p = regressor.p
        self.regressor, self.robot = regressor, regressor.robot
        self.L = None if L is None else _adaptation_gain(L, p)
        self.alpha = None if alpha is None else as_number("alpha", alpha, unit="1/s", above=0.0)
        if self.alpha is not None:
            as_diagonal("alpha", self.alpha, 1, unit="1/s")  # not beyond what gains may be
        self.theta0 = as_entries("theta0", regressor.theta if theta0 is None else theta0, p)
        self.bounds = None if bounds is None else self._bounds(bounds)
        limits = self.robot.effort_limits if torque_limits is None else torque_limits
        self.torque_limits = as_limits("torque_limits", limits, self.robot.nv, unit="N m or N")

    def __repr__(self) -> str:
        shown = [f"{self.robot.name!r}", f"{self.regressor.p} parameters"]
        if self.L is not None:
            shown.append(f"L={short(self.L) if self.L.ndim == 1 else 'a matrix'}")
        if self.alpha is not None:
            shown.append(f"alpha={self.alpha:.4g}")
        return f"AdaptiveGravity({', '.join(shown)})"

    def _bounds(self, bounds: Any) -> tuple[Array, Array]:
        try:
            lower, upper = bounds
        except (TypeError, ValueError) as error:
            raise InvalidInputError(
                f"bounds must be a smallest and a largest theta, got {bounds!r}", given=bounds
            ) from error
        lower, upper = (as_entries("bounds", bound, self.regressor.p) for bound in (lower, upper))
        holds_theta0 = ((lower <= self.theta0) & (self.theta0 <= upper)).all()
        for holds, wanted in (
            ((lower < upper).all(), "be a smallest and a larger theta"),
            (holds_theta0, f"hold theta0 = {self.theta0.tolist()}"),
        ):
            if not holds:
                raise InvalidInputError(
                    f"bounds must {wanted}, got {lower.tolist()} to {upper.tolist()}", given=bounds
                )
        if self.L is not None and self.L.ndim == 2:
            raise InvalidInputError(
                "bounds need L to be a number or a diagonal: with a full matrix, keeping one "
                "parameter back would spoil the others",
                given=bounds,
            )
        return lower, upper


class Adaptation(NamedTuple):
    """An `AdaptiveGravity` with its defaults filled in, for one task and its gains."""

    regressor: GravityRegressor
    L: Array
    alpha: float
    theta0: Array
    bounds: tuple[Array, Array] | None
    torque_limits: Array

    def __repr__(self) -> str:
        L = short(self.L) if self.L.ndim == 1 else "a matrix"
        return f"Adaptation({self.regressor.robot.name!r}, L={L}, alpha={self.alpha:.4g})"

    def rests(self, torque: Array) -> bool:
        """Return whether any torque (n_v,) is beyond its limit, where θ̂ stands still."""
        share = torque / self.torque_limits
        # the norm first: it is cheap, and mostly small enough
        return bool(math.hypot(*share.tolist()) > 1.0 and np.abs(share).max() > 1.0)


Gravity = ModelGravity | NoGravity | RegressorGravity | AdaptiveGravity


def believed_gravity(
    gravity: Gravity | None, task: Task, gains: Diagonals
) -> tuple[Gravity, Adaptation | None]:
    """Return a source of gravity torque, by default the model of a task's robot, and what learns.

    Raises:
        InvalidInputError: No source of gravity torque, or gravity of a robot with other joints.
    """
    robot = task.robot
    if gravity is None:
        return ModelGravity(robot), None
    wanted = (
        "one of ModelGravity, RegressorGravity, AdaptiveGravity and NoGravity, such as "
        "AdaptiveGravity(belief)"
    )
    require("gravity", gravity, get_args(Gravity), wanted)
    if gravity.robot.joint_names != robot.joint_names:
        raise InvalidInputError(
            f"gravity must be that of a robot with the joints of the task's robot "
            f"({', '.join(robot.joint_names)}), got {gravity.robot!r}",
            given=gravity,
        )
    if not isinstance(gravity, AdaptiveGravity):
        return gravity, None
    L, alpha, regressor = gravity.L, gravity.alpha, gravity.regressor
    if L is None or alpha is None:
        usual, alpha = default_adaptation(task, gains, regressor, alpha)
        L = usual if L is None else L
    theta0, bounds, limits = gravity.theta0, gravity.bounds, gravity.torque_limits
    return gravity, Adaptation(regressor, L, alpha, theta0, bounds, limits)


def _adaptation_gain(L: Any, p: int) -> Array:
    if is_scalar(L) or all(is_scalar(row) for row in L):
        return as_diagonal("L", L, p)
    matrix = as_array("L", L, (p, p))
    as_diagonal("L", np.abs(matrix).max(), p)  # not beyond what gains may be
    asymmetry = np.abs(matrix - matrix.T).max()
    if asymmetry > 1e-9 * np.abs(matrix).max() or np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise InvalidInputError(
            f"L must be symmetric positive definite, got {matrix.tolist()}", given=L
        )
    return matrix
