"""Inverse kinematics of a true robot, for analysis only."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from approxjac.tasks import Task
from approxjac.tasks.analysis import sees
from approxjac.validation import Array

_STEPS = 200
_EXACT = 1e-10  # error that counts as none, relative to the size of the Jacobian
_LONGEST = 0.3  # step [rad or m]


def inverse_kinematics(sensor: Task, x_d: Array, q0: Array) -> Array | None:
    """Return a configuration that a sensor sees with the value x_d, or None if none is found.

    Damped Gauss–Newton steps from a visible start q0 (nq,), which also end at rest where the target
    is out of reach, and where a camera loses its image.
    """
    q = np.array(q0)
    for _ in range(_STEPS):
        e, J = sensor.error(sensor.value(q), x_d), sensor._sensor_jacobian(q)
        size = float(np.linalg.norm(J, 2))
        error = float(np.linalg.norm(e))
        if error <= _EXACT * size:
            return q if sees(sensor, q) else None
        if size == 0.0 or math.isnan(error):  # no way to move the task; behind the camera
            return None
        damping = (1e-3 * size) ** 2 * min(1.0, error / size)
        step = -J.T @ np.linalg.solve(J @ J.T + damping * np.eye(len(e)), e)
        shorter = max(1.0, float(np.abs(step).max()) / _LONGEST)
        q = np.array(pin.integrate(sensor.robot.model, q, step / shorter))
    return None
