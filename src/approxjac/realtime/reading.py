"""`read`: what a driver read, as arrays of the loop's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.controllers.arguments import told_ahead
from approxjac.errors import InvalidInputError
from approxjac.interface import Measurement
from approxjac.realtime.driver import Driver
from approxjac.tasks import Task
from approxjac.validation import Array

_AHEAD = 0.01  # s, and a period: by which x may be stamped later than the state it comes with


def read(driver: Driver, task: Task) -> Measurement:
    """Return the next measurement, copied, as drivers may write to the same arrays each time.

    Raises:
        InvalidInputError: q, q̇ or x with another number of entries.
    """
    t, q, v, x, t_x = driver.read()
    measured = Measurement(float(t), _numbers(q), _numbers(v), _numbers(x), t_x)
    if measured.q.shape == (task.robot.nv,):  # encoders tell angles of continuous joints, too
        measured = measured._replace(q=_configuration(task, measured.q))
    robot, sizes = task.robot, (measured.q.shape, measured.v.shape, measured.x.shape)
    if sizes != ((robot.nq,), (robot.nv,), (task.n_x,)):
        raise InvalidInputError(
            f"driver must read q, q̇ and x with {robot.nq}, {robot.nv} and {task.n_x} numbers, "
            f"got shapes {', '.join(map(str, sizes))}",
            given=measured,
        )
    return measured


def two_clocks(measurement: Measurement, dt: float) -> str:
    """Return in words that x was taken after t, which no one clock can tell, or ""."""
    return told_ahead(measurement.t, measurement.t_x, dt + _AHEAD)


def _configuration(task: Task, q: Array) -> Array:
    """Return a configuration of one number a joint, NaN where that is."""
    robot = task.robot
    if robot.nq == robot.nv:
        return q
    return np.array(pin.integrate(robot.model, robot.neutral(), q))


def _numbers(values: Any) -> Array:
    """Return a copy; what a mask hides is not measured."""
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(float), np.nan)
    return np.array(values, dtype=np.float64)
