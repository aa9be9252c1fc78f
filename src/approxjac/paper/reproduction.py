"""Results of the study: a simulation judged, and the bound of Figure 1."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from approxjac import law
from approxjac.paper.experiments import EXPERIMENTS, Experiment, Setup, Verdict, build
from approxjac.simulation import Computation, Trajectory, simulate
from approxjac.stability import LocalStability, local_stability
from approxjac.validation import Array

REPORT_TIMES = (5.0, 20.0, 60.0, 120.0)
"""Times at which error ratios are reported [s]."""


@dataclass(frozen=True, eq=False)
class Reproduction:
    """One experiment, run."""

    experiment: Experiment
    run: Trajectory
    local: LocalStability  # the exact linearisation at the target
    theta_hat: Array | None  # at the end, shape (2,); None where gravity is known

    @property
    def settles(self) -> bool:
        """Tell if the run's error dies down, or is all but gone.

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
        """Tell if the linearisation and the run say the same."""
        return self.local.stable == self.settles

    @property
    def verdict(self) -> Verdict:
        """Stable if the linearisation and the run both say so."""
        return "stable" if self.local.stable and self.settles else "unstable"

    @property
    def reason(self) -> str:
        """Evidence for the verdict, in words; says so where linearisation and run differ."""
        run = f"the run's error {'falls' if self.settles else 'does not fall'}"
        if self.local.singular:
            where = "the target is a singular configuration"
            return f"{where}, where the linearisation decides nothing; {run}"
        text = f"max Re λ = {self.local.max_real_eigenvalue:+.4f}, {run}"
        if self.evidence_agrees:
            return text
        growth = "" if self.local.stable else " to show the growth"
        ends = f"the run may be too short{growth}, or end elsewhere than at the target"
        return f"{text}; they differ: {ends}"

    @property
    def agrees_with_paper(self) -> bool:
        """Tell if the verdict is the paper's."""
        return self.verdict == self.experiment.paper_says

    @property
    def error_ratios(self) -> dict[float, float]:
        """‖e(t)‖ / ‖e(0)‖ at the `REPORT_TIMES` that the run reaches."""
        reached = [t for t in REPORT_TIMES if t <= self.run.t[-1] + 1e-9]
        return {t: self.run.error_ratio(t) for t in reached}


def run_experiment(
    experiment: Experiment, setup: Setup, progress: Callable[[float], None] | None = None
) -> Reproduction:
    """Simulate one experiment as one differential equation and judge it.

    `progress` is called now and then with the time reached [s].
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
        # at most 25 ms, whatever the duration: error ratios are read between the records
        record_every=setup.duration / max(4800, math.ceil(setup.duration / 0.025)),
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
        """Tell if (23) holds for some α; Theorem 1 asks for (14) and (22) besides."""
        return self.p_of_figure_4 < self.allowed_p_at_a_of_figure_4


def jacobian_bound(setup: Setup) -> JacobianBound:
    """Evaluate (23) and (25) on the true and believed arm of Figure 4."""
    experiment, q = EXPERIMENTS[4], np.array(setup.target)
    plant, controller = build(experiment, setup)
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
