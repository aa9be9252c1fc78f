"""Controller of a scenario: law, limits, and what is learnt of kinematics."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from approxjac.cameras import PlanarCamera
from approxjac.controllers import (
    AdaptiveCamera,
    AdaptiveGravity,
    AdaptiveKinematics,
    AdaptivePlanarCamera,
    AwayFromStops,
    DifferentiatedVelocity,
    Gains,
    Gravity,
    HeldMeasurement,
    Kinematics,
    KnownKinematics,
    Latency,
    Limits,
    ModelDynamics,
    ModelGravity,
    NoGravity,
    Posture,
    PredictedMeasurement,
    RegressorGravity,
    SetpointController,
    TorqueLimited,
    TrackingController,
    tuned,
)
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError
from approxjac.law import Sine
from approxjac.robots import GravityRegressor, Robot
from approxjac.scenario.scenario import Scenario
from approxjac.tasks import ImageTask, Task
from approxjac.validation import Array

_LEAST_PIXELS = 0.05  # of an image, likewise [px]
_LEAST_NOISE = 1e-4  # of x that a scenario has without [m or rad]


def controller_of(
    scenario: Scenario, task: Task, truth: Robot, q0: Array, limits: Limits | None
) -> tuple[Controller, Controller]:
    """Return the law, and it within limits, with what it learns and holds."""
    chosen, dt, belief = scenario.controller, sampling_time(scenario), task.robot
    kinematics = None
    if chosen.unknown:
        kinematics = _kinematics(scenario, task)
    law: Controller
    if chosen.law == "tracking":
        learns = chosen.gravity == "learnt"
        law = TrackingController(
            task,
            kinematics=KnownKinematics(task) if kinematics is None else kinematics,
            dynamics=None if learns else ModelDynamics(belief),
            dt=dt,
            command=chosen.command,
        )
    else:
        gravity = _gravity(truth, belief, chosen.gravity, chosen.integral_action)
        law = _setpoint(task, gravity, q0, scenario, within_limits=limits is not None)
    controller: Controller = law
    if limits is not None and chosen.command == "torque":
        controller = TorqueLimited(law, limits, dt=dt)
    if kinematics is not None and chosen.law != "tracking":
        controller = PredictedMeasurement(controller, kinematics)
    if chosen.unseen is not None:
        controller = HeldMeasurement(controller, chosen.unseen)
    return law, controller


def _kinematics(scenario: Scenario, task: Task) -> Kinematics:
    """Return the kinematics that learn what a scenario says to be unknown."""
    unknown, sensor = scenario.controller.unknown, scenario.sensor
    rest: dict[str, Any] = {"delay": sensor.delay, "dt": sampling_time(scenario)}
    if not isinstance(task, ImageTask):
        noise = max(sensor.noise, _LEAST_NOISE)
        return AdaptiveKinematics(task, unknown, noise=noise, angle_noise=noise, **rest)
    if isinstance(task.camera, PlanarCamera):
        least = _LEAST_NOISE * task.camera.magnification
        return AdaptivePlanarCamera(task, unknown, noise=max(sensor.noise, least), **rest)
    if "camera" in unknown:  # with its focal length
        unknown = tuple(dict.fromkeys((*unknown, "focal_length")))
    if task.camera.mount is not None:
        unknown = tuple("points" if kind == "tool" else kind for kind in unknown)
    return AdaptiveCamera(task, unknown, noise=max(sensor.noise, _LEAST_PIXELS), **rest)


def _gravity(truth: Robot, belief: Robot, kind: str, integral_action: bool | None) -> Gravity:
    """Return the gravity of a controller by its kind."""
    if kind in ("learnt", "learn_residual"):
        nothing = 0.0 if integral_action is False else None
        theta0 = 0.0 if kind == "learn_residual" else None
        return AdaptiveGravity(belief, theta0=theta0, task_force=nothing, joint_torque=nothing)
    if kind == "exact":
        regressor = GravityRegressor(belief)
        theta = regressor.fit(truth)[0]
        if integral_action:
            return AdaptiveGravity(regressor, L=0.0, theta0=theta)
        return RegressorGravity(regressor, theta)
    if integral_action:
        return AdaptiveGravity(belief, L=0.0, theta0=0.0 if kind == "none" else None)
    return NoGravity(belief) if kind == "none" else ModelGravity(belief)


def _setpoint(
    task: Task, gravity: Gravity, q0: Array, scenario: Scenario, *, within_limits: bool
) -> SetpointController:
    chosen, stiffness = scenario.controller, scenario.controller.posture_stiffness
    posture: Posture | AwayFromStops | None = None
    if stiffness:
        posture = Posture(q0, stiffness)
    elif within_limits and task.robot.nv > task.m:
        posture = AwayFromStops()
    differentiator = chosen.differentiator
    return SetpointController(
        task,
        _gains(task, scenario),
        gravity=gravity,
        saturation=None if chosen.gamma is None else Sine(chosen.gamma),
        velocity=None if differentiator is None else DifferentiatedVelocity(differentiator),
        posture=posture,
        latency=latency_of(scenario),
        settling_time=chosen.settling_time,
    )


def _gains(task: Task, scenario: Scenario) -> Gains | None:
    """Return the gains that are given, with those of the rule beside them; None if none is."""
    chosen = scenario.controller
    given = {"kp": chosen.kp, "kv": chosen.kv, "damping": chosen.damping}
    if not any(given.values()):
        return None
    usual = tuned(task, latency_of(scenario), settling_time=chosen.settling_time).gains
    values = {
        name: getattr(usual, name) if value is None else value[0] if len(value) == 1 else value
        for name, value in given.items()
    }
    return Gains(**values)


def latency_of(scenario: Scenario) -> Latency:
    """Return the delays of a scenario's loop; continuous control as at 1 kHz."""
    sensor = scenario.sensor
    learns = bool(scenario.controller.unknown)  # then frames are outside the loop
    return Latency(
        period=sampling_time(scenario) or Latency.period,
        torque_delay=scenario.loop.actuator_delay,
        velocity_filter=sensor.velocity_filter or 0.0,
        image_period=0.0 if learns or sensor.rate is None else 1.0 / sensor.rate,
        image_age=0.0 if learns else sensor.delay,
    )


def sampling_time(scenario: Scenario) -> float:
    """Return the period of control [s], 0 where it is continuous."""
    return scenario.loop.dt if isinstance(scenario.loop.dt, float) else 0.0


def limits_of(scenario: Scenario, belief: Robot) -> Limits | None:
    """Return the limits that the controller keeps, with an entry for each joint."""
    share = scenario.controller.limits
    if share == "none" or sampling_time(scenario) == 0.0:
        return None
    if not np.isfinite(belief.effort_limits).any():
        if share == "urdf":
            return None
        raise InvalidInputError(
            f"controller.limits are shares of the URDF's effort limits, and that of {belief.name} "
            f"has none, got {share}",
            given=share,
        )
    limits = Limits.of(belief, share if isinstance(share, float) else 1.0)
    return replace(limits, rate=scenario.controller.torque_rate).for_joints(belief.nv)
