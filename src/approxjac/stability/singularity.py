"""Where Ĵ loses rank within a region: no sample hits such postures, and no test holds there.

At a singular posture Ĵᵀ K_p s = 0 for some s ≠ 0: the arm may stand still there, away from its
target. G = αĴ⁺ does not exist, and with G = αD⁻¹ĴᵀK_v the block sym(K_pĴG) of Q is singular. The
margins are relative to that block, so they stay positive however near such a posture is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from approxjac.stability.samples import Scenarios
from approxjac.stability.visibility import SeenPart
from approxjac.tasks import Task
from approxjac.tasks.analysis import vanishing
from approxjac.validation import Array

_STARTS = 5
_STEPS = 20
_SINGULAR = 1e-4  # of a tenth of the typical σ_max


def singular_posture(parts: Sequence[SeenPart], task: Task, scenarios: Scenarios) -> Array | None:
    """A posture (nq,) where Ĵ loses rank, or None if the search finds none.

    Newton steps towards σ_min(Ĵ) = 0 from the least regular of the scenarios, halved until they
    stay in the region.

    Args:
        parts: The region as each true robot's sensor sees it.
        task: The believed task.
        scenarios: Where to start.
    """
    sizes = np.linalg.svd(scenarios.J_hat, compute_uv=False)[:, -1]
    tiny = _SINGULAR * vanishing(task)
    for k in np.argsort(sizes)[:_STARTS]:
        part = parts[int(scenarios.truth[k])]
        q, size, gradient = _approach(task, scenarios.q[k])
        for _ in range(_STEPS):
            if size <= tiny:
                return q
            step = -size * gradient / max(float(gradient @ gradient), 1e-300)
            found = _shorter(part, task, q, step, size)
            if found is None:
                break
            q, size, gradient = found
    return None


def _approach(task: Task, q: Array) -> tuple[Array, float, Array]:
    """A posture, its σ_min(Ĵ), and ∂σ_min/∂q = uᵀ(∂Ĵ/∂q_k)v, shape (n_v,)."""
    U, values, rows = np.linalg.svd(task.jacobian(q))
    u, v = U[:, -1], rows[len(values) - 1]
    gradient = np.array([u @ task.jacobian_dot(q, unit) @ v for unit in np.eye(task.robot.nv)])
    return q, float(values[-1]), gradient


def _shorter(
    part: SeenPart, task: Task, q: Array, step: Array, size: float
) -> tuple[Array, float, Array] | None:
    """What a step leads to, halved until that is in the region and nearer to singular."""
    for _ in range(8):
        moved = np.array(pin.integrate(task.robot.model, q, step))
        if part.contains(moved):
            found = _approach(task, moved)
            if found[1] < size:
                return found
        step = 0.5 * step
    return None
