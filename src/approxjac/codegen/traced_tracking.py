"""Law T on symbols: what `TrackingController` computes in a usual step, as machine code."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

from approxjac import law
from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.learnt_arm import LearntBodies, point_motion
from approxjac.codegen.arm.rigid_body import Arm
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.trace.linear import is_regular
from approxjac.codegen.trace.program import Program
from approxjac.codegen.trace.symbols import Symbols, select, symbols
from approxjac.controllers import AdaptiveDynamics, AdaptiveKinematics, TrackingController
from approxjac.controllers.arguments import FLOAT64, HUGE
from approxjac.controllers.controller import Controller
from approxjac.controllers.learning.estimator import pulled_back
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, LimitStatus, Measurement, Status, Target
from approxjac.law.factors import Factors
from approxjac.robots.dynamics_regressor import COULOMB_SPEED
from approxjac.tasks import PoseTask
from approxjac.validation import Array

Step = Callable[[Array, Measurement, Target | Array, float], tuple[Array, Evaluation]]
_SMALL_ANGLE = 1e-4  # as of `law.rotation_exp`
_ROUND_OFF = 1e-12


def require_covered(controller: Controller) -> None:
    """Refuse a law of which no code can be made.

    Raises:
        InvalidInputError: Another law than law T, one that commands velocities, or kinematics,
            dynamics or a task of another kind.
    """

    def refuse(name: str, wanted: str, given: Any) -> NoReturn:
        raise InvalidInputError(
            f"{name} must be {wanted} to make code of it, got {given!r}", given=given
        )

    if type(controller) is not TrackingController:
        refuse("controller", "a TrackingController", controller)
    if controller.command != "torque":
        refuse("command", '"torque"', controller.command)
    if type(controller.kinematics) is not AdaptiveKinematics:
        refuse("kinematics", "AdaptiveKinematics", controller.kinematics)
    if type(controller.dynamics) is not AdaptiveDynamics:
        refuse("dynamics", "AdaptiveDynamics", controller.dynamics)
    if isinstance(controller.task, PoseTask):
        refuse("task", "one of positions", controller.task)
    tasks.require_covered(controller.task)


def step_program(controller: TrackingController) -> Program:
    """Return the program of one step of law T without a new frame.

    What is kept are its arguments "q", "v", "x", "x_d", "v_d", "a_d", "a_hat" (what the dynamics
    have learnt) and "smoothed" (what the kinematics go by, and its rates), and its answer "torque",
    "e", "J_hat", "gravity", "reference", "learnt" (a_hat after the step), "advanced" (the smoothed
    estimates after it) and "usual" (whether all of that holds: numbers are small, and Ĵ is far from
    singular).

    Args:
        controller: The law, one that `require_covered` takes.
    """
    task, kinematics = controller.task, controller.kinematics
    robot, m = task.robot, task.m
    assert isinstance(kinematics, AdaptiveKinematics)
    program = Program()
    arm = Arm(program.given, "belief", robot, kinematics.regressor.frames)
    q, v = program.kept("q", robot.nq), program.kept("v", robot.nv)
    x, x_d = program.kept("x", task.n_x), program.kept("x_d", task.n_x)
    v_d, a_d = program.kept("v_d", m), program.kept("a_d", m)
    a_hat = program.kept("a_hat", controller.dynamics.n_state)
    places = _smoothed(kinematics)
    flat = program.kept("smoothed", places["spin"].stop)
    smoothed = {name: flat[place] for name, place in places.items()}
    here = arm.at(q)

    # kinematics, and the motion that they lead to
    unknowns, regressor = kinematics._unknowns, kinematics.regressor
    theta = symbols(unknowns.translations(smoothed["u"]))
    theta_dot = symbols(unknowns.rates(smoothed["u_dot"]))
    motion = unknowns.seen(point_motion(here, regressor, v, theta, theta_dot))
    R = unknowns.R if unknowns.is_turned else None
    if unknowns.turns:
        R = smoothed["R"].reshape(unknowns.d, unknowns.d)
    target = Target(x_d, v_d, a_d)
    prediction = pulled_back(motion, smoothed["b"], smoothed["b_dot"], R, smoothed["spin"], target)
    z, J, J_dot, feed, feed_dot, drift = map(symbols, prediction)
    z_dot = J @ v - feed + drift
    u, u_dot = law.task_velocity(z, z_dot, feed, feed_dot, controller._alpha, controller._k)
    null, null_dot = map(symbols, controller._rest.velocity(q, v))
    G = J @ J.T
    regular = is_regular(G, controller._ratio, controller._scale)
    v_r, a_r = law.solved_reference(_solver(G), 0.0, J, J_dot, u, u_dot, null, null_dot)
    v_r, a_r = _within_speeds(v_r, a_r, controller._fastest)

    # dynamics
    dynamics, sigma = controller.dynamics, v - v_r
    assert isinstance(dynamics, AdaptiveDynamics)
    links, bodies = dynamics.regressor.links, LearntBodies(here, v, v_r, a_r)
    joints = np.array([a_r, v_r, np.tanh(v_r / COULOMB_SPEED), symbols(np.ones(robot.nv))])
    Y_d_sigma = np.concatenate([bodies.powers(sigma), symbols(joints * sigma).ravel()])
    learnt = a_hat + controller.dt * law.dynamics_rate(dynamics.gamma, Y_d_sigma)
    learnt = np.minimum(np.maximum(learnt, dynamics._low), dynamics._high)
    of_joints = symbols(joints * learnt[links:].reshape(joints.shape))
    feedforward = bodies.torque(learnt[:links]) + of_joints.sum(axis=0)
    M_sigma = here.momentum(sigma) + (dynamics.rotor_inertia + controller._added) * sigma
    torque = law.tracking_torque(feedforward, controller.kappa, M_sigma)

    e = tasks.error(task, x, x_d)
    numbers = (q, v, x, x_d, v_d, a_d, a_hat, e, torque, v_r, a_r, J)
    size = sum(((each * each).sum() for each in numbers), 0.0)
    usual = regular & (size < HUGE)
    for joint in list(robot.model.joints)[1:]:
        if joint.nq == 2:  # a (cos, sin) pair off the unit circle is for Python to judge
            cosine, sine = q[joint.idx_q], q[joint.idx_q + 1]
            usual = usual & (abs(cosine * cosine + sine * sine - 1.0) < _ROUND_OFF)
    found = {
        "torque": torque, "e": e, "J_hat": J, "gravity": bodies.gravity(learnt[:links]),
        "reference": v_r, "learnt": learnt, "advanced": _advanced(smoothed, controller.dt),
        "usual": select(usual, 1.0, 0.0),
    }  # fmt: skip
    for name, value in found.items():
        program.kept(name, symbols(value).size)
    program.step(found)
    return program


def _smoothed(kinematics: AdaptiveKinematics) -> dict[str, slice]:
    """Return where in a state, from "u" on, the smoothed estimates and their rates are."""
    first = kinematics._at["u"].start
    return {
        name: slice(kinematics._at[name].start - first, kinematics._at[name].stop - first)
        for name in ("u", "b", "R", "u_dot", "b_dot", "spin")
    }


def _solver(G: Symbols) -> Callable[[Symbols], Symbols]:
    """Return b ↦ G⁻¹b."""
    if len(G) > 3:
        return Factors(G).solve
    rows, determinant, _, _ = law.adjugate(G.tolist())
    return lambda b: symbols(law.solution(rows, determinant, b.tolist()))


def _within_speeds(v_r: Symbols, a_r: Symbols, fastest: Array) -> tuple[Symbols, Symbols]:
    """Return what `law.within_speeds` does."""
    shares = np.abs(v_r) / fastest
    share, v_i, a_i = shares[0], v_r[0], a_r[0]
    for each, v_next, a_next in zip(shares[1:], v_r[1:], a_r[1:], strict=True):
        more = each > share
        share, v_i, a_i = (
            select(more, *pair) for pair in ((each, share), (v_next, v_i), (a_next, a_i))
        )
    slow_v, slow_a = law.slowed(v_r, a_r, share, a_i / v_i)
    is_fast = symbols(share > 1.0)
    return np.where(is_fast, slow_v, v_r), np.where(is_fast, slow_a, a_r)


def _advanced(smoothed: dict[str, Symbols], dt: float) -> Symbols:
    """Return u, b and R after dt [s], as `AdaptiveKinematics` goes on with them."""
    parts = [smoothed[name] + dt * smoothed[f"{name}_dot"] for name in ("u", "b")]
    spin = dt * smoothed["spin"]
    if len(spin):
        angle = np.sqrt(symbols([(spin * spin).sum()]))
        (s,), (c,) = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
        turns = angle[0] > _SMALL_ANGLE
        turn = law.rodrigues(spin.tolist(), select(turns, s, 1.0), select(turns, c, 0.5))
        parts.append((symbols(turn) @ smoothed["R"].reshape(len(turn), -1)).ravel())
    return np.concatenate(parts)


def compiled_step(controller: TrackingController, ordinary: Callable[..., Any]) -> Step:
    """Return `step` of a law with machine code.

    Args:
        controller: The law, one that `require_covered` takes.
        ordinary: `step` of what is not usual.
    """
    kinematics, dt = controller.kinematics, controller.dt
    assert isinstance(kinematics, AdaptiveKinematics)
    program = step_program(controller)
    buffer = np.zeros((1, program.n_rows, 1))
    flat = buffer[0, :, 0]
    run = LlvmLanes(program, width=1).bound(buffer, np.zeros((1, 1, 1)))
    place = {name: slice(at, at + size) for name, (at, size) in program.rows.items()}
    given = ("q", "v", "x", "x_d", "v_d", "a_d", "a_hat", "smoothed")
    q_in, v_in, x_in, x_d_in, v_d_in, a_d_in, a_in, smoothed_in = (
        flat[place[name]] for name in given
    )
    first = place["torque"].start
    answered = flat[first:]
    told = ("torque", "e", "J_hat", "gravity", "reference", "learnt")
    torque_at, e_at, J_at, gravity_at, reference_at, learnt_at = (
        slice(place[name].start - first, place[name].stop - first) for name in told
    )
    usual_at = place["usual"].start - first
    m, p, end = controller.task.m, controller._n_dynamics, controller._end
    begin = p + kinematics._at["u"].start  # in the state
    smoothed_at = slice(begin, begin + len(smoothed_in))
    J_shape, shapes, task_shape = (m, controller.task.robot.nv), controller._shapes, (m,)
    float64, array, made, isfinite = FLOAT64, np.ndarray, tuple.__new__, math.isfinite
    ok, unlimited = Status.OK, LimitStatus.UNLIMITED

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
            _, q, v, x, _ = measurement
            if not (
                (q.shape, v.shape, x.shape, x_d.shape, state.shape) == shapes
                and q.dtype is v.dtype is x.dtype is x_d.dtype is state.dtype is float64
                # what a mask hides is not measured
                and type(q) is type(v) is type(x) is type(x_d) is type(state) is array
                and put(v_d, v_d_in)
                and put(a_d, a_d_in)
            ):
                return None
        except (AttributeError, TypeError, ValueError):
            return None
        if kinematics.status(state[p:end], measurement) is not ok or not state.dot(state) < HUGE:
            return None
        q_in[:], v_in[:], x_in[:], x_d_in[:] = q, v, x, x_d
        a_in[:], smoothed_in[:] = state[:p], state[smoothed_at]
        run()
        found = answered.copy()
        if not found[usual_at]:
            return None
        after = state.copy()
        after[:p] = found[learnt_at]
        known = after[p:end]
        with np.errstate(over="ignore", invalid="ignore"):  # which ends as an error
            try:
                kinematics.check(known, measurement, dt)
                kinematics.correct(known, measurement, dt)
            except np.linalg.LinAlgError:
                return None
            if not isfinite(after.dot(after)):
                return None
        return after, made(Evaluation, (
            found[torque_at], None, ok, found[e_at], found[J_at].reshape(J_shape),
            found[gravity_at], unlimited, 0.0, found[reference_at],
        ))  # fmt: skip

    def step(
        state: Array, measurement: Measurement, target: Target | Array, given_dt: float
    ) -> tuple[Array, Evaluation]:
        found = answer(state, measurement, target) if given_dt == dt else None
        return ordinary(state, measurement, target, given_dt) if found is None else found

    return step
