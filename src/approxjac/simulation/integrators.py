"""One step of the plant under a torque that is held."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from approxjac.validation import Array

Acceleration = Callable[[Array, Array, Array], Array]
Motion = Callable[[Array, Array], Array]
Integrator = Callable[[Acceleration, Motion, Array, Array, Array, float], tuple[Array, Array]]


def rk4(
    acceleration: Acceleration, moved: Motion, q: Array, v: Array, tau: Array, dt: float
) -> tuple[Array, Array]:
    """Return (q, v) after dt [s] by the classical Runge–Kutta method, order 4.

    The acceleration q̈(q, q̇, τ) may alias scratch memory; `moved` is q (nq,) after a motion
    (n_v,).
    """
    half = 0.5 * dt
    a1 = acceleration(q, v, tau).copy()
    v2 = v + half * a1
    a2 = acceleration(moved(q, half * v), v2, tau).copy()
    v3 = v + half * a2
    a3 = acceleration(moved(q, half * v2), v3, tau).copy()
    v4 = v + dt * a3
    a4 = acceleration(moved(q, dt * v3), v4, tau)
    q_new = moved(q, dt / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4))
    return q_new, v + dt / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)


def semi_implicit_euler(
    acceleration: Acceleration, moved: Motion, q: Array, v: Array, tau: Array, dt: float
) -> tuple[Array, Array]:
    """Return (q, v) after dt: velocity first, then position with the new velocity, order 1.

    The scheme of most physics engines. Arguments as for `rk4`.
    """
    v_new = v + dt * acceleration(q, v, tau)
    return moved(q, dt * v_new), v_new


INTEGRATORS: Mapping[str, Integrator] = {"rk4": rk4, "semi_implicit_euler": semi_implicit_euler}
