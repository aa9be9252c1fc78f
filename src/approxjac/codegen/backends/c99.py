"""Programs as C99, and one sampled step of a law, with its limits, as one."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from approxjac.codegen import traced_limits as limits
from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.rigid_body import Arm
from approxjac.codegen.backends.numpy_source import numpy_function
from approxjac.codegen.trace.program import Going, Language, Program, Rows, Writer
from approxjac.codegen.trace.symbols import Graph, Number, Passes, inputs, symbols
from approxjac.controllers.limits.torque_limited import TorqueLimited
from approxjac.controllers.setpoint import SetpointController
from approxjac.interface import Measurement
from approxjac.validation import Array

_TEMPLATES = {
    "add": "{0} + {1}",
    "subtract": "{0} - {1}",
    "multiply": "{0} * {1}",
    "divide": "{0} / {1}",
    "negative": "-{0}",
    "absolute": "fabs({0})",
    "sqrt": "sqrt({0})",
    "floor": "floor({0})",
    "power": "power_of_two({0})",
    "less": "{0} < {1}",
    "less_equal": "{0} <= {1}",
    "equal": "{0} == {1}",
    "and": "{0} & {1}",
    "or": "{0} | {1}",
    "not": "!{0}",
    "select": "{0} ? {1} : {2}",
}


def constant(value: float) -> str:
    """Return a number as C writes it, to the last bit."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0.0 else "(-INFINITY)"
    text = repr(value) if value == int(value) and abs(value) < 1e6 else value.hex()
    return f"({text})" if text.startswith("-") else text


def _rare(
    _: str, condition: str, lines: list[str], results: list[tuple[str, str, str]]
) -> list[str]:
    return [
        *(f"    double {name} = {other};" for name, _, other in results),
        f"    if ({condition}) {{",
        *(f"    {line}" for line in lines),
        *(f"        {name} = {value};" for name, value, _ in results),
        "    }",
    ]


def _table(name: str, numbers: list[str], is_constant: bool) -> list[str]:
    rows = textwrap.wrap(", ".join(numbers), 72)
    first = f"    {'static ' if is_constant else ''}const double {name}[] = {{"
    return [first, *(f"        {row}" for row in rows), "    };"]


def _loop(label: str, loop: Passes, lines: list[str], going: Going, rows: Rows) -> list[str]:
    s, y, i = f"s{label}", f"y{label}", f"i{label}"
    return [
        *([f"    double {s}[{loop.n}];"] if going else []),
        *([f"    double {y}[{loop.times * loop.m}];"] if rows else []),
        *(f"    {s}[{at}] = {start};" for at, start, _ in going),
        f"    for (int {i} = 0; {i} < {loop.times}; ++{i}) {{",
        *(f"    {line}" for line in lines),
        *(f"        {s}[{at}] = {after};" for at, _, after in going),
        *(f"        {y}[{loop.m} * {i} + {at}] = {each};" for at, each in rows),
        "    }",
    ]


LANGUAGE = Language(
    templates=_TEMPLATES,
    variable="v",
    assigned=lambda name, text, is_condition: (
        f"    const {'int' if is_condition else 'double'} {name} = {text};"
    ),
    read=lambda name, i: name if name == "dt" else f"{name}[{i}]",
    constant=constant,
    rare=_rare,
    table=_table,
    loop=_loop,
    cell=lambda name, array, i: [f"    const double {name} = {array}[{i}];"],
    taken=lambda name, array, i, apart, first: [
        f"    const double {name} = {array}[{apart} * {i} + {first}];"
    ],
    number=lambda name, i: [f"    const double {name} = (double){i};"],
)


class SampledStep(NamedTuple):
    """One step of a law with a state, as arithmetic.

    Attributes:
        graph: All that is computed, of the inputs "q", "v", "x", "target", "state" and "dt".
        outputs: Name → numbers: "torque", "after" (the state after the step), "e", "gravity",
            "J_hat" (row by row), "status" (its place in `setpoint.STATUSES`), "limit_status" and
            "slack".
        law: The law, as it is inside of its limits.
        initial_state: State before the first step, shape (n_state,), but for the last
            `n_followed`, which are the first x.
        n_followed: How many numbers of the state, its last, follow x: m of law (5).
    """

    graph: Graph
    outputs: dict[str, list[Number]]
    law: SetpointController
    initial_state: Array
    n_followed: int

    def lines(self) -> tuple[list[str], dict[str, list[str]]]:
        """Return the lines of C that compute the outputs, and what these are called there."""
        flat = [number for numbers in self.outputs.values() for number in numbers]
        lines, names = Writer(self.graph, LANGUAGE).lines(flat)
        return lines, self._split(names)

    def in_numpy(self) -> Callable[..., dict[str, Array]]:
        """Return the same as a function of the inputs by name, (rows, N) → (rows, N)."""
        flat = [number for numbers in self.outputs.values() for number in numbers]
        function = numpy_function(self.graph, flat)

        def step(**given: Array) -> dict[str, Array]:
            size = len(given["dt"][0])
            with np.errstate(all="ignore"):
                rows = [np.broadcast_to(row, size) for row in function(**given)]
            return {
                name: np.array(each, dtype=float).reshape(-1, size)
                for name, each in self._split(rows).items()
            }

        return step

    def _split(self, flat: list[Any]) -> dict[str, list[Any]]:
        found, at = {}, 0
        for name, numbers in self.outputs.items():
            found[name] = flat[at : at + len(numbers)]
            at += len(numbers)
        return found


def sampled_step(controller: SetpointController | TorqueLimited) -> SampledStep:
    """Return one step of a controller that `limits.require_covered` takes, for a target at rest.

    x may be lost. Where the sweeps that keep what is learnt within its bounds do not end, it rests.
    """
    law = limits.law_of(controller)
    task, robot, p = law.task, law.task.robot, law.resting
    neutral = robot.neutral()
    rest = Measurement(0.0, neutral, np.zeros(robot.nv), task.value(neutral))
    initial_state = law.initial_state(rest)
    program = Program()
    sizes = {
        "q": robot.nq, "v": robot.nv, "x": task.n_x, "target": task.n_x,
        "state": len(initial_state), "dt": 1,
    }  # fmt: skip
    given = {name: inputs(program.graph, name, size) for name, size in sizes.items()}
    q, v, x, target, state, (dt,) = given.values()
    arm = Arm(program.given, "belief", robot, tasks.frames(task)).at(q)
    answer, within = limits.answer(controller, arm, q, v, x, target, state, may_lose=True)
    rate = symbols(answer.rate)
    rate[:p] = np.where(answer.left, 0.0, rate[:p])
    outputs = {
        "torque": within.torque, "after": state + np.multiply(dt, rate), "e": answer.e,
        "gravity": answer.gravity, "J_hat": answer.J_hat, "status": answer.status,
        "limit_status": within.status, "slack": within.slack,
    }  # fmt: skip
    flat = {name: symbols(value).ravel().tolist() for name, value in outputs.items()}
    return SampledStep(program.graph, flat, law, initial_state, len(initial_state) - p)
