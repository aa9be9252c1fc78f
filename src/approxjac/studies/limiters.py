"""Torque limiters compared: the same reaches with each, while the motors get weaker."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import chain
from typing import NamedTuple

import numpy as np

from approxjac.controllers import (
    Limits,
    RegressorGravity,
    SetpointController,
    TorqueLimited,
    default_gains,
)
from approxjac.errors import ApproxJacError, InvalidInputError, UnknownNameError
from approxjac.interface import Controller
from approxjac.robots import Dynamics, GravityRegressor, Robot, load_robot, robot_names
from approxjac.simulation import Plant
from approxjac.studies import reach
from approxjac.studies.arms import carried_object
from approxjac.studies.decrease import Decrease, decrease
from approxjac.studies.limiting import limited
from approxjac.studies.postures import regular_posture
from approxjac.studies.processes import run_in_processes
from approxjac.studies.reach_result import AT_LIMIT, Reach
from approxjac.studies.reach_settings import Settings
from approxjac.studies.watch import Tally
from approxjac.tasks import PositionTask, Task
from approxjac.validation import as_number

ROBOTS = ("panda", "xarm7", "two_link")
SCALES = (1.0, 0.7, 0.5, 0.35, 0.25)
TORQUE_TOLERANCE = 1e-9  # by which rounding may carry a torque beyond its limit [N m or N]
_SETTLING_TIME = 0.5  # gains fast enough for limits to matter [s]
_POSTURES = 2000
_RESERVE = 2.0  # over the largest gravity torque, where a URDF knows no effort limit
_SPEED = 3.0  # where it knows no speed limit [rad/s or m/s]
_TRIES = 20_000  # few postures can be held with weak motors


class Case(NamedTuple):
    """A start and a target of an arm whose effort limits are scaled."""

    robot: str
    scale: float
    seed: int
    duration: float


class Outcome(NamedTuple):
    """What became of one case with one limiter.

    Attributes:
        case: The case.
        limiter: Its name.
        start_error: ‖e‖ at the start [m].
        final_error: ‖e‖ at the end [m]; infinite if there was none.
        settling_time: From when on ‖e‖ is within 1 mm [s]; NaN if it is not at the end.
        converged: Whether the task was done, as in `reach.Result`.
        within: Whether no joint was beyond its position limits by more than 0.01 rad besides.
        reason: What kept the task from being done.
        peak_torque: Largest torque asked of a motor, as a share of what it delivers.
        torque_violation: How far a torque was beyond its limit in any step [N m or N].
        peak_speed: Largest |q̇| as a share of its limit.
        position_excess: How far a joint was beyond its position limits [rad or m].
        statuses: Steps with each `LimitStatus`, by name.
        largest_slack: Largest σ reported in any step [W]; NaN where none is.
        proof: V̇ against −W; None where V is that of another law, and where nothing ran.
    """

    case: Case
    limiter: str
    start_error: float = math.nan
    final_error: float = math.inf
    settling_time: float = math.nan
    converged: bool = False
    within: bool = False
    reason: str = ""
    peak_torque: float = math.nan
    torque_violation: float = math.nan
    peak_speed: float = math.nan
    position_excess: float = math.nan
    statuses: dict[str, int] = {}  # noqa: RUF012 - never changed
    largest_slack: float = math.nan
    proof: Decrease | None = None


class _Arm(NamedTuple):
    """What all cases of an arm share."""

    sensor: Task
    task: Task
    controller: SetpointController
    alpha: float
    limits: Limits


def cases(
    robots: Sequence[str], scales: Sequence[float], starts: int, duration: float
) -> list[Case]:
    """Return the cases of the study, those of weak motors first, as they take longest.

    Raises:
        UnknownNameError: A robot that does not load by name.
        InvalidInputError: No starts, or scales and a duration that are not positive.
    """
    for robot in robots:
        if robot not in robot_names():
            raise UnknownNameError("robot", robot, "the robots known by name", robot_names())
    if starts < 1:
        raise InvalidInputError(f"starts must be at least 1, got {starts}", given=starts)
    scales = [as_number("scales", scale, above=0.0) for scale in scales]
    as_number("duration", duration, unit="s", minimum=0.1)
    return [
        Case(robot, scale, seed, duration)
        for scale in sorted(set(scales or SCALES))
        for robot in dict.fromkeys(robots or ROBOTS)
        for seed in range(starts)
    ]


def run(
    cases: Sequence[Case],
    jobs: int | None = None,
    progress: Callable[[], None] | None = None,
) -> list[Outcome]:
    """Run cases in several processes, each with every limiter."""
    return list(chain.from_iterable(run_in_processes(run_case, cases, jobs, progress)))


def run_case(case: Case) -> list[Outcome]:
    """Run one case with every limiter, sampled at 1 kHz, with motors that saturate."""
    ready = prepare(case)
    return [run_limiter(case, name, ready, make) for name, make in makers().items()]


def prepare(case: Case) -> Reach:
    """Return the start, target and law that all limiters get, with their limits.

    Raises:
        InvalidInputError: No posture of the arm can be held with so little torque.
    """
    arm = _arm(case.robot)
    limits = Limits(
        case.scale * np.asarray(arm.limits.effort),
        position=arm.limits.position,
        velocity=arm.limits.velocity,
    ).for_joints(arm.task.robot.nv)
    effort, rng = np.asarray(limits.effort), np.random.default_rng(case.seed)
    q0, q_target = (regular_posture(arm.sensor, arm.task, rng, effort, _TRIES) for _ in range(2))
    length, mass = carried_object(case.robot)
    settings = Settings(
        object_length=length,
        object_mass=mass,
        gravity="exact",
        settling_time=_SETTLING_TIME,
        duration=case.duration,
        seed=case.seed,
    )
    plant = Plant(arm.sensor.robot, arm.sensor, torque_limits=effort)
    target = arm.sensor.value(q_target)
    return Reach(settings, plant, arm.controller, q0, target, limits=limits)


def run_limiter(
    case: Case, name: str, ready: Reach, make: Callable[[Reach], Controller]
) -> Outcome:
    """Run a case with one limiter.

    Args:
        case: The case.
        name: Of the limiter.
        ready: What `prepare` returned for the case.
        make: Returns the limiter.
    """
    try:
        result = reach.run(replace(ready, limiter=make(ready)))
    except ApproxJacError as error:
        return Outcome(case, name, reason=f"{error}")
    arm, tally, norm = _arm(case.robot), result.tally or Tally(), result.run.error_norm
    proof = None
    if name != "tanh":  # V is that of another law
        plant = Plant(arm.sensor.robot, arm.sensor)
        proof = decrease(plant, arm.controller, arm.alpha, result.run, result.motor_limits)
    return Outcome(
        case,
        name,
        start_error=float(norm[0]),
        final_error=float(norm[-1]),
        settling_time=result.settling_time,
        converged=result.converged,
        within=result.converged and result.joint_limit_excess <= AT_LIMIT,
        reason=result.reason,
        peak_torque=result.peak_torque_ratio,
        torque_violation=tally.torque_violation,
        peak_speed=result.peak_speed_ratio,
        position_excess=result.joint_limit_excess,
        statuses={status.name: n for status, n in sorted(tally.counts.items())},
        largest_slack=tally.largest_slack,
        proof=proof,
    )


def makers() -> dict[str, Callable[[Reach], Controller]]:
    """Return what makes each limiter, by name."""
    return {
        "qp": lambda ready: limited(ready.controller, _limits(ready), "qp"),
        "qp-torque": lambda ready: limited(ready.controller, Limits(_limits(ready).effort), "qp"),
        "clip": lambda ready: limited(ready.controller, _limits(ready), "clip"),
        "scale": lambda ready: limited(ready.controller, _limits(ready), "scale"),
    }


def _limits(ready: Reach) -> Limits:
    return ready.limits or Limits()


@cache
def _arm(robot: str) -> _Arm:
    """Truth and belief of an arm, as in the study of all arms, and its unscaled limits."""
    arm = load_robot(robot)
    truth = arm.with_object(*carried_object(robot))
    belief = arm.with_object(0.0)
    sensor = PositionTask(truth)
    task = PositionTask(belief)
    regressor = GravityRegressor(belief)
    controller = SetpointController(
        task,
        default_gains(task, _SETTLING_TIME),
        gravity=RegressorGravity(regressor, regressor.fit(truth)[0]),
    )
    alpha = TorqueLimited(controller).alpha
    return _Arm(sensor, task, controller, alpha, full_limits(truth))


def full_limits(truth: Robot) -> Limits:
    """Limits of the URDF, and others in place of those that it does not know.

    An effort limit that is not known is twice the largest gravity torque of the joint over 2000
    seeded postures of the true arm, a speed limit 3 rad/s.
    """
    dynamics, rng = Dynamics(truth), np.random.default_rng(0)
    weights = [np.abs(dynamics.g(truth.random_configuration(rng))) for _ in range(_POSTURES)]
    effort, velocity = truth.effort_limits, truth.velocity_limits
    return Limits(
        np.where(np.isfinite(effort), effort, _RESERVE * np.max(weights, axis=0)),
        position=truth.position_limits,
        velocity=np.where(np.isfinite(velocity), velocity, _SPEED),
    )
