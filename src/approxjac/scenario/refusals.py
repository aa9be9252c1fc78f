"""Checks for keys of a scenario that would have no effect, or contradict each other."""

import math
from collections.abc import Iterable, Iterator
from operator import attrgetter
from typing import Any

from approxjac.errors import InvalidInputError
from approxjac.robots.urdf import as_size
from approxjac.scenario.convert import typed_as
from approxjac.scenario.records import Tracker
from approxjac.scenario.scenario import Scenario

_OF_SETPOINT = ["settling_time", "kp", "kv", "damping", "gamma"]
_OF_SETPOINT += ["differentiator", "integral_action"]
Rule = tuple[str, bool, str, str]
"""A key that may do nothing, whether it does here, its use, and what there is in its place."""


def refuse(scenario: Scenario, rules: Iterable[Rule]) -> None:
    """Raise an InvalidInputError for a given key without effect, by some rules."""
    usual = Scenario(scenario.robot)
    for key, useless, what, there_is in rules:
        value = attrgetter(key)(scenario)
        if useless and value != attrgetter(key)(usual):
            given = typed_as(value) if isinstance(value, tuple) else value
            where = f" with {there_is}" if there_is else ""
            raise InvalidInputError(f"{key} {what}, got {given}{where}", given=value)


def require_effect(scenario: Scenario) -> None:
    """Raise an InvalidInputError for keys without effect, or that contradict each other."""
    refuse(scenario, _rules(scenario))
    for kind, held in (("true", scenario.true.object), ("believed", scenario.believed.object)):
        for name, size in (("length", held.length), ("radius", held.radius)):
            as_size(f"{kind}.object.{name}", size or 0.0)
        as_size(f"{kind}.object.mass", held.mass or 0.0, "kg")
    for value, message in _faults(scenario):
        raise InvalidInputError(message, given=value)


def require_reportable(scenario: Scenario) -> None:
    """Raise an InvalidInputError for a scenario that a stability report does not cover."""
    kind = scenario.task.kind
    fixed = "must be left out of a report, which is about a fixed Jacobian"
    adds = scenario.controller.gravity == "learn_residual"
    none = "must be learnt, exact, believed or none in a report, which is of robots that add none"
    rules = [
        ("controller.unknown", True, fixed, ""),
        ("controller.law", scenario.controller.law == "tracking", fixed, ""),
        ("controller.gravity", adds, none, ""),
        ("stability.map_points", scenario.stability.map_points == 1, "must be 0 or >= 2", ""),
    ]
    for name in ("focal_length", "distance", "roll", "tilt", "shift"):
        rules.append((f"stability.{name}", kind != "image", "needs task.kind image", kind))
    refuse(scenario, rules)


def _rules(scenario: Scenario) -> Iterator[Rule]:
    task, control, true = scenario.task, scenario.controller, scenario.true
    image = task.kind == "image"
    pinhole = image and true.camera.kind == "pinhole"
    in_hand = pinhole and true.camera.mount is not None
    tracks, learns = control.law == "tracking", bool(control.unknown)
    velocities = control.command == "velocity"
    gains = None not in (control.kp, control.kv, control.damping)
    tracked = task.kind in ("position", "pose")
    yield from [
        ("true.floor", true.engine != "mujoco", "needs true.engine mujoco", true.engine),
        ("task.axes", task.kind in ("pose", "image"), "are those of a position", task.kind),
        ("task.frames", task.kind != "stacked", "are those of a stacked task", task.kind),
        ("task.points", not pinhole, "are those of a pinhole camera's image", task.kind),
        ("task.depth", not pinhole, "is that of a pinhole camera's image", task.kind),
        ("task.spread", task.points == 1, "is for several points", "one point"),
        ("true.camera", not image, "is for task.kind image", task.kind),
        ("true.tracker", not tracked, "is for task.kind position or pose", task.kind),
        ("believed.camera", not image, "is for task.kind image", task.kind),
        ("true.camera.looking_at", in_hand, "is for a camera in the world", "one in hand"),
        ("controller.settling_time", gains, "is for default gains", "given ones"),
        ("true.drives", velocities, "is for a robot that takes torques", control.command),
        ("true.servo", not velocities, "needs controller.command velocity", control.command),
        ("controller.command", not tracks, "needs controller.law tracking", "setpoint"),
        ("controller.detours", not tracks, "needs controller.law tracking", "setpoint"),
        ("controller.self_motion", not tracks, "needs controller.law tracking", "setpoint"),
        ("controller.unseen", learns, "is of no use where x is predicted", "controller.unknown"),
    ]
    for name in _OF_SETPOINT:
        yield f"controller.{name}", tracks, "is of the law setpoint", "tracking"
    sampled = [f"controller.{k}" for k in ("unknown", "unseen", *["law"] * tracks)]
    sampled += ["sensor", "loop.actuator_delay", "true.drives"]
    if control.limits != "none":
        sampled.append("controller.limits")
    for key in sampled:
        yield key, scenario.loop.dt == "continuous", "needs a loop.dt in s", "continuous"
    # what a camera in hand watches is not the object
    for kind, held in (("true", true.object), ("believed", scenario.believed.object)):
        weightless = in_hand and held.mass == 0.0 and held.length != 0.0
        yield f"{kind}.object.length", weightless, f"needs {kind}.object.mass", "a camera in hand"


