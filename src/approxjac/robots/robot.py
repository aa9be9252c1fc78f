"""`Robot`: an arm from a URDF, with objects attached to it and errors applied to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import pinocchio as pin

from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.files import write_text
from approxjac.robots import meshes
from approxjac.robots.model import MimicJoints, build_model, outward_axis, own_joints
from approxjac.robots.urdf import (
    OBJECT_RADIUS,
    Urdf,
    direction,
    likely_tips,
    object_size,
    require_new,
    with_locked_joints,
    with_moved_origins,
    with_object,
)
from approxjac.validation import Array, Immutable, as_array, as_number, as_vector, require, shape_of

STANDARD_GRAVITY = (0.0, 0.0, -9.81)


class Robot(Immutable):
    """A fixed-base arm: its URDF and the Pinocchio model built from it.

    Immutable: every change returns a new robot. Two robots are equal when their URDF text and
    gravity are. Meshes are never needed. A mimic joint is no degree of freedom: it moves with the
    joint that it follows, under that joint's limits, and is locked with it.

    Args:
        urdf: URDF text, or a tree of it.
        gravity: Acceleration of gravity in the world frame, shape (3,) [m/s²].
        tip: End-effector frame to use where none is named; by default the last link of an
            unbranched arm, and None of others.
        urdf_dir: Folder that mesh names in the URDF are relative to.
        source: What to call the URDF in errors.
        name: What to call the robot; its name in the URDF by default.
        outward: Axis of the tip, such as "z", along which the arm leads on; by default the one that
            the last three joints say.

    Attributes:
        tree: The URDF as a tree. Read-only.
        model: Pinocchio model. Read-only; call `model.copy()` to change it.
        mimic_joints: How mimic joints move with the others.
        nq: Length of a configuration q; larger than `nv` where joints are continuous.
        nv: Number of degrees of freedom n_v.

    Raises:
        UrdfError: Malformed, or not usable for torque control, such as links without inertia.
        UnknownNameError: `tip` is not a frame.
    """

    def __init__(
        self,
        urdf: str | Urdf,
        *,
        gravity: Sequence[float] | Array = STANDARD_GRAVITY,
        tip: str | None = None,
        urdf_dir: Path | None = None,
        source: str = "URDF text",
        name: str | None = None,
        outward: str | None = None,
    ) -> None:
        require("urdf", urdf, (str, Urdf), "URDF text")
        gravity = as_array("gravity", gravity, (3,), "m/s^2")
        self.tree = urdf if isinstance(urdf, Urdf) else Urdf.parse(urdf, source)
        self.gravity = gravity
        self.urdf_dir = urdf_dir
        self.name = self.tree.name if name is None else name
        self.model, self.mimic_joints = build_model(self.tree)
        self.nq, self.nv = int(self.model.nq), int(self.model.nv)
        self._joints = own_joints(self.model)
        for model in self.models:
            model.gravity.linear = self.gravity
        # A body and a joint may share a name; the body's frame is the one people mean.
        frames = sorted(enumerate(self.model.frames), key=lambda f: f[1].type == pin.FrameType.BODY)
        self._frames = {frame.name: index for index, frame in frames if frame.name != "universe"}
        parents = {joint.parent for joint in self.tree.joints.values()}
        leaves = [link for link in self.tree.links if link not in parents]
        self.tip = tip if tip is not None else (leaves[0] if len(leaves) == 1 else None)
        self._outward = outward
        if self.tip is not None:
            self.frame_id(self.tip)

    # -- what it is ---------------------------------------------------------------------

    @property
    def urdf(self) -> str:
        """URDF text."""
        return self.tree.text

    @property
    def models(self) -> tuple[pin.Model, ...]:
        """`model`, and where mimic joints move the one in which they move on their own."""
        coupled = self.mimic_joints.G is not None
        return (self.model, self.mimic_joints.model) if coupled else (self.model,)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints that move on their own, in the order of v and τ."""
        return tuple(self._joints)

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Unit of each joint's position, "rad", or "m" for prismatic joints."""
        kinds = (joint.shortname() for joint in self._joints.values())
        return tuple("m" if kind.startswith("JointModelP") else "rad" for kind in kinds)

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Names of all frames, which are links and joints."""
        return tuple(self._frames)

    @property
    def effort_limits(self) -> Array:
        """Torque or force limits, shape (n_v,) [N m or N]; infinite where none is known."""
        limits = self.model.upperEffortLimit
        return np.where(limits > 0.0, limits, np.inf)  # 0 in a URDF: nobody filled it in

    @property
    def velocity_limits(self) -> Array:
        """Speed limits, shape (n_v,) [rad/s or m/s]; infinite where none is known."""
        limits = self.model.upperVelocityLimit
        return np.where(limits > 0.0, limits, np.inf)

    @property
    def position_limits(self) -> tuple[Array, Array]:
        """Lower and upper joint limits, each of shape (n_v,) [rad or m].

        Infinite where none is known: continuous joints, and limits of zero width.
        """
        at = [joint.idx_q for joint in self._joints.values()]
        low, high = self.model.lowerPositionLimit[at], self.model.upperPositionLimit[at]
        known = np.array([joint.nq == 1 for joint in self._joints.values()]) & (low < high)
        return np.where(known, low, -np.inf), np.where(known, high, np.inf)

    def neutral(self) -> Array:
        """Configuration with every joint at zero, shape (nq,)."""
        return np.array(pin.neutral(self.model))

    def usual_range(self) -> tuple[Array, Array]:
        """Range of each joint that is drawn from, as two motions from zero (n_v,) [rad or m].

        The joint limits; the turn or the 2 m nearest to zero of a wider range, or without limits.
        """
        lower, upper = self.position_limits
        reach = np.where(np.array(self.joint_units) == "m", 1.0, np.pi)
        wide = upper - lower > 2.0 * reach
        middle = np.maximum(lower + reach, np.minimum(0.0, upper - reach))
        return np.where(wide, middle - reach, lower), np.where(wide, middle + reach, upper)

    def random_configuration(self, rng: np.random.Generator) -> Array:
        """Uniform configuration within `usual_range`, shape (nq,) [rad or m]."""
        motion = rng.uniform(*self.usual_range())
        return np.array(pin.integrate(self.model, self.neutral(), motion))

    def configuration(self, q: Sequence[float] | Array, name: str = "q") -> Array:
        """Return `q` as a float array of shape (nq,), itself if it is one already.

        One number a joint, shape (n_v,), is taken as well: the angles of continuous joints. An
        InvalidInputError says what else is wrong, such as (cos, sin) pairs off the unit circle.
        """
        if self.nq == self.nv or hasattr(q, "arm_of"):  # symbols
            return as_vector(name, q, self.nq, "rad or m")
        if shape_of(q) == (self.nv,):
            motion = as_array(name, q, (self.nv,), "rad or m")
            return np.array(pin.integrate(self.model, self.neutral(), motion))
        vector = as_vector(name, q, self.nq, "rad or m")
        if not pin.isNormalized(self.model, vector, 1e-3):
            raise InvalidInputError(
                f"{name} must have cos^2 + sin^2 = 1 in the pairs of continuous joints of "
                f"{self.name}, got {vector.tolist()}; neutral() is a valid configuration",
                given=q,
            )
        return vector

    def angles(self, q: Sequence[float] | Array) -> Array:
        """Return the position of each joint at q, (…, nq) → (…, n_v): back from `configuration`.

        Those of continuous joints are from -π to π [rad or m].
        """
        q = np.asarray(q, dtype=float)
        if q.shape[-1:] != (self.nq,):
            raise InvalidInputError(f"q must have shape (..., {self.nq}), got {q.shape}", given=q)
        if self.nq == self.nv:
            return q
        zero, each = self.neutral(), q.reshape(-1, self.nq)
        differences = [pin.difference(self.model, zero, one) for one in each]
        return np.array(differences).reshape(*q.shape[:-1], self.nv)

    def beyond_limits(self, q: Array) -> Array:
        """Return the excess of each joint over its limits at q (N, nq); shape (N, n_v) [rad or m].

        Negative within them, −∞ where a joint has none.
        """
        low, high = self.position_limits
        motions = np.array([pin.difference(self.model, self.neutral(), each) for each in q])
        return np.asarray(np.maximum(motions - high, low - motions))

    def require_radians(self, name: str, q: Array) -> None:
        """Raise an InvalidInputError if q (nq,) is a turn or more beyond a limit, as degrees are.

        One that is a little beyond them may be where a run ended.
        """
        beyond = self.beyond_limits(q[np.newaxis])[0]
        beyond[np.array(self.joint_units) != "rad"] = 0.0
        if beyond.max() > 2.0 * np.pi:
            raise InvalidInputError(
                f"{name} must be in radians: it is {beyond.max():.4g} rad beyond the limits of "
                f"{self.joint_names[int(beyond.argmax())]}, as degrees would be",
                given=q,
            )

    def reach_bound(self, frame: str) -> tuple[Array, float]:
        """Return the place of the first joint before a frame (3,), and a bound on its reach [m].

        The bound is the arm stretched out along its links, whatever its joints allow; infinite with
        a prismatic joint without limits, or one that mimics another.
        """
        model, there = self.model, self.model.frames[self.frame_id(frame)]
        joints = list(model.supports[there.parentJoint])[1:]
        origins = [model.jointPlacements[j].translation for j in joints]
        ways = (*origins[1:], there.placement.translation)
        reach = sum(float(np.linalg.norm(way)) for way in ways)
        slides = dict(zip(self.joint_names, np.abs(self.position_limits).max(axis=0), strict=True))
        every = self.mimic_joints.model  # in which mimic joints move on their own
        for name in (model.names[j] for j in joints):
            if every.joints[every.getJointId(name)].shortname().startswith("JointModelP"):
                reach += float(slides.get(name, np.inf))
        return np.array(origins[0]) if joints else np.zeros(3), reach

    def frame_id(self, frame: str) -> int:
        """Return Pinocchio's index of a frame, or raise an UnknownNameError."""
        try:
            return self._frames[frame]
        except (KeyError, TypeError):
            raise UnknownNameError("frame", frame, self.name, self.tree.links) from None

    def tip_or(self, frame: str | None) -> str:
        """Return `frame` if it exists, or the robot's own tip where it is None.

        Raises:
            UnknownNameError: No such frame.
            InvalidInputError: None was given and the robot has more than one end.
        """
        if frame is None:
            if self.tip is None:
                raise InvalidInputError(
                    f"a frame must be named: {self.name} has more than one end; name its tip "
                    "once, load_robot(path, tip=...), or --tip on the command line; "
                    f"{likely_tips(self.tree)}",
                    given=None,
                )
            return self.tip
        self.frame_id(frame)
        return frame

    # -- robots made from it ------------------------------------------------------------

    def with_object(
        self,
        length: float,
        mass: float = 0.0,
        radius: float = OBJECT_RADIUS,
        parent: str | None = None,
        axis: str | Sequence[float] | None = None,
        name: str = "object",
    ) -> Robot:
        """Return this robot holding an object: a uniform cylinder with a frame at its far end.

        The object is a URDF link `name` on a fixed joint at the origin of `parent`; the frame at
        its end is the link `{name}_tip`, which becomes the new `tip`, turned as `parent` is.

        Args:
            length: From the parent's origin to the tip, 0 to 10 [m].
            mass: ≥ 0 [kg].
            radius: Of the cylinder, 0 to 10 [m]; 0 is a thin rod.
            parent: Link that holds it; the robot's `tip` by default.
            axis: Direction in the parent's frame: "x", "-z", …, or a vector of shape (3,); by
                default the axis that leads on from the arm (`outward_axis`).
            name: Name of the new link.

        Raises:
            InvalidInputError: Numbers that are negative, not finite or too large, an axis that is
                none, or a name that is taken.
            UnknownNameError: No such parent.
        """
        length, mass, radius = object_size(length, mass, radius)
        parent = self.tip_or(parent)
        if parent not in self.tree.links:
            raise UnknownNameError("link", parent, self.name, self.tree.links)
        along = direction(self.outward_axis(parent) if axis is None else axis)
        require_new(name, set(self._frames) | {"universe"}, self.name)
        size = {"length": length, "mass": mass, "radius": radius}
        urdf = with_object(self.tree, name=name, parent=parent, axis=along, **size)
        outward = self.outward_axis(parent)  # the tip is turned as its parent is
        return self._changed(urdf, tip=f"{name}_tip", outward=outward)

    def outward_axis(self, frame: str | None = None) -> str:
        """Return the axis of a frame, the tip by default, along which the arm leads on: "-z", …."""
        frame = self.tip_or(frame)
        if frame == self.tip and self._outward is not None:
            return self._outward
        return outward_axis(self.model, self.frame_id(frame))

    def with_kinematic_error(
        self,
        shifts: Mapping[str, Sequence[float]] | None = None,
        rotations: Mapping[str, Sequence[float]] | None = None,
    ) -> Robot:
        """Return this robot with the origins of joints, also fixed ones, shifted or turned.

        Args:
            shifts: Joint name → shift of its origin in the parent link's frame, shape (3,) [m].
            rotations: Joint name → rotation vector in the joint's own frame, shape (3,) [rad].

        Raises:
            UnknownNameError: No such joint.
            InvalidInputError: Wrong shape or not finite.
        """
        for name, given in (("shifts", shifts), ("rotations", rotations)):
            if given is not None:
                require(name, given, Mapping, "a mapping from joint names to 3-vectors")
        shifts, rotations, none = shifts or {}, rotations or {}, np.zeros(3)
        errors = {}
        for joint in dict.fromkeys([*shifts, *rotations]):
            if joint not in self.tree.joints:
                raise UnknownNameError("joint", joint, self.name, self.tree.joints)
            shift = as_array(f"shift of {joint}", shifts.get(joint, none), (3,), "m")
            turn = as_array(f"rotation of {joint}", rotations.get(joint, none), (3,), "rad")
            errors[joint] = shift, turn
        return self._changed(with_moved_origins(self.tree, errors))

    def with_locked_joints(self, positions: Mapping[str, float]) -> Robot:
        """Return this robot with joints fixed for good, such as those of fingers.

        Args:
            positions: Joint name → position at which it is fixed [rad or m]. Mimic joints are
                fixed with the joint that they follow, or where this says.

        Raises:
            UnknownNameError: Not a moving joint of this robot.
            InvalidInputError: A position that is not finite.
        """
        require("positions", positions, Mapping, "a mapping from joint names to positions")
        moving = list(self.mimic_joints.model.names)[1:]
        locked: dict[str, float] = {}
        for joint, position in positions.items():
            if joint not in moving:
                raise UnknownNameError("moving joint", joint, self.name, moving)
            locked[joint] = as_number(f"position of {joint}", position, unit="rad or m")
        return self._changed(with_locked_joints(self.tree, locked))

    def with_gravity(self, gravity: Sequence[float] | Array) -> Robot:
        """Return this robot under another gravity in the world frame, shape (3,) [m/s²]."""
        gravity = as_array("gravity", gravity, (3,), "m/s^2")
        changes = {**self._changes, "gravity": gravity}
        robot = self.like(self, gravity=gravity, _changes=changes)
        for model in robot.models:
            model.gravity.linear = gravity
        return robot

    def save_urdf(self, path: str | Path) -> Path:
        """Write a URDF that Pinocchio, MuJoCo, MeshCat and yourdfpy open alike; return its path.

        Mesh files are named by their full path, so the file is meant for this machine. Collision
        meshes in formats that MuJoCo does not read are converted to STL, into a folder beside the
        file. A URDF tells neither gravity nor the tip: `load_robot(path, tip=robot.tip)`.

        Raises:
            InvalidInputError: The file cannot be written.
        """
        require("path", path, (str, Path), "a file to write")
        path = Path(path)
        urdf = self.tree.copy()
        meshes.for_other_tools(urdf, self.urdf_dir, path)
        try:
            write_text(path, urdf.text)
        except OSError as error:
            raise InvalidInputError(
                f"path must be a file that can be written, got {path}: {error}", given=path
            ) from error
        return path

    # -- Python -------------------------------------------------------------------------

    def _changed(self, urdf: Urdf, **changes: Any) -> Robot:
        outward = None if self.tip is None else self.outward_axis()
        return Robot(**self._arguments | {"urdf": urdf, "outward": outward} | changes)

    @classmethod
    def like(cls, robot: Robot, **changes: Any) -> Self:
        """Return the same robot with models of its own, which may be changed at once."""
        new, model, mimic_joints = cls.__new__(cls), pin.Model(robot.model), robot.mimic_joints
        independent = model if mimic_joints.G is None else pin.Model(mimic_joints.model)
        mimic_joints = MimicJoints(independent, *mimic_joints[1:])
        new.__dict__.update(robot.__dict__, model=model, mimic_joints=mimic_joints, **changes)
        return new

    def __repr__(self) -> str:
        return (
            f"Robot({self.name!r}: {self.nv} joints {', '.join(self.joint_names)}; "
            f"tip {self.tip!r}; {self.mass:.4g} kg)"
        )

    @property
    def mass(self) -> float:
        """Mass of everything that moves [kg]."""
        return float(sum(inertia.mass for inertia in list(self.model.inertias)[1:]))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Robot):
            return NotImplemented
        return self is other or (
            self.urdf == other.urdf and np.array_equal(self.gravity, other.gravity)
        )

    def __hash__(self) -> int:
        return hash(self.urdf)

    def __deepcopy__(self, memo: dict[int, Any]) -> Robot:
        return self  # it never changes
