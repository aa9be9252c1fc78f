"""The dynamics regressor Y_d(q, q̇, q̇_r, q̈_r): a torque linear in what moves, and in its joints."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.robots.robot import Robot
from approxjac.robots.traced import arm_of
from approxjac.validation import Array, require

COULOMB_SPEED = 0.05
"""Speed within which Coulomb friction passes from −τ_c to τ_c [rad/s or m/s]."""

_HALF = np.array(0.5)  # an array, which NumPy multiplies with in a third of the time of a number
_OF_A_LINK = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
_OF_A_JOINT = ("rotor", "viscous", "coulomb", "constant")


class LinkMotion:
    """The columns Y of links in M(q)q̈_r + C(q, q̇)q̇_r + g(q) = Y a, as products with them."""

    def __init__(self, regressor: DynamicsRegressor, q: Array, Y: Array) -> None:
        self._regressor, self._q, self._Y = regressor, q, Y

    def powers(self, sigma: Array) -> Array:
        """Return Yᵀσ of σ (n_v,), shape (p,)."""
        return np.asarray(sigma.dot(self._Y))

    def torque(self, a: Array) -> Array:
        """Return Y a of parameters (p,), shape (n_v,) [N m or N]."""
        return np.asarray(self._Y.dot(a))

    def gravity(self, a: Array) -> Array:
        """Return g(q) of parameters (p,), shape (n_v,) [N m or N]."""
        return np.asarray(self._regressor.Z(self._q).dot(a))


class DynamicsRegressor:
    """M(q)q̈_r + C(q, q̇)q̇_r + g(q) + joint torques = Y_d(q, q̇, q̇_r, q̈_r) a.

    Of each moving link a has ten inertial parameters about the joint's frame, as
    `pin.Inertia.toDynamicParameters` has them: m, the first moments and the inertia. Of each joint
    it has rotor inertia, viscous friction, Coulomb friction and a constant torque, with columns
    q̈_r, q̇_r, tanh(q̇_r/v_c) and 1. It is the friction of the *reference* velocity: friction never
    falls with speed, so what the true one has more opposes σ = q̇ − q̇_r.

    C is the Christoffel form, by polarisation: C(q, q̇)q̇_r = c(q, ½(q̇ + q̇_r)) − c(q, ½(q̇ − q̇_r))
    with c(q, v) = C(q, v)v. So Ṁ − 2C is skew-symmetric.

    All parameters are kept, although they depend on each other: a law that learns them from a prior
    leaves what makes no torque as it was.

    Owns scratch memory: one instance a thread.

    Args:
        robot: The (believed) robot.

    Attributes:
        names: Names of the parameters, such as "joint1.mx" [kg m] or "joint1.rotor" [kg m²].
        units: Their units.
        a: Their values for `robot` itself, whose joints have none, shape (p,).
        links: Number of the parameters of links, which come first.
        last_link: Those of the link that holds the tip.
    """

    def __init__(self, robot: Robot) -> None:
        require("robot", robot, Robot, "a Robot")
        self.robot = robot
        self._mimic_joints = robot.mimic_joints
        self._model = robot.mimic_joints.model  # Pinocchio has no regressor with mimic joints
        self._weightless = pin.Model(self._model)
        self._weightless.gravity.linear = np.zeros(3)
        self._data = self._model.createData()
        self._many = self._model.nv > 1  # of one joint Pinocchio's regressor has lost an axis
        self._zero, self._one = np.zeros(self._model.nv), np.ones(robot.nv)
        movers = list(self._model.names)[1:]
        self.links = 10 * len(movers)
        last = len(movers)
        if robot.tip is not None:
            frame = self._model.getFrameId(robot.tip, pin.FrameType.BODY)
            last = int(self._model.frames[frame].parentJoint) or last
        self.last_link = slice(10 * (last - 1), 10 * last)
        names = [f"{mover}.{label}" for mover in movers for label in _OF_A_LINK]
        # all of one kind at once, so that its columns are a diagonal
        names += [f"{joint}.{label}" for label in _OF_A_JOINT for joint in robot.joint_names]
        self.names = tuple(names)
        turning = [unit == "rad" for unit in robot.joint_units]
        of_joints = (("kg m²", "kg"), ("N m s/rad", "N s/m"), ("N m", "N"), ("N m", "N"))
        self.units = ("kg", *3 * ("kg m",), *6 * ("kg m²",)) * len(movers) + tuple(
            angular if turns else linear for angular, linear in of_joints for turns in turning
        )
        inertias = list(self._model.inertias)[1:]
        nothing = np.zeros(len(_OF_A_JOINT) * robot.nv)
        self.a = np.concatenate([*(each.toDynamicParameters() for each in inertias), nothing])
        self.a.flags.writeable = False

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.robot,)  # a copy has scratch memory of its own

    @property
    def p(self) -> int:
        """Number of parameters."""
        return len(self.names)

    def Y_d(self, q: Array, v: Array, v_r: Array, a_r: Array) -> Array:
        """Y_d(q, q̇, q̇_r, q̈_r), shape (n_v, p).

        Its arguments are not checked.

        Args:
            q: Configuration, shape (nq,).
            v: q̇, shape (n_v,) [rad/s or m/s].
            v_r: q̇_r, shape (n_v,) [rad/s or m/s].
            a_r: q̈_r, shape (n_v,) [rad/s² or m/s²].
        """
        links, joints = self.parts(q, v, v_r, a_r)
        return np.concatenate([links, *(np.diag(each) for each in joints)], axis=1)

    def parts(self, q: Array, v: Array, v_r: Array, a_r: Array) -> tuple[Array, Array]:
        """Return Y_d as its columns of links (n_v, 10 links), and the diagonals of the others.

        The arguments are those of `Y_d`; the diagonals are (4, n_v).
        """
        mimic, q_all = self._mimic_joints, self._mimic_joints.q(q)
        middle, apart = mimic.v(_HALF * (v + v_r)), mimic.v(_HALF * (v - v_r))
        links = self._torques(self._model, q_all, middle, mimic.v(a_r))
        links = links - self._torques(self._weightless, q_all, apart, self._zero)
        return links, self.of_joints(v_r, a_r)

    def of_joints(self, v_r: Array, a_r: Array) -> Array:
        """Return the diagonals of the columns of joints, shape (4, n_v)."""
        each = a_r, v_r, np.tanh(v_r / COULOMB_SPEED), self._one
        return np.concatenate(each).reshape(4, -1)

    def motion(self, q: Array, v: Array, v_r: Array, a_r: Array) -> LinkMotion:
        """Return what the links' part of `Y_d` makes of vectors; the arguments are those of it."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            found: LinkMotion = arm.bodies(v, v_r, a_r)
            return found
        return LinkMotion(self, q, self.parts(q, v, v_r, a_r)[0])

    def Z(self, q: Array) -> Array:
        """Gravity's part of the links' columns, Y_d(q, 0, 0, 0), shape (n_v, 10 links)."""
        return self._torques(self._model, self._mimic_joints.q(q), self._zero, self._zero)

    def _torques(self, model: pin.Model, q_all: Array, v: Array, a: Array) -> Array:
        """Return Pinocchio's regressor of a torque, ten columns for each moving link."""
        Y: Array = pin.computeJointTorqueRegressor(model, self._data, q_all, v, a)
        return self._mimic_joints.rows(Y if self._many else Y[np.newaxis])

    def __repr__(self) -> str:
        return f"DynamicsRegressor({self.robot.name!r}: {self.p} parameters)"
