"""Kinematics and dynamics of arms on symbols, by the recursions of Luh, Walker and Paul.

All is computed in the frames of the joints, whose constant zeros and ones then fold away. With
mimic joints all joints move on their own, and q̇_all = G q̇ brings them back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from approxjac.codegen.functions import sine_and_cosine
from approxjac.codegen.graph import Number, Scalar
from approxjac.codegen.linear import Factors
from approxjac.codegen.symbols import Symbols, symbols
from approxjac.robots import GravityRegressor, Robot
from approxjac.validation import Array

Given = Callable[[str, Array], Symbols]
_ROUND_OFF = 1e-15  # what a URDF's angles of π/2 leave of zeros and ones


class ArmNumbers(NamedTuple):
    """What a model of a robot holds, for its n joints and some frames; or stacked, of many.

    Attributes:
        rotations: Of each joint's placement in its parent, shape (n, 3, 3).
        translations: Of it, shape (n, 3) [m].
        inertias: m, m c, and I about the joint's origin, shape (n, 10), in Pinocchio's order.
        gravity: Shape (3,) [m/s²].
        frame_rotations: Of each frame in its joint, shape (k, 3, 3).
        frame_translations: Of it, shape (k, 3) [m].
    """

    rotations: Array
    translations: Array
    inertias: Array
    gravity: Array
    frame_rotations: Array
    frame_translations: Array


def arm_numbers(robot: Robot, frames: Sequence[str] = ()) -> ArmNumbers:
    """Return what a robot's model holds."""
    model = robot.mimic_joints.model
    placements, inertias = list(model.jointPlacements)[1:], list(model.inertias)[1:]
    of_frames = [model.frames[model.getFrameId(frame)].placement for frame in frames]
    return ArmNumbers(
        _exact(np.array([placement.rotation for placement in placements])),
        np.array([placement.translation for placement in placements]),
        np.array([inertia.toDynamicParameters() for inertia in inertias]),
        np.array(robot.gravity),
        _exact(np.array([placement.rotation for placement in of_frames]).reshape(-1, 3, 3)),
        np.array([placement.translation for placement in of_frames]).reshape(-1, 3),
    )


def _exact(rotations: Array) -> Array:
    """Return rotations without the round-off about 0 and ±1."""
    near = np.round(rotations)
    return np.where(np.abs(rotations - near) < _ROUND_OFF, near, rotations)


class Arm:
    """Arms with the same joints, whose numbers may differ from run to run.

    Args:
        given: `Program.given`.
        name: What their numbers are called in the program.
        robot: One of them.
        frames: Frames that are asked for.
        numbers: Of all of them, stacked; of that robot alone by default.
    """

    def __init__(
        self,
        given: Given,
        name: str,
        robot: Robot,
        frames: Sequence[str],
        numbers: ArmNumbers | None = None,
    ) -> None:
        if numbers is None:
            numbers = ArmNumbers(*(each[np.newaxis] for each in arm_numbers(robot, frames)))
        self.numbers = ArmNumbers(
            *(given(f"{name}.{part}", each) for part, each in numbers._asdict().items())
        )
        self.robot, self.frames = robot, tuple(frames)
        model = robot.mimic_joints.model
        self.parents = [int(parent) - 1 for parent in list(model.parents)[1:]]
        joints = list(model.joints)[1:]
        self.places = [int(joint.idx_q) for joint in joints]
        self.wraps = [joint.nq == 2 for joint in joints]
        self.slides = [joint.shortname().startswith("JointModelP") for joint in joints]
        axes = np.array([robot.tree.joints[each].axis for each in list(model.names)[1:]], float)
        self.axes = _exact(axes / np.linalg.norm(axes, axis=1)[:, np.newaxis])
        self.of_frames = {
            frame: int(model.frames[model.getFrameId(frame)].parentJoint) - 1 for frame in frames
        }

    def at(self, q: Symbols) -> Configured:
        """Return these arms at a configuration, shape (nq,)."""
        return Configured(self, q)


