"""`Perturbation`: robots that differ in their object and in the origins of their joints."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.robots.robot import Robot, require_inertia
from approxjac.robots.urdf import OBJECT_RADIUS, Urdf, as_size, direction, rotation_onto
from approxjac.validation import Array, Immutable

Place = tuple[Array, Array]
"""Rotations (N, 3, 3) and origins (N, 3) [m] in the axes of what carries them."""


class Changes(NamedTuple):
    """The parts of N robots that differ from the model, by indices of Pinocchio."""

    joints: dict[int, Place]
    frames: dict[int, Place]
    links: dict[int, Array]  # dynamic parameters of all that a joint moves, shape (N, 10)
    held: Array | None  # dynamic parameters of the object, shape (N, 10)


class Perturbation(Immutable):
    """A family of robots that differ in the size of their object and the origins of their joints.

    `robot` changes a copy of the Pinocchio model, in a hundredth of the time that
    `Robot.with_object` and `with_kinematic_error` take.

    Args:
        arm: The robot, without the object.
        held: Length [m] and mass [kg] of the object that `base` holds, or None for no object.
        axis: Axis of the tip that the object points along, as for `Robot.with_object`.
        joints: Joints whose origins may differ, fixed ones too.

    Attributes:
        base: The robot without perturbations.
    """

    def __init__(
        self,
        arm: Robot,
        held: tuple[float, float] | None = None,
        axis: str | Sequence[float] | None = None,
        joints: Sequence[str] = (),
    ) -> None:
        self._made_of = (arm, held, axis, tuple(joints))
        self.base = arm if held is None else arm.with_object(*held, axis=axis)
        self._outward = None if self.base.tip is None else self.base.outward_axis()
        n = None
        if held is not None:
            n = direction(arm.outward_axis() if axis is None else axis)
        self._parts = [_Parts(model, joints, n) for model in self.base.models]
        # links that resist every turn leave no inertia matrix singular, wherever they are
        self._surely_regular = all(
            np.linalg.eigvalsh(inertia.inertia)[0] > 0.0 for inertia in list(arm.model.inertias)[1:]
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> Perturbation:
        return self  # it never changes

    def robot(self, length: float, mass: float, shifts: Array, turns: Array) -> Robot:
        """Return a perturbed robot; raise a UrdfError if its inertia matrix would be singular.

        Args:
            length: Length of the object, if there is one, 0 to 10 [m].
            mass: Its mass, ≥ 0 [kg].
            shifts: Shifts of the k joint origins in the parent links' frames, shape (k, 3) [m].
            turns: Rotations in the joints' own frames, shape (k, 3, 3).
        """
        if self._made_of[1] is not None:
            as_size("length", length)
            as_size("mass", mass, "kg")
        values = (length, mass, shifts, turns)
        robot = PerturbedRobot.like(self.base, _outward=self._outward)
        robot._made_by = self, values
        robot.__dict__.pop("tree", None)  # that of `base`
        for model, parts in zip(robot.models, self._parts, strict=True):
            parts.change(model, *values)
        if not self._surely_regular:
            require_inertia(robot.model, robot.mimic_joints, self.base.tree.source)
        return robot

    def changes(self, lengths: Array, masses: Array, shifts: Array, turns: Array) -> Changes:
        """Return the parts of N robots that differ from the base's model, all joints independent.

        Args:
            lengths: Lengths of the object, shape (N,) [m].
            masses: Its masses, shape (N,) [kg].
            shifts: Shifts of the k joint origins in the parent links' frames, shape (N, k, 3) [m].
            turns: Rotations in the joints' own frames, shape (N, k, 3, 3).
        """
        return self._parts[-1].changes(lengths, masses, shifts, turns)


class PerturbedRobot(Robot):
    """A robot whose model is a changed copy; its URDF is made on first access."""

    _made_by: tuple[Perturbation, tuple[float, float, Array, Array]]

    @functools.cached_property
    def tree(self) -> Urdf:  # type: ignore[override]
        """The URDF as a tree. Read-only."""
        perturbation, (length, mass, shift, turn) = self._made_by
        robot, held, axis, joints = perturbation._made_of
        if held is not None:
            robot = robot.with_object(length, mass, axis=axis)
        shifts, turns = (
            {joint: error for joint, error in zip(joints, each, strict=True) if error.any()}
            for each in (shift, np.array([*map(pin.log3, turn)]))
        )
        return (robot.with_kinematic_error(shifts, turns) if shifts or turns else robot).tree

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (*self._made_by, self.gravity)


def _again(perturbation: Perturbation, values: tuple[Any, ...], gravity: Array) -> Robot:
    """Rebuild a perturbed robot in another process."""
    return perturbation.robot(*values).with_gravity(gravity)


class _Parts:
    """Parts of a model that depend on the object, along n (3,) or None, and on joint origins."""

    def __init__(self, model: pin.Model, joints: Sequence[str], n: Array | None) -> None:
        frames = list(model.frames)
        kinds = (pin.FrameType.JOINT, pin.FrameType.FIXED_JOINT)
        at = {frame.name: k for k, frame in enumerate(frames) if frame.type in kinds}
        errors = {at[joint]: i for i, joint in enumerate(joints)}
        self._n, self._object, self._tip = n, -1, -1
        if n is not None:
            self._onto_axis = rotation_onto(n)
            self._object, self._tip = at["object_joint"], at["object_tip_joint"]
        # what moves on its link: joints with an error, the object's tip, and all that a fixed one
        # of them carries, each with where it is on the frame that carries it
        self._places: list[tuple[int, int | None, int, Place, int | None]] = []
        carried: list[int] = []
        for k, frame in enumerate(frames):  # frames come after those that carry them
            on = frame.parentFrame
            if k not in errors and k != self._tip and on not in carried:
                continue
            moves = frame.type == pin.FrameType.JOINT
            place = model.jointPlacements[frame.parentJoint] if moves else frame.placement
            origin, joint = _place(frames[on].placement.inverse() * place), frame.parentJoint
            self._places.append((k, joint if moves else None, on, origin, errors.get(k)))
            if not moves:
                carried.append(k)
        # bodies that may move within a link, as dynamic parameters; and the rest of the link
        self._at = {k: _place(frame.placement) for k, frame in enumerate(frames)}
        self._bodies: dict[int, Array] = {}
        self._links: dict[int, tuple[Array, list[int]]] = {}
        for k, frame in enumerate(frames):
            own = frame.placement.act(frame.inertia).toDynamicParameters()
            if k == self._object or (k in carried and own.any()):
                j = frame.parentJoint
                rest, parts = self._links.get(j, (model.inertias[j].toDynamicParameters(), []))
                self._links[j] = rest - own, [*parts, k]
                self._bodies[k] = frame.inertia.toDynamicParameters()

    def change(
        self, model: pin.Model, length: float, mass: float, shifts: Array, turns: Array
    ) -> None:
        """Change a copy of the model, with the errors that `Perturbation.robot` takes."""
        errors = shifts[np.newaxis], turns[np.newaxis]
        new = self.changes(np.array([length]), np.array([mass]), *errors)
        if new.held is not None:
            model.frames[self._object].inertia = _inertia(new.held[0])
        for k, (R, t) in new.frames.items():
            model.frames[k].placement = pin.SE3(R[0], t[0])
        for j, (R, t) in new.joints.items():
            model.jointPlacements[j] = pin.SE3(R[0], t[0])
        for j, body in new.links.items():
            model.inertias[j] = _inertia(body[0])

    def changes(self, lengths: Array, masses: Array, shifts: Array, turns: Array) -> Changes:
        """Return the parts of N robots that differ from the model; see `Perturbation.changes`."""
        at, bodies, new = self._at.copy(), self._bodies.copy(), Changes({}, {}, {}, None)
        if self._n is not None:
            tips = lengths[:, np.newaxis] * self._n
            cylinders = np.zeros((len(masses), 10))
            cylinders[:, 0], cylinders[:, 9] = masses, 0.5 * masses * OBJECT_RADIUS**2
            across = masses * (3.0 * OBJECT_RADIUS**2 + lengths**2) / 12.0
            cylinders[:, 4], cylinders[:, 6] = across, across
            held = _placed(cylinders, self._onto_axis, 0.5 * tips)
            bodies[self._object], new = held, new._replace(held=held)
        for k, joint, on, (R, t), error in self._places:
            if k == self._tip:
                R, t = np.tile(np.eye(3), (len(lengths), 1, 1)), tips
            if error is not None:  # a shift is in the axes of what carries the joint
                R, t = R @ turns[:, error], t + shifts[:, error]
            carrying, origin = at[on]
            at[k] = carrying @ R, origin + _turned(carrying, t)
            if joint is None:
                new.frames[k] = at[k]
            else:
                new.joints[joint] = at[k]
        for j, (rest, parts) in self._links.items():
            new.links[j] = rest + sum(_placed(bodies[k], *at[k]) for k in parts)
        return new


def rotations_of(vectors: Array) -> Array:
    """Return the rotation matrices (…, 3, 3) of rotation vectors (…, 3) [rad]."""
    if not vectors.any():
        return np.zeros((*vectors.shape, 3)) + np.eye(3)
    angles = np.linalg.norm(vectors, axis=-1)[..., np.newaxis, np.newaxis]
    K = np.cross(np.eye(3), vectors[..., np.newaxis, :])  # K u is v × u
    # (1 − cos a)/a² as ½(sin ½a / ½a)²
    c = 0.5 * np.sinc(0.5 * angles / np.pi) ** 2
    return np.asarray(np.eye(3) + np.sinc(angles / np.pi) * K + c * (K @ K))


def _place(placement: pin.SE3) -> Place:
    return np.array(placement.rotation), np.array(placement.translation)


def _turned(R: Array, t: Array) -> Array:
    return np.asarray((R @ t[..., np.newaxis])[..., 0])


def _placed(bodies: Array, R: Array, t: Array) -> Array:
    """Return the dynamic parameters (N, 10) of bodies placed on a link at R and t."""
    m, h = bodies[..., :1], _turned(R, bodies[..., 1:4])
    inertias = bodies[..., [[4, 5, 7], [5, 6, 8], [7, 8, 9]]]
    spreads = _spread(inertias, 0.5)  # ∫ r rᵀ dm
    lever, outward = t[..., np.newaxis] * h[..., np.newaxis, :], t[..., np.newaxis]
    mass = m[..., np.newaxis] * outward * np.swapaxes(outward, -1, -2)
    spreads = R @ spreads @ np.swapaxes(R, -1, -2) + lever + np.swapaxes(lever, -1, -2) + mass
    inertias = _spread(spreads, 1.0)[..., [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    return np.concatenate([m + 0.0 * h[..., :1], h + m * t, inertias], axis=-1)


def _spread(matrices: Array, share: float) -> Array:
    """Return share tr(A) 1 − A of matrices (…, 3, 3): inertias of spreads, or with ½ back."""
    traces = np.trace(matrices, axis1=-2, axis2=-1)[..., np.newaxis, np.newaxis]
    return np.asarray(share * traces * np.eye(3) - matrices)


def _inertia(body: Array) -> pin.Inertia:
    # what has no mass has no centre of mass
    return pin.Inertia.FromDynamicParameters(body) if body[0] else pin.Inertia.Zero()
