"""Functions of a task for analysis, sensors and plots."""

from collections.abc import Iterable
from itertools import islice

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.tasks.image import ImageTask
from approxjac.tasks.task import Feature, Task
from approxjac.validation import Array, as_array, require

FINE = {"m": 1e-3, "rad": 1e-3, "px": 0.5}  # errors that count as none, by the unit of a task
_NOISY = 3.0  # times a sensor's noise, within which an error counts as none, too
_OF_A_BODY = 6  # motions, however many points it has
_TRIES = 20000  # random configurations to look for ones that a camera sees


def fine_error(units: Iterable[str], noise: float = 0.0) -> float:
    """Return the error below which a task in these units counts as done, given sensor noise."""
    return max(_NOISY * noise, *(FINE.get(unit, FINE["m"]) for unit in units))


def jacobian_gradient(task: Task, q: Array) -> Array:
    """Return ∂J/∂q_k, shape (n_v, m, n_v), k first: `jacobian_dot` along each joint."""
    return np.array([task.jacobian_dot(q, unit) for unit in np.eye(task.robot.nv)])


def with_error(task: Task, x: Array, x_d: Array, e: Array) -> Array:
    """Return the value whose error to x_d is e (m,); entries without an error as in x; (n_x,)."""
    value = task.displaced(x_d, e)
    value[task.ignored] = x[task.ignored]
    return value


def combination(task: Task) -> Array:
    """Return the matrix from errors of the measured value to those of the task."""
    measured, origin = task.measured, task.origin
    if measured is task:
        return np.eye(task.m)
    units = [measured.displaced(origin, unit) for unit in np.eye(measured.m)]
    return np.column_stack([task.error(x, origin) for x in units])


def uncombined(task: Task) -> Array | None:
    """Return the matrix from a task's errors to the smallest measured ones; None for I."""
    return None if task.measured is task else np.asarray(np.linalg.pinv(combination(task)))


def controllable_coordinates(task: Task) -> int:
    """Return the largest number of coordinates that the arm can move independently."""
    most = min(task.m, task.robot.nv)
    return min(most, _OF_A_BODY) if isinstance(task, ImageTask) else most


def require_controllable(task: Task) -> None:
    """Raise an InvalidInputError for a task with more coordinates than the arm can move."""
    require("task", task, Task, "a task of the believed robot, such as PositionTask(robot)")
    m, nv, most = task.m, task.robot.nv, controllable_coordinates(task)
    if m > most:
        raise InvalidInputError(
            f"task must have at most as many coordinates as the robot has joints (m <= n_v), and 6 "
            f"of points of one body, got m = {m} for {task.robot.name} with n_v = {nv}: "
            f"CombinedTask.balanced(task, x_d) makes {most} of them",
            given=task,
        )
    q = next(task.robot.configurations(1))
    x, J = task.value(q), task.jacobian(q)
    for what, each in (("value", x), ("jacobian", J)):
        require(f"{what} of the task", each, np.ndarray, f"an array for {task!r}")
    as_array("value of the task", np.nan_to_num(x), (task.n_x,))  # NaN is not seen
    as_array("jacobian of the task", J, (m, nv))


def features(task: Task | None) -> tuple[Feature, ...]:
    """Return the features that a task follows; none for a user's own task."""
    return () if task is None else task.features


def place_of(task: Task, x: Array) -> Array | None:
    """Return the position in the world (3,) [m] of a value x (n_x,); None if it has none."""
    placed = next((part for part in features(task) if part.axes == "xyz"), None)
    return None if placed is None else placed.place(x)


def image_feature(task: Task | None) -> Feature | None:
    """Return the first feature of a task that a camera sees, or None."""
    return next((feature for feature in features(task) if feature.camera is not None), None)


def require_unmirrored(task: Task, name: str, x: Array, like: Array, whose: str) -> None:
    """Raise an InvalidInputError if a value's points run in the opposite sense to another's."""
    if task.is_mirrored(x, like):
        raise InvalidInputError(
            f"{name} must have its points in the task's order: they run round the other way than "
            f"in {whose}, as if in a mirror; pupil-apriltags' corners are to be reversed, "
            f"corners[::-1]; got {np.round(x, 1).tolist()}",
            given=x,
        )


def require_as_believed(task: Task, q: Array, x: Array) -> None:
    """Raise an InvalidInputError if a measured x is mirrored against the believed image."""
    if image_feature(task) is not None and np.isfinite(q).all():
        require_unmirrored(task, "x", x, task.value(q), "the believed image")


def sees(task: Task, q: Array) -> bool:
    """Return True if a sensor delivers all of a task's value at q (nq,)."""
    if type(task).visible is Task.visible:
        return True
    return bool(np.isfinite(task.visible(task.value(q))).all())


def seen_configurations(task: Task, count: int) -> list[Array]:
    """Draw up to `count` seeded configurations in which the task's sensor sees it."""
    drawn = task.robot.configurations(max(count, _TRIES))
    seen = list(islice((q for q in drawn if sees(task, q)), count))
    if not seen:
        raise InvalidInputError(
            f"task must be one that its own sensor sees somewhere within the joint limits of "
            f"{task.robot.name}, got {task!r}",
            given=task,
        )
    return seen


def vanishing(task: Task) -> float:
    """Return the σ_max [unit of the task/rad] below which Ĵ vanishes: a tenth of the usual one."""
    threshold: float | None = vars(task).get("_vanishing")  # which no task changes
    if threshold is None:
        largest = [np.linalg.norm(task.jacobian(q), 2) for q in seen_configurations(task, 20)]
        threshold = vars(task)["_vanishing"] = 0.1 * float(np.median(largest))
    return threshold


def require_jacobian_of_q(task: Task, what: str) -> None:
    """Raise an InvalidInputError if a task's Jacobian uses the measured x."""
    if task.uses_x:
        raise InvalidInputError(
            f"{what} is for a task whose Jacobian depends on q only and has a rate, such as an "
            f"ImageTask with depth='believed', got {task!r}; local_stability and rollouts are for "
            "every task",
            given=task,
        )
