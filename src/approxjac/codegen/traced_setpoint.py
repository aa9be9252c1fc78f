"""The set-point laws on symbols: what `SetpointController` computes in a usual step."""

from __future__ import annotations

from types import NoneType
from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.codegen.arm import traced_tasks as tasks
from approxjac.codegen.arm.rigid_body import Arm, Configured
from approxjac.codegen.trace.linear import Factors, damped_gram_solve, product
from approxjac.codegen.trace.symbols import Condition, Scalar, Symbols, any_of, select, symbols
from approxjac.controllers import AwayFromStops, Posture
from approxjac.controllers.controller import Controller
from approxjac.controllers.gains.default_gains import slow_rate
from approxjac.controllers.gains.gains import Diagonals
from approxjac.controllers.gains.reach import UNKNOWN_TOOL
from approxjac.controllers.gravity import (
    Adaptation,
    AdaptiveGravity,
    ModelGravity,
    NoGravity,
    RegressorGravity,
)
from approxjac.controllers.setpoint import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.interface import Status
from approxjac.law import Linear, Saturation, Sine, Tanh
from approxjac.law.saturation import sine, tanh
from approxjac.robots import GravityRegressor, Robot

_SWEEPS = 10
_ROUND_OFF = 1e-12  # of what led out of bounds
_LIFT = 1e-14  # of the trace, well above what rounding leaves
_GRAVITY = (ModelGravity, NoGravity, RegressorGravity, AdaptiveGravity, Adaptation)
STATUSES = tuple(Status)
"""A status is its place in this."""


class Answer(NamedTuple):
    """Answer of a law.

    Attributes:
        torque: Shape (n_v,).
        rate: Of the state, shape (n_state,).
        status: Place in `STATUSES`.
        e: Task error, shape (m,); NaN where x is lost.
        J_hat: Ĵ, shape (m, n_v).
        pinv_s: Ĵ⁺s(e), shape (n_v,).
        gravity: Gravity torque in it, shape (n_v,).
        left: Whether the rest does not hold, and is left to Python.
        reference: Ĵ⁺ẋ_d of a target that moves, shape (n_v,).
    """

    torque: Symbols
    rate: Symbols
    status: Any
    e: Symbols
    J_hat: Symbols
    pinv_s: Symbols
    gravity: Symbols
    left: Condition
    reference: Any = 0.0


def require_covered(controller: Controller) -> None:
    """Refuse a law of which no code can be made.

    Raises:
        InvalidInputError: A task, a saturation, a source of gravity or a posture of another kind
            than those covered.
    """
    if type(controller) is not SetpointController:
        raise InvalidInputError(
            "controller must be a SetpointController, or one in a TorqueLimited with limits of "
            "effort alone, to make code of it (`compiled` also takes a TrackingController; what "
            f"else goes around a law goes around the compiled one), got {controller!r}",
            given=controller,
        )
    tasks.require_covered(controller.task)
    saturation, gravity, posture = controller.saturation, controller.gravity, controller.posture
    if type(saturation) not in (Linear, Sine, Tanh):
        raise InvalidInputError(
            f"saturation must be Linear, Sine or Tanh to make code of it, got {saturation!r}",
            given=saturation,
        )
    robot = controller.task.robot
    if type(gravity) not in _GRAVITY:
        raise InvalidInputError(
            "gravity must be a ModelGravity, NoGravity, RegressorGravity or AdaptiveGravity to "
            f"make code of it, got {type(gravity).__name__}: {gravity!r}",
            given=gravity,
        )
    is_own = type(posture) in (Posture, AwayFromStops, NoneType)
    if not is_own or (isinstance(posture, Posture) and robot.nq != robot.nv):
        raise InvalidInputError(
            "posture must be a Posture or AwayFromStops itself, and AwayFromStops for an arm with "
            f"continuous joints, to make code of it, got {posture!r}",
            given=posture,
        )


def n_state(controller: SetpointController) -> int:
    """Return the length of a law's state."""
    followed = 0 if controller.velocity is None else controller.task.m
    return controller.resting + followed


