"""`Guard`: which samples a controller accepts, and what it does without one."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from approxjac import law
from approxjac.controllers.gains.sample_configurations import max_damping_rate, usual_inertias
from approxjac.controllers.limits.limits import Limits
from approxjac.errors import InvalidInputError, MeasurementError
from approxjac.formatting import joined, short_fields
from approxjac.interface import Evaluation, Measurement, Status, Target
from approxjac.law import guard as checks
from approxjac.robots import Robot
from approxjac.robots.drives import usual_effort
from approxjac.robots.traced import motion_between
from approxjac.tasks.analysis import uncombined
from approxjac.validation import Array, as_diagonal, as_integer, as_limits, as_number

_X = {"m": 0.03, "rad": 0.1, "px": 30.0}
_PAYLOAD = 1.5  # times the acceleration that the believed inertia allows
_OFTEN = 0.9  # of the configurations have less
_PUSHED = 0.1  # of the motors' torques: what else may act
_LEAST = 10.0  # rad/s² or m/s²
_FASTEST = 20.0  # rad/s or m/s, where no limit is known
_CHANGE = 2.0  # times the largest speed, of a period
_SOONEST = 0.1  # s, in which a commanded velocity goes from the fastest to zero
_SERVO = 2e-3  # s, in which joints that take velocities reach theirs
_BRIDGED, _EASES = 0.02, 0.5  # s, at most; what is left of the last command from bad to bad sample
_STOPS = 100.0  # 1/s, the largest rate of damping in a stop
_STIFF = 20.0  # 1/s, its stiffness over its damping
_MOST = 1e15  # N m or N
_ABSURD = 1e100
_KINDS = (
    Status.OK, Status.JOINTS_UNKNOWN, Status.POSITION_JUMPED, Status.VELOCITY_JUMPED,
    Status.VELOCITY_DISAGREES, Status.STATE_REPEATED, Status.CLOCK_JUMPED, Status.SENSOR_JUMPED,
)  # fmt: skip
_OFFSET = float(_KINDS[1]) - 1.0


@dataclass(frozen=True, eq=False, repr=False)
class Guard:
    """Bounds of the samples that a controller accepts; `controller.guarded(...)` sets them.

    A sample of q, q̇ and t that no motion of the arm explains is refused: the last command goes out
    once more, eased from the second one on, and nothing that the controller remembers changes. The
    status says why. What is unusual, such as a blow, is refused once. After `periods` in a row the
    controller stops the arm (`Status.STOPPED`): it damps the joints and holds them where they are,
    with gravity compensated, until it begins anew with `initial_state` or `resumed`. Bounds follow
    from the last good sample, the torques sent, what q̈ is usual, the inertia of the believed robot,
    and the errors below; see "The guard" in the documentation. A value of x that jumps farther than
    twice what the arm has moved by is treated as lost, and one refused for 0.25 s ends in a stop,
    too.

    Attributes:
        q: Error of a change of q between two samples, a number or (n_v,) [rad or m]: the step of
            its encoder and noise. By default that of an encoder of 12 bits, whose differences
            give q̇.
        x: Error of a change of x, a number or (m,) [unit of the task]; 0.03 m, 0.1 rad and 30 px by
            default.
        lag: Largest lag of q̇, such as the time constant of its filter [s].
        periods: Periods in a row that are bridged by the last command, for 20 ms at most.

    Raises:
        InvalidInputError: Numbers that are negative or not finite.
    """

    q: float | Sequence[float] | Array = 2.0 * math.pi / 4096
    x: float | Sequence[float] | Array | None = None
    lag: float = 5e-3
    periods: int = 5
    __repr__ = short_fields

    def __post_init__(self) -> None:
        as_diagonal("q", self.q, positive=False)
        as_number("lag", self.lag, unit="s", minimum=0.0)
        as_integer("periods", self.periods, 1)


USUAL = Guard()


class SampleGuard:
    """A guard of one controller: it lets its samples pass or replaces them.

    Args:
        guard: The bounds.
        controller: The `Controller`, whose limits a stop keeps.

    Attributes:
        first: Its memory before the first sample.
    """

    def __init__(self, guard: Guard, controller: Any) -> None:
        task = controller.task
        robot, measured = task.robot, task.measured
        n, m = robot.nv, measured.m
        self._robot, self._measured, self._uncombined = robot, measured, uncombined(task)
        self._takes_torque = controller.command == "torque"
        fastest = np.where(np.isfinite(robot.velocity_limits), robot.velocity_limits, _FASTEST)
        self._reach, self._push, self._damping = usual_accelerations(robot)
        if (own := controller.law.diagonals) is not None:
            self._damping = np.maximum(self._damping, own.damping)
        if not self._takes_torque:
            self._damping = np.zeros(n)
            self._push = np.maximum(self._push, fastest / _SERVO)
        noise = [_X.get(unit, math.inf) for unit in measured.units]
        if guard.x is not None:
            noise = as_limits("x of a guard", guard.x, m, unit=joined(measured.units)).tolist()
        q_noise = 2.0 * as_diagonal("q of a guard", guard.q, n, positive=False)
        self._bounds = checks.GuardBounds(
            q_noise.tolist(), guard.lag, (_CHANGE * fastest).tolist(), self._push, noise,
            tuple(measured.parts), float(guard.periods), _BRIDGED,
        )  # fmt: skip
        begin = robot.neutral().tolist(), task.origin.tolist()
        self.first = checks.first_memory(*begin, self._bounds)
        self._ends = ends = checks.GuardMemory.ends(robot.nq, n, task.n_x, len(measured.parts))
        self._subtracts, self._command = robot.nq == n, slice(ends[8], ends[9])
        kept = (controller.limits or Limits()).for_joints(n)
        effort, rate = np.asarray(kept.effort), np.asarray(kept.rate)
        if not self._takes_torque:
            effort, rate = np.full(n, math.inf), fastest / _SOONEST
        stop = self._damping, _STIFF * self._damping, effort
        self._stop, self._rate = [each.tolist() for each in stop], rate.tolist()
        self._eases = np.where(np.isfinite(rate), 1.0, _EASES)  # a limiter knows no other

    def step(
        self,
        controller: Any,
        state: Array,
        memory: Array,
        measurement: Measurement,
        target: Target | Array,
        dt: float,
    ) -> tuple[Array, Evaluation]:
        """Do the work of `Controller.step`, with its state in two parts."""
        traced = hasattr(memory, "arm_of")
        try:
            t, q, v, x, t_x = measurement
            kept = checks.GuardMemory.of(memory.tolist(), self._ends)
            with np.errstate(over="ignore", invalid="ignore"):
                before, seen = memory[4 : self._ends[1]], memory[self._ends[9] : self._ends[10]]
                way = q - before if self._subtracts else motion_between(self._robot, before, q)
                x_way = x - seen if self._measured.subtracts else self._measured.error(x, seen)
                size = 0.0 if traced else memory.dot(memory)
            taken = math.nan if t_x is None else t_x
            ways = way.tolist(), law.array(x_way).tolist()
            sample = checks.Sample(t, q.tolist(), v.tolist(), x.tolist(), taken, *ways)
            judgement = checks.judged(kept, sample, dt, self._bounds)
        except (ArithmeticError, AttributeError, IndexError, TypeError, ValueError) as error:
            controller.advance(state, measurement, target, dt)  # which says what is wrong
            message = f"measurement must hold times [s] and arrays of floats, got {measurement!r}"
            raise InvalidInputError(message, given=measurement) from error
        if not size < _ABSURD * _ABSURD:
            message = (
                f"state must be finite, and below {_ABSURD:.0e}, got {memory.tolist()} of the guard"
            )
            raise InvalidInputError(message, given=memory)
        kind, refuses_x, anew = judgement.verdict
        is_bad, stops, refuses_x = kind > 0, judgement.after.kind > 0, refuses_x > 0
        is_first, passed = kept.t <= 0.5 * checks.UNSEEN, measurement
        if (is_bad is True or refuses_x is True) and is_first:
            controller.advance(state, measurement, target, dt)  # there is no good sample yet
            if is_bad:
                message = (
                    "a first sample must have a q and q̇ that joints can have, and a time t below "
                    f"1e15 s, got {measurement!r}"
                )
                raise MeasurementError(message, given=measurement)
        is_changed = is_bad | stops | refuses_x
        is_slowed = is_first if traced else is_first and judgement.v != sample.v
        if (is_changed | is_slowed) is not False:
            unknown = None if t_x is None or isinstance(t_x, float) else math.nan
            t, t_x = law.select(is_bad, kept.t + dt, t), law.select(is_changed, unknown, t_x)
            q, v, x = map(law.array, (judgement.q, judgement.v, judgement.x))
            passed = Measurement(t, q, v, x, t_x)
        after, answer = controller.advance(state, passed, target, dt)
        command, gravity = answer.torque, answer.gravity

        def replaced() -> tuple[Array, Array]:
            """Return the state and the command of a bad sample."""
            g = 0.0 * command
            if self._takes_torque:
                g = controller.gravity_torque(state, passed.q) if gravity is None else gravity
            change = [dt * each for each in self._rate]
            halt = checks.stop_command(judgement, g.tolist(), *self._stop, kept.command, change)
            last = law.array(kept.command)
            eased = law.select(kept.bad > 0.0, halt + self._eases * (last - halt), last)
            return state, law.select(stops | (anew > 0), halt, eased)

        if is_changed is not False:
            usual = after, command
            after, command = law.choose(is_bad | stops, replaced, lambda: usual)
            status = law.select(refuses_x, Status.SENSOR_JUMPED, answer.status)
            name = _KINDS[kind] if type(kind) is int else kind + _OFFSET
            status = law.select(stops, Status.STOPPED, law.select(is_bad, name, status))
            answer = answer._replace(torque=command, status=status)
        rest = 0.0 * command if gravity is None else gravity  # the arm's, before a first command
        before = law.select(is_first, rest, memory[self._command])
        if self._takes_torque:  # by how much |q̈| may change from one command to the next
            push = self._reach @ np.minimum(np.abs(command - before), _MOST)
        else:
            push = np.minimum(np.abs(command - v) / _SERVO, _MOST)
        J_hat, sizes = answer.J_hat, None
        if J_hat is not None:
            if self._uncombined is not None:  # of what is measured
                J_hat = self._uncombined.dot(J_hat)
            sizes = [law.length(J_hat[rows].ravel()) for _, rows in self._bounds.parts]
        memory = checks.remembered(judgement, dt, command.tolist(), push.tolist(), sizes).joined()
        if not traced and not np.isfinite(memory).all() and np.isfinite(command).all():
            message = f"what is remembered of {measurement!r} overflows in a step of {dt!r} s"
            raise MeasurementError(message, given=measurement)
        return np.concatenate([after, memory]) if len(after) else memory, answer


@functools.lru_cache(maxsize=32)
def usual_accelerations(robot: Robot) -> tuple[Array, Array, Array]:
    """Return |q̈| per unit of torque (n_v, n_v), |q̈| of loads, and a stop's damping, (n_v,) each."""
    inertias = usual_inertias(robot)
    M_inv = np.linalg.inv(inertias)
    mobility = _PAYLOAD * np.quantile(np.abs(M_inv), _OFTEN, axis=0)
    light = 1.0 / np.diagonal(M_inv, axis1=1, axis2=2).max(axis=0)
    damping = light * (_STOPS / max_damping_rate(inertias, light))
    push = np.linalg.norm(mobility * (_PUSHED * usual_effort(robot)), axis=1)
    return mobility, np.maximum(push, _LEAST), damping
