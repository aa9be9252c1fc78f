"""Symbols for numbers, arrays of them, and the graph of operations on them.

`Scalar` stands for a number, `SymbolArray` for an array, which the functions of `law` accept like
NumPy's. Operations on them are recorded in their `Graph`, where constants are folded and equal
operations are shared. All operations are correctly rounded ones of IEEE 754 (and moves of bits), so
that all backends compute the same bits. Sine and cosine, tanh and exp, whose last bits differ from
machine to machine, are made of those: sine and cosine within two units of the last place, tanh
within four.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.law import products
from approxjac.law.branches import collected
from approxjac.law.factors import Factors

Number = Any  # a `Scalar`, or a float: mypy cannot tell which are folded to a float
Condition = Any  # a `Scalar` that is true or false, or a bool


class Node(NamedTuple):
    """One operation.

    It is arithmetic, as backends' templates have it, "input", "constant" or "rare"; or of loops an
    array ("table" of numbers, "state" before a pass, "loop" after the last, where what was
    collected follows in its order), "index", "cell" or "take".
    """

    operation: str
    arguments: tuple[int, ...] = ()  # their places in the graph
    # The constant; name and place of an input; number of a rare block; a `Passes`; number of the
    # loop of an index or a state; which cell; how far cells are apart, and the first, of a take.
    value: Any = None


class Passes(NamedTuple):
    """Number of passes of a loop, and of the numbers that it keeps.

    Its arguments are its start, what follows it, and what is collected, in each pass.
    """

    number: int  # of the loop
    times: int
    n: int  # go from pass to pass
    m: int  # are collected in each


FAR = 1.5 * 2.0**52  # added to a number up to 2⁵¹, it leaves an integer next to that
POWER_SHIFT = 1023.0 + FAR
"""Added to an integer k, the last 12 bits of the sum are those of 2**k's exponent."""

CONDITIONS = frozenset({"less", "less_equal", "equal", "and", "or", "not"})
"""Operations whose result is true or false."""

_COMMUTES = frozenset({"add", "multiply", "equal", "and", "or"})


