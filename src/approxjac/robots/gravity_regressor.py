"""The gravity regressor Z(q) of eq. (27) in base parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.robots.dynamics import Dynamics
from approxjac.robots.robot import Robot
from approxjac.robots.traced import arm_of
from approxjac.validation import Array, as_array, as_number, axis_rows, require, shape_of

_RANK_TOLERANCE = 1e-9


class GravityRegressor:
    """g(q) = Z(q) θ with as few parameters as gravity can tell apart.

    Pinocchio's joint-torque regressor at rest has for each moving link its mass and three first
    moments (m c_x, m c_y, m c_z). Many of these columns depend on each other (an outer link's
    mass acts like a first moment of its parent). A column that depends on columns before it,
    in link order, is left out and its parameter is added to theirs.

    The span of Z does not change when the translations of joint origins are wrong, so gravity
    can be learnt exactly with wrong lengths; wrong axis directions break that.

    Owns scratch memory: one instance a thread.

    Args:
        robot: The (believed) robot.
        moments: Axes of the link frames along which centres of mass may lie. "xyz" assumes
            nothing. "x" is the paper's arm, whose rods lie along x: it gives exactly the
            paper's θ₁ and θ₂, where "xyz" gives two more that are zero there.

    Attributes:
        names: Names of the parameters, such as "joint1.mx" [kg m] or "joint1.m" [kg].
        units: Their units.
        theta: Their values for `robot` itself, shape (p,).
        columns: Their places among the ten dynamic parameters of each joint, shape (p,).

    Raises:
        InvalidInputError: No or doubled axes, centres of mass of `robot` that `moments` does not
            cover, or gravity exerts no torque on this robot.
        UnknownNameError: An axis that is not x, y or z.
    """

    def __init__(self, robot: Robot, moments: str = "xyz") -> None:
        require("robot", robot, Robot, "a Robot")
        self._moments = moments
        axes = axis_rows("moments", moments)
        self.robot = robot
        self._model = robot.mimic_joints.model  # Pinocchio has no regressor with mimic joints
        self._data = self._model.createData()
        self._zero = np.zeros(self._model.nv)
        # of each link's ten dynamic parameters, the first four are m, m c_x, m c_y, m c_z
        offsets = [0, *(1 + axis for axis in sorted(axes))]
        candidates = np.array([10 * i + k for i in range(self._model.nv) for k in offsets])
        rng = np.random.default_rng(0)
        stacked = np.vstack([self._full(q)[:, candidates] for q in _anywhere(robot, rng)])
        kept, grouping = _independent_columns(stacked)
        if not kept:
            raise InvalidInputError(
                f"gravity exerts no torque on {robot.name}: there is nothing to learn "
                f"(gravity is {robot.gravity.tolist()} m/s^2)",
                given=robot,
            )
        self.columns = candidates[kept]
        self._held = grouping[:, candidates // 10 == self._last_mover()]
        self._usual = np.sqrt(np.mean(stacked[:, kept] ** 2, axis=0))
        labels = ["m", "mx", "my", "mz"]
        movers = list(self._model.names)[1:]
        self.names = tuple(f"{movers[c // 10]}.{labels[c % 10]}" for c in self.columns)
        self.units = tuple("kg m" if c % 10 else "kg" for c in self.columns)
        parameters = np.concatenate(
            [inertia.toDynamicParameters() for inertia in list(self._model.inertias)[1:]]
        )
        self.theta = grouping @ parameters[candidates]
        self.theta.flags.writeable = False
        error = self._error(robot, self.theta, rng)
        if error > 1e-9:
            raise InvalidInputError(
                f"moments must cover the centres of mass of {robot.name}, got {moments!r}: gravity "
                f"would be wrong by {100 * error:.2g} %; 'xyz' covers every robot",
                given=moments,
            )

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.robot, self._moments)  # a copy has scratch memory of its own

    @property
    def p(self) -> int:
        """Number of parameters."""
        return len(self.columns)

    def Z(self, q: Array) -> Array:
        """Gravity regressor Z(q), shape (n_v, p) [m²/s² for first moments, with g inside]."""
        if type(q) is not np.ndarray and (arm := arm_of(self.robot, q)) is not None:
            return np.asanyarray(arm.Z(self))
        return self._full(self.robot.configuration(q)).take(self.columns, 1)

    def fit(self, robot: Robot, *, seed: int = 0) -> tuple[Array, float]:
        """Return the θ with which this Z(q) reproduces the gravity of another robot.

        Of all θ that do so equally well, the one nearest to this robot's own.

        Args:
            robot: Robot with the same joints, such as the true one.
            seed: Of the random configurations.

        Returns:
            θ, shape (p,), and the residual, which is the largest error of Z θ relative to the
            largest gravity torque, over random configurations that the fit did not use.

        Raises:
            InvalidInputError: Other joints, or another gravity.
        """
        require("robot", robot, Robot, "a Robot")
        if robot.joint_names != self.robot.joint_names:
            raise InvalidInputError(
                f"robot must have the joints of {self.robot.name} "
                f"({', '.join(self.robot.joint_names)}), got {robot!r}",
                given=robot,
            )
        if not np.array_equal(robot.gravity, self.robot.gravity):
            raise InvalidInputError(
                f"robot must be under the gravity {self.robot.gravity.tolist()} of the regressor "
                f"[m/s^2], got {robot.gravity.tolist()}",
                given=robot,
            )
        rng = np.random.default_rng(seed)
        Z, g = self._samples(robot, rng)
        theta: Array = self.theta + np.linalg.lstsq(Z, g - Z @ self.theta, rcond=1e-12)[0]
        return theta, self._error(robot, theta, rng)

    def payload(self, change: Array) -> Array:
        """Return the load on the last link that acts most like a change of θ (p,).

        Returns:
            Mass [kg] and first moments in the axes of that link's joint [kg m], those of `moments`
            only; of all loads that do so equally well, the smallest. Shape (1 + moments,).
        """
        weighted = self._held * self._usual[:, np.newaxis]
        load: Array = np.linalg.lstsq(weighted, change * self._usual, rcond=1e-9)[0]
        return load

    def _last_mover(self) -> int:
        """Return the index of the moving link that holds the tip."""
        model, tip = self._model, self.robot.tip
        if tip is None:
            return int(model.nv) - 1
        return int(model.frames[model.getFrameId(tip, pin.FrameType.BODY)].parentJoint) - 1

    def _samples(self, robot: Robot, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return Z of this robot and g of another, stacked over random configurations."""
        dynamics, configurations = Dynamics(robot), _anywhere(robot, rng)
        Z = np.vstack([self.Z(q) for q in configurations])
        return Z, np.concatenate([dynamics.g(q) for q in configurations])

    def _error(self, robot: Robot, theta: Array, rng: np.random.Generator) -> float:
        """Return the largest error of Z θ over new configurations, relative to the largest g."""
        Z, g = self._samples(robot, rng)
        return float(np.abs(Z @ theta - g).max() / max(np.abs(g).max(), 1e-300))

    def _full(self, q: Array) -> Array:
        """Return all columns at rest, ten for each moving link; an alias of scratch memory."""
        mimic_joints = self.robot.mimic_joints
        regressor: Array = pin.computeJointTorqueRegressor(
            self._model, self._data, mimic_joints.q(q), self._zero, self._zero
        )
        if regressor.ndim == 1:  # of one joint Pinocchio's regressor has lost an axis
            regressor = regressor[np.newaxis]
        return mimic_joints.rows(regressor)

    def __repr__(self) -> str:
        return f"GravityRegressor({self.robot.name!r}: {self.p} parameters {', '.join(self.names)})"


