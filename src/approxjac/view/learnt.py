"""The tip of the believed arm while its kinematics are learnt."""

from __future__ import annotations

import numpy as np

from approxjac.robots import KinematicRegressor
from approxjac.simulation.trajectory import Scene
from approxjac.tasks import Task
from approxjac.tasks.analysis import features
from approxjac.tasks.task import Feature
from approxjac.validation import Array


def followed(task: Task | None) -> Feature | None:
    """Return the part of a task that is looked at: its first position, or else its first image."""
    parts = features(task)
    return next((part for part in parts if part.axes), parts[0] if parts else None)


def learnt_regressor(scene: Scene) -> KinematicRegressor | None:
    """Return p(q) of the tip that is followed, where a run learns its translations, or None."""
    feature = followed(scene.task) if scene.parameters else None
    if scene.belief is None or feature is None or feature.frame is None:
        return None  # or a camera in hand, which watches points of the world
    regressor = KinematicRegressor(scene.belief, feature.frame, feature.points[:1])
    return regressor if set(regressor.names) & set(scene.parameters) else None


def learnt_tips(scene: Scene, q: Array, learnt: Array) -> Array | None:
    """Return the tip's positions by the translations learnt so far, shape (N, 3) [m].

    For configurations q (N, nq) and what was learnt (N, p); None where a run does not learn them.
    """
    regressor = learnt_regressor(scene)
    if regressor is None:
        return None
    theta = np.tile(regressor.theta, (len(q), 1))
    for name, values in zip(scene.parameters, learnt.T, strict=True):
        if name in regressor.names:
            theta[:, regressor.names.index(name)] = values
    return np.array([regressor.position(*row) for row in zip(q, theta, strict=True)])
