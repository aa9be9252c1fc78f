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


def inverse_kinematics(
    sensor: Task, x_d: Array, q0: Array, *, within_limits: bool = False
) -> Array | None:
    """Return a configuration that a sensor sees with the value x_d, or None if none is found.

    Damped Gauss–Newton steps from a visible start q0 (nq,), which also end at rest where the target
    is out of reach, and where a camera loses its image.

    With `within_limits` a joint that gets to its position limit stays there while the others go on,
    as an arm does on its straight way to a target: None may mean that this way is barred.
    """
    model, neutral = sensor.robot.model, sensor.robot.neutral()
    motion = pin.difference(model, neutral, q0)
    low, high = sensor.robot.position_limits if within_limits else (-math.inf, math.inf)
    for _ in range(_STEPS):
        q = np.array(pin.integrate(model, neutral, motion))
        e, J = sensor.error(sensor.value(q), x_d), sensor._sensor_jacobian(q)
        size = float(np.linalg.norm(J, 2))
        error = float(np.linalg.norm(e))
        if error <= _EXACT * size:
            return q if sees(sensor, q) else None
        if size == 0.0 or math.isnan(error):  # no way to move the task; behind the camera
            return None
        damping = (1e-3 * size) ** 2 * min(1.0, error / size)
        for _ in motion:
            step = -J.T @ np.linalg.solve(J @ J.T + damping * np.eye(len(e)), e)
            barred = ((motion <= low) & (step < 0.0)) | ((motion >= high) & (step > 0.0))
            if not barred.any():
                break
            J = np.where(barred, 0.0, J)
        shorter = max(1.0, float(np.abs(step).max()) / _LONGEST)
        motion = np.clip(motion + step / shorter, low, high)
    return None
