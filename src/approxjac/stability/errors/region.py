"""Regions of joint space for stability tests."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np

from approxjac import law
from approxjac.controllers import Controller, SetpointController
from approxjac.errors import InvalidInputError
from approxjac.formatting import numbers, short
from approxjac.law.factors import Factors
from approxjac.robots import Robot
from approxjac.robots.traced import motion_between, moved
from approxjac.tasks import Task
from approxjac.tasks.analysis import sees
from approxjac.validation import Array, as_entries, as_number, require

_TRIES = 1000


class Region(ABC):
    """A set of configurations that can be sampled.

    Attributes:
        robot: A robot with the joints of the configurations.
    """

    robot: Robot

    @abstractmethod
    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Draw n configurations, shape (n, nq).

        Raises:
            InvalidInputError: The region is empty, as far as drawing can tell.
        """

    @property
    def box(self) -> JointBox:
        """A box of joints that holds the region."""
        return JointBox(self.robot)

    @abstractmethod
    def contains(self, q: Array) -> bool:
        """Return True if a configuration (nq,) belongs to the region; lanes trace it."""

    def _away(self, q: Array, other: Array) -> Array:
        other = other if np.shape(other) == (self.robot.nq,) else self.robot.configuration(other)
        return motion_between(self.robot, q, other)


class JointBox(Region):
    """Configurations between two bounds of every joint.

    Args:
        robot: True or believed.
        lower: Smallest motion from `center`, a number or shape (n_v,) [rad or m]; by default the
            lower joint limits, where `center` must not be given.
        upper: Largest motion from `center`; by default the upper joint limits. Ranges wider than a
            turn or 2 m, or without limits, are reduced to `Robot.usual_range`.
        center: Configuration that motions are counted from, shape (nq,); all joints at zero by
            default.

    Raises:
        InvalidInputError: Wrong shapes, not finite, or an empty box.
    """

    def __init__(
        self,
        robot: Robot,
        lower: float | Sequence[float] | Array | None = None,
        upper: float | Sequence[float] | Array | None = None,
        center: Sequence[float] | Array | None = None,
    ) -> None:
        require("robot", robot, Robot, "a Robot")
        self.robot = robot
        if (lower is None) != (upper is None) or (lower is None and center is not None):
            raise InvalidInputError(
                "lower and upper must both be given, or neither they nor a center, "
                f"got {lower!r}, {upper!r} and {center!r}",
                given=(lower, upper, center),
            )
        self.center = robot.neutral() if center is None else robot.configuration(center, "center")
        self._whole = lower is None
        if lower is None or upper is None:
            self.lower, self.upper = robot.usual_range
        else:
            self.lower = as_entries("lower", lower, robot.nv)
            self.upper = as_entries("upper", upper, robot.nv)
        if not (self.lower <= self.upper).all():
            raise InvalidInputError(
                "lower must be at most upper in every joint, or the region is empty, got "
                f"{self.lower.tolist()} and {self.upper.tolist()}",
                given=(lower, upper),
            )
        # about its middle: differences of continuous joints go half a turn to either side
        middle = 0.5 * (self.lower + self.upper)
        self.center = moved(robot, self.center, middle)
        self.lower, self.upper = self.lower - middle, self.upper - middle

    @classmethod
    def around(
        cls, robot: Robot, q: Sequence[float] | Array, radius: float | Sequence[float] | Array
    ) -> JointBox:
        """Return the box of all configurations whose joints are within `radius` [rad or m] of q."""
        radius = as_entries("radius", radius, robot.nv, "rad")
        robot.require_radians("q", robot.configuration(q))
        return cls(robot, -radius, radius, q)

    @property
    def box(self) -> JointBox:
        return self

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        # as rng.uniform, which takes its time
        motions = self.lower + (self.upper - self.lower) * rng.random((n, self.robot.nv))
        if self.robot.nq == self.robot.nv:
            return np.asarray(self.center + motions)
        return np.array([moved(self.robot, self.center, motion) for motion in motions])

    def contains(self, q: Array) -> bool:
        away = np.abs(self._away(self.center, q))
        return law.all_of(away <= self.upper + 1e-12)  # lower is −upper

    def __str__(self) -> str:
        if self._whole:
            return "all configurations within the joint limits"
        radius, unit = self.upper, "rad" if set(self.robot.joint_units) == {"rad"} else ""
        away = f"{numbers(radius)} {unit or 'rad or m'}" + (" each" if np.ptp(radius) else "")
        center = numbers(self.robot.angles(self.center))
        return f"configurations whose joints are within {away} of {center}"

    def __repr__(self) -> str:
        bounds = f"{self.robot.name!r}, {short(self.lower)}, {short(self.upper)}"
        is_off = self._away(self.robot.neutral(), self.center).any()
        center = f", center={short(self.robot.angles(self.center))}" if is_off else ""
        return f"JointBox({bounds}{center})"


