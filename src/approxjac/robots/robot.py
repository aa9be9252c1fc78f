"""`Robot`: an arm from a URDF, with attached objects and kinematic errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import pinocchio as pin
from lxml import etree

from approxjac.errors import InvalidInputError, UnknownNameError, UrdfError, require_known
from approxjac.files import refusing, write_text
from approxjac.robots import meshes
from approxjac.robots import urdf as edits
from approxjac.robots.urdf import OBJECT_RADIUS, Urdf, as_size, direction, leader_of, likely_tips
from approxjac.validation import (
    Array,
    Immutable,
    as_array,
    as_number,
    as_vector,
    read_only,
    require,
    shape_of,
)

STANDARD_GRAVITY = (0.0, 0.0, -9.81)
WORLD = pin.Convention.WORLD  # members of Pinocchio's enums are slow to look up
_FAR = 1e6  # a locked joint is from zero [rad or m]
_MOST_MOVING = 150  # Pinocchio's scratch memory grows with the cube of it


class MimicJoints(NamedTuple):
    """The map from the n_v independent joints to all, mimic joints included: q_all = A q + b.

    Some of Pinocchio's algorithms refuse models with mimic joints, or silently return wrong values
    (M, C, Jacobian rates). They run on `model`, in which every joint is independent, and results
    are mapped back with v_all = G v, G constant. Without mimic joints, `model` is the robot's own
    and every method returns its argument.
    """

    model: pin.Model
    G: Array | None = None  # (n_all, n_v), None where nothing is coupled
    A: Array | None = None  # (nq_all, nq)
    b: Array | None = None  # (nq_all,)

    def q(self, q: Array) -> Array:
        """Return the configuration of all joints, shape (nq_all,)."""
        return q if self.A is None or self.b is None else self.A @ q + self.b

    def v(self, v: Array) -> Array:
        """Return the velocities of all joints, shape (n_all,)."""
        return v if self.G is None else self.G @ v

    def columns(self, J: Array) -> Array:
        """Return J G: a Jacobian in all velocities as one in v, shape (…, n_v)."""
        return J if self.G is None else J @ self.G

    def rows(self, tau: Array) -> Array:
        """Return Gᵀ τ: torques at all joints as those at the n_v, shape (n_v, …)."""
        return tau if self.G is None else self.G.T @ tau


class Robot(Immutable):
    """A fixed-base arm: its URDF and the Pinocchio model built from it.

    Immutable: every change returns a new robot. Two robots are equal when their URDF text and
    gravity are. Meshes are not needed. A mimic joint is no degree of freedom: it moves with the
    joint that it follows, under that joint's limits, and is locked with it.

    Args:
        urdf: URDF text, or a tree of it.
        gravity: Acceleration of gravity in the world frame, shape (3,) [m/s²].
        tip: End-effector frame to use where none is named, a link or the joint that moves it; by
            default the last link of an unbranched arm, and None for others.
        urdf_dir: Folder that mesh names in the URDF are relative to.
        source: Name of the URDF in errors.
        name: Name of the robot; by default that in the URDF.
        outward: Axis of the tip that points away from the arm; see `outward_axis`.

    Attributes:
        tree: The URDF as a tree. Read-only.
        model: Pinocchio model. Read-only; call `model.copy()` to change it.
        mimic_joints: The map from independent joints to all joints.
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
        self.gravity = as_array("gravity", gravity, (3,), "m/s^2")
        self.tree = urdf if isinstance(urdf, Urdf) else Urdf.parse(urdf, source)
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
        if tip is None:
            tip = leaves[0] if len(leaves) == 1 else None
        elif self.frame_id(tip):  # a joint's frame is its child's
            tip = self.tree.link_of(tip)
        self.tip, self._outward = tip, outward

    # -- what it is ---------------------------------------------------------------------

    @property
    def urdf(self) -> str:
        """URDF text."""
        return self.tree.text

    @property
    def models(self) -> tuple[pin.Model, ...]:
        """`model` and, with mimic joints, the model in which these are independent."""
        coupled = self.mimic_joints.G is not None
        return (self.model, self.mimic_joints.model) if coupled else (self.model,)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the independent joints, in the order of v and τ."""
        return tuple(self._joints)

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Unit of each joint's position, "rad", or "m" for prismatic joints."""
        kinds = (joint.shortname() for joint in self._joints.values())
        return tuple("m" if kind.startswith("JointModelP") else "rad" for kind in kinds)

    @property
    def force_units(self) -> tuple[str, ...]:
        """Unit of each joint's torque, "N m", or "N" for the force of prismatic joints."""
        return tuple("N" if unit == "m" else "N m" for unit in self.joint_units)

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Names of all frames: links and joints."""
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

    @cached_property
    def position_limits(self) -> tuple[Array, Array]:
        """Lower and upper joint limits, each of shape (n_v,) [rad or m]. Read-only.

        Infinite where none is known: continuous joints, and limits of zero width.
        """
        at = [joint.idx_q for joint in self._joints.values()]
        low, high = self.model.lowerPositionLimit[at], self.model.upperPositionLimit[at]
        known = np.array([joint.nq == 1 for joint in self._joints.values()]) & (low < high)
        return read_only(np.where(known, low, -np.inf)), read_only(np.where(known, high, np.inf))

    def neutral(self) -> Array:
        """Return the configuration with every joint at zero, shape (nq,)."""
        return np.array(pin.neutral(self.model))

    @cached_property
    def usual_range(self) -> tuple[Array, Array]:
        """The range that random configurations cover, as two offsets (n_v,) [rad or m]. Read-only.

        It is that of the joint limits; of a wider or unlimited range, the turn or 2 m nearest to 0.
        """
        lower, upper = self.position_limits
        reach = np.where(np.array(self.joint_units) == "m", 1.0, np.pi)
        wide = upper - lower > 2.0 * reach
        middle = np.maximum(lower + reach, np.minimum(0.0, upper - reach))
        lower, upper = np.where(wide, middle - reach, lower), np.where(wide, middle + reach, upper)
        return read_only(lower), read_only(upper)

    def random_configuration(self, rng: np.random.Generator) -> Array:
        """Draw a configuration uniformly within `usual_range`, shape (nq,) [rad or m]."""
        return self.configuration(rng.uniform(*self.usual_range))

    def configurations(self, count: int) -> Iterator[Array]:
        """Draw random configurations (nq,), the same each time [rad or m]."""
        rng = np.random.default_rng(0)
        return (self.random_configuration(rng) for _ in range(count))

    def configuration(self, q: Sequence[float] | Array, name: str = "q") -> Array:
        """Return `q` as a float array of shape (nq,), itself if it is one already.

        One number per joint, shape (n_v,), is accepted as well, with angles for continuous joints.
        Anything else is an InvalidInputError, such as (cos, sin) pairs off the unit circle.
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
        """Return the joint positions at q, (…, nq) → (…, n_v) [rad or m]; inverts `configuration`.

        Those of continuous joints are from −π to π.
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
        """Return the excess over joint limits at q (N, nq), −∞ without; (N, n_v) [rad or m]."""
        (low, high), motions = self.position_limits, self.angles(q)
        return np.asarray(np.maximum(motions - high, low - motions))

    def require_radians(self, name: str, q: Array) -> None:
        """Raise an InvalidInputError if q (nq,) seems to be in degrees: a turn beyond a limit."""
        beyond = self.beyond_limits(q[np.newaxis])[0]
        beyond[np.array(self.joint_units) != "rad"] = 0.0
        if beyond.max() > 2.0 * np.pi:
            raise InvalidInputError(
                f"{name} must be in radians: it is {beyond.max():.4g} rad beyond the limits of "
                f"{self.joint_names[int(beyond.argmax())]}, as degrees would be",
                given=q,
            )

    def reach_bound(self, frame: str) -> tuple[Array, float]:
        """Return the chain's first joint's position (3,) [m] and a bound on a frame's reach [m].

        The bound is the sum of the link lengths, regardless of limits of revolute joints; infinite
        with a prismatic joint that has no limits or mimics another.
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
        """Return `frame` if it exists, or the robot's own tip if it is None.

        Raises:
            UnknownNameError: No such frame.
            InvalidInputError: `frame` is None and the robot has no single tip.
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

        The object is a link `name` on a fixed joint; the link at its end, `{name}_tip`, oriented
        as `parent`, becomes the new `tip`.

        Args:
            length: From the parent's origin to the tip, 0 to 10 [m].
            mass: ≥ 0 [kg].
            radius: Radius of the cylinder, 0 to 10 [m]; 0 is a thin rod.
            parent: Link that holds it; the robot's `tip` by default.
            axis: Direction in the parent's frame: "x", "-z", …, or a vector of shape (3,); by
                default the axis that points away from the arm (`outward_axis`).
            name: Name of the new link.

        Raises:
            InvalidInputError: Numbers out of range, a zero axis, or a name that is taken.
            UnknownNameError: No such parent.
        """
        length, mass = as_size("length", length), as_size("mass", mass, "kg")
        radius = as_size("radius", radius)
        parent = self.tip_or(parent)
        require_known("link", parent, self.name, self.tree.links)
        along = direction(self.outward_axis(parent) if axis is None else axis)
        if not isinstance(name, str) or not name.isprintable() or not name or " " in name:
            message = f"name must be a text without spaces, such as 'object', got {name!r}"
            raise InvalidInputError(message, given=name)
        for new in (name, f"{name}_tip", f"{name}_joint", f"{name}_tip_joint"):
            if new in self._frames or new == "universe":
                raise InvalidInputError(
                    f"name must be new to the robot, got {name!r}: {self.name} already has a frame "
                    f"{new!r}",
                    given=name,
                )
        size = {"length": length, "mass": mass, "radius": radius}
        urdf = edits.with_object(self.tree, name=name, parent=parent, axis=along, **size)
        outward = self.outward_axis(parent)  # the tip is turned as its parent is
        return self._changed(urdf, tip=f"{name}_tip", outward=outward)

    def outward_axis(self, frame: str | None = None) -> str:
        """Return the axis of a frame (the tip by default) that points away from the arm: "-z", ….

        By default the axis nearest to the direction from the third-last joint to it at q = 0.
        """
        frame = self.tip_or(frame)
        if frame == self.tip and self._outward is not None:
            return self._outward
        model, data, at = self.model, self.model.createData(), self.frame_id(frame)
        pin.framesForwardKinematics(model, data, self.neutral())
        joints = list(model.supports[model.frames[at].parentJoint])[1:] or [0]
        lever = -data.oMf[at].actInv(data.oMi[joints[-3:][0]].translation)
        k = int(np.abs(lever).argmax()) if np.linalg.norm(lever) > 1e-9 else 2
        return ("" if lever[k] >= 0.0 else "-") + "xyz"[k]

    def with_kinematic_error(
        self,
        shifts: Mapping[str, Sequence[float]] | None = None,
        rotations: Mapping[str, Sequence[float]] | None = None,
    ) -> Robot:
        """Return this robot with joint origins, also of fixed joints, shifted or rotated.

        Args:
            shifts: Joint name → shift of its origin in the parent link's frame, shape (3,) [m].
            rotations: Joint name → rotation vector in the joint's own frame, shape (3,) [rad].

        Raises:
            UnknownNameError: No such joint.
        """
        for name, given in (("shifts", shifts), ("rotations", rotations)):
            require(name, given, Mapping | None, "a mapping from joint names to 3-vectors")
        shifts, rotations, none = shifts or {}, rotations or {}, np.zeros(3)
        errors = {}
        for joint in dict.fromkeys([*shifts, *rotations]):
            require_known("joint", joint, self.name, self.tree.joints)
            shift = as_array(f"shift of {joint}", shifts.get(joint, none), (3,), "m")
            turn = as_array(f"rotation of {joint}", rotations.get(joint, none), (3,), "rad")
            errors[joint] = shift, turn
        return self._changed(edits.with_moved_origins(self.tree, errors))

    def with_locked_joints(self, positions: Mapping[str, float]) -> Robot:
        """Return this robot with some joints fixed, such as those of fingers.

        Args:
            positions: Joint name → position at which it is fixed [rad or m]. Mimic joints are
                fixed with the joint that they follow, or at the position given here.

        Raises:
            UnknownNameError: Not a moving joint of this robot.
            InvalidInputError: A position that is no number, or beyond 1e6 rad or m.
        """
        require("positions", positions, Mapping, "a mapping from joint names to positions")
        moving = list(self.mimic_joints.model.names)[1:]
        locked: dict[str, float] = {}
        for joint, position in positions.items():
            require_known("moving joint", joint, self.name, moving)
            locked[joint] = as_number(
                f"position of {joint}", position, unit="rad or m", minimum=-_FAR, most=_FAR
            )
        return self._changed(edits.with_locked_joints(self.tree, locked))

    def with_gravity(self, gravity: Sequence[float] | Array) -> Robot:
        """Return this robot under another gravity in the world frame, shape (3,) [m/s²]."""
        gravity = as_array("gravity", gravity, (3,), "m/s^2")
        robot = self.like(self, gravity=gravity, _changes={**self._changes, "gravity": gravity})
        for model in robot.models:
            model.gravity.linear = gravity
        return robot

    def save_urdf(self, path: str | Path) -> Path:
        """Write a URDF that Pinocchio, MuJoCo, MeshCat and yourdfpy open alike; return its path.

        Mesh files are named by their full path, so the file is for this machine only. Collision
        meshes in formats that MuJoCo does not read are converted to STL, in a folder beside the
        file. A URDF holds neither gravity nor the tip: `load_robot(path, tip=robot.tip)`.

        Raises:
            InvalidInputError: The file cannot be written.
        """
        require("path", path, (str, Path), "a file to write")
        path = Path(path)
        urdf = self.tree.copy()
        meshes.for_other_tools(urdf, self.urdf_dir, path)
        with refusing("path must be a file that can be written", path, (OSError, ValueError)):
            write_text(path, urdf.text)
        return path

    # -- Python -------------------------------------------------------------------------

    def _changed(self, urdf: Urdf, **changes: Any) -> Robot:
        outward = None if self.tip is None else self.outward_axis()
        return Robot(**self._arguments | {"urdf": urdf, "outward": outward} | changes)

    @classmethod
    def like(cls, robot: Robot, **changes: Any) -> Self:
        """Return a copy of a robot with Pinocchio models of its own, which may be modified."""
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
        """Mass of all moving links [kg]."""
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


