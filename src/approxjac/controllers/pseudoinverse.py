"""`Pseudoinverse`: the Ĵ⁺ of a set-point law, plain or weighted, damped near singularities."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from approxjac import law
from approxjac.tasks import Task
from approxjac.tasks.analysis import image_feature, seen_configurations
from approxjac.validation import Array

_LEAST = 1e-6  # ratio of singular values
_OF_POINTS = 6  # coordinates of an image, from which on it may show some motions badly
_UNUSUAL = 0.2  # of the usual σ_min/σ_max
_CONFIGURATIONS = 20


def singular_ratio(task: Task, most: float = law.SINGULAR_RATIO) -> float:
    """Return the σ_min/σ_max of Ĵ below which it counts as near singular.

    It is `most`; for images of three points or more, in which a tilt makes small differences in
    every configuration, at most a fifth of the usual ratio.
    """
    if task.m < _OF_POINTS or image_feature(task) is None:
        return most
    seen = seen_configurations(task, _CONFIGURATIONS)
    values = [np.linalg.svd(task.jacobian(q, task.value(q)), compute_uv=False) for q in seen]
    usual = float(np.median([each[-1] / each[0] for each in values]))
    return min(most, max(_UNUSUAL * usual, _LEAST))


class Pseudoinverse:
    """Ĵ⁺, damped near singular configurations as in the law.

    With a `weight` (from `tuned`), Ĵ⁺s minimizes q̇ᵀB_cq̇ over all q̇ with Ĵq̇ = s, as the arm's own
    motion towards its target does. So y of (10) is small along that motion, which disturbs learning
    less. Without one it is the Moore–Penrose inverse, as in the paper.
    """

    def __init__(self, weight: Array | None, scale: float, ratio: float) -> None:
        self.weight = weight  # as for `law.cross_weight_pinv`, shape (n_v,); None is I
        inverse_root = None if weight is None else 1.0 / np.sqrt(weight)
        self.singularity = law.Singularity(ratio, scale, inverse_root)

    def times(self, J_hat: Array, s: Array, whole: Array | None = None) -> Array:
        """Return Ĵ⁺s (n_v,); if Ĵ lacks columns, damping is judged by the `whole` Ĵ's size."""
        singularity = self.singularity
        if whole is not None:
            scale = float(np.linalg.norm(self._weighted(whole), 2))
            singularity = singularity._replace(scale=scale)
        return law.damped_pinv(J_hat, s, singularity)[0]

    def is_damped(self, J_hat: Array) -> NDArray[np.bool_]:
        """Return True where Ĵ⁺ is damped, for Ĵ (…, m, n_v); shape (…)."""
        sizes: Any = np.linalg.svd(self._weighted(J_hat), compute_uv=False)
        squares, (ratio, scale, _) = sizes**2, self.singularity
        return law.gram_damping(squares[..., -1], squares[..., 0], ratio, scale) > 0.0

    def _weighted(self, J_hat: Array) -> Array:
        inverse_root = self.singularity.inverse_root
        return J_hat if inverse_root is None else J_hat * inverse_root

    def matrix(self, J_hat: Array) -> Array:
        """Return Ĵ⁺ (n_v, m) for a Ĵ (m, n_v)."""
        return np.array([self.times(J_hat, unit) for unit in np.eye(len(J_hat))]).T
