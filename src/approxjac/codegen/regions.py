"""Regions on symbols: whether a configuration is outside of one."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.rigid_body import Arm
from approxjac.codegen.trace.symbols import Condition, Symbols, any_of, symbols
from approxjac.law.factors import Factors
from approxjac.robots import Robot
from approxjac.tasks import Task
from approxjac.validation import Array

_ROUND_OFF = 1e-12  # that `JointBox` leaves at its ends


class Box(NamedTuple):
    """Configurations between bounds, where a task may have to be regular.

    Attributes:
        center: Shape (nq,).
        lower: Smallest motion from it, shape (n_v,).
        upper: Largest motion from it, shape (n_v,); of continuous joints as far as `lower`.
        task: The task.
        sigma_min: Smallest singular value that its Jacobian must have.
    """

    center: Array
    lower: Array
    upper: Array
    task: Task | None = None
    sigma_min: float = 0.0


def outside(q: Symbols, robot: Robot, box: Box) -> Condition:
    """Return whether a configuration (nq,) of a robot is not in a box."""
    found: list[Condition] = []
    for joint in list(robot.model.joints)[1:]:
        if not joint.nv:
            continue
        at, low, high = joint.idx_q, box.lower[joint.idx_v], box.upper[joint.idx_v]
        if joint.nq == 1:
            motion = q[at] - box.center[at]
            found += [motion < low - _ROUND_OFF, motion > high + _ROUND_OFF]
        elif high + _ROUND_OFF < math.pi:
            cosine, sine = box.center[at : at + 2]
            found.append(q[at] * cosine + q[at + 1] * sine < math.cos(high + _ROUND_OFF))
    if box.task is not None and box.sigma_min > 0.0:
        own = box.task.robot
        arm = Arm(_known, "region", own, tasks.frames(box.task))
        J = tasks.jacobian(box.task, arm.at(q))
        G = J @ J.T if J.shape[0] <= J.shape[1] else J.T @ J
        pivots = Factors(G - np.multiply(box.sigma_min**2, np.eye(len(G)))).pivots
        found += [pivot <= 0.0 for pivot in pivots]  # one is, where an eigenvalue is
    return any_of(np.array(found, dtype=object))


def _known(name: str, values: Array) -> Symbols:
    """Return numbers that are the same in all runs, as `Program.given` does."""
    return symbols(values[0].tolist())