class Graph:
    """Operations in an order of execution.

    If `is_finite`, all numbers are assumed to be finite, without checks. Results are invalid where
    `left` is True.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.is_finite = False
        self.arms: list[Any] = []  # whose terms are computed, each with the robot that it is
        self.left: Condition = False
        self._known: dict[object, int] = {}
        self._blocks = self._loops = 0
        self._running: list[int] = []  # loops whose body is being written down
        self._ends: dict[int, int] = {}  # number of a loop → its place

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
        places = tuple([
            each.place if type(each) is Scalar and each.graph is self else self.place(each)
            for each in numbers
        ])  # fmt: skip
        if operation in _COMMUTES and places[0] > places[1]:
            places = places[::-1]
        return self._scalar(Node(operation, places))

    def rare(
        self, condition: Scalar, values: Sequence[Number], others: Sequence[Number]
    ) -> list[Number]:
        """Return values where a condition holds, others elsewhere, as `select` does.

        What only the values need is computed where the condition holds in at least one run of a
        vector: so it costs nothing where it never does.
        """
        self._blocks += 1
        places = [(self.place(a), self.place(b)) for a, b in zip(values, others, strict=True)]
        return [
            other if a == b else self._scalar(Node("rare", (condition.place, a, b), self._blocks))
            for (a, b), other in zip(places, others, strict=True)
        ]

    def loop(
        self,
        count: int,
        start: Sequence[Number],
        body: Callable[[Scalar, list[Number]], tuple[Sequence[Number], Sequence[Number]]],
    ) -> tuple[list[Number], list[list[Number]]]:
        """Return some numbers after a loop, and those that it collected, pass by pass.

        Args:
            count: Number of passes of the body, ≥ 1.
            start: The numbers before it.
            body: Of the number of the pass, from 0, and the numbers before it; returns those after
                it, and what is collected.
        """
        self._loops = number = self._loops + 1
        self._running.append(number)
        state = self._scalar(Node("state", (), number))
        before = [self._cell(state, i) for i in range(len(start))]
        after, collected = body(self._scalar(Node("index", (), number)), list(before))
        self._running.remove(number)
        places = tuple(self.place(each) for each in (*start, *after, *collected))
        n, m = len(start), len(collected)
        if len(places) != 2 * n + m:
            raise ValueError(f"a loop over {n} numbers must return as many, got {len(after)}")
        left = self._scalar(Node("loop", places, Passes(number, count, n, m)))
        self._ends[number] = left.place
        rows = [[self._cell(left, n + i * m + j) for j in range(m)] for i in range(count)]
        return [self._cell(left, i) for i in range(n)], rows

    def take(self, rows: Sequence[Sequence[Number]], index: Scalar) -> list[Number]:
        """Return one of some rows, by the number of a loop's pass."""
        node = self.nodes[index.place]
        if node.operation != "index" or node.value not in self._running:
            raise TypeError("an array takes the number of a loop's pass, as it is, as its index")
        flat, width = [each for row in rows for each in row], len(rows[0])
        if all(not isinstance(row, Scalar) and row == flat[0] for row in flat):
            return [flat[0]] * width
        memory, first, apart = self._memory(rows)
        arguments = memory, index.place
        return [self._scalar(Node("take", arguments, (apart, first + j))) for j in range(width)]

    def _memory(self, rows: Sequence[Sequence[Number]]) -> tuple[int, int, int]:
        """Return the place of an array with some rows, where they begin in it and how far apart."""
        cells = [[self._cell_of(each) for each in row] for row in rows]
        memory, first = cells[0][0]
        apart = cells[1][0][1] - first if len(rows) > 1 else len(rows[0])
        if memory >= 0 and all(
            cell == (memory, first + i * apart + j)
            for i, row in enumerate(cells)
            for j, cell in enumerate(row)
        ):
            return memory, first, apart
        places = [self.place(each) for row in rows for each in row]
        return self._scalar(Node("table", tuple(places))).place, 0, len(rows[0])

    def _cell_of(self, number: Number) -> tuple[int, int]:
        """Return the place of the array that holds a number, and its index; (-1, 0) if none."""
        if isinstance(number, Scalar):
            node = self.nodes[number.place]
            if node.operation == "cell":
                return node.arguments[0], node.value
        return -1, 0

    def _cell(self, memory: Scalar, i: int) -> Scalar:
        return self._scalar(Node("cell", (memory.place,), i))

    def changes_rarely(self, after: Number, before: Scalar) -> bool:
        """Return True if one number is another one, but for what rare blocks do to it."""
        place = self.place(after)
        while self.nodes[place].operation == "rare":
            place = self.nodes[place].arguments[2]
        return place == before.place

    def needed(self, numbers: Sequence[Number]) -> list[int]:
        """Return the places of all that some numbers depend on, in order."""
        return self.reached(map(self.place, numbers))[0]

    def asked(self, numbers: Sequence[Number]) -> set[str]:
        """Return the names of inputs that some numbers depend on."""
        each = (self.nodes[place] for place in self.needed(numbers))
        return {node.value[0] for node in each if node.operation == "input"}

    def reached(self, wanted: Iterable[int]) -> tuple[list[int], dict[int, set[int]]]:
        """Return the places on which some depend, in order, and the needed parts of each loop.

        Of a loop, only what is needed of it is computed: its numbers, and columns of what it
        collects, counted from n.
        """
        needed: set[int] = set()
        parts: dict[int, set[int]] = {}
        waiting = list(wanted)

        def need(place: int, some: Iterable[int]) -> None:
            loop, arguments = self.nodes[place].value, self.nodes[place].arguments
            own = parts.setdefault(place, set())
            for part in set(some) - own:
                own.add(part)
                waiting.append(arguments[loop.n + part])
                waiting.extend(arguments[part : part + 1] if part < loop.n else ())
            waiting.append(place)

        while waiting:
            place = waiting.pop()
            if place in needed:
                continue
            needed.add(place)
            operation, arguments, value = self.nodes[place]
            if operation in ("cell", "take"):
                memory = self.nodes[arguments[0]]
                waiting += arguments
                if memory.operation == "table":
                    continue
                at = arguments[0] if memory.operation == "loop" else self._ends[memory.value]
                loop, first = self.nodes[at].value, value if operation == "cell" else value[1]
                if operation == "cell":
                    some = {first if first < loop.n else loop.n + (first - loop.n) % loop.m}
                else:
                    some = set(range(loop.n) if first < loop.n else range(loop.n, loop.n + loop.m))
                need(at, some)
            elif operation != "loop":
                waiting += arguments
        return sorted(needed), parts

    def _scalar(self, node: Node) -> Scalar:
        # 0.0 and −0.0 are equal, and not the same
        key = (*node[:2], repr(node.value)) if node.operation == "constant" else node
        place = self._known.get(key)
        if place is None:
            place = self._known[key] = len(self.nodes)
            self.nodes.append(node)
        return Scalar(self, place)


