"""Figure 1: the Jacobian error that Theorem 1 allows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from approxjac import law
from approxjac.paper.experiments import EXPERIMENTS, Setup, build


@dataclass(frozen=True)
class JacobianBound:
    """Figure 1: the largest Jacobian error allowed, for Figure 4's controller at the target.

    Attributes:
        lambda_2: λ₂ = λ_min[ĴᵀĴ + B/k_v] of (23).
        alpha: λ₂^½, which allows the largest p.
        largest_allowed_p: λ₂^½, the largest p that (23) allows for any a and α: (25).
        allowed_p_at_a_of_figure_4: The largest p that (23) allows for any α at its gain ratio a.
        p_of_figure_4: ‖Jᵀ − Ĵᵀ‖ there.
    """

    lambda_2: float
    alpha: float
    largest_allowed_p: float
    allowed_p_at_a_of_figure_4: float
    p_of_figure_4: float

    @property
    def condition_23_met(self) -> bool:
        """Tell if (23) holds for some α; Theorem 1 asks for (14) and (22) besides."""
        return self.p_of_figure_4 < self.allowed_p_at_a_of_figure_4


def jacobian_bound(setup: Setup) -> JacobianBound:
    """Evaluate (23) and (25) on the true and believed arm of Figure 4."""
    experiment = EXPERIMENTS[4]
    plant, controller = build(experiment, setup)
    q = np.array(setup.target)
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