class Configured:
    """Arms at a configuration.

    Args:
        arm: The arms.
        q: The configuration, shape (nq,).
    """

    def __init__(self, arm: Arm, q: Symbols) -> None:
        self._arm = arm
        self.nv = arm.robot.nv
        mimic_joints, numbers = arm.robot.mimic_joints, arm.numbers
        if mimic_joints.A is not None and mimic_joints.b is not None:
            q = symbols(mimic_joints.A) @ q + mimic_joints.b
        self._G = mimic_joints.G
        self._R: list[Symbols] = []  # from each joint's frame to its parent's
        self._p: list[Symbols] = []
        for i, (place, axis) in enumerate(zip(arm.places, arm.axes, strict=True)):
            rotation, translation = numbers.rotations[i], numbers.translations[i]
            if arm.slides[i]:
                self._R.append(rotation)
                self._p.append(translation + rotation @ (axis * q[place]))
                continue
            sine, cosine = (q[place + 1], q[place]) if arm.wraps[i] else _angle(q[place])
            along = np.outer(axis, axis)
            turned = along + np.multiply(cosine, np.eye(3) - along) + np.multiply(sine, skew(axis))
            self._R.append(rotation @ symbols(turned))
            self._p.append(translation)

    # -- in the world ---------------------------------------------------------------------

    @cached_property
    def _placements(self) -> list[tuple[Symbols, Symbols]]:
        placed: list[tuple[Symbols, Symbols]] = []
        for parent, R, p in zip(self._arm.parents, self._R, self._p, strict=True):
            if parent < 0:
                placed.append((R, p))
            else:
                R_0, p_0 = placed[parent]
                placed.append((R_0 @ R, p_0 + R_0 @ p))
        return placed

    def frame(self, name: str) -> tuple[Symbols, Symbols]:
        """Return the rotation (3, 3) and the position (3,) [m] of a frame in the world."""
        arm, k = self._arm, self._arm.frames.index(name)
        R, p = arm.numbers.frame_rotations[k], arm.numbers.frame_translations[k]
        joint = arm.of_frames[name]
        if joint < 0:
            return R, p
        R_0, p_0 = self._placements[joint]
        return R_0 @ R, p_0 + R_0 @ p

    def jacobian(self, name: str) -> Symbols:
        """Return the Jacobian (6, n_v) of (velocity, angular velocity), in the world's axes."""
        arm, (_, p) = self._arm, self.frame(name)
        J, joint = symbols(np.zeros((6, len(arm.parents)))), arm.of_frames[name]
        while joint >= 0:
            R, origin = self._placements[joint]
            axis = R @ arm.axes[joint]
            if arm.slides[joint]:
                J[:3, joint] = axis
            else:
                J[:3, joint], J[3:, joint] = cross(axis, p - origin), axis
            joint = arm.parents[joint]
        return J if self._G is None else J @ symbols(self._G)

    # -- in the frames of the joints --------------------------------------------------------

    def M(self) -> Symbols:
        """Return the inertia matrix M(q), shape (n_v, n_v)."""
        arm, n = self._arm, len(self._R)
        composite = [_Inertia.of(each) for each in arm.numbers.inertias]
        M = symbols(np.zeros((n, n)))
        for i in reversed(range(n)):
            axis = arm.axes[i]
            if arm.slides[i]:
                f, moment = np.multiply(composite[i].m, axis), cross(composite[i].h, axis)
            else:
                f, moment = cross(axis, composite[i].h), composite[i].I @ axis
            j = i
            while True:
                M[i, j] = M[j, i] = arm.axes[j] @ (f if arm.slides[j] else moment)
                if arm.parents[j] < 0:
                    break
                f = self._R[j] @ f
                moment = self._R[j] @ moment + cross(self._p[j], f)
                j = arm.parents[j]
            if arm.parents[i] >= 0:
                moved = composite[i].moved(self._R[i], self._p[i])
                composite[arm.parents[i]] = composite[arm.parents[i]] + moved
        return M if self._G is None else symbols(self._G.T) @ M @ symbols(self._G)

    @cached_property
    def _gravities(self) -> list[Symbols]:
        """Gravity in the frame of each joint."""
        found: list[Symbols] = []
        for parent, R in zip(self._arm.parents, self._R, strict=True):
            found.append(R.T @ (self._arm.numbers.gravity if parent < 0 else found[parent]))
        return found

    def gravity(self) -> Symbols:
        """Return g(q), shape (n_v,)."""
        arm, n = self._arm, len(self._R)
        m = [each[0] for each in arm.numbers.inertias]
        h = [each[1:4] for each in arm.numbers.inertias]
        torque = symbols(np.zeros(n))
        for i in reversed(range(n)):
            g, parent = self._gravities[i], arm.parents[i]
            torque[i] = -(arm.axes[i] @ (np.multiply(m[i], g) if arm.slides[i] else cross(h[i], g)))
            if parent >= 0:
                h[parent] = h[parent] + self._R[i] @ h[i] + np.multiply(m[i], self._p[i])
                m[parent] = m[parent] + m[i]
        return self._rows(torque)

    def bias(self, v: Symbols) -> Symbols:
        """Return C(q, q̇)q̇ + g(q), shape (n_v,)."""
        arm, n = self._arm, len(self._R)
        v = v if self._G is None else symbols(self._G) @ v
        still = symbols(np.zeros(3))
        motion: list[tuple[Symbols, Symbols, Symbols]] = []  # ω, its rate, the origin's acceleration
        f: list[Symbols] = []
        moment: list[Symbols] = []
        for i, (parent, axis) in enumerate(zip(arm.parents, arm.axes, strict=True)):
            w, rate, a = motion[parent] if parent >= 0 else (still, still, -arm.numbers.gravity)
            R, p, along = self._R[i], self._p[i], np.multiply(v[i], axis)
            a = R.T @ (a + cross(rate, p) + cross(w, cross(w, p)))
            w, rate = R.T @ w, R.T @ rate
            if arm.slides[i]:
                a = a + 2.0 * cross(w, along)
            else:
                rate = rate + cross(w, along)
                w = w + along
            motion.append((w, rate, a))
            body = _Inertia.of(arm.numbers.inertias[i])
            f.append(np.multiply(body.m, a) + cross(rate, body.h) + cross(w, cross(w, body.h)))
            moment.append(body.I @ rate + cross(w, body.I @ w) + cross(body.h, a))
        torque = symbols(np.zeros(n))
        for i in reversed(range(n)):
            parent = arm.parents[i]
            torque[i] = arm.axes[i] @ (f[i] if arm.slides[i] else moment[i])
            if parent >= 0:
                force = self._R[i] @ f[i]
                f[parent] = f[parent] + force
                moment[parent] = moment[parent] + self._R[i] @ moment[i] + cross(self._p[i], force)
        return self._rows(torque)

    def forward(self, v: Symbols, torque: Symbols) -> Symbols:
        """Return q̈ = M⁻¹(τ − C q̇ − g), shape (n_v,)."""
        return self.factors.solve(torque - self.bias(v))

    @cached_property
    def factors(self) -> Factors:
        """M(q), factored."""
        return Factors(self.M())

    def Z(self, regressor: GravityRegressor) -> Symbols:
        """Return the gravity regressor, shape (n_v, p)."""
        arm, n = self._arm, len(self._R)
        Z = symbols(np.zeros((n, regressor.p)))
        for column, of in enumerate(regressor.columns.tolist()):
            j, k = divmod(of, 10)
            g = self._gravities[j]
            f = -g if k == 0 else symbols(np.zeros(3))
            moment = symbols(np.zeros(3)) if k == 0 else -cross(np.eye(3)[k - 1], g)
            while True:
                Z[j, column] = arm.axes[j] @ (f if arm.slides[j] else moment)
                if arm.parents[j] < 0:
                    break
                f = self._R[j] @ f
                moment = self._R[j] @ moment + cross(self._p[j], f)
                j = arm.parents[j]
        return self._rows(Z)

    def _rows(self, torque: Symbols) -> Symbols:
        return torque if self._G is None else symbols(self._G.T) @ torque


