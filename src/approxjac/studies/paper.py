"""The paper's two-link study: Figures 1 and 3–8, from the URDF through Pinocchio.

The paper leaves the start, the target, the inertias, s(e) and B open. The defaults of `Setup` are
one choice under which a single start gives every verdict of the paper.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from approxjac import law
from approxjac.controllers import (
    AdaptiveGravity,
    Gains,
    RegressorGravity,
    SetpointController,
)
from approxjac.errors import InvalidInputError, UnknownNameError
from approxjac.law import Linear, Saturation, Sine
from approxjac.robots import GravityRegressor, Robot, load_robot
from approxjac.simulation import Plant, Trajectory, simulate
from approxjac.stability import LocalStability, local_stability
from approxjac.tasks import ImageTask, PlanarCamera
from approxjac.validation import Array, as_array, as_number

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
REPORT_TIMES = (5.0, 20.0, 60.0, 120.0)
"""Times at which error ratios are reported [s]."""
_ROLLED = PlanarCamera(focal_length=0.05, distance=3.0, roll=math.radians(60.0))
_ALL_WRONG = PlanarCamera(focal_length=0.1, distance=4.0, roll=math.radians(60.0))
_WRONG_LENGTHS = (0.75, 1.25, 0.0)


@dataclass(frozen=True)
class Experiment:
    """One of the paper's simulations.

    Attributes:
        figure: Its number in the paper.
        title: What it shows.
        camera: Believed camera.
        lengths: Believed l̂₁, l̂₂, l̂_o [m].
        kp: K_p = kp I [N/m].
        kv: K_v = kv I [N s/m].
        learn_gravity: Whether θ̂ starts at zero and is learnt, with `LEARNING_GAIN` and `ALPHA`.
        paper_says: The paper's verdict.
        paper_words: The paper's words.
    """

    figure: int
    title: str
    camera: PlanarCamera
    lengths: tuple[float, float, float]
    kp: float
    kv: float
    paper_says: Verdict
    paper_words: str
    learn_gravity: bool = False


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
    """What the paper leaves open.

    Attributes:
        start: q(0) [rad].
        target: Posture whose image is the target X_d [rad].
        friction: B, the same at both joints [N m s/rad].
        gamma: γ of s(e) = γ sin(e/γ) [m on the sensor]; None is s(e) = e.
        inertia: "rod" for uniform rods, "point-mass" for masses at the middles of the rods.
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
        object.__setattr__(self, "start", tuple(start.tolist()))
        object.__setattr__(self, "target", tuple(target.tolist()))


@dataclass(frozen=True, eq=False)
class Result:
    """One experiment, run.

    Attributes:
        experiment: What was run.
        run: What happened.
        local: The exact linearisation at the target.
        theta_hat: θ̂ at the end, shape (2,); None where gravity is known.
    """

    experiment: Experiment
    run: Trajectory
    local: LocalStability
    theta_hat: Array | None

    @property
    def settles(self) -> bool:
        """Whether the run's error dies down.

        It does when the largest error of its last quarter is below the start and 5 % below that
        of the quarter before, and the last eighth is below the eighth before; or when the error
        is all but gone.
        """
        norm = self.run.error_norm / self.run.error_norm[0]
        before, last = np.array_split(norm, 4)[2:]
        early, late = np.array_split(last, 2)
        falls = last.max() < 0.95 * before.max() and late.max() < early.max()
        return bool(last.max() < 1e-6 or (falls and last.max() < 1.0))

    @property
    def evidence_agrees(self) -> bool:
        """Whether the linearisation and the run say the same."""
        return self.local.stable == self.settles

    @property
    def verdict(self) -> Verdict:
        """Stable if the linearisation and the run both say so."""
        return "stable" if self.local.stable and self.settles else "unstable"

    @property
    def reason(self) -> str:
        """What the verdict rests on; says so where linearisation and run differ."""
        run = "the run's error " + ("falls" if self.settles else "does not fall")
        if self.local.singular:
            return (
                f"the target is a singular posture, where the linearisation decides nothing; {run}"
            )
        text = f"max Re λ = {self.local.max_real_eigenvalue:+.4f}, {run}"
        if self.local.stable and not self.settles:
            text += "; they differ: the run may be too short, or end elsewhere than at the target"
        if not self.local.stable and self.settles:
            text += (
                "; they differ: the run may be too short to show the growth, or end elsewhere than "
                "at the target"
            )
        return text

    @property
    def agrees_with_paper(self) -> bool:
        """Whether the verdict is the paper's."""
        return self.verdict == self.experiment.paper_says

    @property
    def error_ratios(self) -> dict[float, float]:
        """‖e(t)‖ / ‖e(0)‖ at the `REPORT_TIMES` that the run reaches."""
        reached = [t for t in REPORT_TIMES if t <= self.run.t[-1] + 1e-9]
        return {t: self.run.error_ratio(t) for t in reached}


