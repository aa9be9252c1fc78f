"""Sources of the gravity torque of a law."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, get_args

import numpy as np

from approxjac import law
from approxjac.controllers.gains.gains import Diagonals
from approxjac.controllers.gains.tuning import Learning, slow_rate
from approxjac.errors import InvalidInputError
from approxjac.formatting import listed, numbers_of, short
from approxjac.robots import Dynamics, GravityRegressor, Robot
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


class ModelGravity(Immutable):
    """g(q) of a robot's model by RNEA, as exact as its masses and lengths.

    Args:
        robot: The believed robot.
    """

    def __init__(self, robot: Robot) -> None:
        require("robot", robot, Robot, "the believed Robot")
        self.robot, self._dynamics = robot, Dynamics(robot)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.robot.name!r})"

    def torque(self, q: Array) -> Array:
        """Return g(q), shape (n_v,) [N m or N]."""
        return self._dynamics.g(q)


class NoGravity(ModelGravity):
    """No gravity torque: the robot compensates it by itself, or there is none."""

    def torque(self, q: Array) -> Array:
        """Return zeros, shape (n_v,)."""
        return np.zeros(self.robot.nv)


class RegressorGravity(Immutable):
    """g(q) = Z(q) θ, eq. (27), with known θ (from identification or a data sheet).

    It can be exact even if the regressor's robot has wrong lengths: see `GravityRegressor`.

    Args:
        regressor: Z(q) of the believed robot.
        theta: Its parameters, shape (p,).

    Raises:
        InvalidInputError: Wrong shape or not finite.
    """

    def __init__(self, regressor: GravityRegressor, theta: Sequence[float] | Array) -> None:
        wanted = "a GravityRegressor of the believed robot"
        require("regressor", regressor, GravityRegressor, wanted)
        self.regressor, self.robot = regressor, regressor.robot
        self.theta = as_array("theta", theta, (regressor.p,))

    def __repr__(self) -> str:
        return f"RegressorGravity({self.robot.name!r}, theta={listed(self.theta)})"

    def torque(self, q: Array) -> Array:
        """Return Z(q) θ, shape (n_v,) [N m or N]."""
        return np.asanyarray(self.regressor.Z(q).dot(self.theta))


class AdaptiveGravity(Immutable):
    """The learnt gravity torque Z(q) θ̂_g + Ĵᵀd̂ + ŵ, with θ̂ = (θ̂_g, d̂, ŵ) adapted by eq. (29).

    θ_g are gravity parameters, d is a constant force on the task (integral action with a proof), w
    are constant joint torques, which compensate friction. Eqs. (28) and (29) hold for the
    regressor Y = [Z, Ĵᵀ, I] with θ = (θ_g, 0, 0), and V̇ = −W with it.

    Adaptation pauses while x is lost, while the target is out of reach, and while the law's torque
    is beyond `torque_limits`: a saturated motor gives no evidence about gravity.

    Args:
        model: The believed robot, or a `GravityRegressor` of it. Its payload affects θ̂_g(0) only.
        L: Adaptation gain of θ_g: a number, a diagonal (p,), or a symmetric positive definite
            matrix (p, p); 0 learns d and w only. None is that of `tuned`.
        alpha: α > 0 of eq. (10) [1/s]; by default the rate of the task's slow pole.
        theta0: θ̂_g(0), a number or shape (p,); that of the believed robot by default.
        bounds: Smallest and largest θ̂_g, each a number or shape (p,), kept to within one step of
            dt. By default none if L is given, else those of `tuned`.
        torque_limits: Torques beyond which adaptation pauses, a number or shape (n_v,) [N m or N];
            the believed robot's effort limits by default, `numpy.inf` for never.
        task_force: L_d ≥ 0 of d, a number or shape (m,); 0 does not learn it. By default 0 if a
            nonzero L is given, else that of `tuned`.
        joint_torque: L_w ≥ 0 of w, a number or shape (n_v,); default as for `task_force`.

    Attributes:
        regressor: Z(q) of the believed robot.
        L: As a diagonal (p,) or a matrix (p, p), or None.
        bounds: As two arrays (p,), or None.

    Raises:
        InvalidInputError: Wrong shapes, not finite, L negative, alpha not positive, or bounds that
            are reversed or do not hold theta0.
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
        *,
        task_force: float | Sequence[float] | Array | None = None,
        joint_torque: float | Sequence[float] | Array | None = None,
    ) -> None:
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
        for name, value in (("task_force", task_force), ("joint_torque", joint_torque)):
            if value is not None:
                value = as_diagonal(name, value, positive=False)
            setattr(self, name, value)

    def __repr__(self) -> str:
        L = "" if self.L is None else f", L={short(self.L) if self.L.ndim == 1 else 'a matrix'}"
        alpha = "" if self.alpha is None else f", alpha={self.alpha:.4g}"
        return f"AdaptiveGravity({self.robot.name!r}, {self.regressor.p} parameters{L}{alpha})"

    def _bounds(self, bounds: Any) -> tuple[Array, Array]:
        if not is_scalar(bounds) and len(bounds) == 2:
            lower, upper = (as_entries("bounds", bound, self.regressor.p) for bound in bounds)
            holds = (lower < upper) & (lower <= self.theta0) & (self.theta0 <= upper)
            if holds.all():
                return lower, upper
        raise InvalidInputError(
            "bounds must be a smallest and a larger theta that hold theta0 = "
            f"{self.theta0.tolist()}, got {bounds!r}",
            given=bounds,
        )

    def adaptation(self, task: Task, gains: Diagonals, chosen: Learning | None) -> Adaptation:
        """Return this with its defaults filled in, for a task, gains and the choice of `tuned`.

        Raises:
            InvalidInputError: A task force or joint torques of another length.
        """
        p, m, nv = self.regressor.p, task.m, self.robot.nv
        alpha, L = self.alpha, self.L
        if alpha is None:
            alpha = slow_rate(task, gains) if chosen is None else chosen.alpha
        parts: list[Array] = []
        for name, size in (("task_force", m), ("joint_torque", nv)):
            given = getattr(self, name)
            if given is None:
                given = 0.0 if chosen is None else getattr(chosen, name)
            values = np.ravel(given)
            whole = np.full(size, values[0]) if len(values) == 1 else values
            part = as_diagonal(name, whole, size, positive=bool(whole.any()))
            parts.append(part if part.any() else np.zeros(0))
        if L is None:
            assert chosen is not None
            L = chosen.gravity
        sizes, own = (p, len(parts[0]), len(parts[1])), L
        L = np.concatenate([np.zeros(p), *parts])
        L = L if own.ndim == 1 else np.diag(L)
        L[(slice(p),) * own.ndim] = own
        theta0 = np.concatenate([self.theta0, np.zeros(sum(sizes[1:]))])
        bounds = None
        if self.bounds is not None or (chosen is not None and self.L is None):
            most = np.full(p + m + nv, np.inf) if chosen is None else chosen.largest
            kinds = np.split(most, [p, p + m])
            widths = np.concatenate([kind[:size] for kind, size in zip(kinds, sizes, strict=True)])
            bounds = theta0 - widths, theta0 + widths
            if self.bounds is not None:
                for side, given in zip(bounds, self.bounds, strict=True):
                    side[:p] = given
        weight, limits = None if chosen is None else chosen.pinv_weight, self.torque_limits
        return Adaptation(self.regressor, sizes, L, alpha, theta0, bounds, limits, limits, weight)