def answer(
    controller: SetpointController,
    arm: Configured,
    q: Symbols,
    v: Symbols,
    x: Symbols,
    x_d: Symbols,
    state: Symbols,
    *,
    may_lose: bool,
    v_d: Symbols | None = None,
    gains: Diagonals | None = None,
) -> Answer:
    """Return what `SetpointController.evaluate` does.

    Args:
        controller: The law.
        arm: The believed arm at q.
        q: Configuration, shape (nq,).
        v: Joint velocity, shape (n_v,).
        x: Measured x, shape (n_x,).
        x_d: Target, shape (n_x,).
        state: State of the law.
        may_lose: Whether x may be lost.
        v_d: Motion of the target, shape (m,); None is at rest.
        gains: In place of the law's own.
    """
    task, learning, scale = controller.task, controller.adaptation, controller.pinv.scale
    ratio = controller.pinv.ratio
    (kp, kv, damping), p = gains or controller.diagonals, controller.resting
    e = tasks.error(task, x, x_d)
    lost: Condition = False
    s = _saturated(controller.saturation, e)
    if may_lose:
        lost = ~((e * e).sum() < np.inf)
        s = np.where(lost, 0.0, s)
    J_hat = tasks.jacobian(task, arm, x)
    G = J_hat @ J_hat.T
    left: Condition = False
    if learning is None:
        g = _gravity(controller, arm)
        Y = np.zeros((len(v), 0))
    else:
        Y = symbols(_regressor(learning, arm, J_hat))
        g = law.gravity(Y, state[:p])
    weight = 1.0 if controller.pinv.root is None else 1.0 / controller.pinv.root
    weighted = J_hat * weight
    w, damped, _, _ = damped_gram_solve(weighted @ weighted.T, s, scale, ratio)
    pinv_s = (w @ weighted) * weight
    bias = g
    if controller.posture is not None:
        bias = bias + _within_null_space(_pull(controller, q), J_hat, G, scale, ratio)
    rate, x_dot, reference = np.zeros(len(state)), None, 0.0
    if controller.velocity is not None:
        x_dot = (x - state[p:]) / controller.velocity.time_constant
        if may_lose:
            x_dot = np.where(lost, J_hat @ v, x_dot)
        rate = np.concatenate([symbols(rate[:p]), x_dot])
    relative = x_dot
    if v_d is not None:
        v_d = np.where(lost, 0.0, controller._combination @ v_d)
        relative = (J_hat @ v if x_dot is None else x_dot) - v_d
        reference = damped_gram_solve(G, v_d, scale, ratio)[0] @ J_hat
        v = v - reference
    if relative is None:
        torque = law.estimated_velocity_torque(J_hat, kp, kv, s, v, damping, bias)
    else:
        torque = law.measured_velocity_torque(J_hat, kp, kv, s, relative, v, damping, bias)
    status = np.where(damped > 0.0, _place(Status.NEAR_SINGULAR), _place(Status.OK))
    if learning is not None:
        rests = any_of(np.abs(torque) > learning.torque_limits)
        far = _is_far(controller, arm, e)
        y = law.passive_output(v, pinv_s, learning.alpha)
        theta_rate = law.theta_hat_rate(symbols(learning.L), Y, y)
        theta_rate, no = _bounded(learning, theta_rate, state[:p], Y, g)
        still = lost | rests | far
        theta_rate = np.where(still, 0.0, theta_rate)
        left = left | (no & ~symbols(still)[()])
        rate = np.concatenate([theta_rate, rate[p:]])
        status = np.where(far, _place(Status.OUT_OF_REACH), status)
        status = np.where(rests, _place(Status.TORQUE_SATURATED), status)
    status = np.where(lost, _place(Status.MEASUREMENT_LOST), status)
    return Answer(torque, rate, status, e, J_hat, pinv_s, g, left, reference)


def _place(status: Status) -> float:
    return float(STATUSES.index(status))


