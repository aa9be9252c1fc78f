"""M, C and g of a robot, through Pinocchio's CRBA and RNEA."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from approxjac.checks import Array, as_vector, require
from approxjac.robots.model import mass_matrix
from approxjac.robots.robot import Robot


class Dynamics:
    """The terms of M(q) q̈ + C(q, q̇) q̇ + g(q) = τ, eq. (1) without friction.

    Owns scratch memory: one instance a thread. What it returns is yours to keep.

    Args:
        robot: The robot, true or believed.

    Raises:
        InvalidInputError: From every method, for a q, v, a or τ of the wrong length or not
            finite.
    """

    def __init__(self, robot: Robot) -> None:
        require("robot", robot, Robot, "a Robot")
        self.robot = robot
        self._model = robot.model
        self._data = self._model.createData()
        self._zero = np.zeros(robot.nv)

    def M(self, q: Array) -> Array:
        """Inertia matrix M(q), shape (n_v, n_v) [kg m², kg m or kg]."""
        return mass_matrix(self._model, self._data, self._q(q))

    def C(self, q: Array, v: Array) -> Array:
        """Coriolis matrix C(q, q̇) with Ṁ − 2C skew-symmetric, shape (n_v, n_v)."""
        return np.array(pin.computeCoriolisMatrix(self._model, self._data, self._q(q), self._v(v)))

    def M_dot(self, q: Array, v: Array) -> Array:
        """dM/dt = C + Cᵀ along q̇, shape (n_v, n_v)."""
        C = self.C(q, v)
        return C + C.T

    def coriolis(self, q: Array, v: Array) -> Array:
        """C(q, q̇)q̇ = (½Ṁ + S)q̇, shape (n_v,) [N m or N]."""
        return self.inverse(q, v, self._zero) - self.g(q)

    def g(self, q: Array) -> Array:
        """Gravity torque g(q), shape (n_v,) [N m or N]."""
        return np.array(pin.computeGeneralizedGravity(self._model, self._data, self._q(q)))

    def inverse(self, q: Array, v: Array, a: Array) -> Array:
        """M(q)a + C(q, q̇)q̇ + g(q) by RNEA, shape (n_v,) [N m or N]."""
        return np.array(pin.rnea(self._model, self._data, self._q(q), self._v(v), self._v(a, "a")))

    def forward(self, q: Array, v: Array, tau: Array) -> Array:
        """q̈ from τ by the articulated-body algorithm, shape (n_v,) [rad/s² or m/s²]."""
        return np.array(
            pin.aba(
                self._model,
                self._data,
                self._q(q),
                self._v(v),
                self._v(tau, "tau"),
                pin.Convention.WORLD,
            )
        )

    def energy(self, q: Array, v: Array) -> float:
        """Kinetic plus potential energy [J]."""
        q, v = self._q(q), self._v(v)
        return float(
            pin.computeKineticEnergy(self._model, self._data, q, v)
            + pin.computePotentialEnergy(self._model, self._data, q)
        )

    def _q(self, q: Array) -> Array:
        return self.robot.configuration(q)

    def _v(self, v: Array, name: str = "v") -> Array:
        return as_vector(name, v, self.robot.nv)
