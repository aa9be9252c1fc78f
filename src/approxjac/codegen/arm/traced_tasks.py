"""Tasks on symbols: their frames, and the numbers of sensors that differ from run to run."""

import re
from collections.abc import Callable, Mapping, Sequence
from traceback import walk_tb
from typing import Any

import numpy as np

from approxjac.cameras import Camera
from approxjac.codegen.arm.rigid_body import Arm, Configured
from approxjac.codegen.trace.symbols import Graph, Symbols, graph_of, inputs, symbols
from approxjac.errors import InvalidInputError
from approxjac.tasks import Task
from approxjac.validation import Array, changed_copy


def frames(task: Task) -> tuple[str, ...]:
    """Return the frames of the robot that a task looks at.

    Raises:
        InvalidInputError: A task that takes no symbols.
    """
    names: tuple[str, ...] | None = vars(task).get("_traced_frames")
    if names is None:
        graph, arm = Graph(), Arm.known(task.robot)
        q, x = inputs(graph, "q", task.robot.nq), inputs(graph, "x", task.n_x)
        with arm.standing_in(graph):
            traced("task", task, lambda: (task.value(q), task.jacobian(q, x), task.error(x, x)))
        names = vars(task)["_traced_frames"] = tuple(arm.frames)
    return names


def traced(name: str, given: Any, computed: Callable[[], Any]) -> Any:
    """Return the result of a user's object, such as a task, on symbols.

    Raises:
        InvalidInputError: It does not take symbols.
    """
    try:
        return computed()
    except (TypeError, AttributeError, ValueError, IndexError, ZeroDivisionError) as error:
        why = f"{type(error).__name__}: {error}"
        if unknown := re.search(r"no callable (\w+) method", why):
            why = f"numpy.{unknown[1]} is none of the functions that code can be made of"
        raise InvalidInputError(
            f"{name} must take symbols to make code of it, with choices by numpy.where or "
            f"law.choose and no branch on a value, which {_place(error)} does not: "
            f"{why}; got {given!r}, which runs in Python",
            given=given,
        ) from error


def _place(error: Exception) -> str:
    """Return the method that failed: the last one of a user's, else of this library's."""
    frames = [frame for frame, _ in walk_tb(error.__traceback__) if "self" in frame.f_locals]
    ours = [f for f in frames if not f.f_globals["__name__"].startswith("approxjac.codegen")]
    own = [f for f in ours if not f.f_globals["__name__"].startswith("approxjac.")]
    last = (own or ours or frames)[-1]
    return f"{type(last.f_locals['self']).__name__}.{last.f_code.co_name}"


def may_lose(task: Task) -> bool:
    """Return True if a sensor may lose its measurement."""
    return bool(_cameras(task)) or type(task).visible is not Task.visible


def _cameras(of: Any) -> list[Camera]:
    if isinstance(of, Camera):
        return [of]
    parts = [*vars(of).values()] if isinstance(of, Task) else of
    each = map(_cameras, parts) if isinstance(parts, list | tuple) else ()
    return [*{id(camera): camera for found in each for camera in found}.values()]


def numbers(sensors: Sequence[Task]) -> dict[str, Array]:
    """Return the numbers of sensors that may differ from run to run, by name, stacked."""
    stacked: dict[str, Array] = {}
    for i, each in enumerate(zip(*map(_cameras, sensors), strict=True)):
        own = [camera.numbers for camera in each]
        for name in own[0]:
            stacked[f"sensor.{i}{name}"] = np.array([one[name] for one in own])
    return stacked


def with_numbers(sensor: Task, given: Mapping[str, Symbols]) -> Task:
    """Return a sensor with numbers by their names in `numbers`."""
    changed = {}
    for i, camera in enumerate(_cameras(sensor)):
        named = {name: given[f"sensor.{i}{name}"] for name in camera.numbers}
        changed[id(camera)] = camera.with_numbers(named)
    return _replaced(sensor, lambda camera: changed[id(camera)])


def _replaced(of: Any, changed: Callable[[Camera], Camera]) -> Any:
    if isinstance(of, Camera):
        return changed(of)
    if isinstance(of, tuple | list):
        parts = [_replaced(part, changed) for part in of]
        if all(a is b for a, b in zip(parts, of, strict=True)):
            return of
        return type(of)(*parts) if hasattr(of, "_fields") else type(of)(parts)
    if isinstance(of, Task):
        own = {name: _replaced(part, changed) for name, part in vars(of).items()}
        is_same = all(own[name] is part for name, part in vars(of).items())
        return of if is_same else changed_copy(of, **own)
    return of


def value(task: Task, here: Configured, given: Mapping[str, Symbols] | None = None) -> Symbols:
    """Return x at a configuration, of a task with its numbers or given ones, shape (n_x,)."""
    own = with_numbers(task, given) if given else task
    with here.arm.standing_in(graph_of(here.q)):
        return symbols(traced("task", task, lambda: own.value(here.q)))


def jacobian(task: Task, here: Configured, x: Symbols | None = None) -> Symbols:
    """Return Ĵ at a configuration where x (n_x,) is measured, shape (m, n_v)."""
    with here.arm.standing_in(graph_of(here.q)):
        return symbols(traced("task", task, lambda: task.jacobian(here.q, x)))


def seen(sensor: Task, x: Symbols) -> Symbols:
    """Return x (n_x,) as a sensor delivers it, with NaN where it cannot see."""
    return symbols(traced("task", sensor, lambda: sensor.visible(x)))


def error(task: Task, x: Symbols, x_d: Symbols) -> Symbols:
    """Return e of x to a target, both (n_x,); shape (m,)."""
    return symbols(traced("task", task, lambda: task.error(x, x_d)))