def _leaves_arrays(method: Callable[[Scalar, Any], Any]) -> Callable[[Scalar, Any], Any]:
    """Leave to NumPy what is done with an array."""

    @functools.wraps(method)
    def arithmetic(self: Scalar, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else method(self, other)

    return arithmetic


def _comparison(operation: str, swaps: bool = False) -> Any:
    def compared(self: Scalar, other: Any) -> Scalar:
        return self.graph.apply(operation, *((other, self) if swaps else (self, other)))

    return _leaves_arrays(compared)


class Scalar:
    """A number, or a truth value, of a graph."""

    __slots__ = ("graph", "place")

    def __init__(self, graph: Graph, place: int) -> None:
        self.graph = graph
        self.place = place

    @_leaves_arrays
    def __add__(self, other: Number) -> Number:
        if (inside := _negated(self)) is not None:
            return other - inside
        if not isinstance(other, Scalar):
            return self if other == 0.0 else self.graph.apply("add", self, other)
        if (inside := _negated(other)) is not None:
            return self - inside
        return self.graph.apply("add", self, other)

    __radd__ = __add__

    @_leaves_arrays
    def __sub__(self, other: Number) -> Number:
        if (inside := _negated(self)) is not None:
            return -(inside + other)
        if not isinstance(other, Scalar):
            return self if other == 0.0 else self.graph.apply("subtract", self, other)
        if (inside := _negated(other)) is not None:
            return self + inside
        return self.graph.apply("subtract", self, other)

    @_leaves_arrays
    def __rsub__(self, other: Number) -> Number:
        return -self if other == 0.0 else self.graph.apply("subtract", other, self)

    @_leaves_arrays
    def __mul__(self, other: Number) -> Number:
        if not isinstance(other, Scalar):
            if other == 0.0:  # an unknown number is finite: a step that is not is no usual one
                return 0.0
            if other in (1.0, -1.0):
                return self if other == 1.0 else -self
        elif (inside := _negated(other)) is not None:
            return -(self * inside)
        if (inside := _negated(self)) is not None:
            return inside * -other
        return self.graph.apply("multiply", self, other)

    __rmul__ = __mul__

    @_leaves_arrays
    def __truediv__(self, other: Number) -> Number:
        if not isinstance(other, Scalar) and other == 1.0:
            return self
        return self.graph.apply("divide", self, other)

    @_leaves_arrays
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

    __lt__ = _comparison("less")
    __gt__ = _comparison("less", swaps=True)
    __le__ = _comparison("less_equal")
    __ge__ = _comparison("less_equal", swaps=True)
    __eq__ = _comparison("equal")

    @_leaves_arrays
    def __ne__(self, other: object) -> Any:
        return ~(self == other)

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
        return _apply(*arguments, **options)

    def __array_function__(self, function: Any, types: Any, arguments: Any, options: Any) -> Any:
        return function(*map(_as_arrays, arguments), **options)

    def choose(self, then: Callable[[], Any], otherwise: Callable[[], Any]) -> Any:
        """Do as `law.choose`; `then` costs nothing where it never holds."""
        pairs = [(symbols(a), symbols(b)) for a, b in zip(then(), otherwise(), strict=True)]
        flat = [
            pair
            for a, b in pairs
            for pair in zip(a.flat, np.broadcast_to(b, a.shape).flat, strict=True)
        ]
        values = iter(self.graph.rare(self, *zip(*flat, strict=True)) if flat else ())
        arrays = [symbols([next(values) for _ in a.flat]).reshape(a.shape) for a, _ in pairs]
        return tuple(each[()] for each in arrays)

    def looped(self, *arguments: Any) -> Any:
        """Do as `law.collect`."""
        return _looped(*arguments)

    def take(self, array: Any) -> Any:
        """Do as `law.take`, with the number of a loop's pass."""
        flat = symbols(array)
        row = self.graph.take(flat.reshape(len(flat), -1).tolist(), self)
        return symbols(row).reshape(flat.shape[1:])[()]

    def select(self, a: Any, b: Any) -> Any:
        """Do as `law.select`."""
        if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
            return _choices(self, a, b)
        return select(self, a, b)

    def array(self, values: Any) -> Any:
        """Do as `law.array`."""
        return symbols(values)

    def is_finite(self) -> Condition:
        """Return True if a number is finite, or the condition of it."""
        return True if self.graph.is_finite else abs(self) < math.inf

    def leave(self) -> None:
        """Do what `law.leave` does."""
        self.graph.left = self.graph.left | self

    def sine_and_cosine(self) -> tuple[Number, Number]:
        """Return sin a and cos a, of an a up to `LARGEST_ANGLE`."""
        quarter = (self * (2.0 / 3.14159265358979323846)).rounded()
        r: Number = self
        for part in _QUARTERS:
            r = r - quarter * part
        square = r * r
        sine = r + r * square * products.polynomial(_SIN, square)
        cosine = (1.0 - 0.5 * square) + square * square * products.polynomial(_COS, square)
        turn = quarter - 4.0 * (quarter * 0.25).rounded()  # of −2, −1, 0, 1, 2 quarters
        swaps, sign = abs(turn) == 1.0, 1.0 - abs(turn)
        return (
            select(swaps, turn * cosine, sign * sine),
            select(swaps, -turn * sine, sign * cosine),
        )

    @staticmethod
    def angle(y: Number, x: Number) -> Number:
        """Return the angle of (x, y), one of them a symbol, from −π to π [rad]."""
        angle = arctangent(abs(y), abs(x))
        angle = select(x < 0.0, math.pi - angle, angle)
        return select(y < 0.0, -angle, angle)

    def sqrt(self) -> Scalar:
        """Return √a."""
        return self.graph.apply("sqrt", self)

    def rounded(self) -> Scalar:
        """Return the integer next to a, the even one of two, of an a up to 2⁵¹."""
        return self.graph.apply("far", self) - FAR

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
    node = number.graph.nodes[number.place]
    return Scalar(number.graph, node.arguments[0]) if node.operation == "negative" else None


# -- functions of one number ----------------------------------------------------------------------

# π/2 and ln 2 in parts of 33 bits and less, so that an integer up to 2²⁰ times each is exact
_QUARTERS = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_LN2 = (6.93147180369123816490e-01, 1.90821492927058770002e-10)
# minimax polynomials of FreeBSD's msun (k_sin.c, k_cos.c), from the lowest power
_SIN = (
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04,
    2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
_COS = (
    4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
    -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip
# of atan (s_atan.c), and the angles that it is reduced by, in two parts
_ATAN = (
    3.33333333333329318027e-01, -1.99999999998764832476e-01, 1.42857142725034663711e-01,
    -1.11111104054623557880e-01, 9.09088713343650656196e-02, -7.69187620504482999495e-02,
    6.66107313738753120669e-02, -5.83357013379057348645e-02, 4.97687799461593236017e-02,
    -3.65315727442169155270e-02, 1.62858201153657823623e-02,
)  # fmt: skip
_ANGLES = (  # up to a tangent of, the tangent and the angle
    (7 / 16, 0.0, 0.0, 0.0),
    (11 / 16, 0.5, 4.63647609000806093515e-01, 2.26987774529616870924e-17),
    (19 / 16, 1.0, 7.85398163397448278999e-01, 3.06161699786838301793e-17),
    (39 / 16, 1.5, 9.82793723247329054082e-01, 1.39033110312309984516e-17),
)  # fmt: skip
_RIGHT = (1.57079632679489655800e00, 6.12323399573676603587e-17)
_FACTORIALS = 14  # terms of exp up to ½ ln 2, whose remainder is 4e-18
_MOST = 700.0  # whose exp does not overflow
_FLAT = 20.0  # beyond it, tanh is 1 to the last bit

LARGEST_ANGLE = 1e6  # angle up to which `Scalar.sine_and_cosine` keeps its digits [rad]


def tanh(x: Scalar) -> Number:
    """Return tanh x."""
    size = abs(x)
    size = select(size < _FLAT, size, _FLAT)
    grown = expm1(size + size)
    value = grown / (grown + 2.0)
    return select(x < 0.0, -value, value)


def arctangent(y: Number, x: Number) -> Number:
    """Return the angle of (x, y), from 0 to π/2 [rad]; neither is negative, nor both 0."""
    top, bottom, (high, low) = -x, y, _RIGHT
    for end, tangent, *angle in reversed(_ANGLES):
        within = y < end * x
        # tan(α − β) = (y − x tan β) / (x + y tan β)
        top = select(within, y - x * tangent, top)
        bottom = select(within, x + y * tangent, bottom)
        high, low = (select(within, *each) for each in zip(angle, (high, low), strict=True))
    t = top / bottom
    square = t * t
    return high - ((t * (square * products.polynomial(_ATAN, square)) - low) - t)


def exp(x: Scalar) -> Number:
    """Return exp(x); beyond ±700 that of ±700."""
    x = select(x < _MOST, x, _MOST)
    return expm1(select(x > -_MOST, x, -_MOST)) + 1.0


def expm1(x: Scalar) -> Number:
    """Return exp(x) − 1, for x from −700 to 700."""
    k = (x * (1.0 / 0.693147180559945309417)).rounded()
    r: Number = x
    for part in _LN2:
        r = r - k * part
    coefficient, coefficients = 1.0, []
    for n in range(1, _FACTORIALS):
        coefficient /= n
        coefficients.append(coefficient)
    power = (k + POWER_SHIFT).graph.apply("power", k + POWER_SHIFT)
    return power * (r * products.polynomial(coefficients, r)) + (power - 1.0)


# -- arrays ----------------------------------------------------------------------------------------


def _of_one(known: Callable[[float], float], unknown: Callable[[Scalar], Any]) -> np.ufunc:
    """Return a function of each entry, known or not."""
    return np.frompyfunc(lambda a: unknown(a) if isinstance(a, Scalar) else known(a), 1, 1)


Symbols = Any  # a `SymbolArray`, which NumPy's stubs take for an array of floats

_FUNCTIONS: dict[np.ufunc, np.ufunc] = {
    np.sin: _of_one(np.sin, lambda a: a.sine_and_cosine()[0]),
    np.cos: _of_one(np.cos, lambda a: a.sine_and_cosine()[1]),
    np.tanh: _of_one(np.tanh, tanh),
    np.sqrt: _of_one(np.sqrt, Scalar.sqrt),
    np.rint: _of_one(np.rint, lambda a: select(abs(a) < 2.0**51, a.rounded(), a)),
    np.minimum: np.frompyfunc(lambda a, b: select(a < b, a, b), 2, 1),
    np.maximum: np.frompyfunc(lambda a, b: select(a > b, a, b), 2, 1),
    np.isfinite: _of_one(np.isfinite, Scalar.is_finite),
    np.less: np.frompyfunc(operator.lt, 2, 1),
    np.less_equal: np.frompyfunc(operator.le, 2, 1),
    np.greater: np.frompyfunc(operator.gt, 2, 1),
    np.greater_equal: np.frompyfunc(operator.ge, 2, 1),
    np.equal: np.frompyfunc(operator.eq, 2, 1),
    np.arctan2: np.frompyfunc(products.angle, 2, 1),
    np.hypot: np.frompyfunc(lambda a, b: products.root(a * a + b * b), 2, 1),
    np.exp: _of_one(np.exp, exp),
    np.expm1: _of_one(np.expm1, expm1),
    np.copysign: np.frompyfunc(lambda a, b: select(b < 0.0, -abs(a), abs(a)), 2, 1),
    np.isnan: _of_one(np.isnan, lambda a: ~(a == a)),
    np.sign: _of_one(np.sign, lambda a: select(a > 0.0, 1.0, select(a < 0.0, -1.0, 0.0))),
    np.logical_and: np.frompyfunc(operator.and_, 2, 1),
    np.logical_or: np.frompyfunc(operator.or_, 2, 1),
    np.logical_not: np.frompyfunc(law.complement, 1, 1),
    np.invert: np.frompyfunc(law.complement, 1, 1),
}
_SWEEPS = {1: 0, 2: 1, 3: 5}
_MANY_SWEEPS = 7  # beyond three rows
_LARGE, _FEW = 800, 4  # entries of a matrix whose product is a loop; of a row that is not in it
_choices = np.frompyfunc(select, 3, 1)


class SymbolArray(np.ndarray):
    """An array of `Scalar`s and numbers.

    It supports the arithmetic of NumPy's arrays. Operations that need a value, such as `if`, raise
    a TypeError: use `np.where` for choices.
    """

    __array_priority__ = 1.0  # so that the product with an array of numbers is one of symbols

    def __array_ufunc__(self, *arguments: Any, **options: Any) -> Any:
        return _apply(*arguments, **options)

    def __array_function__(self, function: Any, types: Any, arguments: Any, options: Any) -> Any:
        if function in _OF_ARRAYS:
            return _OF_ARRAYS[function](*arguments, **options)
        result = super().__array_function__(function, types, arguments, options)
        return result.view(SymbolArray) if isinstance(result, np.ndarray) else result

    def dot(self, other: Any) -> Any:  # type: ignore[override]
        """Return self @ other."""
        if self.ndim == 1 and np.ndim(other) == 2:
            return np.transpose(other) @ self
        return self @ other

    looped = Scalar.looped

    def arm_of(self, robot: Any) -> Any:
        """Return a robot's arm at this configuration (nq,), as `robots.traced.arm_of` does."""
        from approxjac.codegen.arm.rigid_body import arm_at

        return arm_at(self, robot)


Values = tuple[Any, ...]


def _as_arrays(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_as_arrays(each) for each in value]
    return symbols(value) if isinstance(value, Scalar) else value


def _norm(x: Any, ord: int | None = None, axis: Any = None, keepdims: bool = False) -> Any:
    if not (ord is None or (ord == 2 and (x.ndim == 1 or axis is not None))):
        raise TypeError(f"no norm of order {ord!r} of a matrix that is not known yet")
    return np.sqrt((x * x).sum(axis=axis, keepdims=keepdims))


def _clip(x: Any, low: Any = None, high: Any = None) -> Any:
    x = x if low is None else np.maximum(x, low)
    return x if high is None else np.minimum(x, high)


# -- small symmetric matrices, without a branch


def _solve(A: Any, b: Any) -> Symbols:
    """Return A⁻¹b of a symmetric A (n, n), or of any of at most three rows."""
    A, b = symbols(A), symbols(b)
    n, rows = len(A), A.tolist()
    if all(_is_same(rows[i][j], rows[j][i]) for i in range(n) for j in range(i)):
        return Factors(A).solve(b)
    if n > 3:
        raise TypeError("no solution with a matrix that is not known yet, nor symmetric, n > 3")
    return _inverse(A) @ b


def _is_same(a: Number, b: Number) -> bool:
    if isinstance(a, Scalar) and isinstance(b, Scalar):
        return a.place == b.place
    return not isinstance(a, Scalar) and not isinstance(b, Scalar) and bool(a == b)


def _inverse(A: Symbols) -> Symbols:
    """Return the inverse of a matrix of at most three rows, by its cofactors."""
    n, whole = len(A), symbols(np.eye(3))
    whole[:n, :n] = A
    a, b, c = whole
    columns = [np.cross(b, c), np.cross(c, a), np.cross(a, b)]
    return (np.stack(columns, axis=1) / (a @ columns[0]))[:n, :n]


def eigensystem(A: Any) -> tuple[Symbols, Symbols]:
    """Return eigenvalues (n,), in no order, and -vectors (n, n) of a symmetric A (n, n).

    By Jacobi's rotations.
    """
    n, a = len(A), symbols(A).tolist()
    if not any(isinstance(each, Scalar) for row in a for each in row):
        squares, U = np.linalg.eigh(a)
        return symbols(squares.tolist()), symbols(U.tolist())
    upper = np.triu_indices(n)

    def sweep(_: object, values: tuple[Symbols, Symbols]) -> tuple[Symbols, Symbols]:
        whole = symbols(np.zeros((n, n)))
        whole[upper] = whole.T[upper] = values[0]
        a, vectors = whole.tolist(), values[1].tolist()
        for p in range(n):
            for q in range(p + 1, n):
                _rotate(a, vectors, p, q)
        return symbols(a)[upper], symbols(vectors)

    start = symbols(a)[upper], symbols(np.eye(n))
    entries, vectors = law.repeat(_SWEEPS.get(n, _MANY_SWEEPS), sweep, start)
    diagonal = symbols(np.zeros((n, n)))
    diagonal[upper] = entries
    return diagonal.diagonal(), vectors


def _rotate(a: list[list[Number]], vectors: list[list[Number]], p: int, q: int) -> None:
    """Make a[p][q] zero."""
    off = a[p][q]
    if not isinstance(off, Scalar) and off == 0.0:
        return
    ratio = (a[q][q] - a[p][p]) / (off + off)
    size = abs(ratio)
    tangent: Number = 1.0 / (size + products.root(size * size + 1.0))
    tangent = select(ratio < 0.0, -tangent, tangent)
    tangent = select(off == 0.0, 0.0, tangent)
    cosine = 1.0 / products.root(tangent * tangent + 1.0)
    sine = tangent * cosine
    a[p][p], a[q][q] = a[p][p] - tangent * off, a[q][q] + tangent * off
    a[p][q] = a[q][p] = 0.0
    for row in vectors:
        row[p], row[q] = cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]
    for r in range(len(a)):
        if r not in (p, q):
            left, right = a[r][p], a[r][q]
            a[r][p] = a[p][r] = cosine * left - sine * right
            a[r][q] = a[q][r] = sine * left + cosine * right


_OF_ARRAYS: dict[Any, Callable[..., Any]] = {
    np.where: _choices,
    np.linalg.norm: _norm,
    np.clip: _clip,
    np.linalg.eigh: eigensystem,
    np.linalg.eigvalsh: lambda A: eigensystem(A)[0],
    np.linalg.solve: _solve,
    np.linalg.inv: lambda A: _solve(A, np.eye(len(A))),
}


def _looped(count: int, body: Callable[[Any, Values], tuple[Values, Values]], start: Values) -> Any:
    """Do as `law.collect`, as a loop of the graph, whose body is traced once."""
    arrays = [symbols(each) for each in start]
    flat = [number for each in arrays for number in each.ravel().tolist()]
    graph = next((each.graph for each in flat if isinstance(each, Scalar)), None)
    if graph is None or count < 2:
        return collected(count, body, start)
    truths = [_is_condition(each) for each in flat]
    kept: list[tuple[int, ...]] = []  # shapes of what is collected

    def flattened(values: Values) -> list[Number]:
        numbers = (number for each in values for number in symbols(each).ravel().tolist())
        return [select(each, 1.0, 0.0) if _is_condition(each) else each for each in numbers]

    def split(numbers: Sequence[Number], shapes: Sequence[tuple[int, ...]]) -> Values:
        ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()
        return tuple(
            symbols(numbers[end - math.prod(shape) : end]).reshape(shape)[()]
            for end, shape in zip(ends, shapes, strict=True)
        )

    def restored(numbers: Sequence[Number]) -> Values:
        pairs = zip(numbers, truths, strict=True)
        known = [each == 1.0 if is_truth else each for each, is_truth in pairs]
        return split(known, [each.shape for each in arrays])

    def written(i: Scalar, before: list[Number]) -> tuple[list[Number], list[Number]]:
        after, row = body(i, restored(before))
        kept[:] = [symbols(each).shape for each in row]
        return flattened(after), flattened(row)

    left, rows = graph.loop(count, flattened(start), written)
    columns = zip(*(split(row, kept) for row in rows), strict=True)
    return restored(left), tuple(np.stack(column) for column in columns)


def _apply(ufunc: np.ufunc, method: str, *arguments: Any, **options: Any) -> Any:
    if "out" in options:
        options["out"] = tuple(map(_plain, options["out"]))
    if ufunc is np.matmul and _is_large(*arguments):
        return _product(*arguments)
    function = getattr(_FUNCTIONS.get(ufunc, ufunc), method)
    result = function(*map(_plain, arguments), **options)
    return result.view(SymbolArray) if isinstance(result, np.ndarray) else result


def _is_large(A: Any, b: Any) -> bool:
    """Return True if A @ b is a loop: of a large matrix of constants and a vector."""
    if np.ndim(A) != 2 or np.ndim(b) != 1 or np.size(A) <= _LARGE or not isinstance(b, SymbolArray):
        return False
    known = not any(isinstance(each, Scalar) for each in np.ravel(A).tolist())
    return known and bool(np.count_nonzero(A) > _LARGE)


def _product(A: Any, b: Symbols) -> Symbols:
    """Return A @ b of constants A (k, n) and b (n,), column by column."""
    A = np.array(A, dtype=float)
    product = symbols(np.zeros(len(A)))
    sparse = np.count_nonzero(A, axis=1) <= _FEW
    product[sparse] = A[sparse] @ b
    A = A[np.logical_not(sparse)]
    used = A.any(axis=0)
    columns, b = A.T[used], b[used]

    def add(j: Scalar, values: tuple[Symbols]) -> tuple[Symbols]:
        return (values[0] + law.take(columns[1:], j) * law.take(b[1:], j),)

    first = columns[0] * b[0]
    (product[~sparse],) = law.repeat(len(b) - 1, add, (first,))
    return product


def symbols(values: Any) -> Symbols:
    """Return numbers or symbols as an array."""
    return np.array(values, dtype=object).view(SymbolArray)


def graph_of(values: Symbols) -> Graph:
    """Return the graph of an array's symbols."""
    return next(each.graph for each in values.ravel().tolist() if isinstance(each, Scalar))


def inputs(graph: Graph, name: str, shape: int | tuple[int, ...]) -> Symbols:
    """Return an input of a graph as an array."""
    size = shape if isinstance(shape, int) else int(np.prod(shape))
    return symbols(graph.input(name, size)).reshape(shape)


def _plain(value: Any) -> Any:
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, SymbolArray):
        return value.view(np.ndarray)
    if isinstance(value, Scalar):
        result = np.empty((), dtype=object)
        result[()] = value
        return result
    return np.asarray(value, dtype=object) if isinstance(value, np.ndarray) else value
