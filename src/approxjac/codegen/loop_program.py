"""The sampled closed loop on symbols: plant, law, and what is told of each run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.codegen import traced_law as laws
from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.arm_numbers import ArmNumbers, arm_numbers
from approxjac.codegen.arm.rigid_body import Arm, Configured, moved
from approxjac.codegen.regions import Box, outside
from approxjac.codegen.sensors import Measured, Senses
from approxjac.codegen.trace.program import Program
from approxjac.codegen.trace.symbols import (
    LARGEST_ANGLE,
    Condition,
    Number,
    Scalar,
    Symbols,
    any_of,
    select,
    symbols,
)
from approxjac.controllers.controller import Controller
from approxjac.controllers.gains.gains import Diagonals
from approxjac.controllers.setpoint import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, Measurement, Target, TargetPath
from approxjac.law.factors import Factors
from approxjac.simulation import Plant
from approxjac.simulation.plant import INTEGRATORS
from approxjac.validation import Array

_GUESSES = 3
_FINITE = 1e200  # sum of squares, beyond which a run has diverged


class Told(NamedTuple):
    """Names of what is told of each run, a number each; all but the last two of what is recorded.

    Attributes:
        last_bad: Number of the step at which the error was last not below the tolerance, or −1.
        error: ‖e‖ at the end.
        torque: Largest share of a motor's limit.
        speed: Largest share of a limit of speed.
        outside: Whether a configuration was outside the region.
        diverged: Whether numbers became too large.
        left: Whether the run is left to Python, as it came to what is not covered.
    """

    last_bad: str = "last_bad"
    error: str = "error"
    torque: str = "torque"
    speed: str = "speed"
    outside: str = "outside"
    diverged: str = "diverged"
    left: str = "left"


TOLD = Told()


class LoopProgram(NamedTuple):
    """The program of a closed loop, and what gives it its parameters.

    Attributes:
        program: The program.
        truth: The true arms.
        senses: Sensors and motors.
    """

    program: Program
    truth: Arm
    senses: Senses


def require_covered(controller: Controller, plant: Plant) -> None:
    """Refuse a closed loop of which no code can be made.

    Raises:
        InvalidInputError: A controller or a sensor that takes no symbols, or another plant than
            those covered.
    """
    laws.require_covered(controller)
    tasks.require_covered(plant.sensor)
    more = (plant.servo, plant.torque_limits, plant.adds_gravity)
    if type(plant) is not Plant or any(part is not None for part in more):
        raise InvalidInputError(
            "plant must be a Plant itself, without a servo, torque_limits and adds_gravity, to "
            f"make code of it, got {plant!r}",
            given=plant,
        )


def closed_loop(
    controller: Controller,
    plant: Plant,
    numbers: ArmNumbers,
    sensors: Mapping[str, Array],
    targets: Array,
    gains: Array,
    region: Box,
    dt: float,
    steps: int,
    tolerance: float,
    integrator: str = "semi_implicit_euler",
    path: Target | TargetPath | None = None,
) -> LoopProgram:
    """Return the program of a sampled closed loop.

    Args:
        controller: The law, `TorqueLimited` around it, or `HeldMeasurement` around them.
        plant: One of the true robots, with its sensor, friction and lateness.
        numbers: Of true robots, stacked, such that all differ in what ever differs.
        sensors: Numbers of their sensors, as `tasks.numbers` has them.
        targets: x_d of each of them, shape (N, n_x).
        gains: Diagonals of the law of each, one after the other, shape (N, 2 m + n_v).
        region: Where runs are to stay.
        dt: Sampling time [s].
        steps: Number of steps of a run.
        tolerance: Error below which a task counts as done.
        integrator: One of `INTEGRATORS`.
        path: Where the target of all moves, in place of `targets`; or None.
    """
    program = Program()
    at_rest = program.given("target", targets)
    sensor = {name: program.given(name, values) for name, values in sensors.items()}
    senses, m = Senses(plant, dt, steps, path), controller.task.m
    x_d, v_d = senses.target(program) or (at_rest, None)
    if gains.size:
        own = Diagonals(*np.split(program.given("gains", gains), (m, 2 * m)))
        controller = laws.with_gains(controller, own)
    loop = _Loop.of(program, controller, plant, numbers, sensor, x_d, dt, integrator, senses, v_d)
    answer, robot = loop.answer, plant.robot
    told = {name: program.kept(name, 1)[0] for name in TOLD}
    program.step(loop.after | {
        TOLD.diverged: select(loop.diverged, 1.0, told[TOLD.diverged]),
        TOLD.left: select(loop.left, 1.0, told[TOLD.left]),
    })  # fmt: skip
    error = np.sqrt((loop.error * loop.error).sum())
    record = told[TOLD.last_bad]
    program.record({
        TOLD.last_bad: select(error < tolerance, record, program.k),
        TOLD.error: error,
        TOLD.torque: _larger(told[TOLD.torque], answer.torque / plant.motor_limits),
        TOLD.speed: _larger(told[TOLD.speed], loop.v / robot.velocity_limits),
        TOLD.outside: select(outside(loop.q, plant.robot, region), 1.0, told[TOLD.outside]),
    })  # fmt: skip
    return LoopProgram(program, loop.truth, senses)


def recorded_loop(controller: Controller, plant: Plant, dt: float, integrator: str) -> Program:
    """Return the program of one run that is recorded.

    Of a plant with ideal sensors. Its target is kept as "target"; "x", "torque", "e", "J_hat",
    "status", "limit_status", "slack" and "rate", that of the state, are of each step.
    """
    program = Program()
    x_d = program.kept("target", plant.sensor.n_x)
    numbers = ArmNumbers.stacked([arm_numbers(plant.robot, tasks.frames(plant.sensor))])
    loop = _Loop.of(program, controller, plant, numbers, {}, x_d, dt, integrator)
    answer = loop.answer
    flags = {
        name: (select(condition, 1.0, program.kept(name, 1)[0]))
        for name, condition in ((TOLD.diverged, loop.diverged), (TOLD.left, loop.left))
    }
    found = {
        "x": loop.x, "torque": answer.torque, "e": answer.e, "J_hat": answer.J_hat,
        "status": answer.status, "limit_status": answer.limit_status, "slack": answer.slack,
        "rate": answer.state_rate,
    }  # fmt: skip
    unknown = {"J_hat": np.zeros((plant.sensor.m, plant.robot.nv)), "rate": np.zeros(0)}
    found |= {name: unknown[name] for name in unknown if found[name] is None}
    for name, value in found.items():
        program.kept(name, symbols(value).size)
    program.step(loop.after | flags | found)
    return program


class _Loop(NamedTuple):
    """A step of the loop: before it, what the law answers, and after it."""

    truth: Arm
    q: Symbols
    v: Symbols
    x: Symbols
    error: Symbols  # of what no sensor sees, too
    answer: Evaluation
    after: dict[str, Any]
    diverged: Condition
    left: Condition

    @classmethod
    def of(
        cls,
        program: Program,
        controller: Controller,
        plant: Plant,
        numbers: ArmNumbers,
        sensor: Mapping[str, Symbols],
        x_d: Symbols,
        dt: float,
        integrator: str,
        senses: Senses | None = None,
        v_d: Symbols | None = None,
    ) -> _Loop:
        robot = plant.robot
        truth = Arm(program.given, "truth", robot, tasks.frames(plant.sensor), numbers)
        q, v = program.kept("q", robot.nq), program.kept("v", robot.nv)
        state = program.kept("state", len(laws.first_state(controller)))
        here = truth.at(q)
        value = tasks.value(plant.sensor, here, sensor)
        x = tasks.seen(plant.sensor, value)
        error = tasks.error(plant.sensor, value, x_d)
        told, may_lose = Measured(q, v, x, {}), tasks.may_lose(plant.sensor)
        left: Condition = False
        counted: dict[str, Any] = {}
        if senses is None:
            count = program.kept("count", 1)[0]
            time, counted = count * dt, {"count": count + 1.0}
            t_x = time
        else:
            told, may_lose = senses.measured(program, q, v, x), may_lose or senses.may_lose
            time, t_x = program.k * dt, senses.time_of_x(program)
            state, left = _begun(program, controller, state, told)
        program.graph.is_finite = not may_lose
        measurement = Measurement(time, told.q, told.v, told.x, t_x)
        target = x_d if v_d is None else Target(x_d, v_d)
        after, answer, unfinished = laws.stepped(controller, state, measurement, target, dt)
        program.graph.is_finite = False
        left = left | unfinished
        acting, kept = answer.torque, told.kept | counted
        if senses is not None:
            acting, late = senses.acting(program, answer.torque)
            kept = kept | late
        q_end, v_end = _advanced(plant, truth, here, q, v, acting, dt, integrator)
        touched = _touched(plant, q_end)
        if isinstance(touched, Scalar):
            q_held, v_held, wrong = _held(plant, here, q, v, acting, dt)
            n, ends = len(q), [*q_end.tolist(), *v_end.tolist(), 0.0]
            stopped = [*q_held.tolist(), *v_held.tolist(), select(wrong, 1.0, 0.0)]
            *ends, is_wrong = program.graph.rare(touched, stopped, ends)
            q_end, v_end, left = symbols(ends[:n]), symbols(ends[n:]), left | (is_wrong > 0.0)
        left = left | any_of(np.abs(q_end) > LARGEST_ANGLE)
        squares = [(each * each).sum() for each in (q_end, v_end, answer.torque, state)]
        diverged = ~(sum(squares, 0.0) < _FINITE)
        following: dict[str, Any] = {"q": q_end, "v": v_end, "state": after}
        return cls(truth, q, v, x, error, answer, following | kept, diverged, left)


def _begun(
    program: Program, controller: Controller, state: Symbols, told: Measured
) -> tuple[Symbols, Condition]:
    """Return a state that begins with the first x, where it does, and whether that is lost."""
    if controller.kinematics is not None and controller.law is controller:
        first = laws.begun(controller, told.q, told.v, told.x)
        law.alter(program.k < 1.0, state, lambda state: state.__setitem__(slice(None), first))
        return state, False
    if not isinstance(controller.law, SetpointController) or controller.law.velocity is None:
        return state, False
    is_first, p, m = symbols(program.k < 1.0), controller.law.resting, controller.law.task.m
    followed = np.where(is_first, told.x, state[p : p + m])
    state = np.concatenate([state[:p], followed, state[p + m :]])
    return state, any_of(is_first & ~np.isfinite(told.x))


def _larger(known: Number, shares: Symbols) -> Number:
    for share in np.abs(shares).tolist():
        if isinstance(share, Scalar):
            known = select(share > known, share, known)
    return known


def _advanced(
    plant: Plant,
    truth: Arm,
    here: Configured,
    q: Symbols,
    v: Symbols,
    torque: Symbols,
    dt: float,
    integrator: str,
) -> tuple[Symbols, Symbols]:
    """Return what `Plant.advance` does without stops."""

    def acceleration(at: Symbols, v: Symbols, torque: Symbols) -> Symbols:
        arm = here if at is q else truth.at(at)
        return arm.forward(v, torque - plant.friction_torque(v))

    def motion(q: Symbols, by: Symbols) -> Symbols:
        return moved(plant.robot, q, by)

    return INTEGRATORS[integrator](acceleration, motion, q, v, torque, dt)


def _touched(plant: Plant, q: Symbols) -> Condition:
    """Return what `JointStops.touched` does."""
    if plant.stops is None:
        return False
    beyond = [
        (value < low) | (value > high)
        for value, (low, high) in zip(q.tolist(), plant.stops.ends, strict=True)
        if math.isfinite(low) or math.isfinite(high)
    ]
    return any_of(np.array(beyond, dtype=object))


def _held(
    plant: Plant, here: Configured, q: Symbols, v: Symbols, torque: Symbols, dt: float
) -> tuple[Symbols, Symbols, Condition]:
    """Return what `Plant.advance` does at stops, as `JointStops.held_torque` has it.

    Which joints press on their stops is found in a few guesses, each from the last one. Returns q
    and v, and whether the last guess was wrong.
    """
    stops, nv = plant.stops, plant.robot.nv
    assert stops is not None
    free = v + dt * here.forward(v, torque - plant.friction_torque(v))
    M_inv = here.factors.solve(symbols(np.eye(nv)))
    depth, side, limited = _depth(plant, q)
    outward = side * free
    slowed = dt * side[:, np.newaxis] * M_inv * side
    per_speed = stops.stiffness * dt + stops.damping
    b = stops.stiffness / per_speed * depth + outward
    nothing = symbols(np.zeros(nv))

    def guess(_: Any, values: tuple[Any, ...]) -> tuple[Any, ...]:
        push, left, touches, presses, _ = values  # left is what is left of b without its own push
        touches = touches | (limited & (depth + dt * (outward - slowed @ push) > 0.0))
        presses = touches & np.where(presses, push > 0.0, left > 0.0)
        A = np.where(presses[:, np.newaxis] & presses, slowed, 0.0)
        A = A + np.diag(np.where(presses, 1.0 / per_speed, 1.0))
        push = np.where(presses, Factors(A).solve(np.where(presses, b, 0.0)), 0.0)
        left = b - slowed @ push
        newly = limited & ~touches & (depth + dt * (outward - slowed @ push) > 0.0)
        wrong = any_of(newly | (presses & (push < 0.0)) | (touches & ~presses & (left > 0.0)))
        return push, left, touches, presses, wrong

    start = nothing, b, nothing < 0.0, nothing < 0.0, False
    push, *_, wrong = law.repeat(_GUESSES, guess, start)
    v_end = free - dt * (M_inv @ (side * push))
    return moved(plant.robot, q, dt * v_end), v_end, wrong


def _depth(plant: Plant, q: Symbols) -> tuple[Symbols, Symbols, Array]:
    """Return what `JointStops.depth` does, and of which joints: 0 and 1 of others."""
    robot = plant.robot
    depth, side = symbols(np.zeros(robot.nv)), symbols(np.ones(robot.nv))
    limited = np.zeros(robot.nv, dtype=bool)
    for i, (name, low, high) in enumerate(
        zip(robot.joint_names, *robot.position_limits, strict=True)
    ):
        joint = robot.model.joints[robot.model.getJointId(name)]
        if joint.nq == 2 or not (math.isfinite(low) or math.isfinite(high)):
            continue
        above, below = q[joint.idx_q] - high, low - q[joint.idx_q]
        depth[i] = select(above > below, above, below)
        side[i] = select(above > below, 1.0, -1.0)
        limited[i] = True
    return depth, side, limited
