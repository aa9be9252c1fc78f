"""`Program`: the operations of a step of many runs, and their memory from step to step."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from approxjac.codegen.trace.symbols import (
    CONDITIONS,
    Graph,
    Number,
    Passes,
    Scalar,
    Symbols,
    inputs,
    symbols,
)
from approxjac.validation import Array

_DUST = 1e-14  # of the largest number, which round-off may leave of one that does not differ
STEP, RECORDED = "k", "recorded"
"""Names of the step's number, and of the number that is 1.0 in recorded steps."""


class Block(NamedTuple):
    """Consecutive steps, with the numbers that are known beforehand."""

    first: int  # number of the first one
    times: Array  # numbers that all runs share, shape (steps, times)
    draws: Array  # random numbers of each run, shape (groups, steps, draws, width)

    @classmethod
    def plain(cls, steps: int = 1) -> Block:
        """Return some steps from 0 on, without such numbers."""
        return cls(0, np.zeros((steps, 0)), np.zeros((0, steps, 0, 1)))


class Program:
    """Steps of many runs that differ in numbers only, each a column of an array.

    Declare inputs with `kept`, `history`, `given`, `timed` and `drawn`, compute with the symbols
    that they return, and set the outputs with `step` and `record`.

    The dictionaries have name → first index, from 0, and size: in rows of kept numbers and of
    parameters, in numbers of times and of draws; for a history the size is that of one place.
    """

    def __init__(self) -> None:
        self.graph = Graph()
        self.rows: dict[str, tuple[int, int]] = {}  # kept from step to step
        self.parameters: dict[str, tuple[int, int]] = {}  # which differ from run to run
        self.histories: dict[str, tuple[int, int]] = {}  # rows that are read later
        self.times: dict[str, tuple[int, int]] = {}  # the same in all runs, step by step
        self.draws: dict[str, tuple[int, int]] = {}  # for each run, step by step
        self.stepped: dict[str, list[Number]] = {}  # name → its numbers after a step
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
        """Return numbers that stay as they are in a run, with values (N, …) in N of them.

        Those that are the same in all runs are constants of the program, and cost nothing.
        """
        flat = values.reshape(len(values), -1)
        differs = (flat != flat[:1]).any(axis=0)
        self._given[name] = differs, flat[0]
        numbers = symbols(flat[0].tolist())
        if size := int(differs.sum()):
            self.parameters[name] = self.n_parameters, size
            self.n_parameters += size
            numbers[differs] = inputs(self.graph, name, size)
        return numbers.reshape(values.shape[1:])

    def filled(self, values: Mapping[str, Array]) -> Array:
        """Return the parameters of N runs, (N, n_parameters), from values by name as of `given`.

        Raises:
            ValueError: A number differs that was the same in all of those.
        """
        n = len(next(iter(values.values())))
        rows = np.empty((n, self.n_parameters))
        for name, each in values.items():
            differs, constants = self._given[name]
            same = np.logical_not(differs)
            flat = each.reshape(n, -1)
            size = np.abs(constants).max(initial=0.0)
            if (np.abs(flat - constants)[:, same] > _DUST * size).any():
                raise ValueError(f"{name} differs from run to run where it did not")
            if name in self.parameters:
                at, size = self.parameters[name]
                rows[:, at : at + size] = flat[:, differs]
        return rows

    @property
    def before(self) -> list[int]:
        """Places of the numbers that those of `step` replace; −1 where they do not."""
        before = []
        for name, numbers in self.stepped.items():
            kept = self.graph.input(name, len(numbers))
            before += [-1 if name in self.histories else each.place for each in kept]
        return before

    @property
    def k(self) -> Scalar:
        """The number of the step, from 0."""
        return self.graph.input(STEP, 1)[0]

    def step(self, values: Mapping[str, Any]) -> None:
        """Declare the numbers kept after a step; those not kept before it are outputs."""
        for name, value in values.items():
            numbers = symbols(value).ravel().tolist()
            if name not in self.rows and name not in self.histories:
                self.kept(name, len(numbers))
            self.stepped[name] = numbers

    def record(self, values: Mapping[str, Number]) -> None:
        """Declare the numbers that change in recorded steps, from those known before the step.

        A time, `RECORDED`, says which steps are: 1.0 of those. Of others they stay as they are.
        """
        is_due = self.timed(RECORDED, 1)[0] > 0.0
        before = [self.graph.input(name, 1)[0] for name in values]
        after = self.graph.rare(is_due, [*values.values()], before)
        self.step(dict(zip(values, after, strict=True)))


