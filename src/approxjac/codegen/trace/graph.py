"""`Graph`: straight-line arithmetic on numbers whose values are not known yet.

`Scalar` stands for one of them. What is done with it is written into its graph, where constants
are folded and equal operations stand once. All operations are those of IEEE 754 that are rounded
correctly (and moves of bits), so that whatever carries them out computes the same bits.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

Number = Any
"""A `Scalar`, or a float: mypy cannot tell which are folded to a float."""
Condition = Any
"""A `Scalar` that is true or false, or a bool."""


class Node(NamedTuple):
    """One operation.

    Attributes:
        operation: One of `OPERATIONS`, "input", "constant" or "rare".
        arguments: Places of its arguments in the graph.
        value: The constant; the name and the place of an input; the number of a rare block.
    """

    operation: str
    arguments: tuple[int, ...] = ()
    value: float | tuple[str, int] | int | None = None


def _select(condition: bool, a: float, b: float) -> float:
    return a if condition else b


def _power(shifted: float) -> float:
    """2**k of k + POWER_SHIFT."""
    return math.ldexp(1.0, int(shifted - POWER_SHIFT))


def _divide(a: float, b: float) -> float:
    if b == 0.0:
        return math.nan if a == 0.0 or math.isnan(a) else math.copysign(math.inf, a * b)
    return a / b


POWER_SHIFT = 1023.0 + 1.5 * 2.0**52
"""Added to an integer k, the last 12 bits of the sum are those of 2**k's exponent."""

OPERATIONS: dict[str, Callable[..., float | bool]] = {
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "divide": _divide,
    "negative": operator.neg,
    "absolute": abs,
    "sqrt": lambda a: math.sqrt(a) if a >= 0.0 else math.nan,
    "floor": lambda a: float(math.floor(a)) if math.isfinite(a) else a,
    "power": _power,
    "less": operator.lt,
    "less_equal": operator.le,
    "equal": operator.eq,
    "and": operator.and_,
    "or": operator.or_,
    "not": operator.not_,
    "select": _select,
}
CONDITIONS = frozenset({"less", "less_equal", "equal", "and", "or", "not"})
"""Operations whose result is true or false."""

_COMMUTES = frozenset({"add", "multiply", "equal", "and", "or"})