def _faults(scenario: Scenario) -> Iterator[tuple[Any, str]]:
    dt, run, sensor, task = scenario.loop.dt, scenario.run, scenario.sensor, scenario.task

    def wrong(key: str, wanted: str, given: Any = None) -> tuple[Any, str]:
        value = attrgetter(key)(scenario)
        return value, f"{key} must be {wanted}, got {value if given is None else given}"

    if isinstance(dt, float):
        if run.duration < dt:
            yield wrong("run.duration", f"a finite number >= loop.dt = {dt:g} [s]")
        if sensor.rate is not None and sensor.rate > 1.0 / dt * (1.0 + 1e-9):
            most = f"at most that of control, {1.0 / dt:g} [Hz]"
            yield wrong("sensor.rate", most, f"{sensor.rate:g}")
    if sensor.delay >= run.duration:
        shorter = f"shorter than the run, {run.duration:g} [s]"
        yield wrong("sensor.delay", shorter, f"{sensor.delay:g}")
    for name, interval in (("lost", sensor.lost), ("frozen", sensor.frozen)):
        if interval is not None and not max(0.0, interval[0]) < min(run.duration, interval[1]):
            within = f"the start and the end of a time within the run, 0 to {run.duration:g} [s]"
            yield wrong(f"sensor.{name}", within)
    if sensor.dropout > 1.0:
        yield wrong("sensor.dropout", "a probability from 0 to 1")
    goal = run.target
    for path, leads in (("circle", "radius"), ("line", "offset"), ("waypoints", "points")):
        half = getattr(goal, path)
        if getattr(half, leads) is None and half != type(half)():
            yield half, f"run.target.{path} must have its {leads}, got none"
    given = {name for name, value in vars(goal).items() if value != getattr(type(goal)(), name)}
    if len(given) > 1:
        ways = " and ".join(f"run.target.{name}" for name in sorted(given))
        yield given, f"{ways} must not both be given, as there is one target"
    control = scenario.controller
    if control.law == "tracking" and control.gravity not in (None, "learnt", "believed"):
        wanted = "learnt or believed with the tracking law (controller.law)"
        yield wrong("controller.gravity", wanted)
    if scenario.true.tracker != Tracker() and task.axes not in (None, "xyz"):
        yield wrong("task.axes", "xyz with true.tracker")
    if control.differentiator is not None and task.depth == "measured":
        alone = "believed or constant with a differentiator, which differentiates the image alone"
        yield wrong("task.depth", alone)
    roll = scenario.believed.camera.roll
    if abs(roll) > math.pi:
        degrees = f"{roll:g} ({math.radians(roll):.4g} rad would be {roll:g} degrees)"
        yield wrong("believed.camera.roll", "within -pi and pi [rad]", degrees)
