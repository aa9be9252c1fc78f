"""Branches and loops that run on numbers and are traced on symbols.

A step of a law is written once, on arrays. With NumPy's arrays one branch runs; with arrays of
symbols (of `codegen`) both are traced.
"""

import functools
import math
import operator
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from approxjac.validation import Array

Values = TypeVar("Values", bound=tuple[Any, ...])

_KNOWN = bool, np.bool_
_MANY = 12  # rows, of which symbols become a loop


def select(condition: Any, a: Any, b: Any) -> Any:
    """Return a where a condition holds, b elsewhere: numbers, or arrays of the same shape.

    Both are computed already; `choose` avoids that. The condition is a truth value of Python or
    NumPy, or a symbol.
    """
    if condition is True:
        return a
    if condition is False:
        return b
    if isinstance(condition, np.bool_):
        return a if condition else b
    return condition.select(a, b)


def selected(condition: Any, a: list[Any], b: list[Any]) -> list[Any]:
    """Apply `select` to each pair of numbers in two lists."""
    if condition is True or condition is False:
        return a if condition else b
    return [select(condition, *pair) for pair in zip(a, b, strict=True)]


def complement(condition: Any) -> Any:
    """Return the opposite of a condition."""
    return not condition if isinstance(condition, _KNOWN) else ~condition


def is_finite(x: Any) -> Any:
    """Return True if all entries of a vector are finite."""
    return all_finite(x.tolist())


def all_finite(numbers: list[Any]) -> Any:
    """Return True if all of some numbers are finite."""
    try:
        return math.isfinite(math.hypot(*numbers))  # which overflows without a warning
    except TypeError:  # they are symbols
        return sum_of_squares(numbers).is_finite()


def sum_of_squares(numbers: list[Any]) -> Any:
    """Return the sum of squares, by halves: a processor need not wait for each addition."""
    sums: list[Any] = [each * each for each in numbers] or [0.0]
    while len(sums) > 1:
        half = len(sums) // 2
        sums = [a + b for a, b in zip(sums[:half], sums[half:], strict=False)] + sums[2 * half :]
    return sums[0]


def leave(condition: Any) -> None:
    """Mark the results as invalid where a symbolic condition holds."""
    if condition is not False:
        condition.leave()


def array(values: Any) -> Any:
    """Return numbers or symbols as an array."""
    numbers = values if isinstance(values, np.ndarray) else np.array(values)
    if not numbers.dtype.hasobject:
        return numbers
    unknown = next((each for each in numbers.flat if hasattr(each, "array")), None)
    return numbers if unknown is None else unknown.array(numbers)


def any_of(conditions: Any) -> Any:
    """Return True if any of some conditions (…) holds."""
    return functools.reduce(operator.or_, conditions.ravel().tolist(), False)


def all_of(conditions: Any) -> Any:
    """Return True if all of some conditions (…) hold."""
    return functools.reduce(operator.and_, conditions.ravel().tolist(), True)


def all_equal(a: Any, b: Any) -> Any:
    """Return True if all entries of two vectors are equal."""
    return all_of(a == b) if a.dtype.hasobject or b.dtype.hasobject else a.tolist() == b.tolist()


def surely(condition: Any) -> bool:
    """Return True if a condition is known to hold; False for a symbol."""
    return isinstance(condition, _KNOWN) and bool(condition)


def alter(condition: Any, values: Array, change: Callable[[Array], None]) -> None:
    """Call `change` to modify an array in place where a condition, usually False, holds."""
    if isinstance(condition, _KNOWN):
        if condition:
            change(values)
        return
    after = values.copy()
    change(after)
    (values[:],) = condition.choose(lambda: (after,), lambda: (values,))


def choose(condition: Any, then: Callable[[], Values], otherwise: Callable[[], Values]) -> Values:
    """Return then() where a condition holds, otherwise() elsewhere.

    Both return tuples of as many numbers and arrays, of the same shapes. Usually it is False.
    """
    if isinstance(condition, _KNOWN):
        return then() if condition else otherwise()
    return condition.choose(then, otherwise)


def repeat(count: int, body: Callable[[Any, Values], Values], start: Values) -> Values:
    """Return `start` after count times values = body(i, values).

    With symbols it becomes a loop in the generated code, and `body` is called once, with a symbol
    i: `take` reads entry i of an array.

    The values are numbers and arrays, whose shapes stay; i counts from 0.
    """
    return collect(count, lambda i, values: (body(i, values), ()), start)[0]


def collect(
    count: int, body: Callable[[Any, Values], tuple[Values, tuple[Any, ...]]], start: Values
) -> tuple[Values, tuple[Array, ...]]:
    """Repeat as `repeat` does, and stack what each pass collects; count is at least 1.

    `body` returns the values after, and a tuple of what is collected, of the same shapes each pass.
    """
    for value in start:
        looped = getattr(value, "looped", None)
        if looped is not None:
            return looped(count, body, start)
    return collected(count, body, start)


def collected(
    count: int, body: Callable[[Any, Values], tuple[Values, tuple[Any, ...]]], start: Values
) -> tuple[Values, tuple[Array, ...]]:
    """Collect as `collect` does, pass after pass."""
    values, rows = start, []
    for i in range(count):
        values, row = body(i, values)
        rows.append(row)
    return values, tuple(np.stack(column) for column in zip(*rows, strict=True))


def fold(
    body: Callable[..., tuple[Values, tuple[Any, ...]]], start: Values, *columns: list[Any]
) -> tuple[Values, tuple[list[Any], ...]]:
    """Return the values after `values, row = body(values, *numbers)`, and the columns of rows.

    The numbers are those of one row after the other of lists. Many symbols become a loop.
    """
    if len(columns[0]) > _MANY:
        arrays = [array(each) for each in columns]
        symbol = next((each for each in arrays[0] if hasattr(each, "looped")), None)
        if symbol is not None:

            def one(i: Any, values: Any) -> Any:
                after, row = body(values[1:], *[take(each, i) for each in arrays])
                return (values[0], *after), row

            after, stacked = symbol.looped(len(arrays[0]), one, (symbol, *start))
            return after[1:], tuple(each.tolist() for each in stacked)
    values, rows = start, []
    for numbers in zip(*columns, strict=True):
        values, row = body(values, *numbers)
        rows.append(row)
    return values, tuple(map(list, zip(*rows, strict=True)))


def take(array: Array, i: Any) -> Any:
    """Return array[i] for the i of `repeat` and `collect`, which may be a symbol."""
    return array[i] if isinstance(i, int) else i.take(array)
