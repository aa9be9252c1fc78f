"""Tasks on symbols: those of `tasks` with frames on symbols, and a choice where they branch."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from approxjac.codegen.arm import traced_cameras as cameras
from approxjac.codegen.arm.rigid_body import Configured, moved
from approxjac.codegen.trace.linear import eigensystem, is_regular
from approxjac.codegen.trace.symbols import Scalar, Symbols, arctangent, select, symbols
from approxjac.errors import InvalidInputError
from approxjac.tasks import (
    CombinedTask,
    ImageTask,
    NonsingularTask,
    PoseTask,
    PoseTrackerTask,
    PositionTask,
    StackedTask,
    Task,
    TrackerTask,
)
from approxjac.tasks.pose import NO_ROTATION, quaternion_between
from approxjac.tasks.task import WrappedTask
from approxjac.validation import Array


class _Frame:
    """`FrameKinematics` of an arm on symbols, which is where it is or somewhere else."""

    def __init__(self, here: Configured, name: str) -> None:
        self._here, self._name = here, name

    def _at(self, q: Symbols) -> Configured:
        return self._here if q is self._here.q else self._here.arm.at(q)

    def placement(self, q: Symbols) -> tuple[Symbols, Symbols]:
        return self._at(q).frame(self._name)

    def position(self, q: Symbols) -> Symbols:
        return self.placement(q)[1]

    def jacobian(self, q: Symbols) -> Symbols:
        return self._at(q).jacobian(self._name)

    def motion(self, q: Symbols) -> tuple[Symbols, Symbols, Symbols]:
        return self.jacobian(q), *self.placement(q)

    def pose(self, q: Symbols) -> Symbols:
        return _pose(*self.placement(q))


def _pose(R: Symbols, p: Symbols) -> Symbols:
    """Return p (3,) and the quaternion (x, y, z, w) of R (3, 3), with the sign of Eigen's."""
    R = symbols(R)
    xx, yy, zz = np.diagonal(R)
    # of four times the squares of w, x, y and z the first is taken if it is large, or the largest
    squares = [1.0 + xx + yy + zz, 1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx - yy + zz]
    wx, wy, wz = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    rows = [[wx, wy, wz, squares[0]], [squares[1], xy, xz, wx], [xy, squares[2], yz, wy],
            [xz, yz, squares[3], wz]]  # fmt: skip
    largest = symbols([*rows[1], squares[1]])
    is_y, is_z = yy > xx, zz > np.maximum(xx, yy)
    largest = np.where(is_y, symbols([*rows[2], squares[2]]), largest)
    largest = np.where(is_z, symbols([*rows[3], squares[3]]), largest)
    *row, square = np.where(xx + yy + zz > 0.0, symbols([*rows[0], squares[0]]), largest)
    return np.concatenate([symbols(p), symbols(row) / (2.0 * np.sqrt(square))])


class _Pose(PoseTask):
    def error(self, x: Symbols, x_d: Symbols) -> Symbols:
        return np.concatenate([x[:3] - x_d[:3], _rotation_between(x[3:], x_d[3:])])

    def displaced(self, x: Symbols, e: Symbols) -> Symbols:
        return np.concatenate([x[:3] + e[:3], _turned(x[3:], symbols(e[3:]))])


class _PoseTracker(PoseTrackerTask):
    error = _Pose.error
    displaced = _Pose.displaced

    def value(self, q: Symbols) -> Symbols:
        return _pose(*self._placement(q))


def _rotation_between(a: Symbols, b: Symbols) -> Symbols:
    """Return what that of `tasks.pose` does."""
    lengths = [np.sqrt((each * each).sum()) for each in (a, b)]
    told = [(length > NO_ROTATION) & (length < math.inf) for length in lengths]
    *turn, w = quaternion_between((a / lengths[0]).tolist(), (b / lengths[1]).tolist())
    xyz = symbols(turn)
    sine = np.sqrt((xyz * xyz).sum())
    angle: Any = 2.0 * arctangent(sine, abs(w))
    sign = select(w < 0.0, -1.0, 1.0)
    factor = sign * select(sine > 1e-150, angle / sine, 2.0)
    return np.where(told[0] & told[1], xyz * factor, math.nan)


def _turned(quaternion: Symbols, phi: Symbols) -> Symbols:
    """Return a quaternion (4,) after a turn by a rotation vector (3,), but for its sign."""
    angle = np.sqrt((phi * phi).sum())
    half = symbols([0.5 * angle])
    sine = select(angle > 1e-8, np.sin(half)[0] / select(angle > 1e-8, angle, 1.0), 0.5)
    inverse = symbols(quaternion) * np.array([-1.0, -1.0, -1.0, 1.0])
    return symbols(quaternion_between([*(phi * sine), np.cos(half)[0]], inverse.tolist()))


class _Image(ImageTask):
    def _seen(self, x: Symbols) -> Symbols:
        delivered = []
        for point in symbols(x).reshape(-1, self._stride):
            u, v = np.isfinite(self.camera.seen(point[:2]))
            delivered.append(np.where(u & v, point, math.nan))
        return np.concatenate(delivered)

    def _located(self, q: Symbols, x: Symbols | None) -> Symbols:
        here = self.value(q)
        x = symbols(here) if x is None else np.where(np.isfinite(x), x, here)
        images = x.reshape(-1, self._stride)
        depths = images[:, 2] if self._stride == 3 else self.depth
        found = []
        for image, Z in zip(images, depths, strict=True):
            place = symbols(self._pinhole.locate(self._pinhole.nearest(image[:2]), Z))
            found.append(np.where(Z > 0.0, place, math.nan))
        return symbols(found)


