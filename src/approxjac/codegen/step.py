"""One step of a law as a program, and `compiled`: a law whose usual steps are machine code."""

from __future__ import annotations

import math
from typing import Any, NoReturn

import numpy as np

from approxjac.codegen import setpoint, tasks
from approxjac.codegen.graph import Scalar, select
from approxjac.codegen.llvm import LlvmLanes
from approxjac.codegen.program import Program
from approxjac.codegen.rigid_body import Arm
from approxjac.codegen.run import WholeLoops
from approxjac.codegen.symbols import symbols
from approxjac.controllers.arguments import FLOAT64, HUGE
from approxjac.controllers.setpoint import SetpointController
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status, Target
from approxjac.validation import Array

_ROUND_OFF = 1e-12
_OK = float(setpoint.STATUSES.index(Status.OK))


def step_program(controller: SetpointController, *, may_lose: bool) -> Program:
    """Return the program of one evaluation of a law, for a target at rest.

    What is kept are its arguments "q", "v", "x", "target" and "state", and its answer "torque",
    "rate", "e", "gravity", "J_hat", "status" (its place in `setpoint.STATUSES`), "left" (whether
    all that does not hold) and "usual" (whether it holds, all numbers are small, and the status is
    OK).

    Args:
        controller: The law, one that `setpoint.require_covered` takes.
        may_lose: Whether x may be lost.
    """
    task, robot = controller.task, controller.task.robot
    program = Program()
    arm = Arm(program.given, "belief", robot, tasks.frames(task))
    q, v = program.kept("q", robot.nq), program.kept("v", robot.nv)
    x, target = program.kept("x", task.n_x), program.kept("target", task.n_x)
    state = program.kept("state", setpoint.n_state(controller))
    answer = setpoint.answer(controller, arm.at(q), q, v, x, target, state, may_lose=may_lose)
    numbers = (q, v, x, target, state, answer.e, answer.torque, answer.rate)
    size = sum(((each * each).sum() for each in numbers), 0.0)
    usual = (answer.status == _OK) & (size < HUGE**2)
    for joint in list(robot.model.joints)[1:]:
        if joint.nq == 2:  # a (cos, sin) pair off the unit circle is for Python to judge
            cosine, sine = q[joint.idx_q], q[joint.idx_q + 1]
            usual = usual & (abs(cosine * cosine + sine * sine - 1.0) < _ROUND_OFF)
    usual = usual & ~answer.left if isinstance(answer.left, Scalar) else usual
    found = {
        "torque": answer.torque, "rate": answer.rate, "e": answer.e, "gravity": answer.gravity,
        "J_hat": answer.J_hat, "status": answer.status, "left": select(answer.left, 1.0, 0.0),
        "usual": select(usual, 1.0, 0.0),
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
    found = object.__new__(_Compiled)
    vars(found).update(vars(controller))
    found._build()
    return found


class _Compiled(SetpointController):
    """A `SetpointController` with machine code."""

    def __init_subclass__(cls) -> NoReturn:
        raise TypeError(f"{cls.__name__} cannot be derived from a law that is compiled")

    @property
    def ordinary(self) -> SetpointController:
        """The law without machine code."""
        plain = object.__new__(SetpointController)
        own = ("evaluate", "step", "whole_run")
        vars(plain).update({name: each for name, each in vars(self).items() if name not in own})
        return plain

    def __reduce__(self) -> tuple[Any, ...]:
        return compiled, (self.ordinary,)

    def _rebuilt(self, **changes: Any) -> Any:
        return compiled(self.ordinary._rebuilt(**changes))

    def _build(self) -> None:
        """Make `evaluate` and `step` of this.

        They are variables: methods that looked attributes up would take twice as long.
        """
        ordinary, ordinary_step = super().evaluate, super().step
        program = step_program(self, may_lose=False)
        buffer = np.zeros((1, program.n_rows, 1))
        flat = buffer[0, :, 0]
        run = LlvmLanes(program, width=1).bound(buffer, np.zeros((1, 1, 1)))
        place = {name: slice(at, at + size) for name, (at, size) in program.rows.items()}
        q_in, v_in, x_in, target_in, state_in = (
            flat[place[name]] for name in ("q", "v", "x", "target", "state")
        )
        first = place["torque"].start
        answered = flat[first:]
        torque_at, rate_at, e_at, gravity_at, J_at = (
            slice(place[name].start - first, place[name].stop - first)
            for name in ("torque", "rate", "e", "gravity", "J_hat")
        )
        usual_at = place["usual"].start - first
        J_shape, shapes, no_rate = (self.task.m, self.task.robot.nv), self._shapes, self._no_rate
        float64, array, made = FLOAT64, np.ndarray, tuple.__new__
        ok, unlimited = Status.OK, LimitStatus.UNLIMITED

        def answer(state: Array, measurement: Measurement, target: Target | Array) -> Any:
            """Return the answer of a usual step, or None."""
            try:
                _, q, v, x, _ = measurement
                if (
                    (q.shape, v.shape, x.shape, target.shape, state.shape) == shapes  # type: ignore[union-attr]
                    and q.dtype is v.dtype is x.dtype is float64
                    and target.dtype is state.dtype is float64  # type: ignore[union-attr]
                    # what a mask hides is not measured
                    and type(q) is type(v) is type(x) is type(target) is type(state) is array
                ):
                    q_in[:], v_in[:], x_in[:], target_in[:] = q, v, x, target
                    rate = no_rate
                    if state.size:
                        state_in[:] = state
                    run()
                    found = answered.copy()
                    if found[usual_at]:
                        if state.size:
                            rate = found[rate_at]
                        return made(Evaluation, (
                            found[torque_at], rate, ok, found[e_at], found[J_at].reshape(J_shape),
                            found[gravity_at], unlimited, 0.0, None,
                        ))  # fmt: skip
            except (AttributeError, TypeError, ValueError):
                pass
            return None

        def evaluate(state: Array, measurement: Measurement, target: Target | Array) -> Evaluation:
            return answer(state, measurement, target) or ordinary(state, measurement, target)

        def step(
            state: Array, measurement: Measurement, target: Target | Array, dt: float
        ) -> tuple[Array, Evaluation]:
            found = answer(state, measurement, target)
            if found is None or not (isinstance(dt, float) and 0.0 < dt < math.inf):
                return ordinary_step(state, measurement, target, dt)
            return (state + dt * found.state_rate if state.size else state.copy()), found

        loops = WholeLoops(self.ordinary)
        vars(self).update(evaluate=evaluate, step=step, whole_run=loops.run)
