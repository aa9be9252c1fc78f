"""`SymbolArray`: arrays of numbers that are not known yet, which the functions of `law` take."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from approxjac.codegen.trace import functions
from approxjac.codegen.trace.graph import Condition, Graph, Number, Scalar, select


def _of_one(known: Callable[[float], float], unknown: Callable[[Scalar], Any]) -> np.ufunc:
    """Return a function of each entry, known or not."""
    function: np.ufunc = np.frompyfunc(
        lambda a: unknown(a) if isinstance(a, Scalar) else known(a), 1, 1
    )
    return function


def _smaller(a: Number, b: Number) -> Number:
    return select(a < b, a, b)


def _larger(a: Number, b: Number) -> Number:
    return select(a > b, a, b)


Symbols = Any
"""A `SymbolArray`, which NumPy's stubs take for an array of floats."""

_FUNCTIONS: dict[np.ufunc, np.ufunc] = {
    np.sin: _of_one(np.sin, lambda a: functions.sine_and_cosine(a)[0]),
    np.cos: _of_one(np.cos, lambda a: functions.sine_and_cosine(a)[1]),
    np.tanh: _of_one(np.tanh, functions.tanh),
    np.sqrt: _of_one(np.sqrt, Scalar.sqrt),
    np.rint: _of_one(np.rint, functions.nearest_integer),
    np.minimum: np.frompyfunc(_smaller, 2, 1),
    np.maximum: np.frompyfunc(_larger, 2, 1),
    np.isfinite: np.frompyfunc(lambda a: abs(a) < np.inf, 1, 1),
    np.less: np.frompyfunc(lambda a, b: a < b, 2, 1),
    np.less_equal: np.frompyfunc(lambda a, b: a <= b, 2, 1),
    np.greater: np.frompyfunc(lambda a, b: a > b, 2, 1),
    np.greater_equal: np.frompyfunc(lambda a, b: a >= b, 2, 1),
    np.equal: np.frompyfunc(lambda a, b: a == b, 2, 1),
    np.bitwise_and: np.frompyfunc(lambda a, b: a & b, 2, 1),
    np.bitwise_or: np.frompyfunc(lambda a, b: a | b, 2, 1),
    np.invert: np.frompyfunc(lambda a: ~a if isinstance(a, Scalar) else not a, 1, 1),
}
_select = np.frompyfunc(select, 3, 1)


class SymbolArray(np.ndarray):
    """An array of `Scalar`s, and of numbers that are known.

    It does what NumPy's arrays do, as far as that is arithmetic. What would have to know a value,
    such as `if`, is a TypeError: a choice is `np.where`.
    """

    def __array_ufunc__(self, *arguments: Any, **options: Any) -> Any:
        return apply(*arguments, **options)

    def __array_function__(self, function: Any, types: Any, arguments: Any, options: Any) -> Any:
        if function is np.where:
            return choose(*arguments)
        result = super().__array_function__(function, types, arguments, options)
        return result.view(SymbolArray) if isinstance(result, np.ndarray) else result

    def repeated(self, count: int, body: Callable[[Any, Any], Any], values: Any) -> Any:
        """Return what `law.repeat` does."""
        for i in range(count):
            values = body(i, values)
        return values


def chosen(condition: Scalar, then: tuple[Any, ...], otherwise: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return then where a condition holds, otherwise elsewhere: numbers and arrays of symbols."""
    arrays = [(symbols(a), symbols(b)) for a, b in zip(then, otherwise, strict=True)]
    flat = [(a, np.broadcast_to(b, a.shape)) for a, b in arrays]
    values = condition.graph.rare(
        condition,
        [each for a, _ in flat for each in a.ravel().tolist()],
        [each for _, b in flat for each in b.ravel().tolist()],
    )
    found, at = [], 0
    for a, _ in flat:
        found.append(symbols(values[at : at + a.size]).reshape(a.shape) if a.ndim else values[at])
        at += a.size
    return tuple(found)


def apply(ufunc: np.ufunc, method: str, *arguments: Any, **options: Any) -> Any:
    """Return what a function of NumPy makes of arrays, some of which hold `Scalar`s."""
    if "out" in options:
        options["out"] = tuple(map(_plain, options["out"]))
    function = getattr(_FUNCTIONS.get(ufunc, ufunc), method)
    result = function(*map(_plain, arguments), **options)
    return result.view(SymbolArray) if isinstance(result, np.ndarray) else result


def choose(condition: Any, a: Any, b: Any) -> Any:
    """Return what `numpy.where` does."""
    result = _select(*map(_plain, (condition, a, b)))
    return result.view(SymbolArray) if isinstance(result, np.ndarray) else result


def symbols(values: Any) -> Symbols:
    """Return numbers, known or not, as an array."""
    return np.array(values, dtype=object).view(SymbolArray)


def inputs(graph: Graph, name: str, shape: int | tuple[int, ...]) -> Symbols:
    """Return an input of a graph as an array."""
    size = shape if isinstance(shape, int) else int(np.prod(shape))
    return symbols(graph.input(name, size)).reshape(shape)


def any_of(conditions: Any) -> Condition:
    """Return whether any of some conditions holds."""
    return functools.reduce(lambda a, b: a | b, np.ravel(conditions).tolist(), False)


def _plain(value: Any) -> Any:
    if isinstance(value, SymbolArray):
        return value.view(np.ndarray)
    if isinstance(value, Scalar):
        found = np.empty((), dtype=object)
        found[()] = value
        return found
    return np.asarray(value, dtype=object) if isinstance(value, np.ndarray) else value
