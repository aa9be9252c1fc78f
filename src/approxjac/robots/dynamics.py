"""M, C and g of a robot, and regressors: torques as a matrix times inertial parameters."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.robots.robot import WORLD, Robot, mass_matrix
from approxjac.robots.traced import arm_of
from approxjac.validation import Array, Immutable, as_vector, axis_rows, read_only, require

_UNITS = {"v": "rad/s or m/s", "a": "rad/s^2 or m/s^2", "tau": "N m or N"}


class Dynamics(Immutable):
    """The terms of M(q) q̈ + C(q, q̇) q̇ + g(q) = τ, eq. (1) without friction.

    q has shape (nq,) [rad or m], q̇ and q̈ (n_v,). Owns scratch memory: one instance per thread;
    returned arrays are copies.

    Args:
        robot: The robot, true or believed.
    """

    def __init__(self, robot: Robot) -> None:
        require("robot", robot, Robot, "a Robot")
        self.robot = robot
        self._model = robot.model
        self._data = self._model.createData()
        self._zero, self._q = np.zeros(robot.nv), robot.configuration
        # the same where there are no mimic joints; Pinocchio's algorithms that cannot couple them
        # run on this model
        self._mimic_joints = robot.mimic_joints
        self._all = robot.mimic_joints.model
        self._all_data = self._data if self._all is self._model else self._all.createData()
        self._is_plain = self._all is self._model and robot.nq == robot.nv
        self._aba = partial(pin.aba, self._model, self._data)

    def __repr__(self) -> str:
        return f"Dynamics({self.robot.name!r})"

    def M(self, q: Array) -> Array:
        """Return the inertia matrix M(q), shape (n_v, n_v) [kg m², kg m or kg]."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.M())
        return mass_matrix(self._mimic_joints, self._all_data, self._q(q))

    def C(self, q: Array, v: Array) -> Array:
        """Return the Coriolis matrix C(q, q̇), Ṁ − 2C skew-symmetric, shape (n_v, n_v)."""
        mimic = self._mimic_joints
        q_all, v_all = mimic.q(self._q(q)), mimic.v(self._v(v))
        C = pin.computeCoriolisMatrix(self._all, self._all_data, q_all, v_all)
        return np.array(mimic.rows(mimic.columns(C)))

    def M_dot(self, q: Array, v: Array) -> Array:
        """Return dM/dt = C + Cᵀ along q̇, shape (n_v, n_v)."""
        C = self.C(q, v)
        return C + C.T

    def M_gradient(self, q: Array) -> Array:
        """Return ∂M/∂q_k, the `M_dot` along each joint; shape (n_v, n_v, n_v), k first."""
        return np.array([self.M_dot(q, unit) for unit in np.eye(self.robot.nv)])

    def coriolis(self, q: Array, v: Array) -> Array:
        """Return C(q, q̇)q̇ = (½Ṁ + S)q̇, shape (n_v,) [N m or N]."""
        return self.inverse(q, v, self._zero) - self.g(q)

    def g(self, q: Array) -> Array:
        """Return the gravity torque g(q), shape (n_v,) [N m or N]."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.gravity())
        return np.array(pin.computeGeneralizedGravity(self._model, self._data, self._q(q)))

    def g_gradient(self, q: Array) -> Array:
        """Return ∂g/∂q, shape (n_v, n_v) [N m or N, per rad or m]."""
        q_all = self._mimic_joints.q(self._q(q))
        G = pin.computeGeneralizedGravityDerivatives(self._all, self._all_data, q_all)
        return np.array(self._mimic_joints.rows(self._mimic_joints.columns(G)))

    def inverse(self, q: Array, v: Array, a: Array) -> Array:
        """Return M(q)a + C(q, q̇)q̇ + g(q) by RNEA, shape (n_v,) [N m or N]."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.inverse(v, a))
        q, v, a = self._q(q), self._v(v), self._v(a, "a")
        return np.array(pin.rnea(self._model, self._data, q, v, a))

    def forward(self, q: Array, v: Array, tau: Array, rotors: Array | None = None) -> Array:
        """Return q̈ under the torque τ, (n_v,) [rad/s² or m/s²]; rotors are those of `M_inv`."""
        if rotors is not None:
            bias = self.inverse(q, v, 0.0 * v)
            return np.asanyarray(np.linalg.solve(self.M(q) + rotors, tau - bias))
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.forward(v, tau))
        if (  # the quick way
            self._is_plain
            and type(q) is type(v) is type(tau) is np.ndarray
            and q.shape == v.shape == tau.shape == self._zero.shape
            and q.dtype is v.dtype is tau.dtype is self._zero.dtype
        ):
            a = np.array(self._aba(q, v, tau, WORLD))
            if math.isfinite(math.hypot(*a.tolist())):  # or one of them is not
                return a
        q, v, tau = self._q(q), self._v(v), self._v(tau, "tau")
        if self._mimic_joints.G is not None:
            bias = pin.rnea(self._model, self._data, q, v, self._zero)
            return np.asarray(np.linalg.solve(self.M(q), tau - bias))
        return np.array(pin.aba(self._model, self._data, q, v, tau, WORLD))

    def M_inv(self, q: Array, rotors: Array | None = None) -> Array:
        """Return M(q)⁻¹, shape (n_v, n_v), with rotor inertias (n_v, n_v) in M if given."""
        if rotors is not None:
            return np.asanyarray(np.linalg.solve(self.M(q) + rotors, np.eye(self.robot.nv)))
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.factors.solve(np.eye(self.robot.nv)))
        return np.asarray(np.linalg.inv(self.M(q)))

    def energy(self, q: Array, v: Array) -> float:
        """Return the kinetic plus potential energy [J]."""
        q, v = self._mimic_joints.q(self._q(q)), self._mimic_joints.v(self._v(v))
        return float(
            pin.computeKineticEnergy(self._all, self._all_data, q, v)
            + pin.computePotentialEnergy(self._all, self._all_data, q)
        )

    def _v(self, v: Array, name: str = "v") -> Array:
        return as_vector(name, v, self.robot.nv, _UNITS[name])


