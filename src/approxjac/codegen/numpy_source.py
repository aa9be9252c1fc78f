"""Programs as NumPy: slow to none of NumPy's speed, and what the others are compared with."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain
from typing import Any

import numpy as np

from approxjac.codegen.graph import Graph, Number
from approxjac.codegen.program import STEP, Language, Program, Writer
from approxjac.validation import Array

_TEMPLATES = {
    "add": "{0} + {1}",
    "subtract": "{0} - {1}",
    "multiply": "{0} * {1}",
    "divide": "{0} / {1}",
    "negative": "-{0}",
    "absolute": "np.abs({0})",
    "sqrt": "np.sqrt({0})",
    "floor": "np.floor({0})",
    "power": "(({0}).view(np.int64) << 52).view(np.float64)",
    "less": "{0} < {1}",
    "less_equal": "{0} <= {1}",
    "equal": "{0} == {1}",
    "and": "{0} & {1}",
    "or": "{0} | {1}",
    "not": "~{0}",
    "select": "np.where({0}, {1}, {2})",
}


_LANGUAGE = Language(
    _TEMPLATES,
    "v",
    lambda name, text, _: f"    {name} = {text}",
    lambda name, i: f"given[{name!r}][{i}]",
    lambda value: f"np.float64({value!r})".replace("nan", "np.nan").replace("inf", "np.inf"),
    lambda _, condition, lines, results: [
        *lines,
        *(f"    {name} = np.where({condition}, {a}, {b})" for name, a, b in results),
    ],
)


def numpy_function(graph: Graph, outputs: list[Number]) -> Callable[..., list[Any]]:
    """Return a function of inputs by their names, each a list of arrays (N,), of these outputs."""
    lines, names = Writer(graph, _LANGUAGE).lines(outputs)
    source = "\n".join(["def function(**given):", *lines, f"    return [{', '.join(names)}]"])
    scope: dict[str, Any] = {"np": np}
    exec(compile(source, "<codegen>", "exec"), scope)
    return scope["function"]  # type: ignore[no-any-return]


class NumpyLanes:
    """A program that NumPy carries out, all runs at once."""

    width = 1

    def __init__(self, program: Program) -> None:
        self._program = program
        numbers = chain(*program.stepped.values(), *program.recorded.values())
        self._function = numpy_function(program.graph, list(numbers))

    def run(self, kept: Array, parameters: Array, last: int, every: int) -> None:
        """Take all steps, in place.

        Args:
            kept: What is kept, shape (groups, rows, width).
            parameters: What stays, shape (groups, parameters, width).
            last: Number of the last step, from 0.
            every: Which steps to record: its multiples, and the last.
        """
        state, given = (np.moveaxis(a, 1, 0).reshape(a.shape[1], -1) for a in (kept, parameters))
        state = state.copy()
        with np.errstate(all="ignore"):
            for k in range(last + 1):
                self._step(state, given, k, is_recorded=k % every == 0 or k == last)
        kept[...] = np.moveaxis(state.reshape(len(state), len(kept), -1), 0, 1)

    def _step(self, state: Array, given: Array, k: int, is_recorded: bool) -> None:
        program = self._program
        places = dict(program.rows)
        places |= {
            name: (at + size * (k % steps), size)
            for name, (at, size, steps) in program.rings.items()
        }
        values: dict[str, Any] = {name: state[at : at + n] for name, (at, n) in places.items()}
        values |= {name: given[at : at + n] for name, (at, n) in program.parameters.items()}
        computed = self._function(**values | {STEP: [np.float64(k)]})
        rows = [np.array(np.broadcast_to(row, state.shape[1:])) for row in computed]
        names = [*program.stepped, *(program.recorded if is_recorded else ())]
        for name in names:
            at, size = places[name]
            if size:
                state[at : at + size], rows = rows[:size], rows[size:]
