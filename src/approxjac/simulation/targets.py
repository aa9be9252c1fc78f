"""Targets of a loop, and the controllers that fit it: what is checked before it begins."""

from __future__ import annotations

import numpy as np

from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError, SimulationError
from approxjac.formatting import joined
from approxjac.interface import Evaluation, Measurement, Target, TargetPath
from approxjac.simulation.plant import Plant
from approxjac.tasks import Task
from approxjac.tasks.analysis import require_unmirrored
from approxjac.validation import Array, as_array, require

Wanted = Target | TargetPath | Array
"""A target that has been checked: an array at rest, a `Target`, or a path."""


def wanted_of(sensor: Task, target: object, t: float) -> Wanted:
    """Return a target, or a path, whose value at t [s] is one of the sensor."""
    if isinstance(target, type) or not isinstance(target, Target | TargetPath):
        return sensor.target(target)
    now = target.at(t) if isinstance(target, TargetPath) else target
    require("at(t) of a path", now, Target, "a Target(x, v, a)")
    x = sensor.target(now.x)
    if isinstance(target, TargetPath):
        return target
    rates = {
        name: None if value is None else as_array(f"{name} of the target", value, (sensor.m,))
        for name, value in (("v", now.v), ("a", now.a))
    }
    return Target(x, **rates)


def target_at(wanted: Wanted, t: float) -> Target | Array:
    """Return the target at t [s]."""
    if isinstance(wanted, np.ndarray | Target):
        return wanted
    return wanted.at(t)


def x_of(target: Target | Array) -> Array:
    """Return x_d, shape (n_x,)."""
    return target.x if isinstance(target, Target) else target


def require_start(task: Task, wanted: Wanted, x: Array) -> None:
    """Refuse a target at rest whose points run round the other way than they are measured."""
    if isinstance(wanted, np.ndarray):
        require_unmirrored(task, "target", wanted, x, "the measured x")


def diverged(t: float, duration: float, error: Exception) -> SimulationError:
    """Return the error of a loop that diverged."""
    return SimulationError(
        f"the simulation diverged at t = {t:g} of {duration:g} s: {error} (a smaller dt or smaller "
        "gains may help)",
        given=t,
    )


def first_state(
    plant: Plant,
    controller: Controller,
    wanted: Target | Array,
    measurement: Measurement,
    dt: float,
    given: Array | None = None,
) -> Array:
    """Return the state that a controller begins with, after a step in which it is seen to be one.

    Its initial state, unless another one is given.
    """
    state = controller.initial_state(measurement)
    if given is not None:
        state = as_array("state", given, state.shape)
    state = as_array("the controller's initial_state", state, (np.size(state),))
    stepped = controller.step(state, measurement, wanted, dt)
    if not (isinstance(stepped, tuple) and len(stepped) == 2):
        raise InvalidInputError(
            f"step of a controller must return (state, Evaluation), got {stepped!r}", given=stepped
        )
    after, answer = stepped
    require("the controller's answer", answer, Evaluation, "an Evaluation")
    unit = "N m or N" if plant.servo is None else "rad/s or m/s"
    as_array(f"the controller's {plant.command}", answer.torque, (plant.robot.nv,), unit)
    require("the controller's state", after, np.ndarray, "an array")
    as_array("the controller's state", after, state.shape)
    learnt = controller.learnt(state)
    require("learnt of the controller", learnt, np.ndarray, "an array")
    if len(learnt) != len(controller.parameters):
        raise InvalidInputError(
            f"parameters of the controller must name the {len(learnt)} numbers that learnt(state) "
            f"returns, got {controller.parameters!r}",
            given=controller,
        )
    if controller.is_continuous:
        as_array("the controller's state_rate", answer.state_rate, state.shape)
    if np.isfinite(measurement.x).all():  # a lost x has no error
        as_array(
            "the controller's e", answer.e, (controller.task.m,), joined(controller.task.units)
        )
    return state


def require_fit(plant: Plant, controller: Controller, dt: float | None) -> None:
    """Refuse a controller that is none, of another task, command or sampling time."""
    like = "a controller, such as SetpointController(...)"
    require("controller", controller, Controller, like)
    require("task of the controller", controller.task, Task, "the task of the believed robot")
    plant.require_measured(controller.task)
    if controller.command != plant.command:
        without = "Plant(..., servo=VelocityServo()) takes velocities, one without servo torques"
        raise InvalidInputError(
            f"command of the controller must be {plant.command!r}, which the plant takes, got "
            f"{controller.command!r} of {controller!r}; {without}",
            given=controller,
        )
    wanted = controller.dt
    if wanted is not None and (dt is None or not np.isclose(dt, wanted, rtol=1e-9, atol=0.0)):
        raise InvalidInputError(
            f"dt must be that of the controller, {wanted:g} [s], for which it was built, got "
            f"{dt!r}",
            given=dt,
        )
