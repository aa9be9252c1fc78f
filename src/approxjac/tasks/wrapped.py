"""Tasks made from others: stacked, with combined coordinates, or with a regular Jacobian."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac import law
from approxjac.errors import InvalidInputError, require_known
from approxjac.formatting import joined
from approxjac.robots import Dynamics, Robot
from approxjac.robots.traced import moved
from approxjac.tasks.analysis import (
    controllable_coordinates,
    seen_configurations,
    vanishing,
    with_error,
)
from approxjac.tasks.task import Task
from approxjac.validation import Array, as_array, as_number, require


class WrappedTask(Task):
    """A task made from others of one robot, whose values, errors and sensors are stacked."""

    def __init__(
        self, tasks: Sequence[Task], labels: Sequence[str], units: Sequence[str] | None = None
    ) -> None:
        units = [unit for task in tasks for unit in task.units] if units is None else units
        super().__init__(tasks[0].robot, labels, units, sum(task.n_x for task in tasks))
        entries = _one_after_the_other([task.n_x for task in tasks])
        rows = _one_after_the_other([task.m for task in tasks])
        measured = _one_after_the_other([task.measured.m for task in tasks])
        self.tasks = tuple(tasks)
        self._each = list(zip(tasks, entries, rows, strict=True))
        self.uses_x = any(task.uses_x for task in tasks)
        parts = tuple(
            (_moved(part, at.start), _moved(coordinates, own.start))
            for (task, at, _), own in zip(self._each, measured, strict=True)
            for part, coordinates in task.parts
        )
        vars(self).update(
            subtracts=all(task.subtracts for task in tasks),
            origin=np.concatenate([task.origin for task in tasks]),
            ignored=[at.start + i for task, at, _ in self._each for i in task.ignored],
            parts=parts,
        )
        self.features = tuple(
            feature._replace(entries=_moved(feature.entries, at.start))
            for task, at, _ in self._each
            for feature in task.features
        )

    def value(self, q: Array) -> Array:
        return np.concatenate([task.value(q) for task in self.tasks])

    def error(self, x: Array, x_d: Array) -> Array:
        return np.concatenate([task.error(x[i], x_d[i]) for task, i, _ in self._each])

    def displaced(self, x: Array, e: Array) -> Array:
        return np.concatenate([task.displaced(x[i], e[rows]) for task, i, rows in self._each])

    def target(self, x_d: object) -> Array:
        target = super().target(x_d)
        for task, entries, _ in self._each:
            task.target(target[entries])  # as it may have edges, such as those of an image
        return target

    @property
    def measured(self) -> Task:
        return self.tasks[0].measured

    def visible(self, x: Array) -> Array:
        return np.concatenate([task.visible(x[i]) for task, i, _ in self._each])

    def is_mirrored(self, x: Array, other: Array) -> bool:
        return any(task.is_mirrored(x[i], other[i]) for task, i, _ in self._each)

    def sensor_jacobian(self, q: Array) -> Array:
        return np.concatenate([task.sensor_jacobian(q) for task in self.tasks])

    def error_jacobian(self, e: Array, J: Array) -> Array:
        return np.concatenate([task.error_jacobian(e[i], J[i]) for task, _, i in self._each])

    def _saved(self) -> dict[str, Any] | None:
        return self.tasks[0]._saved()  # what the law changes is no affair of a picture


def _one_after_the_other(sizes: list[int]) -> list[slice]:
    return [slice(end - size, end) for size, end in zip(sizes, accumulate(sizes), strict=True)]


def _moved(entries: slice, start: int) -> slice:
    return slice(entries.start + start, entries.stop + start)


class StackedTask(WrappedTask):
    """X = the values of several tasks; labels start with the task's number: "1.x", "2.x".

    Args:
        *tasks: At least one task, all of the same robot.

    Raises:
        InvalidInputError: No task, tasks of different robots, or more coordinates than joints.
    """

    def __init__(self, *tasks: Task) -> None:
        if not tasks:
            raise InvalidInputError("tasks must be at least one task, got none", given=tasks)
        for task in tasks:
            require("each of tasks", task, Task, "a task, such as PositionTask(robot)")
            if task.robot != tasks[0].robot:
                message = f"tasks must be of one robot, got {tasks[0].robot!r} and {task.robot!r}"
                raise InvalidInputError(message, given=tasks)
        self.overdetermined = any(task.overdetermined for task in tasks)
        super().__init__(tasks, [f"{i + 1}.{at}" for i, t in enumerate(tasks) for at in t.labels])

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        given = [(task, None if x is None else x[i]) for task, i, _ in self._each]
        return np.concatenate([task.jacobian(q, part) for task, part in given])

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        return np.concatenate([task.jacobian_dot(q, v) for task in self.tasks])

    def on(self, robot: Robot) -> StackedTask:
        return StackedTask(*(task.on(robot) for task in self.tasks))

    @property
    def measured(self) -> Task:
        plain = [task.measured for task in self.tasks]
        same = all(a is b for a, b in zip(plain, self.tasks, strict=True))
        return self if same else StackedTask(*plain)

    def _saved(self) -> dict[str, Any] | None:
        parts = [task._saved() for task in self.tasks]
        return None if None in parts else {"kind": "stacked", "tasks": parts}

    def __repr__(self) -> str:
        return f"StackedTask({', '.join(map(repr, self.tasks))})"


_CONFIGURATIONS = 400
_NEAREST = 30  # of these, by their value's distance to the target
_STARTS, _STEPS = 10, 20  # of the search for configurations with the target's value
_DAMPED = 1e-3  # of the largest singular value
_BEST = 1.5  # times the least error that was found is as good
_LONGEST = 0.3  # step of that search [rad or m]
_LEAST = 0.01  # mobility that a direction is taken to have at least, as a share of the largest
_REGULAR = 1e-9  # σ_min/σ_max of C below which it has no inverse


class CombinedTask(WrappedTask):
    """e = C (error of another task): the same task in other coordinates, as many or fewer.

    K_p and K_v are diagonal and cannot weigh combinations of coordinates: the images of several
    points move together when the hand moves sideways, and hardly apart when it comes nearer, so
    that one gain for all makes the second slow. With C, which `balanced` chooses, each motion
    is a coordinate of its own. Measurements and targets stay those of the task itself.

    With fewer rows than columns C reduces the coordinates, such as the eight of a tag's corners to
    the six of a rigid body. The law's proof holds wherever C Ĵ has full row rank.

    Source: the combination matrix of B. Espiau, F. Chaumette and P. Rives, "A new approach to
    visual servoing in robotics", IEEE Trans. Robotics and Automation 8 (1992).

    It is for controllers; the plant's sensor, also in rollouts, is the task itself. The other
    stability tests need a plant whose sensor is `CombinedTask(sensor, C)` with the same C.

    Args:
        task: The task of the believed robot.
        C: Matrix of full row rank with m columns and at most m rows. Its scale does not matter:
            the default gains are chosen for it.

    Raises:
        InvalidInputError: A matrix without full row rank, or with more rows than joints.
    """

    def __init__(self, task: Task, C: object) -> None:
        require("task", task, Task, "a task, such as ImageTask(robot, camera, points=points)")
        self.C = as_array("C", C, ("k", task.m))
        k = len(self.C)
        values = np.linalg.svd(self.C, compute_uv=False)
        if k > task.m or not values[-1] > _REGULAR * values[0]:
            raise InvalidInputError(
                f"C must have full row rank, with at most {task.m} rows, got shape {self.C.shape} "
                f"and singular values {values.tolist()}",
                given=C,
            )
        labels = [f"c{i}" for i in range(1, k + 1)]
        super().__init__((task,), labels, (joined(task.units),) * k)
        self.task = task
        self._inverse = np.linalg.inv(self.C) if k == task.m else np.linalg.pinv(self.C)
        vars(self).update(subtracts=False)

    @classmethod
    def balanced(cls, task: Task, target: object) -> CombinedTask:
        """Combine coordinates such that the arm has the same inertia along all of them.

        C = Ā^(−1/2), scaled to ‖C‖ = 1, so that no error grows. Ā is the mean of the mobility
        Ĵ M̂⁻¹ Ĵᵀ, of trace one, over the 30 of 400 seeded configurations whose values are nearest to
        the target. Of more coordinates than the arm can move independently, such as the eight of
        a tag's corners, C keeps those with the largest mobility; then Ā is that at the believed
        arm's configuration nearest to the target.

        Args:
            task: The task of the believed robot.
            target: x_d, shape (n_x,).

        Raises:
            InvalidInputError: Coordinates of different units, whose inertias cannot be compared.
        """
        require("task", task, Task, "a task, such as ImageTask(robot, camera, points=points)")
        if len(set(task.units)) > 1:
            raise InvalidInputError(
                f"task must have coordinates of one unit to be balanced, got {joined(task.units)}: "
                "balance each part, StackedTask(CombinedTask.balanced(image, x_d), position)",
                given=task,
            )
        x_d = task.target(target)
        seen = seen_configurations(task, _CONFIGURATIONS)
        far = [np.linalg.norm(task.error(task.value(q), x_d)) for q in seen]
        near, rows = [seen[k] for k in np.argsort(far)[:_NEAREST]], controllable_coordinates(task)
        if rows < task.m:
            ends = [_nearer(task, x_d, q) for q in near[:_STARTS]]
            least = min(error for _, error in ends)
            near = [q for q, error in ends if error <= _BEST * least + 1e-6]
        dynamics, A, none = Dynamics(task.robot), np.zeros((task.m, task.m)), np.zeros(task.m)
        for q in near:
            J = task.jacobian(q, with_error(task, task.value(q), x_d, none))
            mobility = J @ np.linalg.solve(dynamics.M(q), J.T)
            A += mobility / np.trace(mobility)
        values, U = np.linalg.eigh(A)
        values, U = values[-rows:], U[:, -rows:]
        values = np.maximum(values, _LEAST * values[-1])
        scaled = U * np.sqrt(values[0] / values)
        return cls(task, scaled @ U.T if rows == task.m else scaled.T)

    def error(self, x: Array, x_d: Array) -> Array:
        return np.asanyarray(self.C @ self.task.error(x, x_d))

    def displaced(self, x: Array, e: Array) -> Array:
        return self.task.displaced(x, self._inverse @ e)

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        return np.asanyarray(self.C @ self.task.jacobian(q, x))

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        return np.asarray(self.C @ self.task.jacobian_dot(q, v))

    def on(self, robot: Robot) -> CombinedTask:
        return CombinedTask(self.task.on(robot), self.C)

    def sensor_jacobian(self, q: Array) -> Array:
        return np.asarray(self.C @ self.task.sensor_jacobian(q))

    def error_jacobian(self, e: Array, J: Array) -> Array:
        inverse = self._inverse
        return np.asarray(self.C @ self.task.error_jacobian(inverse @ e, inverse @ J))

    def __repr__(self) -> str:
        return f"CombinedTask({self.task!r}, C of shape {self.C.shape})"


def _nearer(task: Task, x_d: Array, q: Array) -> tuple[Array, float]:
    """Return the configuration that damped least squares lead to, and the error's size there."""
    e = task.error(task.value(q), x_d)
    for _ in range(_STEPS):
        J = task.error_jacobian(e, task.jacobian(q, task.value(q)))
        damping = _DAMPED * np.linalg.norm(J, 2)
        step = -J.T @ np.linalg.solve(J @ J.T + damping**2 * np.eye(task.m), e)
        step /= max(1.0, float(np.abs(step).max()) / _LONGEST)
        moved = np.array(pin.integrate(task.robot.model, q, step))
        after = task.error(task.value(moved), x_d)
        if not np.linalg.norm(after) < np.linalg.norm(e):
            break
        q, e = moved, after
    return q, float(np.linalg.norm(e))


