"""`export_c`: a controller as readable C99 code."""

import re
import textwrap
from collections.abc import Iterator
from itertools import chain
from os import PathLike
from pathlib import Path
from string import Template

import numpy as np

from approxjac.codegen.backends.c99 import LANGUAGE, SampledStep, constant, sampled_step, table
from approxjac.codegen.backends.templates import template
from approxjac.codegen.trace.program import Writer
from approxjac.codegen.trace.symbols import LARGEST_ANGLE
from approxjac.codegen.traced_law import pairs
from approxjac.controllers.controller import Controller
from approxjac.controllers.gains.gains import Latency
from approxjac.errors import InvalidInputError
from approxjac.files import refusing, together, write_text
from approxjac.formatting import joined
from approxjac.interface import LimitStatus, Measurement, Status
from approxjac.law.guard import UNSEEN
from approxjac.robots.traced import moved
from approxjac.tasks import PoseTask, Task
from approxjac.validation import Array, require

_LINE = 96
_RUNS, _STEPS = 10, 5  # of the self-test
_LOST = 2  # the step in which x is, in every other run
_OFF_CIRCLE = 1e-3  # what Robot.configuration takes, too


def export_c(controller: Controller, folder: str | PathLike[str]) -> Path:
    """Write a controller as plain C99 that is C++11, too: no allocation, only libm, re-entrant.

    The folder gets controller.h and controller.c, a selftest.c that calls them with recorded steps,
    and a CMakeLists.txt. The header documents functions, units and the controller's origin.

    A step in C equals a step in Python to rounding, and is bit-identical on all machines if the
    compiler neither contracts nor reorders; options that drop NaN are refused. But Python's errors
    are statuses below zero; and learning pauses in a step where the few sweeps that keep gravity
    within its bounds do not converge, or where limits give up the proof and in Python the other
    joints learn: V̇ ≤ −W is not claimed there.

    Args:
        controller: Any controller that can be traced, as for `compiled`.
        folder: Folder to write to; created if missing.

    Returns:
        The folder.

    Raises:
        InvalidInputError: The controller cannot be traced, or the folder not be written to.
    """
    require("controller", controller, Controller, "a controller such as SetpointController(task)")
    require("folder", folder, (str, PathLike), "a folder")
    step = sampled_step(controller)
    named = template_values(step)
    dt = controller.dt or (controller.latency or Latency()).period
    records = _recorded(step, dt)
    named |= _source(step) | {"records": _rows(records), "dt": constant(dt)}
    names = "controller.h", "controller.c", "selftest.c", "CMakeLists.txt"
    filled = {name: Template(template(name)).substitute(named) for name in names}
    path = Path(folder)
    wanted = "folder must be one that can be made and written to"
    with refusing(wanted, folder, (OSError, ValueError)):
        path.mkdir(parents=True, exist_ok=True)
        with together(path) as unfinished:
            for name, text in filled.items():
                write_text(unfinished / name, text)
    return path