def build_arm(lengths: tuple[float, float, float] = LENGTHS, inertia: Inertia = "rod") -> Robot:
    """Return the arm holding the object; the true one, or one that is believed to be.

    Args:
        lengths: l₁, l₂ and l_o [m].
        inertia: "rod" or "point-mass".
    """
    l1, l2, lo = lengths
    point_masses = inertia == "point-mass"
    arm = load_robot("two_link_point_mass" if point_masses else "two_link").with_kinematic_error(
        {"joint2": (l1 - LENGTHS[0], 0.0, 0.0), "tool0_joint": (l2 - LENGTHS[1], 0.0, 0.0)}
    )
    if not point_masses:
        return arm.with_object(lo, OBJECT_MASS, radius=0.0, axis="x")
    # a massless rod in two halves with a point mass between them
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
    plant = Plant(truth, ImageTask(truth, CAMERA), friction=setup.friction)
    regressor = GravityRegressor(belief, moments="x")
    saturation: Saturation = Linear() if setup.gamma is None else Sine(setup.gamma)
    controller = SetpointController(
        ImageTask(belief, experiment.camera),
        Gains(kp=experiment.kp, kv=experiment.kv),
        gravity=(
            AdaptiveGravity(regressor, L=LEARNING_GAIN, alpha=ALPHA, theta0=np.zeros(2))
            if experiment.learn_gravity
            else RegressorGravity(regressor, GravityRegressor(truth, moments="x").theta)
        ),
        saturation=saturation,
    )
    return plant, controller


def run_experiment(
    experiment: Experiment,
    setup: Setup,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Simulate one experiment as one differential equation and judge it.

    Args:
        experiment: One of `EXPERIMENTS`.
        setup: What the paper leaves open.
        progress: Called now and then with the time reached [s].
    """
    plant, controller = build(experiment, setup)
    q_target = np.array(setup.target)
    run = simulate(
        plant,
        controller,
        target=plant.sensor.value(q_target),
        q0=setup.start,
        duration=setup.duration,
        dt=None,
        # at most 50 ms, whatever the duration: error ratios are read between the records
        record_every=setup.duration / max(2400, math.ceil(setup.duration / 0.05)),
        progress=progress,
    )
    theta_hat = controller.theta_hat(run.state)[-1] if experiment.learn_gravity else None
    return Result(experiment, run, local_stability(plant, controller, q_target), theta_hat)


@dataclass(frozen=True, eq=False)
class JacobianBound:
    """Figure 1: how large the Jacobian error may be, for Figure 4's controller at the target.

    Attributes:
        lambda2: λ₂ = λ_min[ĴᵀĴ + B/k_v] of (23).
        alpha: λ₂^½, which allows the largest p.
        a: Gain ratios k_p/k_v, shape (N,) [1/s].
        velocity: 2λ₂/(a + α), shape (N,).
        position: 2aα/(a + α), shape (N,).
        largest: λ₂^½, the largest p that (23) allows for any a and α: (25).
        at_own_a: The largest p that (23) allows for any α at that controller's a.
        p: ‖Jᵀ − Ĵᵀ‖ of that controller there.
    """

    lambda2: float
    alpha: float
    a: Array
    velocity: Array
    position: Array
    largest: float
    at_own_a: float
    p: float

    @property
    def condition_23_met(self) -> bool:
        """Whether (23) holds for some α; Theorem 1 asks for (14) and (22) besides."""
        return self.p < self.at_own_a


def jacobian_bound(setup: Setup) -> JacobianBound:
    """Evaluate the two curves of Figure 1 on the true and believed arm of Figure 4."""
    experiment = EXPERIMENTS[4]
    plant, controller = build(experiment, setup)
    q = np.array(setup.target)
    J_hat = controller.task.jacobian(q)
    lambda2 = law.lambda_2(J_hat, plant.friction / experiment.kv)
    alpha = math.sqrt(lambda2)
    a = np.linspace(0.0, max(4.0 * alpha, 1e-12), 400)[1:]
    return JacobianBound(
        lambda2,
        alpha,
        a,
        law.allowed_p_velocity(a, alpha, lambda2),
        law.allowed_p_position(a, alpha),
        law.largest_allowed_p(lambda2),
        # for a given a the curves cross at α = λ₂/a, and there their minimum is largest
        law.allowed_p_at_crossing(lambda2 * experiment.kv / experiment.kp, lambda2),
        law.jacobian_error(plant.sensor.jacobian(q), J_hat),
    )
