"""The search for configurations of a region where Ĵ is singular, or nearly so."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pinocchio as pin

from approxjac.stability.loop.samples import Samples
from approxjac.stability.loop.visibility import VisiblePart
from approxjac.tasks import Task
from approxjac.validation import Array

_STARTS, _STEPS, _HALVINGS = 5, 20, 8


def least_regular(
    task: Task,
    parts: Sequence[VisiblePart],
    samples: Samples,
    wanted: Callable[[Array, float], bool],
) -> Array | None:
    """Return a configuration (nq,) that is wanted by itself and its σ_min(Ĵ), or None.

    Newton steps towards σ_min(Ĵ) = 0 from the least regular samples, halved until they stay in
    the region and lead nearer.

    Args:
        task: The believed task.
        parts: The region as each true robot's sensor sees it.
        samples: To begin at.
        wanted: Whether a configuration is one, with its σ_min(Ĵ).
    """
    sizes = np.linalg.svd(samples.J_hat, compute_uv=False)[:, -1]
    for k in np.argsort(sizes)[:_STARTS]:
        part = parts[int(samples.truth[k])]
        q: Array = samples.q[k]
        size, gradient = _sigma_min(task, q)
        for _ in range(_STEPS):
            if wanted(q, size):
                return q
            step = -size * gradient / max(float(gradient @ gradient), 1e-300)
            for halving in range(_HALVINGS):
                moved = np.array(pin.integrate(task.robot.model, q, 0.5**halving * step))
                if part.contains(moved):
                    nearer, its_gradient = _sigma_min(task, moved)
                    if nearer < size:
                        break
            else:
                break
            q, size, gradient = moved, nearer, its_gradient
    return None


def _sigma_min(task: Task, q: Array) -> tuple[float, Array]:
    """Return σ_min(Ĵ) and ∂σ_min/∂q = uᵀ(∂Ĵ/∂q_k)v, shape (n_v,)."""
    U, values, rows = np.linalg.svd(task.jacobian(q))
    u, v = U[:, -1], rows[len(values) - 1]
    gradient = np.array([u @ task.jacobian_dot(q, unit) @ v for unit in np.eye(task.robot.nv)])
    return float(values[-1]), gradient