Going = list[tuple[int, str, str]]
"""Of each number that goes from pass to pass its place, its start, and what follows it."""
Rows = list[tuple[int, str]]  # of each number that is collected its place, and what it is


class Language(NamedTuple):
    """Language that code is written in.

    Lines of a block come without its indentation, which the language adds. In front of the label of
    a loop, s is the name of what goes from pass to pass, y of what is collected, and i of the
    number of the pass. The name of a table is t and a number.
    """

    templates: Mapping[str, str]  # operation → how it is written, with arguments {0}, {1}, {2}
    variable: str  # the beginning of names of variables
    # the line that assigns a text to a name, which is a condition or is not
    assigned: Callable[[str, str, bool], str]
    read: Callable[[str, int], str]  # the text of an input, of its name and its place
    constant: Callable[[float], str]
    # lines of a rare block: from its label, its condition, its lines, and for each result its name,
    # its value in the block and its value elsewhere
    rare: Callable[[str, str, list[str], list[tuple[str, str, str]]], list[str]]
    # lines that make an array: from its name, its numbers, and True if these are constants
    table: Callable[[str, list[str], bool], list[str]]
    loop: Callable[[str, Passes, list[str], Going, Rows], list[str]]
    cell: Callable[[str, str, int], list[str]]  # lines that read a place of an array
    # lines that read the cell of a pass: from a name, an array, i, the distance of cells, the first
    taken: Callable[[str, str, str, int, int], list[str]]
    number: Callable[[str, str], list[str]]  # lines that make i a number
    # lines in a rare block that write a wanted number in place: from its index, its name and value,
    # the block's condition, and one under which it stays all the same
    changed: Callable[[int, str, str, str, str | None], list[str]] = lambda *_: []


class Scope:
    """Lines that run under the same conditions: all, those of a rare block, those of a loop."""

    def __init__(self, parent: Scope | None = None, loop: int | None = None) -> None:
        self.parent, self.loop = parent, loop
        self.depth: int = 0 if parent is None else parent.depth + 1
        self.places: list[int] = []

    def shared(self, other: Scope | None) -> Scope:
        """Return the innermost scope that contains both."""
        a, b = self, self if other is None else other
        while a is not b:
            if a.depth < b.depth:
                a, b = b, a
            assert a.parent is not None
            a = a.parent
        return a

    def before_loops(self, needed: frozenset[int]) -> Scope:
        """Return the scope for a result that depends on some loops: outside all other loops."""
        scope = region = self
        while region.parent is not None and region.loop not in needed:
            if region.loop is not None:
                scope = region.parent
            region = region.parent
        return scope


