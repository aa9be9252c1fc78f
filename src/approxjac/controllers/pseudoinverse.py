"""Where a task's Ĵ counts as near singular."""

import numpy as np

from approxjac import law
from approxjac.tasks import Task
from approxjac.tasks.analysis import image_feature, seen_configurations

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