# -- the Pinocchio model of a URDF -------------------------------------------------------


def build_model(urdf: Urdf) -> tuple[pin.Model, MimicJoints]:
    """Return the Pinocchio model of a URDF, and its map of mimic joints."""
    source = urdf.source
    moving = sum(joint.type != "fixed" for joint in urdf.joints.values())
    if moving > _MOST_MOVING:
        raise UrdfError(
            f"{source} must have at most {_MOST_MOVING} joints that move, got {moving}; with "
            "tip=... those that do not move the tip are locked",
            given=source,
        )
    root = urdf.copy().root
    # not every parser takes every geometry, nor instructions
    etree.strip_tags(root, etree.Comment, etree.ProcessingInstruction)
    etree.strip_elements(root, "visual", "collision")
    model = _parsed(root, source)
    if model.nv == 0:
        raise UrdfError(f"{source} has no moving joint", given=source)
    for name, joint in zip(model.names[1:], list(model.joints)[1:], strict=True):
        if joint.nv != 1:
            raise UrdfError(
                f"{source}: joint {name!r} has {joint.nv} degrees of freedom; every joint of an "
                "arm must be revolute, continuous, prismatic or fixed; the arm on a base that "
                f"moves is loaded with tip=... and base={urdf.joints[name].child!r}, or a link "
                "beyond",
                given=source,
            )
    coupled, mimic_joints = _coupled(urdf, root, model)
    require_inertia(coupled, mimic_joints, source)
    return coupled, mimic_joints


