"""Gains of the bounded law, and what its torque can come to over the range of the joints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from approxjac.checks import (
    Array,
    as_array,
    as_diagonal,
    as_limits,
    as_number,
    is_scalar,
    require,
    shape_of,
)
from approxjac.controllers.gravity import (
    AdaptiveGravity,
    Gravity,
    NoGravity,
    RegressorGravity,
    believed_gravity,
    require_gravity,
)
from approxjac.controllers.tuning import joint_damping, position_gains
from approxjac.errors import InvalidInputError
from approxjac.robots import Robot
from approxjac.robots.ranges import JointRange, Load
from approxjac.tasks import ImageTask, PlanarCamera, PoseTask, PositionTask, StackedTask, Task
from approxjac.text import short_fields

JointRangeLike = tuple[float | Sequence[float] | Array, float | Sequence[float] | Array]

_POSTURES = 2000  # drawn where no bound of a Jacobian is known
_DRAWN_MARGIN = 1.1
_SHARE = 0.45  # below a half: see `bounded_gains`
_NOTHING = 1e-3  # share of a limit that counts as nothing left
_ROUNDING = 1e-9
_SMALLEST = 1e-60


@dataclass(frozen=True, eq=False, repr=False)
class BoundedGains:
    """Gains of `BoundedController`, each a number or one number a coordinate or joint.

    Near the target the law is law (6) with this K_p, K_v = 0 and B_c = K_d/v₀.

    Attributes:
        kp: K_p > 0, a number or shape (m,) [N per unit of the task where that is metres].
        gamma: γ > 0 of s(e) = γ tanh(e/γ), a number or shape (m,) [unit of the task]. The force
            along a coordinate is at most K_p γ.
        kd: K_d > 0, the largest damping torque, a number or shape (n_v,) [N m or N].
        v0: v₀ > 0, the velocity at which it saturates, a number or shape (n_v,) [rad/s or m/s].

    Raises:
        InvalidInputError: Not finite, not positive, or beyond what can be computed with.
    """

    kp: float | Sequence[float] | Array
    gamma: float | Sequence[float] | Array
    kd: float | Sequence[float] | Array
    v0: float | Sequence[float] | Array

    def __post_init__(self) -> None:
        for name in ("kp", "gamma", "kd", "v0"):
            value = getattr(self, name)
            diagonal = as_diagonal(name, value, math.prod(shape_of(value)))
            if (diagonal < _SMALLEST).any():  # or dividing by it could overflow
                raise InvalidInputError(
                    f"{name} must be at least {_SMALLEST:g}, got {diagonal.tolist()}", given=value
                )
            # a copy, so that nobody changes it later
            object.__setattr__(self, name, float(value) if is_scalar(value) else diagonal)

    def __repr__(self) -> str:
        return short_fields(self)

    def diagonals(self, m: int, nv: int) -> BoundedDiagonals:
        """Return the diagonals for a task of m coordinates on an arm of n_v joints.

        Raises:
            InvalidInputError: A vector of another length.
        """
        return BoundedDiagonals(
            as_diagonal("kp", self.kp, m),
            as_diagonal("gamma", self.gamma, m),
            as_diagonal("kd", self.kd, nv),
            as_diagonal("v0", self.v0, nv),
        )


class BoundedDiagonals(NamedTuple):
    """Bounded gains as vectors: kp (m,), gamma (m,), kd (n_v,), v0 (n_v,)."""

    kp: Array
    gamma: Array
    kd: Array
    v0: Array


def bounded_gains(
    task: Task,
    torque_limits: float | Sequence[float] | Array | None = None,
    *,
    gravity: Gravity | None = None,
    joint_range: JointRangeLike | None = None,
    settling_time: float = 1.0,
    bandwidth: float = 1000.0,
    task_share: float = _SHARE,
) -> BoundedGains:
    """Gains with which the bounded law stays within torque limits over a range of the joints.

    With ḡᵢ the largest gravity torque of joint i over the range, and L̄ᵢ the largest Σⱼabs(Ĵⱼᵢ),

        f = share · minᵢ (limitᵢ − ḡᵢ) / L̄ᵢ,   k_di = limitᵢ − ḡᵢ − f L̄ᵢ,

    so that abs(τᵢ) ≤ ḡᵢ + f L̄ᵢ + k_di = limitᵢ. The force f along every coordinate is K_p γ, and
    coordinates of each unit get an equal part of the share. Of what gravity leaves, damping gets
    at least the other 1 − share. With a share below ½ the task's torque is at most
    share / (1 − share) of each joint's largest damping torque, so that no joint is accelerated
    for ever, however wrong Ĵ is. A joint without a limit gets the largest v₀ of the others, or
    more if that ratio asks for it.

    Slopes come from the settling time: B = K_d/v₀ has the diagonal of ĴᵀK_vĴ + B_c of
    `default_gains`, and K_p = r K_b as it has it without K_v. So γ = f/K_p and v₀ = k_d/B.

    ḡ and L̄ are guaranteed bounds, up to a tenth (L̄: a fifth) above what can be found, for
    positions, poses, images of a `PlanarCamera` and stacks of these. For other tasks L̄ is 1.1
    times the largest of 2000 seeded postures.

    Args:
        task: The task of the believed robot.
        torque_limits: A number or shape (n_v,) [N m or N]; the believed robot's effort limits by
            default, infinite where there is none.
        gravity: As in `BoundedController`.
        joint_range: Lowest and highest position of the joints, each a number or shape (n_v,), as
            motions from zero [rad or m]; `Robot.usual_range` by default.
        settling_time: > 0 [s].
        bandwidth: How fast damping may be > 0 [1/s]: see `default_gains`.
        task_share: Part of what gravity leaves that the task force gets, > 0 and < 1.

    Raises:
        InvalidInputError: Limits that leave nothing above gravity, no limit at all, gravity that
            is learnt, or numbers out of range.
    """
    share = as_number("task_share", task_share, above=0.0)
    if share >= 1.0:
        raise InvalidInputError(f"task_share must be < 1, got {task_share!r}", given=task_share)
    require("task", task, Task, "a task of the believed robot, such as PositionTask(robot)")
    limits = limits_of(task.robot, torque_limits)
    extremes = Extremes(task, gravity, joint_range)
    return shared_out(extremes, limits, settling_time, bandwidth, share)


def shared_out(
    extremes: Extremes,
    limits: Array,
    settling_time: float = 1.0,
    bandwidth: float = 1000.0,
    share: float = _SHARE,
) -> BoundedGains:
    """`bounded_gains` for extremes that are known already."""
    task, room = extremes.task, extremes.room(limits)
    robot = task.robot
    units = np.array(task.units)
    groups = [units == unit for unit in dict.fromkeys(task.units)]
    force, taken = np.zeros(task.m), np.zeros(robot.nv)
    for group in groups:
        levers = extremes.task_torque(np.where(group, 1.0, 0.0))
        moved = np.isfinite(room) & (levers > 0.0)
        if not moved.any():
            raise InvalidInputError(
                f"torque_limits must be finite for a joint of {robot.name} that moves {task!r}, "
                f"got {limits.tolist()}: nothing bounds the force; give limits, or "
                "BoundedGains(kp, gamma, kd, v0)",
                given=limits,
            )
        force[group] = share / len(groups) * (room[moved] / levers[moved]).min()
        taken += force[group][0] * levers
    slope = joint_damping(task, settling_time, bandwidth)
    kp = position_gains(task, np.zeros(task.m), slope, settling_time)
    kd = (room - taken) * (1.0 - _ROUNDING)
    v0 = kd / slope
    unlimited = ~np.isfinite(v0)
    usual = v0[~unlimited].max()
    v0[unlimited] = np.maximum(usual, (1.0 - share) / share * taken / slope)[unlimited]
    kd[unlimited] = (slope * v0)[unlimited]
    return BoundedGains(kp=kp, gamma=force / kp, kd=kd, v0=v0)


def limits_of(robot: Robot, torque_limits: object) -> Array:
    """Torque limits as an array (n_v,), those of the robot where None is given."""
    limits = robot.effort_limits if torque_limits is None else torque_limits
    return as_limits("torque_limits", limits, robot.nv, unit="N m or N")


class Extremes:
    """The largest gravity torques and task torques over a range of the joints.

    Attributes:
        task: The task.
        gravity: Where the gravity torque comes from.
        holding: ḡ, shape (n_v,) [N m or N].
        guaranteed: Whether task torques are proved bounds, or drawn.
    """

    def __init__(
        self, task: Task, gravity: Gravity | None, joint_range: JointRangeLike | None
    ) -> None:
        require_gravity(gravity)
        if isinstance(gravity, AdaptiveGravity):
            raise InvalidInputError(
                "gravity must not be learnt for a bounded law: nothing bounds Z(q) theta_hat; "
                "give ModelGravity, RegressorGravity or NoGravity",
                given=gravity,
            )
        robot = task.robot
        self.task = task
        self.gravity: Gravity = believed_gravity(gravity, robot)
        self.lower, self.upper = _range_of(robot, joint_range)
        self._range = JointRange(robot, self.lower, self.upper)
        self.holding = self._holding()
        self.guaranteed = _loads(task, np.ones(task.m), self._range) is not None

    def _holding(self) -> Array:
        gravity = self.gravity
        where = JointRange(gravity.robot, self.lower, self.upper)
        if isinstance(gravity, NoGravity):
            return np.zeros(gravity.robot.nv)
        if isinstance(gravity, RegressorGravity):
            return where.largest([where.weight(*gravity.regressor.masses(gravity.theta))])
        return where.largest([where.own_weight()])

    def task_torque(self, force: Array) -> Array:
        """Bound of Σⱼ abs(Ĵⱼᵢ) fⱼ for forces f ≥ 0 along the coordinates, shape (n_v,)."""
        loads = _loads(self.task, force, self._range)
        if loads is not None:
            return self._range.largest(loads)
        rng = np.random.default_rng(0)
        robot = self.task.robot
        largest = np.zeros(robot.nv)
        for _ in range(_POSTURES):
            q = pin.integrate(robot.model, robot.neutral(), rng.uniform(self.lower, self.upper))
            largest = np.maximum(largest, force.dot(np.abs(self.task.jacobian(q))))
        return _DRAWN_MARGIN * largest

    def room(self, limits: Array) -> Array:
        """What gravity leaves of the limits, shape (n_v,).

        Raises:
            InvalidInputError: Nothing at some joint.
        """
        room: Array = limits - self.holding
        short = self.holding >= (1.0 - _NOTHING) * limits
        if short.any():
            robot = self.task.robot
            said = _list(robot, short, "{name} has {0:.4g} {unit} and holding takes up to {1:.4g}",
                         limits, self.holding)  # fmt: skip
            least = [f"{torque:.4g}" for torque in self.holding]
            raise InvalidInputError(
                f"torque_limits must leave something above gravity over the range of the joints of "
                f"{robot.name}: {said}; limits above [{', '.join(least)}] are valid, or a "
                "joint_range within which less is to be held",
                given=limits,
            )
        return room

    def require_within(self, gains: BoundedDiagonals, limits: Array) -> None:
        """Refuse gains whose torque may be beyond the limits.

        Raises:
            InvalidInputError: Some joint's may.
        """
        self.room(limits)
        pull = self.task_torque(gains.kp * gains.gamma)
        bound = self.holding + pull + gains.kd
        beyond = bound > limits * (1.0 + _ROUNDING)
        if beyond.any():
            robot = self.task.robot
            text = (
                "{name} has {0:.4g} {unit} and may be asked for {1:.4g}, of them {2:.4g} for "
                "gravity, {3:.4g} for the task, {4:.4g} for damping"
            )
            said = _list(robot, beyond, text, limits, bound, self.holding, pull, gains.kd)
            raise InvalidInputError(
                f"kp gamma and kd must keep the torque of {robot.name} within its limits over the "
                f"range of the joints: {said}; bounded_gains(task, torque_limits) does",
                given=gains,
            )


def _list(robot: Robot, which: NDArray[np.bool_], text: str, *values: Array) -> str:
    """A clause for each joint."""
    clauses = []
    for i in np.flatnonzero(which):
        unit = "N" if robot.joint_units[i] == "m" else "N m"
        numbers = [value[i] for value in values]
        clauses.append(text.format(*numbers, name=robot.joint_names[i], unit=unit))
    return "; ".join(clauses)


def _range_of(robot: Robot, given: JointRangeLike | None) -> tuple[Array, Array]:
    """A range of joints as two arrays (n_v,)."""
    if given is None:
        return robot.usual_range()
    try:
        lower, upper = given
    except (TypeError, ValueError):
        raise InvalidInputError(
            f"joint_range must be a lowest and a highest position, got {given!r}", given=given
        ) from None
    n = robot.nv
    low, high = (
        as_array("joint_range", [value] * n if is_scalar(value) else value, (n,), "rad or m")
        for value in (lower, upper)
    )
    if (low > high).any():
        raise InvalidInputError(
            f"joint_range must not have a highest position below the lowest, got {low.tolist()} "
            f"to {high.tolist()}",
            given=given,
        )
    return low, high


def _loads(task: Task, force: Array, where: JointRange) -> list[Load] | None:
    """The rows of a task's Jacobian times forces, or None where they are not known."""
    none = np.zeros((0, 3))
    # not isinstance: what derives from these may have another Jacobian
    if type(task) is PositionTask:
        rows = np.eye(3)[["xyz".index(label) for label in task.labels]]
        return [where.point_load(task.frame, force[:, np.newaxis] * rows, none)]
    if type(task) is PoseTask:
        pulls, turns = np.diag(force[:3]), np.diag(force[3:])
        return [where.point_load(task.frame, pulls, turns)]
    if type(task) is ImageTask and type(task.camera) is PlanarCamera and task.frame is not None:
        if task.points.any():
            return None  # the loads of a frame are known where its origin is
        rows = task.camera.interaction(np.zeros(3))
        return [where.point_load(task.frame, force[:, np.newaxis] * rows, none)]
    if type(task) is StackedTask:
        loads: list[Load] = []
        start = 0
        for part in task.tasks:
            found = _loads(part, force[start : start + part.m], where)
            if found is None:
                return None
            loads, start = loads + found, start + part.m
        return loads
    return None
