"""Settings of a visual servoing run that would do nothing are refused by name."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.studies.servo_settings import ServoSettings
from approxjac.validation import as_number

_CHOICES: dict[str, tuple[str, ...]] = {
    "eye": ("to-hand", "in-hand"),
    "law": ("6", "5", "ibvs"),
    "gravity": ("learnt", "exact", "believed", "none"),
}
_DEFAULTS = {field.name: field.default for field in fields(ServoSettings)}


def require_effect(settings: ServoSettings) -> None:
    """Refuse settings that are out of range, and those that were given but would do nothing.

    Raises:
        InvalidInputError: Such settings.
        UnknownNameError: A choice that is none.
    """
    for name, valid in _CHOICES.items():
        if getattr(settings, name) not in valid:
            raise UnknownNameError(name, getattr(settings, name), "the settings", valid)
    rate = as_number("rate", settings.rate, unit="Hz", above=0.0)
    duration = as_number("duration", settings.duration, unit="s", minimum=1.0 / rate)
    as_number("settling_time", settings.settling_time, unit="s", above=0.0)
    if abs(as_number("roll", settings.roll, unit="rad")) > math.pi:
        raise InvalidInputError(
            f"roll must be within -pi and pi [rad], got {settings.roll:g}"
            f" ({math.radians(settings.roll):.4g} rad would be {settings.roll:g} degrees)",
            given=settings.roll,
        )
    as_number("depth_factor", settings.depth_factor, above=0.0)
    if settings.tolerance is not None:
        as_number("tolerance", settings.tolerance, unit="px", above=0.0)
    for name, unit in (("noise", "px"), ("quantum", "px"), ("latency", "s")):
        as_number(name, getattr(settings, name), unit=unit, minimum=0.0)
    if settings.velocity_filter is not None:
        as_number("velocity_filter", settings.velocity_filter, unit="s", minimum=0.0)
    if settings.law == "5":
        as_number("differentiator", settings.differentiator, unit="s", above=0.0)
    if not 0.0 <= settings.dropout <= 1.0:
        raise InvalidInputError(
            f"dropout must be a probability from 0 to 1, got {settings.dropout}",
            given=settings.dropout,
        )
    if settings.seed < 0:
        raise InvalidInputError(f"seed must be >= 0, got {settings.seed}", given=settings.seed)
    if as_number("frame_rate", settings.frame_rate, unit="Hz", above=0.0) > rate:
        raise InvalidInputError(
            f"frame_rate must be at most the rate of control, {rate:g} [Hz], got "
            f"{settings.frame_rate:g}",
            given=settings.frame_rate,
        )
    for name in ("lost", "frozen"):
        interval = getattr(settings, name)
        if interval is not None and not max(0.0, interval[0]) < min(duration, interval[1]):
            raise InvalidInputError(
                f"{name} must be the start and the end of a time within the run, "
                f"0 to {duration:g} [s], got {interval}",
                given=interval,
            )
    if settings.law == "ibvs" and settings.gravity == "learnt":
        raise InvalidInputError(
            "gravity must be exact, believed or none with ibvs, which learns nothing, got learnt",
            given=settings.gravity,
        )
    if settings.law == "5" and settings.depth == "measured":
        raise InvalidInputError(
            "depth must be believed or constant with law 5, which differentiates the image alone, "
            "got measured",
            given=settings.depth,
        )
    in_hand, law = settings.eye == "in-hand", settings.law
    _refuse(settings, "camera_target", in_hand, "is for an eye to hand", "one in hand")
    _refuse(settings, "differentiator", law != "5", "is for law 5", f"law {law}")
    _refuse(settings, "spread", settings.points == 1, "is for several points", "one point")
    for name in ("kp", "kv", "damping"):
        _refuse(settings, name, law == "ibvs", "is a gain of the laws 5 and 6", "ibvs")
    given = all(getattr(settings, name) is not None for name in ("kp", "kv", "damping"))
    _refuse(settings, "settling_time", given, "is for default gains", "given ones")
    # what a camera in hand watches is not the object, which is then no more than a weight
    for kind in ("object", "believed"):
        length, mass = getattr(settings, f"{kind}_length"), getattr(settings, f"{kind}_mass")
        weightless = in_hand and mass == 0.0 and length != 0.0
        _refuse(settings, f"{kind}_length", weightless, f"needs {kind}_mass", "an eye in hand")


def _refuse(settings: ServoSettings, name: str, useless: bool, what: str, where: str) -> None:
    value: Any = getattr(settings, name)
    if useless and value != _DEFAULTS[name]:
        raise InvalidInputError(f"{name} {what}, got {value} with {where}", given=value)
