"""The gravity regressor Z(q) of eq. (27) in base parameters."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from approxjac.checks import Array, as_vector
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.robots.robot import Robot

_MOMENTS = {"x": 1, "y": 2, "z": 3}  # position in Inertia.toDynamicParameters()
_POSTURES = 60  # random postures that rank and grouping are found from
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
        theta: Their values for `robot` itself, shape (p,).

    Raises:
        InvalidInputError: No or doubled axes, or gravity exerts no torque on this robot.
        UnknownNameError: An axis that is not x, y or z.
    """

    def __init__(self, robot: Robot, moments: str = "xyz") -> None:
        if not moments or len(set(moments)) != len(moments):
            raise InvalidInputError(
                f"moments must name each axis once, such as 'xyz' or 'x', got {moments!r}",
                given=moments,
            )
        for letter in moments:
            if letter not in _MOMENTS:
                raise UnknownNameError("axis", letter, "moments", _MOMENTS)
        self.robot = robot
        self._model = robot.model
        self._data = self._model.createData()
        self._zero = np.zeros(robot.nv)
        offsets = [0, *sorted(_MOMENTS[letter] for letter in moments)]
        candidates = np.array([10 * i + k for i in range(robot.nv) for k in offsets])
        rng = np.random.default_rng(0)
        postures = [robot.random_configuration(rng) for _ in range(_POSTURES)]
        stacked = np.vstack([self._full(q)[:, candidates] for q in postures])
        kept, grouping = _independent_columns(stacked)
        if not kept:
            raise InvalidInputError(
                f"gravity exerts no torque on {robot.name}: there is nothing to learn "
                f"(gravity is {robot.gravity.tolist()} m/s^2)",
                given=robot,
            )
        self._columns = candidates[kept]
        labels = ["m", "mx", "my", "mz"]
        self.names = tuple(f"{robot.joint_names[c // 10]}.{labels[c % 10]}" for c in self._columns)
        parameters = np.concatenate(
            [inertia.toDynamicParameters() for inertia in list(self._model.inertias)[1:]]
        )
        self.theta = grouping @ parameters[candidates]
        self.theta.flags.writeable = False

    @property
    def p(self) -> int:
        """Number of parameters."""
        return len(self._columns)

    def Z(self, q: Array) -> Array:
        """Gravity regressor Z(q), shape (n_v, p) [m²/s² for first moments, with g inside]."""
        return self._full(q)[:, self._columns]

    def fit(self, robot: Robot, *, seed: int = 0) -> tuple[Array, float]:
        """Return the θ with which this Z(q) reproduces the gravity of another robot.

        Args:
            robot: Robot with the same joints, such as the true one.
            seed: Of the random postures.

        Returns:
            θ, shape (p,), and the residual: the largest error of Z θ relative to the largest
            gravity torque, over random postures that the fit did not use.

        Raises:
            InvalidInputError: Another number of joints.
        """
        if robot.nv != self.robot.nv or robot.nq != self.robot.nq:
            raise InvalidInputError(
                f"robot must have {self.robot.nv} joints like {self.robot.name}, "
                f"got {robot.nv} ({robot.name})",
                given=robot,
            )
        data = robot.model.createData()
        rng = np.random.default_rng(seed)

        def samples() -> tuple[Array, Array]:
            postures = [self.robot.random_configuration(rng) for _ in range(_POSTURES)]
            Z = np.vstack([self.Z(q) for q in postures])
            torques = [pin.computeGeneralizedGravity(robot.model, data, q) for q in postures]
            return Z, np.concatenate([np.array(g) for g in torques])

        Z, g = samples()
        theta: Array = np.linalg.lstsq(Z, g, rcond=None)[0].astype(np.float64)
        Z, g = samples()
        residual = float(np.abs(Z @ theta - g).max() / max(np.abs(g).max(), 1e-300))
        return theta, residual

    def _full(self, q: Array) -> Array:
        """All columns at rest, shape (n_v, 10 n_v); an alias of scratch memory."""
        regressor: Array = pin.computeJointTorqueRegressor(
            self._model, self._data, as_vector("q", q, self.robot.nq), self._zero, self._zero
        )
        return regressor

    def __repr__(self) -> str:
        return f"GravityRegressor({self.robot.name!r}: {self.p} parameters {', '.join(self.names)})"


def _independent_columns(A: Array) -> tuple[list[int], Array]:
    """Keep each column of A that does not depend on those before it.

    Returns:
        The kept column indices, and the matrix G with A θ = A[:, kept] (G θ) for all θ.
    """
    scale = np.linalg.norm(A, axis=0)
    largest = scale.max(initial=0.0)
    kept: list[int] = []
    basis = np.zeros((A.shape[0], 0))
    for j in range(A.shape[1]):
        if scale[j] <= _RANK_TOLERANCE * largest:
            continue
        column = A[:, j] / scale[j]
        for _ in range(2):  # Gram-Schmidt twice is as good as Householder
            column = column - basis @ (basis.T @ column)
        norm = float(np.linalg.norm(column))
        if norm > _RANK_TOLERANCE:
            basis = np.column_stack([basis, column / norm])
            kept.append(j)
    if not kept:
        return kept, np.zeros((0, A.shape[1]))
    grouping: Array = np.linalg.lstsq(A[:, kept], A, rcond=None)[0].astype(np.float64)
    grouping[np.abs(grouping) < 1e-12] = 0.0
    return kept, grouping