class _Nonsingular(NonsingularTask):
    def jacobian(self, q: Symbols, x: Symbols | None = None) -> Symbols:
        J = symbols(self.task.jacobian(q, x))
        G = J @ J.T
        regular = is_regular(G, self._ratio, self._scale)
        if not isinstance(regular, Scalar) and regular:
            return J
        bent = symbols(self.task.jacobian(moved(self.robot, q, self._bend), x))
        squares, U = eigensystem(G)
        weights = self._weights(squares)
        designed = symbols(self._designed(J, bent, weights, U))
        if not isinstance(regular, Scalar):
            return designed
        found = regular.graph.rare(~regular, designed.ravel().tolist(), J.ravel().tolist())
        return symbols(found).reshape(J.shape)


_KINDS: dict[type[Task], type[Task]] = {
    PositionTask: PositionTask,
    PoseTask: _Pose,
    TrackerTask: TrackerTask,
    PoseTrackerTask: _PoseTracker,
    ImageTask: _Image,
    StackedTask: StackedTask,
    CombinedTask: CombinedTask,
    NonsingularTask: _Nonsingular,
}
COVERED = tuple(_KINDS)
"""Tasks of which code can be made."""


def _parts(task: Task) -> tuple[Task, ...]:
    if isinstance(task, StackedTask):
        return task.tasks
    return (task.task,) if isinstance(task, WrappedTask) else ()


def _all(task: Task) -> Iterator[Task]:
    """Return a task and all that it is made of."""
    yield task
    for part in _parts(task):
        yield from _all(part)


def require_covered(task: Task) -> None:
    """Refuse a task of which no code can be made."""
    for part in _all(task):
        if type(part) not in COVERED:
            names = ", ".join(each.__name__ for each in COVERED)
            raise InvalidInputError(
                f"task must be one of {names} to make code of it, got "
                f"{type(part).__name__}: {part!r}",
                given=task,
            )
        if isinstance(part, ImageTask) and type(part.camera) not in cameras.COVERED:
            names = " or a ".join(each.__name__ for each in cameras.COVERED)
            raise InvalidInputError(
                f"camera must be a {names} to make code of it, got "
                f"{type(part.camera).__name__}: {part.camera!r}",
                given=task,
            )


def frames(task: Task) -> tuple[str, ...]:
    """Return the frames of the robot that a task looks at."""
    found: dict[str, None] = {}
    for part in _all(task):
        found[getattr(part, "frame", None)] = None  # type: ignore[index]
        if isinstance(part, ImageTask):
            found[part.camera.mount] = None  # type: ignore[index]
    return tuple(name for name in found if name is not None)


def may_lose(task: Task) -> bool:
    """Return whether a sensor may not see what it measures."""
    return any(isinstance(part, ImageTask) for part in _all(task))


def numbers(sensors: Sequence[Task]) -> dict[str, Array]:
    """Return the numbers of sensors that may differ from run to run, by name, stacked."""
    found: dict[str, Array] = {}
    for i, parts in enumerate(zip(*map(_all, sensors), strict=True)):
        if isinstance(parts[0], ImageTask):
            each = [cameras.numbers(part.camera) for part in parts]
            for name in each[0]:
                found[f"sensor.{i}{name}"] = np.array([one[name] for one in each])
    return found


def on_symbols(
    task: Task, here: Configured | None = None, given: Mapping[str, Symbols] | None = None
) -> Any:
    """Return a task whose functions take symbols.

    Args:
        task: The task.
        here: The arm, for what depends on it.
        given: The numbers of a sensor by their names in `numbers`; those of the task by default.
    """
    places = {id(part): i for i, part in enumerate(_all(task))}

    def made(task: Task) -> Any:
        found = object.__new__(_KINDS[type(task)])
        own = vars(task).copy()
        if here is not None and "_frame" in own:
            own["_frame"] = _Frame(here, own["frame"])
        if isinstance(task, ImageTask):
            prefix = f"sensor.{places[id(task)]}"
            named = {name: prefix + name for name in cameras.numbers(task.camera)}
            values = {name: given[at] for name, at in named.items() if given and at in given}
            own["camera"] = cameras.on_symbols(task.camera, values)
            if here is not None:
                own["_kinematics"] = _points(task, here)
        if isinstance(task, StackedTask):
            each = [made(part) for part in task.tasks]
            rest = [entries for _, *entries in task._each]
            own["tasks"] = tuple(each)
            own["_each"] = [(part, *more) for part, more in zip(each, rest, strict=True)]
        if isinstance(task, WrappedTask):
            own["task"] = made(task.task)
        vars(found).update(own)
        return found

    return made(task)


def _points(task: ImageTask, here: Configured) -> Any:
    own = task._kinematics
    found = object.__new__(type(own))
    vars(found).update(
        vars(own),
        _frame=None if own.frame is None else _Frame(here, own.frame),
        _mount=None if own.mount is None else _Frame(here, own.mount),
    )
    return found


def value(task: Task, here: Configured, given: Mapping[str, Symbols] | None = None) -> Symbols:
    """Return x at a configuration, of a task with its numbers or given ones, shape (n_x,)."""
    return symbols(on_symbols(task, here, given).value(here.q))


def seen(sensor: Task, x: Symbols) -> Symbols:
    """Return what a sensor delivers of x (n_x,), shape (n_x,); NaN what it cannot see."""
    return symbols(on_symbols(sensor)._seen(x))


def jacobian(task: Task, here: Configured, x: Symbols | None = None) -> Symbols:
    """Return Ĵ at a configuration where x (n_x,) is measured, shape (m, n_v)."""
    return symbols(on_symbols(task, here).jacobian(here.q, x))


def error(task: Task, x: Symbols, x_d: Symbols) -> Symbols:
    """Return e of x to a target, both (n_x,); shape (m,)."""
    return symbols(on_symbols(task).error(x, x_d))
