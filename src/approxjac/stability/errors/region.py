"""Regions of joint space: where the stability tests look."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from approxjac.controllers import Controller, SetpointController
from approxjac.errors import InvalidInputError
from approxjac.formatting import numbers, short
from approxjac.robots import Robot
from approxjac.simulation import Plant
from approxjac.tasks import Task
from approxjac.tasks.analysis import sees
from approxjac.validation import Array, as_entries, as_number, require

_TRIES = 1000
_THINNING = 25
_BURN_IN = 100  # steps until a walk has left its start
_BETWEEN = 4  # configurations along a step that have to be in the set


class Region(ABC):
    """A set of configurations that can be drawn from.

    Attributes:
        robot: A robot with the joints of the configurations.
        spread: Typical width along each joint, shape (n_v,) [rad or m].
        independent: Whether configurations are drawn independently of each other, uniformly.
    """

    robot: Robot
    spread: Array
    independent: bool = True

    @abstractmethod
    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Draw n configurations, shape (n, nq).

        Raises:
            InvalidInputError: The region is empty, as far as drawing can tell.
        """

    @abstractmethod
    def contains(self, q: Array) -> bool:
        """Return whether a configuration (nq,) belongs to the region."""

    def near(self, q: Array, size: float, rng: np.random.Generator) -> Array:
        """Return a configuration of the region about `size` spreads away from one of its own, q."""
        for _ in range(20):
            moved = self._moved(q, size * self.spread * rng.standard_normal(self.robot.nv))
            if self.contains(moved):
                return moved
        return q

    def _moved(self, q: Array, motion: Array) -> Array:
        return np.array(pin.integrate(self.robot.model, q, motion))

    def _away(self, q: Array, other: Array) -> Array:
        """Motion (n_v,) from a configuration to another one, which may be given as angles."""
        other = other if np.shape(other) == (self.robot.nq,) else self.robot.configuration(other)
        return np.asarray(pin.difference(self.robot.model, q, other))


