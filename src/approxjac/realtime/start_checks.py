"""Conditions under which a loop may begin on a robot."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pinocchio as pin

from approxjac.controllers import Latency
from approxjac.controllers.controller import Controller
from approxjac.errors import InvalidInputError
from approxjac.formatting import listed
from approxjac.interface import Evaluation, LimitStatus, Measurement
from approxjac.realtime.driver import Driver, read, two_clocks
from approxjac.robots import Dynamics
from approxjac.tasks import Task
from approxjac.tasks.analysis import features
from approxjac.validation import Array

_READS = 5
_SLOWER = 1.2  # times the period that gains were chosen for
_AT_REST = 0.05  # rad/s or m/s
_FAR, _REACHES = 50.0, 20.0  # m and reaches of the arm, beyond both of which no x is in metres
_HELD = 0.2  # share of the largest torque by which what is believed of gravity may be off


def require_able(driver: Driver, controller: Controller) -> None:
    """Refuse a controller that may command what the robot does not do."""
    if controller.command != driver.command:
        raise InvalidInputError(
            f"command of the controller must be {driver.command!r}, which the driver sends, got "
            f"{controller.command!r} of {controller!r}",
            given=controller,
        )
    law, nv = controller.law, controller.task.robot.nv
    tuning = law.tuning
    if tuning is not None and driver.dt > _SLOWER * tuning.latency.period:
        # as it was given: the rule's own has the lag of law (5), too
        latency = dataclasses.replace(law.latency or Latency(), period=driver.dt)
        raise InvalidInputError(
            f"latency of the law must be that of the loop: what it chose by itself (gains or "
            f"learning) is for a period of {tuning.latency.period:g} s, and the driver's dt is "
            f"{driver.dt:g} s; take its latency with that period, SetpointController(..., "
            f"latency={latency!r})",
            given=controller,
        )
    if driver.command != "torque":
        return
    most = np.asarray(driver.limits.for_joints(nv).effort)
    kept = controller.limits
    own = np.full(nv, np.inf) if kept is None else np.asarray(kept.effort)
    if (own > most * (1.0 + 1e-9)).any():
        raise InvalidInputError(
            f"controller must keep the robot's limits of effort, {listed(most)} [N m or N], such "
            f"as TorqueLimited(controller, driver.limits), got {controller!r}",
            given=controller,
        )


def require_at_rest(driver: Driver, task: Task, timeout: float) -> Measurement:
    """Return a first measurement of an arm at rest, within its limits and seen.

    A first frame of x may be lost, or still be under way: for that long it is waited for [s].
    """
    robot, last, measured = task.robot, -np.inf, None
    for count in range(max(_READS, math.ceil(timeout / driver.dt))):
        measured = read(driver, task)
        if not measured.t > last:
            raise InvalidInputError(
                f"the clock of the driver must go on, got {measured.t!r} s after {last!r} s",
                given=measured,
            )
        last = measured.t
        if count + 1 >= _READS and np.isfinite(measured.x).all():
            break
    assert measured is not None
    for name, values in (("q", measured.q), ("v", measured.v), ("x", measured.x)):
        if not np.isfinite(values).all():
            raise InvalidInputError(
                f"{name} must be known before the arm moves, got {listed(values)}", given=measured
            )
    if message := two_clocks(measured, driver.dt):
        raise InvalidInputError(f"t_x must be by the clock of t: {message}", given=measured)
    if (np.abs(measured.v) > _AT_REST).any():
        raise InvalidInputError(
            f"the arm must be at rest, below {_AT_REST} rad/s or m/s, got v = {listed(measured.v)}",
            given=measured,
        )
    robot.require_radians("q", measured.q)
    beyond = np.flatnonzero(robot.beyond_limits(measured.q[None])[0] > 0.0)
    if beyond.size:
        low, high = robot.position_limits
        angles = pin.difference(robot.model, robot.neutral(), measured.q)
        where = "; ".join(
            f"{robot.joint_names[j]} at {angles[j]:.4g} {robot.joint_units[j]}, limits "
            f"{low[j]:.4g} and {high[j]:.4g}"
            for j in beyond
        )
        raise InvalidInputError(f"q must be within the joints' limits, got {where}", given=measured)
    return measured


def require_near(task: Task, x: Array) -> None:
    """Refuse positions so far from the arm that they are in millimetres, say.

    A tracker may have its origin elsewhere in a hall.
    """
    for feature in features(task):
        if not feature.axes or feature.frame is None:
            continue
        origin, reach = task.robot.reach_bound(feature.frame)
        origin = origin[["xyz".index(axis) for axis in feature.axes]]
        away = float(np.linalg.norm(feature.place(x) - origin))
        if away > max(_FAR, _REACHES * reach):
            raise InvalidInputError(
                f"x must be in m, got {listed(x)}: the tip would be {away:.3g} m from the base of "
                f"an arm that reaches {reach:.3g} m; 1 mm is 0.001",
                given=x,
            )


def require_held(driver: Driver, controller: Controller, q: Array, answer: Evaluation) -> None:
    """Refuse to begin where the command does not hold the arm, as it is believed to be."""
    robot = controller.task.robot
    if answer.limit_status in (LimitStatus.INFEASIBLE, LimitStatus.SOLVER_FAILED):
        raise InvalidInputError(
            f"the limits do not hold the arm as it stands: {answer.limit_status.message}",
            given=answer,
        )
    if driver.command != "torque" or answer.gravity is None:
        return
    most = np.asarray(driver.limits.for_joints(robot.nv).effort)
    needed = np.zeros(robot.nv) if driver.adds_gravity else Dynamics(robot).g(q)
    slack = _HELD * np.where(np.isfinite(most), most, np.abs(needed).max())
    if (np.abs(answer.gravity - needed) > slack).any():
        message = "the controller must compensate gravity, such as by AdaptiveGravity(robot)"
        if driver.adds_gravity:
            message = "the robot adds its own gravity: " + (
                "take it off each torque in the driver's send, as FrankaDriver(gravity=arm) does, "
                "and set adds_gravity = False, for the tracking law compensates all of it"
                if controller.law.kinematics is not None
                else "the controller must learn what is left of it, AdaptiveGravity(robot, "
                "theta0=0.0), or leave it out, NoGravity(robot)"
            )
        raise InvalidInputError(
            f"{message}; it compensates {listed(answer.gravity)}, and the arm takes "
            f"{listed(needed)} [N m or N]",
            given=answer,
        )
