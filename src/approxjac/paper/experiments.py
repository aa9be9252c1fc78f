"""The paper's simulations: arm, camera, what is believed of both, gains, and what is left open."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from approxjac.cameras import PlanarCamera
from approxjac.controllers import AdaptiveGravity, Gains, RegressorGravity, SetpointController
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.law import Linear, Sine
from approxjac.robots import GravityRegressor, Robot, load_robot
from approxjac.simulation import Plant
from approxjac.tasks import ImageTask
from approxjac.validation import as_array, as_number

Verdict = Literal["stable", "unstable"]
Inertia = Literal["rod", "point-mass"]

LENGTHS = (1.0, 1.0, 0.5)
"""l₁, l₂ and l_o of the true arm [m]."""
OBJECT_MASS = 0.5
"""m_o [kg], believed too; the links' masses are in urdf/two_link.urdf."""
CAMERA = PlanarCamera(focal_length=0.05, distance=3.0)
"""The true camera."""
LEARNING_GAIN, ALPHA = 0.12, 1.0
"""L = 0.12 I and α [1/s] where gravity is learnt."""
_ROLLED = PlanarCamera(focal_length=0.05, distance=3.0, roll=math.radians(60.0))
_ALL_WRONG = PlanarCamera(focal_length=0.1, distance=4.0, roll=math.radians(60.0))
_WRONG_LENGTHS = (0.75, 1.25, 0.0)


@dataclass(frozen=True)
class Experiment:
    """One of the paper's simulations."""

    figure: int
    title: str
    camera: PlanarCamera  # believed
    lengths: tuple[float, float, float]  # believed l̂₁, l̂₂, l̂_o [m]
    kp: float  # K_p = kp I [N/m]
    kv: float  # K_v = kv I [N s/m]
    paper_says: Verdict
    paper_words: str
    learn_gravity: bool = False  # θ̂ starts at zero, with `LEARNING_GAIN` and `ALPHA`


EXPERIMENTS: Mapping[int, Experiment] = {
    e.figure: e
    for e in (
        Experiment(
            3, "camera roll wrong by 60°, a = 1", _ROLLED, LENGTHS, 5000.0, 5000.0,
            "unstable", "an unstable response",
        ),
        Experiment(
            4, "a reduced to 0.5 by a larger K_v", _ROLLED, LENGTHS, 5000.0, 10000.0,
            "stable", "a stable response",
        ),
        Experiment(
            5, "a reduced to 0.5 by a smaller K_p", _ROLLED, LENGTHS, 2500.0, 5000.0,
            "stable", "a stable response",
        ),
        Experiment(
            6, "lengths of links and object wrong", CAMERA, _WRONG_LENGTHS, 5000.0, 5000.0,
            "stable", "Effect of Uncertain Kinematics",
        ),
        Experiment(
            7, "camera and lengths wrong", _ALL_WRONG, _WRONG_LENGTHS, 5000.0, 30000.0,
            "stable", "a stable response",
        ),
        Experiment(
            8, "camera and lengths wrong, gravity learnt", _ALL_WRONG, _WRONG_LENGTHS,
            5000.0, 30000.0, "stable", "the result of using a regressor", learn_gravity=True,
        ),
    )
}  # fmt: skip


@dataclass(frozen=True)
class Setup:
    """Choices that the paper leaves open; the default ones give every verdict of the paper.

    Attributes:
        start: q(0) [rad].
        target: Configuration whose image is the target X_d [rad].
        friction: B, the same at both joints [N m s/rad].
        gamma: γ of s(e) = γ sin(e/γ) [m on the sensor]; None is s(e) = e.
        inertia: Uniform rods, or point masses at the middles of the rods.
        duration: Length of each run [s].

    Raises:
        InvalidInputError: Numbers out of range, or start and target with the same image.
        UnknownNameError: Another kind of inertia.
    """

    start: tuple[float, float] = (math.radians(60.0), math.radians(90.0))
    target: tuple[float, float] = (math.radians(90.0), math.radians(90.0))
    friction: float = 0.0
    gamma: float | None = None
    inertia: Inertia = "rod"
    duration: float = 120.0

    def __post_init__(self) -> None:
        start = as_array("start", self.start, (2,), "rad")
        target = as_array("target", self.target, (2,), "rad")
        as_number("friction", self.friction, unit="N m s/rad", minimum=0.0)
        as_number("duration", self.duration, unit="s", above=0.0)
        if self.gamma is not None:
            as_number("gamma", self.gamma, unit="m", above=0.0)
        if self.inertia not in ("rod", "point-mass"):
            raise UnknownNameError("inertia", self.inertia, "the study", ["rod", "point-mass"])
        image = ImageTask(build_arm(inertia=self.inertia), CAMERA)
        if float(np.linalg.norm(image.value(start) - image.value(target))) < 1e-9:
            raise InvalidInputError(
                "start must not have the image of the target already, got start = "
                f"{start.tolist()} and target = {target.tolist()} [rad]",
                given=self.start,
            )


def build_arm(lengths: tuple[float, float, float] = LENGTHS, inertia: Inertia = "rod") -> Robot:
    """Return the arm of lengths l₁, l₂, l_o [m] with the object, the true or a believed one."""
    l1, l2, lo = lengths
    shifts = {"joint2": (l1 - LENGTHS[0], 0.0, 0.0), "tool0_joint": (l2 - LENGTHS[1], 0.0, 0.0)}
    if inertia == "rod":
        arm = load_robot("two_link").with_kinematic_error(shifts)
        return arm.with_object(lo, OBJECT_MASS, radius=0.0, axis="x")
    # a massless rod in two halves with a point mass between them
    arm = load_robot("two_link_point_mass").with_kinematic_error(shifts)
    half = arm.with_object(lo / 2.0, axis="x", name="object_near")
    weighted = half.with_object(0.0, OBJECT_MASS, radius=0.0, name="object_mass")
    return weighted.with_object(lo / 2.0, axis="x", name="object")


def build(experiment: Experiment, setup: Setup) -> tuple[Plant, SetpointController]:
    """Return the plant and the controller of one experiment.

    Gravity is known in Figures 3–7, as the paper assumes: as Z(q)θ, eq. (27), with the true
    θ but the believed robot's Z, so that the true lengths stay out of the controller.
    """
    truth = build_arm(inertia=setup.inertia)
    belief = build_arm(experiment.lengths, setup.inertia)
    regressor = GravityRegressor(belief, moments="x")
    gravity: AdaptiveGravity | RegressorGravity
    if experiment.learn_gravity:
        gravity = AdaptiveGravity(regressor, L=LEARNING_GAIN, alpha=ALPHA, theta0=np.zeros(2))
    else:
        gravity = RegressorGravity(regressor, GravityRegressor(truth, moments="x").theta)
    controller = SetpointController(
        ImageTask(belief, experiment.camera),
        Gains(kp=experiment.kp, kv=experiment.kv),
        gravity=gravity,
        saturation=Linear() if setup.gamma is None else Sine(setup.gamma),
    )
    return Plant(truth, ImageTask(truth, CAMERA), friction=setup.friction), controller
