"""Programs as C99, and one sampled step of a law, with its limits, as one."""

import math
import sys
import textwrap
from collections.abc import Callable
from itertools import chain
from types import FrameType
from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.codegen import traced_law as laws
from approxjac.codegen.backends.numpy_function import numpy_function
from approxjac.codegen.trace.program import Going, Language, Rows
from approxjac.codegen.trace.symbols import FAR, Graph, Number, Passes, Scalar, inputs, symbols
from approxjac.controllers.controller import Controller
from approxjac.interface import Measurement
from approxjac.validation import Array

_TRACER = laws.__name__  # whose frames are below those of a law
_TEMPLATES = {
    "add": "{0} + {1}",
    "subtract": "{0} - {1}",
    "multiply": "{0} * {1}",
    "divide": "{0} / {1}",
    "negative": "-{0}",
    "less": "{0} < {1}",
    "less_equal": "{0} <= {1}",
    "equal": "{0} == {1}",
    "and": "{0} & {1}",
    "or": "{0} | {1}",
    "absolute": "fabs({0})",
    "sqrt": "sqrt({0})",
    "far": f"{{0}} + {FAR}",
    "power": "power_of_two({0})",
    "not": "!{0}",
    "select": "{0} ? {1} : {2}",
}


def constant(value: float) -> str:
    """Return a number as a C literal, which is exact: the shortest decimal that is read as it."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0.0 else "(-INFINITY)"
    text = repr(value)  # as C++ has no hexadecimal ones before C++17
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


def table(name: str, numbers: list[str], is_constant: bool) -> list[str]:
    """Return the lines of an array that holds some numbers."""
    rows = textwrap.wrap(", ".join(each.strip("()") for each in numbers), 92)
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


READ = {  # an argument of a step
    "t": "now->t",
    "q": "now->q[{}]",
    "v": "now->v[{}]",
    "x": "now->x[{}]",
    "t_x": "now->t_x",
    "target": "target->x[{}]",
    "target_v": "target->v[{}]",
    "target_a": "target->a[{}]",
    "state": "state[{}]",
    "dt": "dt",
}

LANGUAGE = Language(
    templates=_TEMPLATES,
    variable="v",
    assigned=lambda name, text, is_condition: (
        f"    const {'int' if is_condition else 'double'} {name} = {text};"
    ),
    read=lambda name, i: READ[name].format(i),
    constant=constant,
    rare=_rare,
    table=table,
    loop=_loop,
    cell=lambda name, array, i: [f"    const double {name} = {array}[{i}];"],
    taken=lambda name, array, i, apart, first: [
        f"    const double {name} = {array}[{apart} * {i} + {first}];"
    ],
    number=lambda name, i: [f"    const double {name} = (double){i};"],
)


class ExplainedGraph(Graph):
    """A graph that knows which equation an operation is from.

    `equations` has the place of each operation of a function of `law` that implements an equation,
    and the name of the function.
    """

    def __init__(self) -> None:
        super().__init__()
        self.equations: dict[int, str] = {}

    def apply(self, operation: str, *numbers: Number) -> Scalar:
        """Return the result of an operation that is written down."""
        before, result = len(self.nodes), super().apply(operation, *numbers)
        frame: FrameType | None = sys._getframe(1) if result.place >= before else None
        while frame is not None and (module := frame.f_globals.get("__name__", "")) != _TRACER:
            function = frame.f_globals.get(frame.f_code.co_name)
            if module.startswith("approxjac.law.") and "Implements" in str(function.__doc__):
                self.equations[result.place] = frame.f_code.co_name
                break
            frame = frame.f_back
        return result


class SampledStep(NamedTuple):
    """One step of a law with a state, as arithmetic.

    Its outputs are "torque", "after" (the state after the step), "e", "gravity", "J_hat" (row by
    row), "status" (the number of a `Status`), "limit_status" and "slack".
    """

    graph: ExplainedGraph  # of the inputs that `READ` names
    outputs: dict[str, list[Number]]
    controller: Controller
    sizes: dict[str, int]  # of inputs
    first: list[Number]  # state before the first step, of the first measurement

    @property
    def asked(self) -> set[str]:
        """Names of the inputs that it uses."""
        return self.graph.asked([*chain(*self.outputs.values()), *self.first])

    def in_numpy(self) -> Callable[..., dict[str, Array]]:
        """Return the step as a function of the inputs by name, (rows, N) → (rows, N)."""
        function = numpy_function(self.graph, [*chain(*self.outputs.values())])

        def step(**given: Array) -> dict[str, Array]:
            rows = iter(_rows_of(function, given))
            size = len(given["dt"][0])
            return {
                name: np.array([next(rows) for _ in numbers]).reshape(-1, size)
                for name, numbers in self.outputs.items()
            }

        return step

    def initial_state(self, measurement: Measurement) -> Array:
        """Return the state before the first step, bit-identical to C's."""
        t_x = math.nan if measurement.t_x is None else measurement.t_x
        given = {name: np.zeros((size, 1)) for name, size in self.sizes.items()}
        for name, value in measurement._replace(t_x=t_x)._asdict().items():
            given[name] = np.reshape(value, (-1, 1))
        rows = _rows_of(numpy_function(self.graph, self.first), given)
        return np.array(rows).reshape(len(self.first))


def _rows_of(function: Callable[..., Any], given: dict[str, Array]) -> list[Array]:
    return [np.broadcast_to(row, given["dt"][0].shape).astype(float) for row in function(**given)]


def sampled_step(controller: Controller) -> SampledStep:
    """Return one step of a controller.

    x may be lost. If the sweeps that keep learnt numbers within bounds do not converge, learning
    pauses.

    Raises:
        InvalidInputError: The controller cannot be traced.
    """
    task, robot = controller.task, controller.task.robot
    graph, sizes = ExplainedGraph(), laws.argument_sizes(controller)
    given = {name: inputs(graph, name, size) for name, size in sizes.items()}
    given["t_x"] = np.where(given["t_x"] == -math.inf, np.nan, given["t_x"])  # never: not known
    after, answer, left = laws.stepped_from(controller, given)
    p = controller.law.resting
    after[:p] = law.select(left, given["state"][:p], after[:p])
    outputs = {
        "torque": answer.torque, "after": after, "e": answer.e, "gravity": answer.gravity,
        "J_hat": answer.J_hat, "status": answer.status, "limit_status": answer.limit_status,
        "slack": np.where(np.isnan(symbols([answer.slack])), 0.0, answer.slack),
    }  # fmt: skip
    zeros = {"gravity": np.zeros(robot.nv), "J_hat": np.zeros((task.m, robot.nv))}
    flat = {
        name: symbols(zeros[name] if value is None else value).ravel().tolist()
        for name, value in outputs.items()
    }
    first = laws.initial_state(controller, laws.measured(given))
    return SampledStep(graph, flat, controller, sizes, first.tolist())
