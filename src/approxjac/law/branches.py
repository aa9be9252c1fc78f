"""Branches and loops that run on numbers, and are written down where numbers are symbols.

A step of a law is written once, on arrays. NumPy's arrays take one branch; arrays whose numbers are
not known yet (of `codegen`) take both, and say themselves how.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

Values = TypeVar("Values", bound=tuple[Any, ...])


def choose(condition: Any, then: Callable[[], Values], otherwise: Callable[[], Values]) -> Values:
    """Return then() where a condition holds, otherwise() elsewhere.

    Both return tuples of as many numbers and arrays, of the same shapes.

    Args:
        condition: A truth value of Python or NumPy, or one that is not known yet.
        then: What is computed where it holds; mostly it does not.
        otherwise: What is computed elsewhere.
    """
    if isinstance(condition, bool | np.bool_):
        return then() if condition else otherwise()
    chosen: Values = condition.choose(then, otherwise)
    return chosen


def repeat(count: int, body: Callable[[Any, Values], Values], start: Values) -> Values:
    """Return what is left of `start` after count times values = body(i, values).

    Args:
        count: How often.
        body: Of i, from 0, and the values before; returns the values after, of the same shapes.
        start: Numbers and arrays.
    """
    for value in start:
        if isinstance(value, np.ndarray) and type(value) is not np.ndarray:
            repeated: Values = value.repeated(count, body, start)  # type: ignore[attr-defined]
            return repeated
    values = start
    for i in range(count):
        values = body(i, values)
    return values
