"""The tracking law as machine code: one step of it, frames and all, traced."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.rigid_body import Arm
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.trace.program import Program
from approxjac.codegen.trace.symbols import select, symbols
from approxjac.controllers.arguments import FLOAT64, HUGE, time_of_x
from approxjac.controllers.tracking import TrackingController
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status, Target
from approxjac.validation import Array

Step = Callable[[Array, Measurement, Target | Array, float], tuple[Array, Evaluation]]
_ROUND_OFF = 1e-12
_FARTHEST = math.sqrt(HUGE)
_ANSWER = "torque", "e", "J_hat", "gravity", "reference", "status", "usual"


def step_program(controller: TrackingController) -> Program:
    """Return the program of one step of the tracking law.

    What is kept are its arguments "q", "v", "x", "x_d", "v_d", "a_d", "times" (t and t_x, NaN where
    it is not known) and "state", which is that after the step then; and its answer "torque", "e",
    "J_hat", "gravity", "reference", "status" and "usual" (whether all numbers are small).

    Args:
        controller: The law.

    Raises:
        InvalidInputError: What a part of it does cannot be traced.
    """
    task, robot = controller.task, controller.task.robot
    program, m = Program(), task._measured.m
    sizes = {
        "q": robot.nq, "v": robot.nv, "x": task.n_x, "x_d": task.n_x, "v_d": m, "a_d": m,
        "times": 2, "state": controller.n_state,
    }  # fmt: skip
    given = {name: program.kept(name, size) for name, size in sizes.items()}
    q, v, x, x_d, v_d, a_d, (t, t_x), state = given.values()
    measurement, target = Measurement(t, q, v, x, t_x), Target(x_d, v_d, a_d)
    with Arm.known(robot).standing_in(program.graph):
        after, answer = tasks.traced(
            "controller", controller, lambda: controller.evolve(state, measurement, target)
        )
    numbers = (*(given[name] for name in sizes if name not in ("x", "times")), after, answer.torque)
    size = sum(((each * each).sum() for each in map(symbols, numbers)), 0.0)
    usual = size < HUGE
    for joint in list(robot.model.joints)[1:]:
        if joint.nq == 2:  # a (cos, sin) pair off the unit circle is for Python to judge
            cosine, sine = q[joint.idx_q], q[joint.idx_q + 1]
            usual = usual & (abs(cosine * cosine + sine * sine - 1.0) < _ROUND_OFF)
    gravity = np.zeros(0) if answer.gravity is None else answer.gravity
    each = (answer.torque, answer.e, answer.J_hat, gravity, answer.reference, answer.status)
    found = dict(zip(_ANSWER, (*each, select(usual, 1.0, 0.0)), strict=True))
    for name, value in found.items():
        program.kept(name, symbols(value).size)
    program.step(found | {"state": after})
    return program


def require_covered(controller: TrackingController) -> None:
    """Refuse a law of which no code can be made.

    Raises:
        InvalidInputError: A law derived from it, or with a part that cannot be traced.
    """
    if type(controller) is not TrackingController:
        raise InvalidInputError(
            "controller must be a TrackingController itself to make code of it, got "
            f"{controller!r}",
            given=controller,
        )


def compiled_step(controller: TrackingController, ordinary: Callable[..., Any]) -> Step:
    """Return `step` of a law with machine code.

    Args:
        controller: The law, one that `require_covered` takes.
        ordinary: `step` of numbers that are wrong, which it names.
    """
    dt, kinematics, task = controller.dt, controller.kinematics, controller.task
    program = step_program(controller)
    buffer = np.zeros((1, program.n_rows, 1))
    flat = buffer[0, :, 0]
    run = LlvmLanes(program, width=1).bound(buffer, np.zeros((1, 1, 1)))
    place = {name: slice(at, at + size) for name, (at, size) in program.rows.items()}
    q_in, v_in, x_in, x_d_in, v_d_in, a_d_in, times, state_in = (
        flat[place[name]] for name in ("q", "v", "x", "x_d", "v_d", "a_d", "times", "state")
    )
    first = place["torque"].start
    answered = flat[first:]
    torque_at, e_at, J_at, gravity_at, reference_at, status_at, usual_at = (
        slice(place[name].start - first, place[name].stop - first) for name in _ANSWER
    )
    p, end = controller.resting, controller.resting + kinematics.n_state
    J_shape, task_shape = (task.m, task.robot.nv), (task._measured.m,)
    shapes = (task.robot.nq,), (task.robot.nv,), (task.n_x,), (task.n_x,), (controller.n_state,)
    float64, array, made = FLOAT64, np.ndarray, tuple.__new__
    statuses, unlimited = {int(each): each for each in Status}, LimitStatus.UNLIMITED
    has_gravity = gravity_at.stop > gravity_at.start

    def put(rate: Array | None, where: Array) -> bool:
        """Write down ẋ_d or ẍ_d; return whether it is a vector, or None."""
        if rate is None:
            where[:] = 0.0
            return True
        if type(rate) is not array or rate.shape != task_shape or rate.dtype is not float64:
            return False
        where[:] = rate
        return True

    def answer(
        state: Array, measurement: Measurement, target: Target | Array
    ) -> tuple[Array, Evaluation] | None:
        """Return the outcome of a usual step, or None."""
        x_d, v_d, a_d = target if isinstance(target, Target) else (target, None, None)
        try:
            t, q, v, x, t_x = measurement
            if not (
                (q.shape, v.shape, x.shape, x_d.shape, state.shape) == shapes
                and q.dtype is v.dtype is x.dtype is x_d.dtype is state.dtype is float64
                # what a mask hides is not measured
                and type(q) is type(v) is type(x) is type(x_d) is type(state) is array
                and put(v_d, v_d_in)
                and put(a_d, a_d_in)
            ):
                return None
            kinematics.check(state[p:end], measurement, dt)
            t_x = time_of_x(t_x)
        except (AttributeError, TypeError, ValueError, InvalidInputError):
            return None
        q_in[:], v_in[:], x_in[:], x_d_in[:], state_in[:] = q, v, x, x_d, state
        if not x.dot(x) < HUGE:  # lost, or beyond what can be learnt from
            x_in[:] = np.where(np.abs(x) < _FARTHEST, x, math.nan)
        times[0], times[1] = t, math.nan if t_x is None else t_x
        run()
        found = answered.copy()
        if not found[usual_at][0]:
            return None
        status = statuses[int(found[status_at][0])]
        return state_in.copy(), made(Evaluation, (
            found[torque_at], None, status, found[e_at], found[J_at].reshape(J_shape),
            found[gravity_at] if has_gravity else None, unlimited, 0.0, found[reference_at],
        ))  # fmt: skip

    def step(
        state: Array, measurement: Measurement, target: Target | Array, given_dt: float
    ) -> tuple[Array, Evaluation]:
        found = answer(state, measurement, target) if given_dt == dt else None
        return ordinary(state, measurement, target, given_dt) if found is None else found

    return step
