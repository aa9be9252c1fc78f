"""One step of a law as a program, and `compiled`: a law whose regular steps are machine code."""

import functools
import math
from itertools import chain
from typing import Any

import numpy as np

from approxjac import law
from approxjac.codegen import traced_law as laws
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.trace.program import Program
from approxjac.codegen.trace.symbols import Scalar, select, symbols
from approxjac.controllers.arguments import FLOAT64, HUGE, time_of_x
from approxjac.controllers.controller import Controller
from approxjac.controllers.guard import Guard
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status, Target
from approxjac.law.branches import sum_of_squares
from approxjac.validation import Array, require

_ROUND_OFF = 1e-12
_USUAL = (Status.OK, Status.MEASUREMENT_HELD, Status.HOLDING)


def step_program(controller: Controller, *, may_lose: bool) -> Program:
    """Return the program of one step of a controller.

    Its kept rows are the arguments (see `argument_sizes`) and the outputs: the fields of the
    `Evaluation`, with `state_rate` as "rate", "left" (1 if the step is left to Python) and "usual"
    (1 if it is not, all numbers are small and the status is usual). The next state takes the place
    of the state, just before the outputs.

    With `may_lose` x may be lost.

    Raises:
        InvalidInputError: It takes no symbols.
    """
    program = Program()
    program.graph.is_finite = not may_lose
    sizes = laws.argument_sizes(controller)
    sizes["state"] = sizes.pop("state")
    given = {name: program.kept(name, size) for name, size in sizes.items()}
    after, answer, left = laws.stepped_from(controller, given)
    predicts = laws.predicts(controller)
    checked = ("q", "v", "target", "target_v", "target_a") + (() if predicts else ("x",))
    # a guard's memory is of numbers that are checked, or harmless
    numbers = [given[name] for name in checked if name in given] + [answer.torque]
    # what is remembered for later was checked as it came
    changing = [
        pair
        for pair in zip(after[: controller.size], given["state"], strict=False)
        if not program.graph.changes_rarely(*pair)
    ]
    numbers += map(list, zip(*changing, strict=True))
    numbers += [] if predicts else [answer.e]
    usual = sum_of_squares([*chain.from_iterable(numbers)]) < HUGE**2
    if not predicts:
        usual = law.any_of(symbols([answer.status == each for each in _USUAL])) & usual
    for at in laws.pairs(controller.task.robot):  # off the unit circle Python is to judge
        cosine, sine = given["q"][at : at + 2]
        usual = usual & (abs(cosine * cosine + sine * sine - 1.0) < _ROUND_OFF)
    usual = usual & ~left if isinstance(left, Scalar) else usual
    if isinstance(answer.limit_status, Scalar):
        usual = usual & ~(answer.limit_status == LimitStatus.INFEASIBLE)
    outputs = {
        "state": after, "torque": answer.torque, "rate": answer.state_rate, "e": answer.e,
        "gravity": answer.gravity, "J_hat": answer.J_hat, "reference": answer.reference,
        "left": select(left, 1.0, 0.0), "status": answer.status,
        "limit_status": answer.limit_status, "slack": answer.slack,
        "usual": select(usual, 1.0, 0.0),
    }  # fmt: skip
    program.step({name: value for name, value in outputs.items() if value is not None})
    return program


def compiled(controller: Controller) -> Any:
    """Return an equivalent controller (to rounding) whose usual steps are machine code.

    A usual step is one whose status is OK, or that of a held x. Any other step (x lost, Ĵ near
    singular, torques beyond the limits where gravity is learnt, limits that no torque keeps,
    wrong arguments) runs in Python, from the beginning. All steps of a `TrackingController` are
    usual. While limits of speed, position or motion act, torques agree with Python's to 1e-6 of
    their size.

    It accepts any controller whose step can be traced, that is, computes with NumPy and never
    branches on a value, also with your own task, camera, saturation or gravity. The error names
    the method that cannot be traced.

    It needs llvmlite (`pip install 'approxjac[fast]'`). Building takes some tenths of a second; a
    copy in another process is built again.

    Args:
        controller: The controller.

    Returns:
        A controller of the same kind.

    Raises:
        InvalidInputError: The controller cannot be traced.
        MissingPackageError: llvmlite is not installed.
    """
    if isinstance(controller, _MachineCode):
        return controller
    wanted = "a controller, such as SetpointController(task)"
    require("controller", controller, Controller, wanted)
    result: Any = object.__new__(_kind_of(type(controller)))
    vars(result).update(vars(controller))
    result._build()
    return result