def _saturated(saturation: Saturation, e: Symbols) -> Symbols:
    if isinstance(saturation, Linear):
        return e
    assert isinstance(saturation, Sine | Tanh)
    gamma = np.broadcast_to(saturation.gamma, e.shape)
    return (sine if isinstance(saturation, Sine) else tanh)(e / gamma, gamma)


def _pull(controller: SetpointController, q: Symbols) -> Symbols:
    """Return τ₀ of the posture; continuous joints have no stops, and a `Posture` has none."""
    task, own = controller.task, controller.posture
    if isinstance(own, Posture):
        return symbols(np.asarray(own.stiffness) * (np.asarray(own.q) - q))
    assert own is not None
    push = own.push(task, controller.diagonals, slow_rate(task, controller.diagonals))
    joints = [joint for joint in list(task.robot.model.joints)[1:] if joint.nv]
    return symbols(push(symbols([q[each.idx_q] if each.nq == 1 else 0.0 for each in joints])))


def _within_null_space(
    torque: Symbols, J_hat: Symbols, G: Symbols, scale: float, ratio: float
) -> Symbols:
    """Return what `posture.within_null_space` does."""
    b = symbols(J_hat @ torque)
    w, damping, _, least = damped_gram_solve(G, b, scale, ratio)
    if not isinstance(damping, Scalar):
        return symbols(torque - w @ J_hat)
    # what is added, so that G⁻¹ exists, goes with the weight: near a singular pose, too
    is_regular, threshold = least > 0.0, least + damping
    lifted = G + np.multiply(_LIFT * G.trace(), np.eye(len(G)))
    projected = np.where(symbols(is_regular), Factors(lifted).solve(b), 0.0)
    weight = symbols(select(is_regular, least / threshold, 0.0))
    faded = weight * (torque - projected @ J_hat)
    plain = torque - w @ J_hat
    return symbols(damping.graph.rare(damping > 0.0, faded.tolist(), plain.tolist()))


def _gravity(controller: SetpointController, arm: Configured) -> Symbols:
    gravity = controller.gravity
    if isinstance(gravity, RegressorGravity):
        return law.gravity(_Z(gravity.regressor, arm), gravity.theta)
    if isinstance(gravity, ModelGravity):
        return _of(gravity.robot, arm).gravity()
    return symbols(np.zeros(arm.nv))


def _Z(regressor: GravityRegressor, arm: Configured) -> Symbols:
    return _of(regressor.robot, arm).Z(regressor)


def _of(robot: Robot, arm: Configured) -> Configured:
    """Return an arm that gravity may be of, which need not be that of the task."""
    if robot == arm.arm.robot:
        return arm
    return Arm(lambda name, values: symbols(values[0].tolist()), "gravity", robot, ()).at(arm.q)


def _regressor(learning: Adaptation, arm: Configured, J_hat: Symbols) -> Symbols:
    """Return what `Adaptation.Y` does."""
    _, forces, torques = learning.sizes
    parts = [_Z(learning.regressor, arm), *([J_hat.T] if forces else [])]
    return np.concatenate([*parts, symbols(np.eye(torques))] if torques else parts, axis=1)


def _is_far(controller: SetpointController, arm: Configured, e: Symbols) -> Condition:
    """Return what `Reach.is_exceeded` does."""
    origin, most = controller.reach.origin, controller.reach.most
    if most == np.inf:
        return False
    k = len(origin)
    offset = tasks.value(controller.task, arm)[:k] - e[:k] - origin
    farthest = (1.0 + UNKNOWN_TOOL) * most
    is_far = (e[:k] * e[:k]).sum() > (UNKNOWN_TOOL * most) ** 2
    return is_far & ((offset * offset).sum() > farthest**2)