COULOMB_SPEED = 0.05  # speed within which Coulomb friction passes from −τ_c to τ_c [rad/s or m/s]
REFERENCE_SPEED = np.array(0.01)  # the same of a reference velocity, which has no noise

_RANK_TOLERANCE = 1e-9
HALF = np.array(0.5)  # arrays, which NumPy multiplies with in a third of the time of a number
_OF_A_LINK = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
_OF_A_JOINT = {  # and their units where it turns and where it slides
    "rotor": ("kg m²", "kg"),
    "viscous": ("N m s/rad", "N s/m"),
    "coulomb": ("N m", "N"),
    "constant": ("N m", "N"),
}


class _TorqueRegressor(Immutable):
    """Pinocchio's regressor of a torque, with ten dynamic parameters of each moving link."""

    names: tuple[str, ...]

    def __init__(self, robot: Robot) -> None:
        require("robot", robot, Robot, "a Robot")
        self.robot, self._mimic_joints = robot, robot.mimic_joints
        self._model = robot.mimic_joints.model  # Pinocchio has no regressor with mimic joints
        self._data = self._model.createData()
        self._zero = np.zeros(self._model.nv)
        self._movers = list(self._model.names)[1:]
        inertias = list(self._model.inertias)[1:]
        self._dynamic = np.concatenate([each.toDynamicParameters() for each in inertias])
        self._last = len(self._movers) - 1  # the moving link that holds the tip
        if robot.tip is not None:
            frame = self._model.getFrameId(robot.tip, pin.FrameType.BODY)
            self._last = int(self._model.frames[frame].parentJoint or self._last + 1) - 1

    @property
    def p(self) -> int:
        """Number of parameters."""
        return len(self.names)

    def _torques(self, model: pin.Model, q: Array, v: Array, a: Array) -> Array:
        """Return the columns of links at q (nq,), and velocities and accelerations of all."""
        q_all = self._mimic_joints.q(q)
        Y: Array = pin.computeJointTorqueRegressor(model, self._data, q_all, v, a)
        return self._mimic_joints.rows(Y if Y.ndim == 2 else Y[np.newaxis])  # flat of one joint

    def _at_rest(self, q: Array) -> Array:
        return self._torques(self._model, q, self._zero, self._zero)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.robot.name!r}: {self.p} parameters)"


class LinkMotion:
    """The links' part Y of `DynamicsRegressor.Y_d`, as products that need no matrix."""

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


