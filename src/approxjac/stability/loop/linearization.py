"""A closed loop near its target to first order: continuous, and as it runs sampled."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from approxjac import law
from approxjac.controllers import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.extras import package_of
from approxjac.simulation import Plant
from approxjac.validation import Array


class LinearLoop(NamedTuple):
    """Parts of the linearised laws (6) and (28), (29), as of `law.adaptive_closed_loop_matrix`.

    Those of many targets have an axis N in front, but for what targets have in common.
    """

    M: Array
    G: Array  # ∂g/∂q at the target, of the robot and of its exact compensation, (n_v, n_v)
    J: Array
    J_hat: Array
    J_hat_pinv: Array
    kp: Array
    kv: Array
    friction: Array  # diagonal of the natural B, (n_v,)
    damping: Array  # diagonal of the added B_c, (n_v,)
    Z: Array  # of all that is learnt, Y of `Adaptation`, (n_v, p); p = 0 where gravity is known
    L: Array
    alpha: float

    def take(self, which: Any) -> LinearLoop:
        """Return the parts of some of many targets, or of one of them."""
        return self._replace(**{name: getattr(self, name)[which] for name in OF_TARGETS})

    def stacked(self) -> LinearLoop:
        """Return the parts of one target as those of many."""
        return self.take(np.newaxis)


OF_TARGETS = ("M", "G", "J", "J_hat", "J_hat_pinv", "Z")
"""Parts of a `LinearLoop` that each target has of its own."""


class Timing(NamedTuple):
    """Times at which things happen in sampled control."""

    dt: float  # sampling time [s]
    x_late: int = 0  # age of the measured x in samples
    torque_late: int = 0  # samples from a torque to its effect
    velocity_filter: float | None = None  # of q̇ from differences of q [s]; None is a tachometer

    @property
    def dead_time(self) -> float:
        """Longest time from a motion to the end of the first torque that answers it [s]."""
        return (1 + self.x_late + self.torque_late) * self.dt

    def states(self, loop: LinearLoop) -> tuple[int, ...]:
        """Lengths of the parts of the state: δq, q̇, δθ̂, filter, late x, late torques."""
        (n, p), m = loop.Z.shape[-2:], loop.J.shape[-2]
        filtered = 0 if self.velocity_filter is None else n
        return n, n, p, filtered, self.x_late * m, self.torque_late * n


def linear_loop(plant: Plant, controller: SetpointController, q: Array) -> LinearLoop:
    """Return the parts of the loop of a plant and a controller at a configuration (nq,).

    Where Ĵ uses the measured x it is taken at that of the target: its change with x is multiplied
    by e and q̇, which are zero there.
    """
    J_hat = np.array(controller.task.jacobian(q, plant.sensor.value(q)))
    M, G = plant.dynamics.M(q), plant.dynamics.g_gradient(q)
    J = np.array(plant.sensor._sensor_jacobian(q))
    terms = [each[np.newaxis] for each in (q, M, G, J, J_hat)]
    return linear_loops(controller, plant.friction, *terms).take(0)


def linear_loops(
    controller: SetpointController,
    friction: Array,
    q: Array,
    M: Array,
    G: Array,
    J: Array,
    J_hat: Array,
) -> LinearLoop:
    """Return the parts of `linear_loop` at many configurations, all with an axis N in front."""
    (N, m, n), learning = J.shape, controller.adaptation
    Z, L, alpha, J_hat_pinv = np.zeros((N, n, 0)), np.zeros(0), 0.0, np.zeros((N, n, m))
    if learning is not None:
        Z, L, alpha = np.array(list(map(learning.Y, q, J_hat))), learning.L, learning.alpha
        J_hat_pinv = np.array(list(map(controller.pinv.matrix, J_hat)))
    kp, kv, damping = controller.diagonals
    return LinearLoop(M, G, J, J_hat, J_hat_pinv, kp, kv, friction, damping, Z, L, alpha)


def continuous_matrix(loop: LinearLoop) -> Array:
    """A of ż = A z with z = (δq, q̇, δθ̂), shape (…, 2 n_v + p, 2 n_v + p)."""
    M, _, J, J_hat, J_hat_pinv, kp, kv, friction, damping, Z, L, alpha = loop
    B = friction + damping
    return law.adaptive_closed_loop_matrix(M, J, J_hat, J_hat_pinv, kp, kv, B, Z, L, alpha)


def sampled_matrix(loop: LinearLoop, timing: Timing) -> Array:
    """A of z(k+1) = A z(k): one sample of `simulate` with dt, to first order.

    z = (δq, q̇, δθ̂, w, the late x, the late torques), the oldest first. The filtered velocity is
    (a/dt) δq + w with a = dt/(T + dt). Between samples the torque is held while friction and
    gravity act all the time, so that gravity and its sampled compensation do not quite cancel.
    """
    (n, _), m, dt = loop.Z.shape, len(loop.J), timing.dt
    sizes = timing.states(loop)
    # each part of the state as rows that select it from z
    q, v, theta, w, x_late, torque_late = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1])

    x = loop.J @ q
    x_seen = np.vstack([x_late, x])[:m]
    v_seen, filtered = v, w
    if timing.velocity_filter is not None:
        a = dt / (timing.velocity_filter + dt)
        v_seen = a / dt * q + w
        filtered = (1.0 - a) * v_seen - a / dt * q
    D = (loop.J_hat.T * loop.kv) @ loop.J_hat + np.diag(loop.damping)
    torque = -(loop.J_hat.T * loop.kp) @ x_seen - D @ v_seen + loop.G @ q + loop.Z @ theta
    torque_acting = np.vstack([torque_late, torque])[:n]

    free, forced = _held(loop, dt)
    y = v_seen + loop.alpha * loop.J_hat_pinv @ x_seen
    return np.vstack(
        [
            free @ np.vstack([q, v]) + forced @ torque_acting,
            theta - dt * law.learning_gain(loop.L, loop.Z) @ y,
            filtered,
            np.vstack([x_late, x])[m:],
            np.vstack([torque_late, torque])[n:],
        ]
    )


def equilibria(loop: LinearLoop, unseen: Array, timing: Timing | None = None) -> Array:
    """Directions in which the equilibria with e = 0 continue, as columns of the state z.

    Self-motion, along which the held torque follows gravity, and changes of θ̂ that no joint feels
    at the target, of which `unseen` is a basis, shape (…, p, p − rank Z).
    """
    m, n = loop.J.shape[-2:]
    self_motion = np.linalg.svd(loop.J)[2][..., m:, :].mT
    sizes = Timing(1.0).states(loop) if timing is None else timing.states(loop)
    directions = np.zeros((*loop.J.shape[:-2], sum(sizes), n - m + unseen.shape[-1]))
    parts = np.split(directions, np.cumsum(sizes)[:-1], axis=-2)  # views
    q, _, theta, w, _, torque_late = parts
    q[..., : n - m] = self_motion
    theta[..., n - m :] = unseen
    if timing is not None:
        if timing.velocity_filter is not None:  # standing still, (a/dt) δq + w = 0
            w[..., : n - m] = -self_motion / (timing.velocity_filter + timing.dt)
        for late in range(timing.torque_late):
            torque_late[..., late * n : (late + 1) * n, : n - m] = loop.G @ self_motion
    return directions


def _held(loop: LinearLoop, dt: float) -> tuple[Array, Array]:
    """Map (δq, q̇) and a torque that is held over dt to (δq, q̇) after it, exactly."""
    expm = package_of("study", "scipy.linalg").expm
    n = len(loop.M)
    flow = np.zeros((3 * n, 3 * n))
    flow[:n, n : 2 * n] = np.eye(n)
    forces = np.hstack([-loop.G, -np.diag(loop.friction), np.eye(n)])
    flow[n : 2 * n] = np.linalg.solve(loop.M, forces)
    with np.errstate(over="ignore", invalid="ignore"):
        after = expm(dt * flow)
    if not np.isfinite(after).all():  # the arm falls from the target without end in one sample
        raise InvalidInputError(
            f"dt must be a sampling time of control, such as 0.001 [s], got {dt:g}: the motion "
            "within one sample overflows",
            given=dt,
        )
    return after[: 2 * n, : 2 * n], after[: 2 * n, 2 * n :]
