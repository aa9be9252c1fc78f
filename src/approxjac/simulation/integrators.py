"""One step of the plant under a torque that is held."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import pinocchio as pin

from approxjac.simulation.plant import Plant
from approxjac.validation import Array

Integrator = Callable[[Plant, Array, Array, Array, float], tuple[Array, Array]]


def rk4(plant: Plant, q: Array, v: Array, tau: Array, dt: float) -> tuple[Array, Array]:
    """Classical Runge–Kutta, order 4: returns (q, v) after dt [s]."""
    model = plant.robot.model
    a1 = plant.acceleration(q, v, tau)
    v2 = v + 0.5 * dt * a1
    a2 = plant.acceleration(pin.integrate(model, q, 0.5 * dt * v), v2, tau)
    v3 = v + 0.5 * dt * a2
    a3 = plant.acceleration(pin.integrate(model, q, 0.5 * dt * v2), v3, tau)
    v4 = v + dt * a3
    a4 = plant.acceleration(pin.integrate(model, q, dt * v3), v4, tau)
    q_new = pin.integrate(model, q, dt / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4))
    return q_new, v + dt / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)


def semi_implicit_euler(
    plant: Plant, q: Array, v: Array, tau: Array, dt: float
) -> tuple[Array, Array]:
    """Velocity first, then position with the new velocity, order 1: returns (q, v) after dt.

    The scheme of most physics engines; one evaluation of the dynamics a step.
    """
    v_new = v + dt * plant.acceleration(q, v, tau)
    return pin.integrate(plant.robot.model, q, dt * v_new), v_new


INTEGRATORS: Mapping[str, Integrator] = {
    "rk4": rk4,
    "semi_implicit_euler": semi_implicit_euler,
}
