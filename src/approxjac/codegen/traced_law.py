"""A controller on symbols: any controller's own step, run on symbols."""

from collections.abc import Callable
from typing import Any

import numpy as np

from approxjac.codegen.arm.traced_tasks import traced
from approxjac.codegen.trace.symbols import Condition, Symbols, graph_of, symbols
from approxjac.controllers.arguments import HUGE
from approxjac.controllers.controller import Controller
from approxjac.controllers.gains.gains import Diagonals
from approxjac.controllers.limits.torque_limited import TorqueLimited
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, Measurement, Target
from approxjac.robots import Robot
from approxjac.robots.robot import own_joints
from approxjac.validation import Array, changed_copy


def stepped(
    controller: Controller,
    state: Symbols,  # its state
    measurement: Measurement,  # what is measured, as symbols
    target: Target | Array,  # wanted task value, as symbols
    dt: Any,  # sampling time [s], known or not
) -> tuple[Symbols, Evaluation, Condition]:
    """Return `Controller.step` of symbols, and whether the step is left to Python.

    Raises:
        InvalidInputError: It takes no symbols, as it branches on a value or asks Pinocchio.
    """
    controller = on_symbols(controller)
    answer: Any
    after, answer = traced(
        "controller", controller, lambda: controller.step(state, measurement, target, dt)
    )
    if not isinstance(answer, Evaluation):
        message = f"step must return a state and an Evaluation, got {answer!r}"
        raise InvalidInputError(message, given=answer)
    after = symbols(after)
    named: dict[str, Any] = {
        name: None if value is None else symbols(value) for name, value in answer._asdict().items()
    }
    for name in ("status", "limit_status", "slack"):
        value = named[name][()]
        named[name] = float(value) if isinstance(value, int | float) else value
    return after, Evaluation(**named), graph_of(measurement.q).left


def on_symbols(controller: Controller) -> Any:
    """Return a controller with this library's parts changed to accept symbols."""
    solver = controller.solver if isinstance(controller, TorqueLimited) else None
    if controller.needs_solver and solver is not None:
        message = f"solver must be None to make code of a limiter that needs one, got {solver!r}"
        raise InvalidInputError(message, given=solver)
    return _with_parts(controller, on_symbols)


def with_gains(controller: Controller, diagonals: Diagonals) -> Controller:
    """Return a controller whose law has symbolic gains."""
    own = {} if controller.diagonals is None else {"diagonals": diagonals}
    return _with_parts(controller, lambda part: with_gains(part, diagonals), **own)


def _with_parts(
    controller: Controller, changed: Callable[[Controller], Controller], **own: Any
) -> Controller:
    controller = getattr(controller, "ordinary", controller)
    for name, part in vars(controller).items():
        if isinstance(part, Controller):
            own[name] = changed(part)
    return changed_copy(controller, **own) if own else controller


def initial_state(controller: Controller, measurement: Measurement) -> Symbols:
    """Return `Controller.initial_state` of symbols."""
    own = getattr(controller, "ordinary", controller)
    return symbols(traced("controller", own, lambda: on_symbols(own).initial_state(measurement)))


def argument_sizes(controller: Controller) -> dict[str, int]:
    """Return the sizes of a step's arguments, by name."""
    task, robot = controller.task, controller.task.robot
    sizes = {
        "q": robot.nq, "v": robot.nv, "x": task.n_x, "target": task.n_x,
        "state": controller.whole_size, "dt": 1, "t": 1, "t_x": 1,
    }  # fmt: skip
    if is_ours(controller):
        sizes |= dict.fromkeys(("target_v", "target_a"), task.measured.m)
    return sizes


def measured(given: dict[str, Symbols]) -> Measurement:
    """Return the measurement among the arguments of a step."""
    return Measurement(given["t"][0], given["q"], given["v"], given["x"], given["t_x"][0])


def stepped_from(
    controller: Controller, given: dict[str, Symbols]
) -> tuple[Symbols, Evaluation, Condition]:
    """Do as `stepped`, from arguments by name, with the sizes of `argument_sizes`."""
    measurement = measured(given)
    if predicts(controller):  # an x beyond what can be learnt from is lost
        x = measurement.x
        measurement = measurement._replace(x=np.where(x * x < HUGE, x, np.nan))
    rates = [given[name] for name in ("target_v", "target_a") if name in given]
    target = Target(given["target"], *rates) if rates else given["target"]
    dt = given["dt"][0] if controller.dt is None else controller.dt
    return stepped(controller, given["state"], measurement, target, dt)


def pairs(robot: Robot) -> list[int]:
    """Return the index in q of the (cos, sin) of each continuous joint."""
    return [joint.idx_q for joint in own_joints(robot.model).values() if joint.nq == 2]


def predicts(controller: Controller) -> bool:
    """Return True if a law controls a prediction, so that a step without x is usual, too."""
    return controller.law.kinematics is not None


def is_ours(controller: Controller) -> bool:
    """Return True for a controller of this library, which also accepts a `Target`."""
    return type(controller).__module__.startswith("approxjac.")