class _MachineCode:
    """Part of a compiled controller that is machine code, in the variables `_MADE`."""

    _MADE = ("evaluate", "advance", "step")

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

    def guarded(self, guard: Guard | None) -> Any:
        """Return this controller with other bounds of good samples; None accepts all."""
        return compiled(self.ordinary.guarded(guard))

    def _rebuilt(self, **changes: Any) -> Any:
        return compiled(self.ordinary._rebuilt(**changes))

    def _build(self) -> None:
        """Set the compiled `evaluate`, `advance` and `step`.

        They are variables: methods that looked attributes up would take twice as long.
        """
        controller = self.ordinary
        usually: Any = super()
        knows_nan = controller.kinematics is not None  # for a t_x that is not known
        bare = controller.guarded(None)
        evaluate, advance, asks = self._made(bare, usually.advance, knows_nan)
        step = advance
        if controller.guard is not None:  # which knows NaN
            _, step, _ = self._made(controller, usually.step, knows_nan or not asks)
        vars(self).update(advance=advance, step=step)
        if controller.is_continuous:
            vars(self)["evaluate"] = evaluate

    def _made(self, controller: Any, ordinary_step: Any, knows_nan: bool) -> tuple[Any, Any, bool]:
        """Return `evaluate`, a step that else is `ordinary_step`, and whether it asks for t_x."""
        usually: Any = super()
        ordinary = usually.evaluate
        predicts, law, task = laws.predicts(controller), controller.law, controller.task
        program = step_program(controller, may_lose=predicts)
        buffer = np.zeros((1, program.n_rows, 1))
        flat = buffer[0, :, 0]
        cells: Any = flat.data  # where numbers are stored faster
        inf, nan = math.inf, math.nan
        run = LlvmLanes(program, width=1).bound(buffer, np.zeros((1, 1, 1)))
        place = {name: slice(at, at + size) for name, (at, size) in program.rows.items()}
        takes_rates = "target_v" in place
        asked = program.graph.asked([*chain(*program.stepped.values())])
        none, first = slice(0, 0), place["state"].start
        q_at, v_at, x_at, target_at, state_at, v_d_at, a_d_at = (
            place.get(name, none)
            for name in ("q", "v", "x", "target", "state", "target_v", "target_a")
        )
        rates_at = slice(v_d_at.start, first) if takes_rates else none
        at_rest = np.zeros(rates_at.stop - rates_at.start)
        dt_at, t_at, t_x_at = (place[name].start for name in ("dt", "t", "t_x"))
        asks_t, asks_t_x = "t" in asked, "t_x" in asked
        answered = flat[first:]
        out = {name: slice(at.start - first, at.stop - first) for name, at in place.items()}
        torque_at, after_at, rate_at, e_at, gravity_at, J_at, reference_at = (
            out.get(name, none)
            for name in ("torque", "state", "rate", "e", "gravity", "J_hat", "reference")
        )
        has_rate, has_gravity, has_J = (name in place for name in ("rate", "gravity", "J_hat"))
        has_state = state_at.stop > first
        verdict_at = slice(out["status"].start, out["usual"].stop)
        learnt_at = slice(law.resting, law.resting + getattr(law.kinematics, "n_state", 0))
        J_shape, m = (task.m, task.robot.nv), (task.measured.m,)
        shapes = tuple(flat[at].shape for at in (q_at, v_at, x_at, target_at, state_at))
        limit_statuses = {float(each): each for each in LimitStatus}
        limited = float(LimitStatus.LIMITED)
        statuses = {float(each): each for each in Status}
        float64, array, made = FLOAT64, np.ndarray, tuple.__new__
        own_dt, any_dt = controller.dt, controller.dt is None
        size, came = controller.size, at_rest  # came from the last step, whose numbers are known

        def put(rate: Array | None, where: slice) -> bool:
            """Copy ẋ_d or ẍ_d to its place; return True if it is a valid vector, or None."""
            if rate is None:
                flat[where] = 0.0
                return True
            if type(rate) is not array or rate.shape != m or rate.dtype is not float64:
                return False
            flat[where] = rate
            return True

        def answer(state: Array, measurement: Measurement, target: Target | Array) -> Any:
            """Return the output of a usual step, or None of another."""
            nonlocal came
            try:
                t, q, v, x, t_x = measurement
                x_d, v_d, a_d = (target, None, None) if type(target) is array else target
                if not (
                    (q.shape, v.shape, x.shape, x_d.shape, state.shape) == shapes
                    and q.dtype is v.dtype is x.dtype is x_d.dtype is state.dtype is float64
                    # what a mask hides is not measured
                    and type(measurement) is Measurement
                    and isinstance(t, float)
                    and type(q) is type(v) is type(x) is type(x_d) is type(state) is array
                ):
                    return None
                if v_d is None and a_d is None:
                    cells[rates_at] = at_rest
                elif not (takes_rates and put(v_d, v_d_at) and put(a_d, a_d_at)):
                    return None
                if state is not came and not np.abs(state[:size]).max(initial=0.0) < HUGE:
                    return None  # as Python judges it
                if predicts:
                    law.kinematics.check(state[learnt_at], measurement, own_dt)
                if asks_t:
                    cells[t_at] = t
                if asks_t_x:
                    if not (type(t_x) is float and -inf < t_x < inf):
                        t_x = time_of_x(t_x)
                        if t_x is None and not knows_nan:
                            return None
                    cells[t_x_at] = nan if t_x is None else t_x
                try:
                    cells[q_at], cells[v_at], cells[x_at], cells[target_at] = q, v, x, x_d
                    if has_state:
                        cells[state_at] = state
                except ValueError:  # one is not aligned
                    flat[q_at], flat[v_at], flat[x_at], flat[target_at] = q, v, x, x_d
                    flat[state_at] = state
                run()
                outputs = answered.copy()
                status, limit, slack, usual = outputs[verdict_at].tolist()
                if not usual:
                    return None
                came = outputs[after_at]
                return outputs, made(Evaluation, (
                    outputs[torque_at], outputs[rate_at] if has_rate else None, statuses[status],
                    outputs[e_at], outputs[J_at].reshape(J_shape) if has_J else None,
                    outputs[gravity_at] if has_gravity else None,
                    limit_statuses[limit], math.nan if limit == limited else slack,
                    None if v_d is None and not predicts else outputs[reference_at],
                ))  # fmt: skip
            except (AttributeError, IndexError, TypeError, ValueError):
                return None

        def evaluate(state: Array, measurement: Measurement, target: Target | Array) -> Any:
            outputs = answer(state, measurement, target)
            return ordinary(state, measurement, target) if outputs is None else outputs[1]

        def step(state: Array, measurement: Measurement, target: Target | Array, dt: float) -> Any:
            outputs = None
            if isinstance(dt, float) and 0.0 < dt <= 1.0 and (any_dt or dt == own_dt):
                cells[dt_at] = dt
                outputs = answer(state, measurement, target)
            if outputs is None:
                return ordinary_step(state, measurement, target, dt)
            return came, outputs[1]

        return evaluate, step, asks_t_x


@functools.cache
def _kind_of(kind: type[Controller]) -> type:
    return type(f"_Compiled{kind.__name__}", (_MachineCode, kind), {"__module__": __name__})
