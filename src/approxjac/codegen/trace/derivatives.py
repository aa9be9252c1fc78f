"""Derivatives of a graph's results, by forward differentiation."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from approxjac.codegen.trace.symbols import CONDITIONS, Number, Scalar, Symbols, select, symbols

_STEPS = frozenset({"far", "power", *CONDITIONS})  # constant from step to step
# rate of an operation's result c, of its arguments a and their rates d
_RULES: dict[str, Callable[[Number, list[Number], list[Number]], Number]] = {
    "add": lambda c, a, d: d[0] + d[1],
    "subtract": lambda c, a, d: d[0] - d[1],
    "multiply": lambda c, a, d: a[0] * d[1] + d[0] * a[1],
    "divide": lambda c, a, d: (d[0] - c * d[1]) / a[1],
    "negative": lambda c, a, d: -d[0],
    "absolute": lambda c, a, d: select(a[0] < 0.0, -d[0], d[0]),
    "sqrt": lambda c, a, d: d[0] / (2.0 * c),
    "select": lambda c, a, d: select(a[0], d[1], d[2]),
    "rare": lambda c, a, d: select(a[0], d[1], d[2]),
}


def rates(of: Symbols, seeds: Sequence[tuple[Scalar, Number]]) -> Symbols:
    """Return the rates of an array of symbols, shape as it, where some inputs have rates.

    Raises:
        TypeError: A result is computed in a loop.
    """
    numbers = np.ravel(of).tolist()
    rate_of: dict[int, Any] = {each.place: rate for each, rate in seeds}
    graph = next(each.graph for each, _ in seeds)

    def known(place: int) -> Number:
        node = graph.nodes[place]
        return node.value if node.operation == "constant" else Scalar(graph, place)

    for place in graph.needed(numbers):
        operation, arguments, _ = graph.nodes[place]
        if operation in _STEPS or not any(each in rate_of for each in arguments):
            continue
        if operation not in _RULES:
            raise TypeError(f"no derivative of a loop, such as {operation!r}")
        own = [rate_of.get(each, 0.0) for each in arguments]
        rate_of[place] = _RULES[operation](known(place), [*map(known, arguments)], own)
    of_each = [
        rate_of.get(each.place, 0.0) if isinstance(each, Scalar) else 0.0 for each in numbers
    ]
    return symbols(of_each).reshape(np.shape(of))
