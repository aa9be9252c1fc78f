"""`Program`: what is done in each step of many runs, and what is kept of each from step to step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from approxjac.validation import Array

from approxjac.codegen.graph import CONDITIONS, Graph, Number, Scalar
from approxjac.codegen.symbols import Symbols, inputs, symbols

STEP = "k"
"""Name of the input that is the number of the step."""


class Program:
    """Steps of many runs that differ in numbers only, each a column of an array.

    Declare what is kept with `kept`, `ring` and `given`, compute with what they return, and say
    with `step` and `record` what follows.

    Attributes:
        graph: All that is computed.
        rows: Name → place and number of rows of what is kept.
        parameters: Name → place and number of rows of what stays.
        rings: Name → place, number of rows and number of steps of what arrives late.
        usual: What follows at a step: names and their numbers.
        unusual: Whether that does not hold for a step, and `complete` has to be taken.
        complete: What follows at any step; to the last bit what `usual` says where that holds.
        recorded: What else is kept of steps that are recorded.
    """

    def __init__(self) -> None:
        self.graph = Graph()
        self.rows: dict[str, tuple[int, int]] = {}
        self.parameters: dict[str, tuple[int, int]] = {}
        self.rings: dict[str, tuple[int, int, int]] = {}
        self.usual: dict[str, list[Number]] = {}
        self.unusual: Scalar | bool = False
        self.complete: dict[str, list[Number]] = {}
        self.recorded: dict[str, list[Number]] = {}
        self.n_rows = 0
        self.n_parameters = 0

    def kept(self, name: str, size: int) -> Symbols:
        """Return numbers that are kept from step to step, as they are before it."""
        self.rows[name] = self.n_rows, size
        self.n_rows += size
        return inputs(self.graph, name, size)

    def ring(self, name: str, size: int, steps: int) -> Symbols:
        """Return numbers as they were kept some steps ago; what is kept now arrives later."""
        self.rings[name] = self.n_rows, size, steps
        self.n_rows += size * steps
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
        found = symbols(flat[0].tolist())
        if differs.any():
            self.parameters[name] = self.n_parameters, int(differs.sum())
            self.n_parameters += int(differs.sum())
            found[differs] = inputs(self.graph, name, int(differs.sum()))
        return found.reshape(values.shape[1:])

    @property
    def k(self) -> Scalar:
        """The number of the step, from 0."""
        return self.graph.input(STEP, 1)[0]

    def step(self, unusual: Scalar | bool, usual: Kept, complete: Kept) -> None:
        """Say what is kept after a step, and when the one that takes less time may be taken."""
        self.unusual, self.usual, self.complete = unusual, _flat(usual), _flat(complete)

    def record(self, values: Kept) -> None:
        """Say what else is kept of a step that is recorded, of what is known before it."""
        self.recorded = _flat(values)


Kept = Mapping[str, Any]


def _flat(values: Kept) -> dict[str, list[Number]]:
    return {name: symbols(value).ravel().tolist() for name, value in values.items()}


Templates = Mapping[str, str]


def statements(
    graph: Graph,
    wanted: list[Number],
    templates: Templates,
    assignment: Callable[[str, str, bool], str],
    variable: str,
    of_input: Callable[[str, int], str],
    of_constant: Callable[[float], str],
    names: dict[int, str],
) -> tuple[list[str], list[str]]:
    """Return the lines that compute some numbers, and what they are called there.

    Args:
        graph: What to compute.
        wanted: The numbers.
        templates: Operation → how it is written, with its arguments as {0}, {1} and {2}.
        assignment: Of a name, what is assigned to it, and whether that is a condition.
        variable: What names of variables begin with.
        of_input: How an input is read.
        of_constant: How a constant is written.
        names: Place in the graph → what is computed already is called; the others are added.
    """
    lines = []
    for place in graph.needed(wanted):
        if place in names:
            continue
        operation, arguments, value = graph.nodes[place]
        if operation == "constant":
            assert isinstance(value, float)
            names[place] = of_constant(value)
            continue
        names[place] = f"{variable}{place}"
        if operation == "input":
            assert isinstance(value, tuple)
            text = of_input(*value)
        else:
            text = templates[operation].format(*(names[each] for each in arguments))
        lines.append(assignment(names[place], text, operation in CONDITIONS))
    return lines, [names[graph.place(number)] for number in wanted]