class Graph:
    """Operations in an order in which they can be carried out.

    Attributes:
        nodes: The operations.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._known: dict[object, int] = {}
        self._blocks = 0

    def input(self, name: str, size: int) -> list[Scalar]:
        """Return the numbers of an input."""
        return [self._scalar(Node("input", (), (name, i))) for i in range(size)]

    def place(self, number: Number) -> int:
        """Return the place of a number, written down if it is a constant."""
        if isinstance(number, Scalar):
            if number.graph is not self:
                raise ValueError("a number of another graph")
            return number.place
        return self._scalar(Node("constant", (), float(number))).place

    def apply(self, operation: str, *numbers: Number) -> Scalar:
        """Return the result of an operation that is written down."""
        places = tuple(map(self.place, numbers))
        if operation in _COMMUTES:
            places = tuple(sorted(places))
        return self._scalar(Node(operation, places))

    def rare(
        self, condition: Condition, values: Sequence[Number], others: Sequence[Number]
    ) -> list[Number]:
        """Return values where a condition holds, others elsewhere, as `select` does.

        What only the values need is computed where the condition holds in at least one run of a
        vector: so it costs nothing where it never does.
        """
        if not isinstance(condition, Scalar):
            return list(values if condition else others)
        self._blocks += 1
        places = [(self.place(a), self.place(b)) for a, b in zip(values, others, strict=True)]
        return [
            self._scalar(Node("rare", (condition.place, *each), self._blocks)) for each in places
        ]

    def needed(self, numbers: Sequence[Number]) -> list[int]:
        """Return the places of all that some numbers depend on, in order."""
        needed, waiting = set(), [self.place(number) for number in numbers]
        while waiting:
            place = waiting.pop()
            if place not in needed:
                needed.add(place)
                waiting += self.nodes[place].arguments
        return sorted(needed)

    def _scalar(self, node: Node) -> Scalar:
        # 0.0 and −0.0 are equal, and not the same
        key = (*node[:2], repr(node.value)) if node.operation == "constant" else node
        place = self._known.get(key)
        if place is None:
            place = self._known[key] = len(self.nodes)
            self.nodes.append(node)
        return Scalar(self, place)


class Scalar:
    """A number, or a truth value, of a graph."""

    __slots__ = ("graph", "place")

    def __init__(self, graph: Graph, place: int) -> None:
        self.graph = graph
        self.place = place

    def __add__(self, other: Number) -> Number:
        if not isinstance(other, Scalar):
            return self if other == 0.0 else self.graph.apply("add", self, other)
        if (inside := _negated(other)) is not None:
            return self - inside
        if (inside := _negated(self)) is not None:
            return other - inside
        return self.graph.apply("add", self, other)

    __radd__ = __add__

    def __sub__(self, other: Number) -> Number:
        if not isinstance(other, Scalar):
            return self if other == 0.0 else self.graph.apply("subtract", self, other)
        if (inside := _negated(other)) is not None:
            return self + inside
        return self.graph.apply("subtract", self, other)

    def __rsub__(self, other: Number) -> Number:
        return -self if other == 0.0 else self.graph.apply("subtract", other, self)

    def __mul__(self, other: Number) -> Number:
        if not isinstance(other, Scalar):
            if other == 0.0:  # an unknown number is finite: a step that is not is no usual one
                return 0.0
            if other in (1.0, -1.0):
                return self if other == 1.0 else -self
        elif (inside := _negated(other)) is not None:
            return -(self * inside)
        if (inside := _negated(self)) is not None:
            return -(inside * other)
        return self.graph.apply("multiply", self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Number) -> Number:
        if not isinstance(other, Scalar) and other == 1.0:
            return self
        return self.graph.apply("divide", self, other)

    def __rtruediv__(self, other: Number) -> Number:
        return 0.0 if other == 0.0 else self.graph.apply("divide", other, self)

    def __neg__(self) -> Scalar:
        inside = _negated(self)
        return self.graph.apply("negative", self) if inside is None else inside

    def __pos__(self) -> Scalar:
        return self

    def __abs__(self) -> Scalar:
        return self.graph.apply("absolute", self)

    def __pow__(self, exponent: float) -> Number:
        if exponent != int(exponent) or not 1 <= exponent <= 8:
            raise TypeError(f"a power must be an integer from 1 to 8, got {exponent!r}")
        product: Number = self
        for _ in range(int(exponent) - 1):
            product = product * self
        return product

    def __lt__(self, other: Number) -> Scalar:
        return self.graph.apply("less", self, other)

    def __gt__(self, other: Number) -> Scalar:
        return self.graph.apply("less", other, self)

    def __le__(self, other: Number) -> Scalar:
        return self.graph.apply("less_equal", self, other)

    def __ge__(self, other: Number) -> Scalar:
        return self.graph.apply("less_equal", other, self)

    def __eq__(self, other: object) -> Scalar:  # type: ignore[override]
        return self.graph.apply("equal", self, other)

    __hash__ = None  # type: ignore[assignment]

    def __and__(self, other: Condition) -> Condition:
        if isinstance(other, Scalar):
            return self.graph.apply("and", self, other)
        return self if other else False

    __rand__ = __and__

    def __or__(self, other: Condition) -> Condition:
        if isinstance(other, Scalar):
            return self.graph.apply("or", self, other)
        return True if other else self

    __ror__ = __or__

    def __invert__(self) -> Scalar:
        return self.graph.apply("not", self)

    def __bool__(self) -> bool:
        raise TypeError("no branch on a number that is not known yet: choose with np.where")

    __float__ = __int__ = __bool__

    def __array_ufunc__(self, *arguments: Any, **options: Any) -> Any:
        from approxjac.codegen.trace.symbols import apply  # which has arrays of these

        return apply(*arguments, **options)

    def __array_function__(self, function: Any, types: Any, arguments: Any, options: Any) -> Any:
        from approxjac.codegen.trace.symbols import choose

        return choose(*arguments) if function is np.where else NotImplemented

    def choose(self, then: Callable[[], Any], otherwise: Callable[[], Any]) -> Any:
        """Return what `law.choose` does; `then` costs nothing where it never holds."""
        from approxjac.codegen.trace.symbols import chosen

        return chosen(self, then(), otherwise())

    def sqrt(self) -> Scalar:
        """Return √a."""
        return self.graph.apply("sqrt", self)

    def floor(self) -> Scalar:
        """Return the largest integer that is at most a."""
        return self.graph.apply("floor", self)

    def __repr__(self) -> str:
        return f"Scalar({self.place}: {self.graph.nodes[self.place]})"


def select(condition: Condition, a: Number, b: Number) -> Number:
    """Return a where a condition holds, b elsewhere."""
    if not isinstance(condition, Scalar):
        return a if condition else b
    if a is b:
        return a
    if _is_condition(a) or _is_condition(b):
        return (condition & a) | (~condition & b)
    return condition.graph.apply("select", condition, a, b)


def _is_condition(number: Number) -> bool:
    if isinstance(number, Scalar):
        return number.graph.nodes[number.place].operation in CONDITIONS
    return isinstance(number, bool | np.bool_)


def _negated(number: Scalar) -> Scalar | None:
    """Return b of a = −b, or None."""
    node = number.graph.nodes[number.place]
    return Scalar(number.graph, node.arguments[0]) if node.operation == "negative" else None