class RegularPart(Region):
    """The configurations of a region where the believed task is not near singular.

    Args:
        region: The region.
        task: The believed task.
        sigma_min: Smallest singular value that Ĵ must have [unit of the task/rad].

    Raises:
        InvalidInputError: A bound that is negative or not finite.
    """

    def __init__(self, region: Region, task: Task, sigma_min: float) -> None:
        require("region", region, Region, "a Region, such as JointBox(robot)")
        require("task", task, Task, "a task of the believed robot, such as PositionTask(robot)")
        self.robot, self.region, self.task = region.robot, region, task
        self.sigma_min = as_number("sigma_min", sigma_min, minimum=0.0)

    @property
    def box(self) -> JointBox:
        return self.region.box

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        drawn: list[Array] = []
        tried = 0
        while len(drawn) < n:
            batch = self.region.sample(max(n - len(drawn), 20), rng)
            tried += len(batch)
            drawn += itertools.islice(filter(self._is_regular, batch), n - len(drawn))
            if tried > _TRIES * (len(drawn) + 1):
                raise InvalidInputError(
                    f"sigma_min must be smaller, or the region is empty: {len(drawn)} of {tried} "
                    f"drawn of {self.region} have it, got {self.sigma_min:g}",
                    given=self.sigma_min,
                )
        return np.array(drawn)

    def contains(self, q: Array) -> bool:
        return self._is_regular(q) & self.region.contains(q)

    def _is_regular(self, q: Array) -> bool:
        J = self.task.jacobian(q)
        if type(J) is np.ndarray:
            return bool(np.linalg.svd(J, compute_uv=False)[-1] >= self.sigma_min)
        G = J @ J.T if J.shape[0] <= J.shape[1] else J.T @ J
        pivots = Factors(G - self.sigma_min**2 * np.eye(len(G))).pivots
        return law.all_of(law.array(pivots) > 0.0)  # one is not, where an eigenvalue is not

    def __str__(self) -> str:
        return f"{self.region}, where sigma_min >= {self.sigma_min:.3g}"

    def __repr__(self) -> str:
        return f"RegularPart({self.region!r}, sigma_min >= {self.sigma_min:g})"


def require_setpoint(controller: Any) -> SetpointController:
    """Return a set-point law; raise an InvalidInputError for anything else, as a wrapper."""
    wanted = "a SetpointController, which learns no Jacobian (controller.law is within wrappers)"
    return require("controller", controller, SetpointController, wanted)


def require_law(controller: Controller) -> SetpointController:
    """Return law (6) or (28) without posture; raise an InvalidInputError for anything else."""
    controller = require_setpoint(controller)
    kind, laws = type(controller), "the conditions are those of the laws (6) and (28)"
    names = ("evaluate", "step")
    own = [name for name in names if getattr(kind, name) is not getattr(SetpointController, name)]
    if own:
        raise InvalidInputError(
            f"{laws}, and {kind.__name__} has another {' and '.join(own)}; rollouts judge any law; "
            f"got {controller!r}",
            given=controller,
        )
    if controller.velocity is not None or controller.posture is not None:
        raise InvalidInputError(
            f"{laws} without a posture torque, got {controller!r} with "
            f"velocity = {controller.velocity!r} and posture = {controller.posture!r}",
            given=controller,
        )
    if controller.friction is not None and controller.friction.known is not None:
        raise InvalidInputError(
            f"{laws} without a friction compensation that is given a friction, which acts as a "
            f"relay on joints that do not rub, got {controller.friction!r}",
            given=controller,
        )
    return controller


def uncovered(controller: Controller) -> str:
    """Return the reason why a controller, or its limited law, has no certificate; or ""."""
    try:
        require_law(controller.limited_law or controller)
    except InvalidInputError as error:
        return str(error).split("; got ")[0].split(", got ")[0]
    return ""


def require_seen(name: str, q: Array, sensor: Task) -> None:
    """Raise an InvalidInputError if a sensor does not see x at a configuration (nq,)."""
    if not sees(sensor, q):
        raise InvalidInputError(
            f"{name} must be a configuration that the sensor sees, or no law acts there, got "
            f"{q.tolist()} with {sensor!r}",
            given=q,
        )
