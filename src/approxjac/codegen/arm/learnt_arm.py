"""An arm whose lengths and masses are learnt, on symbols: what its regressors stand for."""

from __future__ import annotations

import numpy as np

from approxjac.codegen.arm.bodies import Body, Wrench, cross, force
from approxjac.codegen.arm.rigid_body import Configured
from approxjac.codegen.trace.symbols import Symbols, symbols
from approxjac.robots.kinematic_regressor import KinematicRegressor, PointMotion
from approxjac.validation import Array

_NOTHING = symbols([0.0, 0.0, 0.0])
_OF_A_LINK = 10  # m, the first moments, and xx, xy, yy, xz, yz, zz of the inertia


class LearntPoints:
    """Points of an arm whose translations are learnt: what `KinematicRegressor` has of them.

    Args:
        arm: The believed arm at q.
        regressor: Of the points.
    """

    def __init__(self, arm: Configured, regressor: KinematicRegressor) -> None:
        self._arm, self._regressor = arm, regressor
        names = list(arm.arm.robot.mimic_joints.model.names)[1:]
        self._of_joint = {name: i for i, name in enumerate(regressor.movers)}
        self._movers, self._n_all = [names.index(name) for name in regressor.movers], len(names)
        places = [arm.arm.require_frame(name) for name in regressor.frames]
        self._carriers = [arm.arm.structure.carriers[place] for place in places]

    def Y(self) -> Symbols:
        """Return Y(q), shape (3k, p)."""
        arm, regressor, rows = self._arm, self._regressor, []
        n = len(self._movers)
        for frame, _ in regressor.points:
            carrier = self._carriers[frame]
            path = arm.path(carrier)
            blocks = [symbols(np.zeros((3, 3))) for _ in range(regressor.p // 3)]
            for i, joint in enumerate(self._movers):
                if joint in path:
                    blocks[i] = arm.axes(arm.structure.parents[joint])
            blocks[n + frame] = arm.axes(carrier)
            rows.append(np.concatenate(blocks, axis=1))
        return np.concatenate(rows)

    def tilts(self, theta: Symbols, across: Array) -> Symbols:
        """Return ∂p/∂(tilts of axes), shape (3k, 2 t)."""
        arm, regressor = self._arm, self._regressor
        origins, points = self._placed(theta)
        J = symbols(np.zeros((3 * regressor.k, 2 * len(across))))
        for t, name in enumerate(regressor.turning):
            joint = self._movers[self._of_joint[name]]
            ways = arm.axes(arm.structure.parents[joint]) @ across[t]
            for k, (frame, _) in enumerate(regressor.points):
                if joint in arm.path(self._carriers[frame]):
                    for i in range(2):
                        J[3 * k : 3 * k + 3, 2 * t + i] = cross(
                            ways[:, i], points[k] - origins[joint]
                        )
        return J

    def _placed(self, theta: Symbols) -> tuple[dict[int, Symbols], list[Symbols]]:
        """Return the origins of joints and the points in the world, each (3,) [m]."""
        arm, own = self._arm, symbols(theta).reshape(-1, 3)
        slid: dict[int, Symbols] = {-1: _NOTHING}  # where what a joint carries begins
        origins: dict[int, Symbols] = {}
        for i, j in enumerate(self._movers):
            parent = arm.structure.parents[j]
            origins[j] = slid[parent] + arm.axes(parent) @ own[i]
            slid[j] = origins[j]
            if arm.structure.slides[j]:
                slid[j] = origins[j] + arm.axis(j) * arm.q_all[arm.structure.places[j]]
        points = []
        for frame, point in self._regressor.points:
            carrier = self._carriers[frame]
            p = slid[carrier] + arm.axes(carrier) @ own[len(self._movers) + frame]
            if point.any():
                p = p + arm.frame(self._regressor.frames[frame])[0] @ point
            points.append(p)
        return origins, points

    def motion(self, v: Symbols | None, theta: Symbols, theta_dot: Symbols | None) -> PointMotion:
        """Return positions and derivatives with q̇ (n_v,), θ and θ' (p,); None is at rest."""
        arm, regressor, structure = self._arm, self._regressor, self._arm.structure
        mimic = arm.arm.robot.mimic_joints
        origins, points = self._placed(theta)
        speeds = symbols(np.zeros(self._n_all)) if v is None else mimic.v(v)
        rates = symbols(np.zeros(regressor.p)) if theta_dot is None else symbols(theta_dot)
        own = rates.reshape(-1, 3)
        spins: dict[int, Symbols] = {-1: _NOTHING}
        slides: dict[int, Symbols] = {-1: _NOTHING}  # velocity of where what it carries begins
        moves: dict[int, Symbols] = {}
        axes: dict[int, tuple[Symbols, Symbols]] = {}
        ends: dict[int, Symbols] = {-1: _NOTHING}
        drifts: dict[int, Symbols] = {-1: _NOTHING}
        for i, j in enumerate(self._movers):
            parent = structure.parents[j]
            z, spin, rate = arm.axis(j), spins[parent], arm.axes(parent) @ own[i]
            z_dot = cross(spin, z)
            moves[j] = slides[parent] + cross(spin, origins[j] - ends[parent]) + rate
            drifts[j] = drifts[parent] + rate
            axes[j], spins[j], slides[j], ends[j] = (z, z_dot), spin, moves[j], origins[j]
            if structure.slides[j]:
                at = arm.q_all[structure.places[j]]
                ends[j] = origins[j] + z * at
                slides[j] = moves[j] + z_dot * at + z * speeds[j]
            else:
                spins[j] = spin + z * speeds[j]
        found = []
        for k, (frame, _) in enumerate(regressor.points):
            carrier, p = self._carriers[frame], points[k]
            rate = arm.axes(carrier) @ own[len(self._movers) + frame]
            p_dot = slides[carrier] + cross(spins[carrier], p - ends[carrier]) + rate
            J, J_dot = symbols(np.zeros((2, 3, self._n_all)))
            for j in arm.path(carrier):
                z, z_dot = axes[j]
                if structure.slides[j]:
                    J[:, j], J_dot[:, j] = z, z_dot
                    continue
                away, away_dot = p - origins[j], p_dot - moves[j]
                J[:, j], J_dot[:, j] = cross(z, away), cross(z_dot, away) + cross(z, away_dot)
            found.append((p, mimic.columns(J), mimic.columns(J_dot), drifts[carrier] + rate))
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