_TINY = 1e-300


class NonsingularTask(WrappedTask):
    """A task whose Ĵ is designed to stay of full rank at the robot's singular configurations.

    The paper (section 6) remarks that Ĵ may be chosen so that the arm does not stall there. Here

        Ĵ_d(q) = Ĵ(q) + P(q) (Ĵ(q ⊕ bend) − Ĵ(q)),   P = Σ wᵢ uᵢuᵢᵀ,   wᵢ = max(0, 1 − (σᵢ/ε)²)

    with σᵢ, uᵢ the singular values and left singular vectors of Ĵ(q) and ε = `ratio` · σ_max (a
    tenth of the typical σ_max of Ĵ in place of a smaller σ_max): task directions near singularity
    get the rows of a slightly bent configuration. `bend` also decides to which side the arm folds.

    It is for controllers; the sensor is a plain task of the true robot.

    Args:
        task: The task of the believed robot.
        bend: Joint name → displacement of the bent configuration [rad or m], as {"joint4": 0.3}.
        ratio: Share of the largest singular value below which Ĵ is changed, > 0 and <= 1.

    Raises:
        UnknownNameError: No such joint.
        InvalidInputError: No joint is bent, or one by a turn or more.
    """

    def __init__(self, task: Task, bend: Mapping[str, float], ratio: float = 0.1) -> None:
        require("task", task, Task, "a task of the believed robot, such as PositionTask(robot)")
        require("bend", bend, Mapping, "a mapping from joint names to displacements")
        super().__init__((task,), task.labels)
        self.task = task
        self._ratio = as_number("ratio", ratio, above=0.0, most=1.0)
        robot = task.robot
        offset = np.zeros(robot.nv)
        for joint, displacement in bend.items():
            require_known("moving joint", joint, robot.name, robot.joint_names)
            i = robot.joint_names.index(joint)
            unit = robot.joint_units[i]
            most = 2.0 * np.pi if unit == "rad" else np.inf
            offset[i] = as_number(
                f"bend of {joint}", displacement, unit=unit, minimum=-most, most=most
            )
        if not offset.any():
            message = f"bend must displace at least one joint of {robot.name}, got {dict(bend)}"
            raise InvalidInputError(message, given=bend)
        self._bend = offset
        self._scale = vanishing(task)

    def jacobian(self, q: Array, x: Array | None = None) -> Array:
        J = law.array(self.task.jacobian(q, x))
        G = J @ J.T

        def designed() -> tuple[Array]:
            squares, U = np.linalg.eigh(G)
            weights = self._weights(squares)
            if type(weights) is np.ndarray and not weights.any():
                return (J,)
            bent = self.task.jacobian(moved(self.robot, q, self._bend), x)
            return (J + (U * weights) @ U.T @ (bent - J),)

        may_be = law.may_be_singular(G, self._ratio, self._scale)
        return np.asanyarray(law.choose(may_be, designed, lambda: (J,))[0])

    def design_error(self, q: Array) -> float:
        """Return ‖Ĵ_d − Ĵ‖, which adds to the error bound p of eq. (7); 0 away from singular."""
        return float(np.linalg.norm(self.jacobian(q) - self.task.jacobian(q), 2))

    def jacobian_dot(self, q: Array, v: Array) -> Array:
        J = self.task.jacobian(q)
        changed = self._weights(np.asarray(np.linalg.eigvalsh(J @ J.T))).any()
        return super().jacobian_dot(q, v) if changed else self.task.jacobian_dot(q, v)

    def _weights(self, squares: Array) -> Array:
        """Return the weight of each left singular vector, 1 where its singular value is 0."""
        threshold = self._ratio**2 * np.maximum(squares.max(), max(self._scale**2, _TINY))
        return np.maximum(0.0, 1.0 - np.maximum(squares, 0.0) / threshold)

    def on(self, robot: Robot) -> Task:
        """Return the original task, for another robot."""
        return self.task.on(robot)

    def __repr__(self) -> str:
        bent = zip(self.robot.joint_names, self._bend.tolist(), strict=True)
        shown = {joint: displacement for joint, displacement in bent if displacement}
        return f"NonsingularTask({self.task!r}, bend={shown})"
