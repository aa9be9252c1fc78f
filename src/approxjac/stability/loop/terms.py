"""Terms of arms and of tasks at many configurations, with their derivatives."""

from __future__ import annotations

import copy
from collections.abc import Hashable, Iterable, Iterator, Sequence
from functools import cached_property
from typing import Literal

import numpy as np

from approxjac.codegen.arm.arm_numbers import ArmNumbers, Reduced, Structure, arm_numbers, reduced
from approxjac.robots import Robot
from approxjac.stability.loop.samples import Indices
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

# a @ _CROSS is [a]ₓ, row by row
_CROSS = np.zeros((3, 9))
_CROSS[[0, 0, 1, 1, 2, 2], [5, 7, 2, 6, 1, 3]] = [-1.0, 1.0, 1.0, -1.0, -1.0, 1.0]


class Arms:
    """Robots with the same joints, such as all true ones.

    Args:
        robots: At least one.
        frames: Frames that are asked for.

    Raises:
        UnknownNameError: No such frame.
    """

    def __init__(self, robots: Sequence[Robot], frames: Sequence[str]) -> None:
        self.robot, self.frames = robots[0], tuple(frames)
        self.structure = Structure.of(self.robot, frames)
        each = [arm_numbers(robot, frames) for robot in robots]
        self.numbers = reduced(ArmNumbers.stacked(each), self.structure)
        n = len(self.structure.parents)
        carries = np.eye(n, dtype=bool)  # whether the first joint moves what the second one does
        for j, parent in enumerate(self.structure.parents):
            if parent >= 0:
                carries[:, j] |= carries[:, parent]
        self.carries = carries

    def joined(self, robots: Sequence[Robot]) -> Arms:
        """Return these robots and others after them.

        Raises:
            UnknownNameError: One that lacks a frame of these.
        """
        other, each = copy.copy(self), [arm_numbers(robot, self.frames) for robot in robots]
        added = reduced(ArmNumbers.stacked(each), self.structure)
        other.numbers = Reduced(*map(np.concatenate, zip(self.numbers, added, strict=True)))
        return other

    def at(self, which: Indices, q: Array) -> Configurations:
        """Return the arms of some indices (N,) at configurations (N, nq)."""
        numbers, structure = Reduced(*(of_all[which] for of_all in self.numbers)), self.structure
        A, b, given = self.robot.mimic_joints.A, self.robot.mimic_joints.b, q
        q = q if A is None or b is None else q @ A.T + b
        R_all, p_all = np.empty_like(numbers.rotations), np.empty_like(numbers.translations)
        for j, parent in enumerate(structure.parents):
            at = structure.places[j]
            R, p = numbers.rotations[:, j], numbers.translations[:, j]
            if structure.slides[j]:
                p = p + R[..., 2] * q[:, at, None]
            if parent >= 0:
                before = R_all[:, parent]
                R, p = before @ R, _times(before, p) + p_all[:, parent]
            R_all[:, j], p_all[:, j] = R, p
            if not structure.slides[j]:
                c, s = q[:, at, None], q[:, at + 1 : at + 2]
                if not structure.pairs[j]:
                    c, s = np.cos(c), np.sin(c)
                R_all[:, j, :, 0] = c * R[..., 0] + s * R[..., 1]
                R_all[:, j, :, 1] = c * R[..., 1] - s * R[..., 0]
        return Configurations(self, given, numbers, R_all, p_all)