class Schedule:
    """A schedule of operations: each is computed as rarely as possible, and then as late."""

    def __init__(self, graph: Graph, wanted: list[int], before: Sequence[int] = ()) -> None:
        self._nodes = nodes = graph.nodes
        # result of a rare block that else is as `before` → which wanted number it is, and a
        # condition under which it stays as before all the same, if there is one
        self.changes: dict[int, tuple[int, int | None]] = {}
        self._read: set[int] = set()  # numbers before these that something else needs, too
        wanted = self._in_place(graph, wanted, before)
        # all that is computed, in order, and what of each loop is needed
        needed = [*wanted, *(each for _, each in self.changes.values() if each is not None)]
        self.places, self.parts = places, parts = graph.reached(needed)
        self.whole = Scope()  # operations that are always computed
        # place of a loop, or number of a rare block → its scope
        self.inside: dict[tuple[str, int], Scope] = {}
        # number of a loop → the place of its passes' number, where that is computed with
        self.indices: dict[int, set[int]] = {}
        for place in places:
            for each in nodes[place].arguments:
                if nodes[each].operation == "index" and nodes[place].operation != "take":
                    self.indices.setdefault(nodes[each].value, set()).add(each)
        needs = self._needs()
        users: dict[int, Scope] = {}
        of_blocks: dict[int, Scope] = {}  # who needs any of their results
        self.results: dict[int, list[int]] = {}  # number of a rare block → places of its results
        for place in places:
            if nodes[place].operation == "rare":
                self.results.setdefault(nodes[place].value, []).append(place)

        def use(place: int, region: Scope) -> None:
            other = users.get(place)
            if other is not region:
                users[place] = region.shared(other)

        for place in wanted:
            use(place, self.whole)
        for place in reversed(places):
            operation, arguments, value = nodes[place]
            if operation in ("constant", "state", "index") or place not in users:
                continue  # the latter of what is only kept in its place
            region = users[place].before_loops(needs[place])
            if operation == "rare":
                results = self.results[value]
                region = of_blocks[value] = region.shared(of_blocks.get(value))
                if place != results[0]:
                    continue
                region = region.before_loops(frozenset().union(*(needs[each] for each in results)))
                inside = self.inside["rare", value] = Scope(region)
                region.places += results
                for each in results:
                    condition, a, b = nodes[each].arguments
                    use(condition, region)
                    use(a, inside)
                    if each not in self.changes:
                        use(b, region)
                        continue
                    if b in self._read:  # before it is written
                        use(b, inside)
                    if (keeps := self.changes[each][1]) is not None:
                        use(keeps, inside)
            elif operation == "loop":
                region.places.append(place)
                inside = self.inside["loop", place] = Scope(region, value.number)
                for part in parts[place]:
                    use(arguments[value.n + part], inside)
                    if part < value.n:
                        use(arguments[part], region)
            else:
                region.places.append(place)
                for each in arguments:
                    use(each, region)
        for region in (self.whole, *self.inside.values()):
            region.places.sort()

    def _in_place(self, graph: Graph, wanted: list[int], before: Sequence[int]) -> list[int]:
        """Return the results wanted; one that only a rare block changes is a result of it."""
        nodes, (places, _) = self._nodes, graph.reached(wanted)
        uses = Counter(chain(wanted, *(nodes[place].arguments for place in places)))
        first: dict[int, int] = {}  # number of a rare block → its first result
        for place in places:
            if nodes[place].operation == "rare":
                first.setdefault(nodes[place].value, place)

        def is_own(place: int, operation: str) -> bool:
            return operation == "rare" and uses[place] == 1

        result = [*wanted]
        for i, was in enumerate(before):
            place, keeps = wanted[i], None
            operation, arguments, block = nodes[place]
            if is_own(place, operation) and arguments[1] == was:  # a later block takes it back
                changed = arguments[2]
                operation, others, block = nodes[changed]
                if is_own(changed, operation) and arguments[0] < first[block]:
                    place, keeps, arguments = changed, arguments[0], others
            if is_own(place, operation) and arguments[2] == was < first[block]:
                result[i] = place
                self.changes[place] = i, keeps
                if uses[was] > (1 if keeps is None else 2):
                    self._read.add(was)
        return result

    def _needs(self) -> dict[int, frozenset[int]]:
        """Return for each operation the loops whose passes it differs between."""
        needs: dict[int, frozenset[int]] = {}
        nothing: frozenset[int] = frozenset()
        for place in self.places:
            operation, arguments, value = self._nodes[place]
            if operation in ("state", "index"):
                needs[place] = frozenset([value])
                continue
            if operation == "loop":
                own = self.parts[place]
                starts = [arguments[part] for part in own if part < value.n]
                arguments = (*starts, *(arguments[value.n + part] for part in own))
            loops = nothing
            for each in arguments:
                if needs[each]:  # which few do
                    loops = loops | needs[each]
            needs[place] = loops - {value.number} if operation == "loop" else loops
        return needs