class Adaptation(NamedTuple):
    """An `AdaptiveGravity` with its defaults filled in, for one task and its gains."""

    regressor: GravityRegressor  # Z(q) of the believed robot
    sizes: tuple[int, int, int]  # numbers of θ_g, d and w that are learnt
    L: Array  # of all parameters, a diagonal (P,) or a matrix (P, P)
    alpha: float  # α [1/s]
    theta0: Array  # θ̂(0), shape (P,)
    bounds: tuple[Array, Array] | None  # smallest and largest θ, each shape (P,)
    torque_limits: Array  # torques beyond which θ̂ stands still, shape (n_v,)
    # those limits, also within a limiter, which decides itself when θ̂ stands still: what θ̂ alone
    # asks for grows no further beyond them
    motors: Array
    pinv_weight: Array | None  # of Ĵ⁺ in y of (10), as of `law.cross_weight_pinv`; None is I

    def __repr__(self) -> str:
        L = short(self.L) if self.L.ndim == 1 else "a matrix"
        return f"Adaptation({self.regressor.robot.name!r}, L={L}, alpha={self.alpha:.4g})"

    @property
    def robot(self) -> Robot:
        """The believed robot."""
        return self.regressor.robot

    def parameters(self, task: Task) -> dict[str, str]:
        """Return names and units of θ̂: of gravity, the force on the task and joint torques."""
        _, forces, torques = self.sizes
        kinds = {"m": "N", "rad": "N m"}
        parameters = dict(zip(self.regressor.names, self.regressor.units, strict=True))
        if forces:
            pairs = zip(task.labels, task.units, strict=True)
            parameters |= {f"force along {at}": kinds.get(u, f"J/{u}") for at, u in pairs}
        if torques:
            joints = zip(self.robot.joint_names, self.robot.joint_units, strict=True)
            parameters |= {f"torque of {at}": kinds[u] for at, u in joints}
        return parameters

    def Y(self, q: Array, J_hat: Array) -> Array:
        """Return Y = [Z, Ĵᵀ, I], only the learnt columns, shape (n_v, P)."""
        Z = self.regressor.Z(q)
        _, forces, torques = self.sizes
        if not (forces or torques):
            return Z
        parts = [Z, J_hat.T] if forces else [Z]
        return np.concatenate([*parts, np.eye(torques)] if torques else parts, axis=1)

    def whole(self, theta: Array) -> Array:
        """Return θ = (θ_g, 0, 0), shape (P,), from θ_g (p,): the true constant forces are zero."""
        return np.pad(theta, (0, sum(self.sizes[1:])))

    def describe(self, theta_hat: Array, task: Task) -> str:
        """Describe a θ̂ (P,): the load that acts most like it, and constant forces."""
        of_gravity, *constant = np.split(theta_hat - self.theta0, np.cumsum(self.sizes)[:-1])
        mass, *moments = self.regressor.payload(of_gravity)
        at = numbers_of(np.round(moments, 4))
        parts = [f"a load on the last link of {mass:+.3g} kg, its first moment {at} kg m"]
        forces = np.concatenate(constant)
        if len(forces):
            others = [*self.parameters(task).items()][self.regressor.p :]
            each = zip(forces, others, strict=True)
            rows = [f"{value:+.3g} {unit} ({name})" for value, (name, unit) in each]
            parts.append(f"constant {', '.join(rows)}")
        return f"to compensate, beside the believed arm's weight: {'; '.join(parts)}"

    def bounded(self, rate: Array, theta_hat: Array, Y: Array, g: Array) -> tuple[Array, Any]:
        """Return dθ̂/dt (P,) within bounds, for g = Yθ̂ (n_v,), and whether that failed.

        Beside the bounds of each parameter, |Yθ̂| may not grow beyond the motors' limits. V̇ ≤ −W
        remains true if the motors can hold the true arm at q.
        """
        if self.bounds is None:
            return rate, False
        if type(rate) is not np.ndarray:
            return law.swept_within_bounds(rate, theta_hat, self.bounds, self.L, Y, g, self.motors)
        outward = None
        if _is_beyond(g, self.motors):
            beyond = np.abs(g) > self.motors
            outward = np.sign(g[beyond])[:, np.newaxis] * Y[beyond]
        return law.within_bounds(rate, theta_hat, *self.bounds, self.L, outward), False

    def rests(self, torque: Array) -> Any:
        """Return True if any torque (n_v,) is beyond its limit, so that adaptation pauses."""
        return _is_beyond(torque, self.torque_limits)


