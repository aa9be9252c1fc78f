"""An arm whose lengths and masses are learnt, on symbols: what its regressors stand for."""

from __future__ import annotations

import numpy as np

from approxjac.codegen.arm.bodies import Body, Wrench, cross, force
from approxjac.codegen.arm.rigid_body import Configured
from approxjac.codegen.trace.symbols import Symbols, symbols
from approxjac.robots.kinematic_regressor import KinematicRegressor, PointMotion

_NOTHING = symbols([0.0, 0.0, 0.0])
_OF_A_LINK = 10  # m, the first moments, and xx, xy, yy, xz, yz, zz of the inertia


def point_motion(
    arm: Configured,
    regressor: KinematicRegressor,
    v: Symbols,
    theta: Symbols,
    theta_dot: Symbols,
) -> PointMotion:
    """Return what `KinematicRegressor.motion` does, of the origins of its frames.

    Args:
        arm: The believed arm at q, with the frames of the regressor.
        regressor: Of the frames.
        v: q̇, shape (n_v,).
        theta: Translations θ, shape (p,).
        theta_dot: Their rates, shape (p,).
    """
    mimic = arm.arm.robot.mimic_joints
    speeds, structure = mimic.v(v), arm.structure
    movers = list(mimic.model.names)[1:]
    own = symbols(theta).reshape(-1, 3), symbols(theta_dot).reshape(-1, 3)
    of_joint = {name: i for i, name in enumerate(regressor.movers)}

    def shift(link: int, i: int) -> tuple[Symbols, Symbols]:
        """Return a translation and its rate in the world, without the turning of the link."""
        R = arm.axes(link)
        return R @ own[0][i], R @ own[1][i]

    # of each joint's origin: place, velocity, and the part of it that the rates of θ are
    still = _NOTHING, _NOTHING, _NOTHING
    origins: dict[int, tuple[Symbols, Symbols, Symbols]] = {-1: still}
    spins: dict[int, Symbols] = {-1: _NOTHING}
    axes: dict[int, tuple[Symbols, Symbols]] = {}
    for j, parent in enumerate(structure.parents):
        if movers[j] not in of_joint:
            continue
        z, spin = arm.axis(j), spins[parent]
        z_dot = cross(spin, z)
        lever, rate = shift(parent, of_joint[movers[j]])
        p, p_dot, drift = origins[parent]
        p, p_dot, drift = p + lever, p_dot + cross(spin, lever) + rate, drift + rate
        axes[j], spins[j] = (z, z_dot), spin
        if structure.slides[j]:
            at = arm.q_all[structure.places[j]]
            p, p_dot = p + z * at, p_dot + z_dot * at + z * speeds[j]
        else:
            spins[j] = spin + z * speeds[j]
        origins[j] = p, p_dot, drift
    found = []
    for i, name in enumerate(regressor.frames):
        carrier = structure.carriers[arm.arm.frames.index(name)]
        lever, rate = shift(carrier, len(of_joint) + i)
        p, p_dot, drift = origins[carrier]
        p, p_dot = p + lever, p_dot + cross(spins[carrier], lever) + rate
        J, J_dot = symbols(np.zeros((2, 3, len(movers))))
        for j in arm.path(carrier):
            z, z_dot = axes[j]
            if structure.slides[j]:
                J[:, j], J_dot[:, j] = z, z_dot
                continue
            away, away_dot = p - origins[j][0], p_dot - origins[j][1]
            J[:, j], J_dot[:, j] = cross(z, away), cross(z_dot, away) + cross(z, away_dot)
        found.append((p, mimic.columns(J), mimic.columns(J_dot), drift + rate))
    return PointMotion(*(np.concatenate(each) for each in zip(*found, strict=True)))


class LearntBodies:
    """M(q)q̈_r + C(q, q̇)q̇_r + g(q) = Y a of links whose ten parameters are learnt.

    It is what `DynamicsRegressor` has, without the regressor: Yᵀσ is the power of what each
    parameter needs, and Y a is Newton's and Euler's equations from link to link.

    Args:
        arm: The believed arm at q.
        v: q̇, shape (n_v,).
        v_r: q̇_r, shape (n_v,).
        a_r: q̈_r, shape (n_v,).
    """

    def __init__(self, arm: Configured, v: Symbols, v_r: Symbols, a_r: Symbols) -> None:
        self._arm, self._still = arm, symbols(np.zeros(arm.nv))
        middle = arm.motions(0.5 * (v + v_r), a_r, -arm.weight)
        apart = arm.motions(0.5 * (v - v_r), self._still, _NOTHING)
        # a wrench is linear in a and U
        self._moved = [
            (a.a - b.a, a.gradient - b.gradient) for a, b in zip(middle, apart, strict=True)
        ]

    def powers(self, sigma: Symbols) -> Symbols:
        """Return Yᵀσ of σ (n_v,), shape (p,)."""
        turned = self._arm.motions(self._still, sigma, _NOTHING)
        found = []
        for j, (each, moved) in enumerate(zip(turned, self._moved, strict=True)):
            for unit in np.eye(_OF_A_LINK):
                f, moment = force(self._body(j, symbols(unit.tolist())), *moved)
                found.append(f @ each.a + moment @ each.omega_dot)
        return symbols(found)

    def torque(self, a: Symbols) -> Symbols:
        """Return Y a of parameters (p,), shape (n_v,) [N m or N]."""
        return self._arm.torque(self._wrenches(a, self._moved))

    def gravity(self, a: Symbols) -> Symbols:
        """Return g(q) of parameters (p,), shape (n_v,) [N m or N]."""
        at_rest = self._arm.motions(self._still, self._still, -self._arm.weight)
        return self._arm.torque(self._wrenches(a, [(each.a, each.gradient) for each in at_rest]))

    def _wrenches(self, a: Symbols, moved: list[tuple[Symbols, Symbols]]) -> list[Wrench]:
        each = a.reshape(-1, _OF_A_LINK)
        return [force(self._body(j, each[j]), *motion) for j, motion in enumerate(moved)]

    def _body(self, j: int, a: Symbols) -> Body:
        """Return a link's parameters in axes whose z is that of its joint."""
        turn = self._arm.structure.turns[j]
        inertia = a[[[4, 5, 7], [5, 6, 8], [7, 8, 9]]]
        S = np.multiply(0.5 * inertia.trace(), symbols(np.eye(3))) - inertia
        return Body(a[0], turn.T @ a[1:4], turn.T @ S @ turn)
