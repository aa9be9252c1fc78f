"""Sources of the tracking law's feedforward torque: the believed model, or learnt dynamics."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from approxjac import law
from approxjac.controllers.friction import FRICTION_SHARE
from approxjac.controllers.gains.sample_configurations import usual_inertias
from approxjac.robots import Dynamics, Friction, Robot
from approxjac.robots.drives import usual_effort
from approxjac.robots.dynamics import HALF, DynamicsRegressor
from approxjac.validation import Array, Immutable, as_diagonal, as_limits, as_number, require

_MASS = 0.03  # share of the arm's mass that a link's may be wrong by
_LENGTH = 0.2  # share of the reach: how far from its place
_SHORTEST = 0.01  # [m]
_LAST = np.array([2.0, 2.0, 2.0, 2.0, 2.5, 2.5, 2.5, 2.5, 2.5, 2.5])  # of an object that is held
_ROTOR = 5.0  # times a link's error of inertia
_FARTHEST = 20.0  # standard deviations that a parameter may go from what is believed
_FRICTION = 0.02  # of the effort
_DRY = 1.4  # times that, of Coulomb friction, which is learnt while a joint moves
_DRIVE = 2e-3  # rotor inertia over effort [s²] that any joint's drive may have
_STANDARD_GRAVITY = 9.81
_GAIN = 20.0  # [1/J]
_LINKS = 16.0  # how fast the links of an arm are learnt [1/s]
_CONFIGURATIONS, _SPEED, _ACCELERATION = 20, 0.5, 2.0  # usual ones [rad/s, rad/s² or m]


class MotionDynamics(Immutable, ABC):
    """The torque of a reference motion, M̂q̈_r + Ĉq̇_r + ĝ, and its learnt parameters.

    Immutable, but it owns scratch memory: one instance per thread.

    Args:
        robot: The believed robot.
        rotor_inertia: Rotor inertias reflected to the joints, a number or shape (n_v,) [kg m² or
            kg].

    Attributes:
        n_state: Length of the state, the number of learnt parameters.
        parameters: Their names and units.
    """

    n_state = 0
    parameters: Mapping[str, str] = MappingProxyType({})

    def __init__(
        self, robot: Robot, *, rotor_inertia: float | Sequence[float] | Array = 0.0
    ) -> None:
        require("robot", robot, Robot, "a Robot")
        self.robot = robot
        self.rotor_inertia = as_diagonal(
            "rotor_inertia", rotor_inertia, robot.nv, unit="kg m^2 or kg", positive=False
        )
        self._dynamics, self._rotors = Dynamics(robot), np.diag(self.rotor_inertia)
        self._still = np.zeros(robot.nv)

    def initial_state(self) -> Array:
        """Return the state before the first step, shape (n_state,); by default none."""
        return np.zeros(self.n_state)

    @abstractmethod
    def step(
        self, state: Array, q: Array, v: Array, v_r: Array, a_r: Array, learns: Any, dt: float
    ) -> tuple[Array, Array, Array]:
        """Return the state dt [s] later, with it the torque of the motion and that of gravity.

        The torque uses the *new* state, so that the step adds nothing to the Lyapunov function V₂,
        however fast the learning is. q is (nq,), q̇, q̇_r and q̈_r are (n_v,); `learns` is True
        to learn.
        """

    @abstractmethod
    def gravity(self, state: Array, q: Array) -> Array:
        """Return the gravity torque by a state, shape (n_v,) [N m or N]."""

    def inertia(self, q: Array) -> Array:
        """Return M̂(q) of the believed arm with its rotors, without learning, (n_v, n_v)."""
        return self._dynamics.M(q) + self._rotors

    def gain_inertia(self, room: float) -> Array:
        """Return inertias F (n_v,) to add to M̂ in the gain κM̂, with λ_max(M̂⁻¹(M̂ + F)) <= room.

        They are typical rotor inertias for the effort limits, because a URDF has none and a gain of
        M̂ alone leaves light wrists soft.
        """
        F = _DRIVE * usual_effort(self.robot)
        if not F.any() or room <= 1.0:
            return np.zeros(self.robot.nv)
        M_inv = np.linalg.inv(usual_inertias(self.robot))
        # each joint alone may fill half of the room, and all together all of it
        alone = M_inv.diagonal(axis1=1, axis2=2).max(axis=0)
        F = np.minimum(F, 0.5 * (room - 1.0) / alone)
        root = np.sqrt(F)
        most = float(np.linalg.eigvalsh(root[:, None] * M_inv * root).max())
        return np.asarray(F * min(1.0, (room - 1.0) / most))


class ModelDynamics(MotionDynamics):
    """The believed model, without learning.

    For a robot that compensates its own weight, use `robot.with_gravity((0, 0, 0))`.
    """

    def step(
        self, state: Array, q: Array, v: Array, v_r: Array, a_r: Array, learns: Any, dt: float
    ) -> tuple[Array, Array, Array]:
        """Return the unchanged state, and torques by two passes of RNEA; see `MotionDynamics`."""
        inverse, g = self._dynamics.inverse, self._dynamics.g(q)
        middle, apart = inverse(q, HALF * (v + v_r), a_r), inverse(q, HALF * (v - v_r), self._still)
        return state, middle - apart + g + self.rotor_inertia * a_r, g

    def gravity(self, state: Array, q: Array) -> Array:
        return self._dynamics.g(q)

    def __repr__(self) -> str:
        return f"ModelDynamics({self.robot.name!r})"


class AdaptiveDynamics(MotionDynamics):
    """Adaptive dynamics: â' = −Γ Y_dᵀσ with Γ = gain · diag(sd²) at most, σ = q̇ − q̇_r.

    The gain is 20/J; for links it is scaled so that light and heavy arms learn a payload equally
    fast: ω = 16/s with ω² = tr(Y_d Γ Y_dᵀ)/tr M, the median over usual motions. A torque error then
    decays as exp(−ω²t/κ). The scaling makes no parameter faster than half of `fastest`, and Γ is
    reduced if one parameter alone would make the loop oscillate faster than `fastest`.

    Learnt are ten inertial parameters of each link, and of each joint rotor inertia, viscous and
    Coulomb friction and a constant torque. Each has a plausible error sd, which sets its rate: a
    link's mass 3 % of the arm's (the last link's, which holds objects, twice that), at up to a
    fifth of the reach from its place; friction the torque of that weight, or 2 % of the effort
    limit if that is more; rotors those of typical drives. A parameter stays within 20 sd of its
    believed value, and rotor inertia and friction above 0. (Γ is diagonal, so V₂ does not rise by
    these bounds if the truth lies within them.)

    Args:
        robot: The believed robot.
        rotor_inertia: As for `MotionDynamics`. If given, they are in the law's gain matrix.
        fastest: Largest learning rate of each parameter at usual configurations > 0 [1/s]. A
            `TrackingController` that makes its own dynamics uses twice its κ.
        most_damping: B, the largest K_σ of each joint, (n_v,) [N m s/rad or N s/m], where the law
            has one: learning is slower by as much as the joints are softer.
        integral: i ≥ 0 [1/s]: Coulomb friction and a constant torque of a joint are together
            learnt at the rate iK_σ at the least, as an integral of σ beside the law's −K_σσ.
        friction: Friction that is known of the joints, with which learning begins: all of its
            viscous and 0.8 of its Coulomb part, as more than there is would act as a relay.

    Attributes:
        regressor: The `DynamicsRegressor`.
        sd: Plausible errors, shape (p,).
        gain: Gain of each parameter, shape (p,) [1/J].
        gamma: Diagonal of Γ, shape (p,).

    Raises:
        InvalidInputError: Numbers out of range or of the wrong shape.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        rotor_inertia: float | Sequence[float] | Array = 0.0,
        fastest: float = 120.0,
        most_damping: Sequence[float] | Array | None = None,
        integral: float = 0.0,
        friction: Friction | None = None,
    ) -> None:
        super().__init__(robot, rotor_inertia=rotor_inertia)
        self.regressor = DynamicsRegressor(robot)
        self.n_state = self.regressor.p
        self.parameters = dict(zip(self.regressor.names, self.regressor.units, strict=True))
        self.sd = plausible_errors(self.regressor)
        self.fastest = as_number("fastest", fastest, unit="1/s", above=0.0)
        (Y_d, M_inv), gamma = usual_motions(self.regressor), _GAIN * self.sd**2
        kappa, softness = 0.5 * self.fastest, np.zeros(robot.nv)
        if most_damping is not None:
            most = as_limits("most_damping", most_damping, robot.nv, unit="N m s/rad or N s/m")
            softness = kappa / most
        # K_σ of each joint where the others give way, and what γ = 1 alone makes of stiff ones
        inertia = 1.0 / np.diagonal(M_inv, axis1=1, axis2=2) + self.rotor_inertia
        damping = kappa * np.median(1.0 / (1.0 / inertia + softness), axis=0)
        heavier = np.linalg.inv(np.linalg.inv(M_inv) + np.diag(self.rotor_inertia))
        alone = squared_rates(Y_d, heavier, np.ones(self.n_state))
        if softness.any():  # κ²K⁻¹MK⁻¹ of K⁻¹ = (κM)⁻¹ + B⁻¹
            root = M_inv + np.diag(softness)
            M_inv = root @ np.linalg.solve(M_inv, root)
        self.gain, rates = np.full(self.n_state, _GAIN), squared_rates(Y_d, M_inv, gamma)
        # tr(Y_d Γ Y_dᵀ)/tr M of links: the mean of joints by their inertia, so that wrists hardly
        # count
        k = slice(self.regressor.links)
        squares = (Y_d[:, :, k] ** 2 * gamma[k]).reshape(len(Y_d), -1)
        swings = squares.sum(axis=1) / np.linalg.inv(M_inv).trace(axis1=1, axis2=2)
        wanted = _LINKS**2 / max(float(np.median(swings)), 1e-9)
        more = np.minimum(wanted, np.maximum(1.0, (0.5 * self.fastest) ** 2 / rates[k]))
        self.gain[k] *= more
        rates[k] *= more
        self.gamma = self.gain * self.sd**2 * np.minimum(1.0, self.fastest**2 / rates)
        links, n = self.regressor.links, robot.nv
        slow = self.gamma[links + 2 * n :]  # a view
        spring = as_number("integral", integral, unit="1/s", minimum=0.0) * damping
        more = np.tile(spring / slow.reshape(2, n).sum(axis=0), 2)
        slow *= np.maximum(np.minimum(more, self.fastest**2 / (alone[-2 * n :] * slow)), 1.0)
        prior = self.regressor.a.copy()
        prior[links : links + n] = self.rotor_inertia
        if friction is not None:
            known = require("friction", friction, Friction, "Friction(...) or None").of(n)
            dry = FRICTION_SHARE * np.asarray(known.coulomb)
            prior[links + n : links + 3 * n] = np.concatenate([known.viscous, dry])
        low, high = prior - _FARTHEST * self.sd, prior + _FARTHEST * self.sd
        low[links : links + 3 * n] = 0.0
        self._prior, self._low, self._high = prior, low, high

    def initial_state(self) -> Array:
        """Return the believed parameters, shape (p,)."""
        return self._prior.copy()

    def step(
        self,
        state: Array,
        q: Array,
        v: Array,
        v_r: Array,
        a_r: Array,
        learns: Any,
        dt: float,
        gamma: Array | None = None,
    ) -> tuple[Array, Array, Array]:
        """Return â dt [s] later, with it Y_d â and Zâ; see `MotionDynamics`.

        `gamma` is the diagonal of Γ if it is not that of the attribute.
        """
        links, k, sigma = self.regressor.motion(q, v, v_r, a_r), self.regressor.links, v - v_r
        joints = self.regressor.of_joints(v_r, a_r)
        Y_d_sigma = np.concatenate([links.powers(sigma), (joints * sigma).ravel()])
        gamma = self.gamma if gamma is None else gamma
        moved = state + dt * law.dynamics_rate(gamma, Y_d_sigma)
        state = law.select(learns, np.minimum(np.maximum(moved, self._low), self._high), state)
        of_joints = joints * state[k:].reshape(joints.shape)
        return state, links.torque(state[:k]) + np.add.reduce(of_joints), links.gravity(state[:k])

    def gravity(self, state: Array, q: Array) -> Array:
        """Return Z(q) â of the links, shape (n_v,) [N m or N]."""
        return np.asarray(self.regressor.Z(q).dot(state[: self.regressor.links]))

    def __repr__(self) -> str:
        return f"AdaptiveDynamics({self.robot.name!r}: {self.n_state} parameters)"


