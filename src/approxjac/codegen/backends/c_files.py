"""`export_c`: a controller as C99 that anyone can read, build and call."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from string import Template

import numpy as np

from approxjac.codegen.backends import c_templates as templates
from approxjac.codegen.backends.c99 import SampledStep, constant, sampled_step
from approxjac.codegen.backends.c_words import identifier, pairs, words
from approxjac.codegen.trace.symbols import LARGEST_ANGLE
from approxjac.controllers.controller import Controller
from approxjac.controllers.gains.latency import Latency
from approxjac.controllers.limits.torque_limited import TorqueLimited
from approxjac.errors import InvalidInputError
from approxjac.files import reason, together, write_text
from approxjac.validation import Array, require

_RECORDED, _SHOWN = 50, 4  # steps of the self-test, and of the example
_LOST = 10  # x is, every so many steps
_OFF_CIRCLE = 1e-3  # what Robot.configuration takes, too


def export_c(controller: Controller, folder: str | PathLike[str]) -> Path:
    """Write a controller as plain C99: no allocation, no library but libm, re-entrant.

    The folder gets controller.h and controller.c, an example main.c, a selftest.c with recorded
    steps, and a CMakeLists.txt. The header says what to call, in which units, and what the
    controller was made from.

    A step in C is a step in Python, to rounding, and the same bits wherever the compiler contracts
    and reorders nothing. But targets are at rest; what Python raises an error for has a status
    below zero; and where gravity is learnt and the few sweeps that keep it within its bounds do not
    end, learning rests for that step, for which V̇ ≤ −W is not claimed.

    Args:
        controller: Any that takes symbols: a `SetpointController`, also with a task, saturation or
            gravity of your own; one in a `HeldMeasurement`, or in a `TorqueLimited` with limits of
            effort alone and a weight that is a diagonal; or a controller of your own.
        folder: Where to write; made if it is not there.

    Returns:
        The folder.

    Raises:
        InvalidInputError: A controller that is not covered, or a folder that cannot be made.
    """
    require("controller", controller, Controller, "a controller such as SetpointController(task)")
    require("folder", folder, (str, PathLike), "a folder")
    step = sampled_step(controller)
    named = words(controller, step)
    dt = _period(controller)
    records = _recorded(step, dt)
    filled = {
        "controller.h": _filled(templates.HEADER, named),
        "controller.c": _filled(templates.SOURCE, named | _source(step)),
        "main.c": _filled(templates.EXAMPLE, named | _example(records) | {"dt": repr(float(dt))}),
        "selftest.c": _filled(
            templates.SELFTEST, named | {"records": _rows(records), "dt": constant(dt)}
        ),
        "CMakeLists.txt": _filled(templates.CMAKE, named),
    }
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"folder must be one that can be made, got {folder}: {reason(error)}", given=folder
        ) from error
    with together(path) as unfinished:
        for name, text in filled.items():
            write_text(unfinished / name, text)
    return path


def _period(controller: Controller) -> float:
    """Return the period that a controller was made for [s]; 1 ms where it does not say."""
    if isinstance(controller, TorqueLimited):
        return controller._dt
    return controller.dt or (controller.latency or Latency()).period


def _filled(text: str, named: dict[str, str]) -> str:
    return Template(text).substitute(named)


def _source(step: SampledStep) -> dict[str, str]:
    """Return what only the source has."""
    lines, names = step.lines()
    prefix = identifier(step.controller.task.robot.name)
    stores = [
        f"    answer->{name}[{i}] = {value};"
        for name in ("torque", "e", "gravity")
        for i, value in enumerate(names[name])
    ]
    nv = len(names["torque"])
    stores += [
        f"    answer->J_hat[{i // nv}][{i % nv}] = {value};"
        for i, value in enumerate(names["J_hat"])
    ]
    after = names["after"] or ["0.0"]
    stores += [f"    after[{i}] = {value};" for i, value in enumerate(after)]
    stores += [
        f"    answer->slack = {names['slack'][0]};",
        f"    answer->status = ({prefix}_status)(int){names['status'][0]};",
        f"    answer->limit_status = ({prefix}_limit_status)(int){names['limit_status'][0]};",
    ]
    has_power = any("power_of_two" in line for line in lines)
    return {
        "lines": "\n".join(lines),
        "stores": "\n".join(stores),
        "helpers": templates.POWER_OF_TWO if has_power else "",
        "q_checks": _q_checks(step),
        "first": _first(step),
    }


def _q_checks(step: SampledStep) -> str:
    """Return the condition that q is a configuration."""
    of_pairs = pairs(step)
    angles = set(range(step.controller.task.robot.nq)) - {i + k for i in of_pairs for k in (0, 1)}
    holds = [f"fabs(q[{i}]) <= {LARGEST_ANGLE!r}" for i in sorted(angles)]
    holds += [
        f"fabs(sqrt(q[{i}] * q[{i}] + q[{i + 1}] * q[{i + 1}]) - 1.0) <= {_OFF_CIRCLE!r}"
        for i in of_pairs
    ]
    return "\n        && ".join(holds)


def _first(step: SampledStep) -> str:
    """Return the body of the function that sets the first state."""
    lines = [
        f"state->values[{k}] = {constant(float(each)) if i is None else f'x[{i}]'};"
        for k, (each, i) in enumerate(zip(step.begun, step.firsts, strict=True))
    ]
    if not lines:
        lines.append("state->values[0] = 0.0;")
    if any(i is not None for i in step.firsts):
        lines.append(f"return is_finite(x, {step.controller.task.n_x});")
    else:
        lines += ["(void)x;", "return 1;"]
    return "\n".join(f"    {line}" for line in lines)


Record = dict[str, Array]


def _recorded(step: SampledStep, dt: float) -> list[Record]:
    """Return steps at random configurations, one after the other, with what they answer."""
    task, rng = step.controller.task, np.random.default_rng(0)
    robot, function, found, state = task.robot, step.in_numpy(), [], np.zeros(0)
    for k in range(_RECORDED):
        q, v = robot.random_configuration(rng), rng.normal(scale=0.5, size=robot.nv)
        x = task.value(q) + rng.normal(scale=0.02, size=task.n_x)
        target = x + rng.normal(scale=0.02 if k % 2 else 0.5, size=task.n_x)
        if k == 0:
            state = step.initial_state(x)
        if k % _LOST == _LOST - 1:
            x = np.full(task.n_x, np.nan)
        given = {"q": q, "v": v, "x": x, "target": target}
        columns = {name: value[:, np.newaxis] for name, value in given.items()}
        answer = function(**columns, state=state[:, np.newaxis], dt=np.array([[dt]]))
        found.append(given | {name: value.ravel() for name, value in answer.items()})
        state = found[-1]["after"]
    return found


def _rows(records: list[Record]) -> str:
    """Return the records as C initializes them."""
    rows = []
    for record in records:
        after = record["after"] if len(record["after"]) else np.zeros(1)
        parts = [record[name] for name in ("q", "v", "x", "target", "torque")]
        numbers = [f"{{{', '.join(map(constant, part.tolist()))}}}" for part in [*parts, after]]
        numbers += [constant(float(record["slack"][0]))]
        numbers += [str(int(record[name][0])) for name in ("status", "limit_status")]
        rows.append("    {" + ",\n     ".join(numbers) + "}")
    return ",\n".join(rows)


def _example(records: list[Record]) -> dict[str, str]:
    """Return the arrays of the example, in plain decimals."""
    return {
        name: ",\n".join(
            f"    {{{', '.join(f'{value:.6g}' for value in record[name].tolist())}}}"
            for record in records[:_SHOWN]
        )
        for name in ("q", "v", "x", "target")
    }
