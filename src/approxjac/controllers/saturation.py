"""Checks of a saturation, made once, when a controller is built.

The tests of stability take it for granted: none of them would notice a slope other than 1.
"""

from __future__ import annotations

import numpy as np

from approxjac.errors import InvalidInputError
from approxjac.formatting import joined, numbers
from approxjac.law import Linear, Saturation
from approxjac.tasks import Task
from approxjac.validation import Array, as_number

_NAMES = ("s", "S", "ds", "d", "c_bar", "d_bar")
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
    """Refuse what is no `law.Saturation` of the task's m coordinates.

    Raises:
        InvalidInputError: A part is missing or fails, s(0) is not 0 or its slope not 1, s, S and ds
            do not belong together, or eq. (8) does not hold with its constants, at errors from far
            below to far beyond the one at which s saturates.
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
    """Return s(e), S(e) or ds(e), of the shape of e."""
    e.flags.writeable = False
    try:
        value = np.asarray(getattr(saturation, name)(e), dtype=np.float64)
    except Exception as error:
        m = e.shape[-1]
        raise _Fault(
            f"{name}(e) fails for an e of shape {e.shape} with {type(error).__name__}: {error} "
            f"(control has e of shape ({m},), tests of stability (N, {m}), neither to be changed)"
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
    _require_pairs(f, (_PAIRS * scale).reshape(2, -1, m))


def _require_pairs(f: Saturation, e: Array) -> None:
    """Require slopes and eq. (8) at pairs (2, N, m) of errors close to each other."""
    m = e.shape[2]
    s, S, ds = (_value(f, name, e.reshape(-1, m)).reshape(e.shape) for name in ("s", "S", "ds"))

    def hold(holds: Array, rule: str, value: Array | None = None) -> None:
        """Say where a rule, one truth value for each pair, does not hold."""
        if not holds.all():
            k, i = np.unravel_index(np.argmin(holds), holds.shape)
            raise _Fault(
                f"{rule}{'' if value is None else f', here {value[k, i]:.6g}'}, got "
                f"s(e) = {s[0, k, i]:.6g}, S(e) = {S[0, k, i]:.6g} and "
                f"ds(e) = {ds[0, k, i]:.6g} at e = {e[0, k, i]:.6g}"
            )

    for values in (s, S, ds):
        hold(np.isfinite(values[0]), "s, S and ds must be finite")
    which = (7 * np.arange(m)) % e.shape[1], np.arange(m)
    among, together = e[0][which], s[0][which]
    alone = _value(f, "s", among)
    if not (np.abs(alone - together) <= _SLACK * np.abs(together)).all():
        raise _Fault(
            f"s must act entry by entry, got s({among.tolist()}) = {alone.tolist()} and, with "
            f"other entries beside each, {together.tolist()}"
        )
    # mean slopes are between those at the two points, kinks or not
    rise, lean = (s[1] - s[0]) / (e[1] - e[0]), (S[1] - S[0]) / (e[1] - e[0])
    hold(_is_between(rise, ds, _SLACK), "ds(e) must be the slope of s", rise)
    hold(ds[0] >= -_SLACK, "s must not fall anywhere, ds(e) >= 0")
    hold(np.sign(s[0]) == np.sign(e[0]), "s(e) must have the sign of e")
    slack = _SLACK * np.abs(s[0])
    hold(_is_between(lean, s, slack), "s(e) must be the slope of S", lean)

    e_max = float(np.abs(e).max())
    try:
        most = f.d_bar(e_max)
    except Exception as error:
        raise _Fault(
            f"d_bar must be a function of e_max, and it fails for {e_max:g} with "
            f"{type(error).__name__}: {error}"
        ) from error
    constants = {"d": f.d, "c_bar": f.c_bar, "d_bar(e_max)": most}
    d, c_bar, d_bar = (
        as_number(f"{name} of a saturation", value, above=0.0) for name, value in constants.items()
    )
    size, size_s, short = np.abs(e[0]), np.abs(s[0]), 1.0 + _SLACK
    for holds, rule in (
        (size * short >= d * size_s, f"e s(e) >= d s(e)² with d = {d:g}"),
        (S[0] * short >= c_bar * size_s**2, f"S(e) >= c_bar s(e)² with c_bar = {c_bar:g}"),
        (
            d_bar * size_s * short >= size,
            f"d_bar(e_max) s(e)² >= e s(e) with d_bar({e_max:g}) = {d_bar:g}",
        ),
    ):
        hold(holds, f"eq. (8) asks for {rule}")


def _is_between(slope: Array, ends: Array, slack: float | Array) -> Array:
    holds: Array = (ends.min(axis=0) - slack <= slope) & (slope <= ends.max(axis=0) + slack)
    return holds


def describe_saturation(saturation: Saturation, task: Task) -> str:
    """Return s(e) in words, such as "saturation Tanh (gamma 0.058 m)"."""
    name = type(saturation).__name__
    if type(saturation) is Linear:
        return "no saturation"
    if not type(saturation).__module__.startswith("approxjac."):
        return f"saturation {name} (your own)"
    gamma = vars(saturation)["gamma"]
    return f"saturation {name} (gamma {numbers(gamma)} {joined(task.units)})"
