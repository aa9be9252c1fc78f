"""A graph on NumPy's arrays, operation by operation: the reference for other backends."""

from collections.abc import Callable
from typing import Any

import numpy as np

from approxjac.codegen.trace.program import Schedule, Scope
from approxjac.codegen.trace.symbols import FAR, Graph, Number

_OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "subtract": np.subtract,
    "multiply": np.multiply,
    "divide": np.divide,
    "negative": np.negative,
    "absolute": np.abs,
    "sqrt": np.sqrt,
    "far": lambda a: a + FAR,
    "power": lambda a: (np.asarray(a).view(np.int64) << 52).view(np.float64),
    "less": np.less,
    "less_equal": np.less_equal,
    "equal": np.equal,
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
    "select": np.where,
}


def numpy_function(graph: Graph, outputs: list[Number]) -> Callable[..., list[Any]]:
    """Return a function of inputs by their names, each a list of arrays (N,), of these outputs."""
    wanted = [graph.place(number) for number in outputs]
    schedule = Schedule(graph, wanted)

    def function(**given: Any) -> list[Any]:
        run = _Run(graph, schedule, given)
        with np.errstate(all="ignore"):
            run.carry_out(schedule.whole)
        return [run.values[place] for place in wanted]

    return function


class _Run:
    """An evaluation of a graph for some inputs."""

    def __init__(self, graph: Graph, schedule: Schedule, given: dict[str, Any]) -> None:
        self._nodes, self._schedule, self._given = graph.nodes, schedule, given
        self._passes: dict[int, tuple[Any, list[Any]]] = {}  # number and state of running loops
        self.values: dict[int, Any] = {
            place: np.float64(graph.nodes[place].value)
            for place in schedule.places
            if graph.nodes[place].operation == "constant"
        }

    def carry_out(self, region: Scope) -> None:
        """Evaluate a scope."""
        values = self.values
        for place in region.places:
            operation, arguments, value = self._nodes[place]
            if function := _OPERATIONS.get(operation):
                values[place] = function(*[values[each] for each in arguments])
            elif operation == "input":
                values[place] = self._given[value[0]][value[1]]
            elif operation == "rare":
                condition, then, otherwise = arguments
                if not np.any(values[condition]):
                    values[place] = values[otherwise]
                    continue
                if place == self._schedule.results[value][0]:
                    self.carry_out(self._schedule.inside["rare", value])
                values[place] = np.where(values[condition], values[then], values[otherwise])
            elif operation == "loop":
                values[place] = self._looped(place)
            elif operation == "table":
                values[place] = [values[each] for each in arguments]
            elif operation == "cell":
                values[place] = self._array(arguments[0])[value]
            else:
                i, _ = self._passes[self._nodes[arguments[1]].value]
                values[place] = self._array(arguments[0])[value[0] * i + value[1]]

    def _array(self, place: int) -> list[Any]:
        operation, _, value = self._nodes[place]
        return self._passes[value][1] if operation == "state" else self.values[place]

    def _looped(self, place: int) -> list[Any]:
        _, arguments, (number, times, n, m) = self._nodes[place]
        parts, values, rows = self._schedule.parts[place], self.values, []
        state = [values[arguments[part]] if part in parts else None for part in range(n)]
        for i in range(times):
            self._passes[number] = i, state
            for each in self._schedule.indices.get(number, ()):
                values[each] = np.float64(i)
            self.carry_out(self._schedule.inside["loop", place])
            after = {part: values[arguments[n + part]] for part in parts}
            state, row = ([after.get(a + j) for j in range(k)] for a, k in ((0, n), (n, m)))
            rows += row
        return state + rows