def _source(step: SampledStep) -> dict[str, str]:
    first, outputs = len(step.outputs["torque"]), [*chain(*step.outputs.values())]
    state = step.graph.input("state", len(step.outputs["after"]))

    def changed(i: int, _: str, value: str, __: str, keeps: str | None) -> list[str]:
        was = "" if keeps is None else f"{keeps} ? state[{i - first}] : "
        return [f"        after[{i - first}] = {was}{value};"]

    writer = Writer(step.graph, LANGUAGE._replace(changed=changed))
    lines, flat = writer.lines(outputs, [-1] * first + [each.place for each in state])
    if state and "" in flat:
        lines.insert(0, "    memcpy(after, state, N_STATE * sizeof *after);")
    equations = step.graph.equations
    for i, line in enumerate(lines):
        if (assigned := re.search(r" v(\d+) = ", line)) and int(assigned[1]) in equations:
            lines[i] += f" /* law.{equations[int(assigned[1])]} */"
    prefix, nv = identifier(step.controller.task.robot.name), step.controller.task.robot.nv
    places = {
        "torque": "answer->torque[{i}]", "after": "after[{i}]", "e": "answer->e[{i}]",
        "gravity": "answer->gravity[{i}]", "J_hat": "answer->J_hat[{row}][{column}]",
        "status": "answer->status", "limit_status": "answer->limit_status",
        "slack": "answer->slack",
    }  # fmt: skip
    kinds = {name: f"({prefix}_{name})(int)" for name in ("status", "limit_status")}
    stores, values = list[str](), iter(flat)
    for name, numbers in step.outputs.items():
        for i in range(len(numbers)):
            place, value = places[name].format(i=i, row=i // nv, column=i % nv), next(values)
            if value:
                stores.append(f"    {place} = {kinds.get(name, '')}{value};")
    if not step.outputs["after"]:
        stores.append("    after[0] = 0.0;")
    begin, begun = Writer(step.graph, LANGUAGE).lines(step.first)
    begin += table("begun", begun or ["0.0"], is_constant=False)
    begin.append("    memcpy(state->values, begun, sizeof begun);")
    rates = [name for name in ("v", "a") if f"target_{name}" in step.asked]
    finite = (f" && is_finite(target->{name}, {prefix.upper()}_M_X)" for name in rates)
    wrong_t = ["!is_finite(&now->t, 1)"] if "t" in step.asked else []
    if "t_x" in step.asked:
        wrong_t += ["now->t_x > DBL_MAX", "now->t_x - now->t > 1.0"]
    refused = f"return refused(answer, {prefix.upper()}_REFUSED_T);"
    t_checks = f"    if (!is_bridged && ({' || '.join(wrong_t)})) {{\n        {refused}\n    }}\n"
    return {
        "lines": "\n".join(lines),
        "stores": "\n".join(stores),
        "nowhere": ", ".join(["NAN"] * step.sizes["x"]),
        "helpers": template("power_of_two.c") if "power_of_two" in "".join(lines + begin) else "",
        "q_checks": _q_checks(step),
        "first": "\n".join([*begin, "    (void)now;"]),
        "t_checks": t_checks if wrong_t else "",
        "rate_checks": "".join(finite),
    } | _guarded(step)


def _guarded(step: SampledStep) -> dict[str, str]:
    """Return the texts of a step with a guard, whose memory begins with a time."""
    at, never = step.controller.size, constant(0.5 * UNSEEN)
    if len(step.first) == at:
        return {"is_bridged": "0", "unguarded": "", "is_unseen": ""}
    unguarded = Template(template("unguarded.c"))
    return {
        "is_bridged": f"kept[{at}] > {never}",
        "unguarded": unguarded.substitute(at=at, unseen=constant(UNSEEN)),
        "is_unseen": f"\n        || after[{at}] < {never}",
    }


def _q_checks(step: SampledStep) -> str:
    of_pairs = pairs(step.controller.task.robot)
    angles = set(range(step.controller.task.robot.nq)) - {i + k for i in of_pairs for k in (0, 1)}
    holds = [f"fabs(q[{i}]) <= {LARGEST_ANGLE!r}" for i in sorted(angles)]
    holds += [
        f"fabs(sqrt(q[{i}] * q[{i}] + q[{i + 1}] * q[{i + 1}]) - 1.0) <= {_OFF_CIRCLE!r}"
        for i in of_pairs
    ]
    return "\n        && ".join(holds)


Record = dict[str, Array]
_MEASURED, _WANTED = ("t", "q", "v", "x", "t_x"), ("target", "target_v", "target_a")


def _recorded(step: SampledStep, dt: float) -> list[Record]:
    """Return runs from random configurations, step by step, with what is answered.

    In the last step of every third run q̇ is wrong, which a guard finds.
    """
    task, rng = step.controller.task, np.random.default_rng(0)
    robot, m, function = task.robot, task.measured.m, step.in_numpy()
    runs: list[list[Record]] = [[] for _ in range(_RUNS)]
    states, places = np.zeros((len(step.first), _RUNS)), list[Array]()
    for k in range(_STEPS):
        given = []
        for run in range(_RUNS):
            v = np.sin(np.arange(robot.nv) + run + 1e-3 * k)
            if k == 0:
                places.append(robot.random_configuration(rng))
            else:
                places[run] = moved(robot, places[run], dt * v)
            q, v = places[run], v + 1e3 * (k == _STEPS - 1 and run % 3 == 0)
            x = task.value(q) + rng.normal(scale=0.002, size=task.n_x)
            seen = np.where(np.isfinite(x), x, task.origin)  # or there would be no target
            target = seen + rng.normal(scale=0.02 if run % 2 else 0.5, size=task.n_x)
            if k == 0:
                x = seen
                states[:, run] = step.initial_state(Measurement(0.0, q, v, x, 0.0))
            if k == _LOST and run % 2:
                x = np.full(task.n_x, np.nan)
            rates = rng.normal(scale=0.1, size=(2, m)) * (run % 2)
            now = np.array([k * dt])
            given.append({
                "t": now, "q": q, "v": v, "x": x, "t_x": now,
                "target": target, "target_v": rates[0], "target_a": rates[1],
            })  # fmt: skip
        columns = {name: np.stack([each[name] for each in given], 1) for name in given[0]}
        answer = function(**columns, state=states, dt=np.full((1, _RUNS), dt))
        for run, own in enumerate(given):
            own |= {name: value[:, run] for name, value in answer.items()}
            # a law of one's own may have no answer where x is lost, which C refuses
            if np.isfinite(own["torque"]).all() and np.isfinite(own["after"]).all():
                states[:, run] = own["after"]
                if k == 0 or runs[run]:
                    runs[run].append(own | {"begins": np.array([k == 0])})
    records = [record for run in runs for record in run]
    if not records:
        message = f"controller must answer with a finite torque, got none of {step.controller!r}"
        raise InvalidInputError(message, given=step.controller)
    return records


def _rows(records: list[Record]) -> str:
    rows = []
    for record in records:
        if not len(record["after"]):
            record = record | {"after": np.zeros(1)}
        parts = [
            *(_braced([_of(record, name) for name in names]) for names in (_MEASURED, _WANTED)),
            *(_of(record, name) for name in ("torque", "after")),
            constant(float(record["slack"][0])),
            *(str(int(record[name][0])) for name in ("status", "limit_status", "begins")),
        ]
        rows.append("    {" + ",\n     ".join(parts) + "}")
    return ",\n".join(rows)


def _of(record: Record, name: str) -> str:
    numbers = [constant(value) for value in record[name].tolist()]
    return numbers[0] if name in ("t", "t_x") else _braced(numbers)


def _braced(parts: list[str]) -> str:
    return f"{{{', '.join(parts)}}}"


# -- the description of a controller --------------------------------------------------------------


def template_values(step: SampledStep) -> dict[str, str]:
    """Return the names, sizes and texts for the files' templates."""
    controller, task, robot = step.controller, step.controller.task, step.controller.task.robot
    prefix, n_state = identifier(robot.name), len(step.first)
    tau = joined(robot.force_units)
    speed = joined(f"{unit}/s" for unit in robot.joint_units)
    commands = f"joint torques to send [{tau}]"
    if controller.command == "velocity":
        commands = f"joint velocities to send [{speed}]"
    return {
        "prefix": prefix,
        "PREFIX": prefix.upper(),
        "is_finite": template("is_finite.c"),
        "nq": str(robot.nq),
        "nv": str(robot.nv),
        "n_x": str(task.n_x),
        "m": str(task.m),
        "m_x": str(task.measured.m),
        "n_state": str(n_state),
        "stored": str(max(n_state, 1)),
        "made_from": _comment(_made_from(controller)),
        "tau_units": tau,
        "commands": commands,
        "e_units": joined(task.units),
        "state_words": _state_words(step),
        "statuses": _enumeration(prefix, Status),
        "limit_statuses": _enumeration(f"{prefix}_LIMITS", LimitStatus),
    } | _fields(step)


def _fields(step: SampledStep) -> dict[str, str]:
    task, law = step.controller.task, step.controller.law
    x_units = _units_of_x(task)
    speeds = joined(f"{unit}/s" for unit in task.robot.joint_units)
    lost = "the torque is damping and gravity, nothing is learnt"
    if law.kinematics is not None:
        lost = "the predicted one takes its place"
    rates = joined(f"{unit}/s" for unit in task.measured.units)
    units = joined(task.robot.joint_units)
    if circles := [f"q[{i}], q[{i + 1}]" for i in pairs(step.controller.task.robot)]:
        units += f"; (cos, sin) of continuous joints: {' and '.join(circles)}"
    texts = {
        "t": "time [s]",
        "q": f"joint positions [{units}]",
        "v": f"joint velocities [{speeds}]",
        "x": f"task value [{x_units}]; where a number is not finite, {lost}",
        "t_x": "when x was taken, by the clock of t [s]; NAN or -INFINITY where it is not known",
        "target": f"task value [{x_units}]",
        "target_v": f"its rate [{rates}], and the rate of that",
    }
    return {
        f"{name}_comment": _said(text + ("" if name in step.asked else "; not looked at"))
        for name, text in texts.items()
    }


def _said(text: str) -> str:
    lines = textwrap.wrap(f"/* {text} */", _LINE, initial_indent=" " * 4, subsequent_indent=" " * 7)
    return "\n".join(lines)


def identifier(name: str) -> str:
    """Return a name as a valid C identifier."""
    word = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_").lower()
    return word if word[:1].isalpha() else f"arm_{word}".rstrip("_")


def _made_from(controller: Controller) -> Iterator[tuple[str, str]]:
    import approxjac

    task, robot = controller.task, controller.task.robot
    first, _, *others = controller.describe()
    yield "made by", f"approxjac {approxjac.__version__}"
    yield "robot", f"{robot.name}, as it is believed, {robot.mass:.6g} kg"
    named = zip(robot.joint_names, robot.joint_units, strict=True)
    yield "joints", ", ".join(f"{name} [{unit}]" for name, unit in named)
    yield "task", f"{task!r}, x in {_units_of_x(task)}"
    yield "law", "; ".join([first, *others])
    yield "as made", repr(controller)
    yield "posture", repr(getattr(controller.law, "posture", None))
    yield "limits", repr(controller.limits) if controller.limits else "none"


def _comment(parts: Iterator[tuple[str, str]]) -> str:
    lines: list[str] = []
    for name, text in parts:
        lines += textwrap.wrap(
            f"{name:<9}{_plain(text)}", _LINE, subsequent_indent=" " * 9, break_on_hyphens=False
        )
    return "\n".join(f" * {line}" for line in lines)


def _plain(text: str) -> str:
    return " ".join(text.split()).replace("*/", "* /").replace("/*", "/ *")


def _enumeration(prefix: str, outcomes: type[Status] | type[LimitStatus]) -> str:
    """Return the members of an enumeration, each after its sentence."""
    lines = list[str]()
    for outcome in outcomes:
        lines.append(_said(_plain(outcome.message)))
        lines.append(f"    {prefix.upper()}_{outcome.name} = {outcome.value},")
    return "\n".join(lines).rstrip(",")


def _units_of_x(task: Task) -> str:
    if isinstance(task, PoseTask):
        return "m, and a quaternion (x, y, z, w)"
    return joined(task.units) + ("" if task.n_x == task.m else ", and m of depths")


def _state_words(step: SampledStep) -> str:
    law, size, n = step.controller.law, step.controller.size, len(step.first)
    if n == 0:
        return "/* What goes from step to step. This law has none; C has no empty structures. */"
    p, filtered = law.resting, 0 if getattr(law, "velocity", None) is None else law.task.n_x
    of, end = "gravity" if law.kinematics is None else "motion", p + filtered
    parts = [f"[0] to [{p - 1}] are what is learnt of {of}"] if p else []
    parts += [f"[{p}] to [{end - 1}] are x, filtered"] if filtered else []
    parts += [f"[{end}] to [{size - 1}] are what the controller keeps"] if size > end else []
    parts += [f"[{size}] to [{n - 1}] are the last good sample and what tells bad ones"] * (
        n > size
    )
    text = f"/* What goes from step to step. {'; '.join(parts)}. */"
    return "\n".join(textwrap.wrap(text, _LINE, subsequent_indent="   "))
