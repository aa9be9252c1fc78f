"""Parts of a scenario that would do nothing, or contradict each other, are refused by name."""

from __future__ import annotations

import math
from typing import Any

from approxjac.errors import InvalidInputError
from approxjac.scenario.scenario import Scenario


def require_effect(scenario: Scenario) -> None:
    """Refuse what was given but would do nothing, or what contradicts something else.

    Raises:
        InvalidInputError: Such a value.
    """
    usual = Scenario(scenario.robot)
    for key, useless, what, where in _rules(scenario):
        value = _value(scenario, key)
        if useless and value != _value(usual, key):
            raise InvalidInputError(f"{key} {what}, got {value} with {where}", given=value)
    _require_times(scenario)
    _require_one_goal(scenario)
    roll = scenario.believed.camera.roll
    if abs(roll) > math.pi:
        raise InvalidInputError(
            f"believed.camera.roll must be within -pi and pi [rad], got {roll:g}"
            f" ({math.radians(roll):.4g} rad would be {roll:g} degrees)",
            given=roll,
        )
    if scenario.sensor.dropout > 1.0:
        raise InvalidInputError(
            f"sensor.dropout must be a probability from 0 to 1, got {scenario.sensor.dropout}",
            given=scenario.sensor.dropout,
        )


def _rules(scenario: Scenario) -> list[tuple[str, bool, str, str]]:
    """Return keys that may do nothing, whether they do here, their use, and what there is."""
    task, control, true = scenario.task, scenario.controller, scenario.true
    image = task.kind == "image"
    pinhole = image and true.camera.kind == "pinhole"
    in_hand = pinhole and true.camera.mount is not None
    needs = 'needs controller.limits, "urdf" or a share of the URDF\'s such as 0.5'
    gains = None not in (control.kp, control.kv, control.damping)
    rules = [
        ("true.floor", true.engine != "mujoco", "needs true.engine mujoco", true.engine),
        ("task.axes", task.kind in ("pose", "image"), "are those of a position", task.kind),
        ("task.frames", task.kind != "stacked", "are those of a stacked task", task.kind),
        ("task.points", not pinhole, "are those of a pinhole camera's image", task.kind),
        ("task.depth", not pinhole, "is that of a pinhole camera's image", task.kind),
        ("task.spread", task.points == 1, "is for several points", "one point"),
        ("true.camera", not image, "is for task.kind image", task.kind),
        ("believed.camera", not image, "is for task.kind image", task.kind),
        ("true.camera.looking_at", in_hand, "is for a camera in the world", "one in hand"),
        ("controller.settling_time", gains, "is for default gains", "given ones"),
        ("controller.torque_rate", control.limits is None, needs, "none"),
        ("sensor.lost_part", scenario.sensor.lost is None, "needs a time in sensor.lost", "none"),
    ]
    if isinstance(scenario.loop.dt, str):
        at = "needs a loop.dt in s"
        rules += [(f"controller.{name}", True, at, "continuous") for name in ("limits", "unseen")]
        rules += [
            ("sensor", True, at, "continuous"),
            ("loop.actuator_delay", True, at, "continuous"),
        ]
    for kind in ("true", "believed"):  # what a camera in hand watches is not the object
        held = _value(scenario, f"{kind}.object")
        weightless = in_hand and held.mass == 0.0 and held.length != 0.0
        needs = f"needs {kind}.object.mass"
        rules.append((f"{kind}.object.length", weightless, needs, "a camera in hand"))
    return rules


def _require_times(scenario: Scenario) -> None:
    dt, duration = scenario.loop.dt, scenario.run.duration
    if isinstance(dt, float):
        if duration < dt:
            raise InvalidInputError(
                f"run.duration must be a finite number >= loop.dt = {dt:g} [s], got {duration}",
                given=duration,
            )
        rate = scenario.sensor.rate
        if rate is not None and rate > 1.0 / dt * (1.0 + 1e-9):
            raise InvalidInputError(
                f"sensor.rate must be at most that of control, {1.0 / dt:g} [Hz], got {rate:g}",
                given=rate,
            )
    parts = max(scenario.task.points, len(scenario.task.frames))
    if (scenario.sensor.lost_part or 1) > parts:
        raise InvalidInputError(
            f"sensor.lost_part must be one of the parts of x, 1 to {parts}, got "
            f"{scenario.sensor.lost_part}",
            given=scenario.sensor.lost_part,
        )
    for name in ("lost", "frozen"):
        interval = getattr(scenario.sensor, name)
        if interval is not None and not max(0.0, interval[0]) < min(duration, interval[1]):
            raise InvalidInputError(
                f"sensor.{name} must be the start and the end of a time within the run, "
                f"0 to {duration:g} [s], got {interval}",
                given=interval,
            )


def _require_one_goal(scenario: Scenario) -> None:
    goal, control = scenario.run.target, scenario.controller
    given = {name for name, value in vars(goal).items() if value != getattr(type(goal)(), name)}
    if len(given) > 1:
        raise InvalidInputError(
            f"run.target must not both be given as {' and as '.join(sorted(given))}",
            given=given,
        )
    if control.differentiator is not None and scenario.task.depth == "measured":
        raise InvalidInputError(
            "task.depth must be believed or constant with a differentiator, which differentiates "
            "the image alone, got measured",
            given=scenario.task.depth,
        )


def _value(scenario: Scenario, key: str) -> Any:
    value: Any = scenario
    for name in key.split("."):
        value = getattr(value, name)
    return value