class DynamicsRegressor(_TorqueRegressor):
    """M(q)q̈_r + C(q, q̇)q̇_r + g(q) + joint torques = Y_d(q, q̇, q̇_r, q̈_r) a.

    The parameters a are, for each moving link, the ten of `pin.Inertia.toDynamicParameters`; for
    each joint, rotor inertia, viscous friction, Coulomb friction and a constant torque, with
    columns q̈_r, q̇_r, tanh(q̇_r/v_c) and 1. Friction is that at the *reference* velocity q̇_r. It
    never falls with speed, so its difference at the true velocity opposes σ = q̇ − q̇_r.

    C is the Christoffel form, so that Ṁ − 2C is skew-symmetric, by polarisation: C(q, q̇)q̇_r =
    c(q, ½(q̇ + q̇_r)) − c(q, ½(q̇ − q̇_r)) with c(q, v) = C(q, v)v. All parameters are kept, although
    some are redundant: learning does not change combinations without effect on the torque.

    Owns scratch memory: one instance per thread.

    Args:
        robot: The (believed) robot.

    Attributes:
        names: Names of the parameters, such as "joint1.mx" or "joint1.rotor".
        units: Their units.
        a: Their values for `robot`, zero for the joints, shape (p,).
        links: Number of link parameters, which come first.
        last_link: Slice of the parameters of the link that holds the tip.
    """

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self._weightless = pin.Model(self._model)
        self._weightless.gravity.linear = np.zeros(3)
        self._one = np.ones(robot.nv)
        self.links = len(self._dynamic)
        self.last_link = slice(10 * self._last, 10 * self._last + 10)
        names = [f"{mover}.{label}" for mover in self._movers for label in _OF_A_LINK]
        # all of one kind at once, so that its columns are a diagonal
        names += [f"{joint}.{label}" for label in _OF_A_JOINT for joint in robot.joint_names]
        self.names = tuple(names)
        kinds = [int(unit == "m") for unit in robot.joint_units]
        of_joints = [units[kind] for units in _OF_A_JOINT.values() for kind in kinds]
        of_links = ("kg", *3 * ("kg m",), *6 * ("kg m²",)) * len(self._movers)
        self.units = (*of_links, *of_joints)
        none = np.zeros(len(_OF_A_JOINT) * robot.nv)
        self.a = read_only(np.concatenate([self._dynamic, none]))

    def Y_d(self, q: Array, v: Array, v_r: Array, a_r: Array) -> Array:
        """Return Y_d (n_v, p) at q (nq,), q̇, q̇_r and q̈_r (n_v,), which are not checked."""
        links = self._links(q, v, v_r, a_r)
        return np.concatenate([links, *map(np.diag, self.of_joints(v_r, a_r))], axis=1)

    def _links(self, q: Array, v: Array, v_r: Array, a_r: Array) -> Array:
        mimic = self._mimic_joints
        middle, apart = mimic.v(HALF * (v + v_r)), mimic.v(HALF * (v - v_r))
        links = self._torques(self._model, q, middle, mimic.v(a_r))
        return links - self._torques(self._weightless, q, apart, self._zero)

    def of_joints(self, v_r: Array, a_r: Array) -> Array:
        """Return the diagonals of the joints' four blocks of columns, shape (4, n_v)."""
        return np.concatenate((a_r, v_r, np.tanh(v_r / REFERENCE_SPEED), self._one)).reshape(4, -1)

    def motion(self, q: Array, v: Array, v_r: Array, a_r: Array) -> LinkMotion:
        """Return the links' part of `Y_d`, of the same arguments, as products with it."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return arm.bodies(v, v_r, a_r)
        return LinkMotion(self, q, self._links(q, v, v_r, a_r))

    def Z(self, q: Array) -> Array:
        """Return the links' columns of gravity, Y_d(q, 0, 0, 0), shape (n_v, 10 links)."""
        return self._at_rest(q)


