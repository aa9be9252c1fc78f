"""A configuration to start from: held by the motors, seen, and far from singular."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError
from approxjac.robots import Dynamics
from approxjac.tasks import Task
from approxjac.tasks.analysis import sees
from approxjac.validation import Array

_DRAWN = 300
_INNER = 0.8  # share of each joint's range that is drawn from
_HOLDABLE = 0.7  # of the effort limits


def ready_configuration(sensor: Task, effort: Array, is_free: Callable[[Array], bool]) -> Array:
    """Return the configuration of `Plant.ready_configuration`.

    Args:
        sensor: Task of the true robot.
        effort: Limits of the motors, shape (n_v,) [N m or N].
        is_free: Whether the arm touches nothing in a configuration.
    """
    robot = sensor.robot
    rng, dynamics = np.random.default_rng(0), Dynamics(robot)
    low, high = robot.usual_range()
    middle, half = 0.5 * (low + high), 0.5 * _INNER * (high - low)
    best, found = -1.0, None
    for _ in range(_DRAWN):
        motion = middle + half * rng.uniform(-1.0, 1.0, robot.nv)
        q = np.array(pin.integrate(robot.model, robot.neutral(), motion))
        if not (sees(sensor, q) and holdable(dynamics, q, effort) and is_free(q)):
            continue
        J = sensor.jacobian(q, sensor.value(q))
        sigma_min = float(np.linalg.svd(J, compute_uv=False)[-1])
        if sigma_min > best:
            best, found = sigma_min, q
    if found is None:
        raise InvalidInputError(
            f"q0 must be given for {robot.name}: no configuration was found that its motors can "
            f"hold and that {sensor!r} sees; a lighter object may help",
            given=None,
        )
    return found


def holdable(dynamics: Dynamics, q: Array, effort: Array) -> bool:
    """Return whether holding a configuration takes at most 70 % of the effort limits."""
    return not (np.abs(dynamics.g(q)) > _HOLDABLE * effort).any()
