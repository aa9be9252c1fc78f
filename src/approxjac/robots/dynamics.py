"""M, C and g of a robot, through Pinocchio's CRBA and RNEA."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.robots.model import WORLD, mass_matrix, symmetric
from approxjac.robots.robot import Robot
from approxjac.robots.traced import arm_of
from approxjac.validation import Array, as_vector, require


class Dynamics:
    """The terms of M(q) q̈ + C(q, q̇) q̇ + g(q) = τ, eq. (1) without friction.

    Owns scratch memory: one instance a thread. What it returns is yours to keep. A q, v, a or τ of
    the wrong length or not finite is an InvalidInputError.

    Args:
        robot: The robot, true or believed.
    """

    def __init__(self, robot: Robot) -> None:
        require("robot", robot, Robot, "a Robot")
        self.robot = robot
        self._model = robot.model
        self._data = self._model.createData()
        self._zero = np.zeros(robot.nv)
        # the same where there are no mimic joints; Pinocchio's algorithms that cannot couple them
        # run on this model
        self._mimic_joints = robot.mimic_joints
        self._all = robot.mimic_joints.model
        self._all_data = self._data if self._all is self._model else self._all.createData()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.robot,)  # a copy has scratch memory of its own

    def __repr__(self) -> str:
        return f"Dynamics({self.robot.name!r})"

    def M(self, q: Array) -> Array:
        """Inertia matrix M(q), shape (n_v, n_v) [kg m², kg m or kg]."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.M())
        return mass_matrix(self._mimic_joints, self._all_data, self._q(q))

    def C(self, q: Array, v: Array) -> Array:
        """Coriolis matrix C(q, q̇) with Ṁ − 2C skew-symmetric, shape (n_v, n_v)."""
        return self._coriolis_matrix(self._mimic_joints.q(self._q(q)), self._v(v))

    def M_dot(self, q: Array, v: Array) -> Array:
        """dM/dt = C + Cᵀ along q̇, shape (n_v, n_v)."""
        C = self.C(q, v)
        return C + C.T

    def M_gradient(self, q: Array) -> Array:
        """∂M/∂q_k, shape (n_v, n_v, n_v), k first: `M_dot` along each joint."""
        q_all, units = self._mimic_joints.q(self._q(q)), np.eye(self.robot.nv)
        dM: Array = np.array([self._coriolis_matrix(q_all, unit) for unit in units])
        return dM + np.swapaxes(dM, 1, 2)

    def coriolis(self, q: Array, v: Array) -> Array:
        """C(q, q̇)q̇ = (½Ṁ + S)q̇, shape (n_v,) [N m or N]."""
        return self.inverse(q, v, self._zero) - self.g(q)

    def g(self, q: Array) -> Array:
        """Gravity torque g(q), shape (n_v,) [N m or N]."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.gravity())
        return np.array(pin.computeGeneralizedGravity(self._model, self._data, self._q(q)))

    def g_gradient(self, q: Array) -> Array:
        """∂g/∂q, shape (n_v, n_v) [N m/rad, and alike with m and N]."""
        q_all = self._mimic_joints.q(self._q(q))
        G = pin.computeGeneralizedGravityDerivatives(self._all, self._all_data, q_all)
        return np.array(self._mimic_joints.rows(self._mimic_joints.columns(G)))

    def inverse(self, q: Array, v: Array, a: Array) -> Array:
        """M(q)a + C(q, q̇)q̇ + g(q) by RNEA, shape (n_v,) [N m or N]."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.bias(v) + arm.momentum(a))
        q, v, a = self._q(q), self._v(v), self._v(a, "a")
        return np.array(pin.rnea(self._model, self._data, q, v, a))

    def forward(self, q: Array, v: Array, tau: Array) -> Array:
        """q̈ from τ, shape (n_v,) [rad/s² or m/s²].

        By the articulated-body algorithm, or with mimic joints by solving with M(q).
        """
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.forward(v, tau))
        q, v, tau = self._q(q), self._v(v), self._v(tau, "tau")
        if self._mimic_joints.G is not None:
            bias = pin.rnea(self._model, self._data, q, v, self._zero)
            return np.asarray(np.linalg.solve(self.M(q), tau - bias))
        return np.array(pin.aba(self._model, self._data, q, v, tau, WORLD))

    def M_inv(self, q: Array) -> Array:
        """M(q)⁻¹, shape (n_v, n_v)."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.factors.solve(np.eye(self.robot.nv)))
        if self._mimic_joints.G is not None:
            return np.asarray(np.linalg.inv(self.M(q)))
        return symmetric(pin.computeMinverse(self._model, self._data, self._q(q)))

    def energy(self, q: Array, v: Array) -> float:
        """Kinetic plus potential energy [J]."""
        q, v = self._mimic_joints.q(self._q(q)), self._mimic_joints.v(self._v(v))
        return float(
            pin.computeKineticEnergy(self._all, self._all_data, q, v)
            + pin.computePotentialEnergy(self._all, self._all_data, q)
        )

    def _coriolis_matrix(self, q_all: Array, v: Array) -> Array:
        v_all = self._mimic_joints.v(v)
        C = pin.computeCoriolisMatrix(self._all, self._all_data, q_all, v_all)
        return np.array(self._mimic_joints.rows(self._mimic_joints.columns(C)))

    def _q(self, q: Array) -> Array:
        return self.robot.configuration(q)

    def _v(self, v: Array, name: str = "v") -> Array:
        return as_vector(name, v, self.robot.nv)