class GravityRegressor(_TorqueRegressor):
    """g(q) = Z(q) θ with as few parameters as gravity can distinguish.

    They are the mass and three first moments (m c_x, m c_y, m c_z) of each moving link. A column
    that depends linearly on those before it, in link order, is left out and its parameter is merged
    into theirs. The span of Z does not change when the translations of joint origins are wrong, so
    gravity can be learnt exactly with wrong lengths, though not with wrong axis directions.

    Owns scratch memory: one instance per thread.

    Args:
        robot: The (believed) robot.
        moments: Axes of the link frames along which centres of mass may lie. "xyz" assumes
            nothing; "x" gives the θ₁ and θ₂ of the paper, whose rods lie along x.

    Attributes:
        names: Names of the parameters, such as "joint1.mx".
        units: Their units.
        theta: Their values for `robot`, shape (p,).
        columns: Their indices among the ten dynamic parameters of each joint, shape (p,).

    Raises:
        InvalidInputError: No or repeated axes, centres of mass of `robot` that `moments` does not
            cover, or gravity exerts no torque on this robot.
    """

    def __init__(self, robot: Robot, moments: str = "xyz") -> None:
        super().__init__(robot)
        axes = axis_rows("moments", moments)
        # of each link's ten dynamic parameters, the first four are m, m c_x, m c_y, m c_z
        offsets = [0, *(1 + axis for axis in sorted(axes))]
        candidates = np.array([10 * i + k for i in range(self._model.nv) for k in offsets])
        rng = np.random.default_rng(0)
        stacked = np.vstack([self._at_rest(q)[:, candidates] for q in anywhere(robot, rng)])
        kept, grouping = independent_columns(stacked)
        if not kept:
            raise InvalidInputError(
                f"gravity exerts no torque on {robot.name}: there is nothing to learn "
                f"(gravity is {robot.gravity.tolist()} m/s^2)",
                given=robot,
            )
        self.columns = candidates[kept]
        self._held = grouping[:, candidates // 10 == self._last]
        self._usual = np.sqrt(np.mean(stacked[:, kept] ** 2, axis=0))
        self.names = tuple(f"{self._movers[c // 10]}.{_OF_A_LINK[c % 10]}" for c in self.columns)
        self.units = tuple("kg m" if c % 10 else "kg" for c in self.columns)
        self.theta = read_only(grouping @ self._dynamic[candidates])
        error = self._error(robot, self.theta, rng)
        if error > 1e-9:
            raise InvalidInputError(
                f"moments must cover the centres of mass of {robot.name}, got {moments!r}: gravity "
                f"would be wrong by {100 * error:.2g} %; 'xyz' covers every robot",
                given=moments,
            )

    def Z(self, q: Array) -> Array:
        """Return the gravity regressor Z(q), shape (n_v, p) [N m or N, per unit of θ]."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.Z(self))
        return self._at_rest(self.robot.configuration(q)).take(self.columns, 1)

    def fit(self, robot: Robot) -> tuple[Array, float]:
        """Fit θ (p,) to the gravity torques of another robot; return it and its relative error.

        The θ is that nearest to this robot's. Its error is the largest of Z θ over the largest
        gravity torque, at random configurations that the fit did not use.

        Raises:
            InvalidInputError: `robot` has other joints, or another gravity.
        """
        require("robot", robot, Robot, "a Robot")
        own = self.robot
        if robot.joint_names != own.joint_names or (robot.gravity != own.gravity).any():
            raise InvalidInputError(
                f"robot must have the joints of {own!r} and be under its gravity of "
                f"{own.gravity.tolist()} m/s^2, got {robot!r} under {robot.gravity.tolist()}",
                given=robot,
            )
        rng = np.random.default_rng(0)
        Z, g = self._samples(robot, rng)
        theta: Array = self.theta + np.linalg.lstsq(Z, g - Z @ self.theta, rcond=1e-12)[0]
        return theta, self._error(robot, theta, rng)

    def payload(self, change: Array) -> Array:
        """Return the smallest load on the last link that best explains a change of θ (p,).

        It is a mass [kg] and, in that link's axes, the first moments that `moments` names [kg m].
        """
        weighted = self._held * self._usual[:, np.newaxis]
        return np.linalg.lstsq(weighted, change * self._usual, rcond=1e-9)[0]

    def _samples(self, robot: Robot, rng: np.random.Generator) -> tuple[Array, Array]:
        dynamics, configurations = Dynamics(robot), anywhere(robot, rng)
        Z = np.vstack([self.Z(q) for q in configurations])
        return Z, np.concatenate([dynamics.g(q) for q in configurations])

    def _error(self, robot: Robot, theta: Array, rng: np.random.Generator) -> float:
        Z, g = self._samples(robot, rng)
        return float(np.abs(Z @ theta - g).max() / max(np.abs(g).max(), 1e-300))


def anywhere(robot: Robot, rng: np.random.Generator) -> list[Array]:
    """Return 60 random configurations over full turns (±1 m), regardless of joint limits."""
    reach = np.where(np.array(robot.joint_units) == "m", 1.0, np.pi)
    return [robot.configuration(motion) for motion in rng.uniform(-reach, reach, (60, robot.nv))]


def independent_columns(A: Array) -> tuple[list[int], Array]:
    """Return the indices of columns of A independent of those before, and G: A = A[:, kept] G."""
    scale = np.linalg.norm(A, axis=0)
    some = np.nonzero(scale > _RANK_TOLERANCE * scale.max(initial=0.0))[0]
    # on the diagonal is what of a column no combination of those before it makes
    alone = np.abs(np.diag(np.linalg.qr(A[:, some] / scale[some], mode="r")))
    kept: list[int] = some[alone > _RANK_TOLERANCE].tolist()
    grouping: Array = np.linalg.lstsq(A[:, kept], A, rcond=None)[0].astype(np.float64)
    grouping[np.abs(grouping) < 1e-12] = 0.0
    return kept, grouping
