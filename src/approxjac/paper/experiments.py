"""The paper's simulations: beliefs, start and target, which the paper leaves open, and results."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from approxjac import law
from approxjac.cameras import PlanarCamera
from approxjac.controllers import AdaptiveGravity, Gains, RegressorGravity, SetpointController
from approxjac.law import Linear
from approxjac.robots import GravityRegressor, Robot, load_robot
from approxjac.simulation import Computation, Plant, Trajectory, simulate
from approxjac.stability import LocalStability, local_stability
from approxjac.tasks import ImageTask
from approxjac.validation import Array, as_number

Verdict = Literal["stable", "unstable"]

LENGTHS = (1.0, 1.0, 0.5)  # l₁, l₂ and l_o of the true arm [m]
OBJECT_MASS = 0.5  # m_o [kg], believed too; the links' masses are in urdf/two_link.urdf
CAMERA = PlanarCamera(focal_length=0.05, distance=3.0)  # the true camera
LEARNING_GAIN, ALPHA = 0.12, 1.0  # L = 0.12 I and α [1/s] where gravity is learnt
START = (math.radians(60.0), math.radians(90.0))  # q(0) [rad]
TARGET = (math.radians(90.0), math.radians(90.0))  # whose image is the target X_d [rad]
REPORT_TIMES = (5.0, 20.0, 60.0, 120.0)  # times at which error ratios are reported [s]
_ROLLED = PlanarCamera(focal_length=0.05, distance=3.0, roll=math.radians(60.0))
_ALL_WRONG = PlanarCamera(focal_length=0.1, distance=4.0, roll=math.radians(60.0))
_WRONG_LENGTHS = (0.75, 1.25, 0.0)


@dataclass(frozen=True)
class Experiment:
    """One of the paper's simulations."""

    figure: int
    title: str
    paper_words: str
    camera: PlanarCamera = CAMERA  # believed
    lengths: tuple[float, float, float] = LENGTHS  # believed l̂₁, l̂₂, l̂_o [m]
    kp: float = 5000.0  # K_p = kp I [N/m]
    kv: float = 5000.0  # K_v = kv I [N s/m]
    paper_says: Verdict = "stable"
    learn_gravity: bool = False  # θ̂ starts at zero, with `LEARNING_GAIN` and `ALPHA`


_STABLE, _ALL = "a stable response", "camera and lengths wrong"
_WORST = Experiment(7, _ALL, _STABLE, _ALL_WRONG, _WRONG_LENGTHS, kv=30000.0)
EXPERIMENTS: Mapping[int, Experiment] = {
    3: Experiment(
        3, "camera roll wrong by 60°, a = 1", "an unstable response", _ROLLED, paper_says="unstable"
    ),
    4: Experiment(4, "a reduced to 0.5 by a larger K_v", _STABLE, _ROLLED, kv=10000.0),
    5: Experiment(5, "a reduced to 0.5 by a smaller K_p", _STABLE, _ROLLED, kp=2500.0),
    6: Experiment(
        6,
        "lengths of links and object wrong",
        "Effect of Uncertain Kinematics",
        lengths=_WRONG_LENGTHS,
    ),
    7: _WORST,
    8: replace(
        _WORST,
        figure=8,
        title=f"{_ALL}, gravity learnt",
        paper_words="the result of using a regressor",
        learn_gravity=True,
    ),
}


def build_arm(lengths: tuple[float, float, float] = LENGTHS) -> Robot:
    """Return the arm of lengths l₁, l₂, l_o [m] with the object, the true or a believed one."""
    l1, l2, lo = lengths
    shifts = {"joint2": (l1 - LENGTHS[0], 0.0, 0.0), "tool0_joint": (l2 - LENGTHS[1], 0.0, 0.0)}
    arm = load_robot("two_link").with_kinematic_error(shifts)
    return arm.with_object(lo, OBJECT_MASS, radius=0.0, axis="x")


def build(experiment: Experiment) -> tuple[Plant, SetpointController]:
    """Return the plant and the controller of one experiment.

    Gravity is known in Figures 3–7, as the paper assumes: as Z(q)θ, eq. (27), with the true
    θ but the believed robot's Z, so that the true lengths stay out of the controller.
    """
    truth, belief = build_arm(), build_arm(experiment.lengths)
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
        saturation=Linear(),
    )
    return Plant(truth, ImageTask(truth, CAMERA)), controller


