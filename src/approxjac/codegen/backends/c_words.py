"""Words of a controller in C about itself: units, state, statuses, what it was made from."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator

import numpy as np

from approxjac.codegen.backends.c99 import SampledStep
from approxjac.controllers.controller import Controller
from approxjac.controllers.gravity import Adaptation
from approxjac.controllers.hold import HeldMeasurement
from approxjac.controllers.limits.torque_limited import TorqueLimited
from approxjac.controllers.setpoint import SetpointController
from approxjac.formatting import joined
from approxjac.interface import LimitStatus, Status
from approxjac.tasks import PoseTask, Task
from approxjac.validation import Array

_LINE = 96


def words(controller: Controller, step: SampledStep) -> dict[str, str]:
    """Return the names, sizes and texts that stand in several files."""
    task, robot = controller.task, controller.task.robot
    prefix, n_state = identifier(robot.name), len(step.begun)
    return {
        "prefix": prefix,
        "PREFIX": prefix.upper(),
        "nq": str(robot.nq),
        "nv": str(robot.nv),
        "n_x": str(task.n_x),
        "m": str(task.m),
        "n_state": str(n_state),
        "stored": str(max(n_state, 1)),
        "made_from": _comment(_made_from(controller, step)),
        "q_units": _units_of_q(step),
        "v_units": joined(f"{unit}/s" for unit in robot.joint_units),
        "tau_units": joined("N" if unit == "m" else "N m" for unit in robot.joint_units),
        "x_units": _units_of_x(task),
        "e_units": joined(task.units),
        "state_words": _state_words(step),
        "statuses": _enumeration(prefix, Status),
        "limit_statuses": _enumeration(f"{prefix}_LIMITS", LimitStatus),
    }


def identifier(name: str) -> str:
    """Return a name as C takes it."""
    found = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower()
    return found if found[:1].isalpha() else f"arm_{found}".rstrip("_")


def pairs(step: SampledStep) -> list[int]:
    """Return where (cos, sin) of continuous joints stand in q."""
    joints = list(step.controller.task.robot.model.joints)[1:]
    return [joint.idx_q for joint in joints if joint.nq == 2]


def _made_from(controller: Controller, step: SampledStep) -> Iterator[tuple[str, str]]:
    """Return what a controller was made from: name, text."""
    import approxjac

    law, task, robot = controller.law, controller.task, controller.task.robot
    yield "made by", f"approxjac {approxjac.__version__}"
    yield "robot", f"{robot.name}, as it is believed, {robot.mass:.6g} kg"
    named = zip(robot.joint_names, robot.joint_units, strict=True)
    yield "joints", ", ".join(f"{name} [{unit}]" for name, unit in named)
    yield "task", f"{task!r}, x in {_units_of_x(task)}"
    if isinstance(law, SetpointController):
        yield from _of_law(law)
    else:
        yield "law", repr(law)
    inside = controller
    if isinstance(controller, HeldMeasurement):
        inside = controller.controller
        unseen = _numbers(controller.unseen)
        yield "held", f"the last x that was seen, until it has moved by {unseen}"
    if isinstance(inside, TorqueLimited):
        how = "so that V' <= -W stays where it can" if inside.proof else "clipped"
        yield "limits", f"{'; '.join(_limits(inside))}; {how}"
    else:
        yield "limits", "none"


def _limits(controller: TorqueLimited) -> Iterator[str]:
    """Return the limits that a controller keeps, in words."""
    limits = controller.limits
    for words, value in (
        ("torques {} [N m or N]", limits.effort),
        ("their rates {} [N m/s or N/s]", limits.rate),
        ("speeds {} [rad/s or m/s]", limits.velocity),
        ("accelerations {} [rad/s^2 or m/s^2]", limits.acceleration),
        ("positions from {} [rad or m]", limits.position and limits.position[0]),
        ("to {} [rad or m]", limits.position and limits.position[1]),
    ):
        if np.isfinite(np.asarray(value, dtype=float)).any():
            yield words.format(_numbers(np.asarray(value)))
    yield from map(repr, controller.motion_limits)


def _of_law(law: SetpointController) -> Iterator[tuple[str, str]]:
    """Return gains, saturation, gravity and so on."""
    kp, kv, damping = law.diagonals
    number = "(6)" if law.velocity is None else "(5)"
    if law.adaptation is not None:
        number = "(28), (29)" if law.velocity is None else "(5), (29)"
    yield "law", number
    yield "K_p", f"{_numbers(kp)} [J per unit of e squared]"
    yield "K_v", f"{_numbers(kv)} [J s per unit of e squared]"
    yield "B_c", f"{_numbers(damping)} [N m s/rad or N s/m]"
    gamma = getattr(law.saturation, "gamma", None)
    of = "" if gamma is None else f", gamma = {_numbers(np.asarray(gamma))}"
    yield "s(e)", f"{type(law.saturation).__name__}{of}"
    learning = law.adaptation
    if learning is None:
        yield "gravity", repr(law.gravity)
    else:
        p, forces, torques = learning.sizes
        yield (
            "gravity",
            f"learnt: {p} parameters of {learning.robot.name}, {forces} task forces, {torques} "
            f"joint torques, alpha = {learning.alpha:.6g} [1/s]{_of_rest(learning)}",
        )
    if law.velocity is not None:
        yield "velocity", f"x, filtered with {law.velocity.time_constant:g} s and differentiated"
    yield "posture", "none" if law.posture is None else repr(law.posture)


def _of_rest(learning: Adaptation) -> str:
    if learning.theta0.any():
        return ""
    return "; from 0: all of it is learnt, or the rest where the robot adds its own"


def _numbers(values: Array) -> str:
    return ", ".join(f"{value:.6g}" for value in np.ravel(values))


def _comment(parts: Iterator[tuple[str, str]]) -> str:
    lines: list[str] = []
    for name, text in parts:
        lines += textwrap.wrap(
            f"{name:<9}{_plain(text)}", _LINE, subsequent_indent=" " * 9, break_on_hyphens=False
        )
    return "\n".join(f" * {line}" for line in lines)


def _plain(text: str) -> str:
    """Return a text that ends no comment and begins none."""
    return " ".join(text.split()).replace("*/", "* /").replace("/*", "/ *")


def _enumeration(prefix: str, outcomes: type[Status] | type[LimitStatus]) -> str:
    """Return the members of an enumeration, each after its sentence."""
    lines = []
    for outcome in outcomes:
        said = textwrap.wrap(_plain(outcome.message), _LINE - 10)
        lines += textwrap.wrap(
            f"/* {' '.join(said)} */", _LINE, initial_indent="    ", subsequent_indent="       "
        )
        lines.append(f"    {prefix.upper()}_{outcome.name} = {outcome.value},")
    return "\n".join(lines).rstrip(",")


def _units_of_q(step: SampledStep) -> str:
    units = joined(step.controller.task.robot.joint_units)
    found = [f"q[{i}], q[{i + 1}]" for i in pairs(step)]
    if not found:
        return units
    return f"{units}; (cos, sin) of continuous joints: {' and '.join(found)}"


def _units_of_x(task: Task) -> str:
    if isinstance(task, PoseTask):
        return "m, and a quaternion (x, y, z, w)"
    return joined(task.units) + ("" if task.n_x == task.m else ", and m of depths")


def _state_words(step: SampledStep) -> str:
    n, p, firsts = len(step.begun), step.controller.law.resting, step.firsts
    if n == 0:
        return "This law has none; C has no empty structures."
    followed = [k for k, i in enumerate(firsts) if i is not None]
    end = followed[-1] + 1 if followed else p
    parts = [f"[0] to [{p - 1}] are what is learnt of gravity"] if p else []
    parts += [f"[{p}] to [{end - 1}] are x, filtered"] if followed else []
    parts += [f"[{end}] to [{n - 1}] are what the controller keeps"] if n > end else []
    return f"{'; '.join(parts)}."
