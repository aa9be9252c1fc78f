"""`Arm`: kinematics and dynamics of arms on symbols, by the recursions of Luh, Walker and Paul.

All is computed in axes of each link whose z is that of its joint. So every joint turns two of three
components, and the constant zeros and ones of placements, and of what the links weigh (`Reduced`),
fold away. With mimic joints all joints move on their own, and q̇_all = G q̇ brings them back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import NamedTuple

import numpy as np

from approxjac.codegen.arm.arm_numbers import ArmNumbers, Reduced, Structure, arm_numbers, reduced
from approxjac.codegen.trace.symbols import Graph, Number, Scalar, Symbols, symbols
from approxjac.law.factors import Factors
from approxjac.robots import GravityRegressor, Robot
from approxjac.validation import Array

Given = Callable[[str, Array], Symbols]
_Z = symbols([0.0, 0.0, 1.0])
_LONG = 12  # joints, beyond which all forces are turned to the world at once
_NOTHING = symbols([0.0, 0.0, 0.0])
_OF_A_LINK = 10  # m, the first moments, and xx, xy, yy, xz, yz, zz of the inertia


class Motion(NamedTuple):
    """Motion of a link, in its own axes."""

    omega: Symbols  # its angular velocity, shape (3,) [rad/s]
    omega_dot: Symbols  # its angular acceleration, shape (3,) [rad/s²]
    a: Symbols  # acceleration of the joint's origin, shape (3,) [m/s²]
    gradient: Symbols  # U (3, 3): what is at r has acceleration a + U r; None of a base


class Body(NamedTuple):
    """Mass [kg], first moments (3,) [kg m] and second moments (3, 3) [kg m²] about an origin."""

    m: Number
    h: Symbols
    S: Symbols


Wrench = tuple[Symbols, Symbols]
"""A force and its moment about the joint's origin, in the link's axes."""


def force(body: Body, a: Symbols, U: Symbols) -> Wrench:
    """Return the force and moment that accelerate a link alone as a + U r."""
    m, h, S = body
    # ∫ r × U r dm
    turning = symbols([
        S[0, 1] * U[2, 0] - S[0, 2] * U[1, 0] + S[1, 1] * U[2, 1] - S[2, 2] * U[1, 2]
        + S[1, 2] * (U[2, 2] - U[1, 1]),
        S[1, 2] * U[0, 1] - S[0, 1] * U[2, 1] + S[2, 2] * U[0, 2] - S[0, 0] * U[2, 0]
        + S[0, 2] * (U[0, 0] - U[2, 2]),
        S[0, 2] * U[1, 2] - S[1, 2] * U[0, 2] + S[0, 0] * U[1, 0] - S[1, 1] * U[0, 1]
        + S[0, 1] * (U[1, 1] - U[0, 0]),
    ])  # fmt: skip
    return a * m + U @ h, turning + np.cross(h, a)


def gradient(omega: Symbols, omega_dot: Symbols) -> Symbols:
    """Return U of a `Motion`, from angular velocity and acceleration (3,)."""
    (x, y, z), (dx, dy, dz) = omega, omega_dot
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return symbols([
        [-(yy + zz), xy - dz, xz + dy],
        [xy + dz, -(xx + zz), yz - dx],
        [xz - dy, yz + dx, -(xx + yy)],
    ])  # fmt: skip


class Arm:
    """Arms with the same joints, whose numbers may differ from run to run: lengths, axes, masses.

    Raises:
        UnknownNameError: No such frame.
    """

    def __init__(
        self,
        given: Given,  # `Program.given`
        name: str,  # prefix of the names of their numbers in the program
        robot: Robot,  # one of them
        frames: Sequence[str],  # frames that are asked for
        # of all of them, stacked; of that robot alone by default
        numbers: ArmNumbers | None = None,
    ) -> None:
        self.name, self.robot = name, robot
        self.structure = Structure.of(robot, frames)
        self._is_known = numbers is None
        if numbers is None:
            numbers = ArmNumbers.stacked([arm_numbers(robot, frames)])
        named = self.named(numbers)
        self.numbers = Reduced(*(given(part, values) for part, values in named.items()))
        each = (
            self.structure.carriers, self.numbers.frame_rotations, self.numbers.frame_translations,
        )  # fmt: skip
        self.frames = dict(zip(frames, zip(*each, strict=True), strict=True))
        self._at: dict[tuple[Number, ...], Configured] = {}

    @classmethod
    def known(cls, robot: Robot) -> Arm:
        """Return a robot whose numbers are constants; its frames are found when asked for."""
        return cls(_known, robot.name, robot, ())

    @contextmanager
    def standing_in(self, graph: Graph) -> Iterator[None]:
        """Use this arm for terms of its robot, in place of the robot's numbers."""
        graph.arms.insert(0, self)
        try:
            yield
        finally:
            graph.arms.remove(self)

    def frame(self, name: str) -> tuple[int, Symbols, Symbols]:
        """Return the joint that moves a frame, its axes (3, 3) and its origin (3,) [m] there.

        Raises:
            UnknownNameError: No such frame.
            ValueError: One that is not among those of an arm with numbers of its own.
        """
        if name not in self.frames:
            if not self._is_known:
                raise ValueError(f"frame {name!r} is not among those of {self.name}")
            self.frames |= Arm(_known, self.name, self.robot, (name,)).frames
        return self.frames[name]

    def named(self, numbers: ArmNumbers) -> dict[str, Array]:
        """Return the numbers of such arms, stacked, as the program knows them."""
        few = reduced(numbers, self.structure)
        return {f"{self.name}.{part}": values for part, values in few._asdict().items()}

    def at(self, q: Symbols) -> Configured:
        """Return these arms at a configuration.

        Args:
            q: As Pinocchio has it, shape (nq,) [rad or m]: pairs (cos, sin) of continuous joints
                on the unit circle, and no mimic joints.
        """
        key = tuple(each.place if isinstance(each, Scalar) else each for each in q.tolist())
        if key not in self._at:
            self._at[key] = Configured(self, q)
        return self._at[key]