class JointBox(Region):
    """Configurations between two bounds of every joint.

    Args:
        robot: True or believed.
        lower: Smallest motion from `center`, a number or shape (n_v,) [rad or m]; by default the
            lower joint limits, where `center` must not be given.
        upper: Largest motion from `center`; by default the upper joint limits. Of a range wider
            than a turn or than 2 m, or without limits, `Robot.random_configuration` tells the part
            that is used.
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
            self.lower, self.upper = robot.usual_range()
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
        self.center = self._moved(self.center, middle)
        self.lower, self.upper = self.lower - middle, self.upper - middle
        self.spread = self.upper - self.lower

    @classmethod
    def around(
        cls, robot: Robot, q: Sequence[float] | Array, radius: float | Sequence[float] | Array
    ) -> JointBox:
        """Return the box of all configurations whose joints are within `radius` [rad or m] of q."""
        radius = as_entries("radius", radius, robot.nv, "rad")
        robot.require_radians("q", robot.configuration(q))
        return cls(robot, -radius, radius, q)

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        # as rng.uniform, which takes its time
        motions = self.lower + self.spread * rng.random((n, self.robot.nv))
        if self.robot.nq == self.robot.nv:
            return np.asarray(self.center + motions)
        return np.array([self._moved(self.center, motion) for motion in motions])

    def contains(self, q: Array) -> bool:
        motion = self._away(self.center, q)
        return bool((self.lower - 1e-12 <= motion).all() and (motion <= self.upper + 1e-12).all())

    def __str__(self) -> str:
        if self._whole:
            return "all configurations within the joint limits"
        radius, unit = 0.5 * self.spread, "rad" if set(self.robot.joint_units) == {"rad"} else ""
        away = f"{numbers(radius)} {unit or 'rad or m'}" + (" each" if np.ptp(radius) else "")
        center = numbers(self.robot.angles(self.center))
        return f"configurations whose joints are within {away} of {center}"

    def __repr__(self) -> str:
        bounds = f"{self.robot.name!r}, {short(self.lower)}, {short(self.upper)}"
        is_off = self._away(self.robot.neutral(), self.center).any()
        center = f", center={short(self.robot.angles(self.center))}" if is_off else ""
        return f"JointBox({bounds}{center})"


class Tube(Region):
    """Configurations near those of a recorded trajectory.

    Args:
        robot: True or believed.
        configurations: Recorded ones, shape (N, nq), such as `Trajectory.q`.
        radius: How far each joint may be from one of them > 0, a number or shape (n_v,).

    Raises:
        InvalidInputError: Wrong shapes, no configuration, or a radius that is not positive.
    """

    def __init__(
        self, robot: Robot, configurations: Array, radius: float | Sequence[float] | Array = 0.05
    ) -> None:
        require("robot", robot, Robot, "a Robot")
        self.robot = robot
        if np.ndim(configurations) != 2 or len(configurations) == 0:
            raise InvalidInputError(
                f"configurations must be of shape (N, {robot.nq}) with N > 0, got shape "
                f"{np.shape(configurations)}",
                given=configurations,
            )
        self.configurations = np.array(
            [robot.configuration(q, "each configuration") for q in configurations]
        )
        self.spread = as_entries("radius", radius, robot.nv)
        if not (self.spread > 0.0).all():
            raise InvalidInputError(
                f"radius must be > 0 in every joint, or the region is empty, got {radius!r}",
                given=radius,
            )

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        known = self.configurations[rng.integers(len(self.configurations), size=n)]
        motions = rng.uniform(-self.spread, self.spread, (n, self.robot.nv))
        return np.array(list(map(self._moved, known, motions)))

    def contains(self, q: Array) -> bool:
        return any(
            bool((np.abs(self._away(known, q)) <= self.spread).all())
            for known in self.configurations
        )

    def __str__(self) -> str:
        within = f"within {numbers(self.spread)} of one of {len(self.configurations)} known ones"
        return f"configurations whose joints are {within}"

    def __repr__(self) -> str:
        return f"Tube({self.robot.name!r}, {len(self.configurations)} configurations)"


class SublevelSet(Region):
    """Configurations that the potential lets the arm reach from a start.

    {q : V(q, 0) ≤ V(q₀, 0)} within the joint limits, with V of eq. (12) for α → 0, which is its
    potential Σ k_p S(e). It is the part connected with the start, drawn from by a random walk, so
    that its configurations are not independent. A motion of this plant that starts at rest in q₀
    and along which this V falls stays in it, as long as a camera sees it; another true robot may
    leave it.

    Args:
        plant: The true robot.
        controller: The controller, for its gains and Ĵ.
        target: x_d, shape (n_x,).
        q0: Start, shape (nq,).

    Raises:
        InvalidInputError: A start outside the limits or not seen by the sensor, or wrong shapes.
    """

    independent = False

    def __init__(
        self,
        plant: Plant,
        controller: SetpointController,
        target: Sequence[float] | Array,
        q0: Sequence[float] | Array,
    ) -> None:
        require("plant", plant, Plant, "a Plant")
        require_setpoint(controller)
        plant.require_task(controller.task)
        self.robot = plant.robot
        self.within = JointBox(plant.robot)
        self._plant, self._controller = plant, controller
        self._target = plant.sensor.target(target)
        self.start = plant.robot.configuration(q0, "q0")
        if not self.within.contains(self.start):
            raise InvalidInputError(
                f"q0 must be in {self.within!r}, or the region is empty, got {self.start.tolist()}",
                given=q0,
            )
        require_seen("q0", self.start, plant.sensor)
        self.level = self._potential(self.start)
        self.spread = self.within.spread

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        walk = [self.start]
        for _ in range(_BURN_IN + n * _THINNING):
            walk.append(self._step(walk[-1], rng))
        return np.array(walk[_BURN_IN + _THINNING :: _THINNING])

    def contains(self, q: Array) -> bool:
        seen = self.within.contains(q) and sees(self._plant.sensor, q)
        return seen and self._potential(q) <= self.level

    def _step(self, q: Array, rng: np.random.Generator) -> Array:
        size = 10.0 ** rng.uniform(-2.5, -0.5)  # a symmetric step: the walk is uniform
        motion = size * self.spread * rng.standard_normal(self.robot.nv)
        for share in np.linspace(0.0, 1.0, _BETWEEN + 1)[1:]:  # no jumps to another part
            moved = self._moved(q, share * motion)
            if not self.contains(moved):
                return q
        return moved

    def _potential(self, q: Array) -> float:
        """V(q, 0)."""
        e = self._plant.sensor.error(self._plant.sensor.value(q), self._target)
        return float(self._controller.diagonals.kp @ self._controller.saturation.S(e))

    def __str__(self) -> str:
        return f"what V lets the arm get to from {numbers(self.start)} (V <= {self.level:.4g} J)"

    def __repr__(self) -> str:
        return f"SublevelSet({self.robot.name!r}, V <= {self.level:.4g} J)"


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
        self.robot, self.spread = region.robot, region.spread
        self.independent = region.independent
        self.region, self.task = region, task
        self.sigma_min = as_number("sigma_min", sigma_min, minimum=0.0)

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
        return self._is_regular(q) and self.region.contains(q)

    def _is_regular(self, q: Array) -> bool:
        return bool(np.linalg.svd(self.task.jacobian(q), compute_uv=False)[-1] >= self.sigma_min)

    def __str__(self) -> str:
        return f"{self.region}, where sigma_min >= {self.sigma_min:.3g}"

    def __repr__(self) -> str:
        return f"RegularPart({self.region!r}, sigma_min >= {self.sigma_min:g})"


def require_setpoint(controller: SetpointController) -> None:
    """Refuse anything else, such as a controller that limits it or holds measurements for it."""
    given: Any = controller
    if isinstance(given, Controller) and given.kinematics is not None:
        raise InvalidInputError(
            "controller must be a SetpointController: a TrackingController learns its Jacobian, "
            "and no test covers that over a region; use rollouts to see how often it converges; "
            f"got {controller!r}",
            given=controller,
        )
    wanted = "a SetpointController (controller.law is the one inside of its wrappers)"
    require("controller", controller, SetpointController, wanted)


def require_law(controller: SetpointController, *, alone: bool = True) -> None:
    """Refuse a controller whose torque is not that of the laws (6) or (28); `alone`: or with more.

    More is a posture torque, or the velocity of law (5).
    """
    require_setpoint(controller)
    kind, laws = type(controller), "the conditions are those of the laws (6) and (28)"
    names = ("evaluate", "step")
    own = [name for name in names if getattr(kind, name) is not getattr(SetpointController, name)]
    if own:
        raise InvalidInputError(
            f"{laws}, and {kind.__name__} has another {' and '.join(own)}; rollouts judge any law; "
            f"got {controller!r}",
            given=controller,
        )
    if alone and (controller.velocity is not None or controller.posture is not None):
        raise InvalidInputError(
            f"{laws} without a posture torque, got {controller!r} with "
            f"velocity = {controller.velocity!r} and posture = {controller.posture!r}",
            given=controller,
        )


def uncovered(controller: Controller) -> str:
    """Return why no certificate is for a controller, or for the law within its limits; or ""."""
    law: Any = controller.limited_law or controller
    try:
        require_law(law)
    except InvalidInputError as error:
        return str(error).split("; got ")[0].split(", got ")[0]
    return ""


def require_seen(name: str, q: Array, sensor: Task) -> None:
    """Raise if a sensor does not see a configuration (nq,)."""
    if not sees(sensor, q):
        raise InvalidInputError(
            f"{name} must be a configuration that the sensor sees, or no law acts there, got "
            f"{q.tolist()} with {sensor!r}",
            given=q,
        )
