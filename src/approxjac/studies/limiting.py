"""Limiters of a controller's torque by name, and their limits as a word or a number."""

from __future__ import annotations

import numpy as np

from approxjac.controllers import (
    Limiter,
    Limits,
    SetpointController,
    TaskTorqueScaled,
    TorqueClipped,
    TorqueLimited,
    VelocityServo,
)
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.robots import Robot
from approxjac.studies.reach_settings import Settings
from approxjac.validation import as_number

LIMITERS = ("qp", "clip", "scale")
# A simulated arm waits for the solver: what comes out must not depend on how busy a machine is.


def limited(
    controller: SetpointController | VelocityServo,
    limits: Limits,
    limiter: str,
    dt: float = 1e-3,
    solver: str = "daqp",
) -> Limiter:
    """Wrap a controller into a limiter.

    Args:
        controller: The controller.
        limits: What to keep; "clip" and "scale" keep those of effort and rate only.
        limiter: One of `LIMITERS`.
        dt: Sampling time [s].
        solver: Of "qp".

    Raises:
        UnknownNameError: No such limiter or solver.
    """
    if limiter == "qp":
        proof = isinstance(controller, SetpointController)  # the others have none
        return TorqueLimited(controller, limits, dt=dt, solver=solver, proof=proof)
    if limiter == "clip":
        return TorqueClipped(controller, limits)
    if limiter == "scale":
        return TaskTorqueScaled(controller, limits)
    raise UnknownNameError("limiter", limiter, "the limiters", LIMITERS)


def limits_from(settings: Settings, robot: Robot) -> Limits | None:
    """Limits that a reach's settings ask for, with an entry for each joint; None if they don't.

    Raises:
        InvalidInputError: A limiter, rate or solver without limits, a solver of another limiter
            than qp, limits that are neither "urdf" nor a number, or of a URDF that has none.
        UnknownNameError: No such limiter.
    """
    text = settings.torque_limits
    if settings.limiter is not None and settings.limiter not in LIMITERS:
        raise UnknownNameError("limiter", settings.limiter, "the limiters", LIMITERS)
    if text is None:
        for name in ("limiter", "torque_rate", "solver"):
            given = getattr(settings, name)
            if given is not None:
                raise InvalidInputError(
                    f'{name} needs torque_limits, "urdf" or a share of the URDF\'s such as 0.5, '
                    f"got {name} {given} without them",
                    given=given,
                )
        return None
    if settings.solver is not None and settings.limiter in ("clip", "scale"):
        raise InvalidInputError(
            f"solver is for the limiter qp, got {settings.solver} for {settings.limiter}",
            given=settings.solver,
        )
    limits = limits_named(text, robot)
    rate = settings.torque_rate
    return Limits(limits.effort, rate, limits.position, limits.velocity).for_joints(robot.nv)


def limits_named(text: str, robot: Robot) -> Limits:
    """Limits of a robot's URDF, with an entry for each joint: "urdf", or a share of its torques.

    Raises:
        InvalidInputError: Neither, or a URDF without effort limits.
    """
    scale = _scale(text)
    if not np.isfinite(robot.effort_limits).any():
        raise InvalidInputError(
            f"torque_limits are shares of the URDF's effort limits, and that of {robot.name} "
            f"has none, got {text}",
            given=text,
        )
    return Limits.of(robot, scale).for_joints(robot.nv)


def _scale(text: object) -> float:
    """Share of the effort limits that "urdf" or a number stands for."""
    if text == "urdf":
        return 1.0
    try:
        return as_number("torque_limits", float(text), above=0.0)  # type: ignore[arg-type]
    except (TypeError, ValueError):  # what is no number, and what is not positive
        raise InvalidInputError(
            f'torque_limits must be "urdf" or a positive share of the URDF\'s effort limits, such '
            f"as 0.5, got {text!r}",
            given=text,
        ) from None
