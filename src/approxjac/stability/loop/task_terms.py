"""Terms of tasks at many configurations: values, Jacobians and their derivatives.

Those of tasks that follow frames come from `Configurations`, all at once; others, such as images
and tasks of one's own, are asked at each configuration.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator
from typing import Literal

import numpy as np

from approxjac.robots import Robot
from approxjac.stability.loop.configuration_terms import Arms, Configurations
from approxjac.tasks import (
    CombinedTask,
    PoseTask,
    PoseTrackerTask,
    PositionTask,
    StackedTask,
    Task,
    TrackerTask,
)
from approxjac.tasks.analysis import jacobian_gradient
from approxjac.validation import Array, axis_rows


def arms_of(robots: list[Robot], tasks: Iterable[Task]) -> Arms:
    """Return robots, with the frames that tasks of any of them follow and all of them have."""
    wanted = dict.fromkeys(frame for task in tasks for frame in _frames(task))
    return Arms(robots, [f for f in wanted if all(f in robot.frame_names for robot in robots)])


def kind(task: Task, frames: Iterable[str]) -> Hashable:
    """Return a key that tasks of true robots share whose terms at `Configurations` are the same.

    The robots may differ: what terms of a frame need of them is in the configurations. Other tasks
    share it with none.
    """
    if type(task) is StackedTask:
        return tuple(kind(part, frames) for part in task.tasks)
    if type(task) is CombinedTask:
        return task.C.tobytes(), kind(task.task, frames)
    if type(task) is PositionTask and task.frame in frames:
        return task.frame, task.axes
    if type(task) is TrackerTask and task.frame in frames:
        return task.frame, task._R.tobytes(), task.offset.tobytes()
    return id(task)


def values(task: Task, at: Configurations) -> Array:
    """Return the values x, shape (N, n_x)."""
    if type(task) is StackedTask:
        return np.concatenate([values(part, at) for part in task.tasks], axis=1)
    if type(task) is CombinedTask:
        return values(task.task, at)
    if type(task) is PositionTask and task.frame in at.arms.frames:
        return np.asarray(at.position(task.frame)[:, axis_rows("axes", task.axes)])
    if type(task) is TrackerTask and task.frame in at.arms.frames:
        return np.asarray(at.position(task.frame) @ task._R.T + task.offset)
    return np.array([task.value(q) for q in at.q]).reshape(-1, task.n_x)


def errors(task: Task, x: Array, x_d: Array) -> Array:
    """Return the errors of values to targets, both (N, n_x); shape (N, m)."""
    if task._subtracts:
        return x - x_d
    found = [task.error(*each) for each in zip(x, x_d, strict=True)]
    return np.array(found).reshape(-1, task.m)


def jacobians(task: Task, at: Configurations) -> Array:
    """Return Ĵ, shape (N, m, n_v)."""
    return _jacobians(task, at, "jacobian")


def sensor_jacobians(task: Task, at: Configurations) -> Array:
    """Return J of a sensor, without what a controller is to assume in it; shape (N, m, n_v)."""
    return _jacobians(task, at, "_sensor_jacobian")


def error_jacobians(task: Task, e: Array, J: Array) -> Array:
    """Return ∂e/∂q where errors are e (N, m) and the Jacobians J; shape (N, m, n_v)."""
    if task._subtracts:
        return J
    found = [task._error_jacobian(*each) for each in zip(e, J, strict=True)]
    return np.array(found).reshape(J.shape)


def gradients(task: Task, at: Configurations) -> Array:
    """Return ∂Ĵ/∂q_k, shape (N, n_v, m, n_v), k first."""
    return _jacobians(task, at, "gradient")


_Term = Literal["jacobian", "_sensor_jacobian", "gradient"]


def _jacobians(task: Task, at: Configurations, term: _Term) -> Array:
    # of just these classes, as one that is derived from them may have a Jacobian of its own
    if type(task) is StackedTask:
        return np.concatenate([_jacobians(part, at, term) for part in task.tasks], axis=-2)
    if type(task) is CombinedTask:
        return np.asarray(task.C @ _jacobians(task.task, at, term))
    frame = _frame(task)
    if frame in at.arms.frames:
        J = at.jacobian_gradient(frame) if term == "gradient" else at.jacobian(frame)
        return _of_frame(task, J)
    n = task.robot.nv
    if term == "gradient":
        found = [jacobian_gradient(task, q) for q in at.q]
        return np.array(found).reshape(-1, n, task.m, n)
    return np.array([getattr(task, term)(q) for q in at.q]).reshape(-1, task.m, n)


def _frames(task: Task) -> Iterator[str]:
    if type(task) is StackedTask:
        for part in task.tasks:
            yield from _frames(part)
    elif type(task) is CombinedTask:
        yield from _frames(task.task)
    elif frame := _frame(task):
        yield frame


def _frame(task: Task) -> str:
    """The frame whose Jacobian that of a task is made of by `_of_frame`, or "" of another task."""
    kinds = PositionTask, PoseTask, TrackerTask, PoseTrackerTask
    return task.frame if type(task) in kinds else ""  # type: ignore[attr-defined]


def _of_frame(task: Task, J: Array) -> Array:
    """Return the Jacobian of a task from that of its frame (…, 6, n_v), or the same of its rate."""
    if isinstance(task, PositionTask):
        return np.asarray(J[..., axis_rows("axes", task.axes), :])
    if not isinstance(task, TrackerTask | PoseTrackerTask):
        return J
    turned = task._R @ J.reshape(*J.shape[:-2], 2, 3, J.shape[-1])
    return np.asarray(turned.reshape(J.shape)[..., : task.m, :])
