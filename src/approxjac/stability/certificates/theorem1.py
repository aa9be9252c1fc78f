"""Test 1: Theorem 1 of the paper, with its constants taken over samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from approxjac import law
from approxjac.stability.certificates.matrix_form import Setting
from approxjac.stability.loop.samples import Samples
from approxjac.validation import Array


@dataclass(frozen=True, eq=False, repr=False)
class Theorem1:
    """The constants of Theorem 1 over a region, and what they allow.

    Attributes:
        p: Largest ‖Jᵀ − Ĵᵀ‖, eq. (7), with ∂e/∂q for J where e is not x − x_d.
        b_J: Largest ‖J‖.
        lambda_m: Largest λ_max[Ĵ⁺ᵀ M Ĵ⁺], of eq. (14).
        lambda_1: Smallest λ_min[ĴᵀK_vĴ + B] / λ_max[K_v], of eq. (21).
        lambda_2: Smallest λ_min[ĴᵀĴ + B/λ_max[K_v]], of eq. (23).
        c0: c₀ of eq. (15); it mixes units as (18) does.
        c1: c₁ of eq. (15).
        setting: Gains and damping.
        worst: Index of the sample that each constant comes from, by its name.
    """

    p: float
    b_J: float
    lambda_m: float
    lambda_1: float
    lambda_2: float
    c0: float
    c1: float
    setting: Setting
    worst: Mapping[str, int]

    def __repr__(self) -> str:
        return f"Theorem1({self})"

    def __str__(self) -> str:
        sign = "<" if self.holds else ">="
        text = f"p = {self.p:.3g} {sign} {max(self.allowed_p, 0.0):.3g} allowed"
        if not self.is_too_fast:
            return text
        allowed = f"(14) allows {self.alpha_max:.3g}"
        return f"{text}: learning has alpha = {self.alpha:.3g} 1/s, {allowed}"

    @property
    def alpha_max(self) -> float:
        """The α that (14) allows [1/s]."""
        return law.largest_alpha(self.setting.kv, self.setting.c_bar, self.lambda_m)

    @property
    def alpha(self) -> float:
        """The α that allows the largest p, or that gravity is learnt with [1/s]."""
        at = self.setting
        if at.fixed_alpha is not None:
            return at.fixed_alpha
        below = _BELOW * self.alpha_max
        return law.best_alpha(at.kp, at.kv, self.lambda_1, self.c0, self.c1, below)

    @property
    def allowed_p(self) -> float:
        """The largest p that (14) and (22) allow, at `alpha`; not positive if none."""
        if self.is_too_fast:
            return 0.0
        kp, kv = self.setting.kp, self.setting.kv
        return min(law.allowed_p(self.alpha, kp, kv, self.lambda_1, self.c0, self.c1))

    @property
    def is_too_fast(self) -> bool:
        """True if learning has a larger α than (14) allows."""
        return self.setting.fixed_alpha is not None and self.alpha >= self.alpha_max

    @property
    def margin(self) -> float:
        """1 − p / allowed p, positive if Theorem 1 holds; −∞ if it allows no p at all."""
        allowed = self.allowed_p
        return 1.0 - self.p / allowed if allowed > 0.0 else -np.inf

    @property
    def holds(self) -> bool:
        """True if (14) and (22) hold for some α."""
        return self.margin > 0.0


CONSTANTS = ("p", "b_J", "lambda_m", "lambda_1", "lambda_2", "c0", "c1")
_BELOW = 0.999  # (14) is strict


def constants(samples: Samples, setting: Setting) -> dict[str, Array]:
    """Return each constant as it is for each sample alone, shape (N,), by name."""
    J, J_hat, kv, B = samples.J, samples.J_hat, setting.kv, setting.B
    D = law.dissipation(J_hat, kv, B)
    G, dG = law.cross_weight_pinv(J_hat, samples.dJ_hat, setting.weight)
    N = law.inertial_block(samples.M, samples.dM, samples.J_e, G, dG, samples.s, samples.slope)
    metric = G.mT @ samples.M @ G
    smallest = np.maximum(np.linalg.eigvalsh(D)[:, 0], 0.0) / float(kv.max())
    also = smallest  # of equal gains D/k_v is the matrix of λ₂
    if (kv != kv[0]).any():
        uniform = law.dissipation(J_hat, np.ones_like(kv), B / float(kv.max()))
        also = np.maximum(np.linalg.eigvalsh(uniform)[:, 0], 0.0)
    # the damping's αs(e)ᵀĴ⁺ᵀBq̇ is shared out by (18)
    c1 = 0.5 * _norm((B[:, None] * G).mT)
    return {
        "p": _norm(samples.J_e - J_hat),
        "b_J": _norm(J),
        "lambda_m": np.linalg.eigvalsh(metric)[:, -1],
        "lambda_1": smallest,
        "lambda_2": also,
        "c0": c1 + np.abs(np.linalg.eigvalsh(N)).max(axis=-1),
        "c1": c1,
    }


def _norm(A: Array) -> Array:
    """Return ‖A‖ of wide matrices (N, m, n), shape (N,): of AAᵀ, which takes a third of an SVD."""
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(A @ A.mT)[:, -1], 0.0)))


def badness(name: str, values: Array) -> Array:
    """Return values that are large where a constant is unfavourable."""
    return -values if name in ("lambda_1", "lambda_2") else values


def theorem1(samples: Samples, setting: Setting) -> Theorem1:
    """Take the constants of Theorem 1 over all samples."""
    each = constants(samples, setting)
    worst = {name: int(np.argmax(badness(name, values))) for name, values in each.items()}
    return Theorem1(
        **{name: float(each[name][k]) for name, k in worst.items()}, setting=setting, worst=worst
    )
