"""Controllers and their gains in plain words, as they are printed."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from approxjac.formatting import joined, listed, numbers, wrapped
from approxjac.law import Linear, Saturation
from approxjac.tasks import Task

if TYPE_CHECKING:
    from approxjac.controllers.gains.gains import Gains
    from approxjac.controllers.setpoint import SetpointController
    from approxjac.controllers.tracking import TrackingController

_GRAVITY = {
    "AdaptiveGravity": "learnt",
    "ModelGravity": "as of the believed arm",
    "NoGravity": "not compensated",
    "RegressorGravity": "as its parameters say",
}


def of_gains(gains: Gains) -> str:
    """Return gains in words."""
    told = [f"K_p {numbers(gains.kp)}", f"K_v {numbers(gains.kv)}"]
    return ", ".join([*told, f"joint damping {numbers(gains.damping)}"])


def of_task(task: Task) -> str:
    """Return a task in words, such as "position task (x, y, z)"."""
    return f"{_spaced(type(task).__name__)} ({', '.join(task.labels)})"


def of_law(law: SetpointController | TrackingController) -> str:
    """Return a law in words, in one line."""
    from approxjac.controllers.tracking import TrackingController

    if isinstance(law, TrackingController):
        kinds = [type(part).__name__ for part in (law.kinematics, law.dynamics)]
        told = " and ".join(_spaced(kind) for kind in kinds)
        told = told.replace("adaptive", "learnt").replace("model", "known")
        return f"tracking law T, alpha {law.alpha:.4g}, kappa {law.kappa:.4g}; {told}"
    number = "(28)" if law.adaptation is not None else "(6)" if law.velocity is None else "(5)"
    name = type(law.gravity).__name__
    gravity = _GRAVITY.get(name, f"by {name}")
    if name == "ModelGravity" and law.gravity.robot != law.task.robot:
        robot = law.gravity.robot
        other = [f"{robot.mass:.4g} kg"] if robot.urdf != law.task.robot.urdf else []
        if (robot.gravity != law.task.robot.gravity).any():
            other.append(f"gravity vector {listed(robot.gravity)} m/s²")
        gravity = f"as of another model: {robot.name} ({', '.join(other)})"
    if name == "NoGravity" and not law.task.robot.gravity.any():
        gravity = "known exactly: the arm is taken without it"
    gains = f"{of_gains(law.gains)}, {of_saturation(law.saturation, law.task)}"
    return f"set-point law {number}, {gains}; gravity {gravity}"


def of_saturation(saturation: Saturation, task: Task) -> str:
    """Return s(e) in words, such as "saturation Tanh (gamma 0.058 m)"."""
    name = type(saturation).__name__
    if type(saturation) is Linear:
        return "no saturation"
    if not type(saturation).__module__.startswith("approxjac."):
        return f"saturation {name} (your own)"
    gamma = vars(saturation)["gamma"]
    return f"saturation {name} (gamma {numbers(gamma)} {joined(task.units)})"


def text(law: SetpointController | TrackingController) -> str:
    """Return a law in words, with its task, and what a rule chose and why."""
    from approxjac.controllers.setpoint import SetpointController

    tuning = law.tuning if isinstance(law, SetpointController) else None
    drawn = "" if isinstance(law, SetpointController) else law._rest.words()
    found = [*wrapped(of_law(law)), *wrapped(f"{of_task(law.task)} of {law.task.robot.name}", "  ")]
    reasons = () if tuning is None else tuning.reasons
    found += wrapped(drawn, "  ") if drawn else []
    return "\n".join([*found, *(line for each in reasons for line in wrapped(each, "  "))])


def _spaced(name: str) -> str:
    """Return the name of a class as words: "PositionTask" as "position task"."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name.strip("_")).lower()
