"""`Uncertainty`: how the true robot may differ from the believed one."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property, partial
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.cameras import Camera
from approxjac.errors import InvalidInputError, require_known
from approxjac.robots import Drives, Friction, KinematicBelief, Perturbation, Robot
from approxjac.robots.kinematic_regressor import KinematicRegressor, Unknowns
from approxjac.robots.perturbation import Changes, rotations_of
from approxjac.robots.urdf import as_size, direction
from approxjac.simulation import Plant
from approxjac.tasks import ImageTask, PositionTask, Task, best_axes
from approxjac.validation import (
    Array,
    as_array,
    as_diagonal,
    as_integer,
    as_number,
    as_vector,
    is_scalar,
    require,
)

_NONE = 1e-4  # of the width of a range: an end that is nearer to 0 is written as 0
_PIECE = 0.25 * math.pi  # longest range of an angle that its two ends stand for [rad]
_LEAST_FOCAL = 0.1  # of the believed one
_TURN = 2.0 * math.pi * (1.0 + 1e-9)
_OPTICS = "camera focal_length", "camera distance", "camera roll"  # some make no camera
_HELD = ("length", "mass")  # of an object
_AXES = {" x", " y", " z"}
_LOOKS = 16  # configurations at which effects of learnt numbers are compared
_STEP = 1e-5  # of a difference, either way [m or rad]
_SMALL = 1e-6  # difference of numbers of the same arm [m or rad], or share that is nothing


class Coordinate(NamedTuple):
    """One uncertain number: its believed value and its range."""

    name: str
    unit: str
    believed: float
    low: float
    high: float

    def scaled(self, factor: float) -> Coordinate:
        """Return this coordinate with a range scaled about its belief; exact for 0 and 1."""
        believed = self.believed
        low, high = (factor * end + (1.0 - factor) * believed for end in (self.low, self.high))
        return self._replace(low=min(low, believed), high=max(high, believed))

    def ends(self) -> tuple[float, ...]:
        """Return the ends of the range, for wide ranges of angles also those of equal pieces.

        Between the ends of δ, a rotation is a convex combination of theirs times at most
        1/cos(δ/2): 1.08 for 45°, but without bound towards half a turn.
        """
        if self.unit != "rad" or self.high - self.low <= _PIECE:
            return tuple(dict.fromkeys((self.low, self.high)))
        if self.high - self.low > _TURN:
            raise InvalidInputError(
                f"{self.name} must have a range of at most a full turn, 6.283 [rad], got "
                f"{self.low:.4g} to {self.high:.4g}",
                given=(self.low, self.high),
            )
        pieces = math.ceil((self.high - self.low) / _PIECE - 1e-9)
        inner = (self.low + k / pieces * (self.high - self.low) for k in range(1, pieces))
        return (self.low, *inner, self.high)


def _as_range(name: str, given: Any, believed: float, unit: str, of: str = "") -> list[Coordinate]:
    if given is None:
        return []
    wanted = f"{name} must be (smallest, largest) [{unit}]"
    if is_scalar(given):
        message = f"{wanted}, such as (0.0, {given!r}), got {given!r}"
        raise InvalidInputError(message, given=given)
    low, high = as_array(name, given, (2,), unit).tolist()
    if low > high:
        message = f"{wanted}, got {(low, high)}; {(high, low)} is such a range"
        raise InvalidInputError(message, given=given)
    if not low <= believed <= high:
        raise InvalidInputError(
            f"{name} must contain what is believed, {believed:g} [{unit}], got {(low, high)}; "
            f"{(min(low, believed), max(high, believed))} does, or believe another value in it",
            given=given,
        )
    return [Coordinate(of + name, unit, float(believed), low, high)]


def _as_bounds(name: str, given: Any, arm: Robot, unit: str) -> dict[str, tuple[float, ...]]:
    """Return the bounds of joint errors along x, y, z, checked, as a new dictionary."""
    require(name, given, Mapping, "a mapping from joint names to bounds of shape (3,)")
    bounds = {}
    for joint, bound in given.items():
        require_known("joint", joint, arm.name, arm.tree.joints)
        size = as_diagonal(f"{name} of {joint}", bound, 3, unit=unit, positive=False)
        bounds[joint] = tuple(size.tolist())
    return bounds


def _camera_range(camera: Camera | None, name: str, given: Any) -> list[Coordinate]:
    if given is None:
        return []
    if camera is None:
        raise InvalidInputError(
            f"{name} is that of a camera, got {given!r} without one: give the believed "
            "camera as camera, such as PlanarCamera(f, z)",
            given=given,
        )
    where = f"the calibration of {type(camera).__name__}"
    require_known("range", name, where, camera.calibration)
    return _as_range(name, given, *camera.calibration[name], of="camera ")


def _camera_bounds(
    camera: Camera | None, name: str, given: Any, count: int, unit: str
) -> list[Coordinate]:
    if given is None:
        return []
    known, bounds = [], as_diagonal(name, given, count, unit=unit, positive=False)
    for axis, bound in zip("xyz", bounds.tolist(), strict=False):
        if bound > 0.0:
            known += _camera_range(camera, f"{name} {axis}", (-bound, bound))
    return known


def _described(name: str, value: float, unit: str) -> str:
    """A coordinate at a value, such as "camera roll 0.349 rad (20.0 deg)"."""
    value += 0.0  # of -0 makes 0
    degrees = f" ({math.degrees(value):.1f} deg)" if unit == "rad" else ""
    return f"{label_of(name)} {value:.3g} {unit}{degrees}"


def label_of(name: str) -> str:
    """Return the name of a coordinate or parameter as text; joints keep theirs."""
    return name.replace("object_", "object ").replace("focal_length", "focal length")


@dataclass(frozen=True, eq=False, repr=False)
class Uncertainty:
    """A box of errors: how the true robot may differ from the one that the controller believes.

    Each given range is one uncertain coordinate, in the order of the attributes below, and x, y, z
    within a joint. The truth is any point of the box, values (d,) of these coordinates (errors are
    independent); so is the belief. Everything else is certain.

    If any length or mass of an object is given, the true and the believed arm hold one.

    Attributes:
        arm: The believed arm, without the object.
        task: Function from a robot, or from robot and camera, to a task, such as
            `functools.partial(PositionTask, axes="xz")`; by default `PositionTask` or `ImageTask`.
            (A lambda cannot be sent to other processes.)
        object_length: Smallest and largest true length of the object [m].
        object_mass: Smallest and largest true mass of the object [kg].
        believed_length: Believed length of the object, ≥ 0 [m].
        believed_mass: Believed mass of the object, ≥ 0 [kg].
        object_axis: Axis of the tip's frame that the object points along; by default as in
            `Robot.with_object`.
        joint_shifts: Joint name → largest error of its origin to either side along each axis of
            the parent link, shape (3,) [m]; an axis with 0 is certain.
        joint_rotations: Joint name → the same for the rotation vector in the joint's own frame,
            shape (3,) [rad].
        camera: The believed camera, if the task is an image. The next five attributes are of its
            `calibration`, in its units.
        focal_length: Smallest and largest true focal length: of a `PlanarCamera` [m], f_x of a
            `PinholeCamera` [px] (f_y along with it).
        distance: Smallest and largest true distance of a `PlanarCamera` [m]; of a
            `PinholeCamera` the shift back along its optical axis from the believed position [m],
            with 0 believed.
        roll: Smallest and largest true roll about the optical axis [rad]: of a `PinholeCamera`
            relative to the believed one, with 0 believed.
        tilt: Largest error of the optical axis of a `PinholeCamera` to either side about its axes
            right and down, as a rotation vector, shape (2,) [rad]; a camera rolls about the tilted
            axis.
        shift: Largest error of the position of a `PinholeCamera` to either side along its axes
            right, down and forward, shape (3,) [m].
        covariance: Calibration of the arm, whose numbers have errors by their covariance: normal
            in draws, and with corners on its ellipsoid.
        confidence: Share of these draws in the ellipsoid.
        friction: Friction of the true joints, which is certain: viscous friction B ≥ 0, a number or
            shape (n_v,) [N m s/rad or N s/m], or a `robots.Friction`.
        drives: Drives of the true joints, which are certain; by default ideal ones. With other
            drives, or dry friction, there are rollouts, but no certificates.
        factor: Factor that scales the ranges about the believed values; see `scaled`.

    Raises:
        InvalidInputError: Ranges that are reversed, not finite, without the believed value, or of
            an angle beyond a full turn; impossible objects or cameras in the box; ranges of a
            camera without a camera; or an invalid function `task`.
        UnknownNameError: No such joint; a range that the camera's calibration does not have.

    Example:
        >>> arm = load_robot("panda")
        >>> Uncertainty(arm, object_length=(0.0, 0.3)).plant([0.2]).robot.tip
        'object_tip'
    """

    arm: Robot
    task: Callable[..., Task] | None = None
    _: KW_ONLY
    object_length: tuple[float, float] | None = None
    object_mass: tuple[float, float] | None = None
    believed_length: float = 0.0
    believed_mass: float = 0.0
    object_axis: str | Sequence[float] | None = None
    joint_shifts: Mapping[str, Sequence[float] | Array] = field(default_factory=dict)
    joint_rotations: Mapping[str, Sequence[float] | Array] = field(default_factory=dict)
    camera: Camera | None = None
    focal_length: tuple[float, float] | None = None
    distance: tuple[float, float] | None = None
    roll: tuple[float, float] | None = None
    tilt: Sequence[float] | Array | None = None
    shift: Sequence[float] | Array | None = None
    covariance: KinematicBelief | None = None
    confidence: float = 0.95
    friction: float | Sequence[float] | Array | Friction = 0.0
    drives: Drives | None = None
    factor: float = 1.0
    _coordinates: tuple[Coordinate, ...] = field(init=False)

    def __post_init__(self) -> None:
        require("arm", self.arm, Robot, "the believed Robot, without the object")
        wanted = "a camera, such as PlanarCamera(f, z), or None"
        require("camera", self.camera, Camera | None, wanted)
        as_size("believed_length", self.believed_length)
        as_size("believed_mass", self.believed_mass, "kg")
        as_number("factor", self.factor, minimum=0.0)
        if self.object_axis is not None:
            direction(self.object_axis)
        own = vars(self)  # frozen once it is built
        # copies, so that nobody changes them later
        for name, unit in (("joint_shifts", "m"), ("joint_rotations", "rad")):
            own[name] = _as_bounds(name, getattr(self, name), self.arm, unit)
        if not (isinstance(self.friction, Friction) or is_scalar(self.friction)):
            own["friction"] = tuple(self.friction)  # type: ignore[arg-type]
        kinds = ("shift", "m", self.joint_shifts), ("rotation", "rad", self.joint_rotations)
        given = [
            *_as_range("object_length", self.object_length, self.believed_length, "m"),
            *_as_range("object_mass", self.object_mass, self.believed_mass, "kg"),
        ]
        for joint, (kind, unit, bounds) in itertools.product(self._joints, kinds):
            for axis, bound in zip("xyz", bounds.get(joint, (0.0,) * 3), strict=True):
                if bound > 0.0:
                    given.append(Coordinate(f"{joint} {kind} {axis}", unit, 0.0, -bound, bound))
        for name in ("focal_length", "distance", "roll"):
            given += _camera_range(self.camera, name, getattr(self, name))
        given += _camera_bounds(self.camera, "tilt", self.tilt, 2, "rad")
        given += _camera_bounds(self.camera, "shift", self.shift, 3, "m")
        as_number("confidence", self.confidence, above=0.0, most=1.0 - _SMALL)
        if (learnt := self._learnt) is not None:
            each = zip(learnt.names, learnt.units, self._radius * learnt.sd, strict=True)
            given += [Coordinate(name, unit, 0.0, -size, size) for name, unit, size in each]
        own["_coordinates"] = tuple(known.scaled(self.factor) for known in given)
        for known in self._coordinates:
            known.ends()  # refuses an angle beyond a full turn
            if known.name.startswith("object_"):
                for end in known[-2:]:
                    as_size(known.name, end, known.unit)
        self.plant(self.believed)  # refuses what fits no such robot: a task, an axis, joints
        corners = (k[-2:] if k.name in _OPTICS else (k[2],) for k in self._coordinates)
        for corner in itertools.product(*corners):  # where a camera is first none
            try:
                self.plant(corner)
            except InvalidInputError as error:
                grown = "" if self.factor == 1.0 else f" with the factor {self.factor:.4g}"
                raise InvalidInputError(
                    f"a camera must exist everywhere in the set, got {self.describe(corner)}"
                    f"{grown}: {error}",
                    given=corner,
                ) from error

    # -- the box ------------------------------------------------------------------------

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the uncertain coordinates, length d."""
        return tuple(known.name for known in self._coordinates)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Their units, length d."""
        return tuple(known.unit for known in self._coordinates)

    @property
    def d(self) -> int:
        """Number of uncertain coordinates; 0 if the belief is the truth."""
        return len(self._coordinates)

    @property
    def believed(self) -> Array:
        """Believed value of each, shape (d,)."""
        return np.array([known.believed for known in self._coordinates])

    @property
    def low(self) -> Array:
        """The smallest values that they may have, shape (d,)."""
        return np.array([known.low for known in self._coordinates])

    @property
    def high(self) -> Array:
        """The largest values that they may have, shape (d,)."""
        return np.array([known.high for known in self._coordinates])

    def scaled(self, factor: float) -> Uncertainty:
        """Return the box with all ranges scaled about the believed values.

        Raises:
            InvalidInputError: A factor < 0, or so large that some robots cannot exist.
        """
        factor = as_number("factor", factor, minimum=0.0)
        return replace(self, factor=self.factor * factor)

    def largest_scale(self, bound: float) -> float:
        """Return the largest valid factor ≤ bound; focal lengths stay ≥ 1/10 of those believed."""
        for name, _, believed, least, _ in self._coordinates:
            if name == "camera focal_length" and least < believed:
                bound = min(bound, max(1.0, (1.0 - _LEAST_FOCAL) * believed / (believed - least)))
        low, high, factor = 0.0, bound, bound
        while high - low > 1e-6 * bound:
            try:
                self.scaled(factor)
                low = factor
            except InvalidInputError:
                high = factor
            factor = 0.5 * (low + high)
        return low

    def corners(self, limit: int = 64) -> Array:
        """Return the corners of the box, or a selection if they are many; shape (k, d).

        A coordinate without width has one end. The range of an angle wider than 45° is cut into
        equal pieces, whose ends count too. If there are more than `limit` corners, the result is,
        without repetition: the points with one coordinate at an end and the others at their
        believed values (whatever the limit), and random corners of a fixed seed, up to `limit`
        points in all.

        With a covariance, `limit` ends of conjugate axes of its ellipsoid are beside them: those
        that change the task's Jacobian most.

        Raises:
            InvalidInputError: A limit that is no integer ≥ 1.
        """
        as_integer("limit", limit, 1)
        if self._learnt is not None:
            box, axes = replace(self, covariance=None).corners(limit), self.factor * self._axes
            both = np.stack([axes, -axes], axis=1).reshape(-1, axes.shape[1])[:limit]
            rows = np.arange(max(len(box), len(both)))
            return np.hstack([box[rows % len(box)], both[rows % len(both)]])
        ends = [known.ends() for known in self._coordinates]
        if math.prod(map(len, ends)) <= limit:
            return np.array(list(itertools.product(*ends)), dtype=float)
        believed = tuple(self.believed.tolist())
        chosen = {
            (*believed[:i], end, *believed[i + 1 :]): None for i in range(self.d) for end in ends[i]
        }
        rng = np.random.default_rng(0)
        while len(chosen) < limit:
            chosen[tuple(each[rng.integers(len(each))] for each in ends)] = None
        return np.array(list(chosen))

    def sample(self, rng: np.random.Generator) -> Array:
        """Return values drawn uniformly from the box, and by the covariance; shape (d,)."""
        low, n = self.low, len(self._root)
        drawn = low + (self.high - low) * rng.random(self.d)  # rng.uniform takes its time
        drawn[self.d - n :] = self.factor * self._root.dot(rng.standard_normal(n))
        return drawn

    def at(self, units: Array) -> Array:
        """Return the values (N, d) of coordinates (N, d) that go from −1 to 1 over the set.

        Those of learnt numbers beyond the unit ball are of the nearest point on the ellipsoid.
        """
        low, high, n = self.low, self.high, len(self._root)
        values = 0.5 * (low + high) + 0.5 * (high - low) * units
        if n:
            ball = units[:, -n:]
            ball = ball / np.maximum(1.0, np.linalg.norm(ball, axis=1, keepdims=True))
            values[:, -n:] = self.factor * self._radius * ball @ self._root.T
        return np.asarray(values)

    def units_of(self, values: Array) -> Array:
        """Return coordinates (N, d) of which `at` makes values (N, d) of the set."""
        low, high, n = self.low, self.high, len(self._root)
        units = (values - 0.5 * (low + high)) / np.where(high > low, 0.5 * (high - low), 1.0)
        if n:
            size = max(self.factor * self._radius, _SMALL)
            units[:, -n:] = np.linalg.solve(self._root, values[:, -n:].T).T / size
        return np.asarray(units)

    # -- the robots ---------------------------------------------------------------------

    @property
    def makes_the_robots(self) -> bool:
        """True unless a subclass makes its own robots, which may differ in more than numbers."""
        own = type(self)
        return (own.plant, own.robot) == (Uncertainty.plant, Uncertainty.robot)

    def belief(self) -> Robot:
        """Return the believed robot, with the believed object."""
        return self._perturbation.base

    def believed_task(self) -> Task:
        """Return a new task of the believed robot, for a controller."""
        return self._task_of(self.belief(), self.camera)

    def robot(self, values: Sequence[float] | Array) -> Robot:
        """Return the true robot at values (d,); without errors the believed one itself."""
        values = self._checked(values)
        at = dict(zip(self.names, values.tolist(), strict=True))
        own = (known for known in self._coordinates if not known.name.startswith("camera "))
        if all(at[known.name] == known.believed for known in own):
            return self.belief()
        length, mass, shifts, turns = self._differences(values[np.newaxis])
        return self._perturbation.robot(float(length[0]), float(mass[0]), shifts[0], turns[0])

    def differences(
        self, values: Sequence[float] | Array
    ) -> tuple[tuple[float, float], dict[str, Array], dict[str, Array]]:
        """Return (length, mass) of the object; shifts and rotations of joints, each (3,)."""
        length, mass, shifts, turns = self._differences(self._checked(values)[np.newaxis])
        of_joints = shifts[0], map(pin.log3, turns[0])
        moved, turned = (dict(zip(self._joints, each, strict=True)) for each in of_joints)
        return (float(length[0]), float(mass[0])), moved, turned

    def changes(self, values: Array) -> Changes:
        """Return the parts of the true robots at values (N, d) that differ from the believed one.

        Of all joints as independent ones; in a hundredth of the time that N times `robot` takes.
        """
        return self._perturbation.changes(*self._differences(values))

    def _differences(self, values: Array) -> tuple[Array, Array, Array, Array]:
        """Return the arguments of `Perturbation.changes` of values (N, d)."""
        at = dict(zip(self.names, values.T, strict=True))
        none = np.zeros(len(values))
        held = (at.get(f"object_{n}", none + getattr(self, f"believed_{n}")) for n in _HELD)
        parts = itertools.product(("shift", "rotation"), self._joints, "xyz")
        places = [at.get(f"{joint} {kind} {axis}", none) for kind, joint, axis in parts]
        errors = np.array(places).reshape(2, -1, 3, len(values))
        shifts, rotations = np.moveaxis(errors, -1, 1).copy()
        turns = rotations_of(rotations)
        for each, learnt in zip((shifts, turns), self._errors(values), strict=False):
            for joint, error in learnt.items():
                each[:, self._joints.index(joint)] = error
        length, mass = held
        return length, mass, shifts, turns

    def plant(self, values: Sequence[float] | Array) -> Plant:
        """Return the true robot at values (d,), with its sensor and friction, in the box or not.

        Raises:
            InvalidInputError: Wrong shape, not finite, or a robot that cannot exist.
        """
        robot = self.robot(values)
        at = dict(zip(self.names, self._checked(values).tolist(), strict=True))
        camera = None if self.camera is None else self._true_camera(self.camera, at)
        return self.nominal._of(robot, self._task_of(robot, camera))

    @cached_property
    def nominal(self) -> Plant:
        """The plant without errors: the believed robot, with its sensor and friction."""
        return Plant(self.belief(), self.believed_task(), self.friction, drives=self.drives)

    def describe(self, values: Sequence[float] | Array) -> str:
        """Describe values (d,), such as "object length 0.3 m, camera roll 0.349 rad"."""
        values, n = self._checked(values), len(self._root)
        words = [*map(_described, self.names, values, self.units)]
        if self._learnt is not None:
            size = np.linalg.norm(np.linalg.solve(self._root, off := values[-n:]))
            most = words[self.d - n + int(np.abs(off / self._learnt.sd).argmax())]
            words[-n:] = [f"learnt numbers {size:.3g} sd off, most {most}"] if size > 0.0 else []
        return ", ".join(words) or "no error"

    def describe_box(self) -> str:
        """Describe the ranges, such as "object length 0 to 0.3 m"."""
        axes: dict[tuple[str, str, str], list[str]] = {}
        for name, unit, _, low, high in self._coordinates[: self.d - len(self._root)]:
            ends = (0.0 if abs(end) < _NONE * (high - low) else end for end in (low, high))
            least, most = (_described("", end, unit).strip() for end in ends)
            first, _, axis = name.rpartition(" ") if name[-2:] in _AXES else (name, "", "")
            joint, _, error = first.rpartition(" ") if axis else (first, "", "")
            size = f"{least.removesuffix(f' {unit}')} to {most}"
            axes.setdefault((label_of(joint), error, size), []).append(axis)
        alike: dict[tuple[str, str, str], list[str]] = {}  # joints, written once
        for (joint, error, size), of in axes.items():
            alike.setdefault((error, ", ".join(of), size), []).append(joint)
        shown = [" ".join(filter(None, (", ".join(of), *each))) for each, of in alike.items()]
        if (n := len(self._root)) > 0:
            shown.append(f"{n} learnt numbers up to {self.factor * self._radius:.3g} sd off")
        return ", ".join(shown) or "no error"

    def _checked(self, values: Sequence[float] | Array) -> Array:
        return as_vector("values", values, self.d, ", ".join(self.units))

    @cached_property
    def _learnt(self) -> Unknowns | None:
        if (belief := self.covariance) is None:
            return None
        require("covariance", belief, KinematicBelief, "a Calibration, or None")
        frame = next((each for each in belief.frames[::-1] if each in self.arm.frame_names), None)
        of = KinematicRegressor(self.arm, frame, axes="axes" in belief.kinds)
        learnt = Unknowns(of, belief.kinds, dict.fromkeys((*belief.kinds, "encoders"), 1.0), belief)
        off = np.abs(learnt.theta(learnt.u) - of.theta).max()
        if off > _SMALL or self.joint_shifts or self.joint_rotations:
            message = "arm must be the robot of the calibration, without joint_shifts and "
            message += f"joint_rotations, got {self.arm!r}, a number of which is {off:.2g} off"
            raise InvalidInputError(message, given=self.arm)
        return learnt

    @cached_property
    def _root(self) -> Array:
        """L with LLᵀ the covariance of the learnt numbers, shape (n, n)."""
        return np.zeros((0, 0)) if self._learnt is None else np.linalg.cholesky(self._learnt.P)

    @property
    def _radius(self) -> float:
        """√χ², after Wilson and Hilferty: of 1, 5 and 45 numbers within 2, 0.1 and 0.01 %."""
        share = 2.0 / (9.0 * len(self._root))
        root = 1.0 - share + NormalDist().inv_cdf(self.confidence) * math.sqrt(share)
        return math.sqrt(len(self._root) * max(root, 0.0) ** 3)

    @cached_property
    def _axes(self) -> Array:
        """Half axes of the ellipsoid, (k, n), first those by which the Jacobian changes most."""
        n, q = len(self._root), [*self.arm.configurations(_LOOKS)]
        off = (np.append(self.believed[:-n], e) for e in _STEP * np.vstack([np.eye(n), -np.eye(n)]))
        J = np.array([[of.jacobian(at) for at in q] for of in (self.plant(e).sensor for e in off)])
        S = np.nan_to_num(J[:n] - J[n:]).reshape(n, -1).T / (2.0 * _STEP)
        _, effects, W = np.linalg.svd(S @ self._root, full_matrices=False)
        return self._radius * (W[effects >= _SMALL * effects.max()] @ self._root.T)

    def _errors(self, values: Array) -> Sequence[dict[str, Array]]:
        """Return shifts and turns of joint origins by learnt numbers, the last of values (N, d)."""
        if (u := self._learnt) is None:
            return ()
        off = u.u + values[:, -len(u.u) :]
        return u.regressor.origins(np.array([u.theta(each) for each in off]))[:2]

    @cached_property
    def _joints(self) -> tuple[str, ...]:
        own = () if self._learnt is None else self._errors(self._learnt.sd[np.newaxis])
        return tuple(dict.fromkeys(itertools.chain(self.joint_shifts, self.joint_rotations, *own)))

    @cached_property
    def _perturbation(self) -> Perturbation:
        given = self.object_length is not None or self.object_mass is not None
        if not given and self.believed_length == 0.0 and self.believed_mass == 0.0:
            return Perturbation(self.arm, joints=self._joints)
        if "object_tip" in self.arm.frame_names:
            raise InvalidInputError(
                "arm must be without an object, which is added by object_length and object_mass, "
                f"got one that holds one: {self.arm!r}",
                given=self.arm,
            )
        held = self.believed_length, self.believed_mass
        return Perturbation(self.arm, held, self.object_axis, self._joints)

    def _true_camera(self, camera: Camera, at: Mapping[str, float]) -> Camera:
        """The camera at some values; the believed one itself where nothing is wrong with it."""
        wrong = {
            name: at[f"camera {name}"]
            for name, (believed, _) in camera.calibration.items()
            if at.get(f"camera {name}", believed) != believed
        }
        return camera.recalibrated(wrong) if wrong else camera

    @cached_property
    def _make_task(self) -> Callable[..., Task]:
        if self.task is None and self.camera is None:
            # the axes of the belief, as errors may let another arm command others
            return partial(PositionTask, axes=best_axes(self.belief()))
        return self.task or ImageTask

    def _task_of(self, robot: Robot, camera: Camera | None) -> Task:
        given = [robot] if camera is None else [robot, camera]
        try:
            task = self._make_task(*given)
        except TypeError as error:
            of = "" if camera is None else " and a camera, such as ImageTask"
            message = f"task must be a function of a robot{of}, got {self.task!r}: {error}"
            raise InvalidInputError(message, given=self.task) from error
        require("what task makes of a robot", task, Task, "a task, such as PositionTask(robot)")
        return task

    def __repr__(self) -> str:
        return f"Uncertainty({self.arm.name!r}: {self.describe_box()})"