def _anywhere(robot: Robot, rng: np.random.Generator) -> list[Array]:
    """Return 60 configurations over full turns (and ±1 m): limits must not hide a column."""
    reach = np.where(np.array(robot.joint_units) == "m", 1.0, np.pi)
    motions = rng.uniform(-reach, reach, (60, robot.nv))
    return [np.array(pin.integrate(robot.model, robot.neutral(), motion)) for motion in motions]


def _independent_columns(A: Array) -> tuple[list[int], Array]:
    """Return the columns of A that do not depend on those before, and G with A = A[:, kept] G."""
    scale = np.linalg.norm(A, axis=0)
    some = np.nonzero(scale > _RANK_TOLERANCE * scale.max(initial=0.0))[0]
    # on the diagonal is what of a column no combination of those before it makes
    alone = np.abs(np.diag(np.linalg.qr(A[:, some] / scale[some], mode="r")))
    kept: list[int] = some[alone > _RANK_TOLERANCE].tolist()
    grouping: Array = np.linalg.lstsq(A[:, kept], A, rcond=None)[0].astype(np.float64)
    grouping[np.abs(grouping) < 1e-12] = 0.0
    return kept, grouping


@dataclass(frozen=True, eq=False, repr=False)
class Excitation:
    """Report of which parameters θ of g = Z(q)θ the configurations of a motion tell apart.

    Attributes:
        names: Names of the parameters, length p.
        effect: Root mean square of the torque that one unit of a parameter makes, shape (p,)
            [N m per unit].
        own: What of it no combination of the other parameters can make, shape (p,) [N m per unit].
            Where it is 0, learning cannot tell the parameter from others on this motion.
        threshold: Share of `effect` that `own` has to reach for a parameter to count as excited.
        rank: Number of combinations of parameters that the motion excites.
    """

    names: tuple[str, ...]
    effect: Array
    own: Array
    threshold: float
    rank: int

    @property
    def excited(self) -> tuple[str, ...]:
        """Parameters that the motion determines by themselves."""
        large = (self.effect > 0.0) & (self.own >= self.threshold * self.effect)
        return tuple(name for name, is_large in zip(self.names, large, strict=True) if is_large)

    def __repr__(self) -> str:
        width, excited = max(len(name) for name in self.names), self.excited
        lines = [
            f"  {name:{width}}  {effect:9.3g}  {own:9.3g}  {'yes' if name in excited else 'no'}"
            for name, effect, own in zip(self.names, self.effect, self.own, strict=True)
        ]
        lines[:0] = [
            f"Excitation: {self.rank} of {len(self.names)} combinations",
            f"  {'':{width}}  {'effect':>9}  {'own':>9}  excited   [N m per unit]",
        ]
        return "\n".join(lines)


