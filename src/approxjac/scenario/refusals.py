"""Parts of a scenario that would do nothing, or contradict each other, are refused by name."""

from __future__ import annotations

import math
from collections.abc import Iterator
from operator import attrgetter
from typing import Any

from approxjac.errors import InvalidInputError
from approxjac.robots.urdf_edit import as_mass, as_size
from approxjac.scenario.scenario import Scenario

_TRACKED = ("position", "pose")  # kinds of tasks that a tracker can be the sensor of


def require_effect(scenario: Scenario) -> None:
    """Refuse what was given but would do nothing, or what contradicts something else."""
    usual = Scenario(scenario.robot)
    for key, useless, what, where in _rules(scenario):
        value = attrgetter(key)(scenario)
        if useless and value != attrgetter(key)(usual):
            raise InvalidInputError(f"{key} {what}, got {value} with {where}", given=value)
    for kind, held in (("true", scenario.true.object), ("believed", scenario.believed.object)):
        for name, size in (("length", held.length), ("radius", held.radius)):
            as_size(f"{kind}.object.{name}", size or 0.0)
        as_mass(f"{kind}.object.mass", held.mass or 0.0)
    for value, message in _faults(scenario):
        raise InvalidInputError(message, given=value)


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
        ("true.inertias", true.engine != "mujoco", "needs true.engine mujoco", true.engine),
        ("task.axes", task.kind in ("pose", "image"), "are those of a position", task.kind),
        ("task.frames", task.kind != "stacked", "are those of a stacked task", task.kind),
        ("task.points", not pinhole, "are those of a pinhole camera's image", task.kind),
        ("task.depth", not pinhole, "is that of a pinhole camera's image", task.kind),
        ("task.spread", task.points == 1, "is for several points", "one point"),
        ("true.camera", not image, "is for task.kind image", task.kind),
        ("true.tracker", task.kind not in _TRACKED, "is for task.kind position or pose", task.kind),
        ("believed.camera", not image, "is for task.kind image", task.kind),
        ("true.camera.looking_at", in_hand, "is for a camera in the world", "one in hand"),
        ("controller.settling_time", gains, "is for default gains", "given ones"),
        ("controller.torque_rate", control.limits == "none", needs, "none"),
        ("sensor.lost_part", scenario.sensor.lost is None, "needs a time in sensor.lost", "none"),
    ]
    tracks, learns = control.law == "tracking", bool(control.unknown)
    for_setpoint = (
        "differentiator",
        "integral_action",
        "settling_time",
        "kp",
        "kv",
        "damping",
        "gamma",
    )
    rules += [
        (f"controller.{name}", tracks, "is of the law setpoint", control.law)
        for name in (*for_setpoint, "posture_stiffness")
    ]
    velocities = control.command == "velocity"
    rules += [
        ("true.servo", not velocities, "needs controller.command velocity", control.command),
        ("controller.command", not tracks, "needs controller.law tracking", control.law),
        ("controller.torque_rate", velocities, "is of torques", control.command),
        ("loop.actuator_delay", velocities, "is of torques: see true.servo", control.command),
        ("controller.unseen", learns, "is of no use where x is predicted", "controller.unknown"),
    ]
    continuous = scenario.loop.dt == "continuous"
    of_control = ("law", "unknown", "torque_rate", "unseen")
    sampled = [*(f"controller.{name}" for name in of_control), "sensor", "loop.actuator_delay"]
    if control.limits != "none":
        sampled.append("controller.limits")
    rules += [(key, continuous, "needs a loop.dt in s", "continuous") for key in sampled]
    # what a camera in hand watches is not the object
    for kind, held in (("true", true.object), ("believed", scenario.believed.object)):
        weightless = in_hand and held.mass == 0.0 and held.length != 0.0
        needs = f"needs {kind}.object.mass"
        rules.append((f"{kind}.object.length", weightless, needs, "a camera in hand"))
    return rules


def _faults(scenario: Scenario) -> Iterator[tuple[Any, str]]:
    """Say which values cannot be, or not with others."""
    dt, run, sensor, task = scenario.loop.dt, scenario.run, scenario.sensor, scenario.task
    if isinstance(dt, float):
        if run.duration < dt:
            wanted = f"a finite number >= loop.dt = {dt:g} [s]"
            yield run.duration, f"run.duration must be {wanted}, got {run.duration}"
        if sensor.rate is not None and sensor.rate > 1.0 / dt * (1.0 + 1e-9):
            wanted = f"at most that of control, {1.0 / dt:g} [Hz]"
            yield sensor.rate, f"sensor.rate must be {wanted}, got {sensor.rate:g}"
    if sensor.delay >= run.duration:
        wanted = f"shorter than the run, {run.duration:g} [s]"
        yield sensor.delay, f"sensor.delay must be {wanted}, got {sensor.delay:g}"
    part, parts = sensor.lost_part, max(task.points, len(task.frames))
    if (part or 1) > parts:
        yield part, f"sensor.lost_part must be one of the parts of x, 1 to {parts}, got {part}"
    for name, interval in (("lost", sensor.lost), ("frozen", sensor.frozen)):
        if interval is not None and not max(0.0, interval[0]) < min(run.duration, interval[1]):
            wanted = f"the start and the end of a time within the run, 0 to {run.duration:g} [s]"
            yield interval, f"sensor.{name} must be {wanted}, got {interval}"
    if sensor.dropout > 1.0:
        wanted = "a probability from 0 to 1"
        yield sensor.dropout, f"sensor.dropout must be {wanted}, got {sensor.dropout}"
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
    if control.law == "tracking" and control.gravity not in ("learnt", "believed"):
        wanted = "learnt or believed with the tracking law (controller.law)"
        yield control.gravity, f"controller.gravity must be {wanted}, got {control.gravity}"
    tracker = scenario.true.tracker
    if tracker != type(tracker)() and task.axes not in (None, "xyz"):
        yield task.axes, f"task.axes must be xyz with true.tracker, got {task.axes}"
    if scenario.controller.differentiator is not None and task.depth == "measured":
        yield (
            task.depth,
            "task.depth must be believed or constant with a differentiator, which differentiates "
            "the image alone, got measured",
        )
    roll = scenario.believed.camera.roll
    if abs(roll) > math.pi:
        yield (
            roll,
            f"believed.camera.roll must be within -pi and pi [rad], got {roll:g}"
            f" ({math.radians(roll):.4g} rad would be {roll:g} degrees)",
        )
