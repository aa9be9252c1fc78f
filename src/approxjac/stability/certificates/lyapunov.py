"""V and W of a closed loop at one state, eqs. (12), (13) and (31)."""

from typing import NamedTuple

import numpy as np

from approxjac import law
from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.simulation import Plant
from approxjac.stability.errors.region import require_law, require_seen
from approxjac.tasks.analysis import require_jacobian_of_q
from approxjac.validation import Array, as_array, as_number, require, shape_of


class LyapunovValue(NamedTuple):
    """V [J] and W = −dV/dt [W]."""

    V: float
    W: float


def lyapunov(
    plant: Plant,
    controller: SetpointController,
    q: Array,
    v: Array,
    target: Array,
    alpha: float | None = None,
    *,
    state: Array | None = None,
    theta: Array | None = None,
) -> LyapunovValue:
    """Evaluate the Lyapunov function of law (6), or (28), and its decrease.

    Along the closed loop dV/dt = −W holds exactly, provided that the controller's gravity is
    exact, or learnt with the same α and in the span of its regressor (with Ĵ⁺ not damped, no bounds
    at work, and torques within the limits of `AdaptiveGravity`). A `Posture` adds its power
    q̇ᵀN τ₀ to dV/dt, which W leaves out.

    Args:
        plant: The true robot, sensor and friction.
        controller: The controller with its believed robot; Ĵ must be of full rank at q.
        q: Configuration, shape (nq,).
        v: Velocity, shape (n_v,).
        target: x_d, shape (n_x,).
        alpha: α of (10) [1/s]; the controller's by default.
        state: Controller state, needed where gravity is learnt, shape (n_state,).
        theta: True θ, needed where gravity is learnt: that of the controller's regressor, shape
            (p,), as from `GravityRegressor.fit`, or followed by the constant task force and joint
            torques, which are 0 if not given.

    Raises:
        InvalidInputError: A law without this V, or a plant that is not ideal; learnt gravity
            without `state` and `theta`, or with another α; another task than the sensor's, or one
            whose Jacobian uses the measured x; a q that the sensor does not see; a singular Ĵ.
    """
    require("plant", plant, Plant, "a Plant")
    require_law(controller, posture=True)
    plant.require_task(controller.task)
    plant.require_ideal("the Lyapunov function")
    alpha = controller.alpha if alpha is None else alpha
    alpha = as_number("alpha", alpha, unit="1/s", above=0.0)
    q, v = plant.robot.configuration(q), as_array("v", v, (plant.robot.nv,))
    task, sensor, dynamics = controller.task, plant.sensor, plant.dynamics
    target = sensor.target(target)
    require_jacobian_of_q(task, "the Lyapunov function")
    require_seen("q", q, sensor)
    kp, kv, damping = controller.diagonals
    e = sensor.error(sensor.value(q), target)
    s = controller.saturation.s(e)
    J_e, J_hat = sensor.error_jacobian(e, sensor.sensor_jacobian(q)), task.jacobian(q)
    sizes = np.linalg.svd(J_hat, compute_uv=False)
    if sizes[-1] <= 1e-7 * sizes[0]:
        raise InvalidInputError(
            "q must not be a singular configuration of the believed robot, where Ĵ⁺ does not "
            f"exist, got {q.tolist()}",
            given=q,
        )
    J_hat_dot = task.jacobian_dot(q, v)
    J_hat_pinv, (J_hat_pinv_dot,) = law.cross_weight_pinv(
        J_hat, J_hat_dot[None], controller.pinv.weight
    )
    M = dynamics.M(q)
    V = law.V(v, s, controller.saturation.S(e), J_hat_pinv, M, kp, kv, alpha)
    learning = controller.adaptation
    if learning is not None:
        if state is None or theta is None or alpha != learning.alpha:
            raise InvalidInputError(
                "where gravity is learnt, state and theta must be given and alpha must be the "
                f"controller's {learning.alpha:g}, got alpha = {alpha:g}, "
                f"state = {state!r}, theta = {theta!r}",
                given=(alpha, state, theta),
            )
        state = as_array("state", state, learning.theta0.shape)
        p = learning.regressor.p
        if shape_of(theta) == (p,):
            theta = learning.whole(as_array("theta", theta, (p,)))
        theta = as_array("theta", theta, learning.theta0.shape)
        V += law.parameter_potential(theta - controller.learnt(state), learning.L)
    s_dot = controller.saturation.ds(e) * (J_e @ v)
    M_dot, C, B = dynamics.M_dot(q, v), dynamics.coriolis(q, v), plant.friction + damping
    pinv, inertia = (J_hat_pinv, J_hat_pinv_dot), (M, M_dot, C)
    return LyapunovValue(V, law.W(v, (s, s_dot), J_e, J_hat, pinv, inertia, B, kp, kv, alpha))