def excitation(regressor: GravityRegressor, q: Array, threshold: float = 0.05) -> Excitation:
    """Report which gravity parameters a motion excites, such as `run.q`.

    Learnt gravity (29) needs no excitation to bring the task to its target; θ̂ reaches θ only
    along what is excited.

    Args:
        regressor: The regressor.
        q: Configurations of the motion, shape (N, nq) [rad or m].
        threshold: Share of a parameter's effect that must be its own, from 0 to 1.

    Raises:
        InvalidInputError: Wrong shapes or not finite, no configuration, or a threshold out of
            range.
    """
    require("regressor", regressor, GravityRegressor, "a GravityRegressor")
    robot = regressor.robot
    size = robot.nv if shape_of(q)[1:] == (robot.nv,) else robot.nq  # or angles of the joints
    q = as_array("q", q, ("N", size), "rad or m")
    threshold = as_number("threshold", threshold, above=0.0)
    if threshold > 1.0:
        raise InvalidInputError(f"threshold must be at most 1, got {threshold:g}", given=threshold)
    Z = np.vstack([regressor.Z(each) for each in q]) / np.sqrt(len(q))
    effect = np.linalg.norm(Z, axis=0)
    effect[effect < 1e-12 * effect.max()] = 0.0  # round-off
    A = np.divide(Z, effect, out=np.zeros_like(Z), where=effect > 0.0)
    A_plus = np.linalg.pinv(A, rcond=1e-6)
    # 1/(A⁺A⁺ᵀ)ₖₖ is the squared distance of column k to the span of the others; a parameter with a
    # share in the null space has none
    alone = 1.0 - np.einsum("ij,ji->i", A_plus, A) < 1e-6
    own = np.divide(effect, np.linalg.norm(A_plus, axis=1), out=np.zeros_like(effect), where=alone)
    rank = int(np.linalg.matrix_rank(A, tol=threshold))
    return Excitation(regressor.names, effect, own, threshold, rank)