def plausible_errors(regressor: DynamicsRegressor) -> Array:
    """Return plausible errors of the parameters of a robot, shape (p,)."""
    robot = regressor.robot
    mass = _MASS * robot.mass
    reach = math.inf if robot.tip is None else robot.reach_bound(robot.tip)[1]
    length = max(_LENGTH * reach, _SHORTEST) if math.isfinite(reach) else _LENGTH
    links = np.tile(mass * np.array([1.0, *[length] * 3, *[length**2] * 6]), regressor.links // 10)
    links[regressor.last_link] *= _LAST
    arm = np.where(np.array(robot.joint_units) == "m", 1.0, length)
    effort = np.where(np.isfinite(robot.effort_limits), robot.effort_limits, 0.0)
    torque = np.maximum(mass * _STANDARD_GRAVITY * arm, _FRICTION * effort)
    rotor = np.maximum(_ROTOR * mass * arm**2, _DRIVE * effort)
    return np.concatenate([links, rotor, torque, _DRY * torque, torque])


def usual_motions(regressor: DynamicsRegressor) -> tuple[Array, Array]:
    """Return Y_d (k, n_v, p) and M⁻¹ (k, n_v, n_v) of usual motions."""
    robot, rng = regressor.robot, np.random.default_rng(0)
    dynamics, Y_d, M_inv = Dynamics(robot), [], []
    for _ in range(_CONFIGURATIONS):
        q = robot.random_configuration(rng)
        v, a = (size * rng.choice((-1.0, 1.0), robot.nv) for size in (_SPEED, _ACCELERATION))
        Y_d.append(regressor.Y_d(q, v, v, a))
        M_inv.append(dynamics.M_inv(q))
    return np.array(Y_d), np.array(M_inv)


def squared_rates(Y_d: Array, M_inv: Array, gamma: Array) -> Array:
    """Return the largest γᵢ Y_dᵢᵀM⁻¹Y_dᵢ of motions, each parameter's ω² alone; (p,) [1/s²]."""
    rates = gamma * (Y_d * (M_inv @ Y_d)).sum(axis=1)
    return np.asarray(np.maximum(rates.max(axis=0), 1e-9))
