"""Where the gravity torque of a law comes from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from approxjac.checks import Array, as_array, as_diagonal, as_number, is_scalar, require
from approxjac.errors import InvalidInputError
from approxjac.robots import Dynamics, GravityRegressor, Robot


class ModelGravity:
    """g(q) of a robot's model, by RNEA: exact as far as its masses and lengths are.

    Args:
        robot: The believed robot.
    """

    def __init__(self, robot: Robot) -> None:
        self._dynamics = Dynamics(robot)

    @property
    def robot(self) -> Robot:
        """The robot whose gravity this is."""
        return self._dynamics.robot

    def torque(self, q: Array) -> Array:
        """g(q), shape (n_v,) [N m or N]."""
        return self._dynamics.g(q)


class NoGravity:
    """No gravity torque: the robot compensates it by itself, or there is none.

    Args:
        robot: The believed robot.
    """

    def __init__(self, robot: Robot) -> None:
        require("robot", robot, Robot, "the believed Robot")
        self.robot = robot
        self._zero = np.zeros(robot.nv)

    def torque(self, q: Array) -> Array:
        """Zeros, shape (n_v,)."""
        return self._zero.copy()


class RegressorGravity:
    """g(q) = Z(q) θ, eq. (27), with θ known from elsewhere (identification, a data sheet).

    It is exact even where the regressor's robot has wrong lengths: see `GravityRegressor`.

    Args:
        regressor: Z(q) of the believed robot.
        theta: Its parameters, shape (p,).

    Raises:
        InvalidInputError: Wrong shape or not finite.
    """

    def __init__(self, regressor: GravityRegressor, theta: Sequence[float] | Array) -> None:
        require(
            "regressor", regressor, GravityRegressor, "a GravityRegressor of the believed robot"
        )
        self.regressor = regressor
        self.theta = as_array("theta", theta, (regressor.p,))

    @property
    def robot(self) -> Robot:
        """The robot whose regressor is used."""
        return self.regressor.robot

    def torque(self, q: Array) -> Array:
        """Z(q) θ, shape (n_v,) [N m or N]."""
        return self.regressor.Z(q) @ self.theta


class AdaptiveGravity:
    """Z(q) θ̂ with θ̂ learnt by eq. (29).

    Args:
        regressor: Z(q) of the believed robot.
        L: Adaptation gain > 0: a number, a diagonal (p,), or a symmetric positive definite
            matrix (p, p).
        alpha: α > 0 of eq. (10) [1/s].
        theta0: θ̂(0), shape (p,); that of the believed robot by default.

    Attributes:
        L: As a diagonal (p,) or a matrix (p, p).

    Raises:
        InvalidInputError: Wrong shapes, not finite, L or alpha not positive.
    """

    def __init__(
        self,
        regressor: GravityRegressor,
        L: float | Sequence[float] | Array,
        alpha: float,
        theta0: Sequence[float] | Array | None = None,
    ) -> None:
        require(
            "regressor", regressor, GravityRegressor, "a GravityRegressor of the believed robot"
        )
        p = regressor.p
        self.regressor = regressor
        self.L = _adaptation_gain(L, p)
        self.alpha = as_number("alpha", alpha, unit="1/s", above=0.0)
        self.theta0 = as_array("theta0", regressor.theta if theta0 is None else theta0, (p,))

    @property
    def robot(self) -> Robot:
        """The robot whose regressor is used."""
        return self.regressor.robot


Gravity = ModelGravity | NoGravity | RegressorGravity | AdaptiveGravity


def _adaptation_gain(L: Any, p: int) -> Array:
    if is_scalar(L) or all(is_scalar(row) for row in L):
        return as_diagonal("L", L, p)
    matrix = as_array("L", L, (p, p))
    asymmetry = np.abs(matrix - matrix.T).max()
    if asymmetry > 1e-9 * np.abs(matrix).max() or np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise InvalidInputError(
            f"L must be symmetric positive definite, got {matrix.tolist()}", given=L
        )
    return matrix
