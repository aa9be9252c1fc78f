"""Singular configurations of Ĵ within a region: no sample hits it, and no test holds there.

At a singular configuration Ĵᵀ K_p s = 0 for some s ≠ 0: the arm may stand still there, away from
its target. G = αĴ⁺ does not exist, and with G = αD⁻¹ĴᵀK_v the block sym(K_pĴG) of Q is singular.
The margins are relative to that block, so they stay positive however near a singularity is.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from approxjac.stability.closed_loop import ClosedLoop
from approxjac.stability.samples import Samples
from approxjac.tasks import Task
from approxjac.tasks.analysis import vanishing
from approxjac.validation import Array

_STARTS = 5
_STEPS = 20
_HALVINGS = 8
_SINGULAR = 1e-4  # of a tenth of the typical σ_max


def singular_configuration(loop: ClosedLoop, samples: Samples) -> Array | None:
    """Return a configuration (nq,) of the region where Ĵ loses rank, or None if none is found.

    Newton steps towards σ_min(Ĵ) = 0 from the least regular samples, halved until they stay in the
    region and lead nearer.
    """
    task = loop.controller.task
    sizes = np.linalg.svd(samples.J_hat, compute_uv=False)[:, -1]
    tiny = _SINGULAR * vanishing(task)
    for k in np.argsort(sizes)[:_STARTS]:
        part = loop.parts[int(samples.truth[k])]
        q: Array = samples.q[k]
        size, gradient = _sigma_min(task, q)
        for _ in range(_STEPS):
            if size <= tiny:
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
