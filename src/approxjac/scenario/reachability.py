"""Targets that the believed or the true arm cannot reach, named before a run."""

from __future__ import annotations

import numpy as np

from approxjac.interface import TargetPath
from approxjac.robots.joint_limits import reach_bound
from approxjac.stability.loop.inverse_kinematics import inverse_kinematics
from approxjac.tasks import PoseTask, PositionTask, Task
from approxjac.validation import Array

_STARTS = 20  # of the search for a configuration
_INSTANTS = 200  # of a path


def too_far(task: Task, values: Array) -> str:
    """Return why values (N, n_x) are out of reach beyond doubt, by the arm stretched out; or ""."""
    if not isinstance(task, PositionTask | PoseTask):
        return ""
    first, most = reach_bound(task.robot, task.frame)
    axes = ["xyz".index(axis) for axis in task.labels[:3]]
    away = float(np.linalg.norm(values[:, : len(axes)] - first[axes], axis=1).max())
    if away <= most:
        return ""
    return f"out of reach: {away:.3g} m from the first joint, where {most:.3g} m is the most"


def doubts(
    task: Task, target: Array | TargetPath, q0: Array, duration: float, whose: str = "believed"
) -> str:
    """Return why the arm of a task cannot reach a target, as far as it tells; or "".

    Beyond doubt where it is too far. Otherwise by inverse kinematics from the start and from 20
    seeded configurations, which may miss one that there is; not of paths and images.
    """
    if not isinstance(target, np.ndarray):
        target = np.array([target.at(t).x for t in np.linspace(0.0, duration, _INSTANTS)])
    far = too_far(task, np.atleast_2d(target))
    if far:
        return f"for the {whose} arm the target is {far}"
    if target.ndim == 2 or not isinstance(task, PositionTask | PoseTask):
        return ""
    rng = np.random.default_rng(0)
    for start in [q0, *(task.robot.random_configuration(rng) for _ in range(_STARTS))]:
        if inverse_kinematics(task, target, start, within_limits=True) is not None:
            return ""
    return (
        f"no configuration of the {whose} arm within its limits was found that reaches the target"
    )
