"""Checks of the arguments of a step, and of options of learnt kinematics."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from approxjac.errors import InvalidInputError, MeasurementError, require_known
from approxjac.formatting import one_line
from approxjac.interface import Measurement, Target
from approxjac.tasks import Task
from approxjac.validation import Array, as_number, as_vector, require

FLOAT64 = np.dtype(np.float64)
HUGE = 1e30  # below it nothing overflows in the law with gains that make sense
LONGEST_DELAY = 1.0  # of a sensor [s]: one that is longer is in milliseconds
_NEARLY = 1e-3  # of a rotation, with the round-off of days
_NUMBERS = (list, tuple, int, float)
_ARRAYS = ("q", "v", "x", "target", "state")


def as_measurement(value: Any) -> Measurement:
    """Return a `Measurement` with times that are floats, or symbols; raise for anything else."""
    require("measurement", value, Measurement, "Measurement(t, q, v, x)")
    t, q, _, _, t_x = value
    if hasattr(q, "arm_of") or (type(t) is float and (t_x is None or type(t_x) is float)):
        return value
    t = t if isinstance(t, float) else as_number("t of a measurement", t, unit="s")
    return value._replace(t=t, t_x=t_x if t_x is None or isinstance(t_x, float) else time_of_x(t_x))


def require_arrays(
    state: Array, measurement: Measurement, target: Array, task: Task, n_state: int
) -> tuple[Array, Array, Array]:
    """Return q, v and x; raise an InvalidInputError if an argument is no array of its size."""
    _, q, v, x, _ = as_measurement(measurement)
    arrays, n_x = (q, v, x, target, state), task.n_x
    sizes = task.robot.nq, task.robot.nv, n_x, n_x, n_state
    usual = [type(a) is np.ndarray and a.dtype is FLOAT64 and a.shape for a in arrays]
    if usual != [(size,) for size in sizes]:
        for name, value, size in zip(_ARRAYS, arrays, sizes, strict=True):
            require_array(name, value, size, task)
    return q, v, x


def require_array(name: str, value: Array, size: int, task: Task) -> None:
    """Raise an InvalidInputError unless a value is a float vector of the task's size."""
    is_array = isinstance(value, np.ndarray) and not isinstance(value, np.ma.MaskedArray)
    if is_array and value.shape == (size,) and value.dtype == FLOAT64:
        return
    given, how = type(value).__name__, ""
    if isinstance(value, np.ma.MaskedArray):  # by chance it would do as if nothing was hidden
        given, how = "a masked one", f"; {name}.filled(numpy.nan) makes a lost entry NaN"
    elif is_array and value.shape == (size,):  # differences of unsigned pixels would wrap around
        given, how = str(value.dtype), f"; {name}.astype(float) makes one of numbers"
    elif is_array:
        given = str(value.shape)
        if value.size == size:  # such as corners, one a row
            how = f"; {name}.ravel() makes one"
        elif name == "q" and value.shape == (task.robot.nv,):  # continuous joints have (cos, sin)
            how = "; task.robot.configuration(q) makes one of one angle a joint"
    elif isinstance(value, _NUMBERS):
        how = f"; numpy.array({name}, dtype=float) makes one of numbers"
    raise InvalidInputError(
        f"{name} must be an array of shape {(size,)} of float64 for {task!r}, got {given}{how}",
        given=value,
    )


def with_rates(target: Target, m: int) -> Target:
    """Return a target with ẋ_d and ẍ_d, if any, checked to be finite vectors (m,)."""
    x, v, a = target
    if v is None and a is None:
        return target
    v = None if v is None else as_vector("v of the target", v, m)
    return Target(x, v, None if a is None else as_vector("a of the target", a, m))