def _parsed(root: Any, source: str, mimic: bool = False) -> pin.Model:
    try:
        return pin.buildModelFromXML(etree.tostring(root, encoding="unicode"), mimic)
    except (ValueError, RuntimeError) as error:
        raise UrdfError(f"{source} is not a valid URDF: {error}", given=source) from error


def _coupled(urdf: Urdf, root: Any, model: pin.Model) -> tuple[pin.Model, MimicJoints]:
    """Return the model without mimic joints in q and v, and how these move."""
    names = list(model.names)
    followers = {joint: follows for joint, follows in urdf.followers.items() if joint in names}
    if not followers:
        return model, MimicJoints(model)
    followed = {joint: leader_of(joint, followers) for joint in followers}
    for joint, (leader, multiplier, offset) in followed.items():
        place = names.index(leader) if leader in names else len(names)
        kinds = [model.joints[names.index(each)].nq for each in (joint, leader) if each in names]
        if leader in followers or place > names.index(joint) or kinds != [1, 1]:
            raise UrdfError(
                f"{urdf.source}: joint {joint!r} mimics {leader!r}, which must be a joint that "
                "moves by itself and comes before it in Pinocchio's order, and neither may be "
                "continuous; make it fixed, or take its <mimic> away",
                given=urdf.source,
            )
        (mimic,) = root.xpath("joint[@name=$name]/mimic[1]", name=joint)
        follows = {"joint": leader, "multiplier": str(multiplier), "offset": str(offset)}
        mimic.attrib.update(follows)
    reduced = _parsed(root, urdf.source, True)
    A, b = np.zeros((model.nq, reduced.nq)), np.zeros(model.nq)
    G = np.zeros((model.nv, reduced.nv))
    for name, own, kept in zip(names[1:], list(model.joints)[1:], reduced.joints[1:], strict=True):
        # the indices of a mimic joint are those of its leader
        _, multiplier, offset = followed.get(name, (name, 1.0, 0.0))
        np.fill_diagonal(A[own.idx_q :, kept.idx_q :][: own.nq], multiplier)
        np.fill_diagonal(G[own.idx_v :, kept.idx_v :][: own.nv], multiplier)
        b[own.idx_q] = offset
    return reduced, MimicJoints(model, G, A, b)


