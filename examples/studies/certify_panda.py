"""Count the configurations of a Panda that one Lyapunov function certifies, at large gains.

In that limit inertia plays no part and the motion is D q̇ = −ĴᵀK_p s(e) with D = ĴᵀK_vĴ + B. Here
K_p = a k_v I and B = βk_v I; the tool is believed absent. The numbers do not depend on k_v and,
with α and w counted in a, not on a either. Both are 1 below.

    python examples/studies/certify_panda.py --out results/certify
"""

import sys
from typing import NamedTuple

import numpy as np
from common import head, parser, row, write

import approxjac as aj
from approxjac import law

TOOLS = ((0.2, 0.03), (0.2, 0.1), (0.3, 0.1), (0.3, 0.3))  # length [m] and β [m²] of each row
REGULAR = 0.1  # least σ_min(Ĵ) [m/rad]
REFINEMENTS = 3


class Shares(NamedTuple):
    """Shares of the configurations, by what certifies them."""

    length: float  # of the tool [m]
    beta: float  # B over k_v [m²]
    paper: float  # G = αĴ⁺ and w = k_p + αk_v
    half: float  # G = αĴ⁺ and one w of at least half of that
    free: float  # G = αĴ⁺ and any one w > 0
    wide: float  # G = αD⁻¹ĴᵀK_v and any one w > 0
    falling: float  # ½‖e‖² falls whatever e is
    local: float  # stable targets


def shares(length, beta, count):
    """Search the one α and w that certify most configurations, family by family."""
    J, J_hat = jacobians(length, count)
    J_hat_T = np.swapaxes(J_hat, -1, -2)
    D = law.dissipation(J_hat, np.ones(J.shape[-2]), np.full(J.shape[-1], beta))
    forced = np.linalg.solve(D, J_hat_T)
    pinv = Family(D, J, J_hat, np.swapaxes(np.linalg.solve(J_hat @ J_hat_T, J_hat), -1, -2))
    flow = J @ forced
    return Shares(
        length,
        beta,
        pinv.best(1.0, 1.0),
        pinv.best(0.5, 1.5),
        pinv.best(0.01, 1.5),
        Family(D, J, J_hat, forced).best(0.01, 1.5),
        float((np.linalg.eigvalsh(flow + np.swapaxes(flow, -1, -2))[:, 0] > 0.0).mean()),
        float((np.linalg.eigvals(flow).real.min(axis=-1) > 0.0).mean()),
    )


def jacobians(length, count):
    """Return J and Ĵ at seeded configurations, shape (count, 3, 7)."""
    rng = np.random.default_rng(0)
    arm = aj.load_robot("panda")
    sensor, task = aj.PositionTask(arm.with_object(length)), aj.PositionTask(arm)
    found = []
    while len(found) < count:
        q = arm.random_configuration(rng)
        J_hat = task.jacobian(q)
        if np.linalg.svd(J_hat, compute_uv=False)[-1] > REGULAR:
            found.append((np.array(sensor.jacobian(q)), np.array(J_hat)))
    return (np.array(part) for part in zip(*found, strict=True))


class Family:
    """Condition Q ≻ 0 of a cross weight αG at all configurations, ready for any α and w.

    Q = [[D, C], [·, αA]] with 2C = αDG + Ĵᵀ − wJᵀ is positive where αA − CᵀD⁻¹C is, and that is a
    quadratic function of (α, 1, w) whose coefficients need computing once only.
    """

    def __init__(self, D, J, J_hat, G):
        parts = [D @ G, np.swapaxes(J_hat, -1, -2), -np.swapaxes(J, -1, -2)]
        solved = [np.linalg.solve(D, part) for part in parts]
        self.gram = np.array([[np.swapaxes(a, -1, -2) @ b for b in solved] for a in parts])
        self.A = law.stiffness_block(J_hat, G, np.ones(J.shape[-2]))

    def share(self, alpha, w):
        """Return the share of the configurations with Q ≻ 0."""
        y = np.array([alpha, 1.0, w])
        rest = alpha * self.A - 0.25 * np.einsum("a,b,ab...->...", y, y, self.gram)
        return float((np.linalg.eigvalsh(rest)[:, 0] > 0.0).mean())

    def best(self, lowest, highest):
        """Return the largest share with w/(1 + α) within bounds, by a grid that is made finer."""
        best = self.search(np.geomspace(0.03, 10.0, 24), np.geomspace(lowest, highest, 16))
        for k in range(REFINEMENTS):
            _, alpha, scale = best
            finer = 1.3 ** (np.linspace(-1.0, 1.0, 9) / 2.0**k)
            scales = np.clip(scale * finer, lowest, highest)
            best = max(best, self.search(alpha * finer, scales))
        return best[0]

    def search(self, alphas, scales):
        """Return the largest share on a grid, with its α and w/(1 + α)."""
        return max(
            (self.share(alpha, scale * (1.0 + alpha)), float(alpha), float(scale))
            for alpha in alphas
            for scale in np.unique(scales)
        )


def table(rows, count):
    """Return the shares as a Markdown table."""
    lines = head(
        "tool", "B / k_v", "paper's weights", "free, w at least half of the paper's", "free",
        "widened", "½‖e‖² falls", "locally stable",
    )  # fmt: skip
    for mine in rows:
        values = (f"{100 * value:.1f} %" for value in mine[2:])
        lines.append(row(f"{100 * mine.length:.0f} cm", f"{mine.beta:g}", *values))
    error = f"sampling error up to {100 / count**0.5:.1f} % (2 σ)"
    return "\n".join([*lines, "", f"{count} configurations a row; {error}."]) + "\n"


def main(arguments=None):
    """Run the study; return the exit code."""
    given = parser(__doc__, "results/certify_panda").parse_args(arguments)
    count = 200 if given.quick else 2000
    rows = [shares(length, beta, count) for length, beta in TOOLS]
    write(given.out, {"certify_panda.md": table(rows, count)}, {"count": count, "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