class Writer:
    """Writes the operations of a graph in a language, each once."""

    def __init__(self, graph: Graph, language: Language) -> None:
        self._graph, self._language = graph, language
        self._names: dict[int, str] = {}
        self._labels: dict[int, str] = {}  # of tables and loops
        self._running: dict[int, str] = {}  # number of a loop → its label

    def lines(
        self, wanted: Sequence[Number], before: Sequence[int] = ()
    ) -> tuple[list[str], list[str]]:
        """Return the lines that compute some numbers, and the names of these.

        `before` are the places of numbers that they replace. Where only a rare block changes one,
        the block writes it in place, and its name is empty.
        """
        graph = self._graph
        roots = [graph.place(number) for number in wanted]
        self._schedule = schedule = Schedule(graph, roots, before)
        lines, in_place = self._region(schedule.whole), {i for i, _ in schedule.changes.values()}
        return lines, ["" if i in in_place else self._name(each) for i, each in enumerate(roots)]

    def _region(self, region: Scope) -> list[str]:
        nodes, language, lines = self._graph.nodes, self._language, []
        for place in region.places:
            operation, arguments, value = nodes[place]
            if operation == "rare":
                if place == self._schedule.results[value][0]:
                    lines += self._rare(value)
            elif operation == "loop":
                lines += self._loop(place)
            elif operation == "table":
                self._labels[place] = label = f"t{place}"
                constant = all(nodes[each].operation == "constant" for each in arguments)
                lines += language.table(label, list(map(self._name, arguments)), constant)
            elif operation != "constant":
                lines += self._line(place)
        return lines

    def _rare(self, block: int) -> list[str]:
        results = self._schedule.results[block]
        condition = self._graph.nodes[results[0]].arguments[0]
        body, choices, names = self._region(self._schedule.inside["rare", block]), [], {}
        for place in results:
            _, then, otherwise = self._graph.nodes[place].arguments
            name = f"{self._language.variable}{place}"
            if place in self._schedule.changes:
                i, keeps = self._schedule.changes[place]
                kept = None if keeps is None else self._name(keeps)
                own = i, name, self._name(then), self._name(condition), kept
                body += self._language.changed(*own)
            else:
                choices.append((name, self._name(then), self._name(otherwise)))
                names[place] = name
        self._names |= names
        return self._language.rare(str(block), self._name(condition), body, choices)

    def _loop(self, place: int) -> list[str]:
        _, arguments, loop = self._graph.nodes[place]
        self._labels[place] = self._running[loop.number] = label = str(loop.number)
        lines: list[str] = []
        for index in self._schedule.indices.get(loop.number, ()):
            self._names[index] = name = f"{self._language.variable}{index}"
            lines += self._language.number(name, f"i{label}")
        lines += self._region(self._schedule.inside["loop", place])
        after = [
            (part, self._name(arguments[loop.n + part]))
            for part in sorted(self._schedule.parts[place])
        ]
        kept = [(part, self._name(arguments[part]), name) for part, name in after if part < loop.n]
        rows = [(part - loop.n, name) for part, name in after if part >= loop.n]
        return self._language.loop(label, loop, lines, kept, rows)

    def _array(self, memory: int, at: int) -> tuple[str, int]:
        """Return the name of an array of a graph, and the index of one of its places."""
        operation, _, value = self._graph.nodes[memory]
        if operation == "state":
            return f"s{self._running[value]}", at
        label = self._labels[memory]
        if operation == "table":
            return label, at
        return (f"s{label}", at) if at < value.n else (f"y{label}", at - value.n)

    def _name(self, place: int) -> str:
        operation, _, value = self._graph.nodes[place]
        return self._language.constant(value) if operation == "constant" else self._names[place]

    def _line(self, place: int) -> list[str]:
        operation, arguments, value = self._graph.nodes[place]
        language = self._language
        self._names[place] = name = f"{language.variable}{place}"
        if operation == "input":
            text = language.read(*value)
        elif operation == "cell":
            return language.cell(name, *self._array(arguments[0], value))
        elif operation == "take":
            apart, first = value
            index = f"i{self._running[self._graph.nodes[arguments[1]].value]}"
            array, first = self._array(arguments[0], first)
            return language.taken(name, array, index, apart, first)
        else:
            text = language.templates[operation].format(*map(self._name, arguments))
        return [language.assigned(name, text, operation in CONDITIONS)]
