"""`CrossWeight`: the G(q) of a Lyapunov function, which a limiter can keep falling."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from approxjac import law
from approxjac.controllers.setpoint import SetpointController
from approxjac.errors import InvalidInputError
from approxjac.interface import Evaluation, Status
from approxjac.validation import Array, as_array, as_diagonal, require

_SAME = 1e-9  # relative


@dataclass(frozen=True, eq=False, repr=False)
class CrossWeight:
    """G = Ĵ⁺A₁ + D⁻¹ĴᵀK_vA₂ of V = ½q̇ᵀMq̇ + q̇ᵀMGs(e) + Σ wᵢSᵢ(eᵢ), with D = ĴᵀK_vĴ + B.

    Whatever w is, another torque τ in place of the law's τ* changes V̇ by yᵀ(τ − τ*), y = q̇ + Gs(e).
    `StabilityReport.cross_weight` is that of the function that certifies.

    Attributes:
        A1: Shape (m, m) [1/s]; αI in the paper.
        A2: Shape (m, m) [1/s]; 0 in the paper.
        damping: Diagonal of B, shape (n_v,): all viscous damping, of the law and of the arm
            [N m s/rad or N s/m].
    """

    A1: Array
    A2: Array
    damping: Array

    def __repr__(self) -> str:
        wide = "Ĵ⁺A₁ + D⁻¹ĴᵀK_vA₂" if np.any(self.A2) else "Ĵ⁺A₁"
        return f"CrossWeight({wide}, {len(self.A1)} task coordinates)"

    def is_like(self, other: CrossWeight) -> bool:
        """Return True if this is the same G as another one, but for round-off."""
        size = max(float(np.abs(self.A1).max()), float(np.abs(self.A2).max()))
        pairs = (self.A1, other.A1), (self.A2, other.A2)
        return all(
            mine.shape == its.shape and np.allclose(mine, its, rtol=_SAME, atol=_SAME * size)
            for mine, its in pairs
        ) and (not np.any(self.A2) or np.allclose(self.damping, other.damping, rtol=_SAME))

    def passive_output(self, controller: Any, answer: Evaluation, v: Array) -> Array:
        """Return y = q̇ + Gs(e) where a law gave an answer, shape (n_v,) [rad/s or m/s].

        It is q̇ where the law says that there is no V: without x, and without Ĵ⁺.
        """
        e, J_hat = answer.e, answer.J_hat
        if answer.status is not Status.OK or J_hat is None or not math.isfinite(e.dot(e)):
            return v
        s = controller.saturation.s(e)
        y = v + controller.pinv.times(J_hat, self.A1.dot(s))
        if self.A2.any():
            kv = controller.diagonals.kv
            D = law.dissipation(J_hat, kv, self.damping)
            y = y + np.linalg.solve(D, J_hat.T.dot(kv * self.A2.dot(s)))
        return np.asarray(y)

    def required_of(self, controller: Any) -> CrossWeight:
        """Return this with arrays of its own, or refuse it for a law.

        Raises:
            InvalidInputError: No `SetpointController`, other shapes than its own, negative damping,
                or another G than that which learns gravity.
        """
        wanted = "a SetpointController, with a cross_weight"
        require("controller", controller, SetpointController, wanted)
        m, nv = controller.task.m, controller.task.robot.nv
        A1, A2 = (
            as_array(f"{name} of cross_weight", value, (m, m), "1/s")
            for name, value in (("A1", self.A1), ("A2", self.A2))
        )
        damping = as_diagonal("damping of cross_weight", self.damping, nv, positive=False)
        learning = controller.adaptation
        if learning is not None and not (
            np.allclose(A1, learning.alpha * np.eye(m), rtol=_SAME) and not A2.any()
        ):
            raise InvalidInputError(
                f"cross_weight must be that with which gravity is learnt, A1 = "
                f"{learning.alpha:g} I [1/s] and A2 = 0, got A1 = {A1.tolist()} and "
                f"A2 = {A2.tolist()}",
                given=self,
            )
        return CrossWeight(A1, A2, damping)
