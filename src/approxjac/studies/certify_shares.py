"""Share of a Panda's postures that one Lyapunov function certifies, in the limit of large gains.

In that limit inertia plays no part and the motion is D q̇ = −ĴᵀK_p s(e) with D = ĴᵀK_vĴ + B. Here
K_p = a k_v I and B = βk_v I; the tool is believed absent. The numbers do not depend on k_v and,
with α and w counted in a, not on a either. Both are 1 below.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from approxjac import law
from approxjac.robots import load_robot
from approxjac.tasks import PositionTask
from approxjac.validation import Array

TOOLS = ((0.2, 0.03), (0.2, 0.1), (0.3, 0.1), (0.3, 0.3))
"""Length of the tool [m] and β of each row."""
_REGULAR = 0.1  # least σ_min(Ĵ) [m/rad]
_REFINEMENTS = 3


class Shares(NamedTuple):
    """Shares of the postures, by what certifies them.

    Attributes:
        length: Of the tool [m].
        beta: B over k_v [m²].
        postures: Number of postures.
        paper: G = αĴ⁺ and w = k_p + αk_v.
        half: G = αĴ⁺ and one w of at least half of that.
        free: G = αĴ⁺ and any one w > 0.
        wide: G = αD⁻¹ĴᵀK_v and any one w > 0.
        falling: Postures where ½‖e‖² falls whatever e is.
        local: Postures that are stable targets.
    """

    length: float
    beta: float
    postures: int
    paper: float
    half: float
    free: float
    wide: float
    falling: float
    local: float


def shares(length: float, beta: float, postures: int = 2000, seed: int = 0) -> Shares:
    """Search the one α and w that certify most postures, family by family."""
    J, J_hat = jacobians(length, postures, seed)
    kv = np.ones(J.shape[-2])
    D = law.dissipation(J_hat, kv, np.full(J.shape[-1], beta))
    forced = np.asarray(np.linalg.solve(D, np.swapaxes(J_hat, -1, -2)), dtype=np.float64)
    pseudo_inverse: Array = np.swapaxes(
        np.linalg.solve(J_hat @ np.swapaxes(J_hat, -1, -2), J_hat), -1, -2
    )
    pinv, damped = _Family(D, J, J_hat, pseudo_inverse), _Family(D, J, J_hat, forced)
    flow = J @ forced
    return Shares(
        length,
        beta,
        postures,
        pinv.best(1.0, 1.0),
        pinv.best(0.5, 1.5),
        pinv.best(0.01, 1.5),
        damped.best(0.01, 1.5),
        float((np.linalg.eigvalsh(flow + np.swapaxes(flow, -1, -2))[:, 0] > 0.0).mean()),
        float((np.linalg.eigvals(flow).real.min(axis=-1) > 0.0).mean()),
    )


def jacobians(length: float, postures: int, seed: int) -> tuple[Array, Array]:
    """J and Ĵ at postures drawn uniformly within the joint limits, where Ĵ is regular."""
    rng = np.random.default_rng(seed)
    arm = load_robot("panda")
    sensor, task = PositionTask(arm.with_object(length)), PositionTask(arm)
    found: list[tuple[Array, Array]] = []
    while len(found) < postures:
        q = arm.random_configuration(rng)
        J_hat = task.jacobian(q)
        if np.linalg.svd(J_hat, compute_uv=False)[-1] > _REGULAR:
            found.append((np.array(sensor.jacobian(q)), np.array(J_hat)))
    J, J_hat = (np.array(part) for part in zip(*found, strict=True))
    return J, J_hat


class _Family:
    """Condition Q ≻ 0 of a cross weight αG at all postures, ready for any α and w.

    Q = [[D, C], [·, αA]] with 2C = αDG + Ĵᵀ − wJᵀ is positive where αA − CᵀD⁻¹C is, and that is a
    quadratic function of (α, 1, w) whose coefficients need computing once only.
    """

    def __init__(self, D: Array, J: Array, J_hat: Array, G: Array) -> None:
        parts = [D @ G, np.swapaxes(J_hat, -1, -2), -np.swapaxes(J, -1, -2)]
        solved = [np.linalg.solve(D, part) for part in parts]
        self._gram = np.array([[np.swapaxes(a, -1, -2) @ b for b in solved] for a in parts])
        self._A = law.stiffness_block(J_hat, G, np.ones(J.shape[-2]))

    def share(self, alpha: float, w: float) -> float:
        """Share of the postures with Q ≻ 0."""
        y = np.array([alpha, 1.0, w])
        rest = alpha * self._A - 0.25 * np.einsum("a,b,ab...->...", y, y, self._gram)
        return float((np.linalg.eigvalsh(rest)[:, 0] > 0.0).mean())

    def best(self, lowest: float, highest: float) -> float:
        """Largest share with w within bounds, each times 1 + α; by a grid that is made finer."""
        alphas, scales = np.geomspace(0.03, 10.0, 24), np.geomspace(lowest, highest, 16)
        share, alpha, scale = self._search(alphas, scales)
        for k in range(_REFINEMENTS):
            finer = 1.3 ** (np.linspace(-1.0, 1.0, 9) / 2.0**k)
            candidates = np.clip(scale * finer, lowest, highest)
            share, alpha, scale = max(
                (share, alpha, scale), self._search(alpha * finer, candidates)
            )
        return share

    def _search(self, alphas: Array, scales: Array) -> tuple[float, float, float]:
        return max(
            (self.share(alpha, scale * (1.0 + alpha)), float(alpha), float(scale))
            for alpha in alphas
            for scale in np.unique(scales)
        )


def run(postures: int = 2000) -> list[Shares]:
    """The rows of the table."""
    return [shares(length, beta, postures) for length, beta in TOOLS]


def table(rows: Sequence[Shares]) -> str:
    """Return the shares as a Markdown table."""
    lines = [
        "| tool | B / k_v | paper's weights | free, w at least half of the paper's | free | "
        "widened | ½‖e‖² falls | locally stable |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [f"{100 * row.length:.0f} cm", f"{row.beta:g}"]
        cells += [f"{100 * value:.1f} %" for value in row[3:]]
        lines.append(f"| {' | '.join(cells)} |")
    count = rows[0].postures
    lines += ["", f"{count} postures a row; sampling error up to {100 / count**0.5:.1f} % (2 σ)."]
    return "\n".join(lines) + "\n"
