"""`Program`: what is done in each step of many runs, and what is kept of each from step to step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from approxjac.codegen.trace.symbols import (
    CONDITIONS,
    Graph,
    Number,
    Scalar,
    Symbols,
    inputs,
    symbols,
)
from approxjac.validation import Array

_DUST = 1e-14  # of the largest number, which round-off may leave of one that does not differ
STEP = "k"
"""Name of the input that is the number of the step."""


class Block(NamedTuple):
    """Steps that follow one another, with what is known of each.

    Attributes:
        first: Number of the first one.
        times: What is the same in all runs, shape (steps, times).
        draws: What is drawn for each, shape (groups, steps, draws, width).
    """

    first: int
    times: Array
    draws: Array

    @classmethod
    def until(cls, last: int) -> Block:
        """Return the steps from 0 to a last one, of which nothing is to be known."""
        return cls(0, np.zeros((last + 1, 0)), np.zeros((0, last + 1, 0, 1)))


class Program:
    """Steps of many runs that differ in numbers only, each a column of an array.

    Declare what there is with `kept`, `history`, `given`, `timed` and `drawn`, compute with what
    they return, and say with `step` and `record` what follows.

    Attributes:
        graph: All that is computed.
        rows: Name → place and number of rows of what is kept.
        parameters: Name → place and number of rows of what stays, and differs from run to run.
        histories: Name → place of the first row, and number of rows, of what is read later.
        times: Name → place and number of what is the same in all runs, step by step.
        draws: Name → place and number of what is drawn for each run, step by step.
        stepped: What follows at a step: names and their numbers.
        recorded: What else is kept of steps that are recorded.
    """

    def __init__(self) -> None:
        self.graph = Graph()
        self.rows: dict[str, tuple[int, int]] = {}
        self.parameters: dict[str, tuple[int, int]] = {}
        self.histories: dict[str, tuple[int, int]] = {}
        self.times: dict[str, tuple[int, int]] = {}
        self.draws: dict[str, tuple[int, int]] = {}
        self.stepped: dict[str, list[Number]] = {}
        self.recorded: dict[str, list[Number]] = {}
        self._given: dict[str, tuple[Any, Array]] = {}  # which differ, and the others
        self.n_rows = self.n_parameters = self.n_times = self.n_draws = 0

    def kept(self, name: str, size: int) -> Symbols:
        """Return numbers that are kept from step to step, as they are before it."""
        self.rows[name] = self.n_rows, size
        self.n_rows += size
        return inputs(self.graph, name, size)

    def history(self, name: str, size: int, places: int) -> Symbols:
        """Return numbers from one of several places, as they are there before the step.

        What `step` keeps under this name goes to another one of them. Times decide which, the same
        for all runs: `name.from` and `name.to`, counted from 0.
        """
        self.histories[name] = self.n_rows, size
        self.n_rows += size * places
        for which in ("from", "to"):
            self.timed(f"{name}.{which}", 1)
        return inputs(self.graph, name, size)

    def timed(self, name: str, size: int) -> Symbols:
        """Return numbers that differ from step to step, and are the same in all runs."""
        self.times[name] = self.n_times, size
        self.n_times += size
        return inputs(self.graph, name, size)

    def drawn(self, name: str, size: int) -> Symbols:
        """Return numbers that differ from step to step and from run to run."""
        self.draws[name] = self.n_draws, size
        self.n_draws += size
        return inputs(self.graph, name, size)

    def given(self, name: str, values: Array) -> Symbols:
        """Return numbers that stay as they are in a run.

        Those that are the same in all runs are constants of the program, and cost nothing.

        Args:
            name: Their name.
            values: Their values, shape (N, …).
        """
        flat = values.reshape(len(values), -1)
        differs = (flat != flat[:1]).any(axis=0)
        self._given[name] = differs, flat[0]
        found = symbols(flat[0].tolist())
        if differs.any():
            self.parameters[name] = self.n_parameters, int(differs.sum())
            self.n_parameters += int(differs.sum())
            found[differs] = inputs(self.graph, name, int(differs.sum()))
        return found.reshape(values.shape[1:])

    def filled(self, values: Mapping[str, Array]) -> Array:
        """Return the parameters of some runs, shape (N, n_parameters).

        Args:
            values: Name → what `given` has been given of the runs that it was built for, now of
                these, shape (N, …).

        Raises:
            ValueError: A number differs that was the same in all of those.
        """
        n = len(next(iter(values.values())))
        found = np.empty((n, self.n_parameters))
        for name, each in values.items():
            differs, constants = self._given[name]
            same = np.logical_not(differs)
            flat = each.reshape(n, -1)
            size = np.abs(constants).max(initial=0.0)
            if (np.abs(flat - constants)[:, same] > _DUST * size).any():
                raise ValueError(f"{name} differs from run to run where it did not")
            if name in self.parameters:
                at, size = self.parameters[name]
                found[:, at : at + size] = flat[:, differs]
        return found

    @property
    def k(self) -> Scalar:
        """The number of the step, from 0."""
        return self.graph.input(STEP, 1)[0]

    def step(self, values: Kept) -> None:
        """Say what is kept after a step."""
        self.stepped = _flat(values)

    def record(self, values: Kept) -> None:
        """Say what else is kept of a step that is recorded, of what is known before it."""
        self.recorded = _flat(values)


Kept = Mapping[str, Any]


def _flat(values: Kept) -> dict[str, list[Number]]:
    return {name: symbols(value).ravel().tolist() for name, value in values.items()}


class Language(NamedTuple):
    """Language that straight-line code is written in.

    Attributes:
        templates: Operation → how it is written, with its arguments as {0}, {1} and {2}.
        variable: What names of variables begin with.
        assigned: The line that assigns a text to a name, which is a condition or is not.
        read: The text that reads an input, of its name and its place.
        constant: The text of a number.
        rare: Of a label of the block, its condition, its lines, and for each result its name, what
            it is in the block and what it is elsewhere: the lines of both.
    """

    templates: Mapping[str, str]
    variable: str
    assigned: Callable[[str, str, bool], str]
    read: Callable[[str, int], str]
    constant: Callable[[float], str]
    rare: Callable[[str, str, list[str], list[tuple[str, str, str]]], list[str]]


class Writer:
    """Writes the operations of a graph in a language, each once.

    But what was written in a rare block is not known beyond it: `lines` that need it later have it
    again, under another name.
    """

    def __init__(self, graph: Graph, language: Language) -> None:
        self._graph, self._language = graph, language
        self._names: dict[int, str] = {}
        self._calls, self._again = 0, ""

    def lines(self, wanted: Sequence[Number]) -> tuple[list[str], list[str]]:
        """Return the lines that compute some numbers, and what they are called there."""
        graph, rare = self._graph, self._language.rare
        self._again = f"_{self._calls}" if self._calls else ""
        self._calls += 1
        places = [place for place in graph.needed(wanted) if place not in self._names]
        inside = self._inside(places, wanted)
        lines: list[str] = []
        blocks: dict[int, list[int]] = {}
        for place in places:
            node = graph.nodes[place]
            if place in inside:
                blocks.setdefault(inside[place], []).append(place)
            elif node.operation != "rare":
                lines += self._line(place)
            elif place not in self._names:
                number = node.value
                assert isinstance(number, int)
                own = blocks.pop(number, [])
                results = [
                    each
                    for each in places
                    if graph.nodes[each].operation == "rare" and graph.nodes[each].value == number
                ]
                body = [line for each in own for line in self._line(each)]
                for each in results:
                    self._names[each] = f"{self._language.variable}{each}{self._again}"
                told = []
                for each in results:
                    _, a, b = graph.nodes[each].arguments
                    told.append((self._names[each], self._name(a), self._name(b)))
                label = f"{number}{self._again}"
                lines += rare(label, self._name(node.arguments[0]), body, told)
        for place in inside:
            self._names.pop(place, None)
        return lines, [self._name(graph.place(number)) for number in wanted]

    def _inside(self, places: list[int], wanted: Sequence[Number]) -> dict[int, int]:
        """Return of what only a rare block needs the number of that block."""
        graph = self._graph
        needed_by: dict[int, set[int]] = {place: set() for place in places}
        for number in wanted:
            needed_by.get(graph.place(number), set()).add(0)
        for place in reversed(places):
            operation, arguments, value = graph.nodes[place]
            by = needed_by[place]
            for i, argument in enumerate(arguments):
                if argument in needed_by:
                    if operation == "rare":
                        needed_by[argument].add(value if i == 1 else 0)  # type: ignore[arg-type]
                    else:
                        needed_by[argument] |= by if len(by) == 1 else {0}
        return {
            place: by.pop()
            for place, by in needed_by.items()
            if len(by) == 1 and 0 not in by and graph.nodes[place].operation != "rare"
        }

    def _name(self, place: int) -> str:
        operation, _, value = self._graph.nodes[place]
        if operation == "constant":
            assert isinstance(value, float)
            return self._language.constant(value)
        return self._names[place]

    def _line(self, place: int) -> list[str]:
        operation, arguments, value = self._graph.nodes[place]
        if operation == "constant":
            return []
        language = self._language
        self._names[place] = f"{language.variable}{place}{self._again}"
        if operation == "input":
            assert isinstance(value, tuple)
            text = language.read(*value)
        else:
            text = language.templates[operation].format(*map(self._name, arguments))
        return [language.assigned(self._names[place], text, operation in CONDITIONS)]
