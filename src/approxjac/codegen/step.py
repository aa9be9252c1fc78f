"""One step of a law as a program, and `compiled`: a law whose usual steps are machine code."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from approxjac.codegen import traced_limits as limits
from approxjac.codegen import traced_setpoint as setpoint
from approxjac.codegen import traced_tracking as tracking
from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.rigid_body import Arm
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.trace.program import Program
from approxjac.codegen.trace.symbols import Scalar, select, symbols
from approxjac.codegen.whole_run import WholeLoops
from approxjac.controllers.arguments import FLOAT64, HUGE
from approxjac.controllers.controller import Controller
from approxjac.controllers.limits.torque_limited import TorqueLimited
from approxjac.controllers.setpoint import SetpointController
from approxjac.controllers.tracking import TrackingController
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status, Target
from approxjac.validation import Array

_ROUND_OFF = 1e-12
_OK = float(setpoint.STATUSES.index(Status.OK))


def step_program(controller: Controller, *, may_lose: bool, moves: bool = False) -> Program:
    """Return the program of one evaluation of a law with its limits.

    What is kept are its arguments "q", "v", "x", "target" and "state", and its answer "torque",
    "rate" (the law's own), "e", "gravity", "J_hat", "status" (its place in `setpoint.STATUSES`),
    "limit_status", "slack", "left" (whether all that does not hold) and "usual" (whether it holds,
    all numbers are small, and the status is OK).

    Args:
        controller: A controller that `limits.require_covered` takes.
        may_lose: Whether x may be lost.
        moves: Whether the target may move: an argument "target_v" more, and "reference" in the
            answer.
    """
    inside = limits.law_of(controller)
    task, robot = inside.task, inside.task.robot
    program = Program()
    arm = Arm(program.given, "belief", robot, tasks.frames(task))
    q, v = program.kept("q", robot.nq), program.kept("v", robot.nv)
    x, target = program.kept("x", task.n_x), program.kept("target", task.n_x)
    state = program.kept("state", setpoint.n_state(inside))
    v_d = program.kept("target_v", task._measured.m) if moves else None
    answer = setpoint.answer(inside, arm.at(q), q, v, x, target, state, may_lose=may_lose, v_d=v_d)
    within = limits.limited(controller, answer, v)
    numbers = [q, v, x, target, state, answer.e, answer.torque, answer.rate]
    numbers += [] if v_d is None else [v_d]
    size = sum(((each * each).sum() for each in numbers), 0.0)
    usual = (answer.status == _OK) & (size < HUGE**2)
    for joint in list(robot.model.joints)[1:]:
        if joint.nq == 2:  # a (cos, sin) pair off the unit circle is for Python to judge
            cosine, sine = q[joint.idx_q], q[joint.idx_q + 1]
            usual = usual & (abs(cosine * cosine + sine * sine - 1.0) < _ROUND_OFF)
    usual = usual & ~answer.left if isinstance(answer.left, Scalar) else usual
    found = {
        "torque": within.torque, "rate": answer.rate, "e": answer.e, "gravity": answer.gravity,
        "J_hat": answer.J_hat, "status": answer.status, "limit_status": within.status,
        "slack": within.slack, "left": select(answer.left, 1.0, 0.0),
        "usual": select(usual, 1.0, 0.0),
    }  # fmt: skip
    if moves:
        found["reference"] = answer.reference
    for name, value in found.items():
        program.kept(name, symbols(value).size)
    program.step(found)
    return program


def compiled(controller: Controller) -> Any:
    """Return a controller that computes the same to rounding, with its usual steps as machine code.

    A usual step is one whose status is OK. Whatever is not (x is lost, Ĵ near a singular pose,
    torques beyond the limits where gravity is learnt, wrong arguments) is left to the controller
    as it is, from the beginning. Kinematics of law T learn from frames in Python.

    It needs llvmlite (`pip install 'approxjac[fast]'`), and some tenths of a second to be built. A
    copy of it, as another process gets, is built again.

    Args:
        controller: A `SetpointController` with a task, a saturation and gravity that code can be
            made of, or such a law in a `TorqueLimited` with limits of effort alone; or a
            `TrackingController` of positions whose kinematics and dynamics learn.

    Returns:
        A controller of the same kind.

    Raises:
        InvalidInputError: Another controller, or one with what is not covered.
        MissingPackageError: llvmlite is not installed.
    """
    if isinstance(controller, _MachineCode):
        return controller
    kind: Any = _Compiled if isinstance(controller, SetpointController) else _CompiledLimits
    if isinstance(controller, TrackingController):
        kind = _CompiledTracking
        tracking.require_covered(controller)
    else:
        limits.require_covered(controller)
    found: Any = object.__new__(kind)
    vars(found).update(vars(controller))
    found._build()
    return found


class _MachineCode:
    """Part of a compiled controller that is machine code, in the variables `_MADE`."""

    _MADE = ("evaluate", "step", "whole_run")

    def __init_subclass__(cls) -> None:
        if _MachineCode not in cls.__bases__:
            raise TypeError(f"{cls.__name__} cannot be derived from a law that is compiled")

    @property
    def ordinary(self) -> Any:
        """The controller without machine code."""
        plain: Any = object.__new__(type(self).__mro__[2])
        vars(plain).update(
            {name: each for name, each in vars(self).items() if name not in self._MADE}
        )
        return plain

    def __reduce__(self) -> tuple[Any, ...]:
        return compiled, (self.ordinary,)

    def __repr__(self) -> str:
        return f"compiled({self.ordinary!r})"

    def _rebuilt(self, **changes: Any) -> Any:
        return compiled(self.ordinary._rebuilt(**changes))

    def _build(self) -> None:
        """Make `evaluate` and `step` of this.

        They are variables: methods that looked attributes up would take twice as long.
        """
        controller = self.ordinary
        inside = limits.law_of(controller)
        usually: Any = super()
        ordinary: Any = getattr(usually, "evaluate", None)
        ordinary_step: Any = usually.step
        program = step_program(controller, may_lose=False, moves=True)
        buffer = np.zeros((1, program.n_rows, 1))
        flat = buffer[0, :, 0]
        run = LlvmLanes(program, width=1).bound(buffer, np.zeros((1, 1, 1)))
        place = {name: slice(at, at + size) for name, (at, size) in program.rows.items()}
        q_in, v_in, x_in, target_in, state_in, rate_in = (
            flat[place[name]] for name in ("q", "v", "x", "target", "state", "target_v")
        )
        first = place["torque"].start
        answered = flat[first:]
        torque_at, rate_at, e_at, gravity_at, J_at, reference_at = (
            slice(place[name].start - first, place[name].stop - first)
            for name in ("torque", "rate", "e", "gravity", "J_hat", "reference")
        )
        usual_at, limit_at, slack_at = (
            place[name].start - first for name in ("usual", "limit_status", "slack")
        )
        J_shape = inside.task.m, inside.task.robot.nv
        p, shapes, no_rate = inside.resting, inside._shapes, inside._no_rate
        is_limited = controller is not inside
        unlimited, limited = LimitStatus.UNLIMITED, LimitStatus.LIMITED
        learns = unlimited, LimitStatus.FREE, LimitStatus.PROOF_KEPT
        statuses = {float(each): each for each in LimitStatus}
        float64, array, made = FLOAT64, np.ndarray, tuple.__new__
        ok, m = Status.OK, (inside.task._measured.m,)

        def answer(state: Array, measurement: Measurement, target: Target | Array) -> Any:
            """Return the answer of a usual step, or None."""
            try:
                _, q, v, x, _ = measurement
                x_d, v_d = (target, None) if type(target) is array else target[:2]
                if (
                    (q.shape, v.shape, x.shape, x_d.shape, state.shape) == shapes
                    and q.dtype is v.dtype is x.dtype is float64
                    and x_d.dtype is state.dtype is float64
                    # what a mask hides is not measured
                    and type(q) is type(v) is type(x) is type(x_d) is type(state) is array
                    and (
                        v_d is None
                        or (type(v_d) is array and v_d.shape == m and v_d.dtype is float64)
                    )
                ):
                    q_in[:], v_in[:], x_in[:], target_in[:] = q, v, x, x_d
                    rate_in[:] = 0.0 if v_d is None else v_d
                    rate = no_rate
                    if state.size:
                        state_in[:] = state
                    run()
                    found = answered.copy()
                    if found[usual_at]:
                        if state.size:
                            rate = found[rate_at]
                        status, slack = unlimited, 0.0
                        if is_limited:
                            status = statuses[found[limit_at]]
                            slack = math.nan if status is limited else float(found[slack_at])
                        return made(Evaluation, (
                            found[torque_at], rate, ok, found[e_at], found[J_at].reshape(J_shape),
                            found[gravity_at], status, slack,
                            None if v_d is None else found[reference_at],
                        ))  # fmt: skip
            except (AttributeError, IndexError, TypeError, ValueError):
                pass
            return None

        def evaluate(state: Array, measurement: Measurement, target: Target | Array) -> Any:
            return answer(state, measurement, target) or ordinary(state, measurement, target)

        def step(state: Array, measurement: Measurement, target: Target | Array, dt: float) -> Any:
            found = answer(state, measurement, target)
            if found is None or not (isinstance(dt, float) and 0.0 < dt <= 1.0):
                return ordinary_step(state, measurement, target, dt)
            after = state + dt * found.state_rate if state.size else state.copy()
            if p and found.limit_status not in learns:
                after[:p] = state[:p]
            return after, found

        vars(self).update(step=step, whole_run=WholeLoops(controller).run)
        if controller is inside:
            vars(self)["evaluate"] = evaluate


class _Compiled(_MachineCode, SetpointController):
    """A law with machine code."""


class _CompiledLimits(_MachineCode, TorqueLimited):
    """A law within limits of effort, with machine code."""


class _CompiledTracking(_MachineCode, TrackingController):
    """Law T with machine code."""

    def _build(self) -> None:
        vars(self)["step"] = tracking.compiled_step(self.ordinary, super(_MachineCode, self).step)
