"""Validation of arguments; `Immutable` objects, and `Saved` ones that files hold.

The functions raise an InvalidInputError with the name and value of the argument.
"""

import copy
import inspect
import math
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Self

import numpy as np
from numpy import ndarray
from numpy.typing import NDArray

from approxjac.errors import InvalidInputError, require_known
from approxjac.formatting import shown

Array = NDArray[np.float64]
_FLOAT64 = np.dtype(np.float64)
_LARGEST = 1e60
_MANY = 50  # numbers, of which the wrong ones are counted in a message
_CHANGEABLE = (list, dict, np.ndarray)


def read_only(array: Array) -> Array:
    """Return an array, which from now on cannot be changed by its name."""
    array.flags.writeable = False
    return array


def _floats(value: Any) -> Array:
    """Return a new array of floats; raise a TypeError or ValueError if masked or no numbers."""
    if _is_masked(value) or np.asarray(value).dtype.kind not in "iuf":  # as text and booleans are
        raise TypeError
    with np.errstate(over="ignore"):  # a long double may become infinite, which is refused
        return np.array(value, dtype=np.float64)


def as_array(name: str, value: Any, shape: tuple[int | str, ...], unit: str = "") -> Array:
    """Return `value` as a new read-only float array of `shape`, all entries finite.

    An axis with a name in place of a length, such as "k", may have any length but 0.
    """
    suffix = f" [{unit}]" if unit else ""
    wanted = str(shape).replace("'", "")
    try:
        array = _floats(value)
    except (TypeError, ValueError) as error:
        message = f"{name} must be numbers of shape {wanted}{suffix}, got {shown(value)}"
        raise InvalidInputError(message, given=value) from error
    fits = array.ndim == len(shape) and all(
        n == k or (n and isinstance(k, str)) for n, k in zip(array.shape, shape, strict=True)
    )
    if not fits:
        message = f"{name} must have shape {wanted}{suffix}, got shape {array.shape}"
        raise InvalidInputError(message, given=value)
    if not np.isfinite(array).all():
        wrong = array.size - int(np.isfinite(array).sum())
        given = array.tolist() if array.size <= _MANY else f"{wrong} of {array.size} that are not"
        raise InvalidInputError(f"{name} must be finite{suffix}, got {given}", given=value)
    return read_only(array)


def _is_masked(value: Any) -> bool:
    """Return True for a masked value, whose hidden number an array would show."""
    if isinstance(value, np.ma.MaskedArray):
        return bool(np.ma.is_masked(value))
    return isinstance(value, list | tuple) and any(map(_is_masked, value))


def as_vector(name: str, value: Any, size: int, unit: str = "") -> Array:
    """Return `value` itself if it is a finite float vector of `size`, else a copy that is.

    Faster than `as_array`, for vectors that arrive a thousand times a second.
    """
    if (
        type(value) is ndarray
        and value.dtype == _FLOAT64
        and value.shape == (size,)
        and math.isfinite(math.hypot(*value.tolist()))  # overflows without a warning
    ):
        return value
    if hasattr(value, "arm_of"):  # symbols, of which nothing is known yet
        return value
    return as_array(name, value, (size,), unit)


def as_entries(name: str, value: Any, size: int, unit: str = "") -> Array:
    """Return a number, or one per entry, as a read-only float vector of `size`."""
    return as_array(name, [value] * size if is_scalar(value) else value, (size,), unit)


def as_number(
    name: str,
    value: Any,
    *,
    unit: str = "",
    minimum: float = -math.inf,
    above: float = -math.inf,
    most: float = math.inf,
) -> float:
    """Return `value` as a finite float that is >= `minimum`, > `above` and <= `most`."""
    if type(value) is float and minimum <= value <= most and value > above and math.isfinite(value):
        return value  # the quick way
    suffix = f" [{unit}]" if unit else ""
    bounds = (">=", minimum), (">", above), ("<=", most)
    bound = " and".join(f" {sign} {end:g}" for sign, end in bounds if math.isfinite(end))
    try:
        number = math.nan if _is_masked(value) or np.ndim(value) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if isinstance(value, bool | str | bytes) or not (
        math.isfinite(number) and minimum <= number <= most and number > above
    ):
        message = f"{name} must be a finite number{bound}{suffix}, got {shown(value)}"
        raise InvalidInputError(message, given=value)
    return number


