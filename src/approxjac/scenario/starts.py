"""Start and target configurations, given or random, and checks of reach."""

from collections.abc import Callable
from functools import partial

import numpy as np

from approxjac.controllers.setpoint import Reach
from approxjac.errors import InvalidInputError
from approxjac.robots import Dynamics, Robot
from approxjac.simulation.plant import holdable
from approxjac.tasks import FrameKinematics, Task
from approxjac.validation import Array, as_array

_WAYS = 100  # that are tried
REGULAR = 0.1  # starts and targets have σ_min of J and of Ĵ above this share of σ_max


def regular_configuration(
    sensor: Task,
    task: Task,
    rng: np.random.Generator,
    effort: Array | None = None,
    tries: int = 1000,
) -> Array:
    """Return a random configuration that can be a start or a target.

    Within the joint limits, neither J nor Ĵ is near singular, and holding it takes at most 70 % of
    the effort limits (n_v,) [N m or N], by default those of the URDF.
    """
    effort = sensor.robot.effort_limits if effort is None else effort
    dynamics = Dynamics(sensor.robot)
    for _ in range(tries):
        q = sensor.robot.random_configuration(rng)
        if holdable(dynamics, q, effort) and is_regular(sensor, task, q):
            return q
    raise InvalidInputError(
        f"no configuration of {sensor.robot.name} was found that its motors can hold and where the "
        "task is not near singular: give a lighter object, larger torque limits, or other axes "
        f"than those of {sensor!r}",
        given=sensor,
    )


def floor_below(robot: Robot) -> float:
    """Return the height of the lowest fixed frame [m]; -inf of an arm that begins no higher."""
    floor = min(f.placement.translation[2] for f in robot.model.frames if f.parentJoint == 0)
    stands = robot.model.jointPlacements[1].translation[2] > floor + 1e-6  # else it may hang
    return float(floor) if stands else -np.inf


def straight_ahead(sensor: Task, q0: Array, draw: Callable[[], Array], floor: float) -> Array:
    """Return a random configuration that the arm reaches on a straight way from q0 (nq,).

    The tip is above the floor [m] in it, and no joint stop blocks that way in task space, unless
    none of all that are drawn is such.
    """
    from approxjac.stability.loop.configurations import inverse_kinematics  # not for a help

    tip = FrameKinematics(sensor.robot, sensor.robot.tip_or(None))
    reached = partial(inverse_kinematics, sensor, q0=q0, within_limits=True)
    for _ in range(_WAYS):
        q = draw()
        if tip.position(q)[2] >= floor and reached(sensor.value(q)) is not None:
            break
    return q


def is_regular(sensor: Task, task: Task, q: Array, ratio: float = REGULAR) -> bool:
    """Return True if neither J nor Ĵ is near singular at a configuration."""
    x = sensor.value(q)
    values = [np.linalg.svd(each.jacobian(q, x), compute_uv=False) for each in (sensor, task)]
    return all(v[-1] > ratio * v[0] for v in values)


def numbers(key: str, values: tuple[float, ...], count: int, unit: str) -> Array:
    """Return the `count` numbers of a key as an array."""
    if len(values) != count:
        message = f"{key} must be {count} numbers [{unit}], got {len(values)}"
        raise InvalidInputError(message, given=values)
    return as_array(key, values, (count,), unit)


def configuration_of(
    robot: Robot, name: str, joints: tuple[float, ...], within_limits: bool = True
) -> Array:
    """Return the configuration (nq,) of one number a joint, continuous joints included."""
    motion = numbers(name, joints, robot.nv, "rad or m")
    if within_limits and robot.nq == robot.nv:
        robot.require_radians(name, motion)
    low, high = robot.position_limits
    for i in np.nonzero((motion < low) | (motion > high))[0] if within_limits else ():
        raise InvalidInputError(
            f"{name} must be within the joint limits, got {motion[i]:g} for {robot.joint_names[i]} "
            f"({low[i]:.4g} to {high[i]:.4g} {robot.joint_units[i]})",
            given=joints,
        )
    return np.array(robot.configuration(motion))


def too_far(task: Task, values: Array) -> str:
    """Return the reason why values (N, n_x) are beyond the stretched arm's reach; or ""."""
    reach = Reach(task)
    if reach.most == np.inf:
        return ""
    away = float(np.linalg.norm(reach.position(values), axis=1).max())
    if away <= reach.most:
        return ""
    return f"out of reach: {away:.3g} m from the first joint, where {reach.most:.3g} m is the most"