class Configured:
    """An arm at a configuration. What terms have in common is computed once.

    Each link has axes of its own, whose z is that of its joint. Bodies are those of `Reduced`.
    """

    def __init__(self, arm: Arm, q: Symbols) -> None:
        self.nv = arm.robot.nv
        self.arm, self.q = arm, q
        self.structure = arm.structure  # in common with arms that differ in numbers only
        self._numbers = numbers = arm.numbers
        self.weight = numbers.gravity  # acceleration in the world, shape (3,) [m/s²]
        mimic = arm.robot.mimic_joints  # and q of all joints, shape (nq_all,)
        q = q if mimic.A is None or mimic.b is None else mimic.A @ q + mimic.b
        self._n = len(self.structure.parents)
        spreads = numbers.spreads[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        each = zip(numbers.masses, numbers.moments, spreads, strict=True)
        self._bodies = [Body(*body) for body in each]
        self._turns: list[tuple[Number, Number]] = []  # cos and sin
        self._origins = list(numbers.translations)
        for j in range(self._n):
            at = self.structure.places[j]
            if self.structure.slides[j]:
                self._turns.append((1.0, 0.0))
                self._origins[j] = self._origins[j] + numbers.rotations[j][:, 2] * q[at]
            elif self.structure.pairs[j]:
                self._turns.append((q[at], q[at + 1]))
            else:
                angle = q[at : at + 1]
                self._turns.append((np.cos(angle)[0], np.sin(angle)[0]))

    # -- kinematics -------------------------------------------------------------------------

    def frame(self, name: str) -> tuple[Symbols, Symbols]:
        """Return the rotation (3, 3) of a frame's axes in the world's, and its origin (3,) [m]."""
        carrier, R, p = self.arm.frame(name)
        if carrier < 0:
            return R, p
        R_joint, p_joint = self._placements[carrier]
        return R_joint @ R, p_joint + R_joint @ p

    def jacobian(self, name: str) -> Symbols:
        """Return the Jacobian of a frame's velocity and angular velocity in the world, (6, n_v)."""
        J, p = _zeros(6, self._n), self.frame(name)[1]
        for j in self.path(self.arm.frame(name)[0]):
            z, origin = self.axis(j), self._placements[j][1]
            if self.structure.slides[j]:
                J[:3, j] = z
            else:
                J[:3, j], J[3:, j] = np.cross(z, p - origin), z
        return self.arm.robot.mimic_joints.columns(J)

    def jacobian_dot(self, name: str, v: Symbols) -> Symbols:
        """Return the rate of `jacobian` along q̇ (n_v,), shape (6, n_v)."""
        speeds, J_dot, axes = self.arm.robot.mimic_joints.v(v), _zeros(6, self._n), {}
        # of the link before: its angular velocity, and its velocity at a point
        spin, rate, origin = _NOTHING, _NOTHING, _NOTHING
        for j in reversed(self.path(self.arm.frame(name)[0])):
            z, begins = self.axis(j), self._placements[j][1]
            if self.structure.slides[j]:
                J_dot[:3, j], rate = np.cross(spin, z), rate + z * speeds[j]
                continue
            rate, origin = rate + np.cross(spin, begins - origin), begins
            axes[j] = z, np.cross(spin, z), begins, rate
            spin = spin + z * speeds[j]
        p = self.frame(name)[1]
        p_dot = rate + np.cross(spin, p - origin)
        for j, (z, z_dot, begins, begins_dot) in axes.items():
            J_dot[:3, j] = np.cross(z_dot, p - begins) + np.cross(z, p_dot - begins_dot)
            J_dot[3:, j] = z_dot
        return self.arm.robot.mimic_joints.columns(J_dot)

    def axis(self, joint: int) -> Symbols:
        """Return the axis of a joint in the world, shape (3,)."""
        return self._placements[joint][0][:, 2]

    @cached_property
    def _placements(self) -> list[tuple[Symbols, Symbols]]:
        """Rotation and origin of each joint's axes in the world."""
        placed: list[tuple[Symbols, Symbols]] = []
        for j, parent in enumerate(self.structure.parents):
            R, p = self._numbers.rotations[j], self._origins[j]
            if parent >= 0:
                R_parent, p_parent = placed[parent]
                R, p = R_parent @ R, p_parent + R_parent @ p
            c, s = self._turns[j]
            turned = [R[:, 0] * c + R[:, 1] * s, R[:, 1] * c - R[:, 0] * s, R[:, 2]]
            placed.append((np.stack(turned, axis=1), p))
        return placed

    # -- dynamics ---------------------------------------------------------------------------

    def M(self) -> Symbols:
        """Return the inertia matrix, shape (n_v, n_v) [kg m², kg m or kg]."""
        mimic = self.arm.robot.mimic_joints
        return mimic.rows(mimic.columns(self._M_all))

    def gravity(self) -> Symbols:
        """Return the gravity torque, shape (n_v,) [N m or N]."""
        tau = _zeros(self._n)
        for j, body in enumerate(self._outwards):
            g = self.weight @ self._placements[j][0]
            tau[j] = (
                -body.m * g[2] if self.structure.slides[j] else g[0] * body.h[1] - g[1] * body.h[0]
            )
        return self.arm.robot.mimic_joints.rows(tau)

    def inverse(self, v: Symbols, a: Symbols) -> Symbols:
        """Return M(q) q̈ + C(q, q̇) q̇ + g(q) of q̇ and q̈ (n_v,), shape (n_v,) [N m or N]."""
        moved = zip(self._bodies, self.motions(v, a, -self.weight), strict=True)
        return self.torque([force(body, each.a, each.gradient) for body, each in moved])

    def motions(self, v: Symbols, a: Symbols, base: Symbols) -> list[Motion]:
        """Return the motion of each link for q̇ and q̈ (n_v,) and the base's acceleration."""
        v, a = self.arm.robot.mimic_joints.v(v), self.arm.robot.mimic_joints.v(a)
        still = Motion(_NOTHING, _NOTHING, base, None)
        motions: list[Motion] = []
        for j, parent in enumerate(self.structure.parents):
            motion = motions[parent] if parent >= 0 else still
            at, U = motion.a, motion.gradient
            at = at if U is None else at + U @ self._origins[j]
            omega, omega_dot, at = (self._in(j, each) for each in (*motion[:2], at))
            across = symbols([omega[1] * v[j], -(omega[0] * v[j]), 0.0])  # ω × z q̇
            if self.structure.slides[j]:
                at = at + 2.0 * across + _Z * a[j]
            else:
                omega, omega_dot = omega + _Z * v[j], omega_dot + across + _Z * a[j]
            motions.append(Motion(omega, omega_dot, at, gradient(omega, omega_dot)))
        return motions

    def torque(self, forces: list[Wrench]) -> Symbols:
        """Return the joint torques that balance wrenches on the links, shape (n_v,) [N m or N]."""
        forces, tau = forces.copy(), _zeros(self._n)
        for j in reversed(range(self._n)):
            f, moment = forces[j]
            tau[j] = f[2] if self.structure.slides[j] else moment[2]
            parent = self.structure.parents[j]
            if parent >= 0:
                f, moment = self._out(j, f), self._out(j, moment)
                held = forces[parent]
                moment = moment + np.cross(self._origins[j], f)
                forces[parent] = held[0] + f, held[1] + moment
        return self.arm.robot.mimic_joints.rows(tau)

    def bodies(self, v: Symbols, v_r: Symbols, a_r: Symbols) -> LearntBodies:
        """Return the links of a reference motion whose parameters are learnt."""
        return LearntBodies(self, v, v_r, a_r)

    def forward(self, v: Symbols, tau: Symbols) -> Symbols:
        """Return q̈ from q̇ and τ (n_v,), shape (n_v,) [rad/s² or m/s²]."""
        return self.factors.solve(tau - self.inverse(v, _zeros(self.nv)))

    @cached_property
    def factors(self) -> Factors:
        """M, factored."""
        return Factors(self.M())

    def Z(self, regressor: GravityRegressor) -> Symbols:
        """Return the gravity regressor, shape (n_v, p) [m²/s² for first moments]."""
        Z = _zeros(self._n, regressor.p)
        # a joint that turns feels g at r with r · (z × g)
        feels = [np.cross(R[:, 2], self.weight) for R, _ in self._placements]
        for column, place in enumerate(regressor.columns.tolist()):
            link, what = divmod(place, 10)  # m, mx, my or mz
            R, p = self._placements[link]
            direction = None if what == 0 else R @ self.structure.turns[link][what - 1]
            for j in self.path(link):
                origin = self._placements[j][1]
                if not self.structure.slides[j]:
                    lever = p - origin if direction is None else direction
                    Z[j, column] = lever @ feels[j]
                elif direction is None:
                    Z[j, column] = -(self.weight @ self._placements[j][0][:, 2])
        return self.arm.robot.mimic_joints.rows(Z)

    @cached_property
    def _M_all(self) -> Symbols:
        M = _zeros(self._n, self._n)
        for j, (m, h, S) in enumerate(self._outwards):
            # what moves with the joint, at one unit of its acceleration
            if self.structure.slides[j]:
                M[j, j] = m
                f, moment = _Z * m, symbols([h[1], -h[0], 0.0])
            else:
                M[j, j] = S[0, 0] + S[1, 1]
                f, moment = symbols([-h[1], h[0], 0.0]), symbols([-S[0, 2], -S[1, 2], M[j, j]])
            if self._n > _LONG:
                R, p = self._placements[j]
                f = R @ f
                moment = R @ moment + np.cross(p, f)
                for k in self.path(j)[1:]:
                    z, origin = self.axis(k), self._placements[k][1]
                    turn = z @ moment - np.cross(z, origin) @ f
                    M[j, k] = M[k, j] = z @ f if self.structure.slides[k] else turn
                continue
            k = j
            while (parent := self.structure.parents[k]) >= 0:
                f, moment = self._out(k, f), self._out(k, moment)
                moment = moment + np.cross(self._origins[k], f)
                k = parent
                M[j, k] = M[k, j] = f[2] if self.structure.slides[k] else moment[2]
        return M

    @cached_property
    def _outwards(self) -> list[Body]:
        """Each joint's link and all that it carries."""
        bodies = self._bodies.copy()
        for j in reversed(range(self._n)):
            parent = self.structure.parents[j]
            if parent < 0:
                continue
            m, h, S = bodies[j]
            h, S, t = self._out(j, h), self._second_out(j, S), self._origins[j]
            half = h + t * (0.5 * m)
            S = S + (np.outer(t, half) + np.outer(half, t))
            held = bodies[parent]
            bodies[parent] = Body(held.m + m, held.h + (h + t * m), held.S + S)
        return bodies

    # -- from link to link ------------------------------------------------------------------

    def _in(self, j: int, vector: Symbols) -> Symbols:
        """Return a vector in the axes of a link, from those of the link that carries it."""
        x, y, z = vector @ self._numbers.rotations[j]
        c, s = self._turns[j]
        return symbols([c * x + s * y, c * y - s * x, z])

    def _out(self, j: int, vector: Symbols) -> Symbols:
        """Return a vector in the axes of the link that carries a link."""
        x, y, z = vector
        c, s = self._turns[j]
        return self._numbers.rotations[j] @ symbols([c * x - s * y, s * x + c * y, z])

    def _second_out(self, j: int, S: Symbols) -> Symbols:
        """Return second moments in the axes of the link that carries a link."""
        c, s = self._turns[j]
        # with c² + s² = 1
        half = s * (S[0, 0] - S[1, 1]) + c * (S[0, 1] + S[0, 1])
        xx, xy, yy = S[0, 0] - s * half, c * half - S[0, 1], S[1, 1] + s * half
        xz, yz = c * S[0, 2] - s * S[1, 2], s * S[0, 2] + c * S[1, 2]
        if not self.structure.slides[j]:
            S = symbols([[xx, xy, xz], [xy, yy, yz], [xz, yz, S[2, 2]]])
        R, turned = self._numbers.rotations[j], _zeros(3, 3)
        half_turned = R @ S
        for i in range(3):
            for k in range(i, 3):
                turned[i, k] = turned[k, i] = half_turned[i] @ R[k]
        return turned

    def path(self, joint: int) -> list[int]:
        """Return the joints that move a link."""
        path = []
        while joint >= 0:
            path.append(joint)
            joint = self.structure.parents[joint]
        return path


class LearntBodies:
    """M(q)q̈_r + C(q, q̇)q̇_r + g(q) = Y a of links whose ten parameters are learnt.

    It is what `DynamicsRegressor` has, without the regressor: Yᵀσ is the power of what each
    parameter needs, and Y a is Newton's and Euler's equations from link to link.

    It is of the believed arm at q, and of q̇, q̇_r and q̈_r, each (n_v,).
    """

    def __init__(self, arm: Configured, v: Symbols, v_r: Symbols, a_r: Symbols) -> None:
        self._arm, self._still = arm, _zeros(arm.nv)
        middle = arm.motions(0.5 * (v + v_r), a_r, -arm.weight)
        apart = arm.motions(0.5 * (v - v_r), self._still, _NOTHING)
        pairs = zip(middle, apart, strict=True)  # a wrench is linear in a and U
        self._moved = [(one.a - other.a, one.gradient - other.gradient) for one, other in pairs]

    def powers(self, sigma: Symbols) -> Symbols:
        """Return Yᵀσ of σ (n_v,), shape (p,)."""
        turned = self._arm.motions(self._still, sigma, _NOTHING)
        products_of = []
        for j, (each, moved) in enumerate(zip(turned, self._moved, strict=True)):
            for unit in np.eye(_OF_A_LINK):
                f, moment = force(self._body(j, symbols(unit.tolist())), *moved)
                products_of.append(f @ each.a + moment @ each.omega_dot)
        return symbols(products_of)

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


def arm_at(q: Symbols, robot: Robot) -> Configured:
    """Return the arm that a robot is in the graph of a configuration, at that configuration."""
    graph = next((each.graph for each in q.tolist() if isinstance(each, Scalar)), None)
    arms: list[Arm] = [] if graph is None else graph.arms
    for arm in arms:
        if arm.robot == robot:
            return arm.at(q)
    arm = Arm.known(robot)
    arms.append(arm)
    return arm.at(q)


def _known(name: str, values: Array) -> Symbols:
    return symbols(values[0].astype(object))


def _zeros(*shape: int) -> Symbols:
    return symbols(np.zeros(shape))
