"""`ArmNumbers`: the numbers of a robot's model as plain arrays, with as many zeros as possible."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.robots import Robot
from approxjac.robots.kinematic_regressor import across
from approxjac.robots.perturbation import Changes
from approxjac.robots.robot import all_frame_id
from approxjac.validation import Array

_ROUND_OFF = 1e-15


class ArmNumbers(NamedTuple):
    """Numbers of an arm with n joints and k frames; of several arms with an axis N in front.

    Inertias are of the links that each joint moves m, m c, and I about the joint's origin, as xx,
    xy, yy, xz, yz, zz [kg, kg m, kg m²].
    """

    rotations: Array  # axes of each joint's frame in those of its parent joint, shape (n, 3, 3)
    translations: Array  # its origin there, shape (n, 3) [m]
    inertias: Array  # shape (n, 10)
    gravity: Array  # in the world, shape (3,) [m/s²]
    frame_rotations: Array  # axes of frames in those of the joint that moves them, (k, 3, 3)
    frame_translations: Array  # their origins there, shape (k, 3) [m]

    def changed(self, by: Changes, frames: Sequence[int], N: int) -> ArmNumbers:
        """Return the numbers of N arms that differ from this one, by indices of its frames."""
        new = ArmNumbers(*(np.repeat(each[np.newaxis], N, axis=0) for each in self))
        for j, (R, t) in by.joints.items():
            new.rotations[:, j - 1], new.translations[:, j - 1] = R, t
        for j, body in by.links.items():
            new.inertias[:, j - 1] = body
        for i, k in enumerate(frames):
            if k in by.frames:
                new.frame_rotations[:, i], new.frame_translations[:, i] = by.frames[k]
        return new

    @classmethod
    def stacked(cls, each: Sequence[ArmNumbers]) -> ArmNumbers:
        """Return the numbers of several arms, with an axis in front."""
        return cls(*map(np.array, zip(*each, strict=True)))


def arm_numbers(robot: Robot, frames: Sequence[str]) -> ArmNumbers:
    """Return the numbers of a robot, with some of its frames.

    Raises:
        UnknownNameError: No such frame.
    """
    model = robot.mimic_joints.model
    joints = model.jointPlacements.tolist()[1:]  # list(...) takes ten times as long
    placed = [model.frames[all_frame_id(robot, frame)].placement for frame in frames]
    inertias = model.inertias.tolist()[1:]
    return ArmNumbers(
        np.array([each.rotation for each in joints]),
        np.array([each.translation for each in joints]),
        np.array([each.toDynamicParameters() for each in inertias]),
        np.array(model.gravity.linear),
        np.array([each.rotation for each in placed]).reshape(-1, 3, 3),
        np.array([each.translation for each in placed]).reshape(-1, 3),
    )


class Structure(NamedTuple):
    """Structure that arms must have in common, joint by joint."""

    parents: tuple[int, ...]  # number of the joint that carries each; -1 for the base
    slides: tuple[bool, ...]  # True if it is prismatic
    turns: tuple[Array, ...]  # rotation from axes whose z is the joint's to its frame, (3, 3)
    places: tuple[int, ...]  # index of its coordinate in q of all joints
    pairs: tuple[bool, ...]  # True if that is a pair (cos, sin)
    carriers: tuple[int, ...]  # of each frame, the joint that moves it; -1 for the base

    @classmethod
    def of(cls, robot: Robot, frames: Sequence[str]) -> Structure:
        """Return the structure of a robot with some of its frames.

        Raises:
            UnknownNameError: No such frame.
        """
        model = robot.mimic_joints.model
        joints, data = list(model.joints)[1:], model.createData()
        pin.forwardKinematics(model, data, pin.neutral(model))  # fills the motion subspaces
        axes = [np.array(each.S).reshape(6) for each in list(data.joints)[1:]]
        slides = tuple(bool(axis[:3].any()) for axis in axes)
        return cls(
            tuple(parent - 1 for parent in list(model.parents)[1:]),
            slides,
            tuple(
                np.stack(across(S[:3] if slide else S[3:]), axis=1) + 0.0
                for S, slide in zip(axes, slides, strict=True)
            ),
            tuple(joint.idx_q for joint in joints),
            tuple(joint.nq == 2 for joint in joints),
            tuple(model.frames[all_frame_id(robot, f)].parentJoint - 1 for f in frames),
        )

    def turn(self, joint: int) -> Array:
        """Return the `turns` of a joint; those of the base, -1, are none."""
        return np.eye(3) if joint < 0 else self.turns[joint]


class Reduced(NamedTuple):
    """The numbers of N arms in axes whose z is each joint's axis, with equivalent bodies.

    Mass on the axis of a revolute joint moves with the link that carries the joint, and exerts no
    torque about it. So it is moved to that link, and finally to the base. Links of prismatic joints
    keep mass and first moments, and pass on their second moments. The result has many zeros, which
    are folded away. Placements are those of `ArmNumbers`.
    """

    rotations: Array  # shape (N, n, 3, 3)
    translations: Array  # shape (N, n, 3) [m]
    masses: Array  # shape (N, n) [kg]
    moments: Array  # first moments, shape (N, n, 3) [kg m]
    spreads: Array  # second ones ∫ r rᵀ dm, as xx, xy, xz, yy, yz, zz, shape (N, n, 6) [kg m²]
    gravity: Array  # shape (N, 3) [m/s²]
    frame_rotations: Array  # shape (N, k, 3, 3)
    frame_translations: Array  # shape (N, k, 3) [m]


def reduced(numbers: ArmNumbers, structure: Structure) -> Reduced:
    """Return numbers of N arms in the axes that give the most zeros.

    Each arm's depend on itself alone, to the last bit.
    """
    turns = np.array(structure.turns)
    carrying = np.array([structure.turn(j) for j in structure.parents])
    backwards = np.swapaxes(carrying, -1, -2)
    R = _tidy(_product(_product(backwards, numbers.rotations), turns))
    t = _tidy(_applied(backwards, numbers.translations))
    back = np.swapaxes(turns, -1, -2)
    m, h = numbers.inertias[..., 0].copy(), _applied(back, numbers.inertias[..., 1:4])
    inertias = numbers.inertias[..., [[4, 5, 7], [5, 6, 8], [7, 8, 9]]]
    trace = inertias[..., 0, 0] + inertias[..., 1, 1] + inertias[..., 2, 2]
    spreads = 0.5 * trace[..., np.newaxis, np.newaxis] * np.eye(3) - inertias
    spreads = _product(_product(back, spreads), turns)

    for j in reversed(range(len(structure.parents))):
        slides, on_axis = structure.slides[j], np.array([False, False, True])
        passed_m = np.where(slides, 0.0, m[:, j])
        passed_h = np.where(on_axis & (not slides), h[:, j], 0.0)
        passed_S = np.where(np.outer(on_axis, on_axis) | slides, spreads[:, j], 0.0)
        m[:, j] -= passed_m
        h[:, j] -= passed_h
        spreads[:, j] -= passed_S
        parent = structure.parents[j]
        if parent < 0:
            continue
        across, shift = R[:, j], t[:, j]
        passed_h = _applied(across, passed_h)
        lever = _outer(shift, passed_h)
        mass = passed_m[:, np.newaxis]
        m[:, parent] += passed_m
        h[:, parent] += passed_h + mass * shift
        spreads[:, parent] += (
            _product(_product(across, passed_S), np.swapaxes(across, -1, -2))
            + (lever + np.swapaxes(lever, -1, -2))
            + mass[..., np.newaxis] * _outer(shift, shift)
        )
    spreads = spreads[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]

    ends = np.array([structure.turn(j) for j in structure.carriers]).reshape(-1, 3, 3)
    ends = np.swapaxes(ends, -1, -2)
    return Reduced(
        R,
        t,
        m,
        _without_dust(h),
        _without_dust(spreads),
        numbers.gravity,
        _tidy(_product(ends, numbers.frame_rotations)),
        _tidy(_applied(ends, numbers.frame_translations)),
    )


def _product(A: Array, B: Array) -> Array:
    """Return A B of stacked matrices, in an order of sums that no library chooses."""
    total: Array = A[..., :, 0, np.newaxis] * B[..., np.newaxis, 0, :]
    for k in (1, 2):
        total = total + A[..., :, k, np.newaxis] * B[..., np.newaxis, k, :]
    return total


def _applied(A: Array, a: Array) -> Array:
    return _product(A, a[..., np.newaxis])[..., 0]


def _outer(a: Array, b: Array) -> Array:
    return a[..., :, np.newaxis] * b[..., np.newaxis, :]


def _tidy(numbers: Array) -> Array:
    """Return entries of placements with exact 0 and ±1 in place of nearly so.

    Such as cos(π/2) = 6e-17, of which hundreds of operations of a Panda would come; what is
    computed stays within 1e-13.
    """
    nearest = np.clip(np.round(numbers), -1.0, 1.0)
    return np.where(np.abs(numbers - nearest) <= _ROUND_OFF, nearest, numbers) + 0.0


def _without_dust(numbers: Array) -> Array:
    """Return numbers of each arm with 0 for those that are round-off of its largest."""
    largest = np.abs(numbers).max(axis=tuple(range(1, numbers.ndim)), keepdims=True)
    return np.where(np.abs(numbers) <= _ROUND_OFF * largest, 0.0, numbers)