def own_joints(model: pin.Model) -> dict[str, Any]:
    """Return name → Pinocchio joint of the independent joints, in the order of v."""
    joints = zip(list(model.names)[1:], list(model.joints)[1:], strict=True)
    return {name: joint for name, joint in joints if joint.nv == 1}  # a mimic joint has nv 0


def all_frame_id(robot: Robot, frame: str) -> int:
    """Return the index of a frame in the model in which mimic joints move on their own."""
    if robot.mimic_joints.model is robot.model:
        return robot.frame_id(frame)
    kind = robot.model.frames[robot.frame_id(frame)].type
    return int(robot.mimic_joints.model.getFrameId(frame, kind))


def mass_matrix(mimic_joints: MimicJoints, data: pin.Data, q: Array) -> Array:
    """Return M(q) by CRBA, made symmetric, from data of the model with all joints independent.

    On models with mimic joints Pinocchio's CRBA is wrong if the chain branches after one of them.
    """
    M = symmetric(pin.crba(mimic_joints.model, data, mimic_joints.q(q), WORLD))
    return M if mimic_joints.G is None else symmetric(mimic_joints.rows(mimic_joints.columns(M)))


def symmetric(upper: Array) -> Array:
    """Return a symmetric matrix from its upper triangle, shape (n, n)."""
    return upper.T.take(_places(len(upper)))  # Pinocchio's matrices are by columns