class _Inertia(NamedTuple):
    """Mass, first moment and inertia of a body about the origin of a frame."""

    m: Number
    h: Symbols
    I: Symbols  # noqa: E741 (as everyone calls it)

    @classmethod
    def of(cls, parameters: Symbols) -> _Inertia:
        m, x, y, z, xx, xy, yy, xz, yz, zz = parameters.tolist()
        return cls(m, symbols([x, y, z]), symbols([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))

    def moved(self, R: Symbols, p: Symbols) -> _Inertia:
        """Return this about another origin, from which R and p lead to its own."""
        h = R @ self.h
        shifted = h + np.multiply(self.m, p)
        turned = R @ self.I @ R.T
        # −[h]ₓ[p]ₓ − [p]ₓ[h + mp]ₓ, the theorem of Steiner
        both = symbols(np.zeros((3, 3)))
        total = p @ h + p @ shifted
        for i in range(3):
            for j in range(i + 1):
                both[i, j] = both[j, i] = (
                    turned[i, j] + (total if i == j else 0.0) - p[i] * h[j] - shifted[i] * p[j]
                )
        return _Inertia(self.m, shifted, both)

    def __add__(self, other: _Inertia) -> _Inertia:  # type: ignore[override]
        return _Inertia(*(a + b for a, b in zip(self, other, strict=True)))


def cross(a: Symbols, b: Symbols) -> Symbols:
    """Return a × b."""
    return symbols([
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ])  # fmt: skip


def skew(a: Array) -> Array:
    """Return [a]ₓ with [a]ₓb = a × b."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def moved(robot: Robot, q: Symbols, motion: Symbols) -> Symbols:
    """Return the configuration (nq,) after a motion (n_v,) from q (nq,)."""
    if robot.nq == robot.nv:
        return q + motion
    found = q.copy()
    for name in robot.joint_names:
        joint = robot.model.joints[robot.model.getJointId(name)]
        place, by = joint.idx_q, motion[joint.idx_v]
        if joint.nq == 1:
            found[place] = q[place] + by
            continue
        sine, cosine = _angle(by)
        c = q[place] * cosine - q[place + 1] * sine
        s = q[place] * sine + q[place + 1] * cosine
        # as Pinocchio keeps them on the unit circle
        size = 0.5 * (3.0 - (c * c + s * s))
        found[place], found[place + 1] = c * size, s * size
    return found


def _angle(x: Number) -> tuple[Number, Number]:
    return sine_and_cosine(x) if isinstance(x, Scalar) else (np.sin(x), np.cos(x))
