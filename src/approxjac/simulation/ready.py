"""Where a run may start: a posture that motors hold, that is seen and far from singular; limits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin

from approxjac.checks import Array
from approxjac.errors import InvalidInputError
from approxjac.robots import Dynamics, Robot
from approxjac.tasks import Task

_DRAWN = 300
_INNER = 0.8  # share of each joint's range that is drawn from
_HOLDABLE = 0.7  # of the effort limits


def ready_posture(sensor: Task, effort: Array, is_free: Callable[[Array], bool]) -> Array:
    """The rule of `Plant.ready_posture`, for motors with the limits `effort`, shape (n_v,).

    Of the postures that are free, `is_free(q)`.
    """
    robot = sensor.robot
    rng, dynamics = np.random.default_rng(0), Dynamics(robot)
    low, high = robot.usual_range()
    middle, half = 0.5 * (low + high), 0.5 * _INNER * (high - low)
    best, found = -1.0, None
    for _ in range(_DRAWN):
        motion = middle + half * rng.uniform(-1.0, 1.0, robot.nv)
        q = np.array(pin.integrate(robot.model, robot.neutral(), motion))
        if not (sensor.sees(q) and holdable(dynamics, q, effort) and is_free(q)):
            continue
        J = sensor.jacobian(q, sensor.value(q))
        sigma_min = float(np.linalg.svd(J, compute_uv=False)[-1])
        if sigma_min > best:
            best, found = sigma_min, q
    if found is None:
        raise InvalidInputError(
            f"q0 must be given for {robot.name}: no posture was found that its motors can hold and "
            f"that {sensor!r} sees; a lighter object may help",
            given=None,
        )
    return found


def holdable(dynamics: Dynamics, q: Array, effort: Array) -> bool:
    """Whether holding a posture takes at most 70 % of the effort limits."""
    return not (np.abs(dynamics.g(q)) > _HOLDABLE * effort).any()


def beyond_positions(robot: Robot, q: Array) -> Array:
    """How far each joint is beyond its position limits, negative within.

    Args:
        robot: The robot.
        q: Configurations, shape (N, nq).

    Returns:
        Shape (N, n_v) [rad or m]; −∞ where a joint has no limits.
    """
    low, high = robot.position_limits
    motions = np.array([pin.difference(robot.model, robot.neutral(), each) for each in q])
    return np.asarray(np.maximum(motions - high, low - motions))


def farthest_beyond(robot: Robot, q: Array) -> str:
    """Which joint was how far beyond its position limits at most, in words.

    Args:
        robot: The robot.
        q: Configurations, shape (N, nq), at least one beyond them.
    """
    beyond = beyond_positions(robot, q).max(axis=0)
    i = int(beyond.argmax())
    name, unit = robot.joint_names[i], robot.joint_units[i]
    return f"{name} was {beyond[i]:.2g} {unit} beyond its position limits"


def require_radians(robot: Robot, q0: Array) -> None:
    """Refuse a start that is a turn or more beyond the limits of a joint: it is in degrees.

    One that is a little beyond them may be where another run ended.

    Raises:
        InvalidInputError: It is.
    """
    beyond = beyond_positions(robot, q0[np.newaxis])[0]
    beyond[np.array(robot.joint_units) != "rad"] = 0.0
    if beyond.max() > 2.0 * np.pi:
        raise InvalidInputError(
            f"q0 must be in radians: it is {beyond.max():.4g} rad beyond the limits of "
            f"{robot.joint_names[int(beyond.argmax())]}; numpy.radians turns degrees into them",
            given=q0,
        )