@dataclass(frozen=True, eq=False)
class Reproduction:
    """One experiment, run."""

    experiment: Experiment
    run: Trajectory
    local: LocalStability  # the exact linearisation at the target
    theta_hat: Array | None  # at the end, shape (2,); None where gravity is known

    @property
    def settles(self) -> bool:
        """True if the run's error decays, or is nearly zero.

        The largest error of the last quarter is then below the start and 5 % below that of the
        quarter before, and the last eighth is below the eighth before.
        """
        norm = self.run.error_norm / self.run.error_norm[0]
        before, last = np.array_split(norm, 4)[2:]
        early, late = np.array_split(last, 2)
        falls = last.max() < 0.95 * before.max() and late.max() < early.max()
        return bool(last.max() < 1e-6 or (falls and last.max() < 1.0))

    @property
    def evidence_agrees(self) -> bool:
        """True if the linearisation and the run agree."""
        return self.local.stable == self.settles

    @property
    def verdict(self) -> Verdict:
        """Stable if the linearisation and the run both say so."""
        return "stable" if self.local.stable and self.settles else "unstable"

    @property
    def reason(self) -> str:
        """Evidence for the verdict, in words; says so where linearisation and run differ."""
        run = f"the run's error {'falls' if self.settles else 'does not fall'}"
        text = f"max Re λ = {self.local.max_real_eigenvalue:+.4f}, {run}"
        if self.evidence_agrees:
            return text
        growth = "" if self.local.stable else " to show the growth"
        ends = f"the run may be too short{growth}, or end elsewhere than at the target"
        return f"{text}; they differ: {ends}"

    @property
    def agrees_with_paper(self) -> bool:
        """True if the verdict is the paper's."""
        return self.verdict == self.experiment.paper_says

    @property
    def error_ratios(self) -> dict[float, float]:
        """‖e(t)‖ / ‖e(0)‖ at the `REPORT_TIMES` that the run reaches."""
        reached = [t for t in REPORT_TIMES if t <= self.run.t[-1] + 1e-9]
        norm = self.run.error_norm
        return {t: float(np.interp(t, self.run.t, norm) / norm[0]) for t in reached}


def run_experiment(
    experiment: Experiment,
    duration: float = 120.0,
    progress: Callable[[float], None] | None = None,
) -> Reproduction:
    """Simulate one experiment of some duration [s] as one differential equation and judge it.

    `progress` is called now and then with the time reached [s].
    """
    as_number("duration", duration, unit="s", above=0.0)
    plant, controller = build(experiment)
    q_target = np.array(TARGET)
    run = simulate(
        plant,
        controller,
        target=plant.sensor.value(q_target),
        q0=START,
        duration=duration,
        dt=None,
        # at most 25 ms, whatever the duration: error ratios are read between the records
        record_every=duration / max(4800, math.ceil(duration / 0.025)),
        computation=Computation(progress=progress),
    )
    theta_hat = controller.learnt(run.state)[-1] if experiment.learn_gravity else None
    return Reproduction(experiment, run, local_stability(plant, controller, q_target), theta_hat)


@dataclass(frozen=True)
class JacobianBound:
    """The largest Jacobian error allowed, for Figure 4's controller at the target."""

    lambda_2: float  # λ_min[ĴᵀĴ + B/k_v] of (23)
    alpha: float  # λ₂^½, which allows the largest p
    largest_allowed_p: float  # λ₂^½, the largest p that (23) allows for any a and α: (25)
    allowed_p_at_a_of_figure_4: float  # the largest that (23) allows for any α at its gain ratio a
    p_of_figure_4: float  # ‖Jᵀ − Ĵᵀ‖ there

    @property
    def condition_23_met(self) -> bool:
        """True if (23) holds for some α; Theorem 1 also needs (14) and (22)."""
        return self.p_of_figure_4 < self.allowed_p_at_a_of_figure_4


def jacobian_bound() -> JacobianBound:
    """Evaluate (23) and (25) on the true and believed arm of Figure 4."""
    experiment, q = EXPERIMENTS[4], np.array(TARGET)
    plant, controller = build(experiment)
    J_hat = controller.task.jacobian(q)
    lambda_2 = law.lambda_2(J_hat, plant.friction / experiment.kv)
    return JacobianBound(
        lambda_2,
        math.sqrt(lambda_2),
        law.largest_allowed_p(lambda_2),
        # for a given a the curves cross at α = λ₂/a, and there their minimum is largest
        law.allowed_p_at_crossing(lambda_2 * experiment.kv / experiment.kp, lambda_2),
        law.jacobian_error(plant.sensor.jacobian(q), J_hat),
    )
