"""One step of a law as a program, and `compiled`: a law whose usual steps are machine code."""

from __future__ import annotations

import copy
import math
from typing import Any, NoReturn

import numpy as np

from approxjac.codegen import setpoint, tasks
from approxjac.codegen.graph import select
from approxjac.codegen.llvm import LlvmLanes
from approxjac.codegen.program import Program
from approxjac.codegen.rigid_body import Arm
from approxjac.codegen.symbols import symbols
from approxjac.controllers.arguments import FLOAT64, HUGE
from approxjac.controllers.setpoint import SetpointController
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status, Target
from approxjac.validation import Array

_OK = setpoint.STATUSES.index(Status.OK)


def step_program(controller: SetpointController, *, may_lose: bool) -> Program:
    """Return the program of one evaluation of a law, for a target at rest.

    What is kept are its arguments "q", "v", "x", "target" and "state", and its answer "torque",
    "rate", "e", "gravity", "J_hat", "status" (its place in `setpoint.STATUSES`) and "left"
    (whether all that does not hold).

    Args:
        controller: The law, one that `setpoint.require_covered` takes.
        may_lose: Whether x may be lost.
    """
    task, robot = controller.task, controller.task.robot
    program = Program()
    arm = Arm(program.given, "belief", robot, tasks.frames(task))
    rest = Measurement(0.0, robot.neutral(), np.zeros(robot.nv), task.value(robot.neutral()))
    n_state = len(controller.initial_state(rest))
    q, v = program.kept("q", robot.nq), program.kept("v", robot.nv)
    x, target = program.kept("x", task.n_x), program.kept("target", task.n_x)
    state = program.kept("state", n_state)
    answer = setpoint.answer(
        controller, arm.at(q), q, v, x, target, state, may_lose=may_lose
    )
    found = {
        "torque": answer.torque, "rate": answer.rate, "e": answer.e, "gravity": answer.gravity,
        "J_hat": answer.J_hat, "status": answer.status, "left": select(answer.left, 1.0, 0.0),
    }  # fmt: skip
    for name, value in found.items():
        program.kept(name, symbols(value).size)
    program.step(found)
    return program


def compiled(controller: SetpointController) -> SetpointController:
    """Return a law that computes the same to rounding, with its usual steps as machine code.

    A usual step is one whose status is OK. Whatever is not (x is lost, Ĵ near a singular pose,
    torques beyond the limits where gravity is learnt, a target that moves, wrong arguments) is left
    to the law as it is, from the beginning.

    It needs llvmlite (`pip install 'approxjac[fast]'`), and some tenths of a second to be built. A
    copy of it, as another process gets, is built again.

    Args:
        controller: A `SetpointController` with a task, a saturation and gravity that code can be
            made of: see `codegen.setpoint.require_covered`.

    Raises:
        InvalidInputError: Another controller, or one with what is not covered.
        MissingPackageError: llvmlite is not installed.
    """
    if isinstance(controller, _Compiled):
        return controller
    setpoint.require_covered(controller)
    found = copy.copy(controller)
    found.__class__ = _Compiled
    found._build()
    return found


class _Compiled(SetpointController):
    """A `SetpointController` with machine code."""

    def __init_subclass__(cls) -> NoReturn:
        raise TypeError(f"{cls.__name__} cannot be derived from a law that is compiled")

    def __reduce__(self) -> tuple[Any, ...]:
        plain = copy.copy(self)
        vars(plain).pop("evaluate")
        plain.__class__ = SetpointController
        return compiled, (plain,)

    def _rebuilt(self, **changes: Any) -> Any:
        _, (plain,) = self.__reduce__()
        return compiled(plain._rebuilt(**changes))

    def _build(self) -> None:
        """Make `evaluate`, as a variable: one that looked attributes up would take twice as long."""
        ordinary = super().evaluate
        program = step_program(self, may_lose=False)
        lanes = LlvmLanes(program, width=1)
        buffer = np.zeros((1, program.n_rows, 1))
        flat, run = buffer[0, :, 0], lanes.bound(buffer, np.zeros((1, 1, 1)))
        place = {name: slice(at, at + size) for name, (at, size) in program.rows.items()}
        given = place["q"].start, place["state"].stop
        q_in, v_in, x_in, target_in, state_in = (
            flat[place[name]] for name in ("q", "v", "x", "target", "state")
        )
        first = place["torque"].start
        torque_at, rate_at, e_at, gravity_at, J_at = (
            slice(place[name].start - first, place[name].stop - first)
            for name in ("torque", "rate", "e", "gravity", "J_hat")
        )
        answered = flat[first : place["left"].stop]
        shape, m = (self.task.m, self.task.robot.nv), self.task.m
        shapes = self._shapes
        pairs = [  # (cos, sin) of continuous joints
            joint.idx_q for joint in list(self.task.robot.model.joints)[1:] if joint.nq == 2
        ]
        float64, huge, hypot, made = FLOAT64, HUGE, math.hypot, tuple.__new__
        ok, unlimited, usual_status = Status.OK, LimitStatus.UNLIMITED, float(_OK)

        def evaluate(state: Array, measurement: Measurement, target: Target | Array) -> Evaluation:
            try:
                _, q, v, x, _ = measurement
                if (
                    (q.shape, v.shape, x.shape, target.shape, state.shape) == shapes  # type: ignore[union-attr]
                    and q.dtype is v.dtype is x.dtype is float64
                    and target.dtype is state.dtype is float64  # type: ignore[union-attr]
                ):
                    q_in[:], v_in[:], x_in[:], target_in[:], state_in[:] = q, v, x, target, state  # type: ignore[assignment]
                    if hypot(*flat[given[0] : given[1]].tolist()) < huge and not pairs:
                        run()
                        found = answered.copy()
                        if found[-2] == usual_status and not found[-1]:
                            torque = found[torque_at]
                            if hypot(*torque.tolist()) < huge:
                                return made(Evaluation, (
                                    torque, found[rate_at], ok, found[e_at],
                                    found[J_at].reshape(shape), found[gravity_at], unlimited, 0.0,
                                    None,
                                ))  # fmt: skip
            except (AttributeError, TypeError, ValueError):
                pass
            return ordinary(state, measurement, target)

        vars(self)["evaluate"] = evaluate
