"""Programs as NumPy: slow to none of NumPy's speed, and what the others are compared with."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain
from typing import Any

import numpy as np

from approxjac.codegen.trace.program import (
    INFIX,
    STEP,
    Block,
    Going,
    Language,
    Program,
    Rows,
    Writer,
)
from approxjac.codegen.trace.symbols import Graph, Number, Passes
from approxjac.validation import Array

_TEMPLATES = INFIX | {
    "absolute": "np.abs({0})",
    "sqrt": "np.sqrt({0})",
    "floor": "np.floor({0})",
    "power": "(({0}).view(np.int64) << 52).view(np.float64)",
    "not": "~{0}",
    "select": "np.where({0}, {1}, {2})",
}


def _rare(
    _: str, condition: str, lines: list[str], results: list[tuple[str, str, str]]
) -> list[str]:
    chosen = [f"    {name} = np.where({condition}, {a}, {b})" for name, a, b in results]
    return [
        f"    if np.any({condition}):",
        *(f"    {line}" for line in [*lines, *chosen]),
        "    else:",
        *(f"        {name} = {b}" for name, _, b in results),
    ]


def _loop(label: str, loop: Passes, lines: list[str], going: Going, rows: Rows) -> list[str]:
    return [
        f"    s{label}, y{label} = [0.0] * {loop.n}, [0.0] * {loop.times * loop.m}",
        *(f"    s{label}[{at}] = {start}" for at, start, _ in going),
        f"    for i{label} in range({loop.times}):",
        *(f"    {line}" for line in lines),
        *(f"        s{label}[{at}] = {after}" for at, _, after in going),
        *(f"        y{label}[{loop.m} * i{label} + {at}] = {each}" for at, each in rows),
    ]


_LANGUAGE = Language(
    templates=_TEMPLATES,
    variable="v",
    assigned=lambda name, text, _: f"    {name} = {text}",
    read=lambda name, i: f"given[{name!r}][{i}]",
    constant=lambda a: f"np.float64({a!r})".replace("nan", "np.nan").replace("inf", "np.inf"),
    rare=_rare,
    table=lambda name, numbers, _: [f"    {name} = [{', '.join(numbers)}]"],
    loop=_loop,
    cell=lambda name, array, i: [f"    {name} = {array}[{i}]"],
    taken=lambda name, array, i, apart, first: [f"    {name} = {array}[{apart} * {i} + {first}]"],
    number=lambda name, i: [f"    {name} = np.float64({i})"],
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

    def run(
        self, kept: Array, parameters: Array, last: int, every: int, block: Block | None = None
    ) -> None:
        """Take steps, in place.

        Args:
            kept: What is kept, shape (groups, rows, width).
            parameters: What stays, shape (groups, parameters, width).
            last: Number of the last step of all, from 0.
            every: Which steps to record: its multiples, and the last.
            block: Which steps to take; all by default.
        """
        first, times, draws = block or Block.until(last)
        state, given = (np.moveaxis(a, 1, 0).reshape(a.shape[1], -1) for a in (kept, parameters))
        state = state.copy()
        groups, steps, n_draws, width = draws.shape
        drawn = np.moveaxis(draws, 0, 2).reshape(steps, n_draws, groups * width)
        with np.errstate(all="ignore"):
            for k, now, own in zip(range(first, first + len(times)), times, drawn, strict=True):
                self._step(state, given, now, own, k, k % every == 0 or k == last)
        kept[...] = np.moveaxis(state.reshape(len(state), len(kept), -1), 0, 1)

    def _step(
        self, state: Array, given: Array, now: Array, own: Array, k: int, is_recorded: bool
    ) -> None:
        program = self._program
        known = (program.rows, state), (program.parameters, given), (program.draws, own)
        values: dict[str, Any] = {STEP: [np.float64(k)]}
        for places, array in (*known, (program.times, now)):
            values |= {name: array[at : at + size] for name, (at, size) in places.items()}
        goes_to = program.rows.copy()
        for name, (start, size) in program.histories.items():
            at, to = (start + size * int(values[f"{name}.{way}"][0]) for way in ("from", "to"))
            values[name], goes_to[name] = state[at : at + size], (to, size)
        computed = self._function(**values)
        rows = [np.array(np.broadcast_to(row, state.shape[1:])) for row in computed]
        names = [*program.stepped, *(program.recorded if is_recorded else ())]
        for name in names:
            at, size = goes_to[name]
            if size:
                state[at : at + size], rows = rows[:size], rows[size:]