@cache
def _places(n: int) -> np.ndarray[Any, np.dtype[np.intp]]:
    i, j = np.indices((n, n))
    return n * np.maximum(i, j) + np.minimum(i, j)


def require_inertia(model: pin.Model, mimic_joints: MimicJoints, source: str) -> None:
    """Raise a UrdfError if the inertia matrix is singular: no torque control is possible.

    Links fixed to the base may have any inertia; common URDFs contain invalid ones there.
    """
    for name, inertia in zip(list(model.names)[1:], list(model.inertias)[1:], strict=True):
        moments = np.linalg.eigvalsh(inertia.inertia)
        if inertia.mass < 0.0 or moments[0] < -1e-9 * max(1e-9, abs(moments[-1])):
            raise UrdfError(
                f"{source}: the links moved by {name} have a negative mass or inertia "
                f"({inertia.mass:g} kg, principal moments {moments.tolist()} kg m^2)",
                given=source,
            )
    M = mass_matrix(mimic_joints, mimic_joints.model.createData(), pin.neutral(model))
    eigenvalues, vectors = np.linalg.eigh(M)
    if eigenvalues[0] > 1e-12 * eigenvalues[-1] > 0.0:
        return
    loose = list(own_joints(model))[int(np.abs(vectors[:, 0]).argmax())]
    raise UrdfError(
        f"{source}: nothing with inertia is moved by joint {loose!r} (the inertia matrix is "
        "singular); torque control needs <inertial> with mass and inertia on what each joint moves",
        given=source,
    )