def as_delay(name: str, value: Any) -> float:
    """Return `value` as a time from 0 to 10 s: one in milliseconds is an error."""
    return as_number(name, value, unit="s", minimum=0.0, most=10.0)


def as_integer(name: str, value: Any, minimum: int) -> int:
    """Return `value` if it is an integer >= `minimum`."""
    if type(value) is not int or value < minimum:
        message = f"{name} must be an integer >= {minimum}, got {shown(value)}"
        raise InvalidInputError(message, given=value)
    return value


def as_diagonal(
    name: str, value: Any, size: int | None = None, *, unit: str = "", positive: bool = True
) -> Array:
    """Return a diagonal given as a scalar or a vector as a read-only vector of `size`.

    Without a size it has as many entries as are given.
    """
    size = math.prod(shape_of(value)) if size is None else size
    array = as_entries(name, value, max(size, 1), unit)
    if not ((array > 0.0 if positive else array >= 0.0) & (array <= _LARGEST)).all():
        # or products of gains could overflow in a control step
        suffix = f" [{unit}]" if unit else ""
        raise InvalidInputError(
            f"{name} must be {'>' if positive else '>='} 0 in every entry{suffix}, and at most "
            f"{_LARGEST:g}, got {array.tolist()}",
            given=value,
        )
    return array


def as_limits(name: str, value: Any, size: int, *, unit: str) -> Array:
    """Return limits given as a scalar or a vector as a read-only vector; inf is no limit."""
    try:
        array = np.broadcast_to(_floats(value), (size,)).copy()
    except (TypeError, ValueError):
        array = np.full(size, np.nan)
    if not (array > 0.0).all():
        raise InvalidInputError(
            f"{name} must be numbers > 0 [{unit}], one{f' or {size}' if size > 1 else ''}, "
            f"infinite where there is no limit, got {shown(value)}",
            given=value,
        )
    return read_only(array)


def require(name: str, value: Any, kind: Any, wanted: str) -> Any:
    """Return an argument, or raise an InvalidInputError if it is not of a type or union `kind`."""
    if isinstance(value, type) or not isinstance(value, kind):  # a class may look like a protocol
        given = f"the class {value.__name__}" if isinstance(value, type) else shown(value)
        if inspect.isroutine(value) and "<" not in value.__name__:
            given = f"the function {value.__name__}; did you mean {value.__name__}()?"
        raise InvalidInputError(f"{name} must be {wanted}, got {given}", given=value)
    return value


def is_scalar(value: Any) -> bool:
    """Return True for a single item; False for a ragged list."""
    if _is_masked(value):  # which NumPy warns of, or fails at
        return isinstance(value, np.ma.MaskedArray) and value.ndim == 0
    try:
        return np.ndim(value) == 0
    except ValueError:
        return False


def shape_of(value: Any) -> tuple[int, ...]:
    """Return the shape of any value; () for a ragged list."""
    try:
        return () if _is_masked(value) else np.shape(value)
    except ValueError:
        return ()


def axis_rows(name: str, axes: str) -> list[int]:
    """Return the rows of the world axes that a text such as "xz" names."""
    if not isinstance(axes, str) or not axes or len(set(axes)) != len(axes):
        message = f"{name} must name each axis once, such as 'xyz' or 'xz', got {axes!r}"
        raise InvalidInputError(message, given=axes)
    for letter in axes:
        require_known("axis", letter, name, "xyz")
    return list(map("xyz".index, axes))


