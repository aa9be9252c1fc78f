"""`Perturbation`: robots that differ in their object and in the origins of their joints."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.robots.robot import Robot, require_inertia
from approxjac.robots.urdf import OBJECT_RADIUS, Urdf, as_size, direction, rotation_onto
from approxjac.validation import Array, Immutable, changed_copy


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
        self._moved: PerturbedRobot | None = None
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

    def moving(self) -> Perturbation:
        """Return a copy whose `robot` changes one robot in place: use it before the next call."""
        return changed_copy(self, _moved=PerturbedRobot.like(self.base, _outward=self._outward))

    def moves(self, robot: Robot) -> bool:
        """Return True for the robot that a copy by `moving` changes in place."""
        return robot is self._moved

    def robot(self, length: float, mass: float, shifts: Array, rotations: Array) -> Robot:
        """Return a perturbed robot; raise a UrdfError if its inertia matrix would be singular.

        Args:
            length: Length of the object, if there is one, 0 to 10 [m].
            mass: Its mass, ≥ 0 [kg].
            shifts: Shifts of the k joint origins in the parent links' frames, shape (k, 3) [m].
            rotations: Rotation vectors in the joints' own frames, shape (k, 3) [rad].
        """
        if self._made_of[1] is not None:
            as_size("length", length)
            as_size("mass", mass, "kg")
        values = (length, mass, shifts, rotations)
        robot = self._moved or PerturbedRobot.like(self.base, _outward=self._outward)
        robot._made_by = self, values
        robot.__dict__.pop("tree", None)  # that of `base`
        for model, parts in zip(robot.models, self._parts, strict=True):
            parts.change(model, *values)
        if not self._surely_regular:
            require_inertia(robot.model, robot.mimic_joints, self.base.tree.source)
        return robot


class PerturbedRobot(Robot):
    """A robot whose model is a changed copy; its URDF is made on first access."""

    _made_by: tuple[Perturbation, tuple[float, float, Array, Array]]

    @functools.cached_property
    def tree(self) -> Urdf:  # type: ignore[override]
        """The URDF as a tree. Read-only."""
        perturbation, (length, mass, *errors) = self._made_by
        robot, held, axis, joints = perturbation._made_of
        if held is not None:
            robot = robot.with_object(length, mass, axis=axis)
        shifts, turns = (
            {joint: error for joint, error in zip(joints, each, strict=True) if error.any()}
            for each in errors
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
        self._places: list[tuple[int, int | None, int, pin.SE3, int | None]] = []
        carried: list[int] = []
        for k, frame in enumerate(frames):  # frames come after those that carry them
            on = frame.parentFrame
            if k not in errors and k != self._tip and on not in carried:
                continue
            moves = frame.type == pin.FrameType.JOINT
            place = model.jointPlacements[frame.parentJoint] if moves else frame.placement
            origin, joint = frames[on].placement.inverse() * place, frame.parentJoint
            self._places.append((k, joint if moves else None, on, origin, errors.get(k)))
            if not moves:
                carried.append(k)
        # inertias of what may move within a link; the rest of the link as dynamic parameters
        self._at = {k: pin.SE3(frame.placement) for k, frame in enumerate(frames)}
        self._inertias: dict[int, pin.Inertia] = {}
        self._links: dict[int, tuple[Array, list[int]]] = {}
        for k, frame in enumerate(frames):
            own = frame.placement.act(frame.inertia).toDynamicParameters()
            if k == self._object or (k in carried and own.any()):
                j = frame.parentJoint
                rest, parts = self._links.get(j, (model.inertias[j].toDynamicParameters(), []))
                self._links[j] = rest - own, [*parts, k]
                self._inertias[k] = pin.Inertia(frame.inertia)

    def change(
        self, model: pin.Model, length: float, mass: float, shifts: Array, rotations: Array
    ) -> None:
        """Change a copy of the model, with the errors that `Perturbation.robot` takes."""
        frames, at, inertias = model.frames, self._at.copy(), self._inertias.copy()
        if self._n is not None:
            tip = length * self._n
            cylinder = pin.Inertia.FromCylinder(mass, OBJECT_RADIUS, length)
            inertias[self._object] = pin.SE3(self._onto_axis, 0.5 * tip).act(cylinder)
            frames[self._object].inertia = inertias[self._object]
        for k, joint, on, origin, error in self._places:
            if k == self._tip:
                origin = pin.SE3(_NO_TURN, tip)
            if error is not None:  # a shift is in the axes of what carries the joint
                shift = origin.rotation.T.dot(shifts[error])
                origin = origin * pin.SE3(pin.exp3(rotations[error]), shift)
            at[k] = place = at[on] * origin
            if joint is None:
                frames[k].placement = place
            else:
                model.jointPlacements[joint] = place
        for j, (rest, parts) in self._links.items():
            total = rest
            for k in parts:
                total = total + at[k].act(inertias[k]).toDynamicParameters()
            # what has no mass has no centre of mass
            known = pin.Inertia.FromDynamicParameters(total) if total[0] else pin.Inertia.Zero()
            model.inertias[j] = known


_NO_TURN = np.eye(3)
