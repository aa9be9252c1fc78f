"""Checks of a saturation when a controller is built.

The stability tests assume them: none would detect a slope other than 1.
"""

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.formatting import joined, numbers
from approxjac.law import Linear, Saturation
from approxjac.tasks import Task
from approxjac.validation import Array, as_number, read_only

_NAMES = ("s", "S", "ds", "c_bar")
_SLACK = 1e-5  # relative: round-off costs less, a mistake more
_ROUNDED = 1e-12  # relative: what formulas that cancel at 0 may leave
_APART = 1e-4  # relative half distance of two points that are compared
_DECADES = np.geomspace(1e-8, 1e8, 33)[:, None]  # errors in any unit
_RATIOS = np.geomspace(1e-2, 1e2, 25)  # of errors to the error at which s saturates
_SIGNED = np.concatenate([_RATIOS, -_RATIOS])[:, None]
_PAIRS = np.concatenate([_SIGNED * (1.0 - _APART), _SIGNED * (1.0 + _APART)])


class _Fault(Exception):
    """Fault of a saturation, in words."""


def require_saturation(saturation: Saturation, task: Task) -> None:
    """Check that an object is a `law.Saturation` of the task's m coordinates.

    Raises:
        InvalidInputError: A part is missing or fails, s(0) is not 0 or its slope not 1, s, S and ds
            are inconsistent, or eq. (8) does not hold with c̄, at errors from far below to far
            above the one at which s saturates.
    """
    try:
        if isinstance(saturation, type):
            raise _Fault("that is a class, give an object of it")
        if missing := [name for name in _NAMES if not hasattr(saturation, name)]:
            raise _Fault(f"it has no {', '.join(missing)}")
        with np.errstate(all="ignore"):  # such errors may never come
            _require_law(saturation, task.m)
    except _Fault as fault:
        raise InvalidInputError(
            f"saturation must be Linear(), Sine(gamma) or Tanh(gamma) with one gamma or {task.m} "
            f"for {task!r}, or a law.Saturation of your own, got {saturation!r}: {fault}",
            given=saturation,
        ) from fault.__cause__


def _value(saturation: Saturation, name: str, e: Array) -> Array:
    try:
        value = np.asarray(getattr(saturation, name)(read_only(e)), dtype=np.float64)
    except Exception as error:
        raise _Fault(
            f"{name}(e) fails for an e of shape {e.shape} with {type(error).__name__}: {error} "
            f"(e has shape ({e.shape[-1]},) or (N, {e.shape[-1]}), and is not to be changed)"
        ) from error
    if value.shape != e.shape:
        raise _Fault(f"{name}(e) must have the shape of e, {e.shape}, got {value.shape}")
    return value


def _require_law(f: Saturation, m: int) -> None:
    at_zero = {name: _value(f, name, np.zeros(m)) for name in ("s", "S", "ds")}
    # the scale of each coordinate: up to there s is within half of e
    far = _DECADES * np.ones(m)
    near = np.logical_and.accumulate(np.abs(_value(f, "s", far) - far) <= 0.5 * far)
    scale = np.maximum((far * near).max(axis=0), _DECADES[0])
    for name, size in (("s", scale), ("S", scale**2)):
        if not (np.abs(at_zero[name]) <= _ROUNDED * size).all():
            raise _Fault(f"{name}(0) must be 0, got {at_zero[name].tolist()}")
    slope = at_zero["ds"]
    if not (np.abs(slope - 1.0) <= _SLACK).all():
        raise _Fault(
            f"its slope ds(0) must be 1 in every coordinate, got {slope.tolist()}; another slope "
            "belongs into the gains, such as kp"
        )
    e = (_PAIRS * scale).reshape(2, -1, m)  # pairs of errors close to each other
    s, S, ds = (_value(f, name, e.reshape(-1, m)).reshape(e.shape) for name in ("s", "S", "ds"))
    one = (7 * np.arange(m)) % e.shape[1], np.arange(m)
    alone = np.zeros_like(s[0])
    alone[one] = _value(f, "s", e[0][one]) - s[0][one]
    # mean slopes are between those at the two points, kinks or not
    rise, lean = (s[1] - s[0]) / (e[1] - e[0]), (S[1] - S[0]) / (e[1] - e[0])
    size, c_bar = np.abs(s[0]), as_number("c_bar of a saturation", f.c_bar, above=0.0)
    for holds, rule in (
        (np.isfinite(s[0] + S[0] + ds[0]), "s, S and ds must be finite"),
        (np.abs(alone) <= _SLACK * size, "s must act entry by entry"),
        (_is_between(rise, ds, _SLACK), "ds(e) must be the slope of s"),
        (ds[0] >= -_SLACK, "s must not fall anywhere, ds(e) >= 0"),
        (np.sign(s[0]) == np.sign(e[0]), "s(e) must have the sign of e"),
        (_is_between(lean, s, _SLACK * size), "s(e) must be the slope of S"),
        (S[0] * (1.0 + _SLACK) >= c_bar * size**2, f"S(e) must be >= c_bar s(e)², c_bar {c_bar:g}"),
    ):
        if not holds.all():
            at = np.unravel_index(np.argmin(holds), holds.shape)
            values = f"s(e) = {s[0][at]:.6g}, S(e) = {S[0][at]:.6g} and ds(e) = {ds[0][at]:.6g}"
            raise _Fault(f"{rule}, got {values} at e = {e[0][at]:.6g}")


def _is_between(slope: Array, ends: Array, slack: float | Array) -> Array:
    return (ends.min(axis=0) - slack <= slope) & (slope <= ends.max(axis=0) + slack)


def describe_saturation(saturation: Saturation, task: Task) -> str:
    """Return s(e) in words, such as "saturation Tanh (gamma 0.058 m)"."""
    name = type(saturation).__name__
    if type(saturation) is Linear:
        return "no saturation"
    if not type(saturation).__module__.startswith("approxjac."):
        return f"saturation {name} (your own)"
    gamma = vars(saturation)["gamma"]
    return f"saturation {name} (gamma {numbers(gamma)} {joined(task.units)})"