def require_finite(q: Array, v: Array, target: Array, state: Array, task: Task) -> None:
    """Raise an error if an argument other than x is not finite."""
    for name, value in (("q", q), ("v", v)):
        if not np.isfinite(value).all():
            raise MeasurementError(
                f"{name} must be finite, got {value.tolist()}: no safe torque exists without "
                "the joint state; stop the robot",
                given=value,
            )
    if not np.isfinite(state).all():
        raise InvalidInputError(f"state must be finite, got {state.tolist()}", given=state)
    if (np.abs(task.target(target)) > HUGE).any():
        message = f"target must be at most {HUGE:.0e}, got {target.tolist()}"
        raise InvalidInputError(message, given=target)


def time_of_x(t_x: Any) -> float | None:
    """Return the checked time at which x was taken [s]; None if unknown, or −inf (never)."""
    if t_x is None or (isinstance(t_x, float) and t_x < math.inf):
        return None if t_x == -math.inf else t_x
    return as_number("t_x of a measurement", t_x, unit="s")


def from_another_clock(t: float, t_x: float | None, most: float) -> str:
    """Return an error text if x was taken more than `most` [s] after t (another clock), else ""."""
    if t_x is None or not t_x - t > most:
        return ""
    return f"x was taken {t_x - t:.3g} s after t: two clocks?"


def overflow(measurement: Measurement) -> MeasurementError:
    """Return the error for a torque that is not finite."""
    _, q, v, x, _ = measurement
    return MeasurementError(
        f"the torque overflows or is no number at q = {q.tolist()}, v = {v.tolist()}, "
        f"x = {x.tolist()}: they are beyond what the law, or a task, saturation or kinematics of "
        "your own, is for",
        given=measurement,
    )


def sampling_time(dt: Any, known: float | None, latency: Any) -> float:
    """Return dt [s]; if it is None, the one that is known, else the latency's period, else 1 ms."""
    if dt is None:
        dt = known or (1e-3 if latency is None else latency.period)
    return as_number("dt", dt, unit="s", above=0.0)


def require_dt(dt: float, sampling_time: float) -> None:
    """Raise an InvalidInputError if dt [s] is not the controller's."""
    dt = as_number("dt", dt, unit="s", above=0.0)
    if not math.isclose(dt, sampling_time):
        wanted = f"that of the controller, {sampling_time:g} [s]"
        raise InvalidInputError(f"dt must be {wanted}, got {dt!r}", given=dt)


def chosen_kinds(unknown: Any, valid: Sequence[str]) -> tuple[str, ...]:
    """Return the kinds of unknown parameters, checked to be one or more of the valid ones."""
    try:
        kinds = (unknown,) if isinstance(unknown, str) else tuple(unknown)
    except TypeError:
        kinds = ()
    if not kinds or any(not isinstance(kind, str) or kind not in valid for kind in kinds):
        message = f"unknown must be one or more of {', '.join(valid)}, got {one_line(unknown)}"
        raise InvalidInputError(message, given=unknown)
    return kinds


def chosen_deviations(
    sd: Any, usual: Mapping[str, float], used: Collection[str]
) -> dict[str, float]:
    """Return plausible errors by kind: those given, else the usual ones.

    Raises an error for a kind that is unknown or not used, as it would have no effect.
    """
    given = {} if sd is None else sd
    require("sd", given, Mapping, f"a mapping from some of {', '.join(usual)} to numbers")
    for kind in given:
        require_known("kind", kind, "sd", usual)
        if kind not in used:
            some = ", ".join(each for each in usual if each in used)
            raise InvalidInputError(
                f"sd must be of unknown parameters, {some}, got one of {kind}, which is taken as "
                "known; add it to unknown",
                given=sd,
            )
    return {
        kind: as_number(f"sd of {kind}", given.get(kind, value), above=0.0)
        for kind, value in usual.items()
    }


def is_rotation(R: Array) -> bool:
    """Return True if R (d, d) is a rotation."""
    return bool(np.abs(R.dot(R.T) - np.eye(len(R))).max() < _NEARLY)
