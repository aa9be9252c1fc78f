"""One reach of any arm whose controller believes a wrong robot: settings → run → verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from approxjac.controllers import (
    AdaptiveGravity,
    Gains,
    Gravity,
    ModelGravity,
    NoGravity,
    Posture,
    RegressorGravity,
    SetpointController,
    default_gains,
)
from approxjac.errors import InvalidInputError
from approxjac.formatting import joined
from approxjac.interface import Controller
from approxjac.law import Linear, Sine
from approxjac.robots import GravityRegressor, Robot, load_robot
from approxjac.simulation import (
    MujocoPlant,
    Plant,
    SampledLoop,
    Sensing,
    Trajectory,
    simulate,
)
from approxjac.studies.limiting import limited, limits_from
from approxjac.studies.postures import posture_from, regular_posture
from approxjac.studies.reach_result import Reach, Result
from approxjac.studies.reach_settings import Settings
from approxjac.studies.servo_settings import ServoSettings
from approxjac.studies.watch import Watched
from approxjac.tasks import PoseTask, PositionTask, Task
from approxjac.validation import Array, as_array, as_number

__all__ = [
    "Reach",
    "Result",
    "Settings",
    "prepare",
    "run",
]


def prepare(robot: str, settings: Settings) -> Reach:
    """Build the truth, the belief and what stands between them.

    Raises:
        ApproxJacError: Settings that are out of range or do not fit the robot.
    """
    arm = load_robot(robot, tip=settings.tip, base=settings.base, free=settings.free)
    axis = settings.object_axis
    truth = arm.with_object(settings.object_length, settings.object_mass, axis=axis)
    believe = partial(_believed, arm, settings)
    belief = believe(settings.believed_length)
    task = _task(belief, settings)
    sensor = task.on(truth)
    as_number("rate", settings.rate, unit="Hz", above=0.0)
    as_number("tolerance", settings.tolerance, above=0.0)
    as_number("duration", settings.duration, unit="s", minimum=1.0 / settings.rate)
    if settings.seed < 0:
        raise InvalidInputError(f"seed must be >= 0, got {settings.seed}", given=settings.seed)
    limits = limits_from(settings, belief)
    motors = truth.effort_limits if limits is None else np.asarray(limits.effort)
    plant = _plant(truth, sensor, motors, settings)
    rng = np.random.default_rng(settings.seed)
    if settings.start is None:
        q0 = plant.ready_configuration()
    elif settings.start == "random":
        q0 = regular_posture(sensor, task, rng, motors)
    else:
        q0 = posture_from(truth, settings.start)
    target = _target(sensor, task, q0, motors, settings, rng)
    controller = SetpointController(
        task,
        _gains(task, settings),
        gravity=gravity_from(truth, belief, settings.gravity),
        saturation=Linear() if settings.gamma is None else Sine(settings.gamma),
        posture=Posture(q0, settings.posture_stiffness) if settings.posture_stiffness else None,
    )
    limiter = None
    if limits is not None:
        kind, solver = settings.limiter or "qp", settings.solver or "daqp"
        limiter = limited(controller, limits, kind, 1.0 / settings.rate, solver)
    return Reach(settings, plant, controller, q0, target, limiter, limits, believe)


def run(
    reach: Reach,
    progress: Callable[[float], None] | None = None,
    observer: Callable[[SampledLoop], None] | None = None,
) -> Result:
    """Simulate a reach and judge it; `progress` and `observer` are those of `simulate`.

    Raises:
        SimulationError: The closed loop diverged.
    """
    settings = reach.settings
    watched = None
    if reach.limiter is not None and reach.limits is not None:
        watched = Watched(reach.limiter, np.asarray(reach.limits.effort))
    controller = watched or reach.controller
    record = sampled(reach.plant, controller, reach.target, reach.q0, settings, progress, observer)
    above = np.nonzero(record.error_norm > settings.tolerance)[0]
    if len(above) == 0:
        settling = 0.0
    elif above[-1] == len(record.t) - 1:
        settling = math.nan
    else:
        settling = float(record.t[above[-1] + 1])
    result = Result(reach, record, settling, math.nan, None if watched is None else watched.tally)
    if np.isfinite(result.motor_limits).any():
        ratio = float((np.abs(record.tau) / result.motor_limits).max())
        result = replace(result, peak_torque_ratio=ratio)
    return result


def sampled(
    plant: Plant,
    controller: Controller,
    target: Array,
    q0: Array,
    settings: Settings | ServoSettings,
    progress: Callable[[float], None] | None = None,
    observer: Callable[[SampledLoop], None] | None = None,
) -> Trajectory:
    """Simulate for the duration and at the rate of settings, with some 2000 records.

    Raises:
        SimulationError: The closed loop diverged.
    """
    dt = 1.0 / settings.rate
    every = max(1, round(settings.rate * settings.duration / 2000.0))
    return simulate(
        plant,
        controller,
        target,
        q0,
        max(1, round(settings.duration / (dt * every))) * dt * every,
        dt=dt,
        record_every=every * dt,
        integrator="semi_implicit_euler",
        seed=settings.seed,
        progress=progress,
        observer=observer,
    )


def _believed(arm: Robot, settings: Settings, length: float) -> Robot:
    """The arm with the object that the controller believes, of a length [m]."""
    belief = arm.with_object(length, settings.believed_mass, axis=settings.object_axis)
    if settings.joint_shifts or settings.joint_rotations:
        belief = belief.with_kinematic_error(settings.joint_shifts, settings.joint_rotations)
    return belief


def _task(robot: Robot, settings: Settings) -> Task:
    if settings.task == "pose":
        if settings.axes is not None:
            raise InvalidInputError(
                f"axes are those of a position, not of a pose, got {settings.axes!r}",
                given=settings.axes,
            )
        return PoseTask(robot)
    return PositionTask(robot, axes=settings.axes)


def _target(
    sensor: Task,
    task: Task,
    q0: Array,
    motors: Array,
    settings: Settings,
    rng: np.random.Generator,
) -> Array:
    if settings.target is not None and settings.target_offset is not None:
        raise InvalidInputError(
            "target and target_offset must not both be given",
            given=(settings.target, settings.target_offset),
        )
    if settings.target is not None:
        return sensor.target(settings.target)
    if settings.target_offset is not None:
        offset = as_array(
            "target_offset", settings.target_offset, (sensor.m,), joined(sensor.units)
        )
        return sensor.displaced(sensor.value(q0), offset)
    return sensor.value(regular_posture(sensor, task, rng, motors))


def _gains(task: Task, settings: Settings) -> Gains:
    lag = 1.0 / settings.rate + (settings.velocity_filter or 0.0) + settings.actuator_delay
    gains = default_gains(task, settings.settling_time, bandwidth=1.0 / lag)
    return Gains(
        kp=given_or(settings.kp, gains.kp),
        kv=given_or(settings.kv, gains.kv),
        damping=given_or(settings.damping, gains.damping),
    )


def given_or(values: tuple[float, ...] | None, default: Any) -> Any:
    """Return numbers that were given, a single one as it is, or the default."""
    if values is None:
        return default
    return values[0] if len(values) == 1 else values


def gravity_from(truth: Robot, belief: Robot, kind: str) -> Gravity:
    """Where a controller has its gravity from: "learnt", "exact", "believed" or "none"."""
    if kind == "none":
        return NoGravity(belief)
    if kind == "believed":
        return ModelGravity(belief)
    if kind == "learnt":
        return AdaptiveGravity(belief)
    regressor = GravityRegressor(belief)
    return RegressorGravity(regressor, regressor.fit(truth)[0])


def _plant(truth: Robot, sensor: Task, motors: Array, settings: Settings) -> Plant:
    sensing = Sensing(
        x_noise=settings.x_noise,
        x_quantum=settings.x_quantum,
        x_delay=settings.x_delay,
        x_dropout=settings.x_dropout,
        q_noise=settings.q_noise,
        q_quantum=settings.q_quantum,
        velocity_filter=settings.velocity_filter,
    )
    options: Mapping[str, Any] = {
        "coulomb": settings.coulomb,
        "sensing": sensing,
        "actuator_delay": settings.actuator_delay,
        "torque_limits": motors,
    }
    if settings.engine == "mujoco":
        return MujocoPlant(truth, sensor, settings.friction, floor=settings.floor, **options)
    if settings.floor is not None:
        raise InvalidInputError(
            "a floor needs the engine mujoco (--engine mujoco), got pinocchio", given=settings.floor
        )
    return Plant(truth, sensor, settings.friction, **options)