class Configurations:
    """Arms at N configurations. What terms have in common is computed once.

    Attributes:
        arms: The arms.
        q: The configurations, shape (N, nq).
    """

    def __init__(self, arms: Arms, q: Array, numbers: Reduced, R: Array, p: Array) -> None:
        self.arms, self.q, self._mimic = arms, q, arms.robot.mimic_joints
        self._numbers = numbers
        # each joint's axes, with z its own, and its origin in the world
        self._R, self._p = R, p

    def take(self, which: Array) -> Configurations:
        """Return some of the configurations."""
        numbers = Reduced(*(of_all[which] for of_all in self._numbers))
        return Configurations(self.arms, self.q[which], numbers, self._R[which], self._p[which])

    # -- frames ---------------------------------------------------------------------------------

    def position(self, frame: str) -> Array:
        """Return the origin of a frame in the world, shape (N, 3) [m]."""
        i, carrier, _ = self._frame(frame)
        p = self._numbers.frame_translations[:, i]
        return p if carrier < 0 else _times(self._R[:, carrier], p) + self._p[:, carrier]

    def jacobian(self, frame: str) -> Array:
        """Return the Jacobians of (velocity, angular velocity) in the world, (N, 6, n_v)."""
        return self._mimic.columns(self._rows(frame).mT)

    def jacobian_gradient(self, frame: str) -> Array:
        """Return ∂J/∂q_k of `jacobian`, shape (N, n_v, 6, n_v), k first."""
        path = self._frame(frame)[2]
        J, moved = self._rows(frame), self._turned * _before(self.arms.carries)[..., None]
        turned = moved[..., 3:].reshape(len(moved), -1, 3) @ _skew(self.position(frame))
        moved[..., :3] += turned.reshape(*moved.shape[:-1], 3)
        moved[..., :3] += self._S[:, None, :, 3:] @ _skew(J[..., :3])
        found = self._mimic.columns((moved * np.outer(path, path)[..., None]).mT)
        return found if self._mimic.G is None else np.einsum("ak,nacj->nkcj", self._mimic.G, found)

    def _rows(self, frame: str) -> Array:
        """Jᵀ of a frame in all joints, (N, n, 6)."""
        J = self._S * self._frame(frame)[2][:, None]
        J[..., :3] += J[..., 3:] @ _skew(self.position(frame))
        return J

    def _frame(self, frame: str) -> tuple[int, int, Array]:
        """Its number, the joint that carries it, and 1 for each joint that moves it."""
        i = self.arms.frames.index(frame)
        carrier = self.arms.structure.carriers[i]
        path = self.arms.carries[:, carrier] if carrier >= 0 else np.zeros(self._p.shape[1])
        return i, carrier, np.asarray(path, dtype=float)

    # -- inertia --------------------------------------------------------------------------------

    def M(self) -> Array:
        """Return the inertia matrices, shape (N, n_v, n_v) [kg m², kg m or kg]."""
        M = np.where(self.arms.carries, self._S @ self._forces.mT, 0.0)
        M = np.where(self.arms.carries, M, M.mT)
        G = self._mimic.G
        return M if G is None else G.T @ M @ G

    def M_gradient(self) -> Array:
        """Return ∂M/∂q_k, shape (N, n_v, n_v, n_v), k first."""
        carries, before = self.arms.carries, _before(self.arms.carries)
        # of M_ij = S_i · I_j S_j, with j carried by i, k moves what it carries
        inside = before.T[:, :, None] & carries[:, None, :]  # k carried by i, and j by k
        beyond = carries[None] & before.T[:, None, :]  # k carried by j: a part of what j carries
        N, n, _ = self._p.shape
        along = (self._turned.reshape(N, n * n, 6) @ self._forces.mT).reshape(N, n, n, n)
        apart = self._turned @ self._momenta.mT
        dM = -np.where(inside, along, 0.0) - np.where(beyond, apart + apart.mT, 0.0)
        dM = np.where(carries, dM, dM.mT)
        G = self._mimic.G
        return dM if G is None else np.einsum("ak,naij->nkij", G, G.T @ dM @ G)

    @cached_property
    def _S(self) -> Array:
        """S_j, shape (N, n, 6)."""
        S = np.zeros((*self._p.shape[:2], 6))
        slides = np.array(self.arms.structure.slides)
        z = self._R[..., 2]
        S[..., :3] = np.where(slides[:, None], z, np.cross(self._p, z))
        S[..., 3:] = np.where(slides[:, None], 0.0, z)
        return S

    @cached_property
    def _turned(self) -> Array:
        """S_k × S_i, shape (N, n, n, 6), k first."""
        v, omega = _skew(self._S[..., :3]), _skew(self._S[..., 3:])
        cross = np.zeros((*self._p.shape[:2], 6, 6))
        cross[..., :3, :3] = cross[..., 3:, 3:] = omega
        cross[..., :3, 3:] = v
        return self._S[:, None] @ cross.mT

    @cached_property
    def _momenta(self) -> Array:
        """I_k S_i, shape (N, n, n, 6), k first."""
        numbers, R, p = self._numbers, self._R, self._p
        h = _times(R, numbers.moments)
        spreads = numbers.spreads[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(R.shape)
        m = numbers.masses[..., None]
        half = (h + 0.5 * m * p)[..., None] * p[..., None, :]
        second = R @ spreads @ R.mT + half + half.mT  # moments ∫ r rᵀ dm about the world's origin
        bodies = np.concatenate([m, h + m * p, second.reshape(*p.shape[:2], 9)], axis=2)
        bodies = self.arms.carries.astype(float) @ bodies
        h, second = _skew(bodies[..., 1:4]), bodies[..., 4:].reshape(R.shape)
        inertia = np.empty((*p.shape[:2], 6, 6))
        inertia[..., :3, :3] = bodies[..., 0, None, None] * np.eye(3)
        inertia[..., :3, 3:], inertia[..., 3:, :3] = -h, h
        trace = np.trace(second, axis1=2, axis2=3)[..., None, None]
        inertia[..., 3:, 3:] = trace * np.eye(3) - second
        return self._S[:, None] @ inertia

    @cached_property
    def _forces(self) -> Array:
        """I_j S_j, shape (N, n, 6)."""
        each = np.arange(self._p.shape[1])
        return self._momenta[:, each, each]


def _before(carries: Array) -> Array:
    """Return whether the first joint carries the second one, which is another one."""
    return np.asarray(carries & ~np.eye(len(carries), dtype=bool))


def _times(A: Array, a: Array) -> Array:
    return np.asarray((A @ a[..., None])[..., 0])


def _skew(a: Array) -> Array:
    """[a]ₓ, shape (…, 3, 3)."""
    return np.asarray(a @ _CROSS).reshape(*a.shape[:-1], 3, 3)


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