def _is_beyond(torque: Array, limits: Array) -> Any:
    if torque.dtype.hasobject:
        finite = np.isfinite(limits)
        return (np.abs(torque) > limits)[finite].any() if finite.any() else False
    share = torque / limits
    # the norm first: it is cheap, and mostly small enough
    return bool(math.hypot(*share.tolist()) > 1.0 and np.abs(share).max() > 1.0)


Gravity = ModelGravity | RegressorGravity | AdaptiveGravity | Adaptation


def require_gravity(gravity: Gravity, task: Task) -> None:
    """Raise an InvalidInputError for no gravity source, or one of a robot with other joints."""
    wanted = (
        "one of ModelGravity, RegressorGravity, AdaptiveGravity and NoGravity, such as "
        "AdaptiveGravity(belief), or derived from ModelGravity with a torque(q) of your own"
    )
    require("gravity", gravity, get_args(Gravity), wanted)
    robot = task.robot
    if gravity.robot.joint_names != robot.joint_names:
        raise InvalidInputError(
            f"gravity must be that of a robot with the joints of the task's robot "
            f"({', '.join(robot.joint_names)}), got {gravity.robot!r}",
            given=gravity,
        )
    if isinstance(gravity, ModelGravity | RegressorGravity):  # which may be a class of one's own
        q = next(robot.configurations(1))
        as_array(f"torque(q) of {gravity!r}", gravity.torque(q), (robot.nv,), "N m or N")


def describe_gravity(gravity: Gravity, believed: Robot) -> str:
    """Describe a source of gravity torque, compared with the believed arm."""
    kind, robot = type(gravity), gravity.robot
    if kind is NoGravity:
        weightless = not believed.gravity.any()
        return "known exactly: the arm is taken without it" if weightless else "not compensated"
    if kind is not ModelGravity:
        return "as its parameters say" if kind is RegressorGravity else f"by {kind.__name__}"
    if robot == believed:
        return "as of the believed arm"
    other = [f"{robot.mass:.4g} kg"] if robot.urdf != believed.urdf else []
    if (robot.gravity != believed.gravity).any():
        other.append(f"gravity vector {listed(robot.gravity)} m/s²")
    return f"as of another model: {robot.name} ({', '.join(other)})"


def _adaptation_gain(L: Any, p: int) -> Array:
    if is_scalar(L) and L == 0.0:
        return np.zeros(p)
    if is_scalar(L) or all(is_scalar(row) for row in L):
        return as_diagonal("L", L, p)
    matrix = as_array("L", L, (p, p))
    as_diagonal("L", np.abs(matrix).max(), p)  # not beyond what gains may be
    asymmetry = np.abs(matrix - matrix.T).max()
    if asymmetry > 1e-9 * np.abs(matrix).max() or np.linalg.eigvalsh(matrix)[0] <= 0.0:
        message = f"L must be symmetric positive definite, got {matrix.tolist()}"
        raise InvalidInputError(message, given=L)
    return matrix