def _bounded(
    learning: Adaptation, rate: Symbols, theta_hat: Symbols, Y: Symbols, g: Symbols
) -> tuple[Symbols, Condition]:
    """Return what `Adaptation.bounded` does, and whether that is left to Python.

    The multipliers of `law.within_bounds` come from a few sweeps of C. Hildreth's method ("A
    quadratic programming procedure", Naval Research Logistics 4(1), 1957), which mostly ends there.
    """
    if learning.bounds is None:
        return rate, False
    lower, upper = learning.bounds
    high, low = theta_hat >= upper, theta_hat <= lower
    side = np.where(high, 1.0, np.where(low, -1.0, 0.0))
    beyond = np.where(np.abs(g) > learning.motors, np.where(g > 0.0, 1.0, -1.0), 0.0)
    # what may lead out; where nothing does, no multiplier is needed
    outward = [*(high & (rate > 0.0)), *(low & (rate < 0.0)), *(np.abs(g) > learning.motors)]
    L = learning.L

    def lead(i: Any) -> Symbols:
        """Return the row of N L of a bound of one parameter."""
        return law.take(side, i) * law.take(L, i)

    def of_motor(i: Any, values: tuple[Any]) -> tuple[tuple[Any], tuple[Any, ...]]:
        """Return rows of N, N L and so on of what a motor has to hold."""
        row = law.take(beyond, i) * law.take(Y, i)
        turned = row * L if L.ndim == 1 else product(row, L)
        return values, (row, turned, _inverse(row @ turned), row @ rate)

    _, (N, NL, inverse, before) = law.collect(len(g), of_motor, (g,))
    own_inverse = _inverse(side * (side * (L if L.ndim == 1 else L.diagonal())))

    def own(values: tuple[Symbols, Symbols]) -> tuple[Symbols, Symbols]:
        """Return the rate and multipliers after a turn of each parameter's own bound."""
        found, multipliers = values
        if L.ndim == 1:
            after = np.maximum(multipliers + (side * found) * own_inverse, 0.0)
            return found - (after - multipliers) * (side * L), after

        def one(i: Any, values: tuple[Symbols]) -> tuple[tuple[Symbols], tuple[Symbols]]:
            was = law.take(multipliers, i)
            along = law.take(side, i) * law.take(values[0], i)
            after = np.maximum(was + along * law.take(own_inverse, i), 0.0)
            return (values[0] - (after - was) * lead(i),), (after,)

        (found,), (after,) = law.collect(len(rate), one, (found,))
        return found, after

    def sweep(_: Any, values: tuple[Symbols, ...]) -> tuple[Symbols, ...]:
        found, of_own, of_motors = values
        found, of_own = own((found, of_own))

        def one(i: Any, values: tuple[Symbols]) -> tuple[tuple[Symbols], tuple[Symbols]]:
            was = law.take(of_motors, i)
            after = was + (law.take(N, i) @ values[0]) * law.take(inverse, i)
            after = np.maximum(after, 0.0)
            return (values[0] - (after - was) * law.take(NL, i),), (after,)

        (found,), (of_motors,) = law.collect(len(g), one, (found,))
        return found, of_own, of_motors

    start = symbols(rate), symbols(np.zeros(len(rate))), symbols(np.zeros(len(g)))
    found, *multipliers = law.repeat(_SWEEPS, sweep, start)
    _, (beside,) = law.collect(len(g), lambda i, v: (v, (law.take(N, i) @ found,)), (g,))
    least = _ROUND_OFF * np.abs(np.concatenate([side * rate, before])).max()
    beside, multiplier = np.concatenate([side * found, beside]), np.concatenate(multipliers)
    wrong = any_of((beside > least) | ((multiplier > 0.0) & (beside < -least)))
    *kept, is_wrong = rate[0].graph.rare(
        any_of(outward), [*found.tolist(), select(wrong, 1.0, 0.0)], [*rate.tolist(), 0.0]
    )
    return symbols(kept), is_wrong > 0.0


def _inverse(sizes: Symbols) -> Symbols:
    """Return 1 / a of each a > 0, 0 of others."""
    return np.where(sizes > 0.0, 1.0 / np.where(sizes > 0.0, sizes, 1.0), 0.0)