def plane_rows(plane: str) -> list[int]:
    """Return the rows of the two world axes of a plane such as "xz"."""
    rows = axis_rows("plane", plane)
    if len(rows) != 2:
        message = f"plane must name two world axes, such as 'xz', got {plane!r}"
        raise InvalidInputError(message, given=plane)
    return rows


class Immutable:
    """An object whose public attributes cannot change after construction.

    Values derived at construction would not follow a later change. A copy is built anew from
    the same arguments, and so has scratch memory of its own.
    """

    _given: tuple[tuple[Any, ...], dict[str, Any]]
    _changes: Mapping[str, Any] = MappingProxyType({})  # of arguments, without building it anew

    def __new__(cls, *given: Any, **named: Any) -> Self:
        """Store the arguments of the constructor, whatever the class takes."""
        self = super().__new__(cls)
        kept = {name: _as_it_is(value) for name, value in named.items()}
        self.__dict__["_given"] = tuple(map(_as_it_is, given)), kept
        return self

    @property
    def _arguments(self) -> dict[str, Any]:
        bound = inspect.signature(type(self)).bind(*self._given[0], **self._given[1])
        bound.apply_defaults()
        for parameter in bound.signature.parameters.values():
            if parameter.kind is parameter.VAR_KEYWORD:
                bound.arguments |= bound.arguments.pop(parameter.name)
        return {**bound.arguments, **self._changes}

    def _recipe(self, **changes: Any) -> tuple[Any, ...]:
        """Return the arguments of `_built` for a copy."""
        named, bound = self._arguments | changes, inspect.signature(type(self)).bind_partial()
        for parameter in bound.signature.parameters.values():
            if parameter.kind is not parameter.VAR_KEYWORD:
                bound.arguments[parameter.name] = named.pop(parameter.name)
        names = getattr(self, "_carried", ())  # of attributes that a copy has besides, if set
        carried = {name: vars(self)[name] for name in names if name in vars(self)}
        return type(self), bound.args, bound.kwargs | named, carried

    def _rebuilt(self, **changes: Any) -> Self:
        return _built(*self._recipe(**changes))

    def __reduce__(self) -> tuple[Any, ...]:
        return _built, self._recipe()

    def __setattr__(self, name: str, value: Any) -> None:
        derived = isinstance(getattr(type(self), name, None), (property, cached_property))
        is_given = name in self.__dict__ or derived
        if is_given and not name.startswith("_"):
            kind = type(self).__name__
            message = f"{name} of a {kind} cannot be changed once it is built; build a new {kind}"
            raise InvalidInputError(message, given=value)
        object.__setattr__(self, name, value)


def _built(kind: Any, given: Any, named: dict[str, Any], carried: dict[str, Any]) -> Any:
    copy = kind(*given, **named)
    vars(copy).update(carried)
    return copy


def _as_it_is(value: Any) -> Any:
    return copy.copy(value) if isinstance(value, _CHANGEABLE) else value


def changed_copy(of: Any, **changes: Any) -> Any:
    """Return a shallow copy with other attributes, whatever its class does to be copied."""
    new = object.__new__(type(of))
    vars(new).update(vars(of), **changes)
    return new


class Saved:
    """An object that a file stores as its kind and the arguments of its constructor.

    Robots are stored separately. A class without a kind of its own is not stored.
    """

    _kind: ClassVar[str]
    _kinds: ClassVar[dict[str, Any]] = {}

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "_kind" in vars(cls):
            Saved._kinds[cls._kind] = cls

    def _saved(self) -> dict[str, Any] | None:
        """Return texts, numbers, lists and dictionaries; None for anything that is not stored."""
        if "_kind" not in vars(type(self)):
            return None
        kept: dict[str, Any] = {"kind": self._kind}
        for name in inspect.signature(type(self)).parameters:
            if name != "robot":
                value = getattr(self, name)
                if isinstance(value, Saved) and (value := value._saved()) is None:
                    return None
                kept[name] = value.tolist() if isinstance(value, np.ndarray) else value
        return kept
